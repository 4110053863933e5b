"""The search: SciPy's COBYQA, a quadratic model in a trust region. It needs few flights and stays in the bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from mavsitl import seeds
from mavsitl.tune.objective import WORST, Score
from mavsitl.tune.space import Floats, Space

Evaluate: TypeAlias = Callable[[tuple[float, ...]], Score]
"""A candidate, a value for each dial, to its score."""

FIRST_STEP = 0.15
"""How far the first candidates are from the start, in shares of each dial's range."""
LAST_STEP = 0.003
"""Where the search has settled; what is left of the budget goes to a new one from somewhere near the best."""
MARGIN = 0.002
"""So far below its limit a constraint is aimed at: what comes to lie on the limit is beyond it half of the time."""


@dataclass(frozen=True)
class Trial:
    """One candidate, flown."""

    number: int
    """0 is the start, what the scenarios have."""
    values: tuple[float, ...]
    """One for each dial."""
    score: Score


class _SpentError(Exception):
    """The budget is."""


def search(
    space: Space,
    evaluate: Evaluate,
    said: Callable[[Trial], None],
    *,
    evaluations: int,
    effort_weight: float,
    seed: int,
    excess: Callable[[Score], Floats],
) -> None:
    """`evaluations` different candidates, the start first; `said` is told of each as it is flown.

    `excess` (any,) is to be 0 or less in each item: constraints, which candidates on the way may break.

    The same seed and the same scores give the same candidates, so a search whose flights are kept goes on where it was
    ended when it is begun anew. It ends early where there is nothing new to try.
    """
    from scipy.optimize import NonlinearConstraint, minimize

    known: dict[tuple[float, ...], Score] = {}
    best, best_place = np.inf, space.start_place

    def scored(place: Floats) -> Score:
        values = space.values(place)
        if values not in known:
            if len(known) == evaluations:
                raise _SpentError
            score = evaluate(values)
            said(Trial(len(known), values, score))
            known[values] = score
        return known[values]

    def objective(place: Floats) -> float:
        nonlocal best, best_place
        score = scored(place)
        found = score.objective(effort_weight)
        if found < best and (excess(score) <= 0.0).all():
            best, best_place = found, np.array(place)
        return found

    def constraint(place: Floats) -> Floats:
        return np.minimum(excess(scored(place)), WORST)  # a lost flight's is infinite

    random = seeds.generator(seed, "tune")
    place = space.start_place
    try:
        objective(place)  # COBYQA itself begins elsewhere when that is near a bound
        constraints = [NonlinearConstraint(constraint, -np.inf, -MARGIN)] if constraint(place).size else []
        before = 0
        while before < len(known):
            before = len(known)
            minimize(
                objective, place, method="COBYQA", bounds=[(0.0, 1.0)] * place.size, constraints=constraints,
                options={"initial_tr_radius": FIRST_STEP, "final_tr_radius": LAST_STEP},
            )  # fmt: skip
            place = np.clip(best_place + random.uniform(-FIRST_STEP, FIRST_STEP, place.size), 0.0, 1.0)
    except _SpentError:
        return
