"""Every row of `commander.FAILSAFES` in flight: when it acts, what it does, what ends it, who may take over."""

from __future__ import annotations

from collections.abc import Callable
from math import hypot

import pytest

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import GCS, Client, flight
from tests.autopilot.copter import (
    ACCEPTED,
    ALTCTL,
    HOLD,
    LAND,
    MISSION,
    OFFBOARD_MODE,
    POSCTL,
    REJECTED,
    RETURN,
    STABILIZED,
    TERMINATION,
    fence_circle,
    flying,
    go_to,
    item,
    set_parameter,
    sticks,
    upload,
    waypoint,
)

SLACK_S = 0.1
HEARTBEAT = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)

Mode = tuple[int, int]


def station(client: Client) -> Callable[[], int]:
    return lambda: client.send(HEARTBEAT, port=GCS, sender=(255, 190))


def severities(client: Client, text: str) -> list[int]:
    return [message.severity for message in client.all("STATUSTEXT", GCS) if message.text.startswith(text)]


def up_with(each: Callable[[Client], Callable[[], int]], **parameters: float) -> tuple[Client, Callable[[], int]]:
    """Taken off and holding, with something that is sent all the time."""
    client = Client(flight(parameters=parameters))
    send = each(client)
    client.run(0.3, send)
    assert client.result(mavlink.MAV_CMD_NAV_TAKEOFF) == ACCEPTED
    assert client.arm() == ACCEPTED
    client.run(6.0, send)
    assert client.flight_mode == HOLD
    return client, send


# --- off-board


OFFBOARD_ACTIONS: list[tuple[int, Mode | None, Mode | None]] = [
    (0, POSCTL, RETURN),
    (1, ALTCTL, RETURN),
    (2, STABILIZED, RETURN),
    (3, RETURN, RETURN),
    (4, LAND, LAND),
    (5, HOLD, HOLD),
    (6, TERMINATION, TERMINATION),
    (7, None, None),
]
"""COM_OBL_RC_ACT, the mode with sticks, the mode without; None: disarmed."""


@pytest.mark.parametrize("with_sticks", [True, False])
@pytest.mark.parametrize(("action", "sticked", "bare"), OFFBOARD_ACTIONS)
def test_loss_of_the_stream(action: int, sticked: Mode | None, bare: Mode | None, with_sticks: bool) -> None:
    client = flying(4.0, parameters={"COM_OBL_RC_ACT": action, "COM_OF_LOSS_T": 0.6})
    stick = sticks(client) if with_sticks else None

    def stream() -> None:
        client.attitude()
        if stick is not None:
            stick()

    client.run(0.1, stream)
    assert client.offboard() == ACCEPTED
    client.run(1.0, stream)
    assert not client.critical
    wanted = sticked if with_sticks else bare
    if wanted is None:
        took_s = client.run_until(lambda: not client.armed, 2.0, stick)
        assert client.texts()[-1] == "Disarmed by failsafe"
    else:
        took_s = client.run_until(lambda: client.flight_mode == wanted, 2.0, stick)  # no holding first
        assert client.texts()[-1].startswith("Failsafe activated: off-board signal lost, ")
        assert severities(client, "Failsafe") == [mavlink.MAV_SEVERITY_CRITICAL]
        terminated = mavlink.MAV_STATE_FLIGHT_TERMINATION
        assert client.heartbeat.system_status == (terminated if wanted == TERMINATION else mavlink.MAV_STATE_CRITICAL)
    assert took_s == pytest.approx(0.6, abs=SLACK_S)
    if wanted not in (None, TERMINATION):
        client.run(0.05, stream)
        assert client.flight_mode == OFFBOARD_MODE
        assert not client.critical
        assert client.texts()[-1] == "Off-board stream regained"


@pytest.mark.parametrize(("rc_action", "mode"), [(1, HOLD), (2, RETURN), (3, LAND), (5, TERMINATION)])
def test_loss_of_the_stream_without_sticks_asks_nav_rcl_act(rc_action: int, mode: Mode) -> None:
    client = flying(4.0, parameters={"COM_OBL_RC_ACT": 0, "NAV_RCL_ACT": rc_action})
    client.attitude()
    client.offboard()
    client.run(1.0 + SLACK_S)
    assert client.flight_mode == mode


def test_a_stream_that_comes_back_after_a_choice_changes_nothing() -> None:
    client = flying(4.0)
    client.attitude()
    client.offboard()
    client.run_until(lambda: client.critical, 2.0)
    assert client.mode(*LAND) == ACCEPTED
    client.run(0.3, client.attitude)
    assert client.flight_mode == LAND
    assert not client.critical


# --- sticks


