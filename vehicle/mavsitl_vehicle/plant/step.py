"""One step of the plant: the classical Runge-Kutta method over the body, the exact solution for the rotors' lag.

The wind and the rotor commands are constant over a step. Vehicles do not meet: each column is integrated on its own, by
the same text whatever the fleet's size, so a lane of a fleet is bit for bit the vehicle alone.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from mavsitl.compiled import compiled, fused
from mavsitl_vehicle.plant import lanes
from mavsitl_vehicle.plant.body import body_derivative
from mavsitl_vehicle.plant.contact import contact_derivative
from mavsitl_vehicle.plant.lanes import LANES
from mavsitl_vehicle.plant.parameters import (
    CONTACT_REACH,
    MAX_ROTOR_SPEED,
    N_PARAMETERS,
    ROTOR_RATE,
    Column,
    parameters_of,
)
from mavsitl_vehicle.plant.rotor import decay
from mavsitl_vehicle.plant.state import N_STATES, ROTOR, VELOCITY, Array, Body, Rotors, Wind


@fused
def derivative(body: Body, rotors: Rotors, wind: Wind, parameters: Column, on_ground: bool) -> Body:
    """d/dt of a body; its legs touch the ground only if that is `on_ground` as well."""
    d = body_derivative(body, rotors, wind, parameters)
    if on_ground and body[2] < parameters[CONTACT_REACH]:
        a_x, a_y, a_z, p, q, r = contact_derivative(body, parameters)
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


@fused
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


@fused
def lagged(command: Rotors, rotors: Rotors, remaining: float) -> Rotors:
    """Rotor speeds when `remaining` of the distance to the command is left."""
    return (
        command[0] + remaining * (rotors[0] - command[0]),
        command[1] + remaining * (rotors[1] - command[1]),
        command[2] + remaining * (rotors[2] - command[2]),
        command[3] + remaining * (rotors[3] - command[3]),
    )


@fused
def clipped(speed: float, limit: float) -> float:
    """`speed` within 0 and `limit`."""
    return min(max(speed, 0.0), limit)


@fused
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


@fused
def four_of(rows: Array, first: int, j: int) -> Rotors:
    """Four rows from `first` on of vehicle `j`."""
    return rows[first, j], rows[first + 1, j], rows[first + 2, j], rows[first + 3, j]


@fused
def wind_of(wind_nwu_m_s: Array, j: int) -> Wind:
    """At vehicle `j`."""
    return wind_nwu_m_s[0, j], wind_nwu_m_s[1, j], wind_nwu_m_s[2, j]


@fused
def put(x: Array, j: int, body: Body, rotors: Rotors) -> None:
    """Into rows 0:17 of vehicle `j`."""
    x[0, j], x[1, j], x[2, j] = body[0], body[1], body[2]
    x[3, j], x[4, j], x[5, j] = body[3], body[4], body[5]
    x[6, j], x[7, j], x[8, j], x[9, j] = body[6], body[7], body[8], body[9]
    x[10, j], x[11, j], x[12, j] = body[10], body[11], body[12]
    x[ROTOR, j], x[ROTOR + 1, j], x[ROTOR + 2, j], x[ROTOR + 3, j] = rotors


@fused
def stepped(
    body: Body,
    rotors: Rotors,
    command: Rotors,
    wind: Wind,
    parameters: Column,
    dt_s: float,
    held: bool,
    on_ground: bool,
) -> tuple[Body, Rotors, bool]:
    """Body and rotors after a step, and whether the vehicle came within the ground's reach.

    Where it did, the result is right only if that is `on_ground`; where it did not, it is the same bits either way.
    """
    limit = parameters[MAX_ROTOR_SPEED]
    target = (
        clipped(command[0], limit),
        clipped(command[1], limit),
        clipped(command[2], limit),
        clipped(command[3], limit),
    )
    half_decay, full_decay = decay(parameters[ROTOR_RATE] * dt_s)
    start = rotors if full_decay > 0.0 else target
    middle = lagged(target, start, half_decay)
    end = lagged(target, start, full_decay)
    still = (*body[:3], 0.0, 0.0, 0.0, *body[6:10], 0.0, 0.0, 0.0)

    d1 = derivative(body, start, wind, parameters, on_ground)
    second = along(body, 0.5 * dt_s, d1)
    d2 = derivative(second, middle, wind, parameters, on_ground)
    third = along(body, 0.5 * dt_s, d2)
    d3 = derivative(third, middle, wind, parameters, on_ground)
    fourth = along(body, dt_s, d3)
    d4 = derivative(fourth, end, wind, parameters, on_ground)
    reach = parameters[CONTACT_REACH]
    touches = body[2] < reach or second[2] < reach or third[2] < reach or fourth[2] < reach
    slope = along(along(d1, 2.0, along(d2, 1.0, d3)), 1.0, d4)
    body = along(body, dt_s / 6.0, slope)

    w, a, b, c = body[6], body[7], body[8], body[9]
    scale = 1.0 / sqrt((w * w + a * a) + (b * b + c * c))
    flown = (*body[:6], w * scale, a * scale, b * scale, c * scale, *body[10:])
    return still if held else flown, end, touches


@fused
def stepped_lane(block: Array, dt_s: float, lane: int, on_ground: bool) -> tuple[Body, Rotors, bool]:
    """`stepped` of one lane of a block."""
    return stepped(
        lanes.body_in(block, lane),
        lanes.four_in(block, ROTOR, lane),
        lanes.four_in(block, lanes.COMMAND, lane),
        lanes.wind_in(block, lane),
        lanes.parameters_in(block, lane),
        dt_s,
        block[lanes.HELD * LANES + lane] != 0.0,
        on_ground,
    )


@compiled
def rk4_step(
    x: Array,
    rotor_speed_command_rad_s: Array,
    wind_nwu_m_s: Array,
    parameters: Array,
    dt_s: float,
    held: NDArray[np.bool_],
    block: Array | None,
) -> None:
    """Advance `x` (17, n) in place by `dt_s`: LANES vehicles at a time, then the rest one by one.

    Commands (4, n) are clipped to what the rotors can do; ideal rotors take them at once. Wind is (3, n). A vehicle
    that is `held` (n,) keeps its pose, with no velocity and no rates, while its rotors follow. `block` is
    `lanes.scratch(n)`.
    """
    n = x.shape[1]
    alone = 0
    if block is not None:
        alone = n - n % LANES
        for first in range(0, alone, LANES):
            lanes.gather(block, 0, N_STATES, x, first)
            lanes.gather(block, lanes.COMMAND, 4, rotor_speed_command_rad_s, first)
            lanes.gather(block, lanes.WIND, 3, wind_nwu_m_s, first)
            lanes.gather(block, lanes.PARAMETERS, N_PARAMETERS, parameters, first)
            for lane in range(LANES):
                block[lanes.HELD * LANES + lane] = 1.0 if held[first + lane] else 0.0
            # First as if all were in the air, and, if any was not, again.
            for lane in range(LANES):
                body, rotors, touches = stepped_lane(block, dt_s, lane, False)
                lanes.put_after(block, lane, body, rotors)
                block[lanes.TOUCHES * LANES + lane] = 1.0 if touches else 0.0
            touching = 0.0
            for lane in range(LANES):
                touching += block[lanes.TOUCHES * LANES + lane]
            if touching > 0.0:
                for lane in range(LANES):
                    body, rotors, _ = stepped_lane(block, dt_s, lane, True)
                    lanes.put_after(block, lane, body, rotors)
            lanes.scatter(block, lanes.AFTER, N_STATES, x, first)
    for j in range(alone, n):
        body, rotors, _ = stepped(
            body_of(x, j),
            four_of(x, ROTOR, j),
            four_of(rotor_speed_command_rad_s, 0, j),
            wind_of(wind_nwu_m_s, j),
            parameters_of(parameters, j),
            dt_s,
            held[j],
            True,
        )
        put(x, j, body, rotors)


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
        d = derivative(
            body_of(x, j), four_of(x, ROTOR, j), wind_of(wind_nwu_m_s, j), parameters_of(parameters, j), True
        )
        for i in range(3):
            acceleration_nwu_m_s2[i, j] = 0.0 if held[j] else d[VELOCITY + i]
