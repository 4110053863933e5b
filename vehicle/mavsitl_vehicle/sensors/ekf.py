"""An error-state extended Kalman filter: inertial navigation corrected by GPS, barometer and magnetometer.

The nominal state is integrated from the IMU; the filter knows the covariance of its error (22 rows). The attitude's
error is a small rotation in world axes, R_true = exp([e]x) R, so that its own transition is the identity. Every
measurement is fused component by component, in Joseph's form. The equations are in docs/explanation/estimator.md.

Functions that take `j` work on one vehicle's column; the fleet's axis is the last.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from mavsitl.compiled import compiled
from mavsitl_vehicle.autopilot.attitude import quaternion_product

Array = NDArray[np.float64]
Rotation = tuple[float, float, float, float, float, float, float, float, float]

# Rows of the nominal state (STATE_ROWS, n), world NWU and body FLU.
POSITION = 0  # 0:3, m
VELOCITY = 3  # 3:6, m/s
QUATERNION = 6  # 6:10, FLU -> NWU
GYRO_BIAS = 10  # 10:13, rad/s
ACCEL_BIAS = 13  # 13:16, m/s^2
GPS_OFFSET = 16  # 16:19, m, the receiver's slow error
BARO_OFFSET = 19  # m
MAG_OFFSET = 20  # 20:23, gauss, body
STATE_ROWS = 23

# Rows of its error, and of the covariance (ERROR_ROWS, ERROR_ROWS, n).
E_POSITION = 0
E_VELOCITY = 3
E_ATTITUDE = 6  # 6:9, rad about the world's axes
E_GYRO_BIAS = 9
E_ACCEL_BIAS = 12
E_GPS_OFFSET = 15
E_BARO_OFFSET = 18
E_MAG_OFFSET = 19
ERROR_ROWS = 22

# Rows of `process` (PROCESS_ROWS,): noise densities and walks, per root second, and the GPS offset's two variances.
GYRO_NOISE = 0
ACCEL_NOISE = 1
GYRO_WALK = 2
ACCEL_WALK = 3
BARO_WALK = 4
GPS_DRIFT_H = 5  # m^2, stationary variance of the horizontal offset
GPS_DRIFT_V = 6
GPS_DRIFT_TIME = 7  # s
PROCESS_ROWS = 8


@compiled
def rotation(x: Array, j: int) -> Rotation:
    """R of vehicle `j`'s attitude, body to world, row by row."""
    w, a, b, c = x[QUATERNION, j], x[QUATERNION + 1, j], x[QUATERNION + 2, j], x[QUATERNION + 3, j]
    return (
        1.0 - 2.0 * (b * b + c * c), 2.0 * (a * b - w * c), 2.0 * (a * c + w * b),
        2.0 * (a * b + w * c), 1.0 - 2.0 * (a * a + c * c), 2.0 * (b * c - w * a),
        2.0 * (a * c - w * b), 2.0 * (b * c + w * a), 1.0 - 2.0 * (a * a + b * b),
    )  # fmt: skip


@compiled
def turn(rx: float, ry: float, rz: float) -> tuple[float, float, float, float]:
    """The unit quaternion of a small rotation vector, to the fifth order of its angle."""
    square = 0.25 * (rx * rx + ry * ry + rz * rz)
    share = 0.5 * (1.0 - square / 6.0 + square * square / 120.0)
    return 1.0 - square / 2.0 + square * square / 24.0, share * rx, share * ry, share * rz


@compiled
def normalise(x: Array, j: int) -> None:
    w, a, b, c = x[QUATERNION, j], x[QUATERNION + 1, j], x[QUATERNION + 2, j], x[QUATERNION + 3, j]
    scale = 1.0 / sqrt((w * w + a * a) + (b * b + c * c))
    for i in range(4):
        x[QUATERNION + i, j] *= scale


# --- in time ---------------------------------------------------------------------------------------------------------


