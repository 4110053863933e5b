"""Roll or pitch as a linear loop: inertia, rotor lag, one sample of delay and the PID, sampled."""

from __future__ import annotations

import numpy as np

from mavsitl.control.arrays import Floats
from mavsitl.scenario import Gains

Shares = tuple[float, float, float]


def held_plant(rotor_time_constant_s: float, period_s: float) -> tuple[Floats, Floats]:
    """x(k + 1) = A x(k) + b u for an input held over the period, x = angle, rate, angular acceleration of the rotors.

    A (3, 3), b (3,). The rotors answer a' = (u - a) / tau; with tau = 0 they answer at once.
    """
    tau, t = rotor_time_constant_s, period_s
    if tau == 0.0:
        return np.array([[1.0, t, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]), np.array([0.5 * t * t, t, 1.0])
    fade = np.exp(-t / tau)
    rate = tau * (1.0 - fade)
    angle = tau * (t - rate)
    return (
        np.array([[1.0, t, angle], [0.0, 1.0, rate], [0.0, 0.0, fade]]),
        np.array([0.5 * t * t - angle, t - rate, 1.0 - fade]),
    )


def closed_loop(gains: Gains, shares: Shares, rotor_time_constant_s: float, period_s: float) -> Floats:
    """The closed loop's matrix, (5, 5), one period.

    States: angle, rate, rotors' acceleration, sum of errors up to the last sample, demand of the last sample (the one
    that acts now). The law is eq 42 with the rate as derivative, its three terms multiplied by `shares`.
    """
    a, b = held_plant(rotor_time_constant_s, period_s)
    p = gains.k_p_per_s2 * shares[0]
    i = gains.k_i_per_s3 * period_s * shares[1]
    d = gains.k_d_per_s * shares[2]
    loop = np.zeros((5, 5))
    loop[:3, :3] = a
    loop[:3, 4] = b
    loop[3] = [-1.0, 0.0, 0.0, 1.0, 0.0]
    loop[4] = [-p - i, -d, 0.0, i, 0.0]
    return loop


def spectral_radius(gains: Gains, shares: Shares, rotor_time_constant_s: float, period_s: float) -> float:
    """Largest modulus of the closed loop's eigenvalues; below 1 is stable."""
    return float(np.abs(np.linalg.eigvals(closed_loop(gains, shares, rotor_time_constant_s, period_s))).max())


def unstable(gains: Gains, grid: Floats, rotor_time_constant_s: float, period_s: float) -> list[Shares]:
    """The points (P, I, D) of grid x grid x grid where the loop is not stable."""
    return [
        (float(p), float(i), float(d))
        for p in grid
        for i in grid
        for d in grid
        if not spectral_radius(gains, (float(p), float(i), float(d)), rotor_time_constant_s, period_s) < 1.0
    ]
