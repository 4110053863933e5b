"""The ground's log, on the vehicle's clock: what was wanted, commanded and learned in each cycle."""

from __future__ import annotations

import numpy as np

from mavsitl.control.arrays import Floats
from mavsitl.log import topics
from mavsitl.log.block import Block, columns
from mavsitl.log.ulog import Recorder
from mavsitl.scenario import Flight
from mavsitl_ground import cycle


def block(recorder: Recorder, flight: Flight, *, with_weights: bool, own: bool = False) -> Block:
    """Takes the rows that `mavsitl_ground.cycle` fills, or `mavsitl_ground.seat`, and makes the topics' of them.

    `own`: of a controller of the user's, which does not say U_2..U_4, and logs what it likes.
    """
    airframe = flight.airframe
    # Angular acceleration to U_2, U_3 (forces) and U_4 (torque), beside U_1 and W_1..W_3.
    per_u = np.array(airframe.inertia_kg_m2) / (airframe.arm_m, airframe.arm_m, 1.0)
    scale = np.concatenate(([1.0], per_u, [1.0, 1.0, 1.0]))

    def control_demand(rows: Floats) -> Floats:
        demand: Floats = rows[:, cycle.U1 : cycle.LINK] * scale
        return demand

    def attitude_setpoint(rows: Floats) -> Floats:
        """phi_d, theta_d, psi_d in FRD, PX4's thrust_body, the same attitude FRD -> NED and a yaw rate, (k, 11)."""
        (cx, cy, cz), (sx, sy, sz) = np.cos(half := 0.5 * rows[:, cycle.DESIRED :][:, :3].T), np.sin(half)
        w, x = cx * cy * cz + sx * sy * sz, sx * cy * cz - cx * sy * sz
        y, z = cx * sy * cz + sx * cy * sz, cx * cy * sz - sx * sy * cz
        return np.column_stack((rows[:, cycle.DESIRED : cycle.U1], w, x, y, z, np.zeros(len(rows))))

    width = cycle.COLUMNS + (topics.MOST_LOGGED if own else 0)
    found = [
        (topics.TRAJECTORY_SETPOINT, columns(cycle.POSITION, cycle.DESIRED)),
        (topics.ATTITUDE_SETPOINT, attitude_setpoint),
        (topics.OWN_CONTROLLER, columns(cycle.COLUMNS, width)) if own else (topics.CONTROL_DEMAND, control_demand),
        (topics.LINK_STATUS, columns(cycle.LINK, cycle.WEIGHTS)),
    ]
    if with_weights:
        found.append((topics.PIDNN_WEIGHTS, columns(cycle.WEIGHTS, cycle.COLUMNS)))
    return Block(recorder, width, found)
