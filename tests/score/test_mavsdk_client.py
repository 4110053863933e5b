"""MAVSDK flies cases of the suite, by the example in the documentation: nothing of mavsitl is in that program."""

from __future__ import annotations

import ast
import shlex
import sys
from pathlib import Path

import pytest

from mavsitl.scenario import load
from mavsitl.score import external, suite
from mavsitl.score.external import Program
from mavsitl.score.suite import CASE, CONTROLLER

pytest.importorskip("mavsdk.plugins", reason="MAVSDK 4 is not installed")

pytestmark = [pytest.mark.interop, pytest.mark.sockets]

CLIENT = Path(__file__).resolve().parents[2] / "docs/examples/bench_mavsdk.py"
PROGRAM = Program.parse(f"{shlex.quote(sys.executable)} {shlex.quote(str(CLIENT))} {{url}} {{reference}}")


def test_it_knows_nothing_of_mavsitl() -> None:
    imported = {
        (node.module if isinstance(node, ast.ImportFrom) else node.names[0].name) or ""
        for node in ast.walk(ast.parse(CLIENT.read_text("utf-8")))
        if isinstance(node, ast.Import | ast.ImportFrom)
    }
    assert {name.partition(".")[0] for name in imported} == {"csv", "queue", "sys", "pathlib", "mavsdk"}


@pytest.mark.parametrize(("name", "duration_s", "speed"), [("hover-dryden-10", 3.0, 1.0), ("spiral", 8.0, 2.0)])
def test_a_case_of_the_suite(tmp_path: Path, name: str, duration_s: float, speed: float) -> None:
    """Shortened. The second goes by the vehicle's clock, twice as fast as the wall's."""
    [case] = suite.read().chosen(pattern=name).cases
    flight = load(case.scenario, {**case.settings, "duration_s": duration_s})
    row = external.fly(PROGRAM, flight, tmp_path, {CASE: name, CONTROLLER: "mavsdk"}, speed=speed)
    output = (tmp_path / "program.log").read_text("utf-8", "replace")
    assert (row.status, row.message) == ("flown", ""), output
    assert "in the air" in output
    assert row.time_s == pytest.approx(duration_s, abs=0.2)
    assert row.position_m < 0.5
