"""`mavsitl tune`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavsitl.cli.campaigns import add_run_options, check_run_options, crew
from mavsitl.cli.common import (
    EXIT_OK,
    PAPER_SCENARIOS,
    above_zero,
    add_json,
    add_scenario_options,
    at_least_1,
    command,
    command_line,
    interrupt,
    leaving,
    not_negative,
    on_signals,
    overrides_of,
    settings_of,
    whole,
)

if TYPE_CHECKING:
    from mavsitl.tune.run import Tuning
    from mavsitl.tune.search import Trial


TUNE_HELP = """\
Search the gains and learning rates of a controller over whole flights in memory. Each candidate flies every scenario
under the same few seeds; what is found is then judged against the start on seeds that the search has not seen. Without
a scenario the paper's four experiments are flown together.

  error      of each scenario and state the RMSE over the paper's number in Tables 3 and 4, or in a scenario that is
             none of the paper's over 0.1 m and 0.5 degrees, or with --against start over what the gains to begin with
             have there; of these ratios the 4-norm: the worst count most
  effort     RMS of the rotors' speeds about their mean, rad/s
  searched   the least error x effort^W, W being --effort-weight, with no RMSE above --no-worse times that of the gains
             to begin with, and no number of the paper's missed that those reach; a lost flight is worse than any that
             was flown

The search starts at the gains that the scenarios have, and is SciPy's COBYQA. --tune KEY=LOW:HIGH names what is turned
and how far, with :log or :linear behind it for how the range is divided; without a range it is a fifth of the value to
five times that; without --tune it is every gain, filter, learning rate and observer bandwidth that the controller
reads. An array such as controller.learning.rate is turned as one, or item by item: controller.learning.rate[0].

The folder gets each scenario with the gains found, tune.json with every candidate, report.html, one self-contained
page, and rows.jsonl, every flight so far: the same command goes on where it was ended. Ctrl-C gives the best so far.

SEEDS is N for 1 to N, or FIRST-LAST, or N,N,N; those to search on and those to judge by have none in common.
"""

TUNE_EXAMPLES = """\
examples:
  mavsitl tune                                       the paper's controller on the paper's four experiments
  mavsitl tune hover-wind-realistic --jobs 8 --evaluations 300
  mavsitl tune my.toml --tune controller.position.k_p_per_s2=1:20 --tune controller.learning.rate=1:100:log
  mavsitl tune hover-wind --search-duration 20 --effort-weight 0.5 --output runs/gentle
  mavsitl tune my.toml --against start --no-worse 1.02    better, and nothing worse by more than 2 %
  mavsitl tune --seeds 2001-2008 --held-out 50 --scheduler tcp://192.0.2.7:8786

