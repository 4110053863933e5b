"""Floods against a real vehicle process on loopback: `python -m tests.hostile.floods`.

Each flood comes from 300 source ports. The vehicle hovers in AUTO.LOITER, and an honest ground station, which asks a
command ten times a second, measures telemetry, round trips and hover.
"""

from __future__ import annotations

import argparse
import os
import random
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import dist, nan
from time import monotonic, sleep
from typing import Any, NamedTuple

from mavsitl import pair
from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.link.udp import LOOPBACK
from tests.hostile.attacks import HANDLED, Attacker, message_class
from tests.hostile.report import Bar, Report, bar
from tests.hostile.rivals import Wire, client, heard, wire

SOURCES = 300
FLOOD_HZ, JUNK_HZ = 5_000.0, 20_000.0
CALM_S, FLOOD_S, PAUSE_S = 6.0, 4.0, 0.5
ASK_S = 0.1
LOST_S = 1.0
"""A command without an answer for so long is lost."""
HONEST = (255, 190)
HEIGHT_M = 3.0
TELEMETRY_SHARE, RTT_S, HOVER_M = 0.9, 0.25, 0.3
QUIET = ("SETUP_SIGNING",)
"""What says nothing about a flood."""


def frames(name: str, count: int = 200) -> list[bytes]:
    """Frames of one message that a second source might send in good faith, again and again."""
    kind = message_class(name)
    made = []
    for number in range(count):
        values: dict[str, Any] = {}
        for each, code, length in zip(
            kind.ordered_fieldnames, kind.native_format.decode()[1:], kind.lengths, strict=True
        ):
            values[each] = b"" if code == "c" else [0] * length if length > 1 else 0
        values.update({each: 1 for each in ("target_system", "target_component") if each in values})
        values |= FIELDS.get(name, {})
        if name == "PING":
            values |= {"target_system": 0, "target_component": 0, "seq": number}
        elif name == "TIMESYNC":
            values["ts1"] = number
        elif name == "FILE_TRANSFER_PROTOCOL":
            values["payload"] = list(bytes((number & 0xFF, 0, 0, 3)) + bytes(247))  # ListDirectory
        message = kind(**{each: values[each] for each in kind.fieldnames})
        made.append(encode(message, number & 0xFF, 66, 1))
    return made


HOLD = mavlink.MAV_CMD_REQUEST_MESSAGE
FIELDS: dict[str, dict[str, Any]] = {
    "COMMAND_LONG": {"command": HOLD, "param1": float(mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES), "param2": 0.0},
    "COMMAND_INT": {"command": mavlink.MAV_CMD_RUN_PREARM_CHECKS},
    "SET_MODE": {"base_mode": 1, "custom_mode": 11 << 16},
    "SET_ATTITUDE_TARGET": {"q": [1.0, 0.0, 0.0, 0.0], "thrust": 0.5, "type_mask": 7},
    "SET_POSITION_TARGET_LOCAL_NED": {"coordinate_frame": 1, "x": 50.0, "z": -HEIGHT_M},
    "SET_POSITION_TARGET_GLOBAL_INT": {"coordinate_frame": 6, "alt": HEIGHT_M},
    "HEARTBEAT": {"type": mavlink.MAV_TYPE_GCS, "autopilot": 8},
    "MISSION_COUNT": {"count": 65535},
    "MISSION_SET_CURRENT": {"seq": 65535},
    "PARAM_REQUEST_READ": {"param_id": b"MC_ROLL_P", "param_index": -1},
    "PARAM_SET": {"param_id": b"MC_ROLL_P", "param_type": 9, "param_value": nan},
    "LOG_REQUEST_LIST": {"end": 65535},
    "LOG_REQUEST_DATA": {"count": 2**32 - 1},
    "MANUAL_CONTROL": {"target": 1, "z": 500},
}  # fmt: skip


class Kind(NamedTuple):
    """One flood."""

    rate_hz: float
    datagrams: list[bytes]
    sources: int = SOURCES


def kinds() -> dict[str, Kind]:
    """By name."""
    found = {name: Kind(FLOOD_HZ, frames(name)) for name in HANDLED if name not in QUIET}
    # From one source, which is a peer and has a peer's budget.
    for name in FROM_ONE:
        found[f"{name}, one source"] = Kind(FLOOD_HZ, frames(name), 1)
    attacker = Attacker("flood")
    found["hostile fields"] = Kind(FLOOD_HZ, [attacker.frame(name) for name in HARMLESS for _ in range(100)])
    found["junk"] = Kind(JUNK_HZ, [random.Random(number).randbytes(64) for number in range(500)])
    found["broken frames"] = Kind(JUNK_HZ, [attacker.broken() for _ in range(1000)])
    return found


