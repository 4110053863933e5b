"""Transfers of missions, fences and rally points that break, at a named item, in either direction."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

from mavsitl.chaos.base import NOTHING, REMEMBERED, Every, Message, Mode, Peer, Repeats, altered, ids
from mavsitl.dialect import mavlink

COUNT = ids("MISSION_COUNT")
ITEMS = ids("MISSION_ITEM", "MISSION_ITEM_INT")
REQUESTS = ids("MISSION_REQUEST", "MISSION_REQUEST_INT")
LIST = ids("MISSION_REQUEST_LIST")
ACK = ids("MISSION_ACK")

CANCELLED: int = mavlink.MAV_MISSION_OPERATION_CANCELLED


def _target(message: Message) -> Peer:
    return message.target_system, message.target_component


def _ack(result: int, target: Peer, mission_type: int) -> Message:
    return mavlink.MAVLink_mission_ack_message(*target, result, mission_type)


class CountFirstLost(Mode):
    gives = COUNT

    def __init__(self) -> None:
        self._repeats = Repeats()

    def outgoing(self, message: Message) -> Sequence[Message]:
        return NOTHING if self._repeats.fails((_target(message), message.mission_type)) else (message,)


class CountWrong(Mode):
    """MISSION_COUNT promises more items than there are."""

    gives = COUNT

    def __init__(self, more: int) -> None:
        self._more = more

    def outgoing(self, message: Message) -> Sequence[Message]:
        return (altered(message, count=(message.count + self._more) & 0xFFFF),)


class BeginFirstLost(Mode):
    """The first MISSION_COUNT of an upload is not looked at."""

    takes = COUNT

    def __init__(self) -> None:
        self._repeats = Repeats()

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        return None if self._repeats.fails((sender, message.mission_type)) else message


class SequenceLost(Mode):
    """Of messages with a `seq`, the one with this number is never sent, or not the first `times`."""

    def __init__(self, kinds: frozenset[int], seq: int, times: int = 0) -> None:
        self.gives = kinds
        self._seq = seq
        self._repeats = Repeats(times) if times else None

    def outgoing(self, message: Message) -> Sequence[Message]:
        if message.seq != self._seq:
            return (message,)
        lost = self._repeats is None or self._repeats.fails((_target(message), message.mission_type))
        return NOTHING if lost else (message,)


class SequenceWrong(Mode):
    """The message of this number says the next one."""

    def __init__(self, kinds: frozenset[int], seq: int) -> None:
        self.gives = kinds
        self._seq = seq

    def outgoing(self, message: Message) -> Sequence[Message]:
        return (altered(message, seq=(message.seq + 1) & 0xFFFF) if message.seq == self._seq else message,)


class ItemRefused(Mode):
    """MISSION_ACK with an error in the place of an item."""

    gives = ITEMS

    def __init__(self, seq: int, result: int) -> None:
        self._seq = seq
        self._result = result

    def outgoing(self, message: Message) -> Sequence[Message]:
        if message.seq != self._seq:
            return (message,)
        return (_ack(self._result, _target(message), message.mission_type),)


class UploadEnds(Mode):
    """Where item `seq` should be asked for there is a MISSION_ACK, and the upload is over; the old plan stays."""

    takes = COUNT | ITEMS

    def __init__(self, seq: int, result: int) -> None:
        self._seq = seq
        self._result = result
        self._counts: OrderedDict[tuple[Peer, int], int] = OrderedDict()

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        key = (sender, int(message.mission_type))
        if type(message).id in COUNT:
            self._counts.pop(key, None)
            self._counts[key] = message.count
            if len(self._counts) > REMEMBERED:
                self._counts.popitem(last=False)
            if self._seq > 0 or message.count == 0:
                return message
            self.line.send(_ack(self._result, sender, message.mission_type))
            return None
        if message.seq != self._seq - 1 or not self._seq < self._counts.get(key, 0):
            return message
        self.line.send(_ack(self._result, sender, message.mission_type))
        return _ack(CANCELLED, _target(message), message.mission_type)  # as if the client had ended it


class AckAltered(Mode):
    """The final MISSION_ACK says something else; the plan is in force all the same."""

    gives = ACK

    def __init__(self, result: int) -> None:
        self._result = result

    def outgoing(self, message: Message) -> Sequence[Message]:
        return (altered(message, type=self._result),)


class AckLate(Mode):
    gives = ACK

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds

    def outgoing(self, message: Message) -> Sequence[Message]:
        self.line.send(message, self._seconds)
        return NOTHING


class Unasked(Mode):
    """A message of a transfer that nobody began, to everybody."""

    def __init__(self, kind: str, seconds: float) -> None:
        self._kind = kind
        self._every = Every(seconds)

    def step(self) -> None:
        if not self._every.due(self.line.now_us):
            return
        if self._kind == "ack":
            self.line.send(_ack(mavlink.MAV_MISSION_ERROR, (0, 0), 0))
        elif self._kind == "request":
            self.line.send(mavlink.MAVLink_mission_request_int_message(0, 0, 0, 0))
        else:
            fields = (0, mavlink.MAV_FRAME_MISSION, mavlink.MAV_CMD_NAV_WAYPOINT, 0, 1, 0.0, 0.0, 0.0, 0.0, 0, 0, 0.0)
            self.line.send(mavlink.MAVLink_mission_item_int_message(0, 0, *fields, 0))
