"""What a step of the plant costs: ``python -m tests.bench.bench_plant``. Nanoseconds of the processor for each vehicle.

The rows take turns, round by round, so that other load on the machine meets all alike; a row's figure is its best
round. Everything runs on one thread. Simulators from the package index (extra ``bench``) are rows of the same run; one
that is not installed says so.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from time import process_time
from typing import Any, NamedTuple

# Before anything is imported that reads them: one thread, and what crazyflow asks for.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("SCIPY_ARRAY_API", "1")

import numpy as np
from mavsitl_vehicle import tick
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint
from mavsitl_vehicle.plant.lanes import LANES, scratch
from mavsitl_vehicle.plant.parameters import plant_parameters
from mavsitl_vehicle.plant.state import Array, initial_state
from mavsitl_vehicle.plant.step import rk4_step
from mavsitl_vehicle.simulation import Simulation
from mavsitl_vehicle.wind.field import WindField, wind_step
from numpy.typing import NDArray
from rich.progress import track

from mavsitl import scenario
from mavsitl.compiled import compiled
from mavsitl.scenario import DrydenPaper, Offnominal, load_airframe

DT_S = 1.0e-3
FLEET = 128
BATCHES = (LANES, FLEET, 1024)
"""Of the others, which gain by larger ones."""
BLOCK_STEPS = 1000
"""Normals are drawn for so many steps at once, as the simulation does."""

Run = Callable[[int], object]
"""So many steps of all vehicles of a row."""


class Row(NamedTuple):
    name: str
    content: str
    n: int
    make: Callable[[], Run]
    share: float = 1.0
    """Of the vehicle-steps that the others do in a round: less for the slow."""


@compiled
def steps(
    count: int, x: Array, command: Array, wind: Array, parameters: Array, held: NDArray[np.bool_],
    state: Array, coefficients: Array, normals: Array, blows: bool, block: Array | None,
) -> None:  # fmt: skip
    now_s = np.empty(x.shape[1])
    for k in range(count):
        if blows:
            now_s[:] = k * DT_S
            wind_step(state, coefficients, normals[k], now_s, wind)
        rk4_step(x, command, wind, parameters, DT_S, held, block)


def ours(n: int, *, height_m: float = 1.0e3, blows: bool = False, draws: bool = False) -> Run:
    """The plant alone: in hover, or at rest on the ground; in turbulence; drawing the turbulence's normals as well."""
    airframe = load_airframe("realistic")
    speed = airframe.hover_rotor_speed_rad_s if height_m > 0.0 else 0.0
    start = initial_state((0.0, 0.0, height_m), 0.3, speed, n)
    command, wind = np.full((4, n), speed), np.zeros((3, n))
    parameters = plant_parameters(airframe, Offnominal(), True, n)
    held = np.zeros(n, dtype=np.bool_)
    field = WindField((DrydenPaper(),), n, DT_S)
    generators = [np.random.default_rng(j) for j in range(n)]

    def draw(count: int) -> Array:
        return np.stack([g.standard_normal((count, field.normals_per_step)) for g in generators], axis=-1)

    drawn = draw(BLOCK_STEPS)

    def run(count: int) -> None:
        x = start.copy()
        for done in range(0, count, BLOCK_STEPS):
            now = min(BLOCK_STEPS, count - done)
            normals = draw(now) if draws else drawn
            steps(now, x, command, wind, parameters, held, field.state, field.coefficients, normals, blows, scratch(n))

    return run


def period(n: int) -> Run:
    """`tick.advance` of hover-wind in free flight: its kernel and the call from Python; normals drawn before."""
    flight = scenario.load("hover-wind")
    own = Parameters(flight.airframe.parameters, flight.scenario.parameters)
    simulation = Simulation(flight, own, 1, n)
    simulation.held[:] = False
    for j in range(n):
        simulation.set_demand(j, AttitudeSetpoint((1.0, 0.0, 0.0, 0.0), 0.0, 0.5))
    simulation.x[2] = 1.0e3
    start, s = simulation.x.copy(), simulation

    def run(count: int) -> None:
        s.x[:] = start
        for k in range(count):
            tick.advance(
                s._rows, s._asked, s.held, s.field.state, s.field.coefficients, s._wind_normals.block,
                s._sensor_normals.block, s._log, s._block, k, s.dt_s, s.substeps,
            )  # fmt: skip

    return run


def rotorpy() -> Run:
    from rotorpy.vehicles.hummingbird_params import quad_params
    from rotorpy.vehicles.multirotor import Multirotor

    vehicle = Multirotor(quad_params)
    control = {"cmd_motor_speeds": vehicle.initial_state["rotor_speeds"]}

    def run(count: int) -> None:
        state = vehicle.initial_state
        for _ in range(count):
            state = vehicle.step(state, control, DT_S)

    return run


