"""`mavsitl bench` without its terminal: what is to be flown, what of it is known, and what is left in the folder.

The folder holds rows.jsonl, the journal, in which every flight in memory is kept under a key that has its controller's
source in it: what is unchanged is not flown again. bench.json and report.html are of the last bench that came to its
end.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

import mavsitl
from mavsitl import controllers
from mavsitl.campaign.errors import GridError, StoreError
from mavsitl.campaign.fly import Row
from mavsitl.campaign.grid import Case, parse_seeds, source_digest
from mavsitl.campaign.store import Journal
from mavsitl.campaign.workers import Workers, fly_all
from mavsitl.keep import replace_json
from mavsitl.score import suite as suites
from mavsitl.score.external import Program
from mavsitl.score.score import STOCK, Board
from mavsitl.score.suite import Suite

JOURNAL_FILE, RESULTS_FILE = "rows.jsonl", "bench.json"


class Result(msgspec.Struct, frozen=True):
    """bench.json."""

    version: str
    code: str
    """`campaign.grid.source_digest` of what flew."""
    command: str
    created_utc: str
    board: Board
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Plan:
    """A part of the suite, and who flies it."""

    suite: Suite
    part: str
    """In words, ``all`` for the whole."""
    names: tuple[str, ...]
    """Controllers, those of the user first."""
    programs: tuple[Program, ...]
    cases: tuple[Case, ...]
    """Of the controllers; those of programs are made as they are flown."""

    @property
    def everybody(self) -> tuple[str, ...]:
        return (*(program.name for program in self.programs), *self.names)

    def __str__(self) -> str:
        counts = ((len(self.suite.cases), "case"), (len(self.suite.seeds), "seed"), (len(self.everybody), "controller"))
        shown = " x ".join(f"{count} {what}{'' if count == 1 else 's'}" for count, what in counts)
        return f"suite {self.suite.version}: {shown}"


def plan(
    wanted: Sequence[str], programs: Sequence[str] = (), *,
    pattern: str | None = None, quick: bool = False, seeds: str | None = None, shipped: bool = True,
) -> Plan:  # fmt: skip
    """`wanted` in the words of `--controller`, `programs` as of `--program`, `seeds` in the grammar of `parse_seeds`.

    `shipped`: beside all that are shipped; else beside `STOCK` alone, whom the score compares with. Raises `GridError`,
    `ControllerError` for a controller that cannot be made, `ScenarioError`.
    """
    whole = suites.read()
    chosen = whole.chosen(pattern=pattern, quick=quick, seeds=None if seeds is None else parse_seeds(seeds))
    names = tuple(dict.fromkeys((*wanted, *(controllers.shipped() if shipped else (STOCK,)))))
    runs = tuple(Program.parse(text) for text in programs)
    everybody = [*(run.name for run in runs), *names]
    for name in everybody:
        if everybody.count(name) > 1:
            raise GridError(f"--program: two are called {name!r}; call one of them otherwise, NAME=COMMAND")
    for name in wanted:
        flight = chosen.cases[0].flight(name)
        if flight.scenario.controller.own:
            controllers.make(flight)  # before anything flies
    part = ", ".join(filter(None, ("quick" if quick else "", f"cases {pattern}" if pattern else ""))) or "all"
    return Plan(chosen, part, names, runs, tuple(chosen.flights(names)))


def missing(plan: Plan, journal: Journal) -> list[Case]:
    """Those that have to be flown; cases of one key once."""
    known = {key for key, row in journal.rows.items() if row.repeatable}
    return list({case.key: case for case in plan.cases if case.key not in known}.values())


def fly(plan: Plan, journal: Journal, workers: Workers) -> Iterator[Row]:
    """What is missing, row by row, each in the journal before it is given."""
    for row in fly_all(missing(plan, journal), workers):
        journal.add(row)
        yield row


def rows(plan: Plan, journal: Journal) -> list[Row]:
    """Of each case, in the plan's order, by its labels."""
    return [msgspec.structs.replace(journal.rows[case.key], labels=case.labels) for case in plan.cases]


def result(board: Board, rows: Sequence[Row], command: str, created_utc: str) -> Result:
    return Result(mavsitl.__version__, source_digest(), command, created_utc, board, tuple(rows))


def save(result: Result, folder: Path) -> Path:
    """Write bench.json, whole or not at all. Raises `StoreError`."""
    path = folder / RESULTS_FILE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        replace_json(path, result)
    except OSError as error:
        raise StoreError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def short_names(names: Sequence[str]) -> Mapping[str, str]:
    """``Mine`` for FILE.py:Mine, or ``my.py:Mine``, as long as no two are alike."""
    shown = {name: name for name in names}
    for separator in ("/", ":"):
        cut = {name: name.replace("\\", "/").rpartition(separator)[2] for name in names}
        taken = list(cut.values())
        shown |= {name: short for name, short in cut.items() if taken.count(short) == 1}
    return shown
