"""MAVLink FTP: the codec, the server by itself, the client against it on good and bad links, and attacks."""

from __future__ import annotations

import errno
import os
import socket
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.services.files import Folder, Gaps, MemoryFiles, Mounts, Quota, parse_path
from mavsitl.services.ftp import (
    DATA_BYTES,
    PAYLOAD_BYTES,
    FtpClient,
    FtpError,
    FtpPayload,
    FtpServer,
    Opcode,
    crc32,
)
from tests.services.lossy import CLIENT, SERVER, LossyLink

OTHER = (250, 191)
STEP_US = 4_000


def content(size: int, seed: int = 1) -> bytes:
    """Bytes without a period that a wrong offset could hide behind."""
    return b"".join(struct.pack("<I", (seed * 2654435761 + n * 40503) & 0xFFFFFFFF) for n in range(size // 4 + 1))[
        :size
    ]


def handles() -> int:
    folder = Path("/proc/self/fd")
    return sum(1 for _ in folder.iterdir()) if folder.is_dir() else 0


class Vehicle:
    """A sandbox, a log folder, metadata; and a server, spoken to without a link."""

    def __init__(self, folder: Path, quota: Quota | None = None) -> None:
        self.outside = folder / "outside"
        self.logs = folder / "logs"
        self.box = folder / "box"
        self.outside.mkdir()
        self.logs.mkdir()
        (self.outside / "secret").write_bytes(b"secret")
        (self.logs / "flight.ulg").write_bytes(content(5000))
        self.sandbox = Folder(self.box, quota or Quota(200_000, 16))
        metadata = MemoryFiles({"extras/general.json": b'{"version":1}', "extras/made.json": lambda: b"made"})
        tree = Mounts(
            {
                "/fs/microsd": self.sandbox,
                "/fs/microsd/log": Folder(self.logs),
                "/log": Folder(self.logs),
                "/etc": metadata,
            }
        )
        self.server = FtpServer(tree)
        self.now_us = 1_000_000
        self.sequence = 100

    def send(self, payload: FtpPayload | bytes, sender: tuple[int, int] = CLIENT) -> list[FtpPayload]:
        """What the server says at once; every message goes through the codec."""
        data = payload if isinstance(payload, bytes) else payload.encode()
        message = mavlink.MAVLink_file_transfer_protocol_message(0, *SERVER, data)
        return self.wire(self.server.receive(message, sender, self.now_us), sender)

    def wire(self, messages: Any, sender: tuple[int, int] = CLIENT) -> list[FtpPayload]:
        replies = []
        for message in messages:
            (frame,) = parse(encode(message, 0, *SERVER))
            assert (frame.message.target_system, frame.message.target_component) == sender
            reply = FtpPayload.decode(bytes(frame.message.payload))
            assert reply is not None
            assert reply.size <= DATA_BYTES
            replies.append(reply)
        return replies

    def ask(
        self,
        opcode: int,
        data: bytes | str = b"",
        offset: int = 0,
        session: int = 0,
        size: int | None = None,
        sender: tuple[int, int] = CLIENT,
    ) -> FtpPayload:
        """A new request and its reply."""
        raw = data.encode() if isinstance(data, str) else data
        self.sequence += 1
        request = FtpPayload(self.sequence, session, opcode, len(raw) if size is None else size, 0, 0, offset, raw)
        (reply,) = self.send(request, sender)
        assert reply.sequence == (self.sequence + 1) & 0xFFFF
        assert (reply.session, reply.requested_opcode) == (session, opcode)
        return reply

    def ok(self, *args: Any, **more: Any) -> bytes:
        reply = self.ask(*args, **more)
        assert reply.opcode == Opcode.ACK, reply
        return reply.data

    def refusal(self, *args: Any, **more: Any) -> tuple[int, ...]:
        """The bytes of a NAK."""
        reply = self.ask(*args, **more)
        assert reply.opcode == Opcode.NAK, reply
        assert reply.size == len(reply.data) == (2 if reply.data[0] == FtpError.FAIL_ERRNO else 1)
        return tuple(reply.data)

    def run(self, seconds: float) -> list[FtpPayload]:
        replies: list[FtpPayload] = []
        for _ in range(round(seconds * 1e6 / STEP_US)):
            self.now_us += STEP_US
            replies += self.wire(self.server.step(self.now_us))
        return replies

    def put(self, path: str, data: bytes) -> None:
        self.ok(Opcode.CREATE_FILE, path)
        for offset in range(0, len(data), DATA_BYTES):
            self.ok(Opcode.WRITE_FILE, data[offset : offset + DATA_BYTES], offset)
        self.ok(Opcode.TERMINATE_SESSION)


@pytest.fixture
def vehicle(tmp_path: Path) -> Iterator[Vehicle]:
    before = handles()
    made = Vehicle(tmp_path)
    yield made
    made.server.close()
    assert handles() == before, "a file is still open"


# ----------------------------------------------------------------------------------------------------------- codec

payloads = st.builds(
    FtpPayload,
    sequence=st.integers(0, 0xFFFF),
    session=st.integers(0, 255),
    opcode=st.integers(0, 255),
    requested_opcode=st.integers(0, 255),
    burst_complete=st.integers(0, 255),
    offset=st.integers(0, 0xFFFFFFFF),
    data=st.binary(max_size=DATA_BYTES),
).map(lambda payload: payload._replace(size=len(payload.data)))


@given(payloads)
def test_a_payload_comes_back(payload: FtpPayload) -> None:
    raw = payload.encode()
    assert len(raw) == PAYLOAD_BYTES
    assert FtpPayload.decode(raw) == payload


def test_layout_on_the_wire() -> None:
    raw = FtpPayload(0x0201, 3, 4, 2, 6, 7, 0x0D0C0B0A, b"xy").encode()
    assert raw[:15] == bytes((1, 2, 3, 4, 2, 6, 7, 0, 0x0A, 0x0B, 0x0C, 0x0D)) + b"xy\0"


@given(st.binary(max_size=300))
def test_anything_is_decoded(raw: bytes) -> None:
    payload = FtpPayload.decode(raw)
    assert (payload is None) == (len(raw) < 12)
    if payload is not None:
        assert len(payload.data) <= min(payload.size, DATA_BYTES)


def test_too_much_data_does_not_fit() -> None:
    with pytest.raises(ValueError, match="240"):
        FtpPayload(data=bytes(240)).encode()


def test_crc_has_no_inversions() -> None:
    """PX4's own crc32part, whose check value for "123456789" is CRC-32/JAMCRC's without the initial ones."""
    assert crc32(b"") == 0
    value = 0
    for byte in b"123456789":
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xEDB88320 if value & 1 else 0)
    assert crc32(b"123456789") == value
    assert crc32(b"6789", crc32(b"12345")) == value


