"""The fixed set of flights: data, with a version, so that a score says what it is of."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from importlib import resources
from typing import Any

import msgspec

from mavsitl import controllers
from mavsitl.campaign.errors import GridError
from mavsitl.campaign.grid import Case, case
from mavsitl.scenario import Flight, load

NEWEST = 1
CASE, CONTROLLER = "case", "controller"
"""Labels of a flight's row."""


class SuiteCase(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A shipped scenario with settings."""

    name: str
    group: str
    scenario: str
    settings: dict[str, Any]
    quick: bool = False
    """Flown by `mavsitl bench --quick` too."""

    def flight(self, controller: str | None = None) -> Flight:
        """As the named controller flies it; None: as the scenario's own does. Raises `ControllerError`."""
        return load(self.scenario, {**self.settings, **(controllers.settings(controller) if controller else {})})


class Suite(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    version: int
    seeds: tuple[int, ...]
    cases: tuple[SuiteCase, ...]

    @property
    def groups(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(each.group for each in self.cases))

    def chosen(self, *, pattern: str | None = None, quick: bool = False, seeds: Sequence[int] | None = None) -> Suite:
        """A part of it: cases whose name or group fits the pattern (as of file names); with `quick` those that are
        marked so, with the first seed. Raises `GridError` where nothing is left.
        """
        kept = [
            each
            for each in self.cases
            if (each.quick or not quick)
            and (pattern is None or fnmatchcase(each.name, pattern) or fnmatchcase(each.group, pattern))
        ]
        if not kept:
            names = ", ".join(f"{group} ({', '.join(self._names(group, quick))})" for group in self.groups)
            raise GridError(f"--case {pattern}: no case of suite {self.version} is called so; there are: {names}")
        return Suite(
            version=self.version, seeds=tuple(seeds or (self.seeds[:1] if quick else self.seeds)), cases=tuple(kept)
        )

    def flights(self, names: Iterable[str]) -> list[Case]:
        """Every case with every seed for each controller, the cases that differ in the controller alone together.

        Raises `ControllerError`.
        """
        names = list(names)
        made = []
        for each in self.cases:
            flights = [(name, each.flight(name)) for name in names]
            for seed in self.seeds:
                made += [case(flight, seed, {CASE: each.name, CONTROLLER: name}) for name, flight in flights]
        return made

    def _names(self, group: str, quick: bool) -> list[str]:
        return [each.name for each in self.cases if each.group == group and (each.quick or not quick)]


def read(version: int = NEWEST) -> Suite:
    """The suite of that number."""
    text = resources.files("mavsitl.score").joinpath(f"suite-{version}.toml").read_text("utf-8")
    return msgspec.convert(tomllib.loads(text), Suite)
