"""A newcomer's path, timed: ``python -m tests.downstream.newcomer``.

README's commands as they stand there, in a shell, with a clone of this tree's HEAD for the repository:

1. the first one, from the clone to the first report;
2. the one for QGroundControl, from the clone until a HEARTBEAT comes to UDP 14550, where QGroundControl listens.
   pymavlink stands for it there: it asks for all parameters, uploads a mission and downloads it again.

Nothing is there before: the environment is new, the compiled kernels and the vehicle's state have new folders. What has
been downloaded is in pip's cache, or, with `--cold`, comes through the network again.
"""

from __future__ import annotations

import argparse
import os
import re
import select
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from math import inf
from pathlib import Path
from time import perf_counter, time
from typing import IO, Any, NamedTuple

from tests.docs import blocks
from tests.downstream.steps import PATIENCE_S, ROOT, StepError, clean, run

LISTENED_PORT = 14550
"""Where QGroundControl listens and where `mavsitl vehicle` sends unless told otherwise."""

ASK_AGAIN_S = 5.0
"""QGroundControl's patience with a list of parameters of which nothing comes."""

PLAN = ((22, 47.397742, 8.545594, 10.0), (16, 47.398, 8.5456, 12.0), (16, 47.398, 8.546, 12.0), (20, 0.0, 0.0, 0.0))
"""Command, latitude, longitude, height above home."""

NAMES = {"git": "clone", "cd": "", "python3": "virtual environment", ".venv/bin/pip": "install"}


def commands(url: str, page: str = "README.md") -> dict[str, list[str]]:
    """README's commands that begin with a clone, by mavsitl's subcommand in the last of their parts."""
    found = {}
    for block in blocks.of_page(page):
        parts = block.text.strip().split(" && ")
        if block.language == "sh" and parts[0].startswith("git clone <url> "):
            subcommand = parts[-1].removeprefix(".venv/bin/mavsitl ").split()[0]
            found[subcommand] = [parts[0].replace("<url>", url), *parts[1:]]
    return found


def stamped(parts: Sequence[str]) -> str:
    """The parts as README joins them, with a line of the time after each on file descriptor 3."""
    return " && ".join(f"{part} && date +%s.%N >&3" for part in parts)


@contextmanager
def listening(port: int) -> Iterator[Any]:
    """QGroundControl's place. Raises `StepError` where somebody else is there."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
            trial.bind(("127.0.0.1", port))
    except OSError as error:
        raise StepError(f"UDP {port} is taken, by a ground station or another vehicle's: {error.strerror}") from error
    from pymavlink import mavutil

    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=255, source_component=190)
    try:
        yield link
    finally:
        link.close()


def silent_until(link: Any, started: Callable[[], bool]) -> None:
    """Until our vehicle has been started. Raises `StepError` for a word before, which is of another vehicle."""
    while not started():
        if select.select([link.port], [], [], 0.02)[0] and not started():
            _, sender = link.port.recvfrom(2048)
            raise StepError(f"another vehicle, at {sender[0]}:{sender[1]}, sends to our port: end it first")


class Station(NamedTuple):
    """What came of a ground station's first minute."""

    heartbeat_s: float
    """By the clock of `time.time`."""
    parameters: int
    parameters_s: float
    """From the HEARTBEAT on; the vehicle may have to be compiled before it answers."""
    mission_s: float


def station(link: Any, patience_s: float = PATIENCE_S) -> Station:
    """Wait for a vehicle; its parameters, a mission to it and back. Raises `StepError`."""

    def message(names: str | list[str], limit_s: float = 10.0) -> Any:
        found = link.recv_match(type=names, blocking=True, timeout=limit_s)
        if found is None:
            raise StepError(f"the vehicle sends no {names} within {limit_s:g} s")
        return found

    beat = message("HEARTBEAT", patience_s)
    heartbeat_s = time()
    to = beat.get_srcSystem(), beat.get_srcComponent()
    link.mav.heartbeat_send(6, 8, 0, 0, 0)

    begun = perf_counter()
    names: set[str] = set()
    wanted = 1
    asked_s = -inf
    while len(names) < wanted:
        # The vehicle says HEARTBEAT while its kernels are compiled, and answers afterwards.
        if perf_counter() - begun > patience_s:
            raise StepError(f"{len(names)} of {wanted} parameters within {patience_s:g} s")
        if perf_counter() - asked_s > ASK_AGAIN_S:
            link.mav.param_request_list_send(*to)
            asked_s = perf_counter()
        value = link.recv_match(type="PARAM_VALUE", blocking=True, timeout=1.0)
        if value is not None:
            names.add(value.param_id)
            wanted, asked_s = value.param_count, perf_counter()
    parameters_s = perf_counter() - begun

    begun = perf_counter()
    link.mav.mission_count_send(*to, len(PLAN), 0)
    for n, (command, latitude, longitude, height_m) in enumerate(PLAN):
        if message(["MISSION_REQUEST", "MISSION_REQUEST_INT"]).seq != n:
            raise StepError(f"the vehicle asks for another item than {n}")
        place = round(latitude * 1e7), round(longitude * 1e7), height_m
        link.mav.mission_item_int_send(*to, n, 6 if latitude else 2, command, 0, 1, 0, 0, 0, 0, *place, 0)
    if (result := message("MISSION_ACK").type) != 0:
        raise StepError(f"the mission is refused, MAV_MISSION_RESULT {result}")
    link.mav.mission_request_list_send(*to, 0)
    if (count := message("MISSION_COUNT").count) != len(PLAN):
        raise StepError(f"a mission of {count} items comes back")
    got: list[tuple[int, int, int]] = []
    for n in range(len(PLAN)):
        link.mav.mission_request_int_send(*to, n, 0)
        item = message("MISSION_ITEM_INT")
        got.append((item.command, item.x, item.y))
    link.mav.mission_ack_send(*to, 0, 0)
    if got != [(command, round(north * 1e7), round(east * 1e7)) for command, north, east, _ in PLAN]:
        raise StepError(f"another mission comes back: {got}")
    return Station(heartbeat_s, len(names), parameters_s, perf_counter() - begun)


