"""Off-board setpoints: messages in, one setpoint or one refusal out. `mavsitl.frames` turns signs to FLU here."""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, cos, isfinite, nan, pi, remainder, sin, sqrt
from typing import Any, NamedTuple, Protocol

from msgspec import Struct

from mavsitl.dialect import mavlink
from mavsitl.frames import Quaternion, Vector, flip_quaternion, flip_vector
from mavsitl.quaternion import rotate
from mavsitl.wire_units import from_deg_e7

ROLL_RATE_IGNORE = mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE
PITCH_RATE_IGNORE = mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
YAW_RATE_IGNORE = mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
THRUST_BODY_SET = 32
"""ATTITUDE_TARGET_TYPEMASK_THRUST_BODY_SET: `thrust_body`, an extension field, in place of `thrust`."""
THROTTLE_IGNORE = mavlink.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE
ATTITUDE_IGNORE = mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE

POSITION_IGNORE = 1, 2, 4
VELOCITY_IGNORE = 8, 16, 32
ACCELERATION_IGNORE = 64, 128, 256
"""POSITION_TARGET_TYPEMASK bits that leave out x, y and z of each group."""
FORCE_SET = mavlink.POSITION_TARGET_TYPEMASK_FORCE_SET
YAW_IGNORE = mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE
TARGET_YAW_RATE_IGNORE = mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE

ABOVE_SEA = mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT
ABOVE_HOME = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
ABOVE_GROUND = mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT, mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT
"""What `alt` of SET_POSITION_TARGET_GLOBAL_INT counts from, by frame."""

LARGEST = 3e7
"""No place on Earth is so many metres away, and no speed, acceleration, angle or rate means anything beyond."""

NORM_TOLERANCE = 0.01
"""How far a setpoint's quaternion may be from unit length; float32 and honest clients stay within 1e-6."""


class AttitudeSetpoint(Struct, frozen=True):
    """Hold `attitude` (FLU -> NWU); turn the heading at `yaw_rate_rad_s` about the world's z axis (NaN: not asked)."""

    attitude: Quaternion
    yaw_rate_rad_s: float
    thrust: float


class RateSetpoint(Struct, frozen=True):
    """Hold the body rates (FLU); a NaN yaw rate means 'as it is'."""

    omega_flu_rad_s: Vector
    thrust: float


class TorqueSetpoint(Struct, frozen=True):
    """Body torque in shares of the airframe's largest (FLU, -1..1) and collective thrust (0..1): U_1..U_4."""

    torque: Vector
    thrust: float


Setpoint = AttitudeSetpoint | RateSetpoint | TorqueSetpoint
"""What the inner loops follow."""

FREE: Vector = (nan, nan, nan)
"""No axis controlled."""


class PositionSetpoint(NamedTuple):
    """What `PositionControl` follows, in the world (NWU). NaN: that axis of that quantity is not asked for.

    Velocity beside position, and acceleration beside either, are fed forward.
    """

    position_nwu_m: Vector = FREE
    velocity_nwu_m_s: Vector = FREE
    acceleration_nwu_m_s2: Vector = FREE
    yaw_rad: float = nan
    yaw_rate_rad_s: float = nan


class State(NamedTuple):
    """What the estimate says of the vehicle; a component that is not finite is not known."""

    position_nwu_m: Vector
    velocity_nwu_m_s: Vector
    attitude: Quaternion
    """Unit, FLU -> NWU."""

    @classmethod
    def of(cls, estimate: Sequence[float]) -> State:
        """From an estimate's rows (13,): position m, velocity m/s, quaternion, and rates, which are not looked at."""
        px, py, pz, vx, vy, vz, w, x, y, z = estimate[:10]
        return cls((px, py, pz), (vx, vy, vz), (w, x, y, z))

    @property
    def yaw_rad(self) -> float:
        """Heading, counter-clockwise from north, -pi to pi; NaN where the attitude is not known."""
        w, x, y, z = self.attitude
        return atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))


