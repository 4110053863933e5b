"""The filter's equations: its Jacobians against differences, its update against the textbook, its covariance sane."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest
from mavsitl_vehicle.sensors import ekf
from numpy.typing import NDArray

from mavsitl.quaternion import conjugate, multiply, normalise

Array = NDArray[np.float64]

DT_S = 0.004
GRAVITY = 9.81
FIELD = np.array([0.2, 0.03, -0.44])
STEP = 1e-6


def state(seed: int) -> Array:
    """(STATE_ROWS, 1) somewhere, at some attitude."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((ekf.STATE_ROWS, 1))
    x[ekf.QUATERNION : ekf.QUATERNION + 4, 0] = normalise(tuple(rng.standard_normal(4).tolist()))
    x[ekf.GYRO_BIAS :] *= 0.1
    return x


def moved(x: Array, row: int, by: float) -> Array:
    """`x` with the error `by` in error row `row`: x_true of x."""
    y = x.copy()
    if ekf.E_ATTITUDE <= row < ekf.E_GYRO_BIAS:
        axis = [0.0, 0.0, 0.0]
        axis[row - ekf.E_ATTITUDE] = 0.5 * by
        turn = normalise((1.0, axis[0], axis[1], axis[2]))
        q = multiply(turn, tuple(x[ekf.QUATERNION : ekf.QUATERNION + 4, 0].tolist()))
        y[ekf.QUATERNION : ekf.QUATERNION + 4, 0] = q
    else:
        y[row if row < ekf.E_ATTITUDE else row + 1, 0] += by
    return y


def difference(true: Array, x: Array) -> Array:
    """(ERROR_ROWS,) the error of `x`."""
    q = multiply(
        tuple(true[ekf.QUATERNION : ekf.QUATERNION + 4, 0].tolist()),
        conjugate(tuple(x[ekf.QUATERNION : ekf.QUATERNION + 4, 0].tolist())),
    )
    turned = 2.0 * np.array(q[1:]) * (1.0 if q[0] >= 0.0 else -1.0)
    error: Array = np.concatenate((true[:6, 0] - x[:6, 0], turned, true[10:, 0] - x[10:, 0]))
    return error


def covariance(seed: int) -> Array:
    """(ERROR_ROWS, ERROR_ROWS, 1) positive definite, of very different sizes."""
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-3.0, 1.0, ekf.ERROR_ROWS)
    root = rng.standard_normal((ekf.ERROR_ROWS, ekf.ERROR_ROWS)) * scale[:, None]
    p: Array = np.ascontiguousarray((root @ root.T)[:, :, None])
    return p


