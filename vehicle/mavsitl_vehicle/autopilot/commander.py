"""Arming, modes and fail-safes: what PX4's commander decides, as one state machine that is stepped with the time."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from mavsitl.dialect import mavlink
from mavsitl_vehicle.autopilot import modes
from mavsitl_vehicle.autopilot.modes import Mode
from mavsitl_vehicle.autopilot.parameters import Parameters

ACCEPTED: int = mavlink.MAV_RESULT_ACCEPTED
TEMPORARILY_REJECTED: int = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
DENIED: int = mavlink.MAV_RESULT_DENIED
UNSUPPORTED: int = mavlink.MAV_RESULT_UNSUPPORTED

FORCE_MAGIC = (21196, 2989)
"""param2 of MAV_CMD_COMPONENT_ARM_DISARM that forces: PX4's number, and the one MAVProxy and QGroundControl send."""

Report = Callable[[int, str], None]
"""(MAV_SEVERITY, text): goes out as a STATUSTEXT."""

HOLD, LAND, DISARM = "hold", "land", "disarm"

OFFBOARD_LOSS_ACTION = {0: LAND, 1: LAND, 2: LAND, 3: LAND, 4: LAND, 5: HOLD, 6: DISARM, 7: DISARM}
"""COM_OBL_RC_ACT to what happens.

Stick modes without sticks and return fall down PX4's list to land, as their modes cannot run.
"""


class Situation(NamedTuple):
    """What the commander looks at, once a step."""

    landed: bool
    """Landing detector: at rest on the ground, or held in the clamp."""
    setpoint_age_us: int | None
    """Age of the last accepted off-board setpoint; None: there was none."""


class Commander:
    """`step` once a tick; the `request_*` methods answer with a MAV_RESULT and report each refusal with its reason."""

    def __init__(self, parameters: Parameters, report: Report) -> None:
        self._parameters = parameters
        self._report = report
        self.mode = Mode.LOITER
        self.armed = False
        self.failsafe = False
        self.armed_at_us = 0
        self._landed_since_us: int | None = None
        self._has_flown = False
        self._situation = Situation(landed=True, setpoint_age_us=None)

    def step(self, now_us: int, situation: Situation) -> None:
        self._situation = situation
        self._watch_offboard()
        self._watch_landing(now_us)

    def spooled_up(self, now_us: int) -> bool:
        return self.armed and now_us - self.armed_at_us >= int(self._parameters["COM_SPOOLUP_TIME"] * 1e6)

    def request_mode(self, mode: Mode | None, described: str) -> int:
        """DO_SET_MODE and SET_MODE. `mode` None: one that this vehicle does not have."""
        if mode is None:
            self._report(mavlink.MAV_SEVERITY_WARNING, f"Mode refused: {described} is not available")
            return DENIED
        if mode is Mode.OFFBOARD and self.armed and not self._stream_is_fresh():
            self._report(mavlink.MAV_SEVERITY_WARNING, f"OFFBOARD refused: {self._stream_text()}")
            return TEMPORARILY_REJECTED
        self._set_mode(mode)
        self.failsafe = False
        return ACCEPTED

    def request_arm(self, arm: bool, force: bool, now_us: int) -> int:
        """COMPONENT_ARM_DISARM. `force` disarms in the air; it never skips the checks before arming, as on PX4."""
        if not arm:
            if self.armed and not self._situation.landed and not force:
                self._report(mavlink.MAV_SEVERITY_WARNING, "Disarming denied: not landed")
                return DENIED
            if self.armed:
                self._disarm("command")
            return ACCEPTED
        if self.armed:
            return ACCEPTED
        reason = self.arming_refusal()
        if reason:
            self._report(mavlink.MAV_SEVERITY_CRITICAL, f"Arming denied: {reason}")
            return TEMPORARILY_REJECTED
        self.armed = True
        self.armed_at_us = now_us
        self._has_flown = False
        self._landed_since_us = None
        self._report(mavlink.MAV_SEVERITY_INFO, "Armed by external command")
        return ACCEPTED

    def arming_refusal(self) -> str | None:
        """Why the vehicle would not arm now; None when it would."""
        info = modes.TABLE[self.mode]
        if not info.can_arm:
            return f"mode {info.name} does not allow arming"
        if self.mode is Mode.OFFBOARD and not self._stream_is_fresh():
            return self._stream_text()
        return None

    def _stream_is_fresh(self) -> bool:
        age = self._situation.setpoint_age_us
        return age is not None and age < int(self._parameters["COM_OF_LOSS_T"] * 1e6)

    def _stream_text(self) -> str:
        age, need = self._situation.setpoint_age_us, self._parameters["COM_OF_LOSS_T"]
        if age is None:
            return "no setpoint received yet"
        return f"last setpoint {age / 1e6:.2f} s ago, need < {need:.2f} s"

    def _watch_offboard(self) -> None:
        if self.failsafe and self._returning and self._stream_is_fresh():
            self.failsafe = False
            self._set_mode(Mode.OFFBOARD)
            self._report(mavlink.MAV_SEVERITY_INFO, "Off-board stream regained")
        elif self.mode is Mode.OFFBOARD and self.armed and not self._stream_is_fresh():
            action = OFFBOARD_LOSS_ACTION[int(self._parameters["COM_OBL_RC_ACT"])]
            self._report(mavlink.MAV_SEVERITY_CRITICAL, f"Failsafe activated: off-board signal lost, {action}")
            if action == DISARM:
                self._disarm("failsafe")
                return
            self._set_mode(Mode.LAND if action == LAND else Mode.LOITER)
            self.failsafe = self._returning = True

    def _watch_landing(self, now_us: int) -> None:
        landed = self._situation.landed
        if not self.armed:
            if landed and self.mode is Mode.LAND:
                self._set_mode(Mode.LOITER)
            return
        if not landed:
            self._has_flown = True
            self._landed_since_us = None
            return
        if self._landed_since_us is None:
            self._landed_since_us = now_us
        parameter = "COM_DISARM_LAND" if self._has_flown else "COM_DISARM_PRFLT"
        limit_s = self._parameters[parameter]
        if limit_s >= 0.0 and now_us - self._landed_since_us >= int(limit_s * 1e6):
            self._disarm("landing" if self._has_flown else "auto preflight disarming")

    def _set_mode(self, mode: Mode) -> None:
        self.mode = mode
        self._returning = False

    _returning = False
    """A fail-safe took the vehicle out of OFFBOARD and the user has not chosen another mode since."""

    def _disarm(self, by: str) -> None:
        self.armed = False
        self.failsafe = self._returning = False
        if self.mode is Mode.LAND:
            self._set_mode(Mode.LOITER)
        self._report(mavlink.MAV_SEVERITY_INFO, f"Disarmed by {by}")
