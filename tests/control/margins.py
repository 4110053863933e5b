"""Margins of roll and yaw with a scenario's gains: `python -m tests.control.margins SCENARIO...`, two rows each.

Linearised as in `linear_loop`: by how much its three gains can grow together before it is unstable, with the airframe's
rotors; and how many of 11 x 11 x 11 weights that the projection allows are unstable with rotors of some lags.
"""

from __future__ import annotations

import sys

import numpy as np

from mavsitl.scenario import Gains, load
from tests.control.linear_loop import spectral_radius, unstable

PERIOD_S = 0.004
LAGS_S = (0.005, 0.010, 0.030)


def gain_margin(gains: Gains, rotor_time_constant_s: float) -> float:
    """The largest factor on all three gains with which the loop is stable; 0 where it is unstable as it is."""

    def stable(factor: float) -> bool:
        return spectral_radius(gains, (factor, factor, factor), rotor_time_constant_s, PERIOD_S) < 1.0

    if not stable(1.0):
        return 0.0
    low, high = 1.0, 2.0
    while stable(high):
        low, high = high, 2.0 * high
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def unstable_weights(gains: Gains, projection: tuple[float, float], rotor_time_constant_s: float) -> int:
    """Of 1331."""
    return len(unstable(gains, np.linspace(*projection, 11), rotor_time_constant_s, PERIOD_S))


def main(names: list[str]) -> None:
    lags = ", ".join(f"{lag_s * 1e3:g}" for lag_s in LAGS_S)
    print(f"| scenario | axis | gain margin with its own rotors | weights of 1331 unstable with {lags} ms of lag |")
    print("|---|---|---:|---:|")
    for name in names:
        flight = load(name)
        controller, own_lag_s = flight.scenario.controller, flight.airframe.rotor_time_constant_s
        for axis, gains in (("roll, pitch", controller.roll_pitch), ("yaw", controller.yaw)):
            counts = [unstable_weights(gains, controller.learning.projection, lag_s) for lag_s in LAGS_S]
            print(f"| {name} | {axis} | {gain_margin(gains, own_lag_s):.2f} | {', '.join(map(str, counts))} |")


if __name__ == "__main__":
    main(sys.argv[1:] or ["hover-wind", "hover-wind-realistic"])
