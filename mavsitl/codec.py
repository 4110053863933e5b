"""MAVLink 2 frames to messages and back, fast, from nothing but the generated classes of the dialect.

For each message class the functions that pack, read and decode it are generated on first use from the class's own
metadata (`ordered_fieldnames`, `native_format`, `lengths`, `array_lengths`, `crc_extra`, `id`), so there is no protocol
table to keep in step. Frames written are byte for byte those of pymavlink; decoded messages are instances of
pymavlink's classes with the values its own decoder gives.

Nothing is decoded that nobody reads: `parse` checks a datagram and gives `Frame`s, `Frame.message` is made when it is
asked for, and a function made by `reader` takes a few fields out of a frame without a message.

Input is one datagram at a time and no state outlives it: what a sender leaves unfinished cannot eat what another sends.
Peers cannot make `parse` raise, nor `Frame.message` or a reader; everything refused is counted in `Counters`.
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
    "Reader",
    "encode",
    "packer",
    "parse",
    "reader",
    "renumber",
    "target_system_offset",
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
_FRAME_BYTES = _HEADER_V2_BYTES + _CRC_BYTES  # what an unsigned MAVLink 2 frame has beside its payload
_LONG_ARRAY = 8
"""Arrays with more elements are packed and unpacked as one block; element by element is faster below."""

_crc = crc16.mcrf4xx
# One more byte, a message's CRC_EXTRA, without a call: ``crc >> 8 ^ _CRC_TABLE[(crc ^ extra) & 0xFF]``.
_CRC_TABLE = tuple(_crc(bytes((octet,)), 0) for octet in range(0x100))
_CRC_INDEX = {value >> 8: octet for octet, value in enumerate(_CRC_TABLE)}


def _state_before(octet: int, crc: int) -> int:
    """The one state that this byte turns into `crc`: the high bytes of the table are all different."""
    index = _CRC_INDEX[crc >> 8]
    return ((crc ^ _CRC_TABLE[index]) & 0xFF) << 8 | (index ^ octet)


def _residue(checksum: int, extra: int) -> int:
    """The state in which the CRC over a good frame ends that goes on over the checksum itself.

    CRC_EXTRA is taken in before the checksum and stands nowhere in the frame, so the residue is not the usual zero. The
    checksum and CRC_EXTRA alone decide it, and a frame with another checksum than it should have leaves another.
    """
    return _crc(checksum.to_bytes(2, "little"), _state_before(extra, checksum))


# The checksum leaves the magic byte out. Begun in the one state that the magic byte turns into the real initial state,
# it can run over the frame from its first byte, which saves a copy.
_CRC_BEFORE_V2 = _state_before(_MAGIC_V2, 0xFFFF)
_CRC_BEFORE_V1 = _state_before(_MAGIC_V1, 0xFFFF)
# A CRC is linear, so a residue is the exclusive or of what each byte of the checksum and CRC_EXTRA contribute. With it
# a frame is checked by one call, and no copy of it without the checksum is made.
_RESIDUE_LOW = tuple(_residue(low, 0) ^ _residue(0, 0) for low in range(0x100))
_RESIDUE_HIGH = tuple(_residue(high << 8, 0) ^ _residue(0, 0) for high in range(0x100))

_STARTS = tuple(bytes((_MAGIC_V2, length)) for length in range(0x100))
"""The first two bytes of a frame, by the length of its payload."""

_HEADER_LAYOUT = "<2sxxBBB3s"
_read_header = struct.Struct("<BBBxBBB3s").unpack_from
"""Magic, length of the payload, incompatibility flags, sequence, system, component, id."""
_write_crc = struct.Struct("<H").pack
_new = object.__new__


class EncodeError(ValueError):
    """A message of ours does not fit its wire format: a field's range, type or length is wrong."""


