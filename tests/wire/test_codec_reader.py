"""`reader`: some fields of a frame, for every message of the dialect, as the decoded message has them."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mavsitl.codec import Frame, Message, MessageClass, encode, parse, reader
from mavsitl.dialect import mavlink
from tests.wire.reference import CLASSES, NAMES, frame_v1, frame_v2

every_message = pytest.mark.parametrize("message_class", CLASSES, ids=NAMES)
few = settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])

ODOMETRY = mavlink.MAVLink_odometry_message
PARAM_VALUE = mavlink.MAVLink_param_value_message


def plain(message: Message, name: str) -> Any:
    """A field of a message, as `reader` promises it."""
    value = getattr(message, name)
    if not isinstance(value, list):
        return value
    octets = message.fieldtypes[message.fieldnames.index(name)] == "uint8_t"
    return bytes(value) if octets else tuple(value)


def frame_of(wire: bytes) -> Frame:
    (frame,) = parse(wire)
    return frame


def check(message_class: MessageClass, wire: bytes, order: list[str]) -> None:
    """`repr`, for NaN is to be NaN and -0.0 is not 0.0."""
    frame = frame_of(wire)
    expected = {name: plain(frame.message, name) for name in message_class.fieldnames}
    assert repr(reader(message_class, *order)(frame)) == repr(tuple(expected[name] for name in order))
    flat: list[Any] = []
    for name in order:
        flat += expected[name] if isinstance(expected[name], tuple) else (expected[name],)
    assert repr(reader(message_class, *order, flat=True)(frame)) == repr(tuple(flat))
    for name, value in expected.items():
        assert repr(reader(message_class, name)(frame_of(wire))) == repr((value,))


@every_message
@given(data=st.data())
@few
def test_a_reader_gives_what_the_message_has(message_class: MessageClass, data: st.DataObject) -> None:
    size = message_class.unpacker.size
    payload = data.draw(st.binary(min_size=0, max_size=min(255, size + 4)) | st.binary(min_size=size, max_size=size))
    order = data.draw(st.permutations(message_class.fieldnames))
    chosen = order[: data.draw(st.integers(1, len(order)))]
    signature = data.draw(st.sampled_from([b"", bytes(range(0xF0, 0xFD))]))
    check(message_class, frame_v2(message_class, payload, incompat=bool(signature), signature=signature), chosen)


@pytest.mark.parametrize(
    "message_class", [c for c in CLASSES if c.id < 256], ids=[c.msgname for c in CLASSES if c.id < 256]
)
@given(data=st.data())
@settings(few, max_examples=3)
def test_a_reader_reads_mavlink_1_too(message_class: MessageClass, data: st.DataObject) -> None:
    payload = data.draw(st.binary(max_size=message_class.unpacker.size))
    check(message_class, frame_v1(message_class, payload), data.draw(st.permutations(message_class.fieldnames)))


@every_message
@pytest.mark.parametrize("length", [0, 1, 2, 3, 5, 8, 255])
def test_the_target_is_known_without_a_message(message_class: MessageClass, length: int) -> None:
    payload = bytes(range(1, 256))[:length]
    wires = [frame_v2(message_class, payload)]
    if message_class.id < 256:
        wires.append(frame_v1(message_class, payload))
    for wire in wires:
        frame = frame_of(wire)
        target = frame.target
        assert target == tuple(getattr(frame.message, name, 0) for name in ("target_system", "target_component"))


def test_text_is_what_pymavlink_makes_of_it() -> None:
    read = reader(PARAM_VALUE, "param_id")
    for text in (b"", b"MPC_Z_P", b"x" * 16, b"a\0b", b"\0b", "é".encode()):
        frame = frame_of(frame_v2(PARAM_VALUE, bytes(8) + text.ljust(16, b"\0") + b"\x09"))
        assert read(frame) == (frame.message.param_id,)


def test_fields_come_in_the_order_asked_for() -> None:
    frame = frame_of(encode(PARAM_VALUE(b"MPC_Z_P", 1.5, 9, 300, 17), 0, 1, 1))
    assert reader(PARAM_VALUE, "param_index", "param_id", "param_value")(frame) == (17, "MPC_Z_P", 1.5)
    assert reader(PARAM_VALUE, "param_value", "param_index")(frame) == (1.5, 17)


@pytest.mark.parametrize(
    ("names", "text"),
    [
        (("x", "height"), "ODOMETRY has no field height; it has: time_usec, frame_id"),
        ((), "at least one"),
        (("x", "x"), "once"),
    ],
)
def test_a_wrong_field_is_named(names: tuple[str, ...], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        reader(ODOMETRY, *names)
