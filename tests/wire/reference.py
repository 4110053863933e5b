"""pymavlink as the reference, and frames built by hand so that its encoder is not needed to test our decoder."""

from __future__ import annotations

import struct
from typing import Any

from mavsitl.codec import Frame, Message, MessageClass
from mavsitl.dialect import mavlink

CLASSES: list[MessageClass] = [mavlink.mavlink_map[message_id] for message_id in sorted(mavlink.mavlink_map)]
NAMES: list[str] = [message_class.msgname for message_class in CLASSES]


def checksum(octets: bytes, crc_extra: int) -> bytes:
    """X.25 checksum of a frame's bytes behind the magic byte, bit by bit as its definition says."""
    crc = 0xFFFF
    for octet in (*octets, crc_extra):
        crc ^= octet
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    return struct.pack("<H", crc)


def frame_v2(
    message_class: MessageClass,
    payload: bytes,
    *,
    sequence: int = 0,
    system_id: int = 1,
    component_id: int = 1,
    incompat: int = 0,
    signature: bytes = b"",
) -> bytes:
    """A MAVLink 2 frame with a payload as it stands."""
    message_id: bytes = message_class.id.to_bytes(3, "little")
    head = bytes((len(payload), incompat, 0, sequence, system_id, component_id)) + message_id
    return b"\xfd" + head + payload + checksum(head + payload, message_class.crc_extra) + signature


def frame_v1(message_class: MessageClass, payload: bytes, sequence: int = 0) -> bytes:
    """A MAVLink 1 frame with a payload as it stands."""
    head = bytes((len(payload), sequence, 1, 1, message_class.id))
    return b"\xfe" + head + payload + checksum(head + payload, message_class.crc_extra)


def address_of(frame: Frame) -> tuple[int, int, int, bool]:
    """System and component id, sequence number, and whether it is signed."""
    return frame.system_id, frame.component_id, frame.sequence, frame.signed


def pymavlink(sequence: int = 0, system_id: int = 1, component_id: int = 1) -> Any:
    """pymavlink's codec, about to send with this sequence number and address."""
    codec = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
    codec.seq = sequence
    return codec


def assert_same_message(ours: Message, theirs: Message) -> None:
    """Every attribute that pymavlink's decoder sets is set alike: type, value, sign of zero, NaN."""
    assert isinstance(ours, type(theirs))
    their_attributes = dict(vars(theirs))
    our_attributes = {name: getattr(ours, name) for name in their_attributes}
    assert set(vars(ours)) <= set(their_attributes)
    assert vars(our_attributes.pop("_header")) == vars(their_attributes.pop("_header"))
    assert our_attributes.pop("_msgbuf") == bytes(their_attributes.pop("_msgbuf"))
    # Of a MAVLink 2 frame pymavlink keeps four bytes of the header as if they were payload; ours is the payload.
    payload = our_attributes.pop("_payload")
    assert bytes(their_attributes.pop("_payload")).endswith(payload)
    assert len(payload) == ours.get_header().mlen
    assert repr(our_attributes) == repr(their_attributes)
    assert repr(ours.to_dict()) == repr(theirs.to_dict())
    assert str(ours) == str(theirs)
