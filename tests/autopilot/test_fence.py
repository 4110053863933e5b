"""The geofence: zones from items, and which positions they allow."""

from __future__ import annotations

from math import cos, hypot, inf, nan, pi, sin
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot.fence import (
    Circle,
    Fence,
    FenceLimits,
    FenceProblem,
    Polygon,
    check_fence_item,
    read_zones,
)

from mavsitl.dialect import mavlink
from mavsitl.geodesy import Origin
from mavsitl.services.mission import MissionItem

ORIGIN = Origin(47.3977418, 8.5455939, 488.0)
HOME = (ORIGIN.latitude_deg, ORIGIN.longitude_deg)
INCLUSION, EXCLUSION, CIRCLE_IN, CIRCLE_OUT, RETURN = 5001, 5002, 5003, 5004, 5000
BOUNDARY, MAX_ALTITUDE = mavlink.FENCE_BREACH_BOUNDARY, mavlink.FENCE_BREACH_MAXALT
PARAM1, PARAM2 = mavlink.MAV_MISSION_INVALID_PARAM1, mavlink.MAV_MISSION_INVALID_PARAM2


def point(command: int, north_m: float, west_m: float, param1: float, group: float = 0.0) -> MissionItem:
    latitude_deg, longitude_deg = ORIGIN.to_global(north_m, west_m)
    return MissionItem(command, 5, param1, group, 0.0, 0.0, round(latitude_deg * 1e7), round(longitude_deg * 1e7), 0.0)


def polygon(command: int, *corners: tuple[float, float], group: float = 0.0) -> list[MissionItem]:
    return [point(command, north, west, len(corners), group) for north, west in corners]


def square(command: int, half_m: float, north_m: float = 0.0, west_m: float = 0.0, group: float = 0.0) -> Any:
    corners = ((-half_m, -half_m), (-half_m, half_m), (half_m, half_m), (half_m, -half_m))
    return polygon(command, *((north_m + north, west_m + west) for north, west in corners), group=group)


def fence(*items: MissionItem) -> Fence:
    zones = read_zones(items)
    assert not isinstance(zones, FenceProblem)
    return Fence(zones, ORIGIN)


def allowed(asked: Fence, north_m: float, west_m: float, **more: Any) -> bool:
    return asked.breach(north_m, west_m, 10.0, **more) is None


def test_no_zones_allow_everything() -> None:
    empty = fence()
    assert not empty
    assert allowed(empty, 1e6, -1e6)
    assert not fence(point(RETURN, 0, 0, 0.0))


@pytest.mark.parametrize("command", [INCLUSION, EXCLUSION])
@pytest.mark.parametrize(
    ("north_m", "west_m", "inside"),
    [
        (0, 0, True),
        (49, 49, True),
        (-49, 49, True),
        (51, 0, False),
        (0, -51, False),
        (500, 49, False),
        (-49, -500, False),
    ],
)
def test_square(command: int, north_m: float, west_m: float, inside: bool) -> None:
    asked = fence(*square(command, 50.0))
    assert allowed(asked, north_m, west_m) is (inside is (command == INCLUSION))


def test_concave_polygon() -> None:
    asked = fence(*polygon(INCLUSION, (0, 0), (100, 0), (100, 100), (50, 20), (0, 100)))
    assert allowed(asked, 50, 10)
    assert allowed(asked, 90, 60)
    assert allowed(asked, 10, 60)
    assert not allowed(asked, 50, 60)  # in the notch
    assert not allowed(asked, 50, -1)


@pytest.mark.parametrize(("command", "inside"), [(CIRCLE_IN, True), (CIRCLE_OUT, False)])
def test_circle(command: int, inside: bool) -> None:
    asked = fence(point(command, 100, 50, 20.0))
    assert allowed(asked, 119.5, 50) is inside
    assert allowed(asked, 120.5, 50) is not inside
    assert allowed(asked, 115, 65) is not inside


