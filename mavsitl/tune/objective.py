"""From flights to numbers that can be compared: error, effort, and what to make of a flight that was lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf, log

import numpy as np

from mavsitl.campaign.errors import CampaignError
from mavsitl.campaign.fly import Row
from mavsitl.report.metrics import PAPER_TABLES, paper_case
from mavsitl.scenario import Scenario
from mavsitl.tune.space import Floats

Six = tuple[float, float, float, float, float, float]


class TuneError(CampaignError):
    """The tuning cannot be done; the message says why."""


SCALE: Six = (0.1, 0.1, 0.1, 0.5, 0.5, 0.5)
"""By what the RMSE of a flight that is none of the paper's is divided: m and degrees."""

NORM = 4
"""The power whose mean over scenarios and states is taken: the worst numbers count most, and smoothly."""

LEAST: Six = (1e-4, 1e-4, 1e-4, 5e-4, 5e-4, 5e-4)
"""An RMSE below this, m and degrees, counts as this when another is divided by it."""

WORST = 13.0
_WORST_EFFORT = 12.0
"""Above the logarithms of any flown flight's error (20 m over `LEAST`) and effort / (rad/s)."""


def scale(scenario: Scenario) -> Six:
    """What each state's RMSE is divided by: the paper's number where it has one, else `SCALE`."""
    case = paper_case(scenario)
    return SCALE if case is None else PAPER_TABLES[case].values()


def growth(after: Sequence[Six], before: Sequence[Six]) -> Floats:
    """How many times as large each RMSE has become, (scenarios, 6); infinite where a flight was lost after alone."""
    now, then = np.maximum(after, LEAST), np.maximum(before, LEAST)
    return np.divide(now, then, out=np.ones_like(now), where=now != then)


@dataclass(frozen=True)
class Score:
    """One set of gains over scenarios and seeds."""

    errors: tuple[float, ...]
    """A seed each: `NORM`-th root of the mean over scenarios and states of (RMSE / scale) ** `NORM`; infinite where a
    flight was lost.
    """
    efforts: tuple[float, ...]
    """A seed each: the mean over scenarios of the rotors' effort, rad/s (`Row.effort_rad_s`)."""
    unflown: float
    """Share of the flights' time that was not flown, 0 to 1; 0 where none was lost."""
    lost: int
    """Flights lost or failed."""
    rmse: tuple[Six, ...]
    """A scenario each: root of the mean square over seeds; infinite where a flight was lost."""
    message: str = ""
    """How the first was lost."""

    @cached_property
    def error(self) -> float:
        """Mean over the seeds."""
        return float(np.mean(self.errors))

    @cached_property
    def effort(self) -> float:
        """Mean over the seeds; infinite where a flight was lost."""
        return inf if self.lost else float(np.mean(self.efforts))

    def objective(self, effort_weight: float) -> float:
        """What is made as small as possible: log(error) + `effort_weight` log(effort).

        With a weight of 0.1, effort that grows by 1 % has to buy 0.1 % of error. Where flights were lost it is above
        all that were flown, and the less was flown the higher.
        """
        if self.lost:
            return WORST + effort_weight * _WORST_EFFORT + self.unflown
        return log(self.error) + effort_weight * log(self.effort)


def score(rows: Sequence[Sequence[Row]], scales: Sequence[Six], durations_s: Sequence[float]) -> Score:
    """`rows[scenario][seed]`, the same seeds for each scenario; a scale and a duration for each scenario.

    Raises `TuneError` where the vehicle's log has no rotor speeds.
    """
    if any(row.flown and row.effort_rad_s is None for each in rows for row in each):
        raise TuneError("the vehicle logs no rotor speeds, so its effort is not known")
    bad = [row for each in rows for row in each if not row.flown]
    squares = np.array([[(inf,) * 6 if row.rmse is None else np.square(row.rmse) for row in each] for each in rows])
    rmse: Floats = np.sqrt(squares)
    efforts = np.array([[row.effort_rad_s if row.flown else inf for row in each] for each in rows], np.float64)
    flown = [
        1.0 if row.flown else min(row.time_s / duration_s, 1.0)
        for each, duration_s in zip(rows, durations_s, strict=True)
        for row in each
    ]
    relative = rmse / np.array(scales)[:, np.newaxis, :]
    return Score(
        errors=tuple(np.power(np.power(relative, NORM).mean(axis=(0, 2)), 1.0 / NORM).tolist()),
        efforts=tuple(efforts.mean(axis=0).tolist()),
        unflown=1.0 - float(np.mean(flown)),
        lost=len(bad),
        rmse=tuple(six(each) for each in np.sqrt(squares.mean(axis=1))),
        message=f"{bad[0].scenario}, seed {bad[0].seed}: {bad[0].message}" if bad else "",
    )


def six(values: Floats) -> Six:
    """Of (6,)."""
    x, y, z, phi, theta, psi = values.tolist()
    return x, y, z, phi, theta, psi


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Which of (effort, error) are not beaten in both by another, by rising effort."""
    chosen: list[int] = []
    for index in sorted(range(len(points)), key=lambda each: points[each]):
        if not chosen or points[index][1] < points[chosen[-1]][1]:
            chosen.append(index)
    return chosen
