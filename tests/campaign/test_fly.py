"""One case to one row."""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import Any

import pytest

from mavsitl import ends, scenario, wings
from mavsitl.campaign import fly, grid
from mavsitl.campaign.sums import first_weights
from mavsitl.drivers import fly_in_memory
from mavsitl.log.flight import FlightData
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.report.metrics import maximum_error, rmse
from tests.campaign.flights import SHORT, measured, short


@pytest.mark.parametrize("name", ["spiral-wind", "takeoff-hover"])
def test_running_sums_are_the_measures_of_the_whole_log(name: str) -> None:
    case = short(name, 5)
    vehicle_log, ground_log = MemoryRecorder(), MemoryRecorder()
    vehicle = wings.find(wings.VEHICLE_GROUP)(case.flight, vehicle_log, seed=5, lockstep=True)
    fly_in_memory(vehicle, wings.find(wings.GROUND_GROUP)(case.flight, ground_log))
    logged = FlightData.from_recorders(vehicle_log, ground_log, duration_s=2.0)
    row = fly.fly(case)
    assert row.status == "flown"
    assert row.rmse == pytest.approx(rmse(logged).values(), rel=1e-5, abs=1e-6)
    assert row.largest == pytest.approx(maximum_error(logged).values(), rel=1e-4, abs=1e-5)
    assert logged.weights is not None
    ratios = logged.weights / first_weights(case.flight)
    assert row.weight_range == pytest.approx((ratios.min(), ratios.max()), rel=1e-6)
    assert ratios.min() < 1.0 < ratios.max()
    assert logged.rotor_speed_rad_s is not None
    assert row.effort_rad_s == pytest.approx(logged.rotor_speed_rad_s.var(axis=0).mean() ** 0.5, rel=1e-4)


def test_a_row_is_of_the_flight_that_mavsitl_fly_flies() -> None:
    """Also over a link that parameters change."""
    changed = [{"at_s": 0.5, "clock": "flight", "parameters": {"SIM_LINK_LAT": 3.0, "SIM_LINK_LOSS": 0.1}}]
    for overrides in ({}, {"link.live": True, "parameter_changes": changed}):
        flight = scenario.load("hover-wind", SHORT | overrides)
        outcome = ends.in_memory(flight, None, report=lambda text: None, progress=None)
        assert fly.fly(grid.case(flight)).wire_hash == outcome.wire_hash


def test_a_lost_flight_is_stopped_and_timed() -> None:
    flight = scenario.load("hover-wind", {"offnominal.rotor_thrust_scale": [0.0, 1.0, 1.0, 1.0]})
    row = fly.fly(grid.case(flight, 1))
    assert row.status == "lost"
    assert row.rmse is None
    assert row.position_m == row.attitude_deg == inf
    assert 1.0 < row.time_s < 10.0
    assert row.message


def test_a_flight_that_raises_is_a_row_with_its_message(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(group: str) -> Any:
        raise LookupError(f"nobody sits at {group}")

    monkeypatch.setattr(wings, "find", find)
    row = fly.fly(short("hover-calm", 1, law="pid"))
    assert (row.status, row.message) == ("failed", "LookupError: nobody sits at mavsitl.vehicle")
    assert row.labels == {"law": "pid"}


def test_keys_tell_scenario_and_seed_apart() -> None:
    flights = [scenario.load(name, ov) for name in ("hover-calm", "hover-wind") for ov in ({}, SHORT)]
    cases = [grid.case(flight, seed) for flight in flights for seed in (1, 2)]
    assert len({case.key for case in cases}) == len(cases)
    assert grid.case(flights[0]) == grid.case(flights[0], 1)
    assert short("hover-calm", 3).key == short("hover-calm", 3, label="another").key


def test_waypoints_travel_with_the_case(tmp_path: Path) -> None:
    """The file may be gone where it is flown, and another file of that name is another case."""
    (tmp_path / "path.csv").write_text("0,0,1,0,0\n0.1,0,1,0,0\n")
    text = 'title = "Path"\nduration_s = 2.0\n[start]\nposition_nwu_m = [0, 0, 1]\nclamp = true\n'
    (tmp_path / "mine.toml").write_text(text + '[reference]\nkind = "waypoints"\nfile = "path.csv"\n')
    flight = scenario.load(str(tmp_path / "mine.toml"))
    case = grid.case(flight)
    here = fly.fly(case)
    assert here.status == "flown"
    data = fly.encode(case)
    (tmp_path / "path.csv").write_text("0,0,2,0,0\n0.1,0,2,0,0\n")
    assert grid.case(flight).key != case.key
    (tmp_path / "path.csv").unlink()
    assert measured(fly.decode(fly.fly_encoded(data), fly.Row)) == measured(here)
    with pytest.raises(scenario.ScenarioError, match=r"reference\.file: .*path\.csv: cannot be read"):
        grid.case(flight)
