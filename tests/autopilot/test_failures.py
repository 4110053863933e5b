"""Failure injection: each row of the table does what it says, whichever way it is asked for, and says so."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, nan, sqrt
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot.battery import Level, open_circuit_v
from mavsitl_vehicle.autopilot.parameters import TABLE as PARAMETERS
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.autopilot.setpoints import RateSetpoint
from mavsitl_vehicle.failures import (
    EFFICIENCIES,
    INSTANCES,
    NO_SILENCE,
    SENSORS,
    SIZES,
    TABLE,
    Failures,
    Kind,
    Unit,
    has_sensors,
    kinds,
    named,
)
from mavsitl_vehicle.links import FAILURES
from mavsitl_vehicle.motors import GARBAGE_S
from mavsitl_vehicle.simulation import Simulation
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import scenario
from mavsitl.dialect import mavlink
from mavsitl.ends import NullRecorder
from mavsitl.log import topics
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.scenario import ScenarioError
from tests.autopilot.conftest import GCS, OFFBOARD, Client, flight
from tests.autopilot.copter import ACCEPTED, DENIED, UNSUPPORTED, flying, parameter, set_parameter, sticks

INJECT = mavlink.MAV_CMD_INJECT_FAILURE
BATTERY, MOTOR, RC, LINK = 100, 101, 104, 105


def standing(**changes: Any) -> Client:
    client = Client(flight(**changes))
    client.run(0.2)
    return client


def inject(client: Client, unit: int, kind: int, instance: int = 0, port: int = OFFBOARD) -> None:
    client.vehicle.parameters.put("SYS_FAILURE_EN", 1)
    assert client.result(INJECT, unit, kind, instance, port=port) == ACCEPTED


# --- motors: what becomes of a rotor that is commanded 0.6 of the thrust


class Rotors:
    """A simulation in free flight, its rates held, with failures."""

    def __init__(self, seed: int = 1, airframe: str = "paper") -> None:
        made = scenario.load("hover-calm", {"airframe": airframe, "start.clamp": True})
        self.failures = Failures()
        parameters = Parameters(made.airframe.parameters)
        self.simulation = Simulation(made, parameters, seed, failures=self.failures)
        self.simulation.held[0] = True  # the rotors are free, the body is not
        self.simulation.set_demand(0, RateSetpoint((0.0, 0.0, 0.0), 0.6))

    def run(self, ticks: int) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Rotor speeds after each tick, (ticks, 4)."""
        rows = []
        for _ in range(ticks):
            self.simulation.advance(-1.0)
            rows.append(self.simulation.x[13:17, 0].copy())
        return np.array(rows)

    @property
    def commanded(self) -> Any:
        return self.simulation.motors[0].commanded_rad_s


def motor_off(rotors: Rotors) -> None:
    rotors.failures.set(Unit.MOTOR, Kind.OFF, 2)
    speeds = rotors.run(5)
    assert (speeds[:, 1] == 0.0).all()
    assert (speeds[:, [0, 2, 3]] > 100.0).all()


def motor_stuck(rotors: Rotors) -> None:
    before = rotors.run(1)[0, 1]
    rotors.failures.set(Unit.MOTOR, Kind.STUCK, 2)
    rotors.simulation.set_demand(0, RateSetpoint((0.0, 0.0, 0.0), 0.2))
    speeds = rotors.run(5)
    assert (speeds[:, 1] == before).all()
    assert (speeds[:, 0] < before - 10.0).all()


def motor_wrong(rotors: Rotors) -> None:
    """Thrust b Omega^2 and drag torque d Omega^2 (eq 3) are both at the share."""
    for value, share in ((None, 0.5), (0.8, 0.8)):
        rotors.failures.set(Unit.MOTOR, Kind.WRONG, 2, value)
        rotors.run(1)
        speed, asked = rotors.simulation.x[14, 0], rotors.commanded[1]
        assert asked > 100.0
        assert speed == pytest.approx(sqrt(share) * asked)


