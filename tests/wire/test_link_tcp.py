"""TCP on loopback, on ports that the system picks; every wait has a limit."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from functools import partial

import pytest

from mavsitl.codec import encode
from mavsitl.dialect import mavlink
from mavsitl.link.base import Link, LinkError, Source
from mavsitl.link.sockets import LOOPBACK
from mavsitl.link.tcp import CLIENT_SILENCE_US, MAX_JUNK_BYTES, RETRY_US, TcpClientLink, TcpServerLink

pytestmark = pytest.mark.sockets

LIMIT_S = 5.0
BEAT = mavlink.MAVLink_heartbeat_message(2, 12, 209, 0x60000, 4, 3)
WIRE = [encode(BEAT, sequence, 1, 1) for sequence in range(256)]


class Made:
    """Links and plain sockets that are closed after the test."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack

    def server(self, *args: tuple[str, int], **options: int) -> TcpServerLink:
        return self._stack.enter_context(closing(TcpServerLink(*args, **options)))  # type: ignore[arg-type]

    def client(self, server: TcpServerLink, **options: int) -> TcpClientLink:
        return self._stack.enter_context(closing(TcpClientLink(at(server.address), **options)))

    def plain(self, server: TcpServerLink, receive_buffer: int | None = None) -> socket.socket:
        """A socket that has connected and been taken in."""
        opened = self._stack.enter_context(socket.socket())
        if receive_buffer is not None:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        opened.settimeout(LIMIT_S)
        opened.connect(at(server.address))
        until(server, lambda: opened.getsockname() in server.peers)
        return opened


@pytest.fixture
def made() -> Iterator[Made]:
    with ExitStack() as stack:
        yield Made(stack)


def at(address: Source) -> tuple[str, int]:
    return str(address[0]), int(address[1])


def until(link: TcpServerLink | TcpClientLink, condition: Callable[[], bool]) -> None:
    """Let the link work until the condition holds: each round waits for what comes, all together have a limit."""
    for _ in range(int(LIMIT_S / 0.01)):
        if condition():
            return
        link.wait(0.01)
    raise AssertionError("it did not come about within the limit")


def connect(client: TcpClientLink, server: TcpServerLink) -> None:
    until(client, lambda: client.connected)
    until(server, lambda: len(server.peers) > 0)


def next_datagrams(link: TcpServerLink | TcpClientLink, count: int) -> list[bytes]:
    found: list[bytes] = []
    while len(found) < count:
        assert link.wait(LIMIT_S)
        found += [datagram for datagram, _ in link.receive(0)]
    return found


def read_all(opened: socket.socket, count: int) -> bytes:
    octets = b""
    while len(octets) < count:
        octets += opened.recv(count - len(octets))
    return octets


def ended(opened: socket.socket) -> bool:
    """Whether the other side has closed; what it sent before is thrown away."""
    try:
        while opened.recv(65_536):
            pass
    except ConnectionError:
        pass
    return True


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind((LOOPBACK, 0))
        return int(taken.getsockname()[1])


def test_both_directions_in_whole_frames(made: Made) -> None:
    server = made.server()
    client = made.client(server)
    connect(client, server)
    ends: tuple[Link, Link] = server, client
    for frame in WIRE[:20]:
        for end in ends:
            end.send(frame)
    assert next_datagrams(client, 20) == WIRE[:20]
    assert next_datagrams(server, 20) == WIRE[:20]
    assert client.remote == server.address


def test_it_listens_on_loopback_unless_told_otherwise(made: Made) -> None:
    server = made.server()
    assert server.address[0] == LOOPBACK
    assert 0 < int(server.address[1]) <= 65535
    assert not server.wait(0.0)
    assert server.receive(0) == []


def test_a_frame_in_pieces_is_not_received_before_it_is_whole(made: Made) -> None:
    server = made.server()
    plain = made.plain(server)
    plain.sendall(WIRE[0][:7])
    assert not server.wait(0.01)
    plain.sendall(WIRE[0][7:] + WIRE[1])
    assert next_datagrams(server, 2) == WIRE[:2]


