"""Bad links: a seeded model of one direction in simulated time, and a link that has it in both.

Each message has a fate of its own, as a real link carries one message a datagram: a datagram of several frames is cut
into them. What happens to the n-th message depends on the seed, the direction, n and the time it is sent at, not on
the wall clock. Delays end at the driver's next look: in lock-step one control period later at most.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from heapq import heappop, heappush
from math import inf
from typing import Any

from mavsitl import seeds
from mavsitl.clock import LatenessHistogram
from mavsitl.link.base import MAX_RECEIVED, Link, Source
from mavsitl.link.framing import split_frames
from mavsitl.link.settings import AS_IN_SCENARIO, DirectionName, Overlay
from mavsitl.scenario import Impairment, LinkChange, LinkModel

__all__ = ["MAX_IN_FLIGHT", "Channel", "Channels", "ImpairedLink", "Statistics", "channels_for"]

MAX_IN_FLIGHT = 20_000
"""Messages on their way in one direction, at most; further ones are lost and counted as queue drops."""

_BLOCK = 512
_FOR_EVER_US = 1 << 62
_MAX_FLIPPED_BITS = 3


class Statistics:
    """What became of the messages of one direction; every count is of messages.

    Attributes:
        sent: handed to the channel.
        delivered: came out, copies and corrupted ones included.
        lost: by chance, for itself or in a burst.
        outage: sent during an outage.
        queue_drops: did not fit the queue of the bandwidth limit, or were too many in flight.
        corrupted: bits flipped.
        duplicated: a second copy sent.
        reordered: held back on purpose.
        late: came out after one that was sent later.
        delay: of those delivered, from being sent to being due; in nanoseconds in, in microseconds out.
    """

    __slots__ = (
        "corrupted", "delay", "delivered", "duplicated", "late", "lost", "outage", "queue_drops", "reordered", "sent"
    )  # fmt: skip

    def __init__(self) -> None:
        self.sent = self.delivered = self.lost = self.outage = self.queue_drops = 0
        self.corrupted = self.duplicated = self.reordered = self.late = 0
        self.delay = LatenessHistogram()

    def as_dict(self) -> dict[str, float]:
        """The counts, and the delay's 50th, 99th and 100th percentile in milliseconds."""
        counts: dict[str, float] = {name: getattr(self, name) for name in _COUNTS}
        return counts | {
            "delay_p50_ms": self.delay.p50_us / 1e3,
            "delay_p99_ms": self.delay.p99_us / 1e3,
            "delay_max_ms": self.delay.max_us / 1e3,
        }


_COUNTS = ("sent", "delivered", "lost", "outage", "queue_drops", "corrupted", "duplicated", "reordered", "late")


class _Draws:
    """One generator's numbers, drawn in blocks; `shape` is gamma's."""

    def __init__(self, seed: int, place: str, direction: str, name: str, kind: str = "uniform") -> None:
        self._generator = seeds.generator(seed, place, direction, name)
        self._kind = kind
        self._shape = 0.0
        self._waiting: list[float] = []

    def __call__(self, shape: float = 0.0) -> float:
        if not self._waiting or shape != self._shape:
            self._shape = shape
            if self._kind == "uniform":
                block = self._generator.random(_BLOCK)
            elif self._kind == "normal":
                block = self._generator.standard_normal(_BLOCK)
            elif self._kind == "exponential":
                block = self._generator.standard_exponential(_BLOCK)
            else:
                block = self._generator.standard_gamma(shape, _BLOCK)
            self._waiting = block[::-1].tolist()
        return self._waiting.pop()