def motor_slow(rotors: Rotors) -> None:
    """A first-order lag of 0.1 s, exact at each physics step."""
    rotors.failures.set(Unit.MOTOR, Kind.SLOW, 2)
    rotors.simulation.gains[27] = 0.0  # no noise of the gyro: the commands stay as they are
    start = float(rotors.run(1)[-1, 1])
    asked = float(rotors.commanded[1])
    rotors.simulation.set_demand(0, RateSetpoint((0.0, 0.0, 0.0), 0.3))
    speeds = rotors.run(25)  # 0.1 s
    assert speeds[-1, 0] == pytest.approx(asked * sqrt(0.5), rel=1e-6)
    assert speeds[-1, 1] == pytest.approx(speeds[-1, 0] + (start - speeds[-1, 0]) * np.exp(-1.0), rel=0.01)


def motor_garbage(rotors: Rotors) -> None:
    rotors.failures.set(Unit.MOTOR, Kind.GARBAGE, 2)
    speeds = rotors.run(1000)[:, 1]
    held = round(GARBAGE_S * 250)
    assert set(np.diff(np.flatnonzero(np.diff(speeds)))) <= {held, held + 1}
    assert 1000 // (held + 1) <= len(np.unique(speeds)) <= 1000 // held
    largest = float(rotors.simulation.gains[26, 0])
    assert 0.0 <= speeds.min() < 0.2 * largest
    assert 0.8 * largest < speeds.max() <= largest


def motor_intermittent(rotors: Rotors) -> None:
    rotors.failures.set(Unit.MOTOR, Kind.INTERMITTENT, 2)
    off = rotors.run(15_000)[:, 1] == 0.0  # a minute
    assert off[0]
    assert 0.05 < off.mean() < 0.15  # 0.1 s of 1.1 s
    assert 30 < np.count_nonzero(np.diff(off.astype(int)) == 1) < 80


MOTORS: dict[Kind, Callable[[Rotors], None]] = {
    Kind.OFF: motor_off,
    Kind.STUCK: motor_stuck,
    Kind.GARBAGE: motor_garbage,
    Kind.WRONG: motor_wrong,
    Kind.SLOW: motor_slow,
    Kind.INTERMITTENT: motor_intermittent,
}


@pytest.mark.parametrize("kind", MOTORS)
def test_what_a_motor_does(kind: Kind) -> None:
    rotors = Rotors()
    MOTORS[kind](rotors)
    rotors.failures.set(Unit.MOTOR, Kind.OK)
    speeds = rotors.run(1)[0]
    assert speeds == pytest.approx(rotors.commanded)
    rotors.simulation.set_demand(0, None)
    rotors.failures.set(Unit.MOTOR, kind)
    assert (rotors.run(3) == 0.0).all(), "disarmed, nothing turns"


def test_erratic_motors_are_seeded_each_for_itself() -> None:
    def speeds(seed: int) -> Any:
        rotors = Rotors(seed)
        rotors.failures.set(Unit.MOTOR, Kind.GARBAGE)
        return rotors.run(100)

    first = speeds(1)
    assert np.array_equal(first, speeds(1))
    assert not np.array_equal(first, speeds(2))
    assert len(np.unique(first[-1])) == 4


def test_a_failure_does_not_change_what_is_drawn_for_wind_and_sensors() -> None:
    well, broken = Rotors(), Rotors()
    well.run(10)
    broken.failures.set(Unit.MOTOR, Kind.GARBAGE, 1)
    broken.run(10)
    assert np.array_equal(well.simulation.wind, broken.simulation.wind)
    # The body is held: position and its noise are the same.
    assert np.array_equal(well.simulation.estimate[:3], broken.simulation.estimate[:3])


def test_the_speed_controllers_reveal_what_they_would() -> None:
    client = standing()
    inject(client, MOTOR, Kind.OFF, 1)
    inject(client, MOTOR, Kind.STUCK, 3)
    inject(client, MOTOR, Kind.WRONG, 4)
    client.run(1.2)
    autopilot = client.vehicle.autopilot
    assert autopilot.failed_motors == 0b0100  # a motor that stands still is nothing strange on the ground
    if hasattr(mavlink, "MAVLINK_MSG_ID_ESC_INFO"):  # where the dialect has them
        assert client.last("ESC_INFO").info == 0b1011
    assert not client.last("SYS_STATUS").onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
    assert client.arm() != ACCEPTED
    inject(client, MOTOR, Kind.OK, 3)
    client.run(0.2)
    assert client.arm() == ACCEPTED
    client.tick()
    assert autopilot.failed_motors == 0b0001


