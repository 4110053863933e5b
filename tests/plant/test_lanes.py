"""Vehicles side by side in a block of lanes: the same bits as each alone, whatever its neighbours do."""

from __future__ import annotations

import re

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle import tick
from mavsitl_vehicle.plant import lanes
from mavsitl_vehicle.plant import parameters as rows
from mavsitl_vehicle.plant.lanes import LANES, scratch
from mavsitl_vehicle.plant.parameters import N_PARAMETERS, parameters_of, plant_parameters
from mavsitl_vehicle.plant.state import N_STATES, Array
from mavsitl_vehicle.plant.step import rk4_step
from mavsitl_vehicle.wind.field import WindField

from mavsitl.compiled import JIT
from mavsitl.scenario import DrydenPaper, Offnominal
from tests.plant.flight import PAPER, REALISTIC, Fleet


def fleet_of(seed: int, n: int, ground_share: float) -> Fleet:
    """Any attitude, speeds up to tumbling, in wind; some on the ground or in it, some held, some with dead rotors."""
    rng = np.random.default_rng(seed)
    fleet = Fleet(ground=True, n=n)
    fleet.parameters[:, ::2] = plant_parameters(REALISTIC, Offnominal(mass_scale=1.2), True, 1)
    fleet.x[:] = rng.normal(0.0, 1.0, fleet.x.shape)
    fleet.x[2] = np.where(rng.random(n) < ground_share, rng.uniform(-0.02, 0.05, n), rng.uniform(0.5, 50.0, n))
    fleet.x[6:10] /= np.linalg.norm(fleet.x[6:10], axis=0)
    fleet.x[13:] = rng.uniform(0.0, PAPER.max_rotor_speed_rad_s, (4, n))
    fleet.wind[:] = rng.normal(0.0, 5.0, (3, n))
    fleet.command[:] = PAPER.max_rotor_speed_rad_s * rng.uniform(-0.1, 1.1, (4, n))
    fleet.held[:] = rng.random(n) < 0.1
    return fleet


def alone(fleet: Fleet, j: int, dt_s: float) -> Array:
    x, command, wind, parameters = (
        np.ascontiguousarray(array[:, j : j + 1]) for array in (fleet.x, fleet.command, fleet.wind, fleet.parameters)
    )
    rk4_step(x, command, wind, parameters, dt_s, fleet.held[j : j + 1].copy(), scratch(1))
    return x[:, 0]


@given(st.integers(0, 2**32 - 1), st.sampled_from([16, 17, 40]), st.sampled_from([0.0, 0.1, 1.0]))
def test_a_step_in_lanes_is_the_step_alone(seed: int, n: int, ground_share: float) -> None:
    fleet = fleet_of(seed, n, ground_share)
    expected = np.stack([alone(fleet, j, 1.0e-3) for j in range(n)], axis=-1)
    rk4_step(fleet.x, fleet.command, fleet.wind, fleet.parameters, 1.0e-3, fleet.held, scratch(n))
    assert fleet.x.tobytes() == expected.tobytes()


def test_touching_during_a_step_is_seen() -> None:
    """A vehicle that is above the ground's reach at a step's start, and below it in its course, is pushed."""
    fleet, free = Fleet(ground=True, n=LANES), Fleet(n=LANES)
    for each in (fleet, free):
        each.x[2] = 1.0
        each.x[2, 5] = fleet.parameters[rows.CONTACT_REACH, 5] + 1.0e-4
        each.x[5, 5] = -100.0
        each.run(5.0e-3, 5.0e-3)
    assert fleet.x[5, 5] > free.x[5, 5] + 0.1
    others = np.arange(LANES) != 5
    np.testing.assert_array_equal(fleet.x[:, others], free.x[:, others])


def test_a_broken_neighbour_breaks_nobody() -> None:
    fleet, whole = fleet_of(1, LANES, 0.3), fleet_of(1, LANES, 0.3)
    fleet.x[:, 7] = np.nan
    for each in (fleet, whole):
        each.run(0.02)
    others = np.arange(LANES) != 7
    np.testing.assert_array_equal(fleet.x[:, others], whole.x[:, others])


