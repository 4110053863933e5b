"""What a failure does to a sensor that measures now and then: one rule for GPS, barometer and magnetometer."""

from __future__ import annotations

import numpy as np

from mavsitl import seeds
from mavsitl_vehicle.failures import Kind, Unit
from mavsitl_vehicle.sensors.ekf import Array

SLOWER = 10
"""One measurement in so many comes while SLOW."""
LATE_US = 500_000
"""A DELAYED one comes so much later than its stamp says."""
SLOT_US = {Unit.GYRO: 50_000, Unit.ACCEL: 50_000}
DEFAULT_SLOT_US = 500_000
"""An INTERMITTENT sensor is there or not for so long, as a coin falls."""


class Coin:
    """Is an intermittent sensor there now? Heads or tails for each slot of time."""

    def __init__(self, unit: Unit, seed: int, vehicle: int) -> None:
        self._slot_us = SLOT_US.get(unit, DEFAULT_SLOT_US)
        self._generator = seeds.generator(seed, "vehicle", vehicle, "failures", unit.name)
        self._until_us = -1
        self._there = True

    def there(self, now_us: int) -> bool:
        if now_us >= self._until_us:
            self._until_us = now_us + self._slot_us
            self._there = bool(self._generator.random() < 0.5)
        return self._there


class Fault:
    """One sensor's, for all vehicles alike. `wrong` (rows,) is added while WRONG, `garbage` (rows,) 1 sigma of GARBAGE.

    Garbage is drawn from a generator of `vehicle`'s own, so that a failure does not change the noise after it.
    """

    def __init__(
        self, unit: Unit, wrong: tuple[float, ...], garbage: tuple[float, ...], seed: int, vehicle: int
    ) -> None:
        self.unit = unit
        self._wrong = np.array(wrong)[:, None]
        self._garbage = np.array(garbage)[:, None]
        self._generator = seeds.generator(seed, "vehicle", vehicle, "failures", unit.name, "garbage")
        self._coin = Coin(unit, seed, vehicle)
        self._count = 0
        self._stuck: Array | None = None

    def through(self, kind: Kind, values: Array, now_us: int) -> Array | None:
        """What comes of `values` (rows, n), measured now; None: nothing."""
        if kind is Kind.OK:
            self._stuck = values
            return values
        self._count += 1
        if kind is Kind.STUCK:
            if self._stuck is None:
                self._stuck = values
            return self._stuck
        if kind is Kind.GARBAGE:
            garbage: Array = values + self._garbage * self._generator.standard_normal(values.shape)
            return garbage
        if kind is Kind.WRONG:
            offset: Array = values + self._wrong
            return offset
        there = (
            kind is Kind.DELAYED
            or (kind is Kind.SLOW and self._count % SLOWER == 0)
            or (kind is Kind.INTERMITTENT and self._coin.there(now_us))
        )
        return values if there else None
