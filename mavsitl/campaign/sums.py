"""Recorders that keep running sums only: the paper's measures of a flight of any length in constant memory.

The rows of a short stretch are joined by `FlightData` as those of a whole flight are, added to the sums and dropped.
"""

from __future__ import annotations

import sys
from math import sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from mavsitl.log import topics
from mavsitl.log.flight import FlightData, FlightError
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.scenario import Flight, Gust, LinkModel, Scenario, Steps

OFFBOARD = 14
"""vehicle_status.nav_state, PX4's number."""

LOST_M = 20.0
"""A position error beyond this is a lost flight."""
SETTLED_M = 0.1
"""A vehicle that is nearer than this to its reference, and stays so, has settled."""

Table = dict[str, npt.NDArray[Any]]
Six = tuple[float, float, float, float, float, float]


class _Stretch(MemoryRecorder):
    """Gives its rows away."""

    def take(self) -> dict[str, Table]:
        """The rows since the last time."""
        tables = self.tables()
        for _, sink in self._rows.values():
            sink.offset = 0
        return tables


class Sums:
    """`vehicle` and `ground` are the ends' recorders; `collect` between two ticks, when both have written the last.

    Position errors in m (NWU), attitude errors in degrees, from the release to the end of the scenario's duration.
    """

    def __init__(self, flight: Flight) -> None:
        self.vehicle = _Stretch()
        self.ground = _Stretch()
        self._duration_s = flight.scenario.duration_s
        self._lossy = flight.scenario.link != LinkModel()
        self._newest: dict[str, Table] = {}
        """The ground's newest row of each topic that is held."""
        self._first_weights = first_weights(flight)
        self._events = np.array(events(flight.scenario))
        self._out_s = np.zeros(len(self._events))
        """When it was last beyond `SETTLED_M` after each event, before the next."""
        self._squares = np.zeros(6)
        self._largest = np.zeros(6)
        self._released_us: int | None = None
        self.samples = 0
        self.time_s = 0.0
        """Of the newest sample, from the release."""
        self.lost_s: float | None = None
        """When the position error first passed `LOST_M` or was not finite; nothing is added from then on."""
        self._rotors: tuple[npt.NDArray[Any], ...] | None = None
        """Each rotor's first speed, and sums of what it differs from that, and of its squares."""
        self.left_offboard = 0
        """How often another mode began to fly, a fail-safe's."""
        self.weight_range = (1.0, 1.0)
        """Least and largest output weight of the PIDNNs off board so far, in multiples of its initial value."""

    @property
    def rmse(self) -> Six | None:
        """x, y, z in m, phi, theta, psi in degrees; None without a sample."""
        return _six(np.sqrt(self._squares / self.samples)) if self.samples else None

    @property
    def largest(self) -> Six:
        """Largest absolute errors so far, as `rmse`."""
        return _six(self._largest)

    @property
    def effort_rad_s(self) -> float | None:
        """RMS of the rotors' speeds about each one's mean so far; None where none was logged."""
        if self._rotors is None:
            return None
        _, total, squares = self._rotors
        variance = squares / self.samples - np.square(total / self.samples)
        return sqrt(max(float(np.mean(variance)), 0.0))

    @property
    def settling_s(self) -> float | None:
        """Mean time from each event to the last moment, before the next, that the vehicle was beyond `SETTLED_M`."""
        begun = self._events[self._events < self.time_s]
        return float(np.mean(np.maximum(self._out_s[: len(begun)] - begun, 0.0))) if len(begun) else None

    def collect(self) -> None:
        """Add what was recorded since the last time, and drop it."""
        self.add(self.vehicle.take(), self.ground.take())

    def add(self, vehicle: dict[str, Table], ground: dict[str, Table]) -> None:
        """Rows of both ends, by topic; `vehicle` loses what is joined."""
        land = vehicle.pop(topics.LAND_DETECTED.name, None)
        if self._released_us is None and land is not None and (land["landed"] == 0).any():
            self._released_us = int(land["timestamp"][land["landed"] == 0][0])
        if self._released_us is None or self.lost_s is not None:
            return
        status = vehicle.get(topics.VEHICLE_STATUS.name)
        if status is not None:
            flown_us = status["timestamp"].astype(np.int64) - self._released_us
            during = (flown_us >= 0) & (flown_us < 1e6 * self._duration_s)
            self.left_offboard += int(np.count_nonzero(during & (status["nav_state"] != OFFBOARD)))
        truth = vehicle.get(topics.LOCAL_POSITION_TRUTH.name)
        if self._lossy and truth is not None:
            for topic in (topics.TRAJECTORY_SETPOINT, topics.ATTITUDE_SETPOINT):
                self._hold(ground, topic.name, truth["timestamp"])
        vehicle[topics.LAND_DETECTED.name] = {
            "timestamp": np.array([self._released_us], np.uint64),
            "landed": np.zeros(1, np.uint8),
        }
        try:
            stretch = FlightData.from_tables(vehicle, ground, duration_s=self._duration_s)
        except FlightError:  # nothing of the flight in this stretch: before its first sample or after its last
            return
        position = stretch.position_error_nwu_m()
        held = np.linalg.norm(position, axis=1) <= LOST_M  # false for NaN as well
        count = len(held) if held.all() else int(np.argmin(held))
        if count < len(held):
            self.lost_s = float(stretch.time_s[count])
        if not count:
            return
        errors = np.hstack((position, stretch.attitude_error_deg()))[:count]
        self.samples += count
        self.time_s = float(stretch.time_s[count - 1])
        self._squares += np.sum(np.square(errors), axis=0)
        self._largest = np.maximum(self._largest, np.max(np.abs(errors), axis=0))
        self._add_settling(stretch.time_s[:count], position[:count])
        if stretch.rotor_speed_rad_s is not None:
            self._add_rotors(stretch.rotor_speed_rad_s[:count])
        if stretch.weights is not None:
            known = self._first_weights > 0.0
            ratios = (stretch.weights[:count] / np.where(known, self._first_weights, 1.0))[:, known]
            if np.isnan(ratios).all():  # none has come over a bad link yet
                return
            low, high = self.weight_range
            largest = min(float(np.nanmax(ratios)), sys.float_info.max)  # a law that diverges passes it
            self.weight_range = (min(low, float(np.nanmin(ratios))), max(high, largest))

    def _add_settling(self, time_s: npt.NDArray[np.float64], error_m: npt.NDArray[np.float64]) -> None:
        out_s = time_s[np.linalg.norm(error_m, axis=1) > SETTLED_M]
        which = np.searchsorted(self._events, out_s, side="right") - 1
        np.maximum.at(self._out_s, which[which >= 0], out_s[which >= 0])

    def _add_rotors(self, speeds: npt.NDArray[np.float64]) -> None:
        """(k, 4), from the stretch's first sample on."""
        if self._rotors is None:
            self._rotors = (speeds[0], np.zeros(speeds.shape[1]), np.zeros(speeds.shape[1]))
        first, total, squares = self._rotors
        change = speeds - first
        self._rotors = (first, total + change.sum(axis=0), squares + np.square(change).sum(axis=0))

    def _hold(self, ground: dict[str, Table], name: str, stamps: npt.NDArray[np.uint64]) -> None:
        """At each stamp the ground's newest row that is not younger, so that what a link loses is not left out."""
        table = ground.get(name)
        kept = self._newest.get(name)
        if table is None or not len(table["timestamp"]):
            table = kept
        elif kept is not None:
            table = {column: np.concatenate((kept[column], table[column])) for column in table}
        if table is None:
            return
        self._newest[name] = {column: values[-1:] for column, values in table.items()}
        rows = np.searchsorted(table["timestamp"], stamps, side="right") - 1
        known = rows >= 0
        ground[name] = {column: values[rows[known]] for column, values in table.items()}
        ground[name]["timestamp"] = stamps[known]


