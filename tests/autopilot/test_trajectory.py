"""The motion of the automatic modes: within its limits whatever it is told, and at its aim in the end."""

from __future__ import annotations

from collections.abc import Callable
from math import hypot, inf, isnan, nan, pi, radians, remainder

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot.setpoints import PositionSetpoint, State
from mavsitl_vehicle.autopilot.trajectory import (
    Trajectory,
    landing_speed,
    takeoff_climb_limit,
)

from mavsitl.frames import Vector
from mavsitl.quaternion import from_yaw
from tests.autopilot.fly import PERIOD_S, VALUES, Array

ORIGIN: Vector = (0.0, 0.0, 0.0)
TOLERANCE = 1e-6
JERK = VALUES["MPC_JERK_AUTO"]


def still(place: Vector = ORIGIN, velocity: Vector = ORIGIN, yaw: float = 0.0) -> State:
    return State(place, velocity, from_yaw(yaw))


class Follower:
    """A vehicle that is always where the motion says; every setpoint is kept."""

    def __init__(self, state: State | None = None, **values: float) -> None:
        self.values = VALUES | values
        self.motion = Trajectory(self.values, PERIOD_S)
        state = state or still()
        self.motion.engage(state)
        self.place = state.position_nwu_m
        self.setpoints: list[PositionSetpoint] = []

    def run(self, seconds: float) -> Array:
        """Rows (ticks, 9): position, velocity, acceleration; where it is steered, the position is the velocity's."""
        rows = []
        for _ in range(round(seconds / PERIOD_S)):
            setpoint = self.motion.update(self.place)
            self.setpoints.append(setpoint)
            x, y, z = (
                b + v * PERIOD_S if isnan(a) else a
                for a, b, v in zip(setpoint.position_nwu_m, self.place, setpoint.velocity_nwu_m_s, strict=True)
            )
            self.place = (x, y, z)
            rows.append((*self.place, *setpoint.velocity_nwu_m_s, *setpoint.acceleration_nwu_m_s2))
        return np.array(rows)

    @property
    def track(self) -> Array:
        return np.array([(*s.position_nwu_m, *s.velocity_nwu_m_s, *s.acceleration_nwu_m_s2) for s in self.setpoints])


def jerks(track: Array) -> Array:
    return np.diff(track[:, 6:9], axis=0) / PERIOD_S


def assert_within_limits(track: Array, jerk: float = JERK, speed: float = VALUES["MPC_XY_CRUISE"]) -> None:
    assert np.max(np.hypot(track[:, 3], track[:, 4])) < speed * 1.001 + TOLERANCE
    assert np.max(np.hypot(track[:, 6], track[:, 7])) < VALUES["MPC_ACC_HOR"] + TOLERANCE
    assert np.max(track[:, 5]) < VALUES["MPC_Z_V_AUTO_UP"] * 1.001
    assert np.min(track[:, 5]) > -VALUES["MPC_Z_V_AUTO_DN"] * 1.001
    assert np.max(track[:, 8]) < VALUES["MPC_ACC_UP_MAX"] + TOLERANCE
    assert np.min(track[:, 8]) > -VALUES["MPC_ACC_DOWN_MAX"] - TOLERANCE
    rates = jerks(track)
    assert np.max(np.hypot(rates[:, 0], rates[:, 1])) < jerk + TOLERANCE
    assert np.max(np.abs(rates[:, 2])) < jerk + TOLERANCE


def assert_consistent(track: Array) -> None:
    """Velocity is the position's rate, acceleration the velocity's."""
    mean = 0.5 * (track[1:, 3:9] + track[:-1, 3:9])
    assert np.max(np.abs(np.diff(track[:, 0:3], axis=0) / PERIOD_S - mean[:, 0:3])) < 1e-4
    assert np.max(np.abs(np.diff(track[:, 3:6], axis=0) / PERIOD_S - mean[:, 3:6])) < 1e-6


