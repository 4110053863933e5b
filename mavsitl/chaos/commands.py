"""Commands that go wrong: COMMAND_LONG and COMMAND_INT in, COMMAND_ACK out."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

from mavsitl.chaos.base import NOTHING, REMEMBERED, Every, Message, Mode, Peer, Repeats, altered, ids
from mavsitl.dialect import mavlink

COMMANDS = ids("COMMAND_LONG", "COMMAND_INT")
ACKS = ids("COMMAND_ACK")

ACCEPTED: int = mavlink.MAV_RESULT_ACCEPTED
TEMPORARILY_REJECTED: int = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
FAILED: int = mavlink.MAV_RESULT_FAILED
IN_PROGRESS: int = mavlink.MAV_RESULT_IN_PROGRESS

PROGRESS_S = 0.5
"""Between two COMMAND_ACKs that say IN_PROGRESS."""
PROGRESS_UNKNOWN = 255

REQUEST_MESSAGE: int = mavlink.MAV_CMD_REQUEST_MESSAGE
REQUESTS: dict[int, int] = {
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
    mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION: 300,
    mavlink.MAV_CMD_GET_HOME_POSITION: mavlink.MAVLINK_MSG_ID_HOME_POSITION,
    mavlink.MAV_CMD_REQUEST_FLIGHT_INFORMATION: mavlink.MAVLINK_MSG_ID_FLIGHT_INFORMATION,
}
"""Commands older than REQUEST_MESSAGE that ask for one message each."""


def _ack(command: int, result: int, target: Peer, progress: int = 0) -> Message:
    return mavlink.MAVLink_command_ack_message(command, result, progress, 0, *target)


def _asker(ack: Message) -> Peer:
    return ack.target_system, ack.target_component


class CommandMode(Mode):
    """Of one command, or of all."""

    def __init__(self, command: int | None) -> None:
        self._command = command

    def meant(self, message: Message) -> bool:
        return self._command is None or message.command == self._command


class AckLost(CommandMode):
    gives = ACKS

    def outgoing(self, message: Message) -> Sequence[Message]:
        return NOTHING if self.meant(message) else (message,)


class AckFirstLost(CommandMode):
    gives = ACKS

    def __init__(self, times: int, command: int | None) -> None:
        super().__init__(command)
        self._repeats = Repeats(times)

    def outgoing(self, message: Message) -> Sequence[Message]:
        if self.meant(message) and self._repeats.fails((message.command, _asker(message))):
            return NOTHING
        return (message,)


class AckLate(CommandMode):
    gives = ACKS

    def __init__(self, seconds: float, command: int | None) -> None:
        super().__init__(command)
        self._seconds = seconds

    def outgoing(self, message: Message) -> Sequence[Message]:
        if not self.meant(message):
            return (message,)
        self.line.send(message, self._seconds)
        return NOTHING


class AckDoubled(CommandMode):
    gives = ACKS

    def outgoing(self, message: Message) -> Sequence[Message]:
        return (message, message) if self.meant(message) else (message,)


class AckAltered(CommandMode):
    gives = ACKS

    def __init__(self, fields: Callable[[Message], dict[str, Any]], command: int | None) -> None:
        super().__init__(command)
        self._fields = fields

    def outgoing(self, message: Message) -> Sequence[Message]:
        return (altered(message, **self._fields(message)),) if self.meant(message) else (message,)


def another_command(ack: Message) -> dict[str, Any]:
    return {"command": (ack.command + 1) & 0xFFFF}


def another_target(ack: Message) -> dict[str, Any]:
    """A system id that nobody asked with: the next one, which is neither 0 nor the asker's."""
    return {"target_system": ack.target_system % 255 + 1}


def no_target(ack: Message) -> dict[str, Any]:
    return {"target_system": 0, "target_component": 0}


class AckUnasked(Mode):
    """For a command of nobody's, to everybody."""

    def __init__(self, command: int, seconds: float) -> None:
        self._command = command
        self._every = Every(seconds)

    def step(self) -> None:
        if self._every.due(self.line.now_us):
            self.line.send(_ack(self._command, ACCEPTED, (0, 0)))


class CommandLost(CommandMode):
    takes = COMMANDS

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        return None if self.meant(message) else message


class CommandFirstLost(CommandMode):
    takes = COMMANDS

    def __init__(self, times: int, command: int | None) -> None:
        super().__init__(command)
        self._repeats = Repeats(times)

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        return None if self.meant(message) and self._repeats.fails((message.command, sender)) else message


class Answered(CommandMode):
    """Not done, and answered with `result`: the first `times` of each command, or always (0)."""

    takes = COMMANDS

    def __init__(self, result: int, times: int, command: int | None) -> None:
        super().__init__(command)
        self._result = result
        self._repeats = Repeats(times) if times else None

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        if not self.meant(message):
            return message
        if self._repeats is not None and not self._repeats.fails((message.command, sender)):
            return message
        self.line.send(_ack(message.command, self._result, sender))
        return None


