"""Latitude and longitude against the local plane: PX4's azimuthal equidistant projection about one point.

The Earth is PX4's sphere (``CONSTANTS_RADIUS_OF_EARTH``), so that a position sent by a client of PX4 lands on the same
spot here. Distance and bearing from the origin are exact in this projection; local axes are north and west (NWU).
"""

from __future__ import annotations

from math import asin, atan2, cos, degrees, hypot, isfinite, nan, pi, radians, remainder, sin, sqrt

from mavsitl.frames import Vector

EARTH_RADIUS_M = 6_371_000.0

DIPOLE_GAUSS = 0.3
"""Magnetic field of the Earth's dipole at the equator."""


class Origin:
    """The point of the Earth at the local origin.

    Attributes:
        latitude_deg, longitude_deg: WGS84 as far as a sphere can be.
        altitude_amsl_m: of the local plane z = 0.
        magnetic_field_nwu_gauss: of an axial dipole, which points north everywhere: a compass needs no declination.
    """

    __slots__ = ("_cos", "_lon", "_sin", "altitude_amsl_m", "latitude_deg", "longitude_deg", "magnetic_field_nwu_gauss")

    def __init__(self, latitude_deg: float, longitude_deg: float, altitude_amsl_m: float) -> None:
        """Raises `ValueError` for a latitude beyond the poles and for anything not finite."""
        if not (-90.0 <= latitude_deg <= 90.0 and isfinite(longitude_deg) and isfinite(altitude_amsl_m)):
            raise ValueError(f"no point of the Earth: {latitude_deg}, {longitude_deg}, {altitude_amsl_m} m")
        self.latitude_deg = latitude_deg
        self.longitude_deg = longitude_deg
        self.altitude_amsl_m = altitude_amsl_m
        self._sin, self._cos = sin(radians(latitude_deg)), cos(radians(latitude_deg))
        self._lon = radians(longitude_deg)
        self.magnetic_field_nwu_gauss: Vector = (DIPOLE_GAUSS * self._cos, 0.0, -2.0 * DIPOLE_GAUSS * self._sin)

    def to_local(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        """``(north_m, west_m)`` of a point; NaN where the point is not finite. The antipode is put due north."""
        if not (isfinite(lat_deg) and isfinite(lon_deg)):
            return nan, nan
        lat, d_lon = radians(lat_deg), radians(lon_deg) - self._lon
        sin_lat, cos_lat, cos_d_lon = sin(lat), cos(lat), cos(d_lon)
        north = self._cos * sin_lat - self._sin * cos_lat * cos_d_lon
        east = cos_lat * sin(d_lon)
        toward = self._sin * sin_lat + self._cos * cos_lat * cos_d_lon
        # The sine and the cosine of the distance's angle: no arc cosine near 1, where it is coarse.
        sine = hypot(north, east)
        if sine == 0.0:
            return (0.0 if toward > 0.0 else pi * EARTH_RADIUS_M), 0.0
        scale = atan2(sine, toward) / sine * EARTH_RADIUS_M
        return scale * north, -scale * east

    def to_global(self, north_m: float, west_m: float) -> tuple[float, float]:
        """``(lat_deg, lon_deg)`` of a local position, longitude in [-180, 180]; NaN where it is not finite."""
        x, y = north_m / EARTH_RADIUS_M, -west_m / EARTH_RADIUS_M
        c = sqrt(x * x + y * y)
        if not isfinite(c):
            return nan, nan
        if c == 0.0:
            return self.latitude_deg, degrees(remainder(self._lon, 2.0 * pi))
        sin_c, cos_c = sin(c), cos(c)
        sine = cos_c * self._sin + x * sin_c * self._cos / c
        lat = asin(min(max(sine, -1.0), 1.0))
        lon = self._lon + atan2(y * sin_c, c * self._cos * cos_c - x * self._sin * sin_c)
        return degrees(lat), degrees(remainder(lon, 2.0 * pi))
