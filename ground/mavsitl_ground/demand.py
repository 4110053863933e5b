"""Demands to setpoint messages: the ground's frame boundary out.

The stamp of the state it answers is each message's token.
"""

from __future__ import annotations

from collections.abc import Sequence

from mavsitl.codec import packer
from mavsitl.dialect import mavlink
from mavsitl.frames import Quaternion, Vector, flip_quaternion, flip_vector
from mavsitl.node import Node

SET_ATTITUDE_TARGET = packer(mavlink.MAVLink_set_attitude_target_message)
SET_ACTUATOR_CONTROL_TARGET = packer(mavlink.MAVLink_set_actuator_control_target_message)

ATTITUDE_MASK = (
    mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE
    | mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
    | mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
)
RATE_MASK = mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE

Target = tuple[int, int]
"""System and component id."""


def send_attitude(node: Node, target: Target, stamp_us: int, attitude: Quaternion, thrust: float) -> None:
    """q and thrust in SET_ATTITUDE_TARGET; `attitude` FLU -> NWU, thrust 0..1."""
    q = flip_quaternion(*attitude)
    node.send(SET_ATTITUDE_TARGET, stamp_us // 1000, *target, ATTITUDE_MASK, q, 0.0, 0.0, 0.0, thrust)


def send_rates(node: Node, target: Target, stamp_us: int, omega_flu_rad_s: Vector, thrust: float) -> None:
    """Body rates and thrust in SET_ATTITUDE_TARGET."""
    rates = flip_vector(*omega_flu_rad_s)
    node.send(SET_ATTITUDE_TARGET, stamp_us // 1000, *target, RATE_MASK, (1.0, 0.0, 0.0, 0.0), *rates, thrust)


def send_torque(node: Node, target: Target, stamp_us: int, shares: Sequence[float], thrust: float) -> None:
    """U_2..U_4 as shares of the largest torque (FLU) and U_1 as thrust, in SET_ACTUATOR_CONTROL_TARGET, group 0."""
    controls = (*flip_vector(shares[0], shares[1], shares[2]), thrust, 0.0, 0.0, 0.0, 0.0)
    node.send(SET_ACTUATOR_CONTROL_TARGET, stamp_us, 0, *target, controls)
