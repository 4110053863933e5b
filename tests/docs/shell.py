"""The commands of a `sh` or `console` block, and what the page shows of their output."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass

_SEPARATORS = {";", "&&", "||", "|", "&"}
_NUMBER = re.compile(r"(?<![A-Za-z_])[-+]?\d+(?:[.,]\d+)*(?:e[-+]?\d+)?")
_FRAME = re.compile(r"[─━│┃┌┐└┘├┤┬┴┼┏┓┗┛┡┩╇╈╷╵╴╶\s]+")


@dataclass
class Command:
    """One program with its arguments.

    Attributes:
        line: within the block, from 0.
        environment: what is set before it, `NAME=value`.
        words: the program and its arguments, unquoted.
        shown: the output that the page shows below it; "" where it shows none.
    """

    line: int
    environment: list[str]
    words: list[str]
    shown: str = ""

    @property
    def program(self) -> str:
        """`mavsitl` by whatever path."""
        if len(self.words) > 2 and self.words[0].startswith("python") and self.words[1:3] == ["-m", "mavsitl"]:
            return "mavsitl"
        return self.words[0].rpartition("/")[2]

    @property
    def arguments(self) -> list[str]:
        is_module = self.program == "mavsitl" and self.words[0].startswith("python")
        return self.words[3:] if is_module else self.words[1:]


def commands(text: str, language: str) -> list[Command]:
    """Those of a block. In a `console` block they stand behind `$ `, and what follows is what they print."""
    found: list[Command] = []
    for number, line in _lines(text):
        if language == "console" and not line.startswith("$ "):
            if found:
                found[-1].shown += line + "\n"
            continue
        found += _split(number, line.removeprefix("$ ") if language == "console" else line)
    return found


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines, with those that end in a backslash joined to the next."""
    first = 0
    parts: list[str] = []
    for number, line in enumerate(text.splitlines()):
        first = first if parts else number
        parts.append(line.removesuffix("\\").strip() if parts else line.removesuffix("\\"))
        if not line.endswith("\\"):
            yield first, " ".join(parts)
            parts = []


def _split(number: int, line: str) -> Iterator[Command]:
    lexer = shlex.shlex(line, posix=True, punctuation_chars=";&|")
    lexer.whitespace_split = True
    words: list[str] = []
    for word in [*lexer, ";"]:
        if word not in _SEPARATORS:
            words.append(word)
            continue
        environment = []
        while words and re.match(r"[A-Za-z_]\w*=", words[0]):
            environment.append(words.pop(0))
        if words:
            yield Command(number, environment, words)
        words = []


def differs(shown: str, printed: str) -> str:
    """How what is printed is not what is shown; "" where it is.

    Numbers may be others, runs of white space and the frames of tables are one space, `...` stands for anything.
    """
    pattern = ".*?".join(re.escape(_plain(piece)) for piece in shown.split("..."))
    if re.search(pattern, _plain(printed), re.S):
        return ""
    return f"shown:\n{shown}\nprinted:\n{printed}"


def _plain(text: str) -> str:
    return _FRAME.sub(" ", _NUMBER.sub("#", text)).strip()
