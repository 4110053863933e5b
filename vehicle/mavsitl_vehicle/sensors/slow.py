"""GPS, barometer and magnetometer: each measures at its rate, and what it measured comes later.

Time is in microseconds, measurements are arrays (rows, n). A measurement carries the stamp that the vehicle believes:
when it came, less the delay that the filter knows of.
"""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heappop, heappush
from math import exp, sqrt
from typing import NamedTuple

import numpy as np

from mavsitl import seeds
from mavsitl.compiled import compiled
from mavsitl.frames import Vector
from mavsitl.scenario import Barometer as BarometerSettings
from mavsitl.scenario import Gps as GpsSettings
from mavsitl.scenario import Magnetometer as MagnetometerSettings
from mavsitl_vehicle.autopilot.position import Values
from mavsitl_vehicle.failures import Failures, Kind, Unit
from mavsitl_vehicle.sensors.ekf import Array
from mavsitl_vehicle.sensors.faults import LATE_US, Fault

PASCAL_PER_METRE = 11.3
"""Of the standard atmosphere at 488 m."""
JAM_NOISE = 30.0
"""A GPS jammed as far as it still has a fix is so many times noisier."""
FIX_SATELLITES = 4
"""Below it there is no fix."""


class Measurement(NamedTuple):
    """One of all vehicles."""

    stamp_us: int
    values: Array
    satellites: int = 0
    noise: float = 1.0
    """How many times noisier than its settings the sensor says it is."""


class SlowSensor:
    """Measures every so often. A subclass fills in `measure`.

    Attributes:
        newest: what came last; None: nothing yet.
        came_us: when.
    """

    def __init__(self, fault: Fault, rate_hz: float, delay_ms: float, failures: Failures) -> None:
        self._fault = fault
        self._failures = failures
        self.interval_us = 1e6 / rate_hz
        self.delay_us = round(delay_ms * 1e3)
        self._next_us = 0.0
        self._count = 0
        self._on_the_way: list[tuple[int, int, Measurement]] = []
        self.newest: Measurement | None = None
        self.came_us = -(2**40)

    def step(self, x: Array, now_us: int) -> Measurement | None:
        """Measure if it is time; what comes in now, if anything."""
        if now_us >= self._next_us:
            self._count += 1
            self._next_us = self._count * self.interval_us
            kind = self._failures.of(self._fault.unit)
            values = self._fault.through(kind, self.measure(x), now_us)
            if values is not None:
                comes_us = now_us + self.delay_us + (LATE_US if kind is Kind.DELAYED else 0)
                measured = self.describe(Measurement(comes_us - self.delay_us, values))
                if measured is not None:
                    heappush(self._on_the_way, (comes_us, self._count, measured))
        came = None
        while self._on_the_way and self._on_the_way[0][0] <= now_us:
            came = heappop(self._on_the_way)[2]
            self.newest, self.came_us = came, now_us
        return came

    def fresh(self, now_us: int, timeout_us: int) -> bool:
        """Did something come in the last `timeout_us`, or two intervals where those are longer?"""
        return now_us - self.came_us <= max(timeout_us, 2.0 * self.interval_us)

    def measure(self, x: Array) -> Array:
        """(rows, n) of the truth `x` (17, n), with the sensor's own errors."""
        raise NotImplementedError

    def describe(self, measured: Measurement) -> Measurement | None:
        """What the sensor says about it; None: it has nothing to say."""
        return measured


class Gps(SlowSensor):
    """Rows: position m and velocity m/s, NWU. SIM_GPS_* act on it."""

    WRONG = (20.0, 20.0, 10.0, 0.0, 0.0, 0.0)
    GARBAGE = (50.0, 50.0, 50.0, 5.0, 5.0, 5.0)

    def __init__(
        self, settings: GpsSettings, parameters: Values, failures: Failures, seed: int, vehicles: Sequence[int]
    ) -> None:
        fault = Fault(Unit.GPS, self.WRONG, self.GARBAGE, seed, vehicles[0])
        super().__init__(fault, settings.rate_hz, settings.delay_ms, failures)
        self._parameters = parameters
        self._generators = [seeds.generator(seed, "vehicle", j, "gps") for j in vehicles]
        h, v, s = settings.horizontal_noise_m, settings.vertical_noise_m, settings.velocity_noise_m_s
        self._sigma = np.array([h, h, v, s, s, s])[:, None]
        h, v = settings.horizontal_drift_m, settings.vertical_drift_m
        self._drift_sigma = np.array([h, h, v])[:, None]
        self._decay = exp(-1.0 / (settings.rate_hz * settings.drift_time_s))
        self._drift = self._drift_sigma * np.stack([g.standard_normal(3) for g in self._generators], axis=-1)

    def measure(self, x: Array) -> Array:
        p = self._parameters
        normals = np.stack([g.standard_normal(9) for g in self._generators], axis=-1)
        self._drift = self._decay * self._drift + sqrt(1.0 - self._decay**2) * self._drift_sigma * normals[6:]
        scale = p["SIM_NOISE_SCALE"] * self._jam_noise
        values: Array = x[:6] + scale * self._sigma * normals[:6]
        values[:3] += self._drift
        for row, sign, axis in ((0, 1.0, "N"), (1, -1.0, "E"), (2, -1.0, "D")):
            values[row] += sign * p[f"SIM_GPS_GLITCH_{axis}"]
        return values

    @property
    def _jam_noise(self) -> float:
        return 1.0 + JAM_NOISE * self._parameters["SIM_GPS_JAM"]

    def describe(self, measured: Measurement) -> Measurement | None:
        satellites = int(self._parameters["SIM_GPS_USED"] * (1.0 - self._parameters["SIM_GPS_JAM"]) + 0.5)
        return measured._replace(satellites=satellites, noise=self._jam_noise)


