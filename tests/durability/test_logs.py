"""Logs of a process that was killed, of a full disk, and of the one before."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest
from mavsitl_vehicle.vehicle import Vehicle
from pymavlink import mavutil
from pyulog import ULog

from mavsitl import ends
from mavsitl.drivers import Tap
from mavsitl.link.memory import memory_pair
from mavsitl.log.errors import LogError
from mavsitl.log.tlog import Direction, TlogWriter
from mavsitl.log.topics import ATTITUDE
from mavsitl.log.ulog import UlogWriter
from tests.drivers.exercise import shortened
from tests.log.test_tlog import heartbeat

FLIGHT = shortened("hover-calm", 1.0)


def test_a_tlog_cut_anywhere_is_read_up_to_the_cut(tmp_path: Path) -> None:
    """By pymavlink: a kill may come in the middle of a write."""
    path, cut = tmp_path / "a.tlog", tmp_path / "cut.tlog"
    with TlogWriter(path) as tlog:
        for k in range(3):
            tlog.write([(Direction.FROM_VEHICLE, 1_700_000_000_000_000 + k, heartbeat(1 + k))])
    data = path.read_bytes()
    size = len(data) // 3
    for length in range(size, len(data) + 1):
        cut.write_bytes(data[:length])
        reader = mavutil.mavlogfile(str(cut))
        seen: list[str] = []
        while (message := reader.recv_msg()) is not None and len(seen) < 10:
            seen.append(message.get_type())
        reader.close()
        assert seen == ["HEARTBEAT"] * (length // size), length


def test_a_ulog_cut_anywhere_is_read_up_to_the_cut(tmp_path: Path) -> None:
    path, cut = tmp_path / "a.ulg", tmp_path / "cut.ulg"
    with UlogWriter(path, {"sys_name": "x"}, {"P": 1.0}, topics=(ATTITUDE,)) as ulog:
        ulog.flush()
        begin = path.stat().st_size
        for k in range(5):
            ulog.topic(ATTITUDE).append(1000 * k, 1, 0, 0, 0)
    data = path.read_bytes()
    size = (len(data) - begin) // 5
    for length in range(begin + size, len(data) + 1):
        cut.write_bytes(data[:length])
        log = ULog(str(cut), disable_str_exceptions=False)
        assert not log.file_corruption
        assert len(log.data_list[0].data["timestamp"]) == (length - begin) // size


class Full:
    """A file of a disk that becomes full."""

    def __init__(self, file: Any, room_bytes: int) -> None:
        self._file = file
        self._room = room_bytes
        self.closed = False

    def write(self, data: Any) -> int:
        if len(data) > self._room:
            if not self._room:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            data = bytes(data)[: self._room]
        self._room -= len(data)
        return int(self._file.write(data))

    def close(self) -> None:
        self.closed = True
        self._file.close()


@pytest.mark.parametrize("log", ["vehicle.ulg", "link.tlog"])
def test_a_full_disk_ends_the_log_and_not_the_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, log: str) -> None:
    """It is said once, what was written is readable, and the vehicle flies on."""
    told: list[LogError] = []
    with ends._logs(tmp_path, "vehicle", FLIGHT, told.append) as (recorder, tap):
        writer: Any = tap.tlog if log == "link.tlog" else recorder
        place = writer if log == "link.tlog" else writer._sink
        place._file = Full(place._file, 100_000)
        vehicle = Vehicle(FLIGHT, recorder, seed=1, ports=("offboard",))
        near, _ = memory_pair()
        for k in range(4000):
            vehicle.step(k * 4000)
            for datagram in vehicle.datagrams(0, combine=False):
                tap.hear(Direction.FROM_VEHICLE, k * 4000, datagram)
                near.send(datagram)
            tap.tick(k * 4000)
            if log == "link.tlog":
                tap.hear(Direction.FROM_VEHICLE, k * 4000, bytes(heartbeat(1)))
    (error,) = told
    assert str(error) == f"{tmp_path / log}: cannot be written: No space left on device"
    assert (tmp_path / log).stat().st_size == pytest.approx(100_000, rel=0.5)
    if log == "vehicle.ulg":
        assert not ULog(str(tmp_path / log), disable_str_exceptions=False).file_corruption
    else:
        assert ULog(str(tmp_path / "vehicle.ulg")).last_timestamp > 15_000_000


def test_without_somebody_to_tell_it_is_an_error(tmp_path: Path) -> None:
    with ends._logs(tmp_path, "ground", FLIGHT) as (recorder, tap):
        writer: Any = recorder
        recorder.message(0, 6, "the first, with which the definitions end")
        writer._sink._file = Full(writer._sink._file, 10)
        recorder.message(0, 6, "too long for it")
        with pytest.raises(LogError, match="No space left"):
            tap.tick(1_000_000)


def open_logs(folder: Path) -> None:
    told: list[LogError] = []
    with ends._logs(folder, "vehicle", FLIGHT, told.append) as (recorder, tap):
        tap.hear(Direction.FROM_VEHICLE, 0, heartbeat(1))
        recorder.message(0, 6, "hello")


def test_the_logs_of_the_process_before_are_kept(tmp_path: Path) -> None:
    """One that was killed and started again with the same command."""
    written = []
    for number in range(3):
        open_logs(tmp_path)
        (tmp_path / "vehicle.ulg").write_bytes(f"log {number}".encode())
        written.append(f"log {number}".encode())
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == [
        "link-001.tlog", "link-002.tlog", "link.tlog", "vehicle-001.ulg", "vehicle-002.ulg", "vehicle.ulg",
    ]  # fmt: skip
    assert [(tmp_path / name).read_bytes() for name in names[3:]] == written


@pytest.mark.parametrize("odd", ["folder", "link"])
def test_something_else_in_a_log_s_place_is_kept_too(tmp_path: Path, odd: str) -> None:
    (tmp_path / "vehicle-007.ulg").touch()
    other = tmp_path / "other"
    other.write_text("not ours")
    if odd == "folder":
        (tmp_path / "vehicle.ulg").mkdir()
    else:
        (tmp_path / "vehicle.ulg").symlink_to(other)
    open_logs(tmp_path)
    assert other.read_text() == "not ours"
    assert os.path.lexists(tmp_path / "vehicle-008.ulg")
    assert not ULog(str(tmp_path / "vehicle.ulg")).file_corruption


def test_a_run_in_lock_step_writes_over_the_last(tmp_path: Path) -> None:
    """Its folder is one run, and the report reads what is in it."""
    for _ in range(2):
        with ends._logs(tmp_path, "ground", FLIGHT):
            pass
    assert [path.name for path in tmp_path.iterdir()] == ["ground.ulg"]


def test_the_tap_is_told_to_flush(tmp_path: Path) -> None:
    with ends._logs(tmp_path, "vehicle", FLIGHT) as (recorder, tap):
        assert isinstance(tap, Tap)
        recorder.topic(ATTITUDE)  # ends the definitions, which go to the disk at once
        before = (tmp_path / "vehicle.ulg").stat().st_size
        recorder.message(0, 6, "hello")
        tap.tick(0, 499_999)
        assert (tmp_path / "vehicle.ulg").stat().st_size == before
        tap.tick(0, 500_000)
        assert (tmp_path / "vehicle.ulg").stat().st_size > before
