"""The vehicle is heard before it is loaded, says that it boots, and goes on with the same sequence numbers."""

from __future__ import annotations

import socket
import subprocess
import sys
from threading import Event
from typing import Any

import pytest
from mavsitl_vehicle import boot
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import ends, wings
from mavsitl.codec import parse
from mavsitl.dialect import mavlink
from mavsitl.ends import NullRecorder, VehicleLinks
from mavsitl.herald import Herald
from mavsitl.link.base import LinkError
from mavsitl.link.memory import MemoryLink, memory_pair
from mavsitl.link.udp import LOOPBACK
from tests.drivers.exercise import shortened


def heard(link: MemoryLink) -> list[Any]:
    return [frame for datagram, _ in link.receive(0) for frame in parse(datagram)]


def test_it_speaks_at_once_on_every_link_and_then_again() -> None:
    pairs = [memory_pair(), memory_pair()]
    thrice = Event()

    def beat(sequence: int, system_id: int) -> bytes:
        if sequence == 3:
            thrice.set()
        return boot.heartbeat(sequence, system_id)

    herald = Herald(beat, {7: [near for near, _ in pairs]}, interval_s=0.001)
    with herald:
        assert pairs[0][1].wait(0.0)
        assert thrice.wait(30.0)
    for _, far in pairs:
        frames = heard(far)
        assert [frame.sequence for frame in frames] == list(range(herald.sequence))
        assert {frame.system_id for frame in frames} == {7}
    assert herald.sequence >= 4


def test_it_speaks_for_each_of_a_fleet() -> None:
    (one, far_one), (two, far_two) = memory_pair(), memory_pair()
    with Herald(boot.heartbeat, {1: [one], 2: [one, two]}) as herald:
        assert herald.sequence == 1
    assert [(frame.system_id, frame.sequence) for frame in heard(far_one)] == [(1, 0), (2, 0)]
    assert [(frame.system_id, frame.sequence) for frame in heard(far_two)] == [(2, 0)]


def test_without_such_a_heartbeat_nothing_is_said() -> None:
    near, far = memory_pair()
    with Herald(None, {1: [near]}) as herald:
        pass
    assert herald.sequence == 0
    assert heard(far) == []


def test_a_link_that_fails_is_left_to_the_vehicle() -> None:
    near, _ = memory_pair()
    said = Event()

    def beat(sequence: int, system_id: int) -> bytes:
        if sequence == 1:
            near.close()
            said.set()
        return boot.heartbeat(sequence, system_id)

    with Herald(beat, {1: [near]}, interval_s=0.001) as herald:
        assert said.wait(30.0)
        herald._thread.join(30.0)
        assert not herald._thread.is_alive()


def test_it_says_what_the_vehicle_says_but_for_the_state() -> None:
    vehicle = Vehicle(shortened("hover-calm", 1.0), NullRecorder(), seed=1, system_id=3, ports=("offboard", "gcs"))
    vehicle.continue_from(255)
    vehicle.step(0)
    for port in (0, 1):
        frames = [frame for datagram in vehicle.datagrams(port, combine=False) for frame in parse(datagram)]
        assert [frame.sequence for frame in frames] == [(255 + index) & 0xFF for index in range(len(frames))]
        (first,) = parse(boot.heartbeat(254, 3))
        then = next(frame for frame in frames if frame.message.get_type() == "HEARTBEAT")
        assert (first.system_id, first.component_id) == (then.system_id, then.component_id)
        assert first.message.system_status == mavlink.MAV_STATE_BOOT
        assert then.message.system_status == mavlink.MAV_STATE_STANDBY
        told, tells = first.message.to_dict(), then.message.to_dict()
        assert {**told, "system_status": None} == {**tells, "system_status": None}


def test_the_shipped_vehicle_has_one_and_others_need_none() -> None:
    assert wings.find_boot() is boot.heartbeat
    assert wings.find_boot("nobody") is None


def test_what_speaks_first_loads_neither_numpy_nor_numba() -> None:
    program = (
        "import sys, mavsitl.cli, mavsitl.ends, mavsitl.scenario, mavsitl_vehicle.boot\n"
        "mavsitl.scenario.load('takeoff-hover', {})\n"
        "sys.exit(' '.join({'numpy', 'scipy', 'numba', 'rich', 'matplotlib'} & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, timeout=60.0, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.sockets
def test_a_vehicle_in_real_time_is_heard_before_it_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    receivers = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for receiver in receivers:
        receiver.bind((LOOPBACK, 0))
        receiver.settimeout(10.0)
    offboard, gcs = (receiver.getsockname()[1] for receiver in receivers)
    links = VehicleLinks(offboard_port=0, offboard_remote=(LOOPBACK, offboard), gcs_port=0, gcs_remote=(LOOPBACK, gcs))
    states: list[int] = []

    def build(*_: Any, **__: Any) -> Any:
        for receiver in receivers:
            (frame,) = parse(receiver.recv(4096))
            states.append(frame.message.system_status)
        raise LinkError("enough")

    monkeypatch.setattr(wings, "find", lambda group, name: build)
    try:
        with pytest.raises(LinkError, match="enough"):
            ends.vehicle_realtime(
                shortened("hover-calm", 1.0), links, None, system_id=1, wing=None, speed=1.0, until_finished=False,
                state=None, report=lambda text: None, stop=lambda: True, progress=None,
            )  # fmt: skip
    finally:
        for receiver in receivers:
            receiver.close()
    assert states == [mavlink.MAV_STATE_BOOT] * 2
