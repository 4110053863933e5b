"""What is in a log: topics with their rates and gaps, parameters, texts, and how it ended."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from mavsitl.log.content import Content, Kind, Table, flights_of, load, logs_of


class TopicInfo(msgspec.Struct, frozen=True, kw_only=True):
    """One topic, or kind of message."""

    name: str
    rows: int
    rate_hz: float | None
    """By the median of the time between two rows; None of one row, or where half of them came at once."""
    longest_gap_s: float | None
    first_s: float
    last_s: float


class SourceInfo(msgspec.Struct, frozen=True, kw_only=True):
    """Who speaks in a tlog."""

    system: int
    component: int
    frames: int
    lost: int
    """Missing by their sequence numbers."""


class Text(msgspec.Struct, frozen=True, kw_only=True):
    time_s: float
    level: str
    text: str


class Change(msgspec.Struct, frozen=True, kw_only=True):
    """Of a parameter, in flight."""

    time_s: float
    name: str
    value: float


class LogInfo(msgspec.Struct, frozen=True, kw_only=True):
    path: str
    kind: Kind
    size_bytes: int
    start_s: float
    duration_s: float
    cut_bytes: int
    """Of a message at the end that is not whole; 0: the log was ended, or cut between two messages."""
    topics: tuple[TopicInfo, ...]
    information: dict[str, str | int] = {}
    parameters: dict[str, float] = {}
    defaults: dict[str, float] = {}
    """Of parameters that differ from them."""
    changes: tuple[Change, ...] = ()
    texts: tuple[Text, ...] = ()
    dropouts_s: float = 0.0
    """Of which the writer knew."""
    bad_frames: int = 0
    sources: tuple[SourceInfo, ...] = ()


def inspect(path: Path) -> tuple[LogInfo, ...]:
    """Of each log that the path names, of all flights of a run and all vehicles of a fleet. Raises `LogError`."""
    folders = flights_of(path) if path.is_dir() else ()
    return tuple(describe(load(log)) for folder in folders or (path,) for log in logs_of(folder))


def describe(content: Content) -> LogInfo:
    return LogInfo(
        path=str(content.path),
        kind=content.kind,
        size_bytes=content.size_bytes,
        start_s=content.start_us / 1e6,
        duration_s=(content.end_us - content.start_us) / 1e6,
        cut_bytes=content.left_over_bytes,
        topics=tuple(_topic(name, table) for name, table in sorted(content.tables.items())),
        information=dict(content.information),
        parameters=dict(content.parameters),
        defaults=dict(content.defaults),
        changes=tuple(Change(time_s=us / 1e6, name=name, value=value) for us, name, value in content.changes),
        texts=tuple(Text(time_s=us / 1e6, level=level, text=text) for us, level, text in content.texts),
        dropouts_s=sum(content.dropouts_ms) / 1e3,
        bad_frames=content.bad_frames,
        sources=_sources(content) if content.kind == "tlog" else (),
    )


def _topic(name: str, table: Table) -> TopicInfo:
    times_s = table["timestamp"].astype(np.float64) / 1e6
    steps_s = np.diff(times_s)
    usual_s = float(np.median(steps_s)) if steps_s.size else 0.0
    return TopicInfo(
        name=name,
        rows=times_s.size,
        rate_hz=1.0 / usual_s if usual_s > 0.0 else None,
        longest_gap_s=float(steps_s.max()) if steps_s.size else None,
        first_s=float(times_s[0]),
        last_s=float(times_s[-1]),
    )


def _sources(content: Content) -> tuple[SourceInfo, ...]:
    frames = dict.fromkeys(content.lost_frames, 0)
    for table in content.tables.values():
        for sender in zip(table["system"].tolist(), table["component"].tolist(), strict=True):
            frames[sender] += 1
    return tuple(
        SourceInfo(system=system, component=component, frames=count, lost=content.lost_frames[system, component])
        for (system, component), count in sorted(frames.items())
    )
