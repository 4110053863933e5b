"""Many vehicles in one process: each a whole one with an autopilot of its own, and all bodies stepped in one call."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mavsitl import formation, seeds
from mavsitl.codec import Counters
from mavsitl.fleet import Collision
from mavsitl.keep import Work
from mavsitl.link.budget import Excess
from mavsitl.log.ulog import Recorder
from mavsitl.routing import NOBODY, by_target
from mavsitl.scenario import Fleet as Settings
from mavsitl.scenario import Flight
from mavsitl_vehicle.failures import Kind, Unit
from mavsitl_vehicle.kept import Kept
from mavsitl_vehicle.tick import Array
from mavsitl_vehicle.vehicle import Vehicle, take_seats

LOOKS = 25
"""In so many looks for what is unsaved each vehicle is looked at once: what is kept does not change every tick."""

MAX_COLLISIONS = 1000
"""Remembered; further ones are still said to the vehicles and logged."""


class Fleet:
    """`count` vehicles of one scenario in their formation; one is the vehicle alone, byte for byte.

    Ports are numbered through: vehicle j's `ports` are j * len(ports) and after it. With `one_link` there are `ports`
    for all together: a frame goes to the vehicle that it is for, one for everybody to each.

    Attributes:
        vehicles: in the order of their system ids.
        collisions: those so far.
    """

    def __init__(
        self,
        flight: Flight,
        recorders: Sequence[Recorder],
        *,
        seed: int,
        count: int,
        system_id: int = 1,
        ports: Sequence[str] = ("offboard",),
        one_link: bool = False,
        lockstep: bool = False,
        states: Sequence[Path | None] | None = None,
        logs: Sequence[Path | None] | None = None,
        unix_us: Callable[[], int] | None = None,
        trusted: bool = True,
    ) -> None:
        """`recorders`, `states` and `logs` are each vehicle's, `system_id` the first one's.

        The rest is as in `Vehicle`.
        """
        flights = formation.flights(flight, count)
        states, logs = states or [None] * count, logs or [None] * count
        kept = [
            Kept(each, system_id=system_id + j, state=states[j], logs=logs[j], unix_us=unix_us, trusted=trusted)
            for j, each in enumerate(flights)
        ]
        seats = take_seats(flights, kept, seed, shared_wind=flight.scenario.fleet.shared_wind and count > 1)
        self.vehicles = [
            Vehicle(
                flights[j], recorders[j], seed=seeds.of_vehicle(seed, j), system_id=system_id + j, ports=ports,
                lockstep=lockstep, forwards=j == 0 or not one_link,
                stream_hz=flight.scenario.fleet.stream_hz, seat=seat,
            )
            for j, seat in enumerate(seats)
        ]  # fmt: skip
        self.period_us = self.vehicles[0].period_us
        self.collisions: list[Collision] = []
        self._ports = len(ports)
        self._one_link = one_link
        self._by_system = {system_id + j: j for j in range(count)}
        self._simulations = list(dict.fromkeys(seat.simulation for seat in seats))
        self._times_s = [np.zeros(simulation.n) for simulation in self._simulations]
        self._columns = [(seat.simulation, self._simulations.index(seat.simulation), seat.column) for seat in seats]
        self._near = _Near(flight.scenario.fleet, count)
        self._cut = flight.scenario.fleet.on_collision == "crash"
        self._active: set[int] = set(range(count))
        """Vehicles that may have something to send."""
        self._looked = 0
        self._writing: dict[Work, Vehicle] = {}
        self._first = True

    @property
    def name(self) -> str:
        """The scenario's."""
        return self.vehicles[0].name

    @property
    def finished(self) -> bool:
        """All have flown and are disarmed again."""
        return all(vehicle.finished for vehicle in self.vehicles)

    @property
    def succeeded(self) -> bool:
        return self.finished

    @property
    def flight_time_s(self) -> float:
        """The longest since a release; negative before the first."""
        return max(vehicle.flight_time_s for vehicle in self.vehicles)

    @property
    def counters(self) -> Any:
        """Frames received and refused, by reason, of all vehicles."""
        return sum((vehicle.counters for vehicle in self.vehicles), Counters())

    @property
    def signed_only(self) -> bool:
        """Every link of every vehicle obeys messages alone that carry a good signature."""
        return all(vehicle.signed_only for vehicle in self.vehicles)

    # --- time --------------------------------------------------------------------------------------------------------

    def step(self, now_us: int) -> None:
        """All fly from the last step to `now_us`, one control period later."""
        for vehicle, (_, number, column) in zip(self.vehicles, self._columns, strict=True):
            self._times_s[number][column] = vehicle.decide(now_us)
        if not self._first:
            for simulation, times_s in zip(self._simulations, self._times_s, strict=True):
                simulation.advance(times_s)
        self._first = False
        for vehicle in self.vehicles:
            vehicle.observe(now_us)
        if self._near.due(now_us):
            self._collide(now_us)
        self._active.update(range(len(self.vehicles)))

    def positions_nwu_m(self) -> Array:
        """Where they really are, (3, count)."""
        if len(self._simulations) == 1:
            positions: Array = self._simulations[0].x[0:3]
            return positions
        return np.stack([simulation.x[0:3, column] for simulation, _, column in self._columns], axis=-1)

    def _collide(self, now_us: int) -> None:
        for i, j, distance_m in self._near.began(self.positions_nwu_m()):
            pair = self.vehicles[i], self.vehicles[j]
            for vehicle, other in (pair, pair[::-1]):
                vehicle.note(f"Collision with vehicle {other.system_id}: {distance_m:.2f} m")
                if self._cut:
                    vehicle.failures.set(Unit.MOTOR, Kind.OFF)
            if len(self.collisions) < MAX_COLLISIONS:
                self.collisions.append(Collision(now_us / 1e6, pair[0].system_id, pair[1].system_id, distance_m))

    # --- messages ----------------------------------------------------------------------------------------------------

    def receive(self, port: int, datagram: bytes, at_us: int | None = None) -> int:
        """One datagram from a link; the number of valid frames in it, for whomever."""
        if not self._one_link:
            j, own = divmod(port, self._ports)
            self._active.add(j)
            return self.vehicles[j].receive(own, datagram, at_us)
        valid = 0
        for target, frames in by_target(datagram):
            if target == 0:
                self._active.update(range(len(self.vehicles)))
                valid += max([vehicle.receive(port, frames, at_us) for vehicle in self.vehicles])
                continue
            # What is for nobody here, or is no frame, is the first one's to pass on or to count.
            j = 0 if target == NOBODY else self._by_system.get(target, 0)
            self._active.add(j)
            valid += self.vehicles[j].receive(port, frames, at_us)
        return valid

    def outgoing(self) -> Iterator[tuple[int, list[bytes]]]:
        """(port, datagrams) where there is something to send; the frames of one vehicle for one link are together."""
        active, self._active = sorted(self._active), set()
        for j in active:
            first = 0 if self._one_link else j * self._ports
            for own, port in enumerate(self.vehicles[j].autopilot.ports):
                if port.node.queued:
                    yield first + own, port.node.datagrams(combine=True)

    def refuse(self, port: int, excess: Excess) -> None:
        """A datagram from a link was dropped unread; on a link of all it is counted as the first one's."""
        j, own = (0, port) if self._one_link else divmod(port, self._ports)
        self.vehicles[j].refuse(own, excess)

    def warn(self, text: str) -> None:
        """For whoever flies any of them."""
        for vehicle in self.vehicles:
            vehicle.warn(text)

    def set_load(self, load: float) -> None:
        """The share of a processor that all of them take together."""
        for vehicle in self.vehicles:
            vehicle.set_load(load)

    # --- what is kept ------------------------------------------------------------------------------------------------

    def unsaved(self, now_us: int) -> list[Work]:
        """As a vehicle's, of the next few of them; after `close` of all."""
        vehicles = self.vehicles
        few = len(vehicles) if self._looked < 0 else -(-len(vehicles) // LOOKS)
        found: list[Work] = []
        for _ in range(few):
            self._looked = (self._looked + 1) % len(vehicles)
            vehicle = vehicles[self._looked]
            for work in vehicle.unsaved(now_us):
                self._writing[work] = vehicle
                found.append(work)
        return found

    def saved(self, work: Work, error: OSError | None, now_us: int) -> None:
        """What became of what `unsaved` gave."""
        self._writing.pop(work).saved(work, error, now_us)

    def close(self) -> None:
        for vehicle in self.vehicles:
            vehicle.close()
        self._looked = -1


class _Near:
    """Which pairs have come nearer than a collision's distance."""

    def __init__(self, settings: Settings, count: int) -> None:
        self._square_m2 = settings.collision_m**2
        self._interval_us = 1_000_000 // settings.collision_hz
        self._due_us = 0 if count > 1 and settings.collision_m > 0.0 else None
        self._together: set[tuple[int, int]] = set()

    def due(self, now_us: int) -> bool:
        if self._due_us is None or now_us < self._due_us:
            return False
        self._due_us = now_us + self._interval_us
        return True

    def began(self, positions_m: Array) -> list[tuple[int, int, float]]:
        """(one, other, distance in m) of the pairs at `positions_m` (3, n) that were apart when looked at last."""
        between = positions_m[:, :, None] - positions_m[:, None, :]
        square = np.einsum("aij,aij->ij", between, between)
        found = np.argwhere(np.triu(square < self._square_m2, 1)).tolist()
        before, self._together = self._together, {(i, j) for i, j in found}
        return [(i, j, float(np.sqrt(square[i, j]))) for i, j in found if (i, j) not in before]
