"""The errors whose text is for the user: a program ends with it and the error's exit code, without a traceback."""

from __future__ import annotations

from typing import ClassVar

__all__ = ["EXIT_FAILED", "EXIT_OK", "EXIT_USAGE", "MavsitlError", "UsageError"]

EXIT_OK, EXIT_FAILED, EXIT_USAGE = 0, 1, 2


class MavsitlError(Exception):
    """What a user can read and act upon: the text names what went wrong and what to do.

    Notes (`add_note`) are further lines for the user, such as where the logs are.
    """

    exit_code: ClassVar[int] = EXIT_FAILED


class UsageError(MavsitlError, ValueError):
    """An argument, a scenario or a name that cannot be what was meant; the text says what is allowed."""

    exit_code = EXIT_USAGE
