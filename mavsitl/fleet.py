"""Many vehicles, or many controllers, in one process: what drives them, with their links and logs.

In real time one selector looks after all sockets: what is not ready is not read, and who has nothing to say is not
asked. The frames that a vehicle has for a link in one control period travel in one datagram.
"""

from __future__ import annotations

import math
import selectors
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from mavsitl.clock import CATCH_UP_US, PacedClock, monotonic_us
from mavsitl.drivers import (
    GUARD_S,
    PROGRESS_INTERVAL_US,
    GroundCore,
    Intake,
    Load,
    LockstepError,
    LostTime,
    Progress,
    RealTime,
    Tap,
    exchange_impaired,
    ground_in_memory,
)
from mavsitl.keep import Keeper, Keeping
from mavsitl.link.base import Link
from mavsitl.link.budget import Excess
from mavsitl.log.tlog import Direction

if TYPE_CHECKING:
    from mavsitl.link.impaired import Channels

LOOK_S = 0.001
"""Real time: between two looks at the sockets within a control period, so that what comes is taken together."""
TAPS = 25
"""Logs are handed to the system in as many groups, a tick each."""


class Collision(NamedTuple):
    """Two vehicles came nearer than `fleet.collision_m`."""

    time_s: float
    """Simulated."""
    vehicle: int
    """System id, as the next."""
    other: int
    distance_m: float


class FleetCore(Keeping, Protocol):
    """Many vehicles as one sans-IO core; ports are numbered through."""

    @property
    def period_us(self) -> int: ...
    @property
    def finished(self) -> bool: ...
    @property
    def flight_time_s(self) -> float: ...
    @property
    def counters(self) -> Any: ...
    def step(self, now_us: int) -> None: ...
    def receive(self, port: int, datagram: bytes, at_us: int | None = None) -> int: ...
    def outgoing(self) -> Iterator[tuple[int, list[bytes]]]:
        """(port, datagrams) where there is something to send."""

    def refuse(self, port: int, excess: Excess) -> None: ...
    def warn(self, text: str) -> None: ...
    def set_load(self, load: float) -> None: ...
    def close(self) -> None: ...


@contextmanager
def _selector(links: Sequence[Link]) -> Iterator[selectors.BaseSelector]:
    """Of the sockets that the links have now, each with its port."""
    with selectors.DefaultSelector() as selector:
        for port, link in enumerate(links):
            for reader in link.readers():
                selector.register(reader, selectors.EVENT_READ, port)
        yield selector


def run_realtime_fleet(
    fleet: FleetCore,
    links: Sequence[Link],
    taps: Mapping[int, Tap],
    *,
    logs: Sequence[Tap] = (),
    polled: Callable[[], Iterable[int]] = lambda: (),
    speed: float = 1.0,
    until_finished: bool = False,
    stop: Callable[[], bool] = lambda: False,
    say: Callable[[str], None] = lambda text: None,
    progress: Progress | None = None,
) -> RealTime:
    """The fleet on the wall clock, times `speed`; `links` and `taps` by port.

    `logs`: the taps that are told the time, whether they hear anything or not. `polled()`: ports to be looked at
    whether a socket is ready or not: links that hold messages back, or whose sockets come and go. However it ends, the
    vehicles are closed, and what they had to keep is on the disk.
    """
    clock = PacedClock(fleet.period_us, speed)
    intake = Intake(fleet, links, taps)
    keeper = Keeper(fleet)
    progressed_us = -PROGRESS_INTERVAL_US
    now_us = tick = 0

    def warn(text: str) -> None:
        fleet.warn(text)
        say(text)

    lost = LostTime(warn)
    load = Load(fleet.set_load)

    def send() -> None:
        for port, datagrams in fleet.outgoing():
            tap, link = taps.get(port), links[port]
            for datagram in datagrams:
                if tap is not None:
                    tap.hear(Direction.FROM_VEHICLE, now_us, datagram)
                link.send(datagram)

    with _selector(links) as selector:

        def take(limit_s: float = 0.0) -> None:
            """What has come, or comes first within `limit_s`."""
            ports = set(polled())
            whole_ms = 0 if ports or intake.waiting else max(int(limit_s * 1e3), 0)  # a selector rounds up
            ports.update(key.data for key, _ in selector.select(whole_ms * 1e-3))
            if ports or intake.waiting:
                intake.take(ports, now_us, monotonic_us(), clock.time_us)

        clock.start()
        start_us = monotonic_us()
        try:
            while not stop() and not (until_finished and fleet.finished):
                fleet.step(now_us)
                send()
                next_us = now_us + fleet.period_us
                while clock.spare_s(next_us) > LOOK_S + GUARD_S:
                    clock.nap(LOOK_S)
                    take(clock.spare_s(next_us) - GUARD_S)
                    send()
                clock.wait_until(next_us)
                take()
                wall_us = monotonic_us()
                keeper.step(wall_us)
                for tap in logs[tick % TAPS :: TAPS]:
                    tap.tick(now_us, wall_us)
                if clock.lost_us != lost.told_us:
                    lost.tell(clock.lost_us, wall_us)
                load.step(wall_us)
                if progress is not None and wall_us - progressed_us >= PROGRESS_INTERVAL_US:
                    progressed_us = wall_us
                    progress(fleet.flight_time_s)
                now_us = next_us
                tick += 1
        finally:
            fleet.close()
            keeper.close(monotonic_us())
    return RealTime(now_us, monotonic_us() - start_us, clock.lateness, clock.rebased, clock.lost_us)


