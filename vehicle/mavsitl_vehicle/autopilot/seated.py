"""The paper's attitude law aboard: the PIDNN makes a torque of an attitude setpoint, in place of the stock cascade."""

from __future__ import annotations

from math import pi, remainder

import numpy as np
from numpy.typing import NDArray

from mavsitl.control.inner_loop import InnerLoop
from mavsitl.quaternion import euler_rates, to_euler
from mavsitl.scenario import Flight
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint, TorqueSetpoint

STALE_US = 50_000
"""Two setpoints further apart than this say nothing about the wanted rates."""


class SeatedLaw:
    """One vehicle's nets. The D neuron (eq 28) takes the wanted angles' rates from differences of the setpoints."""

    def __init__(self, flight: Flight) -> None:
        self._law = InnerLoop(
            flight.scenario.controller, flight.airframe, flight.scenario.rates.control_period_us / 1e6
        )
        self._angles = np.zeros((3, 1))
        self._rates = np.zeros((3, 1))
        self._desired = np.zeros((3, 1))
        self._desired_rates = np.zeros((3, 1))
        self._setpoint_us = -STALE_US
        self._law.update(
            self._angles, self._rates, self._desired
        )  # compiles, or reads the cache, before the clock runs
        self.reset()

    @property
    def weights(self) -> NDArray[np.float64] | None:
        """Output weights (3 outputs P I D, 3 axes, 1) of a PIDNN; None for the PID."""
        return self._law.weights

    def reset(self) -> None:
        """Back to the identical PID, at rest."""
        self._law.reset()
        self._desired_rates[:] = 0.0
        self._setpoint_us = -STALE_US

    def update(self, setpoint: AttitudeSetpoint, setpoint_us: int, estimate: NDArray[np.float64]) -> TorqueSetpoint:
        """One period. `setpoint_us`: when it came; `estimate` (13,) as in `mavsitl_vehicle.tick`."""
        desired = to_euler(setpoint.attitude)
        since_us = setpoint_us - self._setpoint_us
        if since_us:
            last = self._desired[:, 0].tolist()
            fresh = 0 < since_us < STALE_US
            for axis in range(3):
                turn = remainder(desired[axis] - last[axis], 2.0 * pi)
                self._desired_rates[axis, 0] = turn * 1e6 / since_us if fresh else 0.0
            self._desired[:, 0] = desired
            self._setpoint_us = setpoint_us
        w, x, y, z, p, q, r = estimate[6:13].tolist()
        angles = to_euler((w, x, y, z))
        self._angles[:, 0] = angles
        self._rates[:, 0] = euler_rates(angles, (p, q, r))
        acceleration = self._law.update(self._angles, self._rates, self._desired, self._desired_rates)
        roll, pitch, yaw = self._law.torque_shares(acceleration)[:, 0].tolist()
        return TorqueSetpoint((roll, pitch, yaw), setpoint.thrust)
