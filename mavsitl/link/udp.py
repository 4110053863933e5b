"""MAVLink over UDP: `UdpLink` for many peers without a wait, `ConnectedUdp` for two that take turns."""

from __future__ import annotations

import errno
import select
import socket
import struct
import sys
from collections.abc import Sequence

from mavsitl.clock import monotonic_us
from mavsitl.codec import MAX_DATAGRAM_BYTES
from mavsitl.link.base import MAX_RECEIVED, LinkError, LinkSilent, Source
from mavsitl.link.sockets import LOOPBACK, bind_socket, resolve, show

__all__ = ["LOOPBACK", "ConnectedUdp", "UdpLink"]

MAX_PEERS = 8
PEER_SILENCE_US = 10_000_000
"""A peer that has sent nothing valid for so long is fed no more."""

NEWCOMER_BYTES = 16_384
"""A new peer is sent no more than this until it speaks again: one forged datagram brings its victim no more."""

RESERVED_BYTES = 1024
"""The part of it that is HEARTBEAT's: a client may wait for one before it says more."""

_SYSTEM_BUFFER_BYTES = 4 << 20
"""Asked for; the system gives what it allows. A flood that comes while the process sleeps pushes nobody else out."""

_READ_BYTES = MAX_DATAGRAM_BYTES + 1  # one more than the parser takes: a cut datagram is still seen to be too long


def _is_heartbeat(datagram: bytes) -> bool:
    """A MAVLink 2 frame with the message id 0."""
    return datagram[7:10] == b"\0\0\0" and datagram[0] == 0xFD


class _Peer:
    """A source that is fed."""

    __slots__ = ("allowance", "heard_us")

    def __init__(self, now_us: int) -> None:
        self.heard_us = now_us
        self.allowance: int | None = NEWCOMER_BYTES
        """Bytes that may still be sent before it speaks again; None: it has, and there is no limit."""


class UdpLink:
    """One socket for both directions. It feeds a default remote, heard or not, and the peers admitted.

    A source becomes a peer by `admit` alone, and never replaces the default remote. Nobody listening at the other side
    is no error. Unless told otherwise it binds loopback, so no other machine can reach it.

    Attributes:
        address: the local socket address, with the real port where 0 was asked for.
        remote: the default remote's socket address, or None.
        refused: sends that met no listener, where the system reports them (Linux does not for a socket of this kind).
        send_errors: datagrams not sent to one receiver because the system refused them (buffers full, no route).
        peers_rejected: admissions refused because every place was taken.
        withheld: datagrams not sent to a new peer that has not spoken again.
    """

    def __init__(
        self,
        bind: tuple[str, int] = (LOOPBACK, 0),
        remote: tuple[str, int] | None = None,
        *,
        max_peers: int = MAX_PEERS,
        peer_silence_us: int = PEER_SILENCE_US,
        port_option: str = "--port ...",
        host_option: str = "--bind ...",
    ) -> None:
        """Bind and resolve. The two options are what an error tells the user to change.

        Raises:
            LinkError: the port is taken, or a host cannot be found or bound.
        """
        family, _ = resolve(*bind)
        self.remote: Source | None = None if remote is None else resolve(*remote, family)[1]
        self._socket = bind_socket(bind, family, socket.SOCK_DGRAM, port_option, host_option)
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SYSTEM_BUFFER_BYTES)
        self.address: Source = self._socket.getsockname()
        self.refused = 0
        self.send_errors = 0
        self.peers_rejected = 0
        self._max_peers = max_peers
        self._peer_silence_us = peer_silence_us
        self.withheld = 0
        self._peers: dict[Source, _Peer] = {}
        self._closed = False

    @property
    def peers(self) -> tuple[Source, ...]:
        """The admitted peers, in the order they came."""
        return tuple(self._peers)

    def readers(self) -> Sequence[socket.socket]:
        """The one socket."""
        return (self._socket,)

    def receive(self, now_us: int, limit: int = MAX_RECEIVED) -> list[tuple[bytes, Source]]:
        """What has come, oldest first, at most `limit`; drops peers silent for too long.

        Raises `LinkError` after `close`.
        """
        self._check_open()
        self._expire(now_us)
        received: list[tuple[bytes, Source]] = []
        for _ in range(limit):
            try:
                received.append(self._socket.recvfrom(_READ_BYTES))
            except BlockingIOError:
                break
            except ConnectionError:
                self.refused += 1  # the answer to an earlier send: nobody listens there
            except OSError as error:
                if error.errno not in (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EMSGSIZE):
                    raise LinkError(f"cannot receive at {show(self.address)}: {error.strerror or error}") from error
                self.refused += 1
        return received

    def wait(self, timeout_s: float) -> bool:
        """Wait until something has come, at most `timeout_s` seconds. Raises `LinkError` after `close`."""
        self._check_open()
        readable, _, _ = select.select([self._socket], [], [], timeout_s)
        return bool(readable)

    def send(self, datagram: bytes) -> None:
        """Send to the default remote and every peer; one that cannot be reached does not keep it from the others.

        Raises:
            LinkError: after `close`, or the datagram is longer than UDP carries.
        """
        self._check_open()
        if self.remote is not None:
            self._send_to(datagram, self.remote)
        for source, peer in self._peers.items():
            if peer.allowance is not None:
                left = peer.allowance - len(datagram)
                if left < (0 if _is_heartbeat(datagram) else RESERVED_BYTES):
                    self.withheld += 1
                    continue
                peer.allowance = left
            self._send_to(datagram, source)

    def admit(self, source: Source, now_us: int) -> bool:
        """Feed `source` until it has been silent too long; whether there was a place for it."""
        self._check_open()
        if source == self.remote:
            return True
        peer = self._peers.get(source)
        if peer is None:
            self._expire(now_us)
            if len(self._peers) >= self._max_peers:
                self.peers_rejected += 1
                return False
            self._peers[source] = _Peer(now_us)
        elif now_us > peer.heard_us:  # not the rest of what came at once
            peer.heard_us = now_us
            peer.allowance = None
        return True

    def close(self) -> None:
        """Close the socket; a second call does nothing."""
        self._closed = True
        self._socket.close()

    def _send_to(self, datagram: bytes, receiver: Source) -> None:
        try:
            self._socket.sendto(datagram, receiver)
        except ConnectionError:
            # The report belongs to an earlier datagram and this one has not gone: send it again.
            self.refused += 1
            try:
                self._socket.sendto(datagram, receiver)
            except OSError:
                self.send_errors += 1
        except OSError as error:
            if error.errno == errno.EMSGSIZE:
                raise LinkError(f"a datagram of {len(datagram)} bytes is too long for {show(receiver)}") from error
            self.send_errors += 1

    def _expire(self, now_us: int) -> None:
        silent = [source for source, peer in self._peers.items() if now_us - peer.heard_us > self._peer_silence_us]
        for source in silent:
            del self._peers[source]

    def _check_open(self) -> None:
        if self._closed:
            raise LinkError(f"the UDP link {show(self.address)} is closed")


