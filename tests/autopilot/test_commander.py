"""Modes, arming, the off-board stream and its loss, as a client sees them."""

from __future__ import annotations

from math import nan

import pytest

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import MAIN_AUTO, MAIN_OFFBOARD, SUB_LAND, SUB_LOITER, Client, flight

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
REJECTED = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
DENIED = mavlink.MAV_RESULT_DENIED

HOLD_MODE = (MAIN_AUTO, SUB_LOITER)
LAND_MODE = (MAIN_AUTO, SUB_LAND)
RETURN_MODE = (MAIN_AUTO, 5)
OFFBOARD_MODE = (MAIN_OFFBOARD, 0)
FORCE = (21196.0, 2989.0)


# --- the stream


def test_arming_in_offboard_needs_a_stream(client: Client) -> None:
    assert client.offboard() == ACCEPTED
    client.tick()
    assert client.flight_mode == OFFBOARD_MODE
    assert client.arm() == REJECTED
    client.tick()
    assert client.texts() == ["Arming denied: no setpoint received yet"]
    client.attitude()
    client.run(1.2)
    assert client.arm() == REJECTED
    client.tick()
    assert client.texts()[1] == "Arming denied: last setpoint 1.20 s ago, need < 1.00 s"
    assert not client.armed
    client.attitude()
    assert client.arm() == ACCEPTED
    client.tick()
    assert client.armed


def test_prearm_bit_says_whether_arming_would_work(client: Client) -> None:
    ready = mavlink.MAV_SYS_STATUS_PREARM_CHECK
    client.run(1.0)
    assert client.last("SYS_STATUS").onboard_control_sensors_health & ready
    client.offboard()
    client.run(1.0)
    assert not client.last("SYS_STATUS").onboard_control_sensors_health & ready


def test_offboard_is_refused_when_armed_without_a_stream(client: Client) -> None:
    assert client.arm() == ACCEPTED
    assert client.offboard() == REJECTED
    client.tick()
    assert client.texts()[-1] == "OFFBOARD refused: no setpoint received yet"
    assert client.flight_mode == HOLD_MODE
    client.attitude()
    client.run(1.5)
    assert client.offboard() == REJECTED
    client.tick()
    assert client.texts()[-1] == "OFFBOARD refused: last setpoint 1.50 s ago, need < 1.00 s"
    client.attitude()
    assert client.offboard() == ACCEPTED


@pytest.mark.parametrize(("interval_s", "kept"), [(1 / 3, True), (0.9, True), (1.1, False)])
def test_what_keeps_a_stream(client: Client, interval_s: float, kept: bool) -> None:
    client.climb(3.0)
    for _ in range(4):
        client.attitude()
        client.run(interval_s)
    assert (client.flight_mode == OFFBOARD_MODE) == kept


def test_stream_loss_lands_and_the_stream_brings_offboard_back() -> None:
    client = Client(flight(parameters={"COM_OBL_RC_ACT": 4}))
    client.climb(4.0)
    lost_us = client.now_us
    taken_s = client.run_until(lambda: client.flight_mode == LAND_MODE, 2.0)
    assert taken_s == pytest.approx(1.0, abs=0.02)
    assert client.critical
    assert client.armed
    assert client.texts()[-1] == "Failsafe activated: off-board signal lost, land"
    severities = [text.severity for text in client.all("STATUSTEXT", 1, lost_us)]
    assert severities == [mavlink.MAV_SEVERITY_CRITICAL]
    client.run(1.0)
    assert client.last("LOCAL_POSITION_NED", 0).vz == pytest.approx(0.7, abs=0.1)
    client.attitude()
    client.tick()
    assert client.flight_mode == OFFBOARD_MODE
    assert not client.critical
    assert client.texts()[-1] == "Off-board stream regained"


