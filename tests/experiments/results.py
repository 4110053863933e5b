"""Tables 3 and 4 by command level, law, wind information and airframe: ``python -m tests.experiments.results``.

Writes docs/reference/results.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from math import inf
from pathlib import Path

import msgspec

from mavsitl.campaign.fly import Row
from mavsitl.campaign.grid import Overrides
from mavsitl.campaign.summary import quantile
from mavsitl.report.metrics import LABELS, PAPER_TABLES, UNITS
from mavsitl.report.tables import number
from mavsitl.scenario import load
from tests.experiments import engine
from tests.experiments.engine import table

OUTPUT = Path("docs") / "reference" / "results.md"
MET = 1.0 + 5e-4
"""The paper prints three or four digits: closer than half of the last of three is the same number."""

SEATS: dict[str, Overrides] = {
    "body_rate/pidnn": {"controller.level": "body_rate", "controller.inner": "stock", "controller.law": "pidnn"},
    "body_rate/pid": {"controller.level": "body_rate", "controller.inner": "stock", "controller.law": "pid"},
    "torque/pidnn": {"controller.level": "torque", "controller.inner": "stock", "controller.law": "pidnn"},
    "torque/pid": {"controller.level": "torque", "controller.inner": "stock", "controller.law": "pid"},
    "attitude/pidnn": {"controller.level": "attitude", "controller.inner": "pidnn", "controller.law": "pidnn"},
    "attitude/pid": {"controller.level": "attitude", "controller.inner": "pidnn", "controller.law": "pid"},
    "attitude/stock": {"controller.level": "attitude", "controller.inner": "stock"},
}
"""Level and law; the stock cascade aboard has no law of the paper in it."""
WIND_INFORMATION = ("observer", "oracle", "none")
REALISTIC = "hover-wind-realistic"
AIRFRAMES = ("paper", "realistic")


@dataclass(frozen=True)
class Cell:
    """One way to fly the paper's four experiments."""

    name: str
    """airframe/level/law/wind information"""
    overrides: Overrides


@dataclass(frozen=True)
class Number:
    """One of the paper's 24."""

    case: str
    state: str
    unit: str
    paper: float
    values: tuple[float, ...]
    """A seed each; infinite for a flight that was lost."""

    @property
    def name(self) -> str:
        return f"{self.case} {self.state}"

    @property
    def median(self) -> float:
        return quantile(self.values, 0.5)

    @property
    def ratio(self) -> float:
        return self.median / self.paper

    @property
    def met(self) -> bool:
        return self.ratio <= MET


def cells() -> list[Cell]:
    """The default one first. The realistic airframe is flown with the controller of the scenario shipped for it."""
    shipped = msgspec.json.decode(msgspec.json.encode(load(REALISTIC).scenario.controller))
    airframes: dict[str, Overrides] = {
        "paper": {"airframe": "paper"},
        "realistic": {"airframe": "realistic", "controller": shipped},
    }
    return [
        Cell(f"{airframe}/{seat}/{wind}", airframes[airframe] | SEATS[seat] | {"controller.wind_information": wind})
        for airframe in AIRFRAMES
        for seat in SEATS
        for wind in WIND_INFORMATION
    ]


def numbers(outcomes: dict[str, list[Row]]) -> list[Number]:
    """The 24, from the outcomes of each of the paper's four cases."""
    made = []
    for case, paper in PAPER_TABLES.items():
        rows = [(inf,) * 6 if outcome.rmse is None else outcome.rmse for outcome in outcomes[case]]
        for i, (label, unit, theirs) in enumerate(zip(LABELS, UNITS, paper.values(), strict=True)):
            made.append(Number(case, label, unit, theirs, tuple(row[i] for row in rows)))
    return made


def show(value: float) -> str:
    return "lost" if value == inf else number(value)


def ratio(value: float) -> str:
    text = "lost" if value == inf else f"{value:.2f}"
    return text if value <= MET else f"**{text}**"


def summary(results: dict[str, tuple[list[Number], list[Row]]]) -> str:
    rows = []
    for name, (found, outcomes) in results.items():
        worst = max(found, key=lambda each: each.ratio)
        met, lost = sum(each.met for each in found), len(engine.failures(outcomes))
        rows.append(
            [f"`{name}`", f"{met} of {len(found)}", f"{worst.name} {ratio(worst.ratio)}", f"{lost} of {len(outcomes)}"]
        )
    return table(("airframe/level/law/wind information", "met or beaten", "worst ratio", "flights lost"), rows)


