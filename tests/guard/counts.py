"""Instructions of the control period and of the codec, beside their budget: ``python -m tests.guard.counts [--write]``.

`budget.json` holds what each costs by function, per minor version of Python (their bytecode differs). A change that
makes the period dearer by more than `MARGIN` fails the test until it is cheaper again or the budget is written anew,
which shows in the review. One that makes it cheaper by `OUTDATED` asks for a new budget, so that the gain is kept.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from unittest import mock

from mavsitl import ends, scenario, wings
from mavsitl.codec import Counters, encode, packer, parse, reader
from mavsitl.node import Node
from tests.bench.bench_codec import messages
from tests.guard.counter import InstructionCounter

BUDGET = Path(__file__).parent / "budget.json"
SCENARIO = "hover-wind"
FLIGHT_S = 2.5
FROM_S = 1.0
"""Flight time at which counting begins: the handshake is over, the controller flies, all streams have begun."""
PERIODS = 250
"""One second of them: what is done once a second is done once."""
MARGIN = 0.01
OUTDATED = 0.1
SHOWN = 8
SIDES = ("vehicle", "ground", "driver")

Counts = dict[str, Counter[str]]
"""By what is measured ("vehicle", "ground", "driver", "codec ..."), instructions by function."""


def steady_flight(
    window: AbstractContextManager[Any],
    into: Callable[[str], None] = lambda side: None,
    change: Callable[[Any, Any], None] = lambda vehicle, ground: None,
) -> None:
    """Fly both ends in memory with their logs; `window` is open during `PERIODS` control periods in steady flight.

    `into` is told whose code runs from now on: "vehicle", "ground", or "driver" for what is between them. `change` is
    given both ends before they fly.
    """
    cores: dict[str, Any] = {}
    find = wings.find
    left = PERIODS

    def switching(side: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def switched(*arguments: Any, **keywords: Any) -> Any:
            into(side)
            result = method(*arguments, **keywords)
            into("driver")
            return result

        return switched

    def stepping(core: Any, step: Callable[[int], None]) -> Callable[[int], None]:
        def stepped(now_us: int) -> None:
            nonlocal left
            if core.flight_time_s >= FROM_S and left >= 0:
                if left == PERIODS:
                    window.__enter__()
                elif left == 0:
                    window.__exit__(None, None, None)
                left -= 1
            step(now_us)

        return stepped

    def watched(group: wings.Group, name: str | None = None) -> Callable[..., Any]:
        build, side = find(group, name), group.removeprefix("mavsitl.")

        def built(*arguments: Any, **keywords: Any) -> Any:
            core = cores[side] = build(*arguments, **keywords)
            if len(cores) == 2:
                change(cores["vehicle"], cores["ground"])
            for method in ("step", "receive", "datagrams"):
                setattr(core, method, switching(side, getattr(core, method)))
            if side == "vehicle":
                core.step = stepping(core, core.step)
            return core

        return built

    with mock.patch.object(wings, "find", watched), tempfile.TemporaryDirectory() as folder:
        flown = scenario.load(SCENARIO, {"duration_s": FLIGHT_S})
        ends.in_memory(flown, Path(folder), report=lambda text: None, progress=None)
    if left >= 0:
        raise RuntimeError(f"the flight is too short: {left} of {PERIODS} control periods are missing")


def flight(change: Callable[[Any, Any], None] = lambda vehicle, ground: None) -> Counts:
    """Instructions of `PERIODS` control periods at each end and between them. `change` as of `steady_flight`."""
    counter = InstructionCounter()
    steady_flight(counter, counter.into, change)
    return {side: counter.counts(side) for side in SIDES}


def codec() -> Counts:
    """Instructions of what the codec and a node do with one message, generated functions warm."""
    found: Counts = {}
    for message in messages():
        message_class = type(message)
        fields = [getattr(message, f"_{name}_raw", getattr(message, name)) for name in message_class.fieldnames]
        pack, read = packer(message_class), reader(message_class, *message_class.fieldnames)
        wire, counters, node = encode(message, 0, 2, 1), Counters(), Node(1, 1)
        (frame,) = parse(wire)
        name = message.msgname
        ways: dict[str, Callable[[], object]] = {
            f"codec: pack {name}": lambda pack=pack, fields=fields: pack(7, 1, 1, *fields),  # type: ignore[misc]
            f"codec: encode {name}": lambda message=message: encode(message, 7, 1, 1),  # type: ignore[misc]
            f"codec: parse {name}": lambda wire=wire, counters=counters: parse(wire, counters),  # type: ignore[misc]
            f"codec: read {name}": lambda read=read, frame=frame: read(frame),  # type: ignore[misc]
            f"codec: message of {name}": lambda wire=wire: parse(wire)[0].message,  # type: ignore[misc]
            f"node: send {name}": lambda node=node, pack=pack, fields=fields: node.send(pack, *fields),  # type: ignore[misc]
            f"node: receive {name}": lambda node=node, wire=wire: node.receive(wire),  # type: ignore[misc]
            f"node: is {name} for it": lambda node=node, frame=frame: node.addressed_to(frame),  # type: ignore[misc]
        }
        for way, function in ways.items():
            function()
            counter = InstructionCounter()
            with counter:
                function()
            found[way] = counter.counts("")
    return found


def measure() -> Counts:
    """All that has a budget."""
    return flight() | codec()


def version() -> str:
    return f"{sys.version_info.major}.{sys.version_info.minor}"


def decoded(text: str | bytes) -> Counts:
    """Counts from JSON."""
    return {what: Counter(functions) for what, functions in json.loads(text).items()}


def budget() -> Counts | None:
    """The committed one for this Python; None where none was written."""
    found = json.loads(BUDGET.read_text()).get(version())
    return None if found is None else decoded(json.dumps(found))


def write(found: Counts) -> None:
    """Make what was found the budget of this Python; those of the others stay."""
    everything = json.loads(BUDGET.read_text()) if BUDGET.exists() else {}
    everything[version()] = {what: dict(sorted(functions.items())) for what, functions in found.items()}
    BUDGET.write_text(json.dumps(dict(sorted(everything.items())), indent=1) + "\n")


def per_period(what: str, count: float) -> float:
    return count / PERIODS if what in SIDES else count


def differences(allowed: Mapping[str, int], found: Mapping[str, int], what: str) -> list[str]:
    """The functions whose count changed most, with the change; at most `SHOWN`."""
    changes = {name: found.get(name, 0) - allowed.get(name, 0) for name in {*allowed, *found}}
    largest = sorted((name for name in changes if changes[name]), key=lambda name: (-abs(changes[name]), name))
    return [f"  {per_period(what, changes[name]):+9.1f}  {name}" for name in largest[:SHOWN]]


def problems(allowed: Counts, found: Counts) -> list[str]:
    """What does not keep its budget, in words, with the functions that are the reason."""
    said = []
    for what in sorted({*allowed, *found}):
        if what not in allowed or what not in found:
            said.append(f"{what}: {'not measured any more' if what in allowed else 'has no budget'}")
            continue
        before, now = allowed[what].total(), found[what].total()
        if now > before * (1.0 + MARGIN):
            verdict = "grew"
        elif now < before * (1.0 - OUTDATED):
            verdict = "shrank, and the budget is to follow,"
        else:
            continue
        unit = "instructions per control period" if what in SIDES else "instructions"
        lines = [f"{what} {verdict} from {per_period(what, before):.1f} to {per_period(what, now):.1f} {unit}:"]
        said.append("\n".join([*lines, *differences(allowed[what], found[what], what)]))
    return said


def main() -> int:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--write", action="store_true", help="make what is found the budget of this Python")
    given = arguments.parse_args()
    found = measure()
    allowed = (budget() if BUDGET.exists() else None) or {}
    print(f"{'Python ' + version():40}{'budget':>10}{'found':>10}")
    for what, functions in found.items():
        before = f"{per_period(what, allowed[what].total()):.1f}" if what in allowed else "-"
        print(f"{what:40}{before:>10}{per_period(what, functions.total()):10.1f}")
    for what in SIDES:
        print(f"\n{what}, instructions per control period:")
        for name, count in found[what].most_common(20):
            print(f"  {per_period(what, count):9.1f}  {name}")
    if given.write:
        write(found)
        return 0
    said = problems(allowed, found)
    print("\n" + "\n".join(said or ["every budget is kept"]))
    return 1 if said else 0


if __name__ == "__main__":
    sys.exit(main())