@pytest.mark.parametrize("choose", ["land", "hold"])
def test_the_stream_does_not_undo_the_users_choice(client: Client, choose: str) -> None:
    client.climb(4.0)
    client.run_until(lambda: client.critical, 2.0)
    assert (client.land() if choose == "land" else client.hold()) == ACCEPTED
    client.tick()
    chosen = LAND_MODE if choose == "land" else HOLD_MODE
    assert client.flight_mode == chosen
    assert not client.critical
    client.run(0.5, client.attitude)
    assert client.flight_mode == chosen


def test_a_refused_mode_leaves_the_failsafe_on(client: Client) -> None:
    client.climb(4.0)
    client.run_until(lambda: client.critical, 2.0)
    assert client.offboard() == REJECTED
    client.tick()
    assert client.critical
    assert client.flight_mode == RETURN_MODE


@pytest.mark.parametrize(
    ("action", "mode"), [(0, RETURN_MODE), (3, RETURN_MODE), (4, LAND_MODE), (5, HOLD_MODE), (7, OFFBOARD_MODE)]
)
def test_action_on_loss(action: int, mode: tuple[int, int]) -> None:
    client = Client(flight(parameters={"COM_OBL_RC_ACT": action, "COM_OF_LOSS_T": 0.5}))
    client.climb(3.0)
    client.run(0.6)
    assert client.flight_mode == mode
    assert client.armed == (action != 7)
    assert client.critical == (action != 7)


# --- arming


def test_arming_and_disarming_on_the_ground(client: Client) -> None:
    assert client.disarm() == ACCEPTED  # disarmed already
    assert client.arm() == ACCEPTED
    assert client.arm() == ACCEPTED
    client.tick()
    assert client.armed
    assert client.texts() == ["Armed by external command"]
    assert client.disarm() == ACCEPTED
    client.tick()
    assert not client.armed
    assert client.texts()[-1] == "Disarmed by command"


@pytest.mark.parametrize("wanted", [2.0, -1.0, 0.5, nan, 1e10])
def test_arm_needs_nought_or_one(client: Client, wanted: float) -> None:
    assert client.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, wanted) == DENIED
    client.tick()
    assert not client.armed
    assert client.texts()[-1] == f"Arm/disarm refused: param1 is {wanted:g}, need 0 or 1"


@pytest.mark.parametrize("magic", FORCE)
def test_force_disarms_in_the_air_and_nothing_less_does(client: Client, magic: float) -> None:
    client.climb(3.0)
    for weaker in (nan, 0.0, 1.0, 21195.0):
        assert client.disarm(weaker) == DENIED
        client.run(0.1, client.attitude)
        assert client.armed
        assert client.texts()[-1] == "Disarming denied: not landed"
    assert client.disarm(magic) == ACCEPTED
    client.tick()
    assert not client.armed
    client.run(0.5)
    assert client.truth[5] < -4.0  # it falls: half a second of gravity
    assert client.truth[13:] == [0.0] * 4


@pytest.mark.parametrize("magic", FORCE)
def test_force_does_not_skip_the_checks_before_arming(client: Client, magic: float) -> None:
    client.offboard()
    assert client.result(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, magic) == REJECTED


def test_land_mode_does_not_arm(client: Client) -> None:
    client.climb(6.0)
    assert client.disarm(FORCE[0]) == ACCEPTED
    assert client.land() == ACCEPTED
    assert client.arm() == REJECTED
    client.tick()
    assert client.texts()[-1] == "Arming denied: mode AUTO.LAND does not allow arming"


def test_auto_disarm_before_flight(client: Client) -> None:
    assert client.arm() == ACCEPTED
    client.tick()
    taken_s = client.run_until(lambda: not client.armed, 12.0)
    assert taken_s == pytest.approx(10.0, abs=0.02)
    assert client.texts()[-1] == "Disarmed by auto preflight disarming"


def test_auto_disarm_can_be_turned_off() -> None:
    client = Client(flight(parameters={"COM_DISARM_PRFLT": -1.0}))
    client.arm()
    client.run(30.0)
    assert client.armed


