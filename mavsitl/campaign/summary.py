"""What many rows say: medians and means with confidence intervals, and two settings compared seed by seed.

A flight that was lost or failed has an infinite error: it counts in medians and quantiles as the worst there is, and
it has no part in means.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from mavsitl import seeds
from mavsitl.campaign.fly import Row
from mavsitl.campaign.grid import Labels

if TYPE_CHECKING:
    import numpy.typing as npt

RESAMPLES = 9999
LEVEL = 0.95
_INFINITE, _FINITE = 1e150, 1e100
"""While resampling: what stands for an infinite error, as between two infinities nothing can be interpolated; and
the bound of what has none of it."""


@dataclass(frozen=True)
class Measure:
    """A number of a flight, the smaller the better."""

    name: str
    unit: str
    of: Callable[[Row], float]
    """Infinite for a flight that was not flown to its end."""

    @property
    def headline(self) -> str:
        return self.name[0].upper() + self.name[1:]

    @property
    def title(self) -> str:
        return f"{self.name} / {self.unit}"


def _effort(row: Row) -> float:
    return row.effort_rad_s if row.flown and row.effort_rad_s is not None else inf


MEASURES: dict[str, Measure] = {
    "position_m": Measure("position RMSE", "m", lambda row: row.position_m),
    "attitude_deg": Measure("attitude RMSE", "°", lambda row: row.attitude_deg),
    "effort_rad_s": Measure("rotor effort", "rad/s", _effort),
}


class Interval(msgspec.Struct, frozen=True):
    """A number with its confidence interval; an infinite number is None, and so are bounds that too few gave."""

    value: float | None
    low: float | None = None
    high: float | None = None


class Spread(msgspec.Struct, frozen=True):
    """One measure over the seeds of a cell. Quantiles are None where they fall on a lost flight."""

    median: Interval
    mean: Interval
    """Of those that were flown to their end."""
    q05: float | None
    q25: float | None
    q75: float | None
    q95: float | None


class CellSummary(msgspec.Struct, frozen=True):
    labels: Labels
    n: int
    lost: int
    failed: int
    measures: dict[str, Spread]
    """By the names of `MEASURES`."""


class Paired(msgspec.Struct, frozen=True):
    """One measure of two settings, seed by seed."""

    difference: Interval
    """Median of second minus first."""
    ratio: Interval
    """Median of second over first."""
    p_value: float | None
    """Wilcoxon's signed-rank test, two-sided; None without a pair."""


class Comparison(msgspec.Struct, frozen=True):
    """A key's second value against its first, in the same air: equal seeds are a pair."""

    key: str
    first: Any
    second: Any
    labels: Labels
    """Of the other keys."""
    pairs: int
    """Of which both were flown to their end; the others are in the next two only."""
    first_not_flown: int
    second_not_flown: int
    measures: dict[str, Paired]


class Summary(msgspec.Struct, frozen=True):
    cells: list[CellSummary]
    comparisons: list[Comparison]


def summarize(rows: Sequence[Row], keys: Sequence[str], compared: Sequence[str]) -> Summary:
    """`keys`: the swept ones, by which rows are one cell. `compared`: those whose values are paired with the first."""
    cells = group(rows, keys)
    return Summary(
        [_cell(labels, mine) for labels, mine in cells],
        [each for key in compared for each in _comparisons(cells, key)],
    )


def group(rows: Sequence[Row], keys: Sequence[str]) -> list[tuple[Labels, list[Row]]]:
    """The rows of each cell, in the order of their first ones."""
    cells: dict[bytes, tuple[Labels, list[Row]]] = {}
    for row in rows:
        labels = {key: row.labels[key] for key in keys}
        cells.setdefault(_name(labels), (labels, []))[1].append(row)
    return list(cells.values())


def pair(first: Sequence[Row], second: Sequence[Row]) -> list[tuple[Row, Row]]:
    """By seed, those of which both were flown to their end."""
    by_seed = {row.seed: row for row in second if row.flown}
    return [(row, by_seed[row.seed]) for row in first if row.flown and row.seed in by_seed]


def _name(labels: Labels) -> bytes:
    return msgspec.json.encode(labels, order="deterministic")


def _cell(labels: Labels, rows: list[Row]) -> CellSummary:
    return CellSummary(
        labels,
        len(rows),
        sum(row.status == "lost" for row in rows),
        sum(row.status == "failed" for row in rows),
        {name: spread([measure.of(row) for row in rows]) for name, measure in MEASURES.items()},
    )


def spread(values: Sequence[float]) -> Spread:
    """Of at least one value."""
    flown = [value for value in values if isfinite(value)]
    return Spread(
        interval(values, np.median),
        interval(flown, np.mean) if flown else Interval(None),
        *(_known(quantile(values, share)) for share in (0.05, 0.25, 0.75, 0.95)),
    )


def interval(values: Sequence[float], statistic: Callable[..., Any]) -> Interval:
    """By the percentile bootstrap, the same each time; from two values on."""
    from scipy.stats import bootstrap

    sample: npt.NDArray[np.float64] = np.minimum(np.asarray(values, np.float64), _INFINITE)
    value = _known(float(statistic(sample)))
    if sample.size < 2:
        return Interval(value)
    found = bootstrap(
        (sample,), statistic, n_resamples=RESAMPLES, confidence_level=LEVEL, method="percentile", vectorized=True,
        rng=seeds.generator(0, "summary"),
    ).confidence_interval  # fmt: skip
    return Interval(value, _known(float(found.low)), _known(float(found.high)))


def _known(value: float) -> float | None:
    """None for one that a lost flight made."""
    return value if abs(value) < _FINITE else None


def _comparisons(cells: list[tuple[Labels, list[Row]]], key: str) -> list[Comparison]:
    made = []
    firsts: dict[bytes, tuple[Any, list[Row]]] = {}
    for labels, rows in cells:
        others = {name: value for name, value in labels.items() if name != key}
        first, base = firsts.setdefault(_name(others), (labels[key], rows))
        if base is not rows:
            made.append(compare(key, first, labels[key], others, base, rows))
    return made


def compare(
    key: str, first: Any, second: Any, others: Labels, base: Sequence[Row], rows: Sequence[Row]
) -> Comparison:  # fmt: skip
    """`rows` have the key's `second` value, `base` its `first`."""
    pairs = pair(base, rows)
    return Comparison(
        key, first, second, others, len(pairs),
        sum(not row.flown for row in base), sum(not row.flown for row in rows),
        {name: paired([(measure.of(a), measure.of(b)) for a, b in pairs]) for name, measure in MEASURES.items()},
    )  # fmt: skip


def paired(pairs: Sequence[tuple[float, float]]) -> Paired:
    """Of (first, second) with both finite."""
    from scipy.stats import wilcoxon

    pairs = [(a, b) for a, b in pairs if isfinite(a) and isfinite(b)]
    if not pairs:
        return Paired(Interval(None), Interval(None), None)
    differences = [b - a for a, b in pairs]
    ratios = [b / a for a, b in pairs if a > 0.0]
    return Paired(
        interval(differences, np.median),
        interval(ratios, np.median) if ratios else Interval(None),
        float(wilcoxon(differences).pvalue) if any(differences) else 1.0,
    )


def quantile(values: Sequence[float], share: float) -> float:
    """Linear between neighbours; infinite where a neighbour is, so that lost flights count as the worst ones."""
    ordered = sorted(values)
    place = share * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    if place == low:
        return ordered[low]
    if ordered[high] == inf:
        return ordered[high]
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])