def test_a_weak_motor_is_commanded_more_and_the_autopilot_sees_only_that() -> None:
    client = flying(2.0)
    set_parameter(client, "SIM_MOT2_EFF", 0.8)
    client.run(3.0)
    asked = client.vehicle.autopilot.outputs
    turning = np.array(client.truth[13:17])
    assert turning == pytest.approx(np.full(4, turning[0]), rel=1e-3)  # thrust and torque balance as before
    assert asked[1] == pytest.approx(asked[0] / sqrt(0.8), rel=1e-3)
    assert abs(client.truth[2] - 2.0) < 0.1
    assert client.vehicle.autopilot.failed_motors == 0


# --- battery


def test_a_battery_that_fails() -> None:
    client = standing()
    pack = client.vehicle.autopilot.battery
    whole_v = pack.voltage_v
    inject(client, BATTERY, Kind.OFF)
    client.run(1.2)
    assert (pack.charge, pack.level, pack.remaining_percent) == (0.0, Level.EMERGENCY, 0)
    assert pack.voltage_v == pytest.approx(pack.cells * open_circuit_v(0.0))
    status = client.last("SYS_STATUS")
    assert status.battery_remaining == 0
    assert not status.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_BATTERY
    inject(client, BATTERY, Kind.WRONG)
    client.run(0.2)
    assert pack.charge == SIZES[Unit.BATTERY, Kind.WRONG].default
    assert pack.level is Level.EMERGENCY
    inject(client, BATTERY, Kind.OK)
    client.run(0.2)
    assert (pack.charge, pack.voltage_v, pack.level) == (1.0, whole_v, Level.FINE)


def test_a_battery_that_is_hardly_read() -> None:
    client = flying(2.0)
    pack = client.vehicle.autopilot.battery
    inject(client, BATTERY, Kind.SLOW)
    client.run(1.0)
    read = pack.charge
    client.run(15.0)
    assert pack.charge == read
    client.run(6.0)
    assert pack.charge < read, "what it gave meanwhile is counted when it is read"


def test_a_stuck_battery_drains_unseen() -> None:
    client = standing()
    set_parameter(client, "SIM_BAT_DRAIN", 20)
    set_parameter(client, "SIM_BAT_MIN_PCT", 0)
    pack = client.vehicle.autopilot.battery
    inject(client, BATTERY, Kind.STUCK)
    assert client.arm() == ACCEPTED
    client.run(2.0)
    assert (pack.charge, pack.current_a) == (1.0, 0.0)
    inject(client, BATTERY, Kind.OK)
    client.run(0.2)
    assert pack.charge < 0.99
    assert pack.current_a > 0.0


# --- sticks


def test_sticks_that_fail() -> None:
    client = standing()
    push = sticks(client, pitch=0.5)
    client.run(0.2, push)
    autopilot = client.vehicle.autopilot
    assert autopilot.commander.sticks_fresh()
    inject(client, RC, Kind.STUCK)
    client.run(2.0, sticks(client, pitch=-1.0))
    assert autopilot.pilot.axes.pitch == pytest.approx(0.5)
    client.run(2.0)  # nothing comes
    assert autopilot.commander.sticks_fresh()
    inject(client, RC, Kind.OFF)
    client.run(1.0, push)
    assert not autopilot.commander.sticks_fresh()
    inject(client, RC, Kind.OK)
    client.run(0.1, push)
    assert autopilot.commander.sticks_fresh()


def test_without_sticks_a_stuck_receiver_makes_none() -> None:
    client = standing()
    inject(client, RC, Kind.STUCK)
    client.run(0.5)
    assert not client.vehicle.autopilot.commander.sticks_fresh()


# --- links


