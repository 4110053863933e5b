"""What every MAVLink service has in common: two halves, each a step function of messages and time.

A server half answers (the vehicle's), a client half asks (the ground's). Both take a message with its sender and the
time, and return the messages to send on the link it came from; neither knows sockets, sequence numbers or its own
address. A server half belongs to one link: what a client began there is answered there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeAlias

from mavsitl.codec import Message

__all__ = ["NOTHING", "Message", "Peer", "Service"]

Peer: TypeAlias = tuple[int, int]
"""(system id, component id)"""

NOTHING: Sequence[Message] = ()
"""The usual answer of a `step`: no list is made for it."""


class Service(Protocol):
    """Either half of a service on one link."""

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        """A message of this service that is addressed to us. Never raises on what is in it."""

    def step(self, now_us: int) -> Sequence[Message]:
        """What is due by now: repeats, paced lists, time-outs."""
