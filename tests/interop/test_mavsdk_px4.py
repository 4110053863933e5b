"""What PX4's own tests with MAVSDK ask of its simulated vehicles, asked of ours: their flights, their tolerances.

The flights of PX4-Autopilot's test/mavsdk_tests for multicopters, re-expressed; durations by the vehicle's own clock.
"""

from __future__ import annotations

import queue
from collections.abc import Iterator
from math import cos, hypot, nan, radians, sin
from typing import Any

import pytest

from tests.interop.conftest import PATIENCE_S, Sitl, sitl
from tests.interop.mavsdk_client import METRES_PER_DEGREE, Pilot, connected, first

pytest.importorskip("mavsdk.plugins", reason="MAVSDK 4 is not installed")

pytestmark = [pytest.mark.interop, pytest.mark.sockets]

SPEED = 10.0
HOME_WITHIN_M = 2.0


@pytest.fixture(scope="module")
def vehicle() -> Iterator[Sitl]:
    with sitl(speed=SPEED) as running:
        yield running


@pytest.fixture(scope="module")
def client(vehicle: Sitl) -> Iterator[Pilot]:
    with connected(vehicle) as pilot:
        pilot.wait("health_all_ok", bool)
        yield pilot


@pytest.fixture
def pilot(client: Pilot) -> Iterator[Pilot]:
    client.reset()
    client.telemetry.set_rate_ground_truth(15.0)
    yield client
    if client.offboard.is_active():
        client.offboard.stop()


class _Clock:
    """Simulated time, by the stamps of ATTITUDE."""

    def __init__(self, pilot: Pilot) -> None:
        self._pilot = pilot

    def states(self, seconds: float) -> Iterator[tuple[float, Any]]:
        """(seconds since the call, ATTITUDE), for so long."""
        begin_us: int | None = None
        with self._pilot.values("attitude_euler") as values:
            while True:
                try:
                    state = values.get(timeout=PATIENCE_S)
                except queue.Empty:
                    pytest.fail("the vehicle has become silent")
                begin_us = state.timestamp_us if begin_us is None else begin_us
                passed_s = (state.timestamp_us - begin_us) / 1e6
                if passed_s > seconds:
                    return
                yield passed_s, state


def _down(pilot: Pilot) -> None:
    pilot.wait("armed", lambda armed: not armed, 40.0)


def _home(pilot: Pilot, start: Any) -> None:
    truth = pilot.wait("ground_truth", lambda _: True)
    north = (truth.latitude_deg - start.latitude_deg) * METRES_PER_DEGREE
    east = (truth.longitude_deg - start.longitude_deg) * METRES_PER_DEGREE * cos(radians(start.latitude_deg))
    assert hypot(north, east) <= HOME_WITHIN_M


def _land_by_velocity(pilot: Pilot) -> None:
    """Down at 1 m/s, off-board, until it has disarmed by itself."""
    from mavsdk.plugins.offboard import VelocityNedYaw

    pilot.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 1.0, 0.0))
    _down(pilot)


def _go(pilot: Pilot, north: float, east: float, down: float, yaw_deg: float, *, within_s: float) -> None:
    """An off-board position is reached to 0.3 m in time."""
    from mavsdk.plugins.offboard import PositionNedYaw

    pilot.offboard.set_position_ned(PositionNedYaw(north, east, down, yaw_deg))
    if pilot.telemetry.flight_mode().name != "OFFBOARD":
        pilot.offboard.start()
        pilot.mode("OFFBOARD")
    for _ in _Clock(pilot).states(within_s):
        at = pilot.telemetry.position_velocity_ned().position
        if hypot(at.north_m - north, at.east_m - east, at.down_m - down) < 0.3:
            return
    pytest.fail(f"{north}, {east}, {down} not reached in {within_s} s; at {at}, {pilot.texts}")


def _origin(pilot: Pilot) -> Any:
    """Where the vehicle stands, in the local frame."""
    return pilot.wait("position_velocity_ned", lambda _: True).position


def test_takeoff_and_hold_position(pilot: Pilot) -> None:
    pilot.action.set_takeoff_altitude(10.0)
    pilot.action.arm()
    pilot.action.takeoff()
    pilot.mode("TAKEOFF")
    ground = -_origin(pilot).down_m
    pilot.height(9.65, 10.35)
    pilot.mode("HOLD")
    for passed_s, _ in _Clock(pilot).states(3.0):  # the take-off ends at 95 %
        assert passed_s <= 3.0
    kept = -_origin(pilot).down_m
    assert kept - ground == pytest.approx(10.0, abs=0.35)
    heights = [-pilot.telemetry.position_velocity_ned().position.down_m for _ in _Clock(pilot).states(30.0)]
    assert len(heights) > 250
    assert max(abs(height - kept) for height in heights) <= 0.25


