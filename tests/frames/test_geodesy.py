"""Latitude and longitude: PX4's projection, by hand and there and back; the wire's scalings at their limits."""

from __future__ import annotations

from math import acos, cos, hypot, inf, isnan, nan, pi, radians, sin

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl import wire_units
from mavsitl.geodesy import EARTH_RADIUS_M, Origin
from mavsitl.scenario import Start

HOME = Origin(47.397742, 8.545594, 488.0)
METRES_PER_DEGREE = pi * EARTH_RADIUS_M / 180.0


def test_the_default_origin_is_px4_sitls_home() -> None:
    start = Start()
    assert (start.latitude_deg, start.longitude_deg, start.altitude_amsl_m) == (47.397742, 8.545594, 488.0)


def test_steps_along_the_axes() -> None:
    """One degree of a great circle is pi R / 180; west is left, so a step east is negative."""
    assert HOME.to_local(48.397742, 8.545594) == pytest.approx((METRES_PER_DEGREE, 0.0), abs=1e-6)
    equator = Origin(0.0, 179.5, 0.0)
    assert equator.to_local(0.0, -179.5) == pytest.approx((0.0, -METRES_PER_DEGREE), abs=1e-6)
    assert equator.to_global(0.0, -METRES_PER_DEGREE) == pytest.approx((0.0, -179.5), abs=1e-12)
    north, west = HOME.to_local(47.397742, 8.546594)
    assert west == pytest.approx(-0.001 * METRES_PER_DEGREE * cos(radians(47.397742)), rel=1e-9)
    assert 0.0 < north < 1e-3  # a parallel bends away to the north of the great circle


def test_a_point_by_px4() -> None:
    """PX4's own formulas, written out: k = c / sin c with c from the arc cosine."""
    lat, lon = radians(47.5), radians(8.7)
    lat_0, lon_0 = radians(47.397742), radians(8.545594)
    c = acos(sin(lat_0) * sin(lat) + cos(lat_0) * cos(lat) * cos(lon - lon_0))
    k = c / sin(c)
    north = k * (cos(lat_0) * sin(lat) - sin(lat_0) * cos(lat) * cos(lon - lon_0)) * 6371000.0
    east = k * cos(lat) * sin(lon - lon_0) * 6371000.0
    assert HOME.to_local(47.5, 8.7) == pytest.approx((north, -east), abs=1e-6)


@given(
    st.floats(-89.9, 89.9),
    st.floats(-180.0, 180.0),
    st.floats(-50_000.0, 50_000.0),
    st.floats(-50_000.0, 50_000.0),
)
def test_there_and_back(lat: float, lon: float, north: float, west: float) -> None:
    origin = Origin(lat, lon, 0.0)
    there = origin.to_global(north, west)
    assert -90.0 <= there[0] <= 90.0
    assert -180.0 <= there[1] <= 180.0
    assert origin.to_local(*there) == pytest.approx((north, west), abs=2e-4 if abs(there[0]) > 89.9 else 1e-6)


@given(st.floats(-90.0, 90.0), st.floats(-180.0, 180.0), st.floats(-90.0, 90.0), st.floats(-180.0, 180.0))
def test_every_point_of_the_earth_is_somewhere(lat: float, lon: float, lat_0: float, lon_0: float) -> None:
    north, west = Origin(lat_0, lon_0, 0.0).to_local(lat, lon)
    assert hypot(north, west) <= pi * EARTH_RADIUS_M * (1.0 + 1e-12)


@pytest.mark.parametrize("wild", [nan, inf, -inf])
def test_what_is_not_finite_is_nowhere(wild: float) -> None:
    for pair in (HOME.to_local(wild, 8.0), HOME.to_local(47.0, wild), HOME.to_global(wild, 0.0)):
        assert all(map(isnan, pair))
    with pytest.raises(ValueError, match="no point of the Earth"):
        Origin(wild, 0.0, 0.0)
    assert all(map(isnan, HOME.to_global(1e308, 1e308)))


def test_the_poles_and_the_antipode() -> None:
    assert Origin(0.0, 0.0, 0.0).to_local(0.0, 180.0)[0] == pytest.approx(0.0, abs=1e-3)
    assert HOME.to_local(47.397742, 8.545594) == (0.0, 0.0)
    assert Origin(90.0, 0.0, 0.0).to_local(89.0, 90.0) == pytest.approx((0.0, -METRES_PER_DEGREE), abs=1e-3)
    with pytest.raises(ValueError, match=r"90\.1"):
        Origin(90.1, 0.0, 0.0)


def test_the_magnetic_field_points_north_and_into_the_ground() -> None:
    assert Origin(0.0, 0.0, 0.0).magnetic_field_nwu_gauss == pytest.approx((0.3, 0.0, 0.0))
    x, y, z = HOME.magnetic_field_nwu_gauss
    assert (x, y, z) == pytest.approx((0.2031, 0.0, -0.4416), abs=1e-4)


@pytest.mark.parametrize(
    ("scale", "value", "wire"),
    [
        (wire_units.deg_e7, 47.397742, 473977420),
        (wire_units.deg_e7, -8.5455941, -85455941),
        (wire_units.millimetres, 488.0004, 488000),
        (wire_units.millimetres, -1e12, -(2**31)),
        (wire_units.millimetres, nan, 0),
        (wire_units.centimetres_per_s, -1.234, -123),
        (wire_units.centimetres_per_s, 1e9, 32767),
        (wire_units.centimetres_per_s_unsigned, 1e9, 65534),
        (wire_units.centimetres_per_s_unsigned, nan, 65535),
        (wire_units.heading_cdeg, -pi / 2.0, 27000),
        (wire_units.heading_cdeg, -1e-9, 0),
        (wire_units.heading_cdeg, nan, 65535),
        (wire_units.heading_cdeg, inf, 65535),
        (wire_units.heading_deg, 2.0 * pi - 1e-6, 0),
        (wire_units.heading_deg, -0.1, 354),
        (wire_units.milli_g, -9.80665, -1000),
        (wire_units.centi_celsius, 15.004, 1500),
        (wire_units.millivolts, 12.6, 12600),
        (wire_units.millivolts, 100.0, 65534),
        (wire_units.centiamperes, 3.456, 346),
        (wire_units.centiamperes, nan, -1),
        (wire_units.boot_ms, (2**32 + 5) * 1000, 5),
    ],
)
def test_wire_scalings(scale: object, value: float, wire: int) -> None:
    assert callable(scale)
    assert scale(value) == wire


@given(st.integers(-900_000_000, 900_000_000))
def test_deg_e7_is_exact(angle: int) -> None:
    assert wire_units.deg_e7(wire_units.from_deg_e7(angle)) == angle
