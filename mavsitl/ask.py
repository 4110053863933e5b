"""One question or wish to a vehicle that runs, without I/O: what `mavsitl param`, `link` and `inject` do.

`Ask` finds the vehicle by its HEARTBEAT, speaks as a companion computer would, and ends with a `Reply`. It is no ground
station for the vehicle, so that nothing is lost to it when the command ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeAlias

import msgspec

from mavsitl.codec import Message
from mavsitl.dialect import mavlink
from mavsitl.node import Node
from mavsitl.services.base import Peer
from mavsitl.services.command import CommandClient
from mavsitl.services.parameter import (
    HASH_CHECK,
    TYPE_MISMATCH,
    TYPE_UNSUPPORTED,
    ParameterClient,
    Request,
)
from mavsitl.services.statustext import Joiner

__all__ = [
    "Ask", "CommandTask", "ListTask", "ParameterTask", "Reply", "Task", "enum_name", "failure_kinds", "failure_units",
]  # fmt: skip

SYSTEM_ID, COMPONENT_ID = 252, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
"""Its own address, on a system id that none of the known clients takes."""

HEARTBEAT_US = 1_000_000
REPEAT_US = 400_000
"""A question without an answer is asked again after so long."""
TEXTS_US = 500_000
"""STATUSTEXTs are waited for so long after an answer that they may explain."""
MAX_TEXTS = 20

_HEARTBEAT = mavlink.MAVLink_heartbeat_message(
    mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
)


class Reply(msgspec.Struct, frozen=True, kw_only=True):
    """What came of it."""

    ok: bool
    vehicle: int | None
    """its system id; None where none was found"""
    parameters: dict[str, float]
    """what the vehicle says that they are, of those that it was asked for"""
    result: str
    """MAV_RESULT of a command, or empty"""
    texts: tuple[str, ...]
    """STATUSTEXTs that came meanwhile"""
    problem: str
    """who did not do what, and why; empty where all is done"""


class Task(Protocol):
    """What is done once the vehicle is known."""

    @property
    def done(self) -> bool: ...
    @property
    def explained(self) -> bool:
        """Whether the answer is complete without a STATUSTEXT."""

    def begin(self, target: Peer, patience_us: int) -> None: ...
    def receive(self, message: Message, sender: Peer, now_us: int) -> None: ...
    def step(self, now_us: int) -> Sequence[Message]: ...
    def parameters(self) -> dict[str, float]: ...
    def result(self) -> str: ...
    def problem(self) -> str:
        """Follows on "vehicle 1 "; empty where all is done."""


Wish: TypeAlias = tuple[str, float | None]
"""(parameter, value; None: it is only read)"""


class ParameterTask:
    """Parameters read and set one after the other; the first that is refused ends it."""

    def __init__(self, wishes: Sequence[Wish]) -> None:
        """Raises ValueError for a name that is none."""
        self._wishes = tuple(wishes)
        for name, _ in self._wishes:
            ParameterClient((1, 1)).read(name)
        self._requests: list[Request] = []
        self._client: ParameterClient | None = None

    def begin(self, target: Peer, patience_us: int) -> None:
        client = self._client = ParameterClient(target, REPEAT_US, max(1, patience_us // REPEAT_US))
        for name, value in self._wishes:
            self._requests.append(client.read(name) if value is None else client.set(name, value))

    @property
    def _failed(self) -> Request | None:
        return next((each for each in self._requests if each.outcome in ("refused", "silent")), None)

    @property
    def done(self) -> bool:
        return self._failed is not None or all(each.outcome == "done" for each in self._requests)

    @property
    def explained(self) -> bool:
        failed = self._failed
        return failed is None or failed.outcome == "silent"

    def receive(self, message: Message, sender: Peer, now_us: int) -> None:
        if self._client is not None:
            self._client.receive(message, sender, now_us)

    def step(self, now_us: int) -> Sequence[Message]:
        return () if self._client is None or self.done else self._client.step(now_us)

    def parameters(self) -> dict[str, float]:
        return {each.name: each.value for each in self._requests if each.value is not None}

    def result(self) -> str:
        return ""

    def problem(self) -> str:
        failed = self._failed
        if failed is None:
            return ""
        if failed.error == mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST:
            return f"has no parameter {failed.name}"
        if failed.outcome == "silent":
            return f"does not answer for {failed.name}: it has no such parameter, or the link is cut"
        held = "" if failed.value is None else f"; it says {failed.value:g}"
        if failed.error is None:
            return f"does not confirm {failed.name} = {failed.wanted:g}{held}"
        why = _ERRORS.get(failed.error) or enum_name("MAV_PARAM_ERROR", failed.error)
        return f"refuses {failed.name} = {failed.wanted:g} ({why}){held}"


_ERRORS = {TYPE_UNSUPPORTED: "TYPE_UNSUPPORTED", TYPE_MISMATCH: "TYPE_MISMATCH"}
"""Those of MAV_PARAM_ERROR that pymavlink does not have."""


class ListTask:
    """All parameters."""

    def __init__(self) -> None:
        self._client: ParameterClient | None = None

    def begin(self, target: Peer, patience_us: int) -> None:
        self._client = ParameterClient(target, REPEAT_US, max(1, patience_us // REPEAT_US))
        self._client.request_list()

    @property
    def done(self) -> bool:
        return self._client is not None and self._client.list_state in ("complete", "failed")

    @property
    def explained(self) -> bool:
        return True

    def receive(self, message: Message, sender: Peer, now_us: int) -> None:
        if self._client is not None:
            self._client.receive(message, sender, now_us)

    def step(self, now_us: int) -> Sequence[Message]:
        return () if self._client is None else self._client.step(now_us)

    def parameters(self) -> dict[str, float]:
        values = {} if self._client is None else self._client.values
        return {name: values[name] for name in sorted(values) if name != HASH_CHECK}

    def result(self) -> str:
        return ""

    def problem(self) -> str:
        client = self._client
        if client is None or client.list_state == "complete":
            return ""
        known = f"{len(client.values)} of {client.count}" if client.count is not None else "none"
        return f"did not send all its parameters: {known} came"


class CommandTask:
    """A command, acknowledged or not."""

    def __init__(self, command: int, *params: float) -> None:
        self._command, self._params = command, params
        self._client: CommandClient | None = None
        self._target: Peer = (0, 0)
        self._out: list[Message] = []

    def begin(self, target: Peer, patience_us: int) -> None:
        self._target = target
        self._client = CommandClient(self._send, REPEAT_US, max(1, patience_us // REPEAT_US))
        self._client.start(self._command, *self._params)

    def _send(self, command: int, confirmation: int, params: tuple[float, ...]) -> None:
        self._out.append(mavlink.MAVLink_command_long_message(*self._target, command, confirmation, *params))

    @property
    def done(self) -> bool:
        return self._client is not None and not self._client.busy

    @property
    def explained(self) -> bool:
        return self._client is None or self._client.result is None

    def receive(self, message: Message, sender: Peer, now_us: int) -> None:
        if self._client is not None and sender == self._target and _is_ack_for_us(message):
            self._client.receive(message)

    def step(self, now_us: int) -> Sequence[Message]:
        if self._client is None:
            return ()
        self._client.step(now_us)
        out, self._out = self._out, []
        return out

    def parameters(self) -> dict[str, float]:
        return {}

    def result(self) -> str:
        known = None if self._client is None else self._client.result
        return "" if known is None else enum_name("MAV_RESULT", known)

    def problem(self) -> str:
        if self._client is None or self._client.result == mavlink.MAV_RESULT_ACCEPTED:
            return ""
        name = enum_name("MAV_CMD", self._command)
        return f"answers {name} with {self.result()}" if self.result() else f"does not acknowledge {name}"


class Ask:
    """Sans-IO. `receive` what comes, `step` with the time, send `datagrams`, until it is `done`; then `reply`."""

    def __init__(self, task: Task, *, system_id: int | None = None, patience_us: int = 5_000_000) -> None:
        """`system_id`: only that vehicle; None: the first heard. `patience_us`: it is waited for the vehicle, and then
        for each answer, at most so long.
        """
        self._task = task
        self._wanted = system_id
        self._patience_us = patience_us
        self._node = Node(SYSTEM_ID, COMPONENT_ID)
        self._texts: list[str] = []
        self._joiner = Joiner()
        self._target: Peer | None = None
        self._begun_us: int | None = None
        self._heartbeat_us = 0
        self._ended_us: int | None = None
        self._others: set[int] = set()
        self._booting: int | None = None
        self.done = False

    def receive(self, datagram: bytes, now_us: int) -> int:
        """Take one datagram; the number of good frames in it. Never raises on its content."""
        frames = self._node.receive(datagram)
        for frame in frames:
            sender, message = (frame.system_id, frame.component_id), frame.message
            if type(message).id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
                self._look(message, sender)
            elif sender == self._target:
                if type(message).id == mavlink.MAVLINK_MSG_ID_STATUSTEXT:
                    self._note(self._joiner.receive(message, sender, now_us))
                elif self._node.addressed_to(frame):
                    self._task.receive(message, sender, now_us)
        return len(frames)

    def _look(self, heartbeat: Message, sender: Peer) -> None:
        if self._target is not None or heartbeat.autopilot == mavlink.MAV_AUTOPILOT_INVALID:
            return
        if self._wanted not in (None, sender[0]):
            if len(self._others) < MAX_TEXTS:
                self._others.add(sender[0])
        elif heartbeat.system_status == mavlink.MAV_STATE_BOOT:
            self._booting = sender[0]
        else:
            self._target = sender
            self._task.begin(sender, self._patience_us)

    def _note(self, texts: Sequence[object]) -> None:
        for text in texts:
            if len(self._texts) < MAX_TEXTS:
                self._texts.append(getattr(text, "text", ""))

    def step(self, now_us: int) -> None:
        if self._begun_us is None:
            self._begun_us = self._heartbeat_us = now_us
        if now_us >= self._heartbeat_us:
            self._heartbeat_us = now_us + HEARTBEAT_US
            self._node.send_message(_HEARTBEAT)
        if self._target is None:
            self.done = now_us - self._begun_us >= self._patience_us
            return
        for message in self._task.step(now_us):
            self._node.send_message(message)
        self._note(self._joiner.step(now_us))
        if self._task.done:
            if self._ended_us is None:
                self._ended_us = now_us
            self.done = self._task.explained or now_us - self._ended_us >= TEXTS_US

    def datagrams(self) -> list[bytes]:
        return self._node.datagrams()

    def reply(self) -> Reply:
        """What came of it, when it is `done`."""
        problem = self._task.problem()
        if self._target is None:
            problem = self._nobody()
        elif problem:
            problem = f"vehicle {self._target[0]} {problem}"
        return Reply(
            ok=not problem,
            vehicle=None if self._target is None else self._target[0],
            parameters=self._task.parameters(),
            result=self._task.result(),
            texts=tuple(self._texts),
            problem=problem,
        )

    def _nobody(self) -> str:
        waited = f"within {self._patience_us / 1e6:g} s"
        if self._booting is not None:
            return f"vehicle {self._booting} is still starting {waited}: try again, or give it a longer --timeout"
        if self._others:
            heard = ", ".join(str(each) for each in sorted(self._others))
            return f"no vehicle with system id {self._wanted} is heard {waited}, but {heard}: choose it with --system"
        return (
            f"no vehicle is heard {waited}: start one with mavsitl vehicle, name another with --instance or "
            "--endpoint, or see who is there with mavsitl check"
        )


def _is_ack_for_us(message: Message) -> bool:
    """One without a target is for everybody (MAVLink 1)."""
    return (
        type(message).id == mavlink.MAVLINK_MSG_ID_COMMAND_ACK
        and message.target_system in (0, SYSTEM_ID)
        and message.target_component in (0, COMPONENT_ID)
    )


def enum_name(name: str, value: int) -> str:
    """The entry without its enumeration's name before it."""
    entry = mavlink.enums[name].get(value)
    return f"{name} {value}" if entry is None else str(entry.name).removeprefix(f"{name}_")


def failure_units() -> dict[str, int]:
    """FAILURE_UNIT by short names: gyro, gps, battery, motor, rc, mavlink, ..."""
    return {
        enum_name("FAILURE_UNIT", value)
        .removeprefix("SENSOR_")
        .removeprefix("SYSTEM_")
        .removesuffix("_SIGNAL")
        .lower(): value
        for value in _entries("FAILURE_UNIT")
    }


def failure_kinds() -> dict[str, int]:
    """FAILURE_TYPE by short names: ok, off, stuck, ..."""
    return {enum_name("FAILURE_TYPE", value).lower(): value for value in _entries("FAILURE_TYPE")}


def _entries(name: str) -> list[int]:
    return [value for value, entry in mavlink.enums[name].items() if not entry.name.endswith("_ENUM_END")]