@given(st.integers(0, 60), st.lists(st.tuples(st.integers(0, 60), st.integers(0, 20)), max_size=20))
def test_gaps_are_what_has_not_come(size: int, pieces: list[tuple[int, int]]) -> None:
    gaps, missing = Gaps(size), set(range(size))
    for begin, length in pieces:
        piece = set(range(begin, begin + length))
        assert gaps.fill(begin, begin + length) == bool(piece & missing)
        missing -= piece
        assert {byte for low, high in gaps for byte in range(low, high)} == missing
        assert gaps.missing_bytes == len(missing)
        assert list(gaps) == sorted(gaps)


# ---------------------------------------------------------------------------------------------------------- server


def test_list(vehicle: Vehicle) -> None:
    assert vehicle.ok(Opcode.LIST_DIRECTORY, "/") == b"Detc\0Dfs\0Dlog\0"
    assert vehicle.refusal(Opcode.LIST_DIRECTORY, "/", 3) == (FtpError.EOF,)
    assert vehicle.refusal(Opcode.LIST_DIRECTORY, "/", 0xFFFFFFFF) == (FtpError.EOF,)
    for path in ("/log", "log", "/fs/microsd/log/", "//log/./", "log\0rest"):
        assert vehicle.ok(Opcode.LIST_DIRECTORY, path) == b"Fflight.ulg\t5000\0"
    assert vehicle.ok(Opcode.LIST_DIRECTORY, "/etc/extras") == b"Fgeneral.json\t13\0Fmade.json\t4\0"
    assert vehicle.ok(Opcode.LIST_DIRECTORY, "/fs/microsd") == b"Dlog\0"
    vehicle.ok(Opcode.CREATE_DIRECTORY, "/fs/microsd/empty")
    assert vehicle.refusal(Opcode.LIST_DIRECTORY, "/fs/microsd/empty") == (FtpError.EOF,)
    assert vehicle.refusal(Opcode.LIST_DIRECTORY, "/log/flight.ulg") == (FtpError.FILE_NOT_FOUND,)
    assert vehicle.refusal(Opcode.LIST_DIRECTORY, "/nowhere") == (FtpError.FILE_NOT_FOUND,)


def test_a_long_listing_is_one_listing(vehicle: Vehicle) -> None:
    names = [f"{n:03d}-{'x' * 60}" for n in range(50)]
    for name in names:
        (vehicle.logs / name).write_bytes(b"")
    records: list[bytes] = []
    while True:
        reply = vehicle.ask(Opcode.LIST_DIRECTORY, "/log", len(records))
        if reply.opcode == Opcode.NAK:
            break
        records += reply.data.rstrip(b"\0").split(b"\0")
        (vehicle.logs / "000-0").write_bytes(b"comes in between")
    assert [record.split(b"\t")[0].decode() for record in records] == [f"F{name}" for name in [*names, "flight.ulg"]]


