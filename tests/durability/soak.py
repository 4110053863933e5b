"""Does anything grow, wear or fail: ``python -m tests.durability.soak [--hours H] [--speed X]``.

A real `mavsitl vehicle` keeps state and logs and flies, while a ground station carries out transactions without pause:
parameters set, read and listed, missions and files up and down, logs listed and downloaded, commands, a flight from
take-off to landing again and again. Its resident memory, file descriptors and threads are read every second. Afterwards
``--lockstep-hours`` of simulated time are flown in memory, and the memory of both cores is watched. Exit code 1 where a
transaction failed, memory grows faster than the limit, or descriptors or threads do. Linux only.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from mavsitl import ends
from mavsitl.dialect import mavlink
from mavsitl.log.ulog import UlogWriter
from mavsitl.scenario import load
from mavsitl.services.ftp import crc32
from mavsitl.services.mission import FENCE, MISSION, RALLY, MissionItem, same_plan
from tests.durability.station import Ports, Process, Station, proc_status

SLOPE_LIMIT_KIB_MIN = 100.0
DRIFT_LIMIT = 0.002
WARM_UP = 0.25
"""This share of the time is not in the slope: caches fill, the allocator finds its size."""
SAMPLE_S = 1.0
HOURS = 8.0 / 60.0

Transaction = Iterator[None]
"""Yields while it waits; it raises AssertionError where it fails."""


@dataclass
class Soak:
    """What came of it."""

    done: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    samples: list[tuple[float, int, int, int]] = field(default_factory=list)
    """(minutes, resident KiB, file descriptors, threads)"""
    drift: float = 0.0
    """Of simulated against wall time, as a share of it; lost time is in it."""
    lost_s: float = 0.0
    """What the machine did not give."""
    exit_code: int = 0

    @property
    def pace(self) -> float:
        """The drift of the time that was not given up."""
        return self.drift + self.lost_s / (60.0 * self.samples[-1][0])

    @property
    def slope_kib_min(self) -> float:
        return slope([(minutes, kib) for minutes, kib, _, _ in self.samples])

    def constant(self, column: int) -> bool:
        """Whether the fewest descriptors (2) or threads (3) are no more at the end than after the warm-up.

        The fewest of many samples are those without an open transfer.
        """
        late = [sample[column] for sample in self.samples[int(WARM_UP * len(self.samples)) :]]
        third = len(late) // 3
        return third == 0 or min(late[-third:]) <= min(late[:third])


def slope(samples: Sequence[tuple[float, float]]) -> float:
    """Of a straight line through what comes after the warm-up."""
    late = samples[int(WARM_UP * len(samples)) :]
    if len(late) < 3:
        return 0.0
    times, values = np.array(late, dtype=float).T
    return float(np.polyfit(times - times[0], values, 1)[0])


class Client:
    """The transactions; each kind runs on its own, beside the others."""

    def __init__(self, station: Station, soak: Soak, seed: int) -> None:
        self._station = station
        self._soak = soak
        self._random = random.Random(seed)
        self._kinds: dict[str, Callable[[], Transaction]] = {
            "parameters": self._parameters, "missions": self._missions, "files": self._files, "logs": self._logs,
            "flights": self._flights,
        }  # fmt: skip
        self._running = {name: make() for name, make in self._kinds.items()}

    def step(self) -> None:
        self._station.pump(0.01)
        for name, transaction in self._running.items():
            try:
                next(transaction)
            except StopIteration:
                self._soak.done[name] += 1
                self._running[name] = self._kinds[name]()
            except AssertionError as error:
                self._soak.failures.append(f"{name}: {error}")
                self._running[name] = self._kinds[name]()

    def _parameters(self) -> Transaction:
        parameters = self._station.parameters
        value = self._random.uniform(2.0, 5.0)
        request = parameters.set("MIS_TAKEOFF_ALT", value)
        while request.outcome == "open":
            yield
        assert request.outcome == "done", f"set: {request.outcome}"
        request = parameters.read("MIS_TAKEOFF_ALT")
        while request.outcome == "open":
            yield
        assert request.value is not None, "read: no value"
        assert abs(request.value - value) < 1e-5, f"read {request.value}, set {value}"
        if self._random.random() < 0.05:
            parameters.request_list()
            while parameters.list_state == "running":
                yield
            assert parameters.list_state == "complete", f"list: {parameters.list_state}"

    def _missions(self) -> Transaction:
        missions = self._station.missions
        kind = self._random.choice((MISSION, FENCE, RALLY))
        items = [self._item(kind, k) for k in range(1 if kind == FENCE else self._random.randrange(1, 30))]
        missions.upload(kind, items)
        while missions.busy:
            yield
        assert missions.result == mavlink.MAV_MISSION_ACCEPTED, f"upload: {missions.result}"
        missions.download(kind)
        while missions.busy:
            yield
        assert same_plan(missions.items, items), "what came back is another plan"

    def _item(self, kind: int, number: int) -> MissionItem:
        command, param1 = {
            MISSION: (mavlink.MAV_CMD_NAV_WAYPOINT, 0.0), RALLY: (mavlink.MAV_CMD_NAV_RALLY_POINT, 0.0),
            FENCE: (mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION, 500.0),
        }[kind]  # fmt: skip
        latitude = 473_977_418 + (self._random.randrange(1000) if kind != FENCE else 0)
        return MissionItem(command, 6, param1, 0.0, 0.0, 0.0, latitude, 85_455_939, 10.0 + number)

    def _files(self) -> Transaction:
        files = self._station.files
        path = f"/fs/microsd/{self._random.randrange(4)}.bin"
        data = self._random.randbytes(self._random.randrange(1, 20_000))

        def ended(begin: Callable[[], None]) -> Transaction:
            begin()
            while files.result is None:
                yield

        yield from ended(lambda: files.upload(path, data))
        assert files.result is not None
        assert files.result.ok, f"upload: {files.result}"
        yield from ended(lambda: files.crc32(path))
        assert files.result.crc32 == crc32(data), "another checksum"
        yield from ended(lambda: files.download(path))
        assert files.result.data == data, "another file came back"

    def _logs(self) -> Transaction:
        logs = self._station.logs
        logs.list()
        while logs.busy:
            yield
        assert logs.entries, "no logs"
        smallest = min(logs.entries, key=lambda entry: entry.size_bytes)
        logs.download(smallest)
        while logs.busy:
            yield
        assert logs.data is not None, "no data"
        assert len(logs.data) == smallest.size_bytes, "another length"

    def _flights(self) -> Transaction:
        """Up, a while, and down again; every command is answered."""
        heard = self._station.heard
        steps: tuple[tuple[int | None, tuple[float, ...]], ...] = (
            (mavlink.MAV_CMD_NAV_TAKEOFF, ()),
            (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (1.0,)),
            (None, (4.0,)),
            (mavlink.MAV_CMD_REQUEST_MESSAGE, (float(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION),)),
            (mavlink.MAV_CMD_NAV_LAND, ()),
        )
        for command, params in steps:
            if command is None:
                yield from _pause(params[0])
                continue
            yield from self._command(command, params)
        until_s = monotonic() + 60.0
        while heard["HEARTBEAT"][1].base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED:
            assert monotonic() < until_s, "it does not land"
            yield

    def _command(self, command: int, params: tuple[float, ...]) -> Transaction:
        commands = self._station.commands
        commands.start(command, *params)
        while commands.busy:
            yield
        assert commands.result == mavlink.MAV_RESULT_ACCEPTED, f"command {command}: {commands.result}"


def _pause(seconds: float) -> Transaction:
    until_s = monotonic() + seconds
    while monotonic() < until_s:
        yield


def realtime(seconds: float, speed: float, folder: Path, *, seed: int = 1, show: bool = False) -> Soak:
    """So long on the wall clock."""
    soak = Soak()
    ports = Ports()
    station = Station(ports)
    logs = folder / "logs"
    logs.mkdir()
    with UlogWriter(logs / "small.ulg", {}, {}):
        pass
    process = Process(
        *ports.vehicle("--state-dir", str(folder / "state"), "--run-dir", str(logs), "--speed", f"{speed:g}")
    )
    try:
        station.wait_booted()
        client = Client(station, soak, seed)
        stamps: list[tuple[float, int]] = []

        def watch(message: Any, now_s: float) -> None:
            if message.get_type() == "ATTITUDE":
                stamps[1:] = [(now_s, message.time_boot_ms)]
                if len(stamps) == 1:
                    stamps.append(stamps[0])

        station.run(1.0)
        station.watch = watch
        begin_s = sample_s = monotonic()
        with Progress(console=Console(stderr=True), disable=not show) as bar:
            task = bar.add_task("soak", total=seconds)
            while (now_s := monotonic()) - begin_s < seconds:
                client.step()
                if now_s >= sample_s:
                    sample_s += SAMPLE_S
                    soak.samples.append(((now_s - begin_s) / 60.0, *proc_status(process.pid)))
                    bar.update(task, completed=now_s - begin_s)
        (first_s, first_ms), (last_s, last_ms) = stamps[0], stamps[-1]
        soak.drift = (last_ms - first_ms) / 1e3 / ((last_s - first_s) * speed) - 1.0
        soak.failures += [f"it said: {text}" for text in station.texts if "cannot" in text or "Logging" in text]
        soak.exit_code = process.end()
        said = process.printed.rpartition(" times, ")[2].partition(" s given up")[0]
        soak.lost_s = float(said)
    finally:
        process.close()
        station.close()
    return soak


def lockstep(hours: float, *, show: bool = False) -> list[tuple[float, float]]:
    """(simulated minutes, resident KiB) of one long flight in memory, vehicle and ground."""
    samples: list[tuple[float, float]] = []
    with Progress(console=Console(stderr=True), disable=not show) as bar:
        task = bar.add_task("lock-step", total=hours * 60.0)

        def progress(time_s: float) -> None:
            samples.append((time_s / 60.0, float(proc_status("self")[0])))
            bar.update(task, completed=time_s / 60.0)

        flight = load("hover-wind", {"duration_s": hours * 3600.0})
        outcome = ends.in_memory(flight, None, report=lambda text: None, progress=progress)
    assert outcome.finished
    return [sample for sample in samples if sample[0] > 0.0]


def table(soak: Soak, speed: float, flown: Sequence[tuple[float, float]]) -> Table:
    made = Table(title=f"soak: {soak.samples[-1][0]:.1f} min at {speed:g} x real time")
    for heading in ("", "found", "limit"):
        made.add_column(heading, justify="right" if heading else "left")
    for name, number in sorted(soak.done.items()):
        made.add_row(f"{name} done", str(number), "")
    made.add_row("failed transactions", str(len(soak.failures)), "0")
    made.add_row("resident memory", f"{soak.samples[-1][1] / 1024:.1f} MiB", "")
    made.add_row("its slope", f"{soak.slope_kib_min:+.1f} KiB/min", f"{SLOPE_LIMIT_KIB_MIN:g}")
    for column, name in ((2, "file descriptors"), (3, "threads")):
        values = [sample[column] for sample in soak.samples]
        made.add_row(f"{name}, least to most", f"{min(values)} to {max(values)}", "constant")
    made.add_row("drift", f"{100 * soak.drift:+.3f} %", f"{100 * DRIFT_LIMIT:g} %")
    made.add_row("real time given up", f"{soak.lost_s:.1f} s", "")
    made.add_row("drift of the rest", f"{100 * soak.pace:+.3f} %", f"{100 * DRIFT_LIMIT:g} %")
    if flown:
        made.add_row("lock-step", f"{flown[-1][0] / 60:.2f} h simulated", "")
        made.add_row("slope of its memory", f"{slope(flown):+.2f} KiB/simulated min", f"{SLOPE_LIMIT_KIB_MIN:g}")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser("python -m tests.durability.soak", description=__doc__)
    parser.add_argument("--hours", type=float, default=HOURS, metavar="H", help="wall clock (default: 8 minutes)")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="default: 1")
    parser.add_argument("--lockstep-hours", type=float, default=2.0, metavar="H", help="simulated (default: 2)")
    options = parser.parse_args(argv)
    with TemporaryDirectory() as folder:
        soak = realtime(options.hours * 3600.0, options.speed, Path(folder), show=True)
    flown = lockstep(options.lockstep_hours, show=True) if options.lockstep_hours > 0.0 else []
    Console().print(table(soak, options.speed, flown))
    for failure in soak.failures:
        print(failure, file=sys.stderr)
    grows = max(soak.slope_kib_min, slope(flown)) > SLOPE_LIMIT_KIB_MIN or not (soak.constant(2) and soak.constant(3))
    return 1 if soak.failures or grows or soak.exit_code or abs(soak.drift) > DRIFT_LIMIT else 0


if __name__ == "__main__":
    raise SystemExit(main())
