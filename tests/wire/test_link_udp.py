"""UDP on loopback, on ports that the system picks; every wait has a limit."""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import pytest

from mavsitl.codec import MAX_DATAGRAM_BYTES, encode
from mavsitl.dialect import mavlink
from mavsitl.link.base import Link, LinkError, LinkSilent, Source
from mavsitl.link.udp import LOOPBACK, MAX_PEERS, NEWCOMER_BYTES, PEER_SILENCE_US, RESERVED_BYTES, ConnectedUdp, UdpLink

pytestmark = pytest.mark.sockets

LIMIT_S = 5.0

HEARTBEAT = encode(mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 0, 3), 0, 1, 1)


@pytest.fixture
def udp() -> Iterator[Callable[..., UdpLink]]:
    """A maker of links that are closed after the test."""
    with ExitStack() as stack:
        yield lambda *args, **options: stack.enter_context(closing(UdpLink(*args, **options)))


def at(address: Source) -> tuple[str, int]:
    return str(address[0]), int(address[1])


def next_datagram(link: UdpLink, now_us: int = 0) -> tuple[bytes, Source]:
    assert link.wait(LIMIT_S)
    ((datagram, source),) = link.receive(now_us)
    return datagram, source


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, 0))
        return int(taken.getsockname()[1])


def test_the_default_remote_is_fed_unheard_and_answers_to_the_same_socket(udp: Callable[..., UdpLink]) -> None:
    ground = udp()
    vehicle: Link = udp(remote=at(ground.address))
    vehicle.send(b"beat")
    datagram, source = next_datagram(ground)
    assert datagram == b"beat"
    ground.admit(source, 0)
    ground.send(b"answer")
    assert vehicle.wait(LIMIT_S)
    assert vehicle.receive(0) == [(b"answer", ground.address)]
    assert vehicle.receive(0) == []


def test_it_binds_loopback_unless_told_otherwise(udp: Callable[..., UdpLink]) -> None:
    link = udp()
    assert link.address[0] == LOOPBACK
    assert 0 < int(link.address[1]) <= 65535
    assert not link.wait(0.0)


def test_only_admitted_sources_are_fed_and_the_remote_stays(udp: Callable[..., UdpLink]) -> None:
    ground, stranger = udp(), udp()
    vehicle = udp(remote=at(ground.address))
    visitor = udp(remote=at(vehicle.address))
    visitor.send(b"hello")
    _, source = next_datagram(vehicle)
    assert source == visitor.address
    vehicle.send(b"1")
    assert next_datagram(ground)[0] == b"1"
    assert vehicle.admit(source, 0)
    vehicle.send(b"2")
    assert next_datagram(ground)[0] == b"2"
    assert next_datagram(visitor)[0] == b"2"
    assert not stranger.wait(0.0)
    assert vehicle.admit(ground.address, 0)
    assert vehicle.peers == (visitor.address,)


def test_silent_peers_are_let_go_by_the_time_passed_in(udp: Callable[..., UdpLink]) -> None:
    vehicle, visitor = udp(), udp()
    vehicle.admit(visitor.address, 1_000_000)
    vehicle.receive(1_000_000 + PEER_SILENCE_US)
    assert vehicle.peers == (visitor.address,)
    vehicle.admit(visitor.address, 2_000_000)
    vehicle.receive(1_000_001 + PEER_SILENCE_US)
    assert vehicle.peers == (visitor.address,)
    vehicle.receive(2_000_001 + PEER_SILENCE_US)
    assert len(vehicle.peers) == 0


def test_the_number_of_peers_is_bounded_and_nobody_is_pushed_out(udp: Callable[..., UdpLink]) -> None:
    vehicle = udp()
    peers = [(LOOPBACK, 20000 + number) for number in range(MAX_PEERS + 3)]
    assert [vehicle.admit(peer, 0) for peer in peers] == [True] * MAX_PEERS + [False] * 3
    assert vehicle.peers == tuple(peers[:MAX_PEERS])
    assert vehicle.peers_rejected == 3
    assert vehicle.admit(peers[0], PEER_SILENCE_US)
    assert vehicle.admit(peers[-1], PEER_SILENCE_US + 1)
    assert vehicle.peers == (peers[0], peers[-1])


