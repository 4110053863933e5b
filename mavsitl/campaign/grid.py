"""What is to be flown: cases, each with a key that says what decides the flight."""

from __future__ import annotations

import hashlib
import re
import tomllib
from collections.abc import Mapping
from decimal import Decimal, InvalidOperation
from functools import cache
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import msgspec

from mavsitl import controllers
from mavsitl.campaign.errors import GridError
from mavsitl.scenario import Flight, ScenarioError, Waypoints, load

Overrides: TypeAlias = dict[str, Any]
"""Dotted keys of a scenario, e.g. ``{"controller.law": "pid"}``."""
Labels: TypeAlias = dict[str, Any]
"""What tells the cases of a campaign apart, by the scenario's dotted keys; values as in the scenario's file."""

NOT_FLYING = (
    "report/", "link/", "campaign/", "tune/", "score/", "cli/", "testing/", "view/",
    *(f"log/{name}." for name in ("content", "convert", "diff", "endings", "info", "mcap", "rejoin")),
    "ask.", "check.", "clock.", "ends.", "herald.", "keep.", "monitor.", "pair.", "__main__",
)  # fmt: skip
DECIDING = (
    "link/impaired.py", "link/framing.py", "link/settings.py", "campaign/fly.py", "campaign/sums.py",
)  # fmt: skip
"""What of the bridge does not decide a flight in memory or what is measured of it, and what of that does."""


class Case(msgspec.Struct, frozen=True):
    """One flight to fly. `flight` has every override and the seed in it."""

    flight: Flight
    seed: int
    key: str
    """A digest of everything that decides the flight: scenario, airframe, seed, and the source of what flies."""
    labels: Labels = {}
    waypoints: bytes | None = None
    """What is in the reference's file, where it has one: whoever flies the case need not have the file."""
    controller: str = ""
    """`controllers.source_digest` of a controller of the user's: whoever flies the case needs the same file."""


def case(flight: Flight, seed: int | None = None, labels: Mapping[str, Any] | None = None) -> Case:
    """`seed`: None is the scenario's. Raises `ScenarioError` for a file of waypoints that cannot be read, and
    `ControllerError` for a controller that is not found.
    """
    scenario = flight.scenario
    if seed is None:
        seed = scenario.seed
    elif seed != scenario.seed:
        scenario = msgspec.structs.replace(scenario, seed=seed)
        flight = msgspec.structs.replace(flight, scenario=scenario)
    waypoints = _waypoints(scenario.reference.file) if isinstance(scenario.reference, Waypoints) else None
    digest = hashlib.blake2b(digest_size=16)
    digest.update(source_digest().encode())
    digest.update(msgspec.json.encode((scenario, flight.airframe), order="deterministic"))
    digest.update(waypoints or b"")
    own = controllers.source_digest(scenario.controller.own) if scenario.controller.own else ""
    digest.update(own.encode())
    return Case(flight, seed, digest.hexdigest(), dict(labels or {}), waypoints, own)


def _waypoints(file: str) -> bytes:
    try:
        return Path(file).read_bytes()
    except OSError as error:
        raise ScenarioError(f"reference.file: {file}: cannot be read: {error.strerror or error}") from error


