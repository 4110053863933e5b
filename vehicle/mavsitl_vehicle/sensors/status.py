"""How well the vehicle knows its state: what every estimator says of itself, and what sensors showed last."""

from __future__ import annotations

from math import pi
from typing import NamedTuple

from mavsitl.frames import Vector
from mavsitl.scenario import Noise


class SensorHealth(NamedTuple):
    """Which sensors have given something lately."""

    gyro: bool = True
    accelerometer: bool = True
    magnetometer: bool = True
    barometer: bool = True
    gps: bool = True
    """With a fix of enough satellites."""


class EstimatorStatus(NamedTuple):
    """Validity, accuracies (1 sigma) and innovation test ratios (at 1 a measurement is at its gate)."""

    attitude_valid: bool
    height_valid: bool
    velocity_valid: bool
    position_valid: bool
    """Horizontal; of the velocity, too, not longer than EKF2_NOAID_TOUT without GPS."""
    dead_reckoning: bool
    """Position and velocity come from the IMU alone."""
    eph_m: float
    """Horizontal position, each axis."""
    epv_m: float
    evh_m_s: float
    """Horizontal velocity, each axis."""
    evv_m_s: float
    tilt_rad: float
    heading_rad: float
    rate_rad_s: float
    velocity_ratio: float = 0.0
    position_ratio: float = 0.0
    height_ratio: float = 0.0
    mag_ratio: float = 0.0
    sensors: SensorHealth = SensorHealth()
    resets: int = 0
    """So often position, velocity or an offset was begun anew."""


def known(noise: Noise) -> EstimatorStatus:
    """Of the truth with white noise: always valid, and as accurate as the noise."""
    attitude_rad, rate_rad_s = noise.attitude_deg * pi / 180.0, noise.rate_deg_s * pi / 180.0
    return EstimatorStatus(
        True, True, True, True, False,
        noise.position_m, noise.position_m, noise.velocity_m_s, noise.velocity_m_s, attitude_rad, attitude_rad,
        rate_rad_s,
    )  # fmt: skip


class GpsReading(NamedTuple):
    """The newest fix, as the receiver tells it."""

    position_nwu_m: Vector
    velocity_nwu_m_s: Vector
    satellites: int
    eph_m: float
    epv_m: float
    evs_m_s: float
    age_us: int


class Readings(NamedTuple):
    """What one vehicle's sensors showed last, body FLU; None: never."""

    gyro_flu_rad_s: Vector
    accel_flu_m_s2: Vector
    mag_flu_gauss: Vector | None
    baro_height_m: float | None
    """Above the local origin."""
    gps: GpsReading | None
    """None, too, without a fix."""
