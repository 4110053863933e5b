"""What every link offers: datagrams in, datagrams out, never a wait unless asked."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from typing import Protocol, TypeAlias

from mavsitl.errors import MavsitlError

__all__ = ["MAX_RECEIVED", "Link", "LinkError", "LinkSilent", "Source"]

MAX_RECEIVED = 256
"""Datagrams in one `Link.receive`, so that a flood cannot hold the caller."""

Source: TypeAlias = tuple[str | int, ...]
"""Where a datagram came from, as the link names it: for UDP the socket address, numeric host and port first."""


class LinkError(MavsitlError):
    """A link cannot be opened or used. The text names the address and what to change."""


class LinkSilent(LinkError):
    """Nothing came within the time allowed."""


class Link(Protocol):
    """A datagram link between one endpoint of ours and its peers.

    The times passed in are microseconds of any clock that does not go back, the same one in every call.
    """

    def receive(self, now_us: int, limit: int = MAX_RECEIVED) -> list[tuple[bytes, Source]]:
        """What has come, oldest first, at most `limit`; empty when nothing has. Does not wait."""

    def readers(self) -> Sequence[socket.socket]:
        """Sockets of which one becomes readable when something comes; none where nothing can come during a wait."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until something can be received, at most `timeout_s` seconds; whether there is something."""

    def send(self, datagram: bytes) -> None:
        """Send to the default remote, if there is one, and to every admitted peer."""

    def admit(self, source: Source, now_us: int) -> bool:
        """Take `source` for a peer, or keep it one. Only for sources of datagrams that held a valid frame.

        Returns whether it is fed from now on: the number of peers is bounded, and a new one may find no place.
        """

    def close(self) -> None:
        """Let go of the link's resources; a second call does nothing. Every other call then raises `LinkError`."""