@pytest.mark.parametrize(
    "target",
    [(0.3, 0.0, 0.0), (0.0, -1.0, 0.5), (3.0, 4.0, 2.5), (10.0, 0.0, 0.0), (-60.0, 30.0, -12.0), (0.0, 0.0, 30.0)],
)
@pytest.mark.parametrize("jerk", [1.0, 4.0, 30.0])
def test_from_rest_to_rest(target: Vector, jerk: float) -> None:
    follower = Follower(MPC_JERK_AUTO=jerk)
    follower.motion.go_to(target)
    assert not follower.motion.resting
    track = follower.run(32.0)
    assert_within_limits(track, jerk)
    assert_consistent(track)
    assert track[-1, :3] == pytest.approx(target, abs=1e-3)
    assert follower.motion.resting
    span = np.linalg.norm(target)
    along = track[:, :3] @ (np.array(target) / span)
    assert np.max(along) < span + 1e-3
    across = np.linalg.norm(
        track[:, :2] - np.outer(track[:, :2] @ target[:2], target[:2]) / max(hypot(*target[:2]), 1e-9) ** 2, axis=1
    )
    assert np.max(across) < 1e-6


@pytest.mark.parametrize(
    ("target", "seconds"), [((1.0, 0.0, 0.0), 2.5), ((10.0, 0.0, 0.0), 4.2), ((0.0, 0.0, 2.5), 3.0)]
)
def test_it_does_not_dawdle(target: Vector, seconds: float) -> None:
    """To 95 %. The least that jerk 4 and acceleration 3 allow for the whole way is 2.0 s, 4.6 s and 2.7 s."""
    follower = Follower()
    follower.motion.go_to(target)
    track = follower.run(seconds)
    assert np.linalg.norm(track[-1, :3]) > 0.95 * np.linalg.norm(target)


def test_cruise_is_flown_at_its_speed() -> None:
    follower = Follower()
    follower.motion.go_to((80.0, 60.0, 20.0), speed_m_s=8.0, climb_m_s=1.0)
    track = follower.run(10.0)
    assert hypot(track[-1, 3], track[-1, 4]) == pytest.approx(8.0, abs=0.01)
    assert track[-1, 5] == pytest.approx(1.0, abs=0.01)
    follower.values["MPC_XY_VEL_MAX"] = 3.0  # counts in flight, over what was asked for
    track = follower.run(4.0)
    assert hypot(track[-1, 3], track[-1, 4]) == pytest.approx(3.0, abs=0.01)


COORDINATE = st.floats(-40.0, 40.0)
PLACES = st.tuples(COORDINATE, COORDINATE, COORDINATE)
ORDER = st.one_of(
    st.tuples(st.just("go_to"), PLACES),
    st.tuples(st.just("stop"), st.just(ORIGIN)),
)


@settings(max_examples=12)
@given(st.lists(st.tuples(ORDER, st.floats(0.1, 4.0)), min_size=1, max_size=5))
def test_retargeting_never_jumps_nor_leaves_the_limits(orders: list[tuple[tuple[str, Vector], float]]) -> None:
    follower = Follower()
    for (order, place), seconds in orders:
        if order == "go_to":
            follower.motion.go_to(place)
        else:
            follower.motion.stop()
        follower.run(seconds)
    track = follower.track
    assert_within_limits(track, speed=1.02 * VALUES["MPC_XY_CRUISE"])
    assert_consistent(track)
    follower.motion.go_to((5.0, 5.0, 5.0))
    assert follower.run(35.0)[-1, :3] == pytest.approx((5.0, 5.0, 5.0), abs=0.01)


@settings(max_examples=12)
@given(st.tuples(*[st.floats(-4.0, 4.0)] * 2, st.floats(-1.4, 2.9)), st.floats(0.0, 30.0))
def test_from_any_motion_it_comes_to_its_aim(velocity: Vector, distance: float) -> None:
    follower = Follower(still(ORIGIN, velocity))
    follower.motion.go_to((distance, 0.0, 2.0))
    track = follower.run(20.0)
    assert track[0, 3:6] == pytest.approx(velocity, abs=0.01)
    assert_consistent(track)
    assert np.max(np.hypot(track[:, 6], track[:, 7])) < VALUES["MPC_ACC_HOR"] + TOLERANCE
    assert track[-1, :3] == pytest.approx((distance, 0.0, 2.0), abs=0.01)


