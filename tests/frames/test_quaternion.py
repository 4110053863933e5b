"""Quaternion helpers against scipy's rotations, and their own laws."""

from __future__ import annotations

from math import inf, nan, pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mavsitl import quaternion
from mavsitl.frames import Quaternion, Vector
from tests.frames.test_frames import small_vectors, units

angles = st.floats(-pi, pi)
pitches = st.floats(-pi / 2, pi / 2)


def rotation(q: Quaternion) -> Rotation:
    return Rotation.from_quat(q, scalar_first=True)


def angle_between(a: Quaternion, b: Quaternion) -> float:
    """The rotation angle from a to b; q and -q are the same attitude."""
    return float((rotation(a).inv() * rotation(b)).magnitude())


@given(units, small_vectors)
def test_rotate_agrees_with_scipy_both_ways(q: Quaternion, vector: Vector) -> None:
    assert quaternion.rotate(q, vector) == pytest.approx(rotation(q).apply(vector), abs=1e-12)
    back = quaternion.rotate(quaternion.conjugate(q), vector)
    assert back == pytest.approx(rotation(q).inv().apply(vector), abs=1e-12)


@given(units, units)
def test_multiply_agrees_with_scipy(left: Quaternion, right: Quaternion) -> None:
    assert (
        angle_between(
            quaternion.multiply(left, right), tuple((rotation(left) * rotation(right)).as_quat(scalar_first=True))
        )
        < 1e-7
    )
    np.testing.assert_allclose(
        rotation(quaternion.multiply(left, right)).as_matrix(),
        (rotation(left) * rotation(right)).as_matrix(),
        atol=1e-13,
    )


def test_multiply_is_hamiltons() -> None:
    i, j, k = (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    assert quaternion.multiply(i, j) == k
    assert quaternion.multiply(j, i) == quaternion.conjugate(k)
    assert quaternion.multiply(k, k) == (-1.0, 0.0, 0.0, 0.0)


@given(units, units, small_vectors)
def test_a_product_turns_as_its_factors_in_turn(left: Quaternion, right: Quaternion, vector: Vector) -> None:
    once = quaternion.rotate(quaternion.multiply(left, right), vector)
    assert once == pytest.approx(quaternion.rotate(left, quaternion.rotate(right, vector)), abs=1e-12)


@given(units)
def test_conjugate_is_the_inverse(q: Quaternion) -> None:
    assert quaternion.multiply(q, quaternion.conjugate(q)) == pytest.approx(quaternion.IDENTITY, abs=1e-15)


@given(units)
def test_up_vector_is_the_turned_z_axis(q: Quaternion) -> None:
    assert quaternion.up_vector(q) == pytest.approx(quaternion.rotate(q, (0.0, 0.0, 1.0)), abs=1e-15)


@given(angles, pitches, angles)
def test_from_euler_agrees_with_scipy(roll: float, pitch: float, yaw: float) -> None:
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    np.testing.assert_allclose(rotation(quaternion.from_euler(roll, pitch, yaw)).as_matrix(), expected, atol=1e-14)


@given(angles)
def test_from_yaw_is_from_euler_at_level(yaw: float) -> None:
    assert quaternion.from_yaw(yaw) == pytest.approx(quaternion.from_euler(0.0, 0.0, yaw), abs=1e-16)


@given(angles, st.floats(-1.55, 1.55), angles)
def test_euler_angles_come_back(roll: float, pitch: float, yaw: float) -> None:
    back = quaternion.to_euler(quaternion.from_euler(roll, pitch, yaw))
    # At the seam, -pi and pi are the same angle.
    assert np.remainder(np.subtract(back, (roll, pitch, yaw)) + pi, 2 * pi) == pytest.approx([pi] * 3, abs=1e-12)


@given(angles, st.sampled_from([-pi / 2, pi / 2]), angles)
def test_nose_straight_up_or_down_still_gives_the_same_attitude(roll: float, pitch: float, yaw: float) -> None:
    q = quaternion.from_euler(roll, pitch, yaw)
    angles_back = quaternion.to_euler(q)
    assert angles_back[0] == 0.0
    assert abs(angles_back[2]) <= pi
    assert angle_between(q, quaternion.from_euler(*angles_back)) < 1e-7


@given(units)
def test_every_attitude_survives_its_euler_angles(q: Quaternion) -> None:
    roll, pitch, yaw = quaternion.to_euler(q)
    assert abs(roll) <= pi
    assert abs(pitch) <= pi / 2
    assert abs(yaw) <= pi
    assert angle_between(q, quaternion.from_euler(roll, pitch, yaw)) < 1e-7


@given(units, st.floats(1e-150, 1e150))
def test_normalise_takes_any_finite_norm(q: Quaternion, scale: float) -> None:
    w, x, y, z = q
    assert quaternion.normalise((w * scale, x * scale, y * scale, z * scale)) == pytest.approx(q, abs=1e-15)


@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0, 0.0), (nan, 0.0, 0.0, 1.0), (inf, 0.0, 0.0, 1.0), (1.0, -inf, 0.0, nan)])
def test_normalise_refuses_what_has_no_direction(q: Quaternion) -> None:
    with pytest.raises(ValueError, match="has no direction"):
        quaternion.normalise(q)