@pytest.mark.parametrize("seed", range(5))
def test_the_transition_is_the_derivative_of_the_strapdown(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    x = state(seed)
    angle, velocity = 0.01 * rng.standard_normal((3, 1)), 0.05 * rng.standard_normal((3, 1))
    decay = 0.999
    r = ekf.rotation(x, 0)
    force = velocity[:, 0] - DT_S * x[ekf.ACCEL_BIAS : ekf.ACCEL_BIAS + 3, 0]
    push = tuple((np.array(r).reshape(3, 3) @ force).tolist())
    f = np.ascontiguousarray(np.eye(ekf.ERROR_ROWS)[:, :, None])
    ekf.apply_transition(r, push, DT_S, decay, f, 0)

    def after(y: Array) -> Array:
        y = y.copy()
        ekf.strapdown(y, angle, velocity, DT_S, GRAVITY, 0)
        y[ekf.GPS_OFFSET : ekf.GPS_OFFSET + 3] *= decay
        return y

    base = after(x)
    for row in range(ekf.ERROR_ROWS):
        plus, minus = after(moved(x, row, STEP)), after(moved(x, row, -STEP))
        column = (difference(plus, base) - difference(minus, base)) / (2.0 * STEP)
        assert column == pytest.approx(f[:, row, 0], abs=2e-4), row  # what the turn within an interval adds is left out


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("axis", range(3))
def test_the_magnetometers_row_is_the_derivative_of_what_it_expects(seed: int, axis: int) -> None:
    x, h, unused = state(seed), np.zeros(ekf.ERROR_ROWS), np.zeros(ekf.ERROR_ROWS)
    ekf.magnetometer_row(x, FIELD, axis, h, 0)
    for row in range(ekf.ERROR_ROWS):
        plus = ekf.magnetometer_row(moved(x, row, STEP), FIELD, axis, unused, 0)
        minus = ekf.magnetometer_row(moved(x, row, -STEP), FIELD, axis, unused, 0)
        assert (plus - minus) / (2.0 * STEP) == pytest.approx(h[row], abs=1e-8), row


@pytest.mark.parametrize("seed", range(5))
def test_an_update_is_the_textbooks(seed: int) -> None:
    rng = np.random.default_rng(200 + seed)
    x, p = state(seed), covariance(seed)
    h = rng.standard_normal(ekf.ERROR_ROWS) * (rng.random(ekf.ERROR_ROWS) < 0.3)
    variance, innovation = 0.3, 1e-3
    prior = p[:, :, 0].copy()
    gain = prior @ h / (h @ prior @ h + variance)
    left = np.eye(ekf.ERROR_ROWS) - np.outer(gain, h)
    wanted = left @ prior @ left.T + variance * np.outer(gain, gain)
    y = x.copy()
    ekf.fuse(y, p, h, innovation, variance, 0)
    assert p[:, :, 0] == pytest.approx(wanted, rel=1e-7, abs=1e-9 * float(np.abs(prior).max()))
    assert difference(y, x) == pytest.approx(gain * innovation, rel=1e-4, abs=1e-9)


def test_the_covariance_stays_symmetric_to_the_bit_and_positive() -> None:
    x, p = state(3), covariance(3)
    rng = np.random.default_rng(3)
    process = np.array([1e-4, 1e-3, 1e-5, 1e-4, 1e-2, 1.0, 2.0, 100.0])
    h, test = np.zeros(ekf.ERROR_ROWS), np.zeros(1)
    for step in range(2000):
        angle, velocity = 0.01 * rng.standard_normal((3, 1)), 0.05 * rng.standard_normal((3, 1))
        ekf.predict(x, p, angle, velocity, DT_S, GRAVITY, process, 0)
        if step % 5 == 0:
            for axis in range(3):
                expected = ekf.magnetometer_row(x, FIELD, axis, h, 0)
                ekf.fuse(x, p, h, 1e-3 * rng.standard_normal(), 1e-6, 0)
                assert np.isfinite(expected)
        if step % 25 == 0:
            z = x[:3] + 0.1 * rng.standard_normal((3, 1))
            ekf.fuse_direct(x, p, ekf.E_POSITION, ekf.E_GPS_OFFSET, 3, z, np.full(3, 1e-8), 0.0, test)
        assert (p[:, :, 0] == p[:, :, 0].T).all()
    scale = 1.0 / np.sqrt(np.diagonal(p[:, :, 0]))
    assert np.linalg.eigvalsh(p[:, :, 0] * np.outer(scale, scale)).min() > 0.0
    assert np.linalg.norm(x[ekf.QUATERNION : ekf.QUATERNION + 4]) == pytest.approx(1.0, abs=1e-12)


def test_a_measurement_beyond_its_gate_changes_nothing() -> None:
    x, p = state(4), covariance(4)
    before, prior = x.copy(), p.copy()
    variance, test = np.full(3, 0.01), np.zeros(1)
    sigma = sqrt(prior[ekf.E_VELOCITY, ekf.E_VELOCITY, 0] + 0.01)
    z = x[ekf.VELOCITY : ekf.VELOCITY + 3].copy()
    z[0] += 5.5 * sigma
    ekf.fuse_direct(x, p, ekf.E_VELOCITY, -1, 3, z, variance, 5.0, test)
    assert test[0] == pytest.approx(1.1)
    assert (x == before).all()
    assert (p == prior).all()
    z[0] -= sigma
    ekf.fuse_direct(x, p, ekf.E_VELOCITY, -1, 3, z, variance, 5.0, test)
    assert test[0] == pytest.approx(0.9)
    assert x[ekf.VELOCITY, 0] > before[ekf.VELOCITY, 0]


def test_the_present_is_the_filters_time_taken_on_by_what_it_has_not_seen() -> None:
    """Delayed fusion: with a ring of d intervals, prediction and presentation are the strapdown over all of them."""
    rng = np.random.default_rng(5)
    deltas = [np.vstack((0.01 * rng.standard_normal((3, 1)), 0.05 * rng.standard_normal((3, 1)))) for _ in range(40)]
    start = state(5)
    p, process = covariance(5), np.array([1e-4, 1e-3, 1e-5, 1e-4, 1e-2, 1.0, 2.0, 1e12])
    straight = start.copy()
    for delta in deltas:
        ekf.strapdown(straight, delta[:3], delta[3:], DT_S, GRAVITY, 0)
    for depth in (0, 1, 25):
        x, ring, head = start.copy(), np.zeros((depth, 6, 1)), 0
        for i, delta in enumerate(deltas):
            ekf.advance(x, p, ring, head, delta, i >= depth, DT_S, GRAVITY, process, np.zeros((6, 1)))
            head = (head + 1) % depth if depth else 0
        estimate = np.zeros((13, 1))
        ekf.present(x, ring, head, np.zeros((3, 1)), DT_S, GRAVITY, np.zeros_like(x), estimate)
        assert estimate[:10] == pytest.approx(straight[:10], abs=1e-12), depth
