"""Rows on the disk: a journal that a kill leaves readable."""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import msgspec

from mavsitl.campaign.fly import Row

if TYPE_CHECKING:
    from io import FileIO


class StoreError(ValueError):
    """What is on the disk cannot be used; the message names the file and what to do."""


class Journal:
    """Rows so far, and a file to which each new one is appended: a line of JSON, in one write.

    So whenever the process is killed, all rows that were added are there. A last line that was cut off (by a full
    disk, or a machine that went down) is dropped, and its case is to be flown again. One process has the file at a
    time. A context manager. Raises `StoreError`.
    """

    def __init__(self, path: Path | None) -> None:
        """`path`: None keeps the rows in memory alone."""
        self.path = path
        self.rows: dict[str, Row] = {}
        """By key."""
        self._file: FileIO | None = None
        if path is not None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._file = path.open("a+b", buffering=0)
            except OSError as error:
                raise StoreError(f"{path}: cannot be written: {error.strerror or error}") from error
            try:
                self._lock(path)
                self._read(path)
            except BaseException:
                self._file.close()
                raise

    def add(self, row: Row) -> None:
        self.rows[row.key] = row
        if self._file is not None:
            line = msgspec.json.encode(row) + b"\n"
            try:
                written = self._file.write(line)
            except OSError as error:
                raise StoreError(f"{self.path}: cannot be written: {error.strerror or error}") from error
            if written != len(line):
                raise StoreError(f"{self.path}: cannot be written: no space is left")

    def close(self) -> None:
        """The rows are with the disk when this returns."""
        if self._file is not None:
            os.fsync(self._file.fileno())
            self._file.close()
            self._file = None

    def __enter__(self) -> Journal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _lock(self, path: Path) -> None:
        """Held until the file is closed, however that comes about. Where the system has no such lock there is none."""
        assert self._file is not None
        try:
            import fcntl
        except ImportError:
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise StoreError(f"{path}: another process is at work on it; wait, or name another folder") from error

    def _read(self, path: Path) -> None:
        assert self._file is not None
        self._file.seek(0)
        data = self._file.readall()
        *lines, tail = data.split(b"\n")
        for number, line in enumerate(lines, start=1):
            try:
                row = msgspec.json.decode(line, type=Row)
            except msgspec.MsgspecError as error:
                raise StoreError(f"{path}: line {number} is no row ({error}); remove the file to start anew") from error
            self.rows[row.key] = row
        if tail:
            self._file.truncate(len(data) - len(tail))
