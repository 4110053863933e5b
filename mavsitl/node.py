"""One MAVLink endpoint on one link, without I/O: datagrams in, frames out; messages in, datagrams out.

It numbers what it sends, counts what it gets, knows its peers' losses and tells which frames are meant for it. A second
link of the same component gets a node of its own: sequence numbers count per link.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from mavsitl.codec import Counters, Frame, Message, Packer, encode, parse
from mavsitl.signing import LinkSigning

__all__ = ["DATAGRAM_BYTES", "MAX_SOURCES", "Node", "SourceStatistics", "Tamper"]

DATAGRAM_BYTES = 1400
"""Combined datagrams end here: an Ethernet packet's 1500 bytes less IP and UDP headers and room for a tunnel."""

MAX_SOURCES = 64
"""Sources whose losses are followed; above it the one not heard for longest gives way."""

_LATE = 128  # a step of half the sequence's circle or more is a step back
_LATE_RUN = 8  # so many steps back in a row are a sender that began anew


@dataclass(slots=True)
class SourceStatistics:
    """What came from one (system id, component id), by its sequence numbers."""

    sequence: int
    """the newest sequence number seen"""
    received: int = 1
    lost: int = 0
    """numbers skipped and not seen since"""
    late: int = 0
    """frames that came after a newer one, or twice"""
    restarts: int = 0
    """times the sender began to count anew"""
    heard: int = 0
    """the node's count of good frames when this source was last heard"""
    late_run: int = 0

    @property
    def loss(self) -> float:
        """Share of the frames sent that never came, 0 to 1."""
        return self.lost / (self.received + self.lost)

    def update(self, sequence: int) -> None:
        """Take in the sequence number of one more frame."""
        self.received += 1
        step = (sequence - self.sequence) & 0xFF
        if 0 < step < _LATE:
            if step > 1:
                self.lost += step - 1
            self.sequence = sequence
            self.late_run = 0
            return
        self.late += 1
        self.late_run += 1
        if self.late_run >= _LATE_RUN:
            self.restarts += 1
            self.sequence = sequence
            self.late_run = 0
        elif step and self.lost:
            self.lost -= 1


class Tamper(Protocol):
    """What stands between a node and its link where the endpoint is to misbehave: `mavsitl.chaos`."""

    def incoming(self, frames: Sequence[Frame]) -> list[Frame]:
        """What is handed on of the frames that came; for whoever dispatches them."""

    def outgoing(self, frames: Sequence[bytes], sequence: int) -> tuple[list[bytes], int]:
        """What goes out in the place of `frames`, not signed yet, and the sequence number that comes after it.

        `sequence` is the one after `frames`.
        """

    def wire(self, frames: Sequence[bytes]) -> list[bytes]:
        """What goes out in the place of whole frames."""


