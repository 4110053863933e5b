"""Demands to setpoint messages.

The stamp of the state it answers is each message's token.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from mavsitl.codec import packer
from mavsitl.dialect import mavlink
from mavsitl.frames import Vector
from mavsitl.node import Node
from mavsitl_ground.cycle import Demand

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

Send: TypeAlias = Callable[[Node, Target, int, Demand], None]
"""``send(node, target, stamp_us, demand)`` queues one setpoint."""


def send_attitude(node: Node, target: Target, stamp_us: int, demand: Demand) -> None:
    """Attitude and thrust in SET_ATTITUDE_TARGET."""
    _queue(node, target, stamp_us, ATTITUDE_MASK, demand)


def send_rates(node: Node, target: Target, stamp_us: int, demand: Demand) -> None:
    """Body rates and thrust in SET_ATTITUDE_TARGET."""
    _queue(node, target, stamp_us, RATE_MASK, demand)


def _queue(node: Node, target: Target, stamp_us: int, mask: int, demand: Demand) -> None:
    system_id, component_id = target
    attitude, roll_rate, pitch_rate, yaw_rate, thrust = demand
    frame = SET_ATTITUDE_TARGET(
        node.sequence, node.system_id, node.component_id, stamp_us // 1000, system_id, component_id, mask,
        attitude, roll_rate, pitch_rate, yaw_rate, thrust,
    )  # fmt: skip
    node.queue(frame)


def send_torque(node: Node, target: Target, stamp_us: int, demand: Demand) -> None:
    """U_2..U_4 as shares of the largest torque and U_1 as thrust, in SET_ACTUATOR_CONTROL_TARGET, group 0."""
    _, roll, pitch, yaw, thrust = demand
    controls = (roll, pitch, yaw, thrust, 0.0, 0.0, 0.0, 0.0)
    node.send(SET_ACTUATOR_CONTROL_TARGET, stamp_us, 0, *target, controls)


SENDS: dict[str, Send] = {"attitude": send_attitude, "body_rate": send_rates, "torque": send_torque}
"""By the scenario's command level."""


SET_POSITION_TARGET_LOCAL_NED = packer(mavlink.MAVLink_set_position_target_local_ned_message)

_GROUPS = (
    mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE,
    mavlink.POSITION_TARGET_TYPEMASK_VX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VZ_IGNORE,
    mavlink.POSITION_TARGET_TYPEMASK_AX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE,
)


def send_position(
    node: Node, target: Target, stamp_us: int,
    position: Vector | None, velocity: Vector | None, acceleration: Vector | None, yaw_rad: float,
) -> None:  # fmt: skip
    """What is given of position, velocity, acceleration (NED) and yaw in SET_POSITION_TARGET_LOCAL_NED."""
    mask = mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
    values: tuple[float, ...] = ()
    for ignore, each in zip(_GROUPS, (position, velocity, acceleration), strict=True):
        if each is None:
            mask |= ignore
        values += each or (0.0, 0.0, 0.0)
    node.send(
        SET_POSITION_TARGET_LOCAL_NED, stamp_us // 1000, *target, mavlink.MAV_FRAME_LOCAL_NED, mask, *values,
        yaw_rad, 0.0,
    )  # fmt: skip
