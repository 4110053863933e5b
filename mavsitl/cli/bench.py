"""`mavsitl bench`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavsitl.cli.common import (
    EXIT_FAILED,
    EXIT_OK,
    UsageError,
    add_json,
    command,
    command_line,
    interrupt,
    leaving,
    on_signals,
    print_json,
    speed_factor,
    whole,
)

if TYPE_CHECKING:
    from rich.console import Console

    from mavsitl.campaign.fly import Row
    from mavsitl.campaign.store import Journal
    from mavsitl.score.bench import Plan
    from mavsitl.score.score import Board

BENCH_HELP = """\
A score board for controllers: each flies a fixed set of cases (paths, wind, gusts, off-nominal airframes, links,
faults) with several seeds, beside the controllers that are shipped: pidnn, pid, stock (the cascade aboard), geometric
and indi. A score of 100 is as good as stock; docs/reference/score.md says how it is made.

  CONTROLLER            FILE.py:NAME, MODULE:NAME or an installed one's name; flown in memory, on all cores
  --program COMMAND     any program that speaks MAVLink, with the vehicle in real time, one flight after another:
                        {url} (MAVSDK's) or {endpoint} (pymavlink's) is where it hears the vehicle,
                        {reference} a CSV file of where it is to be, {duration} the flight time

The folder gets rows.jsonl, flight by flight, then bench.json and report.html. A flight in memory is known by its
scenario, seed, the code that flies and the controller's own source: what has not changed is not flown again.
"""

BENCH_EXAMPLES = """\
examples:
  mavsitl bench                                      the shipped ones alone
  mavsitl bench my.py:MyController                   one of your own beside them
  mavsitl bench my.py:MyController --quick           a few cases, one seed: a minute
  mavsitl bench my.py:A my.py:B --only --case wind   two of your own, beside stock, in a group of cases
  mavsitl bench --program "python my_client.py {url} {reference}" --quick --only

