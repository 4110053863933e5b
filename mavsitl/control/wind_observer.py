"""A velocity disturbance observer: W_1..W_3 of eq 11 from what a real vehicle measures."""

from __future__ import annotations

import math

import numpy as np

from mavsitl.compiled import compiled, inlined
from mavsitl.control.arrays import Floats, Record, at, record


@compiled
def observer_step(
    velocity: Floats,
    model: Floats,
    period: float,
    horizontal: float,
    vertical: float,
    last_velocity: Floats,
    started: Floats,
    wind: Floats,
) -> None:
    """`WindObserver.update`: moves `wind` (3, n). The last five are `WindObserver.record`'s."""
    if velocity.shape != wind.shape or model.shape != wind.shape:
        raise ValueError("velocity and model acceleration must have shape (3, n)")
    for axis in range(3):
        bandwidth = vertical if axis == 2 else horizontal
        share = -math.expm1(-bandwidth * period)
        for i in range(wind.shape[1]):
            if started[i] == 0.0:
                last_velocity[axis, i] = velocity[axis, i]
                wind[axis, i] = 0.0
            elif period > 0.0:
                acceleration = (velocity[axis, i] - last_velocity[axis, i]) / period
                wind[axis, i] += share * (acceleration - model[axis, i] - wind[axis, i])
                last_velocity[axis, i] = velocity[axis, i]
    for i in range(wind.shape[1]):
        started[i] = 1.0


@inlined
def model_step(quaternion: Floats, thrust: Floats, mass: float, gravity: float, out: Floats) -> None:
    """See `model_acceleration`."""
    n = out.shape[1]
    if quaternion.shape[0] != 4 or quaternion.shape[1] != n or thrust.shape[0] != n or out.shape[0] != 3:
        raise ValueError("the quaternion must have shape (4, n), the thrust (n,), the output (3, n)")
    for i in range(n):
        w = quaternion[0, i]
        x = quaternion[1, i]
        y = quaternion[2, i]
        z = quaternion[3, i]
        specific = thrust[i] / mass
        out[0, i] = specific * 2.0 * (x * z + w * y)
        out[1, i] = specific * 2.0 * (y * z - w * x)
        out[2, i] = specific * (1.0 - 2.0 * (x * x + y * y)) - gravity


def model_acceleration(
    quaternion: Floats, thrust_n: Floats, mass_kg: float, gravity_m_s2: float, out: Floats
) -> Floats:
    """R e_z U_1 / m - g e_z: eq 11's translation without wind, (3, n) in m/s^2 NWU, written to `out` and returned.

    quaternion (4, n), scalar first, FLU to NWU, unit; thrust (n,). Raises `ValueError` for a wrong shape.
    """
    model_step(quaternion, thrust_n, mass_kg, gravity_m_s2, out)
    return out


class WindObserver:
    """z' = a_model + W, W = L (v - z): W follows the true W_1..W_3 as a first-order lag of bandwidth L per axis.

    Not in the paper, whose eqs 19, 25 and 26 take W as known. Without z that is W' = L (v' - a_model - W), solved
    exactly for accelerations held over the period T:

        W += (1 - exp(-L T)) ((v - v_last) / T - a_model - W)

    The pole is exp(-L T): stable at any bandwidth, and T may differ from call to call.
    """

    def __init__(self, horizontal_rad_s: float, vertical_rad_s: float, n: int = 1) -> None:
        """Raises `ValueError` for a bandwidth that is not > 0."""
        if not min(horizontal_rad_s, vertical_rad_s) > 0.0:
            raise ValueError("horizontal_rad_s and vertical_rad_s must be greater than 0")
        self._horizontal = float(horizontal_rad_s)
        self._vertical = float(vertical_rad_s)
        self._last_velocity = np.zeros((3, n))
        self._started = np.zeros(n)
        self.acceleration_nwu_m_s2 = np.zeros((3, n))
        """W_1..W_3 as last estimated."""

    def update(self, velocity_nwu_m_s: Floats, model_acceleration_nwu_m_s2: Floats, period_s: float) -> Floats:
        """W_1..W_3 in m/s^2 NWU, (3, n), overwritten by the next call.

        `velocity_nwu_m_s` (3, n) is measured now; `model_acceleration_nwu_m_s2` (3, n) is what the model gave over the
        `period_s` that ends now. A period of 0 or less (the same telemetry twice) changes nothing. The first call after
        `reset` only sets z = v. Raises `ValueError` for a wrong shape.
        """
        observer_step(
            velocity_nwu_m_s,
            model_acceleration_nwu_m_s2,
            period_s,
            self._horizontal,
            self._vertical,
            self._last_velocity,
            self._started,
            self.acceleration_nwu_m_s2,
        )
        return self.acceleration_nwu_m_s2

    def record(self) -> Record:
        """What `observer_step` takes beside its inputs, as it stands, by the names of its parameters."""
        return record(
            horizontal=self._horizontal,
            vertical=self._vertical,
            last_velocity=self._last_velocity,
            started=self._started,
            wind=self.acceleration_nwu_m_s2,
        )

    def reset(self, vehicle: int | None = None) -> None:
        """W = 0 and z = v at the next update, for one vehicle or all: wherever other forces act (ground, clamp)."""
        self._started[at(vehicle)] = 0.0
        self.acceleration_nwu_m_s2[:, at(vehicle)] = 0.0
