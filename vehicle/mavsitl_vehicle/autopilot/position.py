"""The position and velocity cascade: a position setpoint and the estimate in, an attitude and a thrust out.

The scheme is PX4's (mc_pos_control): P on position with velocity fed forward, PID on velocity with acceleration fed
forward, acceleration to thrust vector, and its limits. World NWU, body FLU; no clock, no message.
"""

from __future__ import annotations

from math import cos, exp, hypot, inf, isfinite, nan, pi, radians, remainder, sin, sqrt, tan
from typing import Protocol

from mavsitl.frames import Quaternion, Vector
from mavsitl.quaternion import to_euler, up_vector
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint, PositionSetpoint, State

DERIVATIVE_FILTER_S = 1.0 / (2.0 * pi * 5.0)
"""Time constant of the velocity's derivative: PX4's default of MPC_VELD_LP, 5 Hz."""
LEAST_UP = 1e-3
"""Upward share of the thrust vector, so that it has a direction whatever the limits are."""
BLEND_S = 0.2
"""Time constant in which the step that a switch of modes would make fades."""
YAW_LEAD_RAD = 0.3
"""A heading that is turned by its rate runs at most this far ahead of the vehicle."""


class Values(Protocol):
    """Parameters by PX4's name, read at every use: `Parameters`, or a dict."""

    def __getitem__(self, name: str, /) -> float: ...


