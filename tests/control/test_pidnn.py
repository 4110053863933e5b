"""Eqs 27-57."""

from __future__ import annotations

from collections.abc import Callable
from math import pi, radians, sqrt
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavsitl.control.arrays import Floats
from mavsitl.control.pidnn import AttitudePid, Derivative, Pidnn, initial_weights
from mavsitl.scenario import Gains, Learning, Vector3
from tests.control.linear_loop import held_plant

T_S = 0.004
ROLL_PITCH = Gains(k_p_per_s2=961.0, k_i_per_s3=328.0, k_d_per_s=92.4)
YAW = Gains(k_p_per_s2=130.0, k_i_per_s3=148.0, k_d_per_s=22.8)
START = initial_weights(ROLL_PITCH, YAW, T_S)
PLAIN = Learning(guards=False, bound="none")
UNLIMITED: Vector3 = (float("inf"), float("inf"), float("inf"))
NO_RATE = np.zeros((3, 1))
MODES: tuple[Derivative, ...] = ("rate", "difference")


def build(
    learning: Learning = PLAIN, derivative: Derivative = "difference", limit: Vector3 = UNLIMITED, n: int = 1
) -> Pidnn:
    return Pidnn(ROLL_PITCH, YAW, learning, T_S, derivative, limit, n)


def plain(**changes: Any) -> Learning:
    return msgspec.structs.replace(PLAIN, **changes)


