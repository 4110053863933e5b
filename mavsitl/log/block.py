"""Rows gathered over a second and handed to their topics together: a tenth of the cost of appending each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mavsitl.frames import flip_vector
from mavsitl.log.topics import Topic
from mavsitl.log.ulog import Recorder

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
        self._targets = [(recorder.topic(topic), split) for topic, split in topics]
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

    def drain(self) -> None:
        """Hand over what was gathered."""
        count, self._count = self._count, 0
        if count:
            for rows, split in self._targets:
                rows.extend(self._stamps[:count], split(self._values[:count]))


def ned(vectors: Array) -> Array:
    """Rows of vectors (k, 3): world NWU to NED, body FLU to FRD."""
    return np.column_stack(flip_vector(*vectors.T))
