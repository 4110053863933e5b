"""The seats of the two wings: found by entry point, so that the bridge imports neither and others can sit down."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

Group = Literal["mavsitl.vehicle", "mavsitl.ground"]

VEHICLE_GROUP: Group = "mavsitl.vehicle"
GROUND_GROUP: Group = "mavsitl.ground"

_SHIPPED = {VEHICLE_GROUP: "quadrotor", GROUND_GROUP: "paper"}


class WingError(LookupError):
    """No such wing is installed; the message lists those that are."""


def find(group: Group, name: str | None = None) -> Any:
    """The `build` function of a wing: ``build(flight, recorder, **options) -> core``. No name: the shipped one."""
    found: dict[str, EntryPoint] = {point.name: point for point in entry_points(group=group)}
    wanted = name or _SHIPPED[group]
    if wanted not in found:
        raise WingError(f"{wanted!r} is not installed under {group}; installed: {', '.join(sorted(found)) or 'none'}")
    return found[wanted].load()
