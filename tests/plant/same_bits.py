"""Fly a stirred fleet and write its bytes to standard output: run with MAVSITL_JIT=0 and without, by test_same_bits."""

from __future__ import annotations

import sys

import numpy as np
from mavsitl_vehicle.plant.state import Array

from tests.plant.flight import PAPER, REALISTIC, Fleet

STEPS = 40
N = 37
"""Two blocks of lanes and five vehicles that are stepped alone."""


def fly(columns: slice) -> Array:
    """States and accelerations, (2 airframes, 20, n), after STEPS steps through the air, the ground and the clamp."""
    results = []
    for base in (PAPER, REALISTIC):
        rng = np.random.default_rng(5)
        fleet = Fleet(base, ground=True, n=N)
        fleet.x[:6] = rng.normal(0.0, 0.05, (6, N))
        fleet.x[6:10] += rng.normal(0.0, 0.1, (4, N))
        fleet.x[10:13] = rng.normal(0.0, 1.0, (3, N))
        fleet.wind[:] = rng.normal(0.0, 3.0, (3, N))
        fleet.held[3] = True
        commands = base.max_rotor_speed_rad_s * rng.uniform(-0.1, 1.1, (STEPS, 4, N))
        for name in ("x", "wind", "held", "parameters", "command"):
            setattr(fleet, name, np.ascontiguousarray(getattr(fleet, name)[..., columns]))
        for command in commands:
            fleet.command[:] = command[:, columns]
            fleet.run(1.0e-3)
        results.append(np.concatenate([fleet.x, fleet.acceleration()]))
    return np.stack(results)


if __name__ == "__main__":
    sys.stdout.buffer.write(fly(slice(None)).tobytes())
