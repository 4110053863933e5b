"""The inner loop: three decentralised PID neural networks (eqs 27-57), and the identical PID (eq 42) beside them.

Both laws act on acceleration: their output is an angular acceleration, which `mavsitl.control.mix` maps to U_2..U_4 by
I / l. Gains per second become eq 42's discrete coefficients by K_P = k_p, K_I = k_i t_s, K_D = k_d / t_s.

How the printed slips are resolved (docs: explanation/pidnn):

- Eqs 27 and 38 with x_1 = phi give u = phi - phi_d, which contradicts eq 40. Eq 40 is meant: here x_1 is the desired
  and x_2 the measured angle, so that w_1j = +1 and w_2j = -1 (eq 38) give u = e = phi_d - phi.
- Eq 37 has no value where its denominator vanishes: 0 there, so nothing is learned. The plant's sign is known, +1,
  which is the default.
- Eqs 43-49 bound the rate by the derivative of e. Eq 50 differentiates sqrt(2 E) in its place, with a factor 1/2 too
  many, which eqs 51-53, 55 and 56 inherit: with d e / d W = -o delta the bounds of eqs 54 and 57 are 2 / (...)^2, not
  8 / (...)^2.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from mavsitl.compiled import compiled, inlined
from mavsitl.control.arrays import Counts, Floats, Record, at, record
from mavsitl.scenario import Gains, Learning, Vector3

Derivative = Literal["rate", "difference"]

YAW = 2
TURN = 2.0 * math.pi
UNLIMITED: Vector3 = (math.inf, math.inf, math.inf)


@inlined
def _short_way(angle: float) -> float:
    """The same angle in [-pi, pi); one that lies there already comes back bit for bit."""
    turned: float = angle - TURN * np.floor((angle + math.pi) / TURN)
    return turned


@inlined
def _check(angles: Floats, rates: Floats, desired: Floats, desired_rates: Floats, out: Floats) -> None:
    if (
        angles.shape != out.shape
        or rates.shape != out.shape
        or desired.shape != out.shape
        or desired_rates.shape != out.shape
    ):
        raise ValueError("angles, rates, desired angles and desired rates must have shape (3, n)")


@compiled
def pid_step(
    angles: Floats,
    rates: Floats,
    desired: Floats,
    desired_rates: Floats,
    by_rate: bool,
    period: float,
    limit: Floats,
    gains: Floats,
    memory: Floats,
    out: Floats,
) -> None:
    """`AttitudePid.update`: fills `out` (3, n). From `by_rate` on all are `AttitudePid.record`'s."""
    _check(angles, rates, desired, desired_rates, out)
    for axis in range(3):
        for i in range(out.shape[1]):
            wanted = desired[axis, i]
            if axis == YAW:
                wanted -= TURN * np.floor((wanted - angles[axis, i] + math.pi) / TURN)
            error = wanted - angles[axis, i]
            if by_rate:
                difference = desired_rates[axis, i] * period - rates[axis, i] * period
            elif memory[2, axis, i] == 0.0:
                difference = 0.0
            else:
                difference = error - memory[1, axis, i]
                if axis == YAW:
                    difference = _short_way(difference)
            total = memory[0, axis, i] + error
            demand = gains[0, axis] * error + gains[1, axis] * total + gains[2, axis] * difference
            if (demand > limit[axis] and error > 0.0) or (demand < -limit[axis] and error < 0.0):
                total = memory[0, axis, i]
                demand = gains[0, axis] * error + gains[1, axis] * total + gains[2, axis] * difference
            memory[0, axis, i] = total
            memory[1, axis, i] = error
            memory[2, axis, i] = 1.0
            out[axis, i] = demand


