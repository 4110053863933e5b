"""RMSE against sums done by hand, the paper's numbers, and the rows of the comparison."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest

from mavsitl import scenario
from mavsitl.log.flight import FlightData
from mavsitl.report import tables
from mavsitl.report.metrics import PAPER_TABLES, Rmse, maximum_error, paper_case, rmse


def still(count: int) -> FlightData:
    """At (0, 0, 1) all the time; the errors are put in by the tests."""
    zeros = np.zeros((count, 3))
    return FlightData(
        time_s=np.linspace(0.0, 0.004 * (count - 1), count),
        position_nwu_m=zeros.copy(),
        position_reference_nwu_m=zeros.copy(),
        velocity_nwu_m_s=zeros.copy(),
        attitude_deg=zeros.copy(),
        attitude_reference_deg=zeros.copy(),
        wind_nwu_m_s=zeros.copy(),
        rotor_speed_rad_s=None,
        weights=None,
        demand=None,
        link=None,
        saturated_share=None,
    )


def test_rmse_and_largest_error_by_hand() -> None:
    flight = still(4)
    flight.position_nwu_m[:, 0] = (3.0, -4.0, 0.0, 0.0)
    flight.position_reference_nwu_m[:, 2] = 2.0
    flight.attitude_deg[:, 2] = (179.0, -179.0, 180.0, 180.0)
    flight.attitude_reference_deg[:, 2] = (-179.0, 179.0, 180.0, -180.0)
    assert rmse(flight).values() == pytest.approx((2.5, 0.0, 2.0, 0.0, 0.0, sqrt(2.0)))
    assert maximum_error(flight).values() == pytest.approx((4.0, 0.0, 2.0, 0.0, 0.0, 2.0))


def test_the_papers_tables() -> None:
    assert {name: len(row.values()) for name, row in PAPER_TABLES.items()} == dict.fromkeys(
        ("hover-calm", "hover-wind", "spiral-calm", "spiral-wind"), 6
    )
    # Sums by column of Tables 3 and 4 as printed.
    assert [round(sum(row.values()), 6) for row in PAPER_TABLES.values()] == [0.129026, 1.20947, 0.9707, 3.635]


def test_the_rows_of_the_comparison() -> None:
    ours = Rmse(0.05, 0.0867541, 0.248, 0.1, 0.2, float("nan"))
    rows = tables.rows(ours, "hover-wind")
    assert [row.state for row in rows] == ["x / m", "y / m", "z / m", "φ / °", "θ / °", "ψ / °"]
    assert [row.verdict for row in rows] == ["beaten", "met", "missed", "beaten", "beaten", "missed"]
    assert rows[2].ratio == pytest.approx(2.0)
    assert rows[0].paper == 9.072e-2
    assert {(row.paper, row.ratio, row.verdict) for row in tables.rows(ours, None)} == {(None, None, None)}


def test_a_flight_that_was_lost_is_not_better_than_the_paper() -> None:
    """However small its errors were until then."""
    rows = tables.rows(Rmse(*[1e-6] * 6), "hover-wind", lost=True)
    assert {(row.ours, tables.ratio(row.ratio or 0.0), row.verdict) for row in rows} == {(1e-6, "lost", "missed")}


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.1, "0.100"), (1.099, "1.10"), (123.4, "123"), (0.00849, "0.00849"), (2e-5, "2.00e-05"), (float("nan"), "nan")],
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert tables.number(value) == text


@pytest.mark.parametrize("name", list(PAPER_TABLES))
def test_the_papers_scenarios_are_known_by_what_they_fly(name: str) -> None:
    assert paper_case(scenario.load(name).scenario) == name
    assert paper_case(scenario.load(name, {"duration_s": 30.0}).scenario) is None
    assert paper_case(scenario.load(name, {"start.position_nwu_m": [0.0, 0.0, 3.0]}).scenario) is None
    steady = [{"model": "steady", "velocity_nwu_m_s": [1.0, 0.0, 0.0]}]
    assert paper_case(scenario.load(name, {"wind": steady}).scenario) is None