class Barometer(SlowSensor):
    """One row: height above the local origin, m, by the standard atmosphere."""

    WRONG = (15.0,)
    GARBAGE = (50.0,)

    def __init__(
        self, settings: BarometerSettings, parameters: Values, failures: Failures, seed: int, vehicles: Sequence[int]
    ) -> None:
        fault = Fault(Unit.BARO, self.WRONG, self.GARBAGE, seed, vehicles[0])
        super().__init__(fault, settings.rate_hz, settings.delay_ms, failures)
        self._parameters = parameters
        self._generators = [seeds.generator(seed, "vehicle", j, "barometer") for j in vehicles]
        self._noise_m = settings.noise_m
        self._walk_m = settings.drift_m_rt_s / sqrt(settings.rate_hz)
        self._offset = settings.offset_m * np.array([[g.standard_normal() for g in self._generators]])

    def measure(self, x: Array) -> Array:
        p = self._parameters
        normals = np.stack([g.standard_normal(2) for g in self._generators], axis=-1)
        self._offset = self._offset + self._walk_m * normals[1:]
        values: Array = x[2:3] + self._offset + p["SIM_NOISE_SCALE"] * self._noise_m * normals[:1]
        return values - p["SIM_BARO_OFF_P"] / PASCAL_PER_METRE


@compiled
def body_field(x: Array, field: Array, values: Array) -> None:
    """R^T `field` (3,) into `values` (3, n)."""
    for j in range(x.shape[1]):
        w, a, b, c = x[6, j], x[7, j], x[8, j], x[9, j]
        fx, fy, fz = field[0], field[1], field[2]
        values[0, j] = fx + 2.0 * (-(b * b + c * c) * fx + (a * b + w * c) * fy + (a * c - w * b) * fz)
        values[1, j] = fy + 2.0 * ((a * b - w * c) * fx - (a * a + c * c) * fy + (b * c + w * a) * fz)
        values[2, j] = fz + 2.0 * ((a * c + w * b) * fx + (b * c - w * a) * fy - (a * a + b * b) * fz)


class Magnetometer(SlowSensor):
    """Rows: the field in body axes, gauss FLU."""

    WRONG = (0.15, 0.15, 0.0)
    GARBAGE = (0.5, 0.5, 0.5)

    def __init__(
        self,
        settings: MagnetometerSettings,
        field_nwu_gauss: Vector,
        parameters: Values,
        failures: Failures,
        seed: int,
        vehicles: Sequence[int],
    ) -> None:
        fault = Fault(Unit.MAG, self.WRONG, self.GARBAGE, seed, vehicles[0])
        super().__init__(fault, settings.rate_hz, settings.delay_ms, failures)
        self._parameters = parameters
        self._generators = [seeds.generator(seed, "vehicle", j, "magnetometer") for j in vehicles]
        self._noise = settings.noise_gauss
        self._field = np.array(field_nwu_gauss)
        self._offset = settings.offset_gauss * np.stack([g.standard_normal(3) for g in self._generators], axis=-1)

    def measure(self, x: Array) -> Array:
        p = self._parameters
        values: Array = np.empty((3, x.shape[1]))
        body_field(x, self._field, values)
        normals = np.stack([g.standard_normal(3) for g in self._generators], axis=-1)
        values += self._offset + p["SIM_NOISE_SCALE"] * self._noise * normals
        for row, sign, axis in ((0, 1.0, "X"), (1, -1.0, "Y"), (2, -1.0, "Z")):
            values[row] += sign * p[f"SIM_MAG_OFFSET_{axis}"]
        return values