def test_who_spoke_once_is_sent_no_more_than_a_newcomer_s_share(udp: Callable[..., UdpLink]) -> None:
    """One datagram with a forged source brings its victim so much, and then silence."""
    vehicle, visitor = udp(), udp()
    datagram = bytes(1000)
    for _ in range(3):  # what came at once counts once
        assert vehicle.admit(visitor.address, 1_000_000)
    for _ in range(100):
        vehicle.send(datagram)
    first = (NEWCOMER_BYTES - RESERVED_BYTES) // len(datagram)
    assert vehicle.withheld == 100 - first
    assert visitor.wait(LIMIT_S)
    assert len(visitor.receive(0)) == first
    for _ in range(100):  # for which it may wait before it says more
        vehicle.send(HEARTBEAT)
    left = NEWCOMER_BYTES - first * len(datagram)
    assert [data for data, _ in visitor.receive(0)] == [HEARTBEAT] * min(100, left // len(HEARTBEAT))
    assert vehicle.admit(visitor.address, 1_000_001)
    for _ in range(20):
        vehicle.send(datagram)
    assert len(visitor.receive(0)) == 20


def test_nobody_listening_is_no_error_before_or_after_a_client(udp: Callable[..., UdpLink]) -> None:
    port = free_port()
    vehicle = udp(remote=(LOOPBACK, port))
    for _ in range(5):
        vehicle.send(b"lost")
        assert vehicle.receive(0) == []
    ground = udp((LOOPBACK, port))
    vehicle.send(b"heard")
    assert next_datagram(ground)[0] == b"heard"
    ground.close()
    for _ in range(5):
        vehicle.send(b"lost")
        assert vehicle.receive(0) == []


@pytest.mark.skipif(sys.platform != "linux", reason="IP_RECVERR is Linux's way to have refusals reported")
def test_reported_refusals_are_counted_and_lose_nothing(udp: Callable[..., UdpLink]) -> None:
    ip_recverr = 11
    vehicle, visitor = udp(remote=(LOOPBACK, free_port())), udp()
    vehicle._socket.setsockopt(socket.IPPROTO_IP, ip_recverr, 1)
    vehicle.admit(visitor.address, 0)
    for number in range(10):
        vehicle.send(bytes((number,)))
        assert next_datagram(visitor)[0] == bytes((number,))
        if number % 2:
            assert vehicle.receive(0) == []
    assert vehicle.refused > 0


def test_a_dead_peer_keeps_nothing_from_the_others(udp: Callable[..., UdpLink]) -> None:
    vehicle, visitor = udp(), udp()
    vehicle.admit((LOOPBACK, free_port()), 0)
    vehicle.admit(visitor.address, 0)
    for number in range(10):
        vehicle.send(bytes((number,)))
        assert next_datagram(visitor)[0] == bytes((number,))


def test_a_busy_port_is_an_error_that_says_what_to_do(udp: Callable[..., UdpLink]) -> None:
    port = int(udp().address[1])
    with pytest.raises(LinkError) as raised:
        UdpLink((LOOPBACK, port), port_option="--port ...")
    assert str(raised.value) == f"port {port} is in use (bind 127.0.0.1): choose another with --port ..."


def test_an_address_of_another_machine_is_an_error() -> None:
    with pytest.raises(LinkError, match=r"192\.0\.2\.1 is not an address of this machine .*--bind"):
        UdpLink(("192.0.2.1", 0))


def test_a_datagram_over_the_parsers_limit_is_still_seen_to_be_too_long(udp: Callable[..., UdpLink]) -> None:
    vehicle = udp()
    udp(remote=at(vehicle.address)).send(bytes(60_000))
    assert len(next_datagram(vehicle)[0]) == MAX_DATAGRAM_BYTES + 1


def test_more_than_udp_carries_is_an_error(udp: Callable[..., UdpLink]) -> None:
    with pytest.raises(LinkError, match="70000 bytes is too long"):
        udp(remote=at(udp().address)).send(bytes(70_000))


def test_a_closed_link_says_so(udp: Callable[..., UdpLink]) -> None:
    link = udp()
    link.close()
    link.close()
    for use in (lambda: link.receive(0), lambda: link.send(b""), lambda: link.wait(0.0), lambda: link.admit((), 0)):
        with pytest.raises(LinkError, match="closed"):
            use()


def test_turns_over_connected_sockets(udp: Callable[..., UdpLink]) -> None:
    other = udp()
    with closing(ConnectedUdp(at(other.address), timeout_s=LIMIT_S)) as ours:
        stranger = udp(remote=at(ours.address))
        for number in range(20):
            ours.send(bytes((number,)))
            assert next_datagram(other) == (bytes((number,)), ours.address)
            stranger.send(b"stranger")
            other.admit(ours.address, 0)
            other.send(b"reply")
            assert ours.receive() == b"reply"


def test_silence_is_an_error_that_names_the_remote(udp: Callable[..., UdpLink]) -> None:
    other = udp()
    with closing(ConnectedUdp(at(other.address), timeout_s=0.02)) as ours:
        ours.send(b"anybody there?")
        with pytest.raises(LinkSilent, match=rf"nothing came from 127\.0\.0\.1:{other.address[1]} .* within 0\.02 s"):
            ours.receive()


def test_a_remote_that_is_not_there_yet_is_waited_for() -> None:
    port = free_port()
    with closing(ConnectedUdp((LOOPBACK, port), timeout_s=0.05)) as ours:
        for _ in range(3):
            ours.send(b"lost")
            with pytest.raises(LinkSilent):
                ours.receive()
        with closing(ConnectedUdp(at(ours.address), (LOOPBACK, port), timeout_s=LIMIT_S)) as other:
            ours.send(b"found")
            assert other.receive() == b"found"
            other.send(b"yes")
            assert ours.receive() == b"yes"


def test_two_turns_at_one_port_are_an_error_and_so_is_a_closed_socket(udp: Callable[..., UdpLink]) -> None:
    other = udp()
    with pytest.raises(LinkError, match="is in use"):
        ConnectedUdp(at(other.address), at(other.address))
    ours = ConnectedUdp(at(other.address))
    ours.close()
    ours.close()
    with pytest.raises(LinkError, match="cannot send"):
        ours.send(b"x")
    with pytest.raises(LinkError, match="cannot receive"):
        ours.receive()
    with pytest.raises(ValueError, match="timeout_s is 0"):
        ConnectedUdp(at(other.address), timeout_s=0)
