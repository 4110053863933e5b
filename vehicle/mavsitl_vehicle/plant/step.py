"""One step of the plant: the classical Runge-Kutta method over the body, the exact solution for the rotors' lag.

The wind and the rotor commands are constant over a step. Vehicles do not meet: each column is integrated on its own, by
the same text whatever the fleet's size, so a lane of a fleet is bit for bit the vehicle alone.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from mavsitl.compiled import compiled
from mavsitl_vehicle.plant.body import body_derivative
from mavsitl_vehicle.plant.contact import contact_derivative
from mavsitl_vehicle.plant.inlined import inlined
from mavsitl_vehicle.plant.parameters import CONTACT_REACH, MAX_ROTOR_SPEED, ROTOR_RATE
from mavsitl_vehicle.plant.rotor import decay
from mavsitl_vehicle.plant.state import OMEGA, ROTOR, VELOCITY, Array, Body, Rotors


@inlined
def derivative(body: Body, rotors: Rotors, wind_nwu_m_s: Array, parameters: Array, j: int) -> Body:
    """d/dt of vehicle `j`'s body, on the ground or in the air."""
    d = body_derivative(body, rotors, wind_nwu_m_s, parameters, j)
    if body[2] < parameters[CONTACT_REACH, j]:
        a_x, a_y, a_z, p, q, r = contact_derivative(body, parameters, j)
        return (
            *d[:3],
            d[3] + a_x,
            d[4] + a_y,
            d[5] + a_z,
            *d[6:10],
            d[10] + p,
            d[11] + q,
            d[12] + r,
        )
    return d


@inlined
def along(x: Body, h: float, d: Body) -> Body:
    """x + h d."""
    return (
        x[0] + h * d[0],
        x[1] + h * d[1],
        x[2] + h * d[2],
        x[3] + h * d[3],
        x[4] + h * d[4],
        x[5] + h * d[5],
        x[6] + h * d[6],
        x[7] + h * d[7],
        x[8] + h * d[8],
        x[9] + h * d[9],
        x[10] + h * d[10],
        x[11] + h * d[11],
        x[12] + h * d[12],
    )


@inlined
def lagged(command: Rotors, rotors: Rotors, remaining: float) -> Rotors:
    """Rotor speeds when `remaining` of the distance to the command is left."""
    return (
        command[0] + remaining * (rotors[0] - command[0]),
        command[1] + remaining * (rotors[1] - command[1]),
        command[2] + remaining * (rotors[2] - command[2]),
        command[3] + remaining * (rotors[3] - command[3]),
    )


@inlined
def clipped(speed: float, limit: float) -> float:
    """`speed` within 0 and `limit`."""
    return min(max(speed, 0.0), limit)


@inlined
def body_of(x: Array, j: int) -> Body:
    """Rows 0:13 of vehicle `j`."""
    return (
        x[0, j],
        x[1, j],
        x[2, j],
        x[3, j],
        x[4, j],
        x[5, j],
        x[6, j],
        x[7, j],
        x[8, j],
        x[9, j],
        x[10, j],
        x[11, j],
        x[12, j],
    )


@inlined
def rotors_of(x: Array, j: int) -> Rotors:
    """Rows 13:17 of vehicle `j`."""
    return x[ROTOR, j], x[ROTOR + 1, j], x[ROTOR + 2, j], x[ROTOR + 3, j]


@compiled
def rk4_step(
    x: Array,
    rotor_speed_command_rad_s: Array,
    wind_nwu_m_s: Array,
    parameters: Array,
    dt_s: float,
    held: NDArray[np.bool_],
) -> None:
    """Advance `x` (17, n) in place by `dt_s`.

    Commands (4, n) are clipped to what the rotors can do; ideal rotors take them at once. Wind is (3, n). A vehicle
    that is `held` (n,) keeps its pose, with no velocity and no rates, while its rotors follow.
    """
    half_dt = 0.5 * dt_s
    sixth_dt = dt_s / 6.0
    for j in range(x.shape[1]):
        limit = parameters[MAX_ROTOR_SPEED, j]
        command = (
            clipped(rotor_speed_command_rad_s[0, j], limit),
            clipped(rotor_speed_command_rad_s[1, j], limit),
            clipped(rotor_speed_command_rad_s[2, j], limit),
            clipped(rotor_speed_command_rad_s[3, j], limit),
        )
        half_decay, full_decay = decay(parameters[ROTOR_RATE, j] * dt_s)
        start = rotors_of(x, j) if full_decay > 0.0 else command
        middle = lagged(command, start, half_decay)
        end = lagged(command, start, full_decay)
        x[ROTOR, j], x[ROTOR + 1, j], x[ROTOR + 2, j], x[ROTOR + 3, j] = end
        if held[j]:
            for i in range(3):
                x[VELOCITY + i, j] = 0.0
                x[OMEGA + i, j] = 0.0
            continue

        body = body_of(x, j)
        d1 = derivative(body, start, wind_nwu_m_s, parameters, j)
        d2 = derivative(along(body, half_dt, d1), middle, wind_nwu_m_s, parameters, j)
        d3 = derivative(along(body, half_dt, d2), middle, wind_nwu_m_s, parameters, j)
        d4 = derivative(along(body, dt_s, d3), end, wind_nwu_m_s, parameters, j)
        slope = along(along(d1, 2.0, along(d2, 1.0, d3)), 1.0, d4)
        body = along(body, sixth_dt, slope)

        w, a, b, c = body[6], body[7], body[8], body[9]
        scale = 1.0 / sqrt((w * w + a * a) + (b * b + c * c))
        x[0, j], x[1, j], x[2, j] = body[0], body[1], body[2]
        x[3, j], x[4, j], x[5, j] = body[3], body[4], body[5]
        x[6, j], x[7, j], x[8, j], x[9, j] = w * scale, a * scale, b * scale, c * scale
        x[10, j], x[11, j], x[12, j] = body[10], body[11], body[12]


@compiled
def linear_acceleration(
    x: Array,
    wind_nwu_m_s: Array,
    parameters: Array,
    held: NDArray[np.bool_],
    acceleration_nwu_m_s2: Array,
) -> None:
    """The mass centre's acceleration in the state `x` (17, n) and wind (3, n), m/s^2 NWU, into (3, n); 0 while held.

    An accelerometer measures this plus gravity (g along z up), turned into the body.
    """
    for j in range(x.shape[1]):
        d = derivative(body_of(x, j), rotors_of(x, j), wind_nwu_m_s, parameters, j)
        for i in range(3):
            acceleration_nwu_m_s2[i, j] = 0.0 if held[j] else d[VELOCITY + i]
