"""One self-contained page for a sweep: no script, no font, no picture from elsewhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from mavsitl.campaign.fly import Row
from mavsitl.campaign.summary import MEASURES, Summary
from mavsitl.keep import replace_file
from mavsitl.report import sweep_figures, sweep_tables
from mavsitl.report.figures import with_ids
from mavsitl.report.html import REPORT_FILE, template
from mavsitl.report.run import RunError

MOST_LOST = 100
"""Flights that were not flown to their end, listed one by one."""


def write(folder: Path, rows: Sequence[Row], summary: Summary, keys: Sequence[str], facts: Mapping[str, str]) -> Path:
    """Write report.html into the folder and return its path. `facts`: `sweep.metadata`. Raises `RunError`."""
    path = folder / REPORT_FILE
    page = render(rows, summary, keys, facts)
    try:
        replace_file(path, page.encode())
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def render(rows: Sequence[Row], summary: Summary, keys: Sequence[str], facts: Mapping[str, str]) -> str:
    """The page as text."""
    gone = [row for row in rows if not row.flown]
    drawings = sweep_figures.drawings(rows, summary, keys)
    return template("sweep.html.j2").render(
        name=rows[0].scenario,
        rows=rows,
        gone=gone[:MOST_LOST],
        unlisted=max(len(gone) - MOST_LOST, 0),
        lost=sum(row.status == "lost" for row in rows),
        failed=sum(row.status == "failed" for row in rows),
        summary=summary,
        keys=keys,
        facts=facts,
        measures=MEASURES,
        compared=sweep_tables.COMPARED,
        drawings=[(with_ids(each.svg, f"f{index}-"), each) for index, each in enumerate(drawings)],
        undrawn=len(summary.cells) > sweep_figures.MOST_ROWS,
        tables=sweep_tables,
    )
