"""The pilot: MANUAL_CONTROL in, the setpoints of the stick modes out."""

from __future__ import annotations

from math import nan
from typing import Any

from mavsitl_vehicle.autopilot.modes import Mode
from mavsitl_vehicle.autopilot.position import Values
from mavsitl_vehicle.autopilot.setpoints import PositionSetpoint, Setpoint, State
from mavsitl_vehicle.autopilot.sticks import (
    CENTRED,
    Acro,
    AltitudeControl,
    Axes,
    PositionHold,
    Stabilized,
    wants_takeoff,
)  # fmt: skip

FULL = 1000
"""MANUAL_CONTROL's full deflection; an axis beyond it, INT16_MAX among them, is not there."""


class Pilot:
    """Keeps the newest sticks, and one law for each stick mode."""

    def __init__(self, parameters: Values, gravity_m_s2: float, hover_thrust: float, period_s: float) -> None:
        self.axes = CENTRED
        self.received_us: int | None = None
        self._laws: dict[Mode, Stabilized | Acro | AltitudeControl | PositionHold] = {
            Mode.MANUAL: Stabilized(parameters, hover_thrust, period_s),
            Mode.STABILIZED: Stabilized(parameters, hover_thrust, period_s),
            Mode.ACRO: Acro(parameters, hover_thrust),
            Mode.ALTCTL: AltitudeControl(parameters, gravity_m_s2, period_s),
            Mode.POSCTL: PositionHold(parameters, period_s),
        }

    def receive(self, message: Any, now_us: int) -> bool:
        """Take a MANUAL_CONTROL; False where none of its axes is there."""
        x, y, r, z = (
            value / FULL if abs(value) <= FULL else nan for value in (message.x, message.y, message.r, message.z)
        )
        if x != x and y != y and r != r and z != z:
            return False
        old = self.axes
        self.axes = Axes(
            x if x == x else old.pitch, y if y == y else old.roll, r if r == r else old.yaw,
            max(z, 0.0) if z == z else old.throttle,
        )  # fmt: skip
        self.received_us = now_us
        return True

    def engage(self, mode: Mode, state: State) -> None:
        self._laws[mode].engage(state)

    def update(self, mode: Mode, state: State, height_m: float, *, present: bool) -> Setpoint | PositionSetpoint:
        """`present`: sticks that fell silent count as centred until the fail-safe acts."""
        axes = self.axes if present else CENTRED
        law = self._laws[mode]
        if isinstance(law, AltitudeControl | PositionHold):
            return law.update(axes, state, height_m)
        return law.update(axes, state)

    def wants_lift(self, mode: Mode) -> bool:
        """Do the sticks ask to leave the ground?"""
        if isinstance(self._laws[mode], AltitudeControl | PositionHold):
            return wants_takeoff(self.axes)
        return self.axes.throttle > 0.0
