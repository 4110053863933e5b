"""What the experiment programs share: their flights by `mavsitl.campaign`, their options and their tables."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import msgspec
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mavsitl.campaign import workers as crews
from mavsitl.campaign.fly import Row
from mavsitl.campaign.grid import Case, Overrides, case
from mavsitl.campaign.store import Journal
from mavsitl.scenario import load

T = TypeVar("T")
DEFAULT_STORE = Path("runs") / "experiments.jsonl"


def job(name: str, overrides: Overrides, seed: int, airframe: Overrides | None = None) -> Case:
    """`airframe`: fields of the airframe that differ from the named one's. Raises `ScenarioError`."""
    flight = load(name, overrides)
    changed = msgspec.structs.replace(flight.airframe, **(airframe or {}))
    return case(msgspec.structs.replace(flight, airframe=changed), seed)


def campaign(cases: Sequence[Case], *, workers: int, store: Path | None, title: str, show: bool = True) -> list[Row]:
    """The rows of `cases`, in their order; `workers` = 1 flies in this process. `show`: a progress bar on stderr."""
    with Journal(store) as journal, crews.local(workers) as crew, _bar(title, show) as bar:
        missing = [each for each in cases if each.key not in journal.rows]
        task = bar.add_task(title, total=len(cases), completed=len(cases) - len(missing), said="")
        bad = 0
        for row in crews.fly_all(missing, crew):
            journal.add(row)
            bad += not row.flown
            bar.update(task, advance=1, said=f"{bad} lost or failed" if bad else "")
        return [journal.rows[each.key] for each in cases]


def flown(cases: Sequence[Case], workers: int, function: Callable[[Case], T], *, title: str) -> list[T]:
    """What `function` makes of each case, in their order, with a progress bar on stderr. What it raises is raised."""
    made: dict[int, T] = {}
    with crews.local(workers) as crew, _bar(title, True) as bar:
        task = bar.add_task(title, total=len(cases), said="")
        for index, result in crew.map(function, cases):
            made[index] = result
            bar.update(task, advance=1)
    return [made[index] for index in range(len(cases))]


def _bar(title: str, show: bool) -> Progress:
    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(*columns, TextColumn("{task.fields[said]}"), console=Console(stderr=True), disable=not show)


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


def failures(rows: Iterable[Row]) -> list[Row]:
    return [row for row in rows if not row.flown]
