"""PREFLIGHT_REBOOT_SHUTDOWN as a client sees it: an answer, then a clock that begins anew on the same links."""

from __future__ import annotations

from itertools import pairwise

import pytest
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.codec import parse
from mavsitl.dialect import mavlink
from mavsitl.log.ulog import MemoryRecorder
from tests.autopilot.conftest import GCS, OFFBOARD, Client, flight


@pytest.fixture
def client() -> Client:
    client = Client()
    client.run(1.3)
    return client


def reboot(client: Client, port: int = OFFBOARD) -> None:
    """As in a live vehicle, what it sends is looked at only after its next step."""
    command = mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
    client.send(mavlink.MAVLink_command_long_message(1, 1, command, 0, 1, 0, 0, 0, 0, 0, 0), port=port)


@pytest.mark.parametrize("port", [OFFBOARD, GCS])
def test_a_reboot_is_answered_on_the_link_that_asked(client: Client, port: int) -> None:
    before_us = client.now_us
    reboot(client, port)
    client.run(1.0)
    (ack,) = client.all("COMMAND_ACK", port)
    assert (ack.command, ack.result) == (mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, mavlink.MAV_RESULT_ACCEPTED)
    assert not client.all("COMMAND_ACK", GCS if port == OFFBOARD else OFFBOARD)
    boots = [message.time_boot_ms for message in client.all("ATTITUDE", GCS, since_us=before_us)]
    assert boots[0] < 200
    assert 700 < boots[-1] < 1100
    assert client.all("HEARTBEAT", GCS, since_us=before_us)


def test_a_reboot_leaves_no_gap_in_the_sequence_numbers(client: Client) -> None:
    reboot(client)
    client.run(1.0)
    for wire in client.wire:
        numbers = [parse(datagram)[0].sequence for datagram in wire]
        assert len(numbers) > 100
        assert all((late - early) & 0xFF == 1 for early, late in pairwise(numbers))


def test_nothing_is_said_before_the_first_step() -> None:
    """Until then others may have spoken for it, and the numbers go on from theirs."""
    vehicle = Vehicle(flight(), MemoryRecorder(), seed=1, ports=("offboard", "gcs"))
    assert not vehicle.datagrams(OFFBOARD, combine=False)
    assert not vehicle.datagrams(GCS, combine=False)
    vehicle.continue_from(255)
    vehicle.step(0)
    frames = [parse(datagram)[0] for datagram in vehicle.datagrams(GCS, combine=False)]
    assert [frame.sequence for frame in frames] == [(255 + n) & 0xFF for n in range(len(frames))]
    assert {"HEARTBEAT", "HOME_POSITION"} <= {frame.message.get_type() for frame in frames}


def test_what_came_on_any_link_is_counted(client: Client) -> None:
    reboot(client, OFFBOARD)
    client.run(0.1)
    reboot(client, GCS)
    client.vehicle.receive(GCS, b"\xfd junk")
    assert client.vehicle.counters.frames == 2
    assert client.vehicle.counters.rejected == 1
