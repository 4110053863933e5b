"""Missions, geofence, rally points: MAVLink's mission protocol, the side that keeps the plans and the side that asks.

The three plans of a vehicle (mission, fence, rally; `mission_type` 0, 1, 2) live in one `MissionStores`, shared by the
`MissionServer` of each link. One transaction runs at a time over all links, whoever else begins one is answered
MISSION_ACK DENIED. An upload goes into a buffer of its own and replaces the plan when its last item is in and the whole
is valid; until then, and when it fails, the old plan stands.

Global frames are stored and sent in their integer form, as PX4 does: an item sent with frame 0 comes back with 5 and 3
with 6 (MISSION_ITEM, the message with float coordinates, carries 0 and 3). A client that compares treats them as equal.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isnan, nan
from typing import Any, NamedTuple
from zlib import crc32

from mavsitl.codec import Message, MessageClass
from mavsitl.dialect import mavlink
from mavsitl.services.base import NOTHING, Peer

__all__ = [
    "DEFAULT_LIMITS",
    "FENCE",
    "MISSION",
    "NOWHERE",
    "RALLY",
    "MissionClient",
    "MissionItem",
    "MissionServer",
    "MissionStatus",
    "MissionStores",
    "check_item",
    "item_from_message",
    "item_message",
    "same_plan",
]

MISSION: int = mavlink.MAV_MISSION_TYPE_MISSION
FENCE: int = mavlink.MAV_MISSION_TYPE_FENCE
RALLY: int = mavlink.MAV_MISSION_TYPE_RALLY
ALL: int = mavlink.MAV_MISSION_TYPE_ALL

ACCEPTED: int = mavlink.MAV_MISSION_ACCEPTED
ERROR: int = mavlink.MAV_MISSION_ERROR
UNSUPPORTED_FRAME: int = mavlink.MAV_MISSION_UNSUPPORTED_FRAME
UNSUPPORTED: int = mavlink.MAV_MISSION_UNSUPPORTED
NO_SPACE: int = mavlink.MAV_MISSION_NO_SPACE
INVALID_PARAM1: int = mavlink.MAV_MISSION_INVALID_PARAM1
INVALID_PARAM5_X: int = mavlink.MAV_MISSION_INVALID_PARAM5_X
INVALID_PARAM6_Y: int = mavlink.MAV_MISSION_INVALID_PARAM6_Y
INVALID_PARAM7: int = mavlink.MAV_MISSION_INVALID_PARAM7
INVALID_SEQUENCE: int = mavlink.MAV_MISSION_INVALID_SEQUENCE
DENIED: int = mavlink.MAV_MISSION_DENIED
CANCELLED: int = mavlink.MAV_MISSION_OPERATION_CANCELLED

DEFAULT_LIMITS: Mapping[int, int] = {MISSION: 2000, FENCE: 64, RALLY: 32}
"""Items per plan. Fence and rally: PX4 1.17 (`DM_KEY_FENCE_POINTS_MAX`, `DM_KEY_SAFE_POINTS_MAX`)."""

NOWHERE = 2**31 - 1
"""An integer coordinate that says nothing, as NaN does in a float: MAVLink's convention for COMMAND_INT and items."""

LARGEST = 1e10
"""No parameter of an item means anything beyond; infinities are."""

REQUEST_RETRY_US = 250_000
"""PX4's `MAVLINK_MISSION_RETRY_TIMEOUT_DEFAULT`."""
GIVE_UP_US = 5_000_000
"""Without progress, not in all: PX4's `MAVLINK_MISSION_PROTOCOL_TIMEOUT_DEFAULT`."""
REQUESTS_PER_KIND = 2
"""Unanswered requests of one kind (MISSION_REQUEST_INT or MISSION_REQUEST) before the other is tried."""
ECHO_US = 100_000
"""A repeated item this soon after our request is an echo of a repeated request. Answered, it would breed for ever."""
ACK_ECHO_US = 200_000
"""The same for the last item and the final MISSION_ACK. A second one would end a client's next upload (MAVSDK)."""
REACHED_REPEATS = 10
"""MISSION_ITEM_REACHED is repeated so many times, once a second, as PX4 does."""

_GLOBAL = {
    mavlink.MAV_FRAME_GLOBAL: mavlink.MAV_FRAME_GLOBAL_INT,
    mavlink.MAV_FRAME_GLOBAL_INT: mavlink.MAV_FRAME_GLOBAL_INT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT: mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
}
_FLOAT_FRAME = {
    mavlink.MAV_FRAME_GLOBAL_INT: mavlink.MAV_FRAME_GLOBAL,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT: mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
}
_FENCE_COMMANDS = frozenset(
    (
        mavlink.MAV_CMD_NAV_FENCE_RETURN_POINT,
        mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION,
        mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION,
        mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION,
        mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION,
    )
)
_RALLY_COMMANDS = frozenset((mavlink.MAV_CMD_NAV_RALLY_POINT,))
_LOCATED = frozenset(
    command for command, entry in mavlink.enums["MAV_CMD"].items() if getattr(entry, "has_location", False)
)
"""Commands whose parameters 5 and 6 are latitude and longitude, from the dialect's own definitions."""

