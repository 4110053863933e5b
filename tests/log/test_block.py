"""Rows of a kernel go to their topics all, thinned, or where a condition holds; in order, none twice."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mavsitl.log.block import BLOCK_ROWS, Array, Group, Window
from mavsitl.log.topics import Topic
from mavsitl.log.ulog import MemoryRecorder

ALL, THIN, SOME = (Topic(name, ("float value",)) for name in ("all", "thin", "some"))


@given(
    rows=st.integers(0, 3 * BLOCK_ROWS),
    drains=st.sets(st.integers(0, 3 * BLOCK_ROWS)),
    period_us=st.sampled_from((1000, 4000, 20_000)),
)
def test_each_row_reaches_its_topics_once(rows: int, drains: set[int], period_us: int) -> None:
    log = MemoryRecorder()
    made: list[float] = []

    def newest(count: int) -> Array:
        return np.array(made[-count:])[:, None]

    def whole(v: Array) -> Array:
        return v

    groups = (
        Group(((ALL, whole),)),
        Group(((THIN, whole),), every_us=8000),
        Group(((SOME, whole),), when=lambda v: v[:, 0] % 3 == 0),
    )
    window = Window(log, groups, newest, period_us)
    for number in range(rows):
        made.append(float(number))
        window.take(number * period_us)
        if number in drains:
            window.drain()
    stamps = np.arange(rows) * period_us
    np.testing.assert_array_equal(log.arrays(ALL)["timestamp"], stamps)
    np.testing.assert_array_equal(log.arrays(ALL)["value"], np.arange(rows))
    np.testing.assert_array_equal(log.arrays(THIN)["timestamp"], stamps[stamps % 8000 < period_us])
    np.testing.assert_array_equal(log.arrays(SOME)["value"], np.arange(0, rows, 3))
    assert window.newest_us == (stamps[-1] if rows else 0)
