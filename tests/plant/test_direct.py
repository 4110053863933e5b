"""What is called directly, past numba's look at the types, gets the same types in every call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from mavsitl_ground.controller import Ground
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import drivers
from mavsitl.compiled import JIT, compiled, direct
from mavsitl.control.arrays import Record, record
from mavsitl.ends import NullRecorder
from mavsitl.scenario import Gust, load

jitted = pytest.mark.skipif(not JIT, reason="un-jitted functions look at no types")

WINDS = {"SIM_WIND_SPD": 3.0, "SIM_WIND_TURB": 1.0, "SIM_WIND_W20": 5.0}
"""Set in flight: the wind's arrays are made anew, with other sizes."""
VARIANTS: dict[str, dict[str, Any]] = {
    "PIDNN, body rates": {},
    "PID, torque": {"controller.level": "torque", "controller.law": "pid"},
    "attitude": {"controller.level": "attitude"},
    "split telemetry": {"controller.telemetry": "split"},
    "calm": {"wind": []},
}


@compiled
def _double(values: Record, factor: float) -> float:
    own = values[0]
    own["x"][0] = factor * own["x"][0]
    total: float = own["x"][0]
    return total


def test_it_gives_what_the_function_gives() -> None:
    one, other = record(x=[1.5]), record(x=[1.5])
    function = direct(_double, record(x=[0.0]), 1.0)
    assert function(one, 3.0) == _double(other, 3.0) == 4.5
    assert np.array_equal(one["x"], other["x"])


@jitted
@pytest.mark.parametrize("settings", VARIANTS.values(), ids=VARIANTS.keys())
def test_every_call_has_the_types_of_the_first(settings: dict[str, Any]) -> None:
    import numba

    flight = load("hover-wind", {"duration_s": 2.0} | settings)
    vehicle = Vehicle(flight, NullRecorder(), seed=1, lockstep=True)
    ground = Ground(flight, NullRecorder())
    seen: dict[str, set[tuple[Any, ...]]] = {}

    def watched(owner: Any, name: str) -> None:
        function: Callable[..., Any] = getattr(owner, name)

        def called(*arguments: Any) -> Any:
            seen.setdefault(name, set()).add(tuple(numba.typeof(argument) for argument in arguments))
            return function(*arguments)

        setattr(owner, name, called)

    watched(vehicle.simulation, "_advance")
    watched(ground._controller, "_cycle")
    if flight.scenario.controller.telemetry == "odometry":
        watched(ground._observer, "_take_odometry")

    def stir(flight_time_s: float) -> None:
        """Whatever makes an array anew."""
        if flight_time_s > 0.0 and not vehicle.parameters["SIM_WIND_SPD"]:
            for parameter, value in WINDS.items():
                assert vehicle.parameters.set(parameter, value) is None
            vehicle.simulation.blow(0, Gust(velocity_nwu_m_s=(1.0, 0.0, 0.0), start_s=1.5, length_s=0.2))

    tap = drivers.Tap(record=lambda now_us: stir(vehicle.flight_time_s))
    drivers.fly_in_memory(vehicle, ground, tap)
    assert vehicle.parameters["SIM_WIND_SPD"] == 3.0
    assert {name: len(types) for name, types in seen.items()} == dict.fromkeys(seen, 1)
    assert {"_advance", "_cycle"} <= seen.keys()
