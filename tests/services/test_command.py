"""The command service by itself: the side that answers, and the side that asks."""

from __future__ import annotations

from math import inf, isnan, nan
from typing import Any

import pytest

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.services.command import Command, CommandClient, CommandServer

LAND = mavlink.MAV_CMD_NAV_LAND
ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
DENIED = mavlink.MAV_RESULT_DENIED


def wire(message: Any) -> Any:
    """The message as its receiver sees it."""
    (frame,) = parse(encode(message, 0, 245, 190))
    return frame.message


def command_long(*params: float, command: int = LAND, confirmation: int = 0) -> Any:
    return wire(mavlink.MAVLink_command_long_message(1, 1, command, confirmation, *params, *[0.0] * (7 - len(params))))


class Server:
    def __init__(self, result: int = ACCEPTED) -> None:
        self.executed: list[tuple[Command, int]] = []
        self.result = result
        self.server = CommandServer(self._execute)

    def _execute(self, command: Command, now_us: int) -> int:
        self.executed.append((command, now_us))
        return self.result

    def receive(self, message: Any, now_us: int = 0, sender: tuple[int, int] = (245, 190)) -> tuple[int, int]:
        return self.server.receive(message, *sender, now_us)


def test_command_long_is_read() -> None:
    server = Server()
    assert server.receive(command_long(1, 2, 3, 4, 5, 6, 7), 99) == (LAND, ACCEPTED)
    assert server.executed == [(Command(LAND, (1, 2, 3, 4, 5, 6, 7), None, 245, 190), 99)]


def test_command_int_is_read() -> None:
    server = Server(DENIED)
    message = mavlink.MAVLink_command_int_message(1, 1, 6, LAND, 0, 0, 1, 2, 3, 4, 2**31 - 1, -(2**31), 7)
    assert server.receive(wire(message)) == (LAND, DENIED)
    assert server.executed == [(Command(LAND, (1, 2, 3, 4, 2**31 - 1, -(2**31), 7), 6, 245, 190), 0)]


@pytest.mark.parametrize(
    ("value", "integer"),
    [(0.0, 0), (-1.0, -1), (-0.0, 0), (2.0**40, 2**40), (0.5, None), (nan, None), (inf, None), (-inf, None)],
)
def test_integer_parameters(value: float, integer: int | None) -> None:
    assert Command(LAND, (0, 0, value, 0, 0, 0, 0), None, 1, 1).integer(3) == integer


def test_repeats_with_nan_are_recognised() -> None:
    server = Server()
    for confirmation in range(4):
        assert server.receive(command_long(nan, confirmation=confirmation)) == (LAND, ACCEPTED)
    assert len(server.executed) == 1


def test_other_parameters_are_another_command() -> None:
    server = Server()
    server.receive(command_long(1))
    server.receive(command_long(2, confirmation=1))
    server.receive(command_long(1, command=22, confirmation=1))
    assert len(server.executed) == 3


def test_memory_lasts_from_the_last_repeat() -> None:
    server = Server()
    server.receive(command_long(), 0)
    last = CommandServer.MEMORY_US - 1
    for now_us in (last, 2 * last, 3 * last):
        server.receive(command_long(confirmation=1), now_us)
    assert len(server.executed) == 1
    server.receive(command_long(confirmation=1), 3 * last + CommandServer.MEMORY_US)
    assert len(server.executed) == 2


def test_memory_is_bounded() -> None:
    server = Server()
    for number in range(CommandServer.REMEMBERED + 1):
        server.receive(command_long(number))
    assert len(server.server._answers) == CommandServer.REMEMBERED
    executed = len(server.executed)
    server.receive(command_long(1, confirmation=1))
    assert len(server.executed) == executed  # the second oldest is known still
    server.receive(command_long(0, confirmation=1))
    assert len(server.executed) == executed + 1  # the oldest gave way


# --- asking


class Asker:
    def __init__(self) -> None:
        self.sent: list[tuple[int, int, tuple[float, ...]]] = []
        self.client = CommandClient(lambda *sent: self.sent.append(sent), timeout_us=500_000, tries=3)

    def ack(self, result: int, command: int = LAND) -> None:
        self.client.receive(wire(mavlink.MAVLink_command_ack_message(command, result)))


def test_it_repeats_with_rising_confirmation_and_gives_up() -> None:
    asker = Asker()
    asker.client.start(LAND, 1.0)
    times = []
    for now_us in range(0, 3_000_000, 100_000):
        before = len(asker.sent)
        asker.client.step(now_us)
        times += [now_us] * (len(asker.sent) - before)
    assert times == [0, 500_000, 1_000_000]
    assert [confirmation for _, confirmation, _ in asker.sent] == [0, 1, 2]
    command, _, params = asker.sent[0]
    assert (command, params[0], len(params)) == (LAND, 1.0, 7)
    assert all(isnan(value) for value in params[1:])
    assert not asker.client.busy
    assert asker.client.result is None


@pytest.mark.parametrize("result", [ACCEPTED, DENIED, mavlink.MAV_RESULT_UNSUPPORTED])
def test_an_answer_ends_it(result: int) -> None:
    asker = Asker()
    asker.client.start(LAND)
    asker.client.step(0)
    asker.ack(ACCEPTED, command=22)  # of another command
    asker.ack(mavlink.MAV_RESULT_IN_PROGRESS)
    assert asker.client.busy
    asker.ack(result)
    assert not asker.client.busy
    assert asker.client.result == result
    asker.client.step(10_000_000)
    assert len(asker.sent) == 1


def test_cancel_and_start_anew() -> None:
    asker = Asker()
    asker.client.start(LAND)
    asker.client.step(0)
    asker.client.cancel()
    asker.ack(ACCEPTED)
    assert asker.client.result is None
    asker.client.start(22)
    asker.client.step(100_000)
    assert [sent[:2] for sent in asker.sent] == [(LAND, 0), (22, 0)]


def test_the_two_sides_execute_once_over_a_lossy_link() -> None:
    server = Server()
    asker = Asker()
    asker.client.start(LAND, nan)
    for now_us in range(0, 1_500_000, 100_000):
        before = len(asker.sent)
        asker.client.step(now_us)
        for command, confirmation, params in asker.sent[before:]:
            message = command_long(*params, command=command, confirmation=confirmation)
            command_id, result = server.receive(message, now_us)
            if confirmation == 2:  # the first two answers are lost
                asker.ack(result, command_id)
    assert asker.client.result == ACCEPTED
    assert len(asker.sent) == 3
    assert len(server.executed) == 1
