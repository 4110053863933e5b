"""`report.html`: what was found, how, and what it costs, on one self-contained page."""

from __future__ import annotations

from importlib import resources
from itertools import groupby
from math import inf
from pathlib import Path

import mavsitl
from mavsitl.keep import replace_file
from mavsitl.report import figures as drawings
from mavsitl.report.html import fill
from mavsitl.report.sweep_tables import bounds, probability
from mavsitl.tune import figures, result
from mavsitl.tune.run import Tuning

PAGE_FILE = "report.html"


def write_page(tuning: Tuning, folder: Path, command: str) -> Path:
    """Raises `OSError`."""
    path = folder / PAGE_FILE
    folder.mkdir(parents=True, exist_ok=True)
    replace_file(path, render(tuning, command).encode())
    return path


def render(tuning: Tuning, command: str) -> str:
    """The page as text."""
    drawn = [figures.trade_off(tuning), figures.convergence(tuning)]
    return fill(
        resources.files("mavsitl.tune") / "page.html.j2",
        names=result.titles(tuning),
        headline=result.verdict(tuning),
        command=command,
        version=mavsitl.__version__,
        trials=len(tuning.trials),
        searched=result.span(tuning.plan.seeds),
        held_out=result.span(tuning.plan.held_out),
        judged=tuning.judged is not None,
        measures=list(result.measures(tuning)),
        effort_weight=tuning.plan.effort_weight,
        shortened=tuning.plan.search_duration_s,
        drawings=[(drawings.with_ids(each.svg, f"t{index}-"), each) for index, each in enumerate(drawn)],
        gains=result.gains(tuning),
        states=[(name, list(rows)) for name, rows in groupby(result.states(tuning), lambda row: row.scenario)],
        infinite=inf,
        bounds=bounds,
        probability=probability,
    )