def test_read(vehicle: Vehicle) -> None:
    assert struct.unpack("<I", vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg")) == (5000,)
    assert vehicle.ok(Opcode.READ_FILE, offset=4000, size=100) == content(5000)[4000:4100]
    assert vehicle.ok(Opcode.READ_FILE, offset=4990, size=100) == content(5000)[4990:]
    assert vehicle.refusal(Opcode.READ_FILE, offset=5000, size=1) == (FtpError.EOF,)
    assert vehicle.refusal(Opcode.READ_FILE, offset=0xFFFFFFFF, size=239) == (FtpError.EOF,)
    assert vehicle.ok(Opcode.TERMINATE_SESSION) == b""
    assert vehicle.refusal(Opcode.READ_FILE, size=1) == (FtpError.INVALID_SESSION,)
    assert vehicle.refusal(Opcode.TERMINATE_SESSION) == (FtpError.INVALID_SESSION,)
    vehicle.ok(Opcode.OPEN_FILE_RO, "etc/extras/made.json")
    assert vehicle.ok(Opcode.READ_FILE, size=239) == b"made"


def test_a_file_that_grows_has_the_length_it_was_opened_with(vehicle: Vehicle) -> None:
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg")
    with (vehicle.logs / "flight.ulg").open("ab") as log:
        log.write(b"more")
    assert vehicle.ok(Opcode.READ_FILE, offset=4998, size=10) == content(5000)[4998:]
    assert vehicle.refusal(Opcode.READ_FILE, offset=5000, size=4) == (FtpError.EOF,)
    vehicle.ok(Opcode.RESET_SESSIONS)
    assert struct.unpack("<I", vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg")) == (5004,)


def test_a_file_that_shrinks_ends_early(vehicle: Vehicle) -> None:
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg")
    (vehicle.logs / "flight.ulg").write_bytes(b"short")
    assert vehicle.refusal(Opcode.READ_FILE, offset=100, size=10) == (FtpError.EOF,)
    vehicle.send(FtpPayload(900, 0, Opcode.BURST_READ_FILE, 239))
    replies = vehicle.run(0.1)
    assert [(reply.opcode, reply.data) for reply in replies] == [(Opcode.ACK, b"short"), (Opcode.NAK, b"\6")]


def test_burst(vehicle: Vehicle) -> None:
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg")
    assert vehicle.send(FtpPayload(65530, 0, Opcode.BURST_READ_FILE, 239, offset=239)) == []
    replies = vehicle.run(0.2)
    assert [reply.offset for reply in replies] == list(range(239, 5000, 239))
    assert [reply.sequence for reply in replies] == [(65531 + n) & 0xFFFF for n in range(20)]
    assert [reply.burst_complete for reply in replies] == [0] * 19 + [1]
    assert b"".join(reply.data for reply in replies) == content(5000)[239:]
    assert vehicle.refusal(Opcode.BURST_READ_FILE, offset=5000, size=239) == (FtpError.EOF,)
    assert vehicle.refusal(Opcode.BURST_READ_FILE, session=1, size=239) == (FtpError.INVALID_SESSION,)
    assert vehicle.run(1.0) == []


@pytest.mark.parametrize(("size", "expected"), [(80, 80), (0, 239)])
def test_burst_packets_are_as_long_as_wanted(vehicle: Vehicle, size: int, expected: int) -> None:
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg")
    vehicle.send(FtpPayload(1, 0, Opcode.BURST_READ_FILE, size))
    replies = vehicle.run(0.5)
    assert {len(reply.data) for reply in replies[:-1]} == {expected}
    assert b"".join(reply.data for reply in replies) == content(5000)


def test_a_burst_of_two_leaves_a_number_out(vehicle: Vehicle) -> None:
    """MAVSDK's next request has the burst's number and one more, its reply another: never the last packet's."""
    (vehicle.logs / "two").write_bytes(content(300))
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/two")
    vehicle.send(FtpPayload(1, 0, Opcode.BURST_READ_FILE, 239))
    assert [reply.sequence for reply in vehicle.run(0.1)] == [2, 4]


def test_bursts_are_paced_and_end(vehicle: Vehicle) -> None:
    (vehicle.logs / "big").write_bytes(content(100_000))
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/big")
    vehicle.run(1.0)  # credit is not saved up
    vehicle.send(FtpPayload(1, 0, Opcode.BURST_READ_FILE, 239))
    vehicle.now_us += STEP_US
    assert len(vehicle.server.step(vehicle.now_us)) == FtpServer.MAX_PACKETS_PER_STEP
    first = vehicle.run(0.1)
    assert len(first) == 100
    rest = vehicle.run(1.0)
    assert len(first) + len(rest) + FtpServer.MAX_PACKETS_PER_STEP == FtpServer.BURST_PACKETS
    assert rest[-1].burst_complete == 1


def test_a_repeated_burst_begins_again_and_is_one(vehicle: Vehicle) -> None:
    (vehicle.logs / "big").write_bytes(content(100_000))
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/big")
    for _ in range(5):
        vehicle.send(FtpPayload(7, 0, Opcode.BURST_READ_FILE, 239))
    assert len(vehicle.run(5.0)) == FtpServer.BURST_PACKETS
    vehicle.send(FtpPayload(7, 0, Opcode.BURST_READ_FILE, 239, offset=1000))  # pymavlink: same number, other offset
    assert [(reply.sequence, reply.offset) for reply in vehicle.run(0.01)[:2]] == [(8, 1000), (9, 1239)]


def test_two_bursts_share_the_pace(vehicle: Vehicle) -> None:
    (vehicle.logs / "big").write_bytes(content(100_000))
    for peer in (CLIENT, OTHER):
        vehicle.ok(Opcode.OPEN_FILE_RO, "/log/big", sender=peer)
        vehicle.send(FtpPayload(1, 0, Opcode.BURST_READ_FILE, 239), peer)
    vehicle.now_us += STEP_US
    vehicle.server.step(vehicle.now_us)
    vehicle.now_us += 16_000
    targets = [message.target_system for message in vehicle.server.step(vehicle.now_us)]
    assert sorted(targets) == [CLIENT[0]] * 8 + [OTHER[0]] * 8


def test_write_is_seen_when_it_is_complete(vehicle: Vehicle) -> None:
    (vehicle.box / "file").write_bytes(b"old")
    assert vehicle.ok(Opcode.CREATE_FILE, "/fs/microsd/file") == bytes(4)
    assert vehicle.ok(Opcode.WRITE_FILE, b"new content") == struct.pack("<I", 11)
    assert (vehicle.box / "file").read_bytes() == b"old"
    assert vehicle.ok(Opcode.LIST_DIRECTORY, "/fs/microsd") == b"Ffile\t3\0Dlog\0"
    vehicle.ok(Opcode.TERMINATE_SESSION)
    assert (vehicle.box / "file").read_bytes() == b"new content"
    assert sorted(path.name for path in vehicle.box.iterdir()) == ["file"]


def test_open_for_writing_keeps_what_is_there(vehicle: Vehicle) -> None:
    (vehicle.box / "file").write_bytes(b"0123456789")
    assert vehicle.ok(Opcode.OPEN_FILE_WO, "/fs/microsd/file") == struct.pack("<I", 10)
    vehicle.ok(Opcode.WRITE_FILE, b"xy", 4)
    vehicle.ok(Opcode.RESET_SESSIONS)  # QGroundControl ends an upload so
    assert (vehicle.box / "file").read_bytes() == b"0123xy6789"


@pytest.mark.parametrize(
    ("writes", "left"),
    [
        ([(0, b"half")], b"half"),
        ([(4, b"second"), (0, b"half")], b"halfsecond"),
        ([(1, b"a hole before")], b"old"),
        ([(0, b"x"), (2, b"a hole between")], b"old"),
        ([(2 * n, b"x") for n in range(300)], b"old"),
    ],
)
def test_an_upload_that_nobody_ends_is_kept_if_it_is_whole(
    vehicle: Vehicle, writes: list[tuple[int, bytes]], left: bytes
) -> None:
    """Its owner had an answer to every write, and the question for the end may be what was lost."""
    (vehicle.box / "file").write_bytes(b"old")
    vehicle.ok(Opcode.CREATE_FILE, "/fs/microsd/file")
    for offset, data in writes:
        vehicle.ok(Opcode.WRITE_FILE, data, offset)
    vehicle.run(10.1)
    assert vehicle.server.open_sessions == 0
    assert vehicle.refusal(Opcode.WRITE_FILE, b"more") == (FtpError.INVALID_SESSION,)
    assert [(path.name, path.read_bytes()) for path in vehicle.box.iterdir()] == [("file", left)]


def test_remains_of_an_earlier_process_are_removed(tmp_path: Path) -> None:
    Folder(tmp_path, Quota()).open_write(("file",), truncate=True)
    assert len(list(tmp_path.iterdir())) == 1
    again = Folder(tmp_path, Quota())
    assert list(tmp_path.iterdir()) == []
    assert again.used == Quota(0, 0)


def test_truncate_rename_remove(vehicle: Vehicle) -> None:
    vehicle.put("/fs/microsd/a", content(1000))
    vehicle.ok(Opcode.TRUNCATE_FILE, "/fs/microsd/a", 600)
    assert (vehicle.box / "a").read_bytes() == content(600)
    vehicle.ok(Opcode.CREATE_DIRECTORY, "/fs/microsd/d")
    vehicle.ok(Opcode.RENAME, "/fs/microsd/a\0/fs/microsd/d/b\0")
    assert (vehicle.box / "d" / "b").read_bytes() == content(600)
    assert vehicle.refusal(Opcode.REMOVE_DIRECTORY, "/fs/microsd/d") == (FtpError.FAIL_ERRNO, errno.ENOTEMPTY)
    vehicle.ok(Opcode.REMOVE_FILE, "/fs/microsd/d/b")
    vehicle.ok(Opcode.REMOVE_DIRECTORY, "/fs/microsd/d")
    assert list(vehicle.box.iterdir()) == []
    assert vehicle.sandbox.used == Quota(0, 0)


def test_checksum(vehicle: Vehicle) -> None:
    assert vehicle.ok(Opcode.CALC_FILE_CRC32, "/log/flight.ulg") == struct.pack("<I", crc32(content(5000)))
    assert vehicle.refusal(Opcode.CALC_FILE_CRC32, "/log/none") == (FtpError.FILE_NOT_FOUND,)


def test_checksum_of_a_long_file_takes_several_steps(vehicle: Vehicle) -> None:
    data = content(1_000_000)
    (vehicle.logs / "big").write_bytes(data)
    request = FtpPayload(5, 0, Opcode.CALC_FILE_CRC32, 8, data=b"/log/big")
    assert vehicle.send(request) == []
    assert vehicle.send(request) == []
    (reply,) = vehicle.run(0.1)
    assert (reply.sequence, reply.data) == (6, struct.pack("<I", crc32(data)))
    assert vehicle.send(request) == [reply]


# ------------------------------------------------------------------------------------------------------ error codes


@pytest.mark.parametrize(
    ("opcode", "data", "expected"),
    [
        (Opcode.OPEN_FILE_RO, "/log/none", (FtpError.FILE_NOT_FOUND,)),
        (Opcode.OPEN_FILE_RO, "/nowhere/at/all", (FtpError.FILE_NOT_FOUND,)),
        (Opcode.OPEN_FILE_RO, "@PARAM/param.pck", (FtpError.FILE_NOT_FOUND,)),
        (Opcode.OPEN_FILE_RO, "@PARAM/param.pck?withdefaults=1", (FtpError.FILE_NOT_FOUND,)),
        (Opcode.OPEN_FILE_RO, "/log/flight.ulg/below", (FtpError.FILE_NOT_FOUND,)),
        (Opcode.OPEN_FILE_RO, "/log", (FtpError.FAIL_ERRNO, errno.EISDIR)),
        (Opcode.OPEN_FILE_RO, "", (FtpError.FAIL_ERRNO, errno.EISDIR)),
        (Opcode.CREATE_FILE, "/fs/microsd/none/file", (FtpError.FILE_NOT_FOUND,)),
        (Opcode.CREATE_FILE, "/fs/microsd/dir", (FtpError.FAIL_ERRNO, errno.EISDIR)),
        (Opcode.CREATE_FILE, "/log/file", (FtpError.FILE_PROTECTED,)),
        (Opcode.CREATE_FILE, "/etc/extras/general.json", (FtpError.FILE_PROTECTED,)),
        (Opcode.CREATE_FILE, "/file", (FtpError.FILE_PROTECTED,)),
        (Opcode.CREATE_FILE, "/fs/microsd", (FtpError.FILE_PROTECTED,)),
        (Opcode.CREATE_FILE, "/fs/microsd/log/file", (FtpError.FILE_PROTECTED,)),
        (Opcode.CREATE_FILE, "/fs/microsd/.mavsitl-upload-0", (FtpError.FILE_PROTECTED,)),
        (Opcode.OPEN_FILE_WO, "/log/flight.ulg", (FtpError.FILE_PROTECTED,)),
        (Opcode.TRUNCATE_FILE, "/log/flight.ulg", (FtpError.FILE_PROTECTED,)),
        (Opcode.TRUNCATE_FILE, "/fs/microsd/none", (FtpError.FILE_NOT_FOUND,)),
        (Opcode.REMOVE_FILE, "/log/flight.ulg", (FtpError.FILE_PROTECTED,)),
        (Opcode.REMOVE_FILE, "/fs/microsd/none", (FtpError.FILE_NOT_FOUND,)),
        (Opcode.REMOVE_FILE, "/fs/microsd/dir", (FtpError.FAIL_ERRNO, errno.EISDIR)),
        (Opcode.CREATE_DIRECTORY, "/fs/microsd/dir", (FtpError.FILE_EXISTS,)),
        (Opcode.CREATE_DIRECTORY, "/fs", (FtpError.FILE_EXISTS,)),
        (Opcode.CREATE_DIRECTORY, "/new", (FtpError.FILE_PROTECTED,)),
        (Opcode.REMOVE_DIRECTORY, "/fs/microsd/log", (FtpError.FILE_PROTECTED,)),
        (Opcode.REMOVE_DIRECTORY, "/fs/microsd/none", (FtpError.FILE_NOT_FOUND,)),
        (Opcode.REMOVE_DIRECTORY, "/log", (FtpError.FILE_PROTECTED,)),
        (Opcode.RENAME, "/fs/microsd/none\0/fs/microsd/new", (FtpError.FILE_NOT_FOUND,)),
        (Opcode.RENAME, "/fs/microsd/dir\0/log/dir", (FtpError.FILE_PROTECTED,)),
        (Opcode.RENAME, "/log/flight.ulg\0/fs/microsd/stolen", (FtpError.FILE_PROTECTED,)),
        (Opcode.RENAME, "/fs/microsd/dir\0/fs/microsd/dir/below", (FtpError.FAIL_ERRNO, errno.EINVAL)),
        (Opcode.RENAME, "/fs/microsd/dir", (FtpError.FAIL_ERRNO, errno.EINVAL)),
        (Opcode.RENAME, "/fs/microsd/dir\0", (FtpError.FAIL_ERRNO, errno.EINVAL)),
        (Opcode.RENAME, "", (FtpError.FAIL_ERRNO, errno.EINVAL)),
        (Opcode.READ_FILE, "", (FtpError.INVALID_SESSION,)),
        (Opcode.WRITE_FILE, "data", (FtpError.INVALID_SESSION,)),
        (16, "/", (FtpError.UNKNOWN_COMMAND,)),
        (127, "", (FtpError.UNKNOWN_COMMAND,)),
        (255, "", (FtpError.UNKNOWN_COMMAND,)),
    ],
)
def test_error_codes(vehicle: Vehicle, opcode: int, data: str, expected: tuple[int, ...]) -> None:
    (vehicle.box / "dir").mkdir()
    assert vehicle.refusal(opcode, data) == expected
    assert [path.name for path in vehicle.box.iterdir()] == ["dir"]
    assert vehicle.server.open_sessions == 0


def test_data_that_does_not_fit_is_an_invalid_size(vehicle: Vehicle) -> None:
    assert vehicle.refusal(Opcode.LIST_DIRECTORY, "/", size=240) == (FtpError.INVALID_DATA_SIZE,)


def test_sessions_are_for_reading_or_for_writing(vehicle: Vehicle) -> None:
    vehicle.put("/fs/microsd/file", b"content")
    vehicle.ok(Opcode.OPEN_FILE_RO, "/fs/microsd/file")
    vehicle.ok(Opcode.LIST_DIRECTORY, "/fs/microsd")
    assert vehicle.refusal(Opcode.WRITE_FILE, b"changed") == (FtpError.FILE_PROTECTED,)
    vehicle.ok(Opcode.CREATE_FILE, "/fs/microsd/other", session=1)
    assert vehicle.refusal(Opcode.READ_FILE, session=1, size=1) == (FtpError.FAIL_ERRNO, errno.EBADF)
    assert vehicle.refusal(Opcode.BURST_READ_FILE, session=1, size=1) == (FtpError.FAIL_ERRNO, errno.EBADF)
    vehicle.ok(Opcode.RESET_SESSIONS)
    assert (vehicle.box / "file").read_bytes() == b"content"


def test_sessions_are_bounded(vehicle: Vehicle) -> None:
    for session in range(FtpServer.MAX_SESSIONS):
        vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg", session=session)
    assert vehicle.refusal(Opcode.OPEN_FILE_RO, "/log/flight.ulg", session=99) == (FtpError.NO_SESSIONS_AVAILABLE,)
    assert vehicle.refusal(Opcode.OPEN_FILE_RO, "/log/flight.ulg", sender=OTHER) == (FtpError.NO_SESSIONS_AVAILABLE,)
    vehicle.ok(Opcode.RESET_SESSIONS)
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg", sender=OTHER)
    assert vehicle.server.open_sessions == 1


def test_a_refused_session_is_tried_anew(vehicle: Vehicle) -> None:
    """MAVSDK repeats the very same request until a session is free."""
    for session in range(FtpServer.MAX_SESSIONS):
        vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg", session=session)
    request = FtpPayload(1, 0, Opcode.OPEN_FILE_RO, 15, data=b"/log/flight.ulg")
    assert vehicle.send(request, OTHER)[0].data == bytes((FtpError.NO_SESSIONS_AVAILABLE,))
    vehicle.ok(Opcode.TERMINATE_SESSION, session=3)
    assert vehicle.send(request, OTHER)[0].opcode == Opcode.ACK


def test_sessions_are_closed_when_nobody_uses_them(vehicle: Vehicle) -> None:
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg")
    vehicle.run(9.0)
    vehicle.ok(Opcode.READ_FILE, size=1)
    vehicle.run(9.0)
    vehicle.ok(Opcode.READ_FILE, size=1)
    vehicle.run(10.1)
    assert vehicle.server.open_sessions == 0
    assert vehicle.refusal(Opcode.READ_FILE, size=1) == (FtpError.INVALID_SESSION,)


def test_another_client_can_not_use_a_session(vehicle: Vehicle) -> None:
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg")
    for opcode in (Opcode.READ_FILE, Opcode.BURST_READ_FILE, Opcode.WRITE_FILE, Opcode.TERMINATE_SESSION):
        assert vehicle.refusal(opcode, size=1, sender=OTHER) == (FtpError.INVALID_SESSION,)
    vehicle.ok(Opcode.RESET_SESSIONS, sender=OTHER)
    assert vehicle.ok(Opcode.READ_FILE, size=3) == content(3)


def test_an_open_that_is_asked_again_is_the_same(vehicle: Vehicle) -> None:
    """QGroundControl repeats with a new number; a forgotten session is replaced once it is stale, not before."""
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg")
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg")
    assert vehicle.server.open_sessions == 1
    vehicle.ok(Opcode.READ_FILE, size=1)
    assert vehicle.refusal(Opcode.OPEN_FILE_RO, "/etc/extras/made.json") == (FtpError.NO_SESSIONS_AVAILABLE,)
    vehicle.run(3.1)
    vehicle.ok(Opcode.OPEN_FILE_RO, "/etc/extras/made.json")
    assert vehicle.ok(Opcode.READ_FILE, size=9) == b"made"
    assert vehicle.server.open_sessions == 1


# ---------------------------------------------------------------------------------------------------------- repeats


def test_a_repeat_gets_the_same_reply_and_is_not_done_twice(vehicle: Vehicle) -> None:
    make = FtpPayload(1, 0, Opcode.CREATE_DIRECTORY, 13, data=b"/fs/microsd/d")
    remove = FtpPayload(2, 0, Opcode.REMOVE_DIRECTORY, 13, data=b"/fs/microsd/d")
    (first,) = vehicle.send(make)
    assert vehicle.send(make) == [first]
    (second,) = vehicle.send(remove)
    assert vehicle.send(make) == [first]  # late
    assert vehicle.send(remove) == [second]
    assert first.opcode == second.opcode == Opcode.ACK
    assert list(vehicle.box.iterdir()) == []
    assert vehicle.send(remove, OTHER)[0].data == bytes((FtpError.FILE_NOT_FOUND,))
    vehicle.run(3.1)
    assert vehicle.send(remove)[0].data == bytes((FtpError.FILE_NOT_FOUND,))


def test_a_client_that_counts_from_zero_every_time_is_understood(vehicle: Vehicle) -> None:
    """MAVSDK: make, remove, make again, each of them number 0; and the same file twice with other content."""
    make = FtpPayload(0, 0, Opcode.CREATE_DIRECTORY, 13, data=b"/fs/microsd/d")
    for _ in range(3):
        assert vehicle.send(make)[0].opcode == Opcode.ACK
        assert (vehicle.box / "d").is_dir()
        assert vehicle.send(make._replace(opcode=Opcode.REMOVE_DIRECTORY))[0].opcode == Opcode.ACK
        assert not (vehicle.box / "d").exists()
    for data in (b"one", b"two", b"two"):
        vehicle.send(FtpPayload(0, 0, Opcode.CREATE_FILE, 13, data=b"/fs/microsd/f"))
        vehicle.send(FtpPayload(1, 0, Opcode.WRITE_FILE, 3, data=data))
        assert vehicle.send(FtpPayload(2, 0, Opcode.TERMINATE_SESSION))[0].opcode == Opcode.ACK
        assert (vehicle.box / "f").read_bytes() == data
        (vehicle.box / "f").unlink()


def test_a_repeated_reset_is_done(vehicle: Vehicle) -> None:
    """A client that starts again begins with number 0, too."""
    reset = FtpPayload(0, 0, Opcode.RESET_SESSIONS)
    vehicle.send(reset)
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg")
    assert vehicle.send(reset)[0].opcode == Opcode.ACK
    assert vehicle.server.open_sessions == 0


def test_what_is_kept_is_bounded(vehicle: Vehicle) -> None:
    request = FtpPayload(0, 0, Opcode.NONE)
    for system in range(1, 251):
        for component in (1, 2, 190):
            for sequence in range(3):
                assert vehicle.send(request._replace(sequence=sequence), (system, component))
    clients = vehicle.server._clients
    assert len(clients) == FtpServer.MAX_PEERS
    for sequence in range(1000):
        vehicle.send(request._replace(sequence=sequence))
    assert len(clients[CLIENT].answers) == FtpServer.MAX_ANSWERS


def test_many_peers_do_not_push_a_session_out(vehicle: Vehicle) -> None:
    vehicle.ok(Opcode.OPEN_FILE_RO, "/log/flight.ulg")
    for system in range(1, 200):
        vehicle.ask(Opcode.LIST_DIRECTORY, "/", sender=(system, 7))
    assert vehicle.ok(Opcode.READ_FILE, size=5) == content(5)


# ---------------------------------------------------------------------------------------------------------- attacks


@pytest.mark.parametrize(
    "path",
    [
        "../outside/secret",
        "/../outside/secret",
        "/log/../../outside/secret",
        "/fs/microsd/../../../outside/secret",
        "/fs/microsd/..",
        "..",
        "/log/./../../outside/secret",
    ],
)
@pytest.mark.parametrize(
    "opcode",
    [
        Opcode.LIST_DIRECTORY,
        Opcode.OPEN_FILE_RO,
        Opcode.OPEN_FILE_WO,
        Opcode.CREATE_FILE,
        Opcode.TRUNCATE_FILE,
        Opcode.REMOVE_FILE,
        Opcode.CREATE_DIRECTORY,
        Opcode.REMOVE_DIRECTORY,
        Opcode.CALC_FILE_CRC32,
    ],
)
def test_no_way_up(vehicle: Vehicle, opcode: Opcode, path: str) -> None:
    assert vehicle.refusal(opcode, path) == (FtpError.FILE_PROTECTED,)
    assert (vehicle.outside / "secret").read_bytes() == b"secret"


def test_no_way_up_by_renaming(vehicle: Vehicle) -> None:
    vehicle.put("/fs/microsd/mine", b"mine")
    for pair in ("/fs/microsd/mine\0/fs/microsd/../../out", "../outside/secret\0/fs/microsd/x"):
        assert vehicle.refusal(Opcode.RENAME, pair) == (FtpError.FILE_PROTECTED,)
    assert (vehicle.box / "mine").exists()


def test_dots_are_names_too(vehicle: Vehicle) -> None:
    vehicle.put("/fs/microsd/..hidden", b"1")
    vehicle.put("/fs/microsd/...", b"2")
    assert {path.name for path in vehicle.box.iterdir()} == {"..hidden", "..."}


def test_absolute_paths_begin_at_the_root_of_the_tree(vehicle: Vehicle) -> None:
    for path in ("/etc/passwd", str(vehicle.outside / "secret"), "//etc//passwd"):
        assert vehicle.refusal(Opcode.OPEN_FILE_RO, path) == (FtpError.FILE_NOT_FOUND,)


@pytest.mark.parametrize("place", ["log", "fs/microsd"])
def test_links_are_not_there(vehicle: Vehicle, place: str) -> None:
    folder = vehicle.logs if place == "log" else vehicle.box
    (folder / "file").symlink_to(vehicle.outside / "secret")
    (folder / "dir").symlink_to(vehicle.outside, target_is_directory=True)
    (folder / "inner").symlink_to("flight.ulg")
    listing = vehicle.ask(Opcode.LIST_DIRECTORY, place).data
    assert not any(name in listing for name in (b"file", b"dir", b"inner"))
    refused = {(FtpError.FILE_PROTECTED,), (FtpError.FILE_NOT_FOUND,), (FtpError.FAIL_ERRNO, errno.ENOTDIR)}
    for name in ("file", "dir", "inner", "dir/secret", "dir/new"):
        for opcode in (
            Opcode.OPEN_FILE_RO, Opcode.CREATE_FILE, Opcode.OPEN_FILE_WO, Opcode.TRUNCATE_FILE, Opcode.REMOVE_FILE,
            Opcode.CALC_FILE_CRC32, Opcode.REMOVE_DIRECTORY,
        ):  # fmt: skip
            assert vehicle.refusal(opcode, f"{place}/{name}") in refused, (name, opcode)
    assert vehicle.refusal(Opcode.LIST_DIRECTORY, f"{place}/dir") in refused
    assert vehicle.refusal(Opcode.RENAME, f"{place}/file\0{place}/moved") in refused
    assert (vehicle.outside / "secret").read_bytes() == b"secret"
    assert [path.name for path in vehicle.outside.iterdir()] == ["secret"]


def test_a_directory_that_becomes_a_link_while_it_is_used_leads_nowhere(vehicle: Vehicle) -> None:
    """The file goes to where the directory went that it was opened in."""
    vehicle.ok(Opcode.CREATE_DIRECTORY, "/fs/microsd/d")
    vehicle.ok(Opcode.CREATE_FILE, "/fs/microsd/d/secret")
    vehicle.ok(Opcode.WRITE_FILE, b"overwritten")
    (vehicle.box / "d").rename(vehicle.box / "moved")
    (vehicle.box / "d").symlink_to(vehicle.outside, target_is_directory=True)
    vehicle.ok(Opcode.TERMINATE_SESSION)
    assert (vehicle.outside / "secret").read_bytes() == b"secret"
    assert (vehicle.box / "moved" / "secret").read_bytes() == b"overwritten"


def test_special_files_are_not_opened(vehicle: Vehicle) -> None:
    os.mkfifo(vehicle.logs / "fifo")
    with socket.socket(socket.AF_UNIX) as unix:
        here = Path.cwd()
        os.chdir(vehicle.logs)  # the names of sockets are short
        try:
            unix.bind("unix")
        finally:
            os.chdir(here)
        for name in ("fifo", "unix"):
            for opcode in (Opcode.OPEN_FILE_RO, Opcode.CALC_FILE_CRC32):
                assert vehicle.refusal(opcode, f"/log/{name}") == (FtpError.FILE_PROTECTED,)
        assert vehicle.ok(Opcode.LIST_DIRECTORY, "/log") == b"Fflight.ulg\t5000\0"


@pytest.mark.parametrize("name", ["a\tb", "a\nb", "\x7f", "\x1b[31m"])
def test_names_that_would_break_a_listing_are_not_made(vehicle: Vehicle, name: str) -> None:
    assert vehicle.refusal(Opcode.CREATE_FILE, f"/fs/microsd/{name}") == (FtpError.FILE_NOT_FOUND,)
    (vehicle.logs / name).write_bytes(b"")
    assert vehicle.ok(Opcode.LIST_DIRECTORY, "/log") == b"Fflight.ulg\t5000\0"


def test_bytes_that_are_no_text_name_nothing(vehicle: Vehicle) -> None:
    assert vehicle.refusal(Opcode.OPEN_FILE_RO, b"/log/\xff\xfe") == (FtpError.FILE_NOT_FOUND,)
    assert vehicle.refusal(Opcode.CREATE_DIRECTORY, "/fs/microsd/\u00e4") == (FtpError.FILE_NOT_FOUND,)


def test_a_name_ends_at_nul(vehicle: Vehicle) -> None:
    vehicle.put("/fs/microsd/name\0.jpg", b"1")
    assert [path.name for path in vehicle.box.iterdir()] == ["name"]


def test_names_too_long_for_a_listing_still_count(vehicle: Vehicle) -> None:
    (vehicle.logs / ("a" * 250)).write_bytes(b"")
    assert vehicle.ok(Opcode.LIST_DIRECTORY, "/log") == b"S\0Fflight.ulg\t5000\0"
    with pytest.raises(OSError, match="too long"):
        parse_path(b"a" * 256)


def test_the_quota_of_bytes(vehicle: Vehicle) -> None:
    full = (FtpError.FAIL_ERRNO, errno.ENOSPC)
    vehicle.ok(Opcode.CREATE_FILE, "/fs/microsd/far")
    assert vehicle.refusal(Opcode.WRITE_FILE, b"x", 0xFFFFFFFF) == full
    assert vehicle.refusal(Opcode.WRITE_FILE, b"x", 200_000) == full
    vehicle.ok(Opcode.TERMINATE_SESSION)  # a spoilt upload leaves nothing
    assert list(vehicle.box.iterdir()) == []
    vehicle.ok(Opcode.CREATE_FILE, "/fs/microsd/far")
    vehicle.ok(Opcode.WRITE_FILE, b"x", 149_999)
    vehicle.ok(Opcode.TERMINATE_SESSION)
    assert vehicle.sandbox.used == Quota(150_000, 1)
    assert vehicle.refusal(Opcode.TRUNCATE_FILE, "/fs/microsd/far", 200_001) == full
    assert vehicle.refusal(Opcode.OPEN_FILE_WO, "/fs/microsd/far") == full  # both versions do not fit
    vehicle.ok(Opcode.TRUNCATE_FILE, "/fs/microsd/far", 10)
    vehicle.put("/fs/microsd/near", content(1000))
    assert vehicle.sandbox.used == Quota(1010, 2)


def test_the_quota_counts_what_is_on_its_way(vehicle: Vehicle) -> None:
    for session in (0, 1):
        vehicle.ok(Opcode.CREATE_FILE, f"/fs/microsd/{session}", session=session)
    vehicle.ok(Opcode.WRITE_FILE, b"x", 120_000, session=0)
    assert vehicle.refusal(Opcode.WRITE_FILE, b"x", 120_000, session=1) == (FtpError.FAIL_ERRNO, errno.ENOSPC)


def test_the_quota_of_files(vehicle: Vehicle) -> None:
    for n in range(15):
        vehicle.ok(Opcode.CREATE_DIRECTORY, f"/fs/microsd/{n}")
    vehicle.put("/fs/microsd/last", b"")
    full = (FtpError.FAIL_ERRNO, errno.ENOSPC)
    assert vehicle.refusal(Opcode.CREATE_DIRECTORY, "/fs/microsd/more") == full
    assert vehicle.refusal(Opcode.CREATE_FILE, "/fs/microsd/more") == full
    vehicle.ok(Opcode.REMOVE_FILE, "/fs/microsd/last")
    vehicle.ok(Opcode.CREATE_DIRECTORY, "/fs/microsd/more")


def test_answers_are_not_answered(vehicle: Vehicle) -> None:
    """Two servers that hear one another would never stop."""
    for opcode in (Opcode.ACK, Opcode.NAK):
        assert vehicle.send(FtpPayload(1, 0, opcode, 1, Opcode.READ_FILE, data=b"\1")) == []


def test_other_messages_are_nobody_s(vehicle: Vehicle) -> None:
    message = mavlink.MAVLink_statustext_message(6, b"text", 110, 0)
    assert not vehicle.server.receive(message, CLIENT, 0)
    assert not FtpClient().receive(message, SERVER, 0)


requests = st.builds(
    lambda header, data: FtpPayload(*header)._replace(data=data),
    st.tuples(
        st.integers(0, 5),
        st.integers(0, 3),
        st.one_of(st.sampled_from(list(Opcode)), st.integers(0, 255)),
        st.one_of(st.integers(0, 60), st.integers(0, 255)),
        st.integers(0, 255),
        st.integers(0, 1),
        st.one_of(st.integers(0, 6000), st.integers(0, 0xFFFFFFFF)),
    ),
    st.one_of(
        st.sampled_from([b"/fs/microsd/a", b"/fs/microsd/d", b"/fs/microsd/a\0/fs/microsd/d/b", b"/log/flight.ulg"]),
        st.lists(st.sampled_from([b"/", b"fs", b"microsd", b"log", b"..", b"a", b"\0", b"\xff"]), max_size=12).map(
            b"".join
        ),
        st.binary(max_size=DATA_BYTES),
    ),
)


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.tuples(requests, st.booleans(), st.integers(0, 4_000_000)), max_size=40))
def test_whatever_comes_is_answered_within_bounds(
    tmp_path_factory: pytest.TempPathFactory, story: list[tuple[FtpPayload, bool, int]]
) -> None:
    before = handles()
    folder = tmp_path_factory.mktemp("ftp")
    vehicle = Vehicle(folder, Quota(20_000, 4))
    (vehicle.box / "a").write_bytes(content(500))
    for payload, other, wait_us in story:
        sender = OTHER if other else CLIENT
        replies = vehicle.send(payload, sender)
        assert len(replies) <= 1
        vehicle.now_us += wait_us
        messages = vehicle.server.step(vehicle.now_us)
        assert len(messages) <= FtpServer.MAX_PACKETS_PER_STEP + FtpServer.MAX_PEERS
        assert vehicle.server.open_sessions <= FtpServer.MAX_SESSIONS
    vehicle.server.close()
    assert handles() == before
    assert (vehicle.outside / "secret").read_bytes() == b"secret"
    assert (vehicle.logs / "flight.ulg").read_bytes() == content(5000)
    assert sorted(path.name for path in folder.iterdir()) == ["box", "logs", "outside"]
    assert sum(path.lstat().st_size for path in vehicle.box.rglob("*") if path.is_file()) <= 20_000


