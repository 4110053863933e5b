"""The attitude law of a scenario, PIDNN or the identical PID, seated in either wing."""

from __future__ import annotations

import numpy as np

from mavsitl.airframes import Airframe
from mavsitl.compiled import inlined
from mavsitl.control.arrays import Floats
from mavsitl.control.pidnn import AttitudePid, Pidnn
from mavsitl.scenario import Controller


@inlined
def torque_shares(acceleration: Floats, limit: Floats, shares: Floats) -> None:
    """`InnerLoop.torque_shares`: fills `shares` (3, n); `limit` (3, 1) is the acceleration of the largest torque."""
    for axis in range(shares.shape[0]):
        for i in range(shares.shape[1]):
            share = acceleration[axis, i] / limit[axis, 0]
            if share > 1.0:
                share = 1.0
            elif share < -1.0:
                share = -1.0
            shares[axis, i] = share


class InnerLoop:
    """Angles to angular acceleration (eqs 27-57), and from there to the wire's torque shares or body rates."""

    def __init__(self, controller: Controller, airframe: Airframe, period_s: float, n: int = 1) -> None:
        inertia, torque = airframe.inertia_kg_m2, airframe.max_torque_n_m
        limits = (torque[0] / inertia[0], torque[1] / inertia[1], torque[2] / inertia[2])
        self.law: Pidnn | AttitudePid
        if controller.law == "pidnn":
            self.law = Pidnn(
                controller.roll_pitch, controller.yaw, controller.learning, period_s, controller.derivative, limits, n
            )
        else:
            self.law = AttitudePid(controller.roll_pitch, controller.yaw, period_s, controller.derivative, limits, n)
        self.limit = np.array(limits)[:, np.newaxis].copy()
        """Angular acceleration of the airframe's largest torque, rad/s^2, (3, 1)."""
        self._inertia = np.array(inertia)[:, np.newaxis]

    @property
    def weights(self) -> Floats | None:
        """Output weights (3 outputs P I D, 3 axes, n) of a PIDNN; None for the PID."""
        return self.law.weights if isinstance(self.law, Pidnn) else None

    def update(
        self,
        angles_rad: Floats,
        omega_flu_rad_s: Floats,
        desired_rad: Floats,
        desired_rates_rad_s: Floats | None = None,
    ) -> Floats:
        """Angular acceleration (3, n), rad/s^2 FLU, overwritten by the next call. Shapes as `Pidnn.update`."""
        return self.law.update(angles_rad, omega_flu_rad_s, desired_rad, desired_rates_rad_s)

    def torque_shares(self, acceleration_rad_s2: Floats) -> Floats:
        """(3, n) in -1..1: shares of the airframe's largest torque, eqs 11 and 12 with the torque's arm included."""
        shares: Floats = np.empty_like(acceleration_rad_s2)
        torque_shares(acceleration_rad_s2, self.limit, shares)
        return shares

    def torque_n_m(self, acceleration_rad_s2: Floats) -> Floats:
        """(3, n), N m."""
        torque: Floats = acceleration_rad_s2 * self._inertia
        return torque

    def reset(self) -> None:
        """Back to the identical PID, integrators empty."""
        self.law.reset()
