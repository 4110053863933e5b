"""Time: the only module that imports `time`. Cores get the time as an integer of microseconds and never ask for it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

__all__ = ["LatenessHistogram", "PacedClock", "SimulatedClock", "monotonic_us", "processor_s"]

SPIN_US = 60
"""The last stretch before a tick is waited for awake: the kernel wakes a sleeper about this much too late."""

CATCH_UP_US = 100_000
"""Wall time: a clock at most so far behind catches up, one further behind gives up what it lost.

Caught-up ticks fly on the setpoint that was there before them, so this is also how old a controller's word may get by
it: far below every time-out (COM_OF_LOSS_T, 1 s), and at 50 Hz five setpoints.
"""


def monotonic_us() -> int:
    """Wall time of a clock that never goes back, microseconds since an arbitrary instant."""
    return time.monotonic_ns() // 1000


def processor_s() -> float:
    """The processor's time that this process has used, seconds."""
    return time.process_time()


class SimulatedClock:
    """Time that passes when told to: for runs in memory and in lock-step."""

    def __init__(self, now_us: int = 0) -> None:
        self.now_us = now_us

    def advance(self, duration_us: int) -> int:
        """Let `duration_us` pass, at least 0, and return the new time, microseconds."""
        if duration_us < 0:
            raise ValueError(f"duration_us is {duration_us}; time does not go back")
        self.now_us += duration_us
        return self.now_us


class LatenessHistogram:
    """Quantiles of a lateness in fixed memory: eight bins an octave: a quantile reads at most 1/8 too high."""

    _SUBDIVISION_BITS = 3
    _OCTAVES = 40  # nanoseconds to 18 minutes

    def __init__(self) -> None:
        self.count = 0
        self.max_us = 0.0
        self._bins = [0] * (self._OCTAVES << self._SUBDIVISION_BITS)

    def add(self, lateness_ns: int) -> None:
        """Count one lateness, nanoseconds; a negative one counts as 0."""
        lateness_ns = max(0, lateness_ns)
        self.count += 1
        self.max_us = max(self.max_us, lateness_ns / 1000)
        self._bins[min(self._bin(lateness_ns), len(self._bins) - 1)] += 1

    def quantile_us(self, share: float) -> float:
        """The lateness that `share` (0 to 1) of all counted ones do not exceed, microseconds; 0 before the first."""
        wanted = math.ceil(share * self.count)
        if wanted == 0:
            return 0.0
        seen = 0
        for index, number in enumerate(self._bins):
            seen += number
            if seen >= wanted:
                return min(self._upper_edge_ns(index) / 1000, self.max_us)
        raise AssertionError("the bins hold every lateness that was counted")

    def copy(self) -> LatenessHistogram:
        """As it is now."""
        made = LatenessHistogram()
        made.count, made.max_us, made._bins = self.count, self.max_us, list(self._bins)
        return made

    def since(self, earlier: LatenessHistogram) -> LatenessHistogram:
        """What was counted after `earlier`, a copy of this one; its maximum is read off the bins, too."""
        made = LatenessHistogram()
        made.count = self.count - earlier.count
        made._bins = [now - before for now, before in zip(self._bins, earlier._bins, strict=True)]
        filled = [index for index, number in enumerate(made._bins) if number]
        made.max_us = min(self._upper_edge_ns(filled[-1]) / 1000, self.max_us) if filled else 0.0
        return made

    @property
    def p50_us(self) -> float:
        """Median lateness, microseconds."""
        return self.quantile_us(0.50)

    @property
    def p99_us(self) -> float:
        """Lateness that one tick in a hundred exceeds, microseconds."""
        return self.quantile_us(0.99)

    @classmethod
    def _bin(cls, lateness_ns: int) -> int:
        shift = max(0, lateness_ns.bit_length() - 1 - cls._SUBDIVISION_BITS)
        return (shift << cls._SUBDIVISION_BITS) + (lateness_ns >> shift)

    @classmethod
    def _upper_edge_ns(cls, index: int) -> int:
        """Largest lateness of a bin."""
        size = 1 << cls._SUBDIVISION_BITS
        if index < 2 * size:
            return index
        shift = index // size - 1
        return ((index - (shift << cls._SUBDIVISION_BITS) + 1) << shift) - 1


