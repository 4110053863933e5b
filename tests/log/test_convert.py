"""Converted logs have the same numbers, read back by readers that are not ours; an output is whole or not there."""

from __future__ import annotations

import csv
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyulog.core import ULog

from mavsitl.log import convert as converting
from mavsitl.log.content import flat, joined, load
from mavsitl.log.convert import WRITERS, convert
from mavsitl.log.endings import ENDINGS
from mavsitl.log.errors import LogError
from mavsitl.log.ulog import read


def test_each_ending_has_its_writer() -> None:
    assert tuple(WRITERS) == tuple(ENDINGS)


def test_csv(run: Path, tmp_path: Path) -> None:
    assert convert(run, tmp_path / "a.csv", ["vehicle_attitude"]) == ("vehicle_attitude",)
    columns = flat(joined(run).tables["vehicle_attitude"])
    with (tmp_path / "a.csv").open(newline="") as file:
        head, *rows = csv.reader(file)
    assert head == list(columns)
    values = np.array(rows)
    for index, name in enumerate(columns):
        np.testing.assert_array_equal(values[:, index].astype(columns[name].dtype), columns[name])


def test_csv_of_every_topic_in_an_archive(run: Path, tmp_path: Path) -> None:
    topics = convert(run, tmp_path / "a.csv.zip")
    with zipfile.ZipFile(tmp_path / "a.csv.zip") as archive:
        assert sorted(archive.namelist()) == sorted(f"{topic}.csv" for topic in topics)
        assert archive.testzip() is None
    convert(run, tmp_path / "b.csv.zip")
    assert (tmp_path / "a.csv.zip").read_bytes() == (tmp_path / "b.csv.zip").read_bytes()


