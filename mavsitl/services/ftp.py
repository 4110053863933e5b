"""MAVLink FTP (FILE_TRANSFER_PROTOCOL): the vehicle's files for ground stations, and the client that asks for them.

Codes and layout: https://mavlink.io/en/services/ftp.html. What that page leaves open is done as PX4 does it, or, where
clients are better off otherwise, so:

* A session has the number that its client asked for, as with ArduPilot, and belongs to that client alone. MAVSDK never
  looks at the number it is given; QGroundControl and pymavlink do.
* A repeated request gets the answer it got before. MAVSDK begins every operation with sequence number 0, so a known
  number with another content means that the client has begun anew, and what was kept of it is forgotten.
* A burst ends with the file: the last packet says `burst_complete`, and EOF is refused only to who asks behind the end.
  PX4 sends EOF uninvited, which MAVSDK takes for a failure if the packet before it was lost.
"""

from __future__ import annotations

import errno
import struct
import zlib
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

from mavsitl.dialect import mavlink
from mavsitl.services.base import NOTHING, Message, Peer
from mavsitl.services.files import Entry, FilePath, FileTree, Gaps, Reader, Writer, parse_path

__all__ = [
    "DATA_BYTES",
    "PAYLOAD_BYTES",
    "FtpClient",
    "FtpError",
    "FtpPayload",
    "FtpResult",
    "FtpServer",
    "Opcode",
    "crc32",
]

PAYLOAD_BYTES = 251
DATA_BYTES = 239

_HEADER = struct.Struct("<HBBBBBxI")
_U32 = struct.Struct("<I")


class Opcode(IntEnum):
    """MAV_FTP_OPCODE."""

    NONE = 0
    TERMINATE_SESSION = 1
    RESET_SESSIONS = 2
    LIST_DIRECTORY = 3
    OPEN_FILE_RO = 4
    READ_FILE = 5
    CREATE_FILE = 6
    WRITE_FILE = 7
    REMOVE_FILE = 8
    CREATE_DIRECTORY = 9
    REMOVE_DIRECTORY = 10
    OPEN_FILE_WO = 11
    TRUNCATE_FILE = 12
    RENAME = 13
    CALC_FILE_CRC32 = 14
    BURST_READ_FILE = 15
    ACK = 128
    NAK = 129


class FtpError(IntEnum):
    """MAV_FTP_ERR."""

    NONE = 0
    FAIL = 1
    FAIL_ERRNO = 2
    INVALID_DATA_SIZE = 3
    INVALID_SESSION = 4
    NO_SESSIONS_AVAILABLE = 5
    EOF = 6
    UNKNOWN_COMMAND = 7
    FILE_EXISTS = 8
    FILE_PROTECTED = 9
    FILE_NOT_FOUND = 10


class FtpPayload(NamedTuple):
    """The payload field of FILE_TRANSFER_PROTOCOL."""

    sequence: int = 0
    session: int = 0
    opcode: int = 0
    size: int = 0
    """As sent. Of a read request the bytes wanted, else those of `data`."""
    requested_opcode: int = 0
    burst_complete: int = 0
    offset: int = 0
    data: bytes = b""
    """Up to 239 bytes."""

    def encode(self) -> bytes:
        """251 bytes. Raises `ValueError` where data does not fit, `struct.error` where a number does not."""
        if len(self.data) > DATA_BYTES:
            raise ValueError(f"{len(self.data)} bytes of data, at most {DATA_BYTES} fit")
        return (_HEADER.pack(*self[:7]) + self.data).ljust(PAYLOAD_BYTES, b"\0")

    @classmethod
    def decode(cls, payload: bytes) -> FtpPayload | None:
        """None where not even a header is there. `data` is cut to what there is room for, `size` stays as sent."""
        if len(payload) < _HEADER.size:
            return None
        sequence, session, opcode, size, requested_opcode, burst_complete, offset = _HEADER.unpack_from(payload)
        data = payload[_HEADER.size : _HEADER.size + min(size, DATA_BYTES)]
        return cls(sequence, session, opcode, size, requested_opcode, burst_complete, offset, data)


def crc32(data: bytes, before: int = 0) -> int:
    """The CRC of CalcFileCRC32 and of component metadata: polynomial 0xEDB88320, from 0, nothing inverted."""
    return zlib.crc32(data, before ^ 0xFFFFFFFF) ^ 0xFFFFFFFF


def _payload_of(message: Message) -> FtpPayload | None:
    try:
        return FtpPayload.decode(bytes(message.payload))
    except (TypeError, ValueError):
        return None


def _message(payload: FtpPayload, target: Peer) -> Message:
    return mavlink.MAVLink_file_transfer_protocol_message(0, *target, payload.encode())


# ---------------------------------------------------------------------------------------------------------- server


class _Refusal(Exception):
    def __init__(self, error: FtpError, number: int = 0) -> None:
        self.error = error
        self.number = number


