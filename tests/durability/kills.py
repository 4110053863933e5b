"""What a vehicle loses by SIGKILL: ``python -m tests.durability.kills [--kills N] [--seed S]``.

A real `mavsitl vehicle` is killed again and again at random instants, while a ground station sets parameters, uploads
missions and files, or while it boots; each next one starts on what was left. What was acknowledged half a second
before has to be there, each file is an old one or a new one and never a part of one, and the logs of the killed process
are read by pyulog and by pymavlink up to its last second of wall clock. Exit code 1 where that does not hold.
"""

from __future__ import annotations

import argparse
import json
import random
import struct
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any

from mavsitl_vehicle.autopilot.parameters import TABLE
from pymavlink import mavutil
from pyulog import ULog
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from mavsitl.dialect import mavlink
from mavsitl.services.ftp import crc32
from mavsitl.services.mission import MISSION, MissionItem, same_plan
from tests.durability.station import Ports, Process, Station

KEPT_AFTER_S = 0.5
LOG_GAP_S = 1.0
HEARTBEAT_LIMIT_S = 5.0
BOOT_S = 0.2
"""Within the time from the first HEARTBEAT to the first SYS_STATUS, 0.3 s."""
KINDS = ("parameters", "mission", "files", "all at once", "boot")
SPEEDS = ("0.5", "1", "2")
FILES = 3
NAMES = tuple(
    name for name, row in sorted(TABLE.items())
    if name.startswith("MC_") and not row.volatile and not row.read_only and isinstance(row.default, float)
)[:12]  # fmt: skip


UNSEEN = object()


@dataclass
class Entry:
    """One thing that is kept, and what it may be after a kill."""

    base: Any = UNSEEN
    """As it was found last."""
    sent: list[tuple[Any, float | None]] = field(default_factory=list)
    """(value, when it was acknowledged, wall time in seconds; None: not), in the order of sending."""

    def allowed(self, killed_s: float) -> list[Any]:
        """The newest that was acknowledged in time, and all that was sent after it."""
        safe = [
            k for k, (_, acked_s) in enumerate(self.sent) if acked_s is not None and acked_s <= killed_s - KEPT_AFTER_S
        ]
        values = [value for value, _ in self.sent]
        return values[safe[-1] :] if safe else [self.base, *values]


@dataclass
class Tally:
    """What came of all kills."""

    kills: Counter[str] = field(default_factory=Counter)
    acknowledged: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    heartbeat_s: list[float] = field(default_factory=list)
    log_gap_s: list[float] = field(default_factory=list)
    logs: int = 0


