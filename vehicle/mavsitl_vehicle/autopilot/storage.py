"""What the vehicle keeps between starts: small JSON files that are, after any crash, the old one or the new one."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from mavsitl_vehicle.autopilot.parameters import Parameters

MAX_BYTES = 4 << 20
"""A longer file is not one of ours."""

Report = Callable[[str], None]
"""Takes one line for the user."""


class Store:
    """One JSON object in one file, written behind: `put` it, `step` with the time, `close` at the end.

    A file that cannot be understood is moved aside as ``<name>.bad`` and the vehicle starts without it. A file that
    cannot be written is reported once and tried again; nothing here raises on what the disk does. With `folder` None
    nothing is read or written.
    """

    WRITE_DELAY_US = 200_000
    """From a change to the file, in simulated time: what changes meanwhile is written at once."""
    RETRY_DELAY_US = 5_000_000

    def __init__(self, folder: Path | None, name: str, schema: int, report: Report, *, private: bool = False) -> None:
        """`schema` is the version of the content's layout; `private`: only the owner may read the file (mode 0600)."""
        self.path = None if folder is None else folder / f"{name}.json"
        self._schema = schema
        self._report = report
        self._mode = 0o600 if private else 0o644
        self._pending: Mapping[str, Any] | Callable[[], Mapping[str, Any]] | None = None
        self._due_us: int | None = None
        """When to write; None: at the first step that sees the change."""
        self._failing = False

    def load(self) -> dict[str, Any]:
        """The content; empty where there is no file, or none that can be understood."""
        if self.path is None:
            return {}
        try:
            with self.path.open("rb") as file:
                data = file.read(MAX_BYTES + 1)
        except FileNotFoundError:
            return {}
        except OSError as error:
            self._report(f"{self.path}: cannot be read, the defaults hold: {error.strerror or error}")
            return {}
        try:
            return self._parse(data)
        except (ValueError, RecursionError) as error:
            self.set_aside(str(error) or "nested too deeply")
            return {}

    def _parse(self, data: bytes) -> dict[str, Any]:
        if len(data) > MAX_BYTES:
            raise ValueError(f"longer than {MAX_BYTES} bytes")
        document = json.loads(data.decode("utf-8"), parse_constant=_no_constant)
        if not isinstance(document, dict) or not isinstance(document.get("content"), dict):
            raise ValueError("not a file of this vehicle")
        if document.get("schema") != self._schema:
            raise ValueError(f"schema {str(document.get('schema'))[:20]}, need {self._schema}")
        content: dict[str, Any] = document["content"]
        return content

    def set_aside(self, reason: str) -> None:
        assert self.path is not None
        aside = self.path.with_name(f"{self.path.name}.bad")
        try:
            self.path.replace(aside)
        except OSError as error:
            kept = f"cannot be moved aside: {error.strerror or error}"
        else:
            kept = f"kept as {aside.name}"
        self._report(f"{self.path}: damaged ({reason}), the defaults hold; {kept}")

    def put(self, content: Mapping[str, Any] | Callable[[], Mapping[str, Any]]) -> None:
        """What the file shall hold from now on: JSON that does not change afterwards, or what makes it at the time."""
        if self.path is not None:
            self._pending = content

    def step(self, now_us: int) -> None:
        """Write what is due. A change is on the disk within `WRITE_DELAY_US` and one step."""
        if self._pending is None:
            return
        if self._due_us is None:
            self._due_us = now_us + self.WRITE_DELAY_US
        elif now_us >= self._due_us:
            self._due_us = None if self.flush() else now_us + self.RETRY_DELAY_US

    def flush(self) -> bool:
        """Write now what is not written yet. False where that fails; it stays to be written."""
        if self._pending is None or self.path is None:
            return True
        content = self._pending() if callable(self._pending) else self._pending
        document = {"schema": self._schema, "content": content}
        data = (json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n").encode("utf-8")
        try:
            _write(self.path, data, self._mode)
        except OSError as error:
            if not self._failing:
                self._report(f"{self.path}: cannot be written: {error.strerror or error}")
            self._failing = True
            return False
        self._failing = False
        self._pending = None
        return True

    def close(self) -> None:
        """Write what is left."""
        self.flush()
        self._due_us = None


def _no_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is not JSON")


def _write(path: Path, data: bytes, mode: int) -> None:
    """Replace `path` in one move: whoever reads it, and whenever the power goes, finds the old or the new bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
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


def keep_parameters(parameters: Parameters, folder: Path | None, report: Report) -> Store:
    """Read the parameters that were set in an earlier run, and keep those that are set from now on.

    The file holds what differs from the defaults of airframe and scenario. The caller steps and closes the store.
    """
    store = Store(folder, "parameters", 1, report)
    texts = parameters.restore(store.load())
    for text in texts[:MAX_TEXTS]:
        report(f"{store.path}: left out: {text}")
    if len(texts) > MAX_TEXTS:
        report(f"{store.path}: left out: {len(texts) - MAX_TEXTS} more")
    parameters.subscribe(lambda name, value: store.put(parameters.changed()))
    return store


MAX_TEXTS = 5
"""Lines about single values of a file; the rest is counted."""
