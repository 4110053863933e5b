"""Recorders: rows of topics into memory or into a ULog file, both packed alike, so that both give equal numbers.

ULog is PX4's log format (docs.px4.io, "ULog File Format"): definitions, then messages with a 3-byte header each.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Iterable, Mapping
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from mavsitl import __version__
from mavsitl.log.errors import Failed
from mavsitl.log.errors import LogError as LogError
from mavsitl.log.topics import DATA_MESSAGE, TOPICS, Topic
from mavsitl.scenario import Flight

if TYPE_CHECKING:
    from pyulog.core import ULog

MAGIC = b"ULog\x01\x12\x35\x01"
_BUFFER_BYTES = 1 << 18
_TEXT_BYTES = 4096
_RELEASE = 255
"""PX4's type of a version that is no alpha, beta or candidate."""
_DATA_FORMAT = 2
"""PX4's, of the fields' meaning: from 2 on positions are in degrees and metres, as double."""
_FRAME_DEFAULT = 2
"""Of a default: the airframe's, not the system's."""
NUMBERS = {
    "ver_sw_release": ("uint32_t", "<I"),
    "ver_data_format": ("uint32_t", "<I"),
    "time_ref_utc": ("int32_t", "<i"),
    "boot_time_utc_us": ("uint64_t", "<Q"),
}
_FLOAT_MAX = float(np.finfo(np.float32).max)


class _Sink:
    """A preallocated buffer and how much of it is filled."""

    __slots__ = ("buffer", "capacity", "offset")

    def __init__(self, capacity: int) -> None:
        self.buffer = bytearray(capacity)
        self.capacity = capacity
        self.offset = 0

    def make_room(self, size: int) -> None:
        """Called when `size` more bytes do not fit: grow."""
        self.capacity = max(2 * self.capacity, self.offset + size)
        grown = bytearray(self.capacity)
        grown[: self.offset] = self.buffer[: self.offset]
        self.buffer = grown


class Rows:
    """Where one topic's rows go. Packs straight into the buffer: no object is kept per row."""

    __slots__ = ("_body", "_header", "_id", "_pack_into", "_sink", "_size", "topic")

    def __init__(self, topic: Topic, message_id: int, sink: _Sink) -> None:
        self.topic = topic
        self._id = message_id
        self._sink = sink
        self._size = topic.message.size
        self._body = self._size - 3
        self._pack_into = topic.message.pack_into
        self._header = topic.header(message_id)

    def append(self, timestamp_us: int, *values: float) -> None:
        """One row; `values` are the topic's fields, arrays flat. A float beyond float32's range is logged as infinite.

        Raises struct.error for a wrong number of values, or for an integer out of range, and `LogError` when the
        buffer is full and the file cannot be written.
        """
        sink = self._sink
        size = self._size
        if sink.offset + size > sink.capacity:
            sink.make_room(size)
        offset = sink.offset
        try:
            self._pack_into(sink.buffer, offset, self._body, DATA_MESSAGE, self._id, timestamp_us, *values)
        except OverflowError:
            limited = [math.copysign(math.inf, v) if abs(v) > _FLOAT_MAX else v for v in values]
            self._pack_into(sink.buffer, offset, self._body, DATA_MESSAGE, self._id, timestamp_us, *limited)
        sink.offset = offset + size

    def extend(self, timestamps_us: npt.NDArray[np.uint64], values: npt.NDArray[np.float64]) -> None:
        """k rows: `timestamps_us` (k,), `values` (k, the topic's fields flat). As k times `append`."""
        sink, size = self._sink, self._size * len(timestamps_us)
        if sink.offset + size > sink.capacity:
            sink.make_room(size)
        self.topic.pack_into(sink.buffer, sink.offset, self._header, timestamps_us, values)
        sink.offset += size


