"""The position and velocity cascade: its limits, what it does without a measurement, and how it flies."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import acos, degrees, hypot, inf, isfinite, nan, pi, radians, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot.position import (
    PositionControl,
    approach_speed,
    thrust_attitude,
)
from mavsitl_vehicle.autopilot.setpoints import (
    FREE,
    AttitudeSetpoint,
    PositionSetpoint,
    RateSetpoint,
    Setpoint,
    State,
)
from mavsitl_vehicle.autopilot.trajectory import Trajectory, landing_speed, takeoff_climb_limit
from msgspec.structs import astuple

from mavsitl.frames import Quaternion, Vector
from mavsitl.quaternion import conjugate, from_euler, multiply, to_euler, up_vector
from tests.autopilot.fly import PERIOD_S, VALUES, Array, Rig

LEVEL: Quaternion = (1.0, 0.0, 0.0, 0.0)
ORIGIN: Vector = (0.0, 0.0, 0.0)
AT_REST = State(ORIGIN, ORIGIN, LEVEL)
GRAVITY = 9.81
HOVER = 0.5


def cascade(**values: float) -> PositionControl:
    return PositionControl(VALUES | values, GRAVITY, HOVER, PERIOD_S)


def turn_between(a: Quaternion, b: Quaternion) -> float:
    """Degrees."""
    w, x, y, z = multiply(conjugate(a), b)
    return degrees(2.0 * np.arctan2(sqrt(x * x + y * y + z * z), abs(w)))


def tilt(attitude: Quaternion) -> float:
    """Degrees."""
    return degrees(acos(min(up_vector(attitude)[2], 1.0)))


def thrust_vector(setpoint: AttitudeSetpoint) -> Array:
    return setpoint.thrust * np.array(up_vector(setpoint.attitude))


# --- whatever comes in, what goes out can be flown


ANYTHING = st.one_of(st.floats(-50.0, 50.0), st.sampled_from([nan, inf, -inf, 0.0, 1e38, -3.0e38, 1e-300]))
ANY_VECTOR = st.tuples(ANYTHING, ANYTHING, ANYTHING)
ANY_SETPOINT = st.builds(PositionSetpoint, ANY_VECTOR, ANY_VECTOR, ANY_VECTOR, ANYTHING, ANYTHING)
ANY_STATE = st.builds(State, ANY_VECTOR, ANY_VECTOR, st.tuples(ANYTHING, ANYTHING, ANYTHING, ANYTHING))


@given(st.lists(st.tuples(ANY_SETPOINT, ANY_STATE), min_size=1, max_size=4))
def test_any_input_gives_a_setpoint_within_the_limits(ticks: list[tuple[PositionSetpoint, State]]) -> None:
    control = cascade(MPC_XY_VEL_D_ACC=0.2, MPC_Z_VEL_D_ACC=0.1)
    control.engage(AttitudeSetpoint(from_euler(0.3, -0.2, 2.0), 0.0, 0.6))
    for setpoint, state in [*ticks, (PositionSetpoint(ORIGIN), AT_REST)]:
        attitude, yaw_rate, thrust = astuple(control.update(setpoint, state))
        assert all(isfinite(value) for value in (*attitude, yaw_rate, thrust))
        assert hypot(*attitude) == pytest.approx(1.0, abs=1e-9)
        assert VALUES["MPC_THR_MIN"] - 1e-9 <= thrust <= VALUES["MPC_THR_MAX"]
        assert tilt(attitude) <= VALUES["MPC_TILTMAX_AIR"] + 1e-6


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("lost", ["position", "velocity", "both"])
def test_a_missing_measurement_takes_its_own_axis_only(lost: str, axis: int) -> None:
    position, velocity = [1.0, -2.0, 3.0], [0.5, 0.5, -0.5]
    if lost != "velocity":
        position[axis] = nan
    if lost != "position":
        velocity[axis] = nan
    setpoint = PositionSetpoint(ORIGIN, (0.1, 0.2, 0.3), (0.01, 0.02, 0.03))
    broken = cascade()
    broken.update(setpoint, State((*position,), (*velocity,), LEVEL))  # type: ignore[arg-type]
    whole = cascade()
    whole.update(setpoint, State((1.0, -2.0, 3.0), (0.5, 0.5, -0.5), LEVEL))
    for i in range(3):
        got, full = broken.acceleration_setpoint_nwu_m_s2[i], whole.acceleration_setpoint_nwu_m_s2[i]
        if i != axis:
            assert got == pytest.approx(full, abs=0.3)  # x and y share one braking curve
        elif lost == "position":
            gain = VALUES["MPC_Z_VEL_P_ACC" if i == 2 else "MPC_XY_VEL_P_ACC"]
            fed = (0.1, 0.2, 0.3)[i] - (0.5, 0.5, -0.5)[i]
            assert got == pytest.approx((0.01, 0.02, 0.03)[i] + gain * fed)
        else:
            assert got == pytest.approx((0.01, 0.02, 0.03)[i])


# --- the parts, by hand


@pytest.mark.parametrize("yaw", [-3.0, -1.0, 0.0, 0.7, 3.1])
@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.0, -0.6, 0.8), (-0.48, 0.6, 0.64)])
def test_thrust_attitude_points_the_thrust_and_keeps_the_heading(up: Vector, yaw: float) -> None:
    attitude = thrust_attitude(up, yaw)
    assert hypot(*attitude) == pytest.approx(1.0, abs=1e-12)
    assert up_vector(attitude) == pytest.approx(up, abs=1e-12)
    assert to_euler(attitude)[2] == pytest.approx(yaw, abs=1e-12)


def test_at_rest_on_its_place_it_hovers() -> None:
    attitude, yaw_rate, thrust = astuple(cascade().update(PositionSetpoint(ORIGIN), AT_REST))
    assert attitude == LEVEL
    assert yaw_rate == 0.0
    assert thrust == pytest.approx(HOVER)


@pytest.mark.parametrize(
    ("acceleration", "direction"),
    [((2.0, 0.0, 0.0), (2.0, 0.0, GRAVITY)), ((0.0, -3.0, 2.0), (0.0, -3.0, GRAVITY + 2.0))],
)
def test_acceleration_alone_becomes_that_force(acceleration: Vector, direction: Vector) -> None:
    """With velocities that nobody asks about."""
    state = State((5.0, 5.0, 5.0), (3.0, 3.0, 3.0), LEVEL)
    control = cascade()
    force = thrust_vector(control.update(PositionSetpoint(acceleration_nwu_m_s2=acceleration), state))
    assert force * GRAVITY / HOVER == pytest.approx(direction)
    assert all(value != value for value in control.velocity_setpoint_nwu_m_s)


def test_an_axis_that_nothing_is_asked_of_is_braked() -> None:
    control = cascade()
    control.update(PositionSetpoint((nan, nan, 2.0)), State((9.0, 9.0, 2.0), (2.0, -1.0, 0.0), LEVEL))
    gain = VALUES["MPC_XY_VEL_P_ACC"]
    assert control.velocity_setpoint_nwu_m_s == (0.0, 0.0, 0.0)
    assert control.acceleration_setpoint_nwu_m_s2 == pytest.approx((-2.0 * gain, gain, 0.0))


@pytest.mark.parametrize(
    ("error", "fed", "expected"),
    [
        ((1.0, 0.0), (0.5, 0.0), (2.5, 0.0)),  # within the limit: added
        ((1.0, 0.0), (0.0, 9.0), (2.0, sqrt(5.0))),  # the way back first, the rest across it
        ((1.0, 0.0), (9.0, 0.0), (3.0, 0.0)),
        ((100.0, 0.0), (0.0, 5.0), (3.0, 0.0)),  # nothing left
        ((0.0, 0.0), (6.0, 8.0), (1.8, 2.4)),
    ],
)
def test_the_way_back_comes_before_the_feed_forward(
    error: tuple[float, float], fed: tuple[float, float], expected: tuple[float, float]
) -> None:
    control = cascade(MPC_XY_VEL_MAX=3.0, MPC_XY_P=2.0, MPC_ACC_HOR_MAX=100.0)
    control.update(PositionSetpoint((*error, 0.0), (*fed, 0.0)), AT_REST)
    assert control.velocity_setpoint_nwu_m_s == pytest.approx((*expected, 0.0))


@pytest.mark.parametrize(("z", "expected"), [(50.0, 3.0), (-50.0, -1.5), (0.1, 0.15), (-0.1, -0.15)])
def test_climb_and_descent_have_their_own_limits(z: float, expected: float) -> None:
    control = cascade()
    control.update(PositionSetpoint((0.0, 0.0, z)), AT_REST)
    assert control.velocity_setpoint_nwu_m_s[2] == pytest.approx(expected)


def test_approach_speed_is_smooth_and_brakes_no_harder_than_said() -> None:
    distances = np.linspace(0.0, 30.0, 3001)
    speeds = np.array([approach_speed(d, 1.5, 4.0)[0] for d in distances])
    assert speeds[100] == pytest.approx(1.5)
    slope = np.diff(speeds) / np.diff(distances)
    assert np.all(np.diff(slope) < 1e-9)
    assert np.max(slope * speeds[1:]) < 4.05  # dv/dt = dv/dd v
    assert approach_speed(5.0, 0.0, 4.0) == (0.0, False)


def test_the_vertical_comes_first_and_leaves_a_margin() -> None:
    control = cascade(MPC_TILTMAX_AIR=80.0, MPC_THR_XY_MARG=0.2)
    both = control.update(PositionSetpoint(acceleration_nwu_m_s2=(100.0, 0.0, 100.0)), AT_REST)
    aside, _, up = thrust_vector(both)
    assert both.thrust == pytest.approx(1.0)
    assert aside == pytest.approx(0.2)
    assert up == pytest.approx(sqrt(1.0 - 0.2**2))
    hovering = cascade(MPC_TILTMAX_AIR=80.0).update(PositionSetpoint(acceleration_nwu_m_s2=(100.0, 0.0, 0.0)), AT_REST)
    assert thrust_vector(hovering)[2] == pytest.approx(HOVER)
    assert hovering.thrust == pytest.approx(1.0)


@pytest.mark.parametrize("tilt_deg", [20.0, 45.0, 60.0])
def test_tilt_limit_keeps_the_lift(tilt_deg: float) -> None:
    control = cascade(MPC_TILTMAX_AIR=tilt_deg, MPC_THR_MAX=1.0)
    setpoint = control.update(PositionSetpoint(acceleration_nwu_m_s2=(-40.0, 30.0, 0.0)), AT_REST)
    x, y, z = thrust_vector(setpoint)
    assert tilt(setpoint.attitude) == pytest.approx(min(tilt_deg, 60.0))
    assert z == pytest.approx(HOVER)
    assert y / x == pytest.approx(-0.75)


def test_least_thrust() -> None:
    setpoint = cascade().update(PositionSetpoint(acceleration_nwu_m_s2=(0.0, 0.0, -100.0)), AT_REST)
    assert setpoint.thrust == pytest.approx(VALUES["MPC_THR_MIN"])
    assert setpoint.attitude == pytest.approx(LEVEL)


def test_parameters_count_from_the_next_update_on() -> None:
    values = dict(VALUES)
    control = PositionControl(values, GRAVITY, HOVER, PERIOD_S)
    moving = State(ORIGIN, (1.0, 0.0, 0.0), LEVEL)
    control.update(PositionSetpoint(velocity_nwu_m_s=ORIGIN), moving)
    before = control.acceleration_setpoint_nwu_m_s2[0]
    values["MPC_XY_VEL_P_ACC"] *= 2.0
    control.update(PositionSetpoint(velocity_nwu_m_s=ORIGIN), moving)
    assert control.acceleration_setpoint_nwu_m_s2[0] == pytest.approx(2.0 * before, rel=0.01)


def test_the_derivative_damps() -> None:
    """0.1 m/s more a tick is 25 m/s^2, most of which is behind its filter after eight of its time constants."""
    accelerations = []
    for gain in (0.0, 0.2):
        control = cascade(MPC_XY_VEL_D_ACC=gain, MPC_XY_VEL_I_ACC=0.0)
        for tick in range(64):
            control.update(PositionSetpoint(velocity_nwu_m_s=ORIGIN), State(ORIGIN, (0.1 * tick, 0.0, 0.0), LEVEL))
        accelerations.append(control.acceleration_setpoint_nwu_m_s2[0])
    assert accelerations[1] - accelerations[0] == pytest.approx(-0.2 * 25.0, rel=0.02)


# --- heading


def test_yaw_is_held_where_it_was_unless_it_is_asked_for() -> None:
    control = cascade()

    def yaw(setpoint: PositionSetpoint, measured: float) -> float:
        state = State(ORIGIN, ORIGIN, from_euler(0.0, 0.0, measured))
        return to_euler(control.update(setpoint, state).attitude)[2]

    assert yaw(PositionSetpoint(ORIGIN), 0.4) == pytest.approx(0.4)
    assert yaw(PositionSetpoint(ORIGIN), 0.5) == pytest.approx(0.4)
    assert yaw(PositionSetpoint(ORIGIN, yaw_rad=-2.0), 0.5) == pytest.approx(-2.0)
    assert yaw(PositionSetpoint(ORIGIN), 0.5) == pytest.approx(-2.0)
    control.reset()
    assert yaw(PositionSetpoint(ORIGIN), 0.5) == pytest.approx(0.5)


def test_a_yaw_rate_turns_the_heading_and_does_not_run_away() -> None:
    rig = Rig(height_m=5.0)
    track = rig.fly(3.0, lambda _: PositionSetpoint((0.0, 0.0, 5.0), yaw_rate_rad_s=-0.5))
    yaw = to_euler(tuple(track[-1, 6:10]))[2]
    assert yaw == pytest.approx(-1.5, abs=0.05)
    assert track[-1, 12] == pytest.approx(-0.5, abs=0.02)
    control = cascade()
    for _ in range(1000):
        setpoint = control.update(PositionSetpoint(ORIGIN, yaw_rate_rad_s=2.0), AT_REST)
    assert to_euler(setpoint.attitude)[2] == pytest.approx(0.3)


# --- switches of modes


TILTED = AttitudeSetpoint(from_euler(0.2, 0.35, 1.0), 0.0, 0.56)


@pytest.mark.parametrize(
    "setpoint",
    [
        PositionSetpoint(ORIGIN),
        PositionSetpoint((5.0, -3.0, 2.0), yaw_rad=-1.0),
        PositionSetpoint(velocity_nwu_m_s=(-4.0, 0.0, 1.0)),
        PositionSetpoint(acceleration_nwu_m_s2=(0.0, 2.0, -1.0), yaw_rad=3.0),
    ],
)
def test_it_begins_where_the_mode_before_left_off(setpoint: PositionSetpoint) -> None:
    control = cascade()
    state = State(ORIGIN, (1.0, 2.0, -0.5), TILTED.attitude)
    control.engage(TILTED)
    first = control.update(setpoint, state)
    assert turn_between(first.attitude, TILTED.attitude) < 0.01
    assert first.thrust == pytest.approx(TILTED.thrust, abs=1e-6)
    unblended = cascade()
    unblended.engage(None)
    aim = unblended.update(setpoint, state)
    assert turn_between(aim.attitude, TILTED.attitude) > 5.0
    for _ in range(500):  # ten time constants: what is left of the step is nothing
        last = control.update(setpoint, state)
        aim = unblended.update(setpoint, state)
    assert turn_between(last.attitude, aim.attitude) < 0.5
    assert last.thrust == pytest.approx(aim.thrust, abs=0.01)


def steps(setpoints: list[AttitudeSetpoint]) -> tuple[float, float]:
    """Largest change from one tick to the next: degrees, thrust."""
    pairs = list(pairwise(setpoints))
    return (
        max(turn_between(a.attitude, b.attitude) for a, b in pairs),
        max(abs(a.thrust - b.thrust) for a, b in pairs),
    )


@pytest.mark.parametrize("airframe", ["paper", "realistic"])
def test_no_jump_in_flight(airframe: str) -> None:
    """Tilted flight by attitude, then hold, then a velocity, then a point, then braking: in noise, on the plant.

    Without the blend the point ahead alone is 45 degrees of tilt and as many of yaw at once. Noise makes up to 2.
    """
    rig = Rig(airframe=airframe, height_m=20.0)
    flown: list[AttitudeSetpoint] = []

    def recorded(law: Callable[[State], Setpoint | PositionSetpoint]) -> Callable[[State], Setpoint]:
        def fly(state: State) -> Setpoint:
            setpoint = law(state)
            if isinstance(setpoint, PositionSetpoint):
                setpoint = rig.control.update(setpoint, state)
            assert isinstance(setpoint, AttitudeSetpoint)
            flown.append(setpoint)
            return setpoint

        return fly

    tilted = AttitudeSetpoint(from_euler(0.0, radians(15.0), 0.3), 0.0, rig.hover_thrust / 0.966)
    rig.fly(1.0, recorded(lambda _: tilted))
    motion = Trajectory(rig.values, PERIOD_S)
    motion.engage(rig.state)
    rig.engage()
    rig.fly(1.0, recorded(lambda state: motion.update(state.position_nwu_m)))
    rig.engage()
    rig.fly(1.0, recorded(lambda _: PositionSetpoint(velocity_nwu_m_s=(-2.0, 3.0, 0.5), yaw_rad=0.3)))
    rig.engage()
    x, y, z = rig.state.position_nwu_m
    rig.fly(1.0, recorded(lambda _: PositionSetpoint((x + 8.0, y, z), yaw_rad=-0.5)))
    rig.engage()
    motion.engage(rig.state)
    rig.fly(1.0, recorded(lambda state: motion.update(state.position_nwu_m)))
    turn, thrust = steps(flown)
    assert turn < 2.5
    assert thrust < 0.04


def test_after_rates_it_acts_at_once() -> None:
    rig = Rig(height_m=20.0)
    rig.flown = RateSetpoint((0.0, 0.0, 0.0), 0.9)
    rig.engage()
    setpoint = rig.control.update(PositionSetpoint((0.0, 0.0, 20.0)), State((0.0, 0.0, 20.0), ORIGIN, LEVEL))
    assert setpoint.thrust == pytest.approx(rig.hover_thrust)


# --- on the plant

HOLD = PositionSetpoint((0.0, 0.0, 10.0), yaw_rad=0.0)


def errors(track: Array, place: Vector) -> Array:
    off: Array = np.linalg.norm(track[:, :3] - np.array(place), axis=1)
    return off


@pytest.mark.parametrize("airframe", ["paper", "realistic"])
def test_hold_in_calm_air(airframe: str) -> None:
    """With noise of 1 cm and 1 cm/s, twice the scenarios'."""
    rig = Rig(airframe=airframe, height_m=10.0, noise__position_m=0.01, noise__velocity_m_s=0.01)
    track = rig.fly(10.0, lambda _: HOLD)
    assert np.max(errors(track[500:], (0.0, 0.0, 10.0))) < 0.01
    rates = np.degrees(track[500:, 10:12])
    assert np.sqrt(np.mean(rates * rates)) < 6.0


