"""What the real-time benchmark leaves behind, and what it reads."""

from __future__ import annotations

import os
import sys

import pytest

from tests.bench import bench_realtime
from tests.bench.bench_realtime import Kept

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


def test_the_burners_end_with_their_context() -> None:
    with bench_realtime.burners(2) as burning:
        assert [each.poll() for each in burning] == [None, None]
    assert None not in [each.returncode for each in burning]


def test_a_burner_ends_when_the_benchmark_is_killed() -> None:
    """Its own parent gone, a child of another process finds another parent."""
    code = bench_realtime.BURNER.replace("os.getppid()\n", "-1\n")
    assert code != bench_realtime.BURNER
    exec(compile(code, "burner", "exec"), {})  # returns at once


def test_memory_is_read_in_its_kinds() -> None:
    memory = bench_realtime.memory_kb(os.getpid())
    assert memory["Rss"] >= memory["Pss"] >= memory["Anonymous"] > 0
    assert memory["Private_Clean"] + memory["Private_Dirty"] > 0


def test_the_table_shows_medians() -> None:
    runs = [Kept(1.0, 2.0, 0.03, 90.0, 70.0, 60.0, 50.0), Kept(3.0, 4.0, 0.05, 90.0, 70.0, 60.0, 50.0)]
    assert bench_realtime.lines({"idle": runs})[-1] == "| idle | 2 | 3 | 4.0% | 90 | 70 | 60 | 50 |"
