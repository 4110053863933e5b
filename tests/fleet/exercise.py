"""A fleet and a client that speaks to its vehicles over the wire, in simulated time."""

from __future__ import annotations

from math import nan
from typing import Any

from mavsitl_vehicle.fleet import Fleet

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.scenario import Flight
from tests.autopilot.conftest import flight

CLIENT = (245, 190)


class Station:
    """Hears every port of a fleet; keeps each message with its port and sender."""

    def __init__(self, count: int, scenario: Flight | None = None, *, one_link: bool = False, **options: Any) -> None:
        self.recorders = [MemoryRecorder() for _ in range(count)]
        self.fleet = Fleet(
            scenario or flight(), self.recorders, seed=1, count=count, ports=("offboard", "gcs"), one_link=one_link,
            **options,
        )  # fmt: skip
        self.now_us = 0
        self.inbox: list[tuple[int, int, Any]] = []
        """(port, system id, message)."""
        self.datagrams: list[tuple[int, bytes]] = []
        self._sequence = 0
        self.fleet.step(0)
        self.collect()

    def send(self, port: int, *messages: Any, sender: tuple[int, int] = CLIENT) -> int:
        """In one datagram; the number of frames that were taken."""
        datagram = b""
        for message in messages:
            datagram += encode(message, self._sequence & 0xFF, *sender)
            self._sequence += 1
        return self.fleet.receive(port, datagram)

    def command(self, port: int, system_id: int, command: int, *params: float) -> None:
        filled = (*params, *([nan] * (7 - len(params))))
        self.send(port, mavlink.MAVLink_command_long_message(system_id, 1, command, 0, *filled))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 1e6 / self.fleet.period_us)):
            self.now_us += self.fleet.period_us
            self.fleet.step(self.now_us)
            self.collect()

    def collect(self) -> None:
        for port, datagrams in self.fleet.outgoing():
            for datagram in datagrams:
                self.datagrams.append((port, datagram))
                for frame in parse(datagram):
                    self.inbox.append((port, frame.system_id, frame.message))

    def of(self, name: str) -> list[tuple[int, int, Any]]:
        return [entry for entry in self.inbox if entry[2].get_type() == name]

    def texts(self, system_id: int) -> list[str]:
        """STATUSTEXT on its ground stations' link."""
        ports = (2 * (system_id - 1) + 1, 1)
        return [
            message.text for port, sender, message in self.of("STATUSTEXT") if sender == system_id and port in ports
        ]
