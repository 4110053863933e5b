"""Protocol chaos: a vehicle that breaks MAVLink's rules on command, by name, for tests of its clients.

`table.TABLE` holds the modes. `Chaos` belongs to one vehicle: what has begun on a port stands between that port's node
and its services. Where nothing has begun, nothing is there. Time is the vehicle's, chance is seeded by port and mode:
the same flight misbehaves the same way again.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from heapq import heappop, heappush
from math import inf
from typing import TYPE_CHECKING

from mavsitl.chaos.base import Message, Mode, Peer
from mavsitl.chaos.table import ALL_PORTS, PORTS, TABLE, ChaosError, Spec, parse
from mavsitl.codec import Frame, encode, renumber
from mavsitl.codec import parse as parse_frames
from mavsitl.node import Node

if TYPE_CHECKING:
    import numpy as np

    from mavsitl.scenario import ChaosWindow

__all__ = ["ALL_PORTS", "PORTS", "TABLE", "Chaos", "ChaosError", "parse"]


class Chaos:
    """What misbehaves on the ports of one vehicle.

    Modes act in the order in which they began: what one lets out goes through those after it. `begin`, `end`, `during`
    and `clear` may be called from another thread than the vehicle's, one at a time.
    """

    def __init__(
        self,
        nodes: Sequence[tuple[str, Node]],
        seed: int,
        *,
        now_us: int = 0,
        parameters: Collection[str] = (),
        note: Callable[[str], None] = lambda text: None,
    ) -> None:
        """`nodes`: each port's name and node. `now_us`: the last tick. `parameters`: the names that there are.

        `note` is told what begins and ends.
        """
        self._ports = [_Port(name, index, node, seed) for index, (name, node) in enumerate(nodes)]
        self._parameters = parameters
        self._note = note
        self._active: dict[tuple[str, str], Spec] = {}
        """By what was asked for and the port's name."""
        self._windows: list[ChaosWindow] = []
        self._scheduled: dict[tuple[str, str], None] = {}
        """What is on because one of the windows is open."""
        for each in self._ports:
            each.now_us = now_us

    @property
    def active(self) -> tuple[str, ...]:
        """What is on, each as ``NAME[:ARGUMENT...]@PORT``."""
        return tuple(f"{mode}@{port}" for mode, port in self._active)

    def begin(self, mode: str, port: str | None = None) -> None:
        """Begin ``NAME[:ARGUMENT...][@PORT]``, on `port` where that names none: "offboard", "gcs", or "all".

        Raises `ChaosError`: no such mode, argument, port or parameter, or it is on already.
        """
        key, spec = self._key(mode, port)
        if key in self._active:
            raise ChaosError(f"chaos mode '{key[0]}' on port '{key[1]}' is on already")
        self._active[key] = spec
        for each in self._ports:
            if key[1] in (ALL_PORTS, each.name):
                each.begin(key, spec)
        self._note(f"chaos: {key[0]} on port {key[1]} begins")

    def end(self, mode: str, port: str | None = None) -> None:
        """End what `begin` began with the same words. Raises `ChaosError` where that is not on."""
        key, _ = self._key(mode, port)
        if key not in self._active:
            raise ChaosError(f"chaos mode '{key[0]}' on port '{key[1]}' is not on; on: {', '.join(self.active) or '-'}")
        del self._active[key]
        for each in self._ports:
            each.end(key)
        self._note(f"chaos: {key[0]} on port {key[1]} ends")

    def check(self, mode: str, port: str | None = None) -> None:
        """Raise what `begin` would of a mode that is none."""
        self._key(mode, port)

    def clear(self) -> None:
        """End all that is on."""
        for mode, port in tuple(self._active):
            self.end(mode, port)

    @contextmanager
    def during(self, *modes: str, port: str | None = None) -> Iterator[Chaos]:
        """``with vehicle.chaos.during("ack-lost"): ...``: on inside, off after."""
        begun: list[str] = []
        try:
            for mode in modes:
                self.begin(mode, port)
                begun.append(mode)
            yield self
        finally:
            for mode in begun:
                if self._key(mode, port)[0] in self._active:
                    self.end(mode, port)

    def schedule(self, windows: Sequence[ChaosWindow]) -> None:
        """A scenario's `[[chaos]]`: each is on in its time window. Raises `ChaosError` as `begin`.

        Where windows of one mode and port overlap, it is on while one of them is open.
        """
        for window in windows:
            self._key(window.mode, window.port)
        self._windows += windows

    def step(self, now_us: int, flight_time_s: float) -> None:
        """Once a tick, before anything is sent: begin and end what is scheduled, and let modes act by themselves."""
        for each in self._ports:
            each.now_us = now_us
        if self._windows:
            self._keep_schedule(now_us * 1e-6, flight_time_s)
        for each in self._ports:
            each.step()

    def _keep_schedule(self, simulated_s: float, flight_time_s: float) -> None:
        wanted: dict[tuple[str, str], None] = {}
        for window in self._windows:
            clock_s = simulated_s if window.clock == "simulated" else flight_time_s
            end_s = inf if window.duration_s is None else window.start_s + window.duration_s
            if window.start_s <= clock_s < end_s:
                wanted[window.mode, window.port] = None
        before, self._scheduled = self._scheduled, wanted
        for key in wanted:
            if key not in before and key not in self._active:
                self.begin(*key)
        for key in before:
            if key not in wanted and key in self._active:
                self.end(*key)

    def _key(self, mode: str, port: str | None) -> tuple[tuple[str, str], Spec]:
        spec = parse(mode)
        if port is not None and port not in PORTS:
            raise ChaosError(f"chaos mode '{mode}': port '{port}' is not allowed; allowed: {', '.join(PORTS)}")
        words, at, named = mode.partition("@")
        where = named if at else port or ALL_PORTS
        has = dict.fromkeys(each.name for each in self._ports)
        if where not in (ALL_PORTS, *has):
            raise ChaosError(f"chaos mode '{mode}': this vehicle has no port '{where}'; it has: {', '.join(has)}")
        for argument, value in zip(TABLE[spec.name].arguments, spec.values, strict=True):
            if argument.is_parameter and self._parameters and value not in self._parameters:
                raise ChaosError(f"chaos mode '{mode}': the vehicle has no parameter '{value}'")
        return (words, where), spec


