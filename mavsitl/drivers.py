"""Drivers: they move datagrams and time, and decide nothing. In memory, lock-step over UDP, real time over UDP.

In lock-step all frames of one tick travel in one datagram each way, in memory and over UDP alike, so both put the same
bytes on the wire. The vehicle advances when a setpoint echoes the stamp of its telemetry; a peer that stays silent is
named.

Over an impaired link the vehicle's end owns both directions of it, and a tick is one exchange, of whatever is due:
nothing, too. The ground counts exchanges for its clock, so that it acts on what it has when its time comes.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from mavsitl.clock import CATCH_UP_US, LatenessHistogram, PacedClock, monotonic_us, processor_s
from mavsitl.keep import Keeper, Keeping
from mavsitl.link.base import Link, LinkError, LinkSilent
from mavsitl.link.budget import Excess, FairQueue, InputBudget
from mavsitl.link.exchange import EXCHANGE_BYTES, HELLO, pack, unpack
from mavsitl.link.sockets import wait_any
from mavsitl.link.udp import ConnectedUdp
from mavsitl.log.tlog import Direction, Heard, TlogWriter, WireHash

if TYPE_CHECKING:
    from mavsitl.ask import Ask
    from mavsitl.check import Check
    from mavsitl.link.impaired import Channels

FROM_VEHICLE, FROM_GROUND = Direction.FROM_VEHICLE, Direction.FROM_GROUND

CHORES_PERIODS = 50
"""Lock-step: logs and progress are looked after so rarely."""
FIRST_REPEAT_S = 0.1
"""Lock-step: the first datagram is repeated this often until the other side is there."""
MAX_OUT_OF_STEP = 1000
"""Lock-step: datagrams of the other side within one tick without the setpoint that is waited for."""
PROGRESS_INTERVAL_US = 100_000
"""Wall clock between two calls of a progress callback."""
SETUP_SIGNING = 256
"""Its message id."""
SETUP_SIGNING_ID = SETUP_SIGNING.to_bytes(3, "little")
"""As a MAVLink 2 header has it; where the bytes stand elsewhere, looking closer does no harm."""
FLUSH_INTERVAL_US = 1_000_000
"""Logs are handed to the system once a second of simulated time."""
FLUSH_WALL_US = 500_000
"""Real time: and as often on the wall clock, so that a kill costs less than a second of whatever is slower."""
SAY_LOST_US = 5_000_000
"""Real time: wall clock between two warnings that the schedule was moved."""
LOAD_US = 1_000_000
"""Real time: wall clock over which the load is measured."""
CHECK_WAIT_S, NO_SOCKET_WAIT_S = 0.02, 0.002
"""Of a check: longest wait for a datagram; and a pause where there is nothing to wait for, a server not there yet."""

TAKEN = 16
"""Real time: datagrams of a link handed over at a time, at most. With more it is first seen whether the tick is due."""
READ = 256
"""Real time: datagrams read from a link at a time, at most: so many a tick are 60,000 a second."""
WAKES = 32
"""Real time: times within a tick that something may wake the vehicle; from then on it waits for the tick."""
WAKE_S = 60e-6
"""Real time: a wait for sockets ends so much later than the same sleep, and is cut by it."""
GUARD_S = 0.0002
"""Real time: what comes so shortly before a tick waits for it, and does not make it late."""


class Core(Protocol):
    """A sans-IO end of the link, vehicle or ground: bytes and time in, bytes out."""

    @property
    def finished(self) -> bool: ...

    @property
    def flight_time_s(self) -> float: ...
    @property
    def counters(self) -> Any: ...
    def receive(self, port: int, datagram: bytes) -> int: ...
    def step(self, now_us: int) -> None: ...
    def datagrams(self, port: int, *, combine: bool) -> list[bytes]: ...


class VehicleCore(Core, Protocol):
    @property
    def period_us(self) -> int: ...
    @property
    def token_us(self) -> int:
        """Stamp that the newest setpoint echoes; -1 before the first."""


class RealTimeVehicleCore(VehicleCore, Keeping, Protocol):
    def warn(self, text: str) -> None:
        """What the driver has to say to whoever flies it."""

    def set_load(self, load: float) -> None:
        """The share of a processor that the process takes, 0 to 1 for each of its threads that is never idle."""

    def receive(self, port: int, datagram: bytes, at_us: int | None = None) -> int:
        """`at_us`: when it came, from the last tick to just before the next; None: at the tick."""

    def close(self) -> None:
        """The end: after it there may be something `unsaved` once more, and nothing after that."""

    def refuse(self, port: int, excess: Excess) -> None:
        """A datagram for `port` was dropped unread; only counted."""


class GroundCore(Core, Protocol):
    @property
    def period_us(self) -> int: ...
    @property
    def vehicle_time_us(self) -> int:
        """Stamp of the newest state; -1 before the first."""


Exchange = Callable[[int, list[bytes]], tuple[list[bytes], bool]]
"""Time in us and what is due to the ground; its answer, and whether that is its last."""

Progress = Callable[[float], None]
"""Flight time in seconds, negative before the release."""


class Tap:
    """What hears every datagram: the digest of the wire, a tlog, and whatever else is to be flushed as time goes.

    What is heard is only kept, and taken in at the next `tick`: some hundred datagrams at once cost half.

    Attributes:
        record: told the time once a second, before the flush: for what is logged at that rate.
        started_us: wall clock at the first datagram of the ground: what came before is start-up, not flying.
    """

    def __init__(
        self,
        tlog: TlogWriter | None = None,
        record: Callable[[int], None] | None = None,
        flush: Callable[[], None] | None = None,
    ) -> None:
        self.tlog = tlog
        self.record = record
        self.flush = flush
        self.started_us: int | None = None
        self._wire = WireHash()
        self._heard: list[Heard] = []
        self._flushed_us = 0
        self._flushed_wall_us = 0

    def hear(self, direction: Direction, now_us: int, datagram: bytes) -> None:
        self._heard.append((direction, now_us, datagram))
        if self.started_us is None and direction is FROM_GROUND:
            self.started_us = monotonic_us()

    @property
    def wire(self) -> WireHash:
        """Of everything heard so far."""
        self._take_in()
        return self._wire

    def close(self) -> None:
        """Take in the last, and close the tlog."""
        try:
            self._take_in()
        finally:
            if self.tlog is not None:
                self.tlog.close()

    def _take_in(self) -> None:
        heard, self._heard = self._heard, []
        self._wire.update(heard)
        if self.tlog is not None:
            # A key is not to be read in a log. A vehicle sends none, and passes none on.
            self.tlog.write(
                [
                    each if each[0] is FROM_VEHICLE or SETUP_SIGNING_ID not in each[2] else _without_keys(each)
                    for each in heard
                ]
            )

    def tick(self, now_us: int, wall_us: int = 0) -> None:
        """Once a control period, or every few. `wall_us`: in real time, where simulated time may be slower."""
        self._take_in()
        if now_us - self._flushed_us >= FLUSH_INTERVAL_US or wall_us - self._flushed_wall_us >= FLUSH_WALL_US:
            self._flushed_us = now_us
            self._flushed_wall_us = wall_us
            if self.record is not None:
                self.record(now_us)
            if self.flush is not None:
                self.flush()
            if self.tlog is not None:
                self.tlog.flush()


def _without_keys(heard: Heard) -> Heard:
    """The good frames that are no SETUP_SIGNING."""
    from mavsitl.codec import parse

    direction, now_us, datagram = heard
    return direction, now_us, b"".join(frame.raw for frame in parse(datagram) if frame.message_id != SETUP_SIGNING)


class _Throttle:
    """Calls back at most every 0.1 s of wall clock; looking at the clock only every 64th time."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress
        self._calls = 0
        self._last_us = -PROGRESS_INTERVAL_US

    def __call__(self, core: Core) -> None:
        self._calls += 1
        if not self._calls & 63:
            self.now(core)

    def now(self, core: Core) -> None:
        """Also while nothing comes: the callback may want to stop the run by an exception."""
        if self._progress is None:
            return
        now_us = monotonic_us()
        if now_us - self._last_us >= PROGRESS_INTERVAL_US:
            self._last_us = now_us
            self._progress(core.flight_time_s)


