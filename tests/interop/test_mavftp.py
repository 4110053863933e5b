"""pymavlink's own FTP client against our server: its code and its timers, a link and a clock of ours."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.services.files import Folder, MemoryFiles, Mounts, Quota
from mavsitl.services.ftp import FtpServer
from tests.services.test_ftp import content, handles

pytestmark = pytest.mark.interop

STEP_S = 0.004
CLIENT = (255, 190)
SERVER = (1, 1)


class Connection:
    """What the client uses of a mavutil connection. Whoever waits for a message lets the time pass."""

    source_system, source_component = CLIENT

    def __init__(self, server: FtpServer) -> None:
        self.server = server
        self.loss = 0.0
        self.now_s = 1000.0
        self.mav = SimpleNamespace(file_transfer_protocol_send=self._send)
        self._random = random.Random(1)
        self._flying: deque[tuple[float, Any]] = deque()
        """(time it arrives, message) to the client"""

    def _through(self, message: Any, sender: tuple[int, int]) -> list[Any]:
        frame = encode(message, 0, *sender)
        return [] if self._random.random() < self.loss else [parsed.message for parsed in parse(frame)]

    def _reply(self, messages: Any) -> None:
        for message in messages:
            self._flying += [(self.now_s + STEP_S, arrived) for arrived in self._through(message, SERVER)]

    def _send(self, network: int, system: int, component: int, payload: bytearray) -> None:
        request = mavlink.MAVLink_file_transfer_protocol_message(network, system, component, bytes(payload))
        for message in self._through(request, CLIENT):
            self._reply(self.server.receive(message, CLIENT, round(self.now_s * 1e6)))

    def recv_match(self, type: Any = None, blocking: bool = False, timeout: float = 0.0) -> Any:  # noqa: A002
        end_s = self.now_s + (timeout or 0.0)
        while True:
            if self._flying and self._flying[0][0] <= self.now_s:
                return self._flying.popleft()[1]
            if self.now_s >= end_s:
                return None
            self.sleep(STEP_S)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        self._reply(self.server.step(round(self.now_s * 1e6)))


class Bench:
    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        from pymavlink import mavftp

        self.folder = folder
        self.box = folder / "box"
        self.logs = folder / "logs"
        self.logs.mkdir()
        metadata = MemoryFiles({"general.json": b'{"version":1}'})
        sandbox = Folder(self.box, Quota())
        tree = Mounts({"/fs/microsd": sandbox, "/log": Folder(self.logs), "/etc/extras": metadata})
        self.connection = Connection(FtpServer(tree))
        clock = SimpleNamespace(time=lambda: self.connection.now_s, sleep=self.connection.sleep)
        monkeypatch.setattr(mavftp, "time", clock)
        self.ftp = mavftp.MAVFTP(self.connection, *SERVER)

    def get(self, path: str) -> tuple[int, bytes, float]:
        """Error code, content and seconds of a download."""
        begin_s, local = self.connection.now_s, self.folder / "got"
        local.unlink(missing_ok=True)
        result = self.ftp.cmd_get([path, str(local)])
        assert result.error_code == 0
        result = self.ftp.process_ftp_reply("OpenFileRO", timeout=300)
        data = local.read_bytes() if local.exists() else b""
        return result.error_code, data, self.connection.now_s - begin_s

    def put(self, path: str, data: bytes) -> int:
        assert self.ftp.cmd_put(["put", path], fh=BytesIO(data)).error_code == 0
        return int(self.ftp.process_ftp_reply("put", timeout=300).error_code)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    before = handles()
    made = Bench(tmp_path, monkeypatch)
    yield made
    made.connection.server.close()
    assert handles() == before


def test_list(bench: Bench) -> None:
    for n in range(30):
        (bench.logs / f"{n:02d}_{'x' * 30}.ulg").write_bytes(bytes(n))
    begin_s = bench.connection.now_s
    result = bench.ftp.cmd_list(["/log"])
    assert result.error_code == 0
    assert [(entry.name, entry.size_b) for entry in result.directory_listing] == [
        (f"{n:02d}_{'x' * 30}.ulg", n) for n in range(30)
    ]
    assert [(entry.name, entry.is_dir) for entry in bench.ftp.cmd_list(["/"]).directory_listing] == [
        ("etc", True),
        ("fs", True),
        ("log", True),
    ]
    assert bench.connection.now_s - begin_s < 0.1


@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("size", [1, 79, 80, 81, 160, 239, 5000, 20_000])
def test_get(bench: Bench, size: int, loss: float) -> None:
    (bench.logs / "file.ulg").write_bytes(content(size))
    bench.connection.loss = loss
    error, data, seconds = bench.get("/log/file.ulg")
    assert (error, data) == (0, content(size))
    if loss == 0.0:
        assert seconds < 0.1 + size / 60_000  # no time-out anywhere


def test_ten_kilobytes_each_way_with_a_quarter_lost(bench: Bench) -> None:
    bench.connection.loss = 0.25
    assert bench.put("/fs/microsd/file", content(10_000)) == 0
    bench.connection.sleep(FtpServer.IDLE_US * 1e-6)
    assert (bench.box / "file").read_bytes() == content(10_000)
    assert bench.get("/fs/microsd/file")[:2] == (0, content(10_000))


def test_gets_one_after_the_other(bench: Bench) -> None:
    for n in range(5):
        (bench.logs / str(n)).write_bytes(content(3000, n))
    for n in range(5):
        assert bench.get(f"/log/{n}")[:2] == (0, content(3000, n))
    assert bench.get("/etc/extras/general.json")[:2] == (0, b'{"version":1}')
    assert bench.connection.server.open_sessions == 0


@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("size", [1, 80, 10_000])
def test_put(bench: Bench, size: int, loss: float) -> None:
    bench.connection.loss = loss
    assert bench.put("/fs/microsd/file", content(size)) == 0
    bench.connection.sleep(FtpServer.IDLE_US * 1e-6)  # it asks once for the end, which may be lost
    assert (bench.box / "file").read_bytes() == content(size)


def test_refusals_are_quick_and_named(bench: Bench) -> None:
    from pymavlink.mavftp import FtpError

    assert bench.get("/log/none")[0] == FtpError.FileNotFound
    assert bench.get("@PARAM/param.pck")[0] == FtpError.FileNotFound
    assert bench.get("/log/../secret")[0] == FtpError.FileProtected
    assert bench.put("/log/file", b"x") == FtpError.FileProtected
    assert bench.ftp.cmd_list(["/none"]).error_code == FtpError.FileNotFound
    assert bench.ftp.cmd_rm(["/fs/microsd/none"]).error_code == FtpError.FileNotFound
    assert bench.ftp.cmd_rmdir(["/log"]).error_code == FtpError.FileProtected


def test_directories(bench: Bench) -> None:
    assert bench.ftp.cmd_mkdir(["/fs/microsd/d"]).error_code == 0
    assert bench.put("/fs/microsd/d/file", b"content") == 0
    assert bench.ftp.cmd_crc(["/fs/microsd/d/file"]).error_code == 0
    assert bench.ftp.cmd_rename(["/fs/microsd/d/file", "/fs/microsd/moved"]).error_code == 0
    assert (bench.box / "moved").read_bytes() == b"content"
    assert bench.ftp.cmd_rmdir(["/fs/microsd/d"]).error_code == 0
    assert bench.ftp.cmd_rm(["/fs/microsd/moved"]).error_code == 0
    assert list(bench.box.iterdir()) == []
