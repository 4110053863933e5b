"""Short flights in memory by every way to close the loop, to bounds that a broken sign, frame or stamp would break."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.drivers.exercise import fly_in_memory, shortened

WAYS: dict[str, dict[str, Any]] = {
    "attitude, stock": {"controller__level": "attitude"},
    "attitude, pidnn aboard": {"controller__level": "attitude", "controller__inner": "pidnn"},
    "body_rate": {"controller__level": "body_rate"},
    "torque": {"controller__level": "torque"},
    "body_rate, pid": {"controller__level": "body_rate", "controller__law": "pid"},
    "split telemetry": {"controller__telemetry": "split"},
    "split telemetry, torque": {"controller__telemetry": "split", "controller__level": "torque"},
}


def position_rmse_m(name: str, duration_s: float, **overrides: Any) -> float:
    flown = fly_in_memory(shortened(name, duration_s, **overrides))
    assert flown.phase == "DONE"
    assert flown.data.time_s[-1] == pytest.approx(duration_s, abs=0.02)
    return float(np.sqrt(np.mean(np.sum(np.square(flown.data.position_error_nwu_m()), axis=1))))


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS.keys())
def test_hover_in_calm_air(way: dict[str, Any]) -> None:
    assert position_rmse_m("hover-calm", 5.0, **way) < 0.02


@pytest.mark.parametrize("source", ["oracle", "observer", "none"])
@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS.keys())
def test_hover_in_wind(way: dict[str, Any], source: str) -> None:
    assert position_rmse_m("hover-wind", 8.0, controller__wind_information=source, **way) < 0.3


def test_the_true_wind_is_worth_something() -> None:
    """What the controller is told of the wind reaches its demand: the source that knows most does best."""
    errors = {
        source: position_rmse_m("hover-wind", 8.0, controller__wind_information=source) for source in ("oracle", "none")
    }
    assert errors["oracle"] < 0.5 * errors["none"]