def test_clients_do_not_mix_and_are_told_apart(made: Made) -> None:
    server = made.server()
    first, second = made.plain(server), made.plain(server)
    first.sendall(WIRE[0][:9])
    second.sendall(WIRE[1][:9])
    assert not server.wait(0.01)
    second.sendall(WIRE[1][9:])
    assert server.wait(LIMIT_S)
    assert server.receive(0) == [(WIRE[1], second.getsockname())]
    first.sendall(WIRE[0][9:])
    assert server.wait(LIMIT_S)
    assert server.receive(0) == [(WIRE[0], first.getsockname())]
    assert server.admit(first.getsockname(), 0)
    assert not server.admit((LOOPBACK, 1), 0)


def test_every_client_is_fed_though_it_has_said_nothing(made: Made) -> None:
    server = made.server()
    clients = [made.plain(server) for _ in range(3)]
    server.send(WIRE[0])
    assert [read_all(client, len(WIRE[0])) for client in clients] == [WIRE[0]] * 3


def test_the_number_of_clients_is_bounded_and_nobody_is_pushed_out(made: Made) -> None:
    server = made.server(max_clients=2)
    clients = [made.plain(server) for _ in range(2)]
    with socket.create_connection(at(server.address), timeout=LIMIT_S) as third:
        until(server, lambda: server.clients_rejected == 1)
        assert ended(third)
    assert server.peers == tuple(client.getsockname() for client in clients)
    clients[0].close()
    until(server, lambda: len(server.peers) == 1)
    made.plain(server)
    assert len(server.peers) == 2


def test_a_silent_client_keeps_its_place_until_somebody_needs_it(made: Made) -> None:
    """Else eight connections that say nothing would keep every ground station out."""
    server = made.server(max_clients=2)
    speaks, silent = made.plain(server), made.plain(server)
    server.receive(CLIENT_SILENCE_US + 1)
    assert len(server.peers) == 2
    assert server.admit(speaks.getsockname(), CLIENT_SILENCE_US + 1)
    newcomer = made.plain(server)
    assert server.peers == (speaks.getsockname(), newcomer.getsockname())
    assert ended(silent)
    assert (server.silent_clients, server.clients_rejected) == (1, 0)


def test_a_client_that_does_not_read_is_let_go_and_the_others_miss_nothing(made: Made) -> None:
    server = made.server(max_pending_bytes=10_000)
    slow, quick = made.plain(server, receive_buffer=4096), made.plain(server)
    # One system's buffers are larger than another's: it goes on until the slow one is found out, within a limit.
    for number in range(20_000):
        server.send(WIRE[number % 256] * 10)
        assert read_all(quick, 10 * len(WIRE[0])) == WIRE[number % 256] * 10
        if server.slow_clients:
            break
    assert server.slow_clients == 1
    assert server.peers == (quick.getsockname(),)
    assert ended(slow)


def test_what_is_kept_for_a_client_reaches_it_in_order(made: Made) -> None:
    server = made.server(max_pending_bytes=10_000_000)
    plain = made.plain(server, receive_buffer=4096)
    sent = 0
    (connection,) = server._clients.values()
    while len(connection.pending) < 50_000:
        server.send(WIRE[sent % 256])
        sent += 1
    octets = b""
    while len(octets) < sent * len(WIRE[0]):
        server.receive(0)
        octets += plain.recv(65_536)
    assert octets == b"".join(WIRE[number % 256] for number in range(sent))
    assert not connection.pending


