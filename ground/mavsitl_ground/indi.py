"""Incremental nonlinear dynamic inversion (INDI) on linear acceleration, from telemetry alone.

E. J. J. Smeur, Q. P. Chu, G. C. H. E. de Croon, "Adaptive Incremental Nonlinear Dynamic Inversion for Attitude Control
of Micro Air Vehicles", JGCD 39(3), 2016, closes its increments on angular acceleration, with the rotors' speeds: an
off-board program has neither at the rate that this needs. What it can do is the outer loop of E. J. J. Smeur, G. C. H.
E. de Croon, Q. P. Chu, "Cascaded incremental nonlinear dynamic inversion for MAV disturbance rejection", CEP 73, 2018:
increments of the thrust vector on linear acceleration, here the derivative of the telemetry's velocity in place of an
accelerometer. The attitude is closed by its error and the rate loop aboard.
"""

from __future__ import annotations

from math import exp

import numpy as np

from mavsitl.airframes import Airframe
from mavsitl.control.arrays import Floats
from mavsitl.controllers import AttitudeDemand, RateDemand, Reference, State
from mavsitl.frames import Quaternion
from mavsitl_ground.geometric import UP, attitude_error, attitude_gain

DAMPING = 0.7
"""Of the measurement's filter."""


class SecondOrder:
    """H(s) = w^2 / (s^2 + 2 d w s + w^2) of a vector (3,), and its derivative s H(s)."""

    def __init__(self, rad_s: float, period_s: float) -> None:
        self._rad_s, self._period_s = rad_s, period_s
        self.value: Floats | None = None
        self.rate: Floats = np.zeros(3)

    def step(self, sample: Floats) -> None:
        """A period on; the first sample is where it starts, at rest. Semi-implicit Euler."""
        if self.value is None:
            self.value = sample.copy()
            return
        change = self._rad_s**2 * (sample - self.value) - 2.0 * DAMPING * self._rad_s * self.rate
        self.rate = self.rate + self._period_s * change
        self.value = self.value + self._period_s * self.rate


class Indi:
    """Thrust increments on measured acceleration.

    ``tau_c = tau_f + (nu - a_f)``, with the wanted acceleration ``nu = a_d - k_x e_x - k_v e_v``, the acceleration a_f
    out of the filtered velocity, and tau_f = (T/m) R e_3 behind the same filter, as both must be equally late (2016,
    section III). T is what was commanded, behind the rotors' nominal lag. Whatever force is not in the model, wind or
    another mass, is in a_f - tau_f and is taken out, so there is no integral.
    """

    def __init__(self, airframe: Airframe, period_s: float) -> None:
        self._mass_kg, self._weight_n = airframe.mass_kg, airframe.weight_n
        self._gravity = airframe.gravity_m_s2
        self._max_thrust_n = airframe.max_thrust_n
        self._period_s = period_s
        tau = airframe.rotor_time_constant_s
        self._share = 1.0 - exp(-period_s / tau) if tau > 0.0 else 1.0
        self._k_r = attitude_gain(airframe)
        pole = 0.25 * self._k_r
        self._k_x, self._k_v = pole**2, 2.0 * pole
        self._filter_rad_s = 0.8 * self._k_r
        self.reset()

    def reset(self) -> None:
        self._velocity = SecondOrder(self._filter_rad_s, self._period_s)
        self._specific = SecondOrder(self._filter_rad_s, self._period_s)
        self._acting_n = self._commanded_n = self._weight_n

    def update(self, time_s: float, state: State, reference: Reference) -> RateDemand:
        axis = state.rotation[:, 2]
        self._acting_n += self._share * (self._commanded_n - self._acting_n)
        self._velocity.step(state.velocity)
        self._specific.step(self._acting_n / self._mass_kg * axis - self._gravity * UP)
        assert self._specific.value is not None
        disturbance = self._velocity.rate - self._specific.value
        error, error_rate = state.position - reference.position, state.velocity - reference.velocity
        wanted = reference.acceleration - self._k_x * error - self._k_v * error_rate
        force = self._mass_kg * (wanted - disturbance + self._gravity * UP)
        w, x, y, z = AttitudeDemand.along(force, reference.yaw).quaternion
        desired: Quaternion = (w, x, y, z)
        w, x, y, z = state.quaternion.tolist()
        self._commanded_n = min(max(float(force @ axis), 0.0), self._max_thrust_n)
        omega = -self._k_r * attitude_error((w, x, y, z), desired)
        return RateDemand(omega, self._commanded_n, desired)

    def log(self) -> Floats:
        """What acts beside the model, m/s^2, NWU."""
        assert self._specific.value is not None
        return self._velocity.rate - self._specific.value
