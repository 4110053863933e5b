"""One text, one seed, one flight: un-jitted is jitted, and a run repeated is the run."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np

from tests.autopilot.same_bits import fly


def test_unjitted_is_jitted() -> None:
    client = fly()
    x = client.vehicle.simulation.x
    assert np.isfinite(x).all()
    assert x[2, 0] > 0.1
    plain = subprocess.run(
        [sys.executable, "-m", "tests.autopilot.same_bits"],
        env={**os.environ, "MAVSITL_JIT": "0"},
        check=True,
        capture_output=True,
    ).stdout
    assert plain == x.tobytes()


def test_same_seed_same_wire() -> None:
    first, second, other = fly(3), fly(3), fly(4)
    assert first.wire == second.wire
    assert first.wire != other.wire
    assert sum(map(len, first.wire)) > 100
