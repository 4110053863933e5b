"""Telemetry to state: the vehicle as the controller knows it, with its age and validity.

The ground's frame boundary in.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite, nan
from typing import Literal, TypeAlias

import numpy as np

from mavsitl.codec import Frame, reader
from mavsitl.compiled import compiled, direct, inlined
from mavsitl.control.arrays import Floats, Record, record
from mavsitl.control.rotation import euler_rates, normalise, rotate, to_euler
from mavsitl.dialect import mavlink
from mavsitl.frames import Quaternion
from mavsitl.quaternion import IDENTITY

SPLIT = (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
ODOMETRY = (mavlink.MAVLINK_MSG_ID_ODOMETRY,)
Source: TypeAlias = Literal["any", "odometry", "split"]
NO_OFFSET_US = 1 << 62
OFFSET_US = 500_000
"""How fast a state can come is known from as long a time, up to twice that: the clocks drift, and the vehicle's stands
still where its machine is too slow or `--speed` is below 1."""
FRAMES = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD)
RESTART_US = 1_000_000
"""The vehicle's clock goes back by more than this when it has restarted; by less, messages were overtaken."""

LINEAR = ("x", "y", "z", "vx", "vy", "vz")
ANGULAR = ("rollspeed", "pitchspeed", "yawspeed")
read_odometry = reader(
    mavlink.MAVLink_odometry_message,
    "time_usec", "x", "y", "z", "q", "vx", "vy", "vz", *ANGULAR, "frame_id", "child_frame_id", flat=True,
)  # fmt: skip
read_attitude = reader(mavlink.MAVLink_attitude_quaternion_message, "time_boot_ms", "q1", "q2", "q3", "q4", *ANGULAR)
read_position = reader(mavlink.MAVLink_local_position_ned_message, "time_boot_ms", *LINEAR)
read_vector = reader(mavlink.MAVLink_debug_vect_message, "x", "y", "z", "name")


@inlined
def _is_attitude(q: Quaternion, p: float, q_rate: float, r: float) -> bool:
    """Near unit length and finite."""
    w, x, y, z = q
    return abs(w * w + x * x + y * y + z * z - 1.0) <= 0.05 and isfinite(p + q_rate + r)


@inlined
def _is_linear(x: float, y: float, z: float, vx: float, vy: float, vz: float) -> bool:
    """Finite."""
    return isfinite(x + y + z + (vx + vy + vz))


@inlined
def _fill_attitude(q: Quaternion, p: float, q_rate: float, r: float, state: Record) -> None:
    w, x, y, z = q
    unit = normalise(w, x, -y, -z)
    angles = to_euler(unit)
    omega = (p, -q_rate, -r)
    rates = euler_rates(angles, omega)
    to = state[0]
    for part in range(4):
        to["quaternion"][part, 0] = unit[part]
    for axis in range(3):
        to["angles"][axis, 0] = angles[axis]
        to["omega"][axis, 0] = omega[axis]
        to["angle_rates"][axis, 0] = rates[axis]


@inlined
def _fill_linear(x: float, y: float, z: float, vx: float, vy: float, vz: float, state: Record) -> None:
    position, velocity = state[0]["position"], state[0]["velocity"]
    position[0, 0], position[1, 0], position[2, 0] = x, -y, -z
    velocity[0, 0], velocity[1, 0], velocity[2, 0] = vx, -vy, -vz


@compiled
def take_attitude(q: Quaternion, p: float, q_rate: float, r: float, newer: bool, state: Record) -> bool:
    """Attitude FRD -> NED and body rates FRD to the state where they are `newer`; whether they are good."""
    good = _is_attitude(q, p, q_rate, r)
    if good and newer:
        _fill_attitude(q, p, q_rate, r, state)
    return good


@compiled
def take_linear(x: float, y: float, z: float, vx: float, vy: float, vz: float, newer: bool, state: Record) -> bool:
    """Position and velocity NED to the state where they are `newer`; whether they are good."""
    good = _is_linear(x, y, z, vx, vy, vz)
    if good and newer:
        _fill_linear(x, y, z, vx, vy, vz, state)
    return good