def events(scenario: Scenario) -> list[float]:
    """Flight times, in s, at which something happens that a vehicle has to recover from: steps of the reference, gusts,
    failures, outages of the link. In order, each once.
    """
    found = {step.time_s for step in scenario.reference.steps} if isinstance(scenario.reference, Steps) else set()
    found |= {wind.start_s for wind in scenario.wind if isinstance(wind, Gust)}
    found |= {each.start_s for each in scenario.failures if each.clock == "flight"}
    for direction in (scenario.link.to_ground, scenario.link.to_vehicle):
        found |= {outage.start_s for outage in direction.outages if outage.clock == "flight"}
    return sorted(time_s for time_s in found if time_s > 0.0)


def first_weights(flight: Flight) -> npt.NDArray[np.float64]:
    """(3 nets roll, pitch, yaw, 3 outputs P, I, D) with which the PIDNN is the PID (eqs 39, 42)."""
    controller, period_s = flight.scenario.controller, flight.scenario.rates.control_period_us / 1e6
    axes = (controller.roll_pitch, controller.roll_pitch, controller.yaw)
    return np.array([[g.k_p_per_s2, g.k_i_per_s3 * period_s, g.k_d_per_s / period_s] for g in axes])


def _six(values: npt.NDArray[np.float64]) -> Six:
    x, y, z, phi, theta, psi = values.tolist()
    return x, y, z, phi, theta, psi