def _pin(cpu: int | None) -> None:
    """Move the process to one CPU, at the first exchange. Does nothing where the system has no such call.

    Two that take turns never run at once and are faster on one core. Not before: until then each starts up, which two
    cores do faster.
    """
    if cpu is not None and hasattr(os, "sched_setaffinity"):
        with contextlib.suppress(OSError):  # a CPU that we may not use: then the system chooses
            os.sched_setaffinity(0, {cpu})


class LockstepError(LinkError):
    """The two ends answer one another, but not in step."""


def fly_in_memory(
    vehicle: VehicleCore,
    ground: GroundCore,
    tap: Tap | None = None,
    *,
    max_time_s: float = math.inf,
    progress: Progress | None = None,
    channels: Channels | None = None,
) -> int:
    """Both ends in this process until both have finished; the microseconds simulated.

    `channels`: what is between them; None: nothing, every message comes in the tick it was sent.
    Raises `LockstepError` when the ground stops answering or `max_time_s` is over.
    """
    tap = tap or Tap()
    throttle = _Throttle(progress)
    if channels is not None:
        return _fly_impaired(vehicle, channels, ground_in_memory(ground), tap, max_time_s, throttle)
    now_us, period_us, last_us = 0, vehicle.period_us, max_time_s * 1e6
    ground_us = chores_us = 0
    hear = tap.hear
    while True:
        vehicle.step(now_us)
        left = vehicle.finished  # over UDP the ground's last words find nobody
        for datagram in vehicle.datagrams(0, combine=True):
            hear(FROM_VEHICLE, now_us, datagram)
            ground.receive(0, datagram)
            stamp_us = ground.vehicle_time_us
            if stamp_us > ground_us:
                ground_us = stamp_us
            ground.step(ground_us)
            for answer in ground.datagrams(0, combine=True):
                if not left:
                    hear(FROM_GROUND, now_us, answer)
                    vehicle.receive(0, answer)
        if left and ground.finished:
            return now_us
        if vehicle.token_us != now_us:
            raise LockstepError(f"the ground did not answer the telemetry stamped {now_us} us")
        if now_us >= last_us:
            raise LockstepError(f"the flight did not end within {max_time_s:g} s of simulated time")
        if now_us >= chores_us:
            chores_us = now_us + CHORES_PERIODS * period_us
            tap.tick(now_us)
            throttle.now(vehicle)
        now_us += period_us