FROM_ONE = ("COMMAND_LONG", "PARAM_SET", "FILE_TRANSFER_PROTOCOL", "MISSION_COUNT", "MISSION_ITEM_INT", "PING")


HARMLESS = (
    "SET_ATTITUDE_TARGET",
    "SET_POSITION_TARGET_LOCAL_NED",
    "MISSION_ITEM_INT",
    "FILE_TRANSFER_PROTOCOL",
    "PING",
)
"""Whatever their fields hold, they do not end a hover in AUTO.LOITER."""


@dataclass
class Figures:
    """What the honest ground station saw in one stretch."""

    seconds: float = 0.0
    messages: int = 0
    round_trips_s: list[float] = field(default_factory=list)
    asked: int = 0
    hover_m: float = 0.0
    critical: bool = False
    left_mode: bool = False

    @property
    def rate_hz(self) -> float:
        return self.messages / self.seconds if self.seconds else 0.0

    @property
    def p99_s(self) -> float:
        """A lost one counts as `LOST_S`."""
        times = sorted([*self.round_trips_s, *[LOST_S] * (self.asked - len(self.round_trips_s))])
        return times[min(len(times) - 1, int(0.99 * len(times)))] if times else LOST_S


HOLD_WITHOUT_STICKS = 2
"""COM_RCL_EXCEPT: a flood of MANUAL_CONTROL that ends is else a lost stick, with a fail-safe of its own."""
STREAMS = frozenset({"ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "ALTITUDE"})
"""Telemetry that comes unasked at a steady rate: what is counted."""


class Station:
    """The process, and an honest ground station at its remote for those."""

    def __init__(self) -> None:
        ports = pair.free_ports(4)
        self.offboard_port, self.gcs_port = ports[:2]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self._socket.bind((LOOPBACK, ports[3]))
        self._sequence = 0
        self.mode = (0, 0)
        self.armed = False
        self.position: list[float] = [0.0, 0.0, 0.0]
        self.home: list[float] = [0.0, 0.0, 0.0]
        self._asked: dict[int, float] = {}
        self._number = 0
        self.process = subprocess.Popen(
            [
                sys.executable, "-m", "mavsitl", "vehicle", "--no-state", "--status", "json",
                "--offboard-port", str(ports[0]), "--offboard-remote", f"{LOOPBACK}:{ports[2]}",
                "--gcs-port", str(ports[1]), "--gcs-remote", f"{LOOPBACK}:{ports[3]}",
                "--set", f"parameters.COM_RCL_EXCEPT={HOLD_WITHOUT_STICKS}",
            ],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def send(self, message: Any) -> None:
        self._sequence = (self._sequence + 1) & 0xFF
        self._socket.sendto(encode(message, self._sequence, *HONEST), (LOOPBACK, self.gcs_port))

    def command(self, command: int, *params: float) -> None:
        filled = (*params, *([nan] * (7 - len(params))))
        self.send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *filled))

    def watch(self, seconds: float, progress: Bar | None = None) -> Figures:
        """Ask and listen for so long."""
        figures = Figures()
        begin = now = monotonic()
        next_ask = next_beat = begin
        while now - begin < seconds:
            if now >= next_beat:
                self.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
                next_beat += 1.0
            if now >= next_ask:
                next_ask += ASK_S
                self._number += 1
                figures.asked += 1
                self._asked[self._number] = now
                # An interval of its own for each question tells the answers apart.
                self.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL, self._number)
                if progress is not None:
                    progress.move(0)
            self._listen(min(next_ask, next_beat) - now, figures)
            now = monotonic()
        late = now + LOST_S
        while any(number in self._asked for number in list(self._asked)) and monotonic() < late:
            self._listen(0.05, Figures(), into=figures)
        self._asked.clear()
        figures.seconds = now - begin
        return figures

    def _listen(self, timeout_s: float, figures: Figures, into: Figures | None = None) -> None:
        if not select.select([self._socket], [], [], max(timeout_s, 0.0))[0]:
            return
        self._socket.setblocking(False)
        for _ in range(200):
            try:
                datagram = self._socket.recv(4096)
            except BlockingIOError:
                break
            for frame in parse(datagram):
                if (frame.system_id, frame.component_id) == (1, 1):
                    self._hear(frame.message, into or figures, figures)
        self._socket.setblocking(True)

    def _hear(self, message: Any, trips: Figures, figures: Figures) -> None:
        name = message.get_type()
        figures.messages += name in STREAMS
        if name == "HEARTBEAT":
            self.mode = (message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF)
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            figures.critical = figures.critical or message.system_status >= mavlink.MAV_STATE_CRITICAL
            figures.left_mode = figures.left_mode or self.mode != (4, 3) or not self.armed
        elif name == "LOCAL_POSITION_NED":
            self.position = [message.x, message.y, message.z]
            figures.hover_m = max(figures.hover_m, dist(self.position, self.home))
        elif name == "MESSAGE_INTERVAL":
            asked = self._asked.pop(message.message_id, None)
            if asked is not None:
                trips.round_trips_s.append(monotonic() - asked)

    def take_off(self) -> None:
        """Up, and at rest in AUTO.LOITER."""
        deadline = monotonic() + 90.0
        while not self.armed:
            assert monotonic() < deadline, "it did not arm"
            self.command(mavlink.MAV_CMD_NAV_TAKEOFF)
            self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
            self.watch(0.5)
        while self.mode != (4, 3):
            assert monotonic() < deadline, "it did not take off"
            self.watch(0.5)
        self.watch(3.0)
        self.home = list(self.position)

    def end(self) -> dict[str, Any]:
        """What the process says at its end; empty where it had ended by itself."""
        import json

        assert self.process.stdout is not None
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        said = self.process.stdout.read()
        code = self.process.wait()
        self.process.stdout.close()
        self._socket.close()
        if code != 0:
            return {}
        events: list[dict[str, Any]] = [json.loads(line) for line in said.splitlines() if line.startswith("{")]
        return next((event for event in events if event["event"] == "end"), {})


