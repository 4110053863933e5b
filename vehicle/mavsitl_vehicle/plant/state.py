"""The plant's state: float64 of shape (17, n), C-contiguous, one column a vehicle. The constants are first rows."""

from __future__ import annotations

from math import cos, sin
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]

POSITION = 0
"""Rows 0:3, metres, NWU. Height 0 is the vehicle at rest on its legs."""
VELOCITY = 3
"""Rows 3:6, m/s, NWU."""
QUATERNION = 6
"""Rows 6:10, (w, x, y, z), body FLU to world NWU, Hamilton."""
OMEGA = 10
"""Rows 10:13, rad/s, body rates FLU."""
ROTOR = 13
"""Rows 13:17, rad/s, speeds of rotors 1 (rear), 2 (right), 3 (front), 4 (left), never negative."""
"""Rows of the rigid body: all but the rotors."""
N_STATES = 17

Body: TypeAlias = tuple[float, float, float, float, float, float, float, float, float, float, float, float, float]
"""Rows 0:13 of one vehicle, or their time derivatives: kernels pass it by value, so a stage lives in registers."""
Rotors: TypeAlias = tuple[float, float, float, float]
"""Rows 13:17 of one vehicle."""
Wind: TypeAlias = tuple[float, float, float]
"""At one vehicle, m/s NWU."""


def initial_state(
    position_nwu_m: tuple[float, float, float], yaw_rad: float, rotor_speed_rad_s: float, n: int
) -> Array:
    """`n` level vehicles at rest at one pose, every rotor at one speed: shape (17, n).

    Yaw is about z up, so positive turns the nose from north to west. Raises `ValueError` for `n` below 1.
    """
    if n < 1:
        raise ValueError(f"n = {n}: a fleet has at least one vehicle")
    x = np.zeros((N_STATES, n))
    x[POSITION:VELOCITY] = np.array(position_nwu_m)[:, np.newaxis]
    x[QUATERNION] = cos(0.5 * yaw_rad)
    x[QUATERNION + 3] = sin(0.5 * yaw_rad)
    x[ROTOR:] = rotor_speed_rad_s
    return x