class Campaign:
    def __init__(self, folder: Path, seed: int) -> None:
        self.random = random.Random(seed)
        self.state = folder / "state"
        self.logs = folder / "logs"
        self.ports = Ports()
        self.station = Station(self.ports)
        self.tally = Tally()
        self.parameters = {name: Entry() for name in NAMES}
        self.mission = Entry()
        self.files = {f"/fs/microsd/{k}.bin": Entry() for k in range(FILES)}
        self._killed_s = 0.0
        """When it was killed last of those times that something was being changed."""

    # --- one kill

    def kill(self, kind: str) -> None:
        """Start on what is there, look at it, change it, and kill it in the middle."""
        station = self.station
        station.drain()
        station.renew()
        speed = float(self.random.choice(SPEEDS))
        process = Process(
            *self.ports.vehicle("--state-dir", str(self.state), "--run-dir", str(self.logs), "--speed", f"{speed:g}")
        )
        try:
            self.tally.heartbeat_s.append(station.until(lambda: "HEARTBEAT" in station.heard, what="a HEARTBEAT"))
            if kind == "boot":
                station.run(self.random.uniform(0.0, BOOT_S))
            else:
                station.wait_booted()
                self.look()
                self.change(kind, monotonic() + self.random.uniform(0.3, 1.6))
        finally:
            killed_s = monotonic()
            process.kill()
        station.pump(0.0)
        self.tally.kills[kind] += 1
        self.look_at_files()
        booted = "SYS_STATUS" in station.heard
        self.look_at_logs(station.clock_ms() / 1e3 if booted else None, speed)
        if kind != "boot":
            self._killed_s = killed_s

    def finish(self) -> None:
        """What the last kill left."""
        self.station.drain()
        self.station.renew()
        process = Process(*self.ports.vehicle("--state-dir", str(self.state)))
        try:
            self.station.wait_booted()
            self.look()
        finally:
            process.close()
            self.station.close()

    def fault(self, text: str) -> None:
        self.tally.faults.append(f"kill {sum(self.tally.kills.values())}: {text}")

    # --- changing

    def change(self, kind: str, until_s: float) -> None:
        jobs: dict[str, Callable[[], Callable[[], bool]]] = {
            "parameters": self.set_parameter, "mission": self.upload_mission, "files": self.upload_file,
        }  # fmt: skip
        chosen = list(jobs.values()) if kind == "all at once" else [jobs[kind]]
        running = [begin() for begin in chosen]
        while (left_s := until_s - monotonic()) > 0.0:
            self.station.pump(min(0.005, left_s))
            for index, done in enumerate(running):
                if done():
                    running[index] = chosen[index]()

    def set_parameter(self) -> Callable[[], bool]:
        name = self.random.choice(NAMES)
        row = TABLE[name]
        value = struct.unpack("<f", struct.pack("<f", self.random.uniform(row.minimum, min(row.maximum, 100.0))))[0]
        entry = self.parameters[name]
        entry.sent.append((value, None))
        request = self.station.parameters.set(name, value)

        def done() -> bool:
            if request.outcome == "done":
                self._acknowledge(entry, "parameters")
            elif request.outcome != "open":
                self.fault(f"{name} = {value} was not taken: {request.outcome}")
            return request.outcome != "open"

        return done

    def upload_mission(self) -> Callable[[], bool]:
        items = [
            MissionItem(mavlink.MAV_CMD_NAV_WAYPOINT, 6, 0.0, 1.0, 0.0, 0.0, 473_977_418 + self.random.randrange(1000),
                        85_455_939, 10.0 + k)
            for k in range(self.random.randrange(1, 60))
        ]  # fmt: skip
        self.mission.sent.append((items, None))
        self.station.missions.upload(MISSION, items)

        def done() -> bool:
            missions = self.station.missions
            if not missions.busy:
                if missions.result == mavlink.MAV_MISSION_ACCEPTED:
                    self._acknowledge(self.mission, "missions")
                else:
                    self.fault(f"a mission was not taken: {missions.result}")
            return not missions.busy

        return done

    def upload_file(self) -> Callable[[], bool]:
        path = self.random.choice(list(self.files))
        data = self.random.randbytes(self.random.randrange(1, 30_000))
        entry = self.files[path]
        entry.sent.append((crc32(data), None))
        self.station.files.upload(path, data)

        def done() -> bool:
            result = self.station.files.result
            if result is not None:
                if result.ok:
                    self._acknowledge(entry, "files")
                else:
                    self.fault(f"{path} was not taken: {result}")
            return result is not None

        return done

    def _acknowledge(self, entry: Entry, what: str) -> None:
        entry.sent[-1] = (entry.sent[-1][0], monotonic())
        self.tally.acknowledged[what] += 1

    # --- looking

    def look(self) -> None:
        """Ask the vehicle for everything that it should have kept."""
        station = self.station
        for text in station.texts:
            if "damaged" in text or "left out" in text or "cannot" in text:
                self.fault(f"it said: {text}")
        for name, entry in self.parameters.items():
            request = station.parameters.read(name)
            station.until(lambda: request.outcome != "open", what=name)  # noqa: B023
            self._compare(name, entry, request.value, lambda found, wanted: bool(found == wanted))
        station.missions.download(MISSION)
        station.until(lambda: not station.missions.busy, what="the mission")
        self._compare("the mission", self.mission, list(station.missions.items), same_plan)
        for path, entry in self.files.items():
            station.files.crc32(path)
            station.until(lambda: station.files.result is not None, what=path)
            assert station.files.result is not None
            self._compare(path, entry, station.files.result.crc32, lambda found, wanted: bool(found == wanted))

    def _compare(self, what: str, entry: Entry, found: Any, same: Callable[[Any, Any], bool]) -> None:
        allowed = entry.allowed(self._killed_s)
        if entry.base is not UNSEEN and not any(same(found, value) for value in allowed):
            self.fault(f"{what} is {str(found)[:80]}, which is none of {len(allowed)} that it may be")
        entry.base = found
        entry.sent.clear()

    def look_at_files(self) -> None:
        """Each is whole, as it lies there."""
        for path in self.state.glob("*.json"):
            try:
                json.loads(path.read_text())
            except ValueError as error:
                self.fault(f"{path.name}: {error}")
        for path in self.state.glob("*.bad*"):
            self.fault(f"{path.name} was set aside")

    def look_at_logs(self, killed_at_s: float | None, speed: float) -> None:
        """`killed_at_s`: the newest time on the vehicle's clock that was heard; None: it had not booted."""
        ulog, tlog = self.logs / "vehicle.ulg", self.logs / "link.tlog"
        if killed_at_s is None:
            return
        try:
            log = ULog(str(ulog), disable_str_exceptions=False)
            if log.file_corruption:
                self.fault("vehicle.ulg: corrupt")
            last_s = max((float(d.data["timestamp"][-1]) for d in log.data_list), default=0.0) / 1e6
            reader = mavutil.mavlogfile(str(tlog))
            last_frame_s = 0.0
            while (message := reader.recv_msg()) is not None:
                if message.get_type() == "BAD_DATA":
                    self.fault("link.tlog: not a frame")
                last_frame_s = message._timestamp
            reader.close()
        except Exception as error:
            self.fault(f"a log cannot be read: {error!r}")
            return
        gap_s = (killed_at_s - min(last_s, last_frame_s)) / speed
        self.tally.logs += 1
        self.tally.log_gap_s.append(gap_s)
        if gap_s > LOG_GAP_S:
            self.fault(f"the logs end {gap_s:.2f} s before the process")


