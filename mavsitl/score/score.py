"""From flights to a score: how many times better than the cascade aboard, 100 being as good.

Of each flight there are three numbers: the RMS distance from the reference, the largest, and what the rotors did for it
(RMS of their speeds about each one's mean). Beside the flight of the stock cascade in the same case with the same seed,
so in the same air, each gives a ratio, stock's over one's own, kept within 1/10 and 10. A flight that was not flown to
its end has 1/10 for each (10 for the other where it is stock's; 1 where it is both's). Their weighted geometric mean
(`WEIGHTS`) is the flight's; the geometric means over seeds, then over the cases of a group, then over groups, times
100, are the scores. So every group weighs the same however many cases it has, an improvement by a factor counts the
same in every case, and no one flight decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import exp, hypot, log
from statistics import fmean, median

import msgspec

from mavsitl.campaign.fly import Row
from mavsitl.score.suite import CASE, CONTROLLER, Suite

STOCK = "stock"
"""Whom all are compared with; in each run of the bench."""
PAR = 100.0
LIMIT = 10.0
"""A ratio beyond this, or below its inverse, counts as this."""
WEIGHTS = {"rms": 0.5, "peak": 0.25, "effort": 0.25}


def rms_m(row: Row) -> float:
    """RMS distance from the reference."""
    return row.position_m


def peak_m(row: Row) -> float:
    """Largest distance from the reference along each axis, the three together."""
    return hypot(*(row.largest or (0.0, 0.0, 0.0))[:3])


def effort_rad_s(row: Row) -> float:
    """RMS of the rotors' speeds about each one's mean."""
    return row.effort_rad_s or 0.0


MEASURES: Mapping[str, Callable[[Row], float]] = {"rms": rms_m, "peak": peak_m, "effort": effort_rad_s}


def ratio(own: Row, stock: Row) -> float:
    """How many times better than stock; above 1 is better."""
    if not own.flown or not stock.flown:
        return {True: 1.0, False: LIMIT if own.flown else 1.0 / LIMIT}[own.flown == stock.flown]
    return exp(sum(weight * log(part(name, own, stock)) for name, weight in WEIGHTS.items()))


def part(name: str, own: Row, stock: Row) -> float:
    """The ratio of one measure, within its limits, of two flights that were flown."""
    theirs, ours = MEASURES[name](stock), MEASURES[name](own)
    if ours <= 0.0 or theirs <= 0.0:
        return 1.0
    return min(max(theirs / ours, 1.0 / LIMIT), LIMIT)


class Cell(msgspec.Struct, frozen=True):
    """A controller in a case: medians over the flights that were flown to their end, None where none was."""

    score: float
    rms_m: float | None
    peak_m: float | None
    effort_rad_s: float | None
    settling_s: float | None
    """From a step, a gust, a failure or an outage until it stays within 0.1 m; None in a case without one."""
    flights: int
    lost: int
    """Not flown to their end."""
    why: str = ""
    """What became of the first of these."""


class Standing(msgspec.Struct, frozen=True):
    """A controller on the board."""

    controller: str
    score: float
    seeds: tuple[float, float]
    """The least and the largest of the scores of each seed by itself."""
    groups: dict[str, float]
    cases: dict[str, Cell]
    flights: int
    lost: int


class Board(msgspec.Struct, frozen=True):
    suite: int
    part: str
    """What of the suite was flown: ``all``, or what was chosen."""
    seeds: tuple[int, ...]
    standings: tuple[Standing, ...]
    """The best first."""


def board(suite: Suite, rows: Iterable[Row], names: Sequence[str], part: str = "all") -> Board:
    """`rows` are of every case and seed of the suite for each of `names`, stock among them, by their labels."""
    found = {(row.labels[CASE], row.labels[CONTROLLER], row.seed): row for row in rows}
    standings = []
    for name in names:
        ratios = {
            (each.name, seed): ratio(found[each.name, name, seed], found[each.name, STOCK, seed])
            for each in suite.cases
            for seed in suite.seeds
        }
        cells = {
            each.name: _cell(
                [found[each.name, name, seed] for seed in suite.seeds],
                PAR * _mean([ratios[each.name, seed] for seed in suite.seeds]),
            )
            for each in suite.cases
        }
        by_seed = [
            PAR * _over_groups(suite, {each.name: ratios[each.name, seed] for each in suite.cases})
            for seed in suite.seeds
        ]
        groups = {
            group: _mean([cells[each.name].score for each in suite.cases if each.group == group])
            for group in suite.groups
        }
        standings.append(Standing(
            controller=name, score=_mean(list(groups.values())), seeds=(min(by_seed), max(by_seed)), groups=groups,
            cases=cells, flights=sum(cell.flights for cell in cells.values()),
            lost=sum(cell.lost for cell in cells.values()),
        ))  # fmt: skip
    standings.sort(key=lambda standing: -standing.score)
    return Board(suite.version, part, suite.seeds, tuple(standings))


def _over_groups(suite: Suite, ratios: Mapping[str, float]) -> float:
    return _mean([_mean([ratios[each.name] for each in suite.cases if each.group == group]) for group in suite.groups])


def _mean(values: Sequence[float]) -> float:
    """Geometric."""
    return exp(fmean(map(log, values)))


def _cell(rows: Sequence[Row], score: float) -> Cell:
    flown = [row for row in rows if row.flown]
    gone = [row for row in rows if not row.flown]
    settled = [row.settling_s for row in flown if row.settling_s is not None]
    return Cell(
        score=score,
        rms_m=median(map(rms_m, flown)) if flown else None,
        peak_m=median(map(peak_m, flown)) if flown else None,
        effort_rad_s=median(map(effort_rad_s, flown)) if flown else None,
        settling_s=median(settled) if settled else None,
        flights=len(rows),
        lost=len(gone),
        why=gone[0].message if gone else "",
    )
