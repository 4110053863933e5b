"""When the entries of a scenario's time line are due, by the flight's clock or by the simulation's."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, TypeAlias

Clock: TypeAlias = Literal["flight", "simulated"]

_HALF_US = 0.5e-6
"""Times are whole microseconds, in seconds: what rounding takes off is no lateness."""


class Schedule:
    """Each entry is due once; one by the flight's clock, once in each flight."""

    def __init__(self, entries: Iterable[tuple[float, Clock]]) -> None:
        """When each begins, in seconds, and by which clock."""
        self._entries = tuple(entries)
        self._done: set[int] = set()
        self._last_flight_s = -1.0

    def due(self, now_us: int, flight_time_s: float) -> list[int]:
        """Numbers of the entries that begin by `now_us` since the start; the flight's time is negative before the
        release.
        """
        if flight_time_s < 0.0 <= self._last_flight_s:
            self._done = {number for number in self._done if self._entries[number][1] == "simulated"}
        self._last_flight_s = flight_time_s
        found = []
        for number, (start_s, clock) in enumerate(self._entries):
            time_s = flight_time_s if clock == "flight" else now_us * 1e-6
            if number not in self._done and time_s >= 0.0 and time_s + _HALF_US >= start_s:
                found.append(number)
        self._done.update(found)
        return found