@compiled
def take_odometry(
    x: float, y: float, z: float, q_w: float, q_x: float, q_y: float, q_z: float,
    vx: float, vy: float, vz: float, p: float, q_rate: float, r: float, in_body: bool, newer: bool, state: Record,
) -> bool:  # fmt: skip
    """Both; the velocity is FRD where it is `in_body`. One message is one state: half of a bad one is not taken."""
    q = q_w, q_x, q_y, q_z
    good = _is_attitude(q, p, q_rate, r) and _is_linear(x, y, z, vx, vy, vz)
    if good and newer:
        if in_body:
            vx, vy, vz = rotate(normalise(q_w, q_x, q_y, q_z), (vx, vy, vz))
        _fill_attitude(q, p, q_rate, r, state)
        _fill_linear(x, y, z, vx, vy, vz, state)
    return good


class Observer:
    """The vehicle's state, filled from ODOMETRY or from ATTITUDE_QUATERNION and LOCAL_POSITION_NED.

    `stamp_us` is the vehicle's clock at the newest attitude; `fresh` says that it is new since `take`.
    """

    def __init__(self, source: Source = "any", max_age_us: int = 500_000) -> None:
        """`source`: two streams of one state are not mixed, so the other one is ignored."""
        self._max_age_us = max_age_us
        vector = np.zeros((3, 1))
        self.state = record(
            position=vector,
            velocity=vector,
            quaternion=[[1.0], [0.0], [0.0], [0.0]],
            angles=vector,
            omega=vector,
            angle_rates=vector,
            true_wind=vector,
        )
        """In one piece what the properties below name, as the compiled controller takes it."""
        ignored = {"any": (), "odometry": SPLIT, "split": ODOMETRY}[source]
        handlers: dict[int, Callable[[Frame], None]] = {
            mavlink.MAVLINK_MSG_ID_ODOMETRY: self._on_odometry,
            mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._on_attitude,
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._on_position,
            mavlink.MAVLINK_MSG_ID_DEBUG_VECT: self._on_vector,
        }
        self.handlers = {key: handler for key, handler in handlers.items() if key not in ignored}
        """What takes a frame of a message in, by the message's id. One with a non-finite value is not taken."""
        self.reset()
        # Compiles, or reads the cache, before the clock runs; what is not newer changes nothing.
        still = (0.0, 0.0, 0.0)
        if source != "split":
            self._take_odometry = direct(take_odometry, *still, *IDENTITY, *still, *still, False, False, self.state)
        if source != "odometry":
            take_attitude(IDENTITY, *still, False, self.state)
            take_linear(*still, *still, False, self.state)

    def reset(self) -> None:
        """Forget everything: another vehicle, or the same after a restart."""
        self.stamp_us = -1
        self.restarted = False
        """The vehicle's clock went backwards by more than a second."""
        self._position_us = -1
        self._pairs = 0
        """Attitudes in a row that had a position of their own stamp; after two the next is waited for too."""
        self._offset_us = self._older_offset_us = NO_OFFSET_US
        self._offset_end_us = 0
        self._fresh = False
        self.state["true_wind"] = nan

    @property
    def position_nwu_m(self) -> Floats:
        """(3, 1), as all vectors here."""
        position: Floats = self.state["position"][0]
        return position

    @property
    def velocity_nwu_m_s(self) -> Floats:
        velocity: Floats = self.state["velocity"][0]
        return velocity

    @property
    def quaternion(self) -> Floats:
        """FLU -> NWU, (4, 1), unit."""
        quaternion: Floats = self.state["quaternion"][0]
        return quaternion

    @property
    def angles_rad(self) -> Floats:
        """Z-Y-X roll, pitch, yaw of FLU in NWU."""
        angles: Floats = self.state["angles"][0]
        return angles

    @property
    def omega_flu_rad_s(self) -> Floats:
        omega: Floats = self.state["omega"][0]
        return omega

    @property
    def angle_rates_rad_s(self) -> Floats:
        """Time derivatives of `angles_rad`, from the body rates."""
        rates: Floats = self.state["angle_rates"][0]
        return rates

    @property
    def true_wind_nwu_m_s(self) -> Floats:
        """From DEBUG_VECT "WIND_TRUE": the oracle's. NaN until one came."""
        wind: Floats = self.state["true_wind"][0]
        return wind

    @property
    def fresh(self) -> bool:
        """A new attitude since the last `take`, and a position and velocity that go with it.

        Where both streams are equally fast, an attitude whose position is still on its way is not fresh yet.
        """
        if not self._fresh or self._position_us < 0:
            return False
        return self.stamp_us - self._position_us <= (0 if self._pairs >= 2 else self._max_age_us)

    def age_us(self, now_us: int) -> int | None:
        """How old the newest state is at `now_us` of the ground's clock, beyond the fastest transport; None before any.

        The clocks' offset is the least difference between taking and stamp, of the states taken in the last second: the
        transport's constant part is not in the age, nor is what the clocks have drifted before.
        """
        if self.stamp_us < 0:
            return None
        offset_us = now_us - self.stamp_us
        return max(offset_us - min(self._offset_us, self._older_offset_us, offset_us), 0)

    def take(self, now_us: int) -> int | None:
        """The age of a fresh state, as of `age_us`: it is fresh no more. None: there is none, or it is too old."""
        if not self.fresh:
            return None
        self._fresh = False
        offset_us = now_us - self.stamp_us
        if now_us >= self._offset_end_us:
            self._offset_end_us = now_us + OFFSET_US
            self._older_offset_us, self._offset_us = self._offset_us, offset_us
        elif offset_us < self._offset_us:
            self._offset_us = offset_us
        age_us = offset_us - min(self._offset_us, self._older_offset_us)
        return age_us if age_us <= self._max_age_us else None

    def receive(self, frame: Frame) -> None:
        """A frame of the vehicle; messages without one of the `handlers` are ignored."""
        handler = self.handlers.get(frame.message_id)
        if handler is not None:
            handler(frame)

    def _on_odometry(self, frame: Frame) -> None:
        stamp_us, x, y, z, q_w, q_x, q_y, q_z, vx, vy, vz, p, q_rate, r, frame_id, child = read_odometry(frame)
        if frame_id != mavlink.MAV_FRAME_LOCAL_NED or child not in FRAMES:
            return
        newer = stamp_us >= self.stamp_us and stamp_us >= self._position_us
        in_body = child == mavlink.MAV_FRAME_BODY_FRD
        take_odometry = self._take_odometry
        if not take_odometry(x, y, z, q_w, q_x, q_y, q_z, vx, vy, vz, p, q_rate, r, in_body, newer, self.state):
            return
        if newer:
            self._attitude_at(stamp_us)
            self._position_us = stamp_us
        else:
            self._late(stamp_us)

    def _on_attitude(self, frame: Frame) -> None:
        time_ms, w, x, y, z, p, q_rate, r = read_attitude(frame)
        stamp_us = time_ms * 1000
        newer = stamp_us >= self.stamp_us
        if not take_attitude((w, x, y, z), p, q_rate, r, newer, self.state):
            return
        if newer:
            self._attitude_at(stamp_us)
        else:
            self._late(stamp_us)

    def _on_position(self, frame: Frame) -> None:
        time_ms, x, y, z, vx, vy, vz = read_position(frame)
        stamp_us = time_ms * 1000
        newer = stamp_us >= self._position_us
        if take_linear(x, y, z, vx, vy, vz, newer, self.state) and newer:
            self._position_us = stamp_us

    def _on_vector(self, frame: Frame) -> None:
        x, y, z, name = read_vector(frame)
        if name == "WIND_TRUE" and isfinite(x + y + z):
            self.state["true_wind"][0, :, 0] = x, -y, -z

    def _attitude_at(self, stamp_us: int) -> None:
        if stamp_us > self.stamp_us:
            self._pairs = self._pairs + 1 if 0 <= self.stamp_us == self._position_us else 0
            self._fresh = True
        self.stamp_us = stamp_us

    def _late(self, stamp_us: int) -> None:
        """A good attitude that is older than the newest."""
        if self.stamp_us - stamp_us > RESTART_US:
            self.restarted = True
