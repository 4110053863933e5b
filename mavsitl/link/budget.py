"""How much each source may say, so that one that floods uses up its own share and the others are served."""

from __future__ import annotations

from collections import OrderedDict, deque
from enum import Enum

from mavsitl.link.base import Source
from mavsitl.services.bucket import TokenBucket

__all__ = ["Excess", "FairQueue", "InputBudget"]

PEER_HZ, PEER_BURST = 4000.0, 400.0
"""Datagrams of one peer. A mission that is uploaded over loopback, each item asked for, comes at 3000 a second."""

STRANGER_HZ, STRANGER_BURST = 200.0, 50.0
"""Datagrams of one source that is no peer: it said nothing valid yet, or found no place."""

STRANGERS_HZ, STRANGERS_BURST = 1000.0, 200.0
"""Datagrams of all of those together."""

MAX_PEERS = 16
"""More than a link feeds."""

MAX_STRANGERS = 32
"""Strangers told apart; above it the one not heard for longest is forgotten."""


class Excess(Enum):
    """Which budget was used up."""

    SOURCE = "source"
    """that of the datagram's source"""
    STRANGERS = "strangers"
    """that of all sources that are no peers"""


class InputBudget:
    """One link's. Sources are told apart by their address, which over UDP anybody may forge."""

    def __init__(self) -> None:
        self._peers: OrderedDict[Source, TokenBucket] = OrderedDict()
        self._strangers: OrderedDict[Source, TokenBucket] = OrderedDict()
        self._all_strangers = TokenBucket(STRANGERS_HZ, STRANGERS_BURST)

    def take(self, source: Source, now_us: int) -> Excess | None:
        """Let a datagram of `source` in: None; or why not."""
        bucket = self._peers.get(source)
        if bucket is not None:
            return None if bucket.take(now_us) else Excess.SOURCE
        strangers = self._strangers
        bucket = strangers.get(source)
        if bucket is None:
            if len(strangers) >= MAX_STRANGERS:
                strangers.popitem(last=False)
            bucket = strangers[source] = TokenBucket(STRANGER_HZ, STRANGER_BURST)
        strangers.move_to_end(source)
        if not bucket.take(now_us):
            return Excess.SOURCE
        return None if self._all_strangers.take(now_us) else Excess.STRANGERS

    def peer(self, source: Source) -> None:
        """`source` is fed by the link: from now on it has a peer's budget. The link bounds how many there are."""
        peers = self._peers
        if source in peers:
            peers.move_to_end(source)
            return
        if len(peers) >= MAX_PEERS:
            peers.popitem(last=False)
        peers[source] = TokenBucket(PEER_HZ, PEER_BURST)
        self._strangers.pop(source, None)


class FairQueue:
    """Datagrams that wait, one of each source in turn: who sent many is not in the way of who sent one.

    The order of each source's own datagrams stays. Of one source `MAX_WAITING` wait at most.
    """

    MAX_WAITING = 512

    def __init__(self) -> None:
        self._waiting: OrderedDict[Source, deque[bytes]] = OrderedDict()
        self._length = 0

    def __len__(self) -> int:
        return self._length

    def put(self, datagram: bytes, source: Source) -> bool:
        """Whether there was room for it."""
        waiting = self._waiting.get(source)
        if waiting is None:
            waiting = self._waiting[source] = deque()
        elif len(waiting) >= self.MAX_WAITING:
            return False
        waiting.append(datagram)
        self._length += 1
        return True

    def get(self) -> tuple[bytes, Source]:
        """The next one. Raises `KeyError` where none waits."""
        source, waiting = self._waiting.popitem(last=False)
        datagram = waiting.popleft()
        if waiting:
            self._waiting[source] = waiting  # behind the others
        self._length -= 1
        return datagram, source
