"""What a person sees: consoles, lines of text, progress. It loads rich, so it is imported where something is shown."""

from __future__ import annotations

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

__all__ = ["console", "flight_progress", "flights_progress", "line"]


def console(*, stderr: bool = False) -> Console:
    """Of stdout, or of stderr where stdout is for a program. It gives numbers and paths no colours of its own."""
    return Console(stderr=stderr, highlight=False)


def line(to: Console, text: str, style: str | None = None) -> None:
    """A text as it is: brackets are no markup, and a path is not broken where the terminal ends."""
    to.print(text, style=style, soft_wrap=True, markup=False)


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