class _GroundTurns:
    """The ground over an impaired link: its clock is the number of exchanges, its period each."""

    def __init__(self, ground: GroundCore) -> None:
        self._ground = ground
        self.now_us = -ground.period_us

    def take(self, messages: list[bytes]) -> list[bytes]:
        """One exchange: what came, a step, and what it says."""
        self.now_us += self._ground.period_us
        for message in messages:
            self._ground.receive(0, message)
        self._ground.step(self.now_us)
        return self._ground.datagrams(0, combine=True)


def ticks_in_memory(
    vehicle: VehicleCore, ground: GroundCore, channels: Channels, tap: Tap | None = None
) -> Iterator[int]:
    """As `fly_in_memory` over an impaired link, for whoever looks between two ticks, and may stop at any.

    Yields the time of each tick that is over, us. It has no limit but the two ends'. Raises as `fly_in_memory`.
    """
    return _impaired_ticks(vehicle, channels, ground_in_memory(ground), tap or Tap())


def ground_in_memory(ground: GroundCore) -> Exchange:
    """The other side of an impaired link's exchanges, in this process."""
    turns = _GroundTurns(ground)

    def exchange(now_us: int, messages: list[bytes]) -> tuple[list[bytes], bool]:
        return turns.take(messages), ground.finished

    return exchange


