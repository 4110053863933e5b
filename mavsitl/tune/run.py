"""A whole tuning: search, judgement on seeds that the search has not seen, and what is to be told of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from mavsitl.campaign.errors import GridError
from mavsitl.tune.flights import Flights, FlyAll
from mavsitl.tune.objective import Score, six
from mavsitl.tune.paired import Paired, paired
from mavsitl.tune.search import Trial, search
from mavsitl.tune.space import Overrides, Space, space


@dataclass(frozen=True)
class Plan:
    """What was asked for."""

    names: tuple[str, ...]
    """Scenarios by name or path."""
    settings: Overrides = field(default_factory=dict)
    """Changes to all of them."""
    asked: tuple[str, ...] = ()
    """``KEY`` or ``KEY=LOW:HIGH[:log|linear]``; none: the default keys."""
    evaluations: int = 150
    effort_weight: float = 0.3
    seeds: tuple[int, ...] = (1001, 1002, 1003)
    """Flown by each candidate."""
    held_out: tuple[int, ...] = tuple(range(1, 21))
    """Flown by start and chosen in the end; 1 to 20 are those of the project's results."""
    search_duration_s: float | None = None
    """So much of each flight in the search; judged is the whole."""
    seed: int = 1
    """Of the search itself."""


@dataclass(frozen=True)
class Judged:
    """Before and after on the held-out seeds, at full length."""

    before: Score
    after: Score
    error: Paired
    """After over before, seed by seed."""
    effort: Paired


@dataclass
class Tuning:
    """Grows as it goes."""

    plan: Plan
    space: Space
    trials: list[Trial] = field(default_factory=list)
    judged: Judged | None = None
    """None: it was interrupted before that."""

    @property
    def start(self) -> Trial:
        return self.trials[0]

    @property
    def best(self) -> Trial:
        """The first of the least objective."""
        return min(self.trials, key=lambda trial: trial.score.objective(self.plan.effort_weight))


def begin(plan: Plan) -> Tuning:
    """Raises `ScenarioError` for what is wrong with the scenarios or the keys, `GridError` for seeds."""
    both = sorted(set(plan.seeds) & set(plan.held_out))
    if both:
        raise GridError(f"--seeds, --held-out: seed {both[0]} is in both; allowed: seeds that are in one alone")
    return Tuning(plan, space(plan.names, plan.settings, plan.asked))


def searched(tuning: Tuning) -> Flights:
    """What a candidate flies in the search."""
    plan = tuning.plan
    return Flights(plan.names, plan.settings, tuning.space, plan.seeds, plan.search_duration_s)


def held_out(tuning: Tuning) -> Flights:
    """What start and chosen fly in the end."""
    plan = tuning.plan
    return Flights(plan.names, plan.settings, tuning.space, plan.held_out)


def flights_of(tuning: Tuning) -> int:
    """How many there are to fly in all, at most."""
    extra = 2 if tuning.plan.search_duration_s else 0
    return searched(tuning).each * (tuning.plan.evaluations + extra) + 2 * held_out(tuning).each


def calibrated(tuning: Tuning, fly_all: FlyAll) -> Flights:
    """What a candidate flies in the search, with scales for a part of each flight.

    A start from rest is a larger part of a short flight than of the whole. So the numbers that a part is measured by
    are those of the whole, times what the start has in the part over what it has in the whole. Where the start is lost
    there is nothing to correct by.
    """
    part = searched(tuning)
    if part.duration_s is None:
        return part
    whole = replace(part, duration_s=None)
    (short,), (long,) = (flights.scores([tuning.space.start], fly_all) for flights in (part, whole))
    if short.lost or long.lost:
        return part
    pairs = zip(short.rmse, long.rmse, strict=True)
    return replace(part, factors=tuple(six(a / np.where(b > 0.0, b, a)) for a, b in map(np.array, pairs)))


def carry_out(tuning: Tuning, fly_all: FlyAll, said: Callable[[Trial], None]) -> None:
    """Search and judge; what is in `tuning` when it is interrupted is good. `said` is told of each trial."""
    plan, flights = tuning.plan, calibrated(tuning, fly_all)

    def evaluate(values: tuple[float, ...]) -> Score:
        return flights.scores([values], fly_all)[0]

    def keep(trial: Trial) -> None:
        tuning.trials.append(trial)
        said(trial)

    search(
        tuning.space, evaluate, keep,
        evaluations=plan.evaluations, effort_weight=plan.effort_weight, seed=plan.seed,
    )  # fmt: skip
    before, after = held_out(tuning).scores([tuning.start.values, tuning.best.values], fly_all)
    tuning.judged = Judged(before, after, paired(after.errors, before.errors), paired(after.efforts, before.efforts))
