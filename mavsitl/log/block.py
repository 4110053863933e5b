"""Rows gathered over a second and handed to their topics together: a tenth of the cost of appending each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mavsitl.frames import flip_vector
from mavsitl.log.topics import Topic
from mavsitl.log.ulog import Recorder, Rows

Array: TypeAlias = NDArray[np.float64]
Split: TypeAlias = Callable[[Array], Array]
"""From the gathered rows (k, width) to a topic's values (k, fields flat)."""

BLOCK_ROWS = 320
"""More than the rows between two flushes of a flight in lock-step at 250 Hz, so that these are what hands over."""


class Group(NamedTuple):
    """Topics that take the same of the gathered rows."""

    topics: Sequence[tuple[Topic, Split]]
    when: Callable[[Array], NDArray[np.bool_]] | None = None
    """Of the gathered rows (k, width): which (k,) there is a row of; None: all."""
    every_us: int = 0
    """The first row of each such stretch of time alone; 0: all."""


class Block:
    """`row` gives the next row to fill; the topics get theirs when the block is full or the recorder is flushed."""

    def __init__(self, recorder: Recorder, width: int, topics: Sequence[tuple[Topic, Split]]) -> None:
        self._stamps: list[int] = []
        self._values = np.zeros((BLOCK_ROWS, width))
        self._targets = _targets(recorder, topics)
        recorder.attach(self.drain)

    def row(self, timestamp_us: int) -> Array:
        """The next row, (width,), to be filled before the next call."""
        if len(self._stamps) == BLOCK_ROWS:
            self.drain()
        stamps = self._stamps
        row: Array = self._values[len(stamps)]
        stamps.append(timestamp_us)
        return row

    def preset(self, columns: slice, values: Array) -> None:
        """From the next row on these columns hold these values, where who fills a row leaves them alone."""
        self.drain()
        self._values[:, columns] = values

    def drain(self) -> None:
        """Hand over what was gathered."""
        stamps, self._stamps = self._stamps, []
        if stamps and self._targets:
            times, values = np.array(stamps, dtype=np.uint64), self._values[: len(stamps)]
            with np.errstate(over="ignore"):
                for rows, split in self._targets:
                    rows.extend(times, split(values))


class Window:
    """As `Block`, of rows that something else keeps, a kernel say: what `take` is told of."""

    def __init__(
        self, recorder: Recorder, groups: Sequence[Group], newest: Callable[[int], Array], period_us: int
    ) -> None:
        """`newest(k)` gives the last k rows (k, width), the oldest first; k is at most `BLOCK_ROWS`.

        `period_us` is between two rows.
        """
        self._newest = newest
        self._period_us = period_us
        self._stamps: list[int] = []
        self._drained_us = 0
        self._groups = [(group, _targets(recorder, group.topics)) for group in groups] if recorder.keeps else []
        recorder.attach(self.drain)

    @property
    def newest_us(self) -> int:
        """Of the last row; 0 before the first."""
        return self._stamps[-1] if self._stamps else self._drained_us

    def take(self, timestamp_us: int) -> None:
        """There is one more row."""
        stamps = self._stamps
        stamps.append(timestamp_us)
        if len(stamps) == BLOCK_ROWS:
            self.drain()

    def drain(self) -> None:
        """Hand over what was taken."""
        stamps = self._stamps
        if not stamps:
            return
        self._stamps, self._drained_us = [], stamps[-1]
        if not self._groups:
            return
        times, values = np.array(stamps, dtype=np.uint64), self._newest(len(stamps))
        with np.errstate(over="ignore"):
            for group, targets in self._groups:
                taken_times, taken = times, values
                if group.every_us:
                    due = taken_times % group.every_us < self._period_us
                    taken_times, taken = taken_times[due], taken[due]
                if group.when is not None and not (chosen := group.when(taken)).all():
                    taken_times, taken = taken_times[chosen], taken[chosen]
                if len(taken):
                    for rows, split in targets:
                        rows.extend(taken_times, split(taken))


def _targets(recorder: Recorder, topics: Sequence[tuple[Topic, Split]]) -> list[tuple[Rows, Split]]:
    return [(recorder.topic(topic), split) for topic, split in topics] if recorder.keeps else []


def columns(first: int, end: int) -> Split:
    """Of the rows gathered, as they are."""
    return lambda rows: rows[:, first:end]


def ned(vectors: Array) -> Array:
    """Rows of vectors (k, 3): world NWU to NED, body FLU to FRD."""
    return np.column_stack(flip_vector(*vectors.T))
