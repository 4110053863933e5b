"""Gyroscope and accelerometer: a sample at every physics step, and their integral over a control period.

The rate loop follows the samples themselves, the filter their integral, so that both see the same sensor: its noise,
its bias and its failures.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import radians, sqrt

import numpy as np

from mavsitl import seeds
from mavsitl.compiled import compiled
from mavsitl.scenario import Imu as Settings
from mavsitl_vehicle.failures import Kind
from mavsitl_vehicle.sensors.ekf import Array

# Rows of `state` (STATE_ROWS, n), body FLU.
GYRO = 0  # 0:3, the newest sample, rad/s
ACCEL = 3  # 3:6, m/s^2
BIAS = 6  # 6:12, of both
DELTA = 12  # 12:18, delta angle (rotation vector, rad) and delta velocity (m/s) of the period so far
FRESH = 18  # 18:20, samples that came in the period, gyro and accelerometer
CORRECTION = 20  # 20:23, the filter's gyro bias, which the rate loop takes off, rad/s
COUNT = 23  # samples since the start
STATE_ROWS = 24

# Rows of `settings` (SETTING_ROWS,).
GYRO_SIGMA = 0  # of a sample, rad/s
ACCEL_SIGMA = 1  # m/s^2
GYRO_WALK = 2  # of the bias, a control period
ACCEL_WALK = 3
GRAVITY = 4  # m/s^2
SLOW_STEPS = 5  # one sample in so many while SLOW
SETTING_ROWS = 6

NORMALS = 6
"""Of a sample; as many more at the end of a period, for the biases."""

SLOW_HZ = 50.0
DELAY_S = 0.02
GARBAGE_GYRO_RAD_S = 10.0
"""1 sigma: a third of the full scale of 2000 deg/s."""
GARBAGE_ACCEL_M_S2 = 50.0
"""1 sigma: a third of the full scale of 16 g."""
WRONG_GYRO_RAD_S = radians(20.0)
WRONG_ACCEL_M_S2 = 3.0
"""Added to each axis."""

# FAILURE_TYPE as the kernel knows it.
OK, OFF, STUCK, GARBAGE, WRONG, SLOW, DELAYED = (
    int(kind) for kind in (Kind.OK, Kind.OFF, Kind.STUCK, Kind.GARBAGE, Kind.WRONG, Kind.SLOW, Kind.DELAYED)
)


@compiled
def corrected_gyro(state: Array, gyro: Array) -> None:
    """What the rate loop sees, into `gyro` (3, n): the newest sample less the filter's bias."""
    for j in range(state.shape[1]):
        for i in range(3):
            gyro[i, j] = state[GYRO + i, j] - state[CORRECTION + i, j]


@compiled
def deliver(
    state: Array, late: Array, row: int, true: float, sigma: float, normal: float, kind: int, added: float,
    garbage: float, wrong: float, slow: bool, slot: int, j: int,
) -> None:  # fmt: skip
    """One axis of one sample, as the failure `kind` lets it through, into row `row` of `state`.

    `late` (steps, 6, n) keeps what was measured, its row `slot` the oldest.
    """
    measured = true + state[BIAS + row, j] + added + sigma * normal
    out = late[slot, row, j]
    late[slot, row, j] = measured
    if kind == OK or (kind == SLOW and slow):
        state[row, j] = measured
    elif kind == GARBAGE:
        state[row, j] = garbage * normal
    elif kind == WRONG:
        state[row, j] = measured + wrong
    elif kind == DELAYED:
        state[row, j] = out
    # OFF, STUCK: the last one stays