@pytest.mark.parametrize(("airframe", "rmse", "largest"), [("paper", 0.12, 0.35), ("realistic", 0.18, 0.5)])
def test_hold_in_the_paper_s_wind(airframe: str, rmse: float, largest: float) -> None:
    rig = Rig(scenario="hover-wind", airframe=airframe, height_m=10.0)
    track = rig.fly(30.0, lambda _: HOLD)[500:]
    off = errors(track, (0.0, 0.0, 10.0))
    assert np.sqrt(np.mean(off * off)) < rmse
    assert np.max(off) < largest
    assert np.max(np.abs(track[:, 2] - 10.0)) < 0.05


@pytest.mark.parametrize("airframe", ["paper", "realistic"])
def test_a_steady_wind_leaves_no_error(airframe: str) -> None:
    wind = [{"model": "steady", "velocity_nwu_m_s": [6.0, -3.0, 1.0]}]
    rig = Rig(airframe=airframe, height_m=10.0, wind=wind)
    track = rig.fly(14.0, lambda _: HOLD)
    assert np.max(errors(track[-500:], (0.0, 0.0, 10.0))) < 0.03
    assert np.max(errors(track, (0.0, 0.0, 10.0))) > 0.05


@pytest.mark.parametrize("airframe", ["paper", "realistic"])
def test_a_step_of_ten_metres(airframe: str) -> None:
    """Off-board style, the point at once, and as the automatic modes fly it, at cruise speed."""
    rig = Rig(airframe=airframe, height_m=10.0)
    track = rig.fly(8.0, lambda _: PositionSetpoint((10.0, 0.0, 10.0), yaw_rad=0.0))
    assert np.max(track[:, 0]) < 10.05
    assert np.all(np.abs(track[1000:, 0] - 10.0) < 0.3)
    assert np.max(np.abs(track[:, 2] - 10.0)) < 0.1

    rig = Rig(airframe=airframe, height_m=10.0)
    motion = Trajectory(rig.values, PERIOD_S)
    motion.engage(rig.state)
    motion.go_to((10.0, 0.0, 10.0))
    track = rig.fly(8.0, lambda state: motion.update(state.position_nwu_m))
    assert np.max(track[:, 0]) < 10.02
    assert np.max(track[:, 3]) > 4.0
    assert np.all(np.abs(track[1000:, 0] - 10.0) < 0.5)
    assert np.max(np.abs(track[:, 2] - 10.0)) < 0.05


