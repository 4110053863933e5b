"""The benchmark of sweeps in its short form."""

from __future__ import annotations

import json

import pytest

from tests.bench import bench_sweep


def test_the_benchmark_of_sweeps_flies_the_same_everywhere(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench_sweep.main(["--flights", "2", "--duration", "1", "--rounds", "1", "--jobs", "2", "--json"]) == 0
    rates = json.loads(capsys.readouterr().out)
    assert list(rates) == [bench_sweep.BARE, bench_sweep.HERE, "campaign, 1 process", "campaign, 2 processes"]
    assert all(rate > 0.0 for found in rates.values() for rate in found)
    shown = bench_sweep.table({name: [1.0, 2.0] for name in rates}, 60.0).splitlines()
    assert shown[2] == "| bare flight, in memory | 1.50 | 90 | 1.00 | 1.00 |"
