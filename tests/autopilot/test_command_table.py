"""Every row of `commands.TABLE`: what it accepts, each refusal with number and reason, and hostile parameters."""

from __future__ import annotations

from math import inf, nan
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot.commands import TABLE
from mavsitl_vehicle.autopilot.telemetry import BY_ID

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import GCS, OFFBOARD, Client, flight
from tests.autopilot.copter import (
    ACCEPTED,
    DENIED,
    HOLD,
    LAND,
    MISSION,
    REJECTED,
    RETURN,
    UNSUPPORTED,
    WRONG_FRAME,
    command_int,
    fence_circle,
    flying,
    item,
    parameter,
    result_int,
    set_parameter,
    upload,
)

M = mavlink
HERE = (47.3977418, 8.5455939, 500.0)
"""Near where the default scenario stands: latitude, longitude, altitude."""

VERSION_ASKED = (ACCEPTED, "") if 300 in BY_ID else (DENIED, "Request refused: message 300 is not served")
"""PROTOCOL_VERSION is served where the dialect has it."""

Case = tuple[int, tuple[float, ...], int, str]
"""MAV_CMD, parameters, MAV_RESULT, how the STATUSTEXT begins (empty: there is none)."""

ON_THE_GROUND: list[Case] = [
    (M.MAV_CMD_COMPONENT_ARM_DISARM, (0,), ACCEPTED, ""),
    (M.MAV_CMD_COMPONENT_ARM_DISARM, (1,), ACCEPTED, "Armed by external command"),
    (M.MAV_CMD_COMPONENT_ARM_DISARM, (2,), DENIED, "Arm/disarm refused: param1 is 2, need 0 or 1"),
    (M.MAV_CMD_DO_SET_MODE, (1, 4, 3), ACCEPTED, ""),
    (M.MAV_CMD_DO_SET_MODE, (1, 9, 0), DENIED, "Mode refused: main 9 sub 0 is not available"),
    (M.MAV_CMD_DO_SET_STANDARD_MODE, (7,), ACCEPTED, ""),
    (M.MAV_CMD_DO_SET_STANDARD_MODE, (3,), DENIED, "Mode refused: standard mode 3 is not available"),
    (M.MAV_CMD_DO_FLIGHTTERMINATION, (1,), DENIED, "Termination refused: not armed"),
    (M.MAV_CMD_DO_FLIGHTTERMINATION, (3,), DENIED, "Termination refused: param1 is 3, need 0, 1 or 2"),
    (M.MAV_CMD_NAV_TAKEOFF, (), ACCEPTED, ""),
    (M.MAV_CMD_NAV_TAKEOFF, (nan, nan, nan, nan, 99, 0, 500), DENIED, "Take-off refused: latitude 99 deg is not"),
    (M.MAV_CMD_NAV_LAND, (), ACCEPTED, ""),
    (M.MAV_CMD_NAV_RETURN_TO_LAUNCH, (), ACCEPTED, ""),
    (M.MAV_CMD_DO_REPOSITION, (-1, 1, 0, nan, *HERE), REJECTED, "Reposition refused: not armed"),
    (M.MAV_CMD_DO_REPOSITION, (-1, 4, 0, nan, *HERE), UNSUPPORTED, "Reposition refused: param2 is 4, need 1"),
    (M.MAV_CMD_DO_CHANGE_ALTITUDE, (500, 0), REJECTED, "Reposition refused: not armed"),
    (M.MAV_CMD_DO_CHANGE_ALTITUDE, (nan, 0), DENIED, "Change of altitude refused: nan m"),
    (M.MAV_CMD_DO_CHANGE_ALTITUDE, (5, 1), WRONG_FRAME, "Change of altitude refused: frame 1"),
    (M.MAV_CMD_DO_ORBIT, (5, 2), REJECTED, "Orbit refused: not flying"),
    (M.MAV_CMD_DO_CHANGE_SPEED, (1, 3), ACCEPTED, ""),
    (M.MAV_CMD_DO_CHANGE_SPEED, (1, -2), ACCEPTED, ""),
    (M.MAV_CMD_DO_CHANGE_SPEED, (4, 3), DENIED, "Speed refused: type 4, need 0 to 3"),
    (M.MAV_CMD_DO_CHANGE_SPEED, (1, 21), DENIED, "Speed refused: 21 m/s, need above 0 to 20, or -1, -2"),
    (M.MAV_CMD_DO_CHANGE_SPEED, (1, 0), DENIED, "Speed refused: 0 m/s"),
    (M.MAV_CMD_DO_SET_HOME, (1,), ACCEPTED, ""),
    (M.MAV_CMD_DO_SET_HOME, (0, 0, 0, nan, *HERE), ACCEPTED, ""),
    (M.MAV_CMD_DO_SET_HOME, (0,), DENIED, "Home refused: latitude, longitude and altitude are needed"),
    (M.MAV_CMD_DO_SET_HOME, (0, 0, 0, nan, 91, 8, 5), DENIED, "Home refused: latitude 91 deg is not supported"),
    (M.MAV_CMD_MISSION_START, (), DENIED, "Mission start refused: there is no mission"),
    (M.MAV_CMD_DO_PAUSE_CONTINUE, (0,), ACCEPTED, ""),
    (M.MAV_CMD_DO_PAUSE_CONTINUE, (2,), DENIED, "Pause/continue refused: param1 is 2, need 0 or 1"),
    (M.MAV_CMD_DO_SET_MISSION_CURRENT, (0,), DENIED, "Mission item refused: no item 0"),
    (M.MAV_CMD_SET_MESSAGE_INTERVAL, (30, 50_000), ACCEPTED, ""),
    (M.MAV_CMD_SET_MESSAGE_INTERVAL, (30, -1), ACCEPTED, ""),
    (M.MAV_CMD_SET_MESSAGE_INTERVAL, (30, 0), ACCEPTED, ""),
    (M.MAV_CMD_SET_MESSAGE_INTERVAL, (0, 0), ACCEPTED, ""),
    (M.MAV_CMD_SET_MESSAGE_INTERVAL, (0, 1e6), DENIED, "Message interval refused: HEARTBEAT stays at its rate"),
    (M.MAV_CMD_SET_MESSAGE_INTERVAL, (nan, 1e6), DENIED, "Message interval refused: no stream of message nan"),
    (M.MAV_CMD_SET_MESSAGE_INTERVAL, (30, -2), DENIED, "Message interval refused: -2 us, need -1 to "),
    (M.MAV_CMD_GET_MESSAGE_INTERVAL, (30,), ACCEPTED, ""),
    (M.MAV_CMD_GET_MESSAGE_INTERVAL, (-1,), DENIED, "Message interval refused: no message -1"),
    (M.MAV_CMD_REQUEST_MESSAGE, (148,), ACCEPTED, ""),
    (M.MAV_CMD_REQUEST_MESSAGE, (244, 30), ACCEPTED, ""),
    (M.MAV_CMD_REQUEST_MESSAGE, (9999,), DENIED, "Request refused: message 9999 is not served"),
    (M.MAV_CMD_REQUEST_MESSAGE, (nan,), DENIED, "Request refused: message nan is not served"),
    (M.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, (1,), ACCEPTED, ""),
    (M.MAV_CMD_GET_HOME_POSITION, (), ACCEPTED, ""),
    (M.MAV_CMD_REQUEST_FLIGHT_INFORMATION, (1,), ACCEPTED, ""),
    (M.MAV_CMD_REQUEST_PROTOCOL_VERSION, (1,), *VERSION_ASKED),
    (M.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, (0,), ACCEPTED, ""),
    (M.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, (2,), UNSUPPORTED, "Reboot refused: param1 is 2, need 0 or 1"),
    (M.MAV_CMD_PREFLIGHT_CALIBRATION, (1, 0, 0, 0, 0, 0, 0), UNSUPPORTED, "Calibration refused: simulated sensors"),
    (M.MAV_CMD_PREFLIGHT_CALIBRATION, (0, 0, 0, 0, 0, 0, 0), ACCEPTED, ""),
    (M.MAV_CMD_PREFLIGHT_STORAGE, (1,), ACCEPTED, ""),
    (M.MAV_CMD_PREFLIGHT_STORAGE, (2,), ACCEPTED, ""),
    (M.MAV_CMD_PREFLIGHT_STORAGE, (9,), UNSUPPORTED, "Storage refused: param1 is 9"),
    (M.MAV_CMD_RUN_PREARM_CHECKS, (), ACCEPTED, ""),
    (M.MAV_CMD_INJECT_FAILURE, (4, 1), DENIED, "Failure injection refused: SYS_FAILURE_EN is 0"),
]


