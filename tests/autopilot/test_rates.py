"""SET_MESSAGE_INTERVAL: every stream at odd intervals is delivered within 2 %, on each link for itself."""

from __future__ import annotations

from collections import Counter

import pytest
from mavsitl_vehicle.autopilot.telemetry import STREAMS, Schedule

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import GCS, OFFBOARD, Client
from tests.autopilot.test_telemetry import names_sent

TICK_US = 4000
ODD_US = (4_001, 5_000, 6_667, 7_777, 9_999, 13_333, 16_667, 33_333, 41_666, 123_457)
"""Hardly any is a multiple of the tick."""


@pytest.mark.parametrize("shift", range(len(ODD_US)))
def test_every_stream_at_an_odd_interval_all_at_once(shift: int) -> None:
    schedule = Schedule("gcs")
    intervals = {stream: ODD_US[(index + shift) % len(ODD_US)] for index, stream in enumerate(STREAMS)}
    for stream, interval_us in intervals.items():
        schedule.set_interval(stream.message_id, interval_us, 0)
    per_message = Counter(name for _, name in names_sent(schedule, 20.0))
    modes = per_message.pop("AVAILABLE_MODES", 0)
    for stream, interval_us in intervals.items():
        if stream.name != "AVAILABLE_MODES":
            assert per_message.pop(stream.name) == pytest.approx(20e6 / interval_us, rel=0.02), stream.name
    assert not per_message
    assert modes > 0


@pytest.mark.parametrize("interval_us", [4_500, 7_777, 30_303, 166_667])
def test_a_link_gets_what_it_asked_for_and_the_other_what_it_had(interval_us: int) -> None:
    client = Client()
    asked = ("ATTITUDE", "GLOBAL_POSITION_INT", "HIL_STATE_QUATERNION", "VFR_HUD", "SYSTEM_TIME")
    client.run(1.0)
    before = {name: len(client.all(name, OFFBOARD)) for name in asked}
    for name in asked:
        message_id = getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
        assert client.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_us, port=GCS) == 0
    begin_us = client.now_us
    client.run(12.0)
    for name in asked:
        assert len(client.all(name, GCS, begin_us)) == pytest.approx(12e6 / interval_us, rel=0.02, abs=1), name
        expected = 12 * before[name]
        assert len(client.all(name, OFFBOARD, begin_us)) == pytest.approx(expected, rel=0.05, abs=12), name


def test_no_stream_is_faster_than_the_control_rate() -> None:
    client = Client()
    attitude = mavlink.MAVLINK_MSG_ID_ATTITUDE
    assert client.result(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, attitude, 100, port=GCS) == 0
    begin_us = client.now_us
    client.run(2.0)
    assert len(client.all("ATTITUDE", GCS, begin_us)) == 2_000_000 // TICK_US
