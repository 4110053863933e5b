"""A flight whose processes are stopped, killed and started again: ``python -m tests.durability.restarts``.

A real `mavsitl vehicle` and a real `mavsitl ground` fly; one is killed (SIGKILL), suspended for a while (SIGSTOP) or
asked to end (SIGTERM) at a random moment, and comes back. Measured from outside, by what they print and by a ground
station at the vehicle's other port: that the other one says so, that both fly again, and how long it took. Exit code 1
where one of them does not recover.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from time import monotonic
from typing import Any

from mavsitl_ground.sequence import PX4_MAIN_MODE_OFFBOARD
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from mavsitl.dialect import mavlink
from tests.durability.station import PATIENCE_S, Ports, Process, Station, stop_all

BACK_LIMIT_S = 2.5
"""From the moment that both are there again until they have one another."""
START_LIMIT_S = 10.0
"""The start of a process on a busy machine is in it."""
SILENCE_LIMIT_S = 5.0
"""A silent vehicle is given up after 3 s."""
STOPPED_S = 5.0
JUMP_LIMIT_S = 0.3
"""Of the vehicle's clock across a suspension: what is caught up, and two telemetry periods."""
BURST_LIMIT = 2.0
"""Times the usual number of messages, in the first half second after a suspension."""


HEIGHT = "[{time_s = 0.0, position_nwu_m = [0.0, 0.0, 4.0]}]"
"""High enough that a controller which begins anew in the air does not touch the ground."""


class Flight:
    """A vehicle, a ground that flies it, and a ground station that looks on."""

    def __init__(self) -> None:
        self.ports = Ports()
        self.station = Station(self.ports)
        self.station.watch = self._watch
        self.stamps: list[tuple[float, int]] = []
        """(wall time s, time since boot ms) of each ATTITUDE."""
        self.vehicle = self.start_vehicle()
        self.ground = self.start_ground()

    def _watch(self, message: Any, now_s: float) -> None:
        if message.get_type() == "ATTITUDE":
            self.stamps.append((now_s, message.time_boot_ms))

    def start_vehicle(self) -> Process:
        self.station.renew()
        self.vehicle = Process(*self.ports.vehicle("--no-state", "--set", "parameters.COM_OBL_RC_ACT=5"))
        return self.vehicle

    def start_ground(self) -> Process:
        self.ground = Process(*self.ports.ground("--duration", "3600", "--set", f"reference.steps={HEIGHT}"))
        return self.ground

    def said(self, process: Process, text: str, since: int = 0, limit_s: float = PATIENCE_S) -> float:
        """Wait for what a process prints while the station goes on; how long that took, seconds."""
        return self.station.until(
            lambda: text in process.printed[since:], limit_s, lambda: f"{text!r} in {process.printed!r}"
        )

    def flying(self, since: int = 0) -> float:
        """Wait until the ground flies the vehicle in OFFBOARD."""
        took_s = self.said(self.ground, "flying\n", since)
        return took_s + self.station.until(lambda: self.offboard, what="OFFBOARD")

    @property
    def offboard(self) -> bool:
        return self._mode() == PX4_MAIN_MODE_OFFBOARD and self.armed

    @property
    def armed(self) -> bool:
        heartbeat = self.station.heard.get("HEARTBEAT")
        return heartbeat is not None and bool(heartbeat[1].base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def _mode(self) -> int:
        heartbeat = self.station.heard.get("HEARTBEAT")
        return -1 if heartbeat is None else heartbeat[1].custom_mode >> 16 & 0xFF

    def close(self) -> None:
        stop_all([self.vehicle, self.ground])
        self.station.close()


@dataclass
class Figures:
    """Seconds, by what was measured; and what went wrong."""

    seconds: dict[str, list[float]] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)

    def note(self, what: str, value: float, limit: float) -> None:
        self.seconds.setdefault(what, []).append(value)
        if value > limit:
            self.faults.append(f"{what}: {value:.2f}, limit {limit:g}")


def vehicle_killed(flight: Flight, chance: random.Random, figures: Figures) -> None:
    """The ground says that it is gone, waits, and flies the next one."""
    mark = len(flight.ground.printed)
    flight.vehicle.kill()
    pause_s = chance.choice((0.0, 4.5))
    if pause_s:
        figures.note(
            "vehicle killed: the ground says so", flight.said(flight.ground, "vehicle lost", mark), SILENCE_LIMIT_S
        )
    flight.start_vehicle()
    flight.station.until(lambda: "HEARTBEAT" in flight.station.heard, what="a HEARTBEAT")
    flight.station.wait_booted()
    figures.note("vehicle back: found", flight.said(flight.ground, "vehicle 1 found", mark), BACK_LIMIT_S)
    assert "vehicle lost" in flight.ground.printed[mark:]
    flight.flying(mark)


def ground_killed(flight: Flight, chance: random.Random, figures: Figures) -> None:
    """The vehicle's fail-safe holds it until the next ground takes over."""
    flight.ground.kill()
    figures.note(
        "ground killed: off-board loss acts", flight.station.until(lambda: not flight.offboard, what="fail-safe"), 2.5
    )
    assert flight.armed
    flight.station.run(chance.uniform(0.0, 2.0))
    flight.start_ground()
    started_s = flight.ground.started_s
    flight.said(flight.ground, "vehicle 1 found")
    figures.note("ground back: has the vehicle, start included", monotonic() - started_s, START_LIMIT_S)
    flight.flying()
    figures.note("ground back: flies it, start included", monotonic() - started_s, 15.0)


