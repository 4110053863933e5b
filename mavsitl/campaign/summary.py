"""What many rows say: quantiles, in which a lost flight is the worst."""

from __future__ import annotations

from collections.abc import Sequence


def quantile(values: Sequence[float], share: float) -> float:
    """Linear between neighbours; infinite where a neighbour is, so that lost flights count as the worst ones."""
    ordered = sorted(values)
    place = share * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    if place == low:
        return ordered[low]
    if ordered[high] == float("inf"):
        return ordered[high]
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])