class ConnectedUdp:
    """A blocking socket between two that take turns: the fastest exchange there is between two processes.

    Being connected it takes datagrams from its remote alone. A remote that is not there yet is waited for.

    Attributes:
        address: the local socket address, with the real port where 0 was asked for.
        remote: the remote's socket address.
    """

    def __init__(
        self,
        remote: tuple[str, int],
        bind: tuple[str, int] = (LOOPBACK, 0),
        *,
        timeout_s: float = 5.0,
        port_option: str = "--port ...",
        host_option: str = "--bind ...",
    ) -> None:
        """Bind and connect. `timeout_s` is the longest silence that `receive` bears, above 0.

        Raises:
            LinkError: the port is taken, or a host cannot be found, bound or routed to.
        """
        if not timeout_s >= 1e-6:
            raise ValueError(f"timeout_s is {timeout_s}; allowed: at least one microsecond")
        family, _ = resolve(*bind)
        self.remote: Source = resolve(*remote, family)[1]
        self._socket = bind_socket(bind, family, socket.SOCK_DGRAM, port_option, host_option)
        self.address: Source = self._socket.getsockname()
        self._timeout_s = timeout_s
        try:
            self._socket.connect(self.remote)
        except OSError as error:
            self._socket.close()
            raise LinkError(f"no way from {bind[0]} to {show(self.remote)}: {error.strerror or error}") from error
        self._set_timeout(timeout_s)

    def receive(self) -> bytes:
        """The next datagram from the remote.

        Raises:
            LinkSilent: none came within `timeout_s`.
            LinkError: the socket failed or is closed.
        """
        try:
            return self._socket.recv(_READ_BYTES)
        except ConnectionError:
            return self._receive_after_refusal()
        except (BlockingIOError, TimeoutError) as error:
            raise self._silence() from error
        except OSError as error:
            raise self._failure("receive", error) from error

    def send(self, datagram: bytes) -> None:
        """Send to the remote; it is lost without an error when nobody is there yet.

        Raises:
            LinkError: the socket failed or is closed, or the datagram is longer than UDP carries.
        """
        try:
            self._socket.send(datagram)
        except OSError as error:
            self._send_again(datagram, error)

    def close(self) -> None:
        """Close the socket; a second call does nothing."""
        self._socket.close()

    def _send_again(self, datagram: bytes, error: OSError) -> None:
        """After "nobody listens there", which belongs to an earlier datagram: this one has not gone."""
        if isinstance(error, ConnectionError):
            try:
                self._socket.send(datagram)
            except ConnectionError:
                return
            except OSError as again:
                error = again
            else:
                return
        raise self._failure("send", error) from error

    def _receive_after_refusal(self) -> bytes:
        """The wait after "nobody listens there", which would otherwise cut it short."""
        deadline_us = monotonic_us() + int(self._timeout_s * 1e6)
        try:
            while (remaining_us := deadline_us - monotonic_us()) > 0:
                self._set_timeout(remaining_us * 1e-6)
                try:
                    return self._socket.recv(_READ_BYTES)
                except ConnectionError:
                    continue
                except (BlockingIOError, TimeoutError):
                    break
            raise self._silence()
        except OSError as error:
            raise self._failure("receive", error) from error
        finally:
            if self._socket.fileno() >= 0:
                self._set_timeout(self._timeout_s)

    def _set_timeout(self, timeout_s: float) -> None:
        if sys.platform == "win32":
            self._socket.settimeout(timeout_s)
        else:
            # The kernel's own limit needs one system call per datagram, Python's needs two.
            seconds, microseconds = divmod(max(1, round(timeout_s * 1e6)), 1_000_000)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", seconds, microseconds))

    def _silence(self) -> LinkSilent:
        return LinkSilent(
            f"nothing came from {show(self.remote)} to {show(self.address)} within {self._timeout_s:g} s: "
            "is the other side running, and does it send there?"
        )

    def _failure(self, what: str, error: OSError) -> LinkError:
        return LinkError(f"cannot {what} at {show(self.address)} ({show(self.remote)}): {error.strerror or error}")