class Origin(Protocol):
    """Where the local frame stands on the earth."""

    @property
    def altitude_amsl_m(self) -> float: ...

    def to_local(self, latitude_deg: float, longitude_deg: float, /) -> tuple[float, float]:
        """(north m, west m)"""


class Refusal(NamedTuple):
    """Why a setpoint message was not taken; such a message does not count for the off-board stream."""

    text: str


ATTITUDE_TARGET_FIELDS = tuple(
    name
    for name in ("q", "body_roll_rate", "body_pitch_rate", "body_yaw_rate", "thrust", "type_mask", "thrust_body")
    if name in mavlink.MAVLink_set_attitude_target_message.fieldnames
)
"""Of SET_ATTITUDE_TARGET, what `from_attitude_target` takes, arrays by element; `thrust_body` where there is one."""


def from_attitude_target(
    w: float,
    x: float,
    y: float,
    z: float,
    roll_rate: float,
    pitch_rate: float,
    yaw_rate: float,
    thrust: float,
    type_mask: int,
    *thrust_body: float,
) -> Setpoint | Refusal:
    """SET_ATTITUDE_TARGET, PX4's reading of `type_mask`.

    The attitude is used unless ATTITUDE_IGNORE is set, and then a body yaw rate that is not ignored feeds its yaw
    forward. Otherwise body rates are used if neither roll nor pitch rate is ignored. THROTTLE_IGNORE means zero thrust;
    THRUST_BODY_SET takes thrust_body's upward share (-z) for the collective and leaves its x and y.
    Fields that the mask leaves out are not looked at; a used field that is not finite or beyond `LARGEST`, or a
    quaternion that is not of unit length, refuses the whole message.
    """
    if type_mask & THRUST_BODY_SET:
        if not thrust_body:
            return Refusal("SET_ATTITUDE_TARGET refused: THRUST_BODY_SET needs thrust_body, not in this dialect")
        thrust = -thrust_body[2]
    use_attitude = not type_mask & ATTITUDE_IGNORE
    if not use_attitude and type_mask & (ROLL_RATE_IGNORE | PITCH_RATE_IGNORE):
        return Refusal(f"SET_ATTITUDE_TARGET refused: type_mask {type_mask:#04x} leaves no setpoint")
    if type_mask & THROTTLE_IGNORE:
        thrust = 0.0
    elif not abs(thrust) <= LARGEST:
        return Refusal(f"SET_ATTITUDE_TARGET refused: thrust is {thrust:g}")
    if type_mask & YAW_RATE_IGNORE:
        yaw_rate = nan
    elif not abs(yaw_rate) <= LARGEST:
        return Refusal(f"SET_ATTITUDE_TARGET refused: body_yaw_rate is {yaw_rate:g}")
    thrust = 0.0 if thrust < 0.0 else 1.0 if thrust > 1.0 else thrust
    if use_attitude:
        norm = sqrt(w * w + x * x + y * y + z * z)
        if not abs(norm - 1.0) <= NORM_TOLERANCE:
            return Refusal(f"SET_ATTITUDE_TARGET refused: |q| is {norm:.3g}, need 1")
        return AttitudeSetpoint(flip_quaternion(w / norm, x / norm, y / norm, z / norm), -yaw_rate, thrust)
    if not (abs(roll_rate) <= LARGEST and abs(pitch_rate) <= LARGEST):
        return Refusal(f"SET_ATTITUDE_TARGET refused: body rates are {roll_rate:g}, {pitch_rate:g}")
    return RateSetpoint(flip_vector(roll_rate, pitch_rate, yaw_rate), thrust)


def from_actuator_control_target(message: Any) -> Setpoint | Refusal:
    """SET_ACTUATOR_CONTROL_TARGET, group 0: roll, pitch, yaw torque (FRD, -1..1), thrust (0..1), clipped to range."""
    if message.group_mlx != 0:
        return Refusal(f"SET_ACTUATOR_CONTROL_TARGET refused: group {message.group_mlx}, only group 0 is flown")
    roll, pitch, yaw, thrust = message.controls[:4]
    if not _usable(roll, pitch, yaw, thrust):
        return Refusal(f"SET_ACTUATOR_CONTROL_TARGET refused: controls are {roll:g}, {pitch:g}, {yaw:g}, {thrust:g}")
    roll, pitch, yaw = (min(max(value, -1.0), 1.0) for value in (roll, pitch, yaw))
    return TorqueSetpoint(flip_vector(roll, pitch, yaw), min(max(thrust, 0.0), 1.0))