@given(st.binary(min_size=PAYLOAD_BYTES, max_size=PAYLOAD_BYTES), st.integers(0, 0xFFFFFFFF))
@settings(max_examples=60)
def test_a_hostile_server_does_not_break_the_client(raw: bytes, now_us: int) -> None:
    client = FtpClient(SERVER, limit_bytes=1000)
    client.download("/file")
    asked = client.step(now_us)
    for _ in range(4):
        assert len(asked) <= FtpClient.WINDOW
        payload = FtpPayload.decode(raw)
        request = FtpPayload.decode(bytes(asked[0].payload)) if asked else None
        assert payload is not None
        if request is not None:
            fitting = payload._replace(sequence=(request.sequence + 1) & 0xFFFF, requested_opcode=request.opcode)
            raw = fitting._replace(opcode=Opcode.ACK).encode()
        asked = client.receive(mavlink.MAVLink_file_transfer_protocol_message(0, *CLIENT, raw), SERVER, now_us)


# ---------------------------------------------------------------------------------------------- client and server


def run(vehicle: Vehicle, loss: float, seed: int = 1) -> tuple[FtpClient, LossyLink]:
    client = FtpClient(SERVER)
    return client, LossyLink(vehicle.server, client, loss, seed)


def done(link: LossyLink, client: FtpClient, limit_s: float = 120.0) -> float:
    seconds = link.run(lambda: client.result is not None, limit_s)
    assert client.result is not None
    assert not client.busy
    return seconds


