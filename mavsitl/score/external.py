"""Programs that speak MAVLink, on the board: the vehicle in real time on free ports, judged by its own log alone.

A program is told by its command line where the vehicle is heard and what is to be flown::

    --program "python my_client.py {url} {reference}"

``{url}``
    The vehicle's off-board link as MAVSDK writes it, udpin://127.0.0.1:PORT: the program listens there.
``{endpoint}``, ``{port}``
    The same as pymavlink and `mavsitl` write it, udpin:127.0.0.1:PORT; and the number alone.
``{reference}``
    A CSV file: where the vehicle is to be, in NED, 50 rows a second (`COLUMNS`).
``{duration}``
    Flight time in seconds, which is the last row's.

It takes OFFBOARD, arms, and follows. Until the vehicle is in the air the program asks for a place above the first row,
a metre say: a vehicle at rest rises where it is asked to, and the clamp that holds it lets go then. Time 0 of the
reference is the release: when the vehicle's EXTENDED_SYS_STATE says for the first time that it is in the air. What is
measured is the truth of the vehicle's log, from the release on.
"""

from __future__ import annotations

import csv
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from mavsitl import ends, wings
from mavsitl.campaign.errors import GridError
from mavsitl.campaign.fly import Row, Status
from mavsitl.campaign.grid import Labels, source_digest
from mavsitl.campaign.sums import LOST_M, Sums
from mavsitl.clock import monotonic_us
from mavsitl.controllers import AttitudeDemand
from mavsitl.frames import flip_euler, flip_vector
from mavsitl.link.udp import LOOPBACK
from mavsitl.log import topics
from mavsitl.log.flight import VEHICLE_LOG
from mavsitl.log.ulog import LogError, read
from mavsitl.pair import free_ports
from mavsitl.quaternion import to_euler
from mavsitl.report.run import scenario_digest
from mavsitl.scenario import Flight

REFERENCE_HZ = 50
COLUMNS = (
    "time_s", "north_m", "east_m", "down_m", "v_north_m_s", "v_east_m_s", "v_down_m_s",
    "a_north_m_s2", "a_east_m_s2", "a_down_m_s2", "yaw_deg",
)  # fmt: skip
"""Of `{reference}`; the heading clockwise from north."""

TAKE_OFF_S = 60.0
"""Wall clock for a program to bring the vehicle into the air."""
ENDING_S = 5.0
"""Wall clock for a program to end when it is told to."""
MARGIN_S = 0.1
"""So much beyond the flight's end the vehicle runs on, so that the log has all of it."""

PLACES = ("url", "endpoint", "port", "reference", "duration")
_PLACE = re.compile(r"\{(\w*)\}")

Table = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Program:
    """A command line with places to fill in."""

    name: str
    words: tuple[str, ...]

    @classmethod
    def parse(cls, text: str) -> Program:
        """COMMAND or NAME=COMMAND. Raises `GridError` for a place that is none and for a program that is not told
        where the vehicle is.
        """
        named = re.match(r"\s*([\w.-]+)=(.*)", text, re.S)
        name, command = (named[1], named[2]) if named else ("", text)
        try:
            words = tuple(shlex.split(command))
        except ValueError as error:
            raise GridError(f"--program {text}: {error}") from error
        allowed = ", ".join(f"{{{place}}}" for place in PLACES)
        found = _PLACE.findall(command)
        for place in found:
            if place not in PLACES:
                raise GridError(f"--program {text}: {{{place}}} is not allowed; allowed: {allowed}")
        if not {"url", "endpoint", "port"} & set(found):
            raise GridError(f"--program {text}: nothing says where the vehicle is; allowed: {allowed}")
        script = next((word for word in words if word.endswith((".py", ".sh"))), words[0])
        return cls(name or Path(script).name, words)

    def filled(self, **places: str) -> list[str]:
        return [_PLACE.sub(lambda found: places[found[1]], word) for word in self.words]


