"""Two sets of gains on the same seeds, seed by seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite

import numpy as np

from mavsitl.campaign import summary
from mavsitl.campaign.summary import Interval


@dataclass(frozen=True)
class Paired:
    """Ratios of the same measure, after over before, a seed each."""

    ratio: Interval
    """Median with its confidence interval; None where a flight that was lost after makes it."""
    p_value: float | None
    """Wilcoxon's signed-rank test, two-sided, of the pairs that were flown both; None without one."""

    @property
    def better(self) -> bool:
        """The whole interval is below 1."""
        return self.ratio.high is not None and self.ratio.high < 1.0

    @property
    def worse(self) -> bool:
        """The whole interval is above 1, or the median is of a lost flight."""
        return self.ratio.value is None or (self.ratio.low is not None and self.ratio.low > 1.0)


def paired(after: Sequence[float], before: Sequence[float]) -> Paired:
    """Of measures above 0, a seed each, infinite where a flight was lost: lost after alone is an infinite ratio."""
    ratios = [_ratio(a, b) for a, b in zip(after, before, strict=True)]
    return Paired(summary.interval(ratios, np.median), summary.paired(list(zip(before, after, strict=True))).p_value)


def _ratio(after: float, before: float) -> float:
    if isfinite(after):
        return after / before
    return inf if isfinite(before) else 1.0