def test_all_inclusion_zones_of_a_group_hold_at_once() -> None:
    asked = fence(*square(INCLUSION, 50.0), point(CIRCLE_IN, 40, 0, 30.0))
    assert allowed(asked, 30, 0)
    assert not allowed(asked, 0, 0)
    assert not allowed(asked, 60, 0)


def test_one_group_is_enough() -> None:
    asked = fence(*square(INCLUSION, 50.0, group=1.0), *square(INCLUSION, 50.0, north_m=200.0, group=2.0))
    assert allowed(asked, 0, 0)
    assert allowed(asked, 200, 0)
    breach = asked.breach(100, 0, 10)
    assert breach is not None
    assert breach.kind == BOUNDARY


def test_exclusion_inside_inclusion() -> None:
    asked = fence(*square(INCLUSION, 100.0), *square(EXCLUSION, 10.0), point(CIRCLE_OUT, 50, 50, 5.0))
    assert allowed(asked, 20, 0)
    assert not allowed(asked, 5, 5)
    assert not allowed(asked, 52, 52)
    assert not allowed(asked, 101, 0)


def test_texts_carry_the_numbers() -> None:
    asked = fence(*square(INCLUSION, 50.0), point(CIRCLE_OUT, 0, 0, 5.0))
    assert [asked.breach(north, 0, 10) for north in (57.25, 2.0)] == [
        (BOUNDARY, "7.2 m outside inclusion polygon 0"),
        (BOUNDARY, "3.0 m inside exclusion circle 1"),
    ]


def test_distance_limits() -> None:
    limits = FenceLimits(100.0, 30.0)
    empty = fence()
    home = {"home_north_m": 10.0, "home_west_m": 20.0}
    assert allowed(empty, 109.9, 20, limits=limits, **home)
    assert empty.breach(110.1, 20, 10, limits=limits, **home) == (BOUNDARY, "100.1 m from home, limit 100.0 m")
    assert empty.breach(0, 0, 30.0, limits=limits) == (MAX_ALTITUDE, "30.0 m above home, limit 30.0 m")
    assert empty.breach(0, 0, 29.9, limits=limits) is None
    assert empty.breach(1e5, 0, 1e5, limits=FenceLimits()) is None


def test_global_positions() -> None:
    asked = fence(point(CIRCLE_IN, 0, 0, 50.0))
    for north_m, inside in ((49.0, True), (51.0, False)):
        assert (asked.breach_at(*ORIGIN.to_global(north_m, 0), 10.0, HOME) is None) is inside
    far = ORIGIN.to_global(30.0, 40.0)
    assert asked.breach_at(*HOME, 10.0, far, FenceLimits(49.0)) == (BOUNDARY, "50.0 m from home, limit 49.0 m")


@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_an_unknown_position_breaches_nothing(value: float) -> None:
    asked = fence(*square(INCLUSION, 50.0))
    for position in ((value, 0.0, 0.0), (0.0, value, 0.0), (0.0, 0.0, value)):
        assert asked.breach(*position, limits=FenceLimits(1.0, 1.0)) is None


@given(
    st.integers(3, 12),
    st.floats(5.0, 500.0),
    st.floats(0.0, 2 * pi),
    st.floats(0.0, 2.0),
    st.floats(0.0, 2 * pi),
)
def test_a_regular_polygon_lies_between_its_circles(
    corners: int, radius_m: float, turn: float, share: float, bearing: float
) -> None:
    angles = [turn + 2 * pi * number / corners for number in range(corners)]
    asked = fence(*polygon(INCLUSION, *((radius_m * cos(angle), radius_m * sin(angle)) for angle in angles)))
    north_m, west_m = share * radius_m * cos(bearing), share * radius_m * sin(bearing)
    distance_m = hypot(north_m, west_m)
    # degE7 rounds a corner by up to 1 cm.
    if distance_m < radius_m * cos(pi / corners) - 0.02:
        assert allowed(asked, north_m, west_m)
    elif distance_m > radius_m + 0.02:
        assert not allowed(asked, north_m, west_m)