def test_every_row_has_its_cases() -> None:
    assert {case[0] for case in ON_THE_GROUND} == set(TABLE)
    assert all(row.text for row in TABLE.values())


@pytest.mark.parametrize(("command", "params", "result", "text"), ON_THE_GROUND)
@pytest.mark.parametrize("form", ["long", "int"])
def test_on_the_ground(form: str, command: int, params: tuple[float, ...], result: int, text: str) -> None:
    client = Client(flight())
    client.run(0.2)
    if form == "long":
        acks = client.command(command, *params)
    else:
        filled = (*params, *([nan] * (7 - len(params))))
        x, y = (2**31 - 1 if value != value else round(value * 1e7) for value in filled[4:6])
        message = command_int(command, *filled[:4], x=x, y=y, z=filled[6], frame=M.MAV_FRAME_GLOBAL)
        acks = client.acks_of(message)
    assert [(ack.command, ack.result) for ack in acks] == [(command, result)]
    client.tick()
    said = client.texts(GCS)
    if text:
        assert said[0].startswith(text)
    else:
        assert said == []


# --- in flight


IN_FLIGHT: list[Case] = [
    (M.MAV_CMD_DO_REPOSITION, (-1, 0, 0, nan, *HERE), ACCEPTED, ""),  # holding already
    (M.MAV_CMD_DO_ORBIT, (0.5, 2), DENIED, "Orbit refused: radius 0.5 m, need 1 to 1000"),
    (M.MAV_CMD_DO_ORBIT, (2000, 2), DENIED, "Orbit refused: radius 2000 m, need 1 to 1000"),
    (M.MAV_CMD_MISSION_START, (), DENIED, "Mission start refused: there is no mission"),
    (M.MAV_CMD_DO_PAUSE_CONTINUE, (1,), REJECTED, "AUTO.MISSION refused: there is no mission"),
    (M.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, (1,), DENIED, "Reboot refused: armed"),
    (M.MAV_CMD_PREFLIGHT_CALIBRATION, (1,), REJECTED, "Calibration refused: armed"),
    (M.MAV_CMD_PREFLIGHT_STORAGE, (2,), REJECTED, "Storage refused: armed"),
    (M.MAV_CMD_COMPONENT_ARM_DISARM, (0,), DENIED, "Disarming denied: not landed"),
    (M.MAV_CMD_COMPONENT_ARM_DISARM, (1,), ACCEPTED, ""),
]