class Channel:
    """One direction. `send` datagrams, take those that are `due`; time is the caller's, in microseconds, and never
    goes back.

    Attributes:
        flight_began_us: when flight time was 0, for outages by flight time; None: not flying.
        statistics: what became of the messages so far.
    """

    def __init__(self, impairment: Impairment, seed: int, direction: DirectionName, place: str = "link") -> None:
        """`place`: one of `settings.PLACES`; each has random numbers of its own."""
        self.statistics = Statistics()
        self.flight_began_us: int | None = None
        # A stream for each effect, so that switching one on leaves the others' draws as they are.
        self._loss = _Draws(seed, place, direction, "loss")
        self._burst_loss = _Draws(seed, place, direction, "burst loss")
        self._burst_time = _Draws(seed, place, direction, "burst time", "exponential")
        self._reorder = _Draws(seed, place, direction, "reorder")
        self._duplicate = _Draws(seed, place, direction, "duplicate")
        self._corrupt = _Draws(seed, place, direction, "corrupt")
        self._flip = _Draws(seed, place, direction, "flip")
        self._delays = {
            kind: _Draws(seed, place, direction, f"delay {kind}", kind) for kind in ("uniform", "normal", "gamma")
        }
        self._heap: list[tuple[int, int, int, int, bytes, Any]] = []
        """(due, number of the piece, number of the push, sent, piece, tag)"""
        self._number = self._pushed = 0
        self._newest = -1
        """Largest number that came out."""
        self._free_us = 0.0
        """When the bandwidth has sent what waits for it."""
        self._last_due_us = 0
        self._bad = False
        self._state_ends_us = -inf
        self.impairment = impairment
        self.configure(impairment)

    @property
    def in_flight(self) -> int:
        """Messages sent and not yet taken."""
        return len(self._heap)

    @property
    def next_due_us(self) -> float:
        """When the next message arrives; infinite where none is on its way."""
        return self._heap[0][0] if self._heap else inf

    def configure(self, impairment: Impairment) -> None:
        """Change what is done to messages sent from now on. Those on their way keep their fate.

        Bursts go on as they are unless they are changed themselves; then they begin anew, with a good stretch.
        """
        if impairment.bursts != self.impairment.bursts:
            self._state_ends_us = -inf
        self.impairment = impairment
        self._byte_us = 8e3 / impairment.bandwidth_kbit_s if impairment.bandwidth_kbit_s > 0.0 else 0.0

    def send(self, datagram: bytes, now_us: int, tag: Any = None) -> None:
        """Put the messages of one datagram on their way. `tag` comes out with each of them."""
        for piece in split_frames(datagram):
            self._send(piece, now_us, tag)

    def due(self, now_us: int, limit_bytes: float = inf) -> list[bytes]:
        """What has arrived, each message a datagram, in the order of arrival; at most `limit_bytes`, later the rest."""
        return [piece for piece, _ in self.take(now_us, limit_bytes)]

    def take(self, now_us: int, limit_bytes: float = inf) -> list[tuple[bytes, Any]]:
        """As `due`, each with the tag that it was sent with."""
        heap, statistics = self._heap, self.statistics
        taken: list[tuple[bytes, Any]] = []
        while heap and heap[0][0] <= now_us and (not taken or len(heap[0][4]) <= limit_bytes):
            due_us, number, _, sent_us, piece, tag = heappop(heap)
            limit_bytes -= len(piece)
            taken.append((piece, tag))
            statistics.delivered += 1
            statistics.delay.add(1000 * (due_us - sent_us))
            if number < self._newest:
                statistics.late += 1
            else:
                self._newest = number
        return taken

    def _send(self, piece: bytes, now_us: int, tag: Any) -> None:
        settings, statistics = self.impairment, self.statistics
        statistics.sent += 1
        number, self._number = self._number, self._number + 1
        start_us: float = now_us
        if self._byte_us:
            self._free_us = max(self._free_us, now_us)
            if (self._free_us - now_us) / self._byte_us + len(piece) > settings.queue_bytes:
                statistics.queue_drops += 1
                return
            self._free_us += len(piece) * self._byte_us
            start_us = self._free_us
        if self._out(now_us):
            statistics.outage += 1
            return
        if self._is_lost(now_us):
            statistics.lost += 1
            return
        if settings.corrupt and self._corrupt() < settings.corrupt:
            statistics.corrupted += 1
            piece = self._flipped(piece)
        held_us = 0.0
        if settings.reorder and self._reorder() < settings.reorder:
            statistics.reordered += 1
            held_us = 1e3 * settings.reorder_ms
        due_us = round(start_us + self._delay_us() + held_us)
        if settings.keep_order and not held_us:
            due_us = self._last_due_us = max(due_us, self._last_due_us)
        self._put(due_us, number, now_us, piece, tag)
        if settings.duplicate and self._duplicate() < settings.duplicate:
            statistics.duplicated += 1
            self._put(max(round(start_us + self._delay_us()), due_us if settings.keep_order else 0), number, now_us,
                      piece, tag)  # fmt: skip

    def _put(self, due_us: int, number: int, sent_us: int, piece: bytes, tag: Any) -> None:
        if len(self._heap) >= MAX_IN_FLIGHT:
            self.statistics.queue_drops += 1
            return
        self._pushed += 1
        heappush(self._heap, (due_us, number, self._pushed, sent_us, piece, tag))

    def _out(self, now_us: int) -> bool:
        if self.impairment.down:
            return True
        for outage in self.impairment.outages:
            origin_us = self.flight_began_us if outage.clock == "flight" else 0
            if origin_us is not None:
                since_us = now_us - origin_us - 1e6 * outage.start_s
                if 0.0 <= since_us < 1e6 * outage.duration_s:
                    return True
        return False

    def _is_lost(self, now_us: int) -> bool:
        settings = self.impairment
        lost = settings.loss > 0.0 and self._loss() < settings.loss
        bursts = settings.bursts
        if bursts.bad_ms:
            if self._state_ends_us == -inf:
                self._bad = False
                self._state_ends_us = now_us + 1e3 * bursts.good_ms * self._burst_time()
            while self._state_ends_us <= now_us:
                self._bad = not self._bad
                mean_ms = bursts.bad_ms if self._bad else bursts.good_ms
                self._state_ends_us += 1e3 * mean_ms * self._burst_time()
            share = bursts.loss_bad if self._bad else bursts.loss_good
            lost = self._burst_loss() < share or lost
        return lost

    def _delay_us(self) -> float:
        settings = self.impairment
        mean_us, jitter_us = 1e3 * settings.latency_ms, 1e3 * settings.jitter_ms
        if not jitter_us:
            return mean_us
        draw = self._delays[settings.distribution]
        if settings.distribution == "uniform":
            return max(0.0, mean_us + jitter_us * (2.0 * draw() - 1.0))
        if settings.distribution == "normal":
            return max(0.0, mean_us + jitter_us * draw())
        if not mean_us:  # no scenario has it, parameters may
            return 0.0
        shape = (mean_us / jitter_us) * (mean_us / jitter_us)
        return mean_us / shape * draw(shape)

    def _flipped(self, piece: bytes) -> bytes:
        """One to three different bits, fewer than the CRC of MAVLink can miss."""
        damaged = bytearray(piece)
        wanted = 1 + int(_MAX_FLIPPED_BITS * self._flip())
        places: set[int] = set()
        while len(places) < wanted:
            places.add(int(8 * len(piece) * self._flip()))
        for place in places:
            damaged[place >> 3] ^= 1 << (place & 7)
        return bytes(damaged)