def test_a_link_that_is_off_says_and_hears_nothing() -> None:
    client = standing()
    inject(client, LINK, Kind.OFF, 1)  # with its acknowledgement, on the very link
    client.tick()
    seen = len(client.inbox)
    client.run(1.0)
    assert {port for _, port, _ in client.inbox[seen:]} == {GCS}
    assert client.command(mavlink.MAV_CMD_RUN_PREARM_CHECKS, port=OFFBOARD) == []
    assert client.send(parameter("COM_OF_LOSS_T", 2.0)) == 0
    assert client.vehicle.parameters["COM_OF_LOSS_T"] == 1.0
    inject(client, LINK, Kind.OK, 1, port=GCS)
    client.run(0.3)
    assert client.inbox[-1][1] in (OFFBOARD, GCS)
    assert {port for time_us, port, _ in client.inbox if time_us > client.now_us - 200_000} == {OFFBOARD, GCS}


def test_what_a_dead_link_would_have_sent_is_lost() -> None:
    """The frames' numbers go on, so that the other side counts them."""
    client = standing()
    first = client.wire[OFFBOARD][-1][4]
    inject(client, LINK, Kind.OFF, 1)
    client.run(0.5)
    inject(client, LINK, Kind.OK, 1, port=GCS)
    client.run(0.02)
    numbers = [datagram[4] for datagram in client.wire[OFFBOARD][-3:]]
    assert all((number - first) & 0xFF > 20 for number in numbers)


def test_telemetry_that_hangs() -> None:
    client = flying(2.0)
    inject(client, LINK, Kind.STUCK, 2)
    client.run(0.2)
    first = client.last("ATTITUDE_QUATERNION", GCS), client.last("LOCAL_POSITION_NED", GCS)
    assert client.land() == ACCEPTED
    client.run(2.0)
    last = client.last("ATTITUDE_QUATERNION", GCS), client.last("LOCAL_POSITION_NED", GCS)
    assert last[0].time_boot_ms > first[0].time_boot_ms + 1800
    assert [last[1].x, last[1].y, last[1].z] == [first[1].x, first[1].y, first[1].z]
    assert client.last("LOCAL_POSITION_NED", OFFBOARD).z > first[1].z + 0.3
    assert client.flight_mode == (4, 6), "the mode stays true"
    client.send(mavlink.MAVLink_command_long_message(1, 1, 512, 0, 32, 0, 0, 0, 0, 0, 0), port=GCS)
    client.tick()
    assert client.last("LOCAL_POSITION_NED", GCS).z == first[1].z, "asked for, it hangs, too"
    inject(client, LINK, Kind.OK, 2)
    client.run(0.2)
    assert client.last("LOCAL_POSITION_NED", GCS).z > first[1].z + 0.3


# --- every row, every way in


def test_every_row_of_the_table_has_its_test() -> None:
    tested = {(Unit.MOTOR, kind) for kind in MOTORS}
    tested |= {(Unit.BATTERY, kind) for kind in (Kind.OFF, Kind.WRONG, Kind.STUCK, Kind.SLOW)}
    tested |= {(Unit.MAVLINK, kind) for kind in FAILURES}  # in tests/drivers/test_failed_links.py
    tested |= {(unit, kind) for unit in (Unit.RC, Unit.MAVLINK) for kind in (Kind.OFF, Kind.STUCK)}
    assert {row for row in TABLE if row[0] not in SENSORS} == tested
    assert all(text.endswith(".") for text in TABLE.values())
    assert set(SIZES) <= set(TABLE)


HERE = [row for row in TABLE if row[0] not in SENSORS]


def state(vehicle: Vehicle, log: MemoryRecorder) -> tuple[Any, ...]:
    rows = log.arrays(topics.INJECTED_FAILURE)
    return (
        dict(vehicle.failures.active),
        {name: vehicle.parameters[name] for name in PARAMETERS if name.startswith(("SIM_FAIL", "SIM_MOT"))},
        [text for _, _, text in log.messages],
        [rows[name].tolist() for name in ("unit", "instance", "type")],
        repr(rows["value"].tolist()),
    )


