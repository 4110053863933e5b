"""How a sweep grows with its workers, and what it adds to a flight: ``python -m tests.bench.bench_sweep``.

Rows: the bare flight in memory without logs, the campaign in one process, on 1, 2, ... N processes, and on Dask workers
where `--scheduler` names a cluster. All fly the same cases, and their rows have to be the same bits. The rows take
turns, round by round, so that load meets all alike; processes are up before the clock starts.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from statistics import median
from time import perf_counter

from rich.console import Console
from rich.progress import track

from mavsitl import ends, scenario
from mavsitl.campaign import workers
from mavsitl.campaign.grid import Case, case
from mavsitl.campaign.workers import Workers

SCENARIO = "hover-wind"
BARE = "bare flight, in memory"
HERE = "campaign, this process"


def fly_bare(cases: Sequence[Case]) -> list[str]:
    """The wire hashes."""
    return [
        ends.in_memory(each.flight, None, report=lambda text: None, progress=None).wire_hash for each in cases
    ]  # fmt: skip


def fly_campaign(cases: Sequence[Case], crew: Workers) -> list[str]:
    rows = {row.key: row for row in workers.fly_all(cases, crew)}
    bad = [row.message for row in rows.values() if not row.flown]
    if bad:
        raise RuntimeError(f"{len(bad)} flights did not end as planned: {bad[0]}")
    return [rows[each.key].wire_hash for each in cases]


def measure(
    contestants: dict[str, Callable[[Sequence[Case]], list[str]]], cases: Sequence[Case], rounds: int
) -> dict[str, list[float]]:
    """Flights per second, round by round. Raises RuntimeError where two did not fly the same."""
    for fly in contestants.values():  # processes start, kernels are loaded
        fly(cases)
    rates: dict[str, list[float]] = {name: [] for name in contestants}
    console = Console(stderr=True)
    for _ in track(range(rounds), "rounds", console=console):
        flown = set()
        for name, fly in contestants.items():
            started_s = perf_counter()
            flown.add(tuple(fly(cases)))
            rates[name].append(len(cases) / (perf_counter() - started_s))
        if len(flown) != 1:
            raise RuntimeError("equal cases were not flown equally")
    return rates


def table(rates: dict[str, list[float]], duration_s: float) -> str:
    """Ratios are medians of those of each round."""
    lines = [
        f"| flights of {duration_s:g} s | flights/s | x real time | to {BARE} | to {HERE} |",
        "|---|---:|---:|---:|---:|",
    ]
    for name, found in rates.items():
        ratios = (
            median(mine / theirs for mine, theirs in zip(found, rates[base], strict=True)) for base in (BARE, HERE)
        )
        rate = median(found)
        lines.append(
            f"| {name} | {rate:.2f} | {rate * duration_s:.0f} | " + " | ".join(f"{r:.2f}" for r in ratios) + " |"
        )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.bench_sweep", description="How a sweep scales.")
    parser.add_argument("--flights", type=int, default=8, metavar="N", help="in a round (default: 8)")
    parser.add_argument("--duration", type=float, default=60.0, metavar="S", help="of each, simulated (default: 60)")
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="default: 5")
    parser.add_argument("--jobs", type=int, default=workers.cores(), metavar="N", help="at most (default: cores)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster")
    parser.add_argument("--json", action="store_true", help="the rates of each round as JSON")
    options = parser.parse_args(argv)
    flight = scenario.load(SCENARIO, {"duration_s": options.duration})
    cases = [case(flight, seed) for seed in range(1, 1 + options.flights)]
    with ExitStack() as stack:
        contestants: dict[str, Callable[[Sequence[Case]], list[str]]] = {BARE: fly_bare}

        def add(name: str, crew: Workers) -> None:
            stack.enter_context(crew)
            contestants[name] = lambda cases: fly_campaign(cases, crew)

        add(HERE, workers.Here())
        counts = [1 << power for power in range(options.jobs.bit_length()) if 1 << power <= options.jobs]
        for jobs in sorted({*counts, options.jobs}):
            add(f"campaign, {jobs} process{'' if jobs == 1 else 'es'}", workers.Local(jobs))
        if options.scheduler:
            cluster = workers.Dask(options.scheduler)
            add(f"campaign, Dask, {cluster.threads} workers", cluster)
        rates = measure(contestants, cases, options.rounds)
    if options.json:
        print(json.dumps(rates))
    else:
        print(table(rates, options.duration))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