def test_in_flight() -> None:
    client = flying(3.0)
    for command, params, result, text in IN_FLIGHT:
        before = len(client.texts())
        assert client.result(command, *params) == result, (command, params)
        client.tick()
        said = client.texts()[before:]
        assert (said and said[0].startswith(text)) if text else not said, (command, params, said)
    assert client.armed


def test_reposition_needs_its_bit_unless_holding() -> None:
    client = flying(3.0)
    client.land()
    client.tick()
    assert client.result(M.MAV_CMD_DO_REPOSITION, -1, 0, nan, nan, *HERE) == UNSUPPORTED
    client.tick()
    assert client.flight_mode == LAND
    assert client.texts()[-1] == "Reposition refused: param2 bit 0 (change mode) is not set"
    assert client.result(M.MAV_CMD_DO_REPOSITION, -1, 1, nan, nan, *HERE) == ACCEPTED
    client.tick()
    assert client.flight_mode == HOLD


def test_reposition_on_the_ground_and_out_of_the_fence() -> None:
    client = Client(flight())
    client.run(0.2)
    upload(client, [fence_circle(client, 20.0)], 1)
    client.arm()
    assert client.result(M.MAV_CMD_DO_REPOSITION, -1, 1, nan, nan, *HERE) == REJECTED
    client.tick()
    assert client.texts()[-1] == "Reposition refused: landed"
    client.result(M.MAV_CMD_NAV_TAKEOFF)
    client.run(6.0)
    far = client.vehicle.autopilot.origin.to_global(50.0, 0.0)
    assert client.result(M.MAV_CMD_DO_REPOSITION, -1, 1, nan, nan, *far, 495.0) == DENIED
    client.tick()
    assert client.texts()[-1].startswith("Reposition refused: ")
    assert client.flight_mode == HOLD


