"""What is to be flown: cases, each with a key that says what decides the flight."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeAlias

import msgspec

from mavsitl.scenario import Flight, ScenarioError, Waypoints

Overrides: TypeAlias = dict[str, Any]
"""Dotted keys of a scenario, e.g. ``{"controller.law": "pid"}``."""
Labels: TypeAlias = dict[str, Any]
"""What tells the cases of a campaign apart, by the scenario's dotted keys; values as in the scenario's file."""

NOT_FLYING = (
    "report/", "link/", "campaign/", "tune/",
    "ask.", "check.", "cli.", "clock.", "ends.", "herald.", "keep.", "pair.", "testing.", "__main__",
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


def case(flight: Flight, seed: int | None = None, labels: Mapping[str, Any] | None = None) -> Case:
    """`seed`: None is the scenario's. Raises `ScenarioError` for a file of waypoints that cannot be read."""
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
    return Case(flight, seed, digest.hexdigest(), dict(labels or {}), waypoints)


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
