"""TIMESYNC (111) and PING (4): how far the other's clock is from ours, and how long a frame takes there and back.

Answers are made on receipt and belong on the wire at once: what they wait in a queue is taken for the link's.
A request of TIMESYNC has ``tc1 == 0``, a request of PING the target 0/0; everything else is an answer and is never
answered.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import median

from mavsitl.codec import Message
from mavsitl.dialect import mavlink
from mavsitl.services.base import NOTHING, Peer
from mavsitl.services.bucket import FairBuckets

__all__ = ["ClockOffset", "Echo", "PingClient", "PingServer", "TimesyncClient", "TimesyncServer"]

ANSWERS_HZ = 200.0
"""Answers a second and asker above which requests are left unanswered: mavros asks 10 times a second."""
ANSWERS_BURST = 50

PENDING = 16
"""Requests that wait for their answer at a time; the oldest gives way."""

_INT64_MAX = 2**63 - 1
_UINT32 = 2**32

# Older definitions of TIMESYNC, pymavlink's among them, have no target.
_TARGETED = "target_system" in mavlink.MAVLink_timesync_message.fieldnames


def _timesync(tc1: int, ts1: int, target: Peer) -> Message:
    return mavlink.MAVLink_timesync_message(tc1, ts1, *(target if _TARGETED else ()))


class TimesyncServer:
    """Answers TIMESYNC requests with our clock.

    Attributes:
        refused: requests left unanswered because there were too many.
    """

    def __init__(self, rate_hz: float = ANSWERS_HZ, burst: float = ANSWERS_BURST) -> None:
        self._buckets = FairBuckets(rate_hz, burst)
        self.refused = 0

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        """A TIMESYNC; `now_us` is the clock to be told, µs."""
        if message.tc1 != 0:
            return NOTHING
        if not self._buckets.take(sender, now_us):
            self.refused += 1
            return NOTHING
        # An answer of 0 would be a request.
        return (_timesync(min(max(now_us * 1000, 1), _INT64_MAX), message.ts1, sender),)

    def step(self, now_us: int) -> Sequence[Message]:
        """Nothing is ever due."""
        return NOTHING


class ClockOffset:
    """The other clock's offset from ours, out of exchanges of which each is late by an unknown part of its round trip.

    One exchange tells the offset to half its round trip. The estimate is the median of the quarter of the last `WINDOW`
    exchanges that were fastest, so queues do not show. `JUMPS` exchanges in a row that contradict it by more than their
    round trips and `tolerance_us` can explain mean that a clock was set or began anew: the past is dropped.

    Attributes:
        offset_ns: the other clock minus ours, ns; None before the first exchange.
        round_trip_ns: of the fastest exchange in the window, ns.
        median_round_trip_ns: of the window, ns.
        exchanges: taken in so far; those that contradict the rest are not.
        restarts: times the past was dropped.
    """

    WINDOW = 16
    JUMPS = 3

    def __init__(self, tolerance_us: int = 10_000) -> None:
        self._tolerance_ns = tolerance_us * 1000
        self._window: deque[tuple[int, int]] = deque(maxlen=self.WINDOW)
        """(round trip ns, offset ns)"""
        self._jumps = 0
        self.offset_ns: int | None = None
        self.round_trip_ns: int | None = None
        self.median_round_trip_ns: int | None = None
        self.exchanges = 0
        self.restarts = 0

    def update(self, sent_ns: int, remote_ns: int, received_ns: int) -> None:
        """One exchange: sent and received by our clock, answered at `remote_ns` by the other; ns."""
        round_trip = received_ns - sent_ns
        if round_trip < 0:
            return
        offset = remote_ns - (sent_ns + received_ns) // 2
        if self.offset_ns is not None and self.round_trip_ns is not None:
            explained = (round_trip + self.round_trip_ns) // 2 + self._tolerance_ns
            if abs(offset - self.offset_ns) > explained:
                self._jumps += 1
                if self._jumps < self.JUMPS:
                    return
                self._window.clear()
                self.restarts += 1
            self._jumps = 0
        self.exchanges += 1
        self._window.append((round_trip, offset))
        fastest = sorted(self._window)
        self.round_trip_ns = fastest[0][0]
        self.median_round_trip_ns = int(median(trip for trip, _ in fastest))
        self.offset_ns = int(median(offset for _, offset in fastest[: (len(fastest) + 3) // 4]))

    def remote_us(self, own_us: int) -> int | None:
        """The other clock when ours shows `own_us`, µs; None before the first exchange."""
        return None if self.offset_ns is None else own_us + self.offset_ns // 1000


class TimesyncClient:
    """Asks one component for its clock at a fixed interval and keeps the estimate.

    Attributes:
        clock: what the answers tell.
    """

    def __init__(self, target: Peer, interval_us: int = 1_000_000, tolerance_us: int = 10_000) -> None:
        """`target` is who is asked and alone believed.

        Raises:
            ValueError: the interval is not above 0.
        """
        if interval_us <= 0:
            raise ValueError(f"interval_us is {interval_us}; allowed: above 0")
        self.clock = ClockOffset(tolerance_us)
        self._target = target
        self._interval_us = interval_us
        self._due_us: int | None = None
        self._pending: deque[int] = deque(maxlen=PENDING)
        """ts1 of the requests without answer, ns"""

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        """A TIMESYNC; taken in if it answers a request of ours, once."""
        if message.tc1 > 0 and sender == self._target and message.ts1 in self._pending:
            self._pending.remove(message.ts1)
            self.clock.update(message.ts1, message.tc1, now_us * 1000)
        return NOTHING

    def step(self, now_us: int) -> Sequence[Message]:
        """A request when one is due; after a pause there is one, not many."""
        if self._due_us is not None and now_us < self._due_us:
            return NOTHING
        self._due_us = now_us + self._interval_us
        stamp_ns = now_us * 1000
        self._pending.append(stamp_ns)
        return (_timesync(0, stamp_ns, self._target),)


class PingServer:
    """Sends each PING that asks everybody back to who sent it.

    Attributes:
        refused: requests left unanswered because there were too many.
    """

    def __init__(self, rate_hz: float = ANSWERS_HZ, burst: float = ANSWERS_BURST) -> None:
        self._buckets = FairBuckets(rate_hz, burst)
        self.refused = 0

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        """A PING; with a target it is an answer to somebody's."""
        if message.target_system != 0 or message.target_component != 0:
            return NOTHING
        if not self._buckets.take(sender, now_us):
            self.refused += 1
            return NOTHING
        return (mavlink.MAVLink_ping_message(message.time_usec, message.seq, *sender),)

    def step(self, now_us: int) -> Sequence[Message]:
        """Nothing is ever due."""
        return NOTHING


