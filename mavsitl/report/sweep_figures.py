"""A sweep's figures, as SVG text: where the errors lie, how they grow with a key, and what one setting changes."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, isfinite, nan
from typing import TYPE_CHECKING, Any

import numpy as np

from mavsitl import seeds
from mavsitl.campaign.fly import Row
from mavsitl.campaign.grid import Labels
from mavsitl.campaign.summary import MEASURES, CellSummary, Comparison, Interval, Summary, group, pair
from mavsitl.report.figures import BROKEN, CALM, REFERENCE, UNDERNEATH, WIND, Drawing, svg
from mavsitl.report.sweep_tables import COMPARED, described, short, shown, versus

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROW_IN, LINE_IN = 0.3, 0.24
"""Of a row of a figure, and of a line of a legend."""
MOST_ROWS = 60
"""Cells and comparisons drawn; a page is not a book."""
MOST_LINES, MOST_FIGURES = 6, 6
"""Curves in one figure, and figures of one kind."""
COLOURS = (CALM, WIND, "#1b7837", "#762a83", "#8c510a", "#5c5c66")
LOG_FROM = 20.0
LOG_RATIO = 4.0
"""A span of errors, and of ratios, of more than this factor is drawn in logarithms."""


def distribution(rows: Sequence[Row], summary: Summary, keys: Sequence[str], name: str) -> Drawing | None:
    """Each flight a dot, each cell a row: its median with the interval, and its quartiles. None for too many cells."""
    cells = [mine for _, mine in group(rows, keys)]
    if len(cells) > MOST_ROWS:
        return None
    measure = MEASURES[name]
    colours = _colours(summary.cells)

    def draw(figure: Figure) -> None:
        values = [[value for row in mine if isfinite(value := measure.of(row))] for mine in cells]
        axes = _rows(figure, [_label(cell.labels) for cell in summary.cells], ", ".join(short(keys)))
        for place, (found, cell, colour) in enumerate(zip(values, summary.cells, colours, strict=True)):
            spread = cell.measures[name]
            if spread.q25 is not None and spread.q75 is not None:
                axes.plot([spread.q25, spread.q75], [place, place], color=UNDERNEATH, linewidth=9.0, alpha=0.45,
                          solid_capstyle="butt", zorder=1)  # fmt: skip
            axes.plot(found, place + _jitter(len(found)), "o", color=colour, markersize=2.6, alpha=0.6,
                      markeredgewidth=0.0, zorder=2)  # fmt: skip
            _mark(axes, spread.median, place, colour)
            if gone := cell.lost + cell.failed:
                axes.annotate(f"{gone} not flown to the end", (1.0, place), xycoords=("axes fraction", "data"),
                              color=BROKEN, ha="right", va="center", fontsize=8.0)  # fmt: skip
        _scale(axes, [value for each in values for value in each], "x")
        axes.set_xlabel(measure.title)

    caption = f"{measure.headline} of each flight, with medians and their 95 % intervals, and quartiles"
    return Drawing(svg(draw, _height(len(cells)), f"distribution-{name}"), caption, "")


def against(summary: Summary, key: str, name: str) -> Drawing | None:
    """The cells' medians by a key of numbers; a curve for each combination of the others. None where that is none."""
    curves: dict[str, list[CellSummary]] = {}
    for cell in summary.cells:
        others = {other: value for other, value in cell.labels.items() if other != key}
        curves.setdefault(described(others), []).append(cell)
    places = [cell.labels[key] for cell in next(iter(curves.values()))]
    numeric = all(isinstance(value, int | float) and not isinstance(value, bool) for value in places)
    if not numeric or len(places) < 3 or len(curves) > MOST_LINES:
        return None
    measure = MEASURES[name]
    lines = ceil(len(curves) / 2) if len(curves) > 1 else 0
    height_in = 3.2 + LINE_IN * lines

    def draw(figure: Figure) -> None:
        bottom, top = 0.52 / height_in, 1.0 - (0.15 + LINE_IN * lines) / height_in
        axes = figure.add_axes((0.1, bottom, 0.87, top - bottom))
        seen: list[float] = []
        for (label, cells), colour in zip(curves.items(), COLOURS, strict=False):
            ordered = sorted(cells, key=lambda cell: float(cell.labels[key]))
            medians = [cell.measures[name].median for cell in ordered]
            x = [float(cell.labels[key]) for cell in ordered]
            middle, low, high = (
                [nan if (bound := getattr(median, part)) is None else bound for median in medians]
                for part in ("value", "low", "high")
            )
            axes.plot(x, middle, "o-", color=colour, label=label, markersize=4.0)
            axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0.0)
            seen += filter(isfinite, (*middle, *high))
        _scale(axes, seen, "y")
        axes.set_xlabel(key)
        axes.set_ylabel(measure.title)
        if lines:
            figure.legend(*axes.get_legend_handles_labels(), loc="upper right", ncols=2, fontsize=8.5)

    caption = f"{measure.headline} against {key}: medians and their 95 % intervals"
    return Drawing(svg(draw, height_in, f"against-{name}"), caption, "")


