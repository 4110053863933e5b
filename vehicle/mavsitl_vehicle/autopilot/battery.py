"""The battery: drained by the rotors' mechanical power, with a cell's discharge curve and internal resistance."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from enum import IntEnum
from itertools import pairwise
from math import ceil, sqrt
from typing import NamedTuple, Protocol

from mavsitl.airframes import Airframe
from mavsitl_vehicle.failures import Kind

OPEN_CIRCUIT_V = (
    (0.00, 3.30),
    (0.05, 3.60),
    (0.10, 3.69),
    (0.20, 3.74),
    (0.30, 3.78),
    (0.40, 3.81),
    (0.50, 3.85),
    (0.60, 3.90),
    (0.70, 3.97),
    (0.80, 4.04),
    (0.90, 4.11),
    (1.00, 4.20),
)
"""(state of charge, V) of one lithium-polymer cell at rest, a typical discharge curve; straight lines between."""

AVERAGE_S = 30.0
"""Time constant of the mean drain that the remaining time is reckoned with."""

_CHARGES = [charge for charge, _ in OPEN_CIRCUIT_V]
_LINES = [(x0, y0, (y1 - y0) / (x1 - x0)) for (x0, y0), (x1, y1) in pairwise(OPEN_CIRCUIT_V)]


class Level(IntEnum):
    """PX4's battery warnings; MAV_BATTERY_CHARGE_STATE is one more."""

    FINE = 0
    LOW = 1
    CRITICAL = 2
    EMERGENCY = 3


class Values(Protocol):
    """Parameters by name."""

    def __getitem__(self, name: str, /) -> float: ...


class Settings(NamedTuple):
    """What the user may change in flight."""

    low: float = 0.15
    """BAT_LOW_THR: shares of the charge below which each warning holds."""
    critical: float = 0.07
    """BAT_CRIT_THR"""
    emergency: float = 0.05
    """BAT_EMERGEN_THR"""
    enabled: bool = True
    """SIM_BAT_ENABLE: False keeps the charge as it is."""
    drain_s: float = 0.0
    """SIM_BAT_DRAIN: time from full to empty in hover, instead of what the pack's capacity gives; 0: the capacity."""
    floor: float = 0.0
    """SIM_BAT_MIN_PCT as a share: the charge stays at or above this."""


def settings(parameters: Values) -> Settings:
    """`Settings` from the vehicle's parameters. The names must be there."""
    return Settings(
        low=parameters["BAT_LOW_THR"],
        critical=parameters["BAT_CRIT_THR"],
        emergency=parameters["BAT_EMERGEN_THR"],
        enabled=parameters["SIM_BAT_ENABLE"] != 0.0,
        drain_s=parameters["SIM_BAT_DRAIN"],
        floor=parameters["SIM_BAT_MIN_PCT"] / 100.0,
    )


def described(airframe: Airframe) -> dict[str, float]:
    """The pack as PX4's parameters describe it: values of BAT1_* that fit the airframe."""
    return {
        "BAT1_N_CELLS": float(airframe.battery_cells),
        "BAT1_V_CHARGED": OPEN_CIRCUIT_V[-1][1],
        "BAT1_V_EMPTY": OPEN_CIRCUIT_V[1][1],
        "BAT1_CAPACITY": 1000.0 * airframe.battery_capacity_ah,
        "BAT1_R_INTERNAL": airframe.battery_cell_resistance_ohm,
    }


def open_circuit_v(charge: float) -> float:
    """One cell's voltage at rest; `charge` from 0 to 1."""
    x, y, slope = _LINES[min(bisect_right(_CHARGES, charge), len(_LINES)) - 1]
    return y + slope * (charge - x)


