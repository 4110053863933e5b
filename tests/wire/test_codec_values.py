"""Every message of the dialect, both ways, against pymavlink."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mavsitl.codec import EncodeError, MessageClass, encode, packer, parse
from mavsitl.dialect import mavlink
from tests.wire.reference import CLASSES, NAMES, address_of, assert_same_message, frame_v1, frame_v2, pymavlink

every_message = pytest.mark.parametrize("message_class", CLASSES, ids=NAMES)
few = settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])
octet = st.integers(0, 255)


@every_message
@given(data=st.data(), sequence=octet, system_id=octet, component_id=octet)
@few
def test_any_payload_reads_and_writes_as_pymavlink_does(
    message_class: MessageClass, data: st.DataObject, sequence: int, system_id: int, component_id: int
) -> None:
    # Shorter payloads are the truncation of trailing zeros, longer ones the fields of a newer definition.
    size = message_class.unpacker.size
    payload = data.draw(st.binary(min_size=0, max_size=min(255, size + 4)) | st.binary(min_size=size, max_size=size))
    wire = frame_v2(message_class, payload, sequence=sequence, system_id=system_id, component_id=component_id)

    (frame,) = parse(wire)
    theirs = pymavlink().decode(bytearray(wire))
    assert_same_message(frame.message, theirs)
    assert address_of(frame) == (system_id, component_id, sequence, False)

    expected = theirs.pack(pymavlink(sequence, system_id, component_id))
    assert encode(frame.message, sequence, system_id, component_id) == expected
    fields = [getattr(theirs, f"_{name}_raw", getattr(theirs, name)) for name in message_class.fieldnames]
    assert packer(message_class)(sequence, system_id, component_id, *fields) == expected


@pytest.mark.parametrize(
    "message_class", [c for c in CLASSES if c.id < 256], ids=[c.msgname for c in CLASSES if c.id < 256]
)
@given(data=st.data())
@settings(few, max_examples=3)
def test_mavlink_1_reads_as_pymavlink_does(message_class: MessageClass, data: st.DataObject) -> None:
    wire = frame_v1(message_class, data.draw(st.binary(max_size=message_class.unpacker.size)), sequence=7)
    (frame,) = parse(wire)
    assert_same_message(frame.message, pymavlink().decode(bytearray(wire)))
    assert address_of(frame) == (1, 1, 7, False)


@every_message
@pytest.mark.parametrize("fill", [0x00, 0x7F, 0x80, 0xFF])
def test_the_ends_of_every_range(message_class: MessageClass, fill: int) -> None:
    wire = frame_v2(message_class, bytes((fill,)) * message_class.unpacker.size)
    (frame,) = parse(wire)
    theirs = pymavlink().decode(bytearray(wire))
    assert_same_message(frame.message, theirs)
    assert encode(frame.message, 3, 2, 1) == theirs.pack(pymavlink(3, 2, 1))


GOLDEN = [
    (mavlink.MAVLink_heartbeat_message(2, 12, 209, 0x60000, 4, 3), "fd09000005010100000000000600020cd10403b6e2"),
    (
        mavlink.MAVLink_param_request_read_message(1, 0, b"MPC_Z_P", -1),
        "fd0b0000050101140000ffff01004d50435f5a5f5024c9",
    ),
    (mavlink.MAVLink_statustext_message(6, b"armed"), "fd060000050101fd00000661726d6564bc43"),
    (mavlink.MAVLink_ping_message(0, 0, 0, 0), "fd01000005010104000000deb8"),
]


@pytest.mark.parametrize(("message", "hexadecimal"), GOLDEN, ids=[message.msgname for message, _ in GOLDEN])
def test_golden_frames(message: object, hexadecimal: str) -> None:
    wire = encode(message, 5, 1, 1)
    assert wire.hex() == hexadecimal
    assert wire == message.pack(pymavlink(5, 1, 1))  # type: ignore[attr-defined]


def test_a_decoded_message_is_pymavlinks_own() -> None:
    message = parse(encode(mavlink.MAVLink_param_value_message(b"MPC_Z_P", 1.5, 9, 3, 1), 8, 42, 7))[0].message
    assert isinstance(message, mavlink.MAVLink_param_value_message)
    assert message.get_type() == "PARAM_VALUE"
    assert message.get_msgId() == 22
    assert (message.get_srcSystem(), message.get_srcComponent(), message.get_seq()) == (42, 7, 8)
    assert message.to_dict() == {
        "mavpackettype": "PARAM_VALUE",
        "param_id": "MPC_Z_P",
        "param_value": 1.5,
        "param_type": 9,
        "param_count": 3,
        "param_index": 1,
    }


def test_a_message_from_the_wire_can_be_sent_on() -> None:
    wire = encode(mavlink.MAVLink_statustext_message(6, "é".encode()), 1, 1, 1)
    assert encode(parse(wire)[0].message, 1, 1, 1) == wire


def test_packer_takes_text_as_str_or_bytes_and_fields_by_keyword() -> None:
    pack = packer(mavlink.MAVLink_statustext_message)
    assert pack(0, 1, 1, 6, "ready") == pack(0, 1, 1, 6, b"ready") == pack(0, 1, 1, text="ready", severity=6)


def test_packer_leaves_extension_fields_at_zero() -> None:
    pack = packer(mavlink.MAVLink_command_ack_message)
    assert pack(0, 1, 1, 400, 0) == pack(0, 1, 1, 400, 0, 0, 0, 0, 0)


def test_packer_takes_byte_arrays_as_bytes_or_integers() -> None:
    pack = packer(mavlink.MAVLink_file_transfer_protocol_message)
    payload = bytes(range(251))
    assert pack(0, 1, 1, 0, 1, 1, payload) == pack(0, 1, 1, 0, 1, 1, list(payload))


def test_packer_takes_a_long_array_as_the_bytes_of_the_wire() -> None:
    pack = packer(mavlink.MAVLink_odometry_message)
    before = (123, 1, 12, 1.0, 2.0, 3.0, (1.0, 0.0, 0.0, 0.0), *(0.5,) * 6)
    pose, velocity = [0.25 * k for k in range(21)], [math.nan] * 21
    octets, others = struct.pack("<21f", *pose), struct.pack("<21f", *velocity)
    assert pack(7, 1, 1, *before, octets, others, 1, 2, 90) == pack(7, 1, 1, *before, pose, velocity, 1, 2, 90)
    for wrong in (octets[:-1], octets + b"\0", b""):
        with pytest.raises(EncodeError, match="pose_covariance needs exactly 84 bytes"):
            pack(7, 1, 1, *before, wrong, others, 1, 2, 90)


UNFIT = [
    (mavlink.MAVLink_heartbeat_message, (256, 0, 0, 0, 0, 0), "HEARTBEAT"),
    (mavlink.MAVLink_heartbeat_message, (2, 0, 0, -1, 0, 0), "HEARTBEAT"),
    (mavlink.MAVLink_heartbeat_message, (2.0, 0, 0, 0, 0, 0), "HEARTBEAT"),
    (mavlink.MAVLink_attitude_message, (0, 1e39, 0, 0, 0, 0, 0), "ATTITUDE"),
    (mavlink.MAVLink_attitude_message, (0, None, 0, 0, 0, 0, 0), "ATTITUDE"),
    (mavlink.MAVLink_set_attitude_target_message, (0, 1, 1, 0, (1, 0, 0), 0, 0, 0, 0), "SET_ATTITUDE_TARGET"),
    (mavlink.MAVLink_statustext_message, (6, "x" * 51), "text has 51 bytes, the field holds 50"),
    (mavlink.MAVLink_file_transfer_protocol_message, (0, 1, 1, bytes(250)), "payload needs exactly 251 bytes"),
    (mavlink.MAVLink_file_transfer_protocol_message, (0, 1, 1, [256] * 251), "FILE_TRANSFER_PROTOCOL"),
    (mavlink.MAVLink_file_transfer_protocol_message, (0, 1, 1, 251), "FILE_TRANSFER_PROTOCOL"),
]


@pytest.mark.parametrize(("message_class", "fields", "text"), UNFIT)
def test_what_does_not_fit_is_refused_with_the_messages_name(
    message_class: MessageClass, fields: tuple[object, ...], text: str
) -> None:
    with pytest.raises(EncodeError, match=text):
        packer(message_class)(0, 1, 1, *fields)


def test_one_array_too_long_beside_one_too_short_is_refused() -> None:
    zeros = (0.0,) * 21
    fields = [0, 1, 1, 0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0), *(0.0,) * 6, zeros[:20], (*zeros, 0.0), 0, 0, 0]
    with pytest.raises(EncodeError, match="ODOMETRY"):
        packer(mavlink.MAVLink_odometry_message)(0, 1, 1, *fields)


def test_nan_and_infinity_go_through() -> None:
    wire = packer(mavlink.MAVLink_attitude_message)(0, 1, 1, 0, math.nan, math.inf, -math.inf, -0.0, 0.0, 1.0)
    message = parse(wire)[0].message
    assert math.isnan(message.roll)
    assert (message.pitch, message.yaw) == (math.inf, -math.inf)
    assert math.copysign(1.0, message.rollspeed) == -1.0
