"""Messages that came from the wire: made when asked for, and then as good as pymavlink's own in every use."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mavsitl import codec
from mavsitl.codec import Message, MessageClass, encode, parse
from mavsitl.dialect import mavlink
from tests.wire.reference import CLASSES, NAMES, address_of, assert_same_message, frame_v1, frame_v2, pymavlink

few = settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.too_slow])
STATUSTEXT = mavlink.MAVLink_statustext_message(6, b"armed", 3, 1)
WIRE = encode(STATUSTEXT, 9, 42, 7)


def received(wire: bytes) -> Message:
    (frame,) = parse(wire)
    return frame.message


def test_nothing_is_decoded_that_nobody_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(raw: bytes) -> Message:
        raise AssertionError("decoded")

    kind = codec._Kind(mavlink.MAVLink_statustext_message)
    kind.decode = refuse
    monkeypatch.setitem(codec._kinds, WIRE[7:10], kind)
    (frame,) = parse(WIRE)
    assert (frame.message_id, *address_of(frame)) == (253, 42, 7, 9, False)
    assert (frame.raw, frame.payload, frame.target) == (WIRE, WIRE[10:-2], (0, 0))
    assert repr(frame) == f"Frame(STATUSTEXT, {WIRE.hex()})"
    with pytest.raises(AssertionError, match="decoded"):
        _ = frame.message


def test_a_message_is_made_once() -> None:
    (frame,) = parse(WIRE)
    assert frame.message is frame.message


@pytest.mark.parametrize("message_class", CLASSES, ids=NAMES)
@given(data=st.data())
@few
def test_pickles_and_copies_are_the_same_message(message_class: MessageClass, data: st.DataObject) -> None:
    payload = data.draw(st.binary(max_size=message_class.unpacker.size))
    wire = frame_v2(message_class, payload, sequence=3)
    theirs = pymavlink().decode(bytearray(wire))
    message = received(wire)
    for other in (pickle.loads(pickle.dumps(message)), copy.copy(message), copy.deepcopy(message)):
        assert_same_message(other, theirs)
        assert other is not message
        assert encode(other, 3, 1, 1) == encode(message, 3, 1, 1)


def test_a_deep_copy_shares_no_array() -> None:
    message = received(
        encode(mavlink.MAVLink_attitude_quaternion_message(1, 1, 0, 0, 0, 0, 0, 0, [1, 2, 3, 4]), 0, 1, 1)
    )
    other = copy.deepcopy(message)
    other.repr_offset_q[0] = 5.0
    assert message.repr_offset_q == [1.0, 2.0, 3.0, 4.0]


def test_what_was_changed_is_kept_in_a_pickle() -> None:
    message = received(WIRE)
    message.severity = 2
    message.get_header().seq = 77
    again = pickle.loads(pickle.dumps(message))
    assert (again.severity, again.get_seq(), again.text) == (2, 77, "armed")


def test_a_message_equals_pymavlinks_own() -> None:
    message, theirs = received(WIRE), pymavlink().decode(bytearray(WIRE))
    assert message == theirs
    assert theirs == message
    assert message != received(encode(STATUSTEXT, 10, 42, 7))


def test_its_class_is_a_message_class_as_good_as_pymavlinks() -> None:
    message = received(WIRE)
    kind = type(message)
    assert issubclass(kind, mavlink.MAVLink_statustext_message)
    assert (kind.id, kind.msgname, kind.__name__) == (253, "STATUSTEXT", "MAVLink_statustext_message")
    assert encode(kind(6, b"armed", 3, 1), 9, 42, 7) == WIRE
    assert type(received(WIRE)) is kind
    with pytest.raises(AttributeError):
        _ = message.no_such_field


@pytest.mark.parametrize("message_class", CLASSES, ids=NAMES)
def test_pymavlink_packs_it_again(message_class: MessageClass) -> None:
    payload = bytes(range(1, message_class.unpacker.size + 1))
    for wire in (frame_v2(message_class, payload), frame_v1(message_class, payload) if message_class.id < 256 else b""):
        for frame in parse(wire):
            theirs = pymavlink().decode(bytearray(wire))
            packed: bytes = frame.message.pack(pymavlink(3, 2, 1))
            assert packed == theirs.pack(pymavlink(3, 2, 1)) == encode(frame.message, 3, 2, 1)
            # Packing leaves its traces in a message; they are the same.
            assert (frame.message.get_msgbuf(), frame.message.get_srcSystem()) == (packed, 2)
            assert (frame.message.get_crc(), bytes(frame.message.get_payload())) == (
                theirs.get_crc(),
                bytes(theirs.get_payload()),
            )


def test_fields_may_be_changed_and_sent_on() -> None:
    message = received(WIRE)
    message.severity = 1
    assert received(encode(message, 0, 1, 1)).severity == 1


@given(st.binary(max_size=80), st.sampled_from(CLASSES))
@settings(max_examples=100, deadline=None)
def test_any_text_reads_as_pymavlink_reads_it(text: bytes, message_class: MessageClass) -> None:
    kinds: list[Any] = [mavlink.MAVLink_statustext_message, mavlink.MAVLink_param_value_message, message_class]
    for kind in kinds:
        wire = frame_v2(kind, (b"\x01\x02\x03\x04" + text + text)[: kind.unpacker.size])
        assert_same_message(received(wire), pymavlink().decode(bytearray(wire)))