def from_position_target_local_ned(message: Any, state: State) -> PositionSetpoint | Refusal:
    """SET_POSITION_TARGET_LOCAL_NED (84), all masks, in four frames.

    LOCAL_NED (1); LOCAL_OFFSET_NED (7): position counts from the present one; BODY_NED (8): PX4's reading, velocity
    turned by the heading, acceleration by the attitude, position not taken; BODY_OFFSET_NED (9): ArduPilot's reading,
    position, velocity, acceleration and yaw count from the present position and heading.

    In the turned frames an axis exists only together with the others that it is turned into: of x and y, one that is
    ignored beside a used one is 0, and BODY_NED takes an acceleration only whole. Refused: other frames, a mask that
    leaves nothing to hold, FORCE with an acceleration, used fields that are not finite or beyond `LARGEST`, and an
    unknown state where the frame needs it.
    """
    name = "SET_POSITION_TARGET_LOCAL_NED"
    mask: int = message.type_mask
    frame: int = message.coordinate_frame
    in_body = frame == mavlink.MAV_FRAME_BODY_NED
    in_body_offset = frame == mavlink.MAV_FRAME_BODY_OFFSET_NED
    in_offset = frame == mavlink.MAV_FRAME_LOCAL_OFFSET_NED
    if not (in_body or in_body_offset or in_offset or frame == mavlink.MAV_FRAME_LOCAL_NED):
        return Refusal(f"{name} refused: coordinate frame {frame} unsupported, need 1, 7, 8 or 9")
    position = FREE if in_body else _used(mask, POSITION_IGNORE, message.x, message.y, message.z)
    velocity = _used(mask, VELOCITY_IGNORE, message.vx, message.vy, message.vz)
    acceleration = _used(mask, ACCELERATION_IGNORE, message.afx, message.afy, message.afz)
    if in_body and mask & sum(ACCELERATION_IGNORE):
        acceleration = FREE
    setpoint = _checked(name, message, mask, position, velocity, acceleration)
    if isinstance(setpoint, Refusal) or frame == mavlink.MAV_FRAME_LOCAL_NED:
        return setpoint
    position, velocity, acceleration, yaw, yaw_rate = setpoint
    if in_body or in_body_offset:
        heading = state.yaw_rad
        if not isfinite(heading):
            return Refusal(f"{name} refused: frame {frame} needs the heading, and it is not known")
        c, s = cos(heading), sin(heading)
        velocity = _turned(velocity, c, s)
        if in_body:
            if acceleration is not FREE:
                acceleration = rotate(state.attitude, acceleration)
        else:
            position, acceleration = _turned(position, c, s), _turned(acceleration, c, s)
            yaw = remainder(heading + yaw, 2.0 * pi)
    if not in_body:
        x, y, z = (a + b for a, b in zip(position, state.position_nwu_m, strict=True))
        if any(isfinite(a) and not isfinite(b) for a, b in zip(position, (x, y, z), strict=True)):
            return Refusal(f"{name} refused: frame {frame} needs the position, and it is not known")
        position = (x, y, z)
    return PositionSetpoint(position, velocity, acceleration, yaw, yaw_rate)