class _Line:
    """See `mavsitl.chaos.base.Line`."""

    def __init__(self, port: _Port, mode: Mode, name: str) -> None:
        self._port = port
        self._mode = mode
        self._name = name
        self._random: np.random.Generator | None = None

    @property
    def now_us(self) -> int:
        return self._port.now_us

    @property
    def address(self) -> Peer:
        return self._port.node.address

    @property
    def random(self) -> np.random.Generator:
        if self._random is None:
            from mavsitl import seeds  # here, for it loads numpy

            self._random = seeds.generator(self._port.seed, "chaos", self._port.index, self._name)
        return self._random

    def send(self, message: Message, after_s: float = 0.0) -> None:
        self._port.hold(self._mode, message, round(after_s * 1e6))


class _Port:
    """The modes on one port: what its node calls `tamper`, while there are any."""

    def __init__(self, name: str, index: int, node: Node, seed: int) -> None:
        self.name = name
        self.index = index
        self.node = node
        self.seed = seed
        self.now_us = 0
        self._modes: dict[tuple[str, str], Mode] = {}
        self._held: list[tuple[int, int, Mode, Message]] = []
        """(due us, order, the mode behind which it goes out, message), soonest first."""
        self._order = 0
        self._out: list[tuple[int, bytes | None, Message]] = []
        """(message id, frame as it was packed, message): one of the two is there."""

    def begin(self, key: tuple[str, str], spec: Spec) -> None:
        mode = spec.make()
        mode.line = _Line(self, mode, spec.name)
        self._modes = {**self._modes, key: mode}  # another one, for the vehicle's thread may go through the old
        self.node.tamper = self

    def end(self, key: tuple[str, str]) -> None:
        """What the mode held back still goes out when it is due."""
        self._modes = {other: mode for other, mode in self._modes.items() if other != key}

    def step(self) -> None:
        for mode in tuple(self._modes.values()):
            mode.step()
        self.node.tamper = self if self._modes or self._held else None

    def hold(self, mode: Mode, message: Message, after_us: int) -> None:
        self._order += 1
        heappush(self._held, (self.now_us + after_us, self._order, mode, message))

    # --- what the node calls

    def incoming(self, frames: Sequence[Frame]) -> list[Frame]:
        """The frames that the vehicle gets in the place of these. Those for others, and nobody's, pass."""
        passed = []
        for frame in frames:
            replaced: Frame | None = frame
            sender = (frame.system_id, frame.component_id)
            for mode in self._modes.values():
                assert replaced is not None
                if not _wants(mode.takes, replaced.message_id) or not self.node.addressed_to(frame):
                    continue
                message = replaced.message
                instead = mode.incoming(message, sender)
                if instead is None:
                    replaced = None
                    break
                if instead is not message:
                    # As it would have come over the wire, so that it has all that a received message has.
                    (replaced,) = parse_frames(encode(instead, frame.sequence, *sender))
            if replaced is not None:
                passed.append(replaced)
        return passed

    def outgoing(self, frames: Sequence[bytes], sequence: int) -> tuple[list[bytes], int]:
        """What goes out in the place of `frames`, and the sequence number after it; `sequence` is that after `frames`.

        It is numbered anew, so that what was held back leaves no gap. Frames of others pass as they are.
        """
        own = self.node.address
        modes = tuple(self._modes.values())
        self._release()
        count = 0
        for frame in frames:
            if _source(frame) != own:
                self._out.append((-1, frame, None))
                continue
            count += 1
            message_id = int.from_bytes(frame[7:10], "little")
            if any(_wants(mode.gives, message_id) for mode in modes):
                (decoded,) = parse_frames(frame)
                self._pass(modes, decoded.message, frame)
            else:
                self._out.append((message_id, frame, None))
        self._release()
        queued, self._out = self._out, []
        return self._number(modes, queued, (sequence - count) & 0xFF)

    def wire(self, frames: Sequence[bytes]) -> list[bytes]:
        """The same, signed where they are signed, as they go onto the wire."""
        for mode in self._modes.values():
            if type(mode).wire is not Mode.wire:
                frames = [each for frame in frames for each in mode.wire(frame)]
        return list(frames)

    # ---

    def _release(self) -> None:
        while self._held and self._held[0][0] <= self.now_us:
            _, _, behind, message = heappop(self._held)
            modes = tuple(self._modes.values())
            after = modes[modes.index(behind) + 1 :] if behind in modes else ()
            self._pass(after, message, None)

    def _pass(self, modes: Sequence[Mode], message: Message, frame: bytes | None) -> None:
        """Through these modes, and out. `frame`: as it was packed, where it was."""
        message_id = type(message).id
        for place, mode in enumerate(modes):
            if not _wants(mode.gives, message_id):
                continue
            instead = mode.outgoing(message)
            if len(instead) == 1 and instead[0] is message:
                continue
            for each in instead:
                self._pass(modes[place + 1 :], each, frame if each is message else None)
            return
        self._out.append((message_id, frame, message))

    def _number(
        self, modes: Sequence[Mode], queued: Sequence[tuple[int, bytes | None, Message]], sequence: int
    ) -> tuple[list[bytes], int]:
        own = self.node.address
        heads = [mode for mode in modes if type(mode).skip is not Mode.skip or type(mode).source is not Mode.source]
        numbered = []
        for message_id, frame, message in queued:
            if message_id < 0:
                assert frame is not None
                numbered.append(frame)
                continue
            source = own
            for mode in heads:
                sequence = (sequence + mode.skip(message_id)) & 0xFF
                source = mode.source(message_id, source)
            if frame is not None and source == own:
                numbered.append(renumber(frame, sequence))
            else:
                if message is None:
                    assert frame is not None
                    (decoded,) = parse_frames(frame)
                    message = decoded.message
                numbered.append(encode(message, sequence, *source))
            sequence = (sequence + 1) & 0xFF
        return numbered, sequence


def _wants(wanted: frozenset[int] | None, message_id: int) -> bool:
    return wanted is None or message_id in wanted


def _source(frame: bytes) -> Peer:
    """System and component id of a frame of either version."""
    return (frame[5], frame[6]) if frame[0] == 0xFD else (frame[3], frame[4])