def fly(
    program: Program, flight: Flight, folder: Path, labels: Labels, *,
    speed: float = 1.0, move: Callable[[float], None] = lambda time_s: None,
) -> Row:  # fmt: skip
    """One flight, on the wall clock times `speed`; `folder` gets the vehicle's log, the reference and the output.

    `move` is told the flight time. Whatever goes wrong with the program is the row. Raises `LinkError`, `LogError`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    scenario = flight.scenario
    duration_s = scenario.duration_s
    path = wings.find(wings.REFERENCE_GROUP)(scenario.reference)
    write_reference(folder / "reference.csv", path, duration_s)
    own, remote, gcs, gcs_remote = free_ports(4)
    links = ends.VehicleLinks(
        offboard_port=own, offboard_remote=(LOOPBACK, remote), gcs_port=gcs, gcs_remote=(LOOPBACK, gcs_remote)
    )
    words = program.filled(
        url=f"udpin://{LOOPBACK}:{remote}", endpoint=f"udpin:{LOOPBACK}:{remote}", port=str(remote),
        reference=str((folder / "reference.csv").absolute()), duration=f"{duration_s:g}",
    )  # fmt: skip

    def row(status: Status, message: str = "", sums: Sums | None = None) -> Row:
        measured = sums if sums is not None else Sums(flight)
        return Row(
            key="", scenario=flight.name, seed=scenario.seed, status=status,
            time_s=measured.time_s if measured.lost_s is None else measured.lost_s,
            rmse=measured.rmse if status == "flown" else None, largest=measured.largest, message=message,
            left_offboard=measured.left_offboard, effort_rad_s=measured.effort_rad_s, settling_s=measured.settling_s,
            labels=labels, scenario_digest=scenario_digest(flight), code=source_digest(),
        )  # fmt: skip

    started_us = monotonic_us()
    seen_s = -1.0
    said: list[str] = []
    with (folder / "program.log").open("wb") as output, _running(words, output) as process:
        if process is None:
            return row("failed", f"{words[0]}: cannot be started; see {folder / 'program.log'}")

        def progress(time_s: float) -> None:
            nonlocal seen_s
            seen_s = time_s
            move(time_s)

        def stop() -> bool:
            if seen_s >= 0.0:
                return seen_s > duration_s + MARGIN_S
            return process.poll() is not None or monotonic_us() - started_us > TAKE_OFF_S * 1e6

        ends.vehicle_realtime(
            flight, links, folder, system_id=1, wing=None, speed=speed, until_finished=False, state=None,
            report=said.append, stop=stop, progress=progress,
        )  # fmt: skip
        code = process.poll()
    ended = "" if code is None else f"the program ended by itself, exit code {code}"
    if seen_s < 0.0:
        why = ended or f"not in the air within {TAKE_OFF_S:g} s"
        return row("failed", f"{why}; its last words: {last_words(folder / 'program.log')}")
    sums = judge(flight, path, folder)
    if sums.lost_s is not None:
        return row("lost", f"more than {LOST_M:g} m from its reference at {sums.lost_s:g} s", sums)
    if down_s := _disarmed_s(folder, duration_s):
        return row("lost", f"disarmed at {down_s:.1f} s", sums)
    if sums.time_s < duration_s - 0.5:
        return row("failed", f"the log ends at {sums.time_s:.1f} s; {'; '.join(said)}", sums)
    return row("flown", "" if code in (None, 0) else ended, sums)


def write_reference(file: Path, path: Any, duration_s: float) -> None:
    """The path as `COLUMNS`, NED, `REFERENCE_HZ` rows a second."""
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        for k in range(round(duration_s * REFERENCE_HZ) + 1):
            time_s = k / REFERENCE_HZ
            *vectors, yaw_rad = path.sample(time_s)
            numbers = [number for vector in vectors for number in flip_vector(*vector)]
            writer.writerow(f"{number + 0.0:.6g}" for number in (time_s, *numbers, degrees(-yaw_rad)))


def judge(flight: Flight, path: Any, folder: Path) -> Sums:
    """What a campaign measures, from the vehicle's log alone. `path` is the reference. Raises `LogError`."""
    tables = {name: dict(table) for name, table in read(folder / VEHICLE_LOG).items()}
    sums = Sums(flight)
    truth, land = tables.get(topics.LOCAL_POSITION_TRUTH.name), tables.get(topics.LAND_DETECTED.name)
    if truth is None or land is None or not (land["landed"] == 0).any():
        raise LogError(f"{folder / VEHICLE_LOG}: holds no flight")
    released_us = int(land["timestamp"][land["landed"] == 0][0])
    stamps = truth["timestamp"][truth["timestamp"] >= released_us]
    stamps = stamps[stamps <= released_us + round(flight.scenario.duration_s * 1e6)]
    sums.add(tables, _as_ground(flight, path, stamps, released_us))
    return sums


