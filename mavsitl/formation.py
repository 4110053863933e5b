"""Where the vehicles of a fleet are in their formation: both wings shift by it, starts or references."""

from __future__ import annotations

from math import ceil, cos, pi, sin, sqrt

import msgspec

from mavsitl.scenario import Fleet, Flight, Vector3

__all__ = ["MAX_VEHICLES", "flights", "places"]

MAX_VEHICLES = 250
"""System ids end at 255, and ground stations take the highest."""


def places(fleet: Fleet, count: int) -> list[Vector3]:
    """Each vehicle's distance from vehicle 0, metres NWU."""
    spacing = fleet.spacing_m
    if fleet.formation == "line":
        return [(0.0, -spacing * j, 0.0) for j in range(count)]
    if fleet.formation == "grid":
        columns = ceil(sqrt(count))
        return [(-spacing * (j // columns), -spacing * (j % columns), 0.0) for j in range(count)]
    if count == 1:
        return [(0.0, 0.0, 0.0)]
    radius = 0.5 * spacing / sin(pi / count)
    angles = [2.0 * pi * j / count for j in range(count)]
    return [(radius * (cos(angle) - 1.0), -radius * sin(angle), 0.0) for angle in angles]


def flights(flight: Flight, count: int) -> list[Flight]:
    """The scenario for each vehicle of a fleet: it starts in its place. Vehicle 0's is the scenario as it is."""
    start = flight.scenario.start
    x, y, z = start.position_nwu_m
    made = [flight]
    for dx, dy, dz in places(flight.scenario.fleet, count)[1:]:
        moved = msgspec.structs.replace(start, position_nwu_m=(x + dx, y + dy, z + dz))
        scenario = msgspec.structs.replace(flight.scenario, start=moved)
        made.append(msgspec.structs.replace(flight, scenario=scenario))
    return made