Exit codes: 0 every flight has its row, lost ones too; 1 some failed by an error; 2 wrong arguments, or a controller
that cannot be found or made; 130 interrupted.
"""


def add(commands: Any) -> None:
    parser = command(commands, "bench", "a score board for controllers", BENCH_HELP, BENCH_EXAMPLES)
    parser.add_argument("controllers", nargs="*", metavar="CONTROLLER", help="FILE.py:NAME, MODULE:NAME or a name")
    parser.add_argument(
        "--program", action="append", default=[], metavar="COMMAND", dest="programs",
        help="a program that speaks MAVLink, COMMAND or NAME=COMMAND; may be repeated",
    )  # fmt: skip
    group = parser.add_argument_group("what is flown")
    group.add_argument("--quick", action="store_true", help="the cases that are marked so, with one seed")
    group.add_argument("--case", metavar="PATTERN", help="cases, or groups of cases, whose names fit: 'mass-*', wind")
    group.add_argument("--seeds", metavar="SEEDS", help="in place of the suite's: N, N,N,N or FIRST-LAST")
    group.add_argument("--only", action="store_true", help="beside stock alone, not all that are shipped")
    group = parser.add_argument_group("run")
    group.add_argument("--jobs", type=whole(1, 4096), metavar="N", help="processes (default: one for each core)")
    group.add_argument(
        "--speed", type=speed_factor, metavar="X",
        help="of programs, simulated over wall time, for those that go by the vehicle's clock (default: 1)",
    )  # fmt: skip
    group.add_argument(
        "--output", type=Path, default=Path("runs/bench"), metavar="DIR",
        help="folder (default: runs/bench); flights that it has are not flown again",
    )  # fmt: skip
    group.add_argument("--no-report", action="store_true", help="results and table only")
    add_json(group, "the board")
    parser.set_defaults(run=_bench)


def _bench(options: argparse.Namespace) -> int:
    from mavsitl.campaign.store import Journal
    from mavsitl.cli import screen
    from mavsitl.clock import utc_stamp
    from mavsitl.score import bench, score

    on_signals(interrupt)
    if options.speed is not None and not options.programs:
        raise UsageError("--speed: only with --program; flights in memory are as fast as they can be")
    plan = bench.plan(
        options.controllers, options.programs, pattern=options.case, quick=options.quick, seeds=options.seeds,
        shipped=not options.only,
    )  # fmt: skip
    created = utc_stamp()
    folder: Path = options.output
    console = screen.console(stderr=options.json)
    screen.line(console, str(plan))
    with Journal(folder / bench.JOURNAL_FILE) as journal:
        _fly_missing(plan, journal, options.jobs, folder)
        rows = bench.rows(plan, journal)
    rows += _fly_programs(plan, folder, options.speed or 1.0)
    board = score.board(plan.suite, rows, plan.everybody, plan.part)
    result = bench.result(board, rows, command_line(), created)
    written = {"results": bench.save(result, folder)}
    if not options.no_report:
        from mavsitl.report import bench as report

        written["report"] = report.write(folder, result, plan.suite)
    if options.json:
        print_json(board)
    else:
        _show(console, plan, board)
    for what, path in written.items():
        screen.line(console, f"{what + ':':8s} {path}")
    return _end(console, plan, rows)


def _fly_missing(plan: Plan, journal: Journal, jobs: int | None, folder: Path) -> None:
    from mavsitl.campaign import workers
    from mavsitl.cli import screen
    from mavsitl.score import bench

    missing = len(bench.missing(plan, journal))
    if not missing:
        return
    lost = done = 0
    with (
        leaving(lambda: f"{done} of {missing} more are in {folder}; the same command goes on with the rest"),
        screen.flights_progress() as bar,
        workers.local(min(jobs or workers.cores(), missing)) as crew,
    ):
        task = bar.add_task("in memory", total=missing, said="")
        for row in bench.fly(plan, journal, crew):
            done += 1
            lost += not row.flown
            bar.update(task, advance=1, said=f"{lost} lost" if lost else "")


def _fly_programs(plan: Plan, folder: Path, speed: float) -> list[Row]:
    """One after another, for each is in real time."""
    import msgspec

    from mavsitl.cli import screen
    from mavsitl.score import external
    from mavsitl.score.suite import CASE, CONTROLLER

    rows: list[Row] = []
    if not plan.programs:
        return rows
    with screen.flight_progress(screen.console(stderr=True)) as bar:
        for program in plan.programs:
            for case in plan.suite.cases:
                flight = case.flight()
                total_s = flight.scenario.duration_s
                for seed in plan.suite.seeds:
                    scenario = msgspec.structs.replace(flight.scenario, seed=seed)
                    place = folder / program.name / f"{case.name}-{seed}"
                    task = bar.add_task(f"{program.name}: {case.name}, seed {seed}", total=total_s, said="")

                    def move(time_s: float, task: Any = task) -> None:
                        bar.update(task, completed=max(time_s, 0.0), said="" if time_s >= 0.0 else "on the ground")

                    row = external.fly(
                        program, msgspec.structs.replace(flight, scenario=scenario), place,
                        {CASE: case.name, CONTROLLER: program.name}, speed=speed, move=move,
                    )  # fmt: skip
                    bar.update(task, said=row.status if row.flown else f"{row.status}: {row.message}", visible=False)
                    if not row.flown:
                        screen.line(
                            bar.console, f"{program.name}, {case.name}, seed {seed}: {row.status}: {row.message}"
                        )
                    rows.append(row)
    return rows


def _show(console: Console, plan: Plan, board: Board) -> None:
    from mavsitl.cli import screen
    from mavsitl.score import bench

    names = [each.controller for each in board.standings]
    shown = bench.short_names(names)
    table = screen.table("", *(shown[name] for name in names), right=[shown[name] for name in names])
    for name, column in zip(names, table.columns[1:], strict=True):
        column.style = "" if name in _shipped() else "bold cyan"
    table.add_row("[bold]score[/]", *(f"[bold]{each.score:.0f}[/]" for each in board.standings))
    if len(board.seeds) > 1:
        table.add_row("  by seed", *(f"{low:.0f}-{high:.0f}" for low, high in (each.seeds for each in board.standings)))
    for group in plan.suite.groups:
        table.add_row(group, *(f"{each.groups[group]:.0f}" for each in board.standings))
    table.add_row("lost", *(f"[bold red]{each.lost}[/]" if each.lost else "0" for each in board.standings))
    console.print(table)
    flights = board.standings[0].flights
    each = "1 flight each" if flights == 1 else f"{flights} flights each"
    console.print(f"100 is as good as the cascade aboard (stock), more is better; {each}", style="dim")


def _shipped() -> tuple[str, ...]:
    from mavsitl import controllers

    return controllers.shipped()


def _end(console: Console, plan: Plan, rows: list[Row]) -> int:
    """What was not flown to its end, of those that are not shipped; and the exit code."""
    from mavsitl.cli import screen
    from mavsitl.score.suite import CASE, CONTROLLER

    gone = [row for row in rows if not row.flown and row.labels[CONTROLLER] not in _shipped()]
    for row in gone[:10]:
        what = f"{row.labels[CONTROLLER]}, {row.labels[CASE]}, seed {row.seed}: {row.status} at {row.time_s:.1f} s"
        screen.line(console, f"{what}: {row.message}")
    if len(gone) > 10:
        console.print(f"and {len(gone) - 10} more")
    return EXIT_FAILED if any(row.status == "failed" for row in rows) else EXIT_OK
