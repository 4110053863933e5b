"""The pilot: MANUAL_CONTROL in, the setpoints of the stick modes out."""

from __future__ import annotations

from math import inf, isfinite, nan
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


GESTURE = 0.9
"""Share of a stick's travel that counts as its corner."""
REST_S = 1.0
"""Time constant of the place where a stick is taken to rest: what is away from it has been moved."""


class Pilot:
    """Keeps the newest sticks, and one law for each stick mode."""

    def __init__(self, parameters: Values, gravity_m_s2: float, hover_thrust: float, period_s: float) -> None:
        self.axes = CENTRED
        self.received_us: int | None = None
        self.moved = False
        """The sticks have been moved, by COM_RC_STICK_OV or more, within about `REST_S`."""
        self._parameters = parameters
        self._rest = CENTRED
        self._gesture_us: int | None = None
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
        self._watch(now_us)
        self.received_us = now_us
        return True

    def kill_asked(self, now_us: int) -> bool:
        """Both sticks in their lower outer corners for MAN_KILL_GEST_T; negative: never."""
        limit_s = self._parameters["MAN_KILL_GEST_T"]
        since_us = self._gesture_us
        return since_us is not None and limit_s >= 0.0 and now_us - since_us >= int(limit_s * 1e6)

    def _watch(self, now_us: int) -> None:
        axes, last_us = self.axes, self.received_us
        elapsed_s = inf if last_us is None else (now_us - last_us) / 1e6
        silent = elapsed_s > REST_S
        share = min(elapsed_s / REST_S, 1.0)
        self._rest = Axes(*(rest + share * (axis - rest) for rest, axis in zip(self._rest, axes, strict=True)))
        limit = 0.01 * self._parameters["COM_RC_STICK_OV"]
        away = (abs(axis - rest) for rest, axis in zip(self._rest, axes, strict=True))
        self.moved = any(isfinite(distance) and distance > limit for distance in away)
        corner = axes.throttle < 0.5 * (1.0 - GESTURE) and axes.yaw < -GESTURE
        corner = corner and axes.pitch < -GESTURE and axes.roll > GESTURE
        if not corner or silent:
            self._gesture_us = None
        if corner and self._gesture_us is None:
            self._gesture_us = now_us

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
