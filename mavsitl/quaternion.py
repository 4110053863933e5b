"""Attitude quaternions on plain floats: scalar first, Hamilton product, body to world.

Every function takes and gives tuples, in any pair of frames: a quaternion is ``(w, x, y, z)`` with i j = k, and turns a
vector's body components into its world components. Angles are in radians; Euler angles are Z-Y-X (yaw, then pitch, then
roll, each about the axis the last turn left). Functions that call their argument `unit` do not check its norm:
`normalise` does, once, where a quaternion comes in. `mavsitl.control.rotation` compiles some of these texts.
"""

from __future__ import annotations

from math import atan2, cos, hypot, isfinite, pi, sin, sqrt

from mavsitl.frames import Quaternion, Vector

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)

_GIMBAL_LOCK_COS_PITCH = 1e-8
"""Below this cos(pitch), yaw from the rotation matrix is rounding error."""


def normalise(q: Quaternion) -> Quaternion:
    """The unit quaternion along `q`, of the same sign. `ValueError` if its norm is zero or not finite."""
    w, x, y, z = q
    norm = hypot(w, x, y, z)
    if norm == 0.0 or not isfinite(norm):
        raise ValueError(f"a quaternion of norm {norm} has no direction: {q}")
    return w / norm, x / norm, y / norm, z / norm


def conjugate(q: Quaternion) -> Quaternion:
    """``(w, -x, -y, -z)``: of a unit quaternion the inverse, world to body."""
    w, x, y, z = q
    return w, -x, -y, -z


def multiply(left: Quaternion, right: Quaternion) -> Quaternion:
    """The Hamilton product: the turn `right` first, then `left`, both seen in `left`'s world."""
    aw, ax, ay, az = left
    bw, bx, by, bz = right
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def rotate(unit: Quaternion, vector: Vector) -> Vector:
    """World components of the vector whose body components are `vector`: the vector part of q v q*."""
    w, x, y, z = unit
    vx, vy, vz = vector
    # v + w t + r x t with t = 2 r x v, where r is the vector part: 15 products in place of 28.
    tx = 2.0 * (y * vz - z * vy)
    ty = 2.0 * (z * vx - x * vz)
    tz = 2.0 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


def up_vector(unit: Quaternion) -> Vector:
    """World components of the body's z axis: the third column of R(q); with FLU in NWU, the direction of the thrust."""
    w, x, y, z = unit
    return 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)


def from_yaw(yaw_rad: float) -> Quaternion:
    """Level, turned by `yaw_rad` about the world's z axis."""
    return cos(0.5 * yaw_rad), 0.0, 0.0, sin(0.5 * yaw_rad)


def from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quaternion:
    """The unit quaternion of Z-Y-X Euler angles."""
    cr, sr = cos(0.5 * roll_rad), sin(0.5 * roll_rad)
    cp, sp = cos(0.5 * pitch_rad), sin(0.5 * pitch_rad)
    cy, sy = cos(0.5 * yaw_rad), sin(0.5 * yaw_rad)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def to_euler(unit: Quaternion) -> Vector:
    """``(roll, pitch, yaw)`` in radians: pitch within [-pi/2, pi/2], the others within [-pi, pi].

    With the nose straight up or down only yaw - roll or yaw + roll is defined; roll is then 0.
    """
    w, x, y, z = unit
    forward_x = 1.0 - 2.0 * (y * y + z * z)
    forward_y = 2.0 * (x * y + w * z)
    sin_pitch = 2.0 * (w * y - x * z)
    cos_pitch = sqrt(forward_x * forward_x + forward_y * forward_y)
    pitch = atan2(sin_pitch, cos_pitch)
    if cos_pitch < _GIMBAL_LOCK_COS_PITCH:
        yaw = 2.0 * atan2(x, w)
        if abs(yaw) > pi:
            yaw -= 2.0 * pi if yaw > 0.0 else -2.0 * pi
        return 0.0, pitch, -yaw if sin_pitch > 0.0 else yaw
    return atan2(2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)), pitch, atan2(forward_y, forward_x)


def euler_rates(angles_rad: Vector, omega_rad_s: Vector) -> Vector:
    """Time derivatives of Z-Y-X roll, pitch, yaw from the body rates, rad/s; the pole at pitch +-90 degrees is cut off.

    Where the paper writes the body rates as the angles' derivatives (eq 11), this is the exact relation.
    """
    roll, pitch, _ = angles_rad
    p, q, r = omega_rad_s
    about_z = q * sin(roll) + r * cos(roll)
    cosine = max(cos(pitch), 1e-3)
    yaw_rate = about_z / cosine
    return p + yaw_rate * sin(pitch), q * cos(roll) - r * sin(roll), yaw_rate
