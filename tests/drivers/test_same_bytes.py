"""Same seed, same bytes: in memory, again in memory, and by two processes over UDP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mavsitl import pair, scenario
from mavsitl.scenario import ScenarioError
from tests.drivers.exercise import hash_in_memory, shortened


@pytest.mark.sockets
@pytest.mark.parametrize("name", scenario.names())
def test_two_processes_put_the_same_bytes_on_the_wire(name: str, tmp_path: Path) -> None:
    """Both ends of the UDP flight heard what the flight in memory heard, and that one repeats itself."""
    flight = shortened(name, 2.0)
    in_memory = hash_in_memory(flight)
    assert hash_in_memory(flight) == in_memory
    events: list[tuple[str, dict[str, Any]]] = []
    result = pair.fly(name, ["duration_s=2.0"], tmp_path, lambda end, event: events.append((end, event)))
    assert result.vehicle["finished"] is True
    assert result.ground["finished"] is (name != "rotor-failure")  # which falls while it lands
    assert result.vehicle["wire_hash"] == result.ground["wire_hash"] == in_memory
    assert ("ground", {"event": "report", "text": "flying"}) in events


@pytest.mark.parametrize("name", ["hover-wind", "hover-calm"])
def test_another_seed_is_another_flight(name: str) -> None:
    """In wind by wind and noise, in calm air by the noise."""
    hashes = {hash_in_memory(shortened(name, 1.0, seed=seed)) for seed in (1, 2, 3)}
    assert len(hashes) == 3


def test_without_wind_and_noise_the_seed_is_nothing() -> None:
    quiet = {f"noise__{key}": 0.0 for key in ("position_m", "velocity_m_s", "attitude_deg", "rate_deg_s")}
    assert len({hash_in_memory(shortened("hover-calm", 1.0, seed=seed, **quiet)) for seed in (1, 2)}) == 1


@pytest.mark.sockets
def test_a_failing_end_is_named_with_its_own_words(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"(vehicle|ground): mavsitl \w+: hover-calm \(shipped\): seed: -1"):
        pair.fly("hover-calm", ["seed=-1"], tmp_path, lambda end, event: None)
