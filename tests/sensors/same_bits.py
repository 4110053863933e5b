"""A short flight by the filter: bytes of truth, estimate and covariance; with MAVSITL_JIT=0 by test_estimator."""

from __future__ import annotations

import sys

from tests.sensors.rig import PERIOD_S, Rig


def fly(seed: int = 3) -> bytes:
    """0.5 s at rest and 0.5 s of take-off: every kernel but that of a reset."""
    rig = Rig(seed=seed, scenario="hover-wind", airframe="realistic")
    rig.rest(0.7)
    for tick in range(round(0.5 / PERIOD_S)):
        rig.tick((0.3, -0.2, 1.2), yaw_rad=0.001 * tick)
    simulation, sensed = rig.simulation, rig.sensed
    assert sensed.aligned
    return simulation.x.tobytes() + simulation.estimate.tobytes() + sensed.x.tobytes() + sensed.p.tobytes()


if __name__ == "__main__":
    sys.stdout.buffer.write(fly())
