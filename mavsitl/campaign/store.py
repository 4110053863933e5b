"""Rows on the disk: a journal that a kill leaves readable, and Parquet at the end."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import msgspec

from mavsitl.campaign import optional
from mavsitl.campaign.errors import StoreError
from mavsitl.campaign.fly import Row
from mavsitl.keep import replace_file

if TYPE_CHECKING:
    from io import FileIO


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


STATES = ("x_m", "y_m", "z_m", "phi_deg", "theta_deg", "psi_deg")
PREFIX = "mavsitl."
"""Of the names in a Parquet file's metadata."""


def columns(rows: Sequence[Row], keys: Sequence[str]) -> dict[str, list[Any]]:
    """A table's columns: a row's fields flat, `keys` of its labels under their own names, None where there is none.

    A key whose values are not all numbers, all texts or all true or false has them as JSON.
    """
    table: dict[str, list[Any]] = {
        name: [getattr(row, name) for row in rows] for name in ("scenario", "scenario_digest", "seed")
    }
    for key in keys:
        table[key] = _alike([row.labels.get(key) for row in rows])
    for name in ("status", "message", "time_s"):
        table[name] = [getattr(row, name) for row in rows]
    for name in ("position_m", "attitude_deg"):
        table[f"rmse_{name}"] = [getattr(row, name) if row.flown else None for row in rows]
    for index, state in enumerate(STATES):
        table[f"rmse_{state}"] = [None if row.rmse is None else row.rmse[index] for row in rows]
        table[f"max_{state}"] = [None if row.largest is None else row.largest[index] for row in rows]
    table["effort_rad_s"] = [row.effort_rad_s for row in rows]
    for index, end in enumerate(("min", "max")):
        table[f"weight_{end}"] = [row.weight_range[index] for row in rows]
    for name in ("left_offboard", "key", "code", "wire_hash", "cpu_s"):
        table[name] = [getattr(row, name) for row in rows]
    return table


def _alike(values: list[Any]) -> list[Any]:
    kinds = {type(value) for value in values}
    if kinds <= {int, float}:
        return [float(value) for value in values] if float in kinds else values
    if kinds in ({str}, {bool}):
        return values
    return [msgspec.json.encode(value, order="deterministic").decode() for value in values]


def write_parquet(path: Path, rows: Sequence[Row], keys: Sequence[str], metadata: Mapping[str, str]) -> None:
    """`columns` as a Parquet file, whole or not at all; `metadata` under `PREFIX` in its schema.

    Raises `StoreError`, and `optional.MissingError` without pyarrow.
    """
    optional.need("pyarrow")
    import pyarrow as pa
    import pyarrow.parquet as pq

    named = {f"{PREFIX}{name}": value for name, value in metadata.items()}
    table = pa.table(columns(rows, keys)).replace_schema_metadata(named)
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, sink.getvalue().to_pybytes())
    except OSError as error:
        raise StoreError(f"{path}: cannot be written: {error.strerror or error}") from error
