"""`mavsitl sweep`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavsitl.cli.campaigns import add_run_options, check_run_options, crew
from mavsitl.cli.common import (
    EXIT_FAILED,
    EXIT_OK,
    add_json,
    command,
    command_line,
    interrupt,
    leaving,
    on_signals,
    print_json,
)

if TYPE_CHECKING:
    from rich.console import Console

    from mavsitl.campaign.fly import Row
    from mavsitl.campaign.store import Journal
    from mavsitl.campaign.summary import Summary
    from mavsitl.campaign.sweep import Known, Plan
    from mavsitl.campaign.workers import Workers


SWEEP_HELP = """\
Fly every combination of the settings with every seed: whole flights in memory, on all cores of this machine or on a
Dask cluster. Each flight is a row: flown, lost (too far from its reference), or failed, with what went wrong.

The folder gets rows.jsonl, row by row, then results.parquet and report.html. A sweep that was interrupted or killed
goes on with the same command. A flight is known by its scenario, airframe, seed and the code that flies: where one of
these has changed it is flown again, else it is not.

  --set KEY=A,B,C            these values; an array or table of TOML is one value
  --set KEY=START:STOP:STEP  a range, STOP included: 0:10:5 is 0, 5, 10
  --set KEY=A                this value in every flight
  --seeds N                  seeds 1 to N; also N,N,N and FIRST-LAST

A key with two values is compared seed by seed: the same seed is the same air and the same noise.
"""

SWEEP_EXAMPLES = """\
examples:
  mavsitl sweep hover-wind --set wind.speed_20ft_m_s=0,5,10 --seeds 50
  mavsitl sweep hover-wind --set controller.law=pid,pidnn --seeds 50 --jobs 4
  mavsitl sweep spiral-wind --set offnominal.mass_scale=0.8:1.4:0.1 --compare controller.law=pid,pidnn
  mavsitl sweep my.toml --compare controller.learning.rate=[0,0,0],[1,1,1],[10,10,10] --seeds 20
  mavsitl sweep hover-wind --seeds 1000 --scheduler tcp://192.0.2.7:8786

Exit codes: 0 every flight has its row, lost ones too; 1 some failed by an error, or the sweep did; 2 wrong arguments;
130 interrupted.
"""


def add(commands: Any) -> None:
    parser = command(commands, "sweep", "fly a grid of settings and seeds, and compare", SWEEP_HELP, SWEEP_EXAMPLES)
    parser.add_argument("scenario", metavar="SCENARIO", help="a shipped scenario's name or a .toml file")
    group = parser.add_argument_group("grid")
    group.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUES", dest="settings",
        help="any key of the scenario, dotted, with its values; may be repeated",
    )  # fmt: skip
    group.add_argument(
        "--compare", action="append", default=[], metavar="KEY=VALUES",
        help="as --set, and each further value is compared with the first, seed by seed; may be repeated",
    )  # fmt: skip
    group.add_argument("--seeds", default="10", metavar="SEEDS", help="default: 10, which is 1 to 10")
    group = parser.add_argument_group("run")
    add_run_options(group, "runs/sweep-SCENARIO; flights that it has are not flown again")
    group.add_argument("--no-report", action="store_true", help="results and tables only")
    add_json(group, "the summary")
    parser.set_defaults(run=_sweep)


def _sweep(options: argparse.Namespace) -> int:
    from mavsitl.campaign import optional, sweep
    from mavsitl.campaign.store import Journal
    from mavsitl.cli import screen
    from mavsitl.clock import utc_stamp

    on_signals(interrupt)
    check_run_options(options)
    plan = sweep.plan(options.scenario, options.settings, options.compare, options.seeds)
    optional.need("pyarrow")  # before anything flies
    facts = sweep.metadata(plan, command_line(), utc_stamp())
    name = plan.cases[0].flight.name
    folder: Path = options.output or Path("runs") / f"sweep-{name}"
    console = screen.console(stderr=options.json)
    console.print(f"[bold]{name}[/]  {plan}", soft_wrap=True)
    with Journal(folder / sweep.JOURNAL_FILE) as journal:
        known = sweep.known(plan, journal)
        for text in _told(known, len(plan.cases), folder):
            screen.line(console, text)
        missing = len(plan.cases) - known.flown
        if missing:
            with crew(options, missing) as workers:
                _fly_missing(plan, journal, workers, known.flown, folder)
        rows = sweep.rows(plan, journal)
    results = sweep.save(plan, rows, folder, facts)
    summary = sweep.summary(plan, rows)
    page = None
    if not options.no_report:
        from mavsitl.report import sweep as report

        page = report.write(folder, rows, summary, plan.grid.keys, facts)
    if options.json:
        _print_sweep_json(results, rows, summary)
    else:
        _show_sweep(console, summary)
    for what, path in (("results", results), ("report", page)):
        if path is not None:
            screen.line(console, f"{what + ':':8s} {path}")
    failed = [row for row in rows if row.status == "failed"]
    if failed:
        said = sorted({row.message for row in failed})
        screen.line(console, f"{len(failed)} of {len(rows)} failed: {said[0]}", "bold red")
    return EXIT_FAILED if failed else EXIT_OK


def _told(known: Known, total: int, folder: Path) -> list[str]:
    """What of a sweep need not be flown again, and what has to, and why."""
    told = []
    if known.flown:
        told.append(f"{known.flown} of {total} were flown before ({folder})")
    if known.other_code:
        told.append(f"{known.other_code} of {total} were flown before by other code, and are flown again")
    if known.other_scenario:
        told.append(
            f"{known.other_scenario} of {total} were flown before with other settings or another scenario file, "
            "and are flown again"
        )
    return told


def _fly_missing(plan: Plan, journal: Journal, workers: Workers, before: int, folder: Path) -> None:
    """With a progress bar on stderr."""
    from mavsitl.campaign import sweep
    from mavsitl.cli import screen

    total, done = len(plan.cases), before
    counts = {"lost": 0, "failed": 0}
    with (
        leaving(lambda: f"{done} of {total} are in {folder}; the same command goes on with the rest"),
        screen.flights_progress() as bar,
    ):
        task = bar.add_task("flights", total=total, completed=before, said="")
        for row in sweep.fly(plan, journal, workers):
            done += 1
            if not row.flown:
                counts[row.status] += 1
            said = ", ".join(f"{count} {status}" for status, count in counts.items() if count)
            bar.update(task, advance=1, said=said)


def _print_sweep_json(results: Path, rows: Sequence[Row], summary: Summary) -> None:
    import msgspec

    counts = {status: sum(row.status == status for row in rows) for status in ("flown", "lost", "failed")}
    shown = {"results": str(results), "flights": len(rows), **counts, **msgspec.to_builtins(summary)}
    print_json(shown)


def _show_sweep(console: Console, summary: Summary) -> None:
    from mavsitl.cli import screen
    from mavsitl.report import sweep_tables

    shown = [("medians, 95 % intervals", sweep_tables.cell_header(summary), sweep_tables.cell_rows(summary))]
    if summary.comparisons:
        header, rows = list(sweep_tables.COMPARISON_HEADER), sweep_tables.comparison_rows(summary)
        shown.append(("seed by seed: median difference and ratio, Wilcoxon's p", header, rows))
    for title, header, rows in shown:
        table = screen.table(*header, title=title, right=set(header) - {"", "measure"})
        for cells in rows:
            table.add_row(*cells)
        console.print(table)
