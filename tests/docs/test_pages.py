"""Every code block of README.md and docs/ does what its page says."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.docs import blocks
from tests.docs.run import PageRun


@pytest.mark.sockets
@pytest.mark.parametrize("page", [page for page in blocks.pages() if blocks.of_page(page)])
def test_a_page(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "110")
    monkeypatch.setenv("NO_COLOR", "1")
    run = PageRun(tmp_path)
    for block in blocks.of_page(page):
        run.run(block)
    if run.missing:
        pytest.skip(f"not installed: {', '.join(sorted(set(run.missing)))}")
