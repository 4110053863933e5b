"""Clocks, on wall time that the test makes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl.clock import CATCH_UP_US, SPIN_US, LatenessHistogram, PacedClock, SimulatedClock, monotonic_us


class Wall:
    """Wall time that passes by 1 us with each look at it, and with each sleep, which lasts `oversleep_ns` too long."""

    def __init__(self, oversleep_ns: int = 50_000) -> None:
        self.ns = 5_000_000_000
        self.oversleep_ns = oversleep_ns
        self.sleeps_s: list[float] = []

    def monotonic_ns(self) -> int:
        self.ns += 1000
        return self.ns

    def sleep_s(self, duration_s: float) -> None:
        self.sleeps_s.append(duration_s)
        self.ns += round(duration_s * 1e9) + self.oversleep_ns

    def clock(self, period_us: int = 4000, speed: float = 1.0) -> PacedClock:
        return PacedClock(period_us, speed, monotonic_ns=self.monotonic_ns, sleep_s=self.sleep_s)


def test_simulated_time_passes_when_told() -> None:
    clock = SimulatedClock(100)
    assert clock.advance(4000) == clock.now_us == 4100
    assert clock.advance(0) == 4100
    with pytest.raises(ValueError, match="time does not go back"):
        clock.advance(-1)


def test_monotonic_time_does_not_go_back() -> None:
    assert monotonic_us() <= monotonic_us()


@pytest.mark.parametrize("speed", [0.5, 1.0, 8.0])
def test_ticks_keep_to_the_absolute_schedule(speed: float) -> None:
    wall = Wall()
    clock = wall.clock(speed=speed)
    start_ns = wall.ns
    for k in range(1, 251):
        assert clock.tick() == clock.now_us == 4000 * k
        late_ns = wall.ns - start_ns - round(4_000_000 * k / speed)
        assert 0 <= late_ns <= 2000
    assert clock.rebased == 0
    assert clock.lateness.count == 250
    assert clock.lateness.max_us <= 2.0
    assert clock.real_time_factor == pytest.approx(speed, rel=1e-3)
    assert len(wall.sleeps_s) == 250


def test_the_last_stretch_is_waited_for_awake() -> None:
    wall = Wall(oversleep_ns=0)
    clock = wall.clock(period_us=SPIN_US)
    clock.tick()
    assert wall.sleeps_s == []
    clock.wait_until(1000 + SPIN_US)
    assert sum(wall.sleeps_s) <= (1000 - SPIN_US) * 1e-6 + 1e-5


def test_a_late_clock_catches_up_without_waiting() -> None:
    wall = Wall()
    clock = wall.clock()
    wall.ns += 40_000_000
    for _ in range(9):
        clock.tick()
    assert wall.sleeps_s == []
    for _ in range(2):
        clock.tick()
    assert len(wall.sleeps_s) > 0
    assert clock.rebased == 0
    assert clock.lateness.max_us == pytest.approx(36_000, abs=10)


@pytest.mark.parametrize("behind_s", [0.105, 0.9, 5.0])
def test_a_clock_far_behind_moves_its_schedule(behind_s: float) -> None:
    """What is caught up stays far below the shortest time-out: a suspended process is no lost controller."""
    wall = Wall()
    clock = wall.clock()
    clock.tick()
    wall.ns += round(behind_s * 1e9)
    assert clock.tick() == 8000
    assert clock.rebased == 1
    assert clock.lost_us == pytest.approx(behind_s * 1e6 - 4000, abs=10)
    for _ in range(10):
        clock.tick()
    assert clock.now_us == 48_000
    assert clock.rebased == 1
    assert len(wall.sleeps_s) == 11
    assert clock.lateness.quantile_us(0.9) < 10
    assert clock.lateness.max_us > CATCH_UP_US
    assert clock.real_time_factor == pytest.approx(0.048 / (0.044 + behind_s), rel=0.01)


def test_start_forgets_the_time_before_it() -> None:
    wall = Wall()
    clock = wall.clock()
    wall.ns += 800_000_000
    clock.start()
    clock.tick()
    assert clock.lateness.max_us < 10


def test_time_before_now_and_odd_settings_are_refused() -> None:
    clock = Wall().clock()
    clock.tick()
    with pytest.raises(ValueError, match="tick_us is 3999"):
        clock.wait_until(3999)
    for period_us, speed in ((0, 1.0), (-4000, 1.0), (4000, 0.0), (4000, float("inf")), (4000, float("nan"))):
        with pytest.raises(ValueError, match="allowed: above 0"):
            PacedClock(period_us, speed)


@given(st.lists(st.integers(-1000, 1 << 42), min_size=1, max_size=60), st.sampled_from([0.01, 0.5, 0.99, 1.0]))
def test_a_quantile_is_at_most_an_eighth_too_high(latenesses_ns: list[int], share: float) -> None:
    histogram = LatenessHistogram()
    for lateness_ns in latenesses_ns:
        histogram.add(lateness_ns)
    ordered = sorted(min(max(0, ns), 1 << 41) for ns in latenesses_ns)
    exact_us = ordered[max(0, -int(-share * len(ordered) // 1) - 1)] / 1000
    found_us = histogram.quantile_us(share)
    assert histogram.count == len(latenesses_ns)
    assert histogram.max_us == max(0, *latenesses_ns, 0) / 1000
    if found_us < 1e9:
        assert exact_us <= found_us <= exact_us * 1.125 + 1e-9


def test_an_empty_histogram_reads_zero() -> None:
    histogram = LatenessHistogram()
    assert (histogram.p50_us, histogram.p99_us, histogram.max_us) == (0.0, 0.0, 0.0)