class PositionControl:
    """One vehicle's cascade. `engage` when a mode that flies by it begins, then `update` once a control period."""

    def __init__(self, parameters: Values, gravity_m_s2: float, hover_thrust: float, period_s: float) -> None:
        """`hover_thrust`: the collective (0..1) that carries the weight."""
        self.velocity_setpoint_nwu_m_s: Vector = (nan, nan, nan)
        """What the velocity loop followed last; NaN: that axis was flown by acceleration alone."""
        self.acceleration_setpoint_nwu_m_s2: Vector = (0.0, 0.0, 0.0)
        """What the cascade asked for last, before the limits of tilt and thrust."""
        self._parameters = parameters
        self._gravity = gravity_m_s2
        self._hover_thrust = hover_thrust
        self._period_s = period_s
        self._fade = exp(-period_s / BLEND_S)
        self._filter = period_s / (period_s + DERIVATIVE_FILTER_S)
        self._integral: list[float] = [0.0, 0.0, 0.0]
        self._far = (False, False, False)
        self._filtered: list[float] = [nan, nan, nan]
        """Velocity behind the derivative's filter."""
        self._yaw_rad = nan
        self._flown_thrust: Vector = (0.0, 0.0, 0.0)
        self._flown_yaw_rad = 0.0
        self._share = 0.0
        """What the mode before still has of the setpoint: 1 at the switch, then fading."""

    def reset(self) -> None:
        """On the ground: forget the integrals and the heading."""
        self._integral = [0.0, 0.0, 0.0]
        self.engage(None)
        self._yaw_rad = nan

    def engage(self, flown: AttitudeSetpoint | None) -> None:
        """Begin where `flown`, the last setpoint of the mode before, left off.

        The first update gives that attitude and thrust, whose share of the setpoint then fades with `BLEND_S`. None: no
        such setpoint (rates, torque or rotors at rest); the cascade acts at once. The integrals stay: the wind and the
        weight are as before.
        """
        self._filtered = [nan, nan, nan]
        self._share = 0.0
        self._yaw_rad = nan
        if flown is not None:
            x, y, z = up_vector(flown.attitude)
            self._flown_thrust = (flown.thrust * x, flown.thrust * y, max(flown.thrust * z, 1e-3))
            self._flown_yaw_rad = self._yaw_rad = to_euler(flown.attitude)[2]
            self._share = 1.0

    def update(self, setpoint: PositionSetpoint, state: State, climb_limit_m_s: float = inf) -> AttitudeSetpoint:
        """One control period. The answer is finite whatever is not in setpoint and state.

        An axis that nothing is asked of is braked to a stop; one whose measurement is missing is flown by what is fed
        forward. `climb_limit_m_s` caps the climb below MPC_Z_VEL_MAX_UP, negative values included (see
        `trajectory.takeoff_climb_limit`).
        """
        p = self._parameters
        gravity, thrust_per_acceleration = self._gravity, self._hover_thrust / self._gravity
        velocity_setpoint = self._velocity_setpoint(setpoint, state, climb_limit_m_s)
        self.velocity_setpoint_nwu_m_s = velocity_setpoint

        p_xy = p["MPC_XY_VEL_P_ACC"]
        gains_p = (p_xy, p_xy, p["MPC_Z_VEL_P_ACC"])
        d_xy = p["MPC_XY_VEL_D_ACC"]
        gains_d = (d_xy, d_xy, p["MPC_Z_VEL_D_ACC"])
        errors = [0.0, 0.0, 0.0]
        wanted = [0.0, 0.0, 0.0]
        integral = self._integral
        for i in range(3):
            fed = setpoint.acceleration_nwu_m_s2[i]
            value = fed if isfinite(fed) else 0.0
            if velocity_setpoint[i] == velocity_setpoint[i]:
                value += integral[i]
                velocity = state.velocity_nwu_m_s[i]
                if isfinite(velocity):
                    errors[i] = velocity_setpoint[i] - velocity
                    value += gains_p[i] * errors[i] - gains_d[i] * self._derivative(i, velocity)
            wanted[i] = value
        ax, ay, az = wanted
        self.acceleration_setpoint_nwu_m_s2 = (ax, ay, az)

        # Vertical first: it gets what it asks for but for a margin, and the horizontal what is left.
        thrust_max = p["MPC_THR_MAX"]
        up = (gravity + az) * thrust_per_acceleration
        aside = hypot(ax, ay) * thrust_per_acceleration
        share = min(aside, p["MPC_THR_XY_MARG"], thrust_max)
        ceiling = sqrt(thrust_max * thrust_max - share * share)
        floor = min(max(p["MPC_THR_MIN"], 1e-3), thrust_max)
        if (up >= ceiling and errors[2] > 0.0) or (up <= floor and errors[2] < 0.0):
            errors[2] = 0.0
        up = max(min(up, ceiling), floor)
        room = sqrt(max(thrust_max * thrust_max - up * up, 0.0))
        room = min(room, up * tan(radians(min(p["MPC_TILTMAX_AIR"], 89.0))))
        scale = room / aside if aside > room else 1.0
        if scale < 1.0 and p_xy > 0.0:  # tracking anti-windup: the integral gives way until the limit is not met
            back = 2.0 / p_xy * (1.0 - scale)
            errors[0] -= back * ax
            errors[1] -= back * ay
        self._integrate(errors, velocity_setpoint)

        tx, ty = ax * scale * thrust_per_acceleration, ay * scale * thrust_per_acceleration
        yaw_rad, yaw_rate_rad_s = self._heading(setpoint, state)
        share = self._share
        if share > 0.0:
            fx, fy, fz = self._flown_thrust
            tx, ty, up = tx + share * (fx - tx), ty + share * (fy - ty), up + share * (fz - up)
            yaw_rad += share * remainder(self._flown_yaw_rad - yaw_rad, 2.0 * pi)
            self._share = self._fade * share if share > 1e-3 else 0.0
        up = max(up, LEAST_UP)
        thrust = sqrt(tx * tx + ty * ty + up * up)
        attitude = thrust_attitude((tx / thrust, ty / thrust, up / thrust), yaw_rad)
        return AttitudeSetpoint(attitude, yaw_rate_rad_s, min(thrust, thrust_max))

    def _velocity_setpoint(self, setpoint: PositionSetpoint, state: State, climb_limit_m_s: float) -> Vector:
        """Position errors to velocities, with the feed-forward, within the limits; NaN where only acceleration counts.

        Horizontally the way back to the position comes before the feed-forward.
        """
        p = self._parameters
        asked = [False, False, False]
        error = [0.0, 0.0, 0.0]
        fed = [0.0, 0.0, 0.0]
        for i in range(3):
            position, velocity = setpoint.position_nwu_m[i], setpoint.velocity_nwu_m_s[i]
            if isfinite(position):
                asked[i] = True
                measured = state.position_nwu_m[i]
                if isfinite(measured):
                    error[i] = position - measured
            if isfinite(velocity):
                asked[i] = True
                fed[i] = velocity
            if not isfinite(setpoint.acceleration_nwu_m_s2[i]):
                asked[i] = True
        distance = hypot(error[0], error[1])
        speed, far = approach_speed(distance, p["MPC_XY_P"], p["MPC_ACC_HOR_MAX"])
        scale = speed / distance if distance > 0.0 else 0.0
        vx, vy = _add_within(scale * error[0], scale * error[1], fed[0], fed[1], p["MPC_XY_VEL_MAX"])
        if error[2] >= 0.0:
            vz, far_z = approach_speed(error[2], p["MPC_Z_P"], p["MPC_ACC_DOWN_MAX"])
        else:
            vz, far_z = approach_speed(-error[2], p["MPC_Z_P"], p["MPC_ACC_UP_MAX"])
            vz = -vz
        self._far = far, far, far_z
        vz = min(max(vz + fed[2], -p["MPC_Z_VEL_MAX_DN"]), p["MPC_Z_VEL_MAX_UP"], climb_limit_m_s)
        return vx if asked[0] else nan, vy if asked[1] else nan, vz if asked[2] else nan

    def _derivative(self, axis: int, velocity: float) -> float:
        """Filtered acceleration of the vehicle, m/s^2."""
        last = self._filtered[axis]
        if not isfinite(last):
            self._filtered[axis] = velocity
            return 0.0
        change = self._filter * (velocity - last)
        self._filtered[axis] = last + change
        return change / self._period_s

    def _integrate(self, errors: list[float], velocity_setpoint: Vector) -> None:
        p = self._parameters
        i_xy = p["MPC_XY_VEL_I_ACC"]
        gains = (i_xy, i_xy, p["MPC_Z_VEL_I_ACC"])
        limit = self._gravity
        for i in range(3):
            # Far out the velocity lags behind a setpoint that moves on purpose: not a disturbance to be learnt.
            if velocity_setpoint[i] == velocity_setpoint[i] and not self._far[i]:
                value = self._integral[i] + gains[i] * errors[i] * self._period_s
                self._integral[i] = min(max(value, -limit), limit)

    def _heading(self, setpoint: PositionSetpoint, state: State) -> tuple[float, float]:
        """Yaw, rad, and its rate, rad/s: as asked, else turned by the rate asked for, else as it was."""
        measured, rate = state.yaw_rad, setpoint.yaw_rate_rad_s
        if not isfinite(self._yaw_rad):
            self._yaw_rad = measured if isfinite(measured) else 0.0
        if isfinite(setpoint.yaw_rad):
            self._yaw_rad = setpoint.yaw_rad
        elif isfinite(rate):
            self._yaw_rad += rate * self._period_s
            if rate != 0.0 and isfinite(measured):
                lead = remainder(self._yaw_rad - measured, 2.0 * pi)
                self._yaw_rad = measured + min(max(lead, -YAW_LEAD_RAD), YAW_LEAD_RAD)
        self._yaw_rad = remainder(self._yaw_rad, 2.0 * pi)
        return self._yaw_rad, rate if isfinite(rate) else 0.0


