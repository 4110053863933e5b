"""Off-board setpoints: messages in, one setpoint or one refusal out. `mavsitl.frames` turns signs to FLU here."""

from __future__ import annotations

from math import isfinite, nan, sqrt
from typing import Any, NamedTuple

from mavsitl.dialect import mavlink
from mavsitl.frames import Quaternion, Vector, flip_quaternion, flip_vector

ROLL_RATE_IGNORE = mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE
PITCH_RATE_IGNORE = mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
YAW_RATE_IGNORE = mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
THRUST_BODY_SET = 32
"""ATTITUDE_TARGET_TYPEMASK_THRUST_BODY_SET; the dialect's message has no thrust_body field."""
THROTTLE_IGNORE = mavlink.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE
ATTITUDE_IGNORE = mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE

NORM_TOLERANCE = 0.01
"""How far a setpoint's quaternion may be from unit length; float32 and honest clients stay within 1e-6."""


class AttitudeSetpoint(NamedTuple):
    """Hold `attitude` (FLU -> NWU); turn the heading at `yaw_rate_rad_s` about the world's z axis (NaN: not asked)."""

    attitude: Quaternion
    yaw_rate_rad_s: float
    thrust: float


class RateSetpoint(NamedTuple):
    """Hold the body rates (FLU); a NaN yaw rate means 'as it is'."""

    omega_flu_rad_s: Vector
    thrust: float


class TorqueSetpoint(NamedTuple):
    """Body torque in shares of the airframe's largest (FLU, -1..1) and collective thrust (0..1): U_1..U_4."""

    torque: Vector
    thrust: float


Setpoint = AttitudeSetpoint | RateSetpoint | TorqueSetpoint


class Refusal(NamedTuple):
    """Why a setpoint message was not taken; such a message does not count for the off-board stream."""

    text: str


def from_attitude_target(message: Any) -> Setpoint | Refusal:
    """SET_ATTITUDE_TARGET, PX4's reading of `type_mask`.

    The attitude is used unless ATTITUDE_IGNORE is set, and then a body yaw rate that is not ignored feeds its yaw
    forward. Otherwise body rates are used if neither roll nor pitch rate is ignored. THROTTLE_IGNORE means zero thrust.
    Fields that the mask leaves out are not looked at; a used field that is not finite, or a quaternion that is not of
    unit length, refuses the whole message.
    """
    mask: int = message.type_mask
    if mask & THRUST_BODY_SET:
        return Refusal("SET_ATTITUDE_TARGET refused: THRUST_BODY_SET needs thrust_body, not in this dialect")
    use_attitude = not mask & ATTITUDE_IGNORE
    use_rates = not mask & (ROLL_RATE_IGNORE | PITCH_RATE_IGNORE)
    if not use_attitude and not use_rates:
        return Refusal(f"SET_ATTITUDE_TARGET refused: type_mask {mask:#04x} leaves no setpoint")
    thrust = 0.0 if mask & THROTTLE_IGNORE else message.thrust
    yaw_rate = nan if mask & YAW_RATE_IGNORE else message.body_yaw_rate
    if not isfinite(thrust):
        return Refusal("SET_ATTITUDE_TARGET refused: thrust is not finite")
    if not mask & YAW_RATE_IGNORE and not isfinite(yaw_rate):
        return Refusal("SET_ATTITUDE_TARGET refused: body_yaw_rate is not finite")
    thrust = min(max(thrust, 0.0), 1.0)
    if use_attitude:
        w, x, y, z = message.q
        norm = sqrt(w * w + x * x + y * y + z * z)
        if not abs(norm - 1.0) <= NORM_TOLERANCE:
            return Refusal(f"SET_ATTITUDE_TARGET refused: |q| is {norm:.3g}, need 1")
        attitude = flip_quaternion(w / norm, x / norm, y / norm, z / norm)
        return AttitudeSetpoint(attitude, -yaw_rate, thrust)
    p, q = message.body_roll_rate, message.body_pitch_rate
    if not (isfinite(p) and isfinite(q)):
        return Refusal("SET_ATTITUDE_TARGET refused: body rates are not finite")
    return RateSetpoint(flip_vector(p, q, yaw_rate), thrust)


def from_actuator_control_target(message: Any) -> Setpoint | Refusal:
    """SET_ACTUATOR_CONTROL_TARGET, group 0: roll, pitch, yaw torque (FRD, -1..1), thrust (0..1), clipped to range."""
    if message.group_mlx != 0:
        return Refusal(f"SET_ACTUATOR_CONTROL_TARGET refused: group {message.group_mlx}, only group 0 is flown")
    roll, pitch, yaw, thrust = message.controls[:4]
    if not (isfinite(roll) and isfinite(pitch) and isfinite(yaw) and isfinite(thrust)):
        return Refusal("SET_ACTUATOR_CONTROL_TARGET refused: controls are not finite")
    roll, pitch, yaw = (min(max(value, -1.0), 1.0) for value in (roll, pitch, yaw))
    return TorqueSetpoint(flip_vector(roll, pitch, yaw), min(max(thrust, 0.0), 1.0))
