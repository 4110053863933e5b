"""Medians with intervals, and pairs."""

from __future__ import annotations

from itertools import product
from math import inf, sqrt
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.stats import binom

from mavsitl import seeds
from mavsitl.campaign.fly import Row, Status
from mavsitl.campaign.summary import interval, paired, quantile, spread, summarize


def row(seed: int, position_m: float | None, status: Status = "flown", **labels: Any) -> Row:
    states = None if position_m is None else (position_m, 0.0, 0.0, 0.0, 0.0, 2.0 * position_m)
    text = msgspec.json.encode(
        {"key": f"{labels} {seed}", "scenario": "s", "seed": seed, "status": status, "time_s": 1.0}
    )
    made = msgspec.json.decode(text, type=Row)
    return msgspec.structs.replace(made, rmse=states, effort_rad_s=10.0, labels=labels)


def test_quantiles_count_lost_flights_as_the_worst() -> None:
    assert quantile([3.0, 1.0, 2.0, 4.0], 0.5) == 2.5
    assert quantile([inf, 1.0, 2.0], 0.5) == 2.0
    assert quantile([inf, 1.0], 0.5) == inf
    assert quantile([inf, inf], 0.25) == inf


def test_the_median_s_interval_is_that_of_order_statistics() -> None:
    """Bootstrapping a median approaches the binomial interval: both are order statistics, a rank apart at most."""
    values = sorted(seeds.generator(1, "values").normal(size=101).tolist())
    found = interval(values, np.median)
    assert found.value == values[50]
    low, high = (int(binom.ppf(share, 101, 0.5)) for share in (0.025, 0.975))
    assert found.low is not None
    assert found.high is not None
    assert values[low - 2] <= found.low <= values[low + 1]
    assert values[high - 2] <= found.high <= values[high + 1]


def test_the_mean_s_interval_is_that_of_the_normal_distribution() -> None:
    values = seeds.generator(2, "values").normal(3.0, 1.0, size=400)
    found = interval(values.tolist(), np.mean)
    half = 1.96 * values.std() / sqrt(400)
    assert (found.low, found.high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.1 * half)


def test_intervals_repeat() -> None:
    values = [1.0, 4.0, 2.0, 8.0]
    assert interval(values, np.median) == interval(values, np.median)
    assert interval([5.0], np.median) == interval([5.0], np.mean)
    assert interval([5.0], np.median).low is None
    assert interval([5.0, 5.0, 5.0], np.median).high == 5.0


def test_lost_flights_are_in_the_median_and_not_in_the_mean() -> None:
    found = spread([1.0, 2.0, 3.0, inf])
    assert (found.median.value, found.mean.value) == (2.5, 2.0)
    assert (found.q25, found.q95) == (1.75, None)
    assert found.median.low is not None
    assert found.median.high is None
    gone = spread([inf, inf])
    assert (gone.median.value, gone.mean.value, gone.q05) == (None, None, None)


def test_a_pair_is_the_same_seed() -> None:
    rows = [row(seed, 0.1 * seed, law="pid") for seed in (1, 2, 3, 4)]
    rows += [row(seed, 0.05 * seed, law="pidnn") for seed in (4, 3, 2, 1)]
    (found,) = summarize(rows, ["law"], ["law"]).comparisons
    assert (found.key, found.first, found.second, found.labels, found.pairs) == ("law", "pid", "pidnn", {}, 4)
    assert found.measures["position_m"].ratio.value == pytest.approx(0.5)
    assert found.measures["position_m"].difference.value == pytest.approx(-0.125)
    assert found.measures["position_m"].p_value == pytest.approx(2 / 16)  # all of one sign: 2 of 2^4 patterns
    assert found.measures["effort_rad_s"].p_value == 1.0


def test_pairs_with_a_lost_flight_are_counted_apart() -> None:
    rows = [row(1, 0.1, law="pid"), row(2, 0.2, law="pid"), row(3, None, "failed", law="pid")]
    rows += [row(1, 0.3, law="pidnn"), row(2, None, "lost", law="pidnn"), row(3, 0.3, law="pidnn")]
    summary = summarize(rows, ["law"], ["law"])
    (found,) = summary.comparisons
    assert (found.pairs, found.first_not_flown, found.second_not_flown) == (1, 1, 1)
    assert found.measures["position_m"].difference.value == pytest.approx(0.2)
    assert [(cell.n, cell.lost, cell.failed) for cell in summary.cells] == [(3, 0, 1), (3, 1, 0)]
    lost = [row(1, 0.1, law="pid"), row(1, None, "lost", law="pidnn")]
    (none,) = summarize(lost, ["law"], ["law"]).comparisons
    assert (none.pairs, none.measures["position_m"].p_value) == (0, None)


def test_each_further_value_is_compared_with_the_first_in_each_other_cell() -> None:
    rows = [
        row(seed, 0.1 * (1 + number) * seed, gain=gain, wind=wind)
        for number, (wind, gain) in enumerate(product((0, [5]), (1, 2, 3)))
        for seed in (1, 2)
    ]
    found = summarize(rows, ["wind", "gain"], ["gain"])
    assert [(each.labels, each.first, each.second) for each in found.comparisons] == [
        ({"wind": wind}, 1, second) for wind in (0, [5]) for second in (2, 3)
    ]
    assert len(found.cells) == 6
    assert found == msgspec.json.decode(msgspec.json.encode(found), type=type(found))


def test_wilcoxon_leaves_equal_pairs_out() -> None:
    assert paired([(1.0, 1.0), (2.0, 2.0)]).p_value == 1.0
    assert paired([(0.0, 1.0)]).ratio.value is None
