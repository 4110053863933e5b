"""MAVLink 2 frames to messages and back, fast, from nothing but the generated classes of the dialect.

For each message class one packing and one decoding function is generated on first use from the class's own metadata
(`ordered_fieldnames`, `native_format`, `lengths`, `array_lengths`, `crc_extra`, `id`), so there is no protocol table to
keep in step. Frames written are byte for byte those of pymavlink; decoded messages are instances of pymavlink's classes
with the values its own decoder gives.

Input is one datagram at a time and no state outlives it: what a sender leaves unfinished cannot eat what another sends.
Peers cannot make `parse` raise; everything it refuses is counted in `Counters`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import astuple, dataclass
from operator import add
from typing import Any, NamedTuple, TypeAlias

from fastcrc import crc16

from mavsitl.dialect import mavlink

__all__ = [
    "MAX_DATAGRAM_BYTES",
    "MAX_REJECTED",
    "SIGNATURE_BYTES",
    "Counters",
    "EncodeError",
    "Frame",
    "Message",
    "MessageClass",
    "Packer",
    "Parsed",
    "encode",
    "packer",
    "parse",
    "renumber",
]

Message: TypeAlias = Any
"""An instance of one of pymavlink's generated message classes. They carry no usable static types, hence `Any`."""

MessageClass: TypeAlias = Any
"""One of pymavlink's generated message classes, e.g. ``mavlink.MAVLink_heartbeat_message``."""

Packer: TypeAlias = Callable[..., bytes]
"""``packer(sequence, system_id, component_id, *fields) -> bytes``; see `packer`."""

MAX_DATAGRAM_BYTES = 2048
"""Longer datagrams are dropped unread: seven of the longest frames fit, and no client sends more at once."""

MAX_REJECTED = 128
"""Refused candidates after which the rest of a datagram is dropped, which bounds the cost of junk."""

SIGNATURE_BYTES = 13

_MAGIC_V1 = 0xFE
_MAGIC_V2 = 0xFD
_SIGNED = 0x01
_HEADER_V1_BYTES = 6
_HEADER_V2_BYTES = 10
_CRC_BYTES = 2

_crc = crc16.mcrf4xx
# The checksum leaves the magic byte out. Begun in the one state that the magic byte turns into the real initial state,
# it can run over the frame from its first byte, which saves a copy.
_CRC_BEFORE_V2 = next(state for state in range(0x10000) if _crc(bytes((_MAGIC_V2,)), state) == 0xFFFF)
_CRC_BEFORE_V1 = next(state for state in range(0x10000) if _crc(bytes((_MAGIC_V1,)), state) == 0xFFFF)

_read_header_v1 = struct.Struct("<xBBBBB").unpack_from
_read_header_v2 = struct.Struct("<xBBBBBB3s").unpack_from
_write_header_v2 = struct.Struct("<BBxxBBB3s").pack
_write_crc = struct.Struct("<H").pack
_read_crc = struct.Struct("<H").unpack_from


class EncodeError(ValueError):
    """A message of ours does not fit its wire format: a field's range, type or length is wrong."""


class Frame(NamedTuple):
    """One good frame of a datagram.

    `signed` says that the frame carries a signature, not that anybody checked it. ``message.get_msgbuf()`` is the whole
    frame as it came, with its signature.
    """

    message: Message
    system_id: int
    component_id: int
    sequence: int
    signed: bool


Parsed: TypeAlias = list[Frame]
"""The good frames of one datagram, in order."""


