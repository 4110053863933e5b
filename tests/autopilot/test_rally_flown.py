"""A return ends at the nearest of home and the rally points."""

from __future__ import annotations

import pytest

from mavsitl.dialect import mavlink
from tests.autopilot.copter import ACCEPTED, flying, go_to, item, set_parameter, upload

RALLY_POINT, RALLY = 5100, 2


@pytest.mark.parametrize(("west_m", "ends_at"), [(12.0, (0.0, 20.0)), (8.0, (0.0, 0.0))])
def test_a_return_ends_at_the_nearest(west_m: float, ends_at: tuple[float, float]) -> None:
    client = flying(3.0)
    point = item(client, RALLY_POINT, at=(0.0, 20.0), height_m=6.0)
    assert upload(client, [point], RALLY) == mavlink.MAV_MISSION_ACCEPTED
    set_parameter(client, "RTL_RETURN_ALT", 4.0)
    assert go_to(client, 0.0, west_m, 3.0) == ACCEPTED
    client.run_until(lambda: abs(client.truth[1] - west_m) < 0.2, 20.0)
    assert client.result(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH) == ACCEPTED
    heights: list[float] = []
    client.run_until(lambda: not client.armed, 60.0, lambda: heights.append(client.truth[2]))
    assert client.truth[:2] == pytest.approx(ends_at, abs=0.3)
    assert (max(heights) > 5.6) is (ends_at[1] > 0.0), "the point's height is the least of the way there"