class PacedClock:
    """Simulated time held to wall time: tick k is due at ``origin + k * period / speed`` on the monotonic clock.

    The schedule is absolute, so single late ticks do not add up. A clock that is late returns at once and catches up by
    ticks without a wait. When it is more than `CATCH_UP_US` behind (a suspended process, an overloaded machine), the
    schedule is moved instead, and `rebased` and `lost_us` count it: simulated time neither jumps nor rushes.

    Attributes:
        now_us: simulated time, microseconds.
        lateness: how late `wait_until` returned against the schedule.
        rebased: times the schedule was moved.
        lost_us: wall time that was given up by that, microseconds.
    """

    def __init__(
        self,
        period_us: int,
        speed: float = 1.0,
        *,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        sleep_s: Callable[[float], None] = time.sleep,
    ) -> None:
        """`speed` is simulated over wall time. Raises `ValueError` for a period or speed that is not above 0."""
        if period_us <= 0:
            raise ValueError(f"period_us is {period_us}; allowed: above 0")
        if not 0.0 < speed < math.inf:
            raise ValueError(f"speed is {speed}; allowed: above 0 and finite")
        self.period_us = period_us
        self.speed = speed
        self.now_us = 0
        self.lateness = LatenessHistogram()
        self.rebased = 0
        self.lost_us = 0
        self._monotonic_ns = monotonic_ns
        self._sleep_s = sleep_s
        self._origin_ns = monotonic_ns()
        self._started_ns = self._origin_ns

    def start(self) -> None:
        """Let simulated time 0 be now: to be called after the set-up, right before the first tick."""
        self._origin_ns = self._started_ns = self._monotonic_ns()
        self.now_us = 0

    def tick(self) -> int:
        """Wait for the next period to begin and return its time, microseconds."""
        self.wait_until(self.now_us + self.period_us)
        return self.now_us

    def wait_until(self, tick_us: int) -> None:
        """Wait until simulated time `tick_us` is due. Raises `ValueError` for a time before `now_us`."""
        if tick_us < self.now_us:
            raise ValueError(f"tick_us is {tick_us}, before the clock's {self.now_us}")
        due_ns = self._origin_ns + round(tick_us * 1000 / self.speed)
        now_ns = self._monotonic_ns()
        while now_ns < due_ns:
            spare_ns = due_ns - now_ns - SPIN_US * 1000
            if spare_ns > 0:
                self._sleep_s(spare_ns * 1e-9)
            now_ns = self._monotonic_ns()
        self.lateness.add(now_ns - due_ns)
        if now_ns - due_ns > CATCH_UP_US * 1000:
            self._origin_ns += now_ns - due_ns
            self.rebased += 1
            self.lost_us += (now_ns - due_ns) // 1000
        self.now_us = tick_us

    def nap(self, seconds: float) -> None:
        """Sleep for so long, whatever is due."""
        self._sleep_s(seconds)

    def spare_s(self, tick_us: int) -> float:
        """Wall time until `wait_until` would wait for `tick_us` awake, seconds; 0 or less when there is none."""
        due_ns = self._origin_ns + round(tick_us * 1000 / self.speed)
        return (due_ns - self._monotonic_ns() - SPIN_US * 1000) * 1e-9

    def time_us(self) -> int:
        """Simulated time by the wall clock, microseconds: from the tick last waited for up to just before the next."""
        passed_us = int((self._monotonic_ns() - self._origin_ns) * self.speed) // 1000
        return min(max(passed_us, self.now_us), self.now_us + self.period_us - 1)

    @property
    def real_time_factor(self) -> float:
        """Simulated over wall time since the start, lost time included; 0 before any time has passed."""
        elapsed_ns = self._monotonic_ns() - self._started_ns
        return self.now_us * 1000 / elapsed_ns if elapsed_ns > 0 else 0.0


def unix_us() -> int:
    """Microseconds since 1970 by the system's clock, which may jump: for time stamps alone."""
    return time.time_ns() // 1000


def utc_stamp() -> str:
    """The wall clock in UTC, ISO 8601 to the second, for names and headers only."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
