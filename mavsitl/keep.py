"""What outlives the process: files replaced in one move, and a thread that writes them beside the control loop.

A core says what is `unsaved` and is told what became of it; it opens no file. A write with fsync takes 5 to 12 ms on a
usual disk, which is one to three control periods, so a real-time driver gives it to a `Keeper`. All times here are of
the wall clock, whatever the speed of the simulation: what a client was told is kept has to be on the disk a moment
later on the client's clock.
"""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any, Protocol

__all__ = ["INTERVAL_US", "Document", "Keeper", "Keeping", "Work", "carry_out", "replace_file"]

INTERVAL_US = 100_000
"""Wall clock between two looks for what is unsaved, after one that found something. With the write itself this bounds
what a kill can cost; the promise is half a second."""

_EVER_US = sys.maxsize


class Work(Protocol):
    """Something to be put on the disk."""

    def write(self) -> None:
        """Do it; on any thread. Raises `OSError`."""


@dataclass(frozen=True, eq=False)
class Document:
    """A file and all that shall be in it."""

    path: Path
    data: bytes
    mode: int = 0o644

    def write(self) -> None:
        """See `replace_file`; the folder is made where it is missing."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(self.path, self.data, self.mode)


class Keeping(Protocol):
    """A core that has something to keep."""

    def unsaved(self, now_us: int) -> Sequence[Work]:
        """What is to be written now; the same is not handed out again before `saved` was told that it failed.

        `now_us` is wall time: what has just failed is held back for a while.
        """

    def saved(self, work: Work, error: OSError | None, now_us: int) -> None:
        """What became of it."""


def carry_out(core: Keeping, now_us: int = _EVER_US) -> None:
    """Write here and now what is unsaved: at the end, or where no clock runs. By default nothing is held back."""
    for work in core.unsaved(now_us):
        core.saved(work, _write(work), now_us)


class Keeper:
    """Writes what a core has unsaved, on a thread of its own; `step` it often, it costs next to nothing.

    One batch is on its way at a time, so files are written in the order of their changes, and what changes meanwhile
    is written at once afterwards.
    """

    def __init__(self, core: Keeping) -> None:
        self._core = core
        self._todo: SimpleQueue[Sequence[Work] | None] = SimpleQueue()
        self._done: deque[tuple[Work, OSError | None]] = deque()
        self._under_way = 0
        self._next_us = 0
        self._thread: Thread | None = None

    def step(self, now_us: int) -> None:
        """Hand over what is unsaved, and tell the core what was written. `now_us`: wall time."""
        if self._under_way:
            self._tell(now_us)
        if self._under_way or now_us < self._next_us:
            return
        batch = self._core.unsaved(now_us)
        if batch:
            self._next_us = now_us + INTERVAL_US
            self._under_way = len(batch)
            if self._thread is None:
                self._thread = Thread(target=self._run, name="keeper", daemon=True)
                self._thread.start()
            self._todo.put(batch)

    def close(self, now_us: int) -> None:
        """All that is unsaved is on the disk, or was tried, when this returns."""
        if self._thread is not None:
            self._todo.put(None)
            self._thread.join()
            self._thread = None
        self._tell(now_us)
        carry_out(self._core)

    def _tell(self, now_us: int) -> None:
        while self._done:
            work, error = self._done.popleft()
            self._under_way -= 1
            self._core.saved(work, error, now_us)

    def _run(self) -> None:
        while (batch := self._todo.get()) is not None:
            for work in batch:
                self._done.append((work, _write(work)))


def _write(work: Work) -> OSError | None:
    try:
        work.write()
    except OSError as error:
        return error
    return None


def replace_file(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Replace `path` in one move: whoever reads it, and whenever the power goes, finds the old or the new bytes.

    What is at `path` is replaced itself: a symbolic link is not followed. Raises `OSError`, and then the old bytes are
    there.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    with suppress(FileNotFoundError):
        temporary.unlink()  # of a process that was killed; its mode may be another
    # A file that is there again by now is not ours to write: O_EXCL follows no link either.
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), mode)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    if hasattr(os, "O_DIRECTORY"):  # the move itself is on the disk only with its folder
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            with suppress(OSError):  # some file systems cannot; the file is whole there too
                os.fsync(folder)
        finally:
            os.close(folder)


def replace_json(path: Path, value: Any) -> None:
    """As `replace_file`, with a struct, a dictionary or a list as indented JSON."""
    import msgspec

    replace_file(path, msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n")
