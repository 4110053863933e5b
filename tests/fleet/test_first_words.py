"""A fleet is heard while it is being built: each vehicle's HEARTBEAT, and then its own messages in sequence."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from mavsitl.codec import Frame, parse
from mavsitl.dialect import mavlink
from mavsitl.link.udp import LOOPBACK
from tests.bench.bench_fleet import free_block
from tests.fleet.test_processes import PATIENCE_S, process

COUNT = 3


def until_built(*options: str) -> list[Frame]:
    """What the ground stations' port hears, in order, until each vehicle has said that it stands by."""
    ports = free_block(2 * COUNT)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind((LOOPBACK, 0))
        station.settimeout(PATIENCE_S)
        remote = f"{LOOPBACK}:{station.getsockname()[1]}"
        arguments = ("formation-spiral", "--count", f"{COUNT}", "--no-state", "--gcs-remote", remote)
        where = ("--offboard-port", f"{ports}", "--gcs-port", f"{ports + COUNT}")
        with process("vehicle", *arguments, *where, *options):
            return list(_frames(station))


def _frames(station: socket.socket) -> Iterator[Frame]:
    waiting = set(range(1, COUNT + 1))
    while waiting:
        for frame in parse(station.recv(65535)):
            yield frame
            if frame.message.get_type() == "HEARTBEAT" and frame.message.system_status != mavlink.MAV_STATE_BOOT:
                waiting.discard(frame.system_id)


@pytest.mark.sockets
@pytest.mark.parametrize("options", [(), ("--one-link",)])
def test_each_vehicle_is_heard_before_it_is_built(options: tuple[str, ...]) -> None:
    frames = until_built(*options)
    for system_id in range(1, COUNT + 1):
        own = [frame for frame in frames if frame.system_id == system_id]
        assert own[0].message.get_type() == "HEARTBEAT"
        assert own[0].message.system_status == mavlink.MAV_STATE_BOOT
        assert [frame.sequence for frame in own] == [number & 0xFF for number in range(len(own))]


@pytest.mark.sockets
def test_nobody_speaks_over_an_impaired_link_before_its_clock_begins() -> None:
    frames = until_built("--set", "gcs_link.to_ground.latency_ms=1")
    states = [frame.message.system_status for frame in frames if frame.message.get_type() == "HEARTBEAT"]
    assert states
    assert mavlink.MAV_STATE_BOOT not in states