class Channels:
    """Both directions of a link, as the vehicle's end has them, through what the scenario and parameters change.

    What holds is the scenario's, as its changes have made it, under the parameters' overlay.
    """

    def __init__(self, model: LinkModel, seed: int, place: str = "link") -> None:
        """`place`: one of `settings.PLACES`."""
        self.to_ground = Channel(model.to_ground, seed, "to_ground", place)
        self.to_vehicle = Channel(model.to_vehicle, seed, "to_vehicle", place)
        self._base: dict[DirectionName, Impairment] = {"to_ground": model.to_ground, "to_vehicle": model.to_vehicle}
        self._overlay = AS_IN_SCENARIO
        self._changes = model.changes
        self._by_flight = _Timeline(model, "flight")
        self._by_time = _Timeline(model, "simulated")

    def channel(self, direction: DirectionName) -> Channel:
        return self.to_ground if direction == "to_ground" else self.to_vehicle

    def fly(self, now_us: int, flight_time_s: float) -> None:
        """Tell the time of flight, negative before the release; what the scenario changes by now is changed."""
        if flight_time_s < 0.0:
            began_us = None
        else:
            began_us = now_us - round(flight_time_s * 1e6)
        self.to_ground.flight_began_us = self.to_vehicle.flight_began_us = began_us
        if self._changes:
            for change in (*self._by_time.due(now_us / 1e6), *self._by_flight.due(flight_time_s)):
                self.change(change)

    def change(self, change: LinkChange) -> None:
        """What a scenario's `link.changes` do when their time comes, for what is sent from now on."""
        for direction, impairment in self._base.items():
            if change.direction in ("both", direction):
                self._base[direction] = change.of(impairment)
        self._configure()

    def base(self, direction: DirectionName) -> Impairment:
        """What holds of a direction under the parameters' overlay."""
        return self._base[direction]

    def lay_over(self, overlay: Overlay) -> None:
        """The parameters' settings, for what is sent from now on."""
        self._overlay = overlay
        self._configure()

    def _configure(self) -> None:
        for direction, impairment in self._base.items():
            self.channel(direction).configure(self._overlay.of(impairment, direction))

    @property
    def next_due_us(self) -> float:
        """When the next message arrives, either way; infinite where none is on its way."""
        return min(self.to_ground.next_due_us, self.to_vehicle.next_due_us)

    def statistics(self) -> dict[str, dict[str, float]]:
        """By direction."""
        return {
            "to_ground": self.to_ground.statistics.as_dict(),
            "to_vehicle": self.to_vehicle.statistics.as_dict(),
        }


