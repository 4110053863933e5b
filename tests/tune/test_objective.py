"""Error, effort and lost flights; the front; the paired comparison."""

from __future__ import annotations

from math import inf, log

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl import scenario
from mavsitl.campaign.fly import Row
from mavsitl.report.metrics import PAPER_TABLES
from mavsitl.tune.objective import LEAST, SCALE, Six, TuneError, front, growth, scale, score
from mavsitl.tune.paired import paired

ONES: Six = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0)


def row(rmse: float | None, effort: float | None = 10.0, time_s: float = 60.0) -> Row:
    if rmse is None:
        return Row("k", "hover-wind", 7, "lost", time_s, message="gone")
    return Row("k", "hover-wind", 7, "flown", time_s, rmse=(rmse,) * 6, effort_rad_s=effort)


def test_the_papers_scenarios_are_weighed_by_its_tables_and_others_by_a_fixed_scale() -> None:
    assert scale(scenario.load("spiral-wind").scenario) == PAPER_TABLES["spiral-wind"].values()
    assert scale(scenario.load("hover-wind", {"airframe": "realistic"}).scenario) == PAPER_TABLES["hover-wind"].values()
    assert scale(scenario.load("hover-gust").scenario) == SCALE


def test_a_score_has_a_number_a_seed_in_which_the_worst_ratio_counts_most() -> None:
    found = score([[row(1.0), row(3.0)], [row(2.0), row(2.0, 30.0)]], [ONES, (2.0,) * 6], [60.0, 60.0])
    assert found.errors == pytest.approx((1.0, ((3.0**4 + 1.0) / 2.0) ** 0.25))
    assert found.efforts == (10.0, 20.0)
    assert (found.effort, found.lost) == (15.0, 0)
    assert found.rmse[0][0] == pytest.approx(5.0**0.5)
    assert found.objective(0.5) == pytest.approx(log(sum(found.errors) / 2.0) + 0.5 * log(15.0))


@given(flown=st.floats(1e-6, 1e4), effort=st.floats(1e-3, 1e5), weight=st.floats(0.0, 5.0), time_s=st.floats(0.0, 60.0))
def test_a_lost_flight_is_worse_than_any_that_was_flown(
    flown: float, effort: float, weight: float, time_s: float
) -> None:
    good = score([[row(flown, effort), row(flown, effort)]], [ONES], [60.0])
    bad = score([[row(1e-9, 1e-9), row(None, time_s=time_s)]], [ONES], [60.0])
    assert bad.objective(weight) > good.objective(weight)
    assert (bad.error, bad.effort, bad.lost) == (inf, inf, 1)
    assert bad.message == "hover-wind, seed 7: gone"


def test_of_lost_ones_the_one_that_flew_longer_is_better() -> None:
    short, long = (score([[row(None, time_s=time_s)]], [ONES], [60.0]) for time_s in (5.0, 50.0))
    assert long.objective(0.3) < short.objective(0.3)


def test_growth_is_of_each_number_and_next_to_nothing_is_no_measure() -> None:
    after: Six = (0.3, 0.1, 1e-5, 1.0, inf, inf)
    before: Six = (0.2, inf, 0.0, 0.0, 1.0, inf)
    found = growth([after], [before])
    assert found.shape == (1, 6)
    assert found[0].tolist() == pytest.approx([1.5, 0.0, 1.0, 1.0 / LEAST[3], inf, 1.0])


def test_without_rotor_speeds_in_the_log_there_is_no_effort() -> None:
    with pytest.raises(TuneError, match="no rotor speeds"):
        score([[row(1.0, None)]], [ONES], [60.0])


def test_the_front_is_what_is_not_beaten_in_both() -> None:
    points = [(3.0, 1.0), (1.0, 3.0), (2.0, 2.0), (2.0, 2.5), (3.0, 3.0), (2.5, 2.0), (4.0, 1.0)]
    assert [points[index] for index in front(points)] == [(1.0, 3.0), (2.0, 2.0), (3.0, 1.0)]
    assert front([]) == []


def test_a_paired_comparison_knows_a_difference_from_chance() -> None:
    before = [1.0 + 0.1 * seed for seed in range(20)]
    better = paired([0.9 * each for each in before], before)
    assert better.ratio.value == pytest.approx(0.9)
    assert better.better
    assert not better.worse
    assert better.p_value is not None
    assert better.p_value < 1e-4
    chance = paired([each * (2.0 if seed % 2 else 0.5) for seed, each in enumerate(before)], before)
    assert not chance.better
    assert not chance.worse
    worse = paired([1.1 * each for each in before], before)
    assert worse.worse


def test_lost_flights_have_their_place_among_the_ratios() -> None:
    found = paired([inf] * 15 + [0.5] * 5, [1.0] * 20)
    assert found.ratio.value is None
    assert found.worse
    mended = paired([1.0] * 20, [inf] * 20)
    assert (mended.ratio.value, mended.better) == (0.0, True)
    assert paired([inf] * 6, [inf] * 6).ratio.value == 1.0
    assert paired([inf] * 6, [inf] * 6).p_value is None
