"""A vehicle process and a client on its two ports, for the benchmarks that measure on the wall clock."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import nan
from pathlib import Path
from time import perf_counter
from typing import Any

from mavsitl import pair
from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.link.udp import LOOPBACK

OFFBOARD, GCS = 0, 1
PATIENCE_S = 60.0


class Live:
    """The process and the client's two sockets. `cpu_s` and `lateness_us` are there after `end`."""

    def __init__(self, *options: str, environment: dict[str, str] | None = None) -> None:
        ports = pair.free_ports(4)
        self._vehicle_ports = ports[:2]
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
        for opened, port in zip(self._sockets, ports[2:], strict=True):
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            opened.bind((LOOPBACK, port))
            opened.settimeout(PATIENCE_S)
        self._sequence = 0
        self.cpu_s = nan
        """User and system time of the process, from its start to its end."""
        self.lateness_us = (nan, nan)
        """p50 and p99 of the tick's lateness, as the vehicle says when it ends."""
        links = (
            "--offboard-port", str(ports[0]), "--offboard-remote", f"{LOOPBACK}:{ports[2]}",
            "--gcs-port", str(ports[1]), "--gcs-remote", f"{LOOPBACK}:{ports[3]}",
        )  # fmt: skip
        self.started_s = perf_counter()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "mavsitl", "vehicle", "--no-state", *links, *options],
            stdout=subprocess.PIPE, env={**os.environ, **(environment or {})}, text=True,
        )  # fmt: skip

    def send(self, message: Any, port: int = OFFBOARD) -> None:
        datagram = encode(message, self._sequence & 0xFF, 245, 190)
        self._sequence += 1
        self._sockets[port].sendto(datagram, (LOOPBACK, self._vehicle_ports[port]))

    def drain(self) -> None:
        """Forget what has come."""
        for opened in self._sockets:
            opened.setblocking(False)
            try:
                while True:
                    opened.recv(4096)
            except BlockingIOError:
                opened.settimeout(PATIENCE_S)

    def wait_for(self, wanted: Callable[[Any], bool], port: int = OFFBOARD) -> Any:
        """The first message that is wanted; other messages are dropped."""
        while True:
            for frame in parse(self._sockets[port].recv(4096)):
                if wanted(frame.message):
                    return frame.message

    def wait_ready(self) -> None:
        wait = self.wait_for
        wait(lambda m: m.get_type() == "SYS_STATUS" and bool(m.onboard_control_sensors_health & PREARM), GCS)

    def command(self, command: int, *params: float) -> int:
        """The result."""
        filled = (*params, *([nan] * (7 - len(params))))
        self.send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *filled))
        return int(self.wait_for(lambda m: m.get_type() == "COMMAND_ACK" and m.command == command).result)

    def cpu_now_s(self) -> float:
        """User and system time so far, to a clock tick of the system (10 ms). Linux only."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))

    def end(self) -> None:
        """Ask the process to end, and note what it used."""
        self.process.send_signal(signal.SIGTERM)
        assert self.process.stdout is not None
        said = self.process.stdout.read()
        _, status, usage = os.wait4(self.process.pid, 0)
        self.process.returncode = os.waitstatus_to_exitcode(status)
        self.cpu_s = usage.ru_utime + usage.ru_stime
        found = re.search(r"p50 (\d+) us, p99 (\d+) us", said)
        if found:
            self.lateness_us = float(found[1]), float(found[2])

    def close(self) -> None:
        if self.process.returncode is None:
            self.process.kill()
            self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()
        for opened in self._sockets:
            opened.close()


@contextmanager
def installed() -> Iterator[dict[str, str]]:
    """The environment of a process whose bytecode is kept, as an installation has it, whatever is said in ours.

    Without it every start compiles a hundred modules. It is kept in a folder that goes with the context.
    """
    with tempfile.TemporaryDirectory() as folder:
        yield {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": folder}


PREARM: int = mavlink.MAV_SYS_STATUS_PREARM_CHECK


@contextmanager
def live(*options: str, environment: dict[str, str] | None = None) -> Iterator[Live]:
    """A vehicle that runs until the context is left."""
    vehicle = Live(*options, environment=environment)
    try:
        yield vehicle
    finally:
        vehicle.close()
