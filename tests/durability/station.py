"""Real processes of mavsitl, and a ground station that carries out transactions with one of them."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from math import nan
from pathlib import Path
from time import monotonic
from typing import Any

from mavsitl import pair
from mavsitl.codec import parse
from mavsitl.dialect import mavlink
from mavsitl.link.udp import LOOPBACK
from mavsitl.node import Node
from mavsitl.services.base import Service
from mavsitl.services.command import CommandClient
from mavsitl.services.ftp import FtpClient
from mavsitl.services.log_transfer import LogClient
from mavsitl.services.mission import MissionClient
from mavsitl.services.parameter import ParameterClient
from mavsitl.services.statustext import Joiner
from mavsitl.services.timesync import TimesyncClient

VEHICLE = (1, 1)
PATIENCE_S = 120.0
"""Of a wait whose length is not what is measured: a first start compiles, on a machine that may be busy."""
HEARTBEAT_S = 1.0
SLICE_S = 0.02


class Process:
    """One `mavsitl` process; what it prints is kept, so that it never waits for a reader."""

    def __init__(self, *arguments: str) -> None:
        self.started_s = monotonic()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "mavsitl", *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )  # fmt: skip
        self.pid = self._process.pid
        self._lock = threading.Lock()
        self._printed = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        while chunk := self._process.stdout.read1(65536):  # type: ignore[attr-defined]
            with self._lock:
                self._printed += chunk.decode(errors="replace")

    @property
    def printed(self) -> str:
        with self._lock:
            return self._printed

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def send(self, number: int) -> None:
        self._process.send_signal(number)

    def kill(self) -> None:
        """At once, by SIGKILL."""
        self._process.kill()
        self.wait()

    def end(self, number: int = signal.SIGTERM) -> int:
        """Ask it to end; its exit code."""
        self._process.send_signal(number)
        return self.wait()

    def wait(self) -> int:
        """Its exit code."""
        code = self._process.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        assert self._process.stdout is not None
        self._process.stdout.close()
        return code

    def close(self) -> None:
        """Whatever has become of it."""
        if self.running:
            self._process.kill()
        self.wait()


class Ports:
    """Of a vehicle (off-board, ground station) and of those it sends to."""

    def __init__(self) -> None:
        self.offboard, self.gcs, self.offboard_remote, self.gcs_remote = pair.free_ports(4)

    def vehicle(self, *options: str) -> list[str]:
        """The command line of a vehicle there."""
        return [
            "vehicle", *options,
            "--offboard-port", str(self.offboard), "--offboard-remote", f"{LOOPBACK}:{self.offboard_remote}",
            "--gcs-port", str(self.gcs), "--gcs-remote", f"{LOOPBACK}:{self.gcs_remote}",
        ]  # fmt: skip

    def ground(self, *options: str) -> list[str]:
        """The command line of a ground that hears that vehicle."""
        return ["ground", *options, "--link", f"udpin:{LOOPBACK}:{self.offboard_remote}"]


class Station:
    """A ground station at the vehicle's second port, with the client halves of all services.

    Attributes:
        heard: the newest message of each name from the vehicle, with the wall time it came, seconds.
        texts: every STATUSTEXT.
        watch: is called with each message of the vehicle and its wall time.
    """

    def __init__(self, ports: Ports) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self._socket.bind((LOOPBACK, ports.gcs_remote))
        self._socket.setblocking(False)
        self._vehicle = (LOOPBACK, ports.gcs)
        self._node = Node(255, 190)
        self._heartbeat_s = -HEARTBEAT_S
        self.heard: dict[str, tuple[float, Any]] = {}
        self.texts: list[str] = []
        self.watch: Callable[[Any, float], None] = lambda message, now_s: None
        self.renew()

    def renew(self) -> None:
        """Forget everything about the vehicle: it is another process now."""
        self.heard.clear()
        self.texts.clear()
        self._joiner = Joiner()
        self.parameters = ParameterClient(VEHICLE)
        self.missions = MissionClient(VEHICLE)
        self.files = FtpClient(VEHICLE)
        self.logs = LogClient(VEHICLE)
        self.timesync = TimesyncClient(VEHICLE, interval_us=100_000)
        self.commands = CommandClient(self._send_command)
        self._services: tuple[Service, ...] = (self.parameters, self.missions, self.files, self.logs, self.timesync)

    def _send_command(self, command: int, confirmation: int, params: tuple[float, ...]) -> None:
        filled = (*params, *([nan] * (7 - len(params))))
        self._node.send_message(mavlink.MAVLink_command_long_message(*VEHICLE, command, confirmation, *filled))

    def drain(self) -> None:
        """Drop what has come and was not looked at."""
        while select.select([self._socket], (), (), 0.0)[0]:
            self._socket.recv(65535)

    def pump(self, wait_s: float = SLICE_S) -> None:
        """Take what has come within a moment, let the services act, send what they say."""
        if select.select([self._socket], (), (), wait_s)[0]:
            for _ in range(500):
                try:
                    datagram = self._socket.recv(65535)
                except BlockingIOError:
                    break
                self._take(datagram, monotonic())
        now_s = monotonic()
        now_us = round(now_s * 1e6)
        if now_s - self._heartbeat_s >= HEARTBEAT_S:
            self._heartbeat_s = now_s
            self._node.send_message(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
        for service in self._services:
            for answer in service.step(now_us):
                self._node.send_message(answer)
        self.commands.step(now_us)
        for out in self._node.datagrams():
            self._socket.sendto(out, self._vehicle)

    def _take(self, datagram: bytes, now_s: float) -> None:
        for frame in parse(datagram):
            if (frame.system_id, frame.component_id) != VEHICLE:
                continue
            message = frame.message
            name = message.get_type()
            self.heard[name] = (now_s, message)
            self.watch(message, now_s)
            if name == "STATUSTEXT":
                self.texts += [text.text for text in self._joiner.receive(message, VEHICLE, round(now_s * 1e6))]
            elif name == "COMMAND_ACK":
                self.commands.receive(message)
            for service in self._services:
                if service is self.timesync and name != "TIMESYNC":
                    continue
                for answer in service.receive(message, VEHICLE, round(now_s * 1e6)):
                    self._node.send_message(answer)

    def run(self, seconds: float) -> None:
        until_s = monotonic() + seconds
        while (left_s := until_s - monotonic()) > 0.0:
            self.pump(min(SLICE_S, left_s))

    def until(
        self,
        condition: Callable[[], object],
        limit_s: float = PATIENCE_S,
        what: str | Callable[[], str] = "it",
    ) -> float:
        """Pump until `condition`; how long that took, seconds. `what` is named where it takes too long."""
        begin_s = monotonic()
        while not condition():
            if monotonic() - begin_s >= limit_s:
                waited_for = what() if callable(what) else what
                raise AssertionError(f"not within {limit_s:g} s: {waited_for}; the vehicle said {self.texts}")
            self.pump()
        return monotonic() - begin_s

    def wait_booted(self) -> None:
        """Until it is the vehicle itself that speaks, and not the first words of a process that is still loading."""
        self.until(lambda: "SYS_STATUS" in self.heard, what="a vehicle")

    def clock_ms(self) -> float:
        """The newest time since boot that the vehicle has said, ms; 0 before any."""
        return max((m.time_boot_ms for _, m in self.heard.values() if hasattr(m, "time_boot_ms")), default=0.0)

    def close(self) -> None:
        self._socket.close()


def stop_all(processes: Sequence[Process]) -> None:
    for process in processes:
        process.close()


def proc_status(pid: int | str) -> tuple[int, int, int]:
    """Resident memory in KiB, open file descriptors, threads of a process, or "self". Linux only."""
    fields = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines() if ":" in line)
    return int(fields["VmRSS"].split()[0]), len(os.listdir(f"/proc/{pid}/fd")), int(fields["Threads"])  # noqa: PTH208
