"""The attitude error against scipy's rotations, built another way: by axis and angle."""

from __future__ import annotations

from math import asin, sqrt

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot.attitude import attitude_error
from scipy.spatial.transform import Rotation

component = st.floats(-1.0, 1.0)
quaternions = st.tuples(component, component, component, component).filter(lambda q: sum(c * c for c in q) > 0.01)


def unit(q: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = sqrt(sum(c * c for c in q))
    return q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm


@settings(max_examples=300)
@given(quaternions, quaternions, st.floats(0.0, 1.0))
def test_attitude_error(
    attitude: tuple[float, float, float, float], setpoint: tuple[float, float, float, float], weight: float
) -> None:
    q, d = unit(attitude), unit(setpoint)
    error = Rotation.from_quat(q, scalar_first=True).inv() * Rotation.from_quat(d, scalar_first=True)
    thrust_axis = error.apply([0.0, 0.0, 1.0])
    angle = np.arccos(np.clip(thrust_axis[2], -1.0, 1.0))
    assume(angle < 3.1)  # upside down the shortest turn has no one axis
    axis = np.cross([0.0, 0.0, 1.0], thrust_axis)
    sine = np.linalg.norm(axis)
    tilt = Rotation.from_rotvec(axis / sine * angle if sine > 1e-9 else np.zeros(3))
    yaw = (tilt.inv() * error).as_rotvec()
    assert abs(yaw[0]) + abs(yaw[1]) < 1e-5
    assume(abs(yaw[2]) < 3.1)  # half a turn goes either way
    whole = tilt * Rotation.from_rotvec([0.0, 0.0, 2.0 * asin(weight * np.sin(yaw[2] / 2.0))])
    w, x, y, z = whole.as_quat(canonical=True, scalar_first=True)
    assume(w > 1e-6)
    np.testing.assert_allclose(attitude_error(*q, *d, weight), (2.0 * x, 2.0 * y, 2.0 * z), atol=2e-6)


@given(quaternions, quaternions)
def test_a_quaternion_and_its_negative_are_one_attitude(
    attitude: tuple[float, float, float, float], setpoint: tuple[float, float, float, float]
) -> None:
    q, d = unit(attitude), unit(setpoint)
    error = Rotation.from_quat(q, scalar_first=True).inv() * Rotation.from_quat(d, scalar_first=True)
    assume(error.magnitude() < 3.1)
    assume(error.apply([0.0, 0.0, 1.0])[2] > -0.999)
    turned = attitude_error(*q, -d[0], -d[1], -d[2], -d[3], 1.0)
    np.testing.assert_allclose(turned, attitude_error(*q, *d, 1.0), atol=1e-9)


def test_upside_down_is_finite() -> None:
    assert attitude_error(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.4) == (2.0, 0.0, 0.0)


def test_yaw_counts_less_than_tilt() -> None:
    half = 0.1
    c, s = float(np.cos(half)), float(np.sin(half))
    assert attitude_error(1.0, 0.0, 0.0, 0.0, c, s, 0.0, 0.0, 0.4)[0] == 2.0 * s
    assert abs(attitude_error(1.0, 0.0, 0.0, 0.0, c, 0.0, 0.0, s, 0.4)[2] - 0.8 * s) < 1e-12
