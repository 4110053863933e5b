"""One text: un-jitted, jitted, and each lane of a fleet give the same bits."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np

from tests.plant.same_bits import N, fly


def test_unjitted_is_jitted() -> None:
    fleet = fly(slice(None))
    assert np.isfinite(fleet).all()
    plain = subprocess.run(
        [sys.executable, "-m", "tests.plant.same_bits"],
        env={**os.environ, "MAVSITL_JIT": "0"},
        check=True,
        capture_output=True,
    ).stdout
    assert plain == fleet.tobytes()


def test_each_lane_is_the_vehicle_alone() -> None:
    fleet = fly(slice(None))
    assert np.unique(fleet[0, 0]).size == N
    for j in range(N):
        np.testing.assert_array_equal(fly(slice(j, j + 1))[..., 0], fleet[..., j])
