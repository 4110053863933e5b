"""What a craft under test logs: in memory for the test, and in files for whoever looks into a failure."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mavsitl.ends import WIRE_LOG
from mavsitl.log.flight import GROUND_LOG, VEHICLE_LOG, open_ulog
from mavsitl.log.tlog import TlogWriter
from mavsitl.log.topics import Topic
from mavsitl.log.ulog import MemoryRecorder, Rows, UlogWriter
from mavsitl.scenario import Flight

__all__ = ["LOG_NAMES", "Logs", "Recording"]

SCENARIO_FILE = "scenario.toml"
LOG_NAMES = (VEHICLE_LOG, GROUND_LOG, WIRE_LOG, SCENARIO_FILE)
"""All that `Logs` writes into its folder."""


class _Both:
    """A topic's rows, in memory and in the file; and the newest that was appended by itself."""

    __slots__ = ("_file", "_memory", "newest")

    def __init__(self, memory: Rows, file: Rows | None) -> None:
        self._memory = memory
        self._file = file
        self.newest: tuple[float, ...] = ()

    def append(self, timestamp_us: int, *values: float) -> None:
        self.newest = values
        self._memory.append(timestamp_us, *values)
        if self._file is not None:
            self._file.append(timestamp_us, *values)

    def extend(self, timestamps_us: npt.NDArray[np.uint64], values: npt.NDArray[np.float64]) -> None:
        self._memory.extend(timestamps_us, values)
        if self._file is not None:
            self._file.extend(timestamps_us, values)


class Recording:
    """A `mavsitl.log.ulog.Recorder` that keeps everything in memory, and in a file as well where it has one."""

    keeps = True

    def __init__(self, file: UlogWriter | None = None) -> None:
        self.memory = MemoryRecorder()
        self._file = file
        self._rows: dict[str, _Both] = {}

    def topic(self, topic: Topic) -> Any:
        rows = self._rows.get(topic.key)
        if rows is None:
            file = None if self._file is None else self._file.topic(topic)
            rows = self._rows[topic.key] = _Both(self.memory.topic(topic), file)
        return rows

    def newest(self, topic: Topic) -> tuple[float, ...]:
        """The fields of the last row that was appended; empty before the first."""
        rows = self._rows.get(topic.key)
        return () if rows is None else rows.newest

    def message(self, timestamp_us: int, level: int, text: str) -> None:
        self.memory.message(timestamp_us, level, text)
        if self._file is not None:
            self._file.message(timestamp_us, level, text)

    def begin(self, parameters: Mapping[str, float], defaults: Mapping[str, float]) -> None:
        self.memory.begin(parameters, defaults)
        if self._file is not None:
            self._file.begin(parameters, defaults)

    def parameter(self, name: str, value: float) -> None:
        self.memory.parameter(name, value)
        if self._file is not None:
            self._file.parameter(name, value)

    def attach(self, drain: Callable[[], None]) -> None:
        self.memory.attach(drain)
        if self._file is not None:
            self._file.attach(drain)


class Logs:
    """The files of one craft in a folder of theirs: `vehicle.ulg`, of a flight `ground.ulg`, `link.tlog`, the scenario.

    Raises `LogError` where they cannot be written.
    """

    def __init__(self, folder: Path, flight: Flight, *, ground: bool) -> None:
        from mavsitl.tune import toml

        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        for name in LOG_NAMES:
            (folder / name).unlink(missing_ok=True)
        head = f"What {folder.name} of a test was set up with; faults that the test asked for are not in it."
        (folder / SCENARIO_FILE).write_text(toml.write(flight.scenario, head=head), "utf-8")
        self.vehicle = open_ulog(folder, "vehicle", flight)
        self.ground = open_ulog(folder, "ground", flight) if ground else None
        self.wire = TlogWriter(folder / WIRE_LOG)

    def flush(self) -> None:
        for each in (self.vehicle, self.ground, self.wire):
            if each is not None:
                each.flush()

    def close(self) -> None:
        """More than once is harmless."""
        for each in (self.vehicle, self.ground, self.wire):
            if each is not None:
                each.close()

    def remove(self) -> None:
        """Close the files and delete them, and the folder where nothing else is in it."""
        self.close()
        for name in LOG_NAMES:
            (self.folder / name).unlink(missing_ok=True)
        if not any(self.folder.iterdir()):
            self.folder.rmdir()