def _fly_impaired(
    vehicle: VehicleCore,
    channels: Channels,
    exchange: Exchange,
    tap: Tap,
    max_time_s: float,
    throttle: _Throttle,
) -> int:
    """The vehicle's end over an impaired link, in memory and over UDP alike, until both ends have finished."""
    now_us, last_us = 0, max_time_s * 1e6
    for now_us in _impaired_ticks(vehicle, channels, exchange, tap):
        if now_us >= last_us:
            raise LockstepError(f"the flight did not end within {max_time_s:g} s of simulated time")
        throttle(vehicle)
    return now_us


def _impaired_ticks(vehicle: VehicleCore, channels: Channels, exchange: Exchange, tap: Tap) -> Iterator[int]:
    """The time of each tick that is over.

    `exchange` hands over what is due to the ground and returns its answer, and whether that was its last. The tap
    hears what passes between the ends: behind the one channel, before the other.
    """
    now_us, period_us = 0, vehicle.period_us
    while True:
        vehicle.step(now_us)
        last = exchange_impaired(vehicle, vehicle.datagrams(0, combine=True), channels, exchange, tap, now_us)
        if last and not vehicle.finished:
            raise LockstepError(f"the ground ended at t = {now_us / 1e6:g} s and the vehicle has not disarmed")
        yield now_us
        if last:
            return
        now_us += period_us


def exchange_impaired(
    vehicle: VehicleCore, said: Sequence[bytes], channels: Channels, exchange: Exchange, tap: Tap, now_us: int
) -> bool:
    """What a tick of an impaired link is after the vehicle's step, in which it `said` this; whether it was the last."""
    channels.fly(now_us, vehicle.flight_time_s)
    for datagram in said:
        channels.to_ground.send(datagram, now_us)
    messages = channels.to_ground.due(now_us, EXCHANGE_BYTES)
    for message in messages:
        tap.hear(FROM_VEHICLE, now_us, message)
    answers, last = exchange(now_us, messages)
    for answer in answers:
        tap.hear(FROM_GROUND, now_us, answer)
        channels.to_vehicle.send(answer, now_us)
    for message in channels.to_vehicle.due(now_us):
        vehicle.receive(0, message)
    if not last:
        tap.tick(now_us)
    return last


class _Exchanges:
    """The vehicle's side of the exchanges over UDP."""

    def __init__(
        self, link: ConnectedUdp, vehicle: VehicleCore, throttle: _Throttle, cpu: int | None,
        deadline_s: float, start_deadline_s: float,
    ) -> None:  # fmt: skip
        self._link = link
        self._vehicle = vehicle
        self._throttle = throttle
        self._cpu = cpu
        self._deadline_s = deadline_s
        self._start_deadline_s = start_deadline_s
        self._met = False

    def __call__(self, now_us: int, messages: list[bytes]) -> tuple[list[bytes], bool]:
        if not self._met:
            self._link.send(HELLO)
            if self._receive(now_us, self._start_deadline_s, repeated=HELLO) != HELLO:
                unpack(b"")  # says what is wrong
            self._met = True
            _pin(self._cpu)
        self._link.send(pack(messages))
        answer = HELLO
        while answer == HELLO:  # of one that was repeated
            answer = self._receive(now_us, self._deadline_s)
        return unpack(answer)

    def _receive(self, now_us: int, limit_s: float, repeated: bytes | None = None) -> bytes:
        return _receive(self._link, self._vehicle, self._throttle, now_us, limit_s, repeated)


def _receive(
    link: ConnectedUdp, core: Core, throttle: _Throttle, now_us: int, limit_s: float, repeated: bytes | None = None
) -> bytes:
    """The next datagram, waited for `limit_s` while progress is shown; `repeated` is sent again at each time-out."""
    silent = 0
    while True:
        try:
            return link.receive()
        except LinkSilent as silence:
            throttle.now(core)
            silent += 1
            if silent >= round(limit_s / FIRST_REPEAT_S):
                raise _stopped(now_us, limit_s, silence) from silence
            if repeated is not None:
                link.send(repeated)


