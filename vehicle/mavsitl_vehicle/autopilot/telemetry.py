"""Telemetry: one table of streams, and a schedule per link. Wire units and NED/FRD signs are made here."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from mavsitl import __version__
from mavsitl.codec import packer
from mavsitl.dialect import mavlink
from mavsitl.frames import flip_quaternion, flip_vector
from mavsitl.node import Node
from mavsitl.quaternion import to_euler
from mavsitl_vehicle.autopilot import modes

if TYPE_CHECKING:
    from mavsitl_vehicle.autopilot.autopilot import Autopilot

Sampler = Callable[["Autopilot", Node, int], None]

HZ = 1_000_000
NEVER = 0

HEARTBEAT = packer(mavlink.MAVLink_heartbeat_message)
SYS_STATUS = packer(mavlink.MAVLink_sys_status_message)
EXTENDED_SYS_STATE = packer(mavlink.MAVLink_extended_sys_state_message)
ATTITUDE = packer(mavlink.MAVLink_attitude_message)
ATTITUDE_QUATERNION = packer(mavlink.MAVLink_attitude_quaternion_message)
LOCAL_POSITION_NED = packer(mavlink.MAVLink_local_position_ned_message)
ODOMETRY = packer(mavlink.MAVLink_odometry_message)
DEBUG_VECT = packer(mavlink.MAVLink_debug_vect_message)
AUTOPILOT_VERSION = packer(mavlink.MAVLink_autopilot_version_message)
COMMAND_ACK = packer(mavlink.MAVLink_command_ack_message)
STATUSTEXT = packer(mavlink.MAVLink_statustext_message)
MESSAGE_INTERVAL = packer(mavlink.MAVLink_message_interval_message)

_SENSORS = (
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink.MAV_SYS_STATUS_SENSOR_ANGULAR_RATE_CONTROL
    | mavlink.MAV_SYS_STATUS_SENSOR_ATTITUDE_STABILIZATION
    | mavlink.MAV_SYS_STATUS_SENSOR_Z_ALTITUDE_CONTROL
    | mavlink.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL
    | mavlink.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
    | mavlink.MAV_SYS_STATUS_AHRS
)

CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)
"""What is served, and nothing more: clients act on these bits."""

TEXT_BYTES = 50
"""STATUSTEXT.text; longer texts go in chunks."""
MAX_INTERVAL_US = 2**31 - 1
"""The longest that MESSAGE_INTERVAL can report."""

_NO_COVARIANCE = [float("nan")] + [0.0] * 20
_NAN = float("nan")


def _flight_sw_version() -> int:
    """PX4 1.17.0 release: the version whose behaviour this vehicle shows, because clients gate on PX4's numbers."""
    return 1 << 24 | 17 << 16 | 0 << 8 | 255


def send_heartbeat(autopilot: Autopilot, node: Node, now_us: int) -> None:
    commander = autopilot.commander
    base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | modes.TABLE[commander.mode].base_mode
    if commander.armed:
        base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        state = mavlink.MAV_STATE_CRITICAL if commander.failsafe else mavlink.MAV_STATE_ACTIVE
    else:
        state = mavlink.MAV_STATE_STANDBY
    node.send(
        HEARTBEAT,
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, base, modes.custom_mode(commander.mode), state, 3,
    )  # fmt: skip


def send_sys_status(autopilot: Autopilot, node: Node, now_us: int) -> None:
    ready = mavlink.MAV_SYS_STATUS_PREARM_CHECK if autopilot.commander.arming_refusal() is None else 0
    enabled = _SENSORS | mavlink.MAV_SYS_STATUS_PREARM_CHECK
    node.send(SYS_STATUS, enabled, enabled, _SENSORS | ready, 0, 65535, -1, -1, 0, 0, 0, 0, 0, 0, 0, 0, 0)


def send_extended_sys_state(autopilot: Autopilot, node: Node, now_us: int) -> None:
    node.send(EXTENDED_SYS_STATE, mavlink.MAV_VTOL_STATE_UNDEFINED, autopilot.landed_state)