def test_land_on_the_ground_does_not_stick(client: Client) -> None:
    assert client.land() == ACCEPTED
    client.tick()
    assert client.flight_mode == LAND_MODE  # seen by who asked for it
    assert client.arm() == REJECTED
    client.run(1.1)
    assert client.flight_mode == HOLD_MODE
    assert client.arm() == ACCEPTED


def test_rotors_stand_until_they_have_spooled_up(client: Client) -> None:
    """Thrust before COM_SPOOLUP_TIME must not lift a vehicle that still counts as landed."""
    client.attitude(thrust=0.8)
    client.offboard()
    client.arm()
    client.run(0.95, lambda: client.attitude(thrust=0.8))
    assert client.truth[2] < 0.01
    assert client.landed
    client.run(0.5, lambda: client.attitude(thrust=0.8))
    assert client.truth[2] > 0.3
    assert client.last("EXTENDED_SYS_STATE", 1).landed_state == mavlink.MAV_LANDED_STATE_IN_AIR


# --- modes


@pytest.mark.parametrize(
    ("main", "sub"),
    [(0, 0), (2, 1), (3, 1), (3, 2), (4, 1), (4, 8), (8, 0), (10, 0), (6, 3), (99, 1), (1 << 30, 0)],
)
def test_modes_that_it_has_not(client: Client, main: int, sub: int) -> None:
    assert client.mode(main, sub) == DENIED
    client.tick()
    assert client.flight_mode == HOLD_MODE
    assert client.texts()[-1] == f"Mode refused: main {main} sub {sub} is not available"


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ((0, 6, 0), "base mode 0 is not available"),
        ((nan, 6, 0), "param1 is nan, need MAV_MODE_FLAG bits"),
        ((300, 6, 0), "param1 is 300, need MAV_MODE_FLAG bits"),
        ((1, nan, 0), "param2 is nan, need PX4's main mode"),
        ((1, 6.5, 0), "param2 is 6.5, need PX4's main mode"),
    ],
)
def test_mode_command_needs_its_parameters(client: Client, params: tuple[float, ...], text: str) -> None:
    assert client.result(mavlink.MAV_CMD_DO_SET_MODE, *params) == DENIED
    client.tick()
    assert client.texts() == [f"Mode refused: {text}"]


@pytest.mark.parametrize(
    ("base_mode", "mode"), [(4, (4, 4)), (8 | 64, (3, 0)), (16 | 64, (7, 0)), (64, (1, 0)), (4 | 64, (4, 4))]
)
def test_base_mode_alone_means_what_it_means_to_px4(client: Client, base_mode: int, mode: tuple[int, int]) -> None:
    assert client.result(mavlink.MAV_CMD_DO_SET_MODE, base_mode, 0, 0) == ACCEPTED
    client.tick()
    assert client.flight_mode == mode
    client.hold()
    assert client.acks_of(mavlink.MAVLink_set_mode_message(1, base_mode, 0)) == []
    client.tick()
    assert client.flight_mode == mode


def test_set_mode_message_has_no_ack(client: Client) -> None:
    for custom_mode, mode in ((6 << 16, OFFBOARD_MODE), (4 << 16 | 3 << 24, HOLD_MODE)):
        assert client.acks_of(mavlink.MAVLink_set_mode_message(1, 1, custom_mode)) == []
        client.tick()
        assert client.flight_mode == mode
    client.send(mavlink.MAVLink_set_mode_message(2, 1, 6 << 16))
    client.tick()
    assert client.flight_mode == HOLD_MODE


def test_changes_are_told_at_once_on_every_port(client: Client) -> None:
    client.run(0.5)
    before_us = client.now_us
    client.arm()
    client.tick()
    for port in (0, 1):
        (heartbeat,) = client.all("HEARTBEAT", port, before_us)
        assert heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        assert "Armed by external command" in client.texts(port)