def test_stop_brakes_and_stays() -> None:
    follower = Follower()
    follower.motion.go_to((100.0, 0.0, 0.0))
    fast = follower.run(5.0)[-1]
    follower.motion.stop()
    track = follower.run(6.0)
    v = fast[3]
    least = 0.5 * v * (v / VALUES["MPC_ACC_HOR"] + VALUES["MPC_ACC_HOR"] / JERK)
    stopped = track[-1, 0] - fast[0]
    assert least < stopped < 1.25 * least
    assert np.max(track[:, 0]) == pytest.approx(track[-1, 0], abs=1e-3)
    assert np.ptp(follower.run(2.0)[:, 0]) < 1e-3
    assert follower.motion.resting
    assert follower.motion.aim_nwu_m == pytest.approx(track[-1, :3], abs=1e-3)


def test_without_an_order_it_brakes() -> None:
    follower = Follower(still((1.0, 2.0, 3.0), (2.0, 0.0, 0.0)))
    track = follower.run(4.0)
    assert track[-1, 3:6] == pytest.approx(ORIGIN, abs=1e-3)
    assert track[-1, 1:3] == pytest.approx((2.0, 3.0))
    assert 1.42 < track[-1, 0] - 1.0 < 1.6  # v sqrt(v / J) is the least


def test_steered_it_gives_velocities_and_then_holds_where_the_vehicle_is() -> None:
    follower = Follower()
    follower.motion.steer((3.0, -4.0))
    follower.motion.climb(-1.0)
    track = follower.run(4.0)
    assert track[-1, 3:6] == pytest.approx((3.0, -4.0, -1.0), abs=1e-3)
    assert all(isnan(value) for value in follower.setpoints[-1].position_nwu_m)
    assert np.max(np.abs(jerks(track))) < VALUES["MPC_JERK_MAX"] + TOLERANCE
    x, y, z = follower.place
    follower.place = (x - 1.0, y + 1.0, z + 0.5)  # the vehicle is not quite where the velocities should have led
    follower.motion.steer((0.0, 0.0))
    follower.motion.climb(0.0)
    track = follower.run(3.0)
    assert np.max(np.abs(np.diff(track[:, :3], axis=0))) < 0.021  # 5 m/s: no way back to where it should have been
    held = follower.setpoints[-1].position_nwu_m
    assert held == pytest.approx(follower.place)
    assert follower.setpoints[-1].velocity_nwu_m_s == pytest.approx(ORIGIN, abs=1e-2)
    follower.place = (held[0] + 0.5, held[1], held[2])  # pushed: it does not follow
    assert follower.motion.update(follower.place).position_nwu_m == pytest.approx(held, abs=1e-3)


def test_horizontal_and_vertical_keep_their_aims_apart() -> None:
    follower = Follower()
    follower.motion.go_to((5.0, 0.0, nan))
    follower.motion.climb(1.0)
    follower.run(6.0)
    last = follower.setpoints[-1]
    assert last.position_nwu_m[:2] == pytest.approx((5.0, 0.0), abs=0.01)
    assert isnan(last.position_nwu_m[2])
    assert last.velocity_nwu_m_s[2] == pytest.approx(1.0, abs=1e-3)
    follower.motion.go_to((nan, nan, 3.0))
    assert follower.run(6.0)[-1, :3] == pytest.approx((5.0, 0.0, 3.0), abs=0.01)


def test_it_waits_for_a_vehicle_that_cannot_follow() -> None:
    """Held fast at the origin, the motion goes no further than its leash; let go, it goes on."""
    follower = Follower()
    follower.motion.go_to((50.0, 0.0, 0.0))
    for _ in range(5000):
        setpoint = follower.motion.update(ORIGIN)
    assert setpoint.position_nwu_m[0] == pytest.approx(2.0, abs=0.01)
    assert setpoint.velocity_nwu_m_s[0] == pytest.approx(0.0, abs=0.02)
    follower.place = setpoint.position_nwu_m
    assert follower.run(20.0)[-1, 0] == pytest.approx(50.0, abs=0.01)


