"""The geofence: zones from fence items, and what a position breaches. Pure geometry on a local plane.

A position is allowed when it lies in all inclusion zones of at least one group, in no exclusion zone and within the
distances of GF_MAX_HOR_DIST and GF_MAX_VER_DIST. The group is parameter 2 of an inclusion item; clients leave it 0, and
then all inclusion zones hold at once, as on PX4.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, isfinite, isnan
from typing import NamedTuple, Protocol

from mavsitl.dialect import mavlink
from mavsitl.services.mission import MissionItem
from mavsitl.wire_units import from_deg_e7

__all__ = [
    "Breach",
    "Circle",
    "Fence",
    "FenceLimits",
    "FenceProblem",
    "Polygon",
    "Projection",
    "Zone",
    "check_fence_item",
    "read_zones",
]

ACCEPTED: int = mavlink.MAV_MISSION_ACCEPTED
INVALID_PARAM1: int = mavlink.MAV_MISSION_INVALID_PARAM1
INVALID_PARAM2: int = mavlink.MAV_MISSION_INVALID_PARAM2

_POLYGONS = {
    mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION: True,
    mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION: False,
}
_CIRCLES = {
    mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION: True,
    mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION: False,
}
_MIN_VERTICES = 3


class Projection(Protocol):
    """A local plane: x north, y west, m."""

    def to_local(self, latitude_deg: float, longitude_deg: float, /) -> tuple[float, float]: ...

    def to_global(self, north_m: float, west_m: float, /) -> tuple[float, float]: ...


class Polygon(NamedTuple):
    """`vertices_e7`: (latitude, longitude) in degE7, at least three."""

    inclusion: bool
    group: int
    vertices_e7: tuple[tuple[int, int], ...]


class Circle(NamedTuple):
    """`center_e7`: (latitude, longitude) in degE7."""

    inclusion: bool
    group: int
    center_e7: tuple[int, int]
    radius_m: float


Zone = Polygon | Circle


class FenceProblem(NamedTuple):
    """Why the items make no fence: MAV_MISSION_RESULT and the item to blame."""

    result: int
    seq: int


def check_fence_item(item: MissionItem) -> int:
    """MAV_MISSION_RESULT of one fence item by itself: its vertex count or radius, and its group."""
    if item.command in _POLYGONS:
        count = item.param1
        if not (isfinite(count) and count == int(count) and count >= _MIN_VERTICES):
            return INVALID_PARAM1
    elif item.command in _CIRCLES:
        if not (isfinite(item.param1) and item.param1 > 0.0):
            return INVALID_PARAM1
    else:
        return ACCEPTED
    group = item.param2
    return ACCEPTED if isnan(group) or (isfinite(group) and group == int(group)) else INVALID_PARAM2


def _group(item: MissionItem) -> int:
    return 0 if isnan(item.param2) else int(item.param2)


def read_zones(items: Sequence[MissionItem]) -> tuple[Zone, ...] | FenceProblem:
    """The zones of a fence plan, in order. Return points (5000) are kept in the plan and mean nothing here."""
    zones: list[Zone] = []
    seq = 0
    while seq < len(items):
        first = items[seq]
        result = check_fence_item(first)
        if result != ACCEPTED:
            return FenceProblem(result, seq)
        if first.command in _CIRCLES:
            inclusion = _CIRCLES[first.command]
            zones.append(Circle(inclusion, _group(first), (first.x, first.y), first.param1))
        if first.command not in _POLYGONS:
            seq += 1
            continue
        end = seq + int(first.param1)
        for number in range(seq, min(end, len(items))):
            vertex = items[number]
            if (vertex.command, vertex.param1) != (first.command, first.param1):
                return FenceProblem(INVALID_PARAM1, number)
            if check_fence_item(vertex) != ACCEPTED or _group(vertex) != _group(first):
                return FenceProblem(INVALID_PARAM2, number)
        if end > len(items):
            return FenceProblem(INVALID_PARAM1, len(items) - 1)
        vertices = tuple((vertex.x, vertex.y) for vertex in items[seq:end])
        zones.append(Polygon(_POLYGONS[first.command], _group(first), vertices))
        seq = end
    return tuple(zones)


class FenceLimits(NamedTuple):
    """GF_MAX_HOR_DIST and GF_MAX_VER_DIST, m from home; 0: no limit."""

    max_horizontal_m: float = 0.0
    max_vertical_m: float = 0.0


NO_LIMITS = FenceLimits()


class Breach(NamedTuple):
    """`kind` is MAVLink's FENCE_BREACH, `text` the reason with its number."""

    kind: int
    text: str


