"""The wind as the vehicle knows it, from its own motion: eq 11's W_1..W_3 observed, and turned into a wind by eq 4.

No sensor measures it. It is known in flight alone: on the ground other forces act.
"""

from __future__ import annotations

from math import exp, pi, sqrt

import numpy as np

from mavsitl.airframes import Airframe
from mavsitl.control.arrays import Floats
from mavsitl.control.wind_observer import WindObserver, model_acceleration
from mavsitl_vehicle.autopilot.telemetry import Wind

BANDWIDTH_RAD_S = 2.0
"""Of the observer: slower than gusts, faster than the mean wind."""
AVERAGE_S = 5.0
"""Time constant of mean and variance."""
SETTLING_S = 3.0
"""In flight, before the estimate is shown."""


class WindEstimate:
    """One vehicle's. `value` is the wind that WIND_COV tells; None: not known."""

    def __init__(self, airframe: Airframe, period_s: float) -> None:
        area_m2 = pi * airframe.rotor_radius_m**2
        self._mass_kg, self._gravity = airframe.mass_kg, airframe.gravity_m_s2
        self._max_thrust_n = airframe.max_thrust_n
        self._per_root_newton = airframe.wind_coupling * sqrt(8.0 * airframe.air_density_kg_m3 * area_m2)
        self._period_s = period_s
        self._share = 1.0 - exp(-period_s / AVERAGE_S)
        self._observer = WindObserver(BANDWIDTH_RAD_S, BANDWIDTH_RAD_S)
        self._model = np.zeros((3, 1))
        self._thrust = np.zeros(1)
        self._flown_s = 0.0
        self._mean = [0.0, 0.0, 0.0]
        self._variance = [0.0, 0.0, 0.0]
        self.value: Wind | None = None
        self.update(np.zeros((13, 1)), 0.0, True)  # compiles, or reads the cache, before the clock runs
        self.update(np.zeros((13, 1)), 0.0, False)

    def update(self, estimate: Floats, thrust: float, flying: bool) -> None:
        """One control period: `estimate` (13, 1), `thrust` the collective demanded during it, 0 to 1."""
        if not flying or self._per_root_newton <= 0.0:
            if self._flown_s:
                self._flown_s = 0.0
                self._observer.reset()
                self.value = None
            return
        thrust_n = thrust * self._max_thrust_n
        self._thrust[0] = thrust_n
        model_acceleration(estimate[6:10], self._thrust, self._mass_kg, self._gravity, self._model)
        pushed = self._observer.update(estimate[3:6], self._model, self._period_s)
        self._flown_s += self._period_s
        if thrust_n <= 0.1 * self._mass_kg * self._gravity:  # the wind acts through the rotors' inflow alone
            return
        scale = self._mass_kg / (self._per_root_newton * sqrt(thrust_n))
        share = self._share if self._flown_s > AVERAGE_S else self._period_s / self._flown_s
        for axis, value in enumerate(pushed[:, 0].tolist()):
            away = scale * value - self._mean[axis]
            self._mean[axis] += share * away
            self._variance[axis] += share * (away * away - self._variance[axis])
        if self._flown_s >= SETTLING_S:
            x, y, z = self._variance
            self.value = Wind((self._mean[0], self._mean[1], self._mean[2]), 0.5 * (x + y), z)