class Recorder(Protocol):
    """What a wing logs to."""

    @property
    def keeps(self) -> bool:
        """False: every row is dropped, and need not be made."""

    def topic(self, topic: Topic) -> Rows:
        """The rows of `topic`; the same object each time."""

    def message(self, timestamp_us: int, level: int, text: str) -> None:
        """A line of text; `level` is MAV_SEVERITY, 0 (emergency) to 7 (debug)."""

    def begin(self, parameters: Mapping[str, float], defaults: Mapping[str, float]) -> None:
        """Before the first `topic`, `message` or `parameter`: all values in force, and what is their default here."""

    def parameter(self, name: str, value: float) -> None:
        """It was changed, after the newest row."""

    def attach(self, drain: Callable[[], None]) -> None:
        """`drain` is called before the rows are read, flushed or closed: for those who gather rows first."""


class MemoryRecorder:
    """Keeps everything in memory."""

    keeps = True

    def __init__(self) -> None:
        self._rows: dict[str, tuple[Rows, _Sink]] = {}
        self._drains: list[Callable[[], None]] = []
        self.messages: list[tuple[int, int, str]] = []
        """(timestamp us, level, text)"""
        self.parameters: dict[str, float] = {}
        """As they began."""
        self.changes: list[tuple[str, float]] = []
        """Of parameters, since."""

    def topic(self, topic: Topic) -> Rows:
        known = self._rows.get(topic.key)
        if known is None:
            sink = _Sink(4096 * topic.message.size)
            known = self._rows[topic.key] = (Rows(topic, len(self._rows), sink), sink)
        elif known[0].topic != topic:
            raise ValueError(f"{topic.name}: recorded already with other fields")
        return known[0]

    def message(self, timestamp_us: int, level: int, text: str) -> None:
        self.messages.append((timestamp_us, level, text))

    def begin(self, parameters: Mapping[str, float], defaults: Mapping[str, float]) -> None:
        self.parameters = dict(parameters)

    def parameter(self, name: str, value: float) -> None:
        self.changes.append((name, value))

    def attach(self, drain: Callable[[], None]) -> None:
        self._drains.append(drain)

    def arrays(self, topic: Topic) -> dict[str, npt.NDArray[Any]]:
        """A copy of the columns, scalars (k,), arrays (k, length), in the log's own types; k = 0 if never written."""
        for drain in self._drains:
            drain()
        rows, sink = self._rows.get(topic.key, (None, _Sink(0)))
        if rows is not None and rows.topic != topic:
            raise ValueError(f"{topic.name}: recorded with other fields")
        return topic.arrays(sink.buffer, sink.offset // topic.message.size)

    def tables(self) -> dict[str, dict[str, npt.NDArray[Any]]]:
        """Every topic that has rows, as `read` gives it."""
        for drain in self._drains:
            drain()
        return {name: self.arrays(rows.topic) for name, (rows, sink) in self._rows.items() if sink.offset}


class _FileSink(_Sink):
    """Drains into a file when full. Whole messages only, so what is on disk is always readable."""

    __slots__ = ("_ended", "_failed", "_file", "_path")

    def __init__(self, path: Path, capacity: int, failed: Failed | None = None) -> None:
        super().__init__(capacity)
        self._path = path
        self._failed = failed
        self._ended = False
        try:
            self._file: FileIO | None = path.open("wb", buffering=0)
        except OSError as error:
            raise _write_error(path, error) from error

    def write(self, data: bytes) -> None:
        size = len(data)
        if self.offset + size > self.capacity:
            self.make_room(size)
        self.buffer[self.offset : self.offset + size] = data
        self.offset += size

    def make_room(self, size: int) -> None:
        self.drain()
        if size > self.capacity:
            super().make_room(size)

    def drain(self) -> None:
        """Raises `LogError`, and then closes the file: what comes after a torn message would not be readable."""
        if self._ended:
            self.offset = 0
            return
        file = self._file
        if file is None:
            raise LogError(f"{self._path}: cannot be written: it is closed")
        written = 0
        try:
            with memoryview(self.buffer) as view:
                while written < self.offset:
                    written += file.write(view[written : self.offset])
        except OSError as error:
            self._file = None
            file.close()
            failure = _write_error(self._path, error)
            if self._failed is None:
                raise failure from error
            self._ended = True
            self._failed(failure)
        self.offset = 0

    def close(self) -> None:
        if self._file is None:
            return
        self.drain()
        file, self._file = self._file, None
        if file is None:  # that was its end
            return
        try:
            file.close()
        except OSError as error:
            raise _write_error(self._path, error) from error


class UlogWriter:
    """Writes a ULog file: definitions at once, subscriptions with what comes first, then rows in the order in which
    they came.

    `info` holds texts and numbers by PX4's keys (sys_name, ver_sw, ...); `parameters` are logged as float, an int value
    as int32_t; `topics` are those that may be asked for. Raises `LogError` when the file cannot be written.
    """

    keeps = True

    def __init__(
        self,
        path: Path,
        info: Mapping[str, str | int],
        parameters: Mapping[str, float],
        *,
        topics: Iterable[Topic] = TOPICS,
        start_us: int = 0,
        failed: Failed | None = None,
    ) -> None:
        """`failed` is told, once, when the file cannot be written any more, and the log ends there; None: raise."""
        self.path = path
        asked = tuple(topics)
        self._drains: list[Callable[[], None]] = []
        parts = [MAGIC + struct.pack("<Q", start_us), _message("B", bytes(40))]
        parts += [_message("F", text.encode("ascii")) for text in dict.fromkeys(topic.ulog_format for topic in asked)]
        parts += [_message("I", _information(key, value)) for key, value in info.items()]
        parts += [_message("P", _parameter(*each)) for each in parameters.items()]
        self._sink = _FileSink(path, _BUFFER_BYTES, failed)
        self._rows = {topic.key: Rows(topic, message_id, self._sink) for message_id, topic in enumerate(asked)}
        self._subscribed = False
        self._sink.write(b"".join(parts))
        self._sink.drain()

    def begin(self, parameters: Mapping[str, float], defaults: Mapping[str, float]) -> None:
        """As in PX4's logs a default is written where it is not the value."""
        if self._subscribed:
            raise ValueError("parameters begin before the first row")
        parts = [_message("P", _parameter(*each)) for each in parameters.items()]
        others = ((name, value) for name, value in defaults.items() if parameters.get(name) != value)
        parts += [_message("Q", bytes([_FRAME_DEFAULT]) + _parameter(*each)) for each in others]
        self._sink.write(b"".join(parts))

    def parameter(self, name: str, value: float) -> None:
        """Readers take the newest row's time for it, so those that wait go first."""
        self._subscribe()
        for drain in self._drains:
            drain()
        self._sink.write(_message("P", _parameter(name, value)))

    def _subscribe(self) -> None:
        """Here the definitions end."""
        if self._subscribed:
            return
        self._subscribed = True
        for message_id, rows in enumerate(self._rows.values()):
            head = struct.pack("<BH", rows.topic.instance, message_id)
            self._sink.write(_message("A", head + rows.topic.name.encode("ascii")))
        self._sink.drain()  # so that a kill leaves them whole

    def topic(self, topic: Topic) -> Rows:
        self._subscribe()
        rows = self._rows.get(topic.key)
        if rows is None or (rows.topic is not topic and rows.topic != topic):
            raise ValueError(f"{topic.name}: not among the topics that this file was opened with")
        return rows

    def message(self, timestamp_us: int, level: int, text: str) -> None:
        if not 0 <= level <= 7:
            raise ValueError(f"level {level}: 0 (emergency) to 7 (debug) is allowed")
        self._subscribe()
        body = text.encode("utf-8")[:_TEXT_BYTES].decode("utf-8", "ignore").encode("utf-8")
        self._sink.write(_message("L", struct.pack("<BQ", ord("0") + level, timestamp_us) + body))

    def flush(self) -> None:
        """Hand the rows to the system, which keeps them whatever becomes of the process."""
        self._subscribe()
        for drain in self._drains:
            drain()
        self._sink.drain()

    def attach(self, drain: Callable[[], None]) -> None:
        self._drains.append(drain)

    def close(self) -> None:
        """Write what is left. More than once is harmless."""
        self._subscribe()
        drains, self._drains = self._drains, []
        for drain in drains:
            drain()
        self._sink.close()

    def __enter__(self) -> UlogWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read(path: Path) -> dict[str, dict[str, npt.NDArray[Any]]]:
    """Topic key -> column -> values: scalars (k,), array fields (k, length), as in `MemoryRecorder.tables`.

    Topics without rows are left out. A file that was cut off is read up to the cut. Raises `LogError`.
    """
    return read_ulog(path)[1]


def read_ulog(path: Path) -> tuple[ULog, dict[str, dict[str, npt.NDArray[Any]]]]:
    """As pyulog has it, and as `read`. Raises `LogError`."""
    from pyulog.core import ULog, ULogException

    try:
        with path.open("rb") as file:
            log = ULog(file, disable_str_exceptions=False)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ULogException, UnicodeDecodeError, struct.error) as error:
        raise LogError(f"{path}: not a ULog file: {error}") from error
    if log.file_corruption:
        why = "damaged" if log.data_list else "damaged, or cut before the first row"
        raise LogError(f"{path}: {why}: a message in it is not valid ULog")
    return log, {Topic(data.name, (), data.multi_id).key: _columns(data.data) for data in log.data_list}