@pytest.mark.parametrize(("unit", "kind"), HERE)
def test_each_way_in_gives_the_same(unit: Unit, kind: Kind) -> None:
    instance = INSTANCES.get(unit, 1)
    name = next(name for name, row in PARAMETERS.items() if "FAILURE_TYPE" in row.text and _is(name, unit, instance))

    def client(**changes: Any) -> tuple[Client, MemoryRecorder]:
        made = Client(flight(parameters__SYS_FAILURE_EN=1, **changes))
        log = MemoryRecorder()
        made.vehicle = Vehicle(flight(parameters__SYS_FAILURE_EN=1, **changes), log, seed=1, ports=("offboard", "gcs"))
        made.vehicle.step(0)
        return made, log

    found = []
    for way in ("command", "parameter", "scenario", "registry"):
        planned = {"unit": named(unit), "type": named(kind), "instance": instance, "start_s": 0.1, "clock": "simulated"}
        made, log = client(failures=[planned]) if way == "scenario" else client()
        made.run(0.1)
        if way == "command":
            assert made.result(INJECT, unit, kind, instance) == ACCEPTED
        elif way == "parameter":
            made.send(parameter(name, kind))
        elif way == "registry":
            made.vehicle.failures.set(unit, kind, instance)
        made.run(0.1)
        found.append(state(made.vehicle, log))
        assert found[-1] == found[0], way
        texts = [text for text in made.texts(GCS if unit is not Unit.MAVLINK else OFFBOARD) if "Failure" in text]
        assert texts == found[0][2], way
    assert found[0][0] == {(unit, instance): kind}
    assert found[0][1][name] == kind


def _is(name: str, unit: Unit, instance: int) -> bool:
    from mavsitl_vehicle.failures import PARAMETERS as NAMES

    return NAMES.get(name) == (unit, instance)


def test_what_is_said_and_logged() -> None:
    client = standing()
    inject(client, MOTOR, Kind.OFF, 2)
    set_parameter(client, "SIM_MOT2_EFF", 0.75)
    set_parameter(client, "SIM_FAIL_MOT2", 0)
    inject(client, BATTERY, Kind.WRONG)
    inject(client, LINK, Kind.OFF, 1, port=GCS)
    inject(client, MOTOR, Kind.OK)  # nothing is broken there: nothing is said
    client.tick()
    assert client.texts() == [
        "Failure injected: motor 2 off",
        "Failure injected: motor 2 wrong, 75 % of the thrust",
        "Failure cleared: motor 2",
        "Failure injected: battery wrong, 4 % of the charge",
        "Failure injected: mavlink 1 off",
    ]


@pytest.mark.parametrize("name", EFFICIENCIES)
def test_efficiency_is_the_size_of_the_failure(name: str) -> None:
    client = standing()
    motor = EFFICIENCIES[name]
    failures, fails = client.vehicle.failures, f"SIM_FAIL_MOT{motor}"
    set_parameter(client, name, 0.7)
    assert failures.of(Unit.MOTOR, motor) is Kind.WRONG
    assert failures.value(Unit.MOTOR, motor) == pytest.approx(0.7)
    assert client.vehicle.parameters[fails] == Kind.WRONG
    set_parameter(client, name, 0.0)
    assert failures.of(Unit.MOTOR, motor) is Kind.OFF
    set_parameter(client, fails, Kind.WRONG)
    assert client.vehicle.parameters[name] == 0.5
    set_parameter(client, fails, Kind.STUCK)
    assert failures.of(Unit.MOTOR, motor) is Kind.STUCK
    assert client.vehicle.parameters[name] == 1.0
    set_parameter(client, name, 0.5)
    set_parameter(client, name, 1.0)
    assert failures.active == {}
    assert client.vehicle.parameters[fails] == 0


def test_parameters_of_failures_are_neither_kept_nor_hashed_nor_settings() -> None:
    client = standing()
    before = client.vehicle.parameters.hash()
    set_parameter(client, "SIM_FAIL_BAT", Kind.OFF)
    set_parameter(client, "SIM_MOT1_EFF", 0.5)
    assert client.vehicle.parameters.hash() == before
    assert client.vehicle.parameters.changed() == {}
    with pytest.raises(ScenarioError, match=r"takeoff-hover: parameters\.SIM_FAIL_MOT1: it happens in flight"):
        Vehicle(flight(parameters__SIM_FAIL_MOT1=1), NullRecorder(), seed=1)