@compiled
def sample(
    state: Array, late: Array, settings: Array, added: Array, gyro_kind: int, accel_kind: int,
    before: Array, x: Array, normals: Array, dt_s: float,
) -> None:  # fmt: skip
    """Measure at the end of a physics step from `before` (7, n), velocity and attitude, to `x` (17, n); integrate.

    The accelerometer gives the step's mean specific force, the gyro the rate at the step's end; the delta angle is
    the trapezoid of two samples, with coning, and the delta velocity is turned back to the period's beginning.
    `added` (6,) is put on the samples, `normals` (6, n).
    """
    slot = int(state[COUNT, 0]) % late.shape[0]
    slow = int(state[COUNT, 0]) % int(settings[SLOW_STEPS]) == 0
    for j in range(x.shape[1]):
        gx, gy, gz = state[GYRO, j], state[GYRO + 1, j], state[GYRO + 2, j]
        for i in range(3):
            deliver(
                state, late, GYRO + i, x[10 + i, j], settings[GYRO_SIGMA], normals[i, j], gyro_kind, added[i],
                GARBAGE_GYRO_RAD_S, WRONG_GYRO_RAD_S, slow, slot, j,
            )  # fmt: skip
        ax = (x[3, j] - before[0, j]) / dt_s
        ay = (x[4, j] - before[1, j]) / dt_s
        az = (x[5, j] - before[2, j]) / dt_s + settings[GRAVITY]
        # the attitude in the middle of the step
        w, a = x[6, j] + before[3, j], x[7, j] + before[4, j]
        b, c = x[8, j] + before[5, j], x[9, j] + before[6, j]
        share = 2.0 / ((w * w + a * a) + (b * b + c * c))
        fx = ax + share * (-(b * b + c * c) * ax + (a * b + w * c) * ay + (a * c - w * b) * az)
        fy = ay + share * ((a * b - w * c) * ax - (a * a + c * c) * ay + (b * c + w * a) * az)
        fz = az + share * ((a * c + w * b) * ax + (b * c - w * a) * ay - (a * a + b * b) * az)
        for i in range(3):
            force = fx if i == 0 else fy if i == 1 else fz
            deliver(
                state, late, ACCEL + i, force, settings[ACCEL_SIGMA], normals[3 + i, j], accel_kind, added[3 + i],
                GARBAGE_ACCEL_M_S2, WRONG_ACCEL_M_S2, slow, slot, j,
            )  # fmt: skip
        half = 0.5 * dt_s
        dx = half * (gx + state[GYRO, j])
        dy = half * (gy + state[GYRO + 1, j])
        dz = half * (gz + state[GYRO + 2, j])
        px, py, pz = state[DELTA, j], state[DELTA + 1, j], state[DELTA + 2, j]
        vx, vy, vz = dt_s * state[ACCEL, j], dt_s * state[ACCEL + 1, j], dt_s * state[ACCEL + 2, j]
        mx, my, mz = px + 0.5 * dx, py + 0.5 * dy, pz + 0.5 * dz
        state[DELTA + 3, j] += vx + (my * vz - mz * vy)
        state[DELTA + 4, j] += vy + (mz * vx - mx * vz)
        state[DELTA + 5, j] += vz + (mx * vy - my * vx)
        state[DELTA, j] = px + dx + 0.5 * (py * dz - pz * dy)
        state[DELTA + 1, j] = py + dy + 0.5 * (pz * dx - px * dz)
        state[DELTA + 2, j] = pz + dz + 0.5 * (px * dy - py * dx)
        for i in range(2):
            kind = gyro_kind if i == 0 else accel_kind
            if kind != OFF and (kind != SLOW or slow):
                state[FRESH + i, j] += 1.0
        state[COUNT, j] += 1.0


@compiled
def begin(state: Array, settings: Array, normals: Array) -> None:
    """A new control period: nothing is integrated yet, and the biases have walked. `normals` (6, n)."""
    for j in range(state.shape[1]):
        for i in range(6):
            state[DELTA + i, j] = 0.0
            state[BIAS + i, j] += (settings[GYRO_WALK] if i < 3 else settings[ACCEL_WALK]) * normals[i, j]
        state[FRESH, j] = 0.0
        state[FRESH + 1, j] = 0.0


class Imu:
    """The arrays that the kernels work on.

    Attributes:
        state: (STATE_ROWS, n).
        late: (steps, 6, n), the measurements of the last `DELAY_S`.
        settings: (SETTING_ROWS,).
        added: (6,), offset put on the samples: rad/s and m/s^2, FLU.
    """

    def __init__(
        self, settings: Settings, gravity_m_s2: float, dt_s: float, period_s: float, seed: int, vehicles: Sequence[int]
    ) -> None:
        self._settings = settings
        self._dt_s = dt_s
        self.generators = [seeds.generator(seed, "vehicle", j, "imu") for j in vehicles]
        n = len(vehicles)
        self.state: Array = np.zeros((STATE_ROWS, n))
        gyro_bias, accel_bias = radians(settings.gyro_bias_deg_s), settings.accel_bias_m_s2
        sigma = np.array([gyro_bias] * 3 + [accel_bias] * 3)[:, None]
        self.state[BIAS : BIAS + 6] = sigma * np.stack([g.standard_normal(6) for g in self.generators], axis=-1)
        self.late: Array = np.zeros((max(round(DELAY_S / dt_s), 1), 6, n))
        self.added: Array = np.zeros(6)
        self.settings: Array = np.zeros(SETTING_ROWS)
        self.settings[GYRO_WALK] = radians(settings.gyro_bias_walk_deg_s_rt_s) * sqrt(period_s)
        self.settings[ACCEL_WALK] = settings.accel_bias_walk_m_s2_rt_s * sqrt(period_s)
        self.settings[GRAVITY] = gravity_m_s2
        self.settings[SLOW_STEPS] = max(round(1.0 / (SLOW_HZ * dt_s)), 1)
        self.set_noise(1.0)

    def set_noise(self, scale: float) -> None:
        """`scale` on the noise of the samples."""
        rate = 1.0 / sqrt(self._dt_s)  # a density of white noise is that of the samples over the root of their rate
        self.settings[GYRO_SIGMA] = radians(self._settings.gyro_noise_deg_s_rt_hz) * rate * scale
        self.settings[ACCEL_SIGMA] = self._settings.accel_noise_m_s2_rt_hz * rate * scale

    def start(self, x: Array) -> None:
        """First samples, at rest in the state `x` (17, n), without noise."""
        n = x.shape[1]
        before = np.vstack((x[3:6], x[6:10]))
        ok = int(Kind.OK)
        self.state[GYRO : GYRO + 3] = x[10:13] + self.state[BIAS : BIAS + 3]
        sample(
            self.state, self.late, self.settings, self.added, ok, ok, before, x, np.zeros((NORMALS, n)), self._dt_s
        )  # fmt: skip
        self.late[:] = self.state[GYRO : GYRO + 6]
