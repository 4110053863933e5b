"""A client that we did not write flies the vehicle: pymavlink's own mavutil, in real time over UDP."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from mavsitl.pair import free_ports

pytestmark = [pytest.mark.interop, pytest.mark.sockets]

OFFBOARD_MAIN_MODE = 6
PATIENCE_S = 30.0


@pytest.fixture
def client() -> Iterator[Any]:
    """A mavutil connection to a vehicle process of its own, in the clamp in calm air."""
    from pymavlink import mavutil

    own, remote, gcs = free_ports(3)
    vehicle = subprocess.Popen(
        [
            sys.executable, "-m", "mavsitl", "vehicle", "hover-calm", "--offboard-port", str(own),
            "--offboard-remote", f"127.0.0.1:{remote}", "--gcs-port", str(gcs), "--gcs-remote", f"127.0.0.1:{gcs}",
        ],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    connection = mavutil.mavlink_connection(f"udpin:127.0.0.1:{remote}", dialect="development", source_system=255)
    try:
        yield connection
    finally:
        connection.close()
        vehicle.terminate()
        output, _ = vehicle.communicate(timeout=PATIENCE_S)
    assert vehicle.returncode == 0, output
    assert re.search(r"\d frames in", output)


def answer(client: Any, command: int, *params: float) -> int:
    """The MAV_RESULT of a COMMAND_LONG."""
    client.mav.command_long_send(1, 1, command, 0, *params, *([0.0] * (7 - len(params))))
    while True:
        ack = client.recv_match(type="COMMAND_ACK", blocking=True, timeout=PATIENCE_S)
        assert ack is not None, f"no answer to command {command}"
        if ack.command == command:
            return int(ack.result)


def test_mavutil_sees_a_px4_and_flies_it_off_board(client: Any) -> None:
    from pymavlink import mavutil

    link = mavutil.mavlink
    heartbeat = client.wait_heartbeat(timeout=PATIENCE_S)
    assert (heartbeat.type, heartbeat.autopilot) == (link.MAV_TYPE_QUADROTOR, link.MAV_AUTOPILOT_PX4)
    assert client.flightmode == "LOITER"

    assert (
        answer(client, link.MAV_CMD_REQUEST_MESSAGE, link.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == link.MAV_RESULT_ACCEPTED
    )
    assert client.messages["AUTOPILOT_VERSION"].flight_sw_version >> 24 == 1
    assert answer(client, link.MAV_CMD_USER_1) == link.MAV_RESULT_UNSUPPORTED

    assert answer(client, link.MAV_CMD_DO_SET_MODE, 1, OFFBOARD_MAIN_MODE) == link.MAV_RESULT_ACCEPTED
    assert answer(client, link.MAV_CMD_COMPONENT_ARM_DISARM, 1) == link.MAV_RESULT_TEMPORARILY_REJECTED

    def stream(thrust: float) -> None:
        client.mav.set_attitude_target_send(0, 1, 1, 0b00000111, [1, 0, 0, 0], 0, 0, 0, thrust)

    stream(0.5)
    assert answer(client, link.MAV_CMD_COMPONENT_ARM_DISARM, 1) == link.MAV_RESULT_ACCEPTED
    heights: list[float] = []
    while not heights or heights[-1] > -1.5:  # NED: the clamp is at -1, the vehicle rises
        stream(0.6)
        position = client.recv_match(type="LOCAL_POSITION_NED", blocking=True, timeout=PATIENCE_S)
        assert position is not None
        heights.append(position.z)
        assert len(heights) < 300, "ten seconds of 0.6 thrust did not lift it half a metre"
    assert client.motors_armed()
    assert client.flightmode == "OFFBOARD"
    assert answer(client, link.MAV_CMD_COMPONENT_ARM_DISARM, 0) == link.MAV_RESULT_DENIED
    assert answer(client, link.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196) == link.MAV_RESULT_ACCEPTED
