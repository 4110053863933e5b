"""The frame boundary, by four attitudes that a person can check by hand, and by properties.

Hold a hand out flat, fingers north, palm down: the body's forward is north, left is west, up is up. Each case turns it
once.
"""

from __future__ import annotations

from math import inf, isclose, pi, sqrt

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl import frames, quaternion
from mavsitl.frames import Quaternion, Vector

HALF = sqrt(0.5)

# Name; FLU to NWU; FRD to NED; roll, pitch, yaw on the wire; the nose's direction in NED; the thrust's in NWU.
BY_HAND: list[tuple[str, Quaternion, Quaternion, Vector, Vector, Vector]] = [
    (
        "level, nose north",
        (1.0, 0.0, 0.0, 0.0),
        (1.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0),
        (1.0, 0.0, 0.0),
        (0.0, 0.0, 1.0),
    ),
    (
        # Compass heading 90 degrees is +90 degrees of NED yaw (down axis) and -90 degrees about the up axis.
        "level, nose east",
        (HALF, 0.0, 0.0, -HALF),
        (HALF, 0.0, 0.0, HALF),
        (0.0, 0.0, pi / 2),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
    ),
    (
        # Pitched up by 90 degrees: positive pitch in FRD, negative in FLU. The nose is up, so NED's third component is
        # -1, and the thrust points south.
        "nose straight up",
        (HALF, 0.0, -HALF, 0.0),
        (HALF, 0.0, HALF, 0.0),
        (0.0, pi / 2, 0.0),
        (0.0, 0.0, -1.0),
        (-1.0, 0.0, 0.0),
    ),
    (
        # Right wing down by 90 degrees: positive roll in both pairs of frames. The thrust points east, NWU's -y.
        "on its right side",
        (HALF, HALF, 0.0, 0.0),
        (HALF, HALF, 0.0, 0.0),
        (pi / 2, 0.0, 0.0),
        (1.0, 0.0, 0.0),
        (0.0, -1.0, 0.0),
    ),
]

numbers = st.floats(allow_nan=False, allow_infinity=False)
vectors = st.tuples(numbers, numbers, numbers)
components = st.floats(-1.0, 1.0)
units = (
    st.tuples(components, components, components, components)
    .filter(lambda q: sum(c * c for c in q) > 1e-6)
    .map(quaternion.normalise)
)
small_vectors = st.tuples(*[st.floats(-100.0, 100.0)] * 3)


@pytest.mark.parametrize(
    ("flu_nwu", "frd_ned", "euler_ned", "nose_ned", "up_nwu"), [c[1:] for c in BY_HAND], ids=[c[0] for c in BY_HAND]
)
def test_attitudes_checked_by_hand(
    flu_nwu: Quaternion, frd_ned: Quaternion, euler_ned: Vector, nose_ned: Vector, up_nwu: Vector
) -> None:
    assert frames.flip_quaternion(*flu_nwu) == frd_ned
    assert quaternion.to_euler(frd_ned) == pytest.approx(euler_ned, abs=1e-15)
    assert quaternion.rotate(frd_ned, (1.0, 0.0, 0.0)) == pytest.approx(nose_ned, abs=1e-15)
    assert quaternion.up_vector(flu_nwu) == pytest.approx(up_nwu, abs=1e-15)


def test_a_climb_to_the_north_west_is_negative_east_and_negative_down_on_the_wire() -> None:
    assert frames.flip_vector(1.0, 2.0, 3.0) == (1.0, -2.0, -3.0)


@given(vectors)
def test_vectors_and_euler_angles_come_back_bit_for_bit(vector: Vector) -> None:
    assert frames.flip_vector(*frames.flip_vector(*vector)) == vector
    assert frames.flip_euler(*frames.flip_euler(*vector)) == vector


@given(st.tuples(numbers, numbers, numbers, numbers))
def test_quaternions_come_back_bit_for_bit(q: Quaternion) -> None:
    assert frames.flip_quaternion(*frames.flip_quaternion(*q)) == q


@given(units, small_vectors)
def test_turning_and_crossing_the_boundary_commute(q: Quaternion, body: Vector) -> None:
    inside = frames.flip_vector(*quaternion.rotate(q, body))
    outside = quaternion.rotate(frames.flip_quaternion(*q), frames.flip_vector(*body))
    assert outside == inside


@given(units, units)
def test_products_cross_the_boundary(left: Quaternion, right: Quaternion) -> None:
    inside = frames.flip_quaternion(*quaternion.multiply(left, right))
    assert quaternion.multiply(frames.flip_quaternion(*left), frames.flip_quaternion(*right)) == inside


@given(st.floats(-pi, pi), st.floats(-pi / 2, pi / 2), st.floats(-pi, pi))
def test_euler_angles_cross_the_boundary_as_their_quaternion_does(roll: float, pitch: float, yaw: float) -> None:
    flipped = frames.flip_quaternion(*quaternion.from_euler(roll, pitch, yaw))
    assert quaternion.from_euler(*frames.flip_euler(roll, pitch, yaw)) == flipped


def test_infinity_keeps_its_size_across_the_boundary() -> None:
    assert frames.flip_vector(inf, inf, -inf) == (inf, -inf, inf)
    assert isclose(frames.flip_vector(0.0, 5e-324, 0.0)[1], -5e-324)