def approach_speed(distance: float, gain_per_s: float, braking_m_s2: float) -> tuple[float, bool]:
    """Speed towards a point `distance` >= 0 ahead: `gain_per_s` times it near by, a constant braking further out.

    Whether it is further out comes second.
    """
    if gain_per_s <= 0.0:
        return 0.0, False
    knee = braking_m_s2 / (gain_per_s * gain_per_s)
    if distance <= knee:
        return gain_per_s * distance, False
    return sqrt(braking_m_s2 * (2.0 * distance - knee)), True


def thrust_attitude(up: Vector, yaw_rad: float) -> Quaternion:
    """The attitude (FLU -> NWU) whose body z axis is the unit vector `up`, z > 0, and whose Z-Y-X yaw is `yaw_rad`."""
    c, s = cos(yaw_rad), sin(yaw_rad)
    forward, left, lift = c * up[0] + s * up[1], c * up[1] - s * up[0], up[2]
    # In the heading's axes body z is (cos(roll) sin(pitch), -sin(roll), cos(roll) cos(pitch)).
    cos_roll = sqrt(forward * forward + lift * lift)
    cr = sqrt(0.5 * (1.0 + cos_roll))
    sr = -0.5 * left / cr
    cp = sqrt(0.5 * (1.0 + lift / cos_roll))
    sp = 0.5 * forward / (cos_roll * cp)
    cy, sy = cos(0.5 * yaw_rad), sin(0.5 * yaw_rad)
    w, x, y, z = cr * cp, sr * cp, cr * sp, -sr * sp  # pitch, then roll
    return cy * w - sy * z, cy * x - sy * y, cy * y + sy * x, cy * z + sy * w


def _add_within(ax: float, ay: float, bx: float, by: float, limit: float) -> tuple[float, float]:
    """a + b, at most `limit` long: b is cut first, a only if it is too long by itself."""
    x, y = ax + bx, ay + by
    if x * x + y * y <= limit * limit:
        return x, y
    length = hypot(ax, ay)
    if limit <= 0.0:
        return 0.0, 0.0
    if length >= limit:
        return ax * limit / length, ay * limit / length
    # |a + k b| = limit, 0 < k < 1: a is inside the circle and a + b outside
    bb, ab = bx * bx + by * by, ax * bx + ay * by
    k = (sqrt(ab * ab + bb * (limit * limit - length * length)) - ab) / bb
    return ax + k * bx, ay + k * by