@compiled
def net_step(
    angles: Floats,
    rates: Floats,
    desired: Floats,
    desired_rates: Floats,
    by_rate: bool,
    learn: bool,
    learn_inputs: bool,
    known_sign: bool,
    guarded: bool,
    settings: Floats,
    initial: Floats,
    memory: Floats,
    weights: Floats,
    input_weights: Floats,
    bounded: Counts,
    input_bounded: Counts,
    hidden: Floats,
    out: Floats,
) -> None:
    """`Pidnn.update`: fills `out` (3, n). But for `learn` all from `by_rate` on are `Pidnn.record`'s."""
    _check(angles, rates, desired, desired_rates, out)
    period = settings[0]
    bound = settings[1]
    low = settings[2]
    high = settings[3]
    pull = settings[4]
    dead_zone = settings[5]
    for axis in range(3):
        limit = settings[9 + axis]
        for i in range(out.shape[1]):
            # Input layer.
            x_2 = angles[axis, i]
            x_1 = desired[axis, i]
            if axis == YAW:
                x_1 -= TURN * np.floor((x_1 - x_2 + math.pi) / TURN)
            error = x_1 - x_2
            started = memory[4, axis, i] != 0.0

            # Hidden layer, eqs 27 and 28. With the rate as its input the D neuron's u_3(k) - u_3(k - 1) is measured.
            u_1 = input_weights[0, 0, axis, i] * x_1 + input_weights[1, 0, axis, i] * x_2
            u_2 = input_weights[0, 1, axis, i] * x_1 + input_weights[1, 1, axis, i] * x_2
            x_1d = x_1
            x_2d = x_2
            if by_rate:
                x_1d = desired_rates[axis, i] * period
                x_2d = rates[axis, i] * period
            u_3 = input_weights[0, 2, axis, i] * x_1d + input_weights[1, 2, axis, i] * x_2d
            if by_rate:
                o_3 = u_3
            elif not started:
                o_3 = 0.0
            else:
                o_3 = u_3 - memory[1, axis, i]
                if axis == YAW:
                    o_3 = _short_way(o_3)
            o_2 = memory[0, axis, i] + u_2

            # Output layer, eq 29.
            w_1 = weights[0, axis, i]
            w_2 = weights[1, axis, i]
            w_3 = weights[2, axis, i]
            demand = w_1 * u_1 + w_2 * o_2 + w_3 * o_3
            if (demand > limit and u_2 > 0.0) or (demand < -limit and u_2 < 0.0):
                o_2 = memory[0, axis, i]
                demand = w_1 * u_1 + w_2 * o_2 + w_3 * o_3
            hidden[0, axis, i] = u_1
            hidden[1, axis, i] = o_2
            hidden[2, axis, i] = o_3

            if learn:
                delta = 1.0
                if not known_sign:
                    # Eq 37: the sign of a quotient is the product of the signs.
                    delta = 0.0
                    if started:
                        moved = x_2 - memory[2, axis, i]
                        if axis == YAW:
                            moved = _short_way(moved)
                        changed = demand - memory[3, axis, i]
                        if (moved > 0.0 and changed > 0.0) or (moved < 0.0 and changed < 0.0):
                            delta = 1.0
                        elif (moved > 0.0 and changed < 0.0) or (moved < 0.0 and changed > 0.0):
                            delta = -1.0
                active = delta != 0.0 and not (guarded and abs(error) < dead_zone)
                for j in range(3):
                    start = initial[j, axis]
                    weight = weights[j, axis, i]
                    if learn_inputs:
                        # Eqs 34, 36 and 57, with the output weight that made this demand.
                        for side in range(2):
                            start_input = 1.0 if side == 0 else -1.0
                            value = input_weights[side, j, axis, i]
                            step = 0.0
                            if active and start > 0.0:
                                x = x_1 if side == 0 else x_2
                                if j == 2:
                                    x = x_1d if side == 0 else x_2d
                                slope = weight * x * delta
                                eta = settings[6 + j] / start
                                if bound > 0.0 and eta * slope * slope > bound:
                                    eta = bound / (slope * slope)
                                    input_bounded[side, j, axis, i] += 1
                                step = eta * error * slope
                            if guarded:
                                value += step + pull * (start_input - value)
                                magnitude = value * start_input
                                if magnitude < low:
                                    value = low * start_input
                                elif magnitude > high:
                                    value = high * start_input
                            else:
                                value += step
                            input_weights[side, j, axis, i] = value
                    # Eqs 31, 33 and 54.
                    step = 0.0
                    if active:
                        slope = hidden[j, axis, i] * delta
                        eta = settings[6 + j] * start
                        if bound > 0.0 and eta * slope * slope > bound:
                            eta = bound / (slope * slope)
                            bounded[j, axis, i] += 1
                        step = eta * error * slope
                    if guarded:
                        weight += step + pull * (start - weight)
                        if weight < low * start:
                            weight = low * start
                        elif weight > high * start:
                            weight = high * start
                    else:
                        weight += step
                    weights[j, axis, i] = weight
            memory[0, axis, i] = o_2
            memory[1, axis, i] = u_3
            memory[2, axis, i] = x_2
            memory[3, axis, i] = demand
            memory[4, axis, i] = 1.0
            out[axis, i] = demand


