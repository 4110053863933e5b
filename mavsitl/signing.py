"""MAVLink 2 message signing: frames signed, and signatures checked in the order that nobody can abuse.

A signature is 13 bytes behind the checksum: link id, time stamp (48 bits, 10 µs since 2015-01-01) and the first 48 bits
of SHA-256 over key, frame, link id and time stamp. A check compares the hash first, then the time stamp, and remembers
the time stamp last: a forged frame changes nothing but a counter.

One `Signing` belongs to a component and is shared by its links, so that a frame heard on one cannot be replayed on
another; `Signing.link` makes what a link's `mavsitl.node.Node` takes. The clock comes from the caller, as does the
store: `Signing.unsaved` says what to keep and when, and what it hands out is ahead of every time stamp accepted or
sent, so a restart opens no window for a replay.

The key never shows: not by `repr`, not by pickling, and SETUP_SIGNING messages end in the node.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import NoReturn

from fastcrc import crc16

from mavsitl.codec import SIGNATURE_BYTES, Frame, Message
from mavsitl.dialect import mavlink

__all__ = [
    "EPOCH_UNIX_US",
    "FUTURE_UNITS",
    "MAX_SETUP_UNITS",
    "MAX_STREAMS",
    "NEW_STREAM_UNITS",
    "SAVE_AHEAD_OF_NEWEST_UNITS",
    "SAVE_AHEAD_UNITS",
    "UNITS_US",
    "UNSIGNED_ACCEPTED",
    "Key",
    "LinkSigning",
    "Signing",
    "SigningCounters",
    "SigningMode",
    "SigningPolicy",
    "SigningState",
    "Verdict",
    "setup_signing",
]

EPOCH_UNIX_US = 1_420_070_400_000_000
"""2015-01-01 00:00 UTC, where the time stamps begin, µs of the Unix epoch."""

UNITS_US = 10
"""One unit of a time stamp, µs."""

NEW_STREAM_UNITS = 6_000_000
"""A stream not heard before may be this much behind the newest time stamp: one minute."""

FUTURE_UNITS = 30_000_000
"""No time stamp may be this much ahead of our clock: five minutes. Else one key holder's wrong clock shuts out all."""

SAVE_AHEAD_UNITS = 6_000_000
"""The stored time stamp is this much ahead of our clock; it is renewed when half of that is used up."""

SAVE_AHEAD_OF_NEWEST_UNITS = 200_000
"""And this much ahead of the newest stamp where that is ahead of our clock. Stamps then count frames, not time, so
little is enough, and one crash after another does not drive the stamps away from the clock."""

MAX_STREAMS = 64
"""Streams told apart. Only frames with a good signature open one; above it the one with the oldest stamp gives way."""

MAX_SETUP_UNITS = 2**47
"""SETUP_SIGNING may set the clock up to here (the year 2059), so that stamps never run out of their 48 bits."""

UNSIGNED_ACCEPTED = frozenset(
    (mavlink.MAVLINK_MSG_ID_RADIO_STATUS, mavlink.MAVLINK_MSG_ID_ADSB_VEHICLE, mavlink.MAVLINK_MSG_ID_COLLISION)
)
"""Messages of radios and receivers that cannot sign (PX4's list)."""

KEY_BYTES = 32

_SETUP_ID = mavlink.MAVLINK_MSG_ID_SETUP_SIGNING
_HASH_BYTES = 6
_HEADER_BYTES = 10
_CRC_BYTES = 2
_MAGIC_V2 = 0xFD
_SIGNED = 0x01

_write_crc = struct.Struct("<H").pack
_sha256 = hashlib.sha256
_same = hmac.compare_digest


