"""A vehicle's link as pymavlink's `mavutil` would have it, in simulated time: for code that takes such a connection."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Any

from mavsitl.dialect import mavlink
from mavsitl.testing.lockstep import SENDER, Message

if TYPE_CHECKING:
    from mavsitl.testing.lockstep import Vehicle

__all__ = ["Connection"]

FOREVER_S = 300.0
"""Of simulated time: a blocking call without a time-out ends there."""


class Connection:
    """What most programs use of `mavutil.mavlink_connection(...)`: `mav`, `recv_match`, `recv_msg`, `wait_heartbeat`.

    Waiting lets simulated time pass instead of real time. A call that does not block, and finds nothing, lets one
    control period pass, so that a loop of such calls comes to its end.

    Attributes:
        mav: pymavlink's own packer, with all its ``..._send`` methods.
        target_system, target_component: of the autopilot that was heard last; 0 before.
        messages: the newest message of each name.
    """

    def __init__(self, vehicle: Vehicle, port: str) -> None:
        self._vehicle = vehicle
        self._port = port
        self._read = len(vehicle._inbox)
        self.mav = mavlink.MAVLink(self, *SENDER)
        self.target_system = self.target_component = 0
        self.messages: dict[str, Message] = {}
        self._times: dict[str, float] = {}
        self._base_mode = 0

    def write(self, data: bytes) -> None:
        """What `mav` packed."""
        self._vehicle.send(bytes(data), port=self._port)

    def recv_msg(self) -> Message | None:
        """The next message that came; None: there is none."""
        message = self._next()
        if message is None:
            self._vehicle._tick()
        return message

    def recv_match(
        self,
        condition: Callable[[Message], bool] | None = None,
        type: str | Collection[str] | None = None,  # noqa: A002  mavutil's name
        blocking: bool = False,
        timeout: float | None = None,
    ) -> Message | None:
        """The next message of these names for which `condition` holds; None: there was none.

        `blocking`: wait for it, `timeout` seconds of simulated time. Without a `timeout` that is for ever, which ends
        here after `FOREVER_S` with a TimeoutError. mavutil's conditions are text; here they are functions.
        """
        if condition is not None and not callable(condition):
            raise TypeError("condition is a function of the message, not text")
        wanted = None if type is None else {type} if isinstance(type, str) else set(type)
        end_s = self._vehicle.time_s + (FOREVER_S if timeout is None else timeout)
        while True:
            message = self._next()
            if message is not None:
                suits = wanted is None or message.get_type() in wanted
                if suits and (condition is None or condition(message)):
                    return message
                continue
            self._vehicle._tick()
            if not blocking:
                return None
            if self._vehicle.time_s >= end_s:
                if timeout is None:
                    raise TimeoutError(f"no {type or 'message'} came within {FOREVER_S:g} s of simulated time")
                return None

    def wait_heartbeat(self, blocking: bool = True, timeout: float | None = None) -> Message | None:
        return self.recv_match(type="HEARTBEAT", blocking=blocking, timeout=timeout)

    def time_since(self, name: str) -> float:
        """Simulated seconds since a message of this name was read; since the start where there was none."""
        return self._vehicle.time_s - self._times.get(name, 0.0)

    def motors_armed(self) -> bool:
        return bool(self._base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def close(self) -> None:
        """Nothing: there is no socket."""

    def _next(self) -> Message | None:
        inbox = self._vehicle._inbox
        while self._read < len(inbox):
            arrived = inbox[self._read]
            self._read += 1
            if arrived.port == self._port:
                message = arrived.frame.message
                self._note(arrived.frame, message)
                return message
        return None

    def _note(self, frame: Any, message: Message) -> None:
        name = message.get_type()
        self.messages[name] = message
        self._times[name] = self._vehicle.time_s
        if name == "HEARTBEAT" and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID:
            self.target_system, self.target_component = frame.system_id, frame.component_id
            self._base_mode = message.base_mode
