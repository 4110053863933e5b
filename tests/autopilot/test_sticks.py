"""The stick-flown laws: which way each stick moves the vehicle, what is held in the middle, and no jump at a switch."""

from __future__ import annotations

from itertools import pairwise
from math import atan2, cos, degrees, hypot, inf, isfinite, isnan, nan, pi, radians, sin, tan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint, PositionSetpoint, State
from mavsitl_vehicle.autopilot.sticks import (
    CENTRED,
    Acro,
    AltitudeControl,
    Axes,
    PositionHold,
    Stabilized,
    throttle_curve,
    wants_takeoff,
)

from mavsitl.frames import Vector
from mavsitl.quaternion import conjugate, from_yaw, multiply, rotate, to_euler, up_vector
from tests.autopilot.fly import PERIOD_S, VALUES, Rig

GRAVITY = 9.81
HOVER = 0.4
ORIGIN: Vector = (0.0, 0.0, 0.0)


def facing(yaw: float, place: Vector = ORIGIN, velocity: Vector = ORIGIN) -> State:
    return State(place, velocity, from_yaw(yaw))


def stabilized(**values: float) -> Stabilized:
    return Stabilized(VALUES | values, HOVER, PERIOD_S)


# --- STABILIZED

DIRECTIONS = [
    ((1.0, 0.0), 0.0),  # forward
    ((0.0, 1.0), -pi / 2),  # right
    ((-1.0, 0.0), pi),
    ((0.0, -1.0), pi / 2),
    ((1.0, 1.0), -pi / 4),
]


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
@pytest.mark.parametrize(("stick", "bearing"), DIRECTIONS)
def test_the_thrust_leans_where_the_stick_points(stick: tuple[float, float], bearing: float, yaw: float) -> None:
    """Counter-clockwise from the nose; a stick in the corner tilts no further than one at the rim."""
    law = stabilized()
    law.engage(facing(yaw))
    setpoint = law.update(Axes(*stick, 0.0, 0.5), facing(yaw))
    x, y, z = up_vector(setpoint.attitude)
    assert atan2(hypot(x, y), z) == pytest.approx(radians(VALUES["MPC_MAN_TILT_MAX"]))
    assert cos(atan2(y, x) - yaw - bearing) == pytest.approx(1.0)


def test_half_the_stick_is_half_the_tilt() -> None:
    law = stabilized()
    law.engage(facing(0.3))
    x, y, z = up_vector(law.update(Axes(-0.5, 0.0, 0.0, 0.5), facing(0.3)).attitude)
    assert degrees(atan2(hypot(x, y), z)) == pytest.approx(0.5 * VALUES["MPC_MAN_TILT_MAX"])


def test_the_heading_is_held_until_the_yaw_stick_turns_it() -> None:
    law = stabilized()
    law.engage(facing(0.4))
    assert to_euler(law.update(CENTRED, facing(0.6)).attitude)[2] == pytest.approx(0.4)
    setpoint = law.update(Axes(0.0, 0.0, 1.0, 0.5), facing(0.4))
    rate = -radians(VALUES["MPC_MAN_Y_MAX"])  # clockwise
    assert setpoint.yaw_rate_rad_s == pytest.approx(rate)
    assert to_euler(setpoint.attitude)[2] == pytest.approx(0.4 + rate * PERIOD_S)
    for _ in range(1000):
        setpoint = law.update(Axes(0.0, 0.0, 1.0, 0.5), facing(0.4))
    assert to_euler(setpoint.attitude)[2] == pytest.approx(0.1)  # at most 0.3 rad ahead
    assert law.update(CENTRED, facing(0.4)).yaw_rate_rad_s == 0.0


@pytest.mark.parametrize(
    ("curve", "throttle", "thrust"),
    [
        (0, 0.0, 0.08),
        (0, 0.25, 0.5 * (0.08 + HOVER)),
        (0, 0.5, HOVER),
        (0, 0.75, 0.5 * (HOVER + 0.9)),
        (0, 1.0, 0.9),
        (1, 0.5, 0.5 * (0.08 + 0.9)),
        (1, 1.0, 0.9),
        (2, 0.5, 0.55),
        (2, 1.0, 0.9),
    ],
)
def test_throttle(curve: int, throttle: float, thrust: float) -> None:
    law = stabilized(MPC_THR_CURVE=curve, MPC_THR_MAX=0.9, MPC_THR_HOVER=0.55)
    assert law.update(Axes(0.0, 0.0, 0.0, throttle), facing(0.0)).thrust == pytest.approx(thrust)