@pytest.mark.parametrize(("action", "mode"), [(1, HOLD), (2, RETURN), (3, LAND), (5, TERMINATION), (6, None)])
def test_loss_of_the_sticks(action: int, mode: Mode | None) -> None:
    client, stick = up_with(sticks, NAV_RCL_ACT=action, COM_RC_LOSS_T=0.8, COM_FAIL_ACT_T=2.0)
    assert client.mode(*POSCTL) == ACCEPTED
    client.run(1.0, stick)
    lost_s = client.run_until(lambda: client.flight_mode != POSCTL or not client.armed, 2.0)
    assert lost_s == pytest.approx(0.8, abs=SLACK_S)
    if action in (2, 3):  # holds first, so that the user may take over
        assert client.flight_mode == HOLD
        waited_s = client.run_until(lambda: client.flight_mode != HOLD, 3.0)
        assert waited_s == pytest.approx(2.0, abs=SLACK_S)
    assert client.armed == (mode is not None)
    if mode is None:
        return
    assert client.flight_mode == mode
    if mode == TERMINATION:
        return
    client.run(0.5, stick)
    if action == 1:  # only held so far: the pilot has it back
        assert client.flight_mode == POSCTL
        assert client.texts()[-1] == "Manual control regained"
    else:  # latched until the user chooses
        assert client.flight_mode == mode
        assert client.mode(*POSCTL) == ACCEPTED
        client.run(0.2, stick)
        assert client.flight_mode == POSCTL
        assert not client.critical


def test_sticks_that_come_back_while_it_holds_have_the_vehicle_back() -> None:
    client, stick = up_with(sticks)
    client.mode(*ALTCTL)
    client.run(0.5, stick)
    client.run(2.0)
    assert client.flight_mode == HOLD
    assert client.critical
    client.run(0.1, stick)
    assert client.flight_mode == ALTCTL
    assert not client.critical


def test_sticks_missing_at_arming_are_not_missed() -> None:
    client = Client(flight())
    client.mode(*POSCTL)
    client.run(0.3)
    assert client.arm() == ACCEPTED
    client.run(2.0)
    assert client.flight_mode == POSCTL
    assert not client.critical


@pytest.mark.parametrize(
    ("exceptions", "in_mode", "missed"), [(0, 1, True), (1, 1, True), (2, 1, False), (0, 4, False)]
)
def test_sticks_are_missed_in_automatic_modes_too(exceptions: int, in_mode: int, missed: bool) -> None:
    client, _ = up_with(sticks, COM_RCL_EXCEPT=exceptions)
    set_parameter(client, "COM_RC_IN_MODE", in_mode)
    client.run(3.0)
    assert client.flight_mode == HOLD
    assert client.critical == missed


# --- ground station


@pytest.mark.parametrize(
    ("action", "mode"), [(0, HOLD), (1, HOLD), (2, RETURN), (3, LAND), (5, TERMINATION), (6, None)]
)
def test_loss_of_the_ground_station(action: int, mode: Mode | None) -> None:
    client, beat = up_with(station, NAV_DLL_ACT=action, COM_DL_LOSS_T=5, COM_FAIL_ACT_T=1.5)
    if action == 0:
        client.run(7.0)
        assert not client.critical
        assert client.flight_mode == mode
        return
    lost_s = client.run_until(lambda: client.critical or client.flight_mode != HOLD or not client.armed, 7.0)
    assert lost_s == pytest.approx(5.0, abs=SLACK_S)
    if action in (2, 3):
        assert client.flight_mode == HOLD
        assert client.run_until(lambda: client.flight_mode != HOLD, 3.0) == pytest.approx(1.5, abs=SLACK_S)
    assert client.armed == (mode is not None)
    if mode is None:
        return
    assert client.flight_mode == mode
    assert client.texts()[-1].startswith("Failsafe activated: connection to ground station lost, ")
    if action in (2, 3):
        client.run(0.3, beat)
        assert client.flight_mode == mode  # latched
        assert client.hold() == ACCEPTED
        client.run(0.1, beat)
        assert client.flight_mode == HOLD
        assert not client.critical
        client.run(5.0 + SLACK_S)  # lost once more: it acts once more
        assert client.critical


def test_a_user_who_takes_over_while_the_station_is_gone_keeps_the_vehicle() -> None:
    client, _ = up_with(station, NAV_DLL_ACT=2, COM_DL_LOSS_T=5, COM_FAIL_ACT_T=1.0)
    client.run_until(lambda: client.critical, 7.0)
    assert client.mode(*LAND) == ACCEPTED
    client.run(1.5)
    assert client.flight_mode == LAND
    assert not client.critical


def test_a_station_that_was_never_there_keeps_the_vehicle_on_the_ground() -> None:
    client = Client(flight(parameters={"NAV_DLL_ACT": 2}))
    client.run(0.3)
    assert client.arm() == REJECTED
    client.tick()
    assert client.texts()[-1] == "Arming denied: no connection to the ground station"
    client.run(0.2, station(client))
    assert client.arm() == ACCEPTED


# --- battery


