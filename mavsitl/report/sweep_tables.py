"""A sweep's summary as plain rows, for the terminal and for the page."""

from __future__ import annotations

from typing import Any

import msgspec

from mavsitl.campaign.grid import Labels
from mavsitl.campaign.summary import MEASURES, CellSummary, Comparison, Interval, Summary
from mavsitl.report.tables import number


def cell_header(summary: Summary) -> list[str]:
    keys = list(summary.cells[0].labels)
    return [*keys, "flown", *(measure.title for measure in MEASURES.values())]


def cell_rows(summary: Summary) -> list[list[str]]:
    """The cells' medians with their intervals; how many were flown to their end."""
    return [
        [*map(shown, cell.labels.values()), flown(cell), *(bounds(each.median) for each in cell.measures.values())]
        for cell in summary.cells
    ]


def comparison_header() -> list[str]:
    header = ["", "in", "pairs"]
    for name in COMPARED:
        header += [MEASURES[name].title, "ratio", "p"]
    return header


COMPARED = ("position_m", "attitude_deg")


def comparison_rows(summary: Summary) -> list[list[str]]:
    rows = []
    for each in summary.comparisons:
        row = [versus(each), described(each.labels), str(each.pairs)]
        for name in COMPARED:
            paired = each.measures[name]
            row += [
                bounds(paired.difference, signed=True),
                "" if paired.ratio is None else f"{paired.ratio:.3f}",
                probability(paired.p_value),
            ]
        rows.append(row)
    return rows


def versus(each: Comparison) -> str:
    return f"{shown(each.second)} against {shown(each.first)}"


def flown(cell: CellSummary) -> str:
    """How many of how many, and what became of the others."""
    others = [f"{count} {name}" for name, count in (("lost", cell.lost), ("failed", cell.failed)) if count]
    text = f"{cell.n - cell.lost - cell.failed} of {cell.n}"
    return f"{text} ({', '.join(others)})" if others else text


def bounds(interval: Interval, *, signed: bool = False) -> str:
    """``0.123 [0.120, 0.126]``; what a lost flight made is ``lost``."""
    if interval.value is None:
        return "lost"
    sign = "+" if signed and interval.value > 0.0 else ""
    text = sign + number(interval.value)
    if interval.low is None:
        return text
    return f"{text} [{number(interval.low)}, {'lost' if interval.high is None else number(interval.high)}]"


def probability(p_value: float | None) -> str:
    if p_value is None:
        return ""
    return f"{p_value:.1e}" if p_value < 0.001 else f"{p_value:.3f}"


def described(labels: Labels) -> str:
    """``wind.speed_20ft_m_s = 5, controller.law = pid``"""
    return ", ".join(f"{key} = {shown(value)}" for key, value in labels.items())


def shown(value: Any) -> str:
    """A value as --set takes it."""
    match value:
        case str():
            return value
        case float() | int() if not isinstance(value, bool):
            return f"{value:g}"
        case _:
            return msgspec.json.encode(value).decode()
