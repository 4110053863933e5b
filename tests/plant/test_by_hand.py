"""Cases that can be worked out on paper."""

from __future__ import annotations

from itertools import pairwise
from math import exp, pi, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mavsitl_vehicle.plant.rotor import decay
from mavsitl_vehicle.plant.state import Array, initial_state

from mavsitl.scenario import Offnominal
from tests.plant.flight import HOVER_RAD_S, PAPER, REALISTIC, Fleet, body_slope, rotation

LEVEL = (0.0,) * 6 + (1.0, 0.0, 0.0, 0.0) + (0.0,) * 3


def test_table_2_hovers_at_182_5_rad_s() -> None:
    assert pytest.approx(182.5, abs=0.05) == HOVER_RAD_S
    fleet = Fleet()
    start = fleet.x.copy()
    fleet.run(10.0)
    np.testing.assert_allclose(fleet.x, start, rtol=0.0, atol=1.0e-12)
    np.testing.assert_allclose(fleet.acceleration(), 0.0, atol=1.0e-14)


def test_initial_yaw_is_about_up() -> None:
    x = initial_state((1.0, 2.0, 3.0), pi / 2.0, 5.0, 2)
    assert x.flags.c_contiguous
    np.testing.assert_allclose(rotation(x[6:10, 1])[:, 0], [0.0, 1.0, 0.0], atol=1e-15)
    np.testing.assert_array_equal(x[:3, 0], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(x[13:], 5.0)


@pytest.mark.parametrize(
    ("squares", "u"),
    [
        ((1.0, 1.0, 1.0, 1.0), (4.0, 0.0, 0.0, 0.0)),
        ((0.0, -1.0, 0.0, 1.0), (0.0, 2.0, 0.0, 0.0)),
        ((1.0, 0.0, -1.0, 0.0), (0.0, 0.0, 2.0, 0.0)),
        ((1.0, -1.0, 1.0, -1.0), (0.0, 0.0, 0.0, 4.0)),
    ],
)
def test_each_u_of_eq_12_alone(squares: tuple[float, ...], u: tuple[float, ...]) -> None:
    """A change of Omega^2 by 1,000 times `squares` gives b u (U_4: d u), and eq 11's acceleration, and nothing else."""
    fleet = Fleet()
    rotors = np.sqrt(HOVER_RAD_S**2 + 1000.0 * np.array(squares))
    d = body_slope(fleet, LEVEL, rotors)
    b, drag = 1000.0 * PAPER.thrust_coefficient_n_s2, 1000.0 * PAPER.drag_coefficient_n_m_s2
    i_x, i_y, i_z = PAPER.inertia_kg_m2
    assert d[5] == pytest.approx(b * u[0] / PAPER.mass_kg, abs=1e-12)
    assert d[10] == pytest.approx(PAPER.arm_m * b * u[1] / i_x, abs=1e-12)
    assert d[11] == pytest.approx(PAPER.arm_m * b * u[2] / i_y, abs=1e-12)
    assert d[12] == pytest.approx(drag * u[3] / i_z, abs=1e-12)
    assert d[3:5].tolist() == [0.0, 0.0]


def test_positive_u2_rolls_right_and_flies_towards_negative_y() -> None:
    fleet = Fleet()
    fleet.command[:, 0] = HOVER_RAD_S * np.array([1.0, 0.99, 1.0, 1.01])
    fleet.run(0.3)
    assert fleet.x[4, 0] < -1.0e-3  # eq 11: y'' = -U_1 sin(phi) / m
    assert abs(fleet.x[3, 0]) < 1.0e-6


def test_positive_u3_pitches_forward_and_flies_towards_positive_x() -> None:
    fleet = Fleet()
    fleet.command[:, 0] = HOVER_RAD_S * np.array([1.01, 1.0, 0.99, 1.0])
    fleet.run(0.3)
    assert fleet.x[3, 0] > 1.0e-3
    assert abs(fleet.x[4, 0]) < 1.0e-6


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_hovering_wind_acceleration_is_the_coupling(axis: int) -> None:
    """kappa 4 (2 rho A) V_d / m: 0.133 x 4 x 0.17318 x 3.200 / 0.723 = 0.408 1/s."""
    fleet = Fleet()
    fleet.wind[axis, 0] = 2.0
    two_rho_a = 2.0 * 1.225 * pi * 0.15**2
    induced = sqrt(PAPER.weight_n / 4.0 / two_rho_a)
    assert induced == pytest.approx(3.200, abs=1e-3)
    expected = np.zeros(3)
    expected[axis] = 0.133 * 4.0 * two_rho_a * induced / 0.723
    assert expected[axis] == pytest.approx(0.408, abs=5e-4)
    np.testing.assert_allclose(fleet.acceleration()[:, 0] / 2.0, expected, atol=1e-12)


def test_wind_moments_of_eq_13() -> None:
    """With rotor 4 faster than 2, an updraught adds W_4 > 0; in a balanced hover W_4..W_6 vanish."""
    fleet = Fleet()
    fleet.wind[2, 0] = 3.0
    balanced = body_slope(fleet, LEVEL, (HOVER_RAD_S,) * 4)
    np.testing.assert_allclose(balanced[10:], 0.0, atol=1e-13)

    rotors = (180.0, 170.0, 180.0, 190.0)
    windy = body_slope(fleet, LEVEL, rotors)
    calm = body_slope(Fleet(), LEVEL, rotors)
    two_rho_a = 2.0 * 1.225 * pi * 0.15**2
    per_speed = sqrt(PAPER.thrust_coefficient_n_s2 / two_rho_a)
    w_4 = PAPER.arm_m * 0.133 * two_rho_a * per_speed * (190.0 - 170.0) * 3.0 / PAPER.inertia_kg_m2[0]
    assert windy[10] - calm[10] == pytest.approx(w_4, rel=1e-9)

    rotors = (190.0, 170.0, 190.0, 170.0)
    windy = body_slope(fleet, LEVEL, rotors)
    calm = body_slope(Fleet(), LEVEL, rotors)
    k_drag = PAPER.drag_coefficient_n_m_s2 / per_speed**2
    v_w = 0.133 * 3.0
    m_w = [k_drag * ((per_speed * o + v_w) ** 2 - (per_speed * o) ** 2) for o in rotors]
    w_6 = (m_w[0] - m_w[1] + m_w[2] - m_w[3]) / PAPER.inertia_kg_m2[2]
    assert windy[12] - calm[12] == pytest.approx(w_6, rel=1e-9)


def test_eq_11_is_the_small_angle_form() -> None:
    """Eq 11 takes (p, q, r) for the Euler rates: at angles and rates of size s the two differ by s^2 and no more."""
    a = PAPER
    rng = np.random.default_rng(3)
    rotors = HOVER_RAD_S * (1.0 + 0.1 * rng.standard_normal(4))
    o_1, o_2, o_3, o_4 = rotors
    u = [
        a.thrust_coefficient_n_s2 * float(rotors @ rotors),
        a.thrust_coefficient_n_s2 * (o_4**2 - o_2**2),
        a.thrust_coefficient_n_s2 * (o_1**2 - o_3**2),
        a.drag_coefficient_n_m_s2 * (o_1**2 - o_2**2 + o_3**2 - o_4**2),
    ]
    omega_r = -o_1 + o_2 - o_3 + o_4
    i_x, i_y, i_z = a.inertia_kg_m2
    direction = np.array([0.7, -0.5, 0.4, 0.6, 0.8, -0.9])
    fleet = Fleet()
    gaps = []
    for size in (0.1, 0.05):
        phi, theta, psi, p, q, r = size * direction
        c, s = np.cos, np.sin
        eq_11 = np.array(
            [
                u[0] * (c(phi) * s(theta) * c(psi) + s(phi) * s(psi)) / a.mass_kg,
                u[0] * (c(phi) * s(theta) * s(psi) - s(phi) * c(psi)) / a.mass_kg,
                u[0] * c(phi) * c(theta) / a.mass_kg - a.gravity_m_s2,
                q * r * (i_y - i_z) / i_x - q * omega_r * a.rotor_inertia_kg_m2 / i_x + u[1] * a.arm_m / i_x,
                p * r * (i_z - i_x) / i_y + p * omega_r * a.rotor_inertia_kg_m2 / i_y + u[2] * a.arm_m / i_y,
                p * q * (i_x - i_y) / i_z + u[3] / i_z,
            ]
        )
        half = np.array([phi, theta, psi]) / 2.0
        (cx, cy, cz), (sx, sy, sz) = np.cos(half), np.sin(half)
        quaternion = (
            cx * cy * cz + sx * sy * sz,
            sx * cy * cz - cx * sy * sz,
            cx * sy * cz + sx * cy * sz,
            cx * cy * sz - sx * sy * cz,
        )
        # Euler rates to body rates: the only place where the full body and eq 11 differ.
        body_rates = np.array(
            [p - s(theta) * r, c(phi) * q + s(phi) * c(theta) * r, -s(phi) * q + c(phi) * c(theta) * r]
        )
        d = body_slope(fleet, (*LEVEL[:6], *quaternion, *body_rates), rotors)
        np.testing.assert_allclose(d[3:6], eq_11[:3], atol=1e-12)
        exact = body_slope(fleet, (*LEVEL[:6], *quaternion, p, q, r), rotors)
        np.testing.assert_allclose(exact[10:], eq_11[3:], atol=1e-11)
        gaps.append(float(np.abs(d[10:] - eq_11[3:]).max()))
    assert gaps[0] < 0.1
    assert 3.0 < gaps[0] / gaps[1] < 10.0


def test_rotor_lag_is_exact_and_ideal_rotors_follow_at_once() -> None:
    lagging = Fleet(REALISTIC)
    lagging.command[:] = 100.0
    lagging.run(0.03, 1.0e-3)
    np.testing.assert_allclose(lagging.x[13:], 100.0 + (HOVER_RAD_S - 100.0) * exp(-1.0), rtol=1e-12)
    ideal = Fleet()
    ideal.command[:] = 100.0
    ideal.run(1.0e-3)
    np.testing.assert_array_equal(ideal.x[13:], 100.0)
    thrust = 4.0 * PAPER.thrust_coefficient_n_s2 * 100.0**2
    assert ideal.x[5, 0] == pytest.approx(1.0e-3 * (thrust / PAPER.mass_kg - PAPER.gravity_m_s2), rel=1e-12)


@given(st.floats(0.0, 1.0))
def test_decay_is_exp(ratio: float) -> None:
    half, full = decay(ratio)
    assert half == pytest.approx(exp(-ratio / 2.0), rel=1e-10)
    assert full == pytest.approx(exp(-ratio), rel=1e-10)


def test_decay_beyond_the_time_constant_stays_a_decay() -> None:
    values = [decay(ratio)[1] for ratio in (1.0, 3.0, 10.0, 100.0, 1.0e6, float("inf"))]
    assert all(later < earlier for earlier, later in pairwise(values))
    assert values[-1] == 0.0


def test_commands_are_clipped() -> None:
    fleet = Fleet(n=2)
    fleet.command[:, 0] = 1.0e4
    fleet.command[:, 1] = -5.0
    fleet.run(1.0e-3)
    np.testing.assert_array_equal(fleet.x[13:, 0], PAPER.max_rotor_speed_rad_s)
    np.testing.assert_array_equal(fleet.x[13:, 1], 0.0)


def test_held_keeps_the_pose_while_rotors_follow() -> None:
    fleet = Fleet(REALISTIC, rotor_speed_rad_s=0.0, n=2)
    fleet.held[0] = True
    fleet.x[3:6] = 1.0
    pose = fleet.x[[0, 1, 2, 6, 7, 8, 9], 0].copy()
    fleet.wind[:] = 4.0
    fleet.command[:] = 150.0
    fleet.run(0.2)
    np.testing.assert_array_equal(fleet.x[[0, 1, 2, 6, 7, 8, 9], 0], pose)
    np.testing.assert_array_equal(fleet.x[3:6, 0], 0.0)
    np.testing.assert_array_equal(fleet.x[13:, 0], fleet.x[13:, 1])
    assert fleet.x[13, 0] == pytest.approx(150.0, rel=0.01)
    np.testing.assert_array_equal(fleet.acceleration()[:, 0], 0.0)
    assert np.abs(fleet.acceleration()[:, 1]).max() > 0.1


def test_off_nominal_mass_inertia_and_one_weak_rotor() -> None:
    heavy = Fleet(offnominal=Offnominal(mass_scale=1.25))
    assert heavy.acceleration()[2, 0] == pytest.approx(-0.2 * PAPER.gravity_m_s2)
    weak = Fleet(offnominal=Offnominal(inertia_scale=2.0, rotor_thrust_scale=(1.0, 0.8, 1.0, 1.0)))
    d = body_slope(weak, LEVEL, (HOVER_RAD_S,) * 4)
    assert d[5] == pytest.approx(-0.05 * PAPER.gravity_m_s2)
    assert d[10] == pytest.approx(PAPER.arm_m * 0.2 * PAPER.weight_n / 4.0 / (2.0 * PAPER.inertia_kg_m2[0]))
    assert d[12] == pytest.approx(0.0, abs=1e-12)


def command_of(fractions: list[float]) -> Array:
    return PAPER.max_rotor_speed_rad_s * np.array(fractions)


fractions = st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4)
rates = st.lists(st.floats(-5.0, 5.0), min_size=3, max_size=3)


