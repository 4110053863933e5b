"""MANUAL_CONTROL's axes to setpoints: the laws of MANUAL, STABILIZED, ACRO, ALTCTL and POSCTL.

Each law is a class with `engage(state)`, called when its mode begins, and `update(axes, state)`, once a control period.
World NWU, body FLU; no clock, no message. Who reads the message leaves out axes that are not there (INT16_MAX).
"""

from __future__ import annotations

from math import cos, hypot, isfinite, nan, pi, radians, remainder, sin, tan
from typing import NamedTuple

from mavsitl.quaternion import from_yaw, multiply
from mavsitl_vehicle.autopilot.position import YAW_LEAD_RAD, Values
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint, PositionSetpoint, RateSetpoint, State
from mavsitl_vehicle.autopilot.trajectory import Trajectory, landing_speed

EXPO = 0.6
"""Share of the cube in velocity and yaw sticks: PX4's default of MPC_XY_MAN_EXPO, MPC_Z_MAN_EXPO, MPC_YAW_EXPO."""
TAKEOFF_STICK = 0.65
"""Throttle from which ALTCTL and POSCTL lift off."""
YAW_CENTRE = 0.02
"""Yaw stick within this holds the heading."""


class Axes(NamedTuple):
    """One MANUAL_CONTROL message: sticks -1 to 1, throttle 0 to 1. What is beyond is cut, what is not finite is 0."""

    pitch: float
    """x: forward is positive."""
    roll: float
    """y: right is positive."""
    yaw: float
    """r: clockwise seen from above is positive."""
    throttle: float
    """z; 0.5 is the middle."""

    def cut(self) -> Axes:
        """Within range and finite; a throttle that is not finite is in the middle."""
        throttle = self.throttle if isfinite(self.throttle) else 0.5
        return Axes(_cut(self.pitch), _cut(self.roll), _cut(self.yaw), min(max(throttle, 0.0), 1.0))


CENTRED = Axes(0.0, 0.0, 0.0, 0.5)


def wants_takeoff(axes: Axes) -> bool:
    """Throttle of a pilot who wants off the ground, in ALTCTL and POSCTL."""
    return axes.cut().throttle > TAKEOFF_STICK


def throttle_curve(throttle: float, idle: float, hover_thrust: float, parameters: Values) -> float:
    """Collective of a throttle stick (0..1): MPC_THR_CURVE 1 is a straight line, 0 and 2 hover in the middle.

    0 takes `hover_thrust`, what the vehicle needs; 2 takes MPC_THR_HOVER.
    """
    largest = parameters["MPC_THR_MAX"]
    idle = min(idle, largest)
    curve = parameters["MPC_THR_CURVE"]
    if curve == 1:
        return idle + throttle * (largest - idle)
    hover = min(parameters["MPC_THR_HOVER"] if curve == 2 else hover_thrust, largest)
    if throttle < 0.5:
        return idle + 2.0 * throttle * (hover - idle)
    return hover + (2.0 * throttle - 1.0) * (largest - hover)


class _Heading:
    """Yaw by the stick's rate, up to MPC_MAN_Y_MAX; held in the middle."""

    def __init__(self, parameters: Values, period_s: float) -> None:
        self.yaw_rad = 0.0
        self._parameters = parameters
        self._period_s = period_s

    def engage(self, state: State) -> None:
        if isfinite(state.yaw_rad):
            self.yaw_rad = state.yaw_rad

    def update(self, stick: float, state: State) -> float:
        """The yaw rate, rad/s."""
        shaped = _shaped(stick, YAW_CENTRE)
        if shaped == 0.0:
            return 0.0
        rate = -radians(self._parameters["MPC_MAN_Y_MAX"]) * shaped
        yaw, measured = self.yaw_rad + rate * self._period_s, state.yaw_rad
        if isfinite(measured):
            lead = remainder(yaw - measured, 2.0 * pi)
            yaw = measured + min(max(lead, -YAW_LEAD_RAD), YAW_LEAD_RAD)
        self.yaw_rad = remainder(yaw, 2.0 * pi)
        return rate


class Stabilized:
    """MANUAL and STABILIZED: the sticks tilt the vehicle by up to MPC_MAN_TILT_MAX, the throttle is the collective."""

    def __init__(self, parameters: Values, hover_thrust: float, period_s: float) -> None:
        self._parameters = parameters
        self._hover_thrust = hover_thrust
        self._heading = _Heading(parameters, period_s)

    def engage(self, state: State) -> None:
        self._heading.engage(state)

    def update(self, axes: Axes, state: State) -> AttitudeSetpoint:
        """The tilt is a turn about one level axis, so that the vehicle goes where the stick points to."""
        axes = axes.cut()
        p = self._parameters
        rate = self._heading.update(axes.yaw, state)
        pitch, roll = _in_circle(axes.pitch, axes.roll)
        share = hypot(pitch, roll)
        half = 0.5 * radians(p["MPC_MAN_TILT_MAX"]) * share
        scale = sin(half) / share if share > 0.0 else 0.0
        tilt = (cos(half), scale * roll, scale * pitch, 0.0)
        thrust = throttle_curve(axes.throttle, p["MPC_MANTHR_MIN"], self._hover_thrust, p)
        return AttitudeSetpoint(multiply(from_yaw(self._heading.yaw_rad), tilt), rate, thrust)