# --- items to zones


def test_zones_in_order() -> None:
    items = [
        *square(INCLUSION, 50.0, group=3.0),
        point(RETURN, 0, 0, 0.0),
        point(CIRCLE_OUT, 10, 0, 5.0),
        *polygon(EXCLUSION, (0, 0), (0, 1), (1, 0)),
    ]
    zones = read_zones(items)
    assert not isinstance(zones, FenceProblem)
    assert [(type(zone), zone.inclusion, zone.group) for zone in zones] == [
        (Polygon, True, 3),
        (Circle, False, 0),
        (Polygon, False, 0),
    ]
    assert isinstance(zones[2], Polygon)
    assert zones[2].vertices_e7 == tuple((item.x, item.y) for item in items[6:])


def test_polygons_of_one_kind_side_by_side() -> None:
    zones = read_zones([*square(INCLUSION, 50.0), *polygon(INCLUSION, (0, 0), (0, 1), (1, 0), (2, 0), (3, 0))])
    assert not isinstance(zones, FenceProblem)
    assert [len(zone.vertices_e7) for zone in zones if isinstance(zone, Polygon)] == [4, 5]


@pytest.mark.parametrize("value", [0.0, 2.0, 3.5, -3.0, nan, inf])
def test_bad_vertex_counts(value: float) -> None:
    assert check_fence_item(point(INCLUSION, 0, 0, value)) == PARAM1


@pytest.mark.parametrize("value", [0.0, -1.0, nan, inf])
def test_bad_radius(value: float) -> None:
    assert check_fence_item(point(CIRCLE_IN, 0, 0, value)) == PARAM1


@pytest.mark.parametrize("value", [0.5, inf, -inf])
def test_bad_group(value: float) -> None:
    assert check_fence_item(point(INCLUSION, 0, 0, 3.0, value)) == PARAM2


@pytest.mark.parametrize(
    ("items", "problem"),
    [
        (square(INCLUSION, 50.0)[:3], (PARAM1, 2)),
        ([*square(INCLUSION, 50.0)[:3], point(EXCLUSION, 0, 0, 4.0)], (PARAM1, 3)),
        ([*square(INCLUSION, 50.0)[:3], point(CIRCLE_IN, 0, 0, 4.0)], (PARAM1, 3)),
        ([*square(INCLUSION, 50.0)[:2], point(INCLUSION, 0, 0, 5.0)], (PARAM1, 2)),
        ([*square(INCLUSION, 50.0)[:3], point(INCLUSION, 0, 0, 4.0, group=1.0)], (PARAM2, 3)),
        ([point(CIRCLE_IN, 0, 0, 5.0), point(INCLUSION, 0, 0, 2.0)], (PARAM1, 1)),
        ([point(INCLUSION, 0, 0, 1e30)], (PARAM1, 0)),
    ],
)
def test_items_that_make_no_fence(items: list[MissionItem], problem: tuple[int, int]) -> None:
    assert read_zones(items) == problem


@given(
    st.lists(
        st.builds(
            MissionItem,
            command=st.integers(4999, 5005),
            frame=st.sampled_from([5, 6]),
            param1=st.one_of(st.sampled_from([1.0, 3.0, 4.0]), st.floats(width=32)),
            param2=st.one_of(st.sampled_from([0.0, 1.0]), st.floats(width=32)),
            param3=st.just(0.0),
            param4=st.just(0.0),
            x=st.integers(-900_000_000, 900_000_000),
            y=st.integers(-1_800_000_000, 1_800_000_000),
            z=st.floats(width=32),
        ),
        max_size=20,
    )
)
def test_any_items_make_a_fence_or_a_problem(items: list[MissionItem]) -> None:
    zones = read_zones(items)
    if isinstance(zones, FenceProblem):
        assert zones.result in (PARAM1, PARAM2)
        assert 0 <= zones.seq < len(items)
    else:
        Fence(zones, ORIGIN).breach(0.0, 0.0, 0.0)
