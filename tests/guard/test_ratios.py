"""Speed as a ratio to pymavlink's in the same process, in CPU time and in turns: a busy machine slows both alike.

The floors are at about 70 % of what is measured. They catch what the counts of instructions cannot see: a call that
became slow inside.
"""

from __future__ import annotations

from time import process_time
from typing import Any

import pytest

from mavsitl.codec import encode, parse
from mavsitl.compiled import JIT
from mavsitl.dialect import mavlink
from tests.bench.bench_codec import best_us, measure, messages, total
from tests.guard.counts import PERIODS, steady_flight

CODEC_FLOORS = {"pack": 3.5, "encode": 3.2, "frame": 8.0, "fields": 4.5, "message": 3.8}
"""Measured: 5.0, 4.6, 11.0, 6.3 and 5.2 (`tests.bench.bench_codec` tells more)."""
PERIOD_FLOOR = 0.2
"""Measured: 0.3."""
ROUNDS = 4


@pytest.fixture(scope="module")
def ratios() -> dict[str, float]:
    """Of five messages together, by the way they go."""
    rows = [measure(parse(encode(message, 0, 1, 1))[0], 1.0, calls=300, repeats=7) for message in messages()]
    mean = total(rows)
    return {way: theirs / ours for way in CODEC_FLOORS for ours, theirs in [getattr(mean, way)]}


@pytest.mark.parametrize("way", CODEC_FLOORS)
def test_the_codec_is_faster_than_pymavlinks(way: str, ratios: dict[str, float]) -> None:
    assert ratios[way] >= CODEC_FLOORS[way], f"{way}: {ratios[way]:.1f} times as fast as pymavlink"


class Stopwatch:
    """CPU time inside the `with`, seconds."""

    def __enter__(self) -> None:
        self.cpu_s = -process_time()

    def __exit__(self, *error: object) -> None:
        self.cpu_s += process_time()


def pymavlinks_share() -> float:
    """CPU time of pymavlink for the two messages of a control period, out at one end and in at the other, us."""
    out = [message for message in messages() if message.msgname in ("ODOMETRY", "SET_ATTITUDE_TARGET")]
    assert len(out) == 2
    reference = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    def exchange() -> Any:
        return [reference.parse_buffer(message.pack(reference)) for message in out]

    (found,) = best_us((exchange,), 200, 3)
    return found


@pytest.mark.skipif(not JIT, reason="un-jitted kernels are not what is compared")
def test_a_control_period_is_short_beside_pymavlinks_share_of_it() -> None:
    """Both ends whole, with plant, autopilot, controller and logs, beside pymavlink's work on their two messages."""
    ours, theirs = [], []
    for _ in range(ROUNDS):
        watch = Stopwatch()
        steady_flight(watch)
        ours.append(watch.cpu_s / PERIODS * 1e6)
        theirs.append(pymavlinks_share())
    ratio = min(theirs) / min(ours)
    assert ratio >= PERIOD_FLOOR, (
        f"a control period takes {min(ours):.1f} us, pymavlink's two messages {min(theirs):.1f}"
    )
