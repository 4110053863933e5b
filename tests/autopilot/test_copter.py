"""Feels like a copter: take-off, hold in calm air and in wind, going places, orbit, return, landing, disarming."""

from __future__ import annotations

from itertools import pairwise
from math import hypot, nan, pi, radians
from typing import Any

import numpy as np
import pytest

from mavsitl.dialect import mavlink
from mavsitl.scenario import load
from tests.autopilot.conftest import GCS, Client, flight
from tests.autopilot.copter import (
    ACCEPTED,
    DENIED,
    HOLD,
    LAND,
    ORBIT,
    REJECTED,
    RELATIVE,
    RETURN,
    TAKEOFF,
    WRONG_FRAME,
    degrees_e7,
    distance,
    flying,
    go_to,
    origin,
    result_int,
    set_parameter,
    take_off,
    track,
)

NAV_TAKEOFF = mavlink.MAV_CMD_NAV_TAKEOFF
REPOSITION = mavlink.MAV_CMD_DO_REPOSITION


def ready() -> Client:
    client = Client(flight())
    client.run(0.2)
    return client


def until_up(client: Client, height_m: float) -> None:
    """AUTO.TAKEOFF has done its work, and the vehicle comes to rest at `height_m`."""
    client.run_until(lambda: client.flight_mode == HOLD and not client.landed, 4.0 + height_m)
    client.run(4.0)
    assert client.truth[2] == pytest.approx(height_m, abs=0.02)
    assert hypot(*client.truth[3:6]) < 0.02


# --- take-off


def test_take_off_is_quick_smooth_and_exact() -> None:
    client = ready()
    assert client.result(NAV_TAKEOFF) == ACCEPTED
    assert client.arm() == ACCEPTED
    heights = track(client, 10.0)[:, 2]
    off = int(np.argmax(heights > 0.02))
    up = int(np.argmax(heights > 0.95 * 2.5))
    assert 1.0 < off * client.vehicle.period_us / 1e6 < 2.0  # spool-up, then the ramp
    assert 0.0 < (up - off) * client.vehicle.period_us / 1e6 < 3.0
    assert heights.max() < 2.5 * 1.02
    assert heights[-1] == pytest.approx(2.5, abs=0.01)
    assert np.diff(heights[off:up]).min() > -1e-3  # it never sinks on the way
    states = [message.landed_state for message in client.all("EXTENDED_SYS_STATE", GCS)]
    assert [states[0], *(b for a, b in pairwise(states) if a != b)] == [1, 3, 2]


CONVENTIONS: list[tuple[str, float, float, float, float, float]] = [
    ("MAVSDK", nan, nan, nan, nan, 2.5),
    ("QGroundControl", 0.0, nan, nan, 4.0, 4.0),
    ("MAVProxy", 0.0, 0.0, 0.0, 3.0, 3.0),
    ("mavros", nan, 0.0, 0.0, 6.0, 6.0),
]
"""Who, yaw deg, north and west of the origin (NaN: left out), altitude as sent, height flown."""


@pytest.mark.parametrize(("who", "yaw", "north", "west", "altitude", "height"), CONVENTIONS)
@pytest.mark.parametrize("armed_first", [True, False])
def test_every_clients_take_off(
    who: str, yaw: float, north: float, west: float, altitude: float, height: float, armed_first: bool
) -> None:
    client = ready()
    place = (nan, nan)
    if who == "MAVProxy":
        place = (0.0, 0.0)
    elif who == "mavros":
        place = origin(client).to_global(north, west)
    if who in ("QGroundControl", "mavros"):
        altitude += origin(client).altitude_amsl_m
    params = (-1.0 if who == "QGroundControl" else nan, 0.0, 0.0, yaw, *place, altitude)
    if armed_first:
        assert client.arm() == ACCEPTED
        client.run(0.5)
    assert client.result(NAV_TAKEOFF, *params) == ACCEPTED
    client.tick()
    assert client.flight_mode == TAKEOFF
    if not armed_first:
        client.run(2.0)
        assert client.landed
        assert client.arm() == ACCEPTED
    until_up(client, height)
    assert hypot(*client.truth[:2]) < (0.5 if who == "mavros" else 0.05)  # a degree in float32 is good for 0.4 m


def test_take_off_by_command_int_relative_and_above_the_sea() -> None:
    for frame, datum in ((RELATIVE, 0.0), (mavlink.MAV_FRAME_GLOBAL_INT, 1.0)):
        client = ready()
        z = 3.0 + datum * origin(client).altitude_amsl_m
        assert result_int(client, NAV_TAKEOFF, z=z, frame=frame) == ACCEPTED
        client.arm()
        until_up(client, 3.0)


