"""The comparison with Tables 3 and 4 as plain rows, for the terminal and for the page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from mavsitl.report.metrics import LABELS, PAPER_TABLES, UNITS, Rmse

Verdict: TypeAlias = Literal["beaten", "met", "missed"]

SYMBOLS: dict[Verdict, str] = {"beaten": "▼", "met": "=", "missed": "▲"}
"""Below, at, above the paper's number."""


@dataclass(frozen=True)
class Row:
    """One state: our RMSE, the paper's and their ratio; the last three are None where the paper has no such flight."""

    state: str
    """E.g. ``x / m``."""
    ours: float
    paper: float | None
    ratio: float | None
    verdict: Verdict | None


def rows(ours: Rmse, paper_case: str | None) -> list[Row]:
    """Six rows, x to psi. `paper_case` is a key of `PAPER_TABLES`, or None. Raises KeyError for another."""
    theirs = PAPER_TABLES[paper_case].values() if paper_case is not None else (None,) * 6
    return [
        _row(f"{label} / {unit}", mine, paper)
        for label, unit, mine, paper in zip(LABELS, UNITS, ours.values(), theirs, strict=True)
    ]


def number(value: float) -> str:
    """Three significant digits, plain where that is readable."""
    if 100.0 <= abs(value) < 1e4:
        return f"{value:.0f}"
    return f"{value:#.3g}" if 1e-3 <= abs(value) < 100.0 else f"{value:.2e}"


def _row(state: str, ours: float, paper: float | None) -> Row:
    if paper is None:
        return Row(state, ours, None, None, None)
    # The paper prints three or four digits: closer than half of the last of three is the same number.
    if abs(ours - paper) <= 5e-4 * paper:
        verdict: Verdict = "met"
    else:
        verdict = "beaten" if ours < paper else "missed"
    return Row(state, ours, paper, ours / paper, verdict)
