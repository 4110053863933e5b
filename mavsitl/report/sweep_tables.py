"""A sweep's summary as plain rows, for the terminal and for the page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from mavsitl.campaign.grid import Labels
from mavsitl.campaign.summary import MEASURES, CellSummary, Comparison, Interval, Paired, Summary
from mavsitl.report.tables import number


def cell_header(summary: Summary) -> list[str]:
    return [*short(list(summary.cells[0].labels)), "flown", *(measure.title for measure in MEASURES.values())]


def cell_rows(summary: Summary) -> list[list[str]]:
    """The cells' medians, each with its interval on a second line; how many were flown to their end."""
    return [
        [*map(shown, cell.labels.values()), flown(cell), *(_stacked(each.median) for each in cell.measures.values())]
        for cell in summary.cells
    ]


COMPARISON_HEADER = ("", "measure", "pairs", "difference", "ratio", "p")
COMPARED = ("position_m", "attitude_deg")
"""Measures that settings are compared by."""


def comparison_rows(summary: Summary) -> list[list[str]]:
    """Each comparison by each measure."""
    rows = []
    for each in summary.comparisons:
        name = "\n".join(filter(None, (versus(each), described(each.labels))))
        for measure in COMPARED:
            paired = each.measures[measure]
            what = "no pair" if paired.p_value is None else _stacked(paired.difference, signed=True)
            rows.append([
                name, MEASURES[measure].title, str(each.pairs), what, factor(paired.ratio.value),
                probability(paired.p_value),
            ])  # fmt: skip
            name = ""
    return rows


def _stacked(interval: Interval, *, signed: bool = False) -> str:
    return bounds(interval, signed=signed).replace(" [", "\n[")


def factor(value: float | None) -> str:
    """To a part in a thousand."""
    if value is None:
        return ""
    return f"{value:.3f}" if value < 10.0 else number(value)


def versus(each: Comparison) -> str:
    """``law pidnn against pid``"""
    return f"{each.key.rpartition('.')[2]} {shown(each.second)} against {shown(each.first)}"


def flown(cell: CellSummary) -> str:
    """How many of how many, and what became of the others."""
    others = [f"{count} {name}" for name, count in (("lost", cell.lost), ("failed", cell.failed)) if count]
    text = f"{cell.n - cell.lost - cell.failed} of {cell.n}"
    return f"{text} ({', '.join(others)})" if others else text


def bounds(interval: Interval, *, signed: bool = False) -> str:
    """``0.123 [0.120, 0.126]``; what a flight that was not flown to its end made is ``lost``."""
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


def short(keys: Sequence[str]) -> list[str]:
    """Each key by its last part, where no other has the same."""
    last = [key.rpartition(".")[2] for key in keys]
    return [end if last.count(end) == 1 else key for key, end in zip(keys, last, strict=True)]


def described(labels: Labels) -> str:
    """``speed_20ft_m_s = 5, law = pid``"""
    return ", ".join(f"{key} = {shown(value)}" for key, value in zip(short(list(labels)), labels.values(), strict=True))


def shown(value: Any) -> str:
    """A value as --set takes it."""
    match value:
        case str():
            return value
        case float() | int() if not isinstance(value, bool):
            return f"{value:g}"
        case _:
            return msgspec.json.encode(value).decode()


def known(value: float | None, otherwise: str = "lost") -> str:
    return otherwise if value is None else number(value)


def span(interval: Interval, said: Callable[[float | None], str] = known) -> str:
    """``0.120 to 0.126``; a dash where there is none."""
    return "–" if interval.low is None else f"{said(interval.low)} to {said(interval.high)}"


def signed(value: float | None) -> str:
    return "" if value is None else f"{'+' if value > 0.0 else ''}{number(value)}"


SURE, SLIGHT = 0.05, 5e-4


def verdict(paired: Paired) -> str:
    """``better``, ``worse``, or ``open`` where chance could have made it, or the ratio is 1 to three digits."""
    change = None if paired.ratio.value is None else paired.ratio.value - 1.0
    if paired.p_value is None or paired.p_value >= SURE or change is None or abs(change) < SLIGHT:
        return "open"
    return "better" if change < 0.0 else "worse"
