"""The parameter protocol: PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET in, PARAM_VALUE and PARAM_ERROR out.

Values are encoded byte-wise, as PX4 does: the four bytes of an integer stand in the message's float field unchanged.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias

from mavsitl.dialect import mavlink
from mavsitl.services.base import NOTHING, Message, Peer
from mavsitl.services.bucket import FairBuckets

__all__ = [
    "HASH_CHECK",
    "ParameterClient",
    "ParameterServer",
    "ParameterTable",
    "Refused",
    "Request",
    "decode_value",
    "encode_value",
]

HASH_CHECK = "_HASH_CHECK"
"""PX4's name for the hash over all values; a ground station with that hash in its cache needs no list."""
HASH_INDEX = 0xFFFF

INT32: int = mavlink.MAV_PARAM_TYPE_INT32
UINT32: int = mavlink.MAV_PARAM_TYPE_UINT32
REAL32: int = mavlink.MAV_PARAM_TYPE_REAL32

# Two codes of MAV_PARAM_ERROR that pymavlink's release does not have yet.
TYPE_UNSUPPORTED = 6
TYPE_MISMATCH = 7

NAME_BYTES = 16
MAX_PARAMETERS = 0x8000
"""What the int16 index of PARAM_REQUEST_READ can name; a client keeps no more."""

_LAYOUTS = {
    mavlink.MAV_PARAM_TYPE_UINT8: struct.Struct("<Bxxx"),
    mavlink.MAV_PARAM_TYPE_INT8: struct.Struct("<bxxx"),
    mavlink.MAV_PARAM_TYPE_UINT16: struct.Struct("<Hxx"),
    mavlink.MAV_PARAM_TYPE_INT16: struct.Struct("<hxx"),
    UINT32: struct.Struct("<I"),
    INT32: struct.Struct("<i"),
    REAL32: struct.Struct("<f"),
}


class Refused(NamedTuple):
    """Why a value was not taken."""

    error: int
    """MAV_PARAM_ERROR"""
    text: str


class ParameterTable(Protocol):
    """What a `ParameterServer` serves. One table is shared by the servers of all links."""

    @property
    def names(self) -> Sequence[str]:
        """Sorted, at most 16 ASCII characters each; the order of the indices."""

    def __getitem__(self, name: str) -> float: ...

    def index(self, name: str) -> int | None:
        """None: no such parameter."""

    def is_integer(self, name: str) -> bool:
        """INT32, otherwise REAL32."""

    def set(self, name: str, value: float) -> Refused | None:
        """Take `value`, or say why not. Any float may come: NaN, infinite, out of range."""

    def hash(self) -> int:
        """The value of `_HASH_CHECK`."""

    def subscribe(self, listener: Callable[[str, float], None], /) -> Callable[[], None]:
        """`listener(name, value)` is called after each change, until the function that is returned is called."""


def encode_value(value: float, param_type: int) -> bytes | None:
    """The four bytes of `value` on the wire; None where the type has no such value, or is not one of 32 bits or less.

    Integer types take whole numbers only.
    """
    layout = _LAYOUTS.get(param_type)
    if layout is None:
        return None
    try:
        if param_type == REAL32:
            return layout.pack(value)
        return layout.pack(int(value)) if value == int(value) else None
    except (struct.error, OverflowError, ValueError):
        return None


def decode_value(data: bytes, param_type: int) -> float | None:
    """The number in the four bytes `data`: int or float by its type; None for a type that `encode_value` refuses."""
    layout = _LAYOUTS.get(param_type)
    if layout is None:
        return None
    value: float = layout.unpack(data)[0]
    return value


def _exact(message_class: Any) -> Any:
    """`message_class` with `param_value` as the four bytes read as an unsigned integer.

    A Python float cannot hold a signalling NaN, which is what the bytes of some integers are as a float.
    """
    layout = message_class.native_format.replace(b"f", b"I")
    return type(message_class.__name__, (message_class,), {"native_format": layout})


_ExactValue = _exact(mavlink.MAVLink_param_value_message)
_ExactSet = _exact(mavlink.MAVLink_param_set_message)
_as_float = struct.Struct("<f")
_as_unsigned = struct.Struct("<I")


def _carry(data: bytes) -> tuple[bool, float]:
    """(a float field carries `data` as it is, what to put into the field)"""
    number: float = _as_float.unpack(data)[0]
    if _as_float.pack(number) == data:
        return True, number
    return False, _as_unsigned.unpack(data)[0]


