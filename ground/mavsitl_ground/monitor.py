"""The ground's end of the monitor link (`mavsitl.monitor`): what only the ground knows, and CTRL_LAW.

It reads what the controller has, twenty times a second; a control period knows nothing of it. Sans-IO.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol
from zlib import crc32

from mavsitl import monitor
from mavsitl.codec import packer, parse
from mavsitl.dialect import mavlink
from mavsitl.frames import Vector, flip_euler, flip_vector
from mavsitl.monitor import CONTROL_LAW, LAWS, NO_LAW, Array
from mavsitl.node import Node
from mavsitl.quaternion import from_euler
from mavsitl.services.parameter import ParameterServer, Refused
from mavsitl_ground.laws import Law

__all__ = ["LawParameter", "Monitor", "Monitors", "Subject"]

HEARTBEAT_US = 1_000_000

_HEARTBEAT = packer(mavlink.MAVLink_heartbeat_message)
_REFERENCE = packer(mavlink.MAVLink_position_target_local_ned_message)
_ATTITUDE = packer(mavlink.MAVLink_attitude_target_message)
_ARRAY = packer(mavlink.MAVLink_debug_float_array_message)
_ARRAY_LENGTH = 58

_NO_ACCELERATION = (
    mavlink.POSITION_TARGET_TYPEMASK_AX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
)
_NO_RATES = (
    mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE
    | mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
    | mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE
)


class Subject(Protocol):
    """What is told of a ground. World NWU, body FLU."""

    @property
    def vehicle_system_id(self) -> int | None:
        """Of the vehicle that it flies; None: it looks for one."""

    @property
    def phase_number(self) -> int:
        """See `mavsitl.monitor.PHASES`."""

    @property
    def vehicle_time_us(self) -> int: ...
    @property
    def in_control(self) -> bool: ...
    @property
    def reference_nwu(self) -> tuple[Vector, Vector, float]:
        """Position m, velocity m/s, yaw rad."""

    @property
    def desired_rad(self) -> Vector:
        """phi_d, theta_d, psi_d."""

    @property
    def control(self) -> tuple[float, Vector]:
        """U_1 in N and W_1..W_3 in m/s^2."""

    @property
    def weights(self) -> tuple[Sequence[float], Sequence[float]] | None:
        """(9,) the nets' output weights, net after net, and what they start from; None: no nets here."""

    def link(self, now_us: int) -> tuple[int, int, int, int]:
        """Frames received, lost, rejected, and the age of the state in us."""

    @property
    def law(self) -> Law | None:
        """Of the attitude; None: it is controlled elsewhere."""

    def fly_by(self, law: Law) -> None: ...


class LawParameter:
    """The table of one parameter, CTRL_LAW, for `ParameterServer`."""

    names = (CONTROL_LAW,)

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        self._listeners: list[Callable[[str, float], None]] = []

    def __getitem__(self, name: str) -> float:
        law = self._subject.law
        return NO_LAW if law is None else LAWS[law]

    def index(self, name: str) -> int | None:
        return 0 if name == CONTROL_LAW else None

    def is_integer(self, name: str) -> bool:
        return True

    def set(self, name: str, value: float) -> Refused | None:
        if self._subject.law is None:
            return Refused(mavlink.MAV_PARAM_ERROR_READ_ONLY, f"{name}: the attitude is not controlled by these laws")
        wanted = next((law for law, number in LAWS.items() if number == value), None)
        if wanted is None:
            allowed = ", ".join(f"{number} ({law})" for law, number in LAWS.items())
            return Refused(mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE, f"{name}: {value:g} is none of {allowed}")
        self._subject.fly_by(wanted)
        for listener in self._listeners:
            listener(name, value)
        return None

    def hash(self) -> int:
        return crc32(f"{CONTROL_LAW}{self[CONTROL_LAW]:g}".encode())

    def subscribe(self, listener: Callable[[str, float], None], /) -> Callable[[], None]:
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)


class Monitor:
    """Tells of one ground. Silent as long as it has no vehicle."""

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        self._parameters = ParameterServer(LawParameter(subject))
        self._node: Node | None = None
        self._due_us = self._heartbeat_us = 0
        self._now_us = 0

    def receive(self, datagram: bytes) -> int:
        """One datagram of a listener; the number of valid frames in it."""
        node = self._node
        if node is None:
            return len(parse(datagram))
        frames = node.receive(datagram)
        for frame in frames:
            if node.addressed_to(frame):
                for answer in self._parameters.receive(
                    frame.message, (frame.system_id, frame.component_id), self._now_us
                ):
                    node.send_message(answer)
        return len(frames)

    def step(self, now_us: int) -> None:
        """Queue what is due."""
        self._now_us = now_us
        number = self._subject.vehicle_system_id
        if number is None:
            self._node = None
            return
        if self._node is None or self._node.system_id != number:
            self._node = Node(number, monitor.COMPONENT_ID)
            self._due_us = self._heartbeat_us = now_us
        if now_us < self._due_us:
            return
        self._due_us = max(self._due_us + monitor.INTERVAL_US, now_us + monitor.INTERVAL_US // 2)
        self._tell(self._node, now_us)
        for message in self._parameters.step(now_us):
            self._node.send_message(message)

    def _tell(self, node: Node, now_us: int) -> None:
        subject = self._subject
        if now_us >= self._heartbeat_us:
            self._heartbeat_us = now_us + HEARTBEAT_US
            node.send(
                _HEARTBEAT, mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID,
                mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, subject.phase_number, mavlink.MAV_STATE_ACTIVE, 3,
            )  # fmt: skip
        stamp_us = subject.vehicle_time_us
        if stamp_us < 0:
            return
        boot_ms = stamp_us // 1000 % 2**32
        received, lost, rejected, age_us = subject.link(now_us)
        self._send(node, stamp_us, monitor.LINK, (received, lost, rejected, age_us * 1e-3))
        if not subject.in_control:
            return
        position, velocity, yaw_rad = subject.reference_nwu
        node.send(
            _REFERENCE, boot_ms, mavlink.MAV_FRAME_LOCAL_NED, _NO_ACCELERATION,
            *flip_vector(*position), *flip_vector(*velocity), 0.0, 0.0, 0.0, -yaw_rad, 0.0,
        )  # fmt: skip
        u1_n, wind = subject.control
        attitude = from_euler(*flip_euler(*subject.desired_rad))
        node.send(_ATTITUDE, boot_ms, _NO_RATES, attitude, 0.0, 0.0, 0.0, 0.0)
        self._send(node, stamp_us, monitor.CONTROL, (u1_n, *flip_vector(*wind)))
        weights = subject.weights
        if weights is not None:
            self._send(node, stamp_us, monitor.WEIGHTS, (*weights[0], *weights[1]))

    @staticmethod
    def _send(node: Node, stamp_us: int, array: Array, numbers: Sequence[float]) -> None:
        node.send(_ARRAY, stamp_us, array.name.encode(), array.id, [*numbers, *[0.0] * (_ARRAY_LENGTH - len(numbers))])

    def datagrams(self) -> list[bytes]:
        return [] if self._node is None else self._node.datagrams(combine=True)


class Monitors:
    """Those of many grounds behind one link. What comes is read by all: it is a question now and then."""

    def __init__(self, monitors: Sequence[Monitor]) -> None:
        self._monitors = monitors

    def receive(self, datagram: bytes) -> int:
        return max(each.receive(datagram) for each in self._monitors)

    def step(self, now_us: int) -> None:
        for each in self._monitors:
            each.step(now_us)

    def datagrams(self) -> list[bytes]:
        return [datagram for each in self._monitors for datagram in each.datagrams()]
