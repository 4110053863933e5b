"""What a vehicle of a fleet costs as the fleet grows: ``python -m tests.bench.bench_fleet``. Linux only.

A fleet in one process on one core; this process, on another where there is one, is what such a fleet has around it: it
reads what all of them send on both links, says HEARTBEAT as a ground station, and streams off-board setpoints to each
at 50 Hz, by which they take off and hover. The figure and the table are of the vehicles' process, by the system's
account, while all fly.
"""

from __future__ import annotations

import argparse
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from math import nan
from pathlib import Path
from time import monotonic, sleep
from typing import Any, NamedTuple

from mavsitl.codec import encode, packer, parse
from mavsitl.dialect import mavlink
from mavsitl.link.udp import LOOPBACK

SCENARIO = "formation-spiral"
COUNTS = (1, 2, 5, 10, 20, 50, 100, 200)
FIGURE = Path("docs") / "explanation" / "figures" / "fleet.svg"
SETPOINT_HZ = 50.0
HEIGHT_M = 2.0
SETTLE_S = 5.0
"""Between the last arming and the measurement."""
PATIENCE_S = 120.0
OFFBOARD_MODE = 6
ARMED: int = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
POSITION_ONLY = 0b1101_1111_1000
"""Type mask: position and yaw; the rest is ignored."""
CLIENT = (245, 190)

_SETPOINT = packer(mavlink.MAVLink_set_position_target_local_ned_message)


class Row(NamedTuple):
    """One fleet."""

    vehicles: int
    share: float
    """Of a core, 0 to 1."""
    p50_us: float
    """Lateness of the ticks, from the process' start to its end."""
    p99_us: float
    lost_s: float
    """Real time that was given up."""
    memory_mb: float
    start_s: float
    """Until all were heard."""
    sent_hz: float
    """Messages that came from all of them, a second."""

    @property
    def share_each(self) -> float:
        return self.share / self.vehicles


def _free_block(count: int) -> int:
    """The first of so many UDP ports in a row that were free a moment ago."""
    for first in range(20_000, 60_000 - count, 500):
        sockets = []
        try:
            for port in range(first, first + count):
                each = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                sockets.append(each)
                each.bind((LOOPBACK, port))
        except OSError:
            continue
        else:
            return first
        finally:
            for each in sockets:
                each.close()
    raise RuntimeError(f"no {count} free ports in a row")