def test_throttle_rises_all_the_way() -> None:
    thrusts = [throttle_curve(step / 100.0, 0.0, HOVER, VALUES) for step in range(101)]
    assert thrusts[0] == 0.0
    assert all(a < b for a, b in pairwise(thrusts))


# --- ACRO


def test_acro_rates_in_body_axes() -> None:
    values = VALUES | {"MC_ACRO_R_MAX": 100.0, "MC_ACRO_P_MAX": 200.0, "MC_ACRO_Y_MAX": 50.0}
    law = Acro(values, HOVER)
    law.engage(facing(0.0))
    setpoint = law.update(Axes(0.5, 1.0, -1.0, 0.5), facing(0.0))
    # FLU: nose down is positive pitch, right wing down positive roll, anti-clockwise positive yaw
    assert setpoint.omega_flu_rad_s == pytest.approx((radians(100.0), radians(100.0), radians(50.0)))
    assert setpoint.thrust == pytest.approx(HOVER)
    assert law.update(Axes(0.0, 0.0, 0.0, 0.0), facing(0.0)).thrust == 0.0


# --- ALTCTL and POSCTL


def altitude_control(**values: float) -> AltitudeControl:
    return AltitudeControl(VALUES | values, GRAVITY, PERIOD_S)


@pytest.mark.parametrize(("stick", "bearing"), DIRECTIONS)
def test_altitude_control_tilts(stick: tuple[float, float], bearing: float) -> None:
    law = altitude_control()
    law.engage(facing(1.0))
    setpoint = law.update(Axes(*stick, 0.0, 0.5), facing(1.0))
    x, y, _ = setpoint.acceleration_nwu_m_s2
    assert hypot(x, y) == pytest.approx(GRAVITY * tan(radians(VALUES["MPC_MAN_TILT_MAX"])))
    assert cos(atan2(y, x) - 1.0 - bearing) == pytest.approx(1.0)
    assert all(isnan(value) for value in (*setpoint.position_nwu_m[:2], *setpoint.velocity_nwu_m_s[:2]))


@pytest.mark.parametrize(
    ("throttle", "height", "rate"),
    [
        (1.0, nan, 3.0),
        (0.0, nan, -1.5),
        (0.54, nan, 0.0),
        (0.46, nan, 0.0),
        (0.0, 20.0, -1.5),
        (0.0, 2.0, -0.7),
        (1.0, 2.0, 3.0),
        (0.775, nan, 3.0 * (0.4 * 0.5 + 0.6 * 0.125)),  # half way from the dead zone's edge
    ],
)
@pytest.mark.parametrize("mode", [AltitudeControl, PositionHold])
def test_throttle_is_climb_rate(mode: type, throttle: float, height: float, rate: float) -> None:
    law = altitude_control() if mode is AltitudeControl else PositionHold(VALUES, PERIOD_S)
    law.engage(facing(0.0))
    for _ in range(800):
        setpoint = law.update(Axes(0.0, 0.0, 0.0, throttle), facing(0.0), height)
    assert setpoint.velocity_nwu_m_s[2] == pytest.approx(rate, abs=0.01)
    assert isnan(setpoint.position_nwu_m[2]) == (rate != 0.0)


@pytest.mark.parametrize(("stick", "bearing"), DIRECTIONS)
def test_position_hold_flies_where_the_stick_points(stick: tuple[float, float], bearing: float) -> None:
    law = PositionHold(VALUES, PERIOD_S)
    law.engage(facing(-2.0))
    for _ in range(1500):
        setpoint = law.update(Axes(*stick, 0.0, 0.5), facing(-2.0))
    x, y, _ = setpoint.velocity_nwu_m_s
    assert hypot(x, y) == pytest.approx(VALUES["MPC_VEL_MANUAL"], abs=0.01)
    assert cos(atan2(y, x) + 2.0 - bearing) == pytest.approx(1.0)
    assert isnan(setpoint.position_nwu_m[0])
    assert isfinite(setpoint.position_nwu_m[2])


def test_the_dead_zone_of_the_sticks_holds_the_place() -> None:
    law = PositionHold(VALUES, PERIOD_S)
    here = facing(0.0, (3.0, 4.0, 5.0))
    law.engage(here)
    for _ in range(10):
        setpoint = law.update(Axes(0.07, -0.07, 0.0, 0.5), here)
    assert setpoint.position_nwu_m == pytest.approx((3.0, 4.0, 5.0))
    assert setpoint.velocity_nwu_m_s == pytest.approx(ORIGIN, abs=1e-9)


