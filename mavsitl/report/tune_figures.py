"""Error against effort of everything tried, and how the search went."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mavsitl.report.figures import Drawing, svg
from mavsitl.tune.objective import front
from mavsitl.tune.run import Tuning

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

START = "#1b1b1f"
CHOSEN = "#d6604d"
FRONT = "#2166ac"
TRIED = "#a9abb8"
ERROR = "error"
EFFORT = "effort / (rad/s)"


def trade_off(tuning: Tuning) -> Drawing:
    """Effort to the right, error upwards: left and low is good."""
    flown = [trial for trial in tuning.trials if not trial.score.lost]
    lost = len(tuning.trials) - len(flown)
    points = [(trial.score.effort, trial.score.error) for trial in flown]
    allowed = [tuning.allowed(trial) for trial in flown]
    kept = [point for point, is_allowed in zip(points, allowed, strict=True) if is_allowed]
    best = [kept[index] for index in front(kept)]

    def draw(figure: Figure) -> None:
        axes = _axes(figure, 1)[0]
        axes.plot(*np.array(kept).reshape(-1, 2).T, ".", color=TRIED, markersize=6, label="tried")
        if not all(allowed):
            refused = [point for point, is_allowed in zip(points, allowed, strict=True) if not is_allowed]
            axes.plot(*np.array(refused).T, "x", color=TRIED, markersize=4, markeredgewidth=0.8, label="not allowed")
        axes.step(
            *np.array(best).reshape(-1, 2).T, where="post", color=FRONT, linewidth=1.2, marker="o", markersize=4,
            label="not beaten in both",
        )  # fmt: skip
        chosen = tuning.best.score
        if not chosen.lost:
            low, high = axes.get_xlim()
            effort = np.linspace(max(low, 1e-3 * high), high, 200)
            alike = chosen.error * (chosen.effort / effort) ** tuning.plan.effort_weight
            axes.plot(effort, alike, color=CHOSEN, linewidth=0.9, linestyle=(0, (4, 3)), label="as good as the chosen")
            axes.set_xlim(low, high)
            axes.plot(chosen.effort, chosen.error, "*", color=CHOSEN, markersize=14, label="chosen")
        if not tuning.start.score.lost:
            axes.plot(
                tuning.start.score.effort, tuning.start.score.error, "D", color=START, markersize=7, label="start"
            )
        axes.set_xlabel(EFFORT)
        axes.set_ylabel(ERROR)
        if flown:
            _logarithmic(axes)
        figure.legend(
            *axes.get_legend_handles_labels(), loc="upper right", ncols=6, borderaxespad=0.2, columnspacing=1.4
        )

    said = f"; {lost} lost a flight and are not shown" if lost else ""
    return Drawing(svg(draw, 4.4, "trade-off"), f"Error against effort of all {len(tuning.trials)} tried{said}", "")


def convergence(tuning: Tuning) -> Drawing:
    """Each trial, and the best so far."""
    weight = tuning.plan.effort_weight
    numbers = np.arange(len(tuning.trials))
    objectives = np.array(
        [trial.score.objective(weight) if tuning.allowed(trial) else np.inf for trial in tuning.trials]
    )
    newest = np.maximum.accumulate(np.where(objectives <= np.minimum.accumulate(objectives), numbers, 0))
    flown = np.array([not trial.score.lost for trial in tuning.trials])

    def draw(figure: Figure) -> None:
        from matplotlib.ticker import MaxNLocator

        rows = _axes(figure, 2)
        for axes, name in zip(rows, ("error", "effort"), strict=True):
            values = np.array([getattr(trial.score, name) for trial in tuning.trials])
            axes.plot(numbers[flown], values[flown], ".", color=TRIED, markersize=5, label="tried")
            so_far = np.where(np.isfinite(values[newest]), values[newest], np.nan)
            axes.step(numbers, so_far, where="post", color=CHOSEN, linewidth=1.4, label="best so far")
            for number in numbers[~flown]:
                axes.axvline(number, color="#a3241b", linewidth=0.6, alpha=0.35)
        if flown.any():
            _logarithmic(rows[0])
        rows[0].set_ylabel(ERROR)
        rows[1].set_ylabel(EFFORT)
        rows[1].set_xlabel("evaluation")
        rows[1].xaxis.set_major_locator(MaxNLocator(integer=True))
        figure.legend(*rows[0].get_legend_handles_labels(), loc="upper right", ncols=2, borderaxespad=0.2)

    said = "; red lines: a flight was lost" if not flown.all() else ""
    return Drawing(svg(draw, 4.4, "convergence"), f"The search, evaluation by evaluation{said}", "")


def _axes(figure: Figure, rows: int) -> list[Axes]:
    width, height = figure.get_size_inches()
    figure.subplots_adjust(left=0.85 / width, right=1.0 - 0.2 / width, bottom=0.52 / height, top=1.0 - 0.45 / height)
    grid = figure.subplots(rows, 1, sharex=True, squeeze=False)
    return list(grid[:, 0])


def _logarithmic(axes: Axes) -> None:
    """With numbers as they are said, not as powers of ten, and enough of them."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator, StrMethodFormatter

    axes.set_yscale("log")
    low, high = axes.get_ylim()
    near = high < 5.0 * low
    axes.yaxis.set_major_locator(MaxNLocator(6) if near else LogLocator(subs=(1.0, 2.0, 3.0, 5.0), numticks=12))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