_LATITUDE_LIMIT = 900_000_000
_LONGITUDE_LIMIT = 1_800_000_000
_INT32_MIN = -(2**31)
_NAMES = {MISSION: "Mission", FENCE: "Geofence", RALLY: "Rally points"}


class MissionItem(NamedTuple):
    """One item of a plan as it is stored.

    Attributes:
        command: MAV_CMD.
        frame: MAV_FRAME 2 (no position), 5 (altitude above mean sea level) or 6 (above home).
        param1, param2, param3, param4: as sent, float32 values; NaN where the sender left them open.
        x, y: latitude and longitude, degE7, in the global frames; parameters 5 and 6, unscaled, in frame 2.
            `NOWHERE` where the sender left them open.
        z: altitude, m, or parameter 7.
        autocontinue: 0: stop after this item.
    """

    command: int
    frame: int
    param1: float
    param2: float
    param3: float
    param4: float
    x: int
    y: int
    z: float
    autocontinue: int = 1


_pack_item = struct.Struct("<HB4fiifB").pack


def _crc(item: MissionItem, before: int) -> int:
    return crc32(
        _pack_item(
            item.command,
            item.frame,
            item.param1,
            item.param2,
            item.param3,
            item.param4,
            item.x,
            item.y,
            item.z,
            item.autocontinue,
        ),
        before,
    )


def _plan_id(items: Sequence[MissionItem]) -> int:
    """Never 0 for a plan with items, equal for equal plans."""
    value = 0
    for item in items:
        value = _crc(item, value)
    return value or len(items)


def same_plan(first: Sequence[MissionItem], second: Sequence[MissionItem]) -> bool:
    """Whether two plans are equal item by item; NaN equals NaN."""
    return len(first) == len(second) and all(
        a == b or (a != a and b != b)
        for one, other in zip(first, second, strict=True)
        for a, b in zip(one, other, strict=True)
    )


# ---------------------------------------------------------------------------------------------------- items on the wire


def _degrees_e7(value: float, scale: float) -> int | None:
    """A float coordinate as the integer of MISSION_ITEM_INT; None where it does not fit."""
    if isnan(value):
        return NOWHERE
    scaled = value * scale
    if not _INT32_MIN <= scaled < NOWHERE:
        return None
    return round(scaled)


def item_from_message(message: Message) -> MissionItem | int:
    """The item of a MISSION_ITEM_INT or MISSION_ITEM with its frame normalised, or the MAV_MISSION_RESULT against it.

    Only the form is looked at: the frame, and that coordinates fit. See `check_item` for the rest.
    """
    frame = _GLOBAL.get(message.frame)
    if frame is None:
        if message.frame != mavlink.MAV_FRAME_MISSION:
            return UNSUPPORTED_FRAME
        frame = message.frame
    if type(message).id == mavlink.MAVLINK_MSG_ID_MISSION_ITEM_INT:
        x, y = message.x, message.y
    else:
        scale = 1.0 if frame == mavlink.MAV_FRAME_MISSION else 1e7
        x_or_none, y_or_none = _degrees_e7(message.x, scale), _degrees_e7(message.y, scale)
        if x_or_none is None:
            return INVALID_PARAM5_X
        if y_or_none is None:
            return INVALID_PARAM6_Y
        x, y = x_or_none, y_or_none
    return MissionItem(
        message.command,
        frame,
        message.param1,
        message.param2,
        message.param3,
        message.param4,
        x,
        y,
        message.z,
        message.autocontinue,
    )


def _float_coordinate(value: int, scale: float) -> float:
    return nan if value == NOWHERE else value / scale


def item_message(
    item: MissionItem, target: Peer, mission_type: int, seq: int, current: bool, as_float: bool = False
) -> Message:
    """A MISSION_ITEM_INT, or with `as_float` a MISSION_ITEM (coordinates to about a metre, frames 0 and 3)."""
    head = (*target, seq)
    params = (item.param1, item.param2, item.param3, item.param4)
    flags = (int(current), item.autocontinue)
    if not as_float:
        return mavlink.MAVLink_mission_item_int_message(
            *head, item.frame, item.command, *flags, *params, item.x, item.y, item.z, mission_type
        )
    scale = 1.0 if item.frame == mavlink.MAV_FRAME_MISSION else 1e7
    x, y = _float_coordinate(item.x, scale), _float_coordinate(item.y, scale)
    frame = _FLOAT_FRAME.get(item.frame, item.frame)
    return mavlink.MAVLink_mission_item_message(*head, frame, item.command, *flags, *params, x, y, item.z, mission_type)


