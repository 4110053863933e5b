"""From process start to the first HEARTBEAT and to ready to arm: ``python -m tests.bench.bench_startup``. POSIX only.

The vehicle is started as users start it. The clock begins before the process is made and stops when the client, on the
ground-station port, has read the datagram: the first HEARTBEAT, then the first SYS_STATUS whose pre-arm bit is healthy.
"Cold" gives numba an empty cache folder, as at the first start after an installation. Bytecode there is, as after one.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from statistics import median
from time import perf_counter
from typing import NamedTuple

from tests.bench.live import GCS, installed, live


class Start(NamedTuple):
    heartbeat_s: float
    ready_s: float
    cpu_s: float
    """User and system time of the process until it was ready, and ended."""


def start(environment: dict[str, str]) -> Start:
    """One, with these variables of the environment beside ours."""
    with live(environment=environment) as vehicle:
        vehicle.wait_for(lambda message: message.get_type() == "HEARTBEAT", GCS)
        heartbeat_s = perf_counter() - vehicle.started_s
        vehicle.wait_ready()
        ready_s = perf_counter() - vehicle.started_s
        vehicle.end()
        return Start(heartbeat_s, ready_s, vehicle.cpu_s)


def cold_start(environment: dict[str, str]) -> Start:
    with tempfile.TemporaryDirectory() as folder:
        return start({**environment, "NUMBA_CACHE_DIR": folder})


def show(name: str, runs: Sequence[Start]) -> None:
    print(f"| {name} |", end="")
    for column in zip(*runs, strict=True):
        print(f" {median(column):.2f} | {max(column):.2f} |", end="")
    print()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--cold-repeats", type=int, default=10)
    options = parser.parse_args()
    with installed() as environment:
        start(environment)
        print("| seconds, median and worst | first HEARTBEAT | | ready to arm | | CPU time | |")
        print("|---|---:|---:|---:|---:|---:|---:|")
        show("warm cache", [start(environment) for _ in range(options.repeats)])
        if options.cold_repeats:
            show("cold cache", [cold_start(environment) for _ in range(options.cold_repeats)])


if __name__ == "__main__":
    main()