class Load:
    """What is around the fleet: `run` it for a time."""

    def __init__(self, count: int, offboard_port: int, remote_port: int, gcs_port: int, gcs_remote_port: int) -> None:
        self._count = count
        self._selector = selectors.DefaultSelector()
        self._sockets: list[socket.socket] = []
        for port in [remote_port + j for j in range(count)] + [gcs_remote_port]:
            opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            opened.setblocking(False)
            opened.bind((LOOPBACK, port))
            self._selector.register(opened, selectors.EVENT_READ, opened)
            self._sockets.append(opened)
        self._to = [(LOOPBACK, offboard_port + j) for j in range(count)]
        self._to_gcs = [(LOOPBACK, gcs_port + j) for j in range(count)]
        self._sequence = 0
        self._next_s = monotonic()
        self._beat_s = 0.0
        self.heard: set[int] = set()
        self.armed: set[int] = set()
        self.starts: dict[int, tuple[float, float, float]] = {}
        """Where each was at first, NED."""
        self.messages = 0

    def send(self, j: int, message: Any) -> None:
        self._sockets[j].sendto(encode(message, self._sequence & 0xFF, *CLIENT), self._to[j])
        self._sequence += 1

    def command(self, j: int, command: int, *params: float) -> None:
        filled = (*params, *([nan] * (7 - len(params))))
        self.send(j, mavlink.MAVLink_command_long_message(j + 1, 1, command, 0, *filled))

    def run(self, seconds: float, done: Callable[[], bool] = lambda: False, look: bool = False) -> bool:
        """Read and stream; with `look` what comes is understood. Ends early when `done`; whether it was."""
        end_s = monotonic() + seconds
        while monotonic() < end_s:
            now_s = monotonic()
            if now_s >= self._next_s:
                self._next_s = max(self._next_s + 1.0 / SETPOINT_HZ, now_s - 0.1)
                self._stream(now_s)
                if done():
                    return True
            for key, _ in self._selector.select(min(max(self._next_s - monotonic(), 0.0), 0.02)):
                self._read(key.fileobj, look)
        return done()

    def _read(self, opened: Any, look: bool) -> None:
        try:
            while True:
                datagram = opened.recv(4096)
                if look:
                    self._look(datagram)
                else:
                    self.messages += _frames(datagram)
        except BlockingIOError:
            pass

    def _look(self, datagram: bytes) -> None:
        for frame in parse(datagram):
            message = frame.message
            if message.get_type() == "HEARTBEAT":
                self.heard.add(frame.system_id)
                if message.base_mode & ARMED:
                    self.armed.add(frame.system_id)
            elif message.get_type() == "LOCAL_POSITION_NED":
                self.starts.setdefault(frame.system_id, (message.x, message.y, message.z))

    def _stream(self, now_s: float) -> None:
        for system_id, (x, y, z) in self.starts.items():
            j = system_id - 1
            datagram = _SETPOINT(
                self._sequence & 0xFF, *CLIENT, 0, system_id, 1, mavlink.MAV_FRAME_LOCAL_NED, POSITION_ONLY,
                x, y, z - HEIGHT_M, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
            )  # fmt: skip
            self._sequence += 1
            self._sockets[j].sendto(datagram, self._to[j])
        if now_s >= self._beat_s:
            self._beat_s = now_s + 1.0
            beat = encode(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), self._sequence & 0xFF, 255, 190)
            for to in self._to_gcs:
                self._sockets[-1].sendto(beat, to)

    def close(self) -> None:
        self._selector.close()
        for opened in self._sockets:
            opened.close()


def _frames(datagram: bytes) -> int:
    """How many MAVLink 2 frames without a signature are in it."""
    found = at = 0
    while at + 12 <= len(datagram):
        at += 12 + datagram[at + 1]
        found += 1
    return found


def _cpu_s(process_id: int) -> float:
    fields = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))


