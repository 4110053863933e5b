"""Telemetry to state: the vehicle as the controller knows it, with its age and validity.

The ground's frame boundary in.
"""

from __future__ import annotations

from math import isfinite
from typing import Any, Literal, TypeAlias

import numpy as np

from mavsitl.dialect import mavlink
from mavsitl.frames import flip_quaternion, flip_vector
from mavsitl.quaternion import euler_rates, normalise, rotate, to_euler

SPLIT = (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
ODOMETRY = (mavlink.MAVLINK_MSG_ID_ODOMETRY,)
Source: TypeAlias = Literal["any", "odometry", "split"]
NO_OFFSET_US = 1 << 62
FRAMES = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_FRD)


class Observer:
    """State arrays with the fleet axis, n = 1, filled from ODOMETRY or from ATTITUDE_QUATERNION and LOCAL_POSITION_NED.

    `stamp_us` is the vehicle's clock at the newest attitude; `fresh` says that it is new since `take`.
    """

    def __init__(self, source: Source = "any", max_age_us: int = 500_000) -> None:
        """`source`: two streams of one state are not mixed, so the other one is ignored."""
        self._ignored: tuple[int, ...] = {"any": (), "odometry": SPLIT, "split": ODOMETRY}[source]
        self._max_age_us = max_age_us
        # One array a message half, written at once; the names below are views of it.
        self._linear = np.zeros(6)
        self._angular = np.zeros(13)
        self._angular[0] = 1.0
        self.position_nwu_m = self._linear[0:3, np.newaxis]
        self.velocity_nwu_m_s = self._linear[3:6, np.newaxis]
        self.quaternion = self._angular[0:4, np.newaxis]
        self.angles_rad = self._angular[4:7, np.newaxis]
        self.omega_flu_rad_s = self._angular[7:10, np.newaxis]
        self.angle_rates_rad_s = self._angular[10:13, np.newaxis]
        """Time derivatives of `angles_rad`, from the body rates."""
        self.true_wind_nwu_m_s: np.ndarray[Any, np.dtype[np.float64]] | None = None
        """From DEBUG_VECT "WIND_TRUE": the oracle's. None until one came."""
        self.reset()

    def reset(self) -> None:
        """Forget everything: another vehicle, or the same after a restart."""
        self.stamp_us = -1
        self.restarted = False
        """The vehicle's clock went backwards by more than a second."""
        self._position_us = -1
        self._pairs = 0
        """Attitudes in a row that had a position of their own stamp; after two the next is waited for too."""
        self._offset_us = NO_OFFSET_US
        self._fresh = False
        self.true_wind_nwu_m_s = None

    @property
    def fresh(self) -> bool:
        """A new attitude since the last `take`, and a position and velocity that go with it.

        Where both streams are equally fast, an attitude whose position is still on its way is not fresh yet.
        """
        gap_us = self.stamp_us - self._position_us
        return self._fresh and self._position_us >= 0 and gap_us <= (0 if self._pairs >= 2 else self._max_age_us)

    def take(self) -> None:
        self._fresh = False

    def age_us(self, now_us: int) -> int | None:
        """How old the newest state is at `now_us` of the ground's clock, beyond the fastest transport; None before any.

        The clocks' offset is the least difference seen between coming and stamp: the transport's constant part is not
        in the age, a drift of the clocks is.
        """
        if self.stamp_us < 0:
            return None
        self._offset_us = min(self._offset_us, now_us - self.stamp_us)
        return now_us - self.stamp_us - self._offset_us

    def valid(self, now_us: int) -> bool:
        age = self.age_us(now_us)
        return age is not None and age <= self._max_age_us

    def receive(self, message: Any) -> None:
        """A message of the vehicle; others than the four below are ignored, as is one with a non-finite value."""
        kind = type(message).id
        if kind in self._ignored:
            return
        if kind == mavlink.MAVLINK_MSG_ID_ODOMETRY:
            self._on_odometry(message)
        elif kind == mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
            q = (message.q1, message.q2, message.q3, message.q4)
            rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
            if _is_attitude(q, rates):
                self._attitude(q, rates, message.time_boot_ms * 1000)
        elif kind == mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            position, velocity = (message.x, message.y, message.z), (message.vx, message.vy, message.vz)
            if isfinite(sum(position) + sum(velocity)):
                self._position(position, velocity, message.time_boot_ms * 1000)
        elif kind == mavlink.MAVLINK_MSG_ID_DEBUG_VECT and message.name == "WIND_TRUE":
            self.true_wind_nwu_m_s = np.array(flip_vector(message.x, message.y, message.z))[:, np.newaxis]

    def _on_odometry(self, message: Any) -> None:
        if message.frame_id != mavlink.MAV_FRAME_LOCAL_NED or message.child_frame_id not in FRAMES:
            return
        q = tuple(message.q)
        rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
        position, velocity = (message.x, message.y, message.z), (message.vx, message.vy, message.vz)
        # One message is one state: half of a bad one is not taken.
        if not (_is_attitude(q, rates) and isfinite(sum(position) + sum(velocity))):
            return
        if message.child_frame_id == mavlink.MAV_FRAME_BODY_FRD:
            velocity = rotate(normalise(q), velocity)
        self._attitude(q, rates, message.time_usec)
        self._position(position, velocity, message.time_usec)

    def _attitude(self, q: Any, rates: Any, stamp_us: int) -> None:
        if stamp_us < self.stamp_us:
            if self.stamp_us - stamp_us > 1_000_000:
                self.restarted = True
            return
        if stamp_us > self.stamp_us:
            self._pairs = self._pairs + 1 if 0 <= self.stamp_us == self._position_us else 0
        unit = normalise(flip_quaternion(*q))
        angles = to_euler(unit)
        omega = flip_vector(*rates)
        self._angular[:] = unit + angles + omega + euler_rates(angles, omega)
        self._fresh = self._fresh or stamp_us > self.stamp_us
        self.stamp_us = stamp_us

    def _position(self, position: Any, velocity: Any, stamp_us: int) -> None:
        if stamp_us < self._position_us:
            return
        self._linear[:] = flip_vector(*position) + flip_vector(*velocity)
        self._position_us = stamp_us


def _is_attitude(q: Any, rates: Any) -> bool:
    """Near unit length and finite."""
    w, x, y, z = q
    return abs(w * w + x * x + y * y + z * z - 1.0) <= 0.05 and isfinite(sum(rates))