def absolute(found: Sequence[Number]) -> str:
    rows = [
        [
            f"{each.case} {each.state} / {each.unit}", show(each.median), show(quantile(each.values, 0.25)),
            show(quantile(each.values, 0.75)), number(each.paper), ratio(each.ratio),
        ]
        for each in found
    ]  # fmt: skip
    return table(("RMSE", "median", "lower quartile", "upper quartile", "paper", "ratio"), rows)


def ratios(found: Sequence[Number]) -> str:
    rows = [[case, *(ratio(each.ratio) for each in found if each.case == case)] for case in PAPER_TABLES]
    return table(("ratio", *LABELS), rows)


INTRODUCTION = """\
<!-- Generated by `python -m tests.experiments.results`; do not edit. -->

# Results

Root mean square errors against Tables 3 and 4 of the paper, medians over {seeds} seeds{short}. Flown in memory, which
puts the same bytes on the wire as two processes do. A ratio is our median over the paper's number; those above 1 are
bold. A lost flight (more than 20 m from its reference, or not ended as planned) counts as an infinite error.

Generated by `python -m tests.experiments.results --seeds {count}{pattern}`. The cell `paper/body_rate/pidnn/observer`
is what the shipped scenarios fly. The realistic airframe is flown with the controller of `{realistic}`. Level
`attitude` with law `pidnn` or `pid` has that law aboard; `stock` is the vehicle's own cascade.
"""


def page(results: dict[str, tuple[list[Number], list[Row]]], options: argparse.Namespace) -> str:
    first, *others = results
    flown = f"{len(engine.seeds_of(options))}"
    short = f", flights of {engine.QUICK_S:g} s only (`--quick`: not comparable)" if options.quick else ""
    pattern = "" if options.cells == "*" else f" --cells '{options.cells}'"
    parts = [
        INTRODUCTION.format(seeds=flown, short=short, count=options.seeds, realistic=REALISTIC, pattern=pattern),
        "## Summary\n",
        summary(results),
        f"## {first}\n",
        absolute(results[first][0]),
    ]
    for name in others:
        parts += [f"## {name}\n", ratios(results[name][0])]
    bad = [(name, outcome) for name, (_, outcomes) in results.items() for outcome in engine.failures(outcomes)]
    if bad:
        counted: dict[tuple[str, str, str], list[Row]] = {}
        for name, outcome in bad:
            counted.setdefault((name, outcome.scenario, outcome.status), []).append(outcome)
        rows = [
            [f"`{name}`", case, status, str(len(each)), f"{min(o.time_s for o in each):.1f}", _said(each)]
            for (name, case, status), each in counted.items()
        ]
        header = ("cell", "scenario", "end", "flights", "first after / s", "message")
        parts += ["## Flights lost\n", table(header, rows)]
    return "\n".join(parts)


def _said(outcomes: Sequence[Row]) -> str:
    if outcomes[0].status == "lost":
        return ""
    return "; ".join(sorted({outcome.message.replace("|", "/") for outcome in outcomes}))


def main(argv: Sequence[str] | None = None) -> int:
    parser = engine.parser("results", "The paper's Tables 3 and 4, cell by cell.", seeds=20, output=OUTPUT)
    parser.add_argument(
        "--cells",
        metavar="PATTERN",
        default="*",
        help="only cells whose name matches, e.g. 'paper/body_rate/*' (default: all)",
    )
    options = parser.parse_args(argv)
    chosen = [cell for cell in cells() if fnmatchcase(cell.name, options.cells)]
    if not chosen:
        parser.error(
            f"--cells: nothing matches {options.cells!r}; there are: {', '.join(cell.name for cell in cells())}"
        )
    if options.quick:
        chosen = chosen[:1]
    extra: Overrides = {"duration_s": engine.QUICK_S} if options.quick else {}
    seeds = engine.seeds_of(options)
    order = [(cell, case, seed) for cell in chosen for case in PAPER_TABLES for seed in seeds]
    jobs = [engine.job(case, cell.overrides | extra, seed) for cell, case, seed in order]
    outcomes = engine.campaign(jobs, workers=options.jobs, store=engine.store_of(options), title="results")
    results: dict[str, tuple[list[Number], list[Row]]] = {}
    for cell in chosen:
        mine = {
            case: [o for (c, k, _), o in zip(order, outcomes, strict=True) if c is cell and k == case]
            for case in PAPER_TABLES
        }
        results[cell.name] = (numbers(mine), [outcome for each in mine.values() for outcome in each])
    engine.publish(page(results, options), options)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
