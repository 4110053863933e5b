"""What a test with a simulated vehicle costs: ``python -m tests.bench.bench_testing``. CPU time, the least of some.

A minute's flight as `mavsitl.testing` flies it, over 20 % loss; set-up apart. Then pytest's own time for a test that
does nothing, with the plugin and without it, in turns: with it only where the installed mavsitl names it.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable
from os import times
from pathlib import Path
from time import process_time

from mavsitl.dialect import mavlink
from mavsitl.testing import Flight, Vehicle

HOVER = mavlink.MAVLink_set_position_target_local_ned_message(
    0, 1, 1, 1, 0b110111111000, 0, 0, -3, 0, 0, 0, 0, 0, 0, 0, 0
)


def flight() -> Callable[[], object]:
    made = Flight("hover-wind")
    made.faults.link(loss=0.2)
    return made.run


def vehicle() -> Callable[[], object]:
    made = Vehicle()
    made.takeoff(3.0)
    made.faults.link(loss=0.2)
    made.stream(HOVER, hz=50.0)
    made.run(0.5)
    assert made.set_mode("OFFBOARD") == "ACCEPTED"
    return lambda: made.run(60.0)


def least(prepare: Callable[[], Callable[[], object]], repeats: int) -> tuple[float, float]:
    """(set-up, run) in seconds."""
    found = []
    for _ in range(repeats + 1):  # the first loads and compiles
        start_s = process_time()
        run = prepare()
        ready_s = process_time()
        run()
        found.append((ready_s - start_s, process_time() - ready_s))
    set_up, flown = zip(*found[1:], strict=True)
    return min(set_up), min(flown)


def pytest_s(*options: str) -> float:
    """Of a process that runs one test."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "test_nothing.py").write_text("def test_nothing(): pass\n", "utf-8")
        before = times()
        subprocess.run([sys.executable, "-m", "pytest", "-q", *options], cwd=folder, check=True, capture_output=True)
        after = times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    print("| 60 s of flight over 20 % loss, CPU time | set-up, s | flight, s |")
    print("|---|---:|---:|")
    for name, prepare in (("Flight, hover-wind", flight), ("Vehicle, OFFBOARD at 50 Hz", vehicle)):
        set_up_s, flown_s = least(prepare, options.repeats)
        print(f"| {name} | {set_up_s:.2f} | {flown_s:.2f} |")
    pairs = [(pytest_s(), pytest_s("-p", "no:mavsitl")) for _ in range(2 * options.repeats)]
    with_it_s, without_s = (min(column) for column in zip(*pairs, strict=True))
    print(f"\npytest for a test that does nothing: {with_it_s:.3f} s, with -p no:mavsitl {without_s:.3f} s")


if __name__ == "__main__":
    main()