class Key:
    """A secret key of 32 bytes that does not show itself."""

    __slots__ = ("_begun", "_octets")

    def __init__(self, octets: bytes) -> None:
        """Raises `ValueError` unless there are exactly 32 bytes, not all zero (which means "no key" on the wire)."""
        if len(octets) != KEY_BYTES or not any(octets):
            raise ValueError(f"a key has {KEY_BYTES} bytes, not all of them zero")
        self._octets = bytes(octets)
        self._begun = _sha256(self._octets)

    @classmethod
    def from_passphrase(cls, passphrase: str) -> Key:
        """The key that MAVProxy and QGroundControl make of a passphrase: its SHA-256."""
        return cls(_sha256(passphrase.encode()).digest())

    def reveal(self) -> bytes:
        """The 32 bytes, for the store and for SETUP_SIGNING."""
        return self._octets

    def tag(self, signed: bytes) -> bytes:
        """The 48-bit hash of a frame up to and with its signature's time stamp."""
        state = self._begun.copy()
        state.update(signed)
        return state.digest()[:_HASH_BYTES]

    def sign(self, frame: bytes, link_id: int, timestamp: int) -> bytes:
        """An unsigned MAVLink 2 frame as a signed one.

        Args:
            frame: as `mavsitl.codec` packs it, of a message of the dialect.
            link_id: 0 to 255.
            timestamp: 10 µs since 2015-01-01, 48 bits.

        Raises:
            ValueError: it is no such frame, or a number is out of range.
        """
        if (
            len(frame) < _HEADER_BYTES + _CRC_BYTES
            or frame[0] != _MAGIC_V2
            or frame[2] != 0
            or len(frame) != _HEADER_BYTES + frame[1] + _CRC_BYTES
        ):
            raise ValueError("not an unsigned MAVLink 2 frame")
        body = b"%c\x01%b" % (frame[1], frame[3:-_CRC_BYTES])
        crc = _write_crc(crc16.mcrf4xx(body + _crc_extra(frame[7:10]), 0xFFFF))
        try:
            signed = b"\xfd%b%b%c%b" % (body, crc, link_id, timestamp.to_bytes(6, "little"))
        except OverflowError as error:
            raise ValueError(f"link id {link_id} or time stamp {timestamp} is out of range") from error
        return signed + self.tag(signed)

    def verify(self, frame: bytes) -> bool:
        """Whether a frame ends in a signature by this key, whatever its time stamp; False for anything but a frame."""
        if (
            len(frame) < _HEADER_BYTES + _CRC_BYTES + SIGNATURE_BYTES
            or frame[0] != _MAGIC_V2
            or not frame[2] & _SIGNED
            or len(frame) != _HEADER_BYTES + frame[1] + _CRC_BYTES + SIGNATURE_BYTES
        ):
            return False
        return _same(self.tag(frame[:-_HASH_BYTES]), frame[-_HASH_BYTES:])

    def __eq__(self, other: object) -> bool:
        return _same(self._octets, other._octets) if isinstance(other, Key) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.tag(b""))

    def __repr__(self) -> str:
        return "Key(hidden)"

    def __reduce__(self) -> NoReturn:
        raise TypeError("a key is not pickled")


_extras: dict[bytes, bytes] = {}


def _crc_extra(id_bytes: bytes) -> bytes:
    extra = _extras.get(id_bytes)
    if extra is None:
        message_class = mavlink.mavlink_map.get(int.from_bytes(id_bytes, "little"))
        if message_class is None:
            raise ValueError("no message of the dialect")
        extra = _extras[id_bytes] = bytes((message_class.crc_extra,))
    return extra


def setup_signing(target: tuple[int, int], key: Key | None, timestamp: int) -> Message:
    """The SETUP_SIGNING that gives a vehicle its key, or takes it away (None).

    For a trusted link, or one that the present key signs. The message shows the key to who prints it.

    Args:
        target: system and component id.
        key: the new key.
        timestamp: where its time stamps begin, 10 µs since 2015-01-01.
    """
    octets = bytes(KEY_BYTES) if key is None else key.reveal()
    return mavlink.MAVLink_setup_signing_message(*target, list(octets), timestamp)


# ---------------------------------------------------------------------------------------------------------- policy


class SigningMode(IntEnum):
    """PX4's parameter MAV_SIGN_CFG; without a key every value is `OFF`."""

    OFF = 0
    """signatures are skipped over"""
    UNTRUSTED = 1
    """demanded, and given, on all links but the trusted ones (PX4: but USB)"""
    ALWAYS = 2
    """on every link"""


