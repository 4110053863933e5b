"""What is tuned: keys of a scenario, each between two bounds, and the unit cube in which they are searched."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from math import exp, isfinite, log
from typing import Any, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from mavsitl.scenario import Controller, Flight, ScenarioError, load

Floats: TypeAlias = npt.NDArray[np.float64]
Overrides: TypeAlias = dict[str, Any]

SPAN = 5.0
"""Without a range a key is searched from a fifth of its value in the scenario to five times that."""
DIGITS = 4
"""Significant ones. Candidates are rounded before they fly, so that the file holds just what was flown."""

ITEM = re.compile(r"(?P<key>[^\[\]]+)\[(?P<index>\d+)\]")
_RANGE = re.compile(r"(?P<low>[^:]+):(?P<high>[^:]+)(?::(?P<scale>[^:]*))?")


@dataclass(frozen=True)
class Dial:
    """One number to be tuned, `low` <= value <= `high`."""

    key: str
    """Dotted, as a scenario has it; ``controller.learning.rate`` is all three, ``controller.learning.rate[0]`` one."""
    low: float
    high: float
    log: bool
    """Searched by its logarithm: as far from 1 to 2 as from 2 to 4."""

    def value(self, place: float) -> float:
        """At `place` of 0 to 1, rounded."""
        place = min(max(place, 0.0), 1.0)
        if self.log:
            value = exp(log(self.low) + place * (log(self.high) - log(self.low)))
        else:
            value = self.low + place * (self.high - self.low)
        return min(max(rounded(value), self.low), self.high)

    def place(self, value: float) -> float:
        """Where in 0 to 1 a value is."""
        if self.log:
            return (log(value) - log(self.low)) / (log(self.high) - log(self.low))
        return (value - self.low) / (self.high - self.low)


@dataclass(frozen=True)
class Space:
    """The dials, and where they stand in the scenarios as they are."""

    dials: tuple[Dial, ...]
    start: tuple[float, ...]
    _lists: Mapping[str, tuple[float, ...]]
    """Arrays of the scenario of which a dial turns some items."""

    @property
    def start_place(self) -> Floats:
        """(dials,), 0 to 1."""
        return np.array([dial.place(value) for dial, value in zip(self.dials, self.start, strict=True)])

    def values(self, place: Floats) -> tuple[float, ...]:
        """One for each dial, at a point (dials,) of the unit cube."""
        return tuple(dial.value(float(x)) for dial, x in zip(self.dials, place, strict=True))

    def overrides(self, values: Sequence[float]) -> Overrides:
        """The scenario's keys for these values, as `mavsitl.scenario.load` takes them."""
        made: Overrides = {}
        lists = {key: list(items) for key, items in self._lists.items()}
        for dial, value in zip(self.dials, values, strict=True):
            item = ITEM.fullmatch(dial.key)
            if item is not None:
                lists[item["key"]][int(item["index"])] = value
                made[item["key"]] = lists[item["key"]]
            elif dial.key in lists:
                made[dial.key] = [value] * len(lists[dial.key])
            else:
                made[dial.key] = value
        return made


def rounded(value: float) -> float:
    """To `DIGITS` significant digits."""
    return float(f"{value:.{DIGITS}g}")


def default_keys(controller: Controller) -> tuple[str, ...]:
    """What is worth tuning of what such a controller reads."""
    keys = [f"controller.{loop}.{gain}" for loop in ("altitude", "position") for gain in _GAINS]
    keys.append("controller.angle_filter_rad_s")
    if controller.level != "attitude" or controller.inner == "pidnn":
        keys += [f"controller.{loop}.{gain}" for loop in ("roll_pitch", "yaw") for gain in _GAINS]
        if controller.law == "pidnn":
            keys.append("controller.learning.rate")
    if controller.wind_information == "observer":
        keys += ["controller.wind_observer.horizontal_rad_s", "controller.wind_observer.vertical_rad_s"]
    return tuple(keys)


_GAINS = ("k_p_per_s2", "k_i_per_s3", "k_d_per_s")


