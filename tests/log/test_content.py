"""Logs are known by what is in them; what cannot be read is said, with the file's name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavsitl.log.content import joined, load, logs_of
from mavsitl.log.errors import LogError
from mavsitl.log.info import inspect
from tests.log.conftest import fly


def test_a_run_is_its_logs(run: Path) -> None:
    names = [path.name for path in logs_of(run)]
    assert names == ["vehicle.ulg", "ground.ulg", "link.tlog"]
    assert logs_of(run.parent) == logs_of(run)  # the one flight of it
    assert logs_of(run / "ground.ulg") == (run / "ground.ulg",)


def test_a_run_s_ulogs_are_one(run: Path) -> None:
    vehicle, ground, both = load(run / "vehicle.ulg"), load(run / "ground.ulg"), joined(run)
    assert both.tables.keys() == vehicle.tables.keys() | ground.tables.keys()
    assert both.tables["trajectory_setpoint"] is not None
    assert both.parameters == vehicle.parameters
    assert both.end_us == max(vehicle.end_us, ground.end_us)


def test_what_both_ends_have_is_the_vehicle_s_first(tmp_path: Path) -> None:
    folder, key = fly(tmp_path, level="attitude"), "vehicle_attitude_setpoint"
    both = joined(folder)
    vehicle, ground = (load(folder / name).tables[key] for name in ("vehicle.ulg", "ground.ulg"))
    np.testing.assert_array_equal(both.tables[key]["q_d"], vehicle["q_d"])
    np.testing.assert_array_equal(both.tables[f"{key}.1"]["q_d"], ground["q_d"])


def test_a_tlog_s_messages_sources_and_losses(run: Path, tmp_path: Path) -> None:
    whole = load(run / "link.tlog")
    assert whole.lost_frames == {(1, 1): 0, (250, 191): 0}
    assert whole.tables["ODOMETRY"]["q"].shape[1] == 4
    data = (run / "link.tlog").read_bytes()
    first = 8 + 12 + data[9]
    (tmp_path / "a.tlog").write_bytes(data[first : first + 8] + b"\xfd" + data[first + 9 :])
    assert (
        sum(len(t["timestamp"]) for t in load(tmp_path / "a.tlog").tables.values())
        == sum(len(t["timestamp"]) for t in whole.tables.values()) - 1
    )
    damaged = bytearray(data)
    damaged[8 + 10] ^= 0xFF
    (tmp_path / "b.tlog").write_bytes(damaged)
    assert load(tmp_path / "b.tlog").bad_frames == 1


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "empty"),
        (b"some text that is no log", "neither a ULog nor a tlog"),
        (b"12345678\xfd\xff", "no MAVLink frame in it is whole"),
        (b"ULog\x01\x12\x35\x01", "not a ULog file"),
    ],
)
def test_what_is_no_log_is_said(tmp_path: Path, data: bytes, reason: str) -> None:
    path = tmp_path / "x.ulg"
    path.write_bytes(data)
    with pytest.raises(LogError, match=rf"x\.ulg: .*{reason}"):
        load(path)


def test_folders_that_are_no_run_are_said(run: Path, tmp_path: Path) -> None:
    with pytest.raises(LogError, match="none: no such file or folder"):
        logs_of(tmp_path / "none")
    with pytest.raises(LogError, match=r"a folder without logs; expected vehicle\.ulg"):
        logs_of(tmp_path)
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "vehicle.ulg").write_bytes((run / "vehicle.ulg").read_bytes())
    with pytest.raises(LogError, match=r"a run of several flights; allowed: .*one, .*two"):
        logs_of(tmp_path)


def definitions(data: bytes) -> int:
    """Where a ULog's definitions end: at the first row or text."""
    at = 16
    while data[at + 2] not in b"DL":
        at += 3 + (data[at] | data[at + 1] << 8)
    return at


@settings(max_examples=15, deadline=None)
@given(share=st.floats(0.0, 1.0))
def test_a_ulog_cut_anywhere_is_read_up_to_the_cut_or_refused(cut_in: Path, run: Path, share: float) -> None:
    data = (run / "vehicle.ulg").read_bytes()
    begin, path = definitions(data), cut_in / "cut.ulg"
    for length in (int(share * begin), begin + int(share * (len(data) - begin))):
        path.write_bytes(data[:length])
        if length < begin:
            try:
                found = dict(load(path).tables)
            except LogError:
                found = {}
            assert found == {}
        else:
            check_cut(path, run / "vehicle.ulg")


@settings(max_examples=15, deadline=None)
@given(share=st.floats(0.0, 1.0))
def test_a_tlog_cut_anywhere_is_read_up_to_the_cut_or_refused(cut_in: Path, run: Path, share: float) -> None:
    data, path = (run / "link.tlog").read_bytes(), cut_in / "cut.tlog"
    begin = 8 + 12 + data[9]
    for length in (int(share * begin), begin + int(share * (len(data) - begin))):
        path.write_bytes(data[:length])
        if length < begin:
            with pytest.raises(LogError, match=r"cut\.tlog: (empty|neither)"):
                load(path)
        else:
            check_cut(path, run / "link.tlog")


@pytest.fixture(scope="module")
def cut_in(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cut")


def check_cut(path: Path, whole_path: Path) -> None:
    (info,) = inspect(path)
    whole = load(whole_path)
    assert all(topic.rows <= len(whole.tables[topic.name]["timestamp"]) for topic in info.topics)
    assert info.cut_bytes < 300
    if path.stat().st_size == whole.size_bytes:
        assert info.cut_bytes == 0