@dataclass(slots=True)
class SigningPolicy:
    """What is demanded where, and who may change the key: decisions alone.

    Attributes:
        mode: MAV_SIGN_CFG.
        unsigned_ids: messages accepted without signature on a link that demands one.
        locked: the key may not be changed now (armed).
    """

    mode: SigningMode = SigningMode.OFF
    unsigned_ids: frozenset[int] = UNSIGNED_ACCEPTED
    locked: bool = False

    def active(self, has_key: bool, trusted: bool) -> bool:
        """Whether a link signs and demands signatures."""
        return has_key and (self.mode == SigningMode.ALWAYS or (self.mode == SigningMode.UNTRUSTED and not trusted))

    def accepts_unsigned(self, message_id: int, has_key: bool, trusted: bool) -> bool:
        """Whether a frame without signature is let in."""
        return not self.active(has_key, trusted) or message_id in self.unsigned_ids

    def accepts_setup(self, has_key: bool, trusted: bool, verified: bool) -> bool:
        """Whether a SETUP_SIGNING is obeyed; `verified`: it carries a good signature by the present key.

        A trusted link needs none, unless it demands one of every frame. Elsewhere only a holder of the key may change
        it, so the first key comes over a trusted link.
        """
        if self.locked:
            return False
        if self.active(has_key, trusted):
            return verified
        return trusted or (has_key and verified)


# ----------------------------------------------------------------------------------------------------------- state


@dataclass(frozen=True, slots=True)
class SigningState:
    """What outlives the process: to be kept in a file that its owner alone can read, never in parameters or logs."""

    key: Key | None = None
    timestamp: int = 0
    """10 µs since 2015-01-01; ahead of everything accepted or sent while it was the stored one"""

    def to_bytes(self) -> bytes:
        """48 bytes: mark, key, time stamp, CRC-32."""
        octets = bytes(KEY_BYTES) if self.key is None else self.key.reveal()
        data = _STATE_MARK + octets + self.timestamp.to_bytes(8, "little")
        return data + zlib.crc32(data).to_bytes(4, "little")

    @classmethod
    def from_bytes(cls, data: bytes) -> SigningState:
        """Raises `ValueError`, without a word of the content, where the bytes are damaged."""
        if (
            len(data) != _STATE_BYTES
            or data[:4] != _STATE_MARK
            or zlib.crc32(data[:-4]).to_bytes(4, "little") != data[-4:]
        ):
            raise ValueError("the signing state is damaged")
        octets, timestamp = data[4:36], int.from_bytes(data[36:44], "little")
        if timestamp > MAX_SETUP_UNITS + MAX_SETUP_UNITS // 2:
            raise ValueError("the signing state's time stamp is out of range")
        return cls(Key(octets) if any(octets) else None, timestamp)


_STATE_MARK = b"MSK1"
_STATE_BYTES = 4 + KEY_BYTES + 8 + 4


class Verdict(Enum):
    """What a check found."""

    GOOD = "good"
    BAD_SIGNATURE = "bad signature"
    REPLAY = "not newer than the last of its stream"
    OLD = "a new stream that is behind"
    FUTURE = "ahead of our clock"


@dataclass(slots=True)
class SigningCounters:
    """What became of the frames of one link."""

    sent: int = 0
    """signed"""
    good: int = 0
    bad_signature: int = 0
    replayed: int = 0
    old: int = 0
    future: int = 0
    unsigned_accepted: int = 0
    """of the messages that need no signature, while one is demanded"""
    unsigned_refused: int = 0
    setups: int = 0
    """SETUP_SIGNING obeyed"""
    setups_refused: int = 0
    """SETUP_SIGNING dropped: not trusted, for another, locked or malformed"""


_COUNTER = {
    Verdict.GOOD: "good",
    Verdict.BAD_SIGNATURE: "bad_signature",
    Verdict.REPLAY: "replayed",
    Verdict.OLD: "old",
    Verdict.FUTURE: "future",
}


