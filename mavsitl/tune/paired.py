"""Two sets of gains on the same seeds, seed by seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isinf, log

import numpy as np

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Paired:
    """Ratios of the same measure, after over before, a seed each."""

    ratio: float
    """Median."""
    low: float
    """Of the median's confidence interval, by order statistics: it assumes nothing of the distribution."""
    high: float
    p_value: float
    """Wilcoxon's signed-rank test on the logarithms, two-sided: of no difference."""


def paired(after: Sequence[float], before: Sequence[float]) -> Paired:
    """Of measures above 0, a seed each, infinite where a flight was lost: lost after alone is an infinite ratio."""
    from scipy.stats import binom, wilcoxon

    ratios = sorted(_ratio(a, b) for a, b in zip(after, before, strict=True))
    n = len(ratios)
    # Below the k-th and above the (n - k + 1)-th smallest lies the median with less than 1 - CONFIDENCE in all.
    k = int(binom.ppf((1.0 - CONFIDENCE) / 2.0, n, 0.5))
    low, high = (ratios[k - 1], ratios[n - k]) if k >= 1 else (0.0, inf)
    logarithms = np.array([1e9 if isinf(each) else -1e9 if each == 0.0 else log(each) for each in ratios])
    p_value = float(wilcoxon(logarithms).pvalue) if logarithms.any() else 1.0
    middle = 0.5 * (ratios[(n - 1) // 2] + ratios[n // 2])
    return Paired(middle, low, high, p_value)


def _ratio(after: float, before: float) -> float:
    if isinf(after) and isinf(before):
        return 1.0
    return after / before if not isinf(after) else inf