def test_take_off_towards_a_place_and_a_heading() -> None:
    client = ready()
    latitude, longitude = origin(client).to_global(4.0, -3.0)
    altitude = origin(client).altitude_amsl_m + 3.0
    assert client.result(NAV_TAKEOFF, nan, nan, nan, 90.0, latitude, longitude, altitude) == ACCEPTED
    client.arm()
    client.run_until(lambda: client.flight_mode == HOLD, 8.0)
    assert hypot(*client.truth[:2]) < 0.1  # straight up first
    client.run(8.0)
    assert distance(client, 4.0, -3.0, 3.0) < 0.5
    assert client.last("ATTITUDE", 0).yaw == pytest.approx(pi / 2, abs=0.02)


def test_a_take_off_asked_for_again_is_the_last_one() -> None:
    client = ready()
    assert client.mode(*TAKEOFF) == ACCEPTED
    client.arm()
    client.run(0.5)
    assert client.result(NAV_TAKEOFF, nan, nan, nan, nan, 0.0, 0.0, 4.0) == ACCEPTED
    until_up(client, 4.0)


def test_a_take_off_that_was_not_flown_is_forgotten() -> None:
    client = ready()
    assert client.result(NAV_TAKEOFF, nan, nan, nan, nan, 0.0, 0.0, 20.0) == ACCEPTED
    client.hold()
    client.arm()
    client.run(0.5)
    assert client.mode(*TAKEOFF) == ACCEPTED
    until_up(client, 2.5)


def test_a_take_off_in_the_air_that_is_too_low_stays_up() -> None:
    client = flying(4.0)
    assert client.result(NAV_TAKEOFF, nan, nan, nan, nan, 0.0, 0.0, 2.0) == ACCEPTED
    client.run(4.0)
    assert client.truth[2] == pytest.approx(4.0, abs=0.05)
    assert client.flight_mode == HOLD
    assert client.texts()[-1].startswith("Already higher")


@pytest.mark.parametrize(
    ("params", "frame", "result"),
    [
        ((91.0, 8.0, 490.0), None, DENIED),
        ((47.0, 181.0, 490.0), None, DENIED),
        ((nan, nan, 2e5), None, DENIED),
        ((nan, nan, 250.0), None, REJECTED),
        ((nan, nan, 0.1), None, REJECTED),
        ((nan, nan, -5.0), None, REJECTED),
        ((nan, nan, -5.0), RELATIVE, REJECTED),
        ((nan, nan, 3.0), mavlink.MAV_FRAME_LOCAL_NED, WRONG_FRAME),
    ],
)
def test_take_offs_refused(params: tuple[float, float, float], frame: int | None, result: int) -> None:
    client = ready()
    if frame is None:
        assert client.result(NAV_TAKEOFF, nan, nan, nan, nan, *params) == result
    else:
        assert result_int(client, NAV_TAKEOFF, z=params[2], frame=frame) == result
    client.tick()
    assert client.flight_mode == HOLD
    assert client.texts()[-1].startswith("Take-off refused: ")


# --- hold


def test_hold_in_calm_air_stays_within_centimetres() -> None:
    client = flying(2.5)
    client.run(2.0)
    path = track(client, 30.0)
    assert np.abs(path[:, :3] - [0.0, 0.0, 2.5]).max() < 0.01


def test_hold_in_the_papers_wind_and_noise() -> None:
    """hover-wind's Dryden wind and sensors: off the point that it holds by less than 10 cm, as a mean square."""
    scenario = load("hover-wind", {"rates.physics_hz": 1000})
    client = Client(scenario)
    client.attitude()
    assert client.offboard() == ACCEPTED
    assert client.arm() == ACCEPTED
    client.run(1.1, client.attitude)
    assert client.hold() == ACCEPTED
    client.run(5.0)
    aim = client.vehicle.autopilot.navigator.aim_nwu_m
    deviation = track(client, 40.0)[:, :3] - aim
    assert float(np.sqrt((deviation**2).sum(axis=1).mean())) < 0.1


# --- going places


def test_go_to_flies_there_stops_and_looks() -> None:
    client = flying(4.0)
    assert go_to(client, 12.0, -6.0, 6.0, yaw=radians(45.0)) == ACCEPTED
    path = track(client, 12.0)
    assert distance(client, 12.0, -6.0, 6.0) < 0.05
    assert client.last("ATTITUDE", 0).yaw == pytest.approx(radians(45.0), abs=0.02)
    assert path[:, 0].max() < 12.15
    assert path[:, 1].min() > -6.15
    assert client.flight_mode == HOLD


