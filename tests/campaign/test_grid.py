"""What --set and --seeds say."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl.campaign.errors import GridError
from mavsitl.campaign.grid import Grid, parse_seeds, parse_setting, split
from mavsitl.scenario import ScenarioError


@pytest.mark.parametrize(
    ("text", "key", "values"),
    [
        ("wind.speed_20ft_m_s=0,5,10", "wind.speed_20ft_m_s", (0, 5, 10)),
        ("a=0:10:5", "a", (0, 5, 10)),
        ("a=0:0.3:0.1", "a", (0.0, 0.1, 0.2, 0.3)),
        ("a=10:0:-5,7", "a", (10, 5, 0, 7)),
        ("a=1:1:1", "a", (1,)),
        ("controller.law=pid,pidnn", "controller.law", ("pid", "pidnn")),
        ('title="one, two",three', "title", ("one, two", "three")),
        (r'title="a\",b",c', "title", ('a",b', "c")),
        ("title='a\\',b", "title", ("a\\", "b")),
        ('title="0:10:5"', "title", ("0:10:5",)),
        ("a=[1,0,0],[0,1,0]", "a", ([1, 0, 0], [0, 1, 0])),
        ('wind=[{model="steady",velocity_nwu_m_s=[1,2,3]}],[]', "wind",
         ([{"model": "steady", "velocity_nwu_m_s": [1, 2, 3]}], [])),
        ("start.clamp=true,false", "start.clamp", (True, False)),
        ("airframe=mine=yours.toml", "airframe", ("mine=yours.toml",)),
    ],
)  # fmt: skip
def test_settings(text: str, key: str, values: tuple[Any, ...]) -> None:
    setting = parse_setting(text)
    assert (setting.key, setting.values) == (key, values)
    assert [type(value) for value in setting.values] == [type(value) for value in values]
    assert setting.swept == (len(values) > 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a", "a: not KEY=VALUE or KEY=A,B,C"),
        ("=1", "=1: not KEY=VALUE"),
        ("a=", "a: a value is missing; allowed: A,B,C or START:STOP:STEP"),
        ("a=1,,2", "a: a value is missing"),
        ("a=1,2,1", "a: 1 is there twice"),
        ("a=5,5.0", "a: 5.0 is there twice"),
        ("a=0:5:10", "a: 0:5:10: steps of 10 do not lead from 0 to 5; allowed: START:STOP:STEP with STOP a whole"),
        ("a=0:1:10", "a: 0:1:10: steps of 10 do not lead from 0 to 1"),
        ("a=0:10:0", "a: 0:10:0: steps of 0"),
        ("a=0:1:1e-9", "a: 0:1:1e-9: steps of 1E-9"),
        ("a=0:1:.", "a: 0:1:.: not START:STOP:STEP in numbers"),
        ("a=[1,2", "a: [1,2: not valid TOML"),
        ("seed=1,2", "seed: not a setting here; --seeds says which"),
    ],
)
def test_wrong_settings_are_named(text: str, message: str) -> None:
    with pytest.raises(GridError) as refusal:
        parse_setting(text)
    assert str(refusal.value).startswith(message)


@given(st.text(alphabet="a1.,:[]{}\"'\\=- ", max_size=30))
def test_any_text_is_a_setting_or_refused(text: str) -> None:
    try:
        assert parse_setting(f"key={text}").values
    except GridError as error:
        told = str(error)
        assert told.startswith("key: ")


@given(st.lists(st.text(alphabet='ab,"[]\\', max_size=8), min_size=1, max_size=5, unique=True))
def test_quoted_texts_come_back(texts: list[str]) -> None:
    quoted = ['"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"' for text in texts]
    assert split(",".join(quoted)) == quoted
    assert parse_setting(f"key={','.join(quoted)}").values == tuple(texts)


@given(st.integers(-1000, 1000), st.integers(1, 50), st.integers(1, 100), st.integers(0, 3))
def test_ranges_are_exact_decimals(start: int, count: int, step: int, places: int) -> None:
    def shown(number: int) -> str:
        return f"{number / 10**places:.{places}f}"

    values = parse_setting(f"key={shown(start)}:{shown(start + count * step)}:{shown(step)}").values
    assert list(values) == [float(shown(start + index * step)) for index in range(count + 1)]


@pytest.mark.parametrize(
    ("text", "seeds"),
    [
        ("3", (1, 2, 3)), ("1", (1,)), ("7,", (7,)), ("1,2,7", (1, 2, 7)), ("10-12", (10, 11, 12)),
        ("0-1, 5", (0, 1, 5)), ("7-7", (7,)),
    ],
)  # fmt: skip
def test_seeds(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "0", "-1", "a", "3-1", "1,,2", "1,1", "1-3,2", "1.5", "1000000", "²"])
def test_wrong_seeds_are_refused(text: str) -> None:
    with pytest.raises(GridError, match=r"allowed|twice"):
        parse_seeds(text)


@given(st.lists(st.integers(0, 10_000), min_size=2, max_size=20, unique=True))
def test_named_seeds_are_these(seeds: list[int]) -> None:
    assert parse_seeds(",".join(map(str, seeds))) == tuple(seeds)


def test_a_grid_is_every_combination_with_every_seed() -> None:
    texts = ("controller.law=pid,pidnn", "duration_s=2", "wind.speed_20ft_m_s=0,5")
    grid = Grid("hover-wind", tuple(map(parse_setting, texts)), (1, 2))
    assert grid.keys == ("controller.law", "wind.speed_20ft_m_s")
    cases = grid.cases()
    assert [(*case.labels.values(), case.seed) for case in cases] == [
        (law, speed, seed) for law in ("pid", "pidnn") for speed in (0, 5) for seed in (1, 2)
    ]
    assert len({case.key for case in cases}) == 8
    for case in cases:
        scenario = case.flight.scenario
        assert (scenario.controller.law, scenario.seed, scenario.duration_s) == (
            case.labels["controller.law"], case.seed, 2.0,
        )  # fmt: skip
        assert getattr(scenario.wind[0], "speed_20ft_m_s") == case.labels["wind.speed_20ft_m_s"]  # noqa: B009


def test_a_grid_is_checked_as_a_whole() -> None:
    for text, message in (
        ("controller.lawn=pid,pidnn", "controller.lawn: unknown key; did you mean law? allowed here: law, level,"),
        ("controller.law=pid,lqr", "controller.law: 'lqr' is not allowed; allowed: 'pid', 'pidnn'"),
    ):
        with pytest.raises(ScenarioError) as refusal:
            Grid("hover-wind", (parse_setting(text),), (1,)).cases()
        assert message in str(refusal.value)