class FormationCore(Protocol):
    """Many ground controllers; port j is the link of the j-th, or 0 that of all."""

    @property
    def period_us(self) -> int: ...
    @property
    def finished(self) -> bool: ...
    @property
    def grounds(self) -> Sequence[GroundCore]: ...
    def receive(self, port: int, datagram: bytes) -> int: ...
    def step(self, now_us: int, *, due: bool) -> None:
        """Those that heard something; with `due` all: so at least once a control period."""

    def tally(self, number: int) -> None:
        """Of a ground that was stepped by itself: take note of how well its vehicle follows."""

    def outgoing(self) -> Iterator[tuple[int, int, list[bytes]]]:
        """(port, number of the controller, datagrams) where there is something to send."""


def run_realtime_formation(
    formation: FormationCore,
    links: Sequence[Link],
    taps: Mapping[int, Tap],
    *,
    stop: Callable[[], bool] = lambda: False,
    say: Callable[[str], None] = lambda text: None,
    aside: Callable[[int], None] = lambda now_us: None,
) -> tuple[int, int]:
    """The controllers on the wall clock: each steps as soon as its telemetry comes, and once a control period.

    Their clock is the wall's less what the process was suspended for. `links` by port, `taps` by controller. Returns
    the microseconds that passed on the clock and on the wall. `aside` is told the clock at each turn, when all else is
    done: what is beside the off-board links.
    """
    period_us = formation.period_us
    start_us = woken_us = monotonic_us()
    lost_us = told_us = 0
    due_us = 0
    logs = list(taps.values())
    turns = 0
    now_us = 0
    with _selector(links) as selector:
        while not stop() and not formation.finished:
            ready = selector.select(period_us / 1e6)
            wall_us = monotonic_us()
            late_us = wall_us - woken_us - period_us
            woken_us = wall_us
            if late_us > CATCH_UP_US:
                lost_us += late_us
            if lost_us != told_us:
                say(f"Suspended or overloaded: {(lost_us - told_us) / 1e6:.1f} s of real time given up")
                told_us = lost_us
            now_us = wall_us - start_us - lost_us
            for key, _ in ready:
                link = links[key.data]
                for datagram, source in link.receive(wall_us - start_us):
                    if formation.receive(key.data, datagram):
                        link.admit(source, wall_us - start_us)
            due = now_us >= due_us
            if due:
                due_us = now_us + period_us
            formation.step(now_us, due=due)
            for port, number, datagrams in formation.outgoing():
                tap = taps.get(number)
                for datagram in datagrams:
                    if tap is not None:
                        tap.hear(Direction.FROM_GROUND, now_us, datagram)
                    links[port].send(datagram)
            for tap in logs[turns % TAPS :: TAPS]:
                tap.tick(now_us, wall_us)
            aside(now_us)
            turns += 1
    return now_us, monotonic_us() - start_us