class Frame:
    """One good frame of a datagram, as `parse` found it.

    Attributes:
        raw: the whole frame as it came, with its signature.
        message_id: of a message of the dialect.
        system_id, component_id: the sender's.
        sequence: 0 to 255.
    """

    __slots__ = ("_kind", "_message", "component_id", "message_id", "raw", "sequence", "system_id")

    _kind: _Kind
    _message: Message
    raw: bytes
    message_id: int
    system_id: int
    component_id: int
    sequence: int

    @property
    def message(self) -> Message:
        """The message, decoded when first asked for: an instance of pymavlink's class, the same one every time."""
        message = self._message
        if message is None:
            message = self._message = self._kind.decode(self.raw)
        return message

    @property
    def payload(self) -> bytes:
        """The payload as it came, trailing zeros cut off or not."""
        begin = _HEADER_V2_BYTES if self.raw[0] == _MAGIC_V2 else _HEADER_V1_BYTES
        return self.raw[begin : begin + self.raw[1]]

    @property
    def signed(self) -> bool:
        """Whether the frame carries a signature, not whether anybody checked it."""
        return self.raw[0] == _MAGIC_V2 and self.raw[2] != 0

    @property
    def target(self) -> tuple[int, int]:
        """Target system and component; 0 is everybody, as it is for a message without these fields."""
        read = self._kind.target
        return read(self)

    def __repr__(self) -> str:
        return f"Frame({self._kind.message_class.msgname}, {self.raw.hex()})"


Parsed: TypeAlias = list[Frame]
"""The good frames of one datagram, in order."""

Reader: TypeAlias = Callable[[Frame], tuple[Any, ...]]
"""``read(frame) -> (field, ...)``; see `reader`."""


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
    offset: int
    """in the payload, bytes"""

    @property
    def long(self) -> bool:
        """Whether it is handled as one block of bytes."""
        return self.octets or self.size > _LONG_ARRAY

    @property
    def bytes(self) -> int:
        return self.size * struct.calcsize(f"<{self.code}")

    @property
    def layout(self) -> str:
        """Its elements one by one, but text as one."""
        if self.text:
            return f"{self.size}s"
        return self.code if self.size == 1 else f"{self.size}{self.code}"

    @property
    def block_layout(self) -> str:
        """The same with what is `long` as one run of bytes: 251 separate integers are slow."""
        return f"{self.bytes}s" if self.long else self.layout


def _fields(message_class: MessageClass) -> list[_Field]:
    """The fields of a class in wire order, from its metadata."""
    fields = []
    offset = 0
    for name, code, length, array_length in zip(
        message_class.ordered_fieldnames,
        message_class.native_format.decode()[1:],
        message_class.lengths,
        message_class.array_lengths,
        strict=True,
    ):
        text = code == "c"
        octets = code == "B" and length > 1
        field = _Field(name, code, array_length if text else length, text, octets, offset)
        fields.append(field)
        offset += field.bytes
    return fields


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


def _build_writer(message_class: MessageClass, name: str, parameters: str, value_of: Callable[[_Field], str]) -> Packer:
    """A function of `parameters` that writes a frame; `value_of` gives the expression of a field's value.

    The frame is packed at full length in one call. Where its last byte is zero, trailing zeros are cut off and the
    length is put right, which is MAVLink 2's truncation: of a payload of zeros one byte is left.
    """
    fields = _fields(message_class)
    names: dict[str, Any] = {
        "_whole": struct.Struct(_HEADER_LAYOUT + "".join(field.block_layout for field in fields)).pack,
        "_tail": _write_crc,
        "_crc": _crc,
        "_table": _CRC_TABLE,
        "_starts": _STARTS,
        "_start": _STARTS[sum(field.bytes for field in fields)],
        "_id": message_class.id.to_bytes(3, "little"),
        "_len": len,
        "_bytes": bytes,
        "_as_text": _as_text,
        "_as_octets": _as_octets,
        "_errors": (struct.error, TypeError, ValueError, OverflowError),
        "_EncodeError": EncodeError,
    }
    prepare: list[str] = []
    values: list[str] = []
    for field in fields:
        value, local = value_of(field), f"_{field.name}"
        if field.text or field.octets:
            fits = f"_len({local}) {'<=' if field.text else '=='} {field.size}"
            convert = "_as_text" if field.text else "_as_octets"
            prepare.append(
                f"        {local} = {value}\n"
                f"        if {local}.__class__ is not _bytes or not {fits}:\n"
                f"            {local} = {convert}({field.name!r}, {field.size}, {local})\n"
            )
            values.append(local)
        elif field.long:
            names[f"_pack{local}"] = struct.Struct(f"<{field.layout}").pack
            prepare.append(
                f"        {local} = {value}\n"
                f"        if {local}.__class__ is not _bytes:\n"
                f"            {local} = _pack{local}(*{local})\n"
                f"        elif _len({local}) != {field.bytes}:\n"
                f"            raise ValueError('{field.name} needs exactly {field.bytes} bytes')\n"
            )
            values.append(local)
        elif field.size > 1:
            elements = [f"{local}_{index}" for index in range(field.size)]
            # Unpacking checks the length of each array: struct alone would take one too long beside one too short.
            prepare.append(f"        {', '.join(elements)} = {value}\n")
            values.extend(elements)
        else:
            values.append(value)
    source = (
        f"def {name}({parameters}):\n"
        "    try:\n"
        f"{''.join(prepare)}"
        f"        _frame = _whole(_start, _sequence, _system_id, _component_id, _id, {', '.join(values)})\n"
        "    except _errors as error:\n"
        f"        raise _EncodeError(f'{message_class.msgname}: {{error}}') from error\n"
        "    if not _frame[-1]:\n"
        f"        _length = _len(_frame.rstrip(b'\\0')) - {_HEADER_V2_BYTES}\n"
        "        if _length < 1:\n"
        "            _length = 1\n"
        f"        _frame = _starts[_length] + _frame[2:_length + {_HEADER_V2_BYTES}]\n"
        f"    _state = _crc(_frame, {_CRC_BEFORE_V2})\n"
        f"    return _frame + _tail(_state >> 8 ^ _table[(_state ^ {message_class.crc_extra}) & 255])\n"
    )
    return _define(name, source, names)  # type: ignore[no-any-return]