def send_attitude(autopilot: Autopilot, node: Node, now_us: int) -> None:
    e = autopilot.estimate
    roll, pitch, yaw = to_euler(flip_quaternion(e[6], e[7], e[8], e[9]))
    node.send(ATTITUDE, now_us // 1000, roll, pitch, yaw, *flip_vector(e[10], e[11], e[12]))


def send_attitude_quaternion(autopilot: Autopilot, node: Node, now_us: int) -> None:
    e = autopilot.estimate
    q = flip_quaternion(e[6], e[7], e[8], e[9])
    node.send(ATTITUDE_QUATERNION, now_us // 1000, *q, *flip_vector(e[10], e[11], e[12]), (0.0, 0.0, 0.0, 0.0))


def send_local_position(autopilot: Autopilot, node: Node, now_us: int) -> None:
    e = autopilot.estimate
    node.send(LOCAL_POSITION_NED, now_us // 1000, *flip_vector(e[0], e[1], e[2]), *flip_vector(e[3], e[4], e[5]))


def send_odometry(autopilot: Autopilot, node: Node, now_us: int) -> None:
    """PX4's frames: pose in LOCAL_NED, velocity in LOCAL_NED (child_frame_id), body rates in FRD; no covariance."""
    e = autopilot.estimate
    node.send(
        ODOMETRY,
        now_us,
        mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_LOCAL_NED,
        *flip_vector(e[0], e[1], e[2]),
        flip_quaternion(e[6], e[7], e[8], e[9]),
        *flip_vector(e[3], e[4], e[5]),
        *flip_vector(e[10], e[11], e[12]),
        _NO_COVARIANCE,
        _NO_COVARIANCE,
        0,
        mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        100,
    )  # fmt: skip


def send_true_wind(autopilot: Autopilot, node: Node, now_us: int) -> None:
    """DEBUG_VECT "WIND_TRUE": the simulator's own wind, NED m/s. No real vehicle has it; sent only on request."""
    node.send(DEBUG_VECT, b"WIND_TRUE", now_us, *flip_vector(*autopilot.true_wind))


def send_autopilot_version(autopilot: Autopilot, node: Node, now_us: int) -> None:
    major, minor, patch = (int(part) for part in __version__.split(".")[:3])
    middleware = major << 24 | minor << 16 | patch << 8 | 255
    uid = 0x6D61_7673_6974_6C00 | autopilot.system_id
    node.send(
        AUTOPILOT_VERSION,
        CAPABILITIES, _flight_sw_version(), middleware, 0, 0,
        list(b"mavsitl\0"), [0] * 8, [0] * 8, 0, 0, uid, list(uid.to_bytes(8, "big")) + [0] * 10,
    )  # fmt: skip


def send_text(node: Node, severity: int, text: str, text_id: int) -> None:
    """STATUSTEXT; a long one in chunks under `text_id` (1 to 65535), of which the last is the one that is not full."""
    data = text.encode("ascii", "replace")
    if len(data) <= TEXT_BYTES:
        node.send(STATUSTEXT, severity, data, 0, 0)
        return
    for chunk, begin in enumerate(range(0, len(data) + 1, TEXT_BYTES)):
        node.send(STATUSTEXT, severity, data[begin : begin + TEXT_BYTES], text_id, chunk)


class Stream(NamedTuple):
    message_id: int
    send: Sampler
    gcs_hz: float
    """Default rate on the ground-station link; 0: only on request."""
    offboard_hz: float


STREAMS: tuple[Stream, ...] = (
    Stream(mavlink.MAVLINK_MSG_ID_HEARTBEAT, send_heartbeat, 1, 1),
    Stream(mavlink.MAVLINK_MSG_ID_SYS_STATUS, send_sys_status, 1, 5),
    Stream(mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, send_extended_sys_state, 1, 5),
    Stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, send_attitude, 10, 50),
    Stream(mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, send_attitude_quaternion, 10, 50),
    Stream(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, send_local_position, 10, 30),
    Stream(mavlink.MAVLINK_MSG_ID_ODOMETRY, send_odometry, NEVER, 30),
    Stream(mavlink.MAVLINK_MSG_ID_DEBUG_VECT, send_true_wind, NEVER, NEVER),
    Stream(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, send_autopilot_version, NEVER, NEVER),
)
BY_ID = {stream.message_id: stream for stream in STREAMS}


class Schedule:
    """When each stream of one link is due. Intervals in microseconds; 0 is off."""

    def __init__(self, offboard: bool) -> None:
        self._offboard = offboard
        self._due: dict[int, int] = {}
        self._interval = {stream.message_id: self.default_us(stream.message_id) for stream in STREAMS}
        self._active = self._list_active()
        self._next_us = 0

    def default_us(self, message_id: int) -> int:
        stream = BY_ID[message_id]
        hz = stream.offboard_hz if self._offboard else stream.gcs_hz
        return round(HZ / hz) if hz else NEVER

    def interval_us(self, message_id: int) -> int:
        return self._interval[message_id]

    def set_interval(self, message_id: int, interval_us: int, now_us: int) -> None:
        self._interval[message_id] = interval_us
        self._due[message_id] = now_us
        self._active = self._list_active()
        self._next_us = 0

    def run(self, autopilot: Autopilot, node: Node, now_us: int) -> None:
        """Send what is due. A stream that fell behind sends once and starts over from now, never a burst."""
        if now_us < self._next_us:
            return
        nearest = now_us + HZ
        due_of = self._due
        for message_id, send, interval in self._active:
            due = due_of.get(message_id, 0)
            if now_us >= due:
                send(autopilot, node, now_us)
                due += interval
                if due <= now_us:
                    due = now_us + interval
                due_of[message_id] = due
            if due < nearest:
                nearest = due
        self._next_us = nearest

    def _list_active(self) -> list[tuple[int, Sampler, int]]:
        """Message id, sampler and interval of the streams that are on, in the table's order."""
        interval = self._interval
        return [(s.message_id, s.send, interval[s.message_id]) for s in STREAMS if interval[s.message_id] != NEVER]
