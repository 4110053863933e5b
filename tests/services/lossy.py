"""Server and client of a service on a link that loses frames, in simulated time: no socket, no sleep, a seed."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from mavsitl.codec import encode, parse
from mavsitl.services.base import Peer, Service

SERVER: Peer = (1, 1)
CLIENT: Peer = (245, 190)
STEP_US = 4_000


@dataclass
class LossyLink:
    """Carries what two halves say to one another; every message goes through the codec, as on a wire.

    `loss` is the share of frames dropped in each direction, `latency_us` the time a frame takes.
    """

    server: Service
    client: Service
    loss: float = 0.0
    seed: int = 1
    latency_us: int = 2_000
    now_us: int = 0
    sent: list[tuple[str, Any]] = field(default_factory=list)
    """(who, message) in order, lost ones included."""
    lost: int = 0

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)
        self._flying: list[tuple[int, str, bytes]] = []
        self._sequence = 0

    def post(self, who: str, messages: Any) -> None:
        """Put messages of "server" or "client" on the link."""
        for message in messages:
            self.sent.append((who, message))
            self._sequence = (self._sequence + 1) & 0xFF
            frame = encode(message, self._sequence, *(SERVER if who == "server" else CLIENT))
            if self._random.random() < self.loss:
                self.lost += 1
            else:
                self._flying.append((self.now_us + self.latency_us, who, frame))

    def run(self, until: Callable[[], bool], limit_s: float = 120.0) -> float:
        """Step both halves until `until()`; the seconds it took. Fails after `limit_s`."""
        begin_us = self.now_us
        while not until():
            assert self.now_us - begin_us < limit_s * 1e6, f"not done after {limit_s:g} s"
            arrived = [flying for flying in self._flying if flying[0] <= self.now_us]
            self._flying = [flying for flying in self._flying if flying[0] > self.now_us]
            for _, who, data in arrived:
                (frame,) = parse(data)
                if who == "server":
                    self.post("client", self.client.receive(frame.message, SERVER, self.now_us))
                else:
                    self.post("server", self.server.receive(frame.message, CLIENT, self.now_us))
            self.post("server", self.server.step(self.now_us))
            self.post("client", self.client.step(self.now_us))
            self.now_us += STEP_US
        return (self.now_us - begin_us) / 1e6
