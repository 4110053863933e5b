"""How a vehicle in real time keeps its time and what it takes: ``python -m tests.bench.bench_realtime``. Linux only.

Rows: an idle machine, and one with a process that computes for each core; each with `--realtime` where that is allowed,
and without. A client empties the two sockets of the links, on which the default streams run, and does nothing else. The
rows take turns. Columns: the lateness of the ticks by the vehicle's own account, over the whole flight; its share of a
core, by the system's account, once it is ready; and its memory when it has stood for a while, by
/proc/PID/smaps_rollup: RSS, PSS (pages of files shared with others are divided), USS (pages that are its own), and what
is not of a file at all.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from statistics import median
from time import perf_counter

from mavsitl import realtime
from mavsitl.realtime import RealTimeError, Wish
from tests.bench.bench_latency import idle
from tests.bench.live import installed, live

BURNER = "while True: pass"


@dataclass(frozen=True)
class Kept:
    """What was measured in one flight."""

    p50_us: float
    p99_us: float
    cpu_share: float
    rss_mb: float
    pss_mb: float
    uss_mb: float
    anonymous_mb: float


@contextmanager
def burners(number: int) -> Iterator[None]:
    """So many processes that compute, ended with the context."""
    burning = [subprocess.Popen([sys.executable, "-S", "-c", BURNER]) for _ in range(number)]
    try:
        yield
    finally:
        for each in burning:
            each.kill()
        for each in burning:
            each.wait()


def memory_kb(pid: int) -> dict[str, int]:
    """Field to kB of /proc/PID/smaps_rollup."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
    return {line.partition(":")[0]: int(line.split()[1]) for line in lines}


def measure(options: Sequence[str], seconds: float, burning: int, environment: dict[str, str]) -> Kept:
    """Of one vehicle, standing, for so many seconds after it is ready."""
    with live(*options, environment=environment) as vehicle:
        vehicle.wait_ready()
        with burners(burning):
            begin_s, cpu_s = perf_counter(), vehicle.cpu_now_s()
            idle(vehicle, seconds)
            share = (vehicle.cpu_now_s() - cpu_s) / (perf_counter() - begin_s)
            memory = memory_kb(vehicle.process.pid)
            vehicle.end()
        uss_kb = memory["Private_Clean"] + memory["Private_Dirty"]
        kb = memory["Rss"], memory["Pss"], uss_kb, memory["Anonymous"]
        return Kept(*vehicle.lateness_us, share, *(each / 1000.0 for each in kb))


def rows() -> dict[str, tuple[list[str], int]]:
    """Name to options of the vehicle and the number of burners."""
    cores = len(os.sched_getaffinity(0))
    made: dict[str, tuple[list[str], int]] = {}
    for state, burning in (("idle", 0), (f"{cores} cores busy", cores)):
        made[state] = ([], burning)
        made[f"{state}, --realtime"] = (["--realtime"], burning)
    try:
        realtime.check(Wish.DEMANDED)
    except RealTimeError as error:
        print(f"no rows with --realtime: {error}", file=sys.stderr)
        made = {name: row for name, row in made.items() if not row[0]}
    return made


def lines(found: dict[str, list[Kept]]) -> list[str]:
    """A table of medians."""
    made = [
        "| | lateness p50, us | p99, us | share of a core | RSS, MB | PSS, MB | USS, MB | not of files, MB |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name, runs in found.items():
        middle = Kept(*(median(getattr(run, field.name) for run in runs) for field in fields(Kept)))
        made.append(
            f"| {name} | {middle.p50_us:.0f} | {middle.p99_us:.0f} | {middle.cpu_share:.1%} | {middle.rss_mb:.0f} "
            f"| {middle.pss_mb:.0f} | {middle.uss_mb:.0f} | {middle.anonymous_mb:.0f} |"
        )
    return made


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.bench_realtime", description="Lateness, CPU and memory of a vehicle in real time."
    )
    parser.add_argument("--seconds", type=float, default=20.0, metavar="S", help="of each flight (default: 20)")
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="rounds (default: 3)")
    parser.add_argument("--json", action="store_true", help="print every flight as JSON, no table")
    options = parser.parse_args(argv)
    plan = rows()
    found: dict[str, list[Kept]] = {name: [] for name in plan}
    with installed() as environment:
        measure([], 0.0, 0, environment)  # writes what the others find
        for _ in range(options.repeats):
            for name, (arguments, burning) in plan.items():
                found[name].append(measure(arguments, options.seconds, burning, environment))
    if options.json:
        print(json.dumps({name: [asdict(run) for run in runs] for name, runs in found.items()}, indent=1))
    else:
        print("\n".join(lines(found)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
