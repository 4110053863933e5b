"""Each fail-safe within its parameters and 0.1 s, from outside; and the page that says so is of this table."""

from __future__ import annotations

from pathlib import Path

import pytest
from mavsitl_vehicle.autopilot.commander import FAILSAFES

from tests.autopilot.failsafe_timing import CASES, OUTPUT, SLACK_S, Case, measure

EARLY_S = 0.11
"""The battery was read up to a tenth of a second before it was not read any more."""


def test_each_row_is_measured_and_on_the_page() -> None:
    assert [case.row for case in CASES] == [row.name for row in FAILSAFES]
    page = (Path(__file__).parents[2] / OUTPUT).read_text("utf-8")
    assert [line.split(" | ")[0][2:] for line in page.splitlines() if line.startswith("| ")][1:] == [
        case.row for case in CASES
    ]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.row)
def test_it_acts_in_time(case: Case) -> None:
    measured = measure(case)
    assert -EARLY_S <= measured.acted_s - case.due_s <= SLACK_S
    if case.holds_s:
        assert -0.02 <= measured.left_s - case.holds_s <= SLACK_S