def _stopped(now_us: int, limit_s: float, silence: LinkSilent) -> LinkSilent:
    return LinkSilent(f"lock-step stopped at t = {now_us / 1e6:g} s after {limit_s:g} s of silence: {silence}")


def run_lockstep_vehicle(
    vehicle: VehicleCore,
    link: ConnectedUdp,
    tap: Tap,
    *,
    deadline_s: float = 10.0,
    start_deadline_s: float = 60.0,
    cpu: int | None = None,
    progress: Progress | None = None,
    channels: Channels | None = None,
    max_time_s: float = math.inf,
) -> int:
    """The vehicle's end, until it has finished; the microseconds simulated. `link` times out after `FIRST_REPEAT_S`.

    `channels`: the impaired link between the ends, which the ground's end must know of (`impaired`); only then is
    `max_time_s` the limit of simulated time, beyond which a `LockstepError` is raised.
    Raises `LinkSilent` naming the peer when it is silent for `deadline_s` (`start_deadline_s` before its first answer).
    """
    throttle = _Throttle(progress)
    if channels is not None:
        exchange = _Exchanges(link, vehicle, throttle, cpu, deadline_s, start_deadline_s)
        return _fly_impaired(vehicle, channels, exchange, tap, max_time_s, throttle)
    now_us, period_us = 0, vehicle.period_us
    chores_us = 0
    limit_s, met = start_deadline_s, False
    hear = tap.hear
    while True:
        vehicle.step(now_us)
        outbound = vehicle.datagrams(0, combine=True)
        for datagram in outbound:
            hear(FROM_VEHICLE, now_us, datagram)
            link.send(datagram)
        if vehicle.finished:
            return now_us
        silent = out_of_step = 0
        while vehicle.token_us != now_us:
            try:
                answer = link.receive()
            except LinkSilent as silence:
                throttle.now(vehicle)
                silent += 1
                if silent >= round(limit_s / FIRST_REPEAT_S):
                    raise _stopped(now_us, limit_s, silence) from silence
                if vehicle.token_us < 0:
                    for datagram in outbound:
                        link.send(datagram)
                continue
            hear(FROM_GROUND, now_us, answer)
            vehicle.receive(0, answer)
            if not met and vehicle.token_us >= 0:
                limit_s, met = deadline_s, True
                _pin(cpu)
            out_of_step += 1
            if out_of_step > MAX_OUT_OF_STEP:
                raise LockstepError(
                    f"lock-step stopped at t = {now_us / 1e6:g} s: the other side answers, but with setpoints stamped "
                    f"{vehicle.token_us / 1e6:g} s; does it run --lockstep and echo the telemetry's stamp?"
                )
        if now_us >= chores_us:
            chores_us = now_us + CHORES_PERIODS * period_us
            tap.tick(now_us)
            throttle.now(vehicle)
        now_us += period_us


def run_lockstep_ground(
    ground: GroundCore,
    link: ConnectedUdp,
    tap: Tap,
    *,
    deadline_s: float = 10.0,
    start_deadline_s: float = 60.0,
    cpu: int | None = None,
    progress: Progress | None = None,
    impaired: bool = False,
) -> int:
    """The ground's end: it answers each datagram of the vehicle, until it has finished; the vehicle's last stamp.

    `impaired`: the vehicle's end has an impaired link; then the time of the last exchange is returned.
    Raises `LinkSilent` naming the peer when it is silent for `deadline_s` (`start_deadline_s` before its first
    datagram); `link` has a time-out of `FIRST_REPEAT_S`.
    """
    throttle = _Throttle(progress)
    if impaired:
        return _ground_impaired(ground, link, tap, deadline_s, start_deadline_s, cpu, throttle)
    now_us = chores_us = 0
    last = b""
    limit_s, met = start_deadline_s, False
    hear = tap.hear
    while not ground.finished:
        datagram = _receive(link, ground, throttle, now_us, limit_s)
        if datagram == last:  # the vehicle repeats its first until it is answered
            continue
        last = datagram
        if not met:
            limit_s, met = deadline_s, True
            _pin(cpu)
        if datagram == HELLO:
            unpack(b"")  # the other side has an impaired link: says so
        ground.receive(0, datagram)
        now_us = max(now_us, ground.vehicle_time_us)
        hear(FROM_VEHICLE, now_us, datagram)
        ground.step(now_us)
        for answer in ground.datagrams(0, combine=True):
            hear(FROM_GROUND, now_us, answer)
            link.send(answer)
        if now_us >= chores_us:
            chores_us = now_us + CHORES_PERIODS * ground.period_us
            tap.tick(now_us)
            throttle.now(ground)
    return now_us


