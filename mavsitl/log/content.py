"""What logs hold, whichever kind they are: a ULog, a tlog, or the folder of a run."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from mavsitl.log.errors import LogError, NoLogError
from mavsitl.log.flight import GROUND_LOG, VEHICLE_LOG
from mavsitl.log.topics import Topic
from mavsitl.log.ulog import MAGIC, read_ulog

Table: TypeAlias = Mapping[str, npt.NDArray[Any]]
"""Column to values: scalars (k,), arrays (k, length), texts; ``timestamp`` (us) is the first."""

Kind = Literal["ULog", "tlog"]

WIRE_LOG = "link.tlog"
RUN_LOGS = (VEHICLE_LOG, GROUND_LOG, WIRE_LOG)
VEHICLE_FOLDER = re.compile("vehicle-([0-9]{1,3})")
"""Of a fleet's vehicle: the instance, its system id less 1."""
NAMED = 9
"""Flights that an error lists."""

_STAMP = struct.Struct(">Q")
_MAVLINK = {0xFE: 8, 0xFD: 12}
"""Magic byte to the bytes around a payload."""
_SIGNATURE_BYTES = 13


@dataclass(frozen=True, eq=False)
class Content:
    """A log, read."""

    path: Path
    kind: Kind
    size_bytes: int
    tables: Mapping[str, Table]
    """By `Topic.key`; of a tlog by the message's name, with the columns ``system`` and ``component``."""
    left_over_bytes: int = 0
    """At its end, of a message that is not whole: it was cut."""
    information: Mapping[str, str | int] = field(default_factory=dict)
    parameters: Mapping[str, float] = field(default_factory=dict)
    """As they were at the beginning."""
    defaults: Mapping[str, float] = field(default_factory=dict)
    """Where they differ from that."""
    changes: tuple[tuple[int, str, float], ...] = ()
    """Of parameters: (us, name, value)."""
    texts: tuple[tuple[int, str, str], ...] = ()
    """(us, level, text)"""
    dropouts_ms: tuple[int, ...] = ()
    """Gaps that the writer of a ULog knew of."""
    bad_frames: int = 0
    """Of a tlog: those with a wrong checksum, or of no known message."""
    lost_frames: Mapping[tuple[int, int], int] = field(default_factory=dict)
    """Of a tlog: missing by their sequence numbers, by (system, component)."""

    @property
    def start_us(self) -> int:
        return min((int(table["timestamp"][0]) for table in self.tables.values()), default=0)

    @property
    def end_us(self) -> int:
        return max((int(table["timestamp"][-1]) for table in self.tables.values()), default=0)


def flights_of(folder: Path) -> tuple[Path, ...]:
    """The folders with the logs of one vehicle each: this, or those of a run's flights; of a fleet each vehicle's.

    In the order of their names, ``vehicle-2`` before ``vehicle-10``. Empty where there is none.
    """
    if _has_logs(folder):
        return (folder,)
    found: list[Path] = []
    for entry in _folders(folder):
        if _has_logs(entry):
            found.append(entry)
        else:
            found += [each for each in _folders(entry) if VEHICLE_FOLDER.fullmatch(each.name) and _has_logs(each)]
    return tuple(found)


def is_fleet(flights: Sequence[Path]) -> bool:
    """Whether folders of `flights_of` are of vehicles that flew together."""
    alike = len({each.parent for each in flights}) == 1
    return len(flights) > 1 and alike and all(VEHICLE_FOLDER.fullmatch(each.name) for each in flights)


def _has_logs(folder: Path) -> bool:
    return any((folder / name).is_file() for name in RUN_LOGS)


def _folders(folder: Path) -> list[Path]:
    def in_order(each: Path) -> list[str | int]:
        return [int(part) if part.isdecimal() else part for part in re.split("([0-9]+)", each.name)]

    return sorted((each for each in folder.iterdir() if each.is_dir()), key=in_order)


def logs_of(path: Path) -> tuple[Path, ...]:
    """The logs that a path names: itself, or those in the folder of a flight, or of a run of one flight.

    Raises `LogError` for what is not there, for a folder without logs, and where there are several flights or vehicles.
    """
    if not path.is_dir():
        if not path.exists():
            raise NoLogError(f"{path}: no such file or folder")
        return (path,)
    flights = flights_of(path)
    if not flights:
        raise NoLogError(
            f"{path}: a folder without logs; expected {', '.join(RUN_LOGS)}, or a run with them in a folder"
        )
    if len(flights) > 1:
        what = f"a fleet of {len(flights)} vehicles, choose one" if is_fleet(flights) else "a run of several flights"
        named = [str(each) for each in flights]
        shown = named if len(named) <= NAMED else [*named[: NAMED - 2], "...", named[-1]]
        raise NoLogError(f"{path}: {what}; allowed: {', '.join(shown)}")
    return tuple(flights[0] / name for name in RUN_LOGS if (flights[0] / name).is_file())


def load(path: Path) -> Content:
    """A ULog or tlog, by what is in it. Raises `LogError` for a file that is neither, is empty or damaged."""
    try:
        with path.open("rb") as file:
            head = file.read(16)
        size = path.stat().st_size
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not head:
        raise LogError(f"{path}: empty: nothing was logged")
    if head.startswith(MAGIC[:7]):
        return _load_ulog(path, size)
    if len(head) > _STAMP.size and head[_STAMP.size] in _MAVLINK:
        return _load_tlog(path, size)
    raise NoLogError(f"{path}: neither a ULog nor a tlog")