@compiled
def strapdown(x: Array, angle: Array, velocity: Array, dt_s: float, gravity_m_s2: float, j: int) -> None:
    """Integrate vehicle `j`'s nominal state over one delta angle and delta velocity (rows 0:3, j), biases taken off.

    Both are in the body axes of the interval's beginning, `angle` as a rotation vector.
    """
    r = rotation(x, j)
    bx = velocity[0, j] - x[ACCEL_BIAS, j] * dt_s
    by = velocity[1, j] - x[ACCEL_BIAS + 1, j] * dt_s
    bz = velocity[2, j] - x[ACCEL_BIAS + 2, j] * dt_s
    half = 0.5 * dt_s
    vx, vy, vz = x[VELOCITY, j], x[VELOCITY + 1, j], x[VELOCITY + 2, j]
    wx = vx + (r[0] * bx + r[1] * by + r[2] * bz)
    wy = vy + (r[3] * bx + r[4] * by + r[5] * bz)
    wz = vz + ((r[6] * bx + r[7] * by + r[8] * bz) - gravity_m_s2 * dt_s)
    x[POSITION, j] += half * (vx + wx)
    x[POSITION + 1, j] += half * (vy + wy)
    x[POSITION + 2, j] += half * (vz + wz)
    x[VELOCITY, j], x[VELOCITY + 1, j], x[VELOCITY + 2, j] = wx, wy, wz
    tw, tx, ty, tz = turn(
        angle[0, j] - x[GYRO_BIAS, j] * dt_s,
        angle[1, j] - x[GYRO_BIAS + 1, j] * dt_s,
        angle[2, j] - x[GYRO_BIAS + 2, j] * dt_s,
    )
    w, a, b, c = quaternion_product(
        x[QUATERNION, j], x[QUATERNION + 1, j], x[QUATERNION + 2, j], x[QUATERNION + 3, j], tw, tx, ty, tz
    )
    x[QUATERNION, j], x[QUATERNION + 1, j], x[QUATERNION + 2, j], x[QUATERNION + 3, j] = w, a, b, c
    normalise(x, j)


@compiled
def apply_transition(
    r: Rotation, push: tuple[float, float, float], dt_s: float, decay: float, m: Array, j: int
) -> None:
    """F m in place, for m (ERROR_ROWS, k, n): the error's transition over one interval, with the zeros left out.

    `r` is the attitude and `push` the velocity gained by the specific force, world axes, both of the interval's
    beginning; `decay` that of the GPS offset.
    """
    half = 0.5 * dt_s
    for k in range(m.shape[1]):
        v0, v1, v2 = m[E_VELOCITY, k, j], m[E_VELOCITY + 1, k, j], m[E_VELOCITY + 2, k, j]
        t0, t1, t2 = m[E_ATTITUDE, k, j], m[E_ATTITUDE + 1, k, j], m[E_ATTITUDE + 2, k, j]
        g0, g1, g2 = m[E_GYRO_BIAS, k, j], m[E_GYRO_BIAS + 1, k, j], m[E_GYRO_BIAS + 2, k, j]
        a0, a1, a2 = m[E_ACCEL_BIAS, k, j], m[E_ACCEL_BIAS + 1, k, j], m[E_ACCEL_BIAS + 2, k, j]
        w0 = v0 + (t1 * push[2] - t2 * push[1]) - dt_s * (r[0] * a0 + r[1] * a1 + r[2] * a2)
        w1 = v1 + (t2 * push[0] - t0 * push[2]) - dt_s * (r[3] * a0 + r[4] * a1 + r[5] * a2)
        w2 = v2 + (t0 * push[1] - t1 * push[0]) - dt_s * (r[6] * a0 + r[7] * a1 + r[8] * a2)
        m[E_POSITION, k, j] += half * (v0 + w0)
        m[E_POSITION + 1, k, j] += half * (v1 + w1)
        m[E_POSITION + 2, k, j] += half * (v2 + w2)
        m[E_VELOCITY, k, j], m[E_VELOCITY + 1, k, j], m[E_VELOCITY + 2, k, j] = w0, w1, w2
        m[E_ATTITUDE, k, j] = t0 - dt_s * (r[0] * g0 + r[1] * g1 + r[2] * g2)
        m[E_ATTITUDE + 1, k, j] = t1 - dt_s * (r[3] * g0 + r[4] * g1 + r[5] * g2)
        m[E_ATTITUDE + 2, k, j] = t2 - dt_s * (r[6] * g0 + r[7] * g1 + r[8] * g2)
        for i in range(3):
            m[E_GPS_OFFSET + i, k, j] *= decay