def test_a_reboot_mends_everything() -> None:
    client = standing()
    inject(client, MOTOR, Kind.OFF)
    inject(client, BATTERY, Kind.OFF)
    assert client.result(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == ACCEPTED
    client.run(0.2)
    assert client.vehicle.failures.active == {}
    assert client.vehicle.parameters["SIM_FAIL_MOT1"] == 0
    assert client.vehicle.parameters["SIM_MOT1_EFF"] == 1.0
    assert client.vehicle.autopilot.battery.charge == 1.0


# --- MAV_CMD_INJECT_FAILURE


ANSWERS: list[tuple[tuple[float, ...], int, str]] = [
    ((101, 1, 2), ACCEPTED, "Failure injected: motor 2 off"),
    ((101, 0, 0), ACCEPTED, ""),
    ((104, 2, 0), ACCEPTED, "Failure injected: rc stuck"),
    ((104, 2, 1), ACCEPTED, "Failure injected: rc stuck"),
    ((101, 6, 1), UNSUPPORTED, "Failure injection refused: motor delayed is not supported; allowed: 0 ok, 1 off,"),
    ((100, 7, 0), UNSUPPORTED, "Failure injection refused: battery intermittent is not supported; allowed: 0 ok,"),
    ((5, 1, 0), UNSUPPORTED, "Failure injection refused: unit 5 type 1 is not supported"),
    ((101, 99, 0), UNSUPPORTED, "Failure injection refused: unit 101 type 99 is not supported"),
    ((-1, 1, 0), UNSUPPORTED, "Failure injection refused: unit -1 type 1 is not supported"),
    *(
        ((unit, kind, 0), UNSUPPORTED, f'Failure injection refused: {named(unit)} needs estimator.kind = "ekf"')
        for unit in sorted(SENSORS)
        for kind in (Kind.OK, Kind.OFF)
    ),
    ((nan, 1, 0), DENIED, "Failure injection refused: param1 is nan, need a FAILURE_UNIT"),
    ((101.5, 1, 0), DENIED, "Failure injection refused: param1 is 101.5, need a FAILURE_UNIT"),
    ((101, inf, 0), DENIED, "Command 420 refused: param2 is inf"),
    ((101, 1, nan), DENIED, "Failure injection refused: param3 is nan, need 0 (all) or more"),
    ((102, 1, nan), UNSUPPORTED, "Failure injection refused: unit 102 type 1 is not supported"),
    ((101, 1, 0.5), DENIED, "Failure injection refused: param3 is 0.5, need 0 (all) or more"),
    ((101, 1, 5), DENIED, "Failure injection refused: motor has no instance 5; allowed: 0 (all) to 4"),
    ((101, 1, -1), DENIED, "Failure injection refused: motor has no instance -1; allowed: 0 (all) to 4"),
    ((100, 1, 2), DENIED, "Failure injection refused: battery has no instance 2; allowed: 0 (all) to 1"),
]


@pytest.fixture(scope="module")
def calm() -> Client:
    return standing(parameters__SYS_FAILURE_EN=1)


@pytest.mark.parametrize(("params", "result", "text"), ANSWERS)
def test_the_command_is_answered(calm: Client, params: tuple[float, ...], result: int, text: str) -> None:
    calm.vehicle.failures.clear()
    calm.run(3.0)  # the same reason is said again after a while
    said = len(calm.texts())
    assert calm.result(INJECT, *params) == result
    calm.tick()
    new = calm.texts()[said:]
    assert new[0].startswith(text) if text else new == []


def test_without_leave_nothing_is_injected() -> None:
    client = standing()
    assert client.result(INJECT, 101, 1, 1) == DENIED
    client.tick()
    assert client.texts() == ["Failure injection refused: SYS_FAILURE_EN is 0"]
    assert client.vehicle.failures.active == {}


def test_sensors_wait_for_the_estimator() -> None:
    assert not has_sensors(flight().scenario)
    client = standing()
    client.send(parameter("SIM_FAIL_GPS", Kind.OFF))
    client.tick()
    assert client.vehicle.parameters["SIM_FAIL_GPS"] == 0
    assert client.last("PARAM_VALUE").param_id == "SIM_FAIL_GPS"
    assert client.texts()[-1].startswith("SIM_FAIL_GPS: ")


HOSTILE = st.one_of(
    st.floats(width=32), st.integers(-3, 200).map(float), st.sampled_from([nan, inf, -inf, 3.4e38, -0.0, 2**31, 1e-40])
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150, deadline=None)
@given(
    st.tuples(
        HOSTILE | st.sampled_from([100.0, 101.0, 104.0, 105.0]),
        HOSTILE | st.integers(0, 7).map(float),
        HOSTILE | st.integers(0, 4).map(float),
    )
)
def test_whatever_is_asked_is_answered_once(calm: Client, params: tuple[float, float, float]) -> None:
    (ack,) = calm.command(INJECT, *params, port=GCS)
    assert ack.result in (ACCEPTED, DENIED, UNSUPPORTED)
    active = calm.vehicle.failures.active
    assert all(kind in kinds(unit) for (unit, _), kind in active.items())
    assert not active or ack.result == ACCEPTED
    calm.vehicle.failures.clear()
    calm.tick()


EVENTS = sorted(
    name for name in PARAMETERS if name.startswith(("SIM_FAIL", "SIM_MOT", "SIM_CPU", "SIM_CLK", "SIM_GUST"))
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=100, deadline=None)
@given(st.sampled_from(EVENTS), HOSTILE)
def test_a_hostile_parameter_is_refused_or_within_its_limits(calm: Client, name: str, value: float) -> None:
    row = PARAMETERS[name]
    kind = mavlink.MAV_PARAM_TYPE_INT32 if row.is_integer else mavlink.MAV_PARAM_TYPE_REAL32
    calm.send(mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, kind))
    calm.run(0.02)
    held = calm.vehicle.parameters[name]
    assert row.problem(held) is None
    calm.vehicle._mishaps.mend()
    calm.run(0.02)
    assert not calm.vehicle._mishaps.stalled
    assert calm.vehicle.failures.active == {}


