"""A whole tuning: search, judgement on seeds that the search has not seen, and what is to be told of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from mavsitl.campaign.errors import GridError
from mavsitl.report.metrics import paper_case
from mavsitl.scenario import load
from mavsitl.tune.flights import Flights, FlyAll
from mavsitl.tune.objective import LEAST, Score, Six, TuneError, growth, scale, six
from mavsitl.tune.paired import Paired, paired
from mavsitl.tune.search import Trial, search
from mavsitl.tune.space import Floats, Overrides, Space, space

Against: TypeAlias = Literal["paper", "start"]


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
    against: Against = "paper"
    """What each RMSE is divided by: the paper's number, or what the first gains have on the same seeds."""
    no_worse: float | None = None
    """The chosen gains have no RMSE above so many times that of the first ones, >= 1, and miss no number of the paper's
    that those reach; None: they may.
    """
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
    limits: tuple[Six, ...] = ()
    """A scenario each, what no RMSE of the chosen gains is above; none: nothing is."""
    judged: Judged | None = None
    """None: it was interrupted before that."""

    @property
    def start(self) -> Trial:
        return self.trials[0]

    @property
    def best(self) -> Trial:
        """The first of the least objective among those that are allowed."""
        return min(filter(self.allowed, self.trials), key=lambda trial: trial.score.objective(self.plan.effort_weight))

    def allowed(self, trial: Trial) -> bool:
        """No RMSE is above its limit."""
        return bool((self.excess(trial.score) <= 0.0).all())

    def excess(self, score: Score) -> Floats:
        """Logarithms of how far each RMSE is above its limit, (scenarios x 6,); empty where there is none."""
        return np.log(growth(score.rmse, self.limits)).ravel() if self.limits else np.empty(0)


def begin(plan: Plan) -> Tuning:
    """Raises `ScenarioError` for what is wrong with the scenarios or the keys, `GridError` for seeds."""
    both = sorted(set(plan.seeds) & set(plan.held_out))
    if both:
        raise GridError(f"--seeds, --held-out: seed {both[0]} is in both; allowed: seeds that are in one alone")
    return Tuning(plan, space(plan.names, plan.settings, plan.asked))


def searched(tuning: Tuning) -> Flights:
    """What a candidate flies in the search, in the paper's measure."""
    plan = tuning.plan
    scales = tuple(scale(load(name, plan.settings).scenario) for name in plan.names)
    return Flights(plan.names, plan.settings, tuning.space, plan.seeds, scales, duration_s=plan.search_duration_s)


def flights_of(tuning: Tuning) -> int:
    """How many there are to fly in all, at most."""
    plan = tuning.plan
    measured = (2 if plan.search_duration_s else 1) if _by_the_start(plan) else 0
    return searched(tuning).each * (plan.evaluations + measured) + 2 * len(plan.names) * len(plan.held_out)


def _by_the_start(plan: Plan) -> bool:
    """What the start has is known before the search."""
    return plan.against == "start" or plan.no_worse is not None or plan.search_duration_s is not None


def measured(tuning: Tuning, fly_all: FlyAll) -> tuple[Flights, Flights]:
    """What a candidate flies in the search, and what start and chosen fly in the end, with what they are measured by.

    A start from rest is a larger part of a short flight than of the whole. So the numbers that a part is measured by
    are those of the whole, times what the start has in the part over what it has in the whole. Where the start is lost
    there is nothing to correct by; raises `TuneError` where there is nothing to compare with.
    """
    plan, part = tuning.plan, searched(tuning)
    whole = replace(part, duration_s=None)
    if not _by_the_start(plan):
        return part, replace(whole, seeds=plan.held_out)
    (long,) = whole.scores([tuning.space.start], fly_all)
    (short,) = part.scores([tuning.space.start], fly_all) if part.duration_s else (long,)
    lost = long.message or short.message
    if lost and (plan.against == "start" or plan.no_worse is not None):
        option = "--against start" if plan.against == "start" else "--no-worse"
        raise TuneError(f"{option}: the gains to begin with lose a flight, so nothing compares with them: {lost}")
    if not lost:
        pairs = zip(part.scales, short.rmse, long.rmse, strict=True)
        part = replace(part, scales=tuple(six(s * a / np.where(b > 0.0, b, a)) for s, a, b in map(np.array, pairs)))
        tuning.limits = _limits(plan, short.rmse, part.scales)
    if plan.against == "start":
        whole, part = replace(whole, scales=_at_least(long.rmse)), replace(part, scales=_at_least(short.rmse))
    return part, replace(whole, seeds=plan.held_out)


def _limits(plan: Plan, start: tuple[Six, ...], scales: tuple[Six, ...]) -> tuple[Six, ...]:
    """By what the start has, and by the paper's numbers that it reaches: `scales` in the paper's own scenarios."""
    if plan.no_worse is None:
        return ()
    made = []
    for name, has, number in zip(plan.names, map(np.array, _at_least(start)), scales, strict=True):
        of_paper = paper_case(load(name, plan.settings).scenario) is not None
        reached = of_paper & (has <= number)
        made.append(six(np.minimum(plan.no_worse * has, np.where(reached, number, np.inf))))
    return tuple(made)


def _at_least(rmse: tuple[Six, ...]) -> tuple[Six, ...]:
    return tuple(six(np.maximum(each, LEAST)) for each in rmse)


def carry_out(tuning: Tuning, fly_all: FlyAll, said: Callable[[Trial], None]) -> None:
    """Search and judge; what is in `tuning` when it is interrupted is good. `said` is told of each trial."""
    plan = tuning.plan
    flights, judging = measured(tuning, fly_all)

    def evaluate(values: tuple[float, ...]) -> Score:
        return flights.scores([values], fly_all)[0]

    def keep(trial: Trial) -> None:
        tuning.trials.append(trial)
        said(trial)

    search(
        tuning.space, evaluate, keep,
        evaluations=plan.evaluations, effort_weight=plan.effort_weight, seed=plan.seed,
        excess=tuning.excess,
    )  # fmt: skip
    before, after = judging.scores([tuning.start.values, tuning.best.values], fly_all)
    tuning.judged = Judged(before, after, paired(after.errors, before.errors), paired(after.efforts, before.efforts))