def axes(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Floats:
    return np.array([[roll], [pitch], [yaw]])


def test_eq_39_in_the_discrete_sense_of_eq_42() -> None:
    assert START[:, 0] == pytest.approx([961.0, 328.0 * T_S, 92.4 / T_S])
    assert START[:, 2] == pytest.approx([130.0, 148.0 * T_S, 22.8 / T_S])
    net = build(n=2)
    assert (net.weights == START[:, :, np.newaxis]).all()
    assert (net.input_weights[0] == 1.0).all()
    assert (net.input_weights[1] == -1.0).all()


def test_eqs_27_to_29_and_38_to_42_by_hand() -> None:
    """e = phi_d - phi goes through: eq 40's sign, not that of eq 38 with x_1 = phi."""
    net = build()
    measured, wanted = [0.10, 0.12, 0.11], [0.30, 0.25, 0.35]
    errors = [w - m for m, w in zip(measured, wanted, strict=True)]
    for k, (phi, phi_d) in enumerate(zip(measured, wanted, strict=True)):
        demand = net.update(axes(phi), NO_RATE, axes(phi_d), learn=False)[0, 0]
        difference = errors[k] - errors[k - 1] if k else 0.0
        assert net.hidden[:, 0, 0] == pytest.approx([errors[k], sum(errors[: k + 1]), difference])
        k_p, k_i, k_d = START[:, 0]
        assert demand == pytest.approx(k_p * errors[k] + k_i * sum(errors[: k + 1]) + k_d * difference)


def test_eqs_27_to_29_with_other_input_weights() -> None:
    net = build()
    net.input_weights[:, :, 1, 0] = [[1.1, 1.2, 1.3], [-0.9, -0.8, -0.7]]
    net.update(axes(pitch=0.2), NO_RATE, axes(pitch=0.5), learn=False)
    net.update(axes(pitch=0.3), NO_RATE, axes(pitch=0.4), learn=False)
    u_2 = (1.2 * 0.5 - 0.8 * 0.2, 1.2 * 0.4 - 0.8 * 0.3)
    u_3 = (1.3 * 0.5 - 0.7 * 0.2, 1.3 * 0.4 - 0.7 * 0.3)
    assert net.hidden[:, 1, 0] == pytest.approx([1.1 * 0.4 - 0.9 * 0.3, sum(u_2), u_3[1] - u_3[0]])


def test_the_rate_neuron_gives_k_d_times_the_rate_difference() -> None:
    net = build(derivative="rate")
    demand = net.update(NO_RATE, axes(0.5, -0.3, 0.2), NO_RATE, learn=False)
    assert demand[:, 0] == pytest.approx([-92.4 * 0.5, 92.4 * 0.3, -22.8 * 0.2])
    demand = net.update(NO_RATE, axes(0.5), NO_RATE, axes(0.8), learn=False)
    assert demand[0, 0] == pytest.approx(92.4 * 0.3)


@given(seed=st.integers(0, 1000), mode=st.sampled_from(MODES), limited=st.booleans(), with_rates=st.booleans())
@settings(deadline=None, max_examples=40)
def test_it_starts_as_the_identical_pid_bit_for_bit(
    seed: int, mode: Derivative, limited: bool, with_rates: bool
) -> None:
    rng = np.random.default_rng(seed)
    limit = (50.0, 50.0, 3.6) if limited else UNLIMITED
    learning = Learning(rate=(0.0, 0.0, 0.0))
    net, pid = build(learning, mode, limit, n=3), AttitudePid(ROLL_PITCH, YAW, T_S, mode, limit, n=3)
    for _ in range(20):
        angles, rates, desired, desired_rates = (rng.normal(size=(3, 3)) for _ in range(4))
        rates_d = desired_rates if with_rates else None
        assert (net.update(angles, rates, desired, rates_d) == pid.update(angles, rates, desired, rates_d)).all()
    assert (net.weights == START[:, :, np.newaxis]).all()


def _gradient(net_at: Callable[[], Pidnn], nudge: Callable[[Pidnn, float], None], axis: int, size: float) -> float:
    """-dE/dw / c of E(k + 1) = e(k + 1)^2 / 2 through the plant phi(k + 1) = phi(k) + c U, by central differences."""
    c = 1e-9
    energies = []
    for sign in (1.0, -1.0):
        net = net_at()
        nudge(net, sign * size)
        angles, desired = _last_sample()
        demand = net.update(angles, NO_RATE, desired, learn=False)[axis, 0]
        energies.append(float(0.5 * (desired[axis, 0] - angles[axis, 0] - c * demand) ** 2))
    return -(energies[0] - energies[1]) / (2.0 * size) / c


def _last_sample() -> tuple[Floats, Floats]:
    return axes(0.10, -0.05, 0.4), axes(0.16, -0.11, 0.3)


def _warm(learning: Learning) -> Pidnn:
    net = build(learning)
    for k in range(5):
        net.update(axes(0.02 * k, 0.01 * k, -0.1), NO_RATE, axes(0.1, 0.03, 0.2), learn=False)
    return net


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("neuron", [0, 1, 2])
def test_eqs_30_to_33_descend_the_gradient(neuron: int, axis: int) -> None:
    learning = plain(rate=(1e-3, 2e-3, 3e-3))
    net = _warm(learning)
    before = net.weights[neuron, axis, 0]
    angles, desired = _last_sample()
    net.update(angles, NO_RATE, desired)
    eta = learning.rate[neuron] * START[neuron, axis]

    def nudge(other: Pidnn, by: float) -> None:
        other.weights[neuron, axis, 0] += by

    slope = _gradient(lambda: _warm(learning), nudge, axis, 0.01 * before)
    error = desired[axis, 0] - angles[axis, 0]
    assert (net.weights[neuron, axis, 0] - before) / eta == pytest.approx(slope, rel=1e-4)
    assert slope == pytest.approx(error * net.hidden[neuron, axis, 0], rel=1e-4)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("neuron", [0, 1, 2])
@pytest.mark.parametrize("side", [0, 1])
def test_eqs_34_to_36_descend_the_gradient(side: int, neuron: int, axis: int) -> None:
    learning = plain(rate=(1e-3, 2e-3, 3e-3), input_weights="learned")
    net = _warm(learning)
    before = net.input_weights[side, neuron, axis, 0]
    angles, desired = _last_sample()
    net.update(angles, NO_RATE, desired)
    eta = learning.rate[neuron] / START[neuron, axis]

    def nudge(other: Pidnn, by: float) -> None:
        other.input_weights[side, neuron, axis, 0] += by

    slope = _gradient(lambda: _warm(learning), nudge, axis, 0.01)
    assert (net.input_weights[side, neuron, axis, 0] - before) / eta == pytest.approx(slope, rel=1e-4)
    error, x = desired[axis, 0] - angles[axis, 0], (desired, angles)[side][axis, 0]
    assert slope == pytest.approx(error * START[neuron, axis] * x, rel=1e-4)


def test_the_rate_neurons_input_weights_learn_from_the_rates() -> None:
    net = build(plain(rate=(0.0, 0.0, 1e-3), input_weights="learned"), "rate")
    net.update(axes(0.1), axes(0.5), axes(0.3), axes(0.7))
    moved = net.input_weights[:, 2, 0, 0] - [1.0, -1.0]
    assert moved == pytest.approx(1e-3 * 0.2 * np.array([0.7, 0.5]) * T_S, rel=1e-9)


def test_fixed_input_weights_do_not_move() -> None:
    net = build(plain(rate=(1.0, 1.0, 1.0)))
    for _ in range(5):
        net.update(axes(0.1), NO_RATE, axes(0.3))
    assert (net.input_weights[0] == 1.0).all()
    assert (net.input_weights[1] == -1.0).all()


@pytest.mark.parametrize(
    ("angles", "expected"),
    [((0.10, 0.11), 1.0), ((0.11, 0.10), -1.0), ((0.10, 0.10), 0.0)],
    ids=["with the demand", "against it", "standing still"],
)
def test_eq_37_is_the_sign_of_the_quotient(angles: tuple[float, float], expected: float) -> None:
    net = build(plain(rate=(1e-3, 0.0, 0.0), delta="printed"), "rate")
    net.update(axes(angles[0]), NO_RATE, axes(0.2))
    assert (net.weights == START[:, :, np.newaxis]).all(), "nothing to compare with at the first update"
    net.update(axes(angles[1]), NO_RATE, axes(0.5))
    error = 0.5 - angles[1]
    moved = net.weights[0, 0, 0] - START[0, 0]
    assert moved == pytest.approx(1e-3 * START[0, 0] * error * error * expected, rel=1e-9)


def test_eq_37_takes_a_yaw_across_the_seam_as_the_small_turn_it_is() -> None:
    net = build(plain(rate=(1e-3, 0.0, 0.0), delta="printed"), "rate")
    net.update(axes(yaw=pi - 0.01), NO_RATE, axes(yaw=pi - 0.005))
    net.update(axes(yaw=-pi + 0.01), NO_RATE, axes(yaw=-pi + 0.11))
    assert net.weights[0, 2, 0] - START[0, 2] == pytest.approx(1e-3 * START[0, 2] * 0.01)


def test_eq_37_is_0_where_its_denominator_vanishes() -> None:
    still = Gains(k_p_per_s2=1.0, k_i_per_s3=0.0, k_d_per_s=0.0)
    net = Pidnn(still, still, plain(delta="printed"), T_S)
    net.update(axes(0.1), NO_RATE, axes(0.2))
    net.update(axes(0.2), NO_RATE, axes(0.3))
    net.update(axes(0.1), NO_RATE, axes(0.2))
    start = np.array([[[1.0]] * 3, [[0.0]] * 3, [[0.0]] * 3])
    assert net.weights[:, 1:] == pytest.approx(start[:, 1:])
    unmoved = Pidnn(still, still, plain(delta="printed"), T_S)
    unmoved.update(axes(0.125), NO_RATE, axes(0.25))
    unmoved.update(axes(0.25), NO_RATE, axes(0.375))
    assert unmoved.demand_flu_rad_s2[0, 0] == 0.125
    assert (unmoved.weights == start).all()


def _static_energy(weight: float, o: float, delta: float) -> float:
    """E of a static plant phi = delta w o, wanted 1."""
    return 0.5 * (1.0 - delta * weight * o) ** 2


@pytest.mark.parametrize(("o", "delta"), [(0.3, 1.0), (-2.0, 1.0), (0.7, -1.0), (5.0, 0.2)])
def test_eqs_43_to_54_the_bound_is_2_not_8(o: float, delta: float) -> None:
    """Eqs 43-49 hold; eqs 50-53 halve the derivative of sqrt(2 E), so that eq 54's 8 is 2."""
    weight, h = 0.1 / (o * delta), 1e-6
    error = 1.0 - delta * weight * o
    slope = (sqrt(2 * _static_energy(weight + h, o, delta)) - sqrt(2 * _static_energy(weight - h, o, delta))) / (2 * h)
    assert slope == pytest.approx(-o * delta, rel=1e-6)

    def change(eta: float) -> float:
        return _static_energy(weight + eta * error * o * delta, o, delta) - _static_energy(weight, o, delta)

    square = (o * delta) ** 2
    for share in (0.1, 1.0, 1.9):
        eta = share / square
        eq_47 = 0.5 * eta * (error * o * delta) ** 2 * (eta * square - 2.0)
        assert change(eta) == pytest.approx(eq_47)
        assert change(eta) < 0.0
    assert change(2.0 / square) == pytest.approx(0.0, abs=1e-12)
    assert change(2.1 / square) > 0.0
    assert change(8.0 / square) == pytest.approx(48.0 * _static_energy(weight, o, delta))


@pytest.mark.parametrize(("bound", "factor"), [("derived", 2.0), ("printed", 8.0)])
def test_eqs_54_and_57_cut_the_rates_and_count(bound: str, factor: float) -> None:
    net = build(plain(rate=(1e6, 0.0, 0.0), bound=bound, input_weights="learned"), n=2)
    phi, phi_d = 0.1, 0.3
    angles, desired = np.zeros((3, 2)), np.zeros((3, 2))
    angles[0, 1], desired[0, 1] = phi, phi_d
    net.update(angles, np.zeros((3, 2)), desired)
    error = phi_d - phi
    w = START[0, 0]
    assert net.weights[0, 0, 1] - w == pytest.approx(factor / error**2 * error * error)
    for side, x in enumerate((phi_d, phi)):
        moved = net.input_weights[side, 0, 0, 1] - (1.0, -1.0)[side]
        assert moved == pytest.approx(factor / (w * x) ** 2 * error * w * x)
    assert net.rate_bounded.sum() == 1
    assert net.rate_bounded[0, 0, 1] == 1
    assert net.input_rate_bounded.sum() == 2
    assert (net.input_rate_bounded[:, 0, 0, 1] == 1).all()


def test_without_a_bound_no_rate_is_cut() -> None:
    net = build(plain(rate=(1e3, 0.0, 0.0)))
    net.update(axes(0.1), NO_RATE, axes(0.3))
    assert net.weights[0, 0, 0] - START[0, 0] == pytest.approx(1e3 * START[0, 0] * 0.04)
    assert not net.rate_bounded.any()


@pytest.mark.parametrize("learn_inputs", ["fixed", "learned"])
@given(seed=st.integers(0, 1000))
@settings(deadline=None, max_examples=15)
def test_projection_holds_every_weight(learn_inputs: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    learning = msgspec.structs.replace(
        Learning(), rate=(1e4, 1e4, 1e4), bound="none", input_weights=learn_inputs, delta="printed"
    )
    net = build(learning, n=4)
    for _ in range(50):
        net.update(rng.normal(size=(3, 4)), np.zeros((3, 4)), rng.normal(size=(3, 4)))
        share = net.weights / START[:, :, np.newaxis]
        assert (share >= 0.5 - 1e-15).all()
        assert (share <= 1.5 + 1e-15).all()
        assert (abs(net.input_weights) >= 0.5).all()
        assert (abs(net.input_weights) <= 1.5).all()
        assert (net.input_weights[0] > 0.0).all()
        assert (net.input_weights[1] < 0.0).all()
    assert share.min() == pytest.approx(0.5)
    assert share.max() == pytest.approx(1.5)


def test_leakage_goes_back_at_its_rate_within_the_dead_zone_too() -> None:
    net = build(Learning(leakage_per_s=0.5))
    net.weights[:] *= 1.2
    for _ in range(100):
        net.update(NO_RATE, NO_RATE, NO_RATE)
    assert net.weights[:, :, 0] == pytest.approx(START * (1.0 + 0.2 * (1.0 - 0.5 * T_S) ** 100))


def test_nothing_is_learned_within_the_dead_zone() -> None:
    learning = Learning(leakage_per_s=0.0, dead_zone_deg=0.1)
    net = build(learning)
    net.update(NO_RATE, NO_RATE, axes(radians(0.0999), -radians(0.0999), radians(0.0999)))
    assert (net.weights[:, :, 0] == START).all()
    net.update(NO_RATE, NO_RATE, axes(radians(0.1001), -radians(0.1001), radians(0.1001)))
    assert (net.weights[0, :, 0] > START[0]).all()


def test_unguarded_there_is_no_dead_zone_leakage_or_projection() -> None:
    net = build(plain(rate=(1e3, 0.0, 0.0), leakage_per_s=1.0, dead_zone_deg=10.0))
    for _ in range(20):
        net.update(NO_RATE, NO_RATE, axes(0.1))
    assert net.weights[0, 0, 0] == pytest.approx(START[0, 0] * (1.0 + 20 * 1e3 * 0.01))
    assert (net.weights[:, 1, 0] == START[:, 1]).all()


def test_learn_off_leaves_every_weight_alone() -> None:
    net = build(Learning(input_weights="learned"))
    net.weights[:] *= 1.3
    before = net.weights.copy()
    net.update(axes(0.1), NO_RATE, axes(0.3), learn=False)
    assert (net.weights == before).all()
    assert (abs(net.input_weights) == 1.0).all()


def _fly_roll(net: Pidnn, seconds: float, seed: int) -> tuple[float, float, float]:
    """Roll behind 20 ms rotors, demands a period late, in turbulence: time flown, largest angle, P weight's share."""
    a, b = held_plant(0.020, T_S)
    rng = np.random.default_rng(seed)
    state = np.zeros(3)
    push = late = worst = 0.0
    flown = 0
    while flown < int(seconds / T_S) and worst <= 1.0:
        demand = float(net.update(axes(state[0]), axes(state[1]), NO_RATE)[0, 0])
        push += -2.0 * T_S * push + 16.0 * sqrt(T_S) * float(rng.normal())
        state = a @ state + b * late
        state[0] += 0.5 * T_S * T_S * push
        state[1] += T_S * push
        late = demand
        worst = max(worst, abs(float(state[0])))
        flown += 1
    return flown * T_S, worst, float(net.weights[0, 0, 0]) / float(START[0, 0])


def test_the_printed_law_runs_away_and_the_guarded_one_does_not() -> None:
    printed = Learning(rate=(100.0, 100.0, 100.0), guards=False, bound="printed")
    flown, worst, share = _fly_roll(build(printed, "rate"), 30.0, 3)
    assert flown < 20.0
    assert worst > 1.0
    assert share > 1.5
    guarded = msgspec.structs.replace(printed, guards=True, bound="derived")
    flown, worst, share = _fly_roll(build(guarded, "rate"), 30.0, 3)
    assert flown == pytest.approx(30.0)
    assert worst < 0.1
    assert 1.0 < share <= 1.5


@given(st.lists(st.floats(-0.3, 0.3), min_size=2, max_size=30))
@settings(deadline=None, max_examples=50)
def test_as_printed_the_p_weight_can_only_grow(errors: list[float]) -> None:
    """Eq 33 with o_1 = e: its step is eta e^2 delta, never negative for delta = +1."""
    net = build(plain(bound="printed"))
    for error in errors:
        before = net.weights[0, 0, 0]
        net.update(NO_RATE, NO_RATE, axes(error))
        assert net.weights[0, 0, 0] >= before
    assert (net.weights[0, 0, 0] > START[0, 0]) == any(abs(e) > 1e-7 for e in errors) or max(map(abs, errors)) < 1e-6


@pytest.mark.parametrize("law", ["net", "pid"])
@pytest.mark.parametrize("mode", MODES)
def test_yaw_turns_the_short_way(law: str, mode: Derivative) -> None:
    controller: Pidnn | AttitudePid = (
        build(Learning(), mode) if law == "net" else AttitudePid(ROLL_PITCH, YAW, T_S, mode)
    )
    demand = controller.update(axes(yaw=pi - 0.1), NO_RATE, axes(yaw=-pi + 0.1), learn=False)[2, 0]
    assert demand == pytest.approx((START[0, 2] + START[1, 2]) * 0.2)
    # The measured angle passes the seam: the error shrinks by 0.05 and its difference does not jump.
    demand = controller.update(axes(yaw=-pi - 0.05), NO_RATE, axes(yaw=-pi + 0.1), learn=False)[2, 0]
    change = START[2, 2] * -0.05 if mode == "difference" else 0.0
    assert demand == pytest.approx(START[0, 2] * 0.15 + START[1, 2] * 0.35 + change)


@pytest.mark.parametrize("mode", MODES)
def test_a_yaw_error_that_passes_half_a_turn_has_no_jump_in_its_difference(mode: Derivative) -> None:
    net = build(PLAIN, mode)
    net.update(axes(yaw=0.0), NO_RATE, axes(yaw=pi - 0.01), learn=False)
    net.update(axes(yaw=-0.02), NO_RATE, axes(yaw=pi - 0.01), learn=False)
    assert net.hidden[0, 2, 0] == pytest.approx(-pi + 0.01)
    assert net.hidden[2, 2, 0] == pytest.approx(0.02 if mode == "difference" else 0.0)


@pytest.mark.parametrize("law", ["net", "pid"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_integral_stands_still_while_the_airframe_cannot_follow(law: str, sign: float) -> None:
    limit = (100.0, 100.0, 3.6)
    controller: Pidnn | AttitudePid = (
        build(PLAIN, "rate", limit) if law == "net" else AttitudePid(ROLL_PITCH, YAW, T_S, "rate", limit)
    )
    for _ in range(500):
        demand = controller.update(NO_RATE, NO_RATE, axes(yaw=sign * 1.0), learn=False)[2, 0]
    assert demand == pytest.approx(sign * START[0, 2])
    for _ in range(3):
        demand = controller.update(NO_RATE, NO_RATE, axes(yaw=sign * 0.01), learn=False)[2, 0]
    assert demand == pytest.approx(sign * (START[0, 2] * 0.01 + START[1, 2] * 0.03))


def test_reset_of_one_vehicle_leaves_the_others() -> None:
    net, pid = build(Learning(input_weights="learned"), n=2), AttitudePid(ROLL_PITCH, YAW, T_S, n=2)
    angles, zero = np.full((3, 2), 0.2), np.zeros((3, 2))
    for _ in range(3):
        net.update(angles, zero, zero)
        pid.update(angles, zero, zero)
    net.reset(0)
    pid.reset(0)
    assert (net.weights[..., 0] == START).all()
    assert (net.weights[..., 1] != START).any()
    fresh = build(Learning(input_weights="learned"), n=2).update(angles, zero, zero)
    again = net.update(angles, zero, zero)
    assert (again[:, 0] == fresh[:, 0]).all()
    assert (again[:, 1] != fresh[:, 1]).all()
    assert (pid.update(angles, zero, zero)[:, 0] == fresh[:, 0]).all()
    net.reset()
    assert (net.weights == START[:, :, np.newaxis]).all()
    assert not net.rate_bounded.any()


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="leakage"):
        build(Learning(leakage_per_s=250.0))
    with pytest.raises(ValueError, match="period"):
        AttitudePid(ROLL_PITCH, YAW, 0.0)
    with pytest.raises(ValueError, match="shape"):
        build().update(np.zeros((3, 2)), NO_RATE, NO_RATE)
    with pytest.raises(ValueError, match="shape"):
        AttitudePid(ROLL_PITCH, YAW, T_S).update(NO_RATE, NO_RATE, np.zeros((2, 1)))
