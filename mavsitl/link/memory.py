"""Two ends in one process, for runs without sockets: the bytes are those that a socket would carry."""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Sequence

from mavsitl.link.base import MAX_RECEIVED, LinkError, Source

__all__ = ["MemoryLink", "memory_pair"]


class MemoryLink:
    """One end of a pair made by `memory_pair`; what it sends waits at the other end.

    Like a socket it has a receive buffer of bounded length: what comes when it is full, or when the end is closed, is
    lost and counted.

    Attributes:
        address: the name by which the other end sees this one.
        dropped: datagrams lost on their way to this end.
    """

    def __init__(self, name: str, capacity: int) -> None:
        if capacity < 1:
            raise ValueError(f"capacity is {capacity}; allowed: 1 or more datagrams")
        self.address: Source = ("memory", name)
        self.dropped = 0
        self._capacity = capacity
        self._inbox: deque[tuple[bytes, Source]] = deque()
        self._peer: MemoryLink | None = None
        self._closed = False

    def receive(self, now_us: int, limit: int = MAX_RECEIVED) -> list[tuple[bytes, Source]]:
        """What has come, oldest first, at most `limit`. Raises `LinkError` after `close`."""
        self._check_open()
        return [self._inbox.popleft() for _ in range(min(limit, len(self._inbox)))]

    def readers(self) -> Sequence[socket.socket]:
        """None."""
        return ()

    def wait(self, timeout_s: float) -> bool:
        """Whether something can be received. It returns at once: nothing can come while the only thread waits."""
        self._check_open()
        return bool(self._inbox)

    def send(self, datagram: bytes) -> None:
        """Send to the other end. Raises `LinkError` after `close`; a closed other end loses it, as over UDP."""
        self._check_open()
        if self._peer is not None:
            self._peer._deliver(datagram, self.address)

    def admit(self, source: Source, now_us: int) -> bool:
        """Whether `source` is the other end, which is always fed."""
        self._check_open()
        return self._peer is not None and source == self._peer.address

    def close(self) -> None:
        """Close this end and forget what it has not read."""
        self._closed = True
        self._inbox.clear()

    def _deliver(self, datagram: bytes, source: Source) -> None:
        if self._closed or len(self._inbox) >= self._capacity:
            self.dropped += 1
        else:
            self._inbox.append((datagram, source))

    def _check_open(self) -> None:
        if self._closed:
            raise LinkError(f"the in-memory link {self.address[1]!r} is closed")


def memory_pair(capacity: int = 4096) -> tuple[MemoryLink, MemoryLink]:
    """Two connected ends, each holding at most `capacity` unread datagrams."""
    first, second = MemoryLink("first", capacity), MemoryLink("second", capacity)
    first._peer, second._peer = second, first
    return first, second