@dataclass(slots=True)
class Counters:
    """What became of the input. Every magic byte looked at is exactly one of the first five."""

    frames: int = 0
    """good frames"""
    bad_crc: int = 0
    """a known message with a wrong checksum"""
    bad_length: int = 0
    """the datagram ends before the frame does"""
    unknown_id: int = 0
    """no such message in the dialect; its checksum cannot be checked"""
    incompatible: int = 0
    """an incompatibility flag other than "signed" is set"""
    oversize: int = 0
    """datagrams dropped whole, longer than the limit"""
    abandoned: int = 0
    """datagrams whose rest was dropped after `MAX_REJECTED` refusals"""
    skipped_bytes: int = 0
    """bytes that belong to no good frame"""
    unsupported: int = 0
    """good frames that no service handles; counted by whoever dispatches them, not here"""
    errors: int = 0
    """good frames whose handler failed, which is a bug of ours; counted as `unsupported` is"""
    over_budget: int = 0
    """datagrams dropped unread because their source had used up its input budget, and commands not done because their
    sender had; counted by whoever reads them"""
    crowded: int = 0
    """the same, for the budget of all sources together that are no peers"""

    def __add__(self, other: Counters) -> Counters:
        return Counters(*map(add, astuple(self), astuple(other)))

    @property
    def rejected(self) -> int:
        """Magic bytes that turned out not to begin a good frame."""
        return self.bad_crc + self.bad_length + self.unknown_id + self.incompatible


# --------------------------------------------------------------------------------------------------- field layout


class _Field(NamedTuple):
    """One field in wire order. `size` is the number of elements, or of characters where `text`."""

    name: str
    code: str
    size: int
    text: bool
    octets: bool


def _fields(message_class: MessageClass) -> list[_Field]:
    """The fields of a class in wire order, from its metadata."""
    fields = []
    for name, code, length, array_length in zip(
        message_class.ordered_fieldnames,
        message_class.native_format.decode()[1:],
        message_class.lengths,
        message_class.array_lengths,
        strict=True,
    ):
        text = code == "c"
        octets = code == "B" and length > 1
        fields.append(_Field(name, code, array_length if text else length, text, octets))
    return fields


def _layout(fields: list[_Field]) -> struct.Struct:
    """The payload's layout, with byte arrays as one run of bytes: 251 separate integers are slow."""
    parts = ["<"]
    for field in fields:
        if field.text or field.octets:
            parts.append(f"{field.size}s")
        else:
            parts.append(field.code if field.size == 1 else f"{field.size}{field.code}")
    return struct.Struct("".join(parts))


def _define(name: str, source: str, names: dict[str, Any]) -> Any:
    exec(compile(source, f"<mavsitl.codec {name}>", "exec"), names)
    return names[name]


# -------------------------------------------------------------------------------------------------------- encoding


def _as_text(field: str, count: int, value: str | bytes) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    if len(data) > count:
        raise ValueError(f"{field} has {len(data)} bytes, the field holds {count}")
    return data


def _as_octets(field: str, count: int, value: Any) -> bytes:
    data = bytes(value) if len(value) == count else b""
    if len(data) != count:
        raise ValueError(f"{field} needs exactly {count} bytes")
    return data


def _build_packer(message_class: MessageClass) -> Packer:
    fields = _fields(message_class)
    names: dict[str, Any] = {
        "_body": _layout(fields).pack,
        "_head": _write_header_v2,
        "_tail": _write_crc,
        "_crc": _crc,
        "_start": _CRC_BEFORE_V2,
        "_extra": bytes((message_class.crc_extra,)),
        "_id": message_class.id.to_bytes(3, "little"),
        "_len": len,
        "_as_text": _as_text,
        "_as_octets": _as_octets,
        "_errors": (struct.error, TypeError, ValueError, OverflowError),
        "_EncodeError": EncodeError,
    }
    prepare: list[str] = []
    values: list[str] = []
    for field in fields:
        if field.text or field.octets:
            convert = "_as_text" if field.text else "_as_octets"
            values.append(f"{convert}({field.name!r}, {field.size}, {field.name})")
        elif field.size > 1:
            elements = [f"_{field.name}_{index}" for index in range(field.size)]
            # Unpacking checks the length of each array: struct alone would take one too long beside one too short.
            prepare.append(f"        {', '.join(elements)} = {field.name}\n")
            values.extend(elements)
        else:
            values.append(field.name)
    name = f"pack_{message_class.msgname.lower()}"
    source = (
        f"def {name}(_sequence, _system_id, _component_id, /, {', '.join(message_class.fieldnames)}):\n"
        "    try:\n"
        f"{''.join(prepare)}"
        f"        body = _body({', '.join(values)}).rstrip(b'\\0') or b'\\0'\n"
        "        frame = _head(253, _len(body), _sequence, _system_id, _component_id, _id) + body\n"
        "    except _errors as error:\n"
        f"        raise _EncodeError(f'{message_class.msgname}: {{error}}') from error\n"
        "    return frame + _tail(_crc(frame + _extra, _start))\n"
    )
    function = _define(name, source, names)
    function.__defaults__ = message_class.__init__.__defaults__
    function.__doc__ = f"A {message_class.msgname} frame from its fields: {', '.join(message_class.fieldnames)}."
    return function  # type: ignore[no-any-return]