# --- stalls, clocks, gusts


def test_a_stalled_processor() -> None:
    client = flying(2.0)
    client.run(0.5)
    set_parameter(client, "SIM_CPU_STALL", 0.1)
    seen, before = len(client.inbox), client.truth
    speeds = []
    stalled = []

    def look() -> None:
        speeds.append(client.truth[13:17])
        stalled.append(client.send(mavlink.MAVLink_ping_message(0, 1, 0, 0)))

    client.run(0.1, look)
    told = [message.get_type() for _, _, message in client.inbox[seen:]]
    assert told == ["PARAM_VALUE", "PING"], "what was answered before it began, no more"
    assert sum(stalled[1:]) == 0
    assert speeds[1:] == [before[13:17]] * (len(speeds) - 1)
    assert client.truth[:13] != before[:13]
    client.run(0.02)
    assert client.vehicle.parameters["SIM_CPU_STALL"] == 0.0
    client.run(0.1)
    assert "Autopilot stalled for 0.1 s" in client.texts()
    client.run(1.0)
    assert abs(client.truth[2] - 2.0) < 0.3


def test_a_stall_longer_than_the_streams_time_out_trips_the_fail_safe() -> None:
    """Time goes on meanwhile, for the autopilot too."""
    client = standing()
    client.run(1.0, lambda: client.attitude(thrust=0.0))
    assert client.offboard() == ACCEPTED
    client.run(0.1, lambda: client.attitude(thrust=0.0))
    assert client.arm() == ACCEPTED
    client.run(0.1, lambda: client.attitude(thrust=0.0))
    set_parameter(client, "SIM_CPU_STALL", 1.5)
    client.run(1.6, lambda: client.attitude(thrust=0.0))
    assert any("off-board signal lost" in text for text in client.texts())
    assert any("stream regained" in text for text in client.texts())


