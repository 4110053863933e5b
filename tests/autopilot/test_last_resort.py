"""A handler that fails is a bug; the flight goes on all the same, and the bug is seen."""

from __future__ import annotations

import logging
from typing import Any, NoReturn

import pytest

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import GCS
from tests.autopilot.copter import flying


def test_it_ends_the_message_alone(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    client = flying(2.0)
    autopilot = client.vehicle.autopilot

    def fails(*_: Any) -> NoReturn:
        raise ZeroDivisionError("a bug")

    monkeypatch.setitem(autopilot._handlers, mavlink.MAVLINK_MSG_ID_MANUAL_CONTROL, fails)
    monkeypatch.setattr(autopilot.ports[GCS]._services[mavlink.MAVLINK_MSG_ID_PING], "receive", fails)
    with caplog.at_level(logging.ERROR):
        for _ in range(50):
            assert client.send(mavlink.MAVLink_manual_control_message(1, 0, 0, 0, 0, 0)) == 1
            assert client.send(mavlink.MAVLink_ping_message(0, 1, 0, 0), port=GCS) == 1
            client.tick()
    assert client.vehicle.counters.errors == 100
    assert client.texts()[-1] == "PING dropped: ZeroDivisionError"
    assert len([text for text in client.texts() if "ZeroDivisionError" in text]) == 2
    assert len(caplog.records) == 2
    assert "a bug" in caplog.text  # with its traceback
    assert client.armed
    assert client.send(mavlink.MAVLink_timesync_message(0, 5), port=GCS) == 1
    client.tick()
    assert client.last("TIMESYNC", GCS).ts1 == 5


def test_texts_that_requests_cause_come_at_a_bounded_rate() -> None:
    """A storm of refused requests brings the link a few lines, not one for each."""
    client = flying(2.0)
    before = len(client.texts())

    def storm() -> None:
        client.send(mavlink.MAVLink_mission_count_message(1, 1, 65535, 0))
        client.send(mavlink.MAVLink_set_mode_message(1, 1, 9 << 16))
        client.send(mavlink.MAVLink_command_long_message(1, 1, 400, 0, *[0.0] * 7))

    client.run(4.0, storm)
    assert 3 <= len(client.texts()) - before <= 3 * (10 + 2 * 4 + 1)


def test_the_commands_of_one_sender_are_answered_at_a_bounded_rate_and_others_as_ever() -> None:
    """One request may bring many messages: what it brings is what is counted."""
    client = flying(2.0)
    modes = (mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES, 0)
    before = len(client.all("AVAILABLE_MODES"))
    answered = 0

    def storm() -> None:
        nonlocal answered
        for _ in range(4):
            client.command(*modes, sender=(66, 1))
        answered += len(client.command(mavlink.MAV_CMD_GET_HOME_POSITION, port=GCS))

    client.run(1.0, lambda: storm() if client.now_us % 20_000 == 0 else None)
    assert answered == 50
    assert 0 < len(client.all("AVAILABLE_MODES")) - before <= 200 + 200 + 30
    assert client.vehicle.counters.over_budget > 100