@settings(max_examples=40, deadline=None)
@given(fractions, rates, rates)
def test_the_quaternion_stays_of_unit_norm(rotors: list[float], omega: list[float], wind: list[float]) -> None:
    fleet = Fleet(ground=True, height_m=0.5)
    fleet.command[:, 0] = command_of(rotors)
    fleet.x[10:13, 0] = omega
    fleet.wind[:, 0] = wind
    for _ in range(50):
        fleet.run(5.0e-3)
        assert abs(float(fleet.x[6:10, 0] @ fleet.x[6:10, 0]) - 1.0) < 1.0e-15


@settings(max_examples=40, deadline=None)
@given(fractions, rates, rates, st.booleans())
def test_left_and_right_are_mirror_images(
    rotors: list[float], omega: list[float], wind: list[float], ground: bool
) -> None:
    """In the mirror y -> -y rotors 2 and 4 change places; drag and spin are turned off, which have a handedness."""
    fleet = Fleet(ground=ground, height_m=0.02 if ground else 100.0, n=2)
    fleet.parameters[[6, 15, 18]] = 0.0
    fleet.command[:, 0] = command_of(rotors)
    fleet.command[:, 1] = fleet.command[[0, 3, 2, 1], 0]
    fleet.x[10:13] = np.array([omega, [-omega[0], omega[1], -omega[2]]]).T
    fleet.wind[:] = np.array([wind, [wind[0], -wind[1], wind[2]]]).T
    fleet.run(0.1)
    mirror = np.array([1, -1, 1, 1, -1, 1, 1, -1, 1, -1, -1, 1, -1])
    np.testing.assert_allclose(mirror * fleet.x[:13, 0], fleet.x[:13, 1], rtol=1e-9, atol=1e-10)