def l2f_single() -> Run:
    import l2f

    device, environment, parameters, generator = l2f.Device(), l2f.Environment(), l2f.Parameters(), l2f.Rng()
    state, after = l2f.State(), l2f.State()
    l2f.initialize_environment(device, environment)
    l2f.initialize_rng(device, generator, 0)
    l2f.initial_parameters(device, environment, parameters)
    action = np.zeros(4, dtype=np.float32)

    def run(count: int) -> None:
        l2f.initial_state(device, environment, parameters, state)
        for _ in range(count):
            l2f.step(device, environment, parameters, state, action, after, generator)
            state.assign(after)

    return run


def l2f_vector(n: int) -> Run:
    import l2f

    of = l2f.vector_selector[n]
    device, environment, parameters, generators = (
        l2f.Device(),
        of.VectorEnvironment(),
        of.VectorParameters(),
        of.VectorRng(),
    )
    state, after = of.VectorState(), of.VectorState()
    of.initialize_rng(device, generators, 0)
    of.initialize_environment(device, environment)
    of.initial_parameters(device, environment, parameters)
    action = np.zeros((n, 4), dtype=np.float32)

    def run(count: int) -> None:
        of.initial_state(device, environment, parameters, state)
        for _ in range(count):
            of.step(device, environment, parameters, state, action, after, generators)
            state.assign(after)

    return run


def crazyflow(n: int) -> Run:
    import jax
    from crazyflow.control import Control
    from crazyflow.sim import Dynamics, Sim
    from crazyflow.sim.integration import Integrator

    hertz = round(1.0 / DT_S)
    sim: Any = Sim(
        n_worlds=n,
        dynamics=Dynamics.first_principles,
        control=Control.rotor_vel,
        integrator=Integrator.rk4,
        freq=hertz,
        state_freq=hertz,
        attitude_freq=hertz,
        body_rate_freq=hertz,
        force_torque_freq=hertz,
    )

    def run(count: int) -> None:
        sim.reset()
        sim.step(count)
        jax.block_until_ready(sim.data)

    return run


def our_rows() -> list[Row]:
    rows = []
    for n in (1, LANES, FLEET):
        name = "mavsitl, one vehicle" if n == 1 else f"mavsitl, {n} in lanes"
        rows += [
            Row(name, "calm air, RK4, float64", n, partial(ours, n)),
            Row(name, "on the ground", n, partial(ours, n, height_m=0.0)),
            Row(name, "Dryden wind", n, partial(ours, n, blows=True)),
            Row(name, "Dryden wind and drawing its normals", n, partial(ours, n, blows=True, draws=True)),
        ]
    return rows


def period_rows() -> list[Row]:
    content = "a period of tick.advance: 4 steps, wind, noise, loops"
    return [Row(f"mavsitl, {n} of a fleet", content, n, partial(period, n), 0.1) for n in (1, LANES, FLEET)]


def rival_rows() -> list[Row]:
    single = "Sim.step, JAX on the CPU, RK4, float32, rotor lag"
    return [
        Row("rotorpy, one vehicle", "Multirotor.step, RK45 of SciPy, float64, rotor lag, drag", 1, rotorpy, 0.002),
        Row("l2f, one vehicle", "step, RK4, float32, rotor lag; the call from Python", 1, l2f_single, 0.1),
        *(Row(f"l2f, {n}", "as above, n in one call", n, partial(l2f_vector, n), 0.2) for n in BATCHES),
        Row("crazyflow, one vehicle", single, 1, partial(crazyflow, 1), 0.01),
        *(Row(f"crazyflow, {n}", "as above, n worlds", n, partial(crazyflow, n), 0.2) for n in BATCHES),
    ]


def measure(rows: Sequence[Row], rounds: int, vehicle_steps: int, show: bool) -> dict[Row, float | str]:
    """Nanoseconds for each vehicle and step (or period), the best of `rounds`; or why there is no figure."""
    best: dict[Row, float | str] = {}
    runs: dict[Row, tuple[Run, int]] = {}
    for row in rows:
        count = max(round(row.share * vehicle_steps / row.n), 1)
        try:
            run = row.make()
        except ImportError as error:
            best[row] = f"not installed: {error.name}"
            continue
        run(count)  # compiles
        runs[row] = run, count
        best[row] = inf
    for _ in track(range(rounds), "rounds", disable=not show):
        for row, (run, count) in runs.items():
            started = process_time()
            run(count)
            spent = (process_time() - started) / (count * row.n) * 1e9
            best[row] = min(spent, float(best[row]))
    return best


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.bench_plant", description=__doc__)
    parser.add_argument("--rounds", type=int, default=15, metavar="N", help="rounds (default: 15)")
    parser.add_argument(
        "--steps", type=int, default=100_000, metavar="N", help="vehicle-steps a round (default: 100000)"
    )
    parser.add_argument("--ours", action="store_true", help="no other simulators")
    options = parser.parse_args(argv)
    rows = our_rows() + period_rows() + ([] if options.ours else rival_rows())
    for row, result in measure(rows, options.rounds, options.steps, show=True).items():
        figure = result if isinstance(result, str) else f"{result:,.0f} ns"
        print(f"{row.name:26} {row.content:58} {figure:>14}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
