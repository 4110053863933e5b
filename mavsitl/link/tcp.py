"""MAVLink over TCP: `TcpServerLink` for those who connect to us, `TcpClientLink` to connect to somebody.

Both cut the stream into datagrams of one frame each. Neither ever waits for a peer: one that does not take what it is
sent, or that sends no frames, is let go.
"""

from __future__ import annotations

import errno
import os
import select
import socket
from collections import deque
from collections.abc import Sequence
from typing import Any

from mavsitl.clock import monotonic_us
from mavsitl.link.base import MAX_RECEIVED, LinkError, Source
from mavsitl.link.framing import StreamSplitter
from mavsitl.link.sockets import LOOPBACK, bind_socket, resolve, resolve_all, show

__all__ = ["MAX_CLIENTS", "MAX_PENDING_BYTES", "TcpClientLink", "TcpServerLink"]

MAX_CLIENTS = 8

CLIENT_SILENCE_US = 10_000_000
"""A client that has sent nothing valid for so long gives its place to a newcomer who finds none; else it may listen."""

MAX_PENDING_BYTES = 65_536
"""What is kept for a peer that does not read; with more it is let go, for old telemetry is worth nothing."""

MAX_JUNK_BYTES = 16_384
"""A peer that sends so much without one frame speaks another protocol."""

RETRY_US = 1_000_000
"""Time from a failed or lost connection to the next attempt."""

_SYSTEM_BUFFER_BYTES = 65_536
_READ_BYTES = 4096
_MAX_READS = 4  # of each connection in one call
_MAX_ACCEPTED = 16

_Inbox = deque[tuple[bytes, Source]]


class _Connection:
    """One connected socket: its stream cut, and what it has still to take."""

    def __init__(self, connected: socket.socket, source: Source, max_pending_bytes: int) -> None:
        connected.setblocking(False)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self.socket = connected
        self.source = source
        self.heard_us = 0
        self.pending = bytearray()
        self.slow = False
        self.junk = False
        self._max_pending_bytes = max_pending_bytes
        self._splitter = StreamSplitter()

    def read(self, inbox: _Inbox) -> tuple[bool, bool]:
        """Read once: whether the connection lives, and whether more may be there."""
        try:
            octets = self.socket.recv(_READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return True, False
        except OSError:
            return False, False
        if not octets:
            return False, False
        inbox.extend((datagram, self.source) for datagram in self._splitter.feed(octets))
        self.junk = self._splitter.junk_run > MAX_JUNK_BYTES
        return not self.junk, len(octets) == _READ_BYTES

    def send(self, octets: bytes) -> bool:
        """Send or keep for later; whether the connection lives."""
        if not self.pending:
            sent = self._send(octets)
            if sent < 0:
                return False
            octets = octets[sent:]
        self.pending += octets
        self.slow = len(self.pending) > self._max_pending_bytes
        return not self.slow

    def flush(self) -> bool:
        """Send what is kept as far as it goes; whether the connection lives."""
        if self.pending:
            sent = self._send(self.pending)
            if sent < 0:
                return False
            del self.pending[:sent]
        return True

    def _send(self, octets: bytes | bytearray) -> int:
        """Bytes that went, or -1 for a connection that has ended."""
        try:
            return self.socket.send(octets)
        except (BlockingIOError, InterruptedError):
            return 0
        except OSError:
            return -1


def _limit_system_buffer(opened: socket.socket) -> None:
    """What the system keeps for a peer is bounded too, or minutes of telemetry would wait there."""
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SYSTEM_BUFFER_BYTES)