def _build_encoder(message_class: MessageClass) -> Packer:
    text = {field.name for field in _fields(message_class) if field.text}
    # The class keeps the bytes of a text field beside its string; pymavlink packs the bytes.
    values = [f"message._{name}_raw" if name in text else f"message.{name}" for name in message_class.fieldnames]
    name = f"encode_{message_class.msgname.lower()}"
    source = (
        f"def {name}(message, sequence, system_id, component_id):\n"
        f"    return _pack(sequence, system_id, component_id, {', '.join(values)})\n"
    )
    return _define(name, source, {"_pack": packer(message_class)})  # type: ignore[no-any-return]


_packers: dict[MessageClass, Packer] = {}
_encoders: dict[MessageClass, Packer] = {}


def packer(message_class: MessageClass) -> Packer:
    """The function that writes frames of one message class, without a message object.

    It is called as ``pack(sequence, system_id, component_id, *fields)`` and returns one unsigned MAVLink 2 frame.
    Fields come in the order of ``message_class.fieldnames`` (or by keyword), units and frames as the message's MAVLink
    definition says; arrays are sequences of exactly the wire's length, text is `str` or `bytes` that fits.
    Extension fields may be left out. It raises `EncodeError` for values that do not fit.

    Keep the function: looking it up on every frame would be slower than calling it.
    """
    function = _packers.get(message_class)
    if function is None:
        function = _packers[message_class] = _build_packer(message_class)
    return function


def encode(message: Message, sequence: int, system_id: int, component_id: int) -> bytes:
    """One unsigned MAVLink 2 frame of a message object, byte for byte as pymavlink packs it.

    Raises:
        EncodeError: a field does not fit. Text longer than its field is refused, where pymavlink cuts it.
    """
    message_class = message.__class__
    function = _encoders.get(message_class)
    if function is None:
        function = _encoders[message_class] = _build_encoder(message_class)
    return function(message, sequence, system_id, component_id)


def renumber(frame: bytes, sequence: int) -> bytes:
    """The same unsigned MAVLink 2 frame of a known message with another sequence number."""
    if frame[4] == sequence:
        return frame
    body = frame[:4] + bytes((sequence,)) + frame[5:-_CRC_BYTES]
    extra = mavlink.mavlink_map[int.from_bytes(frame[7:10], "little")].crc_extra
    return body + _write_crc(_crc(body + bytes((extra,)), _CRC_BEFORE_V2))


# -------------------------------------------------------------------------------------------------------- decoding

_Decoder: TypeAlias = Callable[[bytes, bytes, int, int, int, int, int, int, int], Message]


def _as_string(value: bytes) -> str:
    """The string pymavlink makes of a text field."""
    return value.split(b"\0", 1)[0].decode("ascii", errors="replace")


