"""Where the guards' projection box is inside the region of linear stability, and where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from mavsitl.control.pidnn import Pidnn
from mavsitl.scenario import Controller, load
from tests.control.linear_loop import Shares, closed_loop, held_plant, unstable

CONTROLLER = Controller()
GAINS = CONTROLLER.roll_pitch
T_S = 0.004
PROJECTION = CONTROLLER.learning.projection
GRID = np.linspace(PROJECTION[0], PROJECTION[1], 11)


LAGGED = load("hover-wind-realistic")


@pytest.mark.parametrize("tau_s", [0.0, 0.005])
def test_every_weight_that_the_projection_allows_is_stable_for_ideal_and_fast_rotors(tau_s: float) -> None:
    assert unstable(GAINS, GRID, tau_s, T_S) == []


def test_every_weight_that_the_projection_allows_is_stable_in_the_scenario_for_30_ms_rotors() -> None:
    assert LAGGED.airframe.rotor_time_constant_s == 0.030
    for tau_s in (0.0, 0.015, 0.030):
        assert unstable(LAGGED.scenario.controller.roll_pitch, GRID, tau_s, T_S) == []


@pytest.mark.parametrize("tau_s", [0.010, 0.020, 0.030])
def test_the_default_gains_are_not_for_lagging_rotors(tau_s: float) -> None:
    """The projection is no proof there; at 30 ms even the initial weights are unstable."""
    assert unstable(GAINS, GRID, tau_s, T_S) != []


@pytest.mark.parametrize("tau_s", [0.0, 0.030])
@pytest.mark.parametrize("shares", [(1.0, 1.0, 1.0), (1.2, 0.7, 0.8)])
def test_the_linear_loop_is_the_law_that_flies(shares: Shares, tau_s: float) -> None:
    """A PIDNN with those weights on the held plant goes where the matrix goes."""
    gains = LAGGED.scenario.controller.roll_pitch
    a, b = held_plant(tau_s, T_S)
    loop = closed_loop(gains, shares, tau_s, T_S)
    net = Pidnn(gains, CONTROLLER.yaw, CONTROLLER.learning, T_S)
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