_BY_ERRNO = {
    errno.ENOENT: FtpError.FILE_NOT_FOUND,
    errno.ENOTDIR: FtpError.FILE_NOT_FOUND,
    errno.EEXIST: FtpError.FILE_EXISTS,
    errno.EACCES: FtpError.FILE_PROTECTED,
    errno.EPERM: FtpError.FILE_PROTECTED,
    errno.EROFS: FtpError.FILE_PROTECTED,
    errno.ELOOP: FtpError.FILE_PROTECTED,
}


def _refusal(error: OSError) -> _Refusal:
    number = error.errno or errno.EIO
    code = _BY_ERRNO.get(number, FtpError.FAIL_ERRNO)
    return _Refusal(code, number & 0xFF)


@dataclass(slots=True)
class _Session:
    path: FilePath
    opcode: int
    file: Reader | Writer
    reader: Reader | None
    writer: Writer | None
    used_us: int
    touched: bool = False
    """Something was read or written since it was opened."""
    spoilt: bool = False
    """A write failed: what came in is not worth keeping."""
    pieces: Gaps | None = None
    """What was not written yet; None where nobody counts any more."""
    burst: _Burst | None = None

    def finish(self) -> None:
        """Close it; what was written takes its place. Raises `OSError`."""
        if self.reader is not None:
            self.reader.close()
        elif self.writer is not None and not self.spoilt:
            self.writer.commit()
        else:
            self.abandon()

    def leave(self) -> None:
        """Close it without its owner. An upload without a hole is kept, for its owner may think it done: pymavlink
        asks once for the end and does not look whether that arrived.
        """
        with suppress(OSError):
            if self.writer is None or (self.pieces and next(iter(self.pieces))[0] >= self.writer.size_bytes):
                self.finish()
            else:
                self.abandon()

    def abandon(self) -> None:
        if self.reader is not None:
            self.reader.close()
        if self.writer is not None:
            self.writer.abandon()


@dataclass(slots=True)
class _Burst:
    request: FtpPayload
    sequence: int
    offset: int
    packet_bytes: int
    packets: int = 0


@dataclass(slots=True)
class _Checksum:
    """A CRC on its way: a long file takes several steps."""

    request: FtpPayload
    reader: Reader
    value: int = 0
    offset: int = 0


@dataclass(slots=True)
class _Client:
    """What is kept of one peer."""

    sessions: dict[int, _Session] = field(default_factory=dict)
    answers: OrderedDict[int, tuple[FtpPayload, FtpPayload, int]] = field(default_factory=OrderedDict)
    """By sequence number: request, reply, time us of the last request."""
    last: int = -1
    """Sequence number of the last answer."""
    listing: tuple[FilePath, list[Entry]] | None = None
    checksum: _Checksum | None = None

    @property
    def busy(self) -> bool:
        return bool(self.sessions) or self.checksum is not None


_READ_ONLY = frozenset({Opcode.NONE, Opcode.LIST_DIRECTORY, Opcode.READ_FILE, Opcode.CALC_FILE_CRC32})
_IN_SESSION = frozenset(
    {Opcode.OPEN_FILE_RO, Opcode.OPEN_FILE_WO, Opcode.CREATE_FILE, Opcode.READ_FILE, Opcode.WRITE_FILE}
)
_NEVER_KEPT = frozenset({Opcode.RESET_SESSIONS, Opcode.BURST_READ_FILE})


