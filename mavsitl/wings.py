"""The seats of the two wings: found by entry point, so that the bridge imports neither and others can sit down."""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points
from typing import Any, Literal

from mavsitl.errors import UsageError

Group = Literal["mavsitl.vehicle", "mavsitl.ground", "mavsitl.reference"]

BOOT_GROUP = "mavsitl.boot"
"""``heartbeat(sequence, system_id) -> frame`` of a vehicle, under its own name: what is sent while it is loaded."""

PARAMETERS_GROUP = "mavsitl.parameters"
"""An iterable of the names of a vehicle's parameters."""

VEHICLE_GROUP: Group = "mavsitl.vehicle"
GROUND_GROUP: Group = "mavsitl.ground"
REFERENCE_GROUP: Group = "mavsitl.reference"
"""``reference_for(reference) -> path`` with ``path.sample(time_s)``: where a ground's vehicle is to be."""

_SHIPPED = {VEHICLE_GROUP: "quadrotor", GROUND_GROUP: "paper", REFERENCE_GROUP: "paper"}


class WingError(UsageError, LookupError):
    """No such wing is installed; the message lists those that are."""


def find(group: Group, name: str | None = None) -> Any:
    """The `build` function of a wing: ``build(flight, recorder, **options) -> core``. No name: the shipped one."""
    found = {point.name: point for point in _installed().select(group=group)}
    wanted = name or _SHIPPED[group]
    if wanted not in found:
        raise WingError(f"{wanted!r} is not installed under {group}; installed: {', '.join(sorted(found)) or 'none'}")
    return found[wanted].load()


def find_boot(name: str | None = None) -> Any | None:
    """The HEARTBEAT of a vehicle wing that is still to be loaded; None where it has none."""
    wanted = name or _SHIPPED[VEHICLE_GROUP]
    return next((point.load() for point in _installed().select(group=BOOT_GROUP) if point.name == wanted), None)


def parameter_names() -> list[str]:
    """Of the vehicles that are installed and tell them, without a vehicle that runs."""
    return sorted({name for point in _installed().select(group=PARAMETERS_GROUP) for name in point.load()})


@cache
def _installed() -> Any:
    """Looking through everything that is installed takes longer than to load what is found."""
    return entry_points()