def check_item(mission_type: int, item: MissionItem) -> int:
    """What holds for every vehicle, as a MAV_MISSION_RESULT: usable numbers, coordinates on Earth, items in their plan.

    A command with a position may leave it open here (NaN, `NOWHERE`) in a mission, since some mean "here" by that;
    a fence or rally point may not.
    """
    for offset, value in enumerate((item.param1, item.param2, item.param3, item.param4)):
        if abs(value) > LARGEST:
            return INVALID_PARAM1 + offset
    if abs(item.z) > LARGEST:
        return INVALID_PARAM7
    is_fence, is_rally = item.command in _FENCE_COMMANDS, item.command in _RALLY_COMMANDS
    if mission_type == MISSION:
        if is_fence or is_rally:
            return ERROR
    elif not (is_fence if mission_type == FENCE else is_rally):
        return UNSUPPORTED
    elif item.frame == mavlink.MAV_FRAME_MISSION:
        return UNSUPPORTED_FRAME
    if item.frame != mavlink.MAV_FRAME_MISSION and item.command in _LOCATED:
        may_be_open = mission_type == MISSION
        if not (abs(item.x) <= _LATITUDE_LIMIT or (may_be_open and item.x == NOWHERE)):
            return INVALID_PARAM5_X
        if not (abs(item.y) <= _LONGITUDE_LIMIT or (may_be_open and item.y == NOWHERE)):
            return INVALID_PARAM6_Y
    if mission_type == RALLY and isnan(item.z):
        return INVALID_PARAM7
    return ACCEPTED


# ------------------------------------------------------------------------------------------------- what the links share


class MissionStatus(NamedTuple):
    """What MISSION_CURRENT tells: `state` is a MISSION_STATE, `mode` 1 in mission mode and 2 out of it."""

    seq: int
    total: int
    state: int
    mode: int


CheckItem = Callable[[int, int, MissionItem], int]
"""``(mission_type, seq, item) -> MAV_MISSION_RESULT`` after `check_item`, item by item."""
Validate = Callable[[int, Sequence[MissionItem]], tuple[int, int]]
"""``(mission_type, items) -> (MAV_MISSION_RESULT, seq to blame)`` of a whole plan, before it takes effect."""
Changed = Callable[[int, int], None]
"""``(mission_type, start_seq)`` after a plan was replaced or cleared; `start_seq` is the item marked as current."""
Report = Callable[[int, str], None]
"""``(MAV_SEVERITY, text)``: goes out as a STATUSTEXT."""


def _accept_item(mission_type: int, seq: int, item: MissionItem) -> int:
    return ACCEPTED


def _accept_plan(mission_type: int, items: Sequence[MissionItem]) -> tuple[int, int]:
    return ACCEPTED, 0


def _ignore(*_: object) -> None:
    pass


@dataclass(slots=True)
class _Transaction:
    server: MissionServer
    peer: Peer
    mission_type: int
    upload: bool
    count: int
    progress_us: int
    snapshot: tuple[MissionItem, ...] = ()
    """Download: the plan as it was at the beginning."""
    buffer: list[MissionItem] = field(default_factory=list)
    """Upload: what is in so far."""
    start_seq: int = 0
    sent_us: int = 0
    unanswered: int = 0
    as_float: bool = False
    speaks_int: bool = False
    """Upload: a MISSION_ITEM_INT came, so silence is loss, and floats would only cost the coordinates' last digits."""
    all_served: bool = False
    """Download: the last item went out, so others need not wait for an acknowledgement that may never come."""