@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("size", [0, 1, 239, 240, 478, 30_000, 146 * 239, 100_000])
def test_download(vehicle: Vehicle, size: int, loss: float) -> None:
    (vehicle.logs / "file").write_bytes(content(size))
    client, link = run(vehicle, loss, seed=size + 1)
    client.download("/log/file")
    seconds = done(link, client)
    assert client.result is not None
    assert client.result.ok
    assert client.result.data == content(size)
    assert seconds < (0.1 + size / 150_000 if loss == 0.0 else 4.0 + size / 20_000)
    link.loss = 0.0
    link.run(lambda: vehicle.server.open_sessions == 0, 12.0)


@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("size", [0, 1, 239, 10_000, 50_000])
def test_upload_and_checksum(vehicle: Vehicle, size: int, loss: float) -> None:
    client, link = run(vehicle, loss, seed=size + 2)
    client.upload("/fs/microsd/file", content(size))
    done(link, client)
    assert client.result is not None
    assert client.result.ok
    assert (vehicle.box / "file").read_bytes() == content(size)
    client.crc32("/fs/microsd/file")
    done(link, client)
    assert client.result.crc32 == crc32(content(size))


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_directories_and_files(vehicle: Vehicle, loss: float) -> None:
    client, link = run(vehicle, loss)

    def expect(error: FtpError = FtpError.NONE, number: int = 0) -> None:
        done(link, client)
        assert client.result is not None
        assert (client.result.error, client.result.errno, client.result.timed_out) == (error, number, False)

    for n in range(12):
        client.make_directory(f"/fs/microsd/{'d' * 50}{n}")
        expect()
    client.list("/fs/microsd")
    expect()
    assert client.result is not None
    assert len(client.result.entries) == 13
    assert all(entry.is_directory for entry in client.result.entries)
    client.rename(f"/fs/microsd/{'d' * 50}0", "/fs/microsd/e")
    expect()
    client.upload("/fs/microsd/e/file", b"0123456789")
    expect()
    client.truncate("/fs/microsd/e/file", 5)
    expect()
    client.list("/fs/microsd/e")
    expect()
    assert [(entry.name, entry.size_bytes) for entry in client.result.entries] == [("file", 5)]
    client.remove_directory("/fs/microsd/e")
    expect(FtpError.FAIL_ERRNO, errno.ENOTEMPTY)
    client.remove("/fs/microsd/e/file")
    expect()
    client.remove_directory("/fs/microsd/e")
    expect()
    client.remove("/fs/microsd/e/file")
    expect(FtpError.FILE_NOT_FOUND)
    client.download("/log/../secret")
    expect(FtpError.FILE_PROTECTED)
    client.upload("/log/new", b"x")
    expect(FtpError.FILE_PROTECTED)
    client.upload("/fs/microsd/big", bytes(300_000))
    expect(FtpError.FAIL_ERRNO, errno.ENOSPC)


