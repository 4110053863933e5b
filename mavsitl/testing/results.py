"""What came of a flight, in a test's terms: NED and FRD, degrees, seconds."""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from mavsitl.frames import Vector, flip_quaternion, flip_vector
from mavsitl.quaternion import to_euler

__all__ = ["Array", "Failsafe", "State", "Status", "Text", "Track"]

Array: TypeAlias = npt.NDArray[np.float64]


class Text(NamedTuple):
    """A STATUSTEXT that the vehicle sent, whatever became of it on the way."""

    time_s: float
    severity: int
    """MAV_SEVERITY, 0 (emergency) to 7 (debug)."""
    text: str


class Status(NamedTuple):
    """What flew from `time_s` on."""

    time_s: float
    mode: str
    """By the names of mavros, e.g. ``OFFBOARD``, ``AUTO.LOITER``."""
    armed: bool
    failsafe: bool


class Failsafe(NamedTuple):
    """A fail-safe held the vehicle."""

    start_s: float
    end_s: float
    """Where it lasts still: the end of what was flown."""
    mode: str
    """That it chose first."""
    text: str
    """How the vehicle announced it, e.g. ``Failsafe activated: off-board signal lost, return``."""


@dataclass(frozen=True)
class State:
    """The vehicle at one moment: the truth, not its estimate."""

    time_s: float
    """By the clock of what is asked: of a `Flight` since the release, negative before it; else since the start."""
    position_ned_m: Vector
    velocity_ned_m_s: Vector
    attitude_deg: Vector
    """Roll, pitch, yaw (Z-Y-X), FRD in NED."""
    rates_deg_s: Vector
    """About x, y, z of FRD."""
    mode: str
    armed: bool
    landed: bool
    failsafe: bool

    def __repr__(self) -> str:
        north, east, down = self.position_ned_m
        facts = [self.mode, "armed" if self.armed else "disarmed", "landed" if self.landed else "in the air"]
        facts += ["fail-safe"] * self.failsafe
        return f"<State at {self.time_s:.2f} s: NED ({north:.2f}, {east:.2f}, {down:.2f}) m, {', '.join(facts)}>"

    @property
    def height_m(self) -> float:
        """Above the origin: minus down."""
        return -self.position_ned_m[2]

    @classmethod
    def of(cls, time_s: float, truth: Any, *, mode: str, armed: bool, landed: bool, failsafe: bool) -> State:
        """`truth`: position NWU m, velocity NWU m/s, quaternion FLU -> NWU, omega FLU rad/s, and more."""
        x, y, z, vx, vy, vz, qw, qx, qy, qz, p, q, r = truth[:13]
        roll, pitch, yaw = to_euler(flip_quaternion(qw, qx, qy, qz))
        p, q, r = flip_vector(p, q, r)
        return cls(
            time_s, flip_vector(x, y, z), flip_vector(vx, vy, vz), (degrees(roll), degrees(pitch), degrees(yaw)),
            (degrees(p), degrees(q), degrees(r)), mode=mode, armed=armed, landed=landed, failsafe=failsafe,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Track:
    """k moments of a flight, one each control period: its `truth`, or its `estimate`, what the vehicle believed."""

    time_s: Array
    """(k,)"""
    position_ned_m: Array
    """(k, 3)"""
    velocity_ned_m_s: Array
    """(k, 3)"""
    attitude_deg: Array
    """(k, 3): roll, pitch, yaw (Z-Y-X), FRD in NED."""
    rates_deg_s: Array
    """(k, 3): about x, y, z of FRD."""

    def __len__(self) -> int:
        return int(self.time_s.size)

    @property
    def height_m(self) -> Array:
        """(k,) above the origin: minus down."""
        height: Array = -self.position_ned_m[:, 2]
        return height

    @property
    def tilt_deg(self) -> Array:
        """(k,) between the vehicle's z axis and the vertical."""
        roll, pitch = np.radians(self.attitude_deg[:, :2]).T
        tilt: Array = np.degrees(np.arccos(np.clip(np.cos(roll) * np.cos(pitch), -1.0, 1.0)))
        return tilt

    def between(self, start_s: float, end_s: float | None = None) -> Track:
        """From `start_s` to `end_s`, both included; None: to the end."""
        rows = self.time_s >= start_s
        if end_s is not None:
            rows &= self.time_s <= end_s
        return Track(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def euler_deg(quaternions: Array) -> Array:
    """(k, 3) roll, pitch, yaw in degrees of (k, 4) unit quaternions, scalar first."""
    w, x, y, z = quaternions.T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    angles: Array = np.degrees(np.column_stack((roll, pitch, yaw)))
    return angles