Exit codes: 0 done, whether something better was found or not; 1 it cannot go on; 2 wrong arguments; 130 interrupted.
"""


def add(commands: Any) -> None:
    parser = command(
        commands, "tune", "search a controller's gains, and judge them on other seeds", TUNE_HELP, TUNE_EXAMPLES
    )
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help="a shipped scenario's name or a .toml file")
    add_scenario_options(parser, seed=False)
    group = parser.add_argument_group("search")
    group.add_argument(
        "--tune", action="append", default=[], metavar="KEY[=LOW:HIGH]", dest="keys",
        help="a key of controller or parameters, and its range; may be repeated",
    )  # fmt: skip
    group.add_argument(
        "--evaluations", type=whole(1, 1_000_000), default=150, metavar="N", help="candidates (default: 150)"
    )
    group.add_argument(
        "--effort-weight", type=not_negative, default=0.3, metavar="W",
        help="what 1 %% of effort has to buy, in %% of error (default: 0.3)",
    )  # fmt: skip
    group.add_argument(
        "--against", choices=("paper", "start"), default="paper",
        help="what each RMSE is divided by: the paper's number, or that of the gains to begin with (default: paper)",
    )  # fmt: skip
    group.add_argument(
        "--no-worse", type=at_least_1, metavar="F",
        help="no RMSE of any scenario and state above F times that of the gains to begin with, and none of the paper's "
        "numbers missed that those reach (default: no bound)",
    )  # fmt: skip
    group.add_argument(
        "--seeds", default="1001-1003", metavar="SEEDS", help="flown by each candidate (default: 1001-1003)"
    )
    group.add_argument("--held-out", default="20", metavar="SEEDS", help="judged by (default: 20, which is 1 to 20)")
    group.add_argument(
        "--search-duration", type=above_zero, metavar="S",
        help="fly so much of each flight in the search; judged is the whole (default: all of it)",
    )  # fmt: skip
    group.add_argument(
        "--search-seed", type=whole(0, 2**31), default=1, metavar="N", help="of the search itself (default: 1)"
    )
    group = parser.add_argument_group("run")
    add_run_options(group, "runs/tune-SCENARIO; what is there is gone on with")
    add_json(group, "what tune.json has")
    parser.set_defaults(run=_tune)


def _tune(options: argparse.Namespace) -> int:
    from mavsitl.campaign.grid import parse_seeds
    from mavsitl.campaign.store import Journal
    from mavsitl.cli import screen
    from mavsitl.tune import flights, result, run

    on_signals(interrupt)
    check_run_options(options)
    plan = run.Plan(
        names=tuple(options.scenarios or PAPER_SCENARIOS), settings=overrides_of(settings_of(options)),
        asked=tuple(options.keys), evaluations=options.evaluations, against=options.against,
        no_worse=options.no_worse, effort_weight=options.effort_weight,
        seeds=parse_seeds(options.seeds), held_out=parse_seeds(options.held_out),
        search_duration_s=options.search_duration, seed=options.search_seed,
    )  # fmt: skip
    tuning = run.begin(plan)
    name = Path(plan.names[0]).stem if len(plan.names) == 1 else "several" if options.scenarios else "paper"
    folder: Path = options.output or Path("runs") / f"tune-{name}"
    each = run.searched(tuning).each
    bar = screen.flights_progress()
    with Journal(folder / "rows.jsonl") as journal, crew(options, each) as workers, bar:
        task = bar.add_task("tune", total=run.flights_of(tuning), said="")

        def said(trial: Trial) -> None:
            if trial.number == 0 and trial.score.lost:
                text = f"the gains to begin with lose {trial.score.lost} of {each} flights: {trial.score.message}"
                screen.line(bar.console, text)
            best = tuning.best.score
            found = "all lost" if best.lost else f"best error {best.error:.4g}, effort {best.effort:.4g}"
            bar.update(task, said=f"{trial.number + 1} tried, {found}")

        try:
            with leaving(lambda: f"the same command goes on from {folder}"):
                run.carry_out(tuning, flights.kept(journal, workers, lambda: bar.advance(task)), said)
        except KeyboardInterrupt as interrupted:
            bar.stop()
            if tuning.trials:
                paths = _write(tuning, folder)
                interrupted.add_note(f"the best so far: {paths[-1]}")
                if not options.json:
                    _show(tuning, paths)
            raise
    paths = _write(tuning, folder)
    if options.json:
        print((folder / result.JSON_FILE).read_text("utf-8"), end="")
    else:
        _show(tuning, paths)
    return EXIT_OK


def _write(tuning: Tuning, folder: Path) -> list[Path]:
    """The files of what was found, the page last."""
    from mavsitl.report import tune as report
    from mavsitl.tune import result

    command = command_line()
    return [*result.write(tuning, folder, command), report.write(tuning, folder, command)]


def _show(tuning: Tuning, paths: Sequence[Path]) -> None:
    from rich.markup import escape

    from mavsitl.cli import screen
    from mavsitl.report.sweep_tables import bounds, probability
    from mavsitl.report.tables import number
    from mavsitl.tune import result

    console = screen.console()
    numbers = ("before", "after", "ratio, seed by seed", "p")
    table = screen.table("measure", "seeds", *numbers, title="before and after", right=numbers)
    for row in result.measures(tuning):
        cells = [row.name, row.seeds, number(row.before), number(row.after)]
        if row.paired is not None:
            cells += [bounds(row.paired.ratio), probability(row.paired.p_value)]
        table.add_row(*(escape(cell) for cell in cells))
    console.print(table)
    table = screen.table("key", "before", "after", "range", "", title="gains", right=("before", "after", "range"))
    for gain in result.gains(tuning):
        bound = "at its bound" if gain.at_bound else ""
        key = gain.key.replace("[", r"\[")
        table.add_row(key, f"{gain.before:.4g}", f"{gain.after:.4g}", f"{gain.low:.4g} to {gain.high:.4g}", bound)
    console.print(table)
    screen.line(console, result.verdict(tuning))
    for path in paths:
        screen.line(console, str(path))