def _ground_impaired(
    ground: GroundCore, link: ConnectedUdp, tap: Tap, deadline_s: float, start_deadline_s: float,
    cpu: int | None, throttle: _Throttle,
) -> int:  # fmt: skip
    turns = _GroundTurns(ground)
    limit_s, met = start_deadline_s, False
    while not ground.finished:
        datagram = _receive(link, ground, throttle, max(turns.now_us, 0), limit_s)
        limit_s = deadline_s
        if datagram == HELLO:
            link.send(HELLO)
            continue
        messages, _ = unpack(datagram)
        if not met:
            met = True
            _pin(cpu)
        answers = turns.take(messages)
        for message in messages:
            tap.hear(FROM_VEHICLE, turns.now_us, message)
        for answer in answers:
            tap.hear(FROM_GROUND, turns.now_us, answer)
        link.send(pack(answers, last=ground.finished))
        tap.tick(turns.now_us)
        throttle(ground)
    return turns.now_us


@dataclass
class RealTime:
    """How a real-time run kept its time."""

    simulated_us: int
    wall_us: int
    lateness: LatenessHistogram
    rebased: int
    """How often the run was so late that the schedule was moved; simulated time never jumps."""
    lost_us: int
    """Wall time that was given up by that."""


class Taker(Protocol):
    """Whoever is given what comes, a vehicle or a fleet: see `RealTimeVehicleCore`."""

    def receive(self, port: int, datagram: bytes, at_us: int | None = None) -> int: ...
    def refuse(self, port: int, excess: Excess) -> None: ...


class Intake:
    """What comes to a vehicle or a fleet in real time: each source within its budget, and so much of it at a time.

    A datagram beyond its budget is dropped unread; `taker.refuse` counts it.
    """

    def __init__(self, taker: Taker, links: Sequence[Link], taps: Mapping[int, Tap]) -> None:
        """`links` and `taps` by port."""
        self._taker = taker
        self._links = links
        self._taps = taps
        self._budgets = [InputBudget() for _ in links]
        self._queues = [FairQueue() for _ in links]
        self._before: Collection[int] = range(len(links))
        """Ports that were read from the last time."""
        self.waiting: set[int] = set()
        """Ports of which something was read and not handed over yet."""

    def take(self, ports: Collection[int], now_us: int, wall_us: int, at_us: Callable[[], int]) -> None:
        """Read what has come to `ports`, and hand over up to `TAKEN` datagrams of each of them and of those that wait.

        `now_us` is the last tick, `wall_us` any clock on which peers expire and budgets grow, whatever the simulated
        one does, and `at_us()` what the vehicle's clock shows.
        """
        taker = self._taker
        for port in ports:
            budget, queue = self._budgets[port], self._queues[port]
            # Of ports that are read from when they are ready there is mostly one: that there is no second is not asked.
            received = self._links[port].receive(wall_us, READ if port in self._before else 1)
            for datagram, source in received:
                excess = budget.take(source, wall_us)
                if excess is None and not queue.put(datagram, source):
                    excess = Excess.SOURCE
                if excess is not None:
                    taker.refuse(port, excess)
            if queue:
                self.waiting.add(port)
        self._before = ports
        for port in sorted(self.waiting):
            budget, queue, tap = self._budgets[port], self._queues[port], self._taps.get(port)
            for _ in range(min(TAKEN, len(queue))):
                datagram, source = queue.get()
                if tap is not None:
                    tap.hear(FROM_GROUND, now_us, datagram)
                if taker.receive(port, datagram, at_us()) and self._links[port].admit(source, wall_us):
                    budget.peer(source)
            if not queue:
                self.waiting.discard(port)


