"""The code blocks of README.md and of the pages in docs/, found by the parser that also builds the pages."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from markdown_it.renderer import RendererHTML
from myst_parser.config.main import MdParserConfig
from myst_parser.parsers.mdit import create_md_parser

ROOT = Path(__file__).resolve().parents[2]

MARKS = ("not run", "file", "fragment of", "beside", "exit", "output")
"""What a comment before a block may say of it; docs/explanation/documentation.md has what each means."""

_DIRECTIVE = re.compile(r"\{([\w-]+)\}\s*(.*)")
_COMMENT = re.compile(r"\A<!--(.*?)-->\s*\Z", re.S)
_CODE_DIRECTIVES = ("code-block", "code", "sourcecode")
_WITH_CONTENT = (
    "note",
    "tip",
    "warning",
    "important",
    "hint",
    "caution",
    "attention",
    "tab-set",
    "tab-item",
    "dropdown",
)
_PARSER: Any = create_md_parser(MdParserConfig(enable_extensions={"colon_fence", "deflist"}), RendererHTML)


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        page: path below the project's root, with slashes.
        line: of the opening fence, from 1.
        language: first word behind the fence, or the argument of a code directive; "" without one.
        text: what is between the fences, dedented.
        marks: what the comment before it says, by key of `MARKS`.
    """

    page: str
    line: int
    language: str
    text: str
    marks: dict[str, str] = field(default_factory=dict)

    @property
    def place(self) -> str:
        return f"{self.page}:{self.line}"


def pages(root: Path = ROOT) -> list[str]:
    """README.md and every page below docs/, by path from `root`."""
    found = sorted(path for path in (root / "docs").rglob("*.md") if "_build" not in path.parts)
    return ["README.md", *(path.relative_to(root).as_posix() for path in found)]


def of_page(page: str, root: Path = ROOT) -> list[Block]:
    return list(find((root / page).read_text("utf-8"), page))


def find(text: str, page: str, first_line: int = 1) -> Iterator[Block]:
    """The blocks of one page, in order; those within admonitions and tabs too."""
    marks: dict[str, str] = {}
    for token in _PARSER.parse(text):
        if token.type in ("myst_line_comment", "html_block"):
            marks = read_marks(token.content)
            continue
        if token.type not in ("fence", "colon_fence"):
            marks = {}
            continue
        line = first_line + token.map[0]
        directive = _DIRECTIVE.match(token.info.strip())
        if directive is None:
            language = token.info.strip().split(" ")[0] if token.type == "fence" else ""
            yield Block(page, line, language, token.content, marks)
        elif directive[1] in _CODE_DIRECTIVES:
            yield Block(page, line, directive[2].strip(), _without_options(token.content), marks)
        elif directive[1] in _WITH_CONTENT:
            yield from find(token.content, page, line + 1)
        marks = {}


def read_marks(comment: str) -> dict[str, str]:
    """`key: value` in each line of a comment; other lines are for people."""
    html = _COMMENT.match(comment)
    found = {}
    for line in (html[1] if html else comment).splitlines():
        key, colon, value = line.strip().partition(":")
        if (colon and key in MARKS) or (key in MARKS and key == "output"):
            found[key] = value.strip()
    return found


def _without_options(content: str) -> str:
    lines = content.splitlines(keepends=True)
    while lines and re.match(r":[\w-]+:", lines[0]):
        lines.pop(0)
    return "".join(lines).lstrip("\n")