def _param_value(name: str, data: bytes, param_type: int, count: int, index: int) -> Message:
    plain, number = _carry(data)
    kind = mavlink.MAVLink_param_value_message if plain else _ExactValue
    return kind(name.encode(), number, param_type, count, index)


def _param_set(target: Peer, name: str, data: bytes, param_type: int) -> Message:
    plain, number = _carry(data)
    kind = mavlink.MAVLink_param_set_message if plain else _ExactSet
    return kind(*target, name.encode(), number, param_type)


def _value_bytes(message: Message) -> bytes:
    """The bytes of `param_value` as they came: the first of the payload of PARAM_SET and PARAM_VALUE alike.

    The decoded field will not do: making it a Python float changes signalling NaNs.
    """
    payload: bytes = message.get_payload()
    return payload[:4].ljust(4, b"\0")


# ---------------------------------------------------------------------------------------------------------- the server


class ParameterServer:
    """Answers on one link for a table that is shared with the other links.

    A change is told on every link. The list, and changes that came from elsewhere, are paced.
    """

    INTERVAL_US = 2_500
    """Between two values of a list: more than 400 a second are lost by MAVProxy."""
    CATCH_UP_US = 50_000
    """What a `step` that comes late sends at most at once: the values of this time."""
    ANSWERS_HZ, ANSWERS_BURST = 1000.0, 200.0
    """Answers to single requests of one asker. The rest goes unanswered."""
    REPORT_INTERVAL_US = 1_000_000

    def __init__(self, table: ParameterTable, report: Callable[[str], None] | None = None) -> None:
        """`report(text)` is told of refused values, at most once a second: for STATUSTEXT."""
        self._table = table
        self._report = report
        self._reported_us: int | None = None
        self._next: int | None = None
        """Index of the list's next value; None: no list is being sent."""
        self._left = 0
        """Values of the list still to send."""
        self._hash_first = False
        self._changed: dict[str, None] = {}
        """Names of values to tell on this link, oldest first."""
        self._setting: str | None = None
        self._due_us = 0
        self._answers = FairBuckets(self.ANSWERS_HZ, self.ANSWERS_BURST)
        self.dropped = 0
        """Requests that went unanswered because there were too many."""
        self._handlers: dict[int, Callable[[Message, Peer, int], Sequence[Message]]] = {
            mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_LIST: self._on_list,
            mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ: self._on_read,
            mavlink.MAVLINK_MSG_ID_PARAM_SET: self._on_set,
        }
        self.close = table.subscribe(self._on_change)
        """Hear of no more changes: the link is gone."""

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        """PARAM_REQUEST_LIST, PARAM_REQUEST_READ or PARAM_SET, as the codec decoded it; others are ignored."""
        handler = self._handlers.get(type(message).id)
        if handler is None:
            return NOTHING
        if handler != self._on_list and not self._answers.take(sender, now_us):
            self.dropped += 1
            return NOTHING
        return handler(message, sender, now_us)

    def step(self, now_us: int) -> Sequence[Message]:
        """What is due of the list and of changes that came from elsewhere."""
        if self._next is None and not self._changed:
            self._due_us = max(self._due_us, now_us)
            return NOTHING
        self._due_us = max(self._due_us, now_us - self.CATCH_UP_US)
        messages: list[Message] = []
        while self._due_us <= now_us:
            message = self._take()
            if message is None:
                break
            messages.append(message)
            self._due_us += self.INTERVAL_US
        return messages

    def _take(self) -> Message | None:
        """The next message to send of itself; what changed goes before the list."""
        if self._changed:
            name = next(iter(self._changed))
            del self._changed[name]
            return self._value(name)
        if self._next is None:
            return None
        if self._hash_first:
            self._hash_first = False
            return self._hash()
        name = self._table.names[self._next]
        self._next = (self._next + 1) % len(self._table.names)
        self._left -= 1
        if not self._left:
            self._next = None
        return self._value(name)

    def _on_list(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        # Whoever asks again while the list runs did not find the hash in its cache.
        self._hash_first = self._next is None
        # It goes on where it is, once round: who asks again and again would else hear its beginning alone.
        self._next = self._next or 0
        self._left = len(self._table.names)
        return NOTHING

    def _on_read(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        index, names = message.param_index, self._table.names
        if index >= 0:
            if index >= len(names):
                return [self._error(message, sender, mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST)]
            return [self._value(names[index])]
        if message.param_id == HASH_CHECK:
            return [self._hash()]
        if self._table.index(message.param_id) is None:
            return [self._error(message, sender, mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST)]
        return [self._value(message.param_id)]

    def _on_set(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        name: str = message.param_id
        if name == HASH_CHECK:
            self._next = None  # the ground station has the values in its cache
            return NOTHING
        if self._table.index(name) is None:
            return [self._error(message, sender, mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST)]
        refused = self._set(name, _value_bytes(message), message.param_type)
        if refused is None:
            return [self._value(name)]
        self._say(refused.text, now_us)
        return [self._value(name), self._error(message, sender, refused.error)]

    def _set(self, name: str, data: bytes, param_type: int) -> Refused | None:
        own_type = INT32 if self._table.is_integer(name) else REAL32
        if param_type != own_type:
            error = TYPE_MISMATCH if param_type in (INT32, REAL32) else TYPE_UNSUPPORTED
            return Refused(error, f"{name}: is {'INT32' if own_type == INT32 else 'REAL32'}, not type {param_type}")
        value = decode_value(data, own_type)
        assert value is not None
        self._setting = name
        try:
            return self._table.set(name, value)
        finally:
            self._setting = None

    def _on_change(self, name: str, value: float) -> None:
        if name != self._setting:  # the one that is being set here is answered at once
            self._changed[name] = None

    def _value(self, name: str) -> Message:
        table = self._table
        param_type = INT32 if table.is_integer(name) else REAL32
        data = encode_value(table[name], param_type)
        index = table.index(name)
        assert data is not None
        assert index is not None
        return _param_value(name, data, param_type, len(table.names), index)

    def _hash(self) -> Message:
        return _param_value(
            HASH_CHECK, _as_unsigned.pack(self._table.hash()), UINT32, len(self._table.names), HASH_INDEX
        )

    def _error(self, message: Message, sender: Peer, error: int) -> Message:
        name: bytes = message.param_id.encode("ascii", "replace")[:NAME_BYTES]
        index = getattr(message, "param_index", -1)
        return mavlink.MAVLink_param_error_message(*sender, name, index, error)

    def _say(self, text: str, now_us: int) -> None:
        if self._report is None:
            return
        if self._reported_us is None or now_us - self._reported_us >= self.REPORT_INTERVAL_US:
            self._reported_us = now_us
            self._report(text)


# ---------------------------------------------------------------------------------------------------------- the client

Outcome: TypeAlias = Literal["open", "done", "refused", "silent"]
ListState: TypeAlias = Literal["idle", "running", "complete", "failed"]


class Request:
    """One `ParameterClient.read` or `set`; look at `outcome` after each step."""

    def __init__(self, name: str, wanted: float | None) -> None:
        self.name = name
        self.wanted = wanted
        """What is to be set; None for a read."""
        self.outcome: Outcome = "open"
        self.value: float | None = None
        """What the vehicle said last."""
        self.error: int | None = None
        """MAV_PARAM_ERROR, where the vehicle sent one."""
        self.tries = 0
        """Messages in a row without the answer that was hoped for."""
        self.set_sent = False


class ParameterClient:
    """Fetches the list with its gaps repaired, reads, and sets with a check. One read or set is open at a time.

    `receive` takes any message; those of others than `target` are ignored.
    """

    CHUNK = 20
    """Missing values of the list that are asked for at once."""

    def __init__(self, target: Peer, timeout_us: int = 250_000, tries: int = 12) -> None:
        """`timeout_us` without an answer before a repeat; `tries` in a row without progress before giving up."""
        self.target = target
        self.values: dict[str, float] = {}
        """Every value that came; int for integer types."""
        self.types: dict[str, int] = {}
        """MAV_PARAM_TYPE"""
        self.count: int | None = None
        """How many parameters the vehicle says it has."""
        self.hash: int | None = None
        """The last `_HASH_CHECK`."""
        self.list_state: ListState = "idle"
        self._timeout_us = timeout_us
        self._tries = tries
        self._seen: set[int] = set()
        self._asked: list[int] = []
        self._list_tries = 0
        self._list_due_us = 0
        self._queue: deque[Request] = deque()
        self._due_us = 0

    # --- what to do

    def request_list(self) -> None:
        """Fetch all values; see `list_state`."""
        self.list_state = "running"
        self.count = None
        self._seen.clear()
        self._asked.clear()
        self._list_tries = 0
        self._list_due_us = 0

    def read(self, name: str) -> Request:
        """Ask for one value. `HASH_CHECK` is a name too. Raises ValueError for a name that does not fit."""
        return self._begin(Request(_fitting(name), None))

    def set(self, name: str, value: float) -> Request:
        """Set one value, with the type that the vehicle says it has: it is read first where that is not known."""
        return self._begin(Request(_fitting(name), value))

    def _begin(self, request: Request) -> Request:
        self._queue.append(request)
        if len(self._queue) == 1:
            self._due_us = 0
        return request

    @property
    def busy(self) -> bool:
        return bool(self._queue) or self.list_state == "running"

    # --- messages

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        if sender == self.target:
            kind = type(message).id
            if kind == mavlink.MAVLINK_MSG_ID_PARAM_VALUE:
                self._on_value(message, now_us)
            elif kind == mavlink.MAVLINK_MSG_ID_PARAM_ERROR:
                self._on_error(message)
        return NOTHING

    def _on_value(self, message: Message, now_us: int) -> None:
        name, param_type, data = message.param_id, message.param_type, _value_bytes(message)
        value = decode_value(data, param_type)
        if value is None or (name not in self.values and len(self.values) >= MAX_PARAMETERS):
            return
        if name == HASH_CHECK:
            self.hash = int(value) if param_type == UINT32 else None
        else:
            if self.list_state == "running":
                self._note(message.param_index, message.param_count, now_us)
            self.values[name] = value
            self.types[name] = param_type
        request = self._queue[0] if self._queue else None
        if request is None or request.name != name:
            return
        request.value = value
        if request.wanted is None or encode_value(request.wanted, param_type) == data:
            self._finish("done")
        elif not request.set_sent:  # its type is known now
            request.tries = 0
            self._due_us = 0

    def _note(self, index: int, count: int, now_us: int) -> None:
        self.count = count
        self._list_due_us = now_us + self._timeout_us
        if index < count and index not in self._seen:
            self._seen.add(index)
            self._list_tries = 0
            if len(self._seen) >= count and all(known in self._seen for known in range(count)):
                self.list_state = "complete"

    def _on_error(self, message: Message) -> None:
        request = self._queue[0] if self._queue else None
        if request is not None and request.name == message.param_id:
            request.error = int(message.error)
            self._finish("refused")

    def _finish(self, outcome: Outcome) -> None:
        self._queue.popleft().outcome = outcome
        self._due_us = 0

    # --- time

    def step(self, now_us: int) -> Sequence[Message]:
        return [*self._step_list(now_us), *self._step_request(now_us)]

    def _step_list(self, now_us: int) -> Sequence[Message]:
        if self.list_state != "running":
            return NOTHING
        answered = bool(self._asked) and all(index in self._seen for index in self._asked)
        if now_us < self._list_due_us and not answered:
            return NOTHING
        if not answered:
            if self._list_tries >= self._tries:
                self.list_state = "failed"
                return NOTHING
            self._list_tries += 1
        self._list_due_us = now_us + self._timeout_us
        if self.count is None:
            return [mavlink.MAVLink_param_request_list_message(*self.target)]
        missing = (index for index in range(min(self.count, MAX_PARAMETERS)) if index not in self._seen)
        self._asked = [index for index, _ in zip(missing, range(self.CHUNK), strict=False)]
        return [mavlink.MAVLink_param_request_read_message(*self.target, b"", index) for index in self._asked]

    def _step_request(self, now_us: int) -> Sequence[Message]:
        if not self._queue or now_us < self._due_us:
            return NOTHING
        request = self._queue[0]
        if request.tries >= self._tries:
            # A value that is not the wanted one, again and again, is a refusal by a vehicle without PARAM_ERROR.
            self._finish("silent" if request.wanted is None or request.value is None else "refused")
            return NOTHING
        self._due_us = now_us + self._timeout_us
        known = self.types.get(request.name)
        if request.wanted is None or known is None:
            request.tries += 1
            return [mavlink.MAVLink_param_request_read_message(*self.target, request.name.encode(), -1)]
        data = encode_value(request.wanted, known)
        if data is None:
            request.value, request.error = self.values[request.name], TYPE_MISMATCH
            self._finish("refused")
            return NOTHING
        request.tries += 1
        request.set_sent = True
        return [_param_set(self.target, request.name, data, known)]


def _fitting(name: str) -> str:
    if not (name.isascii() and 0 < len(name) <= NAME_BYTES):
        raise ValueError(f"{name!r}: a parameter's name has 1 to {NAME_BYTES} ASCII characters")
    return name
