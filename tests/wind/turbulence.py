"""Runs of a wind field, for the tests of the wind."""

from __future__ import annotations

import numpy as np
from mavsitl_vehicle.wind.dryden import Array
from mavsitl_vehicle.wind.field import WindField

from mavsitl.scenario import Wind


def blow(winds: tuple[Wind, ...], n: int, dt_s: float, steps: int, seed: int = 1) -> Array:
    """Wind of a field started stationary: shape (steps, 3, n), m/s NWU."""
    rng = np.random.default_rng(seed)
    field = WindField(winds, n, dt_s)
    field.reset(rng.standard_normal((field.normals_for_reset, n)))
    wind = np.empty((steps, 3, n))
    for k in range(steps):
        field.step(k * dt_s, rng.standard_normal((field.normals_per_step, n)), wind[k])
    return wind