class _Timeline:
    """The changes of one clock. A clock that goes back begins anew: the next flight."""

    def __init__(self, model: LinkModel, clock: str) -> None:
        self._changes = [change for change in model.changes if change.clock == clock]
        self._next = 0

    def due(self, time_s: float) -> list[LinkChange]:
        if time_s < 0.0:
            self._next = 0
            return []
        first = self._next
        while self._next < len(self._changes) and self._changes[self._next].at_s <= time_s:
            self._next += 1
        return self._changes[first : self._next]


def channels_for(model: LinkModel, seed: int, place: str = "link") -> Channels | None:
    """Both channels of a scenario's link; None where it is perfect, and nothing is to be between the ends."""
    return None if model == LinkModel() else Channels(model, seed, place)


class ImpairedLink:
    """A link of the vehicle's with both channels before it, for real time.

    What is due goes when the driver sends or receives: it is told by `due_us` when to look.
    """

    def __init__(
        self,
        link: Link,
        channels: Channels,
        now_us: Callable[[], int],
        flight_time_s: Callable[[], float] = lambda: -1.0,
    ) -> None:
        """`now_us`: simulated time by the wall clock; `flight_time_s`: negative before the release."""
        self._link = link
        self.channels = channels
        self._now_us = now_us
        self.flight_time_s = flight_time_s

    def send(self, datagram: bytes) -> None:
        now_us = self._now_us()
        self.channels.fly(now_us, self.flight_time_s())
        self.channels.to_ground.send(datagram, now_us)
        self._pass_on(now_us)

    def receive(self, now_us: int, limit: int = MAX_RECEIVED) -> list[tuple[bytes, Source]]:
        """What has come through, oldest first. More than `limit` are possible: a datagram of several frames is cut."""
        simulated_us = self._now_us()
        self.channels.fly(simulated_us, self.flight_time_s())
        self._pass_on(simulated_us)
        for datagram, source in self._link.receive(now_us, limit):
            self.channels.to_vehicle.send(datagram, simulated_us, source)
        return self.channels.to_vehicle.take(simulated_us)

    def due_us(self) -> float:
        """From now to the next arrival, in simulated microseconds, at least 0; infinite where nothing is on its way."""
        due_us = self.channels.next_due_us
        return due_us if due_us == inf else max(0.0, due_us - self._now_us())

    def _pass_on(self, now_us: int) -> None:
        for datagram in self.channels.to_ground.due(now_us):
            self._link.send(datagram)

    def readers(self) -> Sequence[socket.socket]:
        return self._link.readers()

    def wait(self, timeout_s: float) -> bool:
        return self._link.wait(timeout_s)

    def admit(self, source: Source, now_us: int) -> bool:
        return self._link.admit(source, now_us)

    def close(self) -> None:
        """What is on its way still arrives, at once: the other end is to hear how it ended."""
        for datagram in self.channels.to_ground.due(_FOR_EVER_US):
            self._link.send(datagram)
        self._link.close()
