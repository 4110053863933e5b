"""Real time: on a wall clock that the test makes, and one short flight on real sockets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import Any

import pytest
from mavsitl_ground.controller import Ground
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import drivers, ends, pair
from mavsitl.clock import PacedClock
from mavsitl.codec import parse
from mavsitl.dialect import mavlink
from mavsitl.drivers import Tap
from mavsitl.ends import NullRecorder, VehicleLinks
from mavsitl.link.address import Address
from mavsitl.link.base import Link
from mavsitl.link.impaired import ImpairedLink, channels_for
from mavsitl.link.memory import memory_pair
from mavsitl.link.udp import LOOPBACK
from mavsitl.log import topics
from mavsitl.log.ulog import MemoryRecorder
from tests.drivers.exercise import shortened


class Wall:
    """Wall time that passes only by sleeping, and a microsecond with each look."""

    def __init__(self) -> None:
        self.ns = 0

    def monotonic_ns(self) -> int:
        self.ns += 1000
        return self.ns

    def sleep_s(self, duration_s: float) -> None:
        self.ns += round(duration_s * 1e9)

    def monotonic_us(self) -> int:
        return self.monotonic_ns() // 1000


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> Wall:
    made = Wall()

    def paced(period_us: int, speed: float) -> PacedClock:
        return PacedClock(period_us, speed, monotonic_ns=made.monotonic_ns, sleep_s=made.sleep_s)

    monkeypatch.setattr(drivers, "PacedClock", paced)
    monkeypatch.setattr(drivers, "monotonic_us", made.monotonic_us)
    return made


class Pumped:
    """A memory link that lets the other side run one round before this side looks for what has come."""

    def __init__(self, link: Link, pump: Callable[[], None]) -> None:
        self._link = link
        self._pump = pump
        self.admitted: list[Any] = []
        self.send = link.send
        self.close = link.close
        self.readers = link.readers

    def wait(self, timeout_s: float) -> bool:
        return True

    def receive(self, now_us: int, limit: int = 256) -> Any:
        self._pump()
        return self._link.receive(now_us, limit)

    def admit(self, source: Any, now_us: int) -> bool:
        self.admitted.append(source)
        return self._link.admit(source, now_us)


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_a_vehicle_flies_on_the_wall_clock(wall: Wall, speed: float) -> None:
    flight = shortened("hover-calm", 1.0)
    vehicle = Vehicle(flight, NullRecorder(), seed=1, ports=("offboard", "gcs"))
    said: list[str] = []
    ground = Ground(flight, NullRecorder(), report=said.append)
    near, far = memory_pair()
    station, vehicle_to_station = memory_pair()

    def one_round() -> None:
        now_us = wall.ns // 1000
        for datagram, _ in far.receive(now_us):
            ground.receive(0, datagram)
        ground.step(now_us)
        for datagram in ground.datagrams(0, combine=False):
            far.send(datagram)

    link = Pumped(near, one_round)
    links: Sequence[Any] = (link, vehicle_to_station)
    timing = drivers.run_realtime_vehicle(vehicle, links, Tap(), speed=speed, until_finished=True)
    assert vehicle.finished
    assert "flying" in said
    assert link.admitted
    assert timing.rebased == 0
    assert timing.simulated_us / speed == pytest.approx(wall.ns / 1000, rel=0.02)
    assert 2_000_000 < timing.simulated_us < 10_000_000
    assert timing.lateness.count == timing.simulated_us // vehicle.period_us
    assert len(station.receive(0)) > 10


def test_a_vehicle_says_how_busy_its_process_is(wall: Wall, monkeypatch: pytest.MonkeyPatch) -> None:
    """SYS_STATUS.load and cpuload in the log: 0 until the first second is over, then what the last second took."""
    monkeypatch.setattr(drivers, "processor_s", lambda: wall.ns / 4e9)
    log = MemoryRecorder()
    vehicle = Vehicle(shortened("hover-calm", 1.0), log, seed=1)
    near, far = memory_pair()
    drivers.run_realtime_vehicle(vehicle, [near], Tap(), stop=lambda: wall.ns > 3.1e9)
    frames = (frame for datagram, _ in far.receive(0, limit=100_000) for frame in parse(datagram))
    loads = [frame.message.load for frame in frames if frame.message_id == mavlink.MAVLINK_MSG_ID_SYS_STATUS]
    assert loads[0] == 0
    assert loads[-1] == 250
    assert set(loads) == {0, 250}
    assert log.arrays(topics.CPULOAD)["load"] == pytest.approx([0.25, 0.25], rel=1e-3)


def test_a_vehicle_flies_over_a_bad_link_on_the_wall_clock(wall: Wall) -> None:
    """Latency, loss and duplicates both ways; at twice the speed a simulated latency is half as long on the wall."""
    bad = {
        f"link__{way}__{key}": value
        for way in ("to_ground", "to_vehicle")
        for key, value in (("latency_ms", 12.0), ("loss", 0.1), ("duplicate", 0.1))
    }
    flight = shortened("hover-calm", 1.0, controller__level="attitude", **bad)
    vehicle = Vehicle(flight, NullRecorder(), seed=1)
    ground = Ground(flight, NullRecorder())
    near, far = memory_pair()
    channels = channels_for(flight.scenario.link, 1)
    assert channels is not None
    link = ImpairedLink(near, channels, lambda: 2 * wall.ns // 1000)
    link.flight_time_s = lambda: vehicle.flight_time_s

    def one_round() -> None:
        now_us = wall.ns // 1000
        for datagram, _ in far.receive(now_us):
            ground.receive(0, datagram)
        ground.step(now_us)
        for datagram in ground.datagrams(0, combine=False):
            far.send(datagram)

    links: Sequence[Any] = (Pumped(link, one_round),)
    drivers.run_realtime_vehicle(vehicle, links, Tap(), speed=2.0, stop=lambda: ground.finished)
    assert vehicle.finished
    assert ground.succeeded
    for statistics in (channels.to_ground.statistics, channels.to_vehicle.statistics):
        assert statistics.delay.p50_us == 12_000.0
        assert 0.05 < statistics.lost / statistics.sent < 0.15
        assert statistics.duplicated > 10


def test_a_ground_flies_on_the_wall_clock(wall: Wall) -> None:
    """Without a vehicle at first; it ends when the flight has."""
    flight = shortened("hover-calm", 1.0)
    vehicle = Vehicle(flight, NullRecorder(), seed=1)
    ground = Ground(flight, NullRecorder())
    near, far = memory_pair()
    period_us = vehicle.period_us
    ticks = iter(range(10_000))

    def one_round() -> None:
        wall.sleep_s(period_us * 1e-6)
        vehicle_us = (next(ticks) - 500) * period_us
        if vehicle_us < 0:
            return
        for datagram, _ in near.receive(vehicle_us):
            vehicle.receive(0, datagram)
        vehicle.step(vehicle_us)
        for datagram in vehicle.datagrams(0, combine=False):
            near.send(datagram)

    link: Any = Pumped(far, one_round)
    tap = Tap()
    drivers.run_realtime_ground(ground, link, tap)
    assert ground.succeeded
    assert link.admitted
    assert tap.wire.hexdigest() != Tap().wire.hexdigest()
    assert ground.flight_time_s == pytest.approx(1.0, abs=0.1)


def test_the_vehicle_ends_when_it_is_told_to(wall: Wall) -> None:
    flight = shortened("hover-calm", 1.0)
    vehicle = Vehicle(flight, NullRecorder(), seed=1)
    near, _ = memory_pair()
    looks = iter([False] * 25 + [True])
    timing = drivers.run_realtime_vehicle(vehicle, [near], Tap(), stop=lambda: next(looks))
    assert timing.simulated_us == 25 * vehicle.period_us
    assert not vehicle.finished


def test_junk_on_the_link_makes_nobody_a_peer(wall: Wall) -> None:
    flight = shortened("hover-calm", 1.0)
    vehicle = Vehicle(flight, NullRecorder(), seed=1)
    near, far = memory_pair()
    link: Any = Pumped(near, lambda: far.send(b"\xfd\x09junk, not a frame"))
    looks = iter([False] * 5 + [True])
    drivers.run_realtime_vehicle(vehicle, [link], Tap(), stop=lambda: next(looks))
    assert link.admitted == []
    assert vehicle.counters.rejected == 5


@pytest.mark.sockets
def test_vehicle_and_ground_meet_on_real_sockets() -> None:
    """At twice real time: the ground answers as telemetry comes, and reaches FLY."""
    flight = shortened("hover-calm", 60.0)
    vehicle_port, gcs_port, gcs_remote, ground_port = pair.free_ports(4)
    links = VehicleLinks(
        offboard_port=vehicle_port,
        offboard_remote=(LOOPBACK, ground_port),
        gcs_port=gcs_port,
        gcs_remote=(LOOPBACK, gcs_remote),
    )
    flying, give_up = Event(), Event()

    def report(text: str) -> None:
        if text == "flying":
            flying.set()

    def stop() -> bool:
        return flying.is_set() or give_up.is_set()

    with ThreadPoolExecutor(2) as pool:
        ground = pool.submit(
            ends.ground_realtime,
            flight, Address("udpin", LOOPBACK, ground_port), None,
            vehicle_system_id=None, wing=None, report=report, stop=stop, progress=None,
        )  # fmt: skip
        vehicle = pool.submit(
            ends.vehicle_realtime,
            flight, links, None,
            system_id=1, wing=None, speed=2.0, until_finished=False, state=None,
            report=lambda text: None, stop=stop, progress=None,
        )  # fmt: skip
        vehicle.add_done_callback(lambda end: give_up.set())  # an end that raises ends the other, and is seen below
        try:
            assert flying.wait(30.0) or vehicle.done()
        finally:
            give_up.set()
        vehicle_outcome, ground_outcome = vehicle.result(10.0), ground.result(10.0)
    assert vehicle_outcome.frames > 50
    assert ground_outcome.frames > 50
    assert vehicle_outcome.rejected == ground_outcome.rejected == 0
    assert vehicle_outcome.lateness_us is not None
    assert not ground_outcome.finished