def run_realtime_vehicle(
    vehicle: RealTimeVehicleCore,
    links: Sequence[Link],
    tap: Tap,
    *,
    speed: float = 1.0,
    until_finished: bool = False,
    stop: Callable[[], bool] = lambda: False,
    say: Callable[[str], None] = lambda text: None,
    progress: Progress | None = None,
    wait: Callable[[Sequence[Link], float], bool] = wait_any,
    due_s: Callable[[], float] = lambda: math.inf,
) -> RealTime:
    """The vehicle on the wall clock, times `speed`. `links` in the order of its ports; peers join by a valid frame.

    Physics, streams and decisions keep to the ticks. What comes between two of them is taken at once, and what the
    services answer to it is sent at once. `wait` tells whether something came within a time in seconds; `say` and the
    vehicle's links are told when real time could not be kept. `due_s`: in so many seconds an impaired link has
    something to hand over. However it ends, the vehicle is closed, and what it had to keep is on the disk.
    """
    clock = PacedClock(vehicle.period_us, speed)
    clock.start()
    start_us = monotonic_us()
    throttle = _Throttle(progress)
    keeper = Keeper(vehicle)
    now_us = 0

    def warn(text: str) -> None:
        vehicle.warn(text)
        say(text)

    lost = LostTime(warn)
    load = Load(vehicle.set_load)

    def send() -> None:
        for port, link in enumerate(links):
            for datagram in vehicle.datagrams(port, combine=False):
                if port == 0:
                    tap.hear(FROM_VEHICLE, now_us, datagram)
                link.send(datagram)

    intake = Intake(vehicle, links, {0: tap})
    ports = range(len(links))

    def take() -> None:
        intake.take(ports, now_us, monotonic_us(), clock.time_us)

    try:
        while not stop() and not (until_finished and vehicle.finished):
            vehicle.step(now_us)
            send()
            next_us = now_us + vehicle.period_us
            for _ in range(WAKES):
                spare_s = clock.spare_s(next_us)
                if spare_s <= GUARD_S:
                    break
                if not intake.waiting:
                    limit_s, soon_s = spare_s - WAKE_S, due_s()
                    came = wait(links, min(limit_s, soon_s)) or soon_s < limit_s
                    if not came or clock.spare_s(next_us) <= GUARD_S:
                        break
                take()
                send()
            clock.wait_until(next_us)
            take()
            wall_us = monotonic_us()
            keeper.step(wall_us)
            tap.tick(now_us, wall_us)
            if clock.lost_us != lost.told_us:
                lost.tell(clock.lost_us, wall_us)
            load.step(wall_us)
            throttle(vehicle)
            now_us = next_us
    finally:
        vehicle.close()
        keeper.close(monotonic_us())
    return RealTime(now_us, monotonic_us() - start_us, clock.lateness, clock.rebased, clock.lost_us)


class LostTime:
    """Says at a bounded rate that the wall clock could not be kept."""

    def __init__(self, warn: Callable[[str], None]) -> None:
        self._warn = warn
        self._next_us = -math.inf
        self.told_us = 0
        """Of the lost time."""

    def tell(self, lost_us: int, now_us: int) -> None:
        if now_us >= self._next_us:
            self._next_us = now_us + SAY_LOST_US
            self._warn(f"Suspended or overloaded: {(lost_us - self.told_us) / 1e6:.1f} s of real time given up")
            self.told_us = lost_us


