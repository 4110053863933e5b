"""Lists every code block of README.md and docs/ with what the tests do with it: ``python -m tests.docs [PAGE...]``."""

from __future__ import annotations

import sys

from tests.docs import blocks
from tests.docs.run import LANGUAGES


def fate(block: blocks.Block) -> str:
    """In a few words."""
    if "not run" in block.marks:
        return f"not run: {block.marks['not run']}"
    said = [f"{key}: {value}".rstrip(": ") for key, value in block.marks.items()]
    if block.language not in LANGUAGES and not said:
        return "an error"
    done = "nothing" if block.language == "text" and not said else "done"
    return f"{done} ({', '.join(said)})" if said else done


def main(pages: list[str]) -> int:
    for page in pages or blocks.pages():
        for block in blocks.of_page(page):
            print(f"{block.place:45s} {block.language:8s} {fate(block)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