@compiled
def predict(
    x: Array, p: Array, angle: Array, velocity: Array, dt_s: float, gravity_m_s2: float, process: Array, j: int
) -> None:
    """One interval of vehicle `j`: P = F P F^T + Q, and the nominal state. `p` stays symmetric to the bit."""
    r = rotation(x, j)
    bx = velocity[0, j] - x[ACCEL_BIAS, j] * dt_s
    by = velocity[1, j] - x[ACCEL_BIAS + 1, j] * dt_s
    bz = velocity[2, j] - x[ACCEL_BIAS + 2, j] * dt_s
    push = (
        r[0] * bx + r[1] * by + r[2] * bz,
        r[3] * bx + r[4] * by + r[5] * bz,
        r[6] * bx + r[7] * by + r[8] * bz,
    )
    decay = 1.0 - dt_s / process[GPS_DRIFT_TIME]
    apply_transition(r, push, dt_s, decay, p, j)
    for a in range(ERROR_ROWS):
        for b in range(a):
            p[a, b, j], p[b, a, j] = p[b, a, j], p[a, b, j]
    apply_transition(r, push, dt_s, decay, p, j)
    for a in range(ERROR_ROWS):
        for b in range(a):
            mean = 0.5 * (p[a, b, j] + p[b, a, j])
            p[a, b, j] = mean
            p[b, a, j] = mean
    renewed = 1.0 - decay * decay
    for i in range(3):
        p[E_VELOCITY + i, E_VELOCITY + i, j] += process[ACCEL_NOISE] * process[ACCEL_NOISE] * dt_s
        p[E_ATTITUDE + i, E_ATTITUDE + i, j] += process[GYRO_NOISE] * process[GYRO_NOISE] * dt_s
        p[E_GYRO_BIAS + i, E_GYRO_BIAS + i, j] += process[GYRO_WALK] * process[GYRO_WALK] * dt_s
        p[E_ACCEL_BIAS + i, E_ACCEL_BIAS + i, j] += process[ACCEL_WALK] * process[ACCEL_WALK] * dt_s
        drift = process[GPS_DRIFT_H] if i < 2 else process[GPS_DRIFT_V]
        p[E_GPS_OFFSET + i, E_GPS_OFFSET + i, j] += drift * renewed
        x[GPS_OFFSET + i, j] *= decay
    p[E_BARO_OFFSET, E_BARO_OFFSET, j] += process[BARO_WALK] * process[BARO_WALK] * dt_s
    strapdown(x, angle, velocity, dt_s, gravity_m_s2, j)


@compiled
def advance(
    x: Array, p: Array, ring: Array, head: int, delta: Array, aligned: bool, dt_s: float, gravity_m_s2: float,
    process: Array, due: Array,
) -> None:  # fmt: skip
    """One control period: the newest IMU interval, `delta` (6, n), takes the oldest one's place in `ring` (d, 6, n).

    That is the one at `head`, and the filter predicts over it: it lives d intervals in the past, when the latest
    measurement comes in. `due` (6, n) is scratch.
    """
    depth = ring.shape[0]
    for j in range(x.shape[1]):
        for i in range(6):
            if depth == 0:
                due[i, j] = delta[i, j]
            else:
                due[i, j] = ring[head, i, j]
                ring[head, i, j] = delta[i, j]
        if aligned:
            predict(x, p, due[:3], due[3:], dt_s, gravity_m_s2, process, j)


