"""What the vehicle keeps between starts: small JSON files that are, after any crash, the old one or the new one."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable, Mapping
from itertools import count
from pathlib import Path
from typing import Any

import msgspec

from mavsitl.keep import Document
from mavsitl_vehicle.autopilot.parameters import Parameters

MAX_BYTES = 4 << 20
"""A longer file is not one of ours."""

MAX_ASIDE = 9
"""Damaged files of one name that are kept; the last gives way to the next."""

_NO_WAIT = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0) | getattr(os, "O_BINARY", 0)

Report = Callable[[str], None]
"""Takes one line for the user."""


class Store:
    """One JSON object in one file: `load` it at the start, `put` what it shall be, `take` what is to be written.

    A file that cannot be read or understood is moved aside as ``<name>.bad`` (then ``.bad-2`` and so on) and the
    vehicle starts without it. A file that cannot be written is reported once and tried again; nothing here raises on
    what the disk does. With `folder` None nothing is read or written. Times are of the wall clock.
    """

    RETRY_DELAY_US = 5_000_000

    def __init__(self, folder: Path | None, name: str, schema: int, report: Report, *, private: bool = False) -> None:
        """`schema` is the version of the content's layout; `private`: only the owner may read the file (mode 0600)."""
        self.path = None if folder is None else folder / f"{name}.json"
        self._schema = schema
        self._report = report
        self._mode = 0o600 if private else 0o644
        self._content: Mapping[str, Any] | Callable[[], Mapping[str, Any]] = {}
        self._changed = False
        self._retry_us = 0
        self._failing = False

    def load(self) -> dict[str, Any]:
        """The content; empty where there is no file, or none that can be understood."""
        if self.path is None:
            return {}
        try:
            return self._parse(_read(self.path))
        except FileNotFoundError:
            return {}
        except OSError as error:
            self.set_aside(f"cannot be read: {error.strerror or error}")
        except (ValueError, RecursionError) as error:
            self.set_aside(str(error))
        return {}

    def _parse(self, data: bytes) -> dict[str, Any]:
        if len(data) > MAX_BYTES:
            raise ValueError(f"longer than {MAX_BYTES} bytes")
        document = msgspec.json.decode(data)
        if not isinstance(document, dict) or not isinstance(document.get("content"), dict):
            raise ValueError("not a file of this vehicle")
        if document.get("schema") != self._schema:
            raise ValueError(f"schema {str(document.get('schema'))[:20]}, need {self._schema}")
        content: dict[str, Any] = document["content"]
        return content

    def set_aside(self, reason: str) -> None:
        """Whatever is in the file's place gets another name, so that it can be looked at and is not written over."""
        assert self.path is not None
        aside = _free_name(self.path)
        try:
            self.path.rename(aside)
        except OSError as error:
            kept = f"cannot be moved aside: {error.strerror or error}"
        else:
            kept = f"kept as {aside.name}"
        self._report(f"{self.path}: damaged ({reason}), the defaults hold; {kept}")

    def put(self, content: Mapping[str, Any] | Callable[[], Mapping[str, Any]]) -> None:
        """What the file shall hold from now on: JSON, or what makes it when it is taken. NaN is kept as null."""
        self._content = content
        self._changed = self.path is not None

    def take(self, now_us: int) -> Document | None:
        """What is to be written, once; None where nothing has changed, or writing failed a moment ago."""
        if not self._changed or self.path is None or now_us < self._retry_us:
            return None
        self._changed = False
        content = self._content() if callable(self._content) else self._content
        text = msgspec.json.encode({"schema": self._schema, "content": content}, order="sorted")
        return Document(self.path, msgspec.json.format(text, indent=1) + b"\n", self._mode)

    def written(self, error: OSError | None, now_us: int) -> None:
        """What became of what was taken."""
        if error is None:
            self._failing = False
            return
        self._changed = True
        self._retry_us = now_us + self.RETRY_DELAY_US
        if not self._failing:
            self._failing = True
            self._report(f"{self.path}: cannot be written: {error.strerror or error}")


def _read(path: Path) -> bytes:
    """At most one byte more than allowed of a plain file, symbolic links followed; never waits, as on a pipe it would.

    Raises `OSError`.
    """
    descriptor = os.open(path, os.O_RDONLY | _NO_WAIT)
    with os.fdopen(descriptor, "rb") as file:
        kind = os.fstat(descriptor).st_mode
        if not stat.S_ISREG(kind):
            raise OSError(errno.EISDIR if stat.S_ISDIR(kind) else errno.EINVAL, "not a plain file")
        return file.read(MAX_BYTES + 1)


def _free_name(path: Path) -> Path:
    for number in count(1):
        aside = path.with_name(f"{path.name}.bad" if number == 1 else f"{path.name}.bad-{number}")
        if number == MAX_ASIDE or not os.path.lexists(aside):
            return aside
    raise AssertionError("counted to the end")


def keep_parameters(parameters: Parameters, folder: Path | None, report: Report) -> Store:
    """Read the parameters that were set in an earlier run, and keep those that are set from now on.

    The file holds what differs from the defaults of airframe and scenario. The caller takes from the store.
    """
    store = Store(folder, "parameters", 1, report)
    texts = parameters.restore(store.load())
    for text in texts[:MAX_TEXTS]:
        report(f"{store.path}: left out: {text}")
    if len(texts) > MAX_TEXTS:
        report(f"{store.path}: left out: {len(texts) - MAX_TEXTS} more")
    parameters.subscribe(lambda name, value: store.put(parameters.changed))
    return store


MAX_TEXTS = 5
"""Lines about single values of a file; the rest is counted."""
