"""Lock-step: any order of start, silence named, repeats dropped."""

from __future__ import annotations

import subprocess
import sys
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import Any, cast

import pytest
from mavsitl_ground.controller import Ground
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import drivers, pair
from mavsitl.drivers import LockstepError, Tap
from mavsitl.ends import NullRecorder
from mavsitl.link.base import LinkSilent
from mavsitl.link.udp import LOOPBACK, ConnectedUdp
from mavsitl.log.tlog import Direction, WireHash
from tests.drivers.exercise import hash_in_memory, shortened

FLIGHT = shortened("hover-calm", 0.3)


class Scripted:
    """A link that gives what it was told to, `None` being silence, and keeps what is sent."""

    def __init__(self, *script: bytes | None) -> None:
        self.script = deque(script)
        self.sent: list[bytes] = []

    def receive(self) -> bytes:
        datagram = self.script.popleft() if self.script else None
        if datagram is None:
            raise LinkSilent("nothing came from 192.0.2.1:14540")
        return datagram

    def send(self, datagram: bytes) -> None:
        self.sent.append(datagram)

    def udp(self) -> ConnectedUdp:
        return cast("ConnectedUdp", self)


class Counter:
    """Either end: a vehicle of four ticks of 4 ms, or the ground that answers it with the stamp."""

    period_us = 4000

    def __init__(self, ticks: int = 4, *, mute: bool = False) -> None:
        self.ticks = ticks
        self.mute = mute
        self.received: list[bytes] = []
        self.token_us = self.vehicle_time_us = -1
        self._now_us = -1
        self.counters = None

    @property
    def finished(self) -> bool:
        return max(self._now_us, self.vehicle_time_us) >= self.ticks * self.period_us

    @property
    def flight_time_s(self) -> float:
        return self._now_us / 1e6

    def receive(self, port: int, datagram: bytes) -> int:
        self.received.append(datagram)
        self.token_us = self.vehicle_time_us = int(datagram)
        return 1

    def step(self, now_us: int) -> None:
        self._now_us = now_us

    def datagrams(self, port: int, *, combine: bool) -> list[bytes]:
        return [] if self.mute else [b"%d" % self._now_us]


def vehicle() -> Vehicle:
    return Vehicle(FLIGHT, NullRecorder(), seed=FLIGHT.scenario.seed, lockstep=True)


def ground() -> Ground:
    return Ground(FLIGHT, NullRecorder())


def connected(local: int, remote: int) -> ConnectedUdp:
    return ConnectedUdp((LOOPBACK, remote), (LOOPBACK, local), timeout_s=drivers.FIRST_REPEAT_S)


class Announced:
    """A link that tells when its owner has begun to wait."""

    def __init__(self, link: ConnectedUdp) -> None:
        self._link = link
        self.waits = Event()
        self.send = link.send

    def receive(self) -> bytes:
        self.waits.set()
        return self._link.receive()


@pytest.mark.sockets
@pytest.mark.parametrize("first", ["vehicle", "ground"])
def test_either_end_may_start_first(first: str) -> None:
    vehicle_port, ground_port = pair.free_ports(2)
    taps = {"vehicle": Tap(), "ground": Tap()}
    ports = {"vehicle": (vehicle_port, ground_port), "ground": (ground_port, vehicle_port)}
    second = "ground" if first == "vehicle" else "vehicle"

    def run(end: str, link: Any) -> int:
        if end == "vehicle":
            return drivers.run_lockstep_vehicle(vehicle(), link, taps[end])
        return drivers.run_lockstep_ground(ground(), link, taps[end])

    early = connected(*ports[first])
    announced = Announced(early)
    with ThreadPoolExecutor(2) as pool:
        try:
            one = pool.submit(run, first, announced)
            assert announced.waits.wait(60.0)
            late = connected(*ports[second])
            try:
                assert run(second, late) == one.result(60.0)
            finally:
                late.close()
        finally:
            early.close()
    assert taps["vehicle"].wire.hexdigest() == taps["ground"].wire.hexdigest() == hash_in_memory(FLIGHT)


@pytest.mark.sockets
def test_a_ground_that_never_comes_is_named() -> None:
    vehicle_port, ground_port = pair.free_ports(2)
    link = connected(vehicle_port, ground_port)
    try:
        with pytest.raises(LinkSilent, match=rf"t = 0 s after 0.2 s of silence.*{LOOPBACK}:{ground_port}"):
            drivers.run_lockstep_vehicle(vehicle(), link, Tap(), start_deadline_s=0.2)
    finally:
        link.close()


@pytest.mark.sockets
def test_a_vehicle_that_never_comes_is_named() -> None:
    vehicle_port, ground_port = pair.free_ports(2)
    link = connected(ground_port, vehicle_port)
    try:
        with pytest.raises(LinkSilent, match=rf"t = 0 s after 0.2 s of silence.*{LOOPBACK}:{vehicle_port}"):
            drivers.run_lockstep_ground(ground(), link, Tap(), start_deadline_s=0.2)
    finally:
        link.close()


