"""Steady wind, gusts, sums, and one text for all of it."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from mavsitl_vehicle.wind.dryden import Array
from mavsitl_vehicle.wind.field import WindField

from mavsitl.scenario import DrydenMil, DrydenPaper, Gust, Steady, Wind
from tests.wind.same_bits import blow_everything
from tests.wind.turbulence import blow


def at(winds: tuple[Wind, ...], time_s: float) -> Array:
    field = WindField(winds, 1, 0.01)
    out = np.empty((3, 1))
    field.step(time_s, np.zeros((field.normals_per_step, 1)), out)
    return out[:, 0]


def test_no_wind_and_steady_winds_add() -> None:
    np.testing.assert_array_equal(at((), 1.0), 0.0)
    two = (Steady(velocity_nwu_m_s=(1.0, 2.0, 0.0)), Steady(velocity_nwu_m_s=(0.5, -3.0, 0.25)))
    np.testing.assert_array_equal(at(two, 1.0), [1.5, -1.0, 0.25])


@pytest.mark.parametrize(
    ("time_s", "pulse", "ramp"),
    [
        (0.0, 0.0, 0.0),
        (2.0, 0.0, 0.0),
        (3.0, 0.5, 0.5),
        (4.0, 1.0, 1.0),
        (5.0, 0.5, 1.0),
        (6.0, 0.0, 1.0),
        (9.0, 0.0, 1.0),
    ],
)
def test_gust_shapes(time_s: float, pulse: float, ramp: float) -> None:
    falls = Gust(velocity_nwu_m_s=(4.0, -2.0, 1.0), start_s=2.0, length_s=2.0, shape="pulse")
    stays = Gust(velocity_nwu_m_s=(4.0, -2.0, 1.0), start_s=2.0, length_s=2.0, shape="ramp")
    np.testing.assert_allclose(at((falls,), time_s), pulse * np.array([4.0, -2.0, 1.0]), atol=1e-12)
    np.testing.assert_allclose(at((stays,), time_s), ramp * np.array([4.0, -2.0, 1.0]), atol=1e-12)


def test_a_third_of_the_way_up_is_a_quarter() -> None:
    """(1 - cos 60 deg) / 2"""
    gust = Gust(velocity_nwu_m_s=(8.0, 0.0, 0.0), start_s=1.0, length_s=3.0)
    np.testing.assert_allclose(at((gust,), 2.0), [2.0, 0.0, 0.0], atol=1e-12)


def test_a_sum_is_the_sum_of_its_parts() -> None:
    paper = DrydenPaper()
    mil = DrydenMil(speed_20ft_m_s=6.0, altitude_m=3.0, from_deg=30.0, include_mean=True)
    steady = Steady(velocity_nwu_m_s=(1.0, 0.0, -0.5))
    field = WindField((paper, steady, mil), 3, 0.01)
    assert field.normals_per_step == 3 + 5
    alone = [WindField((paper,), 3, 0.01), WindField((mil,), 3, 0.01)]
    rng = np.random.default_rng(2)
    normals = rng.standard_normal((8, 3))
    field.reset(normals)
    alone[0].reset(normals[:3])
    alone[1].reset(normals[3:])
    total, part_1, part_2 = np.empty((3, 3, 3))
    for k in range(50):
        normals = rng.standard_normal((8, 3))
        field.step(0.01 * k, normals, total)
        alone[0].step(0.01 * k, normals[:3], part_1)
        alone[1].step(0.01 * k, normals[3:], part_2)
        np.testing.assert_allclose(total, part_1 + part_2 + np.array([[1.0], [0.0], [-0.5]]), atol=1e-12)


def test_normals_needed_for_each_form() -> None:
    assert WindField((), 1, 0.01).normals_per_step == 0
    assert WindField((DrydenPaper(),), 1, 0.01).normals_per_step == 3
    assert WindField((DrydenPaper(form="spectrum"),), 1, 0.01).normals_for_reset == 5


def test_the_first_wind_is_that_of_the_reset() -> None:
    field = WindField((DrydenPaper(),), 1, 0.01)
    field.reset(np.ones((3, 1)))
    out = np.empty((3, 1))
    field.step(0.0, np.zeros((3, 1)), out)
    np.testing.assert_allclose(out[:, 0], [1.9953, 3.981 * 0.93060, 0.93060], rtol=2e-4)


def test_wrong_shapes_are_refused() -> None:
    field = WindField((DrydenPaper(),), 2, 0.01)
    with pytest.raises(ValueError, match=r"\(3, 2\)"):
        field.reset(np.zeros((3, 1)))
    with pytest.raises(ValueError, match=r"\(3, 2\)"):
        field.step(0.0, np.zeros((5, 2)), np.zeros((3, 2)))
    with pytest.raises(ValueError, match="n = 0"):
        WindField((), 0, 0.01)
    with pytest.raises(ValueError, match="dt_s = 0"):
        WindField((), 1, 0.0)


def test_unjitted_is_jitted() -> None:
    everything = blow_everything()
    assert np.unique(everything[-1]).size == everything[-1].size
    plain = subprocess.run(
        [sys.executable, "-m", "tests.wind.same_bits"],
        env={**os.environ, "MAVSITL_JIT": "0"},
        check=True,
        capture_output=True,
    ).stdout
    assert plain == everything.tobytes()


def test_equal_seeds_equal_wind() -> None:
    np.testing.assert_array_equal(blow((DrydenPaper(),), 2, 0.01, 5), blow((DrydenPaper(),), 2, 0.01, 5))


def test_turbulence_of_no_wind_is_calm_and_draws_nothing() -> None:
    """The lower end of a sweep over the wind's speed."""
    winds: tuple[Wind, ...] = (
        DrydenPaper(speed_20ft_m_s=0.0),
        DrydenMil(speed_20ft_m_s=0.0, altitude_m=6.0, include_mean=True),
    )
    field = WindField(winds, 1, 0.001)
    assert field.normals_per_step == 0
    assert field.coefficients.shape[0] == 0
    alone = WindField((DrydenPaper(),), 1, 0.001)
    assert np.array_equal(WindField((*winds, DrydenPaper()), 1, 0.001).coefficients, alone.coefficients)
