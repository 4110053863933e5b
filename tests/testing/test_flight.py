"""A whole flight in memory: the same as `mavsitl fly`, stopped anywhere, and what came of it in a test's terms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mavsitl import ends, scenario
from mavsitl.controllers import AttitudeDemand, ControllerError, Reference, State
from mavsitl.log.flight import FlightData
from mavsitl.log.ulog import read
from mavsitl.report.metrics import PAPER_TABLES, rmse
from mavsitl.scenario import ScenarioError
from mavsitl.testing import Flight, FlightAssertionError

SHORT = {"duration_s": 2.0}


def in_memory(name: str, **overrides: object) -> ends.Outcome:
    flight = scenario.load(name, {"link.live": True, **SHORT, **overrides})
    return ends.in_memory(flight, None, report=lambda text: None, progress=None)


def test_it_puts_the_bytes_of_mavsitl_fly_on_the_wire() -> None:
    assert Flight("hover-wind", overrides=SHORT).run().wire_hash == in_memory("hover-wind").wire_hash
    lossy = {"link.to_ground.loss": 0.2, "link.to_vehicle.loss": 0.2}
    flight = Flight("hover-wind", overrides=SHORT | lossy).run()
    assert flight.wire_hash == in_memory("hover-wind", **lossy).wire_hash


def test_a_link_that_may_become_worse_changes_nothing_of_the_flight(tmp_path: Path) -> None:
    flight = scenario.load("hover-wind", SHORT)
    plain = ends.in_memory(flight, tmp_path, report=lambda text: None, progress=None)
    assert plain.finished
    made = Flight(flight).run()
    assert made.rmse == rmse(FlightData.from_folder(tmp_path, duration_s=2.0))
    np.testing.assert_allclose(made.data.time_s, made.truth.time_s)
    np.testing.assert_allclose(made.data.position_nwu_m * (1.0, -1.0, -1.0), made.truth.position_ned_m)


def test_the_same_in_pieces_and_at_once() -> None:
    pieces = Flight("hover-wind", overrides=SHORT)
    assert pieces.time_s == -1.0
    assert pieces.run_until(0.5).time_s == pytest.approx(0.5)
    assert not pieces.ended
    state = pieces.run_until(lambda state: state.time_s > 1.0, within_s=5.0)
    assert state.mode == "OFFBOARD"
    assert state.armed
    assert pieces.run().wire_hash == Flight("hover-wind", overrides=SHORT).run().wire_hash
    assert pieces.ended
    assert pieces.trouble == ""


def test_seeds_and_variants() -> None:
    flight = Flight("hover-wind", seed=5, overrides=SHORT)
    same, other = flight.variant(), flight.variant(seed=6, overrides={"controller.law": "pid"})
    hashes = [each.run().wire_hash for each in (flight, same, other)]
    assert hashes[0] == hashes[1] != hashes[2]
    assert other.scenario.scenario.controller.law == "pid"
    assert other.scenario.scenario.duration_s == 2.0


def test_positions_are_ned_and_agree_with_the_log(tmp_path: Path) -> None:
    flight = Flight("takeoff-hover", overrides={"duration_s": 4.0}, logs=tmp_path / "logs").run()
    flight.close()
    truth, estimate = flight.truth, flight.estimate
    assert truth.position_ned_m[-1, 2] == pytest.approx(-0.5, abs=0.1)
    assert truth.height_m.max() > 0.4
    assert 0.0 < np.abs(truth.position_ned_m - estimate.position_ned_m).max() < 0.1
    table = read(tmp_path / "logs" / "vehicle.ulg")["vehicle_local_position_groundtruth"]
    rows = np.isin(table["timestamp"], np.round((truth.time_s * 1e6) + flight._zero_us()).astype(np.uint64))
    np.testing.assert_array_equal(table["z"][rows].astype(float), truth.position_ned_m[:, 2])
    assert {path.name for path in (tmp_path / "logs").iterdir()} == {
        "vehicle.ulg", "ground.ulg", "link.tlog", "scenario.toml"
    }  # fmt: skip
    again = scenario.load(str(tmp_path / "logs" / "scenario.toml"))
    assert again.scenario == flight.scenario.scenario
    flight.discard()
    assert not (tmp_path / "logs").exists()


def test_the_papers_numbers_stand_beside() -> None:
    assert Flight("spiral-wind").paper == PAPER_TABLES["spiral-wind"]
    assert Flight("takeoff-hover").paper is None


def test_a_lost_vehicle_is_no_exception_and_says_how() -> None:
    flight = Flight("rotor-failure", overrides={"duration_s": 14.0}).run()
    assert flight.lost
    assert flight.trouble == f"lost: {flight.lost}"
    assert any("motor 3 off" in text.text for text in flight.texts)


def test_what_does_not_come_is_an_assertion() -> None:
    flight = Flight("hover-calm", overrides=SHORT)
    with pytest.raises(FlightAssertionError, match=r"the condition comes within 0\.5 s\n  it did not"):
        flight.run_until(lambda state: state.height_m > 100.0, within_s=0.5)
    with pytest.raises(FlightAssertionError, match="it ended before 100 s"):
        flight.run_until(100.0)


def test_modes_texts_and_fail_safes_are_as_the_vehicle_said_them() -> None:
    """The link loses every text; a setpoint stream that stops brings the vehicle out of OFFBOARD."""
    flight = Flight("takeoff-hover", overrides={"duration_s": 12.0})
    flight.run_until(6.0)
    flight.faults.link(direction="to_vehicle", down=True)
    flight.run_until(8.0)
    assert [mode for _, mode in flight.modes] == ["AUTO.LOITER", "OFFBOARD", "AUTO.RTL"]
    (failsafe,) = flight.failsafes
    assert failsafe.start_s == pytest.approx(7.0, abs=0.1)
    assert failsafe.mode == "AUTO.RTL"
    assert failsafe.text == "Failsafe activated: off-board signal lost, return"
    assert "Armed by external command" in [text.text for text in flight.texts]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"scenario": "hover"}, "hover: no such shipped file"),
        ({"overrides": {"wind.x": 1}}, "wind"),
        ({"overrides": {"noise.position_m": -1}}, "noise.position_m: -1 is not allowed"),
        ({"seed": -1}, "seed: -1 is not allowed"),
        ({"seed": 1.5}, "seed: 1.5 is not allowed"),
        ({"scenario": {"titel": "x"}}, "titel: unknown key"),
        ({"scenario": scenario.load("hover-calm"), "overrides": {"duration": 1}}, "duration: unknown key"),
    ],
)
def test_wrong_set_ups_are_told(arguments: dict[str, object], said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        Flight(**arguments)  # type: ignore[arg-type]


def test_keys_over_a_loaded_scenario_are_those_over_its_file() -> None:
    """Optional keys that are not there, tagged tables and arrays of tables survive."""
    for name in scenario.names():
        overrides = {"duration_s": 7.0, "noise.position_m": 0.0, "link.to_ground.loss": 0.5}
        if scenario.load(name).scenario.estimator.kind == "ekf":
            del overrides["noise.position_m"]
        assert scenario.changed(scenario.load(name), overrides) == scenario.load(name, overrides)
    lossy = scenario.load("hover-calm", {"link.changes": [{"at_s": 1.0, "loss": 0.3}]})
    assert scenario.changed(lossy, {"seed": 4}).scenario.link == lossy.scenario.link


class Upright:
    """A controller of a user's."""

    def __init__(self, airframe: Any) -> None:
        self._weight_n = airframe.weight_n

    def update(self, time_s: float, state: State, reference: Reference) -> AttitudeDemand:
        return AttitudeDemand.along((0.0, 0.0, self._weight_n), reference.yaw)


def test_a_controller_of_the_users_by_class_and_by_name() -> None:
    by_class = Flight("hover-calm", controller=Upright, overrides=SHORT).run()
    by_name = Flight("hover-calm", controller=f"{__file__}:Upright", overrides=SHORT).run()
    assert by_class.wire_hash == by_name.wire_hash != Flight("hover-calm", overrides=SHORT).run().wire_hash
    with pytest.raises(ControllerError, match="Nobody"):
        Flight("hover-calm", controller=f"{__file__}:Nobody")
