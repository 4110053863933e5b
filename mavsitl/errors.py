"""The errors whose text is for the user: a program ends with it and the error's exit code, without a traceback."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar

__all__ = ["EXIT_FAILED", "EXIT_OK", "EXIT_USAGE", "MavsitlError", "UsageError", "did_you_mean"]

EXIT_OK, EXIT_FAILED, EXIT_USAGE = 0, 1, 2


class MavsitlError(Exception):
    """What a user can read and act upon: the text names what went wrong and what to do.

    Notes (`add_note`) are further lines for the user, such as where the logs are.
    """

    exit_code: ClassVar[int] = EXIT_FAILED


class UsageError(MavsitlError, ValueError):
    """An argument, a scenario or a name that cannot be what was meant; the text says what is allowed."""

    exit_code = EXIT_USAGE


def did_you_mean(name: str, names: Iterable[str], before: str = "") -> str:
    """Of the names that exist those that look like the one that does not, as ``did you mean A, B? ``; empty: none does.

    With `before` in front the text stands at the end: ``; did you mean A, B?``. A name whose end was left out, as its
    unit, looks like it too.
    """
    from difflib import get_close_matches

    known = list(names)
    near = get_close_matches(name, known) or [each for each in known if len(name) > 2 and each.startswith(name)]
    if not near:
        return ""
    text = f"did you mean {', '.join(near)}?"
    return before + text if before else text + " "