def test_a_silent_vehicle_is_given_up(vehicle: Vehicle) -> None:
    client, link = run(vehicle, 1.0)
    client.download("/log/flight.ulg")
    done(link, client)
    assert client.result is not None
    assert client.result.timed_out
    assert not client.result.ok


def test_a_silence_in_the_middle_of_a_burst_is_given_up(vehicle: Vehicle) -> None:
    (vehicle.logs / "big").write_bytes(content(100_000))
    client, link = run(vehicle, 0.0)
    client.download("/log/big")
    link.run(lambda: client.progress > 0.2)
    link.loss = 1.0
    done(link, client)
    assert client.result is not None
    assert client.result.timed_out


def test_a_client_that_starts_again_is_served(vehicle: Vehicle) -> None:
    (vehicle.logs / "big").write_bytes(content(100_000))
    client, link = run(vehicle, 0.0)
    client.download("/log/big")
    link.run(lambda: client.progress > 0.3)
    link.client = again = FtpClient(SERVER)
    again.download("/log/flight.ulg")
    done(link, again)
    assert again.result is not None
    assert again.result.data == content(5000)


def test_a_download_from_a_server_that_says_eof_uninvited() -> None:
    """PX4's way; here the packet before it was lost."""
    client = FtpClient(SERVER)
    client.download("/f")

    def say(payload: FtpPayload) -> list[FtpPayload]:
        message = mavlink.MAVLink_file_transfer_protocol_message(0, *CLIENT, payload.encode())
        out = client.receive(message, SERVER, 10_000)
        return [request for sent in out if (request := FtpPayload.decode(bytes(sent.payload)))]

    client.step(0)
    say(FtpPayload(1, 0, Opcode.ACK, 0, Opcode.RESET_SESSIONS))
    (burst,) = say(FtpPayload(2, 0, Opcode.ACK, 4, Opcode.OPEN_FILE_RO, data=struct.pack("<I", 300)))
    assert burst.opcode == Opcode.BURST_READ_FILE
    assert say(FtpPayload(3, 0, Opcode.ACK, 239, Opcode.BURST_READ_FILE, 0, 0, bytes(239))) == []
    (read,) = say(FtpPayload(5, 0, Opcode.NAK, 1, Opcode.BURST_READ_FILE, 0, 300, b"\6"))
    assert (read.opcode, read.offset, read.size) == (Opcode.READ_FILE, 239, 61)
    (end,) = say(FtpPayload(read.sequence + 1, 0, Opcode.ACK, 61, Opcode.READ_FILE, 0, 239, b"x" * 61))
    assert end.opcode == Opcode.TERMINATE_SESSION
    say(FtpPayload(end.sequence + 1, 0, Opcode.ACK, 0, Opcode.TERMINATE_SESSION))
    assert client.result is not None
    assert client.result.data == bytes(239) + b"x" * 61


def test_one_thing_at_a_time() -> None:
    client = FtpClient()
    client.list("/")
    with pytest.raises(RuntimeError):
        client.download("/file")
    client.cancel()
    client.download("/file")
    with pytest.raises(ValueError, match="path"):
        FtpClient().list("x" * 240)
    with pytest.raises(ValueError, match="path"):
        FtpClient().remove("a\0b")


def test_replies_of_others_are_not_taken(vehicle: Vehicle) -> None:
    client = FtpClient(SERVER)
    client.crc32("/log/flight.ulg")
    (message,) = client.step(0)
    (reply,) = vehicle.server.receive(message, CLIENT, 0)
    client.receive(reply, (2, 1), 0)
    assert client.busy
    client.receive(reply, SERVER, 0)
    assert client.result is not None
    assert replace(client.result).crc32 == crc32(content(5000))
