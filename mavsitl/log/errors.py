"""What reading and writing logs may raise; apart from the modules that do it, which load numpy."""

from __future__ import annotations


class LogError(OSError):
    """A log cannot be written or read; the message names the file and the reason."""
