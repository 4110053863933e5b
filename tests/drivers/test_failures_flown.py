"""Failures on a scenario's time line: when they act, the same bytes each time, and vehicles that are lost by them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mavsitl_ground.controller import Ground
from mavsitl_vehicle.failures import Failures, Kind, Timeline, Unit
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import pair, scenario
from mavsitl.cli import main
from mavsitl.drivers import fly_in_memory as fly
from mavsitl.ends import NullRecorder
from mavsitl.link.impaired import channels_for
from mavsitl.report.html import show
from mavsitl.report.metrics import aftermath, paper_case
from mavsitl.report.run import record
from mavsitl.scenario import ScenarioError
from tests.drivers.exercise import fly_in_memory, hash_in_memory, shortened

MOTOR = {"unit": "motor", "instance": 2}
LOSSY = {"link__to_ground__queue_bytes": 9000}
"""A link that does nothing, but is one: lock-step then does not wait for each message."""
FALL: dict[str, Any] = {
    "duration_s": 8.0,
    "start.position_nwu_m": [0.0, 0.0, 3.0],
    "reference.position_nwu_m": [0.0, 0.0, 3.0],
    "failures": [{"unit": "motor", "type": "off", "instance": 3, "start_s": 0.5}],
}
SETTINGS = [f"{key}={json.dumps(value)}" for key, value in FALL.items() if key != "failures"] + [
    'failures=[{unit="motor", type="off", instance=3, start_s=0.5}]'
]


def test_a_failure_acts_from_its_time_for_its_time() -> None:
    planned = [{**MOTOR, "type": "wrong", "value": 0.9, "start_s": 0.5, "duration_s": 0.3}]
    data = fly_in_memory(shortened("hover-calm", 1.2, failures=planned)).data
    (broken,) = data.broken
    assert broken.what == "motor 2 wrong (0.9)"
    assert broken.start_s == pytest.approx(0.5, abs=1e-6)
    assert broken.end_s == pytest.approx(0.8, abs=1e-6)
    assert data.rotor_speed_rad_s is not None
    right, left = data.rotor_speed_rad_s[:, 1], data.rotor_speed_rad_s[:, 3]
    at = {time_s: int(np.searchsorted(data.time_s, time_s - 1e-6)) for time_s in (0.5, 0.504, 0.804)}
    before = right[: at[0.5] + 1]
    assert right[at[0.504]] < 0.98 * before.mean(), "in the first period after its time"
    assert right[at[0.504] : at[0.804]].mean() / left[at[0.504] : at[0.804]].mean() == pytest.approx(1.0, abs=0.03)


@pytest.mark.sockets
@pytest.mark.parametrize(
    ("planned", "changes"),
    [
        ({**MOTOR, "type": "garbage", "start_s": 0.5, "duration_s": 0.05}, {}),
        ({"unit": "mavlink", "type": "stuck", "instance": 1, "start_s": 0.5, "duration_s": 0.1}, {}),
        ({"unit": "mavlink", "type": "off", "start_s": 0.5, "duration_s": 0.4}, LOSSY),
    ],
)
def test_the_same_bytes_in_memory_and_by_two_processes(
    planned: dict[str, Any], changes: dict[str, Any], tmp_path: Path
) -> None:
    flight = shortened("hover-calm", 1.5, failures=[planned], **changes)
    once = hash_in_memory(flight)
    assert hash_in_memory(flight) == once
    assert hash_in_memory(shortened("hover-calm", 1.5, **changes)) != once
    toml = ", ".join(f"{key}={json.dumps(value)}" for key, value in planned.items())
    settings = ["duration_s=1.5", f"failures=[{{{toml}}}]"]
    settings += [f"{key.replace('__', '.')}={value}" for key, value in changes.items()]
    result = pair.fly("hover-calm", settings, tmp_path, lambda end, event: None)
    assert result.vehicle["wire_hash"] == result.ground["wire_hash"] == once


def test_until_it_comes_a_failure_changes_nothing() -> None:
    later = [{**MOTOR, "type": "off", "start_s": 100.0}]
    assert hash_in_memory(shortened("hover-wind", 1.0, failures=later)) == hash_in_memory(shortened("hover-wind", 1.0))


def timeline(*planned: dict[str, Any], **changes: Any) -> tuple[Timeline, Failures]:
    failures = Failures()
    return Timeline(shortened("hover-calm", 9.0, failures=list(planned), **changes), failures, lockstep=True), failures


def test_each_flight_has_the_failures_of_its_clock() -> None:
    by_flight = {**MOTOR, "type": "off", "start_s": 2.0, "duration_s": 1.0}
    by_time = {"unit": "battery", "type": "off", "start_s": 1.0, "duration_s": 0.5, "clock": "simulated"}
    line, failures = timeline(by_flight, by_time)
    changed: list[tuple[float, str]] = []
    now = 0
    failures.subscribe(lambda change: changed.append((now / 1e6, change.text.partition("Failure ")[2])))
    for now in range(0, 20_000_000, 500_000):
        flown_s = now / 1e6 - 5.0 if now < 9_500_000 else now / 1e6 - 12.0  # lands after 4.5 s, lifts off again at 12 s
        line.step(now, flown_s if flown_s >= 0.0 else -1.0)
    assert changed == [
        (1.0, "injected: battery off"),
        (1.5, "cleared: battery"),
        (7.0, "injected: motor 2 off"),
        (8.0, "cleared: motor 2"),
        (14.0, "injected: motor 2 off"),
        (15.0, "cleared: motor 2"),
    ]


def test_an_end_leaves_what_somebody_else_has_set_since() -> None:
    line, failures = timeline({"unit": "motor", "type": "off", "start_s": 0.0, "duration_s": 1.0})
    line.step(0, 0.0)
    failures.set(Unit.MOTOR, Kind.STUCK, 2)
    failures.set(Unit.MOTOR, Kind.OK, 3)
    line.step(2_000_000, 2.0)
    assert failures.active == {(Unit.MOTOR, 2): Kind.STUCK}


REFUSED = [
    (
        {"unit": "motor", "type": "delayed", "start_s": 1},
        "hover-calm: failures[0].type: motor delayed is not supported; allowed: 0 ok, 1 off, 2 stuck, 3 garbage,",
    ),
    ({"unit": "gps", "type": "off", "start_s": 1}, 'hover-calm: failures[0].type: gps needs estimator.kind = "ekf"'),
    (
        {"unit": "motor", "type": "off", "start_s": 1, "instance": 5},
        "hover-calm: failures[0].instance: motor has no instance 5; allowed: 0 (all) to 4",
    ),
    (
        {"unit": "motor", "type": "wrong", "start_s": 1, "value": 1.5},
        "hover-calm: failures[0].value: 1.5 is not allowed for motor wrong; allowed: 0 to 1",
    ),
    (
        {"unit": "motor", "type": "off", "start_s": 1, "value": 0.5},
        "hover-calm: failures[0].value: motor off has no value",
    ),
    (
        {"unit": "mavlink", "type": "off", "start_s": 1},
        "hover-calm: failures[0].type: mavlink off: in lock-step it needs an impaired [link]",
    ),
    (
        {"unit": "wing", "type": "off", "start_s": 1},
        "hover-calm (shipped): failures[0].unit: 'wing' is not allowed; allowed: 'accel', 'baro', 'battery',",
    ),
    ({"unit": "motor", "type": "off"}, "hover-calm (shipped): failures[0].start_s: missing; allowed: number >= 0"),
    (
        {"unit": "motor", "type": "ok", "start_s": 1},
        "hover-calm (shipped): failures[0].type: 'ok' is not allowed; allowed: 'delayed', 'garbage',",
    ),
    (
        {"unit": "motor", "type": "off", "start_s": 1, "motor": 2},
        "hover-calm (shipped): failures[0].motor: unknown key; allowed here: unit, type, start_s, instance,",
    ),
]


@pytest.mark.parametrize(("planned", "text"), REFUSED)
def test_a_wrong_entry_is_named_with_what_is_allowed(planned: dict[str, Any], text: str) -> None:
    with pytest.raises(ScenarioError) as error:
        Vehicle(shortened("hover-calm", 1.0, failures=[planned]), NullRecorder(), seed=1, lockstep=True)
    assert str(error.value).startswith(text)


def test_a_scenarios_own_failures_need_no_leave() -> None:
    flight = scenario.load("rotor-failure", FALL)
    assert "SYS_FAILURE_EN" not in flight.scenario.parameters
    assert fly_in_memory(flight).data.broken[0].what == "motor 3 off"


# --- lost


def test_a_crashed_vehicle_is_lost_and_said_to_be() -> None:
    flown = fly_in_memory(scenario.load("rotor-failure", FALL))
    assert flown.phase == "LOST"
    data = flown.data
    assert data.time_s[-1] < 6.0, "ended soon after it hit the ground"
    since = aftermath(data, 0.5)
    assert since.altitude_m == pytest.approx(3.0, abs=0.2)
    assert since.position_m >= since.altitude_m
    assert since.tilt_deg > 20.0
    assert since.yaw_rate_deg_s > 90.0


def test_a_lost_fifth_of_thrust_is_flown() -> None:
    flown = fly_in_memory(scenario.load("thrust-loss", {"duration_s": 13.0}))
    assert flown.phase == "DONE"
    (broken,) = flown.data.broken
    assert (broken.what, broken.end_s) == ("motor 3 wrong (0.8)", np.inf)
    assert aftermath(flown.data, broken.start_s).position_m < 0.3


@pytest.mark.sockets
@pytest.mark.parametrize("memory", [True, False])
def test_fly_ends_with_a_statement_and_a_report(
    memory: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = [text for setting in SETTINGS for text in ("--set", setting)]
    arguments = ["fly", "rotor-failure", *settings, "--run-dir", str(tmp_path)]
    assert main([*arguments, "--in-memory"] if memory else arguments) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "rotor-failure was lost after " in said
    assert "s: the vehicle is on the ground, " in said
    (flight,) = json.loads((tmp_path / "run.json").read_text())["flights"]
    assert flight["lost"].startswith("the vehicle is on the ground, ")
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "What failed" in page
    assert "motor 3 off from 0.5 s on" in page
    assert ">lost</span>" in page
    assert page.count('id="s0-') == len({part.split('"')[0] for part in page.split('id="s0-')[1:]})


def test_a_vehicle_that_disarms_itself_in_flight_is_lost() -> None:
    silent = [{"unit": "mavlink", "type": "off", "start_s": 0.5, "duration_s": 1.5}]
    flight = shortened("hover-calm", 4.0, failures=silent, parameters__COM_OBL_RC_ACT=7, **LOSSY)
    flown = fly_in_memory(flight)
    assert flown.phase == "ABORTED"
    assert [status.armed for status in flown.data.statuses] == [True, False]


def test_a_landing_by_fail_safe_is_no_crash() -> None:
    """The vehicle comes down far below its reference, but it is not the controller that flies it."""
    deaf = {"link__to_vehicle__outages": [{"start_s": 3.0, "duration_s": 60.0}]}
    high = {"reference__steps": [{"time_s": 0.0, "position_nwu_m": [0.0, 0.0, 2.0]}]}
    flight = shortened("takeoff-hover", 30.0, parameters__COM_OBL_RC_ACT=4, **deaf, **high)
    vehicle, said = Vehicle(flight, NullRecorder(), seed=1, lockstep=True), list[str]()
    ground = Ground(flight, NullRecorder(), report=said.append)
    fly(vehicle, ground, max_time_s=60.0, channels=channels_for(flight.scenario.link, 1))
    assert ground.phase == "ABORTED"
    assert said[-1] == ground.lost == "the vehicle was disarmed in flight"
    assert not any(text.startswith("crashed") for text in said)


def test_the_page_of_a_flight_without_failures_says_nothing_of_them() -> None:
    flight = shortened("hover-calm", 1.0)
    about = record(flight, folder="hover-calm", wire_hash="", real_time_factor=None)
    assert show(about, fly_in_memory(flight).data).broken == []
    assert (paper_case(scenario.load("hover-calm").scenario)) == "hover-calm"
    planned = [{**MOTOR, "type": "off", "start_s": 1.0}]
    assert paper_case(scenario.load("hover-calm", {"failures": planned}).scenario) is None
