"""Two flights: the same, or where they part and by how much."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from mavsitl.log.diff import compare
from mavsitl.log.topics import ATTITUDE, ROTOR_STATUS
from mavsitl.log.ulog import UlogWriter
from tests.log.conftest import fly


def write(path: Path, *, error: float = 0.0, rows: int = 20, texts: tuple[str, ...] = (), gain: float = 1.0) -> Path:
    """`error` from row 10 on, in q[1]."""
    with UlogWriter(path, {"sys_name": "x"}, {"P": gain}, topics=(ATTITUDE, ROTOR_STATUS)) as log:
        for k in range(rows):
            log.topic(ATTITUDE).append(4000 * k, 1.0, error if k >= 10 else 0.0, float("nan"), 0.0)
        for text in texts:
            log.message(5000, 4, text)
    return path


def test_the_same_bytes(run: Path, tmp_path: Path) -> None:
    found = compare(run, fly(tmp_path / "again"))
    assert found.same_bytes
    assert found.equal


def test_other_bytes_of_the_same_content(tmp_path: Path) -> None:
    one = write(tmp_path / "a.ulg")
    other = tmp_path / "b.ulg"
    sync = struct.pack("<HB", 8, ord("S")) + bytes([0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12])
    other.write_bytes(one.read_bytes() + sync)
    found = compare(one, other)
    assert found.equal
    assert not found.same_bytes
    assert found.equal_topics == 1


def test_where_and_by_how_much_two_logs_part(tmp_path: Path) -> None:
    one = write(tmp_path / "a.ulg", texts=("hello",))
    found = compare(one, write(tmp_path / "b.ulg", error=0.25, rows=21, gain=2.0, texts=("bye",)))
    assert not found.equal
    assert found.parted_s == pytest.approx(0.04)
    (topic,) = found.topics
    assert (topic.name, topic.rows, topic.common) == ("vehicle_attitude", (20, 21), 20)
    (column,) = topic.columns
    assert column.first_s == pytest.approx(0.04)
    assert (column.name, column.rows, column.largest) == ("q[1]", 10, 0.25)
    assert found.parameters == {"P": (1.0, 2.0)}
    assert found.texts == ((1, "0.005 s: hello"), (2, "0.005 s: bye"))


def test_a_difference_within_the_tolerance_is_none(tmp_path: Path) -> None:
    one, other = write(tmp_path / "a.ulg"), write(tmp_path / "b.ulg", error=0.25)
    assert compare(one, other, 0.25).equal
    assert not compare(one, other, 0.24).equal


def test_a_number_against_none_differs_infinitely(tmp_path: Path) -> None:
    one, other = write(tmp_path / "a.ulg"), write(tmp_path / "b.ulg", error=float("nan"))
    (topic,) = compare(one, other, 1e9).topics
    assert topic.columns[0].largest == float("inf")


def test_another_seed_is_another_flight(run: Path, tmp_path: Path) -> None:
    found = compare(run, fly(tmp_path, seed=2))
    assert found.information == {"seed": ("1", "2")}
    assert found.parted_s == 0.0  # noise of the estimate, from the first row on
    assert "wind_groundtruth" in {topic.name for topic in found.topics}


def test_tlogs_are_compared_message_by_message(run: Path, tmp_path: Path) -> None:
    other = fly(tmp_path, seed=2)
    found = compare(run / "link.tlog", other / "link.tlog")
    assert "ODOMETRY" in {topic.name for topic in found.topics}
