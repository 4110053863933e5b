"""The wind of a scenario: all its models, summed and advanced by one compiled step. It draws no random numbers."""

from __future__ import annotations

from collections.abc import Mapping
from math import cos, pi, radians, sin

import numpy as np

from mavsitl.compiled import compiled
from mavsitl.scenario import DrydenMil, DrydenPaper, Gust, Steady, Wind
from mavsitl_vehicle.wind import dryden
from mavsitl_vehicle.wind.dryden import Array

# Columns of `coefficients`, one row for each thing that blows.
MODEL = 0
DIRECTION = 1
"""Columns 1:4, NWU: the velocity of a steady wind or gust, the unit vector of a turbulence component."""
GUST_START = 4
GUST_LENGTH = 5
DECAY = 4
CROSS = 5
NOISE_11 = 6
NOISE_21 = 7
NOISE_22 = 8
OUT_1 = 9
OUT_2 = 10
VEHICLE = 11
"""The one it blows on; `EVERY`: all of them."""
STATE_ROW = 12
"""Its first row of the turbulence's state."""
N_COLUMNS = 13

EVERY = -1.0

# Values of MODEL.
STEADY = 0.0
GUST_PULSE = 1.0
GUST_RAMP = 2.0
FIRST_ORDER = 3.0
SECOND_ORDER = 4.0


@compiled
def gust_share(time_s: float, start_s: float, length_s: float, pulse: bool) -> float:
    """The 1-cosine gust: from 0 at `start_s` to 1 after `length_s`; a pulse then falls as slowly, a ramp stays."""
    phase = (time_s - start_s) / length_s
    if phase <= 0.0 or (pulse and phase >= 2.0):
        return 0.0
    if phase >= 1.0 and not pulse:
        return 1.0
    return 0.5 - 0.5 * cos(pi * phase)


@compiled
def wind_step(state: Array, coefficients: Array, normals: Array, time_s: Array, wind_nwu_m_s: Array) -> None:
    """Write the wind at `time_s` into `wind_nwu_m_s` (3, n), then advance the turbulence's `state` by one step.

    `state` (normals_per_step, n) and `coefficients` (k, 13) are the `WindField`'s; `normals` has the shape of `state`.
    `time_s` (n,) is each vehicle's, by which its gusts go.
    """
    n = wind_nwu_m_s.shape[1]
    for axis in range(3):
        for j in range(n):
            wind_nwu_m_s[axis, j] = 0.0

    for k in range(coefficients.shape[0]):
        model = coefficients[k, MODEL]
        row = int(coefficients[k, STATE_ROW])
        first, last = 0, n
        if coefficients[k, VEHICLE] >= 0.0:
            first = int(coefficients[k, VEHICLE])
            last = first + 1
        to_x, to_y, to_z = coefficients[k, DIRECTION], coefficients[k, DIRECTION + 1], coefficients[k, DIRECTION + 2]
        if model < FIRST_ORDER:
            share = 1.0
            for j in range(first, last):
                if model != STEADY:
                    share = gust_share(
                        time_s[j], coefficients[k, GUST_START], coefficients[k, GUST_LENGTH], model == GUST_PULSE
                    )
                wind_nwu_m_s[0, j] += to_x * share
                wind_nwu_m_s[1, j] += to_y * share
                wind_nwu_m_s[2, j] += to_z * share
        elif model == FIRST_ORDER:
            decay, noise, out = coefficients[k, DECAY], coefficients[k, NOISE_11], coefficients[k, OUT_1]
            for j in range(first, last):
                s = state[row, j]
                speed = out * s
                wind_nwu_m_s[0, j] += to_x * speed
                wind_nwu_m_s[1, j] += to_y * speed
                wind_nwu_m_s[2, j] += to_z * speed
                state[row, j] = decay * s + noise * normals[row, j]
        else:
            decay, cross = coefficients[k, DECAY], coefficients[k, CROSS]
            noise_11, noise_21 = coefficients[k, NOISE_11], coefficients[k, NOISE_21]
            noise_22 = coefficients[k, NOISE_22]
            out_1, out_2 = coefficients[k, OUT_1], coefficients[k, OUT_2]
            for j in range(first, last):
                s_1 = state[row, j]
                s_2 = state[row + 1, j]
                speed = out_1 * s_1 + out_2 * s_2
                wind_nwu_m_s[0, j] += to_x * speed
                wind_nwu_m_s[1, j] += to_y * speed
                wind_nwu_m_s[2, j] += to_z * speed
                xi_1 = normals[row, j]
                xi_2 = normals[row + 1, j]
                state[row, j] = decay * s_1 + noise_11 * xi_1
                state[row + 1, j] = cross * s_1 + decay * s_2 + noise_21 * xi_1 + noise_22 * xi_2


