"""Real time between two ticks: questions are answered at once, a flood delays nothing, stamps stay in order."""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence
from typing import Any

import pytest
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import drivers
from mavsitl.clock import PacedClock
from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.drivers import GUARD_S, TAKEN, WAKES, RealTime, Tap
from mavsitl.ends import NullRecorder
from mavsitl.link.base import Link
from mavsitl.link.budget import STRANGER_BURST
from mavsitl.link.memory import MemoryLink, memory_pair
from mavsitl.link.sockets import LOOPBACK, wait_any
from mavsitl.link.tcp import TcpServerLink
from mavsitl.link.udp import UdpLink
from tests.drivers.exercise import shortened

PERIOD_US = 4000
RECEIVE_US = 50
"""What a datagram costs on the wall in these tests."""
LOOKS_US = 60
"""What looking at the clock costs in a tick, at most."""


class Wall:
    """Wall time that passes only by sleeping, and a microsecond with each look."""

    def __init__(self) -> None:
        self.ns = 0

    def monotonic_ns(self) -> int:
        self.ns += 1000
        return self.ns

    def sleep_s(self, duration_s: float) -> None:
        self.ns += max(round(duration_s * 1e9), 1000)

    def monotonic_us(self) -> int:
        return self.monotonic_ns() // 1000


class Costly:
    """A vehicle whose `receive` takes its time; notes when each datagram was taken."""

    def __init__(self, vehicle: Vehicle, wall: Wall) -> None:
        self._vehicle = vehicle
        self._wall = wall
        self.taken_us: list[int] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._vehicle, name)

    def receive(self, port: int, datagram: bytes, at_us: int | None = None) -> int:
        self.taken_us.append(self._wall.monotonic_us())
        self._wall.ns += RECEIVE_US * 1000
        return self._vehicle.receive(port, datagram, at_us)


