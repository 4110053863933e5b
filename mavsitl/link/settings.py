"""What parameters say of a link that flies: a few settings laid over the scenario's.

A vehicle tells them by their names in `KEYS`, which are the ends of its parameters' names (``SIM_LINK_LAT``).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple, TypeAlias

import msgspec

from mavsitl.scenario import Impairment, LinkModel

__all__ = [
    "AS_IN_SCENARIO",
    "BOTH",
    "DIRECTION",
    "KEYS",
    "PLACES",
    "PREFIXES",
    "DirectionName",
    "LinkName",
    "Overlay",
    "initial",
]

LinkName: TypeAlias = Literal["link", "gcs_link"]
"""As the scenario's sections are called: the off-board link, and the ground stations'."""

PREFIXES: Mapping[LinkName, str] = {"link": "SIM_LINK_", "gcs_link": "SIM_GLINK_"}
"""Of the parameters' names."""

PLACES = ("link", "gcs_link", "tcp_link")
"""A vehicle's ports in order: off-board, ground stations over UDP, over TCP. The last two are both "gcs_link"; each
place has random numbers of its own."""

DirectionName: TypeAlias = Literal["to_ground", "to_vehicle"]

BOTH = 0
DIRECTIONS: Mapping[int, tuple[DirectionName, ...]] = {
    BOTH: ("to_ground", "to_vehicle"),
    1: ("to_ground",),
    2: ("to_vehicle",),
}
DIRECTION = "DIR"
"""The setting that says for which directions the others hold: a key of `DIRECTIONS`."""

KEYS: Mapping[str, str] = {
    "LAT": "latency_ms",
    "JIT": "jitter_ms",
    "LOSS": "loss",
    "BURST": "bursts.bad_ms",
    "GOOD": "bursts.good_ms",
    "REORD": "reorder",
    "DUP": "duplicate",
    "CORR": "corrupt",
    "BW": "bandwidth_kbit_s",
    "DOWN": "down",
}
"""Setting to the key of `Impairment` that it replaces."""


class Overlay(NamedTuple):
    """Settings that replace the scenario's in some directions; those that are not named stay the scenario's."""

    values: Mapping[str, float]
    """By the names in `KEYS`, in the units of the scenario's keys."""
    direction: int = BOTH
    """A key of `DIRECTIONS`: where `values` hold."""
    everywhere: Mapping[str, float] = {}
    """As `values`, over them and in both directions: of a failure."""

    def of(self, impairment: Impairment, direction: DirectionName) -> Impairment:
        """What the scenario's impairment of a direction becomes."""
        chosen = self.values if direction in DIRECTIONS[self.direction] else {}
        settings = {**chosen, **self.everywhere}
        if not settings:
            return impairment
        bursts = impairment.bursts
        plain: dict[str, float | bool] = {}
        for name, value in settings.items():
            section, _, key = KEYS[name].rpartition(".")
            if section:
                bursts = msgspec.structs.replace(bursts, **{key: value})
            else:
                plain[key] = bool(value) if key == "down" else value
        return msgspec.structs.replace(impairment, bursts=bursts, **plain)

    def leaves(self, model: LinkModel) -> bool:
        """Whether it changes nothing of that link."""
        to_ground, to_vehicle = model.to_ground, model.to_vehicle
        return self.of(to_ground, "to_ground") == to_ground and self.of(to_vehicle, "to_vehicle") == to_vehicle


AS_IN_SCENARIO = Overlay({})


def initial(model: LinkModel) -> dict[str, float]:
    """The settings with which a link begins: those of the scenario; where its directions differ, to the vehicle."""
    impairment = model.to_vehicle
    found: dict[str, float] = {DIRECTION: BOTH}
    for name, path in KEYS.items():
        section, _, key = path.rpartition(".")
        found[name] = float(getattr(impairment.bursts if section else impairment, key))
    return found
