"""The program that compares the estimators, in its short form."""

from __future__ import annotations

import pytest

from mavsitl.campaign.fly import Row
from mavsitl.report.metrics import PAPER_TABLES
from tests.bench import bench_estimator
from tests.experiments import estimators


def test_estimators_has_every_experiment_and_kind(capsys: pytest.CaptureFixture[str]) -> None:
    assert estimators.main(["--quick", "--jobs", "1"]) == 0
    page = capsys.readouterr().out
    assert [line[3:] for line in page.splitlines() if line.startswith("## ")] == list(PAPER_TABLES)
    rows = [line.split("|")[1:-1] for line in page.splitlines() if line.startswith("| `body_rate/pidnn`")]
    assert len(rows) == len(PAPER_TABLES)
    for _, white, *others in rows:
        assert "(x" not in white
        assert all(cell.count("(x") == 2 and "lost" not in cell for cell in others)


def test_a_cell_tells_the_factor_and_the_losses() -> None:
    def flown(size: float) -> list[Row]:
        return [Row("", "hover-wind", seed, "flown", 60.0, (0.0, 0.0, size, 0.0, 0.0, size)) for seed in (1, 2)]

    lost = Row("", "hover-wind", 3, "lost", 3.0)
    base = flown(0.2)
    assert estimators.cell(base, base) == "0.200 m, 0.200°"
    assert estimators.cell(flown(0.5), base) == "0.500 m (x 2.5), 0.500° (x 2.5)"
    assert estimators.cell([*base, lost], base) == "0.200 m (x 1.0), 0.200° (x 1.0) (1 of 3 lost)"
    assert estimators.cell([lost], base) == "lost"


def test_the_benchmark_flies_both_kinds() -> None:
    for kind in bench_estimator.KINDS:
        assert bench_estimator.period_us(kind, 10) > 0.0