def test_a_clock_that_jumps_is_seen_in_system_time_alone() -> None:
    unix_us = 1_700_000_000_000_000
    client = Client(flight())
    client.vehicle = Vehicle(flight(), NullRecorder(), seed=1, ports=("offboard", "gcs"), unix_us=lambda: unix_us)
    client.vehicle.step(0)
    client.run(1.2)
    before = client.last("SYSTEM_TIME", GCS)
    assert before.time_unix_usec == unix_us + 1000 * before.time_boot_ms
    set_parameter(client, "SIM_CLK_JUMP", -3600.0)
    client.run(1.2)
    after = client.last("SYSTEM_TIME", GCS)
    assert after.time_unix_usec == unix_us + 1000 * after.time_boot_ms - 3600 * 10**6
    assert after.time_boot_ms > before.time_boot_ms
    client.send(mavlink.MAVLink_timesync_message(0, 77))
    client._collect()
    assert client.last("TIMESYNC", OFFBOARD).tc1 == 1000 * client.now_us
    set_parameter(client, "SIM_CLK_JUMP", 0.0)
    client.run(1.2)
    again = client.last("SYSTEM_TIME", GCS)
    assert again.time_unix_usec == unix_us + 1000 * again.time_boot_ms


def test_a_gust_blows_when_it_is_asked_for() -> None:
    client = flying(2.0)
    for name, value in (("SIM_GUST_SPD", 2.0), ("SIM_GUST_DIR", 90.0), ("SIM_GUST_LEN", 0.5)):
        set_parameter(client, name, value)
    set_parameter(client, "SIM_GUST_TRIG", 1)
    winds: list[Any] = []
    client.run(0.6, lambda: winds.append(client.vehicle.simulation.wind[:, 0].copy()))
    peak = np.array(winds)[:, 1].max()  # from the east: towards +y, the west
    assert peak == pytest.approx(2.0, abs=1e-3)
    assert winds[63][1] == pytest.approx(1.0, abs=0.05)  # half way up, half the speed: 1 - cos
    client.run(0.5)
    assert client.vehicle.parameters["SIM_GUST_TRIG"] == 0
    assert client.vehicle.simulation.wind[:, 0] == pytest.approx(0.0)
    assert client.vehicle.simulation.field.coefficients.shape[0] == 0
    set_parameter(client, "SIM_GUST_TRIG", 1)
    client.run(0.25)
    set_parameter(client, "SIM_WIND_SPD", 1.0)
    client.tick()
    assert client.vehicle.simulation.wind[1, 0] == pytest.approx(1.0, abs=0.05), "another wind leaves the gust"
    set_parameter(client, "SIM_GUST_TRIG", 0)
    client.tick()
    assert client.vehicle.simulation.wind[:, 0] == pytest.approx((-1.0, 0.0, 0.0))


def test_on_the_ground_no_gust_begins() -> None:
    client = standing()
    client.send(parameter("SIM_GUST_TRIG", 1))
    client.tick()
    assert client.vehicle.parameters["SIM_GUST_TRIG"] == 0
    assert client.texts()[-1] == "SIM_GUST_TRIG: the vehicle is not flying"


@pytest.mark.parametrize(("name", "value"), [("SIM_CPU_STALL", 0.5), ("SIM_FAIL_LINK1", int(Kind.OFF))])
def test_in_lock_step_over_a_perfect_link_nothing_falls_silent(name: str, value: float) -> None:
    """The ground would wait for the tick's telemetry, and the vehicle for the answer to it."""
    vehicle = Vehicle(flight(), NullRecorder(), seed=1, lockstep=True)
    refused = vehicle.parameters.set(name, value)
    assert refused is not None
    assert refused.text == f"{name}: {NO_SILENCE}"
    lossy = Vehicle(flight(link__to_ground__queue_bytes=9000), NullRecorder(), seed=1, lockstep=True)
    assert lossy.parameters.set(name, value) is None
    client = Client(flight())
    client.vehicle.parameters.put("SYS_FAILURE_EN", 1)
    client.vehicle.autopilot.may_fall_silent = False
    assert client.result(INJECT, LINK, Kind.OFF, 1) == DENIED
    assert client.result(INJECT, LINK, Kind.STUCK, 1) == ACCEPTED
