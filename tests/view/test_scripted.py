"""The demonstration by script in its short form: take-off, a gust, landing, each by its button and seen on the page."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.view import scripted
from tests.view.browser import program

pytestmark = [
    pytest.mark.sockets,
    pytest.mark.skipif(program() is None, reason="no Chromium here"),
]


def test_a_demonstration_is_given(tmp_path: Path) -> None:
    assert scripted.main(["--short", "--pictures", str(tmp_path)]) == 0
    pictures = sorted(path.name for path in tmp_path.iterdir())
    assert pictures == ["01-gust.png", "02-landed.png"]
