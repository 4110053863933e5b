"""Every transaction with a quarter of all frames lost, in memory and in simulated time: `python -m tests.hostile.loss`.

Our client halves against the whole vehicle: parameters, a mission of 500 items, a file of 10 kB both ways, a log, and
commands. Each direction loses its frames independently.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from mavsitl_vehicle.autopilot.parameters import TABLE
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.ends import NullRecorder
from mavsitl.services.base import NOTHING, Message, Peer, Service
from mavsitl.services.command import CommandClient
from mavsitl.services.ftp import FtpClient
from mavsitl.services.log_transfer import LogClient
from mavsitl.services.mission import MISSION, MissionClient, MissionItem, same_plan
from mavsitl.services.parameter import ParameterClient
from tests.autopilot.conftest import flight
from tests.hostile.report import Report, bar

LOSS = 0.25
LIMIT_S = 300.0
ITEMS = 500
FILE_BYTES, LOG_BYTES = 10_000, 100_000
VEHICLE, CLIENT = (1, 1), (245, 190)


class Wire:
    """The vehicle and a client's half with a bad link between them, 2 ms each way."""

    def __init__(self, folder: Path, seed: int, loss: float = LOSS) -> None:
        logs = folder / f"logs-{seed}"
        logs.mkdir()
        self.log = random.Random(seed).randbytes(LOG_BYTES)
        (logs / "vehicle.ulg").write_bytes(self.log)
        self.vehicle = Vehicle(flight(), NullRecorder(), seed=1, state=folder / f"state-{seed}", logs=logs)
        self.now_us = 0
        self.lost = self.sent = 0
        self._loss = loss
        self._random = random.Random(f"loss-{seed}")
        self._sequence = 0
        self._to_client: list[bytes] = []
        self.vehicle.step(0)

    def arrives(self) -> bool:
        self.sent += 1
        lost = self._random.random() < self._loss
        self.lost += lost
        return not lost

    def say(self, messages: Sequence[Message]) -> None:
        for message in messages:
            self._sequence = (self._sequence + 1) & 0xFF
            if self.arrives():
                self.vehicle.receive(0, encode(message, self._sequence, *CLIENT))

    def run(self, client: Service, done: Callable[[], bool]) -> float:
        """Until it is done or `LIMIT_S` is over; the seconds that took."""
        begin_us = self.now_us
        while not done() and self.now_us - begin_us < LIMIT_S * 1e6:
            self.now_us += self.vehicle.period_us
            self.vehicle.step(self.now_us)
            came, self._to_client = self._to_client, [
                datagram for datagram in self.vehicle.datagrams(0, combine=False) if self.arrives()
            ]  # fmt: skip
            for datagram in came:
                for frame in parse(datagram):
                    self.say(client.receive(frame.message, VEHICLE, self.now_us))
            self.say(client.step(self.now_us))
        return (self.now_us - begin_us) / 1e6


def mission(count: int) -> list[MissionItem]:
    first = MissionItem(mavlink.MAV_CMD_NAV_TAKEOFF, 6, 0.0, 0.0, 0.0, 0.0, 473977418, 85455939, 10.0)
    return [
        first,
        *(first._replace(command=mavlink.MAV_CMD_NAV_WAYPOINT, x=first.x + 100 * n) for n in range(1, count)),
    ]


def measure(report: Report, seed: int = 1, *, show: bool = False) -> None:
    """All transactions in turn, over one wire."""
    with TemporaryDirectory() as name, bar(8, show=show) as progress:
        wire = Wire(Path(name), seed)

        def row(what: str, seconds: float, right: bool) -> None:
            progress.move(1, what)
            report.demand(f"{what}, seed {seed}", f"whole in {LIMIT_S:g} s", f"{seconds:.1f} s", right)

        parameters = ParameterClient(VEHICLE)
        parameters.request_list()
        took = wire.run(parameters, lambda: parameters.list_state != "running")
        values = wire.vehicle.parameters.as_dict()
        equal = {name: value == np.float32(values[name]) for name, value in parameters.values.items()}
        row(f"{len(TABLE)} parameters read", took, set(equal) == set(TABLE) and all(equal.values()))

        wanted = {name: row.default for name, row in list(TABLE.items())[::7] if not row.read_only and not row.values}
        requests = [parameters.set(name, value) for name, value in wanted.items()]
        took = wire.run(parameters, lambda: all(request.outcome != "open" for request in requests))
        row(f"{len(requests)} parameters set", took, all(request.outcome == "done" for request in requests))

        items = mission(ITEMS)
        plans = MissionClient(VEHICLE)
        plans.upload(MISSION, items)
        took = wire.run(plans, lambda: not plans.busy)
        row(f"{ITEMS} mission items up", took, same_plan(wire.vehicle.plan.stores.items(MISSION), items))
        plans.download(MISSION)
        took = wire.run(plans, lambda: not plans.busy)
        row(f"{ITEMS} mission items down", took, same_plan(plans.items, items))

        content = random.Random(seed + 1).randbytes(FILE_BYTES)
        files = FtpClient(VEHICLE)
        files.upload("/fs/microsd/file", content)
        took = wire.run(files, lambda: files.result is not None)
        row(f"file of {FILE_BYTES} bytes up", took, files.result is not None and files.result.ok)
        files.download("/fs/microsd/file")
        took = wire.run(files, lambda: files.result is not None)
        row(f"file of {FILE_BYTES} bytes down", took, files.result is not None and files.result.data == content)

        logs = LogClient(VEHICLE)
        logs.list()
        took = wire.run(logs, lambda: not logs.busy)
        if logs.entries:
            logs.download(logs.entries[0])
            took += wire.run(logs, lambda: not logs.busy)
        row(f"log of {LOG_BYTES} bytes down", took, logs.data == wire.log)

        took, right = commands(wire)
        row("50 commands", took, right)
        share = wire.lost / wire.sent
        report.demand(f"frames lost, seed {seed}", "25 %", f"{share:.1%} of {wire.sent}", abs(share - LOSS) < 0.02)
        errors = wire.vehicle.counters.errors
        report.demand(f"exceptions of a handler, seed {seed}", "0", errors, errors == 0)
        wire.vehicle.close()


class Commander:
    """A `CommandClient` as a service: its commands are messages."""

    def __init__(self) -> None:
        self._outbox: list[Message] = []
        self.client = CommandClient(self._send, tries=20)

    def _send(self, command: int, confirmation: int, params: tuple[float, ...]) -> None:
        self._outbox.append(mavlink.MAVLink_command_long_message(1, 1, command, confirmation, *params))

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        if message.get_type() == "COMMAND_ACK":
            self.client.receive(message)
        return NOTHING

    def step(self, now_us: int) -> Sequence[Message]:
        self.client.step(now_us)
        messages, self._outbox = self._outbox, []
        return messages


def commands(wire: Wire) -> tuple[float, bool]:
    """Fifty in turn; seconds, and whether each was acknowledged as taken."""
    commander = Commander()
    took, right = 0.0, True
    for _ in range(50):
        commander.client.start(mavlink.MAV_CMD_GET_HOME_POSITION)
        took += wire.run(commander, lambda: commander.client.result is not None)
        right = right and commander.client.result == mavlink.MAV_RESULT_ACCEPTED
    return took, right


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    options = parser.parse_args()
    report = Report("a quarter of the frames lost, each way")
    for seed in range(1, options.seeds + 1):
        measure(report, seed, show=True)
    return report.print()


if __name__ == "__main__":
    sys.exit(main())
