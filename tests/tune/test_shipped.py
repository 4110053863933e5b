"""The shipped gains are those that the page about them says the search found."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import pytest

from mavsitl.scenario import load

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "tuning.md"
ROW = re.compile(r"^\| `(controller\.[\w.]+)` \| [^|]+ \| ([^|]+) \| [^|]+ \| ([^|]+) \|$", re.MULTILINE)
"""A key, set by hand and shipped, on the paper's airframe and on the realistic one."""


@pytest.mark.parametrize(("scenario", "column"), [("hover-wind", 1), ("hover-wind-realistic", 2)])
def test_the_page_has_the_shipped_gains(scenario: str, column: int) -> None:
    controller = msgspec.to_builtins({"controller": load(scenario).scenario.controller})
    rows = [match.groups() for match in ROW.finditer(PAGE.read_text("utf-8"))]
    assert len(rows) > 10
    for row in rows:
        value = controller
        for part in row[0].split("."):
            value = value[part]
        shipped = value[0] if isinstance(value, list | tuple) else value
        assert float(row[column]) == shipped, row[0]
