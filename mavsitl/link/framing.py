"""A byte stream cut into datagrams for the codec: each whole frame one datagram."""

from __future__ import annotations

import re

from fastcrc import crc16

from mavsitl.codec import MAX_DATAGRAM_BYTES, SIGNATURE_BYTES
from mavsitl.dialect import mavlink

__all__ = ["LONGEST_FRAME_BYTES", "StreamSplitter", "split_frames"]

LONGEST_FRAME_BYTES = 10 + 255 + 2 + SIGNATURE_BYTES
"""A signed MAVLink 2 frame of the longest payload."""

_MAGIC_V1 = 0xFE
_MAGIC_V2 = 0xFD
_SIGNED = 0x01
_next_magic = re.compile(rb"[\xfd\xfe]").search

_INCOMPLETE = -1
_REFUSED = 0


def split_frames(datagram: bytes) -> list[bytes]:
    """A datagram's frames by their lengths alone; from where no frame begins, or none ends, the rest in one piece."""
    pieces = []
    begin, available = 0, len(datagram)
    while begin < available:
        stop = available
        if datagram[begin] == _MAGIC_V2 and available - begin > 2:
            signature = SIGNATURE_BYTES if datagram[begin + 2] & _SIGNED else 0
            stop = begin + 12 + datagram[begin + 1] + signature
        elif datagram[begin] == _MAGIC_V1 and available - begin > 1:
            stop = begin + 8 + datagram[begin + 1]
        pieces.append(datagram[begin:stop])
        begin = stop
    return pieces


class StreamSplitter:
    """Cuts what one sender streams.

    Nothing is lost or invented: the datagrams put together are the stream, less what is held back. A datagram is one
    frame or a stretch of bytes that are in none, which the codec counts as it counts them over UDP. At most
    `LONGEST_FRAME_BYTES` - 1 bytes are held back, the beginning of a frame whose rest has not come.

    A frame of a known message is told by its checksum, so a stray magic byte hides nothing behind it. A frame of an
    unknown message counts where the next one, or the end of what has come, follows it.

    Attributes:
        frames: frames found.
        junk_run: bytes outside frames since the newest frame.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.junk_run = 0
        self._held = b""

    @property
    def held_bytes(self) -> int:
        """Bytes held back."""
        return len(self._held)

    def feed(self, octets: bytes) -> list[bytes]:
        """The datagrams that `octets` complete, in order; never raises."""
        data = self._held + octets
        datagrams: list[bytes] = []
        junk = 0
        begin = _find(data, 0)
        while begin < len(data):
            stop = _end_of_frame(data, begin)
            if stop == _INCOMPLETE:
                break
            if stop == _REFUSED:
                begin = _find(data, begin + 1)
                continue
            self._take_junk(data, junk, begin, datagrams)
            datagrams.append(data[begin:stop])
            self.frames += 1
            self.junk_run = 0
            junk = stop
            begin = _find(data, stop)
        self._take_junk(data, junk, begin, datagrams)
        self._held = data[begin:]
        return datagrams

    def _take_junk(self, data: bytes, begin: int, end: int, datagrams: list[bytes]) -> None:
        self.junk_run += end - begin
        for first in range(begin, end, MAX_DATAGRAM_BYTES):
            datagrams.append(data[first : min(first + MAX_DATAGRAM_BYTES, end)])


def _find(data: bytes, begin: int) -> int:
    """Index of the next byte that may begin a frame, or the length of the data."""
    found = _next_magic(data, begin)
    return len(data) if found is None else found.start()


def _end_of_frame(data: bytes, begin: int) -> int:
    """Index behind the frame that begins with the magic byte at `begin`, or that it is incomplete or none."""
    available = len(data) - begin
    if data[begin] == _MAGIC_V2:
        if available >= 3 and data[begin + 2] & ~_SIGNED:
            return _REFUSED
        if available < 10:
            return _INCOMPLETE
        body_end = begin + 10 + data[begin + 1]
        stop = body_end + 2 + (SIGNATURE_BYTES if data[begin + 2] else 0)
        message_id = int.from_bytes(data[begin + 7 : begin + 10], "little")
    else:
        if available < 6:
            return _INCOMPLETE
        body_end = begin + 6 + data[begin + 1]
        stop = body_end + 2
        message_id = data[begin + 5]
    if stop > len(data):
        return _INCOMPLETE
    message_class = mavlink.mavlink_map.get(message_id)
    if message_class is None:
        follows = stop == len(data) or data[stop] in (_MAGIC_V1, _MAGIC_V2)
        return stop if follows else _REFUSED
    crc = crc16.mcrf4xx(data[begin + 1 : body_end] + bytes((message_class.crc_extra,)), 0xFFFF)
    return stop if crc == data[body_end] | data[body_end + 1] << 8 else _REFUSED