class Walk:
    """One command of README's in a folder of its own; what is kept between runs is in `home`."""

    def __init__(self, parts: Sequence[str], folder: Path, pip_cache: str) -> None:
        self.parts, self.folder = parts, folder
        home = folder / "home"
        home.mkdir(parents=True)
        self.variables = clean(
            XDG_CACHE_HOME=str(home / "cache"), XDG_DATA_HOME=str(home / "data"),
            PIP_CACHE_DIR=pip_cache, PYTHONUNBUFFERED="1",
        )  # fmt: skip
        # The Python of the machine, not the one of an environment that is active here.
        own = str(Path(sys.executable).parent)
        path = [each for each in os.environ.get("PATH", "").split(os.pathsep) if each != own]
        base = str(Path(sys.base_prefix) / "bin")
        self.variables["PATH"] = os.pathsep.join([base, *path])

    @contextmanager
    def running(self) -> Iterator[subprocess.Popen[bytes]]:
        """The command, in a process group of its own that is ended with all that it started."""
        with (self.folder / "output.txt").open("wb") as output, (self.folder / "stamps.txt").open("wb") as stamps:
            self.begun_s = time()
            process = _start(["sh", "-c", stamped(self.parts)], self.folder, self.variables, output, stamps)
        try:
            yield process
        finally:
            for number in (signal.SIGTERM, signal.SIGKILL):
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, number)
                with suppress(subprocess.TimeoutExpired):
                    process.wait(10.0)

    def output(self) -> str:
        return (self.folder / "output.txt").read_text("utf-8", "replace")

    def times(self) -> list[tuple[str, float]]:
        """Seconds of each part that has ended."""
        ends = [float(line) for line in (self.folder / "stamps.txt").read_text().split()]
        begins = [self.begun_s, *ends]
        return [(_named(part), end - begin) for part, begin, end in zip(self.parts, begins, ends, strict=False)]


def _start(
    words: Sequence[str], folder: Path, variables: dict[str, str], output: IO[bytes], stamps: IO[bytes]
) -> subprocess.Popen[bytes]:
    """With `stamps` as file descriptor 3."""
    shell = ["bash", "-c", f'exec "$@" 3>&{stamps.fileno()}', "bash", *words]
    return subprocess.Popen(
        shell, cwd=folder, env=variables, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
        start_new_session=True, pass_fds=(stamps.fileno(),),
    )  # fmt: skip


def _named(part: str) -> str:
    return NAMES.get(part.split()[0], part.removeprefix(".venv/bin/"))


def first_report(walk: Walk) -> list[tuple[str, float]]:
    with walk.running() as process:
        try:
            code = process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            code = -1
    reports = re.findall(r"^report: +(\S+)", walk.output(), re.M)
    if code != 0 or not reports or not (walk.folder / "mavsitl" / reports[-1]).is_file():
        raise StepError(f"no report; exit code {code}\n{walk.output()}")
    rows = walk.times()
    return [*rows, ("clone to the first report", sum(seconds for _, seconds in rows))]


def ready_vehicle(walk: Walk, port: int = LISTENED_PORT) -> list[tuple[str, float]]:
    last = len(walk.parts) - 1
    with listening(port) as link, walk.running() as process:
        try:
            silent_until(link, lambda: process.poll() is not None or len(walk.times()) == last)
            if process.poll() is not None:
                raise StepError("no vehicle has been started")
            found = station(link)
        except StepError as error:
            raise StepError(f"{error}; exit code {process.poll()}\n{walk.output()}") from error
    rows = walk.times()
    began_s = walk.begun_s + sum(seconds for _, seconds in rows)
    whole_s = found.heartbeat_s - walk.begun_s + found.parameters_s + found.mission_s
    return [
        *rows,
        ("mavsitl vehicle to the first HEARTBEAT on 14550", found.heartbeat_s - began_s),
        (f"from there to all {found.parameters} parameters, the compiler included", found.parameters_s),
        (f"a mission of {len(PLAN)} items to it and back", found.mission_s),
        ("clone to a vehicle that QGroundControl has", whole_s),
    ]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.downstream.newcomer", description=__doc__)
    parser.add_argument("--only", choices=("fly", "vehicle"), help="one of the two commands")
    parser.add_argument("--cold", action="store_true", help="with an empty cache of pip's, too")
    options = parser.parse_args()
    found = commands(ROOT.as_uri())
    warm = run([sys.executable, "-m", "pip", "cache", "dir"], ROOT).strip().splitlines()[-1]
    print("| | s |\n|---|---:|", flush=True)
    with tempfile.TemporaryDirectory(prefix="mavsitl-newcomer-") as name:
        folder = Path(name)
        for what in ("warm", "cold") if options.cold else ("warm",):
            for subcommand, walked in (("fly", first_report), ("vehicle", ready_vehicle)):
                if options.only not in (None, subcommand):
                    continue
                pip_cache = warm if what == "warm" else f"{name}/pip-{subcommand}"
                walk = Walk(found[subcommand], folder / f"{what}-{subcommand}", pip_cache)
                try:
                    rows = walked(walk)
                except StepError as error:
                    print(f"README's command for `{subcommand}`: {error}")
                    return 1
                print(f"| **`{subcommand}`, pip's cache {what}** | |")
                for shown, seconds in rows:
                    if shown:
                        print(f"| {shown} | {seconds:.1f} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
