"""What is recorded must come out again, from memory and, with pyulog, from a file, also from one that was cut."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from pyulog.core import ULog

from mavsitl.log.topics import ATTITUDE, LINK_STATUS, LOCAL_POSITION_TRUTH, PIDNN_WEIGHTS, ROTOR_STATUS, TOPICS, Topic
from mavsitl.log.ulog import LogError, MemoryRecorder, Recorder, UlogWriter, read

FIRST = Topic("first", ("float x", "uint16_t[2] pair", "int32_t signed", "double wide", "uint8_t flag"))


def fill(recorder: Recorder, rows: int) -> None:
    for k in range(rows):
        recorder.topic(LOCAL_POSITION_TRUTH).append(4000 * k, 0.1 * k, -k, 1e-30, math.nan, 2.0, 3.0)
        recorder.topic(ATTITUDE).append(4000 * k, 1.0, 0.25, -0.5, k)
        if k % 10 == 0:
            recorder.topic(LINK_STATUS).append(4000 * k, k, 2**32 - 1, 0, 8000)
            recorder.message(4000 * k, 4, f"row {k} β")


def test_topics_are_named_once_and_pack_without_padding() -> None:
    assert len({topic.key for topic in TOPICS}) == len(TOPICS)
    for topic in TOPICS:
        assert topic.dtype.itemsize == topic.message.size
        assert topic.columns[0] == ("timestamp", "uint64_t", None)
    assert PIDNN_WEIGHTS.message.size == 5 + 8 + 36
    assert ROTOR_STATUS.ulog_format == "rotor_status:uint64_t timestamp;float[4] speed_rad_s;uint8_t saturated;"


@pytest.mark.parametrize("field", ["text t", "float", "float[0] a", "float Big", "float[3]a"])
def test_a_wrong_field_is_refused(field: str) -> None:
    with pytest.raises(ValueError, match="bad: "):
        Topic("bad", (field,))


def test_memory_gives_back_what_was_appended_beyond_its_first_buffer() -> None:
    memory = MemoryRecorder()
    fill(memory, 10_000)
    columns = memory.arrays(LOCAL_POSITION_TRUTH)
    assert columns["timestamp"].dtype == np.uint64
    np.testing.assert_array_equal(columns["timestamp"], 4000 * np.arange(10_000))
    np.testing.assert_array_equal(columns["x"], (0.1 * np.arange(10_000)).astype(np.float32))
    assert np.isnan(columns["vx"]).all()
    assert memory.arrays(ATTITUDE)["q"].shape == (10_000, 4)
    assert memory.arrays(PIDNN_WEIGHTS)["roll"].shape == (0, 3)
    assert memory.messages[1] == (40_000, 4, "row 10 β")
    assert "pidnn_weights" not in memory.tables()


def test_rows_that_do_not_fit_the_topic_are_refused_and_leave_nothing() -> None:
    memory = MemoryRecorder()
    rows = memory.topic(ATTITUDE)
    with pytest.raises(struct.error):
        rows.append(0, 1.0, 2.0)
    with pytest.raises(struct.error):
        memory.topic(LINK_STATUS).append(0, -1, 0, 0, 0)
    assert memory.tables() == {}
    with pytest.raises(ValueError, match="other fields"):
        memory.topic(Topic(ATTITUDE.name, ("float w",)))


def test_a_number_beyond_float32_becomes_infinite() -> None:
    memory = MemoryRecorder()
    memory.topic(ATTITUDE).append(0, 1e300, -1e300, 1.0, math.nan)
    q = memory.arrays(ATTITUDE)["q"][0]
    assert (q[0], q[1], q[2]) == (math.inf, -math.inf, 1.0)
    assert math.isnan(q[3])


def test_pyulog_reads_the_same_numbers_texts_and_definitions(tmp_path: Path) -> None:
    path = tmp_path / "a.ulg"
    memory = MemoryRecorder()
    with UlogWriter(
        path, {"sys_name": "mavsitl", "empty": ""}, {"MPC_THR_HOVER": 0.5, "COM_OF": 3}, topics=(*TOPICS, FIRST)
    ) as ulog:
        for recorder in (memory, ulog):
            fill(recorder, 9000)
            recorder.topic(FIRST).append(7, 1.5, 1, 65535, -5, 0.1, 255)
    log = ULog(str(path), disable_str_exceptions=False)
    assert not log.file_corruption
    assert log.msg_info_dict == {"sys_name": "mavsitl", "empty": ""}
    assert log.initial_parameters == {"MPC_THR_HOVER": 0.5, "COM_OF": 3}
    assert [(m.timestamp, m.log_level_str(), m.message) for m in log.logged_messages[:2]] == [
        (0, "WARNING", "row 0 β"),
        (40_000, "WARNING", "row 10 β"),
    ]
    tables = read(path)
    assert tables.keys() == memory.tables().keys()
    for name, columns in memory.tables().items():
        assert tables[name].keys() == columns.keys()
        for column, values in columns.items():
            assert tables[name][column].dtype == values.dtype
            np.testing.assert_array_equal(tables[name][column], values)


def test_a_cut_file_is_read_up_to_the_cut(tmp_path: Path) -> None:
    whole = tmp_path / "whole.ulg"
    with UlogWriter(whole, {}, {}) as ulog:
        ulog.flush()
        definitions = whole.stat().st_size
        fill(ulog, 50)
    data = whole.read_bytes()
    full = read(whole)
    cut = tmp_path / "cut.ulg"
    for length in (definitions, definitions + 1, definitions + 40, definitions + 177, len(data) - 900, len(data) - 1):
        cut.write_bytes(data[:length])
        tables = read(cut)
        for name, columns in tables.items():
            for column, values in columns.items():
                np.testing.assert_array_equal(values, full[name][column][: len(values)])
    assert len(tables["vehicle_attitude"]["timestamp"]) == 49
    assert len(tables["vehicle_local_position_groundtruth"]["timestamp"]) == 50


def test_rows_are_on_disk_after_a_flush(tmp_path: Path) -> None:
    path = tmp_path / "a.ulg"
    with UlogWriter(path, {}, {}) as ulog:
        rows = ulog.topic(ATTITUDE)
        rows.append(0, 1, 0, 0, 0)
        assert read(path) == {}
        ulog.flush()
        assert len(read(path)["vehicle_attitude"]["q"]) == 1


def test_a_full_buffer_reaches_the_disk_without_a_flush(tmp_path: Path) -> None:
    path = tmp_path / "a.ulg"
    with UlogWriter(path, {}, {}) as ulog:
        rows = ulog.topic(ATTITUDE)
        for k in range(10_000):
            rows.append(k, 1, 0, 0, 0)
        assert len(read(path)["vehicle_attitude"]["q"]) > 9000


def test_faults_name_the_file(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"none/a\.ulg: cannot be written: No such file"):
        UlogWriter(tmp_path / "none" / "a.ulg", {}, {})
    with pytest.raises(LogError, match=r"b\.ulg: cannot be read: No such file"):
        read(tmp_path / "b.ulg")
    (tmp_path / "c.ulg").write_bytes(b"not a log at all, but long enough")
    with pytest.raises(LogError, match=r"c\.ulg: not a ULog file"):
        read(tmp_path / "c.ulg")
    ulog = UlogWriter(tmp_path / "d.ulg", {}, {})
    with pytest.raises(ValueError, match="not among the topics"):
        ulog.topic(FIRST)
    with pytest.raises(ValueError, match="level 8"):
        ulog.message(0, 8, "no such level")
    ulog.close()
    ulog.close()
    ulog.topic(ATTITUDE).append(0, 1, 0, 0, 0)
    with pytest.raises(LogError, match=r"d\.ulg: cannot be written: it is closed"):
        ulog.flush()


def test_a_full_disk_is_reported() -> None:
    with pytest.raises(LogError, match="/dev/full: cannot be written: No space left"):
        UlogWriter(Path("/dev/full"), {}, {})


def test_a_damaged_file_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "a.ulg"
    with UlogWriter(path, {}, {}) as ulog:
        ulog.flush()
        definitions = path.stat().st_size
        fill(ulog, 50)
    data = bytearray(path.read_bytes())
    data[definitions + 200 : definitions + 260] = bytes(60)
    path.write_bytes(data)
    with pytest.raises(LogError, match=r"a\.ulg: damaged"):
        read(path)