class Flood(threading.Thread):
    """Sends from many sockets, in bursts of a millisecond's worth, in a process of its own."""

    def __init__(self, port: int, kind: Kind, seconds: float) -> None:
        super().__init__(daemon=True)
        self._port, self._kind, self._seconds = port, kind, seconds

    def run(self) -> None:
        child = os.fork()
        if child == 0:
            code = 0
            try:
                self._flood()
            except BaseException:
                code = 1
            os._exit(code)
        os.waitpid(child, 0)

    def _flood(self) -> None:
        rate_hz, datagrams, sources = self._kind
        sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(sources)]
        begin = monotonic()
        sent = 0
        while (passed := monotonic() - begin) < self._seconds:
            while sent < passed * rate_hz:
                sockets[sent % sources].sendto(datagrams[sent % len(datagrams)], (LOOPBACK, self._port))
                sent += 1
            sleep(0.001)


def floods(names: Sequence[str] | None = None, *, show: bool = True) -> Report:
    """All of them, or those named, one after the other."""
    assert names is None or set(names) <= set(kinds()), f"known: {', '.join(kinds())}"
    chosen = {name: kind for name, kind in kinds().items() if names is None or name in names}
    report = Report("floods from 300 ports, as an honest ground station sees the vehicle")
    station = Station()
    try:
        with bar(len(chosen), show=show) as progress:
            progress.move(0, "take-off")
            station.take_off()
            calm = station.watch(CALM_S)
            report.demand("calm: telemetry 1/s", "> 0", calm.rate_hz, calm.rate_hz > 0.0)
            report.demand("calm: command p99, ms", f"<= {RTT_S * 1e3:g}", 1e3 * calm.p99_s, calm.p99_s <= RTT_S)
            report.demand("calm: hover, m", "", calm.hover_m, True)
            for name, kind in chosen.items():
                progress.move(0, name)
                flood = Flood(station.gcs_port, kind, FLOOD_S + 0.2)
                flood.start()
                sleep(0.1)
                seen = station.watch(FLOOD_S)
                flood.join()
                station.watch(PAUSE_S)
                alive = station.process.poll() is None
                share = seen.rate_hz / calm.rate_hz
                met = (
                    alive and share >= TELEMETRY_SHARE and seen.p99_s <= RTT_S
                    and seen.hover_m <= calm.hover_m + HOVER_M and not seen.critical and not seen.left_mode
                )  # fmt: skip
                state = "crashed" if not alive else "fail-safe" if seen.critical or seen.left_mode else "flies"
                report.demand(
                    f"{name} {kind.rate_hz:g}/s", "90 %, 250 ms, calm + 0.3 m, flies",
                    f"{share:.0%}, {1e3 * seen.p99_s:.0f} ms ({len(seen.round_trips_s)}/{seen.asked}), "
                    f"{seen.hover_m:.2f} m, {state}", met,
                )  # fmt: skip
                progress.move(1)
                if not alive:
                    break
    finally:
        end = station.end()
    dropped = end.get("dropped", {})
    report.demand("ended in order", "yes", bool(end), bool(end))
    report.demand("exceptions of a handler", "0", dropped.get("errors", 0), not dropped.get("errors", 0))
    counted = {name: dropped.get(name, 0) for name in ("over_budget", "crowded")}
    report.demand("dropped and counted, by reason", "> 0", counted, names is not None or all(counted.values()))
    return report


