"""Structure-aware fuzzing of a vehicle in flight, in memory and in simulated time: `python -m tests.hostile.fuzz`.

Two vehicles take turns. One gets broken datagrams, in which no frame is well formed: nothing may change, and it hovers
on. The other gets hostile ones: every frame is well formed and its fields hold anything, so it may be told to land or
to stop, but nothing escapes, its state stays finite, and honest requests are answered.
"""

from __future__ import annotations

import argparse
import gc
import shutil
import sys
from collections.abc import Iterable
from math import dist, isfinite
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from mavsitl_vehicle.failures import Kind, Unit
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.ends import NullRecorder
from mavsitl.signing import EPOCH_UNIX_US
from tests.autopilot.conftest import flight
from tests.hostile.attacks import Attacker
from tests.hostile.report import Report, bar

ROUND = 2_000
PER_TICK = 20
"""Datagrams a tick: 5,000 a second."""
HONEST = (255, 190)
HONEST_TICKS = 10
"""Ticks between two honest requests."""
PATIENCE_TICKS = 25
"""0.1 s: an answer that comes later is none."""
HEIGHT_M = 3.0
MAX_GROWTH_MIB = 8.0
WARM = 50_000
"""Datagrams, or a quarter of all, after which memory is looked at for the first time."""
HOVER_M = 0.3