def space(names: Sequence[str], settings: Overrides, asked: Sequence[str]) -> Space:
    """The space of `asked`, each ``KEY`` or ``KEY=LOW:HIGH[:log|linear]``; the default keys where nothing is asked.

    `names` are scenarios by name or path, changed by `settings`. Raises `ScenarioError` for a key that no scenario has
    or that is no gain, a range that is none or that the scenario does not allow, and scenarios that differ in a key.
    """
    flights = [load(name, settings) for name in names]
    texts = list(asked)
    if not texts:
        wanted = dict.fromkeys(key for flight in flights for key in default_keys(flight.scenario.controller))
        texts = [key for key in wanted if any(_numbers(_find(flights[0], key)))]
    dials, start, lists = [], [], {}
    for text in texts:
        key, equals, bounds = (part.strip() for part in text.partition("="))
        value, items = _present(key, names, flights)
        low, high, scale = _bounds(text, bounds, value) if equals else _around(key, value)
        if not low <= value <= high:
            raise ScenarioError(f"--tune {text}: the search begins at the scenario's value, {value:g}, outside of it")
        dials.append(Dial(key, low, high, scale))
        start.append(value)
        if items is not None:
            lists[ITEM.sub(r"\g<key>", key)] = items
    for key, same in groupby(sorted(ITEM.sub(r"\g<key>", dial.key) for dial in dials)):
        named = [dial.key for dial in dials if ITEM.sub(r"\g<key>", dial.key) == key]
        if len(list(same)) != len(set(named)) or (len(named) > 1 and key in named):
            raise ScenarioError(f"--tune {key}: given twice")
    made = Space(tuple(dials), tuple(start), lists)
    for values in ([dial.low for dial in dials], [dial.high for dial in dials]):
        for name in names:
            load(name, settings | made.overrides(values))
    return made


def _present(key: str, names: Sequence[str], flights: Sequence[Flight]) -> tuple[float, tuple[float, ...] | None]:
    """The value that the scenarios have for `key`, and the whole array that it is of."""
    if not key.startswith(("controller.", "parameters.")):
        raise ScenarioError(f"--tune {key}: not allowed; allowed: keys of controller and of parameters")
    item = ITEM.fullmatch(key)
    found = [_find(flight, item["key"] if item else key) for flight in flights]
    for name, other in zip(names[1:], found[1:], strict=True):
        if other != found[0]:
            raise ScenarioError(
                f"--tune {key}: {names[0]} has {_show(found[0])} and {name} {_show(other)}; "
                "give both the same with --set"
            )
    numbers = _numbers(found[0])
    if not numbers:
        raise ScenarioError(f"--tune {key}: {_show(found[0])} is not a number that can be tuned")
    items = numbers if isinstance(found[0], list | tuple) else None
    if item is not None:
        if items is None or int(item["index"]) >= len(items):
            allowed = "no index" if items is None else f"an index from 0 to {len(items) - 1}"
            raise ScenarioError(f"--tune {key}: there is no such item; allowed: {allowed}")
        return items[int(item["index"])], items
    if len(set(numbers)) > 1:
        raise ScenarioError(f"--tune {key}: its items differ, {_show(found[0])}; name one, as {key}[0]")
    return numbers[0], items


def _find(flight: Flight, key: str) -> Any:
    """Plain data: a number, a list, a text. Raises `ScenarioError` naming what there is at the place."""
    data: Any = msgspec.to_builtins(flight.scenario)
    data["parameters"] = dict(flight.airframe.parameters) | data["parameters"]
    path = key.split(".")
    for depth, part in enumerate(path):
        if not isinstance(data, dict) or part not in data:
            at = ".".join(path[:depth])
            allowed = ", ".join(data) if isinstance(data, dict) else "nothing below it"
            raise ScenarioError(f"--tune {key}: {at} has no '{part}'; it has: {allowed}")
        data = data[part]
    return data


def _numbers(data: Any) -> tuple[float, ...]:
    """Of a number or an array of numbers; none of anything else."""
    items = data if isinstance(data, list | tuple) else [data]
    return tuple(items) if all(isinstance(each, float) for each in items) else ()


def _bounds(text: str, bounds: str, value: float) -> tuple[float, float, bool]:
    match = _RANGE.fullmatch(bounds)
    try:
        if match is None or match["scale"] not in (None, "log", "linear"):
            raise ValueError
        low, high = float(match["low"]), float(match["high"])
        if not (isfinite(low) and isfinite(high) and low < high):
            raise ValueError
    except ValueError:
        raise ScenarioError(
            f"--tune {text}: '{bounds}' is no range; allowed: LOW:HIGH, LOW:HIGH:log or LOW:HIGH:linear with LOW < HIGH"
        ) from None
    scale = match["scale"] == "log" or (match["scale"] is None and low > 0.0 and high >= SPAN * low)
    if scale and not low > 0.0:
        raise ScenarioError(f"--tune {text}: a logarithm needs LOW > 0")
    return low, high, scale


def _around(key: str, value: float) -> tuple[float, float, bool]:
    if not value > 0.0:
        raise ScenarioError(f"--tune {key}: the scenario has {value:g} there, so it needs a range: {key}=LOW:HIGH")
    return rounded(value / SPAN), rounded(value * SPAN), True


def _show(data: Any) -> str:
    match data:
        case dict():
            return "a table"
        case list() | tuple():
            return str(list(data))
        case _:
            return str(data)