def test_takeoff_and_land(pilot: Pilot) -> None:
    start = pilot.wait("ground_truth", lambda _: True)
    pilot.action.arm()
    pilot.action.takeoff()
    pilot.wait("in_air", bool)
    pilot.mode("HOLD")
    pilot.action.land()
    _down(pilot)
    _home(pilot, start)


def test_offboard_takeoff_and_land(pilot: Pilot) -> None:
    start, at = pilot.wait("ground_truth", lambda _: True), _origin(pilot)
    pilot.action.arm()
    _go(pilot, at.north_m, at.east_m, at.down_m - 2.0, 0.0, within_s=90.0)
    _land_by_velocity(pilot)
    _home(pilot, start)


def test_offboard_position_control(pilot: Pilot) -> None:
    start, at = pilot.wait("ground_truth", lambda _: True), _origin(pilot)
    pilot.action.arm()
    for north, east, down, yaw in [
        (0.0, 0.0, -2.0, 0.0), (0.0, 4.0, -2.0, 180.0), (4.0, 4.0, -2.0, 180.0), (4.0, 0.0, -2.0, 90.0),
        (0.0, 0.0, -2.0, 90.0),
    ]:  # fmt: skip
        _go(pilot, at.north_m + north, at.east_m + east, at.down_m + down, yaw, within_s=10.0)
    _land_by_velocity(pilot)
    _home(pilot, start)


def test_offboard_attitude_control(pilot: Pilot) -> None:
    from mavsdk.plugins.offboard import Attitude

    height = pilot.wait("raw_gps", lambda _: True).absolute_altitude_m
    pilot.offboard.set_attitude(Attitude(0.0, 0.0, 0.0, 0.8))
    pilot.action.arm()
    pilot.offboard.start()
    with pilot.values("raw_gps") as values:
        first(values, lambda gps: gps.absolute_altitude_m > height + 10.0, PATIENCE_S, "10 m by thrust")
    pilot.offboard.set_attitude(Attitude(0.0, -20.0, 0.0, 0.5))
    settled = [state for passed_s, state in _Clock(pilot).states(3.0) if passed_s > 1.0]
    assert len(settled) > 20
    assert all(abs(state.roll_deg) < 5.0 and abs(state.pitch_deg + 20.0) < 5.0 for state in settled)
    pilot.offboard.stop()
    pilot.action.land()
    _down(pilot)


def test_straight_mission_with_return(pilot: Pilot) -> None:
    from mavsdk.plugins.mission import MissionItem, MissionPlan

    start = pilot.wait("ground_truth", lambda _: True)
    at = pilot.telemetry.position()
    bearing = radians(30.0)
    north, east = cos(bearing) / METRES_PER_DEGREE, sin(bearing) / METRES_PER_DEGREE / cos(radians(at.latitude_deg))
    items = [
        MissionItem(at.latitude_deg + d * north, at.longitude_deg + d * east, 10.0, nan, False, acceptance_radius_m=1.0)
        for d in (0.0, 20.0, 40.0)
    ]
    pilot.mission.set_return_to_launch_after_mission(True)
    pilot.action.set_return_to_launch_altitude(10.0)
    pilot.mission.upload_mission(MissionPlan(items))
    pilot.action.arm()
    with pilot.values("position_velocity_ned") as track:
        origin = track.get(timeout=PATIENCE_S).position
        with pilot.values("mission_progress", "mission") as progress:
            pilot.mission.start_mission()
            first(progress, lambda p: p.current == p.total, 40.0, "the last waypoint")
        flown = [track.get_nowait() for _ in range(track.qsize())]
    across = [
        -sin(bearing) * (s.position.north_m - origin.north_m) + cos(bearing) * (s.position.east_m - origin.east_m)
        for s in flown
    ]
    assert max(map(abs, across)) < 5.0, "PX4's corridor"
    assert max(hypot(s.velocity.north_m_s, s.velocity.east_m_s) for s in flown) > 4.0
    _down(pilot)
    _home(pilot, start)