SHORT_S = 0.4


def simulated(report: Report, names: Sequence[str] | None = None, *, seconds: float = SHORT_S) -> None:
    """The same floods in simulated time: what arrives is weighed and counted, and no clock of the wall is looked at."""
    chosen = {name: kind for name, kind in kinds().items() if names is None or name in names}
    with wire() as world:
        sources = [client() for _ in range(SOURCES)]
        try:
            _simulated(report, world, sources, chosen, seconds)
        finally:
            for opened in sources:
                opened.close()


def _simulated(
    report: Report,
    world: Wire,
    sources: Sequence[socket.socket],
    chosen: dict[str, Kind],
    seconds: float,
) -> None:
    period_s = world.vehicle.period_us / 1e6

    def say(command: int, *params: float) -> None:
        filled = (*params, *([nan] * (7 - len(params))))
        message = mavlink.MAVLink_command_long_message(1, 1, command, 0, *filled)
        world.remote.sendto(encode(message, 0, *HONEST), world.gcs)

    def stretch(kind: Kind, duration_s: float) -> tuple[float, float, float]:
        """Telemetry a second, share of the questions that were answered, and the farthest from `home`, m."""
        heard(world.remote)
        sent = asked = ticks = 0
        worst_m = 0.0

        def each() -> None:
            nonlocal sent, asked, ticks, worst_m
            ticks += 1
            while sent < ticks * period_s * kind.rate_hz:
                sources[sent % kind.sources].sendto(kind.datagrams[sent % len(kind.datagrams)], world.gcs)
                sent += 1
            if ticks % 10 == 0:
                asked += 1
                say(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL, asked)
            worst_m = max(worst_m, dist(world.vehicle.simulation.x[:3, 0].tolist(), home))

        world.run(duration_s, each)
        world.run(0.02)
        messages = [frame.message for datagram in heard(world.remote) for frame in parse(datagram)]
        answers = {m.message_id for m in messages if m.get_type() == "MESSAGE_INTERVAL"}
        telemetry = sum(m.get_type() in STREAMS for m in messages)
        return telemetry / duration_s, len(answers & set(range(1, asked + 1))) / asked, worst_m

    home = [0.0, 0.0, 0.0]
    world.vehicle.parameters.put("COM_RCL_EXCEPT", HOLD_WITHOUT_STICKS)
    world.run(0.4)
    say(mavlink.MAV_CMD_NAV_TAKEOFF)
    say(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    world.run(8.0)
    commander = world.vehicle.autopilot.commander
    assert commander.armed, "it did not take off"
    home = world.vehicle.simulation.x[:3, 0].tolist()
    calm_hz, _, _ = stretch(Kind(0.0, []), 2.0)
    for name, kind in chosen.items():
        telemetry_hz, answered, worst_m = stretch(kind, seconds)
        # A stretch this short cuts each stream anywhere.
        met = (
            telemetry_hz >= TELEMETRY_SHARE * calm_hz - 5 / seconds and answered >= 0.95 and worst_m <= HOVER_M
            and commander.armed and commander.mode.name == "LOITER" and not commander.failsafe
        )  # fmt: skip
        report.demand(
            f"{name} {kind.rate_hz:g}/s", "90 %, 95 %, 0.3 m",
            f"{telemetry_hz:.0f} of {calm_hz:.0f}/s, {answered:.0%}, {worst_m:.2f} m", met,
        )  # fmt: skip
    counters = world.vehicle.counters
    dropped = counters.over_budget + counters.crowded
    report.demand("dropped and counted", "> 0", dropped, dropped > 0)
    report.demand("exceptions of a handler", "0", counters.errors, counters.errors == 0)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", metavar="NAME", help="one kind; may be repeated")
    options = parser.parse_args()
    return floods(options.only).print()


if __name__ == "__main__":
    sys.exit(main())
