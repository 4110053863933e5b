"""Parameters that a scenario's time line sets: when, with what effect, the same bytes each time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.ends import NullRecorder
from mavsitl.scenario import ScenarioError, load
from tests.autopilot.conftest import Client, flight
from tests.drivers.exercise import fly_in_memory, hash_in_memory, shortened

GUST = {"SIM_GUST_SPD": 5.0, "SIM_GUST_DIR": 0.0, "SIM_GUST_LEN": 0.2, "SIM_GUST_TRIG": 1}


def change(parameters: dict[str, float], **more: Any) -> dict[str, Any]:
    return {"at_s": 0.5, "parameters": parameters, **more}


def test_a_gust_comes_at_its_time_and_goes() -> None:
    planned = shortened("hover-calm", 1.5, parameter_changes=[change(GUST)])
    data = fly_in_memory(planned).data
    assert data.wind_nwu_m_s is not None
    speed = np.linalg.norm(data.wind_nwu_m_s, axis=1)
    blows = data.time_s[speed > 0.01]
    assert blows[0] == pytest.approx(0.51, abs=0.02)
    assert blows[-1] == pytest.approx(0.89, abs=0.03)
    assert speed.max() == pytest.approx(5.0, abs=0.05)
    assert hash_in_memory(planned) == hash_in_memory(planned) != hash_in_memory(shortened("hover-calm", 1.5))


def test_a_stalled_processor_and_the_vehicle_s_own_time() -> None:
    client = Client(flight(parameter_changes=[change({"SIM_CPU_STALL": 0.25}, clock="simulated")]))
    client.run(0.49)
    assert client.vehicle.parameters["SIM_CPU_STALL"] == 0.0
    client.run(0.05)
    assert client.vehicle.parameters["SIM_CPU_STALL"] == 0.25
    client.run(0.3)
    assert client.vehicle.parameters["SIM_CPU_STALL"] == 0.0
    assert any(text.startswith("Autopilot stalled for 0.25") for text in client.texts())


def test_what_the_vehicle_refuses_then_is_said() -> None:
    client = Client(flight(parameter_changes=[change({"SIM_GUST_TRIG": 1}, clock="simulated")]))
    client.run(0.6)
    assert "SIM_GUST_TRIG: the vehicle is not flying" in client.texts()


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"SIM_NO_SUCH": 1.0}, r"parameter_changes\[0\]\.parameters\.SIM_NO_SUCH: no such parameter"),
        ({"SIM_CPU_STALL": 61.0}, r"parameter_changes\[0\]\.parameters\.SIM_CPU_STALL: 61 s is not allowed; allowed:"),
    ],
)
def test_a_wrong_name_or_value_is_an_error_at_the_start(parameters: dict[str, float], words: str) -> None:
    wrong = load("hover-calm", {"parameter_changes": [change(parameters)]})
    with pytest.raises(ScenarioError, match=words):
        Vehicle(wrong, NullRecorder(), seed=1)