class _LocalZone(NamedTuple):
    name: str
    inclusion: bool
    group: int
    points: tuple[tuple[float, float], ...]
    """(north m, west m): vertices, or the centre alone"""
    radius_m: float | None

    def depth_m(self, north_m: float, west_m: float) -> float:
        """How far inside the zone's edge a position is, m; negative outside."""
        if self.radius_m is not None:
            ((center_north, center_west),) = self.points
            return self.radius_m - hypot(north_m - center_north, west_m - center_west)
        distance = float("inf")
        inside = False
        north_1, west_1 = self.points[-1]
        for north_2, west_2 in self.points:
            distance = min(distance, _distance_to_edge(north_m, west_m, north_1, west_1, north_2, west_2))
            # Count the edges that a ray to the north crosses; half-open in west, so that a vertex counts once.
            crosses = (west_1 > west_m) != (west_2 > west_m)
            if crosses and north_m < north_1 + (north_2 - north_1) * (west_m - west_1) / (west_2 - west_1):
                inside = not inside
            north_1, west_1 = north_2, west_2
        return distance if inside else -distance


def _distance_to_edge(
    north_m: float, west_m: float, north_1: float, west_1: float, north_2: float, west_2: float
) -> float:
    along_north, along_west = north_2 - north_1, west_2 - west_1
    length_squared = along_north * along_north + along_west * along_west
    share = 0.0
    if length_squared > 0.0:
        share = ((north_m - north_1) * along_north + (west_m - west_1) * along_west) / length_squared
        share = min(max(share, 0.0), 1.0)
    return hypot(north_m - north_1 - share * along_north, west_m - west_1 - share * along_west)


class Fence:
    """The zones on a local plane, ready to be asked about positions. It is made anew when zones or origin change."""

    def __init__(self, zones: Sequence[Zone], projection: Projection) -> None:
        self._projection = projection
        self._zones: list[_LocalZone] = []
        for number, zone in enumerate(zones):
            kind = "inclusion" if zone.inclusion else "exclusion"
            corners: tuple[tuple[int, int], ...]
            radius: float | None
            if isinstance(zone, Circle):
                name, corners, radius = f"{kind} circle {number}", (zone.center_e7,), zone.radius_m
            else:
                name, corners, radius = f"{kind} polygon {number}", zone.vertices_e7, None
            points = tuple(projection.to_local(from_deg_e7(x), from_deg_e7(y)) for x, y in corners)
            self._zones.append(_LocalZone(name, zone.inclusion, zone.group, points, radius))

    def __bool__(self) -> bool:
        """Whether there are zones at all."""
        return bool(self._zones)

    def breach(
        self,
        north_m: float,
        west_m: float,
        height_m: float,
        home_north_m: float = 0.0,
        home_west_m: float = 0.0,
        limits: FenceLimits = NO_LIMITS,
    ) -> Breach | None:
        """Why a position is not allowed, None when it is.

        Args:
            north_m, west_m: position on the plane of the projection.
            height_m: above home.
            home_north_m, home_west_m: home on the same plane.
            limits: distances from home.

        A position that is not finite is not known, and breaches nothing.
        """
        if not (isfinite(north_m) and isfinite(west_m) and isfinite(height_m)):
            return None
        if limits.max_vertical_m > 0.0 and height_m >= limits.max_vertical_m:
            return Breach(
                mavlink.FENCE_BREACH_MAXALT, f"{height_m:.1f} m above home, limit {limits.max_vertical_m:.1f} m"
            )
        from_home_m = hypot(north_m - home_north_m, west_m - home_west_m)
        if limits.max_horizontal_m > 0.0 and from_home_m >= limits.max_horizontal_m:
            return Breach(
                mavlink.FENCE_BREACH_BOUNDARY,
                f"{from_home_m:.1f} m from home, limit {limits.max_horizontal_m:.1f} m",
            )
        groups: dict[int, tuple[float, str]] = {}
        for zone in self._zones:
            depth_m = zone.depth_m(north_m, west_m)
            if zone.inclusion:
                worst = groups.get(zone.group)
                if worst is None or depth_m < worst[0]:
                    groups[zone.group] = (depth_m, zone.name)
            elif depth_m > 0.0:
                return Breach(mavlink.FENCE_BREACH_BOUNDARY, f"{depth_m:.1f} m inside {zone.name}")
        if groups:
            depth_m, name = max(groups.values())
            if depth_m < 0.0:
                return Breach(mavlink.FENCE_BREACH_BOUNDARY, f"{-depth_m:.1f} m outside {name}")
        return None

    def breach_at(
        self,
        latitude_deg: float,
        longitude_deg: float,
        height_m: float,
        home_deg: tuple[float, float],
        limits: FenceLimits = NO_LIMITS,
    ) -> Breach | None:
        """`breach` of a global position; `home_deg` is home's latitude and longitude, `height_m` above home."""
        north_m, west_m = self._projection.to_local(latitude_deg, longitude_deg)
        home_north_m, home_west_m = self._projection.to_local(*home_deg)
        return self.breach(north_m, west_m, height_m, home_north_m, home_west_m, limits)
