"""The handshake with a vehicle that comes late, goes, comes back, is another one, or is taken away."""

from __future__ import annotations

from typing import Any

import pytest
from mavsitl_ground.sequence import FORCE_DISARM, NOW, SILENCE_TIMEOUT_US, Handshake, Phase

from mavsitl.codec import packer, parse
from mavsitl.dialect import mavlink
from mavsitl.node import Node
from tests.drivers.exercise import Air, shortened
from tests.ground.exercise import framed

FLIGHT = shortened("hover-calm", 1.0)
LONG = shortened("hover-calm", 60.0)

HEARTBEAT = packer(mavlink.MAVLink_heartbeat_message)
ODOMETRY = packer(mavlink.MAVLink_odometry_message)
COMMAND_LONG = packer(mavlink.MAVLink_command_long_message)
ODOMETRY_ID, WIND_ID = mavlink.MAVLINK_MSG_ID_ODOMETRY, mavlink.MAVLINK_MSG_ID_DEBUG_VECT


def messages(air: Air, message_id: int) -> list[Any]:
    """What the ground sent of one kind."""
    found = [frame.message for datagram in air.from_ground for frame in parse(datagram)]
    return [message for message in found if type(message).id == message_id]


def arm_commands(air: Air) -> list[Any]:
    commands = messages(air, mavlink.MAVLINK_MSG_ID_COMMAND_LONG)
    return [each for each in commands if each.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM and each.param1 == 1.0]


def in_flight(system_id: int = 1) -> Air:
    air = Air(LONG)
    air.start_vehicle(system_id)
    assert air.reaches("FLY")
    assert not air.run(1.0)
    assert air.ground.phase == "FLY"
    return air


def test_a_vehicle_that_comes_up_after_the_ground_is_flown() -> None:
    air = Air(FLIGHT)
    assert not air.run(5.0)
    assert air.ground.phase == "SEARCH"
    assert len(messages(air, mavlink.MAVLINK_MSG_ID_HEARTBEAT)) == 5
    air.start_vehicle()
    assert air.reaches("FLY")
    assert air.reaches("DONE")
    assert air.ground.succeeded
    vehicle = air.vehicle
    assert vehicle is not None
    air.run(0.1)
    assert vehicle.finished


@pytest.mark.parametrize("system_id", [1, 7, 255])
def test_a_vehicle_that_goes_and_comes_back_is_flown_again(system_id: int) -> None:
    """Gone for longer than the time-out; then it, or another one, starts with its clock at 0."""
    air = in_flight()
    air.vehicle = None
    assert air.reaches("SEARCH", within_s=3.5)
    assert "vehicle lost: silent for 3 s" in air.said
    assert air.ground.vehicle_time_us == -1
    assert air.ground.flight_time_s == -1.0
    sent = len(air.from_ground)
    assert not air.run(3.0)
    assert {len(parse(each)) for each in air.from_ground[sent:]} == {1}
    assert len(air.from_ground) - sent == 3  # heartbeats only: nobody is commanded while nobody is there
    air.start_vehicle(system_id)
    assert air.reaches("FLY")
    assert air.said.count("flying") == 2
    assert air.said[-1] == "flying"
    assert 0.0 <= air.ground.flight_time_s < 0.1
    assert not air.run(1.0)
    assert air.ground.phase == "FLY"
    assert messages(air, mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET)[-1].target_system == system_id


@pytest.mark.parametrize("gap_s", [0.0, 0.5, 2.0])
def test_a_quick_restart_is_seen_by_the_clock_going_back(gap_s: float) -> None:
    air = in_flight()
    air.vehicle = None
    air.run(gap_s)
    assert air.ground.phase == "FLY"
    air.start_vehicle()
    assert air.reaches("SEARCH", within_s=1.0)
    assert air.said[-1] == "vehicle lost: its clock went back, it has restarted"
    assert air.reaches("FLY")
    assert sum(text.startswith("vehicle lost") for text in air.said) == 1
    assert air.said.count("flying") == 2


