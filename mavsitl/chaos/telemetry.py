"""What the vehicle says of itself, gone wrong: HEARTBEAT, clocks, states, texts, and the frames themselves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mavsitl.chaos.base import NOTHING, Every, Message, Mode, Peer, altered, ids
from mavsitl.dialect import mavlink

HEARTBEAT = ids("HEARTBEAT")

ANSWERS = ids(
    "HEARTBEAT", "STATUSTEXT", "COMMAND_ACK", "PARAM_VALUE", "PARAM_ERROR", "MISSION_COUNT", "MISSION_ITEM",
    "MISSION_ITEM_INT", "MISSION_REQUEST", "MISSION_REQUEST_INT", "MISSION_ACK", "MISSION_ITEM_REACHED",
    "FILE_TRANSFER_PROTOCOL", "LOG_ENTRY", "LOG_DATA", "TIMESYNC", "PING", "AUTOPILOT_VERSION", "AVAILABLE_MODES",
    "MESSAGE_INTERVAL", "FLIGHT_INFORMATION",
) | {397}  # fmt: skip
"""What is not telemetry: signs of life, texts, and what somebody asked for. 397 is COMPONENT_METADATA, which not every
dialect has."""


class Altered(Mode):
    """Every message of a kind with other values in some fields."""

    def __init__(self, name: str, fields: Callable[[Message], dict[str, Any]]) -> None:
        self.gives = ids(name)
        self._fields = fields

    def outgoing(self, message: Message) -> Sequence[Message]:
        return (altered(message, **self._fields(message)),)


class Slow(Mode):
    """HEARTBEAT so seldom, the changes that are told at once among the rest."""

    gives = HEARTBEAT

    def __init__(self, seconds: float) -> None:
        self._every = Every(seconds)

    def outgoing(self, message: Message) -> Sequence[Message]:
        return (message,) if self._every.due(self.line.now_us) else NOTHING


class OtherSystem(Mode):
    """Every second HEARTBEAT comes from the next system id."""

    def __init__(self) -> None:
        self._count = 0

    def source(self, message_id: int, own: Peer) -> Peer:
        if message_id not in HEARTBEAT:
            return own
        self._count += 1
        return (own[0] % 255 + 1, own[1]) if self._count % 2 == 0 else own


class Silent(Mode):
    """Nothing is sent, nothing is looked at, or neither; for `seconds`, or for good (0)."""

    def __init__(self, seconds: float, *, mute: bool, deaf: bool) -> None:
        self._us = round(seconds * 1e6)
        self._until_us: int | None = None
        self.gives = None if mute else frozenset()
        self.takes = None if deaf else frozenset()

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        return None if self._on() else message

    def outgoing(self, message: Message) -> Sequence[Message]:
        return NOTHING if self._on() else (message,)

    def step(self) -> None:
        self._on()

    def _on(self) -> bool:
        if self._until_us is None:
            self._until_us = self.line.now_us + self._us
        return self._us == 0 or self.line.now_us < self._until_us


class Stopped(Mode):
    """Telemetry ends; HEARTBEAT, texts and answers go on."""

    gives = None

    def outgoing(self, message: Message) -> Sequence[Message]:
        return (message,) if type(message).id in ANSWERS else NOTHING


class Frozen(Mode):
    """Telemetry repeats what it said when the mode began; HEARTBEAT, texts and answers go on."""

    gives = None

    def __init__(self) -> None:
        self._first: dict[int, Message] = {}

    def outgoing(self, message: Message) -> Sequence[Message]:
        kind = type(message).id
        return (message,) if kind in ANSWERS else (self._first.setdefault(kind, message),)


class SystemTimeGarbage(Mode):
    gives = ids("SYSTEM_TIME")

    def outgoing(self, message: Message) -> Sequence[Message]:
        unix_us, boot_ms = (int(self.line.random.integers(2**bits, dtype="uint64")) for bits in (63, 32))
        return (altered(message, time_unix_usec=unix_us, time_boot_ms=boot_ms),)


class TimesyncJumps(Mode):
    """Each answer's clock is wrong by another amount."""

    gives = ids("TIMESYNC")

    def __init__(self, seconds: float) -> None:
        self._ns = seconds * 1e9

    def outgoing(self, message: Message) -> Sequence[Message]:
        if message.tc1 == 0:
            return (message,)
        return (altered(message, tc1=max(message.tc1 + int(self.line.random.uniform(-self._ns, self._ns)), 1)),)


class TextFlood(Mode):
    def __init__(self, hz: float) -> None:
        self._every = Every(1.0 / hz)
        self._count = 0

    def step(self) -> None:
        while self._every.due(self.line.now_us):
            self._count += 1
            text = f"Chaos: text {self._count} of a flood".encode()
            self.line.send(mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_WARNING, text))


class ChunkLost(Mode):
    """The second part of every STATUSTEXT that has several."""

    gives = ids("STATUSTEXT")

    def outgoing(self, message: Message) -> Sequence[Message]:
        return NOTHING if message.chunk_seq == 1 else (message,)


V2 = 0xFD
UNKNOWN_ID = 0xFFFFF0
"""No dialect has this message."""


class UnknownMessage(Mode):
    """Every n-th frame is followed by one of a message that no dialect knows: the same bytes under another id."""

    gives = None

    def __init__(self, n: int) -> None:
        self._n = n
        self._count = 0

    def wire(self, frame: bytes) -> Sequence[bytes]:
        self._count += 1
        if self._count % self._n or frame[0] != V2:
            return (frame,)
        return (frame, frame[:7] + UNKNOWN_ID.to_bytes(3, "little") + frame[10:])


class SequenceGaps(Mode):
    """Before every n-th frame one sequence number is left out."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._count = 0

    def skip(self, message_id: int) -> int:
        self._count += 1
        return int(self._count % self._n == 0)


class CrcWrong(Mode):
    """Every n-th frame has a wrong checksum."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._count = 0

    def wire(self, frame: bytes) -> Sequence[bytes]:
        self._count += 1
        if self._count % self._n:
            return (frame,)
        end = frame[1] + (10 if frame[0] == V2 else 6)
        return (frame[:end] + bytes((frame[end] ^ 0xFF,)) + frame[end + 1 :],)


class FrameCut(Mode):
    """Every n-th frame ends in its middle."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._count = 0

    def wire(self, frame: bytes) -> Sequence[bytes]:
        self._count += 1
        return (frame[: len(frame) // 2] if self._count % self._n == 0 else frame,)
