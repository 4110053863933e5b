"""Many controllers in one process: one for each vehicle of a fleet, its reference shifted to the vehicle's place."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import dist, sqrt
from typing import Any

from mavsitl import formation
from mavsitl.codec import Counters
from mavsitl.fleet import Flown
from mavsitl.log.ulog import Recorder
from mavsitl.routing import by_sender
from mavsitl.scenario import Flight
from mavsitl_ground.controller import Ground
from mavsitl_ground.monitor import Monitors


@dataclass
class _Tally:
    """How well one vehicle has followed its reference so far."""

    flight_time_s: float = -1.0
    square_sum_m2: float = 0.0
    worst_m: float = 0.0
    count: int = 0

    def add(self, ground: Ground) -> None:
        time_s = ground.flight_time_s
        if time_s <= self.flight_time_s or not ground.in_control:
            return
        error_m = dist(ground.position_nwu_m, ground.reference_nwu_m)
        self.flight_time_s = time_s
        self.square_sum_m2 += error_m * error_m
        self.worst_m = max(self.worst_m, error_m)
        self.count += 1

    @property
    def rms_m(self) -> float | None:
        return sqrt(self.square_sum_m2 / self.count) if self.count else None


class Formation:
    """`count` ground cores. Port j is the link of the j-th; with `one_link` port 0 is that of all.

    On one link a frame is the business of the controller whose vehicle sent it.

    Attributes:
        grounds: in the order of their vehicles' system ids.
    """

    def __init__(
        self,
        flight: Flight,
        recorders: Sequence[Recorder],
        *,
        count: int,
        report: Callable[[str], None] = lambda text: None,
        vehicle_system_id: int = 1,
        one_link: bool = False,
        monitored: bool = False,
    ) -> None:
        """`vehicle_system_id`: of the first vehicle, the others follow. `report` gets the lines of all, named."""
        self.grounds = [
            Ground(
                flight, recorders[j], report=_named(report, vehicle_system_id + j),
                vehicle_system_id=vehicle_system_id + j, offset_nwu_m=place, monitored=monitored,
            )
            for j, place in enumerate(formation.places(flight.scenario.fleet, count))
        ]  # fmt: skip
        self.monitor = Monitors([each.monitor for each in self.grounds if each.monitor]) if monitored else None
        self.period_us = self.grounds[0].period_us
        self._first_id = vehicle_system_id
        self._one_link = one_link
        self._tallies = [_Tally() for _ in self.grounds]
        self._heard: set[int] = set()
        self._active: set[int] = set()

    @property
    def finished(self) -> bool:
        return all(ground.finished for ground in self.grounds)

    @property
    def counters(self) -> Any:
        return sum((ground.counters for ground in self.grounds), Counters())

    def receive(self, port: int, datagram: bytes) -> int:
        """One datagram from a link; the number of valid frames in it."""
        if not self._one_link:
            self._heard.add(port)
            return self.grounds[port].receive(0, datagram)
        valid = 0
        for system_id, frames in by_sender(datagram):
            j = system_id - self._first_id
            if 0 <= j < len(self.grounds):
                self._heard.add(j)
                valid += self.grounds[j].receive(0, frames)
        return valid

    def step(self, now_us: int, *, due: bool) -> None:
        """Those that heard something since the last step; with `due` all."""
        stepped = range(len(self.grounds)) if due else sorted(self._heard)
        for j in stepped:
            self.grounds[j].step(now_us)
            self.tally(j)
        self._heard.clear()
        self._active.update(stepped)

    def tally(self, number: int) -> None:
        """Of a ground that was stepped by itself: take note of how well its vehicle follows."""
        self._tallies[number].add(self.grounds[number])

    def outgoing(self) -> Iterator[tuple[int, int, list[bytes]]]:
        """(port, number of the controller, datagrams) where there is something to send."""
        active, self._active = sorted(self._active), set()
        for j in active:
            datagrams = self.grounds[j].datagrams(0, combine=True)
            if datagrams:
                yield 0 if self._one_link else j, j, datagrams

    def flown(self) -> tuple[Flown, ...]:
        """What became of each vehicle."""
        return tuple(
            Flown(
                self._first_id + j, ground.succeeded, lost=ground.lost, flight_time_s=max(tally.flight_time_s, 0.0),
                rms_m=tally.rms_m, worst_m=tally.worst_m if tally.count else None,
            )
            for j, (ground, tally) in enumerate(zip(self.grounds, self._tallies, strict=True))
        )  # fmt: skip


def _named(report: Callable[[str], None], system_id: int) -> Callable[[str], None]:
    return lambda text: report(f"{system_id}: {text}")