def _build_packer(message_class: MessageClass) -> Packer:
    function = _build_writer(
        message_class,
        f"pack_{message_class.msgname.lower()}",
        f"_sequence, _system_id, _component_id, /, {', '.join(message_class.fieldnames)}",
        lambda field: field.name,
    )
    function.__defaults__ = message_class.__init__.__defaults__
    function.__doc__ = f"A {message_class.msgname} frame from its fields: {', '.join(message_class.fieldnames)}."
    return function


def _build_encoder(message_class: MessageClass) -> Packer:
    # The class keeps the bytes of a text field beside its string; pymavlink packs the bytes.
    return _build_writer(
        message_class,
        f"encode_{message_class.msgname.lower()}",
        "_message, _sequence, _system_id, _component_id",
        lambda field: f"_message._{field.name}_raw" if field.text else f"_message.{field.name}",
    )


_packers: dict[MessageClass, Packer] = {}
_encoders: dict[MessageClass, Packer] = {}


def packer(message_class: MessageClass) -> Packer:
    """The function that writes frames of one message class, without a message object.

    It is called as ``pack(sequence, system_id, component_id, *fields)`` and returns one unsigned MAVLink 2 frame.
    Fields come in the order of ``message_class.fieldnames`` (or by keyword), units and frames as the message's MAVLink
    definition says; arrays are sequences of exactly the wire's length, text is `str` or `bytes` that fits. An array of
    more than 8 elements may also be `bytes`, as on the wire: what seldom changes need not be packed every time.
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
    try:
        function = _encoders[message_class]
    except KeyError:
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


class _OnDemand:
    """An attribute of a received message that is made of ``_msgbuf`` when first read, and is an ordinary one then."""

    def __init__(self, make: Callable[[bytes], Any]) -> None:
        self._make = make

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, message: Message, owner: type) -> Any:
        if message is None:
            return self
        value = message.__dict__[self._name] = self._make(message._msgbuf)
        return value


def _header_of(raw: bytes) -> Any:
    if raw[0] == _MAGIC_V2:
        _, length, incompat, compat, sequence, system_id, component_id = raw[:7]
        message_id = int.from_bytes(raw[7:10], "little")
    else:
        _, length, sequence, system_id, component_id, message_id = raw[:_HEADER_V1_BYTES]
        incompat = compat = 0
    return mavlink.MAVLink_header(message_id, incompat, compat, length, sequence, system_id, component_id)


def _payload_of(raw: bytes) -> bytes:
    begin = _HEADER_V2_BYTES if raw[0] == _MAGIC_V2 else _HEADER_V1_BYTES
    return raw[begin : begin + raw[1]]


def _crc_of(raw: bytes) -> int:
    end = (_HEADER_V2_BYTES if raw[0] == _MAGIC_V2 else _HEADER_V1_BYTES) + raw[1]
    return raw[end] | raw[end + 1] << 8


def _received_again(message_class: MessageClass, attributes: dict[str, Any]) -> Message:
    """What a pickle or copy of a received message is made by."""
    message = _new(_received(message_class))
    message.__dict__.update(attributes)
    return message


_received_classes: dict[MessageClass, MessageClass] = {}


def _received(message_class: MessageClass) -> MessageClass:
    """The subclass of pymavlink's class whose instances come from the wire.

    What pymavlink's initialiser and decoder set alike in every message of a class stands in the class here, and what
    is rarely read is made on demand. The fields and ``_msgbuf`` alone are set in each message.
    """
    found = _received_classes.get(message_class)
    if found is None:
        found = _received_classes[message_class] = type(
            message_class.__name__,
            (message_class,),
            {
                "__module__": message_class.__module__,
                "__qualname__": message_class.__qualname__,
                "__doc__": message_class.__doc__,
                "__reduce__": lambda message: (_received_again, (message_class, dict(vars(message)))),
                "_header": _OnDemand(_header_of),
                "_payload": _OnDemand(_payload_of),
                "_crc": _OnDemand(_crc_of),
                "_fieldnames": message_class.fieldnames,
                "_type": message_class.msgname,
                "_signed": False,
                "_link_id": None,
                "_instances": None,
                "_instance_field": message_class.instance_field,
                "_instance_offset": message_class.instance_offset,
            },
        )
    return found


def _extended(raw: bytes, size: int) -> bytes:
    """A frame with a MAVLink 2 header's length before its payload, and zeros behind it up to `size` bytes in all."""
    if raw[0] == _MAGIC_V2:
        return raw[: _HEADER_V2_BYTES + raw[1]].ljust(size, b"\0")
    return (b"\0\0\0\0" + raw[: _HEADER_V1_BYTES + raw[1]]).ljust(size, b"\0")


