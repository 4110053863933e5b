"""The flights of a tuning: for each candidate every scenario under every seed, flown by a campaign's workers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import msgspec

from mavsitl.campaign.fly import Row
from mavsitl.campaign.grid import Case, case
from mavsitl.campaign.store import Journal
from mavsitl.campaign.workers import Workers, fly_all
from mavsitl.scenario import Flight, load
from mavsitl.tune.objective import Score, Six, score
from mavsitl.tune.space import Overrides, Space

FlyAll: TypeAlias = Callable[[Sequence[Case]], Iterator[Row]]
"""A row for each case, in any order; cases of one key once."""


def kept(journal: Journal, workers: Workers, flown: Callable[[], None] = lambda: None) -> FlyAll:
    """Flies what is not in the journal, and keeps it there. `flown` is told of each flight, flown or found."""

    def each_once(cases: Sequence[Case]) -> Iterator[Row]:
        found = {key: row for key, row in journal.rows.items() if row.repeatable}
        for each in cases:
            if each.key in found:
                flown()
                yield found[each.key]
        for row in fly_all([each for each in cases if each.key not in found], workers):
            journal.add(row)
            flown()
            yield row

    return each_once


@dataclass(frozen=True)
class Flights:
    """What a candidate flies."""

    names: tuple[str, ...]
    """Scenarios by name or path."""
    settings: Overrides
    """Changes to all of them."""
    space: Space
    seeds: tuple[int, ...]
    scales: tuple[Six, ...]
    """A scenario each: what the RMSE of each state is divided by."""
    duration_s: float | None = None
    """So much of each flight at most; None: as long as its scenario says."""

    @property
    def each(self) -> int:
        """So many for a candidate."""
        return len(self.names) * len(self.seeds)

    def flight(self, name: str, values: Sequence[float]) -> Flight:
        """The scenario with a candidate's values in it, a value for each dial."""
        return load(name, self.settings | self.space.overrides(values))

    def scores(self, candidates: Sequence[tuple[float, ...]], fly_all: FlyAll) -> list[Score]:
        """In their order."""
        durations_s: list[float] = []
        grid: list[list[list[Case]]] = []
        for values in candidates:
            grid.append([])
            labels = {dial.key: value for dial, value in zip(self.space.dials, values, strict=True)}
            for name in self.names:
                flight = self._shortened(self.flight(name, values))
                durations_s.append(flight.scenario.duration_s)
                grid[-1].append([case(flight, seed, labels) for seed in self.seeds])
        rows = {row.key: row for row in fly_all([each for of in grid for group in of for each in group])}
        flown = [[[rows[each.key] for each in group] for group in of] for of in grid]
        return [score(each, self.scales, durations_s[: len(self.names)]) for each in flown]

    def _shortened(self, flight: Flight) -> Flight:
        scenario = flight.scenario
        if self.duration_s is None or scenario.duration_s <= self.duration_s:
            return flight
        return msgspec.structs.replace(flight, scenario=msgspec.structs.replace(scenario, duration_s=self.duration_s))
