"""The program that times the plant runs, each row of its own."""

from __future__ import annotations

import pytest

from tests.bench.bench_plant import main, our_rows, period_rows


def test_short_form(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--ours", "--rounds", "1", "--steps", "256"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("mavsitl")]
    assert len(lines) == len(our_rows()) + len(period_rows())
    for line in lines:
        assert float(line.split()[-2].replace(",", "")) > 0.0