class FtpServer:
    """Serves a `FileTree` on one link.

    Each request gets one reply at once; bursts and the CRC of long files come from `step`. Everything is bounded:
    peers, sessions, kept replies, packets of a burst and packets of a step.
    """

    MAX_PEERS = 16
    MAX_SESSIONS = 8
    """of all peers together"""
    IDLE_US = 10_000_000
    """A session that nobody used for so long is closed (PX4: 10 s); an upload with holes in it is dropped then."""
    STALE_US = 3_000_000
    """From then on its owner can open another file with the same number: it has lost track of the first."""
    MEMORY_US = 3_000_000
    MAX_ANSWERS = 16
    MAX_PIECES = 256
    """An upload in more pieces than these at a time has holes for good."""
    BURST_PACKETS = 146
    """Packets of one burst, 35 kB, as PX4: the client asks for the next one, so it is never more than this behind."""
    MAX_PACKETS_PER_STEP = 16
    CRC_BYTES_PER_STEP = 256 * 1024

    def __init__(self, tree: FileTree, packets_per_s: float = 1000.0) -> None:
        """`packets_per_s` is the pace of bursts, all of them together."""
        self._tree = tree
        self._packets_per_s = packets_per_s
        self._credit = 0.0
        self._step_us: int | None = None
        self._clients: OrderedDict[Peer, _Client] = OrderedDict()
        self._turn: deque[tuple[Peer, int]] = deque()
        """(peer, session) of the bursts that are on, next one first."""
        self._handlers: dict[int, Callable[[_Client, Peer, FtpPayload, int], bytes | None]] = {
            Opcode.NONE: self._none,
            Opcode.TERMINATE_SESSION: self._terminate,
            Opcode.RESET_SESSIONS: self._reset,
            Opcode.LIST_DIRECTORY: self._list,
            Opcode.OPEN_FILE_RO: self._open,
            Opcode.READ_FILE: self._read,
            Opcode.CREATE_FILE: self._open,
            Opcode.WRITE_FILE: self._write,
            Opcode.REMOVE_FILE: self._remove,
            Opcode.CREATE_DIRECTORY: self._make_directory,
            Opcode.REMOVE_DIRECTORY: self._remove_directory,
            Opcode.OPEN_FILE_WO: self._open,
            Opcode.TRUNCATE_FILE: self._truncate,
            Opcode.RENAME: self._rename,
            Opcode.CALC_FILE_CRC32: self._checksum,
            Opcode.BURST_READ_FILE: self._burst,
        }

    @property
    def open_sessions(self) -> int:
        return sum(len(client.sessions) for client in self._clients.values())

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        if type(message).id != mavlink.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL:
            return NOTHING
        request = _payload_of(message)
        # The answers of another server are not for us; a refusal would be refused in turn, for ever.
        if request is None or request.opcode in (Opcode.ACK, Opcode.NAK):
            return NOTHING
        client = self._client(sender)
        reply = self._recall(client, request, now_us)
        if reply is None:
            if client.last >= 0 and (request.sequence - client.last - 1) & 0xFFFF >= 0x8000:
                client.answers.clear()  # it counts from the beginning: what it asked after this was another time
            reply = self._answer(client, sender, request, now_us)
            if reply is None:
                return NOTHING
            self._keep(client, request, reply, now_us)
        return (_message(reply, sender),)

    def step(self, now_us: int) -> Sequence[Message]:
        elapsed_us = 0 if self._step_us is None else max(0, now_us - self._step_us)
        self._step_us = now_us
        self._credit = min(self.MAX_PACKETS_PER_STEP, self._credit + elapsed_us * 1e-6 * self._packets_per_s)
        if not self._clients:
            return NOTHING
        self._close_idle(now_us)
        messages = self._finished_checksums(now_us)
        while self._turn and self._credit >= 1.0:
            peer, number = self._turn.popleft()
            session = self._clients[peer].sessions.get(number) if peer in self._clients else None
            if session is None or session.burst is None:
                continue
            self._credit -= 1.0
            messages.append(_message(self._burst_packet(session, session.burst), peer))
            if session.burst is not None:
                self._turn.append((peer, number))
        return messages or NOTHING

    def close(self) -> None:
        """Close every file; uploads with holes are dropped."""
        for client in self._clients.values():
            self._release(client)
        self._clients.clear()
        self._turn.clear()

    # -- peers and repeats

    def _client(self, peer: Peer) -> _Client:
        """What is kept of a peer; nothing lasting for one too many."""
        client = self._clients.get(peer)
        if client is None:
            client = _Client()
            if len(self._clients) >= self.MAX_PEERS:
                unused = next((other for other, known in self._clients.items() if not known.busy), None)
                if unused is None:
                    return client
                del self._clients[unused]
            self._clients[peer] = client
        self._clients.move_to_end(peer)
        return client

    def _recall(self, client: _Client, request: FtpPayload, now_us: int) -> FtpPayload | None:
        known = client.answers.get(request.sequence)
        if known is None or request.opcode in _NEVER_KEPT:
            return None
        asked, reply, then_us = known
        if asked != request:
            client.answers.clear()
            return None
        if now_us - then_us >= self.MEMORY_US:
            return None
        # What only reads is repeated for a lost reply, and that is the last one; else it is a new question.
        if request.opcode in _READ_ONLY and client.last != request.sequence:
            return None
        client.answers[request.sequence] = (asked, reply, now_us)
        return reply

    def _keep(self, client: _Client, request: FtpPayload, reply: FtpPayload, now_us: int) -> None:
        # MAVSDK asks again with the same number when it finds no session, and hopes for another answer.
        no_session = reply.opcode == Opcode.NAK and reply.data[0] == FtpError.NO_SESSIONS_AVAILABLE
        if request.opcode in _NEVER_KEPT or no_session:
            return
        client.answers[request.sequence] = (request, reply, now_us)
        client.answers.move_to_end(request.sequence)
        client.last = request.sequence
        if len(client.answers) > self.MAX_ANSWERS:
            client.answers.popitem(last=False)

    def _answer(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> FtpPayload | None:
        try:
            if request.size > DATA_BYTES:
                raise _Refusal(FtpError.INVALID_DATA_SIZE)
            handler = self._handlers.get(request.opcode)
            if handler is None:
                raise _Refusal(FtpError.UNKNOWN_COMMAND)
            data = handler(client, peer, request, now_us)
        except OSError as error:
            return self._refused(request, _refusal(error))
        except _Refusal as refusal:
            return self._refused(request, refusal)
        return None if data is None else self._acknowledged(request, data)

    @staticmethod
    def _acknowledged(request: FtpPayload, data: bytes) -> FtpPayload:
        sequence = (request.sequence + 1) & 0xFFFF
        return FtpPayload(sequence, request.session, Opcode.ACK, len(data), request.opcode, 0, request.offset, data)

    @staticmethod
    def _refused(request: FtpPayload, refusal: _Refusal) -> FtpPayload:
        data = bytes((refusal.error,))
        if refusal.error == FtpError.FAIL_ERRNO:
            data += bytes((refusal.number,))
        return FtpServer._acknowledged(request, data)._replace(opcode=Opcode.NAK)

    # -- sessions

    def _session(self, client: _Client, request: FtpPayload, now_us: int) -> _Session:
        session = client.sessions.get(request.session)
        if session is None:
            raise _Refusal(FtpError.INVALID_SESSION)
        session.used_us = now_us
        return session

    def _forget(self, client: _Client, number: int) -> None:
        """A closed session's replies mean nothing any more; a repeat of its opening opens anew."""
        for sequence, (asked, _, _) in list(client.answers.items()):
            if asked.session == number and asked.opcode in _IN_SESSION:
                del client.answers[sequence]

    def _release(self, client: _Client) -> None:
        for session in client.sessions.values():
            session.leave()
        client.sessions.clear()
        if client.checksum is not None:
            client.checksum.reader.close()
            client.checksum = None

    def _close_idle(self, now_us: int) -> None:
        for client in self._clients.values():
            for number, session in list(client.sessions.items()):
                if now_us - session.used_us >= self.IDLE_US:
                    del client.sessions[number]
                    self._forget(client, number)
                    session.leave()

    def _none(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> bytes:
        return b""

    def _terminate(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> bytes:
        session = self._session(client, request, now_us)
        del client.sessions[request.session]
        self._forget(client, request.session)
        session.finish()
        return b""

    def _reset(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> bytes:
        sessions = list(client.sessions.values())
        client.sessions.clear()
        client.answers.clear()
        client.listing = None
        failure: OSError | None = None
        for session in sessions:
            try:
                session.finish()
            except OSError as error:
                failure = error
        self._release(client)
        if failure is not None:
            raise failure
        return b""

    def _open(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> bytes:
        path = parse_path(request.data)
        old = client.sessions.get(request.session)
        if old is not None:
            if not old.touched and old.path == path and old.opcode == request.opcode:
                old.used_us = now_us
                return _U32.pack(min(old.file.size_bytes, 0xFFFFFFFF))
            if now_us - old.used_us < self.STALE_US:
                raise _Refusal(FtpError.NO_SESSIONS_AVAILABLE)
            del client.sessions[request.session]
            self._forget(client, request.session)
            old.leave()
        if self._clients.get(peer) is not client or self.open_sessions >= self.MAX_SESSIONS:
            raise _Refusal(FtpError.NO_SESSIONS_AVAILABLE)
        if request.opcode == Opcode.OPEN_FILE_RO:
            reader = self._tree.open_read(path)
            session = _Session(path, request.opcode, reader, reader, None, now_us)
        else:
            writer = self._tree.open_write(path, truncate=request.opcode == Opcode.CREATE_FILE)
            pieces = Gaps(1 << 33)
            pieces.fill(0, writer.size_bytes)
            session = _Session(path, request.opcode, writer, None, writer, now_us, pieces=pieces)
        client.sessions[request.session] = session
        return _U32.pack(min(session.file.size_bytes, 0xFFFFFFFF))

    def _reader(self, client: _Client, request: FtpPayload, now_us: int) -> tuple[_Session, Reader]:
        session = self._session(client, request, now_us)
        if session.reader is None:
            raise _Refusal(FtpError.FAIL_ERRNO, errno.EBADF)
        if request.offset >= session.reader.size_bytes:
            raise _Refusal(FtpError.EOF)
        session.touched = True
        return session, session.reader

    def _read(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> bytes:
        _, reader = self._reader(client, request, now_us)
        data = reader.read(request.offset, request.size)
        if request.size and not data:
            raise _Refusal(FtpError.EOF)  # it was longer when it was opened
        return data

    def _write(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> bytes:
        session = self._session(client, request, now_us)
        if session.writer is None:
            raise _Refusal(FtpError.FILE_PROTECTED)
        session.touched = True
        try:
            session.writer.write(request.offset, request.data)
        except OSError:
            session.spoilt = True
            raise
        if session.pieces is not None:
            session.pieces.fill(request.offset, request.offset + len(request.data))
            if len(session.pieces) > self.MAX_PIECES:
                session.pieces = None
        return _U32.pack(len(request.data))

    def _burst(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> None:
        session, _ = self._reader(client, request, now_us)
        packet_bytes = request.size or DATA_BYTES
        session.burst = _Burst(request, (request.sequence + 1) & 0xFFFF, request.offset, packet_bytes)
        if (peer, request.session) not in self._turn:
            self._turn.append((peer, request.session))

    def _burst_packet(self, session: _Session, burst: _Burst) -> FtpPayload:
        """The next packet; the last one ends the burst."""
        assert session.reader is not None
        request = burst.request._replace(sequence=burst.sequence - 1, offset=burst.offset)
        refusal: _Refusal | None = None
        try:
            data = session.reader.read(burst.offset, burst.packet_bytes)
            if not data:
                refusal = _Refusal(FtpError.EOF)
        except OSError as error:
            refusal = _refusal(error)
        if refusal is not None:
            session.burst = None
            return self._refused(request, refusal)
        burst.packets += 1
        burst.offset += len(data)
        burst.sequence = (burst.sequence + 1) & 0xFFFF
        reply = self._acknowledged(request, data)
        if burst.offset < session.reader.size_bytes and burst.packets < self.BURST_PACKETS:
            return reply
        session.burst = None
        if burst.packets == 2:
            # MAVSDK's next request is answered with this very number, and MAVSDK drops what has the number of the
            # message before. One further on is as good.
            reply = reply._replace(sequence=burst.sequence)
        return reply._replace(burst_complete=1)

    # -- files

    def _list(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> bytes:
        path = parse_path(request.data)
        # Offsets count entries, so all parts of a listing must be parts of the same one.
        if request.offset == 0 or client.listing is None or client.listing[0] != path:
            client.listing = (path, self._tree.entries(path))
        entries = client.listing[1]
        data = b""
        for entry in entries[request.offset : request.offset + DATA_BYTES]:
            line = f"D{entry.name}" if entry.is_directory else f"F{entry.name}\t{entry.size_bytes}"
            record = line.encode("ascii") + b"\0"
            if len(record) > DATA_BYTES:
                record = b"S\0"  # too long to be named; it still counts
            if len(data) + len(record) > DATA_BYTES:
                break
            data += record
        if not data:
            client.listing = None
            raise _Refusal(FtpError.EOF)
        return data

    def _remove(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> bytes:
        self._tree.remove(parse_path(request.data))
        return b""

    def _make_directory(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> bytes:
        self._tree.make_directory(parse_path(request.data))
        return b""

    def _remove_directory(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> bytes:
        self._tree.remove_directory(parse_path(request.data))
        return b""

    def _truncate(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> bytes:
        self._tree.truncate(parse_path(request.data), request.offset)
        return b""

    def _rename(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> bytes:
        old, separator, new = request.data.partition(b"\0")
        if not separator or not new.strip(b"\0"):
            raise _Refusal(FtpError.FAIL_ERRNO, errno.EINVAL)
        self._tree.rename(parse_path(old), parse_path(new))
        return b""

    def _checksum(self, client: _Client, peer: Peer, request: FtpPayload, now_us: int) -> bytes | None:
        path = parse_path(request.data)
        if client.checksum is not None:
            if client.checksum.request == request:
                return None  # a repeat; its answer is being made
            client.checksum.reader.close()
            client.checksum = None
        checksum = _Checksum(request, self._tree.open_read(path))
        lasting = self._clients.get(peer) is client
        done = False
        try:
            done = self._advance(checksum)
        finally:
            if done or not lasting:
                checksum.reader.close()
            else:
                client.checksum = checksum
        if not done and not lasting:
            raise _Refusal(FtpError.NO_SESSIONS_AVAILABLE)
        return _U32.pack(checksum.value) if done else None

    def _advance(self, checksum: _Checksum) -> bool:
        """One step's worth; whether that was all. Raises `OSError`."""
        data = checksum.reader.read(checksum.offset, self.CRC_BYTES_PER_STEP)
        checksum.value = crc32(data, checksum.value)
        checksum.offset += len(data)
        return not data or checksum.offset >= checksum.reader.size_bytes

    def _finished_checksums(self, now_us: int) -> list[Message]:
        messages = []
        for peer, client in self._clients.items():
            checksum = client.checksum
            if checksum is None:
                continue
            try:
                if not self._advance(checksum):
                    break  # one file per step
                reply = self._acknowledged(checksum.request, _U32.pack(checksum.value))
            except OSError as error:
                reply = self._refused(checksum.request, _refusal(error))
            checksum.reader.close()
            client.checksum = None
            self._keep(client, checksum.request, reply, now_us)
            messages.append(_message(reply, peer))
        return messages


# ---------------------------------------------------------------------------------------------------------- client


@dataclass(slots=True)
class FtpResult:
    """What became of an operation."""

    error: FtpError = FtpError.NONE
    errno: int = 0
    """With FAIL_ERRNO: the vehicle's."""
    timed_out: bool = False
    entries: tuple[Entry, ...] = ()
    """Of `list`."""
    data: bytes = b""
    """Of `download`."""
    crc32: int | None = None

    @property
    def ok(self) -> bool:
        return self.error == FtpError.NONE and not self.timed_out


@dataclass(slots=True)
class _Asked:
    """A request that waits for its reply."""

    payload: FtpPayload
    sent_us: int
    due_us: int
    tries: int = 1


class _Stop(Exception):
    """An operation has ended."""

    def __init__(self, result: FtpResult) -> None:
        self.result = result


class FtpClient:
    """Asks a vehicle for files: one operation at a time, begun by its method and done when `result` is there.

    Requests are repeated with their sequence number until answered, the time to wait learned from the answers.
    Downloads come in bursts whose gaps are read afterwards, several at once.
    """

    FIRST_TIMEOUT_US = 500_000
    MIN_TIMEOUT_US = 60_000
    MAX_TIMEOUT_US = 1_000_000
    WINDOW = 16
    """Requests on their way at once, where their order does not matter."""
    MAX_ENTRIES = 10_000

    def __init__(self, target: Peer = (1, 1), tries: int = 15, limit_bytes: int = 256 * 1024 * 1024) -> None:
        """`tries` in a row without an answer end an operation, `limit_bytes` is the longest file it downloads."""
        self._target = target
        self._tries = tries
        self._limit_bytes = limit_bytes
        self._sequence = 0
        self._timeout_us: float | None = None
        self._asked: dict[int, _Asked] = {}
        self._out: list[Message] = []
        self._operation: _Operation | None = None
        self.result: FtpResult | None = None
        """Of the last operation; None before the first one ends and while one is on."""

    @property
    def busy(self) -> bool:
        return self._operation is not None

    @property
    def progress(self) -> float:
        """Of a transfer, from 0 to 1."""
        return self._operation.progress if self._operation is not None else float(self.result is not None)

    def list(self, path: str) -> None:
        """What is in a directory: `FtpResult.entries`."""
        self._begin(_List(self, _name(path)))

    def download(self, path: str) -> None:
        """A file: `FtpResult.data`."""
        self._begin(_Download(self, _name(path), self._limit_bytes))

    def upload(self, path: str, data: bytes) -> None:
        """Put `data` into a file; one that is there is replaced."""
        self._begin(_Upload(self, _name(path), data))

    def remove(self, path: str) -> None:
        self._begin(_Single(self, Opcode.REMOVE_FILE, _name(path)))

    def rename(self, old: str, new: str) -> None:
        self._begin(_Single(self, Opcode.RENAME, _name(old) + b"\0" + _name(new)))

    def make_directory(self, path: str) -> None:
        self._begin(_Single(self, Opcode.CREATE_DIRECTORY, _name(path)))

    def remove_directory(self, path: str) -> None:
        self._begin(_Single(self, Opcode.REMOVE_DIRECTORY, _name(path)))

    def truncate(self, path: str, size_bytes: int) -> None:
        self._begin(_Single(self, Opcode.TRUNCATE_FILE, _name(path), size_bytes))

    def crc32(self, path: str) -> None:
        """The checksum of a file as the vehicle has it: `FtpResult.crc32`; compare with `crc32` of this module."""
        self._begin(_Single(self, Opcode.CALC_FILE_CRC32, _name(path)))

    def cancel(self) -> None:
        """Stop; the vehicle closes what is open by itself."""
        self._operation = None
        self._asked.clear()

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        if (
            self._operation is None
            or type(message).id != mavlink.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL
            or sender != self._target
        ):
            return NOTHING
        reply = _payload_of(message)
        if reply is None or reply.opcode not in (Opcode.ACK, Opcode.NAK) or reply.size > DATA_BYTES:
            return NOTHING
        try:
            if reply.requested_opcode == Opcode.BURST_READ_FILE:
                self._operation.burst(reply, now_us)
            else:
                asked = self._asked.get((reply.sequence - 1) & 0xFFFF)
                if asked is None or asked.payload.opcode != reply.requested_opcode:
                    return NOTHING
                del self._asked[asked.payload.sequence]
                if asked.tries == 1:
                    self.learn(now_us - asked.sent_us)
                self._operation.answer(asked.payload, reply, now_us)
        except _Stop as stop:
            self._end(stop.result)
        return self._take()

    def step(self, now_us: int) -> Sequence[Message]:
        if self._operation is None:
            return NOTHING
        try:
            if not self._operation.begun:
                self._operation.begun = True
                self._operation.begin(now_us)
            for asked in list(self._asked.values()):
                if now_us < asked.due_us:
                    continue
                if asked.tries >= self._tries:
                    raise _Stop(FtpResult(timed_out=True))
                asked.due_us = now_us + min(self.timeout_us << min(asked.tries, 6), self.MAX_TIMEOUT_US)
                asked.tries += 1
                self._out.append(_message(asked.payload, self._target))
            self._operation.step(now_us)
        except _Stop as stop:
            self._end(stop.result)
        return self._take()

    @property
    def timeout_us(self) -> int:
        """How long to wait for an answer by what is known of the link."""
        if self._timeout_us is None:
            return self.FIRST_TIMEOUT_US
        return int(min(max(self._timeout_us, self.MIN_TIMEOUT_US), self.MAX_TIMEOUT_US))

    def learn(self, round_trip_us: int) -> None:
        """An answer took so long."""
        sample_us = 4.0 * round_trip_us
        self._timeout_us = sample_us if self._timeout_us is None else 0.875 * self._timeout_us + 0.125 * sample_us

    @property
    def tries(self) -> int:
        return self._tries

    @property
    def waiting(self) -> Iterator[FtpPayload]:
        """Requests without an answer."""
        return (asked.payload for asked in self._asked.values())

    def ask(self, opcode: int, now_us: int, *, offset: int = 0, data: bytes = b"", size: int | None = None) -> None:
        """Send a request. For operations; not of use from outside."""
        length = len(data) if size is None else size
        payload = FtpPayload(self._sequence, 0, opcode, length, 0, 0, offset, data)
        self._sequence = (self._sequence + 1) & 0xFFFF
        if opcode != Opcode.BURST_READ_FILE:
            self._asked[payload.sequence] = _Asked(payload, now_us, now_us + self.timeout_us)
        self._out.append(_message(payload, self._target))

    def _begin(self, operation: _Operation) -> None:
        if self._operation is not None:
            raise RuntimeError("another operation is on")
        self._operation, self.result = operation, None

    def _end(self, result: FtpResult) -> None:
        self._operation, self.result = None, result
        self._asked.clear()

    def _take(self) -> Sequence[Message]:
        out, self._out = self._out, []
        return out or NOTHING


def _name(path: str) -> bytes:
    data = path.encode()
    if not data or len(data) > DATA_BYTES or b"\0" in data:
        raise ValueError(f"no path for MAVLink FTP: {path!r}")
    return data


def _failure(reply: FtpPayload) -> FtpResult:
    code = reply.data[0] if reply.data else FtpError.FAIL
    number = reply.data[1] if len(reply.data) > 1 else 0
    return FtpResult(FtpError(code) if code in tuple(FtpError)[1:] else FtpError.FAIL, number)


class _Operation:
    def __init__(self, client: FtpClient) -> None:
        self.client = client
        self.begun = False

    @property
    def progress(self) -> float:
        return 0.0

    def begin(self, now_us: int) -> None:
        raise NotImplementedError

    def answer(self, asked: FtpPayload, reply: FtpPayload, now_us: int) -> None:
        raise NotImplementedError

    def burst(self, reply: FtpPayload, now_us: int) -> None:
        """A packet of a burst; nobody else than a download waits for one."""

    def step(self, now_us: int) -> None:
        """Called with every step of the client."""


class _Single(_Operation):
    """One question, one answer."""

    def __init__(self, client: FtpClient, opcode: Opcode, data: bytes, offset: int = 0) -> None:
        super().__init__(client)
        if len(data) > DATA_BYTES:
            raise ValueError("the two paths are too long together")
        self._opcode, self._data, self._offset = opcode, data, offset

    def begin(self, now_us: int) -> None:
        self.client.ask(self._opcode, now_us, offset=self._offset, data=self._data)

    def answer(self, asked: FtpPayload, reply: FtpPayload, now_us: int) -> None:
        if reply.opcode == Opcode.NAK:
            raise _Stop(_failure(reply))
        if self._opcode != Opcode.CALC_FILE_CRC32:
            raise _Stop(FtpResult())
        if len(reply.data) != _U32.size:
            raise _Stop(FtpResult(FtpError.INVALID_DATA_SIZE))
        raise _Stop(FtpResult(crc32=_U32.unpack(reply.data)[0]))


class _List(_Operation):
    def __init__(self, client: FtpClient, path: bytes) -> None:
        super().__init__(client)
        self._path = path
        self._counted = 0
        self._entries: list[Entry] = []

    def begin(self, now_us: int) -> None:
        self.client.ask(Opcode.LIST_DIRECTORY, now_us, offset=self._counted, data=self._path)

    def answer(self, asked: FtpPayload, reply: FtpPayload, now_us: int) -> None:
        if reply.opcode == Opcode.NAK:
            result = _failure(reply)
            raise _Stop(FtpResult(entries=tuple(self._entries)) if result.error == FtpError.EOF else result)
        records = [record for record in reply.data.split(b"\0") if record]
        if not records or self._counted + len(records) > self.client.MAX_ENTRIES:
            raise _Stop(FtpResult(FtpError.INVALID_DATA_SIZE))
        self._counted += len(records)
        for record in records:
            kind, text = record[:1], record[1:].decode("utf-8", "replace")
            if kind == b"D":
                self._entries.append(Entry(text, True, 0, 0.0))
            elif kind == b"F":
                name, _, size = text.partition("\t")
                digits = size.split("\t")[0]
                short = digits.isascii() and digits.isdigit() and len(digits) < 20
                self._entries.append(Entry(name, False, int(digits) if short else 0, 0.0))
        self.begin(now_us)


class _Download(_Operation):
    def __init__(self, client: FtpClient, path: bytes, limit_bytes: int) -> None:
        super().__init__(client)
        self._path = path
        self._limit_bytes = limit_bytes
        self._data = bytearray()
        self._gaps = Gaps(0)
        self._reached = 0
        """Behind the last byte that came in a burst."""
        self._bursting = False
        self._asked_us: int | None = None
        self._heard_us = 0
        self._silent = 0

    @property
    def progress(self) -> float:
        return 1.0 - self._gaps.missing_bytes / len(self._data) if self._data else 0.0

    def begin(self, now_us: int) -> None:
        self.client.ask(Opcode.RESET_SESSIONS, now_us)

    def answer(self, asked: FtpPayload, reply: FtpPayload, now_us: int) -> None:
        if asked.opcode == Opcode.TERMINATE_SESSION:
            raise _Stop(FtpResult(data=bytes(self._data)))  # the file is here, whatever the vehicle says
        if reply.opcode == Opcode.NAK:
            raise _Stop(_failure(reply))
        if asked.opcode == Opcode.RESET_SESSIONS:
            self.client.ask(Opcode.OPEN_FILE_RO, now_us, data=self._path)
        elif asked.opcode == Opcode.OPEN_FILE_RO:
            self._open(reply, now_us)
        elif asked.opcode == Opcode.READ_FILE:
            if reply.offset != asked.offset or not 0 < len(reply.data) <= asked.size:
                raise _Stop(FtpResult(FtpError.FAIL))
            self._put(reply.offset, reply.data)
            self._repair(now_us)

    def _open(self, reply: FtpPayload, now_us: int) -> None:
        size_bytes = _U32.unpack(reply.data)[0] if len(reply.data) == _U32.size else -1
        if not 0 <= size_bytes <= self._limit_bytes:
            raise _Stop(FtpResult(FtpError.INVALID_DATA_SIZE))
        self._data = bytearray(size_bytes)
        self._gaps = Gaps(size_bytes)
        self._go_on(now_us)

    def _go_on(self, now_us: int) -> None:
        """The next burst, or what is missing after the last one."""
        if self._reached < len(self._data):
            self._bursting = True
            self._asked_us = self._heard_us = now_us
            self.client.ask(Opcode.BURST_READ_FILE, now_us, offset=self._reached, size=DATA_BYTES)
        else:
            self._bursting = False
            self._repair(now_us)

    def _put(self, offset: int, data: bytes) -> None:
        end = offset + len(data)
        if end <= len(self._data) and self._gaps.fill(offset, end):
            self._data[offset:end] = data

    def _repair(self, now_us: int) -> None:
        """Read what is missing, a window's worth at once."""
        asked = {payload.offset for payload in self.client.waiting}
        room = self.client.WINDOW - len(asked)
        for begin, end in self._gaps:
            for offset in range(begin, end, DATA_BYTES):
                if room <= 0:
                    return
                if offset not in asked:
                    room -= 1
                    self.client.ask(Opcode.READ_FILE, now_us, offset=offset, size=min(DATA_BYTES, end - offset))
        if not self._gaps and not asked:
            self.client.ask(Opcode.TERMINATE_SESSION, now_us)

    def burst(self, reply: FtpPayload, now_us: int) -> None:
        if not self._bursting:
            return
        if reply.opcode == Opcode.NAK:
            failure = _failure(reply)
            if failure.error != FtpError.EOF:
                raise _Stop(failure)
            # PX4 says so after the last packet; if that was lost, it is missing like any other.
            self._reached = len(self._data)
            self._go_on(now_us)
            return
        if self._asked_us is not None and self._silent == 0:
            self.client.learn(now_us - self._asked_us)
        self._asked_us, self._heard_us, self._silent = None, now_us, 0
        end = reply.offset + len(reply.data)
        self._put(reply.offset, reply.data)
        if end <= self._reached or end > len(self._data):
            return  # of an earlier burst, or made up
        self._reached = end
        if reply.burst_complete or end == len(self._data):
            self._go_on(now_us)

    def step(self, now_us: int) -> None:
        # A burst has one request and many replies: its silence is what is to be noticed.
        if self._bursting and now_us - self._heard_us >= self.client.timeout_us << min(self._silent, 3):
            self._silent += 1
            if self._silent >= self.client.tries:
                raise _Stop(FtpResult(timed_out=True))
            self._go_on(now_us)


class _Upload(_Operation):
    def __init__(self, client: FtpClient, path: bytes, data: bytes) -> None:
        super().__init__(client)
        self._path = path
        self._data = data
        self._next = 0
        self._written = 0

    @property
    def progress(self) -> float:
        return self._written / len(self._data) if self._data else 0.0

    def begin(self, now_us: int) -> None:
        self.client.ask(Opcode.RESET_SESSIONS, now_us)

    def answer(self, asked: FtpPayload, reply: FtpPayload, now_us: int) -> None:
        if reply.opcode == Opcode.NAK:
            raise _Stop(_failure(reply))
        if asked.opcode == Opcode.RESET_SESSIONS:
            self.client.ask(Opcode.CREATE_FILE, now_us, data=self._path)
            return
        if asked.opcode == Opcode.TERMINATE_SESSION:
            raise _Stop(FtpResult())
        self._written += len(asked.data) if asked.opcode == Opcode.WRITE_FILE else 0
        pending = sum(1 for _ in self.client.waiting)
        while self._next < len(self._data) and pending < self.client.WINDOW:
            piece = self._data[self._next : self._next + DATA_BYTES]
            self.client.ask(Opcode.WRITE_FILE, now_us, offset=self._next, data=piece)
            self._next += len(piece)
            pending += 1
        if not pending:
            self.client.ask(Opcode.TERMINATE_SESSION, now_us)
