"""The parameters that make something happen to the vehicle: failures, a stalled processor, a wrong clock, a gust."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import TYPE_CHECKING

from mavsitl.scenario import Flight, Gust, ScenarioError
from mavsitl_vehicle import failures
from mavsitl_vehicle.autopilot.parameters import TABLE, Parameters, checked
from mavsitl_vehicle.failures import Change, Kind, Unit
from mavsitl_vehicle.schedule import Schedule
from mavsitl_vehicle.wind.field import mil_axes

if TYPE_CHECKING:
    from mavsitl_vehicle.vehicle import Vehicle

HAPPENINGS = ("SIM_CPU_STALL", "SIM_CLK_JUMP", "SIM_GUST_TRIG")
EVENTS = (*failures.PARAMETERS, *failures.EFFICIENCIES, *HAPPENINGS)
"""Parameters that make something happen when they are set."""


class ParameterTimeline:
    """Sets the scenario's parameters when their time comes; those by the flight's time again in each flight."""

    def __init__(self, flight: Flight, parameters: Parameters, warn: Callable[[str], None]) -> None:
        """Raises `ScenarioError` for a name or a value that there is not."""
        self._parameters = parameters
        self._warn = warn
        self._changes = [
            {
                name: checked(f"{flight.name}: parameter_changes[{number}].", name, value)
                for name, value in change.parameters.items()
            }
            for number, change in enumerate(flight.scenario.parameter_changes)
        ]
        self._schedule = Schedule((change.at_s, change.clock) for change in flight.scenario.parameter_changes)

    def __bool__(self) -> bool:
        return bool(self._changes)

    def step(self, now_us: int, flight_time_s: float) -> None:
        """What is due by `now_us` since the start; the flight's time is negative before the release."""
        for number in self._schedule.due(now_us, flight_time_s):
            for name, value in self._changes[number].items():
                if refused := self._parameters.set(name, value):
                    self._warn(refused.text)


class Mishaps:
    """Makes of the parameters what they say, and shows in them what has happened, whoever asked for it."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Raises `ScenarioError` where the scenario or the airframe has such a parameter: these are no settings."""
        self._vehicle = vehicle
        self._parameters = vehicle.parameters
        for name in EVENTS:
            if self._parameters[name] != TABLE[name].default:
                raise ScenarioError(
                    f"{vehicle.name}: parameters.{name}: it happens in flight and is no setting; see [[failures]]"
                )
        self.stalled = False
        """The autopilot does not run."""
        self._stalled_us = 0
        self._gust_ends_s = inf
        self.busy = False
        """`step` is needed."""
        self._showing = False
        self._parameters.guard(self._why_not)
        self._parameters.subscribe(self._on_parameter)
        vehicle.failures.subscribe(self._on_failure)

    def step(self, now_us: int, period_us: int) -> bool:
        """At `now_us`, the end of a control period; whether the autopilot was stalled in it."""
        vehicle = self._vehicle
        if self._parameters["SIM_GUST_TRIG"] and not 0.0 <= vehicle.flight_time_s < self._gust_ends_s:
            self._parameters.put("SIM_GUST_TRIG", 0)
        stall_s = self._parameters["SIM_CPU_STALL"]
        if stall_s and not self.stalled:
            self.stalled = True
            self._stalled_us = now_us - period_us
            vehicle.simulation.stall(vehicle.column, True)
        lasts_us = now_us - period_us - self._stalled_us
        if self.stalled and lasts_us >= stall_s * 1e6 - 0.5:
            self.stalled = False
            vehicle.simulation.stall(vehicle.column, False)
            self._parameters.put("SIM_CPU_STALL", 0)
            vehicle.note(f"Autopilot stalled for {lasts_us / 1e6:g} s")
        self.busy = self.stalled or bool(self._parameters["SIM_GUST_TRIG"])
        return self.stalled

    def mend(self) -> None:
        """The vehicle starts anew: nothing is broken, nothing happens."""
        self._vehicle.failures.clear()
        for name in HAPPENINGS:
            self._parameters.put(name, TABLE[name].default)

    # --- parameters --------------------------------------------------------------------------------------------------

    def _why_not(self, name: str, value: float) -> str | None:
        vehicle = self._vehicle
        if not value or value == self._parameters[name]:
            return None
        if name in failures.PARAMETERS:
            unit, _ = failures.PARAMETERS[name]
            if failures.silences(unit, int(value)) and not vehicle.autopilot.may_fall_silent:
                return failures.NO_SILENCE
            return failures.unsupported(unit, int(value), sensors=vehicle.autopilot.has_sensors)
        if name == "SIM_CPU_STALL" and not vehicle.autopilot.may_fall_silent:
            return failures.NO_SILENCE
        if name == "SIM_GUST_TRIG" and vehicle.flight_time_s < 0.0:
            return "the vehicle is not flying"
        return None

    def _on_parameter(self, name: str, value: float) -> None:
        if self._showing:
            return
        vehicle = self._vehicle
        if name in failures.PARAMETERS:
            unit, instance = failures.PARAMETERS[name]
            vehicle.failures.set(unit, Kind(int(value)), instance)
        elif name in failures.EFFICIENCIES:
            motor = failures.EFFICIENCIES[name]
            if 0.0 < value < 1.0:
                vehicle.failures.set(Unit.MOTOR, Kind.WRONG, motor, value)
            else:
                vehicle.failures.set(Unit.MOTOR, Kind.OK if value else Kind.OFF, motor)
        elif name == "SIM_CPU_STALL":
            self.busy = True
        elif name == "SIM_CLK_JUMP":
            vehicle.autopilot.jump_clock(value)
        elif name == "SIM_GUST_TRIG":
            self._blow(bool(value))

    def _blow(self, start: bool) -> None:
        vehicle, p = self._vehicle, self._parameters
        if not start:
            vehicle.simulation.blow(vehicle.column, None)
            return
        x, y, z = (p["SIM_GUST_SPD"] * mil_axes(p["SIM_GUST_DIR"])[0]).tolist()
        start_s, length_s = vehicle.flight_time_s, p["SIM_GUST_LEN"]
        gust = Gust(velocity_nwu_m_s=(x, y, z), start_s=start_s, length_s=length_s)
        vehicle.simulation.blow(vehicle.column, gust)
        self._gust_ends_s = start_s + 2.0 * length_s
        self.busy = True

    def _on_failure(self, change: Change) -> None:
        self._showing = True
        for name, broken in failures.PARAMETERS.items():
            if broken == (change.unit, change.instance):
                self._parameters.put(name, change.kind)
        for name, motor in failures.EFFICIENCIES.items():
            if (change.unit, change.instance) == (Unit.MOTOR, motor):
                share = {Kind.OFF: 0.0, Kind.WRONG: change.value}.get(change.kind, 1.0)
                self._parameters.put(name, share)
        self._showing = False
        self._vehicle.note_failure(change)
