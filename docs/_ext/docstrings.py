"""What autodoc makes of the docstrings, put right for a reader.

What stands indented below a colon is a formula or a program, and stays as it is. Aliases of types go by their names.
What Python itself writes about named tuples is left out.
"""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.typing import ExtensionMetadata

_ALIAS = re.compile(r"TypeAliasForwardRef\('(\w+)'\)")
_before: dict[str, list[str]] = {}
"""Docstrings of attributes, by name, as they are before napoleon."""
_FIELD, _NEW = "Alias for field number", "Create new instance of"
"""What Python says of a named tuple's fields, and of how one is made."""


def keep_lines(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Make `text:`, an empty line and an indented block a literal block; a block that is one already stays one."""
    for index, (line, empty, below) in enumerate(zip(lines, lines[1:], lines[2:], strict=False)):
        indented = len(below) - len(below.lstrip()) > len(line) - len(line.lstrip())
        if line.endswith(":") and not line.endswith("::") and not empty.strip() and below.strip() and indented:
            lines[index] = line + ":"
    if lines and lines[0].startswith(_FIELD):
        lines.clear()
    if what in ("attribute", "data", "property"):
        _before[name] = list(lines)


def after_napoleon(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Give an attribute its text back, of which napoleon takes what stands before a colon for a type."""
    if name in _before:
        lines[:] = _before.pop(name)


def name_aliases(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Of `autodoc_type_aliases`, within other types too."""
    shown, result = (None if text is None else _ALIAS.sub(r"\1", text) for text in (signature, returned))
    return shown, result


def skip(app: Sphinx, what: str, name: str, obj: Any, skipped: bool, options: Any) -> bool | None:
    return True if str(getattr(obj, "__doc__", "")).startswith(_NEW) else None


def setup(app: Sphinx) -> ExtensionMetadata:
    # Before napoleon, which is at 500: its own sections are not yet there.
    app.connect("autodoc-process-docstring", keep_lines, priority=400)
    app.connect("autodoc-process-docstring", after_napoleon, priority=600)
    app.connect("autodoc-process-signature", name_aliases)
    app.connect("autodoc-skip-member", skip)
    return {"version": "1", "parallel_read_safe": True}