@compiled
def present(
    x: Array, ring: Array, head: int, gyro: Array, dt_s: float, gravity_m_s2: float, now: Array, estimate: Array
) -> None:
    """The state now: the filter's, taken through the intervals that it has not seen, the oldest at `head`.

    `gyro` (3, n) is the newest sample; `now` (STATE_ROWS, n) is scratch; fills `estimate` (13, n).
    """
    depth = ring.shape[0]
    for j in range(x.shape[1]):
        for i in range(STATE_ROWS):
            now[i, j] = x[i, j]
        for k in range(depth):
            delta = ring[(head + k) % depth]
            strapdown(now, delta[:3], delta[3:], dt_s, gravity_m_s2, j)
        for i in range(10):
            estimate[i, j] = now[i, j]
        for i in range(3):
            estimate[10 + i, j] = gyro[i, j] - x[GYRO_BIAS + i, j]


# --- measurements ----------------------------------------------------------------------------------------------------


@compiled
def fuse(x: Array, p: Array, h: Array, innovation: float, variance: float, j: int) -> None:
    """One component z = h e + noise: gain, Joseph's form of the covariance, and the error put into the nominal state.

    `h` (ERROR_ROWS,).
    """
    rows = ERROR_ROWS
    c = np.empty(rows)
    for a in range(rows):
        total = 0.0
        for b in range(rows):
            if h[b] != 0.0:
                total += p[a, b, j] * h[b]
        c[a] = total
    s = variance
    for a in range(rows):
        s += h[a] * c[a]
    if not s > 0.0:
        return
    gain = c / s
    # (I - K h) P (I - K h)^T + K R K^T; M = (I - K h) P = P - K c^T, and M h^T = c - K (h c)
    seen = s - variance
    for a in range(rows):
        left = c[a] - gain[a] * seen
        for b in range(a + 1):
            value = p[a, b, j] - gain[a] * c[b] - left * gain[b] + variance * gain[a] * gain[b]
            p[a, b, j] = value
            p[b, a, j] = value
    for i in range(3):
        x[POSITION + i, j] += gain[E_POSITION + i] * innovation
        x[VELOCITY + i, j] += gain[E_VELOCITY + i] * innovation
    tw, tx, ty, tz = turn(
        gain[E_ATTITUDE] * innovation, gain[E_ATTITUDE + 1] * innovation, gain[E_ATTITUDE + 2] * innovation
    )
    w, qx, qy, qz = quaternion_product(
        tw, tx, ty, tz, x[QUATERNION, j], x[QUATERNION + 1, j], x[QUATERNION + 2, j], x[QUATERNION + 3, j]
    )
    x[QUATERNION, j], x[QUATERNION + 1, j], x[QUATERNION + 2, j], x[QUATERNION + 3, j] = w, qx, qy, qz
    normalise(x, j)
    for a in range(E_GYRO_BIAS, rows):
        x[a + 1, j] += gain[a] * innovation


@compiled
def ratio(p: Array, h: Array, innovation: float, variance: float, gate: float, j: int) -> float:
    """|innovation| over `gate` times its standard deviation: above 1 it is refused."""
    s = variance
    for a in range(ERROR_ROWS):
        if h[a] != 0.0:
            for b in range(ERROR_ROWS):
                if h[b] != 0.0:
                    s += h[a] * p[a, b, j] * h[b]
    return abs(innovation) / (gate * sqrt(s))


@compiled
def magnetometer_row(x: Array, field: Array, axis: int, h: Array, j: int) -> float:
    """Fill `h` for body `axis` of the magnetometer; the field expected there, gauss. `field` (3,) is the world's."""
    r = rotation(x, j)
    column = (r[axis], r[3 + axis], r[6 + axis])
    for a in range(ERROR_ROWS):
        h[a] = 0.0
    # R_true^T m = R^T (m + m x e): the row of R^T [m]x
    h[E_ATTITUDE] = column[1] * field[2] - column[2] * field[1]
    h[E_ATTITUDE + 1] = column[2] * field[0] - column[0] * field[2]
    h[E_ATTITUDE + 2] = column[0] * field[1] - column[1] * field[0]
    h[E_MAG_OFFSET + axis] = 1.0
    expected: float = column[0] * field[0] + column[1] * field[1] + column[2] * field[2] + x[MAG_OFFSET + axis, j]
    return expected


