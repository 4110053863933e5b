"""The ground's log, on the vehicle's clock: what was wanted, commanded and learned in each cycle."""

from __future__ import annotations

import numpy as np

from mavsitl.control.arrays import Floats
from mavsitl.frames import flip_euler
from mavsitl.log import topics
from mavsitl.log.block import Block, ned
from mavsitl.log.ulog import Recorder
from mavsitl.scenario import Flight
from mavsitl_ground import cycle

_DESIRED = slice(cycle.DESIRED, cycle.DESIRED + 3)
_BY_NET = [cycle.WEIGHTS + k for k in (0, 3, 6, 1, 4, 7, 2, 5, 8)]
"""From (P, I, D) x (roll, pitch, yaw) to a net after another."""


def block(recorder: Recorder, flight: Flight, *, with_weights: bool, own: bool = False) -> Block:
    """Takes the rows that `mavsitl_ground.cycle` fills, or `mavsitl_ground.seat`, and makes the topics' of them.

    `own`: of a controller of the user's, which does not say U_2..U_4, and logs what it likes.
    """
    airframe = flight.airframe
    # Angular acceleration to U_2, U_3 (forces) and U_4 (torque).
    per_u = np.array(airframe.inertia_kg_m2) / (airframe.arm_m, airframe.arm_m, 1.0)

    def trajectory(v: Floats) -> Floats:
        position, velocity = v[:, cycle.POSITION :][:, :3], v[:, cycle.VELOCITY :][:, :3]
        return np.hstack((ned(position), ned(velocity), -v[:, cycle.YAW, np.newaxis]))

    def control_demand(v: Floats) -> Floats:
        acceleration, wind = v[:, cycle.ACCELERATION :][:, :3], v[:, cycle.WIND :][:, :3]
        return np.hstack((v[:, cycle.U1, np.newaxis], acceleration * per_u, wind))

    width = cycle.COLUMNS + (topics.MOST_LOGGED if own else 0)
    columns = [
        (topics.TRAJECTORY_SETPOINT, trajectory),
        (topics.ATTITUDE_SETPOINT, _attitude_setpoint),
        (topics.OWN_CONTROLLER, lambda v: v[:, cycle.COLUMNS :]) if own else (topics.CONTROL_DEMAND, control_demand),
        (topics.LINK_STATUS, lambda v: v[:, cycle.LINK : cycle.LINK + 4]),
    ]
    if with_weights:
        columns.append((topics.PIDNN_WEIGHTS, lambda v: v[:, _BY_NET]))
    return Block(recorder, width, columns)


def _attitude_setpoint(v: Floats) -> Floats:
    """phi_d, theta_d, psi_d in FRD and PX4's thrust_body, (k, 6)."""
    zero = np.zeros(len(v))
    return np.column_stack((*flip_euler(*v[:, _DESIRED].T), zero, zero, -v[:, cycle.THRUST]))