class WindField:
    """The sum of a scenario's winds over `n` vehicles, in steps of `dt_s`; each vehicle has turbulence of its own.

    After `reset` with normals the turbulence is stationary; before, it starts from calm. Compiled callers pass `state`
    (normals_per_step, n) and `coefficients` (k, 13) to `wind_step`; others call `step`.
    Raises `ValueError` for `n` below 1 or a `dt_s` that is not positive.
    """

    def __init__(
        self, winds: tuple[Wind, ...], n: int, dt_s: float, own: Mapping[int, tuple[Wind, ...]] | None = None
    ) -> None:
        """`own`: by vehicle, what blows on that one alone, on top of `winds`."""
        if n < 1 or not dt_s > 0.0:
            raise ValueError(f"n = {n}, dt_s = {dt_s}: a wind field needs a vehicle and a step")
        self.n = n
        self.dt_s = dt_s
        self._rows: list[Array] = []
        self._filters = self._add(winds, EVERY, 0)
        common = sum(filter_.order for filter_ in self._filters)
        self.own_normals = [0] * n
        """Of `normals_per_step` those that each vehicle's own winds take, after the common ones."""
        for j, blowing in (own or {}).items():
            self.own_normals[j] = sum(filter_.order for filter_ in self._add(blowing, j, common))
        self._gusts: dict[int, Array] = {}
        self.coefficients: Array = np.zeros((0, N_COLUMNS))
        self._stack()
        self.normals_per_step = common + max(self.own_normals)
        """Standard normals for each vehicle and step: the first axis of `step`'s and `wind_step`'s normals."""
        self.normals_for_reset = common
        """Standard normals for each vehicle that `reset` takes."""
        self.state: Array = np.zeros((self.normals_per_step, n))

    def _add(self, winds: tuple[Wind, ...], vehicle: float, state_row: int) -> list[dryden.Filter]:
        """Rows of `winds`; the filters among them, whose state begins at `state_row`."""
        found: list[dryden.Filter] = []
        dt_s = self.dt_s

        def put(row: list[float]) -> None:
            self._rows.append(_coefficients(row, vehicle, state_row))

        for wind in winds:
            match wind:
                case Steady():
                    put([STEADY, *wind.velocity_nwu_m_s])
                    continue
                case Gust():
                    put(_gust_row(wind))
                    continue
                case DrydenPaper(speed_20ft_m_s=0.0) | DrydenMil(speed_20ft_m_s=0.0):
                    continue
                case DrydenPaper():
                    axes = np.eye(3)
                    filters = dryden.shaping_filters(
                        dryden.paper_scales(wind), wind.form == "spectrum", wind.intensity == "two-pi"
                    )
                case DrydenMil():
                    axes = mil_axes(wind.from_deg)
                    filters = dryden.shaping_filters(dryden.mil_scales(wind), second_order=True, two_pi=True)
                    if wind.include_mean:
                        put([STEADY, *(dryden.mil_mean_speed_m_s(wind) * axes[0])])
            for filter_, axis in zip(filters, axes, strict=True):
                model = FIRST_ORDER if filter_.order == 1 else SECOND_ORDER
                noise = dryden.cholesky(*dryden.covariance(filter_, dt_s))
                put([model, *axis, *dryden.transition(filter_, dt_s), *noise, *dryden.output(filter_)])
                state_row += filter_.order
            found += filters
        return found

    def _stack(self) -> None:
        self.coefficients = np.vstack((np.zeros((0, N_COLUMNS)), *self._rows, *self._gusts.values()))
        self.gusty = bool(np.isin(self.coefficients[:, MODEL], (GUST_PULSE, GUST_RAMP)).any())
        """It goes by the flight's time."""

    def blow(self, vehicle: int, gust: Gust | None) -> None:
        """A gust on one vehicle, on top and in place of its last one; it needs no normals. None: it is over."""
        self._gusts.pop(vehicle, None)
        if gust is not None:
            self._gusts[vehicle] = _coefficients(_gust_row(gust), vehicle, 0)
        self._stack()

    def reset(self, normals: Array) -> None:
        """Draw the turbulence's state from its stationary distribution: `normals` (normals_for_reset, n), in place.

        Raises `ValueError` for normals of another shape.
        """
        self._check(normals, self.normals_for_reset)
        row = 0
        for filter_ in self._filters:
            l_11, l_21, l_22 = dryden.cholesky(*dryden.covariance(filter_, None))
            self.state[row] = l_11 * normals[row]
            if filter_.order == 2:
                self.state[row + 1] = l_21 * normals[row] + l_22 * normals[row + 1]
            row += filter_.order

    def step(self, time_s: float, normals: Array, wind_nwu_m_s: Array) -> None:
        """`wind_step` on this field's arrays: `normals` (normals_per_step, n) in, `wind_nwu_m_s` (3, n) out.

        `time_s` is that of all vehicles.

        Raises `ValueError` for arrays of another shape.
        """
        self._check(normals, self.normals_per_step)
        self._check(wind_nwu_m_s, 3)
        wind_step(self.state, self.coefficients, normals, np.full(self.n, time_s), wind_nwu_m_s)

    def _check(self, array: Array, rows: int) -> None:
        if array.shape != (rows, self.n):
            raise ValueError(f"an array of shape {array.shape}; ({rows}, {self.n}) is needed")


def _coefficients(row: list[float], vehicle: float, state_row: int) -> Array:
    """(1, N_COLUMNS)"""
    coefficients = np.zeros((1, N_COLUMNS))
    coefficients[0, : len(row)] = row
    coefficients[0, VEHICLE] = vehicle
    coefficients[0, STATE_ROW] = state_row
    return coefficients


def _gust_row(gust: Gust) -> list[float]:
    model = GUST_PULSE if gust.shape == "pulse" else GUST_RAMP
    return [model, *gust.velocity_nwu_m_s, gust.start_s, gust.length_s]


def mil_axes(from_deg: float) -> Array:
    """Rows u, v, w in NWU for a mean wind from `from_deg`, clockwise from north: u along it, w up, v = w x u."""
    angle = radians(from_deg)
    u_x, u_y = -cos(angle), sin(angle)
    return np.array([[u_x, u_y, 0.0], [-u_y, u_x, 0.0], [0.0, 0.0, 1.0]])
