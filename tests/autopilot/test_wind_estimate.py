"""WIND_COV: the wind that the vehicle works out from its own motion, against the one that blows."""

from __future__ import annotations

import pytest

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import Client, flight

STEADY = [{"model": "steady", "velocity_nwu_m_s": [3.0, -2.0, 0.0]}]


def hovering(client: Client) -> Client:
    assert client.result(mavlink.MAV_CMD_NAV_TAKEOFF) == mavlink.MAV_RESULT_ACCEPTED
    assert client.arm() == mavlink.MAV_RESULT_ACCEPTED
    client.run(12.0)
    return client


def test_a_steady_wind_is_found() -> None:
    told = hovering(Client(flight(wind=STEADY))).last("WIND_COV", 0)
    assert told.wind_x == pytest.approx(3.0, abs=0.2)
    assert told.wind_y == pytest.approx(2.0, abs=0.2)  # NED: east
    assert told.wind_z == pytest.approx(0.0, abs=0.2)


def test_calm_air_is_told_as_calm() -> None:
    told = hovering(Client()).last("WIND_COV", 0)
    assert abs(told.wind_x) < 0.1
    assert abs(told.wind_y) < 0.1


def test_it_is_not_told_on_the_ground() -> None:
    client = Client(flight(wind=STEADY))
    client.run(3.0)
    assert client.all("WIND_COV") == []
