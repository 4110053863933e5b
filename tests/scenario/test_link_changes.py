"""The scenario's links: what is the same in both sections, and what a time line of changes may say."""

from __future__ import annotations

from typing import Any

import pytest

from mavsitl.scenario import Impairment, LinkChange, LinkModel, ScenarioError, load


def test_a_change_can_say_all_that_a_direction_has_but_its_outages() -> None:
    assert {key for key in Impairment.__struct_fields__ if key not in LinkChange.__struct_fields__} == {"outages"}


def test_both_links_have_the_same_keys() -> None:
    made = load("hover-calm", {"gcs_link.to_ground.loss": 0.1, "link.live": True}).scenario
    assert made.gcs_link == LinkModel(to_ground=Impairment(loss=0.1))
    assert made.link == LinkModel(live=True)
    assert made.link != LinkModel()


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("link.changes", [{"loss": 0.5}], r"link\.changes\[0\]\.at_s: missing"),
        ("link.changes", [{"at_s": 1.0, "los": 0.5}], r"link\.changes\[0\]\.los: unknown key"),
        ("link.changes", [{"at_s": 1.0, "loss": 1.5}], r"link\.changes\[0\]\.loss: 1\.5 is not allowed"),
        ("link.changes", [{"at_s": 1.0, "direction": "up"}], r"changes\[0\]\.direction: 'up' is not allowed"),
        ("gcs_link.changes", [{"at_s": 2.0}, {"at_s": 1.0}], r"gcs_link\.changes: at_s must not decrease"),
        (
            "link.changes", [{"at_s": 1.0, "distribution": "uniform", "jitter_ms": 5.0}],
            r"link\.changes\[0\]\.jitter_ms: 5 is not allowed; allowed: at most latency_ms",
        ),
        ("gcs_link.to_ground.loss", 2.0, r"gcs_link\.to_ground\.loss: 2\.0 is not allowed"),
        ("gcs_link.to_ground.down", 1, r"gcs_link\.to_ground\.down: 1 is not allowed; allowed: true, false"),
    ],
)  # fmt: skip
def test_a_wrong_link_names_the_key_and_what_is_allowed(key: str, value: Any, text: str) -> None:
    with pytest.raises(ScenarioError, match=text):
        load("hover-calm", {key: value})


def test_changes_of_different_clocks_stand_in_any_order_and_add_up() -> None:
    changes = [
        {"at_s": 5.0, "latency_ms": 20.0, "direction": "to_ground"},
        {"at_s": 1.0, "clock": "simulated", "loss": 0.5},
        {"at_s": 6.0, "distribution": "uniform", "jitter_ms": 20.0, "direction": "to_ground"},
    ]
    made = load("hover-calm", {"link.changes": changes}).scenario.link
    impairment = made.to_ground
    for change in made.changes:
        impairment = change.of(impairment)
    assert impairment == Impairment(latency_ms=20.0, loss=0.5, distribution="uniform", jitter_ms=20.0)
