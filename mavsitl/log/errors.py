"""What reading and writing logs may raise; apart from the modules that do it, which load numpy."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from mavsitl.errors import EXIT_USAGE, MavsitlError


class LogError(MavsitlError, OSError):
    """A log cannot be written or read; the message names the file and the reason."""


class NoLogError(LogError):
    """What was named is no log, or has not what was asked of it; the message says what is allowed."""

    exit_code = EXIT_USAGE


Failed: TypeAlias = Callable[[LogError], None]
"""Is told that a log cannot be written any more."""
