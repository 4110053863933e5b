"""Many flights in memory over a pool of processes, with failures kept as results, and a campaign that can be continued.

A campaign's results go to an append-only file, a line a flight. Its key is a digest of everything that decides the
flight: the scenario, the airframe, the seed and the source of what flies. A flight whose key is there is not repeated.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec

from mavsitl import drivers, wings
from mavsitl.drivers import VehicleCore
from mavsitl.link.impaired import channels_for
from mavsitl.report.metrics import Rmse
from mavsitl.scenario import Flight, Waypoints, load
from tests.experiments.sums import LOST_M, Six, Sums

Overrides = dict[str, Any]
S = TypeVar("S")
T = TypeVar("T")
DEFAULT_STORE = Path("runs") / "experiments.jsonl"
GRACE_S = 120.0
"""Simulated time beside the flight itself: handshake, take-off, landing."""

NOT_FLYING = ("report/", "link/", "cli.", "ends.", "pair.", "__main__")
DECIDING_LINKS = ("link/impaired.py", "link/framing.py")
"""What of the product does not decide a flight in memory, and what of that does."""

STRETCH_TICKS = 250
"""A flight's rows are summed up, and it is looked at, this often."""


class Job(msgspec.Struct, frozen=True):
    """One flight to fly. `flight` has every override in it."""

    flight: Flight
    seed: int
    key: str


class Outcome(msgspec.Struct, frozen=True):
    """How one flight went."""

    key: str
    scenario: str
    seed: int
    status: Literal["flown", "lost", "failed"]
    """``lost``: too far from its reference; ``failed``: an error, or an end that was not the planned one."""
    time_s: float
    """Flight time at the end, or when it was lost."""
    rmse: Six | None = None
    """Only of a flight that was flown to its end."""
    largest: Six | None = None
    """Largest absolute errors, of a lost flight up to its loss."""
    weight_range: tuple[float, float] = (1.0, 1.0)
    message: str = ""
    left_offboard: int = 0
    """Times that the vehicle was in another mode than OFFBOARD during the flight."""

    @property
    def flown(self) -> bool:
        return self.status == "flown"

    @property
    def states(self) -> Rmse:
        """Raises ValueError for a flight that was not flown."""
        if self.rmse is None:
            raise ValueError(f"{self.scenario}, seed {self.seed}: {self.status} at {self.time_s:g} s")
        return Rmse(*self.rmse)


class LostError(RuntimeError):
    """The vehicle is too far from its reference."""


class Watched:
    """A vehicle core that stops the flight as soon as it is lost."""

    def __init__(self, core: VehicleCore, sums: Sums) -> None:
        self._core = core
        self._sums = sums
        self._ticks = 0

    @property
    def period_us(self) -> int:
        return self._core.period_us

    @property
    def token_us(self) -> int:
        return self._core.token_us

    @property
    def finished(self) -> bool:
        return self._core.finished

    @property
    def flight_time_s(self) -> float:
        return self._core.flight_time_s

    @property
    def counters(self) -> Any:
        return self._core.counters

    def step(self, now_us: int) -> None:
        self._ticks += 1
        if self._ticks % STRETCH_TICKS == 0:
            self._sums.collect()
            if self._sums.lost_s is not None:
                raise LostError(f"more than {LOST_M:g} m from its reference at {self._sums.lost_s:g} s")
        self._core.step(now_us)

    def receive(self, port: int, datagram: bytes) -> int:
        return self._core.receive(port, datagram)

    def datagrams(self, port: int, *, combine: bool) -> list[bytes]:
        return self._core.datagrams(port, combine=combine)


