"""What no force can change, and what a free fall keeps."""

from __future__ import annotations

import numpy as np
import pytest
from mavsitl_vehicle.plant.state import ROTOR, Array

from tests.plant.flight import PAPER, Fleet, airframe, body_slope, rotation

WITHOUT_THRUST = airframe(drag_coefficient_n_m_s2=1.0e-300, thrust_coefficient_n_s2=1.0e-300)
"""Rotors that spin and do nothing but spin."""


def world_momentum(fleet: Fleet, spin_sign: float) -> Array:
    """Angular momentum, NWU, of body and rotors; `spin_sign` times eq 8's Omega_r is the rotors' spin about body z."""
    omega = fleet.x[10:13, 0]
    o1, o2, o3, o4 = fleet.x[ROTOR:, 0]
    rotors = PAPER.rotor_inertia_kg_m2 * (-o1 + o2 - o3 + o4)
    return np.asarray(rotation(fleet.x[6:10, 0]) @ (fleet.inertia() * omega + [0.0, 0.0, spin_sign * rotors]))


def tumbling(rotors: list[float]) -> Fleet:
    fleet = Fleet(WITHOUT_THRUST)
    fleet.x[10:13, 0] = [3.0, -2.0, 1.0]
    fleet.x[ROTOR:, 0] = rotors
    fleet.command[:, 0] = rotors
    return fleet


def test_angular_momentum_with_the_rotors() -> None:
    """Rotors 2 and 4 turn counter-clockwise, along +z (eq 9: their drag turns the body the other way)."""
    fleet = tumbling([100.0, 250.0, 100.0, 250.0])
    before = world_momentum(fleet, 1.0)
    other_sign_before = world_momentum(fleet, -1.0)
    fleet.run(5.0)
    np.testing.assert_allclose(
        world_momentum(fleet, 1.0), before, rtol=0.0, atol=1.0e-9 * float(np.linalg.norm(before))
    )
    # The printed sign of eqs 7 and 11 would keep this one instead: rotors spinning with, not against, their drag.
    assert np.linalg.norm(world_momentum(fleet, -1.0) - other_sign_before) > 0.01 * np.linalg.norm(other_sign_before)


def test_rotational_energy() -> None:
    fleet = tumbling([100.0, 250.0, 100.0, 250.0])
    before = fleet.inertia() @ fleet.x[10:13, 0] ** 2
    fleet.run(5.0)
    assert fleet.inertia() @ fleet.x[10:13, 0] ** 2 == pytest.approx(before, rel=1.0e-10)
    assert np.abs(fleet.x[10:13, 0] - [3.0, -2.0, 1.0]).max() > 0.1


def test_the_rotors_drag_and_their_spin_are_opposite() -> None:
    """The drag moment of eq 9 on the body is against the spin that the gyroscopic moment assumes, rotor by rotor."""
    for rotor in range(4):
        fleet = Fleet()
        rotors = np.zeros(4)
        rotors[rotor] = 200.0
        level = (0.0,) * 6 + (1.0, 0.0, 0.0, 0.0)
        at_rest = body_slope(fleet, (*level, 0.0, 0.0, 0.0), rotors)
        turned = body_slope(fleet, (*level, 1.0, 0.0, 0.0), rotors)
        # -omega x h with omega = (1, 0, 0) and h = (0, 0, h): a pitch moment +h.
        spin = (turned[11] - at_rest[11]) * fleet.inertia()[1]
        assert spin * at_rest[12] < 0.0
        assert abs(spin) == pytest.approx(PAPER.rotor_inertia_kg_m2 * 200.0, rel=1e-9)


def test_energy_in_free_fall() -> None:
    fleet = Fleet(rotor_speed_rad_s=0.0)
    fleet.x[3:6, 0] = [1.0, -2.0, 5.0]
    energy = 0.5 * fleet.x[3:6, 0] @ fleet.x[3:6, 0] + PAPER.gravity_m_s2 * fleet.x[2, 0]
    fleet.run(3.0)
    after = 0.5 * fleet.x[3:6, 0] @ fleet.x[3:6, 0] + PAPER.gravity_m_s2 * fleet.x[2, 0]
    assert after == pytest.approx(energy, rel=1.0e-11)
    assert fleet.x[2, 0] == pytest.approx(100.0 + 5.0 * 3.0 - 0.5 * 9.81 * 9.0, abs=1.0e-9)