def drained(action: int) -> Client:
    """In the air, on the way from full to empty within 25 s of hover."""
    parameters = {
        "COM_LOW_BAT_ACT": action, "SIM_BAT_MIN_PCT": 0.0, "SIM_BAT_DRAIN": 25.0, "COM_FAIL_ACT_T": 0.5,
        "BAT_LOW_THR": 0.5, "BAT_CRIT_THR": 0.35, "BAT_EMERGEN_THR": 0.2,
    }  # fmt: skip
    return flying(4.0, parameters=parameters)


def until_charge(client: Client, share: float) -> None:
    client.run_until(lambda: client.vehicle.autopilot.battery.charge < share, 25.0)


@pytest.mark.parametrize(("action", "critical", "emergency"), [(0, HOLD, HOLD), (2, LAND, LAND), (3, RETURN, LAND)])
def test_battery_levels(action: int, critical: Mode, emergency: Mode) -> None:
    client = drained(action)
    until_charge(client, 0.5)
    client.run(SLACK_S)
    assert severities(client, "Warning: low battery") == [mavlink.MAV_SEVERITY_WARNING]
    assert client.flight_mode == HOLD
    assert not client.critical
    until_charge(client, 0.35)
    client.run(SLACK_S)
    assert client.flight_mode == HOLD  # for COM_FAIL_ACT_T at least
    assert client.critical == (action != 0)
    client.run(0.5)
    assert client.flight_mode == critical
    until_charge(client, 0.2)
    client.run(0.5 + 2 * SLACK_S)
    assert client.flight_mode == emergency
    said = [text for text in client.texts() if "battery" in text]
    assert said[0] == "Warning: low battery"
    assert any("critical battery" in text for text in said)
    assert any("emergency battery level" in text for text in said)


def test_a_user_may_overrule_a_battery_until_the_next_level() -> None:
    client = drained(3)
    client.run_until(lambda: client.flight_mode == RETURN, 25.0)
    assert client.hold() == ACCEPTED
    client.run(0.3)
    assert client.flight_mode == HOLD
    client.run_until(lambda: client.flight_mode == LAND, 10.0)


def test_a_critical_battery_does_not_arm() -> None:
    client = drained(0)
    until_charge(client, 0.3)
    client.land()
    client.run_until(lambda: not client.armed, 20.0)
    client.run(0.2)
    assert client.arm() == REJECTED
    client.tick()
    assert client.texts()[-1] == "Arming denied: low battery"


# --- more than one, and what they stop


def test_the_worse_of_two_wins() -> None:
    """A fence that holds, then a lost ground station that returns."""
    client, beat = up_with(station, NAV_DLL_ACT=2, COM_DL_LOSS_T=5, COM_FAIL_ACT_T=0.5, GF_ACTION=2)
    set_parameter(client, "GF_MAX_VER_DIST", 1.5)
    client.run(0.2, beat)
    assert client.critical
    assert client.flight_mode == HOLD
    client.run_until(lambda: client.flight_mode == RETURN, 7.0)
    assert client.critical


def test_a_failsafe_that_holds_stops_a_vehicle_that_is_on_its_way_in_hold() -> None:
    client = flying(4.0)
    assert go_to(client, 40.0, 0.0, 4.0) == ACCEPTED
    client.run(3.0)
    began = client.truth[0]
    set_parameter(client, "GF_MAX_HOR_DIST", 2.0)
    client.run(6.0)
    assert client.critical
    assert client.truth[0] < began + 9.0
    assert hypot(*client.truth[3:6]) < 0.05


def test_a_mission_goes_on_after_a_warning() -> None:
    client = Client(flight(parameters={"GF_ACTION": 1}))
    client.run(0.2)
    upload(client, [item(client, 22, height_m=3.0), waypoint(client, 6, 0, 3)])
    assert client.result(mavlink.MAV_CMD_MISSION_START, 0, 0) == ACCEPTED
    client.run(6.0)
    upload(client, [fence_circle(client, 0.5)], 1)
    client.run_until(lambda: client.last("MISSION_CURRENT", 0).mission_state == 5, 15.0)
    assert client.flight_mode == MISSION
    assert not client.critical
    assert "Warning: geofence breached" in client.texts()


def test_a_failsafe_whose_mode_cannot_fly_gives_way_to_the_next() -> None:
    """A return needs a home: without one it lands."""
    client = flying(4.0, parameters={"COM_OBL_RC_ACT": 3})
    client.vehicle.autopilot.commander.home_set = False
    client.attitude()
    client.offboard()
    client.run(1.0 + SLACK_S)
    assert client.flight_mode == LAND


def test_termination_stops_the_rotors_and_never_clears() -> None:
    client = flying(8.0)
    assert client.result(mavlink.MAV_CMD_DO_FLIGHTTERMINATION, 1.0) == ACCEPTED
    client.run(0.4)
    assert client.flight_mode == TERMINATION
    assert client.truth[13:] == [0.0] * 4
    assert client.hold() == REJECTED
    assert client.land() == REJECTED
    client.run(0.2)
    assert client.flight_mode == TERMINATION
    assert "flight terminated" in client.texts()[-1]
