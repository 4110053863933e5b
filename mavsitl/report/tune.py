"""`report.html`: what was found, how, and what it costs, on one self-contained page."""

from __future__ import annotations

from itertools import groupby
from math import inf
from pathlib import Path

import mavsitl
from mavsitl.keep import replace_file
from mavsitl.report import tune_figures
from mavsitl.report.figures import with_ids
from mavsitl.report.html import REPORT_FILE, template
from mavsitl.report.run import RunError
from mavsitl.report.sweep_tables import bounds, probability
from mavsitl.tune import result
from mavsitl.tune.run import Tuning


def write(tuning: Tuning, folder: Path, command: str) -> Path:
    """Write report.html into the folder and return its path. Raises `RunError`."""
    path = folder / REPORT_FILE
    page = render(tuning, command)
    try:
        replace_file(path, page.encode())
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def render(tuning: Tuning, command: str) -> str:
    """The page as text."""
    drawn = [tune_figures.trade_off(tuning), tune_figures.convergence(tuning)]
    return template("tune.html.j2").render(
        names=result.titles(tuning),
        headline=result.verdict(tuning),
        command=command,
        version=mavsitl.__version__,
        trials=len(tuning.trials),
        searched=result.span(tuning.plan.seeds),
        held_out=result.span(tuning.plan.held_out),
        judged=tuning.judged is not None,
        measures=list(result.measures(tuning)),
        against=tuning.plan.against,
        no_worse=tuning.plan.no_worse,
        effort_weight=tuning.plan.effort_weight,
        shortened=tuning.plan.search_duration_s,
        drawings=[(with_ids(each.svg, f"t{index}-"), each) for index, each in enumerate(drawn)],
        gains=result.gains(tuning),
        states=[(name, list(rows)) for name, rows in groupby(result.states(tuning), lambda row: row.scenario)],
        infinite=inf,
        bounds=bounds,
        probability=probability,
    )
