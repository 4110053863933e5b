"""Lock-step beside its rivals in the same run: ``python -m tests.bench.bench_lockstep``.

mavsitl's rows: two processes over UDP with logs, as `mavsitl fly` runs them, both on one core; the same without logs;
with logs, but wherever the system puts them; and the same flight in one process, with and without logs.

The rivals, two processes over UDP each, all on one core: a C program that exchanges the same datagrams
(`rivals/exchange.c`), a loop of mavutil and numpy that does the same work as the flight (`rivals/full.py`), and one
that does much less (`rivals/lean.py`). Each has to end at its hover, or the benchmark fails.

The rows take turns, round by round, so that load meets all alike.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

from mavsitl import drivers, ends, pair, scenario, wings
from tests.bench.rivals import exchange, full, lean

SCENARIO = "hover-wind"
HOVER_M = 0.1
"""A rival that is further off does not fly."""
ALIKE = 0.01
"""Share by which the C program's datagrams may differ in size from ours, on average."""

SHIPPED, NO_LOGS, UNPINNED = (
    f"mavsitl, two processes over UDP, {how}" for how in ("as shipped", "no logs", "unpinned")
)
MEMORY, MEMORY_NO_LOGS = "mavsitl, one process, in memory", "mavsitl, one process, in memory, no logs"
C, FULL, LEAN = "C, the same datagrams", "mavutil + numpy, the same work", "mavutil + numpy, much less work"

PYTHON_RIVALS: dict[str, Any] = {"full": full, "lean": lean}