def test_a_step_of_a_hundred_metres_saturates_and_does_not_overshoot() -> None:
    rig = Rig(airframe="realistic", height_m=30.0)
    track = rig.fly(22.0, lambda _: PositionSetpoint((60.0, -80.0, 30.0)))
    along = track[:, :2] @ np.array([0.6, -0.8])
    assert np.max(np.hypot(track[:, 3], track[:, 4])) == pytest.approx(12.0, abs=0.3)
    assert np.max(along) < 100.1
    assert along[-1] == pytest.approx(100.0, abs=0.1)
    assert np.max(np.abs(track[:, 2] - 30.0)) < 0.3


def test_velocity_with_a_height_and_acceleration_off_board() -> None:
    rig = Rig(height_m=10.0)
    track = rig.fly(4.0, lambda _: PositionSetpoint((nan, nan, 12.0), (4.0, -3.0, nan)))
    assert track[-1, 3:5] == pytest.approx((4.0, -3.0), abs=0.05)
    assert track[-1, 2] == pytest.approx(12.0, abs=0.05)
    rig = Rig(height_m=10.0)
    track = rig.fly(1.0, lambda _: PositionSetpoint(acceleration_nwu_m_s2=(2.0, 0.0, 0.0)))
    assert track[-1, 3] == pytest.approx(2.0, abs=0.15)
    assert track[-1, 5] == pytest.approx(0.0, abs=0.1)


