"""A flight by two operating-system processes, a vehicle and a ground, that share nothing but datagrams on loopback."""

from __future__ import annotations

import os
import random
import selectors
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import msgspec

from mavsitl.errors import EXIT_USAGE, MavsitlError
from mavsitl.link.udp import LOOPBACK
from mavsitl.scenario import ScenarioError

Event = dict[str, Any]
OnEvent = Callable[[str, Event], None]
"""(end, event): end is "vehicle" or "ground"; events are what ``--status json`` prints, a JSON object a line."""


class PairError(MavsitlError, RuntimeError):
    """One of the two processes failed; the message is its own."""


@dataclass
class Result:
    """The last word of each end, the event "end" of ``--status json``."""

    vehicle: Event = field(default_factory=dict)
    ground: Event = field(default_factory=dict)


def free_ports(count: int) -> list[int]:
    """Ports of loopback that were free a moment ago."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    try:
        for each in sockets:
            each.bind((LOOPBACK, 0))
        return [each.getsockname()[1] for each in sockets]
    finally:
        for each in sockets:
            each.close()


def fly(scenario: str, settings: Sequence[str], folder: Path, on_event: OnEvent) -> Result:
    """Fly one scenario in lock-step; the logs go to `folder`. Both processes are ended whatever happens.

    `settings` are ``--set`` arguments. Raises `PairError` with the text of the end that failed, `ScenarioError` where
    the scenario is to blame.
    """
    vehicle_port, ground_port = free_ports(2)
    common = [scenario, "--lockstep", "--run-dir", str(folder), "--status", "json"]
    if hasattr(os, "sched_getaffinity"):
        first, *others = sorted(os.sched_getaffinity(0))  # the first serves most interrupts
        common += ["--cpu", str(random.choice(others or [first]))]
    for setting in settings:
        common += ["--set", setting]
    vehicle = [
        "vehicle",
        *common,
        "--offboard-port",
        str(vehicle_port),
        "--offboard-remote",
        f"{LOOPBACK}:{ground_port}",
    ]
    ground = ["ground", *common, "--link", f"udpin:{LOOPBACK}:{ground_port}", "--vehicle", f"{LOOPBACK}:{vehicle_port}"]
    processes: dict[str, subprocess.Popen[bytes]] = {}
    try:
        processes["ground"] = _start(ground)
        processes["vehicle"] = _start(vehicle)
        return _follow(processes, on_event)
    finally:
        for process in processes.values():
            if process.poll() is None:
                process.terminate()
        for process in processes.values():
            try:
                process.wait(timeout=5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            for stream in (process.stdout, process.stderr):
                if stream is not None:
                    stream.close()


def _start(arguments: list[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "mavsitl", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )


def _follow(processes: dict[str, subprocess.Popen[bytes]], on_event: OnEvent) -> Result:
    """Read both ends' events until both have ended or one has failed. A lost vehicle is an end, too."""
    result = Result()
    errors = dict.fromkeys(processes, b"")
    with selectors.DefaultSelector() as selector:
        for end, process in processes.items():
            selector.register(_stream(process.stdout), selectors.EVENT_READ, (end, "out"))
            selector.register(_stream(process.stderr), selectors.EVENT_READ, (end, "err"))
        open_streams = 2 * len(processes)
        pending = dict.fromkeys(processes, b"")
        while open_streams:
            for key, _ in selector.select():
                end, kind = key.data
                chunk = os.read(key.fd, 65536)
                if not chunk:
                    selector.unregister(key.fileobj)
                    open_streams -= 1
                    ended_well = kind != "out" or processes[end].wait() == 0 or getattr(result, end).get("lost")
                    if not ended_well:
                        _drain(processes[end], errors, end)
                        said = errors[end].decode(errors="replace").strip() or "the flight did not end as planned"
                        blame = ScenarioError if processes[end].returncode == EXIT_USAGE else PairError
                        raise blame(f"{end}: {said}")
                elif kind == "err":
                    errors[end] += chunk
                else:
                    *lines, pending[end] = (pending[end] + chunk).split(b"\n")
                    for line in lines:
                        event = msgspec.json.decode(line)
                        if event.get("event") == "end":
                            setattr(result, end, event)
                        on_event(end, event)
    return result


def _drain(process: subprocess.Popen[bytes], errors: dict[str, bytes], end: str) -> None:
    if process.stderr is not None:
        errors[end] += process.stderr.read()


def _stream(stream: IO[bytes] | None) -> IO[bytes]:
    if stream is None:  # Popen was asked for pipes
        raise AssertionError("no pipe")
    return stream
