"""Single keys set over a scenario."""

from __future__ import annotations

import msgspec
import pytest

from mavsitl.scenario import Controller, ScenarioError, load


@pytest.mark.parametrize("name", ["hover-wind", "hover-wind-realistic"])
def test_one_gain_is_set_and_those_beside_it_stay(name: str) -> None:
    """Gains are given whole in a file; `hover-wind` has none, so that they are the defaults."""
    before = load(name).scenario.controller
    after = load(name, {"controller.position.k_p_per_s2": 7.0, "controller.yaw.k_d_per_s": 30.0}).scenario.controller
    assert after.position == msgspec.structs.replace(before.position, k_p_per_s2=7.0)
    assert after.yaw == msgspec.structs.replace(before.yaw, k_d_per_s=30.0)
    assert after.altitude == Controller().altitude


def test_a_reference_of_another_kind_is_not_filled_up() -> None:
    with pytest.raises(ScenarioError, match=r"reference\.kind: missing"):
        load("rotor-failure", {"gcs_link.live": True, "wind": [], "reference": {"rate_rad_s": 1.0}})
    with pytest.raises(ScenarioError, match=r"controller\.position\.kp: unknown key; allowed here: k_p_per_s2"):
        load("hover-wind", {"controller.position.kp": 1.0})


def test_what_was_handed_in_stays_as_it_was() -> None:
    table = {"k_p_per_s2": 1.0, "k_i_per_s3": 2.0, "k_d_per_s": 3.0}
    overrides = {"controller.position": table, "controller.position.k_p_per_s2": 7.0}
    for _ in range(2):
        assert load("hover-wind", overrides).scenario.controller.position.k_p_per_s2 == 7.0
    assert table["k_p_per_s2"] == 1.0