def test_takeoff_stick() -> None:
    assert not wants_takeoff(CENTRED)
    assert not wants_takeoff(Axes(0.0, 0.0, 0.0, nan))
    assert wants_takeoff(Axes(0.0, 0.0, 0.0, 0.7))


ANYTHING = st.one_of(st.floats(-2.0, 2.0), st.sampled_from([nan, inf, -inf, 3.0e38]))
ANY_AXES = st.builds(Axes, ANYTHING, ANYTHING, ANYTHING, ANYTHING)
ANY_VECTOR = st.tuples(ANYTHING, ANYTHING, ANYTHING)
ANY_STATE = st.builds(State, ANY_VECTOR, ANY_VECTOR, st.tuples(ANYTHING, ANYTHING, ANYTHING, ANYTHING))


@given(ANY_STATE, st.lists(st.tuples(ANY_AXES, ANY_STATE), min_size=1, max_size=3))
def test_any_stick_and_state_give_a_setpoint(first: State, ticks: list[tuple[Axes, State]]) -> None:
    attitude, rates = stabilized(), Acro(VALUES, HOVER)
    altitude, position = altitude_control(), PositionHold(VALUES, PERIOD_S)
    for law in (attitude, rates, altitude, position):
        law.engage(first)
    for axes, state in ticks:
        tilted = attitude.update(axes, state)
        assert hypot(*tilted.attitude) == pytest.approx(1.0)
        assert up_vector(tilted.attitude)[2] >= cos(radians(VALUES["MPC_MAN_TILT_MAX"])) - 1e-9
        assert 0.0 <= tilted.thrust <= 1.0
        turned = rates.update(axes, state)
        assert all(abs(rate) <= radians(100.0) + 1e-9 for rate in turned.omega_flu_rad_s)
        assert 0.0 <= turned.thrust <= 1.0
        for setpoint in (altitude.update(axes, state), position.update(axes, state)):
            for index in range(3):  # some way to fly each axis, and nothing infinite
                values = [group[index] for group in setpoint[:3]]
                assert any(isfinite(value) for value in values)
                assert not any(abs(value) == inf for value in values)
            assert isfinite(setpoint.yaw_rad)
            assert isfinite(setpoint.yaw_rate_rad_s)


# --- flown


def test_stabilized_forward_right_and_round() -> None:
    rig = Rig(height_m=50.0)
    law = Stabilized(rig.values, rig.hover_thrust, PERIOD_S)
    law.engage(rig.state)
    track = rig.fly(0.6, lambda state: law.update(Axes(0.5, 0.0, 0.0, 0.5), state))
    assert track[-1, 3] > 0.5
    assert abs(track[-1, 4]) < 0.05
    track = rig.fly(0.6, lambda state: law.update(Axes(-0.5, 0.5, 0.0, 0.5), state))
    assert track[-1, 4] < -0.5
    track = rig.fly(1.0, lambda state: law.update(Axes(0.0, 0.0, 0.5, 0.5), state))
    assert to_euler(tuple(track[-1, 6:10]))[2] < -0.3


def test_acro_rolls_right() -> None:
    rig = Rig(height_m=50.0)
    law = Acro(rig.values, rig.hover_thrust)
    track = rig.fly(0.3, lambda state: law.update(Axes(0.0, 1.0, 0.0, 0.5), state))
    assert track[-1, 10] == pytest.approx(radians(100.0), rel=0.1)
    assert to_euler(tuple(track[-1, 6:10]))[0] > radians(20.0)


@pytest.mark.parametrize("airframe", ["paper", "realistic"])
def test_altitude_control_climbs_locks_and_holds_while_tilting(airframe: str) -> None:
    rig = Rig(airframe=airframe, height_m=10.0)
    law = AltitudeControl(rig.values, rig.gravity_m_s2, PERIOD_S)
    law.engage(rig.state)
    track = rig.fly(2.0, lambda state: law.update(Axes(0.0, 0.0, 0.0, 1.0), state))
    assert track[-1, 5] == pytest.approx(3.0, abs=0.1)
    track = rig.fly(3.0, lambda state: law.update(CENTRED, state))
    locked = track[-1, 2]
    assert abs(track[-1, 5]) < 0.02
    assert np.max(track[:, 2]) - locked < 0.1
    track = rig.fly(3.0, lambda state: law.update(Axes(0.6, 0.0, 0.0, 0.5), state))
    assert track[-1, 3] > 3.0
    assert np.max(np.abs(track[:, 2] - locked)) < 0.1


