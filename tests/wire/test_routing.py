"""Routing between the links of a vehicle: who gets what, and what never goes anywhere."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl.codec import Frame, encode, parse
from mavsitl.dialect import mavlink
from mavsitl.node import Node
from mavsitl.routing import MAX_PEERS, TIMEOUT_US, Router
from mavsitl.signing import Key, setup_signing

OWN = (1, 1)
GCS = (255, 190)
OTHER_GCS = (254, 190)
COMPANION = (1, 191)
GIMBAL = (1, 154)
OTHER_VEHICLE = (2, 1)

HEARTBEAT = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)


def frame(message: Any, sender: tuple[int, int]) -> Frame:
    (found,) = parse(encode(message, 0, *sender))
    return found


def command(target: tuple[int, int], sender: tuple[int, int] = GCS) -> Frame:
    return frame(mavlink.MAVLink_command_long_message(*target, 400, 0, 1, 0, 0, 0, 0, 0, 0), sender)


@pytest.fixture
def router() -> Router:
    """A ground station on port 0, companion and gimbal on 1, another vehicle on 2, nobody on 3."""
    router = Router(4, OWN)
    router.note(0, GCS, 0)
    router.note(1, COMPANION, 0)
    router.note(1, GIMBAL, 0)
    router.note(2, OTHER_VEHICLE, 0)
    return router


@pytest.mark.parametrize(
    ("target", "ports"),
    [
        (COMPANION, (1,)),
        (GIMBAL, (1,)),
        (OTHER_VEHICLE, (2,)),
        ((2, 0), (2,)),
        ((1, 0), (1,)),  # all of our system: us, and those elsewhere
        ((0, 0), (1, 2)),
        (OWN, ()),
        ((2, 154), ()),  # the component was not heard
        ((77, 1), ()),
        (GCS, ()),  # lives where it came from
    ],
)
def test_a_command_goes_where_its_target_is(router: Router, target: tuple[int, int], ports: tuple[int, ...]) -> None:
    assert router.destinations(0, command(target), 1) == ports


def test_what_is_for_all_goes_where_anybody_is(router: Router) -> None:
    text = mavlink.MAVLink_statustext_message(4, b"hello", 0, 0)
    for message in (HEARTBEAT, text, mavlink.MAVLink_system_time_message(1, 2)):
        assert router.destinations(0, frame(message, GCS), 1) == (1, 2)
        assert router.destinations(1, frame(message, COMPANION), 1) == (0, 2)


def test_answers_find_their_way_back(router: Router) -> None:
    ack = mavlink.MAVLink_command_ack_message(400, 0, 0, 0, *GCS)
    assert router.destinations(1, frame(ack, COMPANION), 1) == (0,)
    assert router.destinations(2, frame(ack, OTHER_VEHICLE), 1) == (0,)


def test_a_message_with_a_target_system_alone_goes_to_all_of_it(router: Router) -> None:
    message = mavlink.MAVLink_set_mode_message(2, 1, 0)
    assert not hasattr(message, "target_component")
    assert router.destinations(0, frame(message, GCS), 1) == (2,)


def test_nothing_goes_to_a_port_where_its_sender_is(router: Router) -> None:
    router.note(2, GCS, 0)  # the ground station is on both: a loop
    assert router.destinations(0, frame(HEARTBEAT, GCS), 1) == (1,)
    assert router.destinations(0, command(OTHER_VEHICLE), 1) == ()


def test_our_own_frames_go_nowhere_and_teach_nothing(router: Router) -> None:
    router.note(3, OWN, 0)
    assert router.destinations(0, frame(HEARTBEAT, OWN), 1) == ()
    assert router.destinations(0, frame(HEARTBEAT, GCS), 1) == (1, 2)


@pytest.mark.parametrize("target", [COMPANION, OTHER_VEHICLE, (0, 0), (2, 0)])
def test_keys_are_never_passed_on(router: Router, target: tuple[int, int]) -> None:
    message = setup_signing(target, Key(bytes(range(32))), 5)
    assert router.destinations(0, frame(message, GCS), 1) == ()
    assert router.destinations(0, command(target), 1) != ()


def test_radio_status_stays_on_its_link(router: Router) -> None:
    message = mavlink.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7)
    assert router.destinations(0, frame(message, (51, 68)), 1) == ()


def test_who_falls_silent_is_gone(router: Router) -> None:
    router.note(1, COMPANION, 1000)
    assert router.destinations(0, frame(HEARTBEAT, GCS), TIMEOUT_US) == (1, 2)
    assert router.destinations(0, frame(HEARTBEAT, GCS), TIMEOUT_US + 1) == (1,)
    assert router.destinations(0, command(GIMBAL), TIMEOUT_US + 1) == ()
    assert router.destinations(0, command(COMPANION), TIMEOUT_US + 1000) == (1,)
    assert router.peers(1, TIMEOUT_US + 1001) == []
    # A ground station that moved to another port is served there when it has fallen silent on the first.
    router.note(3, GCS, TIMEOUT_US)
    assert router.destinations(1, frame(HEARTBEAT, COMPANION), TIMEOUT_US + 1) == (3,)


def test_strangers_neither_fill_the_memory_nor_drive_out_the_known(router: Router) -> None:
    for number in range(1000):
        router.note(0, (2 + number % 200, 2 + number // 200), 1)
    assert len(router.peers(0, 1)) == MAX_PEERS
    assert router.destinations(1, command(GCS, COMPANION), 2) == (0,)
    router.note(0, GCS, TIMEOUT_US)
    router.note(0, OTHER_GCS, TIMEOUT_US + 2)  # the strangers have fallen silent: there is room again
    assert router.peers(0, TIMEOUT_US + 2) == [GCS, OTHER_GCS]


def test_frames_are_passed_on_byte_for_byte(router: Router) -> None:
    key = Key(bytes(range(32)))
    version1 = HEARTBEAT.pack(mavlink.MAVLink(None, srcSystem=255, srcComponent=190), force_mavlink1=True)
    arriving = [encode(HEARTBEAT, 200, *GCS), key.sign(encode(HEARTBEAT, 201, *GCS), 3, 99), version1]
    inside, outside = Node(*OWN), Node(*OWN)
    outside.send_message(HEARTBEAT)
    for found in inside.receive(b"".join(arriving)):
        assert 1 in router.destinations(0, found, 1)
        outside.forward(found.raw)
    outside.send_message(HEARTBEAT)
    first, *passed, last = outside.datagrams()
    assert passed == arriving
    assert (parse(first)[0].sequence, parse(last)[0].sequence) == (0, 1)


ADDRESS = st.tuples(st.integers(0, 4), st.integers(0, 4))


@given(
    notes=st.lists(st.tuples(st.integers(0, 3), ADDRESS, st.integers(0, 3 * TIMEOUT_US)), max_size=40),
    port=st.integers(0, 3),
    sender=ADDRESS,
    target=ADDRESS,
    now_us=st.integers(0, 3 * TIMEOUT_US),
)
def test_whatever_was_heard_the_rules_hold(
    notes: list[tuple[int, tuple[int, int], int]],
    port: int,
    sender: tuple[int, int],
    target: tuple[int, int],
    now_us: int,
) -> None:
    router = Router(4, OWN)
    for where, who, when_us in notes:
        router.note(where, who, when_us)
    ports = router.destinations(port, command(target, sender), now_us)
    assert list(ports) == sorted(set(ports))
    assert port not in ports
    assert not ports or (sender != OWN and target != OWN)
    for other in range(4):
        peers = router.peers(other, now_us)
        here = any(target[0] in (0, peer[0]) and (target[0] == 0 or target[1] in (0, peer[1])) for peer in peers)
        if other in ports:
            assert sender not in peers
            assert here
        elif other != port and sender not in peers and OWN not in (sender, target):
            assert not here