class MissionStores:
    """The three plans, their rules and the transaction that runs, shared by the servers of all links.

    The owner gives the rules as callables; without them all that `check_item` accepts is accepted. `set_current(seq)`
    says whether it could go there.

    Attributes:
        limits: items per plan.
        reached_total: items reported by `reached` so far.
    """

    REACHED_REMEMBERED = 64

    def __init__(
        self,
        limits: Mapping[int, int] = DEFAULT_LIMITS,
        check: CheckItem = _accept_item,
        validate: Validate = _accept_plan,
        changed: Changed = _ignore,
        set_current: Callable[[int], bool] | None = None,
        status: Callable[[], MissionStatus] | None = None,
        report: Report = _ignore,
    ) -> None:
        self.limits = dict(limits)
        self.check = check
        self.validate = validate
        self.changed = changed
        self.set_current = set_current if set_current is not None else self._set_current
        self.status = status if status is not None else self._status
        self.report = report
        self.transaction: _Transaction | None = None
        self.reached_total = 0
        self._items: dict[int, tuple[MissionItem, ...]] = {MISSION: (), FENCE: (), RALLY: ()}
        self._ids = {MISSION: 0, FENCE: 0, RALLY: 0}
        self._reached: deque[int] = deque(maxlen=self.REACHED_REMEMBERED)
        self._seq = 0

    def items(self, mission_type: int) -> tuple[MissionItem, ...]:
        """The plan in force."""
        return self._items[mission_type]

    def id(self, mission_type: int) -> int:
        """The opaque id of a plan: 0 when empty, otherwise a number that is another for another plan."""
        return self._ids[mission_type]

    def replace(self, mission_type: int, items: Sequence[MissionItem], start_seq: int = 0) -> None:
        """Put a plan into force without asking the rules: for the owner, who loads it or has checked it."""
        self._items[mission_type] = tuple(items)
        self._ids[mission_type] = _plan_id(items)
        if mission_type == MISSION:
            self._seq = start_seq
            self._reached.clear()
        self.changed(mission_type, start_seq)

    def reached(self, seq: int) -> None:
        """An item of the mission was reached or done: every link says so."""
        self._reached.append(seq)
        self.reached_total += 1

    def reached_since(self, total: int) -> list[int]:
        """The items reached after `reached_total` was `total`, those that are remembered."""
        new = min(self.reached_total - total, len(self._reached))
        return list(self._reached)[len(self._reached) - new :] if new > 0 else []

    @property
    def last_reached(self) -> int | None:
        return self._reached[-1] if self._reached else None

    def _set_current(self, seq: int) -> bool:
        if seq >= len(self._items[MISSION]):
            return False
        self._seq = seq
        return True

    def _status(self) -> MissionStatus:
        total = len(self._items[MISSION])
        state = mavlink.MISSION_STATE_NOT_STARTED if total else mavlink.MISSION_STATE_NO_MISSION
        return MissionStatus(self._seq, total, state, 2)


# ------------------------------------------------------------------------------------------------------------- messages


def _with_extensions(message_class: MessageClass, *fields: object, **extensions: int) -> Message:
    """A message with those extension fields that the dialect knows: older definitions lack the plans' ids."""
    known = {name: value for name, value in extensions.items() if name in message_class.fieldnames}
    return message_class(*fields, **known)


def _ack(target: Peer, result: int, mission_type: int, opaque_id: int = 0) -> Message:
    return _with_extensions(mavlink.MAVLink_mission_ack_message, *target, result, mission_type, opaque_id=opaque_id)


def _count(target: Peer, count: int, mission_type: int, opaque_id: int = 0) -> Message:
    return _with_extensions(mavlink.MAVLink_mission_count_message, *target, count, mission_type, opaque_id=opaque_id)


def _request(target: Peer, seq: int, mission_type: int, as_float: bool) -> Message:
    if as_float:
        return mavlink.MAVLink_mission_request_message(*target, seq, mission_type)
    return mavlink.MAVLink_mission_request_int_message(*target, seq, mission_type)


class _Finished(NamedTuple):
    """The upload that ended last, for a client that did not hear of it."""

    peer: Peer
    mission_type: int
    seq: int
    """its last item that we looked at"""
    result: int
    opaque_id: int