def _as_string(value: bytes) -> str:
    """The string pymavlink makes of a text field."""
    return str(value.split(b"\0", 1)[0], "ascii", "replace")


def _unpacking(fields: list[_Field]) -> struct.Struct:
    """The layout of a whole MAVLink 2 frame with these fields of its payload, given in wire order."""
    parts = ["<"]
    position = -_HEADER_V2_BYTES
    for field in fields:
        if field.offset > position:
            parts.append(f"{field.offset - position}x")
        parts.append(f"{field.size}s" if field.octets else field.layout)
        position = field.offset + field.bytes
    return struct.Struct("".join(parts))


_SHORT = (
    "    if raw[1] < {size} or raw[0] != {magic}:\n"
    "        raw = _extended(raw, {total})\n"
)  # fmt: skip
"""Where the fields are not all there, at their places: a truncated payload, or MAVLink 1."""


def _begin_reading(fields: list[_Field]) -> tuple[str, dict[str, Any]]:
    layout = _unpacking(fields)
    size = layout.size - _HEADER_V2_BYTES
    names = {"_unpack": layout.unpack_from, "_extended": _extended, "_as_string": _as_string}
    return _SHORT.format(size=size, magic=_MAGIC_V2, total=layout.size), names


def _build_decoder(message_class: MessageClass) -> Callable[[bytes], Message]:
    fields = _fields(message_class)
    short, names = _begin_reading(fields)
    names |= {"_new": _new, "_class": _received(message_class), "_list": list}
    targets: list[str] = []
    rest: list[str] = []
    for index, field in enumerate(fields):
        local, attribute = f"v{index}", f"message.{field.name}"
        if field.text:
            targets.append(local)
            rest.append(f"    message._{field.name}_raw = {local} = {local}.rstrip(b'\\0')\n")
            easy = f"{local}.isascii() and 0 not in {local}"
            rest.append(f"    {attribute} = {local}.decode() if {easy} else _as_string({local})\n")
        elif field.octets:
            targets.append(local)
            rest.append(f"    {attribute} = _list({local})\n")
        elif field.size > 1:
            elements = [f"{local}_{element}" for element in range(field.size)]
            targets.extend(elements)
            rest.append(f"    {attribute} = [{', '.join(elements)}]\n")
        else:
            targets.append(attribute)
    name = f"decode_{message_class.msgname.lower()}"
    # Every instance gains its attributes in one order: such instances share their keys, which makes storing cheap.
    source = (
        f"def {name}(raw):\n"
        "    message = _new(_class)\n"
        "    message._msgbuf = raw\n"
        f"{short}"
        f"    {', '.join(targets)}, = _unpack(raw)\n"
        f"{''.join(rest)}"
        "    return message\n"
    )
    return _define(name, source, names)  # type: ignore[no-any-return]