@pytest.mark.parametrize("lost", [(nan, 0.0, 0.0), (inf, nan, -inf), (0.0, 0.0, nan)])
def test_a_place_that_is_not_known_gives_no_nan(lost: Vector) -> None:
    motion = Trajectory(VALUES, PERIOD_S)
    motion.engage(still((1.0, 1.0, 1.0)))
    motion.engage(State(lost, lost, (nan, nan, nan, nan)))
    motion.go_to((9.0, 0.0, 0.0), nan)
    for _ in range(100):
        setpoint = motion.update(lost)
        assert np.all(np.isfinite(np.hstack([np.hstack(setpoint[:3]), setpoint[3:]])))
    motion.steer((1.0, 0.0))
    motion.climb(1.0)
    for _ in range(100):
        setpoint = motion.update(lost)
        assert np.all(np.isfinite(np.hstack([np.hstack(setpoint[1:3]), setpoint[3:]])))


@pytest.mark.parametrize(("start", "target"), [(0.0, 2.0), (3.0, -3.0), (-1.0, -1.2), (0.5, 0.5 + pi - 0.01)])
def test_yaw_turns_the_shorter_way_within_its_rate(start: float, target: float) -> None:
    follower = Follower(still(yaw=start))
    follower.motion.go_to(ORIGIN, target)
    follower.run(14.0)
    yaws = np.unwrap([start, *(setpoint.yaw_rad for setpoint in follower.setpoints)])
    rates = np.diff(yaws) / PERIOD_S
    turn = remainder(target - start, 2.0 * pi)
    assert yaws[-1] - start == pytest.approx(turn, abs=1e-3)
    assert np.max(np.abs(rates)) < radians(VALUES["MPC_YAWRAUTO_MAX"]) + TOLERANCE
    assert np.max(np.abs(np.diff(rates))) < radians(VALUES["MPC_YAWRAUTO_ACC"]) * PERIOD_S + TOLERANCE
    assert np.max((yaws - start) * np.sign(turn)) < abs(turn) + 1e-3
    assert [setpoint.yaw_rate_rad_s for setpoint in follower.setpoints] == pytest.approx(rates, abs=1e-9)


def test_yaw_is_kept_where_none_is_asked_for() -> None:
    follower = Follower(still(yaw=1.2))
    follower.motion.go_to((5.0, 0.0, 0.0))
    follower.run(1.0)
    assert follower.setpoints[-1].yaw_rad == pytest.approx(1.2)


@pytest.mark.parametrize(
    ("height", "speed"), [(50.0, 1.5), (10.0, 1.5), (7.5, 1.1), (5.0, 0.7), (0.0, 0.7), (-3.0, 0.7), (nan, 0.7)]
)
def test_landing_speed(height: float, speed: float) -> None:
    assert landing_speed(height, VALUES) == pytest.approx(speed)


@pytest.mark.parametrize(("low", "high", "speed"), [(5.0, 5.0, 1.5), (8.0, 2.0, 1.5)])
def test_landing_altitudes_in_disorder(low: float, high: float, speed: float) -> None:
    assert landing_speed(20.0, VALUES | {"MPC_LAND_ALT1": high, "MPC_LAND_ALT2": low}) == speed


def test_takeoff_ramp() -> None:
    values = VALUES | {"MPC_TKO_RAMP_T": 2.0, "MPC_Z_VEL_P_ACC": 4.0}
    limits: Callable[[float], float] = lambda since: takeoff_climb_limit(since, 9.81, values)  # noqa: E731
    assert limits(-1.0) == limits(0.0) == pytest.approx(-9.81 / 4.0)
    assert limits(1.0) == pytest.approx(0.5 * (1.5 - 9.81 / 4.0))
    assert limits(2.0) == inf
    assert takeoff_climb_limit(0.0, 9.81, values | {"MPC_TKO_RAMP_T": 0.0}) == inf
