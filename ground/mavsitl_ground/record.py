"""The ground's log, on the vehicle's clock: what was wanted, commanded and learned in each cycle."""

from __future__ import annotations

import numpy as np

from mavsitl.control.arrays import Floats
from mavsitl.log import topics
from mavsitl.log.block import Block, columns
from mavsitl.log.ulog import Recorder
from mavsitl.scenario import Flight
from mavsitl_ground import cycle


def block(recorder: Recorder, flight: Flight, *, with_weights: bool) -> Block:
    """Takes the rows that `mavsitl_ground.cycle` fills and makes the topics' of them."""
    airframe = flight.airframe
    # Angular acceleration to U_2, U_3 (forces) and U_4 (torque), beside U_1 and W_1..W_3.
    per_u = np.array(airframe.inertia_kg_m2) / (airframe.arm_m, airframe.arm_m, 1.0)
    scale = np.concatenate(([1.0], per_u, [1.0, 1.0, 1.0]))

    def control_demand(rows: Floats) -> Floats:
        demand: Floats = rows[:, cycle.U1 : cycle.LINK] * scale
        return demand

    found = [
        (topics.TRAJECTORY_SETPOINT, columns(cycle.POSITION, cycle.DESIRED)),
        (topics.ATTITUDE_SETPOINT, columns(cycle.DESIRED, cycle.U1)),
        (topics.CONTROL_DEMAND, control_demand),
        (topics.LINK_STATUS, columns(cycle.LINK, cycle.WEIGHTS)),
    ]
    if with_weights:
        found.append((topics.PIDNN_WEIGHTS, columns(cycle.WEIGHTS, cycle.COLUMNS)))
    return Block(recorder, cycle.COLUMNS, found)