def test_an_outage_of_the_link_is_flown_on() -> None:
    """The vehicle kept flying by its fail-safe; its clock went on. It is taken over again without a restart."""
    air = in_flight()
    vehicle, stamp_us = air.vehicle, air.vehicle_us
    assert vehicle is not None
    air.vehicle = None
    assert air.reaches("SEARCH", within_s=3.5)
    for _ in range(875):
        vehicle.step(stamp_us)
        vehicle.datagrams(0, combine=False)
        stamp_us += LONG.scenario.rates.control_period_us
    air.vehicle, air.vehicle_us = vehicle, stamp_us
    assert air.reaches("FLY")
    assert air.ground.vehicle_time_us >= stamp_us


def test_another_vehicle_than_the_wanted_one_is_left_alone() -> None:
    air = Air(FLIGHT, system_id=2)
    air.start_vehicle(1)
    assert not air.run(3.0)
    assert air.ground.phase == "SEARCH"
    assert {type(frame.message).id for each in air.from_ground for frame in parse(each)} == {0}
    air.start_vehicle(2)
    assert air.reaches("FLY")
    assert "vehicle 1 found" not in air.said
    assert "vehicle 2 found" in air.said


def test_what_is_not_an_autopilot_is_not_flown() -> None:
    air = Air(FLIGHT)
    station, gimbal = Node(255, 190), Node(4, mavlink.MAV_COMP_ID_GIMBAL)
    station.send(HEARTBEAT, mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
    gimbal.send(HEARTBEAT, mavlink.MAV_TYPE_GIMBAL, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)
    for node in (station, gimbal):
        for datagram in node.datagrams():
            assert air.ground.receive(0, datagram) == 1
    air.run(0.1)
    assert air.ground.phase == "SEARCH"
    assert air.said == []


def test_another_system_s_telemetry_does_not_disturb_the_flight() -> None:
    """With a second autopilot on the link the ground sends, byte for byte, what it sends without it."""
    alone, beside = in_flight(), in_flight()
    other = Node(9, 1)
    nan21 = [float("nan")] * 21
    start = len(alone.from_ground)
    for tick in range(250):
        other.send(HEARTBEAT, mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 1, 0, 3, 3)
        stamp_us = beside.vehicle_us + 1_000_000 * (tick % 2)
        other.send(
            ODOMETRY, stamp_us, 1, 1, 99.0, 99.0, 99.0, (0.0, 1.0, 0.0, 0.0), 9.0, 9.0, 9.0, 1.0, 1.0, 1.0,
            nan21, nan21, 0, 0, 0,
        )  # fmt: skip
        other.send(COMMAND_LONG, 1, 1, mavlink.MAV_CMD_NAV_LAND, 0, *[0.0] * 7)
        for datagram in other.datagrams():
            assert beside.ground.receive(0, datagram) == 1
        for air in (alone, beside):
            air.run(0.004)
    assert len(alone.from_ground) - start >= 250
    assert beside.from_ground == alone.from_ground


def test_a_vehicle_disarmed_by_somebody_else_is_not_armed_again() -> None:
    air = in_flight()
    armed = len(arm_commands(air))
    vehicle = air.vehicle
    assert vehicle is not None
    station = Node(255, 190)
    nan = float("nan")
    station.send(
        COMMAND_LONG, 1, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 0.0, FORCE_DISARM, nan, nan, nan, nan, nan
    )
    for datagram in station.datagrams():
        assert vehicle.receive(0, datagram) == 1
    assert air.reaches("ABORTED", within_s=1.5)
    assert "the vehicle was disarmed in flight" in air.said
    assert air.ground.finished
    assert not air.ground.succeeded
    assert not air.run(5.0)
    assert air.ground.phase == "ABORTED"
    assert len(arm_commands(air)) == armed
    assert not vehicle.autopilot.commander.armed


def test_a_refused_arming_is_asked_for_again() -> None:
    """A vehicle that answers, but whose arming is refused at first: the ground asks again and says so."""
    air = Air(FLIGHT)
    vehicle = air.start_vehicle()
    commander = vehicle.autopilot.commander
    allowed = commander.arming_refusal
    commander.arming_refusal = lambda: "not today"  # type: ignore[method-assign]
    assert not air.run(5.0, lambda: air.ground.phase == "RELEASE")
    assert air.ground.phase == "ARM"
    assert any(text.startswith("arming refused (MAV_RESULT") for text in air.said)
    assert any("not today" in text for text in air.said)
    commander.arming_refusal = allowed  # type: ignore[method-assign]
    assert air.reaches("FLY")


def test_the_oracle_does_not_fly_blind() -> None:
    """A vehicle that refuses the true wind is not flown under the oracle's name."""
    sent: list[int] = []
    said: list[str] = []
    handshake = Handshake(
        lambda command, confirmation, params: sent.append(int(params[0])),
        [(ODOMETRY_ID, 4000), (WIND_ID, 4000)],
        land=True,
        required=frozenset((WIND_ID,)),
        report=said.append,
    )
    heartbeat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 3, 3)
    handshake.on_heartbeat(heartbeat, 1, 1, 0)
    refusal = mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_RESULT_DENIED)
    for now_us in range(0, 100_000, 4000):
        handshake.step(now_us)
        if sent:
            sent.clear()
            handshake.on_message(framed(refusal), now_us)
    assert handshake.phase is Phase.ABORTED
    assert said[-1] == f"no flight without message {WIND_ID}: the scenario needs it"