def _columns(flat: dict[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
    """pyulog's ``q[0]``, ``q[1]``, ... put together as ``q`` (k, length)."""
    grouped: dict[str, list[npt.NDArray[Any]]] = {}
    scalars: dict[str, npt.NDArray[Any]] = {}
    for name, values in flat.items():
        base, bracket, _ = name.partition("[")
        if bracket:
            grouped.setdefault(base, []).append(values)
        else:
            scalars[name] = values
    return scalars | {name: np.stack(columns, axis=1) for name, columns in grouped.items()}


def _message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def information(flight: Flight, boot_us: int | None = None) -> dict[str, str | int]:
    """What a log says of itself, by PX4's keys and `scenario` and `seed`.

    `boot_us`: UNIX time at its zero; None in lock-step, where a flight is the same at any time.
    """
    major, minor, patch = (int(part) for part in re.findall(r"\d+", __version__)[:3])
    found: dict[str, str | int] = {
        "sys_name": "mavsitl",
        "ver_hw": "SITL",
        "ver_sw": __version__,
        "ver_sw_release": major << 24 | minor << 16 | patch << 8 | _RELEASE,
        "ver_data_format": _DATA_FORMAT,
        "time_ref_utc": 0,
        "scenario": flight.name,
        "seed": str(flight.scenario.seed),
    }
    return found if boot_us is None else found | {"boot_time_utc_us": boot_us}


def _information(key: str, value: str | int) -> bytes:
    if isinstance(value, int):
        kind, code = NUMBERS[key]
        return _keyed(f"{kind} {key}", struct.pack(code, value))
    text = value.encode("utf-8")
    return _keyed(f"char[{len(text)}] {key}", text)


def _parameter(name: str, value: float) -> bytes:
    if isinstance(value, int):
        return _keyed(f"int32_t {name}", struct.pack("<i", value))
    return _keyed(f"float {name}", struct.pack("<f", value))


def _keyed(declaration: str, value: bytes) -> bytes:
    key = declaration.encode("ascii")
    return bytes([len(key)]) + key + value


def _write_error(path: Path, error: OSError) -> LogError:
    return LogError(f"{path}: cannot be written: {error.strerror or error}")