@pytest.mark.parametrize(("speed", "expected"), [(2.0, 2.0), (-1.0, 5.0)])
def test_go_to_at_a_speed(speed: float, expected: float) -> None:
    client = flying(4.0)
    assert go_to(client, 30.0, 0.0, 4.0, speed=speed) == ACCEPTED
    path = track(client, 8.0)
    assert np.hypot(path[:, 3], path[:, 4]).max() == pytest.approx(expected, abs=0.15)


def test_change_of_speed_in_flight_counts_at_once_and_ends() -> None:
    client = flying(4.0)
    go_to(client, 60.0, 0.0, 4.0)
    client.run(5.0)
    assert client.truth[3] == pytest.approx(5.0, abs=0.2)
    assert client.result(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1.0, 2.0) == ACCEPTED
    client.run(3.0)
    assert client.truth[3] == pytest.approx(2.0, abs=0.1)
    assert client.result(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1.0, -1.0) == ACCEPTED
    client.run(3.0)
    assert client.truth[3] == pytest.approx(5.0, abs=0.2)


def test_go_to_after_a_flight_by_the_stream_does_not_sink() -> None:
    """Only a climb that began on the ground is ramped like a take-off."""
    client = Client(flight())
    client.climb(4.0)
    client.hold()
    client.run(3.0, client.attitude)
    low = client.truth[2]
    assert go_to(client, 5.0, 0.0, low) == ACCEPTED
    path = track(client, 6.0)
    assert path[:, 2].min() > low - 0.1
    assert path[-1, 0] == pytest.approx(5.0, abs=0.1)


def test_pause_is_a_reposition_of_nans() -> None:
    client = flying(4.0)
    go_to(client, 40.0, 0.0, 4.0)
    client.run(4.0)
    began = client.truth[0]
    assert client.result(REPOSITION, -1.0, 1.0) == ACCEPTED
    client.run(6.0)
    assert began < client.truth[0] < began + 8.0
    assert hypot(*client.truth[3:6]) < 0.02
    assert client.truth[2] == pytest.approx(4.0, abs=0.05)


def test_change_of_altitude_alone_stays_over_the_place() -> None:
    client = flying(4.0)
    altitude = origin(client).altitude_amsl_m + 7.0
    assert client.result(REPOSITION, -1.0, 1.0, nan, nan, nan, nan, altitude) == ACCEPTED
    client.run(6.0)
    assert distance(client, 0.0, 0.0, 7.0) < 0.05
    assert client.result(mavlink.MAV_CMD_DO_CHANGE_ALTITUDE, 3.0, float(RELATIVE)) == ACCEPTED
    client.run(7.0)
    assert distance(client, 0.0, 0.0, 3.0) < 0.05


def test_a_place_that_was_asked_for_and_taken_over_is_forgotten() -> None:
    client = flying(4.0)
    client.mode(*RETURN)
    client.tick()
    client.attitude()
    assert go_to(client, 50.0, 0.0, 4.0) == ACCEPTED
    assert client.offboard() == ACCEPTED  # before the vehicle could begin
    client.run(0.5, client.attitude)
    assert client.hold() == ACCEPTED
    client.run(4.0)
    assert abs(client.truth[0]) < 1.0


# --- orbit


@pytest.mark.parametrize("radius", [10.0, -6.0])
def test_orbit_radius_direction_speed_and_heading(radius: float) -> None:
    client = flying(5.0)
    x, y = degrees_e7(client, 8.0, 0.0)
    assert result_int(client, mavlink.MAV_CMD_DO_ORBIT, radius, 3.0, 0.0, nan, x=x, y=y, z=5.0) == ACCEPTED
    client.run(12.0)
    assert client.flight_mode == ORBIT
    path = track(client, 10.0)
    rx, ry = path[:, 0] - 8.0, path[:, 1]
    assert np.abs(np.hypot(rx, ry) - abs(radius)).max() < 0.15
    assert np.abs(np.hypot(path[:, 3], path[:, 4]) - 3.0).max() < 0.1
    turning = rx * path[:, 4] - ry * path[:, 3]  # positive: counter-clockwise seen from above
    assert np.all(turning * -np.sign(radius) > 0.0)
    assert np.abs(path[:, 2] - 5.0).max() < 0.05
    inward = np.arctan2(-path[-1, 1], 8.0 - path[-1, 0])
    heading = -client.last("ATTITUDE", 0).yaw
    assert abs((heading - inward + pi) % (2 * pi) - pi) < 0.35


