"""The command protocol: COMMAND_LONG and COMMAND_INT in, one final COMMAND_ACK out; and the asker, with retries."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from math import isfinite
from typing import Any, NamedTuple

from mavsitl.dialect import mavlink


class Command(NamedTuple):
    """A command, whichever message brought it.

    Parameters are as sent: NaN means 'default'; 5 and 6 of COMMAND_INT stay integers.
    """

    id: int
    params: tuple[float, float, float, float, float, float, float]
    frame: int | None
    """MAV_FRAME of a COMMAND_INT; None for COMMAND_LONG."""
    system_id: int
    component_id: int
    """Who asked."""

    def integer(self, index: int) -> int | None:
        """Parameter `index` (1-based) as an integer; None where it is not a whole finite number."""
        value = self.params[index - 1]
        return int(value) if isfinite(value) and value == int(value) else None


class CommandServer:
    """Answers each command once: a repeat (`confirmation` > 0) gets the first answer again and is not executed twice.

    An answer is forgotten `MEMORY_US` after it was last asked for. A repeat that comes later is of a new command, whose
    first frame was lost.
    """

    REMEMBERED = 32
    MEMORY_US = 3_000_000
    """Clients repeat after 0.5 s (MAVSDK) to 1.2 s (QGroundControl)."""

    def __init__(self, execute: Callable[[Command, int], int]) -> None:
        """`execute(command, now_us)` does it and returns the MAV_RESULT."""
        self._execute = execute
        self._answers: OrderedDict[tuple[int, int, int, str], tuple[int, int]] = OrderedDict()
        """(MAV_RESULT, time us of the last frame)"""

    def receive(self, message: Any, system_id: int, component_id: int, now_us: int) -> tuple[int, int]:
        """A COMMAND_LONG or COMMAND_INT that is addressed to us: its id and the MAV_RESULT to acknowledge."""
        if type(message).id == mavlink.MAVLINK_MSG_ID_COMMAND_LONG:
            last, frame, confirmation = (message.param5, message.param6, message.param7), None, message.confirmation
        else:
            last, frame, confirmation = (message.x, message.y, message.z), message.frame, 0
        params = (message.param1, message.param2, message.param3, message.param4, *last)
        command = Command(message.command, params, frame, system_id, component_id)
        key = (command.id, system_id, component_id, repr(params))
        known = self._answers.get(key)
        if confirmation > 0 and known is not None and now_us - known[1] < self.MEMORY_US:
            result = known[0]
        else:
            result = self._execute(command, now_us)
        self._answers[key] = (result, now_us)
        self._answers.move_to_end(key)
        if len(self._answers) > self.REMEMBERED:
            self._answers.popitem(last=False)
        return command.id, result


class Pending(NamedTuple):
    command: int
    params: tuple[float, ...]


class CommandClient:
    """Sends one command at a time, repeats it until its COMMAND_ACK or the last try. Step it with the time."""

    def __init__(
        self, send: Callable[[int, int, tuple[float, ...]], None], timeout_us: int = 500_000, tries: int = 5
    ) -> None:
        """`send(command, confirmation, params)` puts a COMMAND_LONG on the wire."""
        self._send = send
        self._timeout_us = timeout_us
        self._tries = tries
        self._pending: Pending | None = None
        self._sent = 0
        self._due_us = 0
        self.result: int | None = None
        """MAV_RESULT of the last command; None while it is open or where no answer came."""

    @property
    def busy(self) -> bool:
        return self._pending is not None

    def start(self, command: int, *params: float) -> None:
        """Begin; the seven parameters are filled up with NaN."""
        filled = (*params, *([float("nan")] * (7 - len(params))))
        self._pending = Pending(command, filled)
        self._sent, self._due_us, self.result = 0, 0, None

    def cancel(self) -> None:
        self._pending = None

    def step(self, now_us: int) -> None:
        if self._pending is None or now_us < self._due_us:
            return
        if self._sent >= self._tries:
            self._pending = None
            return
        self._send(self._pending.command, self._sent, self._pending.params)
        self._sent += 1
        self._due_us = now_us + self._timeout_us

    def receive(self, ack: Any) -> None:
        """A COMMAND_ACK from the vehicle."""
        if (
            self._pending is None
            or ack.command != self._pending.command
            or ack.result == mavlink.MAV_RESULT_IN_PROGRESS
        ):
            return
        self.result = ack.result
        self._pending = None