def _build_reader(message_class: MessageClass, fieldnames: tuple[str, ...], flat: bool) -> Reader:
    fields = [field for field in _fields(message_class) if field.name in fieldnames]
    short, names = _begin_reading(fields)
    targets: list[str] = []
    values: dict[str, str] = {}
    for index, field in enumerate(fields):
        local = f"v{index}"
        elements = [local]
        values[field.name] = local
        if field.text:
            values[field.name] = f"_as_string({local})"
        elif field.size > 1 and not field.octets:
            elements = [f"{local}_{element}" for element in range(field.size)]
            values[field.name] = ", ".join(elements) if flat else f"({', '.join(elements)})"
        targets.extend(elements)
    found = [values[name] for name in fieldnames]
    name = f"read_{message_class.msgname.lower()}"
    source = f"def {name}(frame):\n    raw = frame.raw\n{short}"
    if ", ".join(found) == ", ".join(targets):
        source += "    return _unpack(raw)\n"
    else:
        source += f"    {', '.join(targets)}, = _unpack(raw)\n    return {', '.join(found)},\n"
    function = _define(name, source, names)
    function.__doc__ = f"({', '.join(fieldnames)}) of a {message_class.msgname} frame."
    return function  # type: ignore[no-any-return]


def _build_target(message_class: MessageClass) -> Callable[[Frame], tuple[int, int]]:
    """What reads target system and component of a frame; the one that a message has not is 0, everybody."""
    names = [name for name in ("target_system", "target_component") if name in message_class.fieldnames]
    if len(names) == 2:
        return reader(message_class, *names)
    if not names:
        return lambda frame: (0, 0)
    read = reader(message_class, *names)
    return lambda frame: (read(frame)[0], 0)


def reader(message_class: MessageClass, *fieldnames: str, flat: bool = False) -> Reader:
    """The function that reads some fields of frames of one message class, without a message object.

    It is called as ``read(frame)`` and returns a tuple with one element for each of `fieldnames`, in that order, of the
    value that ``frame.message`` has; units and frames as the message's MAVLink definition says. Text is `str`, an array
    is a tuple, an array of uint8_t is `bytes`. What a truncated payload leaves out is zero. With `flat` the elements of
    arrays stand one by one among the others; fields that are asked for in wire order are the fastest then.

    The frame has to be of this class (``frame.message_id == message_class.id``); that is not looked at again.
    Keep the function: it is generated by every call.

    Raises:
        ValueError: no field is asked for, one twice, or one that the message does not have.
    """
    unknown = [name for name in fieldnames if name not in message_class.fieldnames]
    if unknown:
        raise ValueError(
            f"{message_class.msgname} has no field {', '.join(unknown)}; it has: {', '.join(message_class.fieldnames)}"
        )
    if not fieldnames or len(set(fieldnames)) < len(fieldnames):
        raise ValueError(f"each field of {message_class.msgname} once, and at least one: got {', '.join(fieldnames)}")
    return _build_reader(message_class, fieldnames, flat)


class _Kind:
    """What has to be known of a message class to check and read its frames."""

    __slots__ = ("decode", "message_class", "message_id", "residue", "target", "target_system")

    def __init__(self, message_class: MessageClass) -> None:
        self.message_class = message_class
        self.message_id: int = message_class.id
        self.residue = _residue(0, message_class.crc_extra)
        self.target_system = next((f.offset for f in _fields(message_class) if f.name == "target_system"), None)
        # Both are generated when they are first asked for, which for most classes is never.
        self.decode: Callable[[bytes], Message] = self._first_message
        self.target: Callable[[Frame], tuple[int, int]] = self._first_target

    def _first_message(self, raw: bytes) -> Message:
        self.decode = _build_decoder(self.message_class)
        return self.decode(raw)

    def _first_target(self, frame: Frame) -> tuple[int, int]:
        self.target = _build_target(self.message_class)
        return self.target(frame)


# By the three id bytes as they stand in the header. Filled on first use with known ids alone, so peers cannot grow it.
_kinds: dict[bytes, _Kind] = {}


def _find_kind(id_bytes: bytes) -> _Kind | None:
    message_class = mavlink.mavlink_map.get(int.from_bytes(id_bytes, "little"))
    if message_class is None:
        return None
    kind = _kinds[id_bytes] = _Kind(message_class)
    return kind


