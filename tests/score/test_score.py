"""The score's rules, on made-up rows, and the suite that it is of."""

from __future__ import annotations

from collections.abc import Iterable
from math import exp, log, sqrt
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl.campaign.errors import GridError
from mavsitl.campaign.fly import Row
from mavsitl.score import suite as suites
from mavsitl.score.score import LIMIT, PAR, WEIGHTS, board, ratio
from mavsitl.score.suite import CASE, CONTROLLER, Suite, SuiteCase

SUITE = Suite(
    version=9, seeds=(1, 2),
    cases=tuple(
        SuiteCase(name=name, group=group, scenario="hover-calm", settings={})
        for name, group in (("a", "one"), ("b", "two"), ("c", "two"), ("d", "two"))
    ),
)  # fmt: skip


def row(rms: float = 0.1, peak: float = 0.3, effort: float = 10.0, status: Any = "flown", **labels: Any) -> Row:
    return Row(
        key="k", scenario="s", seed=labels.pop("seed", 1), status=status, time_s=10.0,
        rmse=(rms, 0.0, 0.0, 1.0, 1.0, 1.0) if status == "flown" else None,
        largest=(peak, 0.0, 0.0, 1.0, 1.0, 1.0), effort_rad_s=effort, message="" if status == "flown" else "fell",
        labels=labels,
    )  # fmt: skip


def rows(better: dict[str, float], lost: Iterable[tuple[str, str, int]] = ()) -> list[Row]:
    """Stock at par; each other's numbers are so many times better."""
    return [
        row(0.1 / by, 0.3 / by, 10.0 / by, "lost" if (case.name, name, seed) in lost else "flown", seed=seed,
            **{CASE: case.name, CONTROLLER: name})
        for name, by in {"stock": 1.0, **better}.items()
        for case in SUITE.cases
        for seed in SUITE.seeds
    ]  # fmt: skip


def test_twice_as_good_is_200_and_the_best_stands_first() -> None:
    made = board(SUITE, rows({"twice": 2.0, "half": 0.5}), ("half", "twice", "stock"))
    assert [(each.controller, round(each.score, 6)) for each in made.standings] == [
        ("twice", 200.0), ("stock", PAR), ("half", 50.0),
    ]  # fmt: skip
    assert made.standings[0].seeds == pytest.approx((200.0, 200.0))


def test_each_group_weighs_the_same() -> None:
    """One case of four, alone in its group of two."""
    table = [
        row(0.4, 1.2, 40.0, seed=each.seed, **each.labels)
        if (each.labels[CASE], each.labels[CONTROLLER]) == ("a", "mine")
        else each
        for each in rows({"mine": 1.0})
    ]
    mine = next(each for each in board(SUITE, table, ("mine", "stock")).standings if each.controller == "mine")
    assert mine.score == pytest.approx(PAR * sqrt(0.25))
    assert mine.groups == pytest.approx({"one": 25.0, "two": 100.0})


def test_a_lost_flight_costs_and_is_told() -> None:
    mine = board(SUITE, rows({"mine": 1.0}, lost=[("b", "mine", 2)]), ("mine", "stock")).standings[1]
    assert mine.cases["b"].score == pytest.approx(PAR * sqrt(1.0 / LIMIT))
    assert (mine.lost, mine.cases["b"].lost, mine.cases["b"].why, mine.flights) == (1, 1, "fell", 8)
    assert mine.seeds == pytest.approx((PAR * exp(log(1.0 / LIMIT) / 6.0), PAR))


def test_where_stock_is_lost_as_well() -> None:
    lost = row(status="lost")
    assert ratio(lost, lost) == 1.0
    assert ratio(row(), lost) == LIMIT
    assert ratio(lost, row()) == 1.0 / LIMIT


numbers = st.floats(1e-6, 1e3)
flights = st.builds(row, numbers, numbers, numbers)


@given(own=flights, stock=flights)
def test_a_ratio_has_its_limits_and_turns_round(own: Row, stock: Row) -> None:
    value = ratio(own, stock)
    assert 1.0 / LIMIT - 1e-9 <= value <= LIMIT + 1e-9
    assert ratio(stock, own) == pytest.approx(1.0 / value)
    assert ratio(own, own) == pytest.approx(1.0)


def test_the_weights_are_of_one() -> None:
    assert sum(WEIGHTS.values()) == 1.0


def test_the_board_is_data() -> None:
    made = board(SUITE, rows({"mine": 2.0}, lost=[("a", "mine", 1), ("a", "mine", 2)]), ("mine", "stock"))
    assert msgspec.json.decode(msgspec.json.encode(made), type=type(made)) == made


# --- the suite


def test_every_case_of_the_suite_is_a_flight_with_what_its_name_says() -> None:
    suite = suites.read()
    assert suite.version == suites.NEWEST
    assert len({each.name for each in suite.cases}) == len(suite.cases)
    assert {each.group for each in suite.cases if each.quick} == set(suite.groups), "quick has some of each group"
    flights = {each.name: each.flight().scenario for each in suite.cases}
    assert len({msgspec.json.encode(scenario) for scenario in flights.values()}) == len(flights)
    assert flights["mass-1.3"].offnominal.mass_scale == 1.3
    assert flights["figure-8"].wind == ()
    assert flights["loss-20"].link.to_vehicle.loss == flights["loss-20"].link.to_ground.loss == 0.2
    for name in ("rotor-at-80", "rotor-slow", "rotor-cuts-out", "gps-intermittent"):
        assert flights[name].failures[0].start_s < flights[name].duration_s


def test_a_part_of_the_suite() -> None:
    suite = suites.read()
    assert {each.group for each in suite.chosen(pattern="wind").cases} == {"wind"}
    assert [each.name for each in suite.chosen(pattern="mass-*").cases] == ["mass-0.8", "mass-1.3"]
    assert suite.chosen(quick=True).seeds == suite.seeds[:1]
    assert suite.chosen(seeds=(7, 8)).seeds == (7, 8)
    with pytest.raises(GridError, match=r"no case of suite 1 is called so; there are: paths \(hover, steps, "):
        suite.chosen(pattern="nothing")


def test_each_case_is_flown_by_each_controller_in_the_same_air() -> None:
    cases = suites.read().chosen(pattern="hover", seeds=(3, 4)).flights(("pid", "stock"))
    assert [(each.labels, each.seed) for each in cases] == [
        ({"case": "hover", "controller": name}, seed) for seed in (3, 4) for name in ("pid", "stock")
    ]
    assert len({each.key for each in cases}) == len(cases)