def test_a_client_that_speaks_another_protocol_is_let_go(made: Made) -> None:
    server = made.server()
    plain = made.plain(server)
    plain.sendall(b"GET / HTTP/1.1\r\n" * (MAX_JUNK_BYTES // 16 + 1))
    until(server, lambda: server.receive(0) == [] and server.junk_clients == 1)
    assert server.peers == ()


def test_a_little_junk_is_handed_on_and_forgiven(made: Made) -> None:
    server = made.server()
    plain = made.plain(server)
    plain.sendall((b"x" * 1000 + WIRE[0]) * (2 * MAX_JUNK_BYTES // 1000))
    found: list[bytes] = []
    while found.count(WIRE[0]) < 2 * MAX_JUNK_BYTES // 1000:
        found += next_datagrams(server, 1)
    assert b"".join(found).count(b"x") == 1000 * (2 * MAX_JUNK_BYTES // 1000)
    assert server.peers == (plain.getsockname(),)


def test_what_a_client_said_before_it_went_is_received(made: Made) -> None:
    server = made.server()
    plain = made.plain(server)
    plain.sendall(WIRE[0] + WIRE[1][:5])
    plain.close()
    assert next_datagrams(server, 1) == [WIRE[0]]
    until(server, lambda: server.peers == ())
    server.send(WIRE[0])


def test_one_call_returns_a_bounded_number_and_loses_none(made: Made) -> None:
    server = made.server()
    plain = made.plain(server)
    sent = b"".join(WIRE) * 4
    plain.sendall(sent)
    received: list[bytes] = []
    while len(received) < 1024:
        assert server.wait(LIMIT_S)
        batch = server.receive(0)
        assert len(batch) <= 256
        received += [datagram for datagram, _ in batch]
    assert b"".join(received) == sent


def test_a_client_waits_for_its_server_and_comes_back_to_it(made: Made) -> None:
    port = free_port()
    with closing(TcpClientLink((LOOPBACK, port))) as client:
        until(client, lambda: client.failures == 1)
        assert client.last_error
        client.send(WIRE[0])
        assert client.unsent == 1
        assert client.receive(0) == []  # from here the next attempt is RETRY_US away
        server = made.server((LOOPBACK, port))
        client.receive(RETRY_US - 1)
        assert not client.wait(0.0)
        assert not client.connected
        client.receive(RETRY_US)
        connect(client, server)
        client.send(WIRE[1])
        assert next_datagrams(server, 1) == [WIRE[1]]

        server.close()
        until(client, lambda: not client.connected)
        assert client.last_error == "the server ended the connection"
        again = made.server((LOOPBACK, port))
        client.receive(10 * RETRY_US)
        client.receive(11 * RETRY_US)
        connect(client, again)
        assert client.connections == 2
        again.send(WIRE[2])
        assert next_datagrams(client, 1) == [WIRE[2]]


def test_a_client_tells_its_server_from_others(made: Made) -> None:
    server = made.server()
    client = made.client(server)
    assert not client.admit(server.address, 0)
    connect(client, server)
    assert client.admit(server.address, 0)
    assert not client.admit((LOOPBACK, 1), 0)


def test_a_client_gives_up_a_server_that_speaks_another_protocol_or_does_not_read(made: Made) -> None:
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        listener.bind((LOOPBACK, 0))
        listener.listen()
        with closing(TcpClientLink(listener.getsockname(), max_pending_bytes=10_000)) as client:
            until(client, lambda: client.connected)
            with listener.accept()[0] as accepted:
                accepted.settimeout(LIMIT_S)
                accepted.sendall(b"SSH-2.0 " * (MAX_JUNK_BYTES // 8 + 1))
                until(client, lambda: client.receive(0) == [] and not client.connected)
            assert client.last_error == "no MAVLink comes from there"
            client.receive(RETRY_US)
            client.receive(2 * RETRY_US)
            until(client, lambda: client.connected)
            with listener.accept()[0]:
                for _ in range(2000):
                    client.send(WIRE[0] * 50)
                    if not client.connected:
                        break
            assert client.slow == 1
            assert client.last_error == "the server does not read"


def test_a_busy_port_is_an_error_that_says_what_to_do(made: Made) -> None:
    port = int(made.server().address[1])
    with pytest.raises(LinkError) as raised:
        TcpServerLink((LOOPBACK, port), port_option="--port ...")
    assert str(raised.value) == f"port {port} is in use (bind 127.0.0.1): choose another with --port ..."


def test_a_port_is_free_again_at_once(made: Made) -> None:
    server = made.server()
    plain = made.plain(server)
    server.close()  # the side that closes first is the one whose port would rest
    assert ended(plain)
    plain.close()
    assert made.server(at(server.address)).address == server.address


def test_an_address_of_another_machine_is_an_error() -> None:
    with pytest.raises(LinkError, match=r"192\.0\.2\.1 is not an address of this machine .*--bind"):
        TcpServerLink(("192.0.2.1", 0))


def test_capacity_is_checked() -> None:
    with pytest.raises(ValueError, match="max_clients is 0"):
        TcpServerLink(max_clients=0)


def test_closed_links_say_so(made: Made) -> None:
    server = made.server()
    client = made.client(server)
    connect(client, server)
    links: tuple[Link, Link] = client, server
    for link in links:
        link.close()
        link.close()
        uses: list[Callable[[], object]] = [
            partial(link.receive, 0),
            partial(link.send, b""),
            partial(link.wait, 0.0),
            partial(link.admit, (), 0),
        ]
        for use in uses:
            with pytest.raises(LinkError, match="closed"):
                use()
