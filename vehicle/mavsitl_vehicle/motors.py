"""What failures make of the commands to the rotors: the rows `motors` of `mavsitl_vehicle.tick`, kept up to date."""

from __future__ import annotations

from math import exp, inf, nan, sqrt

from mavsitl import seeds
from mavsitl_vehicle import tick
from mavsitl_vehicle.failures import Change, Failures, Kind, Unit

MOTORS = 4
CUT_OUT_S, TURNING_S = 0.1, 1.0
"""INTERMITTENT: mean lengths of the stretches without and with power, exponentially distributed."""
GARBAGE_S = 0.1
"""GARBAGE: so long each speed is held."""


class MotorFailures:
    """Of one vehicle."""

    def __init__(
        self, failures: Failures, seed: int, step_s: float, largest_rad_s: float, rows: tick.Array, vehicle: int
    ) -> None:
        """`step_s`: of the physics; `rows` (MOTOR_ROWS,): its column; `vehicle`: its number in the fleet."""
        self._rows = rows
        rows[tick.SPEED_SHARE : tick.SPEED_SHARE + MOTORS] = 1.0
        rows[tick.FIXED_SPEED : tick.FIXED_SPEED + MOTORS] = nan
        rows[tick.FOLLOW : tick.FOLLOW + MOTORS] = 1.0
        self.busy = False
        """`step` is needed before the next period."""
        self._failures = failures
        self._step_s = step_s
        self._largest = largest_rad_s
        self._generators = [
            seeds.generator(seed, "vehicle", vehicle, "failures", "motor", motor) for motor in range(1, MOTORS + 1)
        ]
        self._kinds = [Kind.OK] * MOTORS
        self._changes_at_s = [-inf] * MOTORS
        """When an erratic motor does something else."""
        self._turning = [True] * MOTORS
        self._own = [nan] * MOTORS
        """Speed that a motor turns at by itself, rad/s; NaN: as commanded."""
        self._held: tick.Array | None = None
        failures.subscribe(self._on_change)

    @property
    def commanded_rad_s(self) -> tick.Array:
        """(4,) what the allocation asked of the rotors."""
        commanded: tick.Array = self._rows[tick.COMMANDED : tick.COMMANDED + MOTORS]
        return commanded

    def hold(self, command_rad_s: tick.Array | None) -> None:
        """All motors at these speeds (4,) whatever is commanded; None: as commanded again."""
        self._held = None if command_rad_s is None else command_rad_s.copy()
        self.busy = True

    def step(self, time_s: float, speeds_rad_s: tick.Array) -> None:
        """Before a control period that begins at `time_s`, with the rotors' speeds (4,) at its beginning."""
        self.busy = False
        for index in range(MOTORS):
            kind = self._failures.of(Unit.MOTOR, index + 1)
            value = self._failures.value(Unit.MOTOR, index + 1)
            began = kind is not self._kinds[index]
            self._kinds[index] = kind
            share, fixed, follow = 1.0, nan, 1.0
            if kind is Kind.OFF:
                fixed = 0.0
            elif kind is Kind.STUCK:
                if began:
                    self._own[index] = float(speeds_rad_s[index])
                fixed = self._own[index]
            elif kind is Kind.WRONG:
                share = sqrt(value)  # eq 3: thrust and drag torque go by the square of the speed
            elif kind is Kind.SLOW:
                follow = 1.0 - exp(-self._step_s / value)
            elif kind is not Kind.OK:
                if began or time_s >= self._changes_at_s[index]:
                    self._go_on(index, kind, time_s, began)
                fixed = self._own[index]
                self.busy = True
            if self._held is not None:
                fixed = float(self._held[index])
            self._rows[tick.SPEED_SHARE + index] = share
            self._rows[tick.FIXED_SPEED + index] = fixed
            self._rows[tick.FOLLOW + index] = follow

    def _go_on(self, index: int, kind: Kind, time_s: float, began: bool) -> None:
        """What a motor that goes its own ways does next, and for how long."""
        generator = self._generators[index]
        if kind is Kind.GARBAGE:
            self._own[index] = self._largest * float(generator.random())
            self._changes_at_s[index] = time_s + GARBAGE_S
            return
        turning = self._turning[index] = not (began or self._turning[index])
        self._own[index] = nan if turning else 0.0
        mean_s = TURNING_S if turning else CUT_OUT_S
        self._changes_at_s[index] = time_s + mean_s * float(generator.standard_exponential())

    def _on_change(self, change: Change) -> None:
        self.busy = self.busy or change.unit is Unit.MOTOR