def target_system_offset(id_bytes: bytes) -> int | None:
    """Of `target_system` in the payload of a message, by its three id bytes; None: it has none, or is not known."""
    kind = _kinds.get(id_bytes) or _find_kind(id_bytes)
    return None if kind is None else kind.target_system


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
    size = len(datagram)
    if size > max_bytes:
        counters.oversize += 1
        counters.skipped_bytes += size
        return []
    # Nearly every datagram is one good unsigned MAVLink 2 frame. All others, and what is wrong with them, are left to
    # the search, which would find the same.
    if size >= _FRAME_BYTES:
        magic, length, incompat, sequence, system_id, component_id, id_bytes = _read_header(datagram)
        kind = _kinds.get(id_bytes)
        if kind is not None and length + _FRAME_BYTES == size and magic == _MAGIC_V2 and not incompat:
            residue = _RESIDUE_LOW[datagram[-2]] ^ _RESIDUE_HIGH[datagram[-1]] ^ kind.residue
            if _crc(datagram, _CRC_BEFORE_V2) == residue:
                frame = Frame()
                frame._kind = kind
                frame._message = None
                frame.raw = datagram
                frame.message_id = kind.message_id
                frame.sequence = sequence
                frame.system_id = system_id
                frame.component_id = component_id
                counters.frames += 1
                return [frame]
    return _search(datagram, counters)


def _search(datagram: bytes, counters: Counters) -> Parsed:
    """The good frames among whatever else is there."""
    frames: Parsed = []
    end_of_data = len(datagram)
    taken = 0
    rejected = 0
    begin = 0
    while begin < end_of_data:
        magic = datagram[begin]
        if magic == _MAGIC_V2:
            frame = _frame_v2(datagram, begin, counters)
        elif magic == _MAGIC_V1:
            frame = _frame_v1(datagram, begin, counters)
        else:
            begin = _next_magic(datagram, begin)
            continue
        if frame is not None:
            frames.append(frame)
            length = len(frame.raw)
            taken += length
            begin += length
            continue
        rejected += 1
        if rejected >= MAX_REJECTED:
            counters.abandoned += 1
            break
        begin = _next_magic(datagram, begin + 1)
    counters.frames += len(frames)
    counters.skipped_bytes += end_of_data - taken
    return frames


def _frame_v2(datagram: bytes, begin: int, counters: Counters) -> Frame | None:
    """The MAVLink 2 frame that begins at `begin`, or None, counted."""
    if begin + _FRAME_BYTES > len(datagram):
        counters.bad_length += 1
        return None
    incompat = datagram[begin + 2]
    end = begin + _HEADER_V2_BYTES + datagram[begin + 1]
    stop = end + _CRC_BYTES + (SIGNATURE_BYTES if incompat else 0)
    if incompat & ~_SIGNED:
        counters.incompatible += 1
        return None
    if stop > len(datagram):
        counters.bad_length += 1
        return None
    sequence, system_id, component_id = datagram[begin + 4 : begin + 7]
    id_bytes = datagram[begin + 7 : begin + 10]
    return _checked(datagram, begin, end, stop, _CRC_BEFORE_V2, id_bytes, sequence, system_id, component_id, counters)


def _frame_v1(datagram: bytes, begin: int, counters: Counters) -> Frame | None:
    """The MAVLink 1 frame that begins at `begin`, or None, counted."""
    if begin + _HEADER_V1_BYTES + _CRC_BYTES > len(datagram):
        counters.bad_length += 1
        return None
    length, sequence, system_id, component_id, message_id = datagram[begin + 1 : begin + _HEADER_V1_BYTES]
    end = begin + _HEADER_V1_BYTES + length
    stop = end + _CRC_BYTES
    if stop > len(datagram):
        counters.bad_length += 1
        return None
    id_bytes = bytes((message_id, 0, 0))
    return _checked(datagram, begin, end, stop, _CRC_BEFORE_V1, id_bytes, sequence, system_id, component_id, counters)


def _checked(
    datagram: bytes,
    begin: int,
    end: int,
    stop: int,
    before: int,
    id_bytes: bytes,
    sequence: int,
    system_id: int,
    component_id: int,
    counters: Counters,
) -> Frame | None:
    """The frame from `begin` to `stop`, its checksum at `end` and begun in the state `before`; or None, counted."""
    kind = _kinds.get(id_bytes) or _find_kind(id_bytes)
    if kind is None:
        counters.unknown_id += 1
        return None
    residue = _RESIDUE_LOW[datagram[end]] ^ _RESIDUE_HIGH[datagram[end + 1]] ^ kind.residue
    if _crc(datagram[begin : end + _CRC_BYTES], before) != residue:
        counters.bad_crc += 1
        return None
    frame = Frame()
    frame._kind = kind
    frame._message = None
    frame.raw = datagram[begin:stop]
    frame.message_id = kind.message_id
    frame.sequence = sequence
    frame.system_id = system_id
    frame.component_id = component_id
    return frame
