"""The time after an event until the vehicle stays near its reference, of made-up flights and of one that is flown."""

from __future__ import annotations

import numpy as np
import pytest

from mavsitl.campaign.fly import fly
from mavsitl.campaign.grid import case
from mavsitl.campaign.sums import Sums, events
from mavsitl.scenario import load


def test_events_are_steps_gusts_failures_and_outages() -> None:
    assert events(load("steps-calm").scenario) == [5.0, 12.0, 19.0, 26.0, 33.0]
    assert events(load("hover-gust").scenario) == [10.0]
    assert events(load("thrust-loss").scenario) == [10.0]
    assert events(load("hover-wind").scenario) == []
    outage = {"link.to_ground.outages": [{"start_s": 3.0, "duration_s": 1.0}]}
    assert events(load("hover-wind", outage).scenario) == [3.0]


def test_the_last_moment_outside_counts_by_event_whatever_the_stretches() -> None:
    """Out for 1 s, back, out again until 2.5 s after the first event; 0.5 s after the second."""
    time_s = np.arange(0.0, 20.0, 0.004)
    far = ((time_s >= 5) & (time_s < 6)) | ((time_s >= 7) & (time_s <= 7.5)) | ((time_s >= 12) & (time_s <= 12.5))
    error = np.zeros((time_s.size, 3))
    error[far, 1] = 0.2
    sums = Sums(load("steps-calm"))
    for part in np.array_split(np.arange(time_s.size), 7):
        sums._add_settling(time_s[part], error[part])
        sums.time_s = float(time_s[part][-1])
    assert sums.settling_s == pytest.approx((2.5 + 0.5 + 0.0) / 3.0, abs=0.01)


def test_of_a_flight() -> None:
    row = fly(case(load("steps-calm", {"duration_s": 8.0})))
    assert row.settling_s is not None
    assert 0.3 < row.settling_s < 3.0
    assert fly(case(load("hover-calm", {"duration_s": 1.0}))).settling_s is None