class Signing:
    """Key, clock and streams of one component, for all its links.

    Attributes:
        policy: what is demanded; `policy.mode` is the parameter MAV_SIGN_CFG.
    """

    def __init__(
        self,
        clock: Callable[[], int],
        policy: SigningPolicy | None = None,
        state: SigningState | None = None,
    ) -> None:
        """`clock` gives µs since 2015-01-01 (`EPOCH_UNIX_US`), `state` is the stored one.

        The clock must not follow the system clock's jumps: take that once and add a monotonic clock.
        """
        stored = SigningState() if state is None else state
        self.policy = SigningPolicy() if policy is None else policy
        self._clock = clock
        self._key = stored.key
        self._ahead = 0
        self._own = 0
        # A little ahead is what a crash leaves, and passes. Much ahead is a clock that SETUP_SIGNING had to set.
        if stored.timestamp > self._time() + FUTURE_UNITS:
            self._set_clock(stored.timestamp)
        self._newest = stored.timestamp
        self._floor = stored.timestamp
        self._streams: dict[tuple[int, int, int], int] = {}
        self._reserved = stored.timestamp
        self._key_unsaved = False

    def __repr__(self) -> str:
        return f"Signing({'no key' if self._key is None else self._key}, {self.policy.mode.name})"

    @property
    def has_key(self) -> bool:
        return self._key is not None

    @property
    def streams(self) -> int:
        """Streams known, at most `MAX_STREAMS`."""
        return len(self._streams)

    def link(self, link_id: int, trusted: bool = False) -> LinkSigning:
        """What the node of one link takes. `link_id` is 0 to 255, another for each link of the component."""
        return LinkSigning(self, link_id, trusted)

    def active(self, trusted: bool) -> bool:
        """Whether a link signs and demands signatures."""
        return self.policy.active(self._key is not None, trusted)

    def set_key(self, key: Key | None, timestamp: int = 0) -> None:
        """Take a key, or none. Its time stamps begin at `timestamp` (10 µs) where that is ahead of our clock.

        Raises:
            ValueError: the time stamp is above `MAX_SETUP_UNITS`.
        """
        if not 0 <= timestamp <= MAX_SETUP_UNITS:
            raise ValueError(f"timestamp is {timestamp}; allowed: 0 to {MAX_SETUP_UNITS}")
        if key != self._key:
            # A key may come back: what was heard under it then is at or below here.
            self._floor = max(self._floor, self._newest)
            self._streams.clear()
            self._key = key
        self._key_unsaved = True
        self._set_clock(timestamp)

    def sign(self, frame: bytes, link_id: int) -> bytes:
        """A frame of ours, signed with the next time stamp. Raises `ValueError` without a key, or as `Key.sign`."""
        if self._key is None:
            raise ValueError("there is no key to sign with")
        stamp = max(self._newest + 1, self._time())
        signed = self._key.sign(frame, link_id, stamp)
        self._newest = stamp
        return signed

    def check(self, frame: bytes) -> Verdict:
        """A signed frame's signature, and if it is good its time stamp; only a frame that passes both is remembered.

        `frame` is the whole frame, from its magic byte to the end of its signature. Anything else is a bad signature.
        """
        if self._key is None or not self._key.verify(frame):
            return Verdict.BAD_SIGNATURE
        stamp = int.from_bytes(frame[-12:-6], "little")
        stream = (frame[5], frame[6], frame[-13])
        now = self._time()
        last = self._streams.get(stream)
        if last is not None:
            if stamp <= last:
                return Verdict.REPLAY
        elif stamp <= self._floor or stamp + NEW_STREAM_UNITS < max(self._newest, now):
            return Verdict.OLD
        if stamp > now + FUTURE_UNITS:
            return Verdict.FUTURE
        if last is None and len(self._streams) >= MAX_STREAMS:
            oldest = min(self._streams, key=lambda known: self._streams[known])
            if stamp <= self._streams[oldest]:
                return Verdict.OLD
            # What it said is older than the oldest of a full table from now on, so it cannot be said again.
            del self._streams[oldest]
        self._streams[stream] = stamp
        self._newest = max(self._newest, stamp)
        return Verdict.GOOD

    def setup(self, message: Message, trusted: bool, verified: bool) -> bool:
        """Obey a SETUP_SIGNING that is addressed to us, or not: whether it was. An all-zero key takes the key away."""
        if not self.policy.accepts_setup(self._key is not None, trusted, verified):
            return False
        octets = bytes(message.secret_key)
        try:
            self.set_key(Key(octets) if any(octets) else None, message.initial_timestamp)
        except ValueError:
            return False
        return True

    def unsaved(self) -> SigningState | None:
        """What has to be stored now, or None. Ask at least once a second; tell `saved` when it is safe on disk."""
        if not self._key_unsaved and (self._key is None or self._reach(2) <= self._reserved):
            return None
        return SigningState(self._key, self._reach(1))

    def saved(self, state: SigningState) -> None:
        """This state is in the store."""
        self._reserved = state.timestamp
        if state.key == self._key:
            self._key_unsaved = False

    def closing_state(self) -> SigningState:
        """What to store at an orderly end, when nothing more is sent or accepted: no time is spent ahead."""
        return SigningState(self._key, max(self._newest, self._floor))

    def _reach(self, divisor: int) -> int:
        """A stamp ahead of all that is sent and accepted in the near future."""
        newest = max(self._newest, self._floor)
        return max(self._time() + SAVE_AHEAD_UNITS // divisor, newest + SAVE_AHEAD_OF_NEWEST_UNITS // divisor)

    def _set_clock(self, units: int) -> None:
        """Let our clock show at least `units` from now on."""
        self._ahead = max(self._ahead, units - self._clock() // UNITS_US)

    def _time(self) -> int:
        self._own = max(self._own, self._clock() // UNITS_US + self._ahead)
        return self._own


class LinkSigning:
    """Signing as one link's node does it.

    Attributes:
        counters: what became of this link's frames.
        link_id: in the signatures of what we send here.
        trusted: whoever is on this link may set the key, and `SigningMode.UNTRUSTED` leaves the link alone.
    """

    __slots__ = ("_signing", "counters", "link_id", "trusted")

    def __init__(self, signing: Signing, link_id: int, trusted: bool) -> None:
        """Raises `ValueError` for a link id outside 0 to 255."""
        if not 0 <= link_id <= 255:
            raise ValueError(f"link_id is {link_id}; allowed: 0 to 255")
        self._signing = signing
        self.link_id = link_id
        self.trusted = trusted
        self.counters = SigningCounters()

    @property
    def active(self) -> bool:
        """This link signs and demands signatures: only a signed frame tells who is there."""
        return self._signing.active(self.trusted)

    def outgoing(self, frames: list[bytes], own: tuple[int, int]) -> list[bytes]:
        """The frames to send, those of `own` address signed if this link signs; forwarded ones stay as they are."""
        signing = self._signing
        if signing._key is None or not signing.active(self.trusted):
            return frames
        return [self._outgoing(frame, own) for frame in frames]

    def incoming(self, frames: list[Frame], own: tuple[int, int]) -> list[Frame]:
        """The frames that may be believed. SETUP_SIGNING ends here, for us or for another, obeyed or not.

        Frames of `own` address pass: the node drops and counts them itself, and none may open a stream.
        """
        signing = self._signing
        if signing._key is None or not signing.active(self.trusted):
            for frame in frames:
                if frame.message_id == _SETUP_ID:
                    break
            else:
                return frames
        return [frame for frame in frames if (frame.system_id, frame.component_id) == own or self._passes(frame, own)]

    def _outgoing(self, frame: bytes, own: tuple[int, int]) -> bytes:
        if frame[0] != _MAGIC_V2 or frame[2] or (frame[5], frame[6]) != own:
            return frame
        self.counters.sent += 1
        return self._signing.sign(frame, self.link_id)

    def _passes(self, frame: Frame, own: tuple[int, int]) -> bool:
        signing, message_id = self._signing, frame.message_id
        setup = message_id == _SETUP_ID
        active = signing.active(self.trusted)
        if not (active or setup):
            return True
        verified = False
        if frame.signed and signing.has_key:
            verdict = signing.check(frame.raw)
            name = _COUNTER[verdict]
            setattr(self.counters, name, getattr(self.counters, name) + 1)
            verified = verdict is Verdict.GOOD
        if not setup:
            if frame.signed:
                return verified
            accepted = message_id in signing.policy.unsigned_ids
            if accepted:
                self.counters.unsigned_accepted += 1
            else:
                self.counters.unsigned_refused += 1
            return accepted
        target_system, target_component = frame.target
        for_us = target_system in (0, own[0]) and target_component in (0, own[1])
        if for_us and signing.setup(frame.message, self.trusted, verified):
            self.counters.setups += 1
        else:
            self.counters.setups_refused += 1
        return False
