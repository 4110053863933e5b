"""The one frame boundary: world NWU and body FLU inside, NED and FRD on the wire.

Both changes of frame are the same half turn about the x axis, so they are sign flips, exact in floating point, and
their own inverses:

- a vector ``(x, y, z)`` becomes ``(x, -y, -z)``, whether world (NWU <-> NED) or body (FLU <-> FRD);
- an attitude quaternion ``(w, x, y, z)``, body to world, becomes ``(w, x, -y, -z)``;
- Euler angles (Z-Y-X) ``(roll, pitch, yaw)`` become ``(roll, -pitch, -yaw)``.
"""

from __future__ import annotations

from typing import TypeAlias

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]


def flip_vector(x: float, y: float, z: float) -> Vector:
    """NWU <-> NED and FLU <-> FRD."""
    return x, -y, -z


def flip_quaternion(w: float, x: float, y: float, z: float) -> Quaternion:
    """Attitude FLU -> NWU <-> attitude FRD -> NED; scalar first, Hamilton."""
    return w, x, -y, -z


def flip_euler(roll: float, pitch: float, yaw: float) -> Vector:
    """Z-Y-X Euler angles of the same attitude in the other pair of frames, in the unit given."""
    return roll, -pitch, -yaw
