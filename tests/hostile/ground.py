"""Hostile telemetry at the controller's end, in flight: `python -m tests.hostile.ground`.

What claims to be the vehicle may lead a controller astray, for nothing is signed there; but no exception leaves it, and
what it sends stays within the format. With broken datagrams alone the flight comes to its end as without them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

from mavsitl_ground.controller import Ground
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.codec import parse
from mavsitl.ends import NullRecorder
from mavsitl.scenario import Flight, load
from tests.hostile.attacks import Attacker
from tests.hostile.report import Report, bar

TELEMETRY = (
    "HEARTBEAT", "ODOMETRY", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "EXTENDED_SYS_STATE", "SYS_STATUS",
    "COMMAND_ACK", "STATUSTEXT", "TIMESYNC", "PARAM_VALUE", "HOME_POSITION", "GPS_GLOBAL_ORIGIN", "SYSTEM_TIME",
)  # fmt: skip
PER_TICK = 20
VEHICLE = (1, 1)


def scenario() -> Flight:
    return load("hover-calm", {"duration_s": 2.0, "rates.physics_hz": 1000})


def attack(make: Callable[[], bytes], ticks: int, report: Report, title: str, *, ends: bool) -> None:
    """A flight in lock-step steps, each with so many more datagrams at the ground."""
    flight = scenario()
    vehicle = Vehicle(flight, NullRecorder(), seed=1, lockstep=True)
    ground = Ground(flight, NullRecorder())
    escaped = bad = now_us = 0
    for _ in range(ticks):
        if vehicle.finished and ground.finished:
            break
        vehicle.step(now_us)
        answers: list[bytes] = []
        try:
            for _ in range(PER_TICK):
                ground.receive(0, make())
            for datagram in vehicle.datagrams(0, combine=True):
                ground.receive(0, datagram)
            ground.step(max(ground.vehicle_time_us, now_us))
            answers = ground.datagrams(0, combine=True)
        except Exception as error:
            escaped += 1
            print(f"{title}: {error!r}", file=sys.stderr)
        for answer in answers:
            bad += not parse(answer)
            vehicle.receive(0, answer)
        now_us += vehicle.period_us
    report.demand(f"{title}: exceptions that left the ground", "0", escaped, escaped == 0)
    report.demand(f"{title}: datagrams of its own that are none", "0", bad, bad == 0)
    if ends:
        report.demand(f"{title}: flown to its end", "yes", ground.succeeded, ground.succeeded)


def ground(report: Report, seed: int = 1, ticks: int = 2000, *, show: bool = True) -> None:
    attacker = Attacker(f"ground-{seed}")
    with bar(2, show=show) as progress:
        attack(attacker.broken, 10_000, report, "broken datagrams", ends=True)
        progress.move()

        def telemetry() -> bytes:
            return attacker.frame(attacker.random.choice(TELEMETRY), VEHICLE)

        attack(telemetry, ticks, report, "hostile telemetry", ends=False)
        progress.move()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ticks", type=int, default=50_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    report = Report("the controller's end")
    ground(report, options.seed, options.ticks)
    return report.print()


if __name__ == "__main__":
    sys.exit(main())
