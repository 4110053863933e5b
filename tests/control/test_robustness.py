"""Where the guards' projection box is inside the region of linear stability, and where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from mavsitl.control.pidnn import Pidnn
from mavsitl.scenario import Controller, Gains
from tests.control.linear_loop import Shares, closed_loop, held_plant, spectral_radius, unstable

CONTROLLER = Controller()
GAINS = CONTROLLER.roll_pitch
T_S = 0.004
PROJECTION = CONTROLLER.learning.projection or (1.0, 1.0)
GRID = np.linspace(PROJECTION[0], PROJECTION[1], 11)


@pytest.mark.parametrize("tau_s", [0.0, 0.005, 0.010, 0.015])
def test_every_weight_that_the_projection_allows_is_stable_up_to_15_ms(tau_s: float) -> None:
    assert unstable(GAINS, GRID, tau_s, T_S) == []


@pytest.mark.parametrize("tau_s", [0.0, 0.010, 0.020, 0.030])
def test_the_initial_weights_are_stable_with_every_rotor(tau_s: float) -> None:
    assert spectral_radius(GAINS, (1.0, 1.0, 1.0), tau_s, T_S) < 0.999


def test_with_20_ms_rotors_two_edges_of_the_box_are_unstable() -> None:
    """P at its top with D at its bottom or at its top."""
    found = {(round(p, 1), round(d, 1)) for p, _, d in unstable(GAINS, GRID, 0.020, T_S)}
    assert found == {(1.5, 0.5), (1.4, 1.5), (1.5, 1.5)}


def test_with_30_ms_rotors_a_third_of_the_box_is_unstable() -> None:
    """All four corners with P at its top, and D alone raised by a half: there the projection is no proof."""
    corners = unstable(GAINS, np.array(PROJECTION), 0.030, T_S)
    assert corners == [(1.5, 0.5, 0.5), (1.5, 0.5, 1.5), (1.5, 1.5, 0.5), (1.5, 1.5, 1.5)]
    found = {(round(p, 1), round(d, 1)) for p, _, d in unstable(GAINS, GRID, 0.030, T_S)}
    assert len(found) == 40
    assert {(0.9, 1.5), (1.0, 1.5), (1.1, 0.5), (1.4, 1.0)} <= found
    assert (1.0, 1.4) not in found
    assert (1.3, 1.0) not in found


def test_with_30_ms_rotors_a_smaller_box_is_stable() -> None:
    assert unstable(GAINS, np.linspace(0.7, 1.2, 11), 0.030, T_S) == []


def test_with_30_ms_rotors_a_slower_better_damped_pid_makes_the_whole_box_stable() -> None:
    slower = Gains(k_p_per_s2=576.0, k_i_per_s3=152.0, k_d_per_s=86.4)
    for tau_s in (0.0, 0.015, 0.030):
        assert unstable(slower, np.linspace(0.5, 1.5, 11), tau_s, T_S) == []


@pytest.mark.parametrize("tau_s", [0.0, 0.030])
@pytest.mark.parametrize("shares", [(1.0, 1.0, 1.0), (1.2, 0.7, 0.8)])
def test_the_linear_loop_is_the_law_that_flies(shares: Shares, tau_s: float) -> None:
    """A PIDNN with those weights on the held plant goes where the matrix goes."""
    a, b = held_plant(tau_s, T_S)
    loop = closed_loop(GAINS, shares, tau_s, T_S)
    net = Pidnn(GAINS, CONTROLLER.yaw, CONTROLLER.learning, T_S)
    net.weights *= np.array(shares)[:, np.newaxis, np.newaxis]
    state, late = np.array([0.1, -0.3, 0.0]), 0.0
    linear = np.array([0.1, -0.3, 0.0, 0.0, 0.0])
    for _ in range(100):
        angles, rates = np.zeros((3, 1)), np.zeros((3, 1))
        angles[0], rates[0] = state[0], state[1]
        demand = float(net.update(angles, rates, np.zeros((3, 1)), learn=False)[0, 0])
        state, late = a @ state + b * late, demand
        linear = loop @ linear
        assert state == pytest.approx(linear[:3], abs=1e-9)
    assert abs(state[0]) < 0.05
