"""What the modes of protocol chaos are made of: a mode sees what comes in and goes out on one port, and meddles."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable, Sequence
from copy import copy
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from mavsitl.codec import Message
from mavsitl.dialect import mavlink
from mavsitl.services.base import NOTHING, Peer

if TYPE_CHECKING:
    import numpy as np

__all__ = [
    "NOTHING",
    "Double",
    "Every",
    "Ids",
    "Ignore",
    "Line",
    "Lose",
    "Message",
    "Mode",
    "Peer",
    "Repeats",
    "altered",
    "ids",
]

Ids: TypeAlias = frozenset[int] | None
"""Message ids; None: all."""

NO_IDS: Ids = frozenset()
REMEMBERED = 64
"""Clients, commands, files that a mode keeps in mind; the oldest gives way, so that nobody can fill the memory."""


def ids(*names: str) -> frozenset[int]:
    """Message ids by name."""
    return frozenset(int(getattr(mavlink, f"MAVLINK_MSG_ID_{name}")) for name in names)


def altered(message: Message, **fields: Any) -> Message:
    """The same message with other numbers in some fields; the original stays as it is."""
    changed = copy(message)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


class Line(Protocol):
    """What a mode has of its port."""

    @property
    def now_us(self) -> int:
        """The vehicle's clock at the last tick."""

    @property
    def address(self) -> Peer:
        """The vehicle's own system and component id."""

    @property
    def random(self) -> np.random.Generator:
        """Of this mode on this port alone."""

    def send(self, message: Message, after_s: float = 0.0) -> None:
        """Let a message out behind this mode, now or later."""


class Mode:
    """One way to misbehave, on one port. What a subclass does not override passes as it came.

    Attributes:
        takes: the messages of which `incoming` is asked.
        gives: the messages of which `outgoing` is asked.
        line: the port, from when the mode begins.
    """

    takes: Ids = NO_IDS
    gives: Ids = NO_IDS
    line: Line

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        """What the vehicle gets in the place of `message`, which is meant for it; None: nothing."""
        return message

    def outgoing(self, message: Message) -> Sequence[Message]:
        """What is sent in the place of `message`."""
        return (message,)

    def step(self) -> None:
        """Once a tick."""

    def skip(self, message_id: int) -> int:
        """Sequence numbers left out before the next frame."""
        return 0

    def source(self, message_id: int, own: Peer) -> Peer:
        """The system and component id that the next frame carries."""
        return own

    def wire(self, frame: bytes) -> Sequence[bytes]:
        """What becomes of a whole frame, its signature and checksum included."""
        return (frame,)


class Repeats:
    """Counts how often each key came, and begins anew after `limit`: for what fails so often and then succeeds."""

    def __init__(self, limit: int = 1) -> None:
        self._limit = limit
        self._counts: OrderedDict[Hashable, int] = OrderedDict()

    def fails(self, key: Hashable) -> bool:
        """Whether this time is still one of the first `limit`."""
        count = self._counts.pop(key, 0)
        if count >= self._limit:
            return False
        self._counts[key] = count + 1
        if len(self._counts) > REMEMBERED:
            self._counts.popitem(last=False)
        return True


class Every:
    """True once every `seconds` of the vehicle's time, the first time at once."""

    def __init__(self, seconds: float) -> None:
        self._period_us = max(round(seconds * 1e6), 1)
        self._due_us: int | None = None

    def due(self, now_us: int) -> bool:
        if self._due_us is None:
            self._due_us = now_us
        if now_us < self._due_us:
            return False
        self._due_us += self._period_us
        return True


class Lose(Mode):
    """What the vehicle sends of these kinds is lost."""

    def __init__(self, *names: str) -> None:
        self.gives = ids(*names)

    def outgoing(self, message: Message) -> Sequence[Message]:
        return NOTHING


class Double(Mode):
    """What the vehicle sends of these kinds comes twice."""

    def __init__(self, *names: str) -> None:
        self.gives = ids(*names)

    def outgoing(self, message: Message) -> Sequence[Message]:
        return (message, message)


class Ignore(Mode):
    """What comes of these kinds is not looked at."""

    def __init__(self, *names: str) -> None:
        self.takes = ids(*names)

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        return None
