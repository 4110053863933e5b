"""`mavsitl sweep` without its terminal: what is asked for, what of it was flown before, and what is left in the folder.

The folder holds rows.jsonl, the journal, which grows flight by flight and serves every later sweep in the same folder;
results.parquet and report.html are of the last sweep that came to its end.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import msgspec

import mavsitl
from mavsitl.campaign.errors import GridError
from mavsitl.campaign.fly import Row
from mavsitl.campaign.grid import Case, Grid, parse_seeds, parse_setting, source_digest
from mavsitl.campaign.store import Journal, write_parquet
from mavsitl.campaign.summary import Summary, summarize
from mavsitl.campaign.workers import Workers, fly_all
from mavsitl.report.run import scenario_digest
from mavsitl.scenario import load, text_of

JOURNAL_FILE, RESULTS_FILE = "rows.jsonl", "results.parquet"


@dataclass(frozen=True)
class Plan:
    """A grid whose every case is known to be one."""

    grid: Grid
    compared: tuple[str, ...]
    """Keys whose further values are compared with their first, seed by seed."""
    cases: tuple[Case, ...]

    def __str__(self) -> str:
        parts = [f"{len(setting.values)} x {setting.key}" for setting in self.grid.settings if setting.swept]
        parts.append(f"{len(self.grid.seeds)} seed{'' if len(self.grid.seeds) == 1 else 's'}")
        return f"{len(self.cases)} flights: {', '.join(parts)}"


def plan(scenario: str, settings: Sequence[str], compare: Sequence[str], seeds: str) -> Plan:
    """`settings` and `compare` in the grammar of `parse_setting`, `seeds` in that of `parse_seeds`.

    A key with exactly two values is compared in any case. Raises `GridError`, `ScenarioError`.
    """
    wanted = [parse_setting(text) for text in settings]
    paired = [parse_setting(text) for text in compare]
    for setting in paired:
        if not setting.swept:
            raise GridError(f"--compare {setting.key}: one value alone; allowed: two or more, KEY=A,B")
    everything = (*wanted, *paired)
    keys = [setting.key for setting in everything]
    for key in keys:
        if keys.count(key) > 1:
            raise GridError(f"{key}: given {keys.count(key)} times; allowed: once, with all its values, KEY=A,B,C")
    grid = Grid(scenario, everything, parse_seeds(seeds))
    named = {setting.key for setting in paired}
    compared = tuple(each.key for each in everything if each.key in named or len(each.values) == 2)
    return Plan(grid, compared, tuple(grid.cases()))


class Known(NamedTuple):
    """Of a plan's cases, those that a journal says something about."""

    flown: int
    """These are not flown again."""
    other_code: int
    """Of these it has the same flight, flown by other code."""
    other_scenario: int
    """Of these it has a flight of the same name, labels and seed, with another scenario, airframe or setting."""


def known(plan: Plan, journal: Journal) -> Known:
    digests = {(row.scenario_digest, row.seed) for row in journal.rows.values()}
    named = {_name(row) for row in journal.rows.values()}
    counts = [0, 0, 0]
    for case in plan.cases:
        if _has(journal, case):
            counts[0] += 1
        elif case.key in journal.rows:  # its worker was lost
            continue
        elif (scenario_digest(case.flight), case.seed) in digests:
            counts[1] += 1
        elif _name(case) in named:
            counts[2] += 1
    return Known(*counts)


def _has(journal: Journal, case: Case) -> bool:
    row = journal.rows.get(case.key)
    return row is not None and row.repeatable


def _name(of: Row | Case) -> tuple[str, int, bytes]:
    name = of.scenario if isinstance(of, Row) else of.flight.name
    return name, of.seed, msgspec.json.encode(of.labels, order="deterministic")


def fly(plan: Plan, journal: Journal, workers: Workers) -> Iterator[Row]:
    """What is missing, row by row, each in the journal before it is given."""
    missing = [case for case in plan.cases if not _has(journal, case)]
    for row in fly_all(missing, workers):
        journal.add(row)
        yield row


def rows(plan: Plan, journal: Journal) -> list[Row]:
    """Of each case, in the plan's order and by its labels, whatever those were when it was flown."""
    return [
        msgspec.structs.replace(journal.rows[case.key], labels=case.labels, scenario=case.flight.name)
        for case in plan.cases
    ]


def summary(plan: Plan, rows: Iterable[Row]) -> Summary:
    return summarize(list(rows), plan.grid.keys, plan.compared)


def metadata(plan: Plan, command: str, created_utc: str) -> dict[str, str]:
    """What the Parquet file says of the whole: see `docs/howto/sweeps.md`."""
    grid = plan.grid
    fixed = {setting.key: setting.values[0] for setting in grid.settings if not setting.swept}
    settings = {setting.key: setting.values for setting in grid.settings}
    return {
        "version": mavsitl.__version__,
        "code": source_digest(),
        "command": command,
        "created_utc": created_utc,
        "scenario": grid.scenario,
        "scenario_toml": text_of(grid.scenario),
        "scenario_digest": scenario_digest(load(grid.scenario, fixed)),
        "settings": msgspec.json.encode(settings).decode(),
        "swept": msgspec.json.encode(grid.keys).decode(),
        "seeds": msgspec.json.encode(grid.seeds).decode(),
    }


def save(plan: Plan, rows: Sequence[Row], folder: Path, facts: Mapping[str, str]) -> Path:
    """Write results.parquet with `facts` in its schema. Raises `StoreError`, `MissingError`."""
    path = folder / RESULTS_FILE
    write_parquet(path, rows, plan.grid.keys, facts)
    return path