@pytest.mark.parametrize("airframe", ["paper", "realistic"])
def test_position_hold_flies_and_locks(airframe: str) -> None:
    rig = Rig(airframe=airframe, height_m=10.0)
    law = PositionHold(rig.values, PERIOD_S)
    law.engage(rig.state)
    track = rig.fly(4.0, lambda state: law.update(Axes(1.0, 0.0, 0.0, 0.5), state))
    assert track[-1, 3] == pytest.approx(10.0, abs=0.2)
    track = rig.fly(6.0, lambda state: law.update(CENTRED, state))
    assert np.all(np.diff(track[:, 0]) > -0.002)  # no way back
    assert np.ptp(track[-250:, :3], axis=0) == pytest.approx((0.0, 0.0, 0.0), abs=0.02)
    assert np.max(np.abs(track[:, 2] - 10.0)) < 0.1


@pytest.mark.parametrize("airframe", ["paper", "realistic"])
def test_position_hold_in_the_paper_s_wind(airframe: str) -> None:
    rig = Rig(scenario="hover-wind", airframe=airframe, height_m=10.0)
    law = PositionHold(rig.values, PERIOD_S)
    law.engage(rig.state)
    track = rig.fly(15.0, lambda state: law.update(CENTRED, state))
    off = track[500:, :3] - np.array([0.0, 0.0, 10.0])
    assert np.sqrt(np.mean(np.sum(off * off, axis=1))) < 0.2


def test_down_to_the_ground_and_off_it_again() -> None:
    rig = Rig(height_m=2.0)
    law = PositionHold(rig.values, PERIOD_S)
    law.engage(rig.state)

    def down(state: State) -> PositionSetpoint:
        return law.update(Axes(0.0, 0.0, 0.0, 0.0), state, state.position_nwu_m[2])

    track = rig.fly(5.0, down)
    assert np.min(track[:, 5]) > -0.85
    assert track[-1, 2] < 0.05
    assert isinstance(rig.flown, AttitudeSetpoint)
    assert rig.flown.thrust < 0.5 * rig.hover_thrust
    track = rig.fly(3.0, lambda state: law.update(Axes(0.0, 0.0, 0.0, 0.8), state))
    assert track[-1, 2] > 1.0


def test_no_jump_between_the_modes() -> None:
    """STABILIZED tilted, ALTCTL with the same sticks, POSCTL, STABILIZED level: what the inner loops see."""
    rig = Rig(airframe="realistic", height_m=30.0)
    seen: list[AttitudeSetpoint] = []

    def flown(setpoint: AttitudeSetpoint | PositionSetpoint, state: State) -> AttitudeSetpoint:
        if isinstance(setpoint, PositionSetpoint):
            setpoint = rig.control.update(setpoint, state)
        seen.append(setpoint)
        return setpoint

    sticks = Axes(0.4, -0.3, 0.0, 0.5)
    attitude = Stabilized(rig.values, rig.hover_thrust, PERIOD_S)
    altitude = AltitudeControl(rig.values, rig.gravity_m_s2, PERIOD_S)
    position = PositionHold(rig.values, PERIOD_S)
    attitude.engage(rig.state)
    rig.fly(1.0, lambda state: flown(attitude.update(sticks, state), state))
    altitude.engage(rig.state)
    rig.engage()
    rig.fly(1.0, lambda state: flown(altitude.update(sticks, state), state))
    position.engage(rig.state)
    rig.engage()
    rig.fly(3.0, lambda state: flown(position.update(sticks, state), state))
    rig.fly(4.0, lambda state: flown(position.update(CENTRED, state), state))
    for a, b in pairwise(seen):
        w, *xyz = multiply(conjugate(a.attitude), b.attitude)
        assert degrees(2.0 * atan2(hypot(*xyz), abs(w))) < 2.5
        assert abs(a.thrust - b.thrust) < 0.04


def test_turning_while_flying_forward_keeps_the_nose_ahead() -> None:
    rig = Rig(height_m=30.0)
    law = PositionHold(rig.values, PERIOD_S)
    law.engage(rig.state)
    track = rig.fly(6.0, lambda state: law.update(Axes(0.5, 0.0, 0.2, 0.5), state))
    ahead = rotate(conjugate(tuple(track[-1, 6:10])), tuple(track[-1, 3:6]))
    assert ahead[0] > 1.0
    assert abs(ahead[1]) < 0.5 * ahead[0]
    assert abs(sin(to_euler(tuple(track[-1, 6:10]))[2])) > 0.05