def test_what_could_not_be_had_is_not_paid_back() -> None:
    """Ten seconds with too little thrust to leave the ground, then enough of it: the climb ends where it should."""
    rig = Rig(values={"MPC_THR_MAX": 0.45})
    held = rig.fly(10.0, lambda _: PositionSetpoint((0.0, 0.0, 3.0), yaw_rad=0.0))
    assert np.max(held[:, 2]) < 0.01
    rig.values["MPC_THR_MAX"] = 1.0
    track = rig.fly(8.0, lambda _: PositionSetpoint((0.0, 0.0, 3.0), yaw_rad=0.0))
    assert np.max(track[:, 2]) < 3.1
    assert track[-1, 2] == pytest.approx(3.0, abs=0.02)


@pytest.mark.parametrize(("climb", "limits"), [(1.0, {"MPC_THR_MAX": 0.45}), (-1.0, {"MPC_THR_MIN": 0.6})])
def test_a_thrust_limit_winds_nothing_up(climb: float, limits: dict[str, float]) -> None:
    values = VALUES | limits
    control = PositionControl(values, GRAVITY, HOVER, PERIOD_S)
    for _ in range(1000):
        control.update(PositionSetpoint(velocity_nwu_m_s=(0.0, 0.0, climb)), AT_REST)
    values.update(VALUES)
    thrust = control.update(PositionSetpoint(velocity_nwu_m_s=ORIGIN), AT_REST).thrust
    assert thrust == pytest.approx(HOVER, abs=0.01)


