"""Rows gathered over a second and handed to their topics together: a tenth of the cost of appending each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mavsitl.frames import flip_vector
from mavsitl.log.topics import Topic
from mavsitl.log.ulog import Recorder, Rows

Array: TypeAlias = NDArray[np.float64]
Split: TypeAlias = Callable[[Array], Array]
"""From the gathered rows (k, width) to a topic's values (k, fields flat)."""

BLOCK_ROWS = 250


class Block:
    """`row` gives the next row to fill; the topics get theirs when the block is full or the recorder is flushed."""

    def __init__(self, recorder: Recorder, width: int, topics: Sequence[tuple[Topic, Split]]) -> None:
        self._stamps = np.zeros(BLOCK_ROWS, dtype=np.uint64)
        self._values = np.zeros((BLOCK_ROWS, width))
        self._count = 0
        self._targets = _targets(recorder, topics)
        recorder.attach(self.drain)

    def row(self, timestamp_us: int) -> Array:
        """The next row, (width,), to be filled before the next call."""
        if self._count == BLOCK_ROWS:
            self.drain()
        index = self._count
        self._stamps[index] = timestamp_us
        self._count = index + 1
        row: Array = self._values[index]
        return row

    def preset(self, columns: slice, values: Array) -> None:
        """From the next row on these columns hold these values, where who fills a row leaves them alone."""
        self.drain()
        self._values[:, columns] = values

    def drain(self) -> None:
        """Hand over what was gathered."""
        count, self._count = self._count, 0
        if count:
            for rows, split in self._targets:
                rows.extend(self._stamps[:count], split(self._values[:count]))


class Window:
    """As `Block`, of rows that something else keeps, a kernel say: what `take` is told of."""

    def __init__(
        self, recorder: Recorder, topics: Sequence[tuple[Topic, Split]], newest: Callable[[int], Array]
    ) -> None:
        """`newest(k)` gives the last k rows (k, width), the oldest first; k is at most `BLOCK_ROWS`."""
        self._newest = newest
        self._stamps: list[int] = []
        self._targets = _targets(recorder, topics)
        recorder.attach(self.drain)

    def take(self, timestamp_us: int) -> None:
        """There is one more row."""
        stamps = self._stamps
        stamps.append(timestamp_us)
        if len(stamps) == BLOCK_ROWS:
            self.drain()

    def drain(self) -> None:
        """Hand over what was taken."""
        stamps, self._stamps = self._stamps, []
        if stamps and self._targets:
            times, values = np.array(stamps, dtype=np.uint64), self._newest(len(stamps))
            for rows, split in self._targets:
                rows.extend(times, split(values))


def _targets(recorder: Recorder, topics: Sequence[tuple[Topic, Split]]) -> list[tuple[Rows, Split]]:
    return [(recorder.topic(topic), split) for topic, split in topics] if recorder.keeps else []


def ned(vectors: Array) -> Array:
    """Rows of vectors (k, 3): world NWU to NED, body FLU to FRD."""
    return np.column_stack(flip_vector(*vectors.T))