def _build_decoder(message_class: MessageClass) -> _Decoder:
    fields = _fields(message_class)
    layout = _layout(fields)
    targets: list[str] = []
    values: dict[str, str] = {}
    for index, field in enumerate(fields):
        local = f"v{index}"
        elements = [local]
        if field.text:
            values[field.name] = f"_as_string({local})"
        elif field.octets:
            values[field.name] = f"_list({local})"
        elif field.size > 1:
            elements = [f"{local}_{element}" for element in range(field.size)]
            values[field.name] = f"[{', '.join(elements)}]"
        else:
            values[field.name] = local
        targets.extend(elements)
    locals_of_text = {field.name: f"v{index}" for index, field in enumerate(fields) if field.text}
    assignments = []
    for name in message_class.fieldnames:
        if name in locals_of_text:
            assignments.append(f"    message._{name}_raw = {locals_of_text[name]}.rstrip(b'\\0')\n")
        assignments.append(f"    message.{name} = {values[name]}\n")
    names: dict[str, Any] = {
        "_unpack": layout.unpack,
        "_new": object.__new__,
        "_class": message_class,
        "_Header": mavlink.MAVLink_header,
        "_fieldnames": message_class.fieldnames,
        "_list": list,
        "_as_string": _as_string,
    }
    name = f"decode_{message_class.msgname.lower()}"
    # The attributes are those that the class's own initialiser and pymavlink's decoder set, in the order of the former:
    # instances of a class that gain their attributes in one order share their keys, and that makes storing them cheap.
    source = (
        f"def {name}(payload, raw, crc, incompat, compat, length, sequence, system_id, component_id):\n"
        f"    {', '.join(targets)}, = _unpack(\n"
        f"        payload if length == {layout.size} else payload[:{layout.size}].ljust({layout.size}, b'\\0'))\n"
        "    header = _new(_Header)\n"
        "    header.mlen = length\n"
        "    header.seq = sequence\n"
        "    header.srcSystem = system_id\n"
        "    header.srcComponent = component_id\n"
        f"    header.msgId = {message_class.id}\n"
        "    header.incompat_flags = incompat\n"
        "    header.compat_flags = compat\n"
        "    message = _new(_class)\n"
        "    message._header = header\n"
        "    message._payload = payload\n"
        "    message._msgbuf = raw\n"
        "    message._crc = crc\n"
        "    message._fieldnames = _fieldnames\n"
        f"    message._type = {message_class.msgname!r}\n"
        "    message._signed = False\n"
        "    message._link_id = None\n"
        "    message._instances = None\n"
        f"    message._instance_field = {message_class.instance_field!r}\n"
        f"    message._instance_offset = {message_class.instance_offset!r}\n"
        f"{''.join(assignments)}"
        "    return message\n"
    )
    return _define(name, source, names)  # type: ignore[no-any-return]


# By the three id bytes as they stand in the header. Filled on first use with known ids alone, so peers cannot grow it.
_decoders: dict[bytes, tuple[_Decoder, bytes]] = {}


def _find_decoder(id_bytes: bytes) -> tuple[_Decoder, bytes] | None:
    message_class = mavlink.mavlink_map.get(int.from_bytes(id_bytes, "little"))
    if message_class is None:
        return None
    entry = _decoders[id_bytes] = (_build_decoder(message_class), bytes((message_class.crc_extra,)))
    return entry


_new_tuple = tuple.__new__


def _next_magic(datagram: bytes, begin: int) -> int:
    """Index of the next byte that may begin a frame, or the length of the datagram."""
    v2 = datagram.find(_MAGIC_V2, begin)
    v1 = datagram.find(_MAGIC_V1, begin, v2 if v2 >= 0 else len(datagram))
    if v1 >= 0:
        return v1
    return v2 if v2 >= 0 else len(datagram)