def fly_in_memory(
    fleet: FleetCore,
    vehicles: Sequence[Any],
    formation: FormationCore,
    taps: Sequence[Tap],
    *,
    max_time_s: float = math.inf,
    progress: Progress | None = None,
    channels: Sequence[Channels] = (),
) -> int:
    """Each of the fleet's `vehicles` with its ground of `formation`, in lock-step in this process, to the end of all.

    Returns the microseconds simulated. A pair that has finished exchanges nothing more; what a tap hears is what it
    would hear of the pair alone. `channels`: what is between each vehicle and its ground; empty: nothing, every message
    comes in the tick it was sent. Raises `LockstepError` when a ground stops answering or `max_time_s` is over; over an
    impaired link a pair that has not ended by then, or whose ground gave up, is one that has not finished.
    """
    if channels:
        return _fly_impaired(fleet, vehicles, formation, taps, channels, max_time_s, progress)
    grounds = formation.grounds
    now_us, last_us = 0, max_time_s * 1e6
    ground_us = [0] * len(grounds)
    flying = set(range(len(grounds)))
    progressed_us = 0
    while True:
        fleet.step(now_us)
        for port, datagrams in fleet.outgoing():
            if port not in flying:
                continue
            vehicle, ground, tap = vehicles[port], grounds[port], taps[port]
            for datagram in datagrams:
                tap.hear(Direction.FROM_VEHICLE, now_us, datagram)
                ground.receive(0, datagram)
                ground_us[port] = max(ground_us[port], ground.vehicle_time_us)
                ground.step(ground_us[port])
                formation.tally(port)
                for answer in ground.datagrams(0, combine=True):
                    if not vehicle.finished:
                        tap.hear(Direction.FROM_GROUND, now_us, answer)
                        fleet.receive(port, answer)
        for port in sorted(flying):
            vehicle, ground = vehicles[port], grounds[port]
            if vehicle.finished and ground.finished:
                flying.discard(port)
            elif vehicle.token_us != now_us:
                raise LockstepError(f"ground {port} did not answer the telemetry stamped {now_us} us")
            else:
                taps[port].tick(now_us)
        if not flying:
            return now_us
        if now_us >= last_us:
            raise LockstepError(f"the flights did not end within {max_time_s:g} s of simulated time")
        if progress is not None and now_us - progressed_us >= PROGRESS_INTERVAL_US:
            progressed_us = now_us
            progress(fleet.flight_time_s)
        now_us += fleet.period_us


def _fly_impaired(
    fleet: FleetCore,
    vehicles: Sequence[Any],
    formation: FormationCore,
    taps: Sequence[Tap],
    channels: Sequence[Channels],
    max_time_s: float,
    progress: Progress | None,
) -> int:
    exchanges = [ground_in_memory(ground) for ground in formation.grounds]
    flying = list(range(len(exchanges)))
    now_us, last_us = 0, max_time_s * 1e6
    progressed_us = 0
    while True:
        fleet.step(now_us)
        said = dict(fleet.outgoing())
        ended = set()
        for port in flying:
            if exchange_impaired(
                vehicles[port], said.get(port, ()), channels[port], exchanges[port], taps[port], now_us
            ):
                ended.add(port)
            formation.tally(port)
        flying = [port for port in flying if port not in ended]
        if not flying or now_us >= last_us:
            return now_us
        if progress is not None and now_us - progressed_us >= PROGRESS_INTERVAL_US:
            progressed_us = now_us
            progress(fleet.flight_time_s)
        now_us += fleet.period_us


@dataclass(frozen=True)
class Flown:
    """What became of one vehicle of a fleet."""

    system_id: int
    finished: bool
    wire_hash: str = ""
    """Of its off-board link, where that was heard."""
    lost: str = ""
    """How it was lost in flight; the ground's to say."""
    flight_time_s: float = 0.0
    rms_m: float | None = None
    """Distance from its reference while it flew, as far as the ground knows; None: it has not."""
    worst_m: float | None = None
    link: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)
    """Statistics of its impaired links, by place and direction."""


@dataclass(frozen=True)
class FleetOutcome:
    """What a fleet, or a formation of controllers, has to say when it is over."""

    simulated_s: float
    wall_s: float
    finished: bool
    frames: int
    rejected: int
    dropped: dict[str, int]
    vehicles: tuple[Flown, ...]
    collisions: tuple[Collision, ...] = ()
    lateness_us: tuple[float, float] | None = None
    rebased: int = 0
    lost_s: float = 0.0

    @property
    def speed(self) -> float:
        """Simulated over wall time."""
        return self.simulated_s / self.wall_s if self.wall_s > 0.0 else 0.0

    @property
    def lost(self) -> list[Flown]:
        return [each for each in self.vehicles if each.lost]

    def as_event(self) -> dict[str, Any]:
        """The event "end" of ``--status json``."""
        return {
            "event": "end", "simulated_s": self.simulated_s, "wall_s": self.wall_s, "speed": self.speed,
            "finished": self.finished, "frames": self.frames, "rejected": self.rejected, "dropped": self.dropped,
            **({} if self.lateness_us is None else {
                "lateness_us": self.lateness_us, "rebased": self.rebased, "lost_s": self.lost_s,
            }),
            "vehicles": [asdict(each) for each in self.vehicles],
            "collisions": [each._asdict() for each in self.collisions],
        }  # fmt: skip
