"""What the vehicle says reaches whoever runs the ground as whole lines."""

from __future__ import annotations

from mavsitl_ground.controller import Ground

from mavsitl.dialect import mavlink
from mavsitl.ends import NullRecorder
from mavsitl.node import Node
from mavsitl.services.statustext import GAP, chunks
from tests.drivers.exercise import shortened

LONG = "Arming denied: the battery is at 12 percent, which is below the limit of 15 percent; charge it and try again"


def say(ground: Ground, vehicle: Node) -> None:
    for datagram in vehicle.datagrams():
        ground.receive(0, datagram)


def test_a_long_text_is_one_line_and_a_lost_part_is_shown() -> None:
    said: list[str] = []
    ground = Ground(shortened("hover-calm", 3.0), NullRecorder(), report=said.append)
    vehicle = Node(1, 1)
    vehicle.send_message(mavlink.MAVLink_heartbeat_message(2, 12, 209, 0x60000, 4, 3))
    say(ground, vehicle)
    ground.step(0)
    said.clear()
    for message in (*chunks(4, LONG, 1), *chunks(4, "short", 2), *chunks(4, LONG, 3)[1:]):
        vehicle.send_message(message)
    say(ground, vehicle)
    assert said == [f"vehicle: {LONG}", "vehicle: short"]
    ground.step(500_000)
    assert not any(GAP in line for line in said)
    ground.step(1_000_000)
    assert f"vehicle: {GAP}{LONG[50:]}" in said