def initial_weights(roll_pitch: Gains, yaw: Gains, period_s: float) -> Floats:
    """Eq 39: the discrete K_P, K_I, K_D of eqs 41, 42, (3 outputs, 3 axes), for gains on angular acceleration."""
    return np.array(
        [[g.k_p_per_s2, g.k_i_per_s3 * period_s, g.k_d_per_s / period_s] for g in (roll_pitch, roll_pitch, yaw)]
    ).T.copy()


def _check_period(period_s: float) -> float:
    if not period_s > 0.0:
        raise ValueError(f"period_s: {period_s} is not allowed; it must be greater than 0")
    return float(period_s)


class AttitudePid:
    """The conventional PID that a `Pidnn` starts as (eq 42), on roll, pitch and yaw of n vehicles.

    U = K_P e + K_I sum(e) + K_D [e(k) - e(k - 1)]. `derivative` says what stands in the bracket: ``difference``, the
    bracket itself (0 at the first update), or ``rate``, t_s (desired rate - body rate), the body rate standing for the
    angle's. The yaw error takes the short way round. `limit_rad_s2` is the angular acceleration that the airframe can
    give: the sum stands still while the demand exceeds it and the error pushes further (the output itself is not cut).
    """

    def __init__(
        self,
        roll_pitch: Gains,
        yaw: Gains,
        period_s: float,
        derivative: Derivative = "rate",
        limit_rad_s2: Vector3 = UNLIMITED,
        n: int = 1,
    ) -> None:
        """Raises `ValueError` for a period that is not > 0."""
        self._period = _check_period(period_s)
        self._by_rate = derivative == "rate"
        self._gains = initial_weights(roll_pitch, yaw, period_s)
        self._limit = np.array(limit_rad_s2)
        self._memory = np.zeros((3, 3, n))
        self._at_rest = np.zeros((3, n))
        self.demand_flu_rad_s2 = np.zeros((3, n))

    def update(
        self,
        angles_rad: Floats,
        omega_flu_rad_s: Floats,
        desired_rad: Floats,
        desired_rates_rad_s: Floats | None = None,
        learn: bool = True,
    ) -> Floats:
        """As `Pidnn.update`; there is nothing to learn, whatever `learn` says."""
        pid_step(
            angles_rad,
            omega_flu_rad_s,
            desired_rad,
            self._at_rest if desired_rates_rad_s is None else desired_rates_rad_s,
            self._by_rate,
            self._period,
            self._limit,
            self._gains,
            self._memory,
            self.demand_flu_rad_s2,
        )
        return self.demand_flu_rad_s2

    def record(self) -> Record:
        """What `pid_step` takes beside its inputs, as it stands, by the names of its parameters."""
        return record(
            by_rate=self._by_rate,
            period=self._period,
            limit=self._limit,
            gains=self._gains,
            memory=self._memory,
            out=self.demand_flu_rad_s2,
        )

    def reset(self, vehicle: int | None = None) -> None:
        """Empty the sums and forget the last errors of one vehicle, or of all."""
        self._memory[..., at(vehicle)] = 0.0
        self.demand_flu_rad_s2[:, at(vehicle)] = 0.0