class Node:
    """A MAVLink endpoint: `send` and `datagrams` outwards, `receive` inwards.

    Attributes:
        system_id, component_id: its own address, 1 to 255 each.
        counters: what became of the input, see `mavsitl.codec.Counters`.
        own_frames: frames dropped because they carry the node's own address (an echo).
        sources: statistics by (system id, component id), at most `MAX_SOURCES`.
        sequence: number of the next frame, 0 to 255.
        signing: signs and checks what passes, see `mavsitl.signing`; None for a link that knows no signatures.
        tamper: makes the endpoint misbehave, see `mavsitl.chaos`; None for one that behaves.
    """

    def __init__(self, system_id: int, component_id: int, signing: LinkSigning | None = None) -> None:
        for name, value in (("system_id", system_id), ("component_id", component_id)):
            if not 1 <= value <= 255:
                raise ValueError(f"{name} is {value}; allowed: 1 to 255")
        self.system_id = system_id
        self.component_id = component_id
        self.counters = Counters()
        self.own_frames = 0
        self.signing = signing
        self.tamper: Tamper | None = None
        self.sources: dict[tuple[int, int], SourceStatistics] = {}
        self.sequence = 0
        self._addresses = {(system, component) for system in (0, system_id) for component in (0, component_id)}
        self._outbox: list[bytes] = []

    def continue_from(self, sequence: int) -> None:
        """Let the next frame carry this sequence number, 0 to 255: others of this component were sent before."""
        self.sequence = sequence & 0xFF

    def send(self, pack: Packer, *fields: object) -> None:
        """Queue one frame: `pack` is a function that `mavsitl.codec.packer` made, `fields` are its fields.

        Raises:
            EncodeError: the fields do not fit; nothing is queued and no sequence number used.
        """
        self._outbox.append(pack(self.sequence, self.system_id, self.component_id, *fields))
        self.sequence = (self.sequence + 1) & 0xFF

    def queue(self, frame: bytes) -> None:
        """Queue a frame of its own that was packed with `sequence` and the node's address: what goes out every period.

        As `send`, and cheaper than handing the fields on.
        """
        self._outbox.append(frame)
        self.sequence = (self.sequence + 1) & 0xFF

    def send_message(self, message: Message) -> None:
        """Queue one message object. Raises `EncodeError` as `send` does."""
        self._outbox.append(encode(message, self.sequence, self.system_id, self.component_id))
        self.sequence = (self.sequence + 1) & 0xFF

    def forward(self, frame: bytes) -> None:
        """Queue another component's frame as it is, with its sequence number and signature."""
        self._outbox.append(frame)

    @property
    def queued(self) -> int:
        """Frames that wait for `datagrams`."""
        return len(self._outbox)

    def lose(self, kept: int) -> None:
        """Drop the queued frames but the first `kept`, as a link does that is down: their numbers are used."""
        del self._outbox[kept:]

    def datagrams(self, combine: bool = False, max_bytes: int = DATAGRAM_BYTES) -> list[bytes]:
        """Take the queued frames as datagrams, in order.

        Args:
            combine: put as many frames into a datagram as fit, instead of one frame each, which is what PX4 does.
            max_bytes: length of the longest combined datagram; a single longer frame still goes, alone.
        """
        frames, self._outbox = self._outbox, []
        if self.tamper is not None:
            frames, self.sequence = self.tamper.outgoing(frames, self.sequence)
        if self.signing is not None:
            frames = self.signing.outgoing(frames, (self.system_id, self.component_id))
        if self.tamper is not None:
            frames = self.tamper.wire(frames)
        if not combine or len(frames) < 2:
            return frames
        if sum(map(len, frames)) <= max_bytes:
            return [b"".join(frames)]
        datagrams: list[bytes] = []
        first = 0
        length = 0
        for index, frame in enumerate(frames):
            if length and length + len(frame) > max_bytes:
                datagrams.append(b"".join(frames[first:index]))
                first = index
                length = 0
            length += len(frame)
        if length:
            datagrams.append(b"".join(frames[first:]))
        return datagrams

    def receive(self, datagram: bytes) -> list[Frame]:
        """The good frames of one datagram, the node's own left out, whomever they are meant for; never raises.

        With signing those that are not believed are left out too, and every SETUP_SIGNING.
        """
        frames = parse(datagram, self.counters)
        if self.signing is not None:
            frames = self.signing.incoming(frames, (self.system_id, self.component_id))
        sources, heard, echoed = self.sources, self.counters.frames, False
        for frame in frames:
            sender = (frame.system_id, frame.component_id)
            source = sources.get(sender)
            if source is not None:
                source.update(frame.sequence)
            elif sender != self.address:
                source = self._meet(sender, frame.sequence)
            else:
                echoed = True
                continue
            source.heard = heard
        if echoed:
            others = [frame for frame in frames if (frame.system_id, frame.component_id) != self.address]
            self.own_frames += len(frames) - len(others)
            return others
        return frames

    @property
    def address(self) -> tuple[int, int]:
        """(system id, component id)."""
        return self.system_id, self.component_id

    def addressed_to(self, frame: Frame) -> bool:
        """Whether a frame is meant for this node: by target system and component, 0 being everybody.

        A message without target fields is meant for everybody.
        """
        return frame.target in self._addresses

    def _meet(self, sender: tuple[int, int], sequence: int) -> SourceStatistics:
        """A sender not heard before, or forgotten."""
        if len(self.sources) >= MAX_SOURCES:
            del self.sources[min(self.sources, key=lambda known: self.sources[known].heard)]
        source = self.sources[sender] = SourceStatistics(sequence)
        return source
