"""A vehicle that restarts within the heartbeat's time-out, seen datagram by datagram as real time delivers it."""

from __future__ import annotations

from mavsitl_ground.controller import Ground
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.ends import NullRecorder
from tests.drivers.exercise import shortened


def fly(ground: Ground, vehicle: Vehicle, start_us: int, periods: int, until: str | None = None) -> int:
    """Both step on, the ground after every single datagram; the ground's time at the end."""
    now_us = start_us
    for tick in range(periods):
        vehicle.step(tick * vehicle.period_us)
        for datagram in vehicle.datagrams(0, combine=False):
            ground.receive(0, datagram)
            ground.step(now_us)
            for answer in ground.datagrams(0, combine=False):
                vehicle.receive(0, answer)
        now_us += vehicle.period_us
        if ground.phase == until:
            break
    return now_us


def test_a_vehicle_killed_and_started_again_within_three_seconds_is_flown_again() -> None:
    flight = shortened("hover-calm", 3.0)
    said: list[str] = []
    ground = Ground(flight, NullRecorder(), report=said.append)
    now_us = fly(ground, Vehicle(flight, NullRecorder(), seed=1), 0, 2000, until="FLY")
    assert ground.phase == "FLY"
    fly(ground, Vehicle(flight, NullRecorder(), seed=1), now_us + 1_000_000, 3000, until="DONE")
    assert ground.succeeded, said
    assert sum("restarted" in line for line in said) == 1
    assert said.count("flying") == 2