class Pidnn:
    """Three decentralised PIDNNs (roll, pitch, yaw) of n vehicles, eqs 27-57, with the guards that keep them stable.

    Forward (eqs 27-29), per axis: u_j = w_1j phi_d + w_2j phi; o_1 = u_1, o_2 = o_2(k-1) + u_2, o_3 = u_3 - u_3(k-1);
    U = sum w'_j o_j. With `derivative` ``rate`` the D neuron's inputs are t_s times the desired and the body rate, and
    o_3 = u_3. With no learning every output is bit for bit `AttitudePid`'s; `limit_rad_s2` acts as there.

    Learning (eqs 30-37), after the output: with e = phi_d - phi in rad,

        w'_j += eta_j e o_j delta,           eta_j = rate_j w'_j(0)               eqs 31, 33
        w_ij += eta_ij e w'_j x_i delta,     eta_ij = rate_j / w'_j(0)            eqs 34, 36, only if learned

    so that one rate moves both layers by comparable shares of their initial values per step (a weight that starts at 0
    stays there). A rate above the bound of eqs 54, 57 is cut to it and counted. Guards: nothing is learned from
    an error below the dead zone; leakage pulls each weight towards its initial value, also within the dead zone;
    projection holds it within multiples of that value. Input weights, if learned, have the same guards about +1 and -1.
    """

    def __init__(
        self,
        roll_pitch: Gains,
        yaw: Gains,
        learning: Learning,
        period_s: float,
        derivative: Derivative = "rate",
        limit_rad_s2: Vector3 = UNLIMITED,
        n: int = 1,
    ) -> None:
        """Raises `ValueError` for a period not > 0, or a leakage of 1 or more per period."""
        self._period = _check_period(period_s)
        if learning.guards and not learning.leakage_per_s * period_s < 1.0:
            raise ValueError(
                f"learning.leakage_per_s: {learning.leakage_per_s} is not below {1.0 / period_s} (one per period)"
            )
        low, high = learning.projection
        self._by_rate = derivative == "rate"
        self._learn_inputs = learning.input_weights == "learned"
        self._known_sign = learning.delta == "known"
        self._guarded = learning.guards
        self._settings = np.array(
            [
                self._period,
                {"derived": 2.0, "printed": 8.0, "none": 0.0}[learning.bound],
                low,
                high,
                learning.leakage_per_s * period_s,
                math.radians(learning.dead_zone_deg),
                *learning.rate,
                *limit_rad_s2,
            ]
        )
        self.initial = initial_weights(roll_pitch, yaw, period_s)
        """w'_j(0), (3 outputs, 3 axes)."""
        self.weights = np.empty((3, 3, n))
        """w'_j, (3 outputs P I D, 3 axes roll pitch yaw, n)."""
        self.input_weights = np.empty((2, 3, 3, n))
        """w_ij, (2 inputs desired measured, 3 neurons, 3 axes, n)."""
        self.hidden = np.zeros((3, 3, n))
        """o_j of the last update, (3 neurons, 3 axes, n), rad."""
        self.rate_bounded: Counts = np.zeros((3, 3, n), dtype=np.int64)
        """How often eq 54's bound cut the rate of an output weight, shaped as `weights`."""
        self.input_rate_bounded: Counts = np.zeros((2, 3, 3, n), dtype=np.int64)
        """How often eq 57's bound cut the rate of an input weight, shaped as `input_weights`."""
        self._memory = np.zeros((5, 3, n))
        self._at_rest = np.zeros((3, n))
        self.demand_flu_rad_s2 = np.zeros((3, n))
        self.reset()

    def update(
        self,
        angles_rad: Floats,
        omega_flu_rad_s: Floats,
        desired_rad: Floats,
        desired_rates_rad_s: Floats | None = None,
        learn: bool = True,
    ) -> Floats:
        """One period: angular acceleration (3, n) in rad/s^2, FLU, overwritten by the next call.

        `angles_rad` and `desired_rad` (3, n) are Z-Y-X roll, pitch, yaw of FLU in NWU; `omega_flu_rad_s` (3, n) is the
        body rate; `desired_rates_rad_s` (3, n), None for 0, enters only with the ``rate`` derivative. `learn` False
        leaves all weights alone, leakage included. Raises `ValueError` for a wrong shape.
        """
        net_step(
            angles_rad,
            omega_flu_rad_s,
            desired_rad,
            self._at_rest if desired_rates_rad_s is None else desired_rates_rad_s,
            self._by_rate,
            learn,
            self._learn_inputs,
            self._known_sign,
            self._guarded,
            self._settings,
            self.initial,
            self._memory,
            self.weights,
            self.input_weights,
            self.rate_bounded,
            self.input_rate_bounded,
            self.hidden,
            self.demand_flu_rad_s2,
        )
        return self.demand_flu_rad_s2

    def record(self) -> Record:
        """What `net_step` takes beside its inputs and `learn`, as it stands, by the names of its parameters."""
        return record(
            by_rate=self._by_rate,
            learn_inputs=self._learn_inputs,
            known_sign=self._known_sign,
            guarded=self._guarded,
            settings=self._settings,
            initial=self.initial,
            memory=self._memory,
            weights=self.weights,
            input_weights=self.input_weights,
            bounded=self.rate_bounded,
            input_bounded=self.input_rate_bounded,
            hidden=self.hidden,
            out=self.demand_flu_rad_s2,
        )

    def reset(self, vehicle: int | None = None) -> None:
        """Start again as the identical PID (eqs 38, 39), one vehicle or all: weights, neurons, counters."""
        which = at(vehicle)
        self.weights[..., which] = self.initial if vehicle is not None else self.initial[..., np.newaxis]
        self.input_weights[0, ..., which] = 1.0
        self.input_weights[1, ..., which] = -1.0
        self.hidden[..., which] = 0.0
        self.rate_bounded[..., which] = 0
        self.input_rate_bounded[..., which] = 0
        self._memory[..., which] = 0.0
        self.demand_flu_rad_s2[:, which] = 0.0
