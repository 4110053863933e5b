"""Where, and by how much, two flights part: their logs compared topic by topic."""

from __future__ import annotations

import filecmp
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mavsitl.log.content import Content, Table, flat, joined, logs_of

_OF_THE_CLOCK = ("boot_time_utc_us",)
"""Information that two equal flights differ in."""


class ColumnDifference(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    first_s: float
    """Time of the first row that differs."""
    rows: int
    largest: float | None
    """Absolute difference; infinite where one is not finite, None of texts."""


class TopicDifference(msgspec.Struct, frozen=True, kw_only=True):
    name: str
    only_in: int | None = None
    """1 or 2, of a topic that one of the logs alone has."""
    rows: tuple[int, int] = (0, 0)
    common: int = 0
    """Rows with the same time in both."""
    first_s: float | None = None
    """Time from which on they differ."""
    columns: tuple[ColumnDifference, ...] = ()
    columns_only_in: tuple[tuple[str, int], ...] = ()


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    logs: tuple[str, str]
    same_bytes: bool
    tolerance: float = 0.0
    topics: tuple[TopicDifference, ...] = ()
    """Those that differ."""
    equal_topics: int = 0
    information: dict[str, tuple[str | None, str | None]] = {}
    parameters: dict[str, tuple[float | None, float | None]] = {}
    texts: tuple[tuple[int, str], ...] = ()
    """(1 or 2, text) of those that one of them alone has."""

    @property
    def equal(self) -> bool:
        return not (self.topics or self.information or self.parameters or self.texts)

    @property
    def parted_s(self) -> float | None:
        """The first time at which a row differs; None: no row does."""
        return min((topic.first_s for topic in self.topics if topic.first_s is not None), default=None)


def compare(one: Path, other: Path, tolerance: float = 0.0) -> Difference:
    """Two logs or runs. Numbers that differ by no more than `tolerance` are equal, and so is NaN to NaN.

    Raises `LogError`.
    """
    paths = logs_of(one), logs_of(other)
    logs = (str(one), str(other))
    if len(paths[0]) == len(paths[1]) and all(
        filecmp.cmp(first, second, shallow=False) for first, second in zip(*paths, strict=True)
    ):
        return Difference(logs=logs, same_bytes=True, tolerance=tolerance)
    return _compare(joined(one), joined(other), logs, tolerance)


def _compare(one: Content, other: Content, logs: tuple[str, str], tolerance: float) -> Difference:
    keys = sorted(one.tables.keys() | other.tables.keys())
    found = [_topic(key, one.tables.get(key), other.tables.get(key), tolerance) for key in keys]
    ours, theirs = ({(us, text) for us, _, text in each.texts} for each in (one, other))
    known = ({n: str(v) for n, v in each.information.items() if n not in _OF_THE_CLOCK} for each in (one, other))
    return Difference(
        logs=logs,
        same_bytes=False,
        tolerance=tolerance,
        topics=tuple(each for each in found if each is not None),
        equal_topics=sum(each is None for each in found),
        information=_values(*known),
        parameters=_values(one.parameters, other.parameters),
        texts=(
            *((1, f"{us / 1e6:.3f} s: {text}") for us, text in sorted(ours - theirs)),
            *((2, f"{us / 1e6:.3f} s: {text}") for us, text in sorted(theirs - ours)),
        ),
    )


def _values(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    names = sorted(one.keys() | other.keys())
    return {name: (one.get(name), other.get(name)) for name in names if one.get(name) != other.get(name)}


def _topic(name: str, one: Table | None, other: Table | None, tolerance: float) -> TopicDifference | None:
    if one is None or other is None:
        present, number = (other, 2) if one is None else (one, 1)
        assert present is not None
        count = len(present["timestamp"])
        rows = (0, count) if one is None else (count, 0)
        return TopicDifference(name=name, only_in=number, rows=rows, first_s=float(present["timestamp"][0]) / 1e6)
    ours, theirs = one["timestamp"], other["timestamp"]
    # Rows of one time are told apart by their order.
    first, second = _numbered(ours), _numbered(theirs)
    _, at, beside = np.intersect1d(first, second, assume_unique=True, return_indices=True)
    alone = np.concatenate((np.delete(ours, at), np.delete(theirs, beside)))
    mine, its = flat(one), flat(other)
    columns = [
        each
        for column in mine.keys() & its.keys() - {"timestamp"}
        if (each := _column(column, ours[at], mine[column][at], its[column][beside], tolerance)) is not None
    ]
    only = sorted([(column, 1) for column in mine.keys() - its.keys()] + [(c, 2) for c in its.keys() - mine.keys()])
    if not (columns or only or alone.size):
        return None
    times = [each.first_s for each in columns] + ([float(alone.min()) / 1e6] if alone.size else [])
    return TopicDifference(
        name=name,
        rows=(ours.size, theirs.size),
        common=at.size,
        first_s=min(times, default=None),
        columns=tuple(sorted(columns, key=lambda each: each.name)),
        columns_only_in=tuple(only),
    )


def _numbered(stamps: Any) -> Any:
    """(k,) of a structure (time, number among those of this time)."""
    first = np.searchsorted(stamps, stamps, side="left")
    keys = np.empty(stamps.size, [("time", np.uint64), ("number", np.int64)])
    keys["time"], keys["number"] = stamps, np.arange(stamps.size) - first
    return keys


def _column(name: str, times: Any, one: Any, other: Any, tolerance: float) -> ColumnDifference | None:
    if one.dtype.kind not in "fiub" or other.dtype.kind not in "fiub":
        differs, apart = one.astype(str) != other.astype(str), None
    else:
        a, b = one.astype(np.float64), other.astype(np.float64)
        with np.errstate(invalid="ignore"):
            apart = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.abs(a - b))
        apart = np.nan_to_num(apart, nan=np.inf, posinf=np.inf)
        differs = apart > tolerance
    if not differs.any():
        return None
    return ColumnDifference(
        name=name,
        first_s=float(times[np.argmax(differs)]) / 1e6,
        rows=int(differs.sum()),
        largest=None if apart is None else float(apart.max()),
    )
