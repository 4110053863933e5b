"""What a person sees: consoles, lines of text, progress. It loads rich, so it is imported where something is shown."""

from __future__ import annotations

import os
from collections.abc import Collection

from rich import box
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

__all__ = ["console", "flight_progress", "flights_progress", "line", "table"]

PIPED_WIDTH = 120
"""Columns of a table in a file or a pipe, where COLUMNS says nothing else."""


def console(*, stderr: bool = False) -> Console:
    """Of stdout, or of stderr where stdout is for a program. It gives numbers and paths no colours of its own."""
    made = Console(stderr=stderr, highlight=False)
    if not made.is_terminal and "COLUMNS" not in os.environ:
        made.width = PIPED_WIDTH
    return made


def line(to: Console, text: str, style: str | None = None) -> None:
    """A text as it is: brackets are no markup, and a path is not broken where the terminal ends."""
    to.print(text, style=style, soft_wrap=True, markup=False)


def table(*columns: str, title: str = "", right: Collection[str] = (), whole: Collection[str] = ()) -> Table:
    """`right`: the columns of numbers; `whole`: those that are not broken and not cut, however narrow the terminal."""
    made = Table(
        title=title or None, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    for name in columns:
        made.add_column(name, justify="right" if name in right else "left", no_wrap=name in whole, overflow="fold")
    return made


def flight_progress(to: Console) -> Progress:
    """Of single flights, a task each, counted in seconds; its field `said` is what the flight says last."""
    said = TextColumn("{task.fields[said]}")
    columns = (TextColumn("{task.description}"), BarColumn(), said, TimeElapsedColumn())
    return Progress(*columns, console=to, disable=not to.is_terminal)


def flights_progress() -> Progress:
    """Of many flights, one task, on stderr; its field `said` is what came of them so far."""
    to = console(stderr=True)
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(*columns, TextColumn("{task.fields[said]}"), console=to, disable=not to.is_terminal)
