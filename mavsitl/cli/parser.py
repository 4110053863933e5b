"""The parser of every command: mistakes become errors that say what was meant, help fits the terminal."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from itertools import groupby
from typing import Any, NoReturn

from mavsitl.errors import UsageError, did_you_mean

__all__ = ["Formatter", "ParseError", "Parser"]

WIDEST = 110
"""Columns of help on a wide terminal: longer lines are hard to read."""

_TWO_COLUMNS = re.compile(r"(?P<left> +\S.*?)(?P<gap> {2,})(?P<right>\S.*)")
"""An example or a term, with what it means behind it."""


class ParseError(UsageError):
    """Arguments that the parser does not take; `prog` is the command whose parser it was, as it is called."""

    def __init__(self, prog: str, text: str) -> None:
        super().__init__(text)
        self.prog = prog
        self.add_note(f"{prog} --help says what it takes")


class Formatter(argparse.RawDescriptionHelpFormatter):
    """Paragraphs are filled to the width of the terminal; indented lines, such as examples, stay lines."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=32, width=WIDEST)

    def format_help(self) -> str:
        # The terminal is looked at here: argparse makes a formatter for each option, and most runs show no help.
        import shutil

        self._width = min(shutil.get_terminal_size().columns, WIDEST)
        return super().format_help()

    def _format_action(self, action: argparse.Action) -> str:
        if not isinstance(action, argparse._SubParsersAction):
            return super()._format_action(action)
        return "".join(map(super()._format_action, action._get_subactions()))  # without a line for all of them

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return "\n".join(indent + line for line in _filled(text, width - len(indent)))


def _filled(text: str, width: int) -> Iterator[str]:
    """The lines of a text at that width."""
    for line in _logical(text):
        if not line.startswith(" "):
            yield from _wrapped(line, width) or [""]
        else:
            yield from _hanging(line, width)


def _logical(text: str) -> Iterator[str]:
    """Paragraphs and indented lines, each as one; what is indented far goes on with the line above."""
    for kind, lines in groupby(text.splitlines(), lambda line: (not line) + 2 * line.startswith(" ")):
        if kind == 0:
            yield " ".join(lines)
        else:
            yield from re.sub(r"\n {6,}(?=\S)", " ", "\n".join(lines)).split("\n")


def _wrapped(text: str, width: int) -> list[str]:
    import textwrap

    return textwrap.wrap(text, width, break_on_hyphens=False, break_long_words=False)


def _hanging(line: str, width: int) -> list[str]:
    """An indented line; where it is too long its second column is wrapped, or begins below."""
    columns = _TWO_COLUMNS.fullmatch(line)
    if len(line) <= width or columns is None:
        return [line]
    left, right = columns["left"], columns["right"]
    column = len(left) + len(columns["gap"])
    below = len(left) + 2 > width // 2
    if below or column > width // 2:
        column = len(left) - len(left.lstrip()) + 4 if below else len(left) + 2
    filled = _wrapped(right, width - column)
    behind = [" " * column + each for each in filled]
    return [left, *behind] if below else [left.ljust(column) + filled[0], *behind[1:]]


class Parser(argparse.ArgumentParser):
    """Raises `ParseError` in place of an exit, with what was probably meant. An option is written in full."""

    def __init__(self, *args: Any, **keywords: Any) -> None:
        keywords.setdefault("formatter_class", Formatter)
        keywords.setdefault("allow_abbrev", False)
        super().__init__(*args, **keywords)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:  # found here, not by the parser above it, which does not know our options
            self.error("; ".join(map(self._not_taken, unknown)))
        return options, unknown

    def error(self, message: str) -> NoReturn:
        raise ParseError(self.prog, message)

    def _not_taken(self, text: str) -> str:
        if not text.startswith("-"):
            return f"{text!r}: one argument too many"
        option = text.partition("=")[0]
        return f"{option}: no such option{did_you_mean(option, self._option_string_actions, '; ')}"

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            meant = did_you_mean(f"{value}", action.choices)
            allowed = ", ".join(map(str, action.choices))
            raise argparse.ArgumentError(action, f"{value!r} is not allowed; {meant}allowed: {allowed}")