def run(kills: int, seed: int, folder: Path, *, show: bool) -> Tally:
    """So many kills, of every kind in turn."""
    campaign = Campaign(folder, seed)
    with Progress(console=Console(stderr=True), disable=not show) as bar:
        for number in bar.track(range(kills), description="kills"):
            campaign.kill(KINDS[number % len(KINDS)])
    campaign.finish()
    return campaign.tally


def table(tally: Tally) -> Table:
    made = Table(title=f"{sum(tally.kills.values())} kills")
    made.add_column("")
    made.add_column("", justify="right")
    for kind in KINDS:
        made.add_row(f"killed during: {kind}", str(tally.kills[kind]))
    for what, number in sorted(tally.acknowledged.items()):
        made.add_row(f"acknowledged {what}", str(number))
    made.add_row("lost, half-written or unreadable", str(len(tally.faults)))
    made.add_row(f"first HEARTBEAT, worst (limit {HEARTBEAT_LIMIT_S:g} s)", f"{max(tally.heartbeat_s):.2f} s")
    made.add_row("pairs of logs read", str(tally.logs))
    made.add_row(f"missing at a log's end, worst (limit {LOG_GAP_S:g} s)", f"{max(tally.log_gap_s, default=0.0):.2f} s")
    return made


def passed(tally: Tally) -> bool:
    return not tally.faults and max(tally.heartbeat_s) <= HEARTBEAT_LIMIT_S


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser("python -m tests.durability.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=100, metavar="N", help="default: 100")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="default: 1")
    options = parser.parse_args(argv)
    with TemporaryDirectory() as folder:
        tally = run(options.kills, options.seed, Path(folder), show=True)
    Console().print(table(tally))
    for fault in tally.faults:
        print(fault, file=sys.stderr)
    return 0 if passed(tally) else 1


if __name__ == "__main__":
    raise SystemExit(main())