@contextmanager
def one_core() -> Iterator[None]:
    """This process and those it starts meanwhile, on one core, where the system lets one choose."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def fly_pair(duration_s: float) -> float:
    """As `mavsitl fly`: two processes with logs, on one core where the system lets one choose. Times real time."""
    with tempfile.TemporaryDirectory() as folder:
        result = pair.fly(SCENARIO, [f"duration_s={duration_s}"], Path(folder), lambda end, event: None)
    return float(result.vehicle["speed"])


def fly_processes(duration_s: float, *, logs: bool, cpu: int | None = None) -> float:
    """The same two processes, flying on one core, or on those that the system gives them: times real time."""
    vehicle_port, ground_port = pair.free_ports(2)
    here, there = f"127.0.0.1:{vehicle_port}", f"127.0.0.1:{ground_port}"
    with tempfile.TemporaryDirectory() as folder:
        common = ["--lockstep", "--status", "json", "--set", f"duration_s={duration_s}"]
        if logs:
            common += ["--run-dir", folder]
        if cpu is not None:
            common += ["--cpu", str(cpu)]
        mavsitl = [sys.executable, "-m", "mavsitl"]
        ground = [*mavsitl, "ground", SCENARIO, *common, "--link", f"udpin:{there}", "--vehicle", here]
        vehicle = [
            *mavsitl, "vehicle", SCENARIO, *common, "--offboard-port", str(vehicle_port), "--offboard-remote", there,
        ]  # fmt: skip
        with subprocess.Popen(ground, stdout=subprocess.DEVNULL) as other:
            try:
                said = subprocess.run(vehicle, stdout=subprocess.PIPE, check=True, timeout=600.0).stdout
                other.wait(timeout=30.0)
            finally:
                if other.poll() is None:
                    other.terminate()
    return float(json.loads(said.splitlines()[-1])["speed"])


def fly_memory(duration_s: float, *, logs: bool) -> float:
    """One process: times real time."""
    flight = scenario.load(SCENARIO, {"duration_s": duration_s})
    with tempfile.TemporaryDirectory() as folder:
        return ends.in_memory(flight, Path(folder) if logs else None, report=lambda text: None, progress=None).speed


def fly_python(name: str, duration_s: float) -> float:
    """A rival's two processes: times real time, by its vehicle, from the first answer to the last. It must hover."""
    (port,) = pair.free_ports(1)
    command = [sys.executable, "-m", "tests.bench.bench_lockstep", "--duration", str(duration_s), "--port", str(port)]
    environment = os.environ | {"MAVLINK20": "1", "OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen([*command, "--rival", name, "--end", "ground"], env=environment) as ground:
        try:
            vehicle = subprocess.run(
                [*command, "--rival", name, "--end", "vehicle"],
                env=environment, capture_output=True, check=False, timeout=600.0,
            )  # fmt: skip
        finally:
            ground.terminate()
    if vehicle.returncode:
        raise RuntimeError(f"the rival's vehicle failed: {vehicle.stderr.decode(errors='replace')}")
    speed, off_m = map(float, vehicle.stdout.split())
    hovers(name, off_m)
    return speed


def fly_c(program: Path, duration_s: float) -> float:
    """Times real time. It must hover."""
    flown = exchange.fly(program, duration_s)
    hovers("the C program", flown.off_m)
    return flown.speed


def hovers(rival: str, off_m: float) -> None:
    """Raises `RuntimeError` where it does not."""
    if not off_m < HOVER_M:
        raise RuntimeError(f"{rival} did not hover: it was {off_m:g} m off; allowed: less than {HOVER_M:g} m")


def our_bytes(duration_s: float = 10.0) -> tuple[float, float]:
    """Mean size of the datagrams of a flight after its release, from the vehicle and to it."""
    flight = scenario.load(SCENARIO, {"duration_s": duration_s})
    vehicle = wings.find(wings.VEHICLE_GROUP)(flight, ends.NullRecorder(), seed=flight.scenario.seed, lockstep=True)
    ground = wings.find(wings.GROUND_GROUP)(flight, ends.NullRecorder())
    sizes: Counter[str] = Counter()
    numbers: Counter[str] = Counter()

    def count(core: Any, name: str) -> None:
        receive = core.receive

        def counted(port: int, datagram: bytes) -> int:
            if vehicle.flight_time_s > 0.0:
                sizes[name] += len(datagram)
                numbers[name] += 1
            return int(receive(port, datagram))

        core.receive = counted

    count(vehicle, "in")
    count(ground, "out")
    drivers.fly_in_memory(vehicle, ground)
    return sizes["out"] / numbers["out"], sizes["in"] / numbers["in"]


def check_bytes(program: Path) -> None:
    """Raises `RuntimeError` where the C program's datagrams are not of our size."""
    ours, flown = our_bytes(), exchange.fly(program, 20.0)
    for mine, its in zip(ours, flown[2:], strict=True):
        if abs(its / mine - 1.0) > ALIKE:
            raise RuntimeError(f"the C program sends {its:.1f} bytes a tick, mavsitl {mine:.1f}: bring it up to date")


def pinned(run: Callable[[float], float]) -> Callable[[float], float]:
    """The same on one core."""

    def on_one_core(seconds: float) -> float:
        with one_core():
            return run(seconds)

    return on_one_core


def measure(options: argparse.Namespace, program: Path | None) -> dict[str, list[float]]:
    """Row name to times real time, a value a round."""
    duration_s, rival_s = options.duration, options.rival_duration
    # The first core serves most interrupts.
    cpu = max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    rows: dict[str, tuple[Callable[[float], float], float]] = {
        SHIPPED: (fly_pair, duration_s),
        NO_LOGS: (lambda s: fly_processes(s, logs=False, cpu=cpu), duration_s),
        UNPINNED: (lambda s: fly_processes(s, logs=True), duration_s),
        MEMORY: (lambda s: fly_memory(s, logs=True), duration_s),
        MEMORY_NO_LOGS: (lambda s: fly_memory(s, logs=False), duration_s),
        FULL: (pinned(lambda s: fly_python("full", s)), rival_s),
        LEAN: (pinned(lambda s: fly_python("lean", s)), rival_s),
    }
    if program is not None:
        rows[C] = (pinned(lambda s: fly_c(program, s)), duration_s)
        check_bytes(program)
    fly_memory(1.0, logs=True)  # compiles, or loads what was compiled
    found: dict[str, list[float]] = {name: [] for name in rows}
    for _ in range(options.repeats):
        for name, (run, seconds) in rows.items():
            found[name].append(run(seconds))
    return found


def cost(found: dict[str, list[float]], with_logs: str, without: str) -> float:
    """Share of the time that the logs take: the median over the rounds, each with its own pair."""
    return median(1.0 - logged / bare for logged, bare in zip(found[with_logs], found[without], strict=True))


def summary(found: dict[str, list[float]]) -> dict[str, Any]:
    """The rows and their ratios, for a program."""
    middle = {name: median(values) for name, values in found.items()}
    return {
        "times_real_time": found,
        "ratio_to_numpy": {name: value / middle[FULL] for name, value in middle.items()},
        "ratio_to_c": {name: value / middle[C] for name, value in middle.items()} if C in middle else None,
        "logging_costs": {"udp": cost(found, SHIPPED, NO_LOGS), "memory": cost(found, MEMORY, MEMORY_NO_LOGS)},
    }


def lines(found: dict[str, list[float]]) -> list[str]:
    """The table: median and range of times real time, and the ratios of medians to the rivals'."""
    told = summary(found)
    made = ["| times real time | median | min | max | to numpy | to C |", "|---|---:|---:|---:|---:|---:|"]
    for name, values in found.items():
        to_c = f"{told['ratio_to_c'][name]:.2f}" if told["ratio_to_c"] else ""
        made.append(
            f"| {name} | {median(values):.1f} | {min(values):.1f} | {max(values):.1f} "
            f"| {told['ratio_to_numpy'][name]:.1f} | {to_c} |"
        )
    if told["ratio_to_c"] is None:
        made.append(f"| {C} | no C compiler here | | | | |")
    costs = told["logging_costs"]
    return [*made, "", f"Logs take {costs['udp']:.1%} of the time over UDP, {costs['memory']:.1%} in memory."]


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.bench_lockstep", description="Times real time in lock-step, beside rivals."
    )
    parser.add_argument("--duration", type=float, default=60.0, metavar="S", help="flight time (default: 60)")
    parser.add_argument(
        "--rival-duration", type=float, default=20.0, metavar="S", help="of mavutil + numpy (default: 20)"
    )
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="rounds (default: 3)")
    parser.add_argument("--json", action="store_true", help="print rows and ratios as JSON, no table")
    parser.add_argument("--rival", choices=PYTHON_RIVALS, help=argparse.SUPPRESS)
    parser.add_argument("--end", choices=("vehicle", "ground"), help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.rival:
        rival, flight = PYTHON_RIVALS[options.rival], scenario.load(SCENARIO)
        if options.end == "ground":
            rival.ground(options.port, flight)
        else:
            print(*rival.vehicle(options.port, options.duration, flight))
        return 0
    with tempfile.TemporaryDirectory() as folder:
        found = measure(options, exchange.build(Path(folder)))
    print(json.dumps(summary(found), indent=1) if options.json else "\n".join(lines(found)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