def parse(datagram: bytes, counters: Counters | None = None, max_bytes: int = MAX_DATAGRAM_BYTES) -> Parsed:
    """The good frames of one datagram, in order; never raises, whatever the bytes are.

    Takes MAVLink 2 (signed or not) and MAVLink 1. A payload shorter than its message is filled with zeros, a longer one
    (extension fields of a newer definition) is cut. A signature is skipped over, not checked. After a refused candidate
    the search goes on one byte behind its magic byte, so a damaged frame hides nothing behind it; `MAX_REJECTED`
    refusals end it, so that work stays bounded.

    Args:
        datagram: what one receive call returned.
        counters: where to count; nothing is counted when absent.
        max_bytes: length of the longest datagram that is read.
    """
    if counters is None:
        counters = Counters()
    end_of_data = len(datagram)
    if end_of_data > max_bytes:
        counters.oversize += 1
        counters.skipped_bytes += end_of_data
        return []
    frames: Parsed = []
    taken = 0
    rejected = 0
    begin = 0
    while begin < end_of_data:
        magic = datagram[begin]
        if magic == _MAGIC_V2:
            if begin + _HEADER_V2_BYTES + _CRC_BYTES > end_of_data:
                counters.bad_length += 1
            else:
                length, incompat, compat, sequence, system_id, component_id, id_bytes = _read_header_v2(datagram, begin)
                body = begin + _HEADER_V2_BYTES
                end = body + length
                stop = end + _CRC_BYTES
                if incompat:
                    stop += SIGNATURE_BYTES
                if incompat & ~_SIGNED:
                    counters.incompatible += 1
                elif stop > end_of_data:
                    counters.bad_length += 1
                else:
                    entry = _decoders.get(id_bytes) or _find_decoder(id_bytes)
                    if entry is None:
                        counters.unknown_id += 1
                    else:
                        decode, extra = entry
                        crc = _crc(extra, _crc(datagram[begin:end], _CRC_BEFORE_V2))
                        if datagram[end] | datagram[end + 1] << 8 == crc:
                            message = decode(
                                datagram[body:end],
                                datagram[begin:stop],
                                crc,
                                incompat,
                                compat,
                                length,
                                sequence,
                                system_id,
                                component_id,
                            )
                            frames.append(
                                _new_tuple(Frame, (message, system_id, component_id, sequence, incompat != 0))
                            )
                            taken += stop - begin
                            begin = stop
                            continue
                        counters.bad_crc += 1
        elif magic == _MAGIC_V1:
            frame = _parse_v1(datagram, begin, counters)
            if frame is not None:
                frames.append(frame)
                length = len(frame.message.get_msgbuf())
                taken += length
                begin += length
                continue
        else:
            begin = _next_magic(datagram, begin)
            continue
        rejected += 1
        if rejected >= MAX_REJECTED:
            counters.abandoned += 1
            break
        begin = _next_magic(datagram, begin + 1)
    counters.frames += len(frames)
    counters.skipped_bytes += end_of_data - taken
    return frames


def _parse_v1(datagram: bytes, begin: int, counters: Counters) -> Frame | None:
    """The MAVLink 1 frame that begins at `begin`, or None, counted."""
    if begin + _HEADER_V1_BYTES + _CRC_BYTES > len(datagram):
        counters.bad_length += 1
        return None
    length, sequence, system_id, component_id, message_id = _read_header_v1(datagram, begin)
    body = begin + _HEADER_V1_BYTES
    end = body + length
    if end + _CRC_BYTES > len(datagram):
        counters.bad_length += 1
        return None
    id_bytes = bytes((message_id, 0, 0))
    entry = _decoders.get(id_bytes) or _find_decoder(id_bytes)
    if entry is None:
        counters.unknown_id += 1
        return None
    decode, extra = entry
    crc = _crc(extra, _crc(datagram[begin:end], _CRC_BEFORE_V1))
    if _read_crc(datagram, end)[0] != crc:
        counters.bad_crc += 1
        return None
    raw = datagram[begin : end + _CRC_BYTES]
    message = decode(datagram[body:end], raw, crc, 0, 0, length, sequence, system_id, component_id)
    return Frame(message, system_id, component_id, sequence, False)