def _as_ground(flight: Flight, path: Any, stamps: npt.NDArray[Any], released_us: int) -> dict[str, Table]:
    """What a ground would have logged: where the vehicle was to be, and the attitude for that in still air."""
    positions, velocities, yaws, angles = [], [], [], []
    gravity = flight.airframe.gravity_m_s2
    for stamp_us in stamps.tolist():
        position, velocity, (x, y, z), yaw_rad = path.sample((stamp_us - released_us) * 1e-6)
        w, *axis = AttitudeDemand.along((x, y, z + gravity), yaw_rad).quaternion
        positions.append(flip_vector(*position))
        velocities.append(flip_vector(*velocity))
        yaws.append(-yaw_rad)
        angles.append(flip_euler(*to_euler((w, axis[0], axis[1], axis[2]))))
    roll, pitch, yaw = np.array(angles).reshape(-1, 3).T
    return {
        topics.TRAJECTORY_SETPOINT.name: {
            "timestamp": stamps, "position": np.array(positions), "velocity": np.array(velocities),
            "yaw": np.array(yaws),
        },
        topics.ATTITUDE_SETPOINT.name: {
            "timestamp": stamps, "roll_body": roll, "pitch_body": pitch, "yaw_body": yaw,
            "thrust_body": np.full((len(stamps), 3), np.nan),
        },
    }  # fmt: skip


def _disarmed_s(folder: Path, duration_s: float) -> float | None:
    """Flight time at which it was disarmed before its time; None: it was not."""
    tables = read(folder / VEHICLE_LOG)
    land, status = tables[topics.LAND_DETECTED.name], tables.get(topics.VEHICLE_STATUS.name)
    if status is None:
        return None
    released_us = int(land["timestamp"][land["landed"] == 0][0])
    flown_s = (status["timestamp"].astype(np.int64) - released_us) * 1e-6
    down = flown_s[(status["arming_state"] == topics.DISARMED) & (flown_s > 0.0) & (flown_s < duration_s)]
    return float(down[0]) if len(down) else None


def last_words(file: Path) -> str:
    """The last line of a program's output that is not empty."""
    lines = [line.strip() for line in file.read_text("utf-8", "replace").splitlines() if line.strip()]
    return lines[-1] if lines else "none"


@contextmanager
def _running(words: list[str], output: IO[bytes]) -> Any:
    """The program in a process group of its own, which is ended with all that it started; None: there is no such."""
    try:
        process = subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONUNBUFFERED": "1"}, start_new_session=True,
        )  # fmt: skip
    except OSError as error:
        output.write(f"{error}\n".encode())
        yield None
        return
    try:
        yield process
    finally:
        _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    if sys.platform == "win32":
        process.terminate()
        process.wait()
        return
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        process.wait(timeout=ENDING_S)
    # Whatever of the group is left, children of a program that has ended too.
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
