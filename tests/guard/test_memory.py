"""A control period gives back what it takes, at once: the collector of cycles finds nothing to do in steady flight."""

from __future__ import annotations

import gc
import sys
from typing import Any

from tests.guard.counts import PERIODS, steady_flight

KEPT_BLOCKS = 4.0
"""Blocks of Python's allocator a period; measured: 0.9, of what the logs gather and statistics count."""


class Blocks:
    """Blocks that were taken and not given back inside the `with`, and unreachable objects left behind."""

    def __enter__(self) -> None:
        self._collecting = gc.isenabled()
        gc.collect()
        gc.disable()
        self.kept = -sys.getallocatedblocks()

    def __exit__(self, *error: object) -> None:
        self.kept += sys.getallocatedblocks()
        self.unreachable = gc.collect()
        if self._collecting:
            gc.enable()


def test_a_control_period_leaves_no_garbage_and_keeps_nothing() -> None:
    blocks = Blocks()
    steady_flight(blocks)
    assert blocks.unreachable == 0
    assert blocks.kept / PERIODS < KEPT_BLOCKS


def test_cycles_and_kept_objects_would_be_seen() -> None:
    kept: list[Any] = []

    def careless(vehicle: Any, ground: Any) -> None:
        step = ground.step

        def stepped(now_us: int) -> None:
            cycle: list[Any] = [now_us]
            cycle.append(cycle)
            kept.append((now_us, [], [], []))
            step(now_us)

        ground.step = stepped

    blocks = Blocks()
    steady_flight(blocks, change=careless)
    assert blocks.unreachable >= PERIODS
    assert blocks.kept / PERIODS > KEPT_BLOCKS