def vehicle_stopped(flight: Flight, chance: random.Random, figures: Figures) -> None:
    """Its clock stands still meanwhile; then it goes on at its usual rate, and says what it lost."""
    del flight.stamps[:]
    flight.station.run(2.0)
    usual = len(flight.stamps) / 2.0
    flight.vehicle.send(signal.SIGSTOP)
    stopped_s = monotonic()
    flight.station.run(STOPPED_S)
    flight.vehicle.send(signal.SIGCONT)
    going_s = monotonic()
    flight.station.run(1.5)
    before = [stamp for stamp in flight.stamps if stamp[0] <= stopped_s + 0.1]
    after = [stamp for stamp in flight.stamps if stamp[0] > stopped_s + 0.1]
    figures.note("vehicle stopped: its clock jumps by", (after[0][1] - before[-1][1]) / 1e3, JUMP_LIMIT_S)
    at_once = sum(going_s <= wall_s < going_s + 0.5 for wall_s, _ in after)
    figures.note("vehicle stopped: rate right after, times the usual", at_once / (0.5 * usual), BURST_LIMIT)
    boots = [stamp for _, stamp in flight.stamps]
    if boots != sorted(boots):
        figures.faults.append("vehicle stopped: its clock went back")
    flight.station.until(lambda: any("given up" in text for text in flight.station.texts), what="the lost time")
    flight.said(flight.vehicle, "given up")
    flight.said(flight.ground, "flying\n", flight.ground.printed.rindex("vehicle lost: silent"))
    flight.station.until(lambda: flight.offboard, what="OFFBOARD")


def ground_stopped(flight: Flight, chance: random.Random, figures: Figures) -> None:
    """Long enough for the vehicle's fail-safe: it ends when the stream is back. The vehicle was never lost."""
    mark = len(flight.ground.printed)
    flight.ground.send(signal.SIGSTOP)
    figures.note(
        "ground stopped: off-board loss acts", flight.station.until(lambda: not flight.offboard, what="fail-safe"), 2.5
    )
    flight.station.run(STOPPED_S - 2.0)
    flight.ground.send(signal.SIGCONT)
    figures.note(
        "ground stopped: OFFBOARD again", flight.station.until(lambda: flight.offboard, what="OFFBOARD"), BACK_LIMIT_S
    )
    flight.said(flight.ground, "given up", mark)
    if "vehicle lost" in flight.ground.printed[mark:]:
        figures.faults.append("ground stopped: it thought that the vehicle was silent")


def vehicle_ended(flight: Flight, chance: random.Random, figures: Figures) -> None:
    """By SIGTERM; then as after a kill."""
    code = flight.vehicle.end(chance.choice((signal.SIGTERM, signal.SIGINT)))
    if code != 0:
        figures.faults.append(f"vehicle ended with {code}")
    mark = len(flight.ground.printed)
    flight.start_vehicle()
    flight.station.wait_booted()
    flight.flying(mark)


def ground_ended(flight: Flight, chance: random.Random, figures: Figures) -> None:
    """By SIGTERM; then as after a kill."""
    code = flight.ground.end(chance.choice((signal.SIGTERM, signal.SIGINT)))
    if code != 0:
        figures.faults.append(f"ground ended with {code}")
    flight.start_ground()
    flight.flying()


def client_back(flight: Flight, chance: random.Random, figures: Figures) -> None:
    """Another ground station at the same address, without a word from the one before it."""
    flight.station.close()
    flight.station = Station(flight.ports)
    flight.station.watch = flight._watch
    request = flight.station.parameters.read("MAV_SYS_ID")
    took_s = flight.station.until(lambda: request.outcome == "done", what="an answer")
    figures.note("ground station back: is answered", took_s, BACK_LIMIT_S)
    took_s = flight.station.until(lambda: flight.offboard, what="a HEARTBEAT")
    figures.note("ground station back: has a HEARTBEAT", took_s, BACK_LIMIT_S)


EVENTS = (vehicle_killed, ground_killed, vehicle_stopped, ground_stopped, vehicle_ended, ground_ended, client_back)


def run(rounds: int, seed: int, *, show: bool) -> Figures:
    """Each of `EVENTS` so often, in one long flight after another."""
    chance = random.Random(seed)
    figures = Figures()
    events = [event for _ in range(rounds) for event in chance.sample(EVENTS, len(EVENTS))]
    flight = Flight()
    try:
        flight.flying()
        with Progress(console=Console(stderr=True), disable=not show) as bar:
            for event in bar.track(events, description="restarts"):
                flight.station.run(chance.uniform(0.0, 2.0))
                try:
                    event(flight, chance, figures)
                except AssertionError as error:
                    figures.faults.append(f"{event.__name__}: {error}")
                    flight.close()
                    flight = Flight()
                    flight.flying()
    finally:
        flight.close()
    return figures


def table(figures: Figures, rounds: int) -> Table:
    made = Table(title=f"each of {len(EVENTS)} events {rounds} times")
    for heading in ("", "median", "worst"):
        made.add_column(heading, justify="left" if not heading else "right")
    for what, values in sorted(figures.seconds.items()):
        made.add_row(what, f"{sorted(values)[len(values) // 2]:.2f}", f"{max(values):.2f}")
    made.add_row("did not recover, or too late", str(len(figures.faults)), "")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser("python -m tests.durability.restarts", description=__doc__)
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="of all events (default: 5)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="default: 1")
    options = parser.parse_args(argv)
    figures = run(options.rounds, options.seed, show=True)
    Console().print(table(figures, options.rounds))
    for fault in figures.faults:
        print(fault, file=sys.stderr)
    return 0 if not figures.faults else 1


if __name__ == "__main__":
    raise SystemExit(main())