class MissionServer:
    """The vehicle's half on one link.

    Each MISSION_ACK belongs to the client whose ids it carries, and should reach no other: MAVSDK looks at neither the
    target nor the type of those it sees.

    Attributes:
        current_interval_us: MISSION_CURRENT comes this often and whenever what it tells changes. None: never by itself.
        timeouts: uploads given up.
    """

    def __init__(self, stores: MissionStores, current_interval_us: int | None = 1_000_000) -> None:
        self.current_interval_us = current_interval_us
        self.timeouts = 0
        self._stores = stores
        self._finished: _Finished | None = None
        self._finished_us = 0
        self._served: _Transaction | None = None
        """The download that ended last: its client may miss the last item still."""
        self._told: tuple[object, ...] | None = None
        self._told_us = 0
        self._reached_seen = stores.reached_total
        self._reached_told = REACHED_REPEATS
        self._handlers: dict[int, Callable[[Any, Peer, int], Sequence[Message]]] = {
            mavlink.MAVLINK_MSG_ID_MISSION_COUNT: self._on_count,
            mavlink.MAVLINK_MSG_ID_MISSION_ITEM_INT: self._on_item,
            mavlink.MAVLINK_MSG_ID_MISSION_ITEM: self._on_item,
            mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_LIST: self._on_list,
            mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_INT: self._on_request,
            mavlink.MAVLINK_MSG_ID_MISSION_REQUEST: self._on_request,
            mavlink.MAVLINK_MSG_ID_MISSION_ACK: self._on_ack,
            mavlink.MAVLINK_MSG_ID_MISSION_CLEAR_ALL: self._on_clear,
            mavlink.MAVLINK_MSG_ID_MISSION_SET_CURRENT: self._on_set_current,
            mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_PARTIAL_LIST: self._on_partial,
            mavlink.MAVLINK_MSG_ID_MISSION_WRITE_PARTIAL_LIST: self._on_partial,
        }
        self.message_ids = frozenset(self._handlers)
        """What `receive` wants to see."""

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        """One of the mission protocol's messages, addressed to us; others are ignored."""
        handler = self._handlers.get(type(message).id)
        return NOTHING if handler is None else handler(message, sender, now_us)

    def step(self, now_us: int) -> Sequence[Message]:
        """Repeated requests, the end of a silent transaction, MISSION_CURRENT and MISSION_ITEM_REACHED."""
        out: list[Message] = []
        transaction = self._stores.transaction
        if transaction is not None and transaction.server is self:
            out.extend(self._watch(transaction, now_us))
        out.extend(self._tell(now_us))
        return out or NOTHING

    def current_message(self) -> Message:
        """MISSION_CURRENT as of now, for MAV_CMD_REQUEST_MESSAGE and the like."""
        status = self._stores.status()
        return _with_extensions(
            mavlink.MAVLink_mission_current_message,
            status.seq,
            status.total,
            status.state,
            status.mode,
            mission_id=self._stores.id(MISSION),
            fence_id=self._stores.id(FENCE),
            rally_points_id=self._stores.id(RALLY),
        )

    # --- the transaction

    def _running(self, sender: Peer) -> _Transaction | None:
        """This client's own transaction."""
        transaction = self._stores.transaction
        if transaction is not None and transaction.server is self and transaction.peer == sender:
            return transaction
        return None

    def _is_taken(self, sender: Peer, now_us: int) -> bool:
        """Whether somebody else's transaction stands in the way."""
        transaction = self._stores.transaction
        if transaction is None or self._running(sender) is not None:
            return False
        # Its own server ends it too, but on a link that is stepped no more nobody would.
        if transaction.all_served or not 0 <= now_us - transaction.progress_us < GIVE_UP_US:
            transaction.server._end(transaction)
            return False
        return True

    def _end(self, transaction: _Transaction) -> None:
        self._stores.transaction = None
        if not transaction.upload:
            self._served = transaction

    def _drop_own(self, sender: Peer) -> None:
        """A client that begins something new has left what it began before."""
        transaction = self._running(sender)
        if transaction is not None:
            self._end(transaction)
        if self._served is not None and self._served.peer == sender:
            self._served = None

    def _watch(self, transaction: _Transaction, now_us: int) -> Sequence[Message]:
        if now_us - transaction.progress_us >= GIVE_UP_US:
            self._end(transaction)
            if not transaction.upload:
                return NOTHING
            self.timeouts += 1
            name, have = _NAMES[transaction.mission_type], len(transaction.buffer)
            self._stores.report(
                mavlink.MAV_SEVERITY_WARNING,
                f"{name} upload given up: item {have} of {transaction.count} missing {GIVE_UP_US / 1e6:g} s",
            )
            return (_ack(transaction.peer, CANCELLED, transaction.mission_type),)
        if transaction.upload and now_us - transaction.sent_us >= REQUEST_RETRY_US:
            transaction.unanswered += 1
            if transaction.unanswered % REQUESTS_PER_KIND == 0 and not transaction.speaks_int:
                transaction.as_float = not transaction.as_float
            return (self._ask(transaction, now_us),)
        return NOTHING

    def _ask(self, transaction: _Transaction, now_us: int) -> Message:
        transaction.sent_us = now_us
        return _request(transaction.peer, len(transaction.buffer), transaction.mission_type, transaction.as_float)

    # --- upload

    def _on_count(self, message: Any, sender: Peer, now_us: int) -> Sequence[Message]:
        mission_type, count = message.mission_type, message.count
        limit = self._stores.limits.get(mission_type)
        if limit is None:
            return (_ack(sender, UNSUPPORTED, mission_type),)
        if self._is_taken(sender, now_us):
            return self._busy(sender, mission_type)
        own = self._running(sender)
        began_us = now_us
        if own is not None and own.upload and not own.buffer and (own.mission_type, own.count) == (mission_type, count):
            # Repeating itself without ever sending an item is no progress: others would wait for ever.
            began_us = own.progress_us
        self._drop_own(sender)
        if count > limit:
            self._stores.report(
                mavlink.MAV_SEVERITY_WARNING, f"{_NAMES[mission_type]} refused: {count} items, at most {limit}"
            )
            return (_ack(sender, NO_SPACE, mission_type),)
        if count == 0:
            self._stores.replace(mission_type, ())
            return (_ack(sender, ACCEPTED, mission_type),)
        transaction = _Transaction(self, sender, mission_type, True, count, began_us)
        self._stores.transaction = transaction
        return (self._ask(transaction, now_us),)

    def _on_item(self, message: Any, sender: Peer, now_us: int) -> Sequence[Message]:
        transaction = self._running(sender)
        if transaction is None or not transaction.upload or transaction.mission_type != message.mission_type:
            return self._on_stray_item(message, sender, now_us)
        expected = len(transaction.buffer)
        if message.seq != expected:
            if message.seq == expected - 1 and now_us - transaction.sent_us >= ECHO_US:
                return (self._ask(transaction, now_us),)
            return NOTHING
        item = item_from_message(message)
        if isinstance(item, int):
            return self._finish(transaction, item, expected, now_us)
        result = check_item(transaction.mission_type, item)
        if result == ACCEPTED:
            result = self._stores.check(transaction.mission_type, expected, item)
        if result != ACCEPTED:
            return self._finish(transaction, result, expected, now_us)
        transaction.buffer.append(item)
        transaction.progress_us = now_us
        transaction.unanswered = 0
        transaction.as_float = type(message).id == mavlink.MAVLINK_MSG_ID_MISSION_ITEM
        transaction.speaks_int = transaction.speaks_int or not transaction.as_float
        if message.current == 1:
            transaction.start_seq = expected
        if len(transaction.buffer) < transaction.count:
            return (self._ask(transaction, now_us),)
        result, blamed = self._stores.validate(transaction.mission_type, transaction.buffer)
        return self._finish(transaction, result, blamed, now_us)

    def _finish(self, transaction: _Transaction, result: int, blamed: int, now_us: int) -> Sequence[Message]:
        peer, mission_type = transaction.peer, transaction.mission_type
        self._end(transaction)
        opaque_id = 0
        if result == ACCEPTED:
            self._stores.replace(mission_type, transaction.buffer, transaction.start_seq)
            opaque_id = self._stores.id(mission_type)
        else:
            name = mavlink.enums["MAV_MISSION_RESULT"][result].name.removeprefix("MAV_MISSION_")
            self._stores.report(
                mavlink.MAV_SEVERITY_WARNING, f"{_NAMES[mission_type]} refused: item {blamed}: {name} ({result})"
            )
        # After a refusal the item looked at last is not in the buffer, unless the whole was refused.
        looked_at = min(len(transaction.buffer), transaction.count - 1)
        self._finished = _Finished(peer, mission_type, looked_at, result, opaque_id)
        self._finished_us = now_us
        return (_ack(peer, result, mission_type, opaque_id),)

    def _on_stray_item(self, message: Any, sender: Peer, now_us: int) -> Sequence[Message]:
        """An item of no upload of this client that runs."""
        mission_type = message.mission_type
        if message.current in (2, 3):
            # ArduPilot's way to fly somewhere: a single item marked as current 2 (3: altitude alone).
            return (_ack(sender, UNSUPPORTED, mission_type),)
        finished = self._finished if now_us - self._finished_us < GIVE_UP_US else None
        if finished is not None and (finished.peer, finished.mission_type) == (sender, mission_type):
            if message.seq == finished.seq:
                # Our acknowledgement was lost, or this is an echo of the item.
                if now_us - self._finished_us < ACK_ECHO_US:
                    return NOTHING
                self._finished_us = now_us
                return (_ack(sender, finished.result, mission_type, finished.opaque_id),)
            if message.seq < finished.seq:
                return NOTHING
        if self._is_taken(sender, now_us):
            return self._busy(sender, mission_type)
        return (_ack(sender, ERROR, mission_type),)

    def _on_ack(self, message: Any, sender: Peer, now_us: int) -> Sequence[Message]:
        transaction = self._running(sender)
        if transaction is None or transaction.mission_type != message.mission_type:
            return NOTHING
        if not transaction.upload:
            self._end(transaction)
        elif message.type == UNSUPPORTED:
            transaction.as_float = not transaction.as_float
            transaction.unanswered = 0
            return (self._ask(transaction, now_us),)
        elif message.type != ACCEPTED:
            self._end(transaction)
        return NOTHING

    # --- download

    def _on_list(self, message: Any, sender: Peer, now_us: int) -> Sequence[Message]:
        mission_type = message.mission_type
        if mission_type not in self._stores.limits:
            return (_ack(sender, UNSUPPORTED, mission_type),)
        if self._is_taken(sender, now_us):
            return self._busy(sender, mission_type)
        self._drop_own(sender)
        items = self._stores.items(mission_type)
        if items:
            transaction = _Transaction(self, sender, mission_type, False, len(items), now_us, snapshot=items)
            self._stores.transaction = transaction
        return (_count(sender, len(items), mission_type, self._stores.id(mission_type)),)

    def _on_request(self, message: Any, sender: Peer, now_us: int) -> Sequence[Message]:
        """An item, for anybody who asks while nobody else's transaction runs: reading does no harm."""
        mission_type, seq = message.mission_type, message.seq
        transaction = self._running(sender)
        if transaction is not None and not transaction.upload and transaction.mission_type == mission_type:
            items = transaction.snapshot
            if seq < len(items):
                transaction.progress_us = now_us
                transaction.all_served = transaction.all_served or seq == len(items) - 1
        elif self._served is not None and (self._served.peer, self._served.mission_type) == (sender, mission_type):
            items = self._served.snapshot
        elif mission_type not in self._stores.limits:
            return (_ack(sender, UNSUPPORTED, mission_type),)
        elif self._is_taken(sender, now_us):
            return self._busy(sender, mission_type)
        else:
            items = self._stores.items(mission_type)
        if seq >= len(items):
            return (_ack(sender, INVALID_SEQUENCE, mission_type),)
        current = mission_type == MISSION and seq == self._stores.status().seq
        as_float = type(message).id == mavlink.MAVLINK_MSG_ID_MISSION_REQUEST
        return (item_message(items[seq], sender, mission_type, seq, current, as_float),)

    # --- the rest

    def _on_clear(self, message: Any, sender: Peer, now_us: int) -> Sequence[Message]:
        mission_type = message.mission_type
        if mission_type != ALL and mission_type not in self._stores.limits:
            return (_ack(sender, UNSUPPORTED, mission_type),)
        if self._is_taken(sender, now_us):
            return self._busy(sender, mission_type)
        self._drop_own(sender)
        for cleared in sorted(self._stores.limits) if mission_type == ALL else (mission_type,):
            if self._stores.items(cleared):
                self._stores.replace(cleared, ())
        return (_ack(sender, ACCEPTED, mission_type),)

    def _on_set_current(self, message: Any, sender: Peer, now_us: int) -> Sequence[Message]:
        if self._stores.set_current(message.seq):
            return (self.current_message(),)
        total = len(self._stores.items(MISSION))
        self._stores.report(mavlink.MAV_SEVERITY_WARNING, f"Mission item {message.seq} refused: there are {total}")
        # No MISSION_CURRENT here: MAVSDK answers one that tells another item with MISSION_SET_CURRENT at once.
        return (_ack(sender, INVALID_SEQUENCE, MISSION),)

    def _on_partial(self, message: Any, sender: Peer, now_us: int) -> Sequence[Message]:
        return (_ack(sender, UNSUPPORTED, message.mission_type),)

    def _busy(self, sender: Peer, mission_type: int) -> Sequence[Message]:
        return (_ack(sender, DENIED, mission_type),)

    def _tell(self, now_us: int) -> Sequence[Message]:
        if self.current_interval_us is None:
            return NOTHING
        stores = self._stores
        state = (stores.status(), stores.id(MISSION), stores.id(FENCE), stores.id(RALLY))
        # A clock that was set back (a restart of the vehicle's time) makes it due as well.
        due = not 0 <= now_us - self._told_us < self.current_interval_us
        fresh = stores.reached_total != self._reached_seen
        if state == self._told and not due and not fresh:
            return NOTHING
        out: list[Message] = []
        if fresh:
            for seq in stores.reached_since(self._reached_seen):
                out.append(mavlink.MAVLink_mission_item_reached_message(seq))
            self._reached_seen = stores.reached_total
            self._reached_told = 0
        elif due and stores.last_reached is not None and self._reached_told < REACHED_REPEATS:
            out.append(mavlink.MAVLink_mission_item_reached_message(stores.last_reached))
            self._reached_told += 1
        if state != self._told or due:
            out.append(self.current_message())
            self._told, self._told_us = state, now_us
        return out