@cache
def source_digest() -> str:
    """32 hexadecimal digits of every source file that can decide a flight: the two wings, and of the bridge a part."""
    digest = hashlib.blake2b(digest_size=16)
    for package in ("mavsitl", "mavsitl_vehicle", "mavsitl_ground"):
        spec = find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            for file in sorted(Path(folder).rglob("*.py")):
                inside = file.relative_to(folder).as_posix()
                if inside.startswith(DECIDING) or not inside.startswith(NOT_FLYING):
                    digest.update(inside.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


class Setting(msgspec.Struct, frozen=True):
    """A key of the scenario and the values that it is to have."""

    key: str
    values: tuple[Any, ...]

    @property
    def swept(self) -> bool:
        return len(self.values) > 1


class Cell(msgspec.Struct, frozen=True):
    """One combination of values; its cases differ in their seeds alone."""

    labels: Labels
    """Of the keys that are swept."""
    flight: Flight


class Grid(msgspec.Struct, frozen=True):
    """Every combination of the settings' values, each with every seed."""

    scenario: str
    """A shipped scenario's name or a file."""
    settings: tuple[Setting, ...]
    seeds: tuple[int, ...]

    @property
    def keys(self) -> tuple[str, ...]:
        """Those that are swept."""
        return tuple(setting.key for setting in self.settings if setting.swept)

    def cells(self) -> list[Cell]:
        """The last key changes first. Raises `ScenarioError` for the first combination that is none."""
        made = []
        for values in product(*(setting.values for setting in self.settings)):
            overrides = {setting.key: value for setting, value in zip(self.settings, values, strict=True)}
            flight = load(self.scenario, overrides)
            made.append(Cell({key: overrides[key] for key in self.keys}, flight))
        return made

    def cases(self) -> list[Case]:
        """Cell by cell, all seeds of a cell together. Raises `ScenarioError`."""
        return [case(cell.flight, seed, cell.labels) for cell in self.cells() for seed in self.seeds]


_RANGE = re.compile(r"\s*([-+]?[\d.]+(?:e[-+]?\d+)?):([-+]?[\d.]+(?:e[-+]?\d+)?):([-+]?[\d.]+(?:e[-+]?\d+)?)\s*", re.I)
_SEEDS = re.compile(r"\s*(\d+)(?:-(\d+))?\s*", re.ASCII)
MOST = 100_000
"""Values of a range, and seeds of one."""
SEEDS_ALLOWED = f"N for 1 to N, or N,N,N or FIRST-LAST, at most {MOST}"


def parse_setting(text: str) -> Setting:
    """KEY=VALUE, KEY=A,B,C or KEY=START:STOP:STEP, STOP included, and mixtures of these.

    A value is TOML's, so that an array or a table is one value, commas and all; what is no TOML is text.
    Raises `GridError`.
    """
    key, equals, listed = text.partition("=")
    key = key.strip()
    if not equals or not key:
        raise GridError(f"{text}: not KEY=VALUE or KEY=A,B,C")
    if key == "seed":
        raise GridError("seed: not a setting here; --seeds says which")
    values: list[Any] = []
    for piece in split(listed):
        values += _values(key, piece)
    for index, value in enumerate(values):
        if value in values[:index]:
            raise GridError(f"{key}: {value!r} is there twice")
    return Setting(key, tuple(values))


def split(text: str) -> list[str]:
    """At the commas that are in no string, array or table of TOML's."""
    pieces, start, depth, quote = [], 0, 0, ""
    index = 0
    while index < len(text):
        letter = text[index]
        if quote:
            if letter == "\\" and quote == '"':
                index += 1
            elif letter == quote:
                quote = ""
        elif letter in "\"'":
            quote = letter
        elif letter in "[{":
            depth += 1
        elif letter in "]}":
            depth -= 1
        elif letter == "," and depth <= 0:
            pieces.append(text[start:index])
            start = index + 1
        index += 1
    return [*pieces, text[start:]]


def _values(key: str, piece: str) -> list[Any]:
    if not piece.strip():
        raise GridError(f"{key}: a value is missing; allowed: A,B,C or START:STOP:STEP")
    if found := _RANGE.fullmatch(piece):
        return _range(key, piece.strip(), *found.groups())
    try:
        return [tomllib.loads(f"value = {piece}")["value"]]
    except tomllib.TOMLDecodeError as error:
        if piece.lstrip()[0] in "[{\"'":
            raise GridError(f"{key}: {piece.strip()}: not valid TOML: {error}") from error
        return [piece.strip()]


def _range(key: str, piece: str, *texts: str) -> list[Any]:
    """In decimals, so that 0:0.3:0.1 is 0, 0.1, 0.2, 0.3."""
    try:
        start, stop, step = map(Decimal, texts)
    except InvalidOperation as error:
        raise GridError(f"{key}: {piece}: not START:STOP:STEP in numbers") from error
    count, rest = divmod(stop - start, step) if step else (Decimal(-1), Decimal(0))
    if rest or not 0 <= count < MOST:
        raise GridError(
            f"{key}: {piece}: steps of {step} do not lead from {start} to {stop}; "
            "allowed: START:STOP:STEP with STOP a whole number of steps from START, e.g. 0:10:5 for 0, 5, 10"
        )
    whole = all(re.fullmatch(r"[-+]?\d+", text) for text in texts)
    return [(int if whole else float)(start + index * step) for index in range(int(count) + 1)]


def parse_seeds(text: str) -> tuple[int, ...]:
    """``50`` is 1 to 50; ``1,2,7``, ``10-19`` and mixtures name them. Raises `GridError`."""
    pieces = text.split(",")
    if len(pieces) > 1 and not pieces[-1].strip():
        pieces.pop()  # 7, is the seed 7 alone
    alone = len(pieces) == 1 and "," not in text
    seeds: list[int] = []
    for piece in pieces:
        found = _SEEDS.fullmatch(piece)
        first, last = (int(found[1]), int(found[2] or found[1])) if found else (1, 0)
        if found and alone and found[2] is None:
            first = 1
        if not first <= last < first + MOST:
            where = "" if alone else f" {text}"
            raise GridError(f"seeds{where}: {piece.strip()!r} is not allowed; allowed: {SEEDS_ALLOWED}")
        seeds += range(first, last + 1)
    if len(set(seeds)) != len(seeds):
        raise GridError(f"seeds {text}: one is there twice")
    return tuple(seeds)
