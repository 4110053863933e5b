"""The shipped controllers beside the paper's: stable and on their paths, and each one's own claim."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mavsitl_ground.geometric import attitude_error
from mavsitl_ground.indi import SecondOrder

from mavsitl.controllers import settings
from mavsitl.quaternion import from_euler
from mavsitl.scenario import load
from tests.drivers.exercise import Flown, fly_in_memory

NAMES = ("stock", "geometric", "indi")


def flown(controller: str, name: str, duration_s: float, **overrides: Any) -> Flown:
    return fly_in_memory(load(name, {"duration_s": duration_s, **settings(controller), **overrides}))


def rms_m(flight: Flown, from_s: float = 0.0) -> float:
    error = flight.data.position_error_nwu_m()[flight.data.time_s >= from_s]
    return float(np.sqrt(np.mean(np.sum(np.square(error), axis=1))))


@pytest.mark.parametrize("airframe", ["paper", "realistic"])
@pytest.mark.parametrize("controller", NAMES)
def test_settles_after_a_step(controller: str, airframe: str) -> None:
    """A metre aside, and a quarter turn: there within a centimetre after five seconds."""
    step = [
        {"time_s": 0.0, "position_nwu_m": [0.0, 0.0, 1.0]},
        {"time_s": 1.0, "position_nwu_m": [1.0, 0.0, 1.0], "yaw_deg": 90.0},
    ]
    flight = flown(controller, "steps-calm", 8.0, **{"reference.steps": step, "airframe": airframe})
    assert flight.phase == "DONE"
    assert rms_m(flight, from_s=6.0) < 0.015
    assert abs(flight.data.attitude_deg[-1, 2] - 90.0) < 2.0


@pytest.mark.parametrize("controller", NAMES)
def test_follows_a_figure_8_in_wind(controller: str) -> None:
    flight = flown(controller, "figure-8-wind", 12.0)
    assert flight.phase == "DONE"
    assert rms_m(flight) < 0.15


@pytest.mark.parametrize("controller", ["geometric", "indi"])
def test_takes_out_a_mass_that_it_does_not_know(controller: str) -> None:
    """By its integral, or by increments on the measured acceleration."""
    flight = flown(controller, "hover-calm", 10.0, **{"offnominal.mass_scale": 1.3})
    assert flight.phase == "DONE"
    assert rms_m(flight, from_s=8.0) < 0.01


def test_e_r_is_the_angle_of_small_errors_and_vanishes_at_none() -> None:
    assert attitude_error(from_euler(0.01, 0.0, 1.0), from_euler(0.0, 0.0, 1.0)) == pytest.approx(
        (0.01, 0.0, 0.0), abs=1e-6
    )
    assert attitude_error(from_euler(0.2, -0.3, 1.0), from_euler(0.2, -0.3, 1.0)) == pytest.approx((0.0, 0.0, 0.0))


def test_e_r_is_lees_by_matrices() -> None:
    def matrix(q: tuple[float, float, float, float]) -> Any:
        w, x, y, z = q
        return np.array((
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ))  # fmt: skip

    q, desired = from_euler(0.4, -0.6, 1.1), from_euler(-0.2, 0.5, 0.3)
    r, r_d = matrix(q), matrix(desired)
    skew = 0.5 * (r_d.T @ r - r.T @ r_d)
    assert attitude_error(q, desired) == pytest.approx((skew[2, 1], skew[0, 2], skew[1, 0]))


def test_the_filter_and_its_derivative_are_of_one_delay() -> None:
    """On a ramp the rate is the slope, and the value is late by 2 d / w."""
    filtered = SecondOrder(20.0, 0.004)
    for k in range(1000):
        filtered.step(np.array((0.5, -1.0, 0.0)) * (k * 0.004))
    assert filtered.value is not None
    assert filtered.rate == pytest.approx((0.5, -1.0, 0.0), abs=1e-6)
    late_s = (999 * 0.004 * 0.5 - filtered.value[0]) / 0.5
    assert late_s == pytest.approx(2 * 0.7 / 20.0, abs=0.005)
