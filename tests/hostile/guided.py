"""Coverage-guided fuzzing of parser and services: `python -m tests.hostile.guided [TARGET ...]`.

An input that reaches a line of `mavsitl` or of the vehicle that none reached before is kept and changed further. The
search is ours, on the interpreter's own tracing; `--engine atheris` searches with libFuzzer, which counts branches and
sees comparisons, and needs the package atheris.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections.abc import Callable, Sequence
from types import CodeType, FrameType
from typing import Any

from tests.hostile.report import Bar, Report, bar
from tests.hostile.targets import TARGETS, Target, seeds

WATCHED = ("mavsitl", "<mavsitl.codec")
MAX_BYTES = 2048
RUNS = 20_000
INTERESTING = (0, 1, 0x7F, 0x80, 0xFD, 0xFE, 0xFF)


class Coverage:
    """Pairs of lines, one after the other, that a call runs through in the code under test."""

    def __init__(self) -> None:
        self._watched: dict[CodeType, bool] = {}
        self._seen: set[tuple[CodeType, int, int]] = set()

    @property
    def edges(self) -> int:
        return len(self._seen)

    def run(self, target: Target, data: bytes) -> bool:
        """Call it; whether it went where none went before. Raises what the target raises."""
        before = len(self._seen)
        sys.settrace(self._enter)
        try:
            target(data)
        finally:
            sys.settrace(None)
        return len(self._seen) > before

    def _enter(self, frame: FrameType, event: str, argument: Any) -> Callable[..., Any] | None:
        code = frame.f_code
        watched = self._watched.get(code)
        if watched is None:
            name = code.co_filename
            watched = self._watched[code] = "/mavsitl" in name.replace("\\", "/") or name.startswith(WATCHED)
        if not watched:
            return None
        last = 0
        seen = self._seen

        def line(inner: FrameType, event: str, argument: Any) -> Callable[..., Any]:
            nonlocal last
            seen.add((code, last, inner.f_lineno))
            last = inner.f_lineno
            return line

        return line


class Mutator:
    """Changes an input a little, or crosses two."""

    def __init__(self, seed: str) -> None:
        self.random = random.Random(seed)

    def change(self, data: bytes, other: bytes) -> bytes:
        draw = self.random
        made = bytearray(data)
        for _ in range(draw.choice((1, 1, 2, 4, 8))):
            kind = draw.randrange(7)
            place = draw.randrange(len(made) + 1)
            if kind == 0 and made:
                made[place % len(made)] ^= 1 << draw.randrange(8)
            elif kind == 1 and made:
                made[place % len(made)] = draw.choice(INTERESTING)
            elif kind == 2:
                made[place:place] = draw.randbytes(draw.randint(1, 8))
            elif kind == 3:
                del made[place : place + draw.randint(1, 16)]
            elif kind == 4:
                length = draw.randint(1, 64)
                made[place:place] = made[draw.randrange(len(made) + 1) :][:length]
            elif kind == 5:
                made[place:] = other[draw.randrange(len(other) + 1) :]
            else:
                made[place : place + 4] = draw.choice((b"\xff\xff\xff\xff", b"\0\0\xc0\x7f", b"\0\0\x80\x7f", bytes(4)))
        return bytes(made[:MAX_BYTES])


def search(name: str, runs: int, seed: int, progress: Bar) -> tuple[int, int, list[tuple[bytes, str]]]:
    """(edges at the beginning, edges at the end, inputs with the exception that each caused)."""
    target = TARGETS[name]
    coverage = Coverage()
    mutator = Mutator(f"{name}-{seed}")
    kept: list[bytes] = []
    failures: list[tuple[bytes, str]] = []

    def attempt(data: bytes) -> None:
        try:
            if coverage.run(target, data):
                kept.append(data)
        except Exception as error:
            failures.append((data, repr(error)))

    for data in seeds(name):
        attempt(data)
    begun = coverage.edges
    for _ in range(runs):
        if len(failures) >= 5 or not kept:
            break
        # The newest finds are looked at more often.
        first = kept[max(mutator.random.randrange(len(kept)), mutator.random.randrange(len(kept)))]
        attempt(mutator.change(first, mutator.random.choice(kept)))
        progress.move(1, name)
    return begun, coverage.edges, failures


def guided(names: Sequence[str], runs: int, seed: int, *, show: bool = True) -> Report:
    report = Report(f"coverage-guided, {runs} inputs each, seed {seed}")
    with bar(runs * len(names), show=show) as progress:
        for name in names:
            begun, edges, failures = search(name, runs, seed, progress)
            for data, text in failures:
                print(f"{name} {data.hex()}: {text}", file=sys.stderr)
            report.demand(f"{name}: edges {begun} at first, {edges} found; failures", "0", len(failures), not failures)
    return report


def with_atheris(name: str, arguments: list[str]) -> None:
    """Does not return: libFuzzer ends the process, by exit code 77 where it found something."""
    import importlib

    atheris = importlib.import_module("atheris")
    for loaded in [module for module in sys.modules if module.startswith(("mavsitl", "tests.hostile.targets"))]:
        del sys.modules[loaded]  # it is instrumented as it is imported
    with atheris.instrument_imports(include=["mavsitl", "mavsitl_vehicle"]):
        target = importlib.import_module("tests.hostile.targets").TARGETS[name]
    atheris.Setup([name, f"-max_len={MAX_BYTES}", *arguments], target)
    atheris.Fuzz()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(TARGETS)} (default: all)")
    parser.add_argument("--runs", type=int, default=RUNS, help=f"inputs for each target (default: {RUNS})")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--engine", choices=("own", "atheris"), default="own")
    options = parser.parse_args()
    names = options.targets or list(TARGETS)
    unknown = set(names) - set(TARGETS)
    if unknown:
        parser.error(f"{', '.join(sorted(unknown))}: known are {', '.join(TARGETS)}")
    if options.engine == "atheris":
        if len(names) != 1:
            parser.error("--engine atheris: one target at a time")
        with_atheris(names[0], [f"-runs={options.runs}", f"-seed={options.seed}"])
    return guided(names, options.runs, options.seed).print()


if __name__ == "__main__":
    sys.exit(main())
