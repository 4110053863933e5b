"""On the ground."""

from __future__ import annotations

import numpy as np
import pytest
from mavsitl_vehicle.plant.contact import FRICTION, leg_force

from mavsitl.scenario import Offnominal
from tests.plant.flight import HOVER_RAD_S, PAPER, Fleet


def test_rests_at_height_zero() -> None:
    fleet = Fleet(ground=True, height_m=0.0, rotor_speed_rad_s=0.0)
    fleet.run(10.0)
    np.testing.assert_allclose(fleet.x[:3, 0], 0.0, atol=1e-9)
    np.testing.assert_allclose(fleet.x[3:6, 0], 0.0, atol=1e-9)
    np.testing.assert_allclose(fleet.acceleration(), 0.0, atol=1e-6)


@pytest.mark.parametrize("dt_s", [1.0e-3, 5.0e-3, 0.02])
@pytest.mark.parametrize("mass_scale", [0.5, 1.0, 2.0])
def test_drops_rebounds_little_and_rests(dt_s: float, mass_scale: float) -> None:
    fleet = Fleet(ground=True, height_m=0.5, rotor_speed_rad_s=0.0, offnominal=Offnominal(mass_scale=mass_scale))
    fleet.run(0.4, dt_s)
    heights = []
    for _ in range(130):
        fleet.run(0.02, dt_s)
        heights.append(float(fleet.x[2, 0]))
    assert max(heights) < 0.05  # of 0.5 m
    assert min(heights) > -0.1
    assert abs(fleet.x[2, 0]) < 2.0e-3
    assert np.abs(fleet.x[3:6, 0]).max() < 1.0e-3


def test_a_tilted_fall_ends_upright() -> None:
    fleet = Fleet(ground=True, height_m=0.3, rotor_speed_rad_s=0.0)
    fleet.x[6:10, 0] = [np.cos(0.2), np.sin(0.2), 0.0, 0.0]
    fleet.run(4.0)
    assert abs(fleet.x[2, 0]) < 2.0e-3
    assert np.abs(fleet.x[7:9, 0]).max() < 1.0e-3


def test_sliding_stops() -> None:
    """From 2 m/s Coulomb friction alone needs v^2 / (2 mu g) = 0.29 m."""
    fleet = Fleet(ground=True, height_m=0.0, rotor_speed_rad_s=0.0)
    fleet.x[3, 0] = 2.0
    fleet.run(2.0)
    assert fleet.x[3, 0] == pytest.approx(0.0, abs=1.0e-4)
    assert fleet.x[0, 0] == pytest.approx(2.0**2 / (2.0 * FRICTION * PAPER.gravity_m_s2), rel=0.15)
    assert abs(fleet.x[2, 0]) < 2.0e-3


def test_spinning_stops() -> None:
    fleet = Fleet(ground=True, height_m=0.0, rotor_speed_rad_s=0.0)
    fleet.x[12, 0] = 3.0
    fleet.run(2.0)
    assert abs(fleet.x[12, 0]) < 1.0e-3


def test_takes_off_without_sticking() -> None:
    """Just above hover thrust the ground lets go: the climb is that in free air and the legs' 1 mm push."""
    fleet = Fleet(ground=True, height_m=0.0, rotor_speed_rad_s=1.05 * HOVER_RAD_S)
    free = Fleet(height_m=0.0, rotor_speed_rad_s=1.05 * HOVER_RAD_S)
    fleet.run(1.0)
    free.run(1.0)
    assert 0.0 <= fleet.x[5, 0] - free.x[5, 0] < 0.1
    assert fleet.x[2, 0] > 0.4


def test_a_leg_pushes_and_never_pulls() -> None:
    assert leg_force(-1.0e-3, 5.0, 1000.0, 10.0) == 0.0
    assert leg_force(1.0e-3, -50.0, 1000.0, 10.0) == 0.0
    assert leg_force(2.0e-3, 0.1, 1000.0, 10.0) == pytest.approx(3.0)
    assert leg_force(1.0e-9, 5.0, 1000.0, 10.0) < 1.0e-3  # continuous at touch-down


def test_switched_off_there_is_no_ground() -> None:
    fleet = Fleet(height_m=0.0, rotor_speed_rad_s=0.0)
    fleet.run(1.0)
    assert fleet.x[2, 0] == pytest.approx(-0.5 * PAPER.gravity_m_s2, rel=1e-9)