class TcpServerLink:
    """A listening socket and the clients that connected to it, each fed from its first moment.

    Unless told otherwise it listens on loopback, so no other machine can reach it.

    Attributes:
        address: the local socket address, with the real port where 0 was asked for.
        clients_rejected: connections closed at once because every place was taken.
        silent_clients: clients let go because they were silent and a newcomer needed the place.
        slow_clients: clients let go because they did not read what they were sent.
        junk_clients: clients let go because what they sent held no frames.
        accept_errors: connections that the system refused to hand over (no descriptors left).
    """

    def __init__(
        self,
        bind: tuple[str, int] = (LOOPBACK, 0),
        *,
        max_clients: int = MAX_CLIENTS,
        max_pending_bytes: int = MAX_PENDING_BYTES,
        port_option: str = "--port ...",
        host_option: str = "--bind ...",
    ) -> None:
        """Listen. The two options are what an error tells the user to change.

        Raises:
            LinkError: the port is taken, or the host cannot be found or bound.
        """
        if max_clients < 1:
            raise ValueError(f"max_clients is {max_clients}; allowed: 1 or more")
        family, _ = resolve(*bind, kind=socket.SOCK_STREAM)
        self._listener = bind_socket(bind, family, socket.SOCK_STREAM, port_option, host_option)
        self._listener.setblocking(False)
        _limit_system_buffer(self._listener)  # clients inherit it
        self.address: Source = self._listener.getsockname()
        self.clients_rejected = 0
        self.silent_clients = 0
        self.slow_clients = 0
        self.junk_clients = 0
        self.accept_errors = 0
        self._max_clients = max_clients
        self._max_pending_bytes = max_pending_bytes
        self._clients: dict[Source, _Connection] = {}
        self._inbox: _Inbox = deque()
        self._now_us = 0
        self._closed = False

    @property
    def peers(self) -> tuple[Source, ...]:
        """The connected clients, in the order they came."""
        return tuple(self._clients)

    def readers(self) -> Sequence[socket.socket]:
        """The listening socket and those of the clients."""
        return (self._listener, *(client.socket for client in self._clients.values()))

    def receive(self, now_us: int, limit: int = MAX_RECEIVED) -> list[tuple[bytes, Source]]:
        """What has come, each client's oldest first, at most `limit`; takes in new clients.

        Raises `LinkError` after `close`.
        """
        self._check_open()
        self._now_us = now_us
        self._pump()
        return [self._inbox.popleft() for _ in range(min(limit, len(self._inbox)))]

    def wait(self, timeout_s: float) -> bool:
        """Wait until a datagram is complete, at most `timeout_s` seconds; serves connections meanwhile.

        Raises `LinkError` after `close`.
        """
        self._check_open()
        deadline_us = monotonic_us() + max(0, round(timeout_s * 1e6))
        errors = self.accept_errors
        self._pump()
        while not self._inbox:
            remaining_us = deadline_us - monotonic_us()
            if remaining_us <= 0:
                return False
            readable = [client.socket for client in self._clients.values()]
            writable = [client.socket for client in self._clients.values() if client.pending]
            # A connection that cannot be accepted now would end every sleep at once.
            if errors == self.accept_errors or not readable:
                readable.append(self._listener)
            select.select(readable, writable, [], remaining_us * 1e-6)
            self._pump()
        return True

    def send(self, datagram: bytes) -> None:
        """Send to every client; one that takes nothing is let go and keeps nothing from the others.

        Raises `LinkError` after `close`.
        """
        self._check_open()
        for client in list(self._clients.values()):
            if not client.send(datagram):
                self._let_go(client)

    def admit(self, source: Source, now_us: int) -> bool:
        """Whether `source` is connected: a client is fed as long as it is. Raises `LinkError` after `close`."""
        self._check_open()
        client = self._clients.get(source)
        if client is not None:
            client.heard_us = now_us
        return client is not None

    def close(self) -> None:
        """Close every connection and stop listening; a second call does nothing."""
        self._closed = True
        self._inbox.clear()
        for client in self._clients.values():
            client.socket.close()
        self._clients.clear()
        self._listener.close()

    def _pump(self) -> None:
        """Take in clients, send what is kept, read: as much as one call may."""
        self._accept()
        for client in list(self._clients.values()):
            if not client.flush():
                self._let_go(client)
        reading = list(self._clients.values())
        for _ in range(_MAX_READS):
            if not reading or len(self._inbox) >= MAX_RECEIVED:
                break
            more: list[_Connection] = []
            for client in reading:
                lives, again = client.read(self._inbox)
                if not lives:
                    self._let_go(client)
                elif again:
                    more.append(client)
            reading = more

    def _accept(self) -> None:
        for _ in range(_MAX_ACCEPTED):
            try:
                accepted, source = self._listener.accept()
            except (BlockingIOError, InterruptedError):
                return
            except ConnectionAbortedError:
                continue
            except OSError:
                self.accept_errors += 1
                return
            if len(self._clients) >= self._max_clients and not self._make_room():
                self.clients_rejected += 1
                accepted.close()
                continue
            try:
                client = self._clients[source] = _Connection(accepted, source, self._max_pending_bytes)
                client.heard_us = self._now_us
            except OSError:  # it has gone already
                accepted.close()

    def _make_room(self) -> bool:
        """Let the client go that was silent for longest, if that is long; whether there was one."""
        silent = min(self._clients.values(), key=lambda client: client.heard_us)
        if self._now_us - silent.heard_us <= CLIENT_SILENCE_US:
            return False
        self.silent_clients += 1
        self._let_go(silent)
        return True

    def _let_go(self, client: _Connection) -> None:
        self.slow_clients += client.slow
        self.junk_clients += client.junk
        client.socket.close()
        self._clients.pop(client.source, None)

    def _check_open(self) -> None:
        if self._closed:
            raise LinkError(f"the TCP link {show(self.address)} is closed")