@compiled
def fuse_magnetometer(x: Array, p: Array, z: Array, field: Array, variance: float, gate: float, test: Array) -> None:
    """`z` (3, n) gauss FLU, all three or none; `test` (n,) gets the largest ratio. `gate` 0: fused whatever comes."""
    h = np.zeros(ERROR_ROWS)
    for j in range(x.shape[1]):
        worst = 0.0
        if gate > 0.0:
            for axis in range(3):
                expected = magnetometer_row(x, field, axis, h, j)
                worst = max(worst, ratio(p, h, z[axis, j] - expected, variance, gate, j))
        test[j] = worst
        if worst <= 1.0:
            for axis in range(3):
                expected = magnetometer_row(x, field, axis, h, j)
                fuse(x, p, h, z[axis, j] - expected, variance, j)


@compiled
def fuse_direct(
    x: Array, p: Array, row: int, offset: int, count: int, z: Array, variance: Array, gate: float, test: Array
) -> None:
    """`count` states from error row `row` on, below `E_ATTITUDE`, each measured by itself: all or none.

    `offset` is the error row of what the sensor adds to the first of them, -1: nothing. `z` (count, n), `variance`
    (count,); `test` and `gate` as in `fuse_magnetometer`.
    """
    h = np.zeros(ERROR_ROWS)
    for j in range(x.shape[1]):
        worst = 0.0
        for late in range(2):
            if late and not worst <= 1.0:
                break
            for i in range(count):
                expected = x[row + i, j]
                for a in range(ERROR_ROWS):
                    h[a] = 0.0
                h[row + i] = 1.0
                if offset >= 0:
                    h[offset + i] = 1.0
                    expected += x[offset + i + 1, j]
                innovation = z[i, j] - expected
                if late:
                    fuse(x, p, h, innovation, variance[i], j)
                elif gate > 0.0:
                    worst = max(worst, ratio(p, h, innovation, variance[i], gate, j))
        test[j] = worst


@compiled
def fuse_at_rest(x: Array, p: Array, force: Array, force_variance: float, gravity_m_s2: float) -> None:
    """The accelerometer's mean at rest, `force` (3, n): it is gravity's reaction, R^T (0, 0, g), and the bias."""
    h = np.zeros(ERROR_ROWS)
    world = np.array([0.0, 0.0, gravity_m_s2])
    for j in range(x.shape[1]):
        for axis in range(3):
            # as the magnetometer's row, with gravity's reaction for the field and the accelerometer's bias
            expected = magnetometer_row(x, world, axis, h, j) - x[MAG_OFFSET + axis, j] + x[ACCEL_BIAS + axis, j]
            h[E_MAG_OFFSET + axis] = 0.0
            h[E_ACCEL_BIAS + axis] = 1.0
            fuse(x, p, h, force[axis, j] - expected, force_variance, j)


@compiled
def fuse_gyro_at_rest(x: Array, p: Array, rate: Array, variance: float) -> None:
    """The gyro's mean at rest, `rate` (3, n): it is the bias."""
    h = np.zeros(ERROR_ROWS)
    for j in range(x.shape[1]):
        for axis in range(3):
            for a in range(ERROR_ROWS):
                h[a] = 0.0
            h[E_GYRO_BIAS + axis] = 1.0
            fuse(x, p, h, rate[axis, j] - x[GYRO_BIAS + axis, j], variance, j)


def forget(p: Array, row: int, count: int, variance: float) -> None:
    """Error rows `row` to `row + count` are as unknown as `variance` says, and tied to nothing."""
    for i in range(row, row + count):
        p[i, :] = 0.0
        p[:, i] = 0.0
        p[i, i] = variance
