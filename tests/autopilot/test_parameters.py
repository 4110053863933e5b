"""Parameters: the table, its limits, and who overrides whom."""

from __future__ import annotations

from math import inf, nan

import pytest
from mavsitl_vehicle.autopilot.parameters import TABLE, Parameters

from mavsitl.scenario import ScenarioError
from tests.autopilot.conftest import Client, flight


def test_unknown_name() -> None:
    with pytest.raises(ScenarioError, match=r"parameters\.MC_ROL_P: no such parameter; known: .*MC_ROLL_P"):
        Client(flight(parameters={"MC_ROL_P": 6.5}))


@pytest.mark.parametrize("name", TABLE)
def test_limits(name: str) -> None:
    row = TABLE[name]
    assert row.minimum <= row.default <= row.maximum
    for good in (row.minimum, row.maximum):
        assert Parameters({name: good})[name] == good
    for bad in (row.minimum - 1e-3, row.maximum + 1e-3, nan, inf, -inf):
        with pytest.raises(ScenarioError, match=rf"parameters\.{name}: .* is not allowed; allowed: "):
            Parameters({name: bad})


def test_out_of_range_in_a_scenario() -> None:
    with pytest.raises(ScenarioError, match=r"COM_OF_LOSS_T: 61 s is not allowed; allowed: 0 to 60 s"):
        Client(flight(parameters={"COM_OF_LOSS_T": 61.0}))


def test_the_last_layer_wins() -> None:
    parameters = Parameters({"MC_ROLL_P": 1.0, "MC_YAW_P": 2.0}, {"MC_ROLL_P": 3.0})
    assert (parameters["MC_ROLL_P"], parameters["MC_YAW_P"], parameters["MC_PITCH_P"]) == (3.0, 2.0, 6.5)