def _memory_mb(process_id: int) -> float:
    return int(Path(f"/proc/{process_id}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(count: int, seconds: float, settings: Sequence[str] = ()) -> Row:
    """A fleet of `count`, flying. Raises `RuntimeError` where one is not heard or does not arm."""
    block = _free_block(3 * count + 1)
    ports = (block, block + count, block + 2 * count, block + 3 * count)
    offboard, remote, gcs, gcs_remote = ports
    cpus = sorted(os.sched_getaffinity(0))
    load = Load(count, *ports)
    command = [
        sys.executable, "-m", "mavsitl", "vehicle", SCENARIO, "--count", str(count), "--no-state", "--status", "json",
        "--offboard-port", str(offboard), "--offboard-remote", f"{LOOPBACK}:{remote}",
        "--gcs-port", str(gcs), "--gcs-remote", f"{LOOPBACK}:{gcs_remote}",
    ]  # fmt: skip
    for setting in settings:
        command += ["--set", setting]
    os.sched_setaffinity(0, {cpus[-1]})
    started_s = monotonic()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, preexec_fn=lambda: os.sched_setaffinity(0, {cpus[0]}))
    try:
        wanted = set(range(1, count + 1))
        if not load.run(PATIENCE_S, lambda: load.heard >= wanted and load.starts.keys() >= wanted, look=True):
            raise RuntimeError(f"not heard: vehicles {sorted(wanted - load.heard)}")
        start_s = monotonic() - started_s
        load.run(2.0, look=True)
        deadline_s = monotonic() + PATIENCE_S
        while load.armed < wanted:
            if monotonic() > deadline_s:
                raise RuntimeError(f"not armed: vehicles {sorted(wanted - load.armed)}")
            for system_id in sorted(wanted - load.armed):
                load.command(system_id - 1, mavlink.MAV_CMD_DO_SET_MODE, 1, OFFBOARD_MODE)
                load.command(system_id - 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
            load.run(1.5, lambda: load.armed >= wanted, look=True)
        load.run(SETTLE_S)
        load.messages = 0
        before_s, wall_s = _cpu_s(process.pid), monotonic()
        load.run(seconds)
        wall_s = monotonic() - wall_s
        used_s = _cpu_s(process.pid) - before_s
        sent_hz, memory_mb = load.messages / wall_s, _memory_mb(process.pid)
        process.send_signal(signal.SIGTERM)
        assert process.stdout is not None
        end = json.loads(process.stdout.read().splitlines()[-1])
        process.wait()
        p50_us, p99_us = end["lateness_us"]
        return Row(count, used_s / wall_s, p50_us, p99_us, end["lost_s"], memory_mb, start_s, sent_hz)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()
        load.close()
        os.sched_setaffinity(0, cpus)


def table(rows: Sequence[Row]) -> list[str]:
    made = [
        "| vehicles | of a core | each | lateness p50 | p99 | given up | messages/s out | memory | all heard |",
        "|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        made.append(
            f"| {row.vehicles} | {100 * row.share:.1f} % | {100 * row.share_each:.2f} % | {row.p50_us / 1e3:.2f} ms "
            f"| {row.p99_us / 1e3:.2f} ms | {row.lost_s:.1f} s | {row.sent_hz:.0f} | {row.memory_mb:.0f} MB "
            f"| {row.start_s:.1f} s |"
        )
    return made


def draw(rows: Sequence[Row], path: Path) -> None:
    """Cost of the fleet and of each vehicle over the number of vehicles."""
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter

    counts = [row.vehicles for row in rows]
    with mpl.rc_context({"svg.hashsalt": "mavsitl", "svg.fonttype": "path", "font.size": 9}):
        figure = Figure(figsize=(8.0, 3.2), layout="constrained")
        whole, each = figure.subplots(1, 2)
        whole.plot(counts, [100 * row.share for row in rows], "o-", color="#084594", ms=4, lw=1.2)
        whole.axhline(100.0, color="0.4", lw=0.8)
        whole.annotate("one core", (counts[0], 100.0), xytext=(0, 3), textcoords="offset points", color="0.3")
        whole.set_ylabel("share of a core, %")
        each.plot(counts, [100 * row.share_each for row in rows], "o-", color="#e6550d", ms=4, lw=1.2)
        each.set_ylabel("share of a core per vehicle, %")
        for panel in (whole, each):
            panel.set_xscale("log")
            panel.set_xlabel("vehicles in the process")
            panel.xaxis.set_major_locator(FixedLocator(counts))
            panel.xaxis.set_minor_locator(NullLocator())
            panel.xaxis.set_major_formatter(ScalarFormatter())
            panel.set_ylim(bottom=0.0)
            panel.grid(color="0.9")
            panel.set_axisbelow(True)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.bench_fleet", description="Cost of a vehicle as its fleet grows."
    )
    parser.add_argument("--counts", default=",".join(map(str, COUNTS)), metavar="N,N", help="sizes (default: all)")
    parser.add_argument("--seconds", type=float, default=15.0, metavar="S", help="measured for so long (default: 15)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings")
    parser.add_argument("--figure", type=Path, metavar="FILE", help=f"draw there, e.g. {FIGURE}")
    options = parser.parse_args(argv)
    from rich.progress import track

    rows = []
    counts = [int(each) for each in options.counts.split(",")]
    for count in track(counts, description="fleets", console=None, disable=not sys.stderr.isatty()):
        rows.append(measure(count, options.seconds, options.settings))
        print(table(rows)[-1], file=sys.stderr, flush=True)
        sleep(0.5)
    print("\n".join(table(rows)))
    if options.figure is not None:
        draw(rows, options.figure)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