class Load:
    """Measures the share of a processor that this process takes: SYS_STATUS.load."""

    def __init__(self, tell: Callable[[float], None]) -> None:
        self._tell = tell
        self._begin_us: int | None = None
        self._begin_s = 0.0

    def step(self, now_us: int) -> None:
        """To be called on the wall clock, often."""
        begin_us = self._begin_us
        if begin_us is not None and now_us < begin_us + LOAD_US:
            return
        used_s = processor_s()
        if begin_us is not None:
            self._tell((used_s - self._begin_s) / (now_us - begin_us) * 1e6)
        self._begin_us, self._begin_s = now_us, used_s


def run_realtime_ground(
    ground: GroundCore,
    link: Link,
    tap: Tap,
    *,
    stop: Callable[[], bool] = lambda: False,
    say: Callable[[str], None] = lambda text: None,
    progress: Progress | None = None,
    aside: Callable[[int], None] = lambda now_us: None,
) -> tuple[int, int]:
    """The ground on the wall clock: it steps as soon as telemetry comes, and at least once a control period.

    Its own clock is the wall's less what it was suspended for, which `say` is told: that was no silence of the vehicle.
    `aside` is told that clock at each turn, when all else is done: what is beside the off-board link.
    Returns the microseconds that passed on the vehicle's clock and on the wall since the first state.
    """
    first: tuple[int, int] | None = None
    last = (0, 0)
    throttle = _Throttle(progress)
    lost = LostTime(say)
    start_us = woken_us = monotonic_us()
    lost_us = 0
    period_s = ground.period_us / 1e6
    while not stop() and not ground.finished:
        link.wait(period_s)
        wall_us = monotonic_us()
        late_us = wall_us - woken_us - ground.period_us
        woken_us = wall_us
        if late_us > CATCH_UP_US:
            lost_us += late_us
        if lost_us != lost.told_us:
            lost.tell(lost_us, wall_us)
        now_us = wall_us - start_us - lost_us
        for datagram, source in link.receive(wall_us - start_us):
            tap.hear(FROM_VEHICLE, now_us, datagram)
            if ground.receive(0, datagram):
                link.admit(source, wall_us - start_us)
        ground.step(now_us)
        if ground.vehicle_time_us >= 0:
            last = (ground.vehicle_time_us, wall_us)
            first = last if first is None or last[0] < first[0] else first
        for answer in ground.datagrams(0, combine=False):
            tap.hear(FROM_GROUND, now_us, answer)
            link.send(answer)
        tap.tick(now_us, wall_us)
        throttle(ground)
        aside(now_us)
    return (0, 0) if first is None else (last[0] - first[0], last[1] - first[1])


def run_check(check: Check, links: Sequence[Link | None], duration_s: float) -> int:
    """Listen for so long on the wall clock, or until Ctrl-C, which ends it early; the time of the report.

    `links` in the order of the check's endpoints; None: that one is not open.
    """
    opened = [(port, link) for port, link in enumerate(links) if link is not None]
    start_us = now_us = monotonic_us()
    end_us = start_us + round(duration_s * 1e6) if opened else start_us
    with contextlib.suppress(KeyboardInterrupt):
        while now_us < end_us:
            if not wait_any([link for _, link in opened], CHECK_WAIT_S):
                opened[0][1].wait(NO_SOCKET_WAIT_S)
            for port, link in opened:
                for datagram, source in link.receive(now_us):
                    if check.receive(port, datagram, source, monotonic_us() - start_us):
                        link.admit(source, now_us)
            check.step(now_us - start_us)
            for port, link in opened:
                for datagram in check.datagrams(port):
                    link.send(datagram)
            now_us = monotonic_us()
    return now_us - start_us


def run_ask(ask: Ask, link: Link) -> None:
    """On the wall clock until it is done."""
    start_us = monotonic_us()
    while not ask.done:
        now_us = monotonic_us()
        ask.step(now_us - start_us)
        for datagram in ask.datagrams():
            link.send(datagram)
        link.wait(CHECK_WAIT_S)
        for datagram, source in link.receive(now_us):  # also where nothing came: a TCP client connects by it
            if ask.receive(datagram, now_us - start_us):
                link.admit(source, now_us)
