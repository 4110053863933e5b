"""Is the filter as good as it says? Its errors and innovations against its own covariance, over seeds, in flight.

Chi-squared bounds of 99.9 % for the mean of independent flights; samples within a flight are not independent.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from mavsitl_vehicle.sensors import ekf
from scipy.stats import chi2

from tests.sensors.rig import PERIOD_S, Rig, Watch

SEEDS = range(8, 20)
ROWS = {
    "position": slice(0, 3),
    "velocity": slice(3, 6),
    "attitude": slice(6, 9),
    "gyro bias": slice(9, 12),
    "accelerometer bias": slice(12, 15),
    "GPS offset": slice(15, 18),
    "barometer offset": slice(18, 19),
    "magnetometer offset": slice(19, 22),
    "all": slice(0, ekf.ERROR_ROWS),
}


@cache
def flown(seed: int) -> dict[str, float]:
    """The NEES at the end of a flight that turns and moves."""
    rig = Rig(seed=seed)
    watch = Watch(rig)
    for _ in range(250):
        rig.rest(PERIOD_S)
        watch.note()
    for tick in range(round(10.0 / PERIOD_S)):
        phase = 0.5 * tick * PERIOD_S
        rig.tick((4.0 * np.sin(phase), 3.0 * np.sin(2.0 * phase), 5.0), yaw_rad=float(np.sin(0.3 * phase)))
        watch.note()
    return {name: watch.nees(rows) for name, rows in ROWS.items()}


@pytest.mark.parametrize("name", ROWS)
def test_errors_are_as_large_as_the_covariance_says(name: str) -> None:
    rows = ROWS[name]
    degrees = (rows.stop - rows.start) * len(SEEDS)
    low, high = chi2.ppf(0.0005, degrees), chi2.ppf(0.9995, degrees)
    assert low < sum(flown(seed)[name] for seed in SEEDS) < high


def test_innovations_are_as_large_as_the_filter_expects() -> None:
    """Test ratios are |innovation| / (gate sigma): the largest of three is below 1 / gate times its quantile."""
    rig = Rig(seed=3)
    rig.rest(1.0)
    gates = {"velocity_ratio": 5.0, "height_ratio": 5.0, "mag_ratio": 3.0}
    seen: dict[str, list[float]] = {name: [] for name in gates}
    for _ in range(2500):
        rig.tick((0.0, 0.0, 5.0))
        for name, gate in gates.items():
            seen[name].append(gate * getattr(rig.status, name))
    # the largest of three Gaussians: mean 1.33 sigma; of two: 1.13
    for name, values in seen.items():
        assert 0.9 < np.mean(values) < 1.6, name
        assert max(values) < 5.0, name
