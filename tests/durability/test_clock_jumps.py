"""Clocks that jump, stop and stall, on wall time that the test makes."""

from __future__ import annotations

import ast
import random
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import mavsitl_ground
import mavsitl_vehicle
import pytest
from mavsitl_ground.controller import Ground
from mavsitl_vehicle.vehicle import Vehicle

import mavsitl
from mavsitl import clock, drivers, ends
from mavsitl.clock import CATCH_UP_US, PacedClock
from mavsitl.codec import encode, packer, parse
from mavsitl.dialect import mavlink
from mavsitl.drivers import RealTime, Tap
from mavsitl.ends import NullRecorder
from mavsitl.link.memory import memory_pair
from tests.drivers.exercise import shortened

DAY_NS = 86_400_000_000_000
PERIOD_US = 4000


class Wall:
    """The module `time` of a machine: what passes is slept, and a microsecond with each look; the date may jump."""

    def __init__(self) -> None:
        self.ns = 0
        self.date_ns = 1_790_000_000_000_000_000
        self.strftime, self.gmtime = time.strftime, time.gmtime

    def monotonic_ns(self) -> int:
        self.ns += 1000
        return self.ns

    def time_ns(self) -> int:
        return self.date_ns + self.ns

    def process_time(self) -> float:
        return self.ns / 4e9

    def sleep(self, duration_s: float) -> None:
        self.ns += max(round(duration_s * 1e9), 1000)


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> Wall:
    made = Wall()

    def paced(period_us: int, speed: float) -> PacedClock:
        return PacedClock(period_us, speed, monotonic_ns=made.monotonic_ns, sleep_s=made.sleep)

    monkeypatch.setattr(clock, "time", made)
    monkeypatch.setattr(drivers, "PacedClock", paced)
    return made


