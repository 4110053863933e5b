"""What one control period costs in lock-step, part by part: ``python -m tests.bench.bench_period``.

A flight is flown once in memory, and what crossed is kept. Then the vehicle flies it again and again against the kept
answers, and each part of each period is timed by itself. A flight is the same every time, so of each period's part the
shortest time counts: what else the machine did is in the others. The parts are added up over the flight.
"""

from __future__ import annotations

import argparse
import gc
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter_ns
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from mavsitl_ground.controller import Ground
from mavsitl_vehicle.vehicle import Vehicle
from rich.console import Console
from rich.progress import track

from mavsitl import drivers, ends, scenario
from mavsitl.drivers import FROM_GROUND, FROM_VEHICLE
from mavsitl.scenario import Flight

SCENARIO = "hover-wind"
PARTS = ("vehicle: step", "vehicle: datagrams", "vehicle: receive", "digest, tlog and flushing of logs")
CLOCK_NS = -max(perf_counter_ns() - perf_counter_ns() for _ in range(1000))
"""Between two readings of the clock with nothing between them."""


class Period(NamedTuple):
    """What crossed in one."""

    now_us: int
    telemetry: list[bytes]
    answers: list[bytes]


class _Kept:
    """A vehicle of which every period is kept."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.periods: list[Period] = []
        self._vehicle = vehicle

    def __getattr__(self, name: str) -> Any:
        return getattr(self._vehicle, name)

    def step(self, now_us: int) -> None:
        self.periods.append(Period(now_us, [], []))
        self._vehicle.step(now_us)

    def datagrams(self, port: int, *, combine: bool) -> list[bytes]:
        sent = self._vehicle.datagrams(port, combine=combine)
        self.periods[-1].telemetry.extend(sent)
        return sent

    def receive(self, port: int, datagram: bytes) -> int:
        self.periods[-1].answers.append(datagram)
        return self._vehicle.receive(port, datagram)


def fly(flight: Flight) -> list[Period]:
    """What crosses in each period of the flight."""
    vehicle: Any = _Kept(Vehicle(flight, ends.NullRecorder(), seed=flight.scenario.seed, lockstep=True))
    drivers.fly_in_memory(vehicle, Ground(flight, ends.NullRecorder()))
    return list(vehicle.periods)


def replay(flight: Flight, periods: list[Period], folder: Path | None) -> npt.NDArray[np.int64]:
    """Nanoseconds (periods, parts) of the vehicle's end, with its logs in `folder`; None: without."""
    taken = np.zeros((len(periods), len(PARTS)), dtype=np.int64)
    with ends._logs(folder, "vehicle", flight) as (recorder, tap):
        vehicle = Vehicle(flight, recorder, seed=flight.scenario.seed, lockstep=True)
        gc.collect()
        for number, (now_us, telemetry, answers) in enumerate(periods):
            begin = perf_counter_ns()
            vehicle.step(now_us)
            stepped = perf_counter_ns()
            sent = vehicle.datagrams(0, combine=True)
            packed = perf_counter_ns()
            for datagram in answers:
                vehicle.receive(0, datagram)
            received = perf_counter_ns()
            for datagram in telemetry:
                tap.hear(FROM_VEHICLE, now_us, datagram)
            for datagram in answers:
                tap.hear(FROM_GROUND, now_us, datagram)
            tap.tick(now_us)
            heard = perf_counter_ns()
            assert sent == telemetry, "the same flight gives the same bytes"
            taken[number] = stepped - begin, packed - stepped, received - packed, heard - received
    return taken - CLOCK_NS


def shortest(flight: Flight, periods: list[Period], runs: int, *, logs: bool, show: bool) -> npt.NDArray[np.float64]:
    """Microseconds (periods, parts), of each the shortest of so many runs; `show`: a progress bar on stderr."""
    best = np.full((len(periods), len(PARTS)), np.inf)
    label = "with logs" if logs else "without logs"
    for _ in track(range(runs), label, console=Console(stderr=True, quiet=not show), transient=True):
        with tempfile.TemporaryDirectory() as folder:
            best = np.minimum(best, replay(flight, periods, Path(folder) if logs else None) / 1e3)
    return best


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="What one control period costs in lock-step, part by part.")
    parser.add_argument("--duration", type=float, default=20.0, help="seconds of flight (%(default)g)")
    parser.add_argument("--runs", type=int, default=15, help="of which the shortest counts (%(default)d)")
    options = parser.parse_args(arguments)
    flight = scenario.load(SCENARIO, {"duration_s": options.duration})
    periods = fly(flight)
    print(f"{SCENARIO}, {len(periods)} periods; microseconds a period")
    for logs in (False, True):
        taken = shortest(flight, periods, options.runs, logs=logs, show=sys.stderr.isatty())
        rows = {**dict(zip(PARTS, taken.T, strict=True)), "together": taken.sum(axis=1)}
        print(f"\n| the vehicle's end, {'with' if logs else 'without'} logs | mean | median |\n|---|---:|---:|")
        for name, parts in rows.items():
            print(f"| {name} | {parts.mean():.2f} | {np.median(parts):.2f} |")


if __name__ == "__main__":
    main()
