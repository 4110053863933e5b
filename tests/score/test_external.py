"""A program that speaks MAVLink is flown, judged by the vehicle's log alone, and ended with all that it started."""

from __future__ import annotations

import csv
import shlex
import sys
import time
from pathlib import Path

import pytest

from mavsitl import process, wings
from mavsitl.clock import monotonic_us
from mavsitl.scenario import Flight, load
from mavsitl.score import external
from mavsitl.score.external import Program, judge
from mavsitl.score.suite import CASE, CONTROLLER

CLIENT = Path(__file__).with_name("client.py")
LABELS = {CASE: "hover", CONTROLLER: "client"}


def flight(duration_s: float = 2.0, name: str = "hover-calm") -> Flight:
    return load(name, {"duration_s": duration_s})


def program(text: str) -> Program:
    return Program.parse(f"{shlex.quote(sys.executable)} {text}")


def test_places_are_filled_in() -> None:
    parsed = Program.parse("mine=python 'my client.py' --at={url}:{duration} {endpoint}")
    assert parsed.name == "mine"
    assert parsed.filled(url="u", endpoint="e", port="p", reference="r", duration="20") == [
        "python", "my client.py", "--at=u:20", "e",
    ]  # fmt: skip
    assert Program.parse("python3 /a/b/fly.py {port}").name == "fly.py"
    assert Program.parse("/opt/pilot --link {url}").name == "pilot"


def test_the_reference_is_the_path_in_ned(tmp_path: Path) -> None:
    scenario = load("steps-calm").scenario
    external.write_reference(tmp_path / "r.csv", wings.find(wings.REFERENCE_GROUP)(scenario.reference), 27.0)
    with (tmp_path / "r.csv").open(newline="") as file:
        header, *rows = list(csv.reader(file))
    assert tuple(header) == external.COLUMNS
    assert len(rows) == 27 * 50 + 1
    after = dict(zip(header, map(float, rows[round(12.5 * 50)]), strict=True))
    assert (after["time_s"], after["north_m"], after["east_m"], after["down_m"]) == (12.5, 1.0, -1.0, -1.0)
    assert float(rows[-1][-1]) == -90.0


@pytest.mark.sockets
def test_a_client_by_pymavlink_alone(tmp_path: Path) -> None:
    seen: list[float] = []
    row = external.fly(
        program(f"{shlex.quote(str(CLIENT))} {{endpoint}} {{reference}}"), flight(), tmp_path, LABELS, move=seen.append
    )
    assert (row.status, row.message) == ("flown", ""), (tmp_path / "program.log").read_text()
    assert row.labels == LABELS
    assert row.position_m < 0.5
    assert row.effort_rad_s is not None
    assert row.time_s == pytest.approx(2.0, abs=0.1)
    assert seen[-1] > 2.0
    assert "in the air" in (tmp_path / "program.log").read_text()


@pytest.mark.sockets
def test_a_program_that_ends_before_it_flies_is_a_row_with_its_last_words(tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text("print('first')\nraise SystemExit('no vehicle for me')\n")
    row = external.fly(program(f"{shlex.quote(str(tmp_path / 'bad.py'))} {{url}}"), flight(), tmp_path / "out", LABELS)
    assert row.status == "failed"
    assert row.message == "the program ended by itself, exit code 1; its last words: no vehicle for me"


def test_a_program_that_there_is_not(tmp_path: Path) -> None:
    row = external.fly(Program.parse("/no/such/program {url}"), flight(), tmp_path, LABELS)
    assert row.status == "failed"
    assert "cannot be started" in row.message


@pytest.mark.skipif(sys.platform == "win32", reason="process groups are POSIX's")
@pytest.mark.sockets
def test_what_a_program_started_ends_with_it(tmp_path: Path) -> None:
    """It ignores SIGTERM, and leaves a child behind when it ends."""
    (tmp_path / "parent.py").write_text(
        "import pathlib, subprocess, sys\n"
        "child = subprocess.Popen([sys.executable, '-c',\n"
        "    'import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN);'\n"
        "    'print(1, flush=True); time.sleep(600)'],\n"
        "    stdout=subprocess.PIPE)\n"
        "child.stdout.readline()\n"
        f"pathlib.Path({str(tmp_path / 'pid')!r}).write_text(str(child.pid))\n"
    )
    external.fly(program(f"{shlex.quote(str(tmp_path / 'parent.py'))} {{url}}"), flight(), tmp_path / "out", LABELS)
    pid = int((tmp_path / "pid").read_text())
    until_us = monotonic_us() + 20_000_000
    while _runs(pid):  # a kill is not at once
        assert monotonic_us() < until_us
        time.sleep(0.01)


def _runs(pid: int) -> bool:
    """A process that has ended and that nobody has asked about yet does not run."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state not in ("Z", "X")


def test_the_judge_needs_no_ground(tmp_path: Path) -> None:
    """Of a flight that has both: the vehicle's log alone gives the numbers of the campaign."""
    from mavsitl import ends
    from mavsitl.campaign.fly import fly
    from mavsitl.campaign.grid import case

    one = flight(3.0, "hover-wind")
    process.one_blas_thread()
    ends.in_memory(one, tmp_path, report=lambda text: None, progress=None)
    (tmp_path / "ground.ulg").unlink()
    judged = judge(one, wings.find(wings.REFERENCE_GROUP)(one.scenario.reference), tmp_path)
    row = fly(case(one))
    assert judged.rmse is not None
    assert row.rmse is not None
    assert judged.rmse[:3] == pytest.approx(row.rmse[:3], rel=1e-3)
    assert judged.effort_rad_s == pytest.approx(row.effort_rad_s, rel=1e-3)
