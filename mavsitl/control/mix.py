"""From angular acceleration to torque and to U_2..U_4, eqs 11 and 12."""

from __future__ import annotations

import numpy as np

from mavsitl.compiled import compiled
from mavsitl.control.arrays import Floats


@compiled
def _step(acceleration: Floats, inertia: Floats, arm: float, torque: Floats, u: Floats) -> None:
    if acceleration.shape != torque.shape:
        raise ValueError("the angular acceleration must have shape (3, n)")
    for i in range(torque.shape[1]):
        for axis in range(3):
            torque[axis, i] = inertia[axis] * acceleration[axis, i]
        u[0, i] = torque[0, i] / arm
        u[1, i] = torque[1, i] / arm
        u[2, i] = torque[2, i]


class Mix:
    """Body torque = I alpha, U_2 = I_xx alpha_x / l, U_3 = I_yy alpha_y / l, U_4 = I_zz alpha_z (a torque: no l).

    The gyroscopic terms of eq 11 are left to the feedback, as in the paper.
    """

    def __init__(self, inertia_kg_m2: tuple[float, float, float], arm_m: float, n: int = 1) -> None:
        self._inertia = np.array(inertia_kg_m2)
        self._arm = float(arm_m)
        self.torque_flu_n_m = np.zeros((3, n))
        self.u = np.zeros((3, n))
        """U_2, U_3 in N, U_4 in N m, as of the last update."""

    def update(self, angular_acceleration_flu_rad_s2: Floats) -> Floats:
        """Torque (3, n) in N m, FLU, overwritten by the next call. Raises `ValueError` for a wrong shape."""
        _step(angular_acceleration_flu_rad_s2, self._inertia, self._arm, self.torque_flu_n_m, self.u)
        return self.torque_flu_n_m