def test_a_block_holds_all_rows() -> None:
    parameters = np.arange(float(N_PARAMETERS))[:, np.newaxis] + np.zeros(LANES)
    block = np.zeros(lanes.BLOCK_SIZE)
    lanes.gather(block, lanes.PARAMETERS, N_PARAMETERS, parameters, 0)
    assert parameters_of(parameters, 3) == tuple(range(N_PARAMETERS))
    assert lanes.parameters_in(block, 3) == tuple(range(N_PARAMETERS))
    assert block.reshape(-1, LANES).shape[0] == 2 * N_STATES + 4 + 3 + N_PARAMETERS + 2
    assert scratch(LANES - 1) is None


@pytest.mark.parametrize("n", [16, 21])
def test_a_control_period_of_a_fleet_is_each_vehicle_s_own(n: int) -> None:
    """The wind's filters, rate loop, allocation, rotors, body and measurement: column by column the same bits."""
    substeps, periods = 4, 5
    field = WindField((DrydenPaper(),), n, 1.0e-3)
    rng = np.random.default_rng(3)
    field.reset(rng.standard_normal((field.normals_for_reset, n)))
    fleet = fleet_of(2, n, 0.3)
    demand = np.zeros((tick.DEMAND_ROWS, n))
    demand[tick.KIND] = rng.choice([tick.STOPPED, tick.TORQUE_KIND, tick.RATE_KIND, tick.ATTITUDE_KIND], n)
    demand[tick.ATTITUDE : tick.ATTITUDE + 4] = [[1.0], [0.0], [0.0], [0.0]]
    demand[tick.THRUST] = 0.6
    gains = np.full((tick.GAIN_ROWS, n), 0.1)
    gains[tick.MAX_ROTOR_SPEED] = PAPER.max_rotor_speed_rad_s
    gains[tick.THRUST_COEFFICIENT] = PAPER.thrust_coefficient_n_s2
    gains[tick.DRAG_COEFFICIENT] = PAPER.drag_coefficient_n_m_s2
    motors = np.ones((tick.MOTOR_ROWS, n))
    motors[tick.FIXED_SPEED : tick.FIXED_SPEED + 4] = np.nan
    wind_normals = rng.standard_normal((periods, substeps * field.normals_per_step, n))
    sensor_normals = rng.standard_normal((periods, substeps * tick.GYRO_NORMALS + tick.MEASURE_NORMALS, n))
    rows = np.zeros((tick.ROWS, n))
    for begin, block in (
        (tick.X, fleet.x), (tick.WIND_AT, fleet.wind), (tick.MOTORS_AT, motors), (tick.COMMAND_AT, fleet.command),
        (tick.GAINS_AT, gains), (tick.PLANT_AT, fleet.parameters),
    ):  # fmt: skip
        rows[begin : begin + len(block)] = block
    rows[tick.SIGMA_AT : tick.PLANT_AT] = 0.01

    def fly(columns: slice) -> Array:
        own, state = rows[:, columns].copy(), field.state[:, columns].copy()
        asked, held = demand.T[columns].copy(), fleet.held[columns].copy()
        log = np.zeros((1, tick.LOG_WIDTH, own.shape[1]))
        winds = np.ascontiguousarray(wind_normals[..., columns])
        noise = np.ascontiguousarray(sensor_normals[..., columns])
        for k in range(periods):
            tick.advance(
                own,
                asked,
                held,
                state,
                field.coefficients,
                winds,
                noise,
                log,
                scratch(own.shape[1]),
                k,
                1.0e-3,
                substeps,
            )
        return np.concatenate([own, state, log[0]])

    together = fly(slice(None))
    assert np.isfinite(together[: tick.X_ROWS]).all()
    for j in range(n):
        assert fly(slice(j, j + 1))[:, 0].tobytes() == together[:, j].tobytes()


@pytest.mark.skipif(not JIT, reason="un-jitted, nothing is compiled")
def test_the_loops_over_the_lanes_are_vectors() -> None:
    """The compiler says nothing when it gives up: every square root of both loops is one of a vector."""
    fresh = numba.njit(error_model="numpy")(rk4_step.py_func)  # type: ignore[attr-defined]
    fleet = fleet_of(1, LANES, 0.0)
    fresh(fleet.x, fleet.command, fleet.wind, fleet.parameters, 1.0e-3, fleet.held, scratch(LANES))
    (code,) = fresh.inspect_llvm().values()
    in_the_air, legs, stages = 1, 4, 4
    assert len(re.findall(r"call <\d+ x double> @llvm\.sqrt", code)) >= in_the_air + (1 + legs * stages)