@pytest.mark.sockets
def test_a_ground_killed_in_flight_is_named() -> None:
    vehicle_port, ground_port = pair.free_ports(2)
    command = [
        *(sys.executable, "-m", "mavsitl", "ground", "hover-calm", "--duration", "100000", "--lockstep"),
        *("--link", f"udpin:{LOOPBACK}:{ground_port}", "--vehicle", f"{LOOPBACK}:{vehicle_port}"),
    ]
    link = connected(vehicle_port, ground_port)
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def kill_in_flight(flight_time_s: float) -> None:
        if flight_time_s > 0.0:
            process.kill()

    try:
        with pytest.raises(LinkSilent, match=rf"after 0.5 s of silence.*{LOOPBACK}:{ground_port}"):
            drivers.run_lockstep_vehicle(vehicle(), link, Tap(), deadline_s=0.5, progress=kill_in_flight)
    finally:
        process.kill()
        process.wait()
        link.close()
    assert process.returncode == -9


def test_the_deadline_after_the_start_is_the_shorter_one() -> None:
    silent = Scripted(b"0", b"4000")
    with pytest.raises(LinkSilent, match=r"t = 0.008 s after 0.3 s of silence: nothing came from 192.0.2.1:14540"):
        drivers.run_lockstep_vehicle(Counter(), silent.udp(), Tap(), deadline_s=0.3, start_deadline_s=1e9)
    with pytest.raises(LinkSilent, match=r"t = 0.004 s after 0.3 s of silence"):
        drivers.run_lockstep_ground(
            Counter(), Scripted(b"0", b"4000").udp(), Tap(), deadline_s=0.3, start_deadline_s=1e9
        )


def test_the_first_datagram_is_repeated_until_it_is_answered_and_heard_once() -> None:
    link = Scripted(None, None, b"0", None, b"4000", b"8000", b"12000")
    tap = Tap()
    assert drivers.run_lockstep_vehicle(Counter(), link.udp(), tap) == 16000
    assert link.sent == [b"0", b"0", b"0", b"4000", b"8000", b"12000", b"16000"]
    expected = WireHash()
    for stamp in (b"0", b"4000", b"8000", b"12000"):
        expected.update([(Direction.FROM_VEHICLE, 0, stamp)])
        expected.update([(Direction.FROM_GROUND, 0, stamp)])
    expected.update([(Direction.FROM_VEHICLE, 0, b"16000")])
    assert tap.wire.hexdigest() == expected.hexdigest()


def test_repeats_of_the_first_datagram_are_dropped() -> None:
    core, link, tap = Counter(), Scripted(b"0", b"0", b"0", b"4000", b"8000", b"12000", b"16000"), Tap()
    assert drivers.run_lockstep_ground(core, link.udp(), tap) == 16000
    assert core.received == link.sent == [b"0", b"4000", b"8000", b"12000", b"16000"]
    expected = WireHash()
    for stamp in core.received:
        expected.update([(Direction.FROM_VEHICLE, 0, stamp)])
        expected.update([(Direction.FROM_GROUND, 0, stamp)])
    assert tap.wire.hexdigest() == expected.hexdigest()


def test_an_answer_to_an_earlier_tick_does_not_advance() -> None:
    link = Scripted(b"0", b"0", b"4000", b"8000", b"12000")
    core = Counter()
    drivers.run_lockstep_vehicle(core, link.udp(), Tap())
    assert core.received == [b"0", b"0", b"4000", b"8000", b"12000"]
    assert link.sent == [b"0", b"4000", b"8000", b"12000", b"16000"]


def test_in_memory_a_ground_that_does_not_answer_is_an_error() -> None:
    with pytest.raises(LockstepError, match="did not answer the telemetry stamped 0 us"):
        drivers.fly_in_memory(Counter(), Counter(mute=True))


def test_in_memory_a_flight_without_end_is_an_error() -> None:
    with pytest.raises(LockstepError, match=r"did not end within 0.02 s"):
        drivers.fly_in_memory(Counter(1000), Counter(1000), max_time_s=0.02)


@pytest.mark.parametrize("end", ["vehicle", "ground"])
def test_a_run_can_be_stopped_while_nothing_comes(end: str) -> None:
    """The progress callback is called in silence, too: its exception ends the run before the deadline."""

    def stop(flight_time_s: float) -> None:
        raise KeyboardInterrupt

    run = drivers.run_lockstep_vehicle if end == "vehicle" else drivers.run_lockstep_ground
    with pytest.raises(KeyboardInterrupt):
        run(Counter(), Scripted().udp(), Tap(), progress=stop)


def test_the_tap_flushes_once_a_second_of_simulated_time() -> None:
    flushed: list[int] = []
    now_us = 0
    tap = Tap(flush=lambda: flushed.append(now_us))
    for now_us in range(0, 3_500_001, 250_000):
        tap.tick(now_us)
    assert flushed == [1_000_000, 2_000_000, 3_000_000]


def test_in_real_time_the_tap_flushes_by_whichever_clock_is_slower() -> None:
    for speed, expected in ((0.5, [0.5, 1.0, 1.5]), (1.0, [0.5, 1.0, 1.5]), (10.0, [0.1 * k for k in range(1, 20)])):
        flushed: list[float] = []
        wall_us = 0
        tap = Tap(flush=lambda: flushed.append(wall_us / 1e6))  # noqa: B023
        for wall_us in range(0, 1_999_999, 4000):
            tap.tick(round(wall_us * speed), wall_us)
        assert flushed == pytest.approx(expected, abs=0.005 * len(expected))
