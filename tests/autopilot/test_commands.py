"""The command protocol at the vehicle: one acknowledgement each, to whom and where, and nothing done twice."""

from __future__ import annotations

from math import nan
from typing import Any

import pytest

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import CLIENT, GCS, OFFBOARD, Client

ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
DENIED = mavlink.MAV_RESULT_DENIED
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM


def command_int(command: int, *params: float, x: int = 0, y: int = 0, z: float = 0.0, frame: int = 0) -> Any:
    filled = (*params, *([nan] * (4 - len(params))))
    return mavlink.MAVLink_command_int_message(1, 1, frame, command, 0, 0, *filled, x, y, z)


COMMANDS = [
    (ARM, (1.0,), ACCEPTED),
    (ARM, (7.0,), DENIED),
    (mavlink.MAV_CMD_DO_SET_MODE, (1.0, 6.0, 0.0), ACCEPTED),
    (mavlink.MAV_CMD_DO_SET_MODE, (1.0, 8.0, 0.0), DENIED),
    (mavlink.MAV_CMD_NAV_LAND, (), ACCEPTED),
    (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (30.0, 1e5), ACCEPTED),
    (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (30.0, 1e6 / 15.0), ACCEPTED),
    (mavlink.MAV_CMD_GET_MESSAGE_INTERVAL, (30.0,), ACCEPTED),
    (mavlink.MAV_CMD_REQUEST_MESSAGE, (30.0,), ACCEPTED),
    (mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, (1.0,), ACCEPTED),
    (mavlink.MAV_CMD_DO_DIGICAM_CONTROL, (), UNSUPPORTED),
    (65535, (), UNSUPPORTED),
]


@pytest.mark.parametrize("form", ["long", "int"])
@pytest.mark.parametrize("port", [OFFBOARD, GCS])
@pytest.mark.parametrize(("command", "params", "result"), COMMANDS)
def test_one_ack_to_the_sender_on_its_port(
    client: Client, form: str, port: int, command: int, params: tuple[float, ...], result: int
) -> None:
    sender = (17, 42)
    if form == "long":
        client.command(command, *params, port=port, sender=sender)
    else:
        client.acks_of(command_int(command, *params), port=port, sender=sender)
    client.run(1.5)
    (ack,) = client.all("COMMAND_ACK")
    assert client.all("COMMAND_ACK", port) == [ack]
    assert (ack.command, ack.result, ack.target_system, ack.target_component) == (command, result, *sender)


def test_unknown_commands_are_named(client: Client) -> None:
    assert client.result(31999) == UNSUPPORTED
    client.tick()
    for port in (OFFBOARD, GCS):
        assert client.texts(port) == ["Command 31999 is not supported"]


@pytest.mark.parametrize("target", [(2, 1), (1, 2), (255, 0), (0, 100)])
def test_commands_for_others_are_left_alone(client: Client, target: tuple[int, int]) -> None:
    assert client.command(ARM, 1, target=target) == []
    client.tick()
    assert not client.armed


@pytest.mark.parametrize("target", [(1, 1), (1, 0), (0, 1), (0, 0)])
def test_broadcast_commands_are_ours(client: Client, target: tuple[int, int]) -> None:
    (ack,) = client.command(ARM, 1, target=target)
    assert ack.result == ACCEPTED


def test_command_int_arms_and_sets_the_mode(client: Client) -> None:
    (ack,) = client.acks_of(command_int(mavlink.MAV_CMD_DO_SET_MODE, 1, 6, x=2**31 - 1, y=-(2**31), z=nan, frame=3))
    assert ack.result == ACCEPTED
    client.attitude()
    (ack,) = client.acks_of(command_int(ARM, 1, frame=5))
    assert ack.result == ACCEPTED
    client.tick()
    assert client.armed
    assert client.flight_mode == (6, 0)


def requests(client: Client, confirmation: int, sender: tuple[int, int] = CLIENT) -> int:
    """AUTOPILOT_VERSIONs that one request brings: a command whose execution can be counted."""
    before = len(client.all("AUTOPILOT_VERSION"))
    options: dict[str, Any] = {"confirmation": confirmation, "sender": sender}
    assert client.result(mavlink.MAV_CMD_REQUEST_MESSAGE, 148, **options) == ACCEPTED
    return len(client.all("AUTOPILOT_VERSION")) - before


def test_a_repeat_is_answered_and_not_executed(client: Client) -> None:
    assert requests(client, 0) == 1
    client.run(0.5)
    assert [requests(client, confirmation) for confirmation in (1, 2, 255)] == [0, 0, 0]
    assert requests(client, 0) == 1  # asked anew
    assert requests(client, 1, sender=(246, 190)) == 1  # somebody else's
    assert requests(client, 1, sender=(CLIENT[0], 191)) == 1


def test_a_repeat_whose_first_frame_was_lost_is_executed(client: Client) -> None:
    assert requests(client, 1) == 1


def test_a_repeat_gets_the_first_answer(client: Client) -> None:
    client.offboard()
    assert client.result(ARM, 1) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    client.attitude()
    assert client.result(ARM, 1, confirmation=1) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert client.result(ARM, 1, confirmation=0) == ACCEPTED


def test_an_old_answer_does_not_pass_for_a_new_command(client: Client) -> None:
    """Armed and disarmed long ago; now arming is asked for anew and its first frame is lost."""
    client.arm()
    client.run(1.0)
    client.disarm()
    client.run(5.0)
    assert client.result(ARM, 1, confirmation=1) == ACCEPTED
    client.tick()
    assert client.armed