@dataclass(slots=True)
class Echo:
    """Who answered our PINGs, and how fast."""

    answers: int = 0
    round_trips_us: deque[int] = field(default_factory=lambda: deque(maxlen=16))
    """the newest, µs"""

    @property
    def median_us(self) -> float:
        """Median round trip of the newest answers, µs."""
        return float(median(self.round_trips_us))


class PingClient:
    """Asks all systems at a fixed interval.

    Attributes:
        echoes: by who answered, at most `MAX_ECHOES`; later ones are not followed.
    """

    MAX_ECHOES = 16

    def __init__(self, interval_us: int = 5_000_000) -> None:
        """Raises `ValueError` unless the interval is above 0."""
        if interval_us <= 0:
            raise ValueError(f"interval_us is {interval_us}; allowed: above 0")
        self.echoes: dict[Peer, Echo] = {}
        self._interval_us = interval_us
        self._due_us: int | None = None
        self._sequence = 0
        self._pending: OrderedDict[tuple[int, int], set[Peer]] = OrderedDict()
        """Who has answered, by (time_usec, seq)."""

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        """A PING; taken in if it answers one of ours, once a sender."""
        if message.target_system == 0:
            return NOTHING
        answered = self._pending.get((message.time_usec, message.seq))
        if answered is None or sender in answered or now_us < message.time_usec:
            return NOTHING
        echo = self.echoes.get(sender)
        if echo is None:
            if len(self.echoes) >= self.MAX_ECHOES:
                return NOTHING
            echo = self.echoes[sender] = Echo()
        answered.add(sender)
        echo.answers += 1
        echo.round_trips_us.append(now_us - message.time_usec)
        return NOTHING

    def step(self, now_us: int) -> Sequence[Message]:
        """A request when one is due."""
        if self._due_us is not None and now_us < self._due_us:
            return NOTHING
        self._due_us = now_us + self._interval_us
        self._sequence = (self._sequence + 1) % _UINT32
        self._pending[now_us, self._sequence] = set()
        if len(self._pending) > PENDING:
            self._pending.popitem(last=False)
        return (mavlink.MAVLink_ping_message(now_us, self._sequence, 0, 0),)
