"""A made-up flight with known errors, written through the recorders as the vehicle and the ground would."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np

from mavsitl.log import topics
from mavsitl.log.ulog import Recorder

PERIOD_US = 4000
RELEASE_US = 2_000_000


@dataclass(frozen=True)
class Made:
    """What goes in: errors are constant amplitudes of a sine, or 0."""

    spiral: bool = False
    windy: bool = False
    seconds: float = 60.0
    position_error_m: float = 0.01
    attitude_error_deg: float = 0.1
    learning: bool = True


def quaternion_ned(phi_deg: float, theta_deg: float, psi_deg: float) -> tuple[float, float, float, float]:
    """FRD -> NED attitude of NWU angles, written out from the half angles (Z-Y-X)."""
    a, b, c = radians(phi_deg) / 2, -radians(theta_deg) / 2, -radians(psi_deg) / 2
    return (
        cos(a) * cos(b) * cos(c) + sin(a) * sin(b) * sin(c),
        sin(a) * cos(b) * cos(c) - cos(a) * sin(b) * sin(c),
        cos(a) * sin(b) * cos(c) + sin(a) * cos(b) * sin(c),
        cos(a) * cos(b) * sin(c) - sin(a) * sin(b) * cos(c),
    )


def write(made: Made, vehicle: Recorder, ground: Recorder, seed: int = 1) -> None:
    """Two seconds on the clamp, then the flight."""
    rng = np.random.default_rng(seed)
    released = False
    wind = np.zeros(3)
    vehicle.message(0, 6, "on the clamp")
    land = vehicle.topic(topics.LAND_DETECTED)
    land.append(0, 1, 1)
    count = (RELEASE_US + round(made.seconds * 1e6)) // PERIOD_US + 1
    weights = np.array([961.0, 328.0, 92.4] * 2 + [130.0, 148.0, 22.8])
    for step in range(count):
        now = step * PERIOD_US
        t = max(0.0, (now - RELEASE_US) * 1e-6)
        if now >= RELEASE_US and not released:
            released = True
            land.append(now, 0, 0)
        if made.spiral:
            reference = (sin(0.2094 * t), cos(0.2094 * t), 0.0333 * t)
        else:
            reference = (0.0, 0.0, 1.0)
        if made.windy:
            wind += -0.004 * wind / np.array([0.8, 0.4, 0.05]) + rng.standard_normal(3) * np.array([0.2, 0.55, 0.4])
        offset = made.position_error_m * np.array([sin(3 * t), cos(2.3 * t), sin(1.7 * t)])
        x, y, z = np.array(reference) + offset
        phi_d, theta_d = -1.5 * float(wind[1]), 1.5 * float(wind[0])
        error = made.attitude_error_deg * np.array([sin(9 * t), cos(11 * t), 0.3 * sin(5 * t)])
        q = quaternion_ned(phi_d + error[0], theta_d + error[1], error[2])
        vehicle.topic(topics.LOCAL_POSITION_TRUTH).append(now, x, -y, -z, 0.1, -0.2, -0.3)
        vehicle.topic(topics.ATTITUDE_TRUTH).append(now, *q)
        vehicle.topic(topics.WIND_TRUTH).append(now, wind[0], -wind[1], -wind[2])
        speeds = 182.5 + rng.standard_normal(4)
        vehicle.topic(topics.ROTOR_STATUS).append(now, *speeds, int(step % 10 == 0))
        ground.topic(topics.TRAJECTORY_SETPOINT).append(now, reference[0], -reference[1], -reference[2], 0, 0, 0, 0)
        ground.topic(topics.ATTITUDE_SETPOINT).append(
            now, radians(phi_d), -radians(theta_d), 0.0, 0.0, 0.0, -0.5, *quaternion_ned(phi_d, theta_d, 0.0), 0.0
        )
        ground.topic(topics.CONTROL_DEMAND).append(now, 7.09 + 0.1 * rng.standard_normal(), 0.1 * sin(t), 0, 0, 0, 0, 0)
        ground.topic(topics.LINK_STATUS).append(now, step, step // 1000, 0, 4000)
        if made.learning:
            ground.topic(topics.PIDNN_WEIGHTS).append(
                now, *(weights * (1.0 + 0.2 * np.sin(0.1 * t * np.arange(1, 10))))
            )
