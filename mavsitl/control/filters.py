"""The angle-reference filter between the outer and the inner loop."""

from __future__ import annotations

import math

import numpy as np

from mavsitl.compiled import inlined
from mavsitl.control.arrays import Floats, Record, at, record


@inlined
def first_order_step(value: Floats, share: float, bandwidth: float, state: Floats, rate: Floats) -> None:
    """`FirstOrder.update`: moves `state` (rows, n) towards `value` and fills `rate`."""
    if value.shape != state.shape:
        raise ValueError("the input must have the shape (rows, n) that the filter was built with")
    for row in range(state.shape[0]):
        for i in range(state.shape[1]):
            if bandwidth > 0.0:
                state[row, i] += share * (value[row, i] - state[row, i])
                rate[row, i] = bandwidth * (value[row, i] - state[row, i])
            else:
                state[row, i] = value[row, i]


class FirstOrder:
    """y' = w (x - y) of (rows, n) signals, solved exactly for an input held over each period: stable at any bandwidth.

    Bandwidth 0 is no filter: y = x, rate 0. For references that do not wrap (roll, pitch), in the unit of the input.
    """

    def __init__(self, bandwidth_rad_s: float, period_s: float, rows: int = 2, n: int = 1) -> None:
        """Raises `ValueError` for a negative bandwidth or a period that is not > 0."""
        if not bandwidth_rad_s >= 0.0 or not period_s > 0.0:
            raise ValueError("bandwidth_rad_s must be at least 0 and period_s greater than 0")
        self._bandwidth = float(bandwidth_rad_s)
        self._share = -math.expm1(-bandwidth_rad_s * period_s)
        self.value = np.zeros((rows, n))
        self.rate = np.zeros((rows, n))
        """y' at the end of the period, unit of the input per second: the reference rate that belongs to y."""

    def update(self, value: Floats) -> Floats:
        """One period: y (rows, n), overwritten by the next call. Raises `ValueError` for a wrong shape."""
        first_order_step(value, self._share, self._bandwidth, self.value, self.rate)
        return self.value

    def record(self) -> Record:
        """What `first_order_step` takes beside its input, as it stands, by the names of its parameters."""
        return record(share=self._share, bandwidth=self._bandwidth, state=self.value, rate=self.rate)

    def reset(self, vehicle: int | None = None, value: float | Floats = 0.0) -> None:
        """Start one vehicle, or all, at rest at `value` (a number, or an array that fits)."""
        self.value[:, at(vehicle)] = value
        self.rate[:, at(vehicle)] = 0.0
