"""The endpoint: numbering, datagrams, sources, addressing."""

from __future__ import annotations

from itertools import pairwise

import pytest

from mavsitl.codec import EncodeError, Frame, encode, packer, parse
from mavsitl.dialect import mavlink
from mavsitl.node import MAX_SOURCES, Node

HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, 12, 209, 0, 4, 3)
pack_ping = packer(mavlink.MAVLink_ping_message)


def heartbeat(sequence: int, system_id: int = 255, component_id: int = 190) -> bytes:
    return encode(HEARTBEAT, sequence, system_id, component_id)


def frame_of(message: object) -> Frame:
    return parse(encode(message, 0, 255, 190))[0]


def test_frames_are_numbered_around_the_circle() -> None:
    node = Node(1, 1)
    for number in range(300):
        node.send(pack_ping, number, number, 0, 0)
    node.send_message(HEARTBEAT)
    frames = [parse(datagram) for datagram in node.datagrams()]
    assert [len(found) for found in frames] == [1] * 301
    assert [found[0].sequence for found in frames] == [number % 256 for number in range(301)]
    assert {(found[0].system_id, found[0].component_id) for found in frames} == {(1, 1)}
    assert node.datagrams() == []


def test_a_message_that_does_not_fit_uses_no_number() -> None:
    node = Node(1, 1)
    with pytest.raises(EncodeError):
        node.send(pack_ping, -1, 0, 0, 0)
    node.send(pack_ping, 1, 0, 0, 0)
    (datagram,) = node.datagrams()
    assert parse(datagram)[0].sequence == 0


@pytest.mark.parametrize("max_bytes", [1, 21, 42, 100, 1400])
def test_combined_datagrams_keep_order_and_size(max_bytes: int) -> None:
    node, single = Node(1, 1), Node(1, 1)
    for number in range(50):
        node.send_message(HEARTBEAT)
        single.send_message(HEARTBEAT)
        node.send(pack_ping, number + 1, 2, 3, 4)
        single.send(pack_ping, number + 1, 2, 3, 4)
    datagrams = node.datagrams(combine=True, max_bytes=max_bytes)
    frames = single.datagrams()
    assert b"".join(datagrams) == b"".join(frames)
    longest = max(len(frame) for frame in frames)
    assert all(len(datagram) <= max(max_bytes, longest) for datagram in datagrams)
    for first, second in pairwise(datagrams):
        assert len(first) + len(second) > max_bytes
    assert node.datagrams(combine=True) == []


def test_own_frames_are_dropped_and_those_of_a_neighbour_component_are_not() -> None:
    node = Node(1, 1)
    frames = node.receive(heartbeat(0, 1, 1) + heartbeat(0, 1, 191) + heartbeat(1, 1, 1))
    assert [(frame.system_id, frame.component_id) for frame in frames] == [(1, 191)]
    assert node.own_frames == 2
    assert node.counters.frames == 3
    assert list(node.sources) == [(1, 191)]


def test_loss_counts_the_gaps_around_the_circle() -> None:
    node = Node(1, 1)
    for sequence in (250, 251, 254, 255, 0, 3):
        node.receive(heartbeat(sequence))
    source = node.sources[255, 190]
    assert (source.received, source.lost, source.late) == (6, 4, 0)
    assert source.loss == pytest.approx(0.4)


def test_a_late_frame_is_not_lost_and_a_repeated_one_changes_no_loss() -> None:
    node = Node(1, 1)
    for sequence in (10, 12, 11, 13, 13):
        node.receive(heartbeat(sequence))
    source = node.sources[255, 190]
    assert (source.received, source.lost, source.late, source.sequence) == (5, 0, 2, 13)


def test_a_sender_that_began_anew_is_followed() -> None:
    node = Node(1, 1)
    node.receive(heartbeat(100))
    for sequence in range(30):
        node.receive(heartbeat(sequence))
    source = node.sources[255, 190]
    assert (source.restarts, source.lost, source.sequence) == (1, 0, 29)


def test_sources_are_counted_apart_and_bounded() -> None:
    node = Node(1, 1)
    node.receive(heartbeat(0))
    for number in range(3 * MAX_SOURCES):
        node.receive(heartbeat(number & 0xFF, 2 + number % 200, 5))
        assert len(node.receive(heartbeat(number + 1 & 0xFF))) == 1
    assert len(node.sources) == MAX_SOURCES
    assert node.sources[255, 190].received == 3 * MAX_SOURCES + 1
    assert node.sources[255, 190].lost == 0


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        ((1, 1), True),
        ((0, 0), True),
        ((1, 0), True),
        ((0, 1), True),
        ((2, 1), False),
        ((1, 25), False),
        ((0, 25), False),
    ],
)
def test_addressing(target: tuple[int, int], expected: bool) -> None:
    node = Node(1, 1)
    assert node.addressed_to(frame_of(mavlink.MAVLink_param_request_list_message(*target))) is expected


def test_messages_with_no_target_or_half_of_one_are_for_everybody_or_the_system() -> None:
    node = Node(1, 1)
    assert node.addressed_to(frame_of(HEARTBEAT))
    assert node.addressed_to(frame_of(mavlink.MAVLink_set_mode_message(1, 0, 0)))
    assert not node.addressed_to(frame_of(mavlink.MAVLink_set_mode_message(2, 0, 0)))


@pytest.mark.parametrize("address", [(0, 1), (1, 0), (256, 1), (1, -1)])
def test_an_address_that_nobody_can_have(address: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="allowed: 1 to 255"):
        Node(*address)
