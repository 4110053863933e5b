"""A vehicle process for a client that we did not write: started, watched and ended."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import pytest

from mavsitl.link.udp import LOOPBACK
from mavsitl.pair import free_ports

PATIENCE_S = 30.0
"""How long a machine that is busy with other things may take over what an idle one does at once."""

_running: list[Sitl] = []


@dataclass(frozen=True)
class Sitl:
    """A running vehicle. Clients listen on `offboard_port` and `gcs_port`; it speaks first."""

    offboard_port: int
    """Where the off-board link sends: 14540 of PX4 SITL."""
    gcs_port: int
    """Where the ground-station link sends: 14550 of PX4 SITL."""
    offboard_own: int
    """Where the off-board link listens: 14580 of PX4 SITL."""
    gcs_own: int
    """Where the ground-station link listens: 18570 of PX4 SITL."""
    speed: float
    process: subprocess.Popen[str]
    output: IO[str]

    def log(self) -> str:
        """What it has printed so far."""
        self.output.flush()
        return Path(self.output.name).read_text("utf-8")


def await_end(process: subprocess.Popen[Any]) -> int:
    """The exit code of a process that was told to end; one that does not is killed, and that is an error."""
    try:
        return process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        raise


@contextmanager
def sitl(
    scenario: str = "takeoff-hover",
    *settings: str,
    speed: float = 1.0,
    run_dir: Path | None = None,
    state_dir: Path | None = None,
) -> Iterator[Sitl]:
    """A vehicle process of its own on free ports of loopback; `settings` are more command-line arguments.

    It is ended at the end, and must then exit with 0. What it printed comes with every failure.
    """
    offboard_own, offboard, gcs_own, gcs = free_ports(4)
    command = [
        sys.executable, "-m", "mavsitl", "vehicle", scenario, "--speed", str(speed),
        "--offboard-port", str(offboard_own), "--offboard-remote", f"{LOOPBACK}:{offboard}",
        "--gcs-port", str(gcs_own), "--gcs-remote", f"{LOOPBACK}:{gcs}",
        *(["--no-state"] if state_dir is None else ["--state-dir", str(state_dir)]),
        *([] if run_dir is None else ["--run-dir", str(run_dir)]),
        *settings,
    ]  # fmt: skip
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", prefix="mavsitl-", suffix=".log") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, text=True)
        vehicle = Sitl(offboard, gcs, offboard_own, gcs_own, speed, process, output)
        _running.append(vehicle)
        try:
            yield vehicle
            assert process.poll() is None, f"the vehicle ended by itself with {process.returncode}:\n{vehicle.log()}"
        except BaseException as error:
            error.add_note(f"vehicle:\n{vehicle.log()}")
            raise
        finally:
            _running.remove(vehicle)
            process.terminate()
            await_end(process)
        assert process.returncode == 0, vehicle.log()


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, None]:
    """A failed test shows what the vehicles that were running had printed."""
    outcome = yield
    report = outcome.get_result()
    if report.failed:
        report.sections += [(f"vehicle on port {each.offboard_own}", each.log()) for each in _running]
