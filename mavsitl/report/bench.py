"""One self-contained page for a score board: no script, no font, no picture from elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from math import log
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from mavsitl import controllers
from mavsitl.keep import replace_file
from mavsitl.report.figures import CALM, REFERENCE, WIND, Drawing, svg, with_ids
from mavsitl.report.html import REPORT_FILE, template
from mavsitl.report.run import RunError
from mavsitl.report.tables import number
from mavsitl.score.bench import Result, short_names
from mavsitl.score.score import LIMIT, PAR, STOCK, WEIGHTS, Board, Cell
from mavsitl.score.suite import CASE, CONTROLLER, Suite

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = (CALM, WIND, "#1b7837", "#762a83", "#8c510a", "#5c5c66", "#c51b7d", "#35978f")
TICKS = (10, 15, 20, 30, 50, 70, 100, 150, 200, 300, 500, 700, 1000)
MOST_DRAWN = len(COLOURS)
MOST_GONE = 100
"""Flights that were not flown to their end, listed one by one."""


class Measured(NamedTuple):
    """A table of the cases by the controllers."""

    title: str
    unit: str
    field: str
    factor: float


MEASURED = (
    Measured("RMS distance from the reference", "mm", "rms_m", 1e3),
    Measured("Largest distance from the reference", "mm", "peak_m", 1e3),
    Measured("Rotor effort", "rad/s", "effort_rad_s", 1.0),
    Measured("Settled within 0.1 m after", "s", "settling_s", 1.0),
)


def write(folder: Path, result: Result, suite: Suite) -> Path:
    """Write report.html into the folder and return its path. Raises `RunError`."""
    path = folder / REPORT_FILE
    try:
        replace_file(path, render(result, suite).encode())
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def render(result: Result, suite: Suite) -> str:
    """The page as text."""
    board = result.board
    names = short_names([each.controller for each in board.standings])
    gone = [row for row in result.rows if not row.flown]

    def told(name: str, measure: Measured) -> bool:
        return any(shown(each.cases[name], measure) for each in board.standings)

    return template("bench.html.j2").render(
        result=result,
        board=board,
        suite=suite,
        names=names,
        shipped=controllers.shipped(),
        most=max(each.score for each in board.standings),
        par=PAR,
        limit=LIMIT,
        weights=WEIGHTS,
        cases=[(group, [each for each in suite.cases if each.group == group]) for group in suite.groups],
        shade=shade,
        measured=MEASURED,
        shown=shown,
        told=told,
        gone=gone[:MOST_GONE],
        unlisted=max(len(gone) - MOST_GONE, 0),
        labels=(CASE, CONTROLLER),
        drawing=with_ids(groups(board, list(names.values())).svg, "g-"),
    )


def shade(score: float) -> str:
    """A cell's background: green above par, red below, the more the farther in factors."""
    strength = min(abs(log(score / PAR)) / log(4.0), 1.0)
    colour = "38, 160, 90" if score >= PAR else "205, 60, 45"
    return f"background: rgba({colour}, {0.06 + 0.5 * strength:.2f})" if strength > 0.01 else ""


def shown(cell: Cell, measure: Measured) -> str:
    """A measure of a cell; empty where it has none."""
    value = getattr(cell, measure.field)
    return "" if value is None else number(value * measure.factor)


def groups(board: Board, names: Sequence[str]) -> Drawing:
    """Each controller's score in each group; stock's is the line."""
    others = [pair for pair in zip(board.standings, names, strict=True) if pair[0].controller != STOCK]
    standings = (others or [(board.standings[0], names[0])])[:MOST_DRAWN]
    labels = list(board.standings[0].groups)
    height_in = 0.75 + len(labels) * (0.12 + 0.1 * max(len(standings), 2))

    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0.1, 0.55 / height_in, 0.7, 1.0 - 0.7 / height_in))
        axes.set_xscale("log")
        values = [value for standing, _ in standings for value in standing.groups.values()] + [PAR]
        axes.set_xlim(min(values) / 1.15, max(values) * 1.15)
        each_in = 0.8 / len(standings)
        for index, ((standing, name), colour) in enumerate(zip(standings, COLOURS, strict=False)):
            places = [k + (index - (len(standings) - 1) / 2) * each_in for k in range(len(labels))]
            values = [standing.groups[label] for label in labels]
            axes.barh(
                places, [value - PAR for value in values], left=PAR, height=0.86 * each_in, color=colour, label=name
            )
        axes.axvline(PAR, color=REFERENCE, linewidth=0.9)
        low, high = axes.get_xlim()
        ticks = [tick for tick in TICKS if low <= tick <= high]
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
        axes.set_yticks(range(len(labels)), labels)
        axes.set_ylim(len(labels) - 0.5, -0.5)
        axes.tick_params(axis="y", length=0.0)
        axes.grid(axis="y", visible=False)
        axes.set_xlabel("score, 100 is stock")
        figure.legend(*axes.get_legend_handles_labels(), loc="upper right", fontsize=8.5)

    return Drawing(svg(draw, height_in, "groups"), "Scores by group of cases", "")
