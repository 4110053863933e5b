"""Rows on the disk."""

from __future__ import annotations

from pathlib import Path

import pytest

from mavsitl.campaign.errors import StoreError
from mavsitl.campaign.fly import Row
from mavsitl.campaign.store import Journal

ROWS = [
    Row(f"key {seed}", "hover-calm", seed, "flown", 2.0, (0.1 * seed,) * 6, labels={"law": "pid", "seeds": [1, 2.5]})
    for seed in (1, 2, 3)
]


def test_what_was_added_is_there_again(tmp_path: Path) -> None:
    path = tmp_path / "new" / "rows.jsonl"
    with Journal(path) as journal:
        for row in ROWS:
            journal.add(row)
    with Journal(path) as journal:
        assert list(journal.rows.values()) == ROWS


def test_each_row_is_there_as_soon_as_it_is_added(tmp_path: Path) -> None:
    """So that nothing is lost when the process is killed."""
    path = tmp_path / "rows.jsonl"
    with Journal(path) as journal:
        journal.add(ROWS[0])
        journal.add(ROWS[1])
        assert path.read_bytes().count(b"\n") == 2


def test_a_cut_off_row_is_dropped_and_the_rest_kept(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    with Journal(path) as journal:
        for row in ROWS:
            journal.add(row)
    whole = path.read_bytes()
    for cut in (1, 20, len(whole.splitlines()[-1])):
        path.write_bytes(whole[:-cut])
        with Journal(path) as journal:
            assert list(journal.rows.values()) == ROWS[:2]
            journal.add(ROWS[2])
        assert path.read_bytes() == whole


def test_a_damaged_journal_is_refused_by_line_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    for text in ('{"key": 3}\n', "notes of somebody\n"):
        path.write_text(text)
        with pytest.raises(StoreError, match=r"rows\.jsonl: line 1 is no row .*; remove the file"):
            Journal(path)
        assert path.read_text() == text


def test_two_processes_do_not_write_into_one_journal(tmp_path: Path) -> None:
    pytest.importorskip("fcntl")
    path = tmp_path / "rows.jsonl"
    with Journal(path), pytest.raises(StoreError, match="another process is at work on it"):
        Journal(path)
    Journal(path).close()


def test_a_journal_that_cannot_be_written_says_where(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=r"rows\.jsonl: cannot be written"):
        Journal(tmp_path / "file" / "rows.jsonl")
