"""The control period and the codec keep their budget of instructions, and the guard would see it if they did not."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from mavsitl.compiled import JIT
from tests.guard import counts
from tests.guard.counter import InstructionCounter

ROOT = Path(__file__).resolve().parents[2]

jitted = pytest.mark.skipif(not JIT, reason="un-jitted kernels are Python, and not what the budget counts")


@pytest.fixture(scope="module")
def found() -> counts.Counts:
    return counts.measure()


@pytest.fixture(scope="module")
def allowed() -> counts.Counts:
    budget = counts.budget()
    if budget is None:
        pytest.skip(f"no budget for Python {counts.version()}: python -m tests.guard.counts --write")
    return budget


@jitted
def test_every_budget_is_kept(allowed: counts.Counts, found: counts.Counts) -> None:
    said = counts.problems(allowed, found)
    if said:
        pytest.fail(
            "\n".join([*said, "If it has to be: python -m tests.guard.counts --write, and say why."]), pytrace=False
        )


@jitted
def test_the_counts_are_the_same_again(found: counts.Counts) -> None:
    """In this process, which has flown before, and in one that has not and hashes differently."""
    assert counts.measure() == found
    script = (
        "import json, sys; from tests.guard import counts;"
        "json.dump({what: dict(functions) for what, functions in counts.measure().items()}, sys.stdout)"
    )
    again = subprocess.run(
        [sys.executable, "-c", script],
        cwd=ROOT,
        env=os.environ | {"PYTHONHASHSEED": "77"},
        stdout=subprocess.PIPE,
        check=True,
        timeout=300.0,
    )
    assert counts.decoded(again.stdout) == found


@jitted
def test_a_decode_more_in_the_loop_is_seen_and_named(found: counts.Counts) -> None:
    """The mistake that is easily made: looking at `Frame.message` where the id would do."""

    def careless(vehicle: Any, ground: Any) -> None:
        receive = ground._node.receive

        def decoding(datagram: bytes) -> Any:
            frames = receive(datagram)
            for frame in frames:
                frame._kind.decode(frame.raw)  # what `Frame.message` does when it is read
            return frames

        ground._node.receive = decoding

    said = "\n".join(counts.problems(found, found | counts.flight(careless)))
    assert "ground grew from" in said
    assert "mavsitl.codec:decode_odometry" in said
    assert "vehicle grew" not in said


def test_what_grew_is_told_with_the_functions_that_are_the_reason() -> None:
    before = {"vehicle": Counter({"a:f": 100_000, "a:g": 1000}), "codec: parse X": Counter({"c:parse": 100})}
    after = {"vehicle": Counter({"a:f": 100_500, "a:h": 2500}), "codec: parse X": Counter({"c:parse": 101})}
    assert counts.problems(before, before) == []
    (said,) = counts.problems(before, after)
    assert said.splitlines() == [
        "vehicle grew from 404.0 to 412.0 instructions per control period:",
        "      +10.0  a:h",
        "       -4.0  a:g",
        "       +2.0  a:f",
    ]


@pytest.mark.parametrize(
    ("after", "text"),
    [
        ({"c": Counter({"c:parse": 102})}, "c grew from 100.0 to 102.0 instructions"),
        ({"c": Counter({"c:parse": 80})}, "c shrank, and the budget is to follow, from 100.0 to 80.0"),
        ({"c": Counter({"c:parse": 100}), "d": Counter()}, "d: has no budget"),
        ({}, "c: not measured any more"),
    ],
)
def test_each_kind_of_problem_is_told(after: counts.Counts, text: str) -> None:
    (said,) = counts.problems({"c": Counter({"c:parse": 100})}, after)
    assert said.startswith(text)


def test_what_is_counted_is_what_runs() -> None:
    from mavsitl.quaternion import conjugate

    once, twice = InstructionCounter(), InstructionCounter()
    with once:
        conjugate((1.0, 0.0, 0.0, 0.0))
    with twice:
        twice.into("second")
        for _ in range(2):
            conjugate((1.0, 0.0, 0.0, 0.0))
    (name,) = once.counts("")
    assert name == "mavsitl.quaternion:conjugate"
    assert twice.counts("second") == Counter({name: 2 * once.counts("")[name]})
    assert once.counts("")[name] > 0
    assert not twice.counts("")
