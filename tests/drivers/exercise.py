"""Flights for the tests: both shipped wings in memory, and both on clocks of their own as real time moves them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from mavsitl_ground.controller import Ground
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import drivers, scenario
from mavsitl.ends import NullRecorder
from mavsitl.link.impaired import channels_for
from mavsitl.log.flight import FlightData
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.scenario import Flight


def shortened(name: str, duration_s: float, **overrides: Any) -> Flight:
    """A shipped scenario; a double underscore in a name stands for the dot of a key."""
    dotted = {key.replace("__", "."): value for key, value in overrides.items()}
    return scenario.load(name, {"duration_s": duration_s, **dotted})


class Flown(NamedTuple):
    wire_hash: str
    data: FlightData
    phase: str


def fly_in_memory(flight: Flight) -> Flown:
    vehicle_log, ground_log = MemoryRecorder(), MemoryRecorder()
    vehicle = Vehicle(flight, vehicle_log, seed=flight.scenario.seed, lockstep=True)
    ground = Ground(flight, ground_log)
    tap = drivers.Tap()
    channels = channels_for(flight.scenario.link, flight.scenario.seed)
    drivers.fly_in_memory(vehicle, ground, tap, max_time_s=flight.scenario.duration_s + 30.0, channels=channels)
    data = FlightData.from_recorders(vehicle_log, ground_log, duration_s=flight.scenario.duration_s)
    return Flown(tap.wire.hexdigest(), data, ground.phase)


def hash_in_memory(flight: Flight) -> str:
    vehicle = Vehicle(flight, NullRecorder(), seed=flight.scenario.seed, lockstep=True)
    tap = drivers.Tap()
    channels = channels_for(flight.scenario.link, flight.scenario.seed)
    drivers.fly_in_memory(vehicle, Ground(flight, NullRecorder()), tap, channels=channels)
    return tap.wire.hexdigest()


class Air:
    """A ground that always runs and a vehicle that comes and goes, each with its own clock, on a link without loss."""

    def __init__(self, flight: Flight, *, system_id: int | None = None) -> None:
        self.flight = flight
        self.said: list[str] = []
        self.ground = Ground(flight, NullRecorder(), report=self.said.append, vehicle_system_id=system_id)
        self.vehicle: Vehicle | None = None
        self.ground_us = 0
        self.vehicle_us = 0
        self.from_ground: list[bytes] = []
        """Every datagram that the ground sent."""

    def start_vehicle(self, system_id: int = 1) -> Vehicle:
        """A new one, whose clock begins at 0."""
        self.vehicle = Vehicle(self.flight, NullRecorder(), seed=self.flight.scenario.seed, system_id=system_id)
        self.vehicle_us = 0
        return self.vehicle

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let up to `seconds` of the ground's time pass; whether `until` came true."""
        period_us = self.ground.period_us
        end_us = self.ground_us + round(seconds * 1e6)
        while self.ground_us < end_us:
            self.ground_us += period_us
            if self.vehicle is not None:
                self.vehicle.step(self.vehicle_us)
                self.vehicle_us += period_us
                for datagram in self.vehicle.datagrams(0, combine=False):
                    self.ground.receive(0, datagram)
            self.ground.step(self.ground_us)
            for datagram in self.ground.datagrams(0, combine=False):
                self.from_ground.append(datagram)
                if self.vehicle is not None:
                    self.vehicle.receive(0, datagram)
            if until():
                return True
        return False

    def reaches(self, phase: str, within_s: float = 10.0) -> bool:
        return self.run(within_s, lambda: self.ground.phase == phase)
