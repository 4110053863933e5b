"""Failures of the unit MAVLINK that the off-board link's channels make, by a scenario's time line in lock-step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from mavsitl import ends, scenario

BEGIN_S, LENGTH_S = 1.0, 0.4
PROBES: dict[str, Callable[[dict[str, float]], bool]] = {
    "delayed": lambda counts: counts["delay_max_ms"] >= 500.0,
    "garbage": lambda counts: 0.1 < counts["corrupted"] / (250 * LENGTH_S) < 0.35,
    "slow": lambda counts: counts["delay_max_ms"] > 100.0,
    "intermittent": lambda counts: counts["lost"] > 10,
}


def fly(*failures: dict[str, Any], **link: Any) -> ends.Outcome:
    changes = {"duration_s": 2.0, "controller.level": "attitude", "link": {"live": True, **link}, "failures": failures}
    flight = scenario.load("hover-calm", {**changes, "failures": list(failures)})
    return ends.in_memory(flight, None, report=lambda text: None, progress=None)


def failure(kind: str, **more: Any) -> dict[str, Any]:
    return {"unit": "mavlink", "type": kind, "instance": 1, "start_s": BEGIN_S, "duration_s": LENGTH_S, **more}


@pytest.mark.parametrize("kind", PROBES)
def test_a_failed_link_does_what_its_row_says_and_mends(kind: str) -> None:
    long = {"duration_s": 1.0} if kind == "intermittent" else {}
    outcome = fly(failure(kind, **long))
    assert outcome.finished
    counts = outcome.links["link"]["to_ground"]
    assert PROBES[kind](counts), counts
    assert counts["delivered"] > 0.5 * counts["sent"]


def test_the_same_seed_gives_the_same_bytes() -> None:
    assert fly(failure("garbage")).wire_hash == fly(failure("garbage")).wire_hash != fly().wire_hash


def test_over_a_perfect_lock_step_link_it_is_refused() -> None:
    flight = scenario.load("hover-calm", {"failures": [failure("delayed")]})
    with pytest.raises(scenario.ScenarioError, match=r"failures\[0\]\.type: mavlink delayed: in lock-step .*\[link\]"):
        ends.in_memory(flight, None, report=lambda text: None, progress=None)
