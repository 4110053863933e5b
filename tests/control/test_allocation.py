"""Eq 12, its inverse and the limits; eq 11's I / l."""

from __future__ import annotations

from math import inf, isfinite, nan

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mavsitl.control.allocation import (
    NOT_A_NUMBER,
    SATURATED_PITCH,
    SATURATED_ROLL,
    SATURATED_THRUST,
    SATURATED_YAW,
    allocate,
    wrench,
)
from mavsitl.control.mix import Mix
from mavsitl.scenario import load_airframe

AIRFRAME = load_airframe("paper")
B = AIRFRAME.thrust_coefficient_n_s2
D = AIRFRAME.drag_coefficient_n_m_s2
ARM = AIRFRAME.arm_m
TOP = AIRFRAME.max_rotor_speed_rad_s
PAIR_N = B * TOP * TOP
"""One rotor's greatest thrust."""


def test_eq_12_by_hand() -> None:
    u1, x, y, z = wrench(100.0, 110.0, 120.0, 130.0, B, D, ARM)
    assert u1 == pytest.approx(B * (10_000 + 12_100 + 14_400 + 16_900))
    assert x == pytest.approx(ARM * B * (16_900 - 12_100))
    assert y == pytest.approx(ARM * B * (10_000 - 14_400))
    assert z == pytest.approx(D * (10_000 - 12_100 + 14_400 - 16_900))


def test_hover_needs_four_equal_rotors() -> None:
    *speeds, bits = allocate(AIRFRAME.weight_n, 0.0, 0.0, 0.0, B, D, ARM, TOP)
    assert speeds == pytest.approx([AIRFRAME.hover_rotor_speed_rad_s] * 4)
    assert bits == 0


@given(st.tuples(*[st.floats(0.01 * TOP, 0.999 * TOP)] * 4))
@settings(deadline=None)
def test_the_inverse_is_exact_within_the_limits(speeds: tuple[float, float, float, float]) -> None:
    *found, bits = allocate(*wrench(*speeds, B, D, ARM), B, D, ARM, TOP)
    assert bits == 0
    assert found == pytest.approx(speeds, rel=1e-8)


DEMAND = st.tuples(st.floats(-40.0, 40.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-0.5, 0.5))


@given(DEMAND)
@example((0.0, 0.0, 0.0, 0.0))
@example((7.0, 0.3, -0.3, 0.2))
@example((1.0, 0.5, 0.5, -0.4))
@settings(deadline=None, max_examples=300)
def test_priorities(demand: tuple[float, float, float, float]) -> None:
    """Roll and pitch are cut by their own limit alone, thrust moves no further than they need, yaw takes the rest."""
    u1, x, y, z = demand
    *speeds, bits = allocate(u1, x, y, z, B, D, ARM, TOP)
    assert all(0.0 <= speed <= TOP for speed in speeds)
    got_u1, got_x, got_y, got_z = wrench(speeds[0], speeds[1], speeds[2], speeds[3], B, D, ARM)
    reach = ARM * PAIR_N
    assert got_x == pytest.approx(min(max(x, -reach), reach), abs=1e-9)
    assert got_y == pytest.approx(min(max(y, -reach), reach), abs=1e-9)
    assert bool(bits & SATURATED_ROLL) == (abs(x) > reach)
    assert bool(bits & SATURATED_PITCH) == (abs(y) > reach)
    least = (abs(got_x) + abs(got_y)) / ARM
    assert got_u1 == pytest.approx(min(max(u1, least), 4.0 * PAIR_N - least), abs=1e-8)
    if bits & SATURATED_YAW:
        assert abs(got_z) <= abs(z) + 1e-9 or z == pytest.approx(0.0, abs=abs(got_z))
        # No more is to be had: a rotor of the pair that would speed up is at its top, or one that would slow at 0.
        faster, slower = ((0, 2), (1, 3)) if z > got_z else ((1, 3), (0, 2))
        assert any(speeds[i] > TOP - 1e-6 for i in faster) or any(speeds[i] < 1e-3 for i in slower)
    else:
        assert got_z == pytest.approx(z, abs=1e-9)


def test_the_thrust_shifts_to_keep_roll() -> None:
    *speeds, bits = allocate(0.0, 0.2, 0.0, 0.0, B, D, ARM, TOP)
    u1, x, _, _ = wrench(speeds[0], speeds[1], speeds[2], speeds[3], B, D, ARM)
    assert x == pytest.approx(0.2)
    assert u1 == pytest.approx(0.2 / ARM)
    assert bits & SATURATED_THRUST


def test_yaw_gives_way_to_thrust() -> None:
    *speeds, bits = allocate(4.0 * PAIR_N, 0.0, 0.0, 0.1, B, D, ARM, TOP)
    assert speeds == pytest.approx([TOP] * 4)
    assert bits == SATURATED_YAW


ANY = st.floats(allow_nan=True, allow_infinity=True)


@given(ANY, ANY, ANY, ANY)
@example(nan, nan, nan, nan)
@example(inf, -inf, inf, -inf)
@settings(deadline=None, max_examples=200)
def test_anything_gives_speeds_within_the_limits(u1: float, x: float, y: float, z: float) -> None:
    *speeds, bits = allocate(u1, x, y, z, B, D, ARM, TOP)
    assert all(isfinite(speed) and 0.0 <= speed <= TOP for speed in speeds)
    assert bool(bits & NOT_A_NUMBER) == any(value != value for value in (u1, x, y, z))


def test_mix_is_i_over_l_but_not_for_yaw() -> None:
    mix = Mix(AIRFRAME.inertia_kg_m2, ARM, n=2)
    torque = mix.update(np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]))
    i_x, i_y, i_z = AIRFRAME.inertia_kg_m2
    assert torque == pytest.approx(np.array([[i_x, 2 * i_x], [3 * i_y, 4 * i_y], [5 * i_z, 6 * i_z]]))
    assert mix.u[0] == pytest.approx(torque[0] / ARM)
    assert mix.u[1] == pytest.approx(torque[1] / ARM)
    assert (mix.u[2] == torque[2]).all()
    with pytest.raises(ValueError, match="shape"):
        mix.update(np.zeros((3, 1)))
