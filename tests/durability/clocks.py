"""How a vehicle keeps its time: ``python -m tests.durability.clocks [--seconds S] [--hogs N]``.

A real `mavsitl vehicle` in real time; a ground station asks for its clock by TIMESYNC ten times a second and for a
parameter as often as it is answered. Measured: the drift of simulated against wall time, the spread of the clock
offset, the round trips. Then the same on a machine that is made busy: as many processes that compute as ``--hogs`` says
on the vehicle's one CPU, with the vehicle behind them in priority. Then it may be late, and what counts is that
its time never goes back, that it says so, and that everything is answered still. Exit code 1 where the first row is out
of its limits or one of these does not hold.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import monotonic
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from tests.durability.station import Ports, Process, Station

DRIFT_LIMIT = 0.002
SPREAD_LIMIT_MS = 25.0
ROUND_TRIP_LIMIT_MS = 50.0
BEHIND = 5
"""How much nicer than the others a vehicle on a busy machine is."""
HOG = "while True: pass"


@dataclass(frozen=True)
class TimeBase:
    """What was measured."""

    seconds: float
    drift: float
    """Of simulated against wall time, as a share of it."""
    spread_ms: float
    """Of the clock offset by TIMESYNC, largest less smallest, drift taken out."""
    round_trip_p50_ms: float
    round_trip_p99_ms: float
    """Of reading a parameter."""
    answers: int
    attitude_hz: float
    backwards: int
    """Times that the vehicle's clock went back."""
    lost_s: float
    """Real time that it gave up, by its own account."""
    texts: tuple[str, ...]
    lateness: str
    """What the vehicle says of its ticks at the end."""


def measure(seconds: float, hogs: int = 0) -> TimeBase:
    """One vehicle for so long."""
    ports = Ports()
    station, process = Station(ports), Process(*ports.vehicle("--no-state"))
    busy: list[subprocess.Popen[bytes]] = []
    offsets: list[tuple[float, float]] = []
    clock: list[int] = []
    stamps: list[tuple[float, int]] = []

    def watch(message: Any, now_s: float) -> None:
        name = message.get_type()
        if name == "TIMESYNC" and message.tc1:
            clock.append(message.tc1)
            sent_s = message.ts1 / 1e9
            offsets.append((now_s, message.tc1 / 1e9 - 0.5 * (sent_s + now_s)))
        elif name == "ATTITUDE":
            stamps.append((now_s, message.time_boot_ms))

    try:
        station.wait_booted()
        station.run(1.0)
        if hogs:
            cpu = min(os.sched_getaffinity(0))
            os.sched_setaffinity(process.pid, {cpu})
            os.setpriority(os.PRIO_PROCESS, process.pid, BEHIND)
            busy = [subprocess.Popen([sys.executable, "-c", HOG]) for _ in range(hogs)]
            for each in busy:
                os.sched_setaffinity(each.pid, {cpu})
        station.watch = watch
        trips: list[float] = []
        begin_s = monotonic()
        while monotonic() - begin_s < seconds:
            asked_s = monotonic()
            request = station.parameters.read("MIS_TAKEOFF_ALT")
            while request.outcome == "open" and monotonic() - asked_s < 10.0:
                station.pump(0.002)
            assert request.outcome == "done", f"a parameter was not answered: {request.outcome}"
            trips.append(monotonic() - asked_s)
            station.run(0.02)
        station.watch = lambda message, now_s: None
        for each in busy:
            each.kill()
        texts = tuple(station.texts)
        process.end()
    finally:
        for each in busy:
            each.kill()
            each.wait()
        process.close()
        station.close()
    wall_s, boot_ms = np.array(stamps, dtype=float).T
    drift = (boot_ms[-1] - boot_ms[0]) / 1e3 / (wall_s[-1] - wall_s[0]) - 1.0
    times, found = np.array(offsets).T
    line = np.polyfit(times - times[0], found, 1)
    rest = found - np.polyval(line, times - times[0])
    p50, p99 = np.quantile(trips, (0.5, 0.99)) * 1e3
    lateness = next(line for line in process.printed.splitlines() if line.startswith("tick lateness"))
    return TimeBase(
        seconds=seconds,
        drift=float(drift),
        spread_ms=float(np.ptp(rest)) * 1e3,
        round_trip_p50_ms=float(p50),
        round_trip_p99_ms=float(p99),
        answers=len(trips),
        attitude_hz=float((len(stamps) - 1) / (wall_s[-1] - wall_s[0])),
        backwards=int(np.count_nonzero(np.diff(boot_ms) < 0)) + int(np.count_nonzero(np.diff(clock) < 0)),
        lost_s=float(lateness.rpartition(", ")[2].partition(" ")[0]),
        texts=texts,
        lateness=lateness,
    )


def table(rows: Sequence[tuple[str, TimeBase]]) -> Table:
    made = Table(title="the vehicle's time")
    made.add_column("")
    for name, found in rows:
        made.add_column(f"{name}, {found.seconds:g} s", justify="right")
    made.add_column("limit", justify="right")
    rows_of: tuple[tuple[str, Callable[[TimeBase], str], str], ...] = (
        ("drift", lambda t: f"{100 * t.drift:+.3f} %", f"{100 * DRIFT_LIMIT:g} %"),
        ("real time given up", lambda t: f"{t.lost_s:.1f} s", ""),
        ("drift of the rest", lambda t: f"{100 * (t.drift + t.lost_s / t.seconds):+.3f} %", ""),
        ("spread of the offset by TIMESYNC", lambda t: f"{t.spread_ms:.2f} ms", f"{SPREAD_LIMIT_MS:g} ms"),
        ("round trip, median", lambda t: f"{t.round_trip_p50_ms:.2f} ms", ""),
        ("round trip, p99", lambda t: f"{t.round_trip_p99_ms:.2f} ms", f"{ROUND_TRIP_LIMIT_MS:g} ms"),
        ("questions answered", lambda t: str(t.answers), "all"),
        ("ATTITUDE", lambda t: f"{t.attitude_hz:.1f} Hz", ""),
        ("its clock went back", lambda t: str(t.backwards), "0"),
        ("warnings of lost time", lambda t: str(sum("given up" in text for text in t.texts)), ""),
    )
    for heading, text, limit in rows_of:
        made.add_row(heading, *(text(found) for _, found in rows), limit)
    return made


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser("python -m tests.durability.clocks", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, metavar="S", help="of each row (default: 60)")
    parser.add_argument("--hogs", type=int, default=4, metavar="N", help="default: 4")
    options = parser.parse_args(argv)
    quiet = measure(options.seconds)
    busy = measure(options.seconds, options.hogs)
    Console().print(table((("quiet", quiet), ("overloaded", busy))))
    for found in (quiet, busy):
        print(found.lateness)
    kept = (
        abs(quiet.drift) <= DRIFT_LIMIT
        and quiet.spread_ms <= SPREAD_LIMIT_MS
        and quiet.round_trip_p99_ms <= ROUND_TRIP_LIMIT_MS
    )
    told = busy.drift > -DRIFT_LIMIT or any("given up" in text for text in busy.texts)
    return 0 if kept and told and not quiet.backwards and not busy.backwards else 1


if __name__ == "__main__":
    raise SystemExit(main())