def fly(
    wall: Wall, ticks: int, each: Callable[[int], None], say: Callable[[str], None] = lambda text: None
) -> tuple[list[Any], RealTime]:
    """(wall us, frame) of what a vehicle says on its off-board link; `each` is called before every tick."""
    near, far = memory_pair()
    vehicle = Vehicle(shortened("hover-calm", 1.0), NullRecorder(), seed=1, unix_us=ends._steady_unix_clock())
    heard: list[Any] = []
    number = iter(range(ticks + 1))

    def stop() -> bool:
        heard.extend((wall.ns // 1000, frame) for datagram, _ in far.receive(0) for frame in parse(datagram))
        tick = next(number)
        each(tick)
        far.send(encode(mavlink.MAVLink_timesync_message(0, tick + 1), tick & 0xFF, 245, 190))
        return tick == ticks

    timing = drivers.run_realtime_vehicle(vehicle, [near], Tap(), stop=stop, say=say)
    return heard, timing


@pytest.mark.parametrize("jump_ns", [DAY_NS, -DAY_NS])
def test_a_jump_of_the_date_changes_nothing(wall: Wall, jump_ns: int) -> None:
    """Not a byte of the telemetry, TIMESYNC and SYSTEM_TIME in it."""
    before, _ = fly(wall, 500, lambda tick: None)
    wall.ns = 0

    def jump(tick: int) -> None:
        if tick == 250:
            wall.date_ns += jump_ns

    after, timing = fly(wall, 500, jump)
    assert [frame.raw for _, frame in before] == [frame.raw for _, frame in after]
    names = {frame.message.get_type() for _, frame in after}
    assert {"TIMESYNC", "SYSTEM_TIME"} <= names
    assert timing.rebased == 0


@pytest.mark.parametrize("stop_s", [0.15, 0.9, 5.0, 3600.0])
def test_a_suspended_vehicle_goes_on_where_it_was(wall: Wall, stop_s: float) -> None:
    def suspend(tick: int) -> None:
        if tick == 250:
            wall.ns += round(stop_s * 1e9)

    said: list[str] = []
    heard, timing = fly(wall, 1500, suspend, said.append)
    assert timing.rebased == 1
    assert timing.lost_us == pytest.approx(stop_s * 1e6, abs=2 * PERIOD_US)
    assert timing.simulated_us == 1500 * PERIOD_US
    stamps = [(at, frame.message.time_boot_ms) for at, frame in heard if frame.message.get_type() == "ATTITUDE"]
    steps = {after - before for (_, before), (_, after) in pairwise(stamps)}
    assert len(steps) <= 2, "simulated time neither jumps nor is repeated"
    gaps_us = [after - before for (before, _), (after, _) in pairwise(stamps)]
    assert min(gaps_us) > 1000 * (min(steps) - 5), "nothing is sent faster to catch up"
    assert said == [f"Suspended or overloaded: {timing.lost_us / 1e6:.1f} s of real time given up"]
    texts = [frame.message.text for _, frame in heard if frame.message.get_type() == "STATUSTEXT"]
    assert "".join(texts).count("real time given up") == 1


def test_a_short_stall_is_caught_up(wall: Wall) -> None:
    """Up to the limit no time is lost, and what is caught up is less than a tenth of a second of telemetry."""

    def stall(tick: int) -> None:
        if tick == 250:
            wall.ns += (CATCH_UP_US - 2 * PERIOD_US) * 1000

    said: list[str] = []
    _, timing = fly(wall, 500, stall, said.append)
    assert (timing.rebased, timing.lost_us, said) == (0, 0, [])
    assert timing.wall_us == pytest.approx(timing.simulated_us, abs=2 * PERIOD_US)


def test_an_overloaded_machine_slows_time_down_and_it_is_said_now_and_then(wall: Wall) -> None:
    """Each tick takes twice its period: simulated time runs at half the rate and never back; one warning in 5 s."""
    chance = random.Random(1)

    def work(tick: int) -> None:
        wall.ns += chance.randrange(2 * PERIOD_US) * 1000 + PERIOD_US * 1000

    said: list[str] = []
    heard, timing = fly(wall, 2500, work, said.append)
    assert timing.simulated_us / timing.wall_us == pytest.approx(0.5, abs=0.05)
    assert timing.lateness.quantile_us(0.9) <= 1.25 * CATCH_UP_US
    assert timing.wall_us - timing.lost_us == pytest.approx(timing.simulated_us, abs=2 * CATCH_UP_US)
    assert len(said) == timing.wall_us // drivers.SAY_LOST_US
    clocks = [frame.message.tc1 for _, frame in heard if frame.message.get_type() == "TIMESYNC"]
    assert clocks == sorted(clocks)
    assert len(clocks) > 1000


HEARTBEAT = packer(mavlink.MAVLink_heartbeat_message)


def test_a_suspended_ground_does_not_take_its_own_sleep_for_the_vehicle_s(wall: Wall) -> None:
    """What waited in the socket is heard first, and its clock stands still meanwhile."""
    near, far = memory_pair()
    said: list[str] = []
    ground = Ground(shortened("hover-calm", 60.0), NullRecorder(), report=said.append)
    number = iter(range(2000))

    def beat(state: int = mavlink.MAV_STATE_STANDBY) -> None:
        near.send(HEARTBEAT(0, 1, 1, mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 1, 0, state, 3))

    def stop() -> bool:
        tick = next(number)
        wall.sleep(PERIOD_US * 1e-6)
        if tick % 125 == 0:
            beat()
        if tick == 1000:
            wall.sleep(5.0)
        return tick == 1999

    drivers.run_realtime_ground(ground, far, Tap(), stop=stop, say=said.append)
    assert said[0] == "vehicle 1 found"
    assert "Suspended or overloaded: 5.0 s of real time given up" in said
    assert not [text for text in said if "vehicle lost" in text]


def test_only_the_clock_imports_time() -> None:
    """Else a jump of it could come in by another door."""
    clocks = {"time", "datetime"}
    found = set()
    for package in (mavsitl, mavsitl_vehicle, mavsitl_ground):
        (folder,) = package.__path__
        for file in Path(folder).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                names = {each.name for each in node.names} if isinstance(node, ast.Import) else set()
                if isinstance(node, ast.ImportFrom) and node.module:
                    names = {node.module}
                if names & clocks:
                    found.add(file.name)
    assert found == {"clock.py"}