class Bench:
    """A vehicle on two memory links, and a wall clock that the test moves."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wall = Wall()
        self.near, self.far = memory_pair()
        self.station, _ = memory_pair()
        vehicle = Vehicle(shortened("hover-calm", 1.0), NullRecorder(), seed=1, ports=("offboard", "gcs"))
        self.vehicle = Costly(vehicle, self.wall)
        wall = self.wall

        def paced(period_us: int, speed: float) -> PacedClock:
            return PacedClock(period_us, speed, monotonic_ns=wall.monotonic_ns, sleep_s=wall.sleep_s)

        monkeypatch.setattr(drivers, "PacedClock", paced)
        monkeypatch.setattr(drivers, "monotonic_us", wall.monotonic_us)

    def run(self, ticks: int, wait: Callable[[Sequence[Link], float], bool]) -> RealTime:
        looks = iter([False] * ticks + [True])
        links: tuple[MemoryLink, ...] = (self.near, self.station)
        return drivers.run_realtime_vehicle(self.vehicle, links, Tap(), stop=lambda: next(looks), wait=wait)

    def answers(self, name: str) -> list[Any]:
        messages = [frame.message for datagram, _ in self.far.receive(0) for frame in parse(datagram)]
        return [message for message in messages if message.get_type() == name]


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def timesync(ts1: int = 77) -> bytes:
    return encode(mavlink.MAVLink_timesync_message(0, ts1), 0, 245, 190)


def test_a_question_between_two_ticks_is_answered_before_the_next(bench: Bench) -> None:
    asked_us: list[int] = []
    answered: list[tuple[int, Any]] = []

    def wait(links: Sequence[Link], timeout_s: float) -> bool:
        answered.extend((bench.wall.monotonic_us(), message) for message in bench.answers("TIMESYNC"))
        if asked_us or bench.wall.monotonic_us() < 10 * PERIOD_US:
            bench.wall.sleep_s(timeout_s)
            return False
        bench.wall.sleep_s(0.0013)
        asked_us.append(bench.wall.monotonic_us())
        bench.far.send(timesync())
        return True

    bench.run(15, wait)
    ((answered_us, message),) = answered
    assert answered_us == pytest.approx(asked_us[0] + RECEIVE_US, abs=LOOKS_US)
    assert message.ts1 == 77
    # The vehicle's clock at that instant, not at the last tick: simulated time 0 was the wall's.
    assert message.tc1 == pytest.approx(asked_us[0] * 1000, abs=LOOKS_US * 1000)
    assert message.tc1 % (PERIOD_US * 1000)


def test_its_clock_never_goes_back(bench: Bench) -> None:
    """Asked at every tick and between them, the answers are in order and never reach the next tick."""
    phase = iter([0.0007, 0.0005, 0.0021] * 100)

    def wait(links: Sequence[Link], timeout_s: float) -> bool:
        step_s = next(phase)
        bench.far.send(timesync())
        bench.wall.sleep_s(min(step_s, timeout_s))
        return step_s < timeout_s

    bench.run(40, wait)
    stamps = [message.tc1 for message in bench.answers("TIMESYNC")]
    assert len(stamps) > 40
    assert stamps == sorted(stamps)
    assert max(stamps) < 40 * PERIOD_US * 1000


def test_what_comes_right_before_a_tick_waits_for_it(bench: Bench) -> None:
    def wait(links: Sequence[Link], timeout_s: float) -> bool:
        bench.wall.sleep_s(timeout_s - GUARD_S / 2)
        bench.far.send(timesync())
        return True

    timing = bench.run(20, wait)
    assert len(bench.vehicle.taken_us) == 20
    assert all(taken_us % PERIOD_US < LOOKS_US for taken_us in bench.vehicle.taken_us)
    assert timing.lateness.max_us < LOOKS_US


@pytest.mark.parametrize("datagram", [timesync(), b"\xfd\x09junk, not a frame" * 10])
def test_a_flood_delays_no_tick(bench: Bench, datagram: bytes) -> None:
    """More than can be handled, on both links: what is beyond the budgets is counted, and the ticks come on time."""

    def wait(links: Sequence[Link], timeout_s: float) -> bool:
        for far in (bench.far, bench.station._peer):
            assert far is not None
            for _ in range(200):
                far.send(datagram)
        bench.far.receive(0)
        return True

    ticks = 100
    timing = bench.run(ticks, wait)
    assert timing.rebased == 0
    assert timing.lateness.max_us <= 2 * TAKEN * RECEIVE_US + LOOKS_US
    assert timing.wall_us <= ticks * PERIOD_US + 2 * (2 * TAKEN * RECEIVE_US + LOOKS_US)
    counters = bench.vehicle.counters
    assert len(bench.vehicle.taken_us) > 2 * STRANGER_BURST
    assert len(bench.vehicle.taken_us) + counters.over_budget + counters.crowded > ticks * 2 * TAKEN


def test_a_link_that_always_wakes_and_never_gives_is_left_alone_until_the_tick(bench: Bench) -> None:
    """A listening socket that cannot accept is readable for ever."""
    woken: list[int] = []

    def wait(links: Sequence[Link], timeout_s: float) -> bool:
        woken.append(bench.wall.monotonic_us())
        return True

    timing = bench.run(10, wait)
    assert len(woken) == 10 * WAKES
    assert timing.lateness.max_us < LOOKS_US


def test_nothing_to_wait_for_is_no_wait() -> None:
    near, _ = memory_pair()
    assert not wait_any([near], 10.0)


def test_spare_time_and_time_between_ticks() -> None:
    wall = Wall()
    clock = PacedClock(PERIOD_US, 2.0, monotonic_ns=wall.monotonic_ns, sleep_s=wall.sleep_s)
    wall.ns = -1000
    clock.start()
    wall.ns = -1000
    assert clock.time_us() == 0
    wall.ns = 1_000_000 - 1000
    assert clock.time_us() == 2000
    assert clock.spare_s(PERIOD_US) == pytest.approx(0.001 - 60e-6 - 1e-6)
    wall.ns = 9_000_000
    assert clock.time_us() == PERIOD_US - 1
    assert clock.spare_s(PERIOD_US) < 0.0
    clock.wait_until(PERIOD_US)
    wall.ns = 0
    assert clock.time_us() == PERIOD_US


@pytest.mark.sockets
def test_sockets_wake() -> None:
    udp, tcp = UdpLink(), TcpServerLink()
    try:
        assert not wait_any([udp, tcp], 0.0)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"x", (LOOPBACK, int(udp.address[1])))
            assert wait_any([tcp, udp], 10.0)
            assert len(udp.receive(0)) == 1
        assert not wait_any([udp, tcp], 0.0)
        with socket.create_connection((LOOPBACK, int(tcp.address[1]))) as client:
            assert wait_any([udp, tcp], 10.0)
            assert tcp.receive(0) == []
            client.sendall(timesync())
            assert wait_any([udp, tcp], 10.0)
            assert len(tcp.receive(0)) == 1
    finally:
        udp.close()
        tcp.close()
