"""Every shipped scenario and airframe loads, says what it is, and means what its name says."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import msgspec
import pytest

from mavsitl import scenario
from mavsitl.scenario import DrydenMil, DrydenPaper, Figure8, Gust, Hover, Spiral, Steps, Waypoints

AIRFRAMES = sorted(
    file.name.removesuffix(".toml")
    for file in (resources.files("mavsitl") / "airframes").iterdir()
    if file.name.endswith(".toml")
)


def test_the_papers_four_experiments_are_shipped() -> None:
    assert {"hover-calm", "hover-wind", "spiral-calm", "spiral-wind"} <= set(scenario.names())


@pytest.mark.parametrize("name", scenario.names())
def test_shipped_scenario_loads_and_describes_itself(name: str) -> None:
    flight = scenario.load(name)
    assert flight.name == name
    assert flight.scenario.title
    assert flight.scenario.description.endswith(".")
    assert flight.scenario.rates.substeps * flight.scenario.rates.control_hz == flight.scenario.rates.physics_hz


@pytest.mark.parametrize("name", scenario.names())
def test_titles_are_unique(name: str) -> None:
    title = scenario.load(name).scenario.title
    assert [other for other in scenario.names() if scenario.load(other).scenario.title == title] == [name]


@pytest.mark.parametrize("name", scenario.names())
def test_a_clamped_vehicle_starts_where_its_reference_does_or_at_the_papers_origin(name: str) -> None:
    flight = scenario.load(name).scenario
    start = flight.start.position_nwu_m
    match flight.reference:
        case Hover(position_nwu_m=position):
            assert start == position
        case Steps(steps=steps) if flight.start.clamp:
            assert start == steps[0].position_nwu_m
        case Steps(steps=steps):
            assert flight.ground_contact
            assert start == (0.0, 0.0, 0.0)
            # The flight's time runs from lift-off, so the first step itself has to lift it off.
            assert steps[0].position_nwu_m[2] > 0.0
        case Figure8(altitude_m=altitude):
            assert start == (0.0, 0.0, altitude)
        case Spiral():
            assert start == (0.0, 0.0, 0.0)
        case Waypoints():
            pytest.fail("a shipped scenario has no place for a file of its own")


@pytest.mark.parametrize("name", scenario.names())
def test_steps_and_gusts_happen_within_the_flight(name: str) -> None:
    flight = scenario.load(name).scenario
    times = [step.time_s for step in flight.reference.steps] if isinstance(flight.reference, Steps) else []
    times += [wind.start_s + wind.length_s for wind in flight.wind if isinstance(wind, Gust)]
    assert all(time < flight.duration_s for time in times)


def test_names_say_what_the_air_does() -> None:
    winds = {name: scenario.load(name).scenario.wind for name in scenario.names()}
    for name, wind in winds.items():
        if name.endswith("-calm"):
            assert wind == (), name
        elif "wind" in name.split("-"):
            assert wind != (), name
    assert winds["hover-wind"] == winds["spiral-wind"] == winds["hover-wind-realistic"] == (DrydenPaper(),)
    assert [type(wind) for wind in winds["hover-gust"]] == [Gust]
    assert [type(wind) for wind in winds["figure-8-wind"]] == [DrydenMil]


@pytest.mark.parametrize("name", AIRFRAMES)
def test_shipped_airframe_is_the_papers_vehicle(name: str) -> None:
    airframe, paper = scenario.load_airframe(name), scenario.load_airframe("paper")
    differs = {
        field.name
        for field in msgspec.structs.fields(airframe)
        if getattr(airframe, field.name) != getattr(paper, field.name)
    }
    expected = {
        "paper": set(),
        "realistic": {"title", "rotor_time_constant_s", "parameters"},
        "full-coupling": {"title", "wind_coupling"},
    }
    assert differs <= expected[name]
    assert airframe.mass_kg == 0.723  # Table 2


def test_full_coupling_is_eq_4_as_printed() -> None:
    assert scenario.load("hover-wind", {"airframe": "full-coupling"}).airframe.wind_coupling == 1.0


def test_a_scenario_file_is_found_by_path_and_its_airframe_and_waypoints_beside_it(tmp_path: Path) -> None:
    text = (resources.files("mavsitl") / "airframes" / "paper.toml").read_text("utf-8")
    (tmp_path / "heavy.toml").write_text(text.replace("mass_kg = 0.723", "mass_kg = 1.5"), "utf-8")
    (tmp_path / "mine.toml").write_text(
        'title = "mine"\nairframe = "heavy.toml"\nreference = { kind = "waypoints", file = "path.csv" }\n', "utf-8"
    )
    flight = scenario.load(str(tmp_path / "mine.toml"))
    assert flight.name == "mine"
    assert flight.airframe.mass_kg == 1.5
    assert flight.scenario.reference == Waypoints(file=str(tmp_path / "path.csv"))


def test_overrides_reach_any_depth() -> None:
    flight = scenario.load("hover-calm", {"controller.law": "pid", "controller.learning.dead_zone_deg": 1, "seed": 7})
    assert flight.scenario.controller.law == "pid"
    assert flight.scenario.controller.learning.dead_zone_deg == 1.0
    assert flight.scenario.seed == 7


@pytest.mark.parametrize("name", ["physics_hz", "control_hz"])
def test_scenarios_are_frozen(name: str) -> None:
    flight = scenario.load("hover-calm")
    with pytest.raises(AttributeError):
        setattr(flight.scenario.rates, name, 500)
