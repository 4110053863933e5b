"""The wire on record: a tlog that ground stations replay, and a digest of every byte that crossed."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from enum import IntEnum
from hashlib import blake2b
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import TypeAlias

from mavsitl.log.errors import Failed, LogError

_STAMP = struct.Struct(">Q")
_PREFIX = struct.Struct("<BI")
_MAVLINK_1 = 0xFE
_MAVLINK_2 = 0xFD
_SIGNED = 0x01
_BUFFER_BYTES = 65_536


class Direction(IntEnum):
    """Who sent it. The value is the byte that `WireHash` takes in."""

    FROM_VEHICLE = 0
    FROM_GROUND = 1


Heard: TypeAlias = tuple[Direction, int, bytes]
"""Who sent a datagram, when, in microseconds, and the datagram."""


def frames(datagram: bytes) -> list[bytes]:
    """The MAVLink 1 and 2 frames of a datagram, split by their length fields; bytes of no frame are left out.

    Checksums are not looked at: the record holds what was on the wire.
    """
    found = []
    at = 0
    size = len(datagram)
    while at < size:
        magic = datagram[at]
        if magic == _MAVLINK_2 and at + 3 <= size:
            length = 12 + datagram[at + 1] + (13 if datagram[at + 2] & _SIGNED else 0)
        elif magic == _MAVLINK_1 and at + 2 <= size:
            length = 8 + datagram[at + 1]
        else:
            at += 1
            continue
        if at + length > size:
            at += 1
            continue
        found.append(datagram[at : at + length])
        at += length
    return found


class TlogWriter:
    """Writes a .tlog: before each frame its time in us, 8 bytes, big-endian. Raises `LogError` as `UlogWriter` does."""

    def __init__(self, path: Path, failed: Failed | None = None) -> None:
        """`failed` is told, once, when the file cannot be written any more, and the log ends there; None: raise."""
        self.path = path
        self._failed = failed
        self._waiting = bytearray()
        self.left_out_bytes = 0
        """Bytes of datagrams that belonged to no frame and so are not in the file."""
        try:
            self._file: FileIO = path.open("wb", buffering=0)
        except OSError as error:
            raise self._error(error) from error

    def write(self, heard: Iterable[Heard]) -> None:
        """Append the frames of datagrams, whoever sent them."""
        waiting, stamp = self._waiting, _STAMP.pack
        for _, now_us, datagram in heard:
            size = len(datagram)
            if size > 2 and datagram[1] + 12 == size and datagram[0] == _MAVLINK_2 and not datagram[2]:
                waiting += stamp(now_us)  # one frame, as nearly always
                waiting += datagram
                continue
            for frame in frames(datagram):
                waiting += stamp(now_us)
                waiting += frame
                size -= len(frame)
            self.left_out_bytes += size
        if len(waiting) > _BUFFER_BYTES:
            self.flush()

    def flush(self) -> None:
        """Hand everything written so far to the system."""
        waiting, self._waiting = self._waiting, bytearray()
        if self._file.closed:
            if self._failed is None:
                raise LogError(f"{self.path}: cannot be written: it is closed")
            return
        try:
            self._write(waiting)
        except OSError as error:
            self._file.close()  # what comes after a torn frame would be read at the wrong place
            if self._failed is None:
                raise self._error(error) from error
            self._failed(self._error(error))

    def _write(self, data: bytearray) -> None:
        with memoryview(data) as view:
            written = 0
            while written < len(data):
                written += self._file.write(view[written:])

    def close(self) -> None:
        """More than once is harmless."""
        if self._file.closed:
            return
        try:
            self.flush()
        finally:
            self._shut()

    def _shut(self) -> None:
        try:
            self._file.close()
        except OSError as error:
            raise self._error(error) from error

    def __enter__(self) -> TlogWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _error(self, error: OSError) -> LogError:
        return LogError(f"{self.path}: cannot be written: {error.strerror or error}")


class WireHash:
    """A running blake2b over (direction byte, uint32 length, datagram): runs that agree exchanged the same bytes."""

    def __init__(self) -> None:
        self._hash = blake2b(digest_size=16)

    def update(self, heard: Iterable[Heard]) -> None:
        parts: list[bytes] = []
        prefix = _PREFIX.pack
        for direction, _, datagram in heard:
            parts += (prefix(direction, len(datagram)), datagram)
        self._hash.update(b"".join(parts))

    def hexdigest(self) -> str:
        """32 hexadecimal digits, of everything so far."""
        return self._hash.hexdigest()
