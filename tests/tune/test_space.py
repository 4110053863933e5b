"""What can be tuned, and how wrong keys and ranges are named."""

from __future__ import annotations

import re

import numpy as np
import pytest

from mavsitl import scenario
from mavsitl.scenario import Controller, ScenarioError
from mavsitl.tune.space import Dial, default_keys, space

PAPER = ("hover-calm", "hover-wind", "spiral-calm", "spiral-wind")


def test_the_defaults_are_the_gains_that_the_controller_reads() -> None:
    made = space(PAPER, {}, ())
    keys = [dial.key for dial in made.dials]
    assert len(keys) == 16
    assert "controller.learning.rate" in keys
    place = keys.index("controller.position.k_p_per_s2")
    assert made.start[place] == Controller().position.k_p_per_s2
    assert (made.dials[place].low, made.dials[place].high, made.dials[place].log) == (2.312, 57.8, True)


@pytest.mark.parametrize(
    ("settings", "absent"),
    [
        ({"law": "pid"}, "learning"),
        ({"wind_information": "none"}, "wind_observer"),
        ({"level": "attitude", "inner": "stock"}, "roll_pitch"),
    ],
)
def test_what_is_not_read_is_not_tuned(settings: dict[str, str], absent: str) -> None:
    changed = scenario.load("hover-wind", {f"controller.{key}": value for key, value in settings.items()})
    assert any(absent in key for key in default_keys(Controller()))
    assert not any(absent in key for key in default_keys(changed.scenario.controller))


def test_a_gain_of_0_stays_out_unless_it_has_a_range() -> None:
    settings = {"controller.angle_filter_rad_s": 0.0}
    assert "controller.angle_filter_rad_s" not in [dial.key for dial in space(["hover-wind"], settings, ()).dials]
    with pytest.raises(ScenarioError, match=r"angle_filter_rad_s: the scenario has 0 there, so it needs a range"):
        space(["hover-wind"], settings, ["controller.angle_filter_rad_s"])
    (dial,) = space(["hover-wind"], settings, ["controller.angle_filter_rad_s=0:20"]).dials
    assert not dial.log


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("controller.position.kp", "controller.position has no 'kp'; it has: k_p_per_s2, k_i_per_s3, k_d_per_s"),
        ("controller.postion.k_p_per_s2", "controller has no 'postion'"),
        ("noise.position_m=0.001:0.1", "allowed: keys of controller and of parameters"),
        ("controller.law", "pidnn is not a number that can be tuned"),
        ("controller.position", "a table is not a number that can be tuned"),
        ("controller.position.k_p_per_s2=20:1", "'20:1' is no range"),
        ("controller.position.k_p_per_s2=1:20:cubic", "'1:20:cubic' is no range"),
        ("controller.position.k_p_per_s2=1:inf", "'1:inf' is no range"),
        ("controller.position.k_p_per_s2=", "'' is no range"),
        ("controller.position.k_i_per_s3=0:1:log", "a logarithm needs LOW > 0"),
        ("controller.position.k_p_per_s2=1:5", "begins at the scenario's value, 11.56, outside of it"),
        ("controller.position.k_d_per_s=-1:9", "controller.position.k_d_per_s: -1.0 is not allowed"),
        ("controller.learning.rate[3]", "no such item; allowed: an index from 0 to 2"),
        ("controller.position.k_p_per_s2[0]", "no such item; allowed: no index"),
        ("parameters.MC_NOTHING", "parameters has no 'MC_NOTHING'"),
    ],
)
def test_a_wrong_key_or_range_is_named(asked: str, said: str) -> None:
    with pytest.raises(ScenarioError, match=re.escape(said)):
        space(["hover-wind"], {}, [asked])


def test_scenarios_that_differ_in_a_key_are_refused() -> None:
    names = ("hover-wind", "hover-wind-realistic")
    with pytest.raises(
        ScenarioError, match=r"hover-wind has 11\.56 and hover-wind-realistic 7\.749; give both the same"
    ):
        space(names, {}, ["controller.position.k_p_per_s2"])
    assert space(names, {"controller.position.k_p_per_s2": 10.0}, ["controller.position.k_p_per_s2"]).start == (10.0,)


@pytest.mark.parametrize("twice", [("law.x", "law.x"), ("law.x", "law.x[0]"), ("law.x[1]", "law.x[1]")])
def test_a_key_is_given_once(twice: tuple[str, str]) -> None:
    asked = [each.replace("law.x", "controller.learning.rate") for each in twice]
    with pytest.raises(ScenarioError, match="given twice"):
        space(["hover-wind"], {}, asked)


def test_an_array_is_turned_as_one_or_item_by_item() -> None:
    whole = space(["hover-wind"], {}, ["controller.learning.rate=1:100"])
    assert whole.overrides([3.0]) == {"controller.learning.rate": [3.0, 3.0, 3.0]}
    items = space(["hover-wind"], {}, ["controller.learning.rate[0]", "controller.learning.rate[2]"])
    assert items.overrides([3.0, 4.0]) == {"controller.learning.rate": [3.0, 13.4, 4.0]}
    with pytest.raises(ScenarioError, match="its items differ"):
        space(["hover-wind"], {"controller.learning.rate": [1.0, 2.0, 3.0]}, ["controller.learning.rate"])


def test_a_parameter_of_the_vehicle_starts_at_the_airframes_value() -> None:
    made = space(["hover-wind"], {"controller.level": "attitude"}, ["parameters.MC_ROLL_P"])
    assert made.start == (20.0,)
    changed = scenario.load("hover-wind", made.overrides([15.0]))
    assert changed.scenario.parameters == {"MC_ROLL_P": 15.0}


@pytest.mark.parametrize("log", [True, False])
def test_the_cube_covers_the_range_and_its_start(log: bool) -> None:
    dial = Dial("k", 0.5, 12.5, log)
    assert [dial.value(place) for place in (-1.0, 0.0, 1.0, 2.0)] == [0.5, 0.5, 12.5, 12.5]
    assert dial.value(0.5) == (2.5 if log else 6.5)
    assert dial.place(dial.value(0.3)) == pytest.approx(0.3, abs=1e-3)
    made = space(PAPER, {}, ())
    assert made.values(made.start_place) == made.start


def test_candidates_have_four_digits() -> None:
    made = space(["hover-wind"], {}, ())
    for value in made.values(np.random.default_rng(1).uniform(size=len(made.dials))):
        assert value == float(f"{value:.4g}")