def ratios(rows: Sequence[Row], summary: Summary, name: str) -> list[Drawing]:
    """For each two settings: each pair a dot, the error of the second over that of the first, each other cell a row."""
    measure = MEASURES[name]
    cells = {_key(labels): mine for labels, mine in group(rows, list(summary.cells[0].labels))}
    settings: dict[str, list[Comparison]] = {}
    for each in summary.comparisons:
        if each.measures[name].ratio.value is not None:
            settings.setdefault(versus(each), []).append(each)
    made = []
    for number, (setting, shown_ones) in enumerate(settings.items()):
        if len(shown_ones) > MOST_ROWS:
            continue

        def draw(figure: Figure, shown_ones: list[Comparison] = shown_ones) -> None:
            keys = list(shown_ones[0].labels)
            axes = _rows(figure, [_label(each.labels) for each in shown_ones], ", ".join(short(keys)))
            axes.axvline(1.0, color=REFERENCE, linewidth=0.9)
            seen = [1.0]
            for place, each in enumerate(shown_ones):
                pairs = pair(cells[_key(_side(each, each.first))], cells[_key(_side(each, each.second))])
                found = [measure.of(b) / measure.of(a) for a, b in pairs if measure.of(a) > 0.0]
                axes.plot(found, place + _jitter(len(found)), "o", color=UNDERNEATH, markersize=3.0,
                          markeredgewidth=0.0, zorder=2)  # fmt: skip
                ratio = each.measures[name].ratio
                _mark(axes, ratio, place, CALM if (ratio.value or 0.0) <= 1.0 else WIND)
                seen += found
            if min(seen) > 0.0 and max(seen) > LOG_RATIO * min(seen):
                axes.set_xscale("log")
                axes.grid(which="minor", axis="x", visible=False)
            axes.set_xlabel(f"{measure.name}, ratio")

        caption = f"{measure.headline}, {setting}, seed by seed: left of 1 it is smaller; medians, 95 % intervals"
        svg_name = f"ratios-{name}-{number}"
        made.append(Drawing(svg(draw, _height(len(shown_ones)), svg_name), caption, ""))
    return made[:MOST_FIGURES]


def drawings(rows: Sequence[Row], summary: Summary, keys: Sequence[str]) -> list[Drawing]:
    """All that there are to draw."""
    found: list[Drawing | None] = []
    for name in COMPARED:
        found.append(distribution(rows, summary, keys, name))
        found += [against(summary, key, name) for key in keys]
        found += ratios(rows, summary, name)
    return [drawing for drawing in found if drawing is not None]


def _side(each: Comparison, value: Any) -> Labels:
    return {**each.labels, each.key: value}


def _key(labels: Labels) -> frozenset[tuple[str, str]]:
    return frozenset((key, shown(value)) for key, value in labels.items())


def _label(labels: Labels) -> str:
    return ", ".join(shown(value) for value in labels.values()) or "all"


def _colours(cells: Sequence[CellSummary]) -> list[str]:
    """By the value of the key with the fewest values, so that what is compared differs."""
    if not cells[0].labels:
        return [CALM]
    values = {key: list(dict.fromkeys(shown(cell.labels[key]) for cell in cells)) for key in cells[0].labels}
    key = min(values, key=lambda name: len(values[name]))
    return [COLOURS[values[key].index(shown(cell.labels[key])) % len(COLOURS)] for cell in cells]


def _height(rows: int) -> float:
    return 0.75 + ROW_IN * rows


def _rows(figure: Figure, labels: Sequence[str], title: str) -> Any:
    """Axes with a row for each label, the first on top."""
    width, height = figure.get_size_inches()
    left = min(0.25 + 0.075 * max(map(len, labels)), 0.5 * width)
    axes: Any = figure.add_axes(
        (left / width, 0.5 / height, 1.0 - (left + 0.25) / width, 1.0 - 0.75 / height)
    )  # fmt: skip
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0.0)
    axes.grid(axis="y", visible=False)
    if title:
        axes.set_title(title, fontsize=9.0, color="#5c5c66", loc="left", x=0.0)
    return axes


def _mark(axes: Any, interval: Interval, place: float, colour: str) -> None:
    """A median, with the line of its interval."""
    if interval.value is None:
        return
    if interval.low is not None and interval.high is not None:
        axes.plot([interval.low, interval.high], [place, place], color=colour, linewidth=2.0, zorder=3)
    axes.plot([interval.value], [place], "D", color=colour, markeredgecolor="white", markersize=6.0, zorder=4)


def _jitter(count: int) -> Any:
    return seeds.generator(0, "jitter").uniform(-0.22, 0.22, count)


def _scale(axes: Any, values: Sequence[float], axis: str) -> None:
    """From 0, or logarithmic where the values span much."""
    positive = [value for value in values if value > 0.0]
    if len(positive) == len(values) and positive and max(positive) > LOG_FROM * min(positive):
        (axes.set_xscale if axis == "x" else axes.set_yscale)("log")
        axes.grid(which="minor", axis=axis, visible=False)
    elif positive:
        top = 1.06 * float(np.max(positive))
        (axes.set_xlim if axis == "x" else axes.set_ylim)(0.0, top)
