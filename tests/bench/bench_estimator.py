"""What the filter costs in time: ``python -m tests.bench.bench_estimator``.

A control period of the simulation alone, and a flight in one process without logs, for each kind of estimator; the
kinds take turns, so that load meets both alike.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from statistics import median
from time import process_time

from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.simulation import Simulation

from mavsitl import ends, scenario

SCENARIO = "hover-wind"
KINDS = ("white-noise", "ekf")


def period_us(kind: str, periods: int) -> float:
    """Microseconds of the processor's time for one control period of the simulation, aligned, in the clamp."""
    flight = scenario.load(SCENARIO, {"estimator.kind": kind})
    simulation = Simulation(flight, Parameters(flight.airframe.parameters, flight.scenario.parameters), 1)
    for _ in range(250):
        simulation.advance(-1.0)
    started = process_time()
    for _ in range(periods):
        simulation.advance(-1.0)
    return (process_time() - started) / periods * 1e6


def speed(kind: str, duration_s: float) -> float:
    """Times real time."""
    flight = scenario.load(SCENARIO, {"estimator.kind": kind, "duration_s": duration_s})
    return ends.in_memory(flight, None, report=lambda text: None, progress=None).speed


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.bench_estimator", description=__doc__)
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="rounds (default: 5)")
    parser.add_argument("--duration", type=float, default=20.0, metavar="S", help="flight time (default: 20)")
    options = parser.parse_args(argv)
    periods: dict[str, list[float]] = {kind: [] for kind in KINDS}
    speeds: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for _ in range(options.rounds):
        for kind in KINDS:
            periods[kind].append(period_us(kind, round(options.duration * 250.0)))
            speeds[kind].append(speed(kind, options.duration))
    for kind in KINDS:
        print(
            f"{kind:12} {min(periods[kind]):6.1f} us a control period of the simulation, "
            f"{median(speeds[kind]):5.1f} x real time in one process"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