def test_a_vehicle_whose_heartbeats_are_lost_is_there_as_long_as_anything_comes() -> None:
    said: list[str] = []
    handshake = Handshake(lambda command, confirmation, params: None, [], land=True, report=said.append)
    heartbeat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 3, 3)
    handshake.on_heartbeat(heartbeat, 1, 1, 0)
    attitude = framed(mavlink.MAVLink_attitude_message(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    for now_us in range(0, 10_000_001, 100_000):
        handshake.on_message(attitude, now_us)
        handshake.step(now_us)
    assert handshake.target == (1, 1)
    handshake.step(13_000_000)
    assert handshake.target == (1, 1)
    handshake.step(13_000_001)
    assert handshake.target is None
    assert said[-1] == "vehicle lost: silent for 3 s"


def test_in_flight_the_handshake_waits_for_messages_and_for_silence() -> None:
    air = in_flight()
    handshake = air.ground._handshake
    heard_us = air.ground_us - air.ground.period_us  # what comes is heard at the time of the step before
    assert handshake.due_us == heard_us + SILENCE_TIMEOUT_US
    handshake.step(handshake.due_us)
    assert air.ground.phase == "FLY"
    handshake.armed = False  # by the next HEARTBEAT: from here on each period counts
    assert handshake.due_us == NOW
    handshake.armed = True
    handshake.step(heard_us + SILENCE_TIMEOUT_US + 1)
    assert air.ground.phase == "SEARCH"
    assert handshake.due_us == NOW


def test_a_vehicle_that_boots_is_another_flight() -> None:
    """Killed and started again at once, it speaks before its clock can be seen: it was not disarmed by somebody."""
    air = in_flight()
    air.vehicle = None
    boot = HEARTBEAT(0, 1, 1, mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 1, 0, mavlink.MAV_STATE_BOOT, 3)
    air.ground.receive(0, boot)
    air.run(0.1)
    sent = len(air.from_ground)
    for _ in range(5):
        air.ground.receive(0, boot)
        air.run(0.5)
    assert air.said.count("vehicle lost: it boots") == 1
    assert air.ground.phase == "SEARCH"
    said = {frame.message.get_type() for datagram in air.from_ground[sent:] for frame in parse(datagram)}
    assert said == {"HEARTBEAT"}, "nobody is commanded who boots"
    air.start_vehicle()
    assert air.reaches("FLY")
    assert air.said[-1] == "flying"