def test_a_wind_beyond_the_tilt_limit_winds_nothing_up() -> None:
    """Blown away at the tilt limit, then back in calm: a wound-up integral would carry it far past its place."""
    wind = [{"model": "gust", "velocity_nwu_m_s": [9.0, 0.0, 0.0], "start_s": 1.0, "length_s": 5.0, "shape": "pulse"}]
    rig = Rig(height_m=10.0, wind=wind, values={"MPC_TILTMAX_AIR": 10.0, "MPC_ACC_HOR_MAX": 1.0})
    track = rig.fly(25.0, lambda _: HOLD)
    assert np.max(track[:, 0]) > 30.0
    assert np.min(track[:, 0]) > -0.1
    assert abs(track[-1, 0]) < 0.05


@pytest.mark.parametrize("airframe", ["paper", "realistic"])
@pytest.mark.parametrize("ramp_s", [0.0, 0.5])
def test_take_off_and_land(airframe: str, ramp_s: float) -> None:
    rig = Rig(airframe=airframe, values={"MPC_TKO_RAMP_T": ramp_s})
    motion = Trajectory(rig.values, PERIOD_S)
    motion.engage(rig.state)
    motion.go_to((0.0, 0.0, 2.5), climb_m_s=rig.values["MPC_TKO_SPEED"])
    climb = [
        rig.fly(
            PERIOD_S,
            lambda state: motion.update(state.position_nwu_m),
            takeoff_climb_limit(tick * PERIOD_S, GRAVITY, rig.values),
        )[0]
        for tick in range(1500)
    ]
    track = np.array(climb)
    up = np.nonzero(track[:, 2] > 0.95 * 2.5)[0][0] * PERIOD_S
    assert 2.3 < up < 3.3
    assert np.max(track[:, 2]) < 1.02 * 2.5
    assert np.max(np.hypot(track[:, 0], track[:, 1])) < 0.02

    motion.climb(-landing_speed(2.5, rig.values))
    track = rig.fly(6.0, lambda state: motion.update(state.position_nwu_m))
    touching = int(np.nonzero(track[:, 2] < 0.05)[0][0])
    assert track[touching - 50, 5] == pytest.approx(-0.7, abs=0.05)
    assert np.min(track[:, 5]) > -0.8
    assert np.all(np.abs(track[-250:, 5]) < 0.01)
    assert isinstance(rig.flown, AttitudeSetpoint)
    assert rig.flown.thrust < 0.5 * rig.hover_thrust
    assert track[-1, 2] < 0.05


def test_setpoints_by_default_ask_for_nothing() -> None:
    assert PositionSetpoint()[:3] == (FREE, FREE, FREE)
    assert abs(State.of([0.0] * 6 + [0.0, 0.0, 0.0, 1.0, 9.0, 9.0, 9.0]).yaw_rad) == pytest.approx(pi)
