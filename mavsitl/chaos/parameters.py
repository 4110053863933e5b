"""The parameter protocol broken: PARAM_REQUEST_LIST, PARAM_REQUEST_READ, PARAM_SET in, PARAM_VALUE, PARAM_ERROR out."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from math import nan

from mavsitl.chaos.base import NOTHING, REMEMBERED, Message, Mode, Peer, Repeats, altered, ids
from mavsitl.dialect import mavlink
from mavsitl.services.parameter import HASH_CHECK, HASH_INDEX, INT32, REAL32

LIST, READ, SET = ids("PARAM_REQUEST_LIST"), ids("PARAM_REQUEST_READ"), ids("PARAM_SET")
VALUE = ids("PARAM_VALUE")


class Asked:
    """Values that were asked for by name or index and not answered yet; each answer strikes one out."""

    def __init__(self) -> None:
        self._keys: OrderedDict[str | int, None] = OrderedDict()

    def note(self, request: Message) -> None:
        index = getattr(request, "param_index", -1)
        self._keys[index if index >= 0 else request.param_id] = None
        if len(self._keys) > REMEMBERED:
            self._keys.popitem(last=False)

    def strike(self, value: Message) -> bool:
        """Whether this PARAM_VALUE is the answer to one of them."""
        for key in (value.param_id, value.param_index):
            if key in self._keys:
                del self._keys[key]
                return True
        return False


class NameLost(Mode):
    """One parameter is never told."""

    gives = VALUE

    def __init__(self, name: str) -> None:
        self._name = name

    def outgoing(self, message: Message) -> Sequence[Message]:
        return NOTHING if message.param_id == self._name else (message,)


class ListWithout(Mode):
    """The list has a hole; who asks for that parameter gets it."""

    takes = READ | SET
    gives = VALUE

    def __init__(self, name: str) -> None:
        self._name = name
        self._asked = Asked()

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        self._asked.note(message)
        return message

    def outgoing(self, message: Message) -> Sequence[Message]:
        if self._asked.strike(message) or message.param_id != self._name:
            return (message,)
        return NOTHING


class ListEnds(Mode):
    """The list stops after `count` values; single ones are answered."""

    takes = LIST | READ | SET
    gives = VALUE

    def __init__(self, count: int) -> None:
        self._count = count
        self._sent = 0
        self._asked = Asked()

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        if type(message).id in LIST:
            self._sent = 0
        else:
            self._asked.note(message)
        return message

    def outgoing(self, message: Message) -> Sequence[Message]:
        if self._asked.strike(message) or message.param_index == HASH_INDEX:
            return (message,)
        self._sent += 1
        return (message,) if self._sent <= self._count else NOTHING


class CountWrong(Mode):
    gives = VALUE

    def __init__(self, more: int) -> None:
        self._more = more

    def outgoing(self, message: Message) -> Sequence[Message]:
        return (altered(message, param_count=(message.param_count + self._more) & 0xFFFF),)


class IndexDoubled(Mode):
    """Every second parameter has the index of the one before it."""

    gives = VALUE

    def outgoing(self, message: Message) -> Sequence[Message]:
        index = message.param_index
        return (altered(message, param_index=index & ~1) if index != HASH_INDEX else message,)


class TypeWrong(Mode):
    """INT32 is said to be REAL32, and the other way round."""

    gives = VALUE

    def outgoing(self, message: Message) -> Sequence[Message]:
        other = {INT32: REAL32, REAL32: INT32}.get(message.param_type, message.param_type)
        return (altered(message, param_type=other),)


class NotANumber(Mode):
    gives = VALUE

    def __init__(self, name: str) -> None:
        self._name = name

    def outgoing(self, message: Message) -> Sequence[Message]:
        return (altered(message, param_value=nan) if message.param_id == self._name else message,)


class Ignored(Mode):
    """PARAM_SET or PARAM_REQUEST_READ, not looked at: always (0), or the first `times` of each parameter."""

    def __init__(self, name: str, times: int) -> None:
        self.takes = ids(name)
        self._repeats = Repeats(times) if times else None

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        key = (sender, message.param_id, getattr(message, "param_index", -1))
        return None if self._repeats is None or self._repeats.fails(key) else message


class SetUnanswered(Mode):
    """The value is taken, and nothing says so here."""

    takes = SET
    gives = VALUE

    def __init__(self) -> None:
        self._asked = Asked()

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        self._asked.note(message)
        return message

    def outgoing(self, message: Message) -> Sequence[Message]:
        return NOTHING if self._asked.strike(message) else (message,)


class Refused(Mode):
    """PARAM_ERROR in the place of a PARAM_VALUE; nothing is set."""

    def __init__(self, name: str, error: int) -> None:
        self.takes = ids(name)
        self._error = error

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        index = getattr(message, "param_index", -1)
        name = message.param_id.encode("ascii", "replace")[:16]
        self.line.send(mavlink.MAVLink_param_error_message(*sender, name, index, self._error))
        return None


class SetKept(Mode):
    """The old value stays, and is the answer."""

    takes = SET

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        name = message.param_id.encode("ascii", "replace")[:16]
        return mavlink.MAVLink_param_request_read_message(message.target_system, message.target_component, name, -1)


class HashSilent(Mode):
    """As a PX4 that is too old for _HASH_CHECK."""

    gives = VALUE

    def outgoing(self, message: Message) -> Sequence[Message]:
        return NOTHING if message.param_id == HASH_CHECK else (message,)
