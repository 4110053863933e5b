"""exchange.c: compiled by the system's `cc` with the messages' CRC_EXTRA from the dialect, and flown."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

from mavsitl import pair
from mavsitl.dialect import mavlink

SOURCE = Path(__file__).with_suffix(".c")
MESSAGES = (
    "heartbeat", "sys_status", "attitude", "attitude_quaternion", "local_position_ned", "set_attitude_target",
    "extended_sys_state", "odometry",
)  # fmt: skip


class Exchange(NamedTuple):
    """One flight."""

    speed: float
    """Times real time."""
    off_m: float
    """From its hover, at the end."""
    bytes_out: float
    """A tick, of the vehicle."""
    bytes_in: float


def build(folder: Path) -> Path | None:
    """The program, in `folder`; None where there is no compiler. Raises `CalledProcessError` where it fails."""
    compiler = shutil.which("cc")
    if compiler is None:
        return None
    program = folder / "exchange"
    extras = [
        f"-DCRC_{name.upper()}={getattr(mavlink, f'MAVLink_{name}_message').crc_extra}" for name in MESSAGES
    ]  # fmt: skip
    subprocess.run(
        [compiler, "-O2", "-std=gnu11", "-Wall", "-Wextra", *extras, "-o", str(program), str(SOURCE), "-lm"], check=True
    )
    return program


def fly(program: Path, duration_s: float) -> Exchange:
    """Both ends, on the cores that this process may use. Raises `RuntimeError` where the vehicle fails."""
    here, there = map(str, pair.free_ports(2))
    with subprocess.Popen([str(program), "ground", there, here]) as ground:
        try:
            vehicle = subprocess.run(
                [str(program), "vehicle", here, there, str(duration_s)], capture_output=True, text=True, check=False,
                timeout=600.0,
            )  # fmt: skip
        finally:
            ground.terminate()
    if vehicle.returncode:
        raise RuntimeError(f"the C program's vehicle failed: {vehicle.stderr}")
    return Exchange(*map(float, vehicle.stdout.split()))
