"""Datagrams are taken apart by system without being decoded."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from mavsitl import codec
from mavsitl.codec import Frame, encode, parse
from mavsitl.dialect import mavlink
from mavsitl.routing import NOBODY, by_sender, by_target

MESSAGES = st.one_of(
    st.builds(
        lambda target, value: mavlink.MAVLink_param_set_message(target, 1, b"MPC_XY_CRUISE", value, 9),
        st.integers(0, 255), st.floats(0, 10, width=32),
    ),
    st.builds(
        lambda target, command: mavlink.MAVLink_command_long_message(target, 0, command, 0, *[0.0] * 7),
        st.integers(0, 255), st.integers(0, 1000),
    ),
    st.builds(lambda kind: mavlink.MAVLink_heartbeat_message(kind, 8, 0, 0, 4, 3), st.integers(0, 40)),
    st.builds(
        lambda target, thrust: mavlink.MAVLink_set_attitude_target_message(
            0, target, 1, 7, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, thrust
        ),
        st.integers(0, 255), st.floats(0, 1, width=32),
    ),
)  # fmt: skip


def _target(frame: Frame) -> int:
    return int(getattr(frame.message, "target_system", 0))


def _sender(frame: Frame) -> int:
    return frame.system_id


@given(st.lists(st.tuples(MESSAGES, st.integers(1, 255)), max_size=6))
def test_every_frame_is_in_the_piece_of_its_target_and_of_its_sender(frames: list[tuple[object, int]]) -> None:
    datagram = b"".join(encode(message, 0, sender, 1) for message, sender in frames)
    for split, owner in ((by_target, _target), (by_sender, _sender)):
        pieces = split(datagram)
        assert b"".join(piece for _, piece in pieces) == datagram
        for system_id, piece in pieces:
            assert {owner(frame) for frame in parse(piece)} == {system_id}
        assert all(one[0] != other[0] for one, other in pairwise(pieces))


@given(st.binary(max_size=400))
def test_any_bytes_are_taken_apart_and_nothing_is_lost(junk: bytes) -> None:
    for split in (by_target, by_sender):
        pieces = split(junk)
        assert b"".join(piece for _, piece in pieces) == junk
        assert all(-1 <= system_id <= 255 and piece for system_id, piece in pieces)


def test_what_is_after_a_cut_frame_is_nobodys() -> None:
    whole = encode(mavlink.MAVLink_param_request_list_message(7, 1), 0, 1, 1)
    assert by_target(whole + whole[:-1]) == [(7, whole), (NOBODY, whole[:-1])]
    assert by_target(b"") == []


def test_of_unknown_messages_nothing_is_remembered() -> None:
    """Else a peer could make a fleet keep sixteen million of them."""
    known = dict(codec._kinds)
    for message_id in range(0x700000, 0x700100):
        frame = bytes((0xFD, 1, 0, 0, 0, 9, 1)) + message_id.to_bytes(3, "little") + b"\x07\0\0"
        assert by_target(frame) == [(0, frame)]
    assert codec._kinds == known