def test_parquet(run: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    convert(run, tmp_path / "a.parquet", ["vehicle_attitude"])
    convert(run, tmp_path / "a.parquet.zip")
    columns = flat(joined(run).tables["vehicle_attitude"])
    with zipfile.ZipFile(tmp_path / "a.parquet.zip") as archive:
        tables = [parquet.read_table(tmp_path / "a.parquet")]
        tables.append(parquet.read_table(io.BytesIO(archive.read("vehicle_attitude.parquet"))))
    for table in tables:
        assert table.column_names == list(columns)
        for name, values in columns.items():
            np.testing.assert_array_equal(table[name].to_numpy(), values)


def test_json_lines_are_by_time_and_strict_json(run: Path, tmp_path: Path) -> None:
    convert(run, tmp_path / "a.jsonl")

    def refuse(text: str) -> Any:
        raise AssertionError(text)

    rows = [json.loads(line, parse_constant=refuse) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    stamps = [row["timestamp"] for row in rows]
    assert stamps == sorted(stamps)
    q = np.array([row["q"] for row in rows if row["topic"] == "vehicle_attitude"], np.float32)
    np.testing.assert_array_equal(q, joined(run).tables["vehicle_attitude"]["q"])
    assert any(
        row["topic"] == "battery_status" and row["time_remaining_s"] is None for row in rows
    )  # NaN on the ground


def test_one_ulog_of_a_run(run: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.ulg"
    convert(run, path)
    both, tables = joined(run), read(path)
    for key, table in both.tables.items():
        assert tables[key].keys() == table.keys()
        for column, values in table.items():
            np.testing.assert_array_equal(tables[key][column], values)
            assert tables[key][column].dtype == values.dtype
    one = load(path)
    assert (one.parameters, one.texts) == (both.parameters, both.texts)
    assert one.information == both.information
    setpoint = tables["vehicle_local_position_setpoint"]  # where Flight Review looks for a reference
    np.testing.assert_array_equal(setpoint["z"], both.tables["trajectory_setpoint"]["position"][:, 2])
    stamps = [int(data.data["timestamp"][0]) for data in ULog(str(path)).data_list]
    assert min(stamps) == one.start_us


def test_parameter_changes_keep_their_place(tmp_path: Path) -> None:
    from mavsitl.log.topics import ATTITUDE
    from mavsitl.log.ulog import UlogWriter

    with UlogWriter(tmp_path / "a.ulg", {}, {}, topics=(ATTITUDE,)) as log:
        log.begin({"A": 1.0, "B": 2}, {"A": 3.0, "B": 2})
        for k in range(10):
            log.topic(ATTITUDE).append(1000 * k, 1, 0, 0, 0)
            if k == 4:
                log.parameter("A", 1.5)
                log.message(4500, 3, "half way")
    convert(tmp_path / "a.ulg", tmp_path / "b.ulg")
    one, other = load(tmp_path / "a.ulg"), load(tmp_path / "b.ulg")
    assert one.changes == other.changes == ((4000, "A", 1.5),)
    assert one.defaults == other.defaults == {"A": 3.0}
    assert one.texts == other.texts == ((4500, "ERROR", "half way"),)


def test_mcap_opens_with_a_3d_view(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_protobuf.decoder")
    convert(run, tmp_path / "a.mcap")
    both = joined(run)
    seen: dict[str, list[Any]] = {}
    times: dict[str, list[int]] = {}
    with (tmp_path / "a.mcap").open("rb") as file:
        made = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        summary = made.get_summary()
        assert summary is not None
        for schema, channel, message in made.iter_messages():
            times.setdefault(channel.topic, []).append(message.log_time)
            if schema is not None and schema.encoding == "jsonschema":
                seen.setdefault(channel.topic, []).append(json.loads(message.data))
        metadata = {each.name: each.metadata for each in made.iter_metadata()}
        names = {channel.topic: summary.schemas[channel.schema_id].name for channel in summary.channels.values()}
        scene = [decoded for *_, decoded in made.iter_decoded_messages(topics=["/scene"])]
        transforms = [decoded for *_, decoded in made.iter_decoded_messages(topics=["/tf"])]
        logged = [decoded for *_, decoded in made.iter_decoded_messages(topics=["/log"])]
    assert names["/tf"] == "foxglove.FrameTransform"
    assert names["/pose"] == "foxglove.PoseInFrame"
    assert names["/scene"] == "foxglove.SceneUpdate"
    assert names["/location"] == "foxglove.LocationFix"
    assert metadata["log"]["scenario"] == "hover-wind"
    for key, table in both.tables.items():
        assert [stamp // 1000 for stamp in times[f"/{key}"]] == table["timestamp"].tolist()
    q = np.array([row["q"] for row in seen["/vehicle_attitude"]], np.float32)
    np.testing.assert_array_equal(q, both.tables["vehicle_attitude"]["q"])
    entities = {entity.id: entity for update in scene for entity in update.entities}
    assert entities.keys() == {"vehicle", "path", "reference"}
    assert len(entities["vehicle"].cylinders) == 4
    truth = both.tables["vehicle_local_position_groundtruth"]
    last, row = transforms[-1], -1
    assert (last.parent_frame_id, last.child_frame_id) == ("world", "vehicle")
    where = (truth["x"][row], -truth["y"][row], -truth["z"][row])  # NED to NWU
    assert (last.translation.x, last.translation.y, last.translation.z) == pytest.approx(where)
    assert [each.message for each in logged] == [text for _, _, text in both.texts]


def test_a_tlog_s_messages_convert_too(run: Path, tmp_path: Path) -> None:
    convert(run / "link.tlog", tmp_path / "a.csv", ["ATTITUDE"])
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows[0].keys() >= {"timestamp", "system", "component", "roll", "time_boot_ms"}
    with pytest.raises(LogError, match="a tlog, which cannot become a ULog"):
        convert(run / "link.tlog", tmp_path / "a.ulg")


def test_what_cannot_be_converted_is_said(run: Path, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"a\.xlsx: its ending says the format; allowed: \.csv\.zip, \.csv"):
        convert(run, tmp_path / "a.xlsx")
    with pytest.raises(LogError, match=r"a\.csv: holds one topic, and there are \d+: choose by --topic .* a\.csv\.zip"):
        convert(run, tmp_path / "a.csv")
    with pytest.raises(LogError, match="no topic wrong; there are actuator_motors, "):
        convert(run, tmp_path / "a.jsonl", ["wrong"])
    with pytest.raises(LogError, match=r"none/a\.jsonl: cannot be written"):
        convert(run, tmp_path / "none" / "a.jsonl")
    assert list(tmp_path.iterdir()) == []


def test_a_failure_leaves_what_was_there(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "a.jsonl"
    out.write_text("before")

    def half(path: Path, content: Any) -> None:
        path.write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(converting.WRITERS, ".jsonl", half)
    with pytest.raises(LogError, match=r"a\.jsonl: cannot be written: No space left"):
        convert(run, out)
    assert out.read_text() == "before"
    assert list(tmp_path.iterdir()) == [out]