class Acro:
    """ACRO: the sticks turn the body at up to MC_ACRO_R_MAX, MC_ACRO_P_MAX, MC_ACRO_Y_MAX, the throttle lifts."""

    def __init__(self, parameters: Values, hover_thrust: float) -> None:
        self._parameters = parameters
        self._hover_thrust = hover_thrust

    def engage(self, state: State) -> None:
        """Rates have no memory."""

    def update(self, axes: Axes, state: State) -> RateSetpoint:
        axes = axes.cut()
        p = self._parameters
        omega = (
            radians(p["MC_ACRO_R_MAX"]) * axes.roll,
            radians(p["MC_ACRO_P_MAX"]) * axes.pitch,
            -radians(p["MC_ACRO_Y_MAX"]) * axes.yaw,
        )
        return RateSetpoint(omega, throttle_curve(axes.throttle, 0.0, self._hover_thrust, p))


class AltitudeControl:
    """ALTCTL: tilt by the sticks, climb rate by the throttle; in its middle (MAN_DEADZONE) the height is held."""

    def __init__(self, parameters: Values, gravity_m_s2: float, period_s: float) -> None:
        self._parameters = parameters
        self._gravity = gravity_m_s2
        self._heading = _Heading(parameters, period_s)
        self._motion = Trajectory(parameters, period_s)

    def engage(self, state: State) -> None:
        self._heading.engage(state)
        self._motion.engage(state)
        self._motion.climb(0.0)

    def update(self, axes: Axes, state: State, height_m: float = nan) -> PositionSetpoint:
        """`height_m` over the ground, where it is known, slows the climb and the descent near it."""
        axes = axes.cut()
        rate = self._heading.update(axes.yaw, state)
        self._motion.climb(_climb(axes.throttle, height_m, self._parameters))
        motion = self._motion.update(state.position_nwu_m)
        pitch, roll = _in_circle(axes.pitch, axes.roll)
        largest = self._gravity * tan(radians(min(self._parameters["MPC_MAN_TILT_MAX"], 89.0)))
        ax, ay = _aloft(largest * pitch, -largest * roll, self._heading.yaw_rad)
        return PositionSetpoint(
            (nan, nan, motion.position_nwu_m[2]),
            (nan, nan, motion.velocity_nwu_m_s[2]),
            (ax, ay, motion.acceleration_nwu_m_s2[2]),
            self._heading.yaw_rad,
            rate,
        )


class PositionHold:
    """POSCTL: velocity by the sticks in the heading's axes, up to MPC_VEL_MANUAL; the place is held at rest."""

    def __init__(self, parameters: Values, period_s: float) -> None:
        self._parameters = parameters
        self._heading = _Heading(parameters, period_s)
        self._motion = Trajectory(parameters, period_s)

    def engage(self, state: State) -> None:
        self._heading.engage(state)
        self._motion.engage(state)
        self._motion.steer((0.0, 0.0))
        self._motion.climb(0.0)

    def update(self, axes: Axes, state: State, height_m: float = nan) -> PositionSetpoint:
        """`height_m` over the ground, where it is known, slows the climb and the descent near it."""
        axes = axes.cut()
        p = self._parameters
        rate = self._heading.update(axes.yaw, state)
        self._motion.climb(_climb(axes.throttle, height_m, p))
        pitch, roll = _in_circle(axes.pitch, axes.roll)
        share = hypot(pitch, roll)
        shaped = _shaped(share, p["MAN_DEADZONE"])
        if shaped == 0.0:
            self._motion.steer((0.0, 0.0))
        else:
            speed = min(p["MPC_VEL_MANUAL"], p["MPC_XY_VEL_MAX"]) * shaped / share
            self._motion.steer(_aloft(speed * pitch, -speed * roll, self._heading.yaw_rad))
        motion = self._motion.update(state.position_nwu_m)
        return motion._replace(yaw_rad=self._heading.yaw_rad, yaw_rate_rad_s=rate)


def _climb(throttle: float, height_m: float, parameters: Values) -> float:
    """Climb rate of a throttle stick, m/s: MPC_Z_VEL_MAX_UP and _DN at its ends, 0 in its middle."""
    shaped = _shaped(2.0 * throttle - 1.0, parameters["MAN_DEADZONE"])
    if shaped >= 0.0:
        return parameters["MPC_Z_VEL_MAX_UP"] * shaped
    sinking = parameters["MPC_Z_VEL_MAX_DN"]
    if isfinite(height_m):
        sinking = min(sinking, landing_speed(height_m, parameters))
    return sinking * shaped


def _aloft(forward: float, left: float, yaw_rad: float) -> tuple[float, float]:
    """From the heading's level axes to north and west."""
    c, s = cos(yaw_rad), sin(yaw_rad)
    return c * forward - s * left, s * forward + c * left


def _shaped(stick: float, dead_zone: float) -> float:
    """0 in the dead zone, +-1 at the ends, between them a line and a cube."""
    size = min(abs(stick), 1.0)
    if size <= dead_zone:
        return 0.0
    size = (size - dead_zone) / (1.0 - dead_zone)
    size = (1.0 - EXPO) * size + EXPO * size * size * size
    return size if stick > 0.0 else -size


def _in_circle(pitch: float, roll: float) -> tuple[float, float]:
    size = hypot(pitch, roll)
    return (pitch, roll) if size <= 1.0 else (pitch / size, roll / size)


def _cut(stick: float) -> float:
    return min(max(stick, -1.0), 1.0) if isfinite(stick) else 0.0