@pytest.mark.parametrize("frame", [1, 2, 4, 7, 8, 9, 12, 20])
@pytest.mark.parametrize("command", [M.MAV_CMD_NAV_TAKEOFF, M.MAV_CMD_DO_SET_HOME])
def test_frames_that_place_nothing(frame: int, command: int, client: Client) -> None:
    client.run(0.2)
    assert result_int(client, command, 0, x=1, y=1, z=5.0, frame=frame) == WRONG_FRAME
    client.tick()
    assert f"frame {frame} is not supported" in client.texts()[-1]


def test_mission_start_at_an_item_and_beyond() -> None:
    client = Client(flight())
    client.run(0.2)
    upload(client, [item(client, 22, height_m=3.0), item(client, 16, at=(3, 0), height_m=3.0)])
    assert client.result(M.MAV_CMD_MISSION_START, 7, 0) == DENIED
    client.tick()
    assert client.texts()[-1] == "Mission start refused: no item 7"
    assert client.result(M.MAV_CMD_MISSION_START, 1e30, 0) == DENIED
    assert client.result(M.MAV_CMD_MISSION_START, 1, 0) == ACCEPTED
    client.run(0.2)
    assert client.flight_mode == MISSION
    assert client.last("MISSION_CURRENT", OFFBOARD).seq == 1


def test_injection_is_refused_by_name_where_it_is_allowed(client: Client) -> None:
    set_parameter(client, "SYS_FAILURE_EN", 1)
    assert client.result(M.MAV_CMD_INJECT_FAILURE, 200, 1, 0) == UNSUPPORTED
    client.tick()
    assert client.texts()[-1].startswith("Failure injection refused: ")


def test_prearm_checks_say_why(client: Client) -> None:
    client.run(0.2)
    client.mode(*RETURN)
    assert client.result(M.MAV_CMD_RUN_PREARM_CHECKS) == ACCEPTED
    client.tick()
    assert client.texts() == ["Preflight Fail: mode AUTO.RTL does not allow arming"]


def test_storage_resets_the_parameters(client: Client) -> None:
    client.send(parameter("MIS_TAKEOFF_ALT", 7.0))
    assert client.vehicle.parameters["MIS_TAKEOFF_ALT"] == 7.0
    assert client.result(M.MAV_CMD_PREFLIGHT_STORAGE, 2) == ACCEPTED
    assert client.vehicle.parameters["MIS_TAKEOFF_ALT"] == 2.5


# --- hostile


HOSTILE = st.one_of(
    st.sampled_from([nan, inf, -inf, 0.0, -0.0, 1.0, -1.0, 2.0**31, -(2.0**31), 3.4e38, -3.4e38, 1e-45, 0.5, 255.0]),
    st.floats(width=32),
    st.integers(-3, 600).map(float),
)
WHOLE = st.integers(-(2**31), 2**31 - 1)
_GROUND, _AIR = Client(flight()), flying(3.0)


@pytest.mark.parametrize("where", ["ground", "air"])
@settings(max_examples=400, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    command=st.one_of(st.sampled_from(sorted(TABLE)), st.integers(0, 65535)),
    params=st.tuples(*[HOSTILE] * 7), frame=st.integers(0, 255), x=WHOLE, y=WHOLE, long=st.booleans(),
)  # fmt: skip
def test_nothing_that_is_sent_raises(
    where: str, command: int, params: tuple[float, ...], frame: int, x: int, y: int, long: bool
) -> None:
    """One ack each, with a known result, and a vehicle that goes on, wherever it is."""
    client = _GROUND if where == "ground" else _AIR
    message: Any
    if long:
        message = M.MAVLink_command_long_message(1, 1, command, 0, *params)
    else:
        message = M.MAVLink_command_int_message(1, 1, frame, command, 0, 0, *params[:4], x, y, params[6])
    client.inbox.clear()
    (ack,) = client.acks_of(message)
    assert ack.command == command
    assert ack.result in range(10)
    client.tick()
    client.tick()
    assert all(value == value and abs(value) < 1e4 for value in client.truth)
