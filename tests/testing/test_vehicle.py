"""A vehicle that a test drives by messages: in simulated time, repeatable, over links that may be bad."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mavsitl_vehicle.autopilot import modes
from pymavlink.dialects.v20 import common

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.px4_modes import MODES, NAV_STATES
from mavsitl.testing import FlightAssertionError, State, Vehicle, assert_flight


def setpoint(north_m: float, east_m: float, down_m: float) -> Any:
    return mavlink.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, 0b110111111000, north_m, east_m, down_m, 0, 0, 0, 0, 0, 0, 0, 0
    )


def off_board(vehicle: Vehicle, seconds: float) -> None:
    """From the ground to (2, 1, -3) m in OFFBOARD."""
    vehicle.takeoff(3.0)
    with vehicle.stream(setpoint(2.0, 1.0, -3.0), hz=20.0):
        vehicle.run(0.2)
        assert vehicle.set_mode("OFFBOARD") == "ACCEPTED"
        vehicle.run(seconds)


def test_an_off_board_flight_and_what_follows_when_the_stream_ends() -> None:
    vehicle = Vehicle()
    off_board(vehicle, 6.0)
    assert_flight(vehicle).reaches((2.0, 1.0, -3.0), within_m=0.2).never_failsafe()
    vehicle.run_until(lambda state: not state.armed, within_s=60.0)
    assert_flight(vehicle).lands().had_failsafe("off-board signal lost").entered("AUTO.RTL")
    assert [mode for _, mode in vehicle.modes][:5] == [
        "AUTO.LOITER", "AUTO.TAKEOFF", "AUTO.LOITER", "OFFBOARD", "AUTO.RTL"
    ]  # fmt: skip


def test_equal_tests_are_equal_flights_and_over_20_percent_loss_too() -> None:
    tracks = []
    for _ in range(2):
        vehicle = Vehicle(seed=4)
        vehicle.faults.link(loss=0.2, latency_ms=20.0)
        off_board(vehicle, 3.0)
        tracks.append(vehicle.truth.position_ned_m)
    np.testing.assert_array_equal(tracks[0], tracks[1])
    assert vehicle._channels["offboard"].to_vehicle.statistics.lost > 0


def test_time_passes_when_the_test_says_so() -> None:
    vehicle = Vehicle()
    assert vehicle.time_s == 0.0
    assert vehicle.run(1.5).time_s == 1.5
    assert len(vehicle.truth) == 376
    first = vehicle.last("ATTITUDE")
    assert first is not None
    assert first.time_boot_ms <= 1500
    message = vehicle.wait("ATTITUDE", within_s=1.0)
    assert message.time_boot_ms > 1500


def test_a_message_is_one_of_any_dialect_or_bytes() -> None:
    vehicle = Vehicle()
    request = (1, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 0, 0, 0, 0, 0, 0)
    for what in (
        common.MAVLink_command_long_message(*request),
        mavlink.MAVLink_command_long_message(*request),
        encode(mavlink.MAVLink_command_long_message(*request), 0, 255, 190),
        [mavlink.MAVLink_command_long_message(*request)],
    ):
        vehicle.send(what)
        assert vehicle.wait("AUTOPILOT_VERSION", within_s=0.1)
    with pytest.raises(TypeError, match="not str"):
        vehicle.send("HEARTBEAT")


def test_a_stack_of_ones_own_gets_the_datagrams() -> None:
    vehicle = Vehicle(port="gcs")
    vehicle.run(1.1)
    names = [frame.message.get_type() for datagram in vehicle.receive() for frame in parse(datagram)]
    assert "HEARTBEAT" in names
    assert names == [message.get_type() for message in vehicle.messages()]
    assert vehicle.receive() == []


def test_each_link_has_its_own_messages() -> None:
    vehicle = Vehicle()
    vehicle.command("REQUEST_MESSAGE", mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, port="gcs")
    assert vehicle.messages("COMMAND_ACK", port="gcs")
    assert not vehicle.messages("COMMAND_ACK")
    vehicle.run(1.0)
    assert not vehicle.messages("HEARTBEAT", after_s=vehicle.time_s + 1.0)


def test_a_stream_may_be_made_of_the_state_and_ends_with_its_block() -> None:
    vehicle = Vehicle()
    asked: list[State] = []

    def each(state: State) -> Any:
        asked.append(state)
        return None if len(asked) % 2 else setpoint(0.0, 0.0, 0.0)

    with vehicle.stream(each, hz=10.0):
        vehicle.run(2.0)
    vehicle.run(1.0)
    assert [state.time_s for state in asked] == pytest.approx([number / 10.0 for number in range(20)], abs=0.004)
    assert vehicle.core.counters.frames == 10
    with pytest.raises(ValueError, match="hz is 0"):
        vehicle.stream(each, hz=0.0)


def test_a_command_is_repeated_and_a_refusal_has_its_name() -> None:
    vehicle = Vehicle()
    vehicle.faults.chaos("ack-first-lost")
    assert vehicle.arm() == "ACCEPTED"
    assert vehicle.set_mode("OFFBOARD") == "TEMPORARILY_REJECTED"
    assert_flight(vehicle).says("OFFBOARD refused")
    vehicle.faults.chaos("ack-lost")
    with pytest.raises(FlightAssertionError, match=r"acknowledges COMPONENT_ARM_DISARM within 1 s"):
        vehicle.command("COMPONENT_ARM_DISARM", 0, within_s=1.0)


def test_what_does_not_come_says_what_came() -> None:
    vehicle = Vehicle()
    with pytest.raises(FlightAssertionError, match=r"COMMAND_ACK that suits comes .* 0\.5 s\n  came: \d+ ATTITUDE"):
        vehicle.wait("COMMAND_ACK", within_s=0.5, where=lambda ack: True)
    with pytest.raises(FlightAssertionError, match="it did not"):
        vehicle.run_until(lambda state: state.armed, within_s=0.1)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda vehicle: vehicle.wait("ATITUDE"), "'ATITUDE' is no message; near it: ATTITUDE"),
        (lambda vehicle: vehicle.command("ARM"), "'ARM' is no MAV_CMD; near it: .*COMPONENT_ARM_DISARM"),
        (lambda vehicle: vehicle.set_mode("HOLD"), "'HOLD' is no mode; allowed: MANUAL,"),
        (lambda vehicle: vehicle.send(b"", port="gsc"), "port: 'gsc' is not allowed; allowed: 'offboard', 'gcs'"),
        (lambda vehicle: vehicle.takeoff(-1.0), "takeoff: MIS_TAKEOFF_ALT: -1 m is not allowed"),
        (lambda vehicle: assert_flight(vehicle).mode_was("HOVER"), "'HOVER' is no mode"),
    ],
)
def test_wrong_names_are_told(call: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        call(Vehicle())


def test_the_modes_are_the_vehicles() -> None:
    """One table in the bridge, which may not look into the wing."""
    rows = {row.name: (row.nav_state, row.main_mode, row.sub_mode) for row in modes.TABLE.values()}
    assert rows == {name: tuple(numbers) for name, numbers in MODES.items()}
    assert len(NAV_STATES) == len(MODES)


# --- as pymavlink's mavutil


def test_a_program_for_mavutil_flies_in_simulated_time() -> None:
    vehicle = Vehicle(port="gcs")
    link = vehicle.connection()
    assert link.wait_heartbeat(timeout=3.0) is not None
    assert (link.target_system, link.target_component) == (1, 1)
    assert not link.motors_armed()
    link.mav.command_long_send(1, 1, mavlink.MAV_CMD_NAV_TAKEOFF, 0, *[float("nan")] * 7)
    ack = link.recv_match(type="COMMAND_ACK", blocking=True, timeout=3.0)
    assert ack is not None
    assert ack.get_srcSystem() == 1
    link.mav.command_long_send(1, 1, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0)
    climbed = link.recv_match(
        lambda message: message.relative_alt > 2000, type=["GLOBAL_POSITION_INT"], blocking=True, timeout=20.0
    )
    assert climbed is not None
    assert link.motors_armed()
    assert link.messages["GLOBAL_POSITION_INT"] is climbed
    assert link.time_since("GLOBAL_POSITION_INT") == pytest.approx(0.0)


def test_a_loop_that_does_not_block_ends_and_time_goes_on() -> None:
    vehicle = Vehicle()
    link = vehicle.connection()
    while (message := link.recv_msg()) is None or message.get_type() != "HEARTBEAT":
        pass
    assert vehicle.time_s > 0.0
    before_s = vehicle.time_s
    assert link.recv_match(type="COMMAND_ACK", blocking=True, timeout=1.0) is None
    assert vehicle.time_s == pytest.approx(before_s + 1.0, abs=0.005)
    assert link.recv_match(type="COMMAND_ACK") is None
    with pytest.raises(TypeError, match="not text"):
        link.recv_match("ATTITUDE.roll > 1")  # type: ignore[arg-type]
