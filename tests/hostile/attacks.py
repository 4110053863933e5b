"""Datagrams that nobody honest sends: made field by field from the dialect's own definitions, and then damaged."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Sequence
from math import inf, nan
from typing import Any

from fastcrc import crc16
from mavsitl_vehicle.autopilot import commands, plan, telemetry
from mavsitl_vehicle.autopilot.parameters import TABLE

from mavsitl.codec import MAX_DATAGRAM_BYTES, encode
from mavsitl.dialect import mavlink
from mavsitl.services.ftp import PAYLOAD_BYTES
from mavsitl.signing import Key

LARGEST = 3.402_823_466_385_288_6e38
FLOATS = (
    nan, inf, -inf, 3e38, -3e38, LARGEST, -LARGEST, 1e-45, -1e-45, 1.17549435e-38, 0.0, -0.0, 2.0**31, -(2.0**31),
    2.0**63, 2.0**53, 1e10, -1e10, 0.5, 1.0, -1.0, 90.0, 180.0, 1e7,
)  # fmt: skip
"""What a float field may hold that an honest sender's seldom does: not numbers, too large, too small, on an edge."""

NOT_NUMBERS = (nan, inf, -inf)
HUGE = (3e38, -3e38, LARGEST, -LARGEST)

RANGES = {
    "B": (0, 255), "b": (-128, 127), "H": (0, 65535), "h": (-32768, 32767), "I": (0, 2**32 - 1),
    "i": (-(2**31), 2**31 - 1), "Q": (0, 2**64 - 1), "q": (-(2**63), 2**63 - 1),
}  # fmt: skip

VEHICLE = (1, 1)
STRANGER = (66, 1)

HANDLED: tuple[str, ...] = (
    "SET_ATTITUDE_TARGET", "SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT",
    "SET_ACTUATOR_CONTROL_TARGET", "MANUAL_CONTROL", "SET_MODE", "HEARTBEAT", "SET_GPS_GLOBAL_ORIGIN", "COMMAND_LONG",
    "COMMAND_INT", "PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET", "FILE_TRANSFER_PROTOCOL",
    "LOG_REQUEST_LIST", "LOG_REQUEST_DATA", "LOG_REQUEST_END", "LOG_ERASE", "TIMESYNC", "PING", "MISSION_COUNT",
    "MISSION_ITEM_INT", "MISSION_ITEM", "MISSION_REQUEST_LIST", "MISSION_REQUEST_INT", "MISSION_REQUEST",
    "MISSION_ACK", "MISSION_CLEAR_ALL", "MISSION_SET_CURRENT", "MISSION_REQUEST_PARTIAL_LIST",
    "MISSION_WRITE_PARTIAL_LIST", "SETUP_SIGNING",
)  # fmt: skip
"""Every message that the vehicle acts on; a test compares this with its own tables."""

PATHS = (
    b"/", b"", b"/fs/microsd", b"/fs/microsd/log", b"/fs/microsd/../../../etc/passwd", b"../../../../etc/passwd",
    b"/../signing.json", b"/fs/microsd/../signing.json", b"/fs/microsd/..", b"/fs/microsd/log/../../signing.json",
    b"//fs//microsd//./x", b"/fs/microsd/a\0/etc/passwd", b"/fs/microsd/" + b"a" * 220, b"/" + b"d/" * 110,
    b"\xff\xfe\xfd", b"/fs/microsd/\n\t", b"/etc/passwd", b"/proc/self/environ", b"/dev/zero", b"~", b"%2e%2e/%2e%2e",
    b"/fs/microsd/x", b"/fs/microsd/y", b"/fs/microsd/d", b"/fs/microsd/d/z", b"@PARAM/param.pck", b"..\\..\\etc",
    b"/fs/microsd/.mavsitl-upload-0",
)  # fmt: skip
"""Path names for FTP: those that lead out of the card, and a few that are good."""


def message_class(name: str) -> Any:
    return getattr(mavlink, f"MAVLink_{name.lower()}_message")


def command_ids() -> Sequence[int]:
    return tuple(commands.TABLE)


