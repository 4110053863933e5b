"""The wire's integer scalings: degE7, mm, cm/s, cdeg and the like. Every value is rounded and clipped to its field.

What is not a number becomes 0, or the value that the message keeps for "unknown" where the caller names it. Angles and
vectors come in wire signs (NED, FRD); `mavsitl.frames` makes those.
"""

from __future__ import annotations

from math import pi

INT16_MAX = 0x7FFF
INT32_MAX = 0x7FFF_FFFF
UINT8_MAX = 0xFF
UINT16_MAX = 0xFFFF
UINT32_MAX = 0xFFFF_FFFF

_CDEG_PER_RAD = 18000.0 / pi
_DEG_PER_RAD = 180.0 / pi


def whole(value: float, low: int, high: int, unknown: int = 0) -> int:
    """`value` rounded, within `low` and `high`; `unknown` for NaN."""
    if low <= value <= high:
        return round(value)
    if value != value:
        return unknown
    return low if value < low else high


def deg_e7(angle_deg: float) -> int:
    """Latitude or longitude, int32."""
    return whole(angle_deg * 1e7, -INT32_MAX - 1, INT32_MAX)


def from_deg_e7(angle: float) -> float:
    """Degrees of a latitude or longitude."""
    return angle / 1e7


def millimetres(length_m: float) -> int:
    """Altitude, int32 mm."""
    return whole(length_m * 1e3, -INT32_MAX - 1, INT32_MAX)


def millimetres_unsigned(length_m: float) -> int:
    """An accuracy, uint32 mm (or mm/s)."""
    return whole(length_m * 1e3, 0, UINT32_MAX)


def centimetres_per_s(speed_m_s: float) -> int:
    """Velocity component, int16 cm/s."""
    return whole(speed_m_s * 100.0, -INT16_MAX - 1, INT16_MAX)


def centimetres_per_s_unsigned(speed_m_s: float, unknown: int = UINT16_MAX) -> int:
    """Speed, uint16 cm/s; its last value is MAVLink's "unknown" and is not used for a speed."""
    return whole(speed_m_s * 100.0, 0, UINT16_MAX - 1, unknown)


def heading_cdeg(angle_rad: float) -> int:
    """Heading, clockwise from north, 0 to 35999; 65535 is MAVLink's "unknown"."""
    value = angle_rad * _CDEG_PER_RAD % 36000.0
    return round(value) % 36000 if value == value else UINT16_MAX


def heading_deg(angle_rad: float) -> int:
    """Heading in whole degrees, 0 to 359; 0 where there is none, as VFR_HUD has no "unknown"."""
    value = angle_rad * _DEG_PER_RAD % 360.0
    return round(value) % 360 if value == value else 0


def milli_g(acceleration_m_s2: float) -> int:
    """Acceleration, int16 in thousandths of 9.80665 m/s^2."""
    return whole(acceleration_m_s2 / 9.80665e-3, -INT16_MAX - 1, INT16_MAX)


def centi_celsius(temperature_c: float) -> int:
    """Temperature, int16 cdegC."""
    return whole(temperature_c * 100.0, -INT16_MAX - 1, INT16_MAX)


def millivolts(voltage_v: float) -> int:
    """Voltage, uint16 mV; 65535 is MAVLink's "not sent"."""
    return whole(voltage_v * 1e3, 0, UINT16_MAX - 1, UINT16_MAX)


def centiamperes(current_a: float) -> int:
    """Current, int16 cA; -1 is MAVLink's "not measured"."""
    return whole(current_a * 100.0, 0, INT16_MAX, -1)


def boot_ms(now_us: int) -> int:
    """time_boot_ms, uint32: it begins again after 49.7 days."""
    return now_us // 1000 & UINT32_MAX
