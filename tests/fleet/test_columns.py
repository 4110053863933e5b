"""A simulation's columns: what is one vehicle's is no other's, and a column is the vehicle alone, bit for bit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint
from mavsitl_vehicle.failures import Failures, Kind, Unit
from mavsitl_vehicle.simulation import BLOCK_TICKS, Simulation
from mavsitl_vehicle.tick import Array

from mavsitl.scenario import Gust, load

FLIGHT = load("hover-wind")
TICKS = 2 * BLOCK_TICKS + 30
CHANGED_AT = BLOCK_TICKS - 20
"""When the other vehicles have drawn for the next block."""


class Columns:
    """Vehicles that hold an attitude in the air, each with parameters and failures of its own."""

    def __init__(self, n: int, *, first: int = 0, shared_wind: bool = False) -> None:
        parameters = (FLIGHT.airframe.parameters, FLIGHT.scenario.parameters)
        self.parameters = [Parameters(*parameters) for _ in range(n)]
        self.failures = [Failures() for _ in range(n)]
        self.simulation = Simulation(FLIGHT, self.parameters, 1, n, self.failures, first=first, shared_wind=shared_wind)
        for j, own in enumerate(self.parameters):
            own.subscribe(self._listener(j))
        self.simulation.held[:] = False
        for j in range(n):
            self.simulation.set_demand(j, AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 0.0, 0.5))
        self.winds: list[Array] = []
        self.flown: list[Array] = []

    def _listener(self, j: int) -> Callable[[str, float], None]:
        return lambda name, value: self.simulation.set_parameter(j, name)

    def run(self, ticks: int, flight_time_s: Callable[[int], float | Array] = lambda tick: 0.004 * tick) -> None:
        for tick in range(ticks):
            self.simulation.advance(flight_time_s(tick))
            self.winds.append(self.simulation.wind.copy())
            self.flown.append(np.vstack((self.simulation.x, self.simulation.estimate)))


def _gains(columns: Columns) -> None:
    columns.parameters[1].put("MC_ROLL_P", 3.0)


def _noise(columns: Columns) -> None:
    columns.parameters[1].put("SIM_NOISE_SCALE", 5.0)


def _mass(columns: Columns) -> None:
    columns.parameters[1].put("SIM_MASS_SCALE", 1.3)


def _wind(columns: Columns) -> None:
    columns.parameters[1].put("SIM_WIND_SPD", 4.0)


def _turbulence(columns: Columns) -> None:
    columns.parameters[1].put("SIM_WIND_TURB", 1)


def _gust(columns: Columns) -> None:
    columns.simulation.blow(1, Gust(velocity_nwu_m_s=(5.0, 0.0, 0.0), start_s=0.0, length_s=1.0))


def _motor(columns: Columns) -> None:
    columns.failures[1].set(Unit.MOTOR, Kind.GARBAGE, 2)


def _stall(columns: Columns) -> None:
    columns.simulation.stall(1, True)


def _upright(columns: Columns) -> None:
    columns.simulation.set_upright(1)


def _back(columns: Columns) -> None:
    columns.simulation.put_back(1)


def _demand(columns: Columns) -> None:
    columns.simulation.set_demand(1, None)


CHANGES = (_gains, _noise, _mass, _wind, _turbulence, _gust, _motor, _stall, _upright, _back, _demand)


@pytest.fixture(scope="module")
def untouched() -> Array:
    columns = Columns(3)
    columns.run(TICKS)
    return np.array(columns.flown)


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_of_one_vehicle_is_none_of_the_others(change: Callable[[Columns], None], untouched: Array) -> None:
    columns = Columns(3)
    columns.run(CHANGED_AT)
    change(columns)
    columns.run(TICKS - CHANGED_AT, lambda tick: 0.004 * (CHANGED_AT + tick))
    flown = np.array(columns.flown)
    for other in (0, 2):
        assert (flown[:, :, other] == untouched[:, :, other]).all()
    assert (flown[:CHANGED_AT, :, 1] == untouched[:CHANGED_AT, :, 1]).all()
    assert (flown[CHANGED_AT + 1, :, 1] != untouched[CHANGED_AT + 1, :, 1]).any()


def test_a_column_is_the_vehicle_alone_whatever_the_size(untouched: Array) -> None:
    for n, first, columns in ((1, 0, [0]), (5, 0, [0, 1, 2]), (1, 2, [2]), (2, 1, [1, 2])):
        alone = Columns(n, first=first)
        alone.run(TICKS)
        flown = np.array(alone.flown)
        for column in columns:
            assert (flown[:, :, column - first] == untouched[:, :, column]).all()


def test_vehicles_are_in_different_air_unless_it_is_shared() -> None:
    own, shared = Columns(3), Columns(3, shared_wind=True)
    for columns in (own, shared):
        columns.run(TICKS)
    winds = np.array(own.winds)
    assert (winds[:, :, 0] != winds[:, :, 1]).any(axis=1).all()
    winds = np.array(shared.winds)
    assert (winds == winds[:, :, :1]).all()
    assert np.abs(np.diff(winds[:, 0, 0])).max() > 0.0
    flown = np.array(shared.flown)
    assert (flown[-1, 17:, 0] != flown[-1, 17:, 1]).any(), "each has noise of its own"


def test_with_shared_wind_a_vehicles_own_wind_is_on_top() -> None:
    columns = Columns(3, shared_wind=True)
    columns.run(CHANGED_AT)
    columns.parameters[1].put("SIM_WIND_SPD", 4.0)  # from the north
    columns.parameters[1].put("SIM_WIND_TURB", 1)
    columns.run(TICKS - CHANGED_AT)
    winds = np.array(columns.winds)
    assert (winds[:, :, 0] == winds[:, :, 2]).all()
    assert (winds[:CHANGED_AT, :, 1] == winds[:CHANGED_AT, :, 0]).all()
    added = (winds[CHANGED_AT:, :, 1] - winds[CHANGED_AT:, :, 0]).mean(axis=0)
    assert added[0] == pytest.approx(-4.0, abs=1.5)
    assert abs(added[2]) < 1.5


def test_gusts_go_by_each_vehicles_own_flight() -> None:
    columns = Columns(2)
    for j in range(2):
        columns.simulation.blow(j, Gust(velocity_nwu_m_s=(0.0, 0.0, 9.0), start_s=0.0, length_s=0.1))
    columns.run(25, lambda tick: np.array([0.004 * tick, -1.0]))
    winds = np.array(columns.winds)[:, 2]
    assert winds[-1, 0] - winds[0, 0] > 4.0
    assert abs(winds[-1, 1] - winds[0, 1]) < 4.0


def test_no_tick_draws_for_the_whole_fleet() -> None:
    """What is drawn for the next block is drawn while this one flies, a few vehicles at a time."""
    columns = Columns(50)
    drawn: list[int] = []
    columns.simulation._wind_normals._draw = lambda each, steps: drawn.append(each)
    most = 0
    for _ in range(BLOCK_TICKS):
        before = len(drawn)
        columns.simulation.advance(0.0)
        most = max(most, len(drawn) - before)
    assert sorted(drawn) == list(range(1, 50))
    assert most == 1


def test_sensors_take_a_simulation_for_each_vehicle() -> None:
    flight = load("hover-wind-ekf")
    parameters = [Parameters(flight.airframe.parameters, flight.scenario.parameters) for _ in range(2)]
    with pytest.raises(ValueError, match="a simulation each"):
        Simulation(flight, parameters, 1, 2)