class ProgressForEver(CommandMode):
    """Not done; IN_PROGRESS for as long as the mode lasts."""

    takes = COMMANDS

    def __init__(self, command: int | None) -> None:
        super().__init__(command)
        self._running: OrderedDict[tuple[int, Peer], tuple[int, Every]] = OrderedDict()
        """By command and asker: IN_PROGRESS said so often, and when again."""

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        if not self.meant(message):
            return message
        key = (int(message.command), sender)
        if key not in self._running:
            if len(self._running) >= REMEMBERED:
                self._running.popitem(last=False)
            self._running[key] = (0, Every(PROGRESS_S))
            self._say()
        return None

    def step(self) -> None:
        self._say()

    def _say(self) -> None:
        for key, (count, every) in self._running.items():
            if every.due(self.line.now_us):
                command, asker = key
                self.line.send(_ack(command, IN_PROGRESS, asker, min(count, 99)))
                self._running[key] = (count + 1, every)


class ProgressStuck(CommandMode):
    """Not done; IN_PROGRESS once, and nothing more."""

    takes = COMMANDS

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        if not self.meant(message):
            return message
        self.line.send(_ack(message.command, IN_PROGRESS, sender, PROGRESS_UNKNOWN))
        return None


def _progress(mode: Mode, command: int, asker: Peer, seconds: float) -> None:
    for n in range(max(int(seconds / PROGRESS_S), 1)):
        mode.line.send(_ack(command, IN_PROGRESS, asker, min(int(100 * n * PROGRESS_S / seconds), 99)), n * PROGRESS_S)


class ProgressThenResult(AckLate):
    """IN_PROGRESS for `seconds`, then the vehicle's own answer."""

    def outgoing(self, message: Message) -> Sequence[Message]:
        if self.meant(message):
            _progress(self, message.command, _asker(message), self._seconds)
        return super().outgoing(message)


class ProgressThenFailed(CommandMode):
    """Not done; IN_PROGRESS for `seconds`, then FAILED."""

    takes = COMMANDS

    def __init__(self, seconds: float, command: int | None) -> None:
        super().__init__(command)
        self._seconds = seconds

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        if not self.meant(message):
            return message
        _progress(self, message.command, sender, self._seconds)
        self.line.send(_ack(message.command, FAILED, sender), self._seconds)
        return None


class NotDone(Mode):
    """These commands are accepted and not done; SET_MODE, which has no answer, is not done either where it is named."""

    def __init__(self, *commands: int, set_mode: bool = False) -> None:
        self._commands = frozenset(commands)
        self.takes = COMMANDS | ids("SET_MODE") if set_mode else COMMANDS

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        if type(message).id not in COMMANDS:
            return None
        if message.command not in self._commands:
            return message
        self.line.send(_ack(message.command, ACCEPTED, sender))
        return None


class RequestAnswered(Mode):
    """A message that is asked for is not sent; the command is answered with `result`, or not at all (None)."""

    takes = COMMANDS

    def __init__(self, result: int | None, message_id: int | None) -> None:
        self._result = result
        self._message_id = message_id

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        wanted = message.param1 if message.command == REQUEST_MESSAGE else REQUESTS.get(message.command)
        if wanted is None or self._message_id not in (None, wanted):
            return message
        if self._result is not None:
            self.line.send(_ack(message.command, self._result, sender))
        return None


class UserCommands(Mode):
    """MAV_CMD_USER_1 to USER_5 and the four numbers behind them, for tests of a client's sender of commands."""

    takes = COMMANDS

    def __init__(self) -> None:
        user = mavlink.MAV_CMD_USER_1
        self._behaviours: dict[int, Mode] = {
            user: Answered(ACCEPTED, 0, None),
            user + 1: Answered(FAILED, 0, None),
            user + 2: Answered(ACCEPTED, 0, None),
            user + 3: Answered(FAILED, 0, None),
            user + 4: CommandLost(None),
            user + 5: CommandLost(None),
            user + 6: ProgressThenAccepted(),
            user + 7: ProgressThenFailed(2.0 * PROGRESS_S, None),
            user + 8: ProgressStuck(None),
        }
        self._repeats = Repeats()
        self._second = (user + 2, user + 3)

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        behaviour = self._behaviours.get(message.command)
        if behaviour is None:
            return message
        if message.command in self._second and self._repeats.fails((message.command, sender)):
            return None
        behaviour.line = self.line
        return behaviour.incoming(message, sender)


class ProgressThenAccepted(Mode):
    """Not done; IN_PROGRESS, and a little later ACCEPTED."""

    takes = COMMANDS

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        _progress(self, message.command, sender, 2.0 * PROGRESS_S)
        self.line.send(_ack(message.command, ACCEPTED, sender), 2.0 * PROGRESS_S)
        return None
