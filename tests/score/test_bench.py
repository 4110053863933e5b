"""The bench as a whole: a user's file beside stock, what is not flown again, and the page."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest

from mavsitl.campaign import workers
from mavsitl.campaign.errors import GridError
from mavsitl.campaign.fly import fly
from mavsitl.campaign.store import Journal
from mavsitl.cli import main
from mavsitl.controllers import ControllerError
from mavsitl.report import bench as report
from mavsitl.score import bench, score
from mavsitl.score import suite as suites
from mavsitl.score.suite import Suite, SuiteCase

MINE = """\
from mavsitl.controllers import PositionDemand


class Mine:
    def update(self, time_s, state, reference):
        return PositionDemand(reference.position, yaw=reference.yaw)
"""
SHORT = Suite(
    version=1, seeds=(1,),
    cases=(
        SuiteCase(name="hover", group="paths", scenario="hover-calm", settings={"duration_s": 1.0}, quick=True),
        SuiteCase(name="wind", group="wind", scenario="hover-wind", settings={"duration_s": 1.0}),
    ),
)  # fmt: skip


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Flights of a second."""
    monkeypatch.setattr(suites, "read", lambda: SHORT)


@pytest.fixture
def mine(tmp_path: Path) -> str:
    (tmp_path / "mine.py").write_text(MINE)
    return f"{tmp_path / 'mine.py'}:Mine"


def flown(plan: bench.Plan, folder: Path) -> int:
    with Journal(folder / bench.JOURNAL_FILE) as journal, workers.local(1) as crew:
        return len(list(bench.fly(plan, journal, crew)))


def test_what_is_known_is_not_flown_again(mine: str, tmp_path: Path) -> None:
    assert flown(bench.plan([mine], shipped=False), tmp_path) == 4
    assert flown(bench.plan([mine], shipped=False), tmp_path) == 0
    Path(mine.rpartition(":")[0]).write_text(MINE.replace("yaw=reference.yaw", "yaw=0.0"))
    assert flown(bench.plan([mine], shipped=False), tmp_path) == 2, "its own flights alone"


def test_a_file_that_changes_while_it_flies_is_said(mine: str) -> None:
    case = bench.plan([mine], shipped=False).cases[0]
    Path(mine.rpartition(":")[0]).write_text(MINE + "\n\n")
    row = fly(case)
    assert (row.status, row.repeatable) == ("failed", False)
    assert "has changed since this flight was asked for" in row.message


def test_the_command(mine: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "out"
    arguments = ["bench", mine, "--only", "--jobs", "1", "--output", str(folder)]
    assert main([*arguments, "--json"]) == 0
    printed = msgspec.json.decode(capsys.readouterr().out, type=score.Board)
    assert {each.controller for each in printed.standings} == {mine, "stock"}
    assert next(each for each in printed.standings if each.controller == "stock").score == pytest.approx(100.0)
    saved = msgspec.json.decode((folder / bench.RESULTS_FILE).read_bytes(), type=bench.Result)
    assert saved.board == printed
    assert len(saved.rows) == 4
    assert main([*arguments, "--no-report"]) == 0
    assert "Mine" in capsys.readouterr().out


def test_a_controller_that_breaks_is_on_the_board_with_its_reason(
    mine: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path(mine.rpartition(":")[0]).write_text(MINE.replace("return", "return 1 /"))
    folder = tmp_path / "out"
    assert main(["bench", mine, "--only", "--quick", "--jobs", "1", "--output", str(folder)]) == 0
    assert "TypeError: unsupported operand" in capsys.readouterr().out
    page = (folder / "report.html").read_text()
    assert "1 lost" in page
    assert "TypeError: unsupported operand" in page


def test_the_page_has_every_case_and_controller_and_nothing_from_elsewhere(mine: str, tmp_path: Path) -> None:
    plan = bench.plan([mine, "indi"], shipped=False)
    with Journal(None) as journal, workers.local(1) as crew:
        list(bench.fly(plan, journal, crew))
        rows = bench.rows(plan, journal)
    board = score.board(plan.suite, rows, plan.everybody)
    page = report.render(bench.result(board, rows, "mavsitl bench <mine>", "2026-01-02T03:04:05Z"), plan.suite)
    for text in (">Mine<", ">indi<", ">stock<", ">hover<", ">wind<", "mavsitl bench &lt;mine&gt;"):
        assert text in page
    assert "<script" not in page
    assert "http" not in page.replace("http://www.w3.org", "")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"wanted": ["nobody"]}, "'nobody' is no controller"),
        ({"wanted": [], "programs": ["run-me"]}, "nothing says where the vehicle is"),
        ({"wanted": [], "programs": ["run-me {url} {speed}"]}, r"\{speed\} is not allowed; allowed: \{url\}"),
        ({"wanted": [], "programs": ["a {url}", "a {url}"]}, "two are called 'a'"),
        ({"wanted": [], "programs": ["stock=a {url}"]}, "two are called 'stock'"),
        ({"wanted": [], "pattern": "x"}, "no case of suite 1 is called so"),
        ({"wanted": [], "seeds": "x"}, "seeds: 'x' is not allowed; allowed: N for 1 to N"),
    ],
)
def test_what_cannot_be_flown_is_said_before_anything_flies(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises((GridError, ControllerError), match=said):
        bench.plan(**arguments)


def test_names_are_as_short_as_they_can_be() -> None:
    names = ["/a/my.py:A", "/b/my.py:B", "/b/other.py:B", "stock"]
    assert bench.short_names(names) == {
        "/a/my.py:A": "A", "/b/my.py:B": "my.py:B", "/b/other.py:B": "other.py:B", "stock": "stock",
    }  # fmt: skip
    assert list(bench.short_names(["/a/m.py:A", "/b/m.py:A"]).values()) == ["/a/m.py:A", "/b/m.py:A"]


def test_help_needs_no_flight() -> None:
    done = subprocess.run([sys.executable, "-m", "mavsitl", "bench", "--help"], capture_output=True, env=os.environ)
    assert done.returncode == 0
    assert b"--program COMMAND" in done.stdout
