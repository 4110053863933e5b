"""Dryden turbulence: scales and intensities, densities, shaping filters, and the filters' exact discretisation.

A filter is driven by white noise w with R(tau) = I delta(tau) and is one of two kinds:

- first order:   G(s) = K / (1 + T s)                              state s1 = x / K
- second order:  G(s) = K (1 + sqrt(3) T s) / (1 + T s)^2          states s1 = w / (1 + T s), s2 = s1 / (1 + T s)

The second order's output is K (sqrt(3) s1 + (1 - sqrt(3)) s2), because
1 + sqrt(3) T s = sqrt(3) (1 + T s) + 1 - sqrt(3).
"""

from __future__ import annotations

from math import exp, log, pi, sqrt
from typing import TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from mavsitl.scenario import DrydenMil, DrydenPaper

Array: TypeAlias = NDArray[np.float64]

FOOT_M = 0.3048
ROUGHNESS_FT = 0.15
"""z_0 of the mean wind's log profile near the ground, MIL-F-8785C for take-off and landing (category C)."""
PROFILE_FLOOR_FT = 3.0
"""The log profile is given from 3 to 1,000 feet; below, the wind is that of 3 feet."""
REFERENCE_FT = 20.0

SQRT_3 = sqrt(3.0)


class Scales(msgspec.Struct, frozen=True):
    """Turbulence at one height, components u, v, w: eq 14's L and sigma, and the speed V that carries it past."""

    length_m: tuple[float, float, float]
    sigma_m_s: tuple[float, float, float]
    speed_m_s: float


class Filter(msgspec.Struct, frozen=True):
    """One shaping filter: its order (1 or 2), T, K and the noise intensity I."""

    order: int
    time_constant_s: float
    gain: float
    intensity: float


def paper_scales(wind: DrydenPaper) -> Scales:
    """Eq 15 as printed: metres in the formulas, sigma_v / sigma_u = sigma_u / sigma_w. Table 1 is 1 m, 10 m/s."""
    h = wind.altitude_m
    base = 0.177 + 0.000823 * h
    length_u = h / base**1.2
    sigma_w = 0.1 * wind.speed_20ft_m_s
    ratio = 1.0 / base**0.4
    return Scales(
        length_m=(length_u, length_u / 2.0, h / 2.0),
        sigma_m_s=(sigma_w * ratio, sigma_w * ratio * ratio, sigma_w),
        speed_m_s=wind.speed_20ft_m_s,
    )


def mil_scales(wind: DrydenMil) -> Scales:
    """MIL-HDBK-1797, low altitude: eq 15's formulas in feet, sigma_v = sigma_u; V is the mean wind at that height."""
    h_ft = wind.altitude_m / FOOT_M
    base = 0.177 + 0.000823 * h_ft
    length_u = h_ft / base**1.2 * FOOT_M
    sigma_w = 0.1 * wind.speed_20ft_m_s
    sigma_u = sigma_w / base**0.4
    return Scales(
        length_m=(length_u, length_u / 2.0, wind.altitude_m / 2.0),
        sigma_m_s=(sigma_u, sigma_u, sigma_w),
        speed_m_s=mil_mean_speed_m_s(wind),
    )


def mil_mean_speed_m_s(wind: DrydenMil) -> float:
    """MIL-F-8785C's mean wind at the altitude: u20 ln(h / z_0) / ln(20 ft / z_0)."""
    h_ft = max(wind.altitude_m / FOOT_M, PROFILE_FLOOR_FT)
    return wind.speed_20ft_m_s * log(h_ft / ROUGHNESS_FT) / log(REFERENCE_FT / ROUGHNESS_FT)


def density(omega_rad_s: Array, scales: Scales, component: int) -> Array:
    """Eq 14: two-sided density, (m/s)^2 per rad/s, of component 0 (u), 1 (v) or 2 (w). Its integral is sigma^2."""
    sigma = scales.sigma_m_s[component]
    travel_s = scales.length_m[component] / scales.speed_m_s
    a = travel_s * omega_rad_s
    level = sigma * sigma * travel_s / pi
    if component == 0:
        return level / (1.0 + a * a)
    return level * (1.0 + 12.0 * a * a) / (1.0 + 4.0 * a * a) ** 2


def shaping_filters(scales: Scales, second_order: bool, two_pi: bool) -> list[Filter]:
    """Filters of u, v, w: eq 17 as printed, or with `second_order` v and w filters that have eq 14's densities.

    Eq 16 with eq 14's density per rad/s asks for noise of intensity 2 pi; without `two_pi` it is 1.
    """
    filters = []
    for component in range(3):
        travel_s = scales.length_m[component] / scales.speed_m_s
        gain = scales.sigma_m_s[component] * sqrt(travel_s / pi)
        order = 2 if second_order and component else 1
        if component == 0:
            time_constant = travel_s
        elif order == 1:
            time_constant = 2.0 * travel_s / SQRT_3
        else:
            time_constant = 2.0 * travel_s
        filters.append(Filter(order, time_constant, gain, 2.0 * pi if two_pi else 1.0))
    return filters


def transition(filter_: Filter, dt_s: float) -> tuple[float, float]:
    """exp(A h) = [[e, 0], [c, e]] as (e, c); the first order has e alone, c = 0."""
    x = dt_s / filter_.time_constant_s
    e = exp(-x)
    return e, x * e if filter_.order == 2 else 0.0


def covariance(filter_: Filter, dt_s: float | None) -> tuple[float, float, float]:
    """Covariance (s1 s1, s1 s2, s2 s2) of what the noise adds over `dt_s`; of the stationary state for None."""
    y = None if dt_s is None else 2.0 * dt_s / filter_.time_constant_s
    level = filter_.intensity / (2.0 * filter_.time_constant_s)
    if filter_.order == 1:
        return level * _tail(1, y), 0.0, 0.0
    return level * _tail(1, y), 0.5 * level * _tail(2, y), 0.5 * level * _tail(3, y)


def cholesky(q_11: float, q_12: float, q_22: float) -> tuple[float, float, float]:
    """Lower factor (l_11, l_21, l_22) of a 2 x 2 covariance."""
    l_11 = sqrt(q_11)
    l_21 = q_12 / l_11
    return l_11, l_21, sqrt(max(q_22 - l_21 * l_21, 0.0))


def output(filter_: Filter) -> tuple[float, float]:
    """The output's weights of s1 and s2, m/s."""
    if filter_.order == 1:
        return filter_.gain, 0.0
    return filter_.gain * SQRT_3, filter_.gain * (1.0 - SQRT_3)


def sigma_m_s(filter_: Filter) -> float:
    """The output's stationary standard deviation."""
    q_11, q_12, q_22 = covariance(filter_, None)
    c_1, c_2 = output(filter_)
    return sqrt(c_1 * c_1 * q_11 + 2.0 * c_1 * c_2 * q_12 + c_2 * c_2 * q_22)


def _tail(k: int, y: float | None) -> float:
    """P(k, y) = 1 - exp(-y) sum of y^i / i! for i < k; 1 for None. For small y by its series, which does not cancel."""
    if y is None:
        return 1.0
    term = 1.0
    terms = [term]
    for i in range(1, 40):
        term *= y / i
        terms.append(term)
    if y < 2.0:
        return float(exp(-y) * np.sum(terms[: k - 1 : -1]))
    return float(1.0 - exp(-y) * sum(terms[:k]))
