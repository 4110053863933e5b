"""The program that times a control period runs, on a short flight."""

from __future__ import annotations

import pytest

from tests.bench import bench_period


def test_the_parts_of_a_period_are_timed(capsys: pytest.CaptureFixture[str]) -> None:
    bench_period.main(["--duration", "0.2", "--runs", "2"])
    said = capsys.readouterr().out
    for part in (*bench_period.PARTS, "together"):
        (without, logged) = (float(line.split("|")[2]) for line in said.splitlines() if line.startswith(f"| {part} |"))
        assert without > 0.0
        assert logged > 0.0
