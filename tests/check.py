"""Everything that CI holds the project to, in one program: ``python -m tests.check [--only NAME] [--fix]``.

Runs every step even after a failure, prints the output of those that fail, and ends with a table and exit code 0 or 1.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

ROOT = Path(__file__).resolve().parent.parent
SCRIPTS = Path(sys.executable).parent
"""The console scripts of this interpreter's environment, which need not be the one on PATH."""


@dataclass(frozen=True)
class Step:
    name: str
    command: tuple[str, ...]
    fix: tuple[str, ...] | None = None
    """What ``--fix`` runs in place of `command`."""
    live: bool = False
    """Output is shown as it comes, whatever the result."""


STEPS = (
    Step("format", ("-m", "ruff", "format", "--check"), fix=("-m", "ruff", "format")),
    Step("lint", ("-m", "ruff", "check"), fix=("-m", "ruff", "check", "--fix")),
    Step("types", ("-m", "mypy")),
    Step("types-docs", ("-m", "mypy", "docs/conf.py", "docs/_ext")),
    Step("imports", (str(SCRIPTS / "lint-imports"), "--no-cache")),
    # -E: no doctree from an earlier build stands in for a page that is gone.
    Step("docs", ("-m", "sphinx", "-W", "--keep-going", "-E", "-q", "-b", "html", "docs", "docs/_build")),
    # Last, so that pytest's own closing line stands just above the table.
    Step("tests", ("-m", "pytest", "-n", "2"), live=True),
)


@dataclass(frozen=True)
class Outcome:
    name: str
    returncode: int
    seconds: float

    @property
    def passed(self) -> bool:
        return self.returncode == 0


def run(step: Step, *, fix: bool) -> Outcome:
    """Run one step from the project's root; its output goes to stdout if it is `live` or fails."""
    arguments = step.fix if fix and step.fix is not None else step.command
    print(f"== {step.name}: {' '.join(arguments)}", flush=True)
    start = perf_counter()
    result = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        stdout=None if step.live else subprocess.PIPE,
        stderr=None if step.live else subprocess.STDOUT,
        check=False,
    )
    seconds = perf_counter() - start
    if result.returncode and not step.live:
        sys.stdout.flush()
        sys.stdout.buffer.write(result.stdout)
        sys.stdout.buffer.flush()
    return Outcome(step.name, result.returncode, seconds)


def table(outcomes: Sequence[Outcome]) -> str:
    """One line a step: name, result, seconds."""
    width = max(len(outcome.name) for outcome in outcomes)
    return "\n".join(
        f"{outcome.name:<{width}}  {'ok' if outcome.passed else f'FAILED ({outcome.returncode})':<12}"
        f"{outcome.seconds:8.1f} s"
        for outcome in outcomes
    )


def main(argv: Sequence[str] | None = None, steps: Sequence[Step] = STEPS) -> int:
    names = [step.name for step in steps]
    parser = argparse.ArgumentParser(prog="python -m tests.check", description="Run the project's checks.")
    parser.add_argument(
        "--only", metavar="NAME", action="append", choices=names, help=f"one of {', '.join(names)}; repeatable"
    )
    parser.add_argument("--fix", action="store_true", help="let ruff rewrite files instead of reporting them")
    options = parser.parse_args(argv)
    outcomes = [run(step, fix=options.fix) for step in steps if options.only is None or step.name in options.only]
    print(f"\n{table(outcomes)}", flush=True)
    return 0 if all(outcome.passed for outcome in outcomes) else 1


if __name__ == "__main__":
    raise SystemExit(main())