def from_position_target_global_int(
    message: Any, origin: Origin, home_altitude_amsl_m: float
) -> PositionSetpoint | Refusal:
    """SET_POSITION_TARGET_GLOBAL_INT (86): altitude above mean sea level in frames 0 and 5, above home in 3 and 6.

    Frames 10 and 11 count from the ground, which is flat at the origin's altitude. Latitude and longitude are used
    both or not at all; velocity and acceleration are NED. `home_altitude_amsl_m` is NaN where there is no home yet.
    Refusals as for `from_position_target_local_ned`.
    """
    name = "SET_POSITION_TARGET_GLOBAL_INT"
    mask: int = message.type_mask
    frame: int = message.coordinate_frame
    if frame in ABOVE_SEA:
        datum = 0.0
    elif frame in ABOVE_HOME:
        datum = home_altitude_amsl_m
    elif frame in ABOVE_GROUND:
        datum = origin.altitude_amsl_m
    else:
        return Refusal(f"{name} refused: coordinate frame {frame} unsupported, need 0, 3, 5, 6, 10 or 11")
    ignored = mask & 3
    if ignored in (1, 2):
        return Refusal(f"{name} refused: latitude and longitude are used or ignored together")
    north = west = up = nan
    if not ignored:
        latitude, longitude = from_deg_e7(message.lat_int), from_deg_e7(message.lon_int)
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
            return Refusal(f"{name} refused: no place on earth at {latitude:g}, {longitude:g}")
        north, west = origin.to_local(latitude, longitude)
    if not mask & POSITION_IGNORE[2]:
        if not isfinite(datum):
            return Refusal(f"{name} refused: frame {frame} needs a home position")
        up = message.alt + datum - origin.altitude_amsl_m
    velocity = _used(mask, VELOCITY_IGNORE, message.vx, message.vy, message.vz)
    acceleration = _used(mask, ACCELERATION_IGNORE, message.afx, message.afy, message.afz)
    return _checked(name, message, mask, (north, -west, -up), velocity, acceleration)


def _usable(*values: float) -> bool:
    return all(abs(value) <= LARGEST for value in values)


def _used(mask: int, bits: tuple[int, int, int], x: float, y: float, z: float) -> Vector:
    return nan if mask & bits[0] else x, nan if mask & bits[1] else y, nan if mask & bits[2] else z


def _checked(
    name: str, message: Any, mask: int, position: Vector, velocity: Vector, acceleration: Vector
) -> PositionSetpoint | Refusal:
    """NED in, NWU out, once all that the mask uses is finite and is something to hold."""
    groups = []
    for label, bits, values in (
        ("position", POSITION_IGNORE, position),
        ("velocity", VELOCITY_IGNORE, velocity),
        ("acceleration", ACCELERATION_IGNORE, acceleration),
    ):
        if values is FREE or all(mask & bit for bit in bits):
            groups.append(FREE)
        elif all(mask & bit or _usable(value) for bit, value in zip(bits, values, strict=True)):
            groups.append(flip_vector(*values))
        else:
            x, y, z = values
            return Refusal(f"{name} refused: {label} is {x:g}, {y:g}, {z:g}")
    if all(group is FREE for group in groups):
        return Refusal(f"{name} refused: type_mask {mask:#05x} leaves no position, velocity or acceleration")
    if mask & FORCE_SET and groups[2] is not FREE:
        return Refusal(f"{name} refused: FORCE is not supported")
    yaw = nan if mask & YAW_IGNORE else -message.yaw
    yaw_rate = nan if mask & TARGET_YAW_RATE_IGNORE else -message.yaw_rate
    if not (mask & YAW_IGNORE or _usable(yaw)):
        return Refusal(f"{name} refused: yaw is {yaw:g}")
    if not (mask & TARGET_YAW_RATE_IGNORE or _usable(yaw_rate)):
        return Refusal(f"{name} refused: yaw_rate is {yaw_rate:g}")
    return PositionSetpoint(groups[0], groups[1], groups[2], remainder(yaw, 2.0 * pi), yaw_rate)


def _turned(vector: Vector, c: float, s: float) -> Vector:
    """From the heading's axes to the world's; of x and y, the one left out beside a used one is 0."""
    x, y, z = vector
    if not (isfinite(x) or isfinite(y)):
        return vector
    x, y = x if isfinite(x) else 0.0, y if isfinite(y) else 0.0
    return c * x - s * y, s * x + c * y, z