def test_another_orbit_while_orbiting() -> None:
    client = flying(5.0)
    x, y = degrees_e7(client, 0.0, 0.0)
    result_int(client, mavlink.MAV_CMD_DO_ORBIT, 5.0, 2.0, 0.0, nan, x=x, y=y, z=5.0)
    client.run(8.0)
    assert result_int(client, mavlink.MAV_CMD_DO_ORBIT, 9.0, 2.0, 0.0, nan, x=x, y=y, z=5.0) == ACCEPTED
    client.run(10.0)
    assert hypot(*client.truth[:2]) == pytest.approx(9.0, abs=0.3)
    assert client.hold() == ACCEPTED
    client.run(4.0)
    assert hypot(*client.truth[3:6]) < 0.02


# --- return and landing


def test_return_climbs_goes_home_and_lands_there() -> None:
    client = flying(5.0)
    set_parameter(client, "RTL_RETURN_ALT", 12.0)
    set_parameter(client, "RTL_DESCEND_ALT", 6.0)
    go_to(client, 25.0, 10.0, 5.0)
    client.run(14.0)
    assert client.result(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH) == ACCEPTED
    client.tick()
    assert client.flight_mode == RETURN
    rows: list[list[float]] = []
    client.run_until(lambda: not client.armed, 80.0, lambda: rows.append(client.truth))
    path = np.array(rows)
    away = np.hypot(path[:, 0], path[:, 1])
    assert path[:, 2].max() == pytest.approx(12.0, abs=0.2)
    assert path[away < 20.0, 2][:200].min() > 11.5  # climbs first
    assert path[away > 3.0, 2][-1] > 11.0  # and sinks over home only
    assert hypot(*client.truth[:2]) < 0.2
    assert client.flight_mode == HOLD
    assert client.texts()[-1] == "Disarmed by landing"


def test_return_close_to_home_does_not_climb_high() -> None:
    client = flying(4.0)
    assert client.result(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH) == ACCEPTED
    rows: list[float] = []
    client.tick()
    client.run_until(lambda: not client.armed, 60.0, lambda: rows.append(client.truth[2]))
    assert max(rows) < 10.3


def test_return_waits_above_home() -> None:
    client = flying(4.0)
    set_parameter(client, "RTL_DESCEND_ALT", 4.0)
    set_parameter(client, "RTL_LAND_DELAY", -1.0)
    client.mode(*RETURN)
    client.run(20.0)
    assert distance(client, 0.0, 0.0, 4.0) < 0.2
    assert client.flight_mode == RETURN


def test_return_on_the_ground_does_not_lift() -> None:
    client = ready()
    client.arm()
    client.run(1.5)
    assert client.mode(*RETURN) == ACCEPTED
    client.run(3.0)
    assert client.truth[2] < 0.01
    assert client.landed


@pytest.mark.parametrize("height", [1.0, 12.0])
def test_land_slows_down_and_disarms(height: float) -> None:
    client = flying(height)
    assert client.land() == ACCEPTED
    client.tick()
    assert client.flight_mode == LAND
    rows: list[list[float]] = []
    client.run_until(lambda: client.landed, 30.0, lambda: rows.append(client.truth))
    path = np.array(rows)
    low = (path[:, 2] > 0.1) & (path[:, 2] < 0.4)
    assert path[low, 5].mean() == pytest.approx(-0.7, abs=0.05)
    assert path[:, 5].min() > -1.6
    assert client.run_until(lambda: not client.armed, 5.0) == pytest.approx(2.0, abs=0.03)
    assert client.flight_mode == HOLD
    assert client.arm() == ACCEPTED  # and again, at once
    assert distance(client, 0.0, 0.0, 0.0) < 0.05


def test_auto_disarm_after_landing_by_its_parameter() -> None:
    client = flying(1.0)
    set_parameter(client, "COM_DISARM_LAND", 0.5)
    client.land()
    client.run_until(lambda: client.landed, 10.0)
    assert client.run_until(lambda: not client.armed, 5.0) == pytest.approx(0.5, abs=0.03)


def test_disarming_is_refused_in_the_air_in_every_auto_mode() -> None:
    client = flying(3.0)
    for mode in (HOLD, RETURN, LAND):
        assert client.mode(*mode) == ACCEPTED
        client.tick()
        assert client.disarm() == DENIED
        client.tick()
        assert client.armed


def test_landed_states_follow_the_flight() -> None:
    client = Client(flight())
    take_off(client, 2.0)
    client.land()
    client.run(6.0)
    seen: list[Any] = []
    for message in client.all("EXTENDED_SYS_STATE", GCS):
        if not seen or seen[-1] != message.landed_state:
            seen.append(message.landed_state)
    assert seen == [
        mavlink.MAV_LANDED_STATE_ON_GROUND,
        mavlink.MAV_LANDED_STATE_TAKEOFF,
        mavlink.MAV_LANDED_STATE_IN_AIR,
        mavlink.MAV_LANDED_STATE_LANDING,
        mavlink.MAV_LANDED_STATE_ON_GROUND,
    ]