class TcpClientLink:
    """A connection to one server, made again when it is lost. A server that is not there yet is no error.

    What is sent while there is no connection is lost and counted, as over UDP to nobody.

    Attributes:
        connections: connections made so far.
        failures: attempts that came to nothing.
        last_error: why the newest attempt or connection ended, or an empty string.
        unsent: datagrams lost for want of a connection.
        slow: connections given up because the server did not read what it was sent.
    """

    def __init__(
        self,
        remote: tuple[str, int],
        *,
        retry_us: int = RETRY_US,
        max_pending_bytes: int = MAX_PENDING_BYTES,
    ) -> None:
        """Find the host and begin to connect.

        Raises:
            LinkError: the host cannot be found.
        """
        self._targets = resolve_all(*remote, kind=socket.SOCK_STREAM)
        self._name = show(remote)
        self.connections = 0
        self.failures = 0
        self.last_error = ""
        self.unsent = 0
        self.slow = 0
        self._retry_us = retry_us
        self._max_pending_bytes = max_pending_bytes
        self._attempts = 0
        self._connecting: tuple[socket.socket, Any] | None = None
        self._connection: _Connection | None = None
        self._retry_at_us: int | None = None
        self._inbox: _Inbox = deque()
        self._closed = False
        # Nobody ever writes into the second: to wait on the first is to wait for the time alone.
        self._idle, self._idle_peer = socket.socketpair()
        self._begin()

    @property
    def connected(self) -> bool:
        """Whether there is a connection now."""
        return self._connection is not None

    @property
    def remote(self) -> Source | None:
        """The server's socket address while there is a connection."""
        return None if self._connection is None else self._connection.source

    def readers(self) -> Sequence[socket.socket]:
        """The connection's socket; none without a connection."""
        return () if self._connection is None else (self._connection.socket,)

    def receive(self, now_us: int, limit: int = MAX_RECEIVED) -> list[tuple[bytes, Source]]:
        """What has come, oldest first, at most `limit`; connects again when it is time.

        Raises `LinkError` after `close`.
        """
        self._check_open()
        self._pump()
        if self._connection is None and self._connecting is None:
            if self._retry_at_us is None:
                self._retry_at_us = now_us + self._retry_us
            elif now_us >= self._retry_at_us:
                self._retry_at_us = None
                self._begin()
        return [self._inbox.popleft() for _ in range(min(limit, len(self._inbox)))]

    def wait(self, timeout_s: float) -> bool:
        """Wait until a datagram is complete, at most `timeout_s` seconds. Raises `LinkError` after `close`."""
        self._check_open()
        deadline_us = monotonic_us() + max(0, round(timeout_s * 1e6))
        self._pump()
        while not self._inbox:
            remaining_us = deadline_us - monotonic_us()
            if remaining_us <= 0:
                return False
            readable, writable = [self._idle], []
            if self._connection is not None:
                readable = [self._connection.socket]
                writable = [self._connection.socket] if self._connection.pending else []
            elif self._connecting is not None:
                writable = [self._connecting[0]]
            # Where a refused connection is reported as an exception only, this third list is what ends the wait.
            select.select(readable, writable, writable, remaining_us * 1e-6)
            self._pump()
        return True

    def send(self, datagram: bytes) -> None:
        """Send to the server; without a connection it is lost. Raises `LinkError` after `close`."""
        self._check_open()
        self._finish()
        if self._connection is None:
            self.unsent += 1
        elif not self._connection.send(datagram):
            self._lose("the server does not read" if self._connection.slow else "the server ended the connection")

    def admit(self, source: Source, now_us: int) -> bool:
        """Whether `source` is the server, which is always fed. Raises `LinkError` after `close`."""
        self._check_open()
        return self._connection is not None and source == self._connection.source

    def close(self) -> None:
        """Close the connection; a second call does nothing."""
        self._closed = True
        self._inbox.clear()
        if self._connecting is not None:
            self._connecting[0].close()
            self._connecting = None
        if self._connection is not None:
            self._connection.socket.close()
            self._connection = None
        self._idle.close()
        self._idle_peer.close()

    def _begin(self) -> None:
        """Begin one attempt, at each of the host's addresses in turn."""
        family, target = self._targets[self._attempts % len(self._targets)]
        self._attempts += 1
        opened = socket.socket(family, socket.SOCK_STREAM)
        try:
            opened.setblocking(False)
            _limit_system_buffer(opened)
            code = opened.connect_ex(target)
        except OSError as error:
            opened.close()
            self._fail(error.strerror or str(error))
            return
        if code in (0, errno.EINPROGRESS, errno.EWOULDBLOCK):
            self._connecting = opened, target
        else:
            opened.close()
            self._fail(os.strerror(code))

    def _finish(self) -> None:
        """Turn an attempt that has come to its end into a connection or a failure."""
        if self._connecting is None:
            return
        opened, target = self._connecting
        _, writable, failed = select.select([], [opened], [opened], 0.0)
        if not writable and not failed:
            return
        self._connecting = None
        code = opened.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if code == 0:
            try:
                # A free port of ours may be the very one asked for: TCP then connects the socket to itself.
                if opened.getsockname() != opened.getpeername():
                    self._connection = _Connection(opened, target, self._max_pending_bytes)
                    self.connections += 1
                    return
                code = errno.ECONNREFUSED
            except OSError as error:
                code = error.errno or errno.ECONNABORTED
        opened.close()
        self._fail(os.strerror(code))

    def _fail(self, reason: str) -> None:
        self.failures += 1
        self.last_error = reason

    def _lose(self, reason: str) -> None:
        if self._connection is not None:
            self.slow += self._connection.slow
            self._connection.socket.close()
            self._connection = None
            self.last_error = reason

    def _pump(self) -> None:
        self._finish()
        connection = self._connection
        if connection is None:
            return
        if not connection.flush():
            self._lose("the server ended the connection")
            return
        for _ in range(_MAX_READS):
            if len(self._inbox) >= MAX_RECEIVED:
                break
            lives, again = connection.read(self._inbox)
            if not lives:
                self._lose("no MAVLink comes from there" if connection.junk else "the server ended the connection")
            if not again:
                break

    def _check_open(self) -> None:
        if self._closed:
            raise LinkError(f"the TCP link to {self._name} is closed")
