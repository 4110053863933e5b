"""Rows of what is demanded and what was measured, and a progress bar: what the programs of this folder print."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table


@dataclass
class Report:
    """Demands and figures, in the order they were measured."""

    title: str
    rows: list[tuple[str, str, str, bool]] = field(default_factory=list)

    def demand(self, what: str, demanded: str, measured: object, met: bool) -> bool:
        shown = f"{measured:.3g}" if isinstance(measured, float) else str(measured)
        self.rows.append((what, demanded, shown, met))
        return met

    @property
    def failures(self) -> list[str]:
        return [f"{what}: {measured}, demanded {demanded}" for what, demanded, measured, met in self.rows if not met]

    def print(self) -> int:
        """The table; the exit code."""
        table = Table("what", "demanded", "measured", "", title=self.title)
        for what, demanded, measured, met in self.rows:
            table.add_row(what, demanded, measured, "[green]met[/]" if met else "[red]MISSED[/]")
        Console(width=140).print(table)
        return 1 if self.failures else 0


class Bar:
    """Moves a bar on a terminal; elsewhere nothing."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress = progress
        self._task = None if progress is None else progress.add_task("", total=total)

    def move(self, steps: int = 1, said: str = "") -> None:
        if self._progress is not None and self._task is not None:
            self._progress.update(self._task, advance=steps, description=said)


@contextmanager
def bar(total: int, *, show: bool = True) -> Iterator[Bar]:
    console = Console(stderr=True)
    if not (show and console.is_terminal):
        yield Bar(None, total)
        return
    columns = (TextColumn("{task.description:28s}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with Progress(*columns, TimeElapsedColumn(), console=console) as progress:
        yield Bar(progress, total)