class Attacker:
    """Makes datagrams, each from the seeded generator alone."""

    def __init__(self, seed: int | str) -> None:
        self.random = random.Random(seed)
        self._key = Key(bytes(range(1, 33)))
        self._classes = list(mavlink.mavlink_map.values())
        self._names = [name.encode() for name in TABLE]
        self._ids = {
            "command": [*command_ids(), *plan.COMMANDS, 0, 65535],
            "message": [stream.message_id for stream in telemetry.STREAMS],
        }
        self._sequence = 0
        self._rest: list[bytes] = []
        """Of a transaction that is under way."""

    # --- fields

    def real(self) -> float:
        draw = self.random
        kind = draw.random()
        if kind < 0.5:
            return draw.choice(FLOATS)
        if kind < 0.8:
            return draw.uniform(-10.0, 10.0)
        if kind < 0.9:
            return float(draw.choice(self._ids["message"]))
        bits: float = struct.unpack("<f", draw.randbytes(4))[0]
        return bits

    def whole(self, code: str) -> int:
        low, high = RANGES[code]
        draw = self.random
        kind = draw.random()
        if kind < 0.35:
            return draw.choice((low, high, 0, max(low, -1), high - 1, high // 2, min(high, 255)))
        if kind < 0.75:
            return draw.randint(max(low, -2), min(high, 16))
        return draw.randint(low, high)

    def field(self, name: str, code: str, length: int, message: str) -> Any:
        draw = self.random
        if length > 1 and code != "c" and message != "FILE_TRANSFER_PROTOCOL":
            return [self.number(code) for _ in range(length)]
        if name == "target_system" or (name == "target" and message == "MANUAL_CONTROL"):
            return draw.choice((1, 1, 1, 1, 1, 1, 1, 0, 255))
        if name == "target_component":
            return draw.choice((1, 1, 1, 1, 1, 1, 1, 0, 190))
        if name == "param_id":
            return draw.choice(self._names) if draw.random() < 0.8 else draw.randbytes(draw.randint(0, 16))
        if name == "command" and draw.random() < 0.9:
            return draw.choice(self._ids["command"])
        if name == "payload" and message == "FILE_TRANSFER_PROTOCOL":
            return self.file_request()
        if name == "mission_type" and draw.random() < 0.8:
            return draw.choice((0, 0, 0, 1, 2))
        if name in ("frame", "coordinate_frame") and draw.random() < 0.8:
            return draw.choice((0, 1, 2, 3, 5, 6, 7, 8, 9))
        if code == "c":
            return draw.randbytes(draw.randint(0, length))
        return self.number(code)

    def number(self, code: str) -> float:
        return self.real() if code in "fd" else self.whole(code)

    def file_request(self) -> bytes:
        draw = self.random
        path = draw.choice(PATHS)
        if draw.random() < 0.2:
            path += b"\0" + draw.choice(PATHS)
        data = (path if draw.random() < 0.7 else draw.randbytes(draw.randint(0, 239)))[:239]
        opcode = draw.randint(0, 15) if draw.random() < 0.9 else draw.randint(0, 255)
        size = len(data) if draw.random() < 0.7 else draw.randint(0, 255)
        offset = draw.choice((0, 0, 0, 1, 239, 2**31, 2**32 - 1, draw.randint(0, 2**32 - 1)))
        head = struct.pack(
            "<HBBBBBxI", draw.randint(0, 65535) if draw.random() < 0.5 else draw.randint(0, 3),
            draw.randint(0, 3) if draw.random() < 0.9 else draw.randint(0, 255),
            opcode, size, 0, draw.randint(0, 1), offset,
        )  # fmt: skip
        return (head + data).ljust(PAYLOAD_BYTES, b"\0")

    # --- messages

    def message(self, name: str | None = None) -> Any:
        """A message of one kind, of any that the vehicle acts on, or now and then of any in the dialect."""
        draw = self.random
        if name is None and draw.random() < 0.05:
            kind = draw.choice(self._classes)
        else:
            kind = message_class(name or draw.choice(HANDLED))
        values = {}
        for field, code, length, array in zip(
            kind.ordered_fieldnames, kind.native_format.decode()[1:], kind.lengths, kind.array_lengths, strict=True
        ):
            values[field] = self.field(field, code, array if code == "c" else length, kind.msgname)
        return kind(**{field: values[field] for field in kind.fieldnames})

    def frame(self, name: str | None = None, sender: tuple[int, int] | None = None) -> bytes:
        self._sequence = (self._sequence + 1) & 0xFF
        if sender is None:
            draw = self.random
            sender = STRANGER if draw.random() < 0.5 else (draw.randint(2, 254), draw.randint(0, 255))
        return encode(self.message(name), self._sequence, *sender)

    def old_frame(self) -> bytes:
        """MAVLink 1: the same payload, 8 bits of id."""
        frame = self.frame(self.random.choice([n for n in HANDLED if message_class(n).id < 256]))
        return as_v1(frame)

    def signed(self) -> bytes:
        """By a key that is nobody's."""
        return self._key.sign(self.frame(), self.random.randint(0, 255), self.random.getrandbits(47))

    # --- transactions: by the protocol, so that what lies behind its first step is reached

    def transaction(self) -> list[bytes]:
        """The frames of one, in order, from one sender."""
        made = self.random.choice((self._upload, self._file, self._log, self._values))()
        sender = (67, self.random.randint(1, 3))
        frames = []
        for message in made:
            self._sequence = (self._sequence + 1) & 0xFF
            frames.append(encode(message, self._sequence, *sender))
        return frames

    def _with(self, name: str, **fields: Any) -> Any:
        message = self.message(name)
        kind = type(message)
        values = {each: getattr(message, f"_{each}_raw", getattr(message, each)) for each in kind.fieldnames}
        return kind(**(values | {"target_system": 1, "target_component": 1} | fields))

    def _upload(self) -> list[Any]:
        kind, count = self.random.choice((0, 0, 1, 2)), self.random.randint(1, 6)
        name = self.random.choice(("MISSION_ITEM_INT", "MISSION_ITEM_INT", "MISSION_ITEM"))
        frame = self.random.choice((2, 3, 6))
        if self.random.random() < 0.5:  # nothing but what is flown
            spots: dict[str, Any] = {
                "x": 473977418,
                "y": 85455939,
                "z": 10.0,
                "command": self.random.choice((16, 22, 21)),
            }
            spots |= {f"param{number}": 0.0 for number in range(1, 5)}
            name, frame = "MISSION_ITEM_INT", 6
        else:
            spots = {}
        return [
            self._with("MISSION_COUNT", count=count, mission_type=kind),
            *(self._with(name, seq=seq, frame=frame, mission_type=kind, current=0, **spots) for seq in range(count)),
            self._with("MISSION_REQUEST_LIST", mission_type=kind),
            *(self._with("MISSION_REQUEST_INT", seq=seq, mission_type=kind) for seq in range(count + 1)),
            self._with("MISSION_ACK", type=0, mission_type=kind),
        ]

    def _file(self) -> list[Any]:
        draw = self.random
        path = draw.choice((b"/fs/microsd/x", b"/fs/microsd/d/z", draw.choice(PATHS)))[:200]
        steps = [(9, b"/fs/microsd/d", 0), (draw.choice((6, 11)), path, 0)]
        steps += [(7, draw.randbytes(200), draw.choice((0, 200, 2**31, 2**32 - 1))) for _ in range(3)]
        steps += [
            (1, b"", 0),
            (4, path, 0),
            (5, bytes(239), draw.choice((0, 100, 2**32 - 1))),
            (15, b"", 0),
            (1, b"", 0),
        ]
        steps += [(14, path, 0), (12, path, draw.choice((0, 5, 2**32 - 1))), (13, path + b"\0" + draw.choice(PATHS), 0)]
        begin = draw.randint(0, 60000)
        messages = []
        for step, (opcode, data, offset) in enumerate(steps):
            head = struct.pack("<HBBBBBxI", begin + step, 1, opcode, len(data[:239]), 0, 0, offset)
            payload = list((head + data[:239]).ljust(PAYLOAD_BYTES, b"\0"))
            messages.append(self._with("FILE_TRANSFER_PROTOCOL", target_network=0, payload=payload))
        return messages

    def _log(self) -> list[Any]:
        draw = self.random
        return [
            self._with("LOG_REQUEST_LIST", start=0, end=65535),
            *(
                self._with("LOG_REQUEST_DATA", id=0, ofs=draw.choice((0, 90, 2**32 - 1)), count=self.whole("I"))
                for _ in range(3)
            ),
            self._with("LOG_REQUEST_END"),
        ]

    def _values(self) -> list[Any]:
        return [self._with("PARAM_SET", param_type=self.random.choice((6, 9))) for _ in range(5)]

    # --- datagrams

    def good(self) -> bytes:
        """One with at least one frame that is well formed, whatever its fields hold."""
        if not self._rest and self.random.random() < 0.02:
            self._rest = self.transaction()
        if self._rest and self.random.random() < 0.5:
            return self._rest.pop(0)
        kind = self.random.random()
        if kind < 0.80:
            return self.frame()
        if kind < 0.88:
            return self.old_frame()
        if kind < 0.94:
            return self.signed()
        return b"".join(self.frame() for _ in range(self.random.randint(2, 6)))

    def broken(self) -> bytes:
        """One without, but for a damaged frame in a few millions."""
        draw = self.random
        return BREAKS[draw.randrange(len(BREAKS))](self)

    def any(self) -> bytes:
        return self.good() if self.random.random() < 0.5 else self.broken()


def as_v1(frame: bytes) -> bytes:
    """A MAVLink 2 frame of a message below 256, as MAVLink 1; no extension fields."""
    message_id = frame[7]
    kind = mavlink.mavlink_map[message_id]
    body = frame[10:-2]
    wire = sum(
        struct.calcsize(f"<{code}") * length
        for code, length in zip(kind.native_format.decode()[1:], kind.lengths, strict=True)
    )
    body = body.ljust(wire, b"\0")[:255]
    head = bytes((len(body), frame[4], frame[5], frame[6], message_id))
    crc = crc16.mcrf4xx(head + body + bytes((kind.crc_extra,)), 0xFFFF)
    return b"\xfe" + head + body + crc.to_bytes(2, "little")


def _truncated(a: Attacker) -> bytes:
    frame = a.frame()
    return frame[: a.random.randint(1, len(frame) - 1)]


def _flipped(a: Attacker) -> bytes:
    frame = bytearray(a.frame())
    # Fewer bits than the checksum of MAVLink can miss.
    for _ in range(a.random.randint(1, 3)):
        place = a.random.randrange(8, 8 * len(frame))
        frame[place >> 3] ^= 1 << (place & 7)
    return bytes(frame) if crc_is_wrong(bytes(frame)) else _junk(a)


def crc_is_wrong(frame: bytes) -> bool:
    """No frame is found in it."""
    from mavsitl.codec import parse

    return not parse(frame)


def _wrong_crc(a: Attacker) -> bytes:
    frame = a.frame()
    return frame[:-2] + bytes((frame[-2] ^ a.random.randint(1, 255), frame[-1]))


def _wrong_length(a: Attacker) -> bytes:
    frame = bytearray(a.frame())
    frame[1] = (frame[1] + a.random.randint(1, 255)) & 0xFF
    return bytes(frame) if crc_is_wrong(bytes(frame)) else _junk(a)


def _wrong_flags(a: Attacker) -> bytes:
    frame = bytearray(a.frame())
    frame[2] = a.random.randint(2, 255)
    return bytes(frame) if crc_is_wrong(bytes(frame)) else _junk(a)


def _unknown_id(a: Attacker) -> bytes:
    while True:
        number = a.random.randrange(1 << 24)
        if number not in mavlink.mavlink_map:
            break
    frame = bytearray(a.frame())
    frame[7:10] = number.to_bytes(3, "little")
    return bytes(frame) if crc_is_wrong(bytes(frame)) else _junk(a)


def _junk(a: Attacker) -> bytes:
    kind = a.random.random()
    length = a.random.choice((0, 1, 3, 17, 280, 1400, MAX_DATAGRAM_BYTES, MAX_DATAGRAM_BYTES + 1))
    if kind < 0.4:
        data = a.random.randbytes(length)
    elif kind < 0.7:
        data = (b"\xfd\xff\x00", b"\xfe\x00", b"\xfd\x00", b"\xfd")[a.random.randrange(4)] * (length // 2)
    else:
        data = bytes(length)
    return data if crc_is_wrong(data) else b"\xfd\xff\x00"


BREAKS: tuple[Callable[[Attacker], bytes], ...] = (
    _truncated, _flipped, _wrong_crc, _wrong_length, _wrong_flags, _unknown_id, _junk,
)  # fmt: skip