def job(name: str, overrides: Overrides, seed: int, airframe: Overrides | None = None) -> Job:
    """`airframe`: fields of the airframe that differ from the named one's. Raises `ScenarioError`."""
    flight = load(name, overrides)
    scenario = msgspec.structs.replace(flight.scenario, seed=seed)
    changed = msgspec.structs.replace(flight.airframe, **(airframe or {}))
    flight = msgspec.structs.replace(flight, scenario=scenario, airframe=changed)
    digest = hashlib.blake2b(digest_size=16)
    digest.update(source_digest().encode())
    digest.update(msgspec.json.encode((scenario, flight.airframe, seed)))
    if isinstance(scenario.reference, Waypoints):
        digest.update(Path(scenario.reference.file).read_bytes())
    return Job(flight, seed, digest.hexdigest())


@cache
def source_digest() -> str:
    """Of every source file of the product that can decide a flight."""
    digest = hashlib.blake2b(digest_size=16)
    for package in ("mavsitl", "mavsitl_vehicle", "mavsitl_ground"):
        spec = find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            for file in sorted(Path(folder).rglob("*.py")):
                inside = file.relative_to(folder).as_posix()
                if inside in DECIDING_LINKS or not inside.startswith(NOT_FLYING):
                    digest.update(inside.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def fly(job: Job) -> Outcome:
    """Fly one job in this process. Whatever goes wrong in the flight is its outcome, not an exception."""
    sums = Sums(job.flight)

    def outcome(status: Literal["flown", "lost", "failed"], message: str = "") -> Outcome:
        time_s = sums.time_s if sums.lost_s is None else sums.lost_s
        rmse = sums.rmse if status == "flown" else None
        return Outcome(
            job.key, job.flight.name, job.seed, status, time_s, rmse, sums.largest, sums.weight_range, message,
            sums.left_offboard,
        )  # fmt: skip

    said: list[str] = []
    try:
        vehicle = wings.find(wings.VEHICLE_GROUP)(job.flight, sums.vehicle, seed=job.seed, lockstep=True)
        ground = wings.find(wings.GROUND_GROUP)(job.flight, sums.ground, report=said.append)
        watched = Watched(vehicle, sums)
        channels = channels_for(job.flight.scenario.link, job.seed)
        limit_s = job.flight.scenario.duration_s + GRACE_S
        drivers.fly_in_memory(watched, ground, max_time_s=limit_s, channels=channels)
    except LostError as loss:
        return outcome("lost", str(loss))
    except Exception as error:  # a campaign goes on without this flight, and says so
        return outcome("failed", f"{type(error).__name__}: {error}")
    sums.collect()
    if sums.lost_s is not None:
        return outcome("lost", f"more than {LOST_M:g} m from its reference at {sums.lost_s:g} s")
    if ground.lost:
        return outcome("lost", ground.lost)
    if not ground.succeeded or not sums.samples:
        return outcome("failed", f"{ground.phase}: {said[-1] if said else 'nothing was said'}")
    return outcome("flown")


class Store:
    """The append-only file of outcomes. A last line that was cut off by an interruption is flown again."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self.outcomes: dict[str, Outcome] = {}
        if path is None or not path.exists():
            return
        *lines, tail = path.read_bytes().split(b"\n")
        for number, line in enumerate(lines, start=1):
            try:
                outcome = msgspec.json.decode(line, type=Outcome)
            except msgspec.MsgspecError as error:
                raise ValueError(
                    f"{path}: line {number} is no outcome ({error}); remove the file to start anew"
                ) from error
            self.outcomes[outcome.key] = outcome
        if tail:
            path.write_bytes(b"".join(line + b"\n" for line in lines))

    def add(self, outcome: Outcome) -> None:
        self.outcomes[outcome.key] = outcome
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("ab") as file:
                file.write(msgspec.json.encode(outcome) + b"\n")


def campaign(jobs: Sequence[Job], *, workers: int, store: Path | None, title: str, show: bool = True) -> list[Outcome]:
    """The outcomes of `jobs`, in their order; `workers` = 1 flies in this process. `show`: a progress bar on stderr."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    kept = Store(store)
    missing = {each.key: each for each in jobs if each.key not in kept.outcomes}
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    text = TextColumn("{task.fields[said]}")
    with Progress(*columns, text, console=Console(stderr=True), disable=not show) as bar:
        task = bar.add_task(title, total=len(jobs), completed=len(jobs) - len(missing), said="")
        bad = 0
        for outcome in _flown(list(missing.values()), workers, fly):
            kept.add(outcome)
            bad += not outcome.flown
            bar.update(task, advance=1, said=f"{bad} lost or failed" if bad else "")
    return [kept.outcomes[each.key] for each in jobs]


def flown(jobs: Sequence[Job], workers: int, function: Callable[[Job], T], *, title: str) -> list[T]:
    """What `function` makes of each job, in their order, with a progress bar on stderr. What it raises is raised."""
    from rich.console import Console
    from rich.progress import track

    results = _flown([(index, job) for index, job in enumerate(jobs)], workers, _Numbered(function))
    return [made for _, made in sorted(track(results, title, len(jobs), console=Console(stderr=True)), key=_first)]


def _first(numbered: tuple[int, Any]) -> int:
    return numbered[0]


class _Numbered:
    """A function of a job with its number."""

    def __init__(self, function: Callable[[Job], Any]) -> None:
        self._function = function

    def __call__(self, numbered: tuple[int, Job]) -> tuple[int, Any]:
        return numbered[0], self._function(numbered[1])


def _flown(jobs: Sequence[S], workers: int, function: Callable[[S], T]) -> Iterable[T]:
    """As they come. With a pool, never more than a few are queued, so that an interruption ends soon."""
    if workers <= 1 or len(jobs) <= 1:
        yield from map(function, jobs)
        return
    remaining = iter(jobs)
    context = multiprocessing.get_context("spawn")  # a fork would copy numba's and rich's threads in mid-air
    with ProcessPoolExecutor(max_workers=workers, mp_context=context) as pool:
        running: set[Future[T]] = set()
        while True:
            for each in remaining:
                running.add(pool.submit(function, each))
                if len(running) >= 2 * workers:
                    break
            if not running:
                return
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()


def parser(program: str, description: str, *, seeds: int, output: Path) -> argparse.ArgumentParser:
    """What every program here takes."""
    made = argparse.ArgumentParser(prog=f"python -m tests.experiments.{program}", description=description)
    made.add_argument("--seeds", type=int, default=seeds, metavar="N", help=f"seeds 1 to N (default: {seeds})")
    made.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (default: 2; 1: this one)")
    made.add_argument("--store", type=Path, default=DEFAULT_STORE, help=f"results so far (default: {DEFAULT_STORE})")
    made.add_argument(
        "--quick",
        action="store_true",
        help="two seeds, 5 s and few flights, to try the program; the page goes to stdout",
    )
    made.add_argument("--output", type=Path, default=None, help=f"the page to write (default: {output.as_posix()})")
    made.set_defaults(default_output=output)
    return made


QUICK_SEEDS = 2
QUICK_S = 5.0


def publish(text: str, options: argparse.Namespace) -> None:
    """Write the page, or print it when the program was only tried."""
    path: Path | None = options.output or (None if options.quick else options.default_output)
    if path is None:
        sys.stdout.write(text)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, "utf-8")


def seeds_of(options: argparse.Namespace) -> range:
    return range(1, 1 + (QUICK_SEEDS if options.quick else options.seeds))


def store_of(options: argparse.Namespace) -> Path | None:
    """A quick trial leaves the campaign's file alone."""
    return None if options.quick else options.store


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; the first column to the left, the others to the right."""
    lines = ["| " + " | ".join(header) + " |", "|" + "|".join(["---", *["---:"] * (len(header) - 1)]) + "|"]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def quantile(values: Sequence[float], share: float) -> float:
    """Linear between neighbours; infinite where a neighbour is, so that lost flights count as the worst ones."""
    ordered = sorted(values)
    place = share * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    if place == low:
        return ordered[low]
    if ordered[high] == float("inf"):
        return ordered[high]
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])


def failures(outcomes: Iterable[Outcome]) -> list[Outcome]:
    return [outcome for outcome in outcomes if not outcome.flown]
