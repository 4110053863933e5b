"""The search alone, over a landscape that costs nothing."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import exp, log

import numpy as np
import pytest

from mavsitl.tune.objective import Score
from mavsitl.tune.search import Trial, search
from mavsitl.tune.space import Floats, Space, space

KEYS = ("controller.position.k_p_per_s2", "controller.position.k_d_per_s", "controller.altitude.k_p_per_s2")
VALLEY = (0.8, 0.3, 0.55)
"""In places of the unit cube."""


@cache
def made() -> Space:
    return space(["hover-wind"], {}, KEYS)


def landscape(values: tuple[float, ...]) -> Score:
    """A valley with a cliff beyond it, behind which everything is lost."""
    places = [dial.place(value) for dial, value in zip(made().dials, values, strict=True)]
    if places[0] > 0.9:
        return Score((float("inf"),), (float("inf"),), places[0] - 0.9, 1, (), "over the cliff")
    height = sum((3.0 * (place - low)) ** 2 for place, low in zip(places, VALLEY, strict=True))
    return Score((exp(height),), (1.0 + places[1],), 0.0, 0, ())


def free(score: Score) -> Floats:
    """No constraint."""
    return np.empty(0)


def trials(
    evaluations: int, seed: int = 1, effort_weight: float = 0.0, excess: Callable[[Score], Floats] = free
) -> list[Trial]:
    found: list[Trial] = []
    search(
        made(), landscape, found.append,
        evaluations=evaluations, effort_weight=effort_weight, seed=seed, excess=excess,
    )  # fmt: skip
    return found


def test_it_finds_the_valley_though_flights_are_lost_beside_it() -> None:
    found = trials(80)
    best = min(found, key=lambda trial: trial.score.objective(0.0))
    places = [dial.place(value) for dial, value in zip(made().dials, best.values, strict=True)]
    assert places == pytest.approx(VALLEY, abs=0.02)


def test_effort_is_weighed() -> None:
    """Effort falls with the second dial, so that a weight on it moves the valley there."""
    free, dear = (
        min(trials(80, effort_weight=weight), key=lambda trial: trial.score.objective(weight)) for weight in (0.0, 1.0)
    )
    assert dear.score.effort < 0.97 * free.score.effort
    assert dear.score.error > free.score.error


def test_a_constraint_is_kept_and_the_best_beside_it_is_found() -> None:
    """Effort is 1 + the second dial's place, 0.3 in the valley; at most 0.2 is allowed, and the start's 0.5 is not."""

    def excess(score: Score) -> Floats:
        return np.array([log(score.effort) - log(1.2), -1.0])

    found = trials(120, excess=excess)
    best = min(
        (trial for trial in found if (excess(trial.score) <= 0.0).all()), key=lambda trial: trial.score.objective(0.0)
    )
    places = [dial.place(value) for dial, value in zip(made().dials, best.values, strict=True)]
    assert places == pytest.approx((VALLEY[0], 0.2, VALLEY[2]), abs=0.03)


def test_the_start_is_the_first_and_the_budget_is_kept() -> None:
    found = trials(17)
    assert [trial.number for trial in found] == list(range(17))
    assert found[0].values == made().start
    assert trials(1)[0].values == made().start


def test_the_same_seed_gives_the_same_candidates_and_another_goes_elsewhere_when_it_begins_again() -> None:
    assert trials(120) == trials(120)
    other = trials(120, seed=2)
    assert other[:10] == trials(120)[:10]
    assert other != trials(120)


def test_no_candidate_is_evaluated_twice_and_the_search_ends_where_there_is_nothing_new() -> None:
    """A range of 21 numbers of four digits."""
    narrow = space(["hover-wind"], {}, ["controller.position.k_p_per_s2=11.5:11.7"])
    evaluated: list[tuple[float, ...]] = []

    def watched(values: tuple[float, ...]) -> Score:
        evaluated.append(values)
        return Score((values[0],), (1.0,), 0.0, 0, ())

    search(narrow, watched, lambda trial: None, evaluations=100, effort_weight=0.0, seed=1, excess=free)
    assert 1 < len(evaluated) == len(set(evaluated)) <= 21