# ------------------------------------------------------------------------------------------------------------- who asks

_IDLE, _UPLOAD, _DOWNLOAD, _CLEAR, _SET_CURRENT = "idle", "upload", "download", "clear", "set current"


class MissionClient:
    """The ground's half: one job at a time, repeated until it is done or nothing has moved for 5 s.

    It answers a MISSION_REQUEST as if it were a MISSION_REQUEST_INT, which MAVLink has asked for since 2020.

    Attributes:
        result: MAV_MISSION_RESULT of the last job; None while it runs and where no answer came.
        items: what the last download brought; complete when `result` is MAV_MISSION_ACCEPTED.
        timed_out: the last job was given up.
        current: the newest MISSION_CURRENT of the vehicle, None before.
        reached: seq of the newest MISSION_ITEM_REACHED, None before.
    """

    RETRY_US = 500_000
    """Repeats of MISSION_COUNT, MISSION_REQUEST_LIST, MISSION_CLEAR_ALL, MISSION_SET_CURRENT and the last item."""

    def __init__(self, target: Peer) -> None:
        self.target = target
        self.result: int | None = None
        self.items: list[MissionItem] = []
        self.timed_out = False
        self.current: Message | None = None
        self.reached: int | None = None
        self._job = _IDLE
        self._mission_type = MISSION
        self._plan: tuple[MissionItem, ...] = ()
        self._count: int | None = None
        self._seq = -1
        self._due_us: int | None = None
        self._progress_us: int | None = None

    @property
    def busy(self) -> bool:
        return self._job != _IDLE

    @property
    def progress(self) -> tuple[int, int]:
        """(items done, items in all) of the transfer."""
        if self._job == _UPLOAD:
            return self._seq + 1, len(self._plan)
        return len(self.items), self._count or 0

    def upload(self, mission_type: int, items: Sequence[MissionItem]) -> None:
        """Replace a plan of the vehicle; none is left of an empty one."""
        self._begin(_UPLOAD, mission_type)
        self._plan = tuple(items)

    def download(self, mission_type: int) -> None:
        self._begin(_DOWNLOAD, mission_type)
        self.items = []

    def clear(self, mission_type: int) -> None:
        """`mission_type` 255: all three."""
        self._begin(_CLEAR, mission_type)

    def set_current(self, seq: int) -> None:
        self._begin(_SET_CURRENT, MISSION)
        self._seq = seq

    def cancel(self) -> Sequence[Message]:
        """Leave the job; the messages that tell the vehicle."""
        told = (_ack(self.target, CANCELLED, self._mission_type),) if self._job in (_UPLOAD, _DOWNLOAD) else NOTHING
        self._job = _IDLE
        return told

    def step(self, now_us: int) -> Sequence[Message]:
        if self._job == _IDLE:
            return NOTHING
        if self._progress_us is None:
            self._progress_us = now_us
        if now_us - self._progress_us >= GIVE_UP_US:
            self._job, self.timed_out = _IDLE, True
            return NOTHING
        if self._due_us is not None and now_us < self._due_us:
            return NOTHING
        return (self._next(now_us),)

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        """What the vehicle says; messages of anybody else are ignored."""
        if sender != self.target:
            return NOTHING
        message_id = type(message).id
        if message_id == mavlink.MAVLINK_MSG_ID_MISSION_CURRENT:
            self.current = message
            if self._job == _SET_CURRENT and message.seq == self._seq:
                self._done(ACCEPTED)
            return NOTHING
        if message_id == mavlink.MAVLINK_MSG_ID_MISSION_ITEM_REACHED:
            self.reached = message.seq
            return NOTHING
        if self._job == _IDLE or getattr(message, "mission_type", None) != self._mission_type:
            return NOTHING
        if message_id == mavlink.MAVLINK_MSG_ID_MISSION_ACK:
            self._on_ack(message)
        elif self._job == _UPLOAD:
            return self._on_request(message, message_id, now_us)
        elif self._job == _DOWNLOAD:
            return self._on_plan(message, message_id, now_us)
        return NOTHING

    def _begin(self, job: str, mission_type: int) -> None:
        self._job, self._mission_type = job, mission_type
        self._count, self._seq = None, -1
        self._due_us = self._progress_us = None
        self.result, self.timed_out = None, False

    def _done(self, result: int) -> None:
        self._job, self.result = _IDLE, result

    def _next(self, now_us: int) -> Message:
        """What is said now and, unless it is answered, said again."""
        self._due_us = now_us + self.RETRY_US
        if self._job == _CLEAR:
            return mavlink.MAVLink_mission_clear_all_message(*self.target, self._mission_type)
        if self._job == _SET_CURRENT:
            return mavlink.MAVLink_mission_set_current_message(*self.target, self._seq)
        if self._job == _UPLOAD:
            if self._seq < 0:
                return _count(self.target, len(self._plan), self._mission_type)
            current = self._mission_type == MISSION and self._seq == 0
            item = self._plan[self._seq]
            return item_message(item, self.target, self._mission_type, self._seq, current)
        if self._count is None:
            return mavlink.MAVLink_mission_request_list_message(*self.target, self._mission_type)
        self._due_us = now_us + REQUEST_RETRY_US
        return _request(self.target, len(self.items), self._mission_type, False)

    def _on_ack(self, message: Any) -> None:
        early = self._job == _UPLOAD and self._seq < len(self._plan) - 1
        if message.type != ACCEPTED or not (early or self._job == _DOWNLOAD):
            self._done(message.type)

    def _on_request(self, message: Any, message_id: int, now_us: int) -> Sequence[Message]:
        if message_id not in (
            mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_INT,
            mavlink.MAVLINK_MSG_ID_MISSION_REQUEST,
        ) or message.seq >= len(self._plan):
            return NOTHING
        if message.seq > self._seq:
            self._progress_us = now_us
        self._seq = message.seq
        return (self._next(now_us),)

    def _on_plan(self, message: Any, message_id: int, now_us: int) -> Sequence[Message]:
        if message_id == mavlink.MAVLINK_MSG_ID_MISSION_COUNT:
            if self._count is not None:
                return NOTHING
            self._count = message.count
        elif message_id in (mavlink.MAVLINK_MSG_ID_MISSION_ITEM_INT, mavlink.MAVLINK_MSG_ID_MISSION_ITEM):
            if self._count is None or message.seq != len(self.items):
                return NOTHING
            item = item_from_message(message)
            if isinstance(item, int):
                self._done(item)
                return (_ack(self.target, item, self._mission_type),)
            self.items.append(item)
        else:
            return NOTHING
        self._progress_us = now_us
        if len(self.items) < self._count:
            return (self._next(now_us),)
        self._done(ACCEPTED)
        return (_ack(self.target, ACCEPTED, self._mission_type),)