def resident_mib() -> float:
    """Of this process, now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


class Target:
    """A vehicle that hovers, with files and a plan, and its honest client on the second link."""

    def __init__(self, folder: Path) -> None:
        logs = folder / "logs"
        logs.mkdir(parents=True)
        (logs / "flight.ulg").write_bytes(bytes(range(256)) * 40)
        self.now_us = 0
        self.vehicle = Vehicle(
            flight(), NullRecorder(), seed=1, ports=("offboard", "gcs"), state=folder, logs=logs,
            unix_us=lambda: EPOCH_UNIX_US + 400_000_000_000_000 + self.now_us,
        )  # fmt: skip
        self.asked = self.answered = 0
        self._sequence = 0
        self._waiting: list[tuple[int, str, Any]] = []
        self._turn = 0
        self.vehicle.step(0)
        self.take_off()

    # --- the honest client

    def send(self, message: Any) -> None:
        self._sequence = (self._sequence + 1) & 0xFF
        self.vehicle.receive(1, encode(message, self._sequence, *HONEST))

    def command(self, command: int, *params: float) -> None:
        filled = (*params, *([float("nan")] * (7 - len(params))))
        self.send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *filled))

    def ask(self) -> None:
        """The next of the honest requests, each with the message that answers it."""
        self._turn += 1
        turn = self._turn % 5
        if turn == 0:
            self.send(mavlink.MAVLink_param_request_read_message(1, 1, b"MC_ROLL_P", -1))
            wanted: tuple[str, Any] = ("PARAM_VALUE", "MC_ROLL_P")
        elif turn == 1:
            self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
            wanted = ("AUTOPILOT_VERSION", None)
        elif turn == 2:
            self.send(mavlink.MAVLink_timesync_message(0, self._turn))
            wanted = ("TIMESYNC", self._turn)
        elif turn == 3:
            self.send(mavlink.MAVLink_ping_message(0, self._turn, 0, 0))
            wanted = ("PING", self._turn)
        else:
            self.command(mavlink.MAV_CMD_GET_HOME_POSITION)
            wanted = ("COMMAND_ACK", mavlink.MAV_CMD_GET_HOME_POSITION)
        self.asked += 1
        self._waiting.append((self.now_us + PATIENCE_TICKS * self.vehicle.period_us, *wanted))

    def listen(self) -> None:
        for port in (0, 1):
            for datagram in self.vehicle.datagrams(port, combine=False):
                if port == 0 or not self._waiting:
                    continue
                for frame in parse(datagram):
                    self._match(frame.message)
        self._waiting = [entry for entry in self._waiting if entry[0] > self.now_us]

    def _match(self, message: Any) -> None:
        name = message.get_type()
        for entry in self._waiting:
            _, wanted, detail = entry
            if wanted != name:
                continue
            if name == "PARAM_VALUE" and message.param_id != detail:
                continue
            if name == "TIMESYNC" and message.ts1 != detail:
                continue
            if name == "PING" and message.seq != detail:
                continue
            if name == "COMMAND_ACK" and (message.command, message.target_system) != (detail, HONEST[0]):
                continue
            self._waiting.remove(entry)
            self.answered += 1
            return

    # --- time and state

    def tick(self) -> None:
        self._mend()
        self.now_us += self.vehicle.period_us
        self.vehicle.step(self.now_us)
        self.listen()

    def _mend(self) -> None:
        """Who may set parameters may ask for silence: a link that is cut, a processor that stalls. Not here."""
        vehicle = self.vehicle
        if vehicle.failures.of(Unit.MAVLINK, 1) or vehicle.failures.of(Unit.MAVLINK, 2):
            vehicle.failures.set(Unit.MAVLINK, Kind.OK)
        vehicle.parameters.put("SIM_CPU_STALL", 0)

    def take_off(self) -> None:
        """Up to its height, and there at rest."""
        autopilot = self.vehicle.autopilot
        self.vehicle.parameters.set("MIS_TAKEOFF_ALT", HEIGHT_M)
        for _ in range(100):
            self.tick()
        self.command(mavlink.MAV_CMD_NAV_TAKEOFF)
        self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
        for _ in range(2000):
            self.tick()
        assert autopilot.commander.armed, "it did not take off"

    @property
    def position(self) -> list[float]:
        found: list[float] = self.vehicle.simulation.x[:3, 0].tolist()
        return found

    @property
    def hovers(self) -> bool:
        autopilot = self.vehicle.autopilot
        return autopilot.commander.armed and not autopilot.on_ground and autopilot.commander.mode.name == "LOITER"

    @property
    def flies(self) -> bool:
        autopilot = self.vehicle.autopilot
        return autopilot.commander.armed and not autopilot.on_ground

    @property
    def finite(self) -> bool:
        simulation = self.vehicle.simulation
        return bool(np.isfinite(simulation.x).all() and np.isfinite(simulation.estimate).all()) and all(
            map(isfinite, self.vehicle.autopilot.estimate)
        )

    def state(self) -> tuple[object, ...]:
        """What a datagram without a frame may not change."""
        autopilot = self.vehicle.autopilot
        stores = self.vehicle.plan.stores
        return (
            tuple(self.vehicle.parameters.as_dict().items()), tuple(stores.id(kind) for kind in range(3)),
            stores.transaction is None, autopilot.commander.mode, autopilot.commander.armed, autopilot.home,
            autopilot.setpoint_us, autopilot.token_us,
        )  # fmt: skip


class Tally:
    """What became of one kind of datagrams, over all flights."""

    def __init__(self) -> None:
        self.flights = self.asked = self.answered = self.errors = self.escaped = 0

    def add(self, target: Target) -> None:
        self.flights += 1
        self.asked += target.asked
        self.answered += target.answered
        self.errors += target.vehicle.counters.errors


def attack(target: Target, datagrams: Iterable[bytes], tally: Tally) -> None:
    """One round, on both links in turn, with honest requests between."""
    for index, datagram in enumerate(datagrams):
        try:
            target.vehicle.receive(index & 1, datagram)
            if index % PER_TICK == 0:
                if index // PER_TICK % HONEST_TICKS == 0:
                    target.ask()
                target.tick()
        except Exception as error:
            tally.escaped += 1
            print(f"{datagram.hex()}: {error!r}", file=sys.stderr)
    for _ in range(PATIENCE_TICKS):
        target.tick()


def fuzz(total: int, seed: int, folder: Path, *, show: bool = True) -> Report:
    """`total` datagrams, half of them broken, at two vehicles; the folder is theirs."""
    attacker = Attacker(f"fuzz-{seed}")
    for kind in mavlink.mavlink_map:  # what is made on first use is made now
        parse(encode(attacker.message(mavlink.mavlink_map[kind].msgname), 0, 66, 1))
    tally = Tally()
    calm, prey = Target(folder / "calm"), Target(folder / "prey")
    changed = strayed = not_finite = sent = 0
    worst_m = 0.0
    before_mib: float | None = None
    with bar(total, show=show) as progress:
        while sent < total:
            count = min(ROUND, total - sent)
            here, state = calm.position, calm.state()
            attack(calm, (attacker.broken() for _ in range(count // 2)), tally)
            changed += calm.state() != state
            strayed += not calm.hovers
            worst_m = max(worst_m, dist(here, calm.position))

            attack(prey, (attacker.good() for _ in range(count - count // 2)), tally)
            not_finite += not prey.finite
            if not prey.flies:  # it was told to land, or worse
                tally.add(prey)
                prey.vehicle.close()
                shutil.rmtree(folder / "prey")
                prey = Target(folder / "prey")
            sent += count
            progress.move(count)
            if before_mib is None and (sent >= WARM or sent >= total // 4):
                gc.collect()
                before_mib = resident_mib()
    for target in (calm, prey):
        tally.add(target)
        target.vehicle.close()
    gc.collect()
    growth_mib = resident_mib() - (before_mib or 0.0)
    report = Report(f"{total} datagrams, seed {seed}, {tally.flights} flights")
    report.demand("exceptions that left the vehicle", "0", tally.escaped, tally.escaped == 0)
    report.demand("exceptions of a handler", "0", tally.errors, tally.errors == 0)
    report.demand("rounds of broken datagrams that changed something", "0", changed, changed == 0)
    report.demand("rounds of broken datagrams that ended the hover", "0", strayed, strayed == 0)
    report.demand("  hover, m off", f"<= {HOVER_M}", worst_m, worst_m <= HOVER_M)
    report.demand("rounds of hostile ones with a state that is not finite", "0", not_finite, not_finite == 0)
    share = tally.answered / tally.asked
    report.demand(f"answers to {tally.asked} honest requests", ">= 95 %", f"{share:.2%}", share >= 0.95)
    report.demand("growth, MiB", f"<= {MAX_GROWTH_MIB:g}", growth_mib, growth_mib <= MAX_GROWTH_MIB)
    return report


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--datagrams", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        return fuzz(options.datagrams, options.seed, Path(folder)).print()


if __name__ == "__main__":
    sys.exit(main())