class Battery:
    """One pack. `update` it with the time that passed; disarmed it rests on the charger's power and keeps its charge.

    Attributes:
        charge: 0 to 1, as measured: a failure makes it wrong.
        voltage_v, current_a: at the terminals, under load, as measured.
        consumed_ah, consumed_j: since full.
        settings: replace it when a parameter changes.
    """

    def __init__(self, airframe: Airframe, settings: Settings | None = None) -> None:
        self.settings = settings or Settings()
        self.cells = airframe.battery_cells
        self.capacity_ah = airframe.battery_capacity_ah
        self._resistance = airframe.battery_cell_resistance_ohm
        self._drag = airframe.drag_coefficient_n_m_s2 / airframe.battery_efficiency
        self._hotel_w = airframe.battery_hotel_w
        self._hover_w = self._hotel_w + 4.0 * self.power_w(airframe.hover_rotor_speed_rad_s)
        self.refill()

    def refill(self) -> None:
        """A full pack, at rest."""
        self.charge = 1.0
        self._true_charge = 1.0
        """What it would have without a failure."""
        self._failure = Kind.OK
        self.current_a = 0.0
        self.voltage_v = self.cells * open_circuit_v(1.0)
        self.consumed_ah = 0.0
        self.consumed_j = 0.0
        self._average_per_s = 0.0
        """Mean share of the charge that goes in a second; 0: none has gone yet."""

    def power_w(self, rotor_speed_rad_s: float) -> float:
        """Electrical power of one rotor: drag torque d omega^2 (eq 9) times omega, by the power train's efficiency."""
        return self._drag * rotor_speed_rad_s * rotor_speed_rad_s * abs(rotor_speed_rad_s)

    def update(
        self, rotor_speeds_rad_s: Sequence[float], armed: bool, dt_s: float,
        failure: Kind = Kind.OK, left: float = 0.0,
    ) -> None:  # fmt: skip
        """Draw the rotors' power and the hotel load for `dt_s`; `left`: the charge of a pack that is WRONG."""
        if failure in (Kind.OK, Kind.SLOW) and self._failure is Kind.OK:
            self._draw(rotor_speeds_rad_s, armed, dt_s)
            return
        if self._failure is Kind.OK:
            self._true_charge = self.charge
        self._failure = failure
        shown = self.charge, self.voltage_v, self.current_a
        self.charge = self._true_charge
        self._draw(rotor_speeds_rad_s, armed, dt_s)
        self._true_charge = self.charge
        if failure is Kind.STUCK:
            self.charge, self.voltage_v, self.current_a = shown
        elif failure in (Kind.OFF, Kind.WRONG):
            lost_v = open_circuit_v(self.charge)
            self.charge = 0.0 if failure is Kind.OFF else min(left, self.charge)
            self.voltage_v -= self.cells * (lost_v - open_circuit_v(self.charge))

    def _draw(self, rotor_speeds_rad_s: Sequence[float], armed: bool, dt_s: float) -> None:
        rest_v = open_circuit_v(self.charge)
        if not armed:
            self.current_a = 0.0
            self.voltage_v = self.cells * rest_v
            return
        power_w = self._hotel_w
        for speed in rotor_speeds_rad_s:
            power_w += self.power_w(speed)
        # P = n (U0 - R I) I for I. Beyond the peak of that parabola the pack cannot follow and gives its most.
        per_cell_w, resistance = power_w / self.cells, self._resistance
        if resistance > 0.0:
            root = rest_v * rest_v - 4.0 * resistance * per_cell_w
            self.current_a = 2.0 * per_cell_w / (rest_v + sqrt(root)) if root > 0.0 else 0.5 * rest_v / resistance
        else:
            self.current_a = per_cell_w / rest_v
        self.voltage_v = self.cells * (rest_v - resistance * self.current_a)
        self.consumed_ah += self.current_a * dt_s / 3600.0
        self.consumed_j += self.voltage_v * self.current_a * dt_s
        levels = self.settings
        if not levels.enabled:
            return
        if levels.drain_s > 0.0:
            per_s = power_w / self._hover_w / levels.drain_s
        else:
            per_s = self.current_a / (3600.0 * self.capacity_ah)
        self.charge = max(self.charge - per_s * dt_s, min(levels.floor, 1.0), 0.0)
        average = self._average_per_s or per_s
        self._average_per_s = average + min(dt_s / AVERAGE_S, 1.0) * (per_s - average)

    @property
    def level(self) -> Level:
        """The warning in force; a share equal to a threshold is still above it, as in PX4."""
        charge, levels = self.charge, self.settings
        if charge < levels.emergency:
            return Level.EMERGENCY
        if charge < levels.critical:
            return Level.CRITICAL
        return Level.LOW if charge < levels.low else Level.FINE

    @property
    def remaining_percent(self) -> int:
        """0 only where nothing is left: clients take 0 for empty."""
        return ceil(100.0 * self.charge)

    @property
    def remaining_s(self) -> float | None:
        """At the mean drain of the last half minute or so; None before there was any."""
        return self.charge / self._average_per_s if self._average_per_s > 0.0 else None
