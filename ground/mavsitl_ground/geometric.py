"""Geometric tracking control on SE(3), down to body rates.

T. Lee, M. Leok, N. H. McClamroch, "Geometric Tracking Control of a Quadrotor UAV on SE(3)", CDC 2010; the integral of
eq 4 in F. Goodarzi, D. Lee, T. Lee, "Geometric Nonlinear PID Control of a Quadrotor UAV on SE(3)", ECC 2013.
"""

from __future__ import annotations

import numpy as np

from mavsitl.airframes import Airframe
from mavsitl.control.arrays import Floats
from mavsitl.controllers import AttitudeDemand, RateDemand, Reference, State
from mavsitl.frames import Quaternion
from mavsitl.quaternion import conjugate, multiply

UP = np.array((0.0, 0.0, 1.0))


def attitude_gain(airframe: Airframe) -> float:
    """1/s: rates by attitude error. As fast as the airframe lets its own attitude loop be (MC_ROLL_P, PX4's 6.5)."""
    return airframe.parameters.get("MC_ROLL_P", 6.5)


def attitude_error(attitude: Quaternion, desired: Quaternion) -> Floats:
    """e_R = 1/2 (R_d^T R - R^T R_d)^vee of Lee 2010, eq 10, (3,): with q_e = q_d* q it is 2 w_e (x_e, y_e, z_e)."""
    w, x, y, z = multiply(conjugate(desired), attitude)
    return 2.0 * w * np.array((x, y, z))


class Geometric:
    """Lee's position law and attitude error; the rate loop aboard stands in for the moment of eq 16.

    Force (eq 15 with an integral): ``F = m (-k_x e_x - k_v e_v - k_i integral(e_x) + a_d) + m g e_3``. Thrust: its part
    along the body's axis, ``f = F . R e_3``. Attitude: R_d with b_3 along F and b_1 towards the yaw. Rates:
    ``Omega = R^T R_d Omega_d - k_R e_R``, which makes e_R fall exponentially where the loop aboard follows; Omega_d is
    that of the reference's own attitude, in still air.
    """

    def __init__(self, airframe: Airframe, period_s: float) -> None:
        self._mass_kg, self._gravity = airframe.mass_kg, airframe.gravity_m_s2
        self._max_thrust_n = airframe.max_thrust_n
        self._period_s = period_s
        self._k_r = attitude_gain(airframe)
        # Three poles a fifth of the attitude loop's: far enough below it.
        pole = 0.2 * self._k_r
        self._k_x, self._k_v, self._k_i = 3.0 * pole**2, 3.0 * pole, pole**3
        self.reset()

    def reset(self) -> None:
        self._integral = np.zeros(3)
        self._before: Quaternion | None = None
        """The reference's attitude a period ago."""

    def update(self, time_s: float, state: State, reference: Reference) -> RateDemand:
        error, error_rate = state.position - reference.position, state.velocity - reference.velocity
        wanted = reference.acceleration - self._k_x * error - self._k_v * error_rate - self._k_i * self._integral
        force = self._mass_kg * (wanted + self._gravity * UP)
        w, x, y, z = AttitudeDemand.along(force, reference.yaw).quaternion
        desired: Quaternion = (w, x, y, z)
        w, x, y, z = state.quaternion.tolist()
        attitude: Quaternion = (w, x, y, z)
        thrust = float(force @ state.rotation[:, 2])
        if 0.0 < thrust < self._max_thrust_n:  # else the integral would wind up
            self._integral = self._integral + self._period_s * error
        turned = multiply(conjugate(attitude), desired)
        fed = _turn(turned, self._feed_forward(reference))
        omega = fed - self._k_r * attitude_error(attitude, desired)
        return RateDemand(omega, thrust, desired)

    def _feed_forward(self, reference: Reference) -> Floats:
        """Omega_d, (3,): by how much the reference's attitude has turned since the period before."""
        force = reference.acceleration + self._gravity * UP
        w, x, y, z = AttitudeDemand.along(force, reference.yaw).quaternion
        now: Quaternion = (w, x, y, z)
        before, self._before = self._before, now
        if before is None:
            return np.zeros(3)
        dw, dx, dy, dz = multiply(conjugate(before), now)
        if abs(dw) < 0.99:  # a jump of the path, which no rate follows
            return np.zeros(3)
        fed: Floats = np.array((dx, dy, dz)) * np.copysign(2.0 / self._period_s, dw)
        return fed


def _turn(q: Quaternion, vector: Floats) -> Floats:
    w, *axis = q
    r = np.array(axis)
    t = 2.0 * np.cross(r, vector)
    turned: Floats = vector + w * t + np.cross(r, t)
    return turned
