"""The comparison with Tables 3 and 4 as plain rows, for the terminal and for the page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
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
    """Infinite for a flight that was lost: what it did before says nothing."""
    verdict: Verdict | None


def rows(ours: Rmse, paper_case: str | None, *, lost: bool = False) -> list[Row]:
    """Six rows, x to psi. `paper_case` is a key of `PAPER_TABLES`, or None. Raises KeyError for another.

    `lost`: the vehicle was, and `ours` is of the time before.
    """
    theirs = PAPER_TABLES[paper_case].values() if paper_case is not None else (None,) * 6
    return [
        _row(f"{label} / {unit}", mine, paper, lost=lost)
        for label, unit, mine, paper in zip(LABELS, UNITS, ours.values(), theirs, strict=True)
    ]


@dataclass(frozen=True)
class LinkRow:
    """One direction of an impaired link, over the whole flight; shares are of what was sent, 0 to 1."""

    link: str
    """E.g. ``off-board, to ground``."""
    sent: int
    delivered: int
    lost: float
    """By chance, for the queue was full, or corrupted."""
    outage: float
    duplicated: float
    late: float
    """Came after one that was sent later."""
    delay_p50_ms: float
    delay_p99_ms: float
    delay_max_ms: float

    def __str__(self) -> str:
        text = f"{self.link}: {self.sent} sent, {100.0 * self.lost:.1f} % lost"
        if self.outage:
            text += f", {100.0 * self.outage:.1f} % in outages"
        return f"{text}, delay {self.delay_p50_ms:.0f} ms (p99 {self.delay_p99_ms:.0f} ms)"


LINKS = {"link": "off-board", "gcs_link": "ground stations", "tcp_link": "ground stations, TCP"}
DIRECTIONS = {"to_ground": "to ground", "to_vehicle": "to vehicle"}


def link_rows(links: Mapping[str, Mapping[str, Mapping[str, float]]]) -> list[LinkRow]:
    """Of `FlightRecord.links`."""
    rows = []
    for place, directions in links.items():
        for direction, counts in directions.items():
            sent = max(counts["sent"], 1)
            rows.append(
                LinkRow(
                    link=f"{LINKS.get(place, place)}, {DIRECTIONS.get(direction, direction)}",
                    sent=int(counts["sent"]),
                    delivered=int(counts["delivered"]),
                    lost=(counts["lost"] + counts["queue_drops"] + counts["corrupted"]) / sent,
                    outage=counts["outage"] / sent,
                    duplicated=counts["duplicated"] / sent,
                    late=counts["late"] / sent,
                    delay_p50_ms=counts["delay_p50_ms"],
                    delay_p99_ms=counts["delay_p99_ms"],
                    delay_max_ms=counts["delay_max_ms"],
                )
            )
    return rows


def number(value: float) -> str:
    """Three significant digits, plain where that is readable; ``lost`` for an infinite error."""
    if value == inf:
        return "lost"
    if 100.0 <= abs(value) < 1e4:
        return f"{value:.0f}"
    return f"{value:#.3g}" if 1e-3 <= abs(value) < 100.0 else f"{value:.2e}"


def ratio(value: float) -> str:
    """Of our number to the paper's; ``lost`` for a flight that was."""
    return "lost" if value == inf else f"{value:.2f}"


def _row(state: str, ours: float, paper: float | None, *, lost: bool) -> Row:
    if paper is None:
        return Row(state, ours, None, None, None)
    if lost:
        return Row(state, ours, paper, inf, "missed")
    # The paper prints three or four digits: closer than half of the last of three is the same number.
    if abs(ours - paper) <= 5e-4 * paper:
        verdict: Verdict = "met"
    else:
        verdict = "beaten" if ours < paper else "missed"
    return Row(state, ours, paper, ours / paper, verdict)