def joined(path: Path) -> Content:
    """What a path names as one log: a run's ULogs together, its tlog left out.

    A topic that both ends have keeps its key for the vehicle's; the ground's gets the next free instance. What the
    ground alone tells keeps its key. Raises as `logs_of` and `load`.
    """
    paths = logs_of(path)
    if len(paths) == 1:
        return load(paths[0])
    first, *others = [load(each) for each in paths if each.name != WIRE_LOG]
    tables, texts, left_over = dict(first.tables), list(first.texts), first.left_over_bytes
    for other in others:
        for key, table in other.tables.items():
            name, _, number = key.partition(".")
            instance = int(number or 0)
            while Topic(name, (), instance).key in tables:
                instance += 1
            tables[Topic(name, (), instance).key] = table
        texts += other.texts
        left_over += other.left_over_bytes
    size = sum(each.size_bytes for each in (first, *others))
    return replace(
        first, path=path, size_bytes=size, tables=tables, texts=tuple(sorted(texts)), left_over_bytes=left_over
    )


def _load_ulog(path: Path, size: int) -> Content:
    log, tables = read_ulog(path)
    return Content(
        path=path,
        kind="ULog",
        size_bytes=size,
        tables=tables,
        left_over_bytes=_left_over(path),
        information=dict(log.msg_info_dict),
        parameters=dict(log.initial_parameters),
        defaults={name: value for kind in range(2) for name, value in log.get_default_parameters(kind).items()},
        changes=tuple((int(us), str(name), value) for us, name, value in log.changed_parameters),
        texts=tuple((int(each.timestamp), each.log_level_str(), each.message) for each in log.logged_messages),
        dropouts_ms=tuple(int(each.duration) for each in log.dropouts),
    )


def _left_over(path: Path) -> int:
    """Bytes after the last whole message."""
    data = path.read_bytes()
    at, size = len(MAGIC) + 8, len(data)
    while at + 3 <= size:
        end = at + 3 + (data[at] | data[at + 1] << 8)
        if end > size:
            break
        at = end
    return size - at


@dataclass
class _Received:
    """The rows of one kind of message as they come."""

    names: tuple[str, ...]
    rows: list[tuple[Any, ...]] = field(default_factory=list)


def _load_tlog(path: Path, size: int) -> Content:
    from mavsitl.codec import parse

    received: dict[str, _Received] = {}
    newest: dict[tuple[int, int], int] = {}
    lost: dict[tuple[int, int], int] = {}
    bad = end = 0
    data = path.read_bytes()
    for at, frame in _frames(data):
        end = at + _STAMP.size + len(frame)
        good = parse(frame)
        if not good:
            bad += 1
            continue
        message, sender = good[0].message, (good[0].system_id, good[0].component_id)
        missing = (good[0].sequence - newest[sender] - 1) % 256 if sender in newest else 0
        newest[sender] = good[0].sequence
        lost[sender] = lost.get(sender, 0) + missing
        kind = message.get_type()
        if kind not in received:
            received[kind] = _Received(tuple(message.get_fieldnames()))
        known = received[kind]
        known.rows.append((_STAMP.unpack_from(data, at)[0], *sender, *(getattr(message, name) for name in known.names)))
    if not received:
        raise NoLogError(f"{path}: neither a ULog nor a tlog: no MAVLink frame in it is whole")
    return Content(
        path=path,
        kind="tlog",
        size_bytes=size,
        tables={kind: _table(each) for kind, each in sorted(received.items())},
        left_over_bytes=size - end,
        bad_frames=bad,
        lost_frames=lost,
    )


def _frames(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(where its stamp is, frame), up to what is cut, or is no frame."""
    at, size = 0, len(data)
    while at + _STAMP.size + 3 <= size:
        begin = at + _STAMP.size
        around = _MAVLINK.get(data[begin])
        if around is None:
            return
        length = around + data[begin + 1] + (_SIGNATURE_BYTES if around == 12 and data[begin + 2] & 1 else 0)
        if begin + length > size:
            return
        yield at, data[begin : begin + length]
        at = begin + length


def _table(received: _Received) -> Table:
    stamps, systems, components, *fields = zip(*received.rows, strict=True)
    own = {"timestamp": np.array(stamps, np.uint64), "system": np.array(systems), "component": np.array(components)}
    names = (f"{name}_" if name in own else name for name in received.names)
    return own | {name: _column(values) for name, values in zip(names, fields, strict=True)}


def _column(values: tuple[Any, ...]) -> npt.NDArray[Any]:
    if isinstance(values[0], bytes):  # some of char arrays
        return np.array([each.decode("utf-8", "replace") for each in values])
    return np.array(values)


def flat(table: Table) -> dict[str, npt.NDArray[Any]]:
    """Columns of numbers and texts alone: ``q`` (k, 4) as ``q[0]`` to ``q[3]``."""
    columns: dict[str, npt.NDArray[Any]] = {}
    for name, values in table.items():
        if values.ndim == 1:
            columns[name] = values
        else:
            columns |= {f"{name}[{index}]": values[:, index] for index in range(values.shape[1])}
    return columns
