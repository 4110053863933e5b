"""Arming, modes and fail-safes: what PX4's commander decides, as one state machine that is stepped with the time.

The user's choice is `intended`; what flies is `mode`, which a fail-safe may set. Both tables are here: `FAILSAFES` says
what trips, what it does and what ends it; `modes.TABLE` what each mode is.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

from mavsitl.dialect import mavlink
from mavsitl_vehicle.autopilot import modes
from mavsitl_vehicle.autopilot.modes import Control, Mode
from mavsitl_vehicle.autopilot.position import Values

ACCEPTED: int = mavlink.MAV_RESULT_ACCEPTED
TEMPORARILY_REJECTED: int = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
DENIED: int = mavlink.MAV_RESULT_DENIED
UNSUPPORTED: int = mavlink.MAV_RESULT_UNSUPPORTED

FORCE_MAGIC = (21196, 2989)
"""param2 of MAV_CMD_COMPONENT_ARM_DISARM that forces: PX4's number, and the one MAVProxy and QGroundControl send."""

GROUNDED_MODE_US = 1_000_000
"""LAND and RTL chosen on the ground are shown for so long, then the vehicle is back in AUTO.LOITER, which can arm."""

Report = Callable[[int, str], None]
"""(MAV_SEVERITY, text): goes out as a STATUSTEXT."""


class Action(IntEnum):
    """What a fail-safe does, in PX4's order: the worst one wins, one that cannot run gives way to the next."""

    NONE = 0
    WARN = 1
    POSITION = 2
    ALTITUDE = 3
    STABILIZED = 4
    HOLD = 5
    RETURN = 6
    LAND = 7
    DISARM = 8
    TERMINATE = 9


ACTION_MODES = {
    Action.POSITION: Mode.POSCTL,
    Action.ALTITUDE: Mode.ALTCTL,
    Action.STABILIZED: Mode.STABILIZED,
    Action.HOLD: Mode.LOITER,
    Action.RETURN: Mode.RTL,
    Action.LAND: Mode.LAND,
    Action.TERMINATE: Mode.TERMINATION,
}

_A = Action
OFFBOARD_LOSS_ACTION = {
    0: _A.POSITION, 1: _A.ALTITUDE, 2: _A.STABILIZED, 3: _A.RETURN, 4: _A.LAND, 5: _A.HOLD, 6: _A.TERMINATE,
    7: _A.DISARM,
}  # fmt: skip
"""COM_OBL_RC_ACT. The stick modes without sticks become NAV_RCL_ACT."""
LINK_LOSS_ACTION = {0: _A.NONE, 1: _A.HOLD, 2: _A.RETURN, 3: _A.LAND, 5: _A.TERMINATE, 6: _A.DISARM}
"""NAV_DLL_ACT, NAV_RCL_ACT"""
FENCE_ACTION = {0: _A.NONE, 1: _A.WARN, 2: _A.HOLD, 3: _A.RETURN, 4: _A.TERMINATE, 5: _A.LAND}
"""GF_ACTION"""
BATTERY_ACTION = {
    0: (_A.WARN, _A.WARN, _A.WARN),
    2: (_A.WARN, _A.LAND, _A.LAND),
    3: (_A.WARN, _A.RETURN, _A.LAND),
}
"""COM_LOW_BAT_ACT to the action at the low, critical and emergency level."""


class Situation(NamedTuple):
    """What the commander looks at, once a step. Ages are microseconds since the last good one; None: there was none."""

    landed: bool
    """Landing detector: at rest on the ground, or held in the clamp."""
    setpoint_age_us: int | None
    """Of the off-board stream."""
    sticks_age_us: int | None = None
    """Of MANUAL_CONTROL."""
    gcs_age_us: int | None = None
    """Of a ground station's HEARTBEAT."""
    mission_refusal: str | None = "no mission"
    """Why AUTO.MISSION would not fly; None when it would."""
    health_refusal: str | None = None
    """Why the sensors do not allow arming; None when they do."""
    battery_level: int = 0
    """0 fine, 1 low, 2 critical, 3 emergency (BAT_LOW_THR, BAT_CRIT_THR, BAT_EMERGEN_THR)."""
    fence_breach: str | None = None


class Failsafe(NamedTuple):
    """One row: a cause, and what follows."""

    name: str
    tripped: Callable[[Commander], bool]
    action: Callable[[Commander], Action]
    deferred: bool
    """A return or landing is preceded by COM_FAIL_ACT_T of holding, in which the user may take over."""
    ends_with_cause: bool
    """The user's mode returns with the signal; otherwise a mode change or disarming ends it."""
    regained: str = ""
    """Said when the cause has gone."""


class Commander:
    """`step` once a tick; the `request_*` methods answer with a MAV_RESULT and report each refusal with its reason."""

    def __init__(self, parameters: Values, report: Report) -> None:
        self.parameters = parameters
        self._report = report
        self.intended = Mode.LOITER
        """What the user chose."""
        self.mode = Mode.LOITER
        """What flies."""
        self.armed = False
        self.armed_at_us = 0
        self.home_set = False
        self.situation = Situation(landed=True, setpoint_age_us=None)
        self.sticks_at_arming = False
        self.battery_at_arming = 0
        self._landed_since_us: int | None = None
        self._has_flown = False
        self._grounded_since_us: int | None = None
        self._tripped: dict[str, tuple[int, Action]] = {}
        """Name of a row to (since us, the action reported)."""
        self._overridden: set[str] = set()
        self._acting = False

    @property
    def failsafe(self) -> bool:
        """A fail-safe, not the user, has set the mode, be it the one that the user had chosen."""
        return self._acting

    def step(self, now_us: int, situation: Situation) -> None:
        self.situation = situation
        if self.armed:
            self.sticks_at_arming |= self.sticks_fresh()  # PX4: optional only until they come
            self._watch_failsafes(now_us)
            self._watch_landing(now_us)
        else:
            self._watch_ground(now_us)

    def spooled_up(self, now_us: int) -> bool:
        return self.armed and now_us - self.armed_at_us >= int(self.parameters["COM_SPOOLUP_TIME"] * 1e6)

    # --- requests ----------------------------------------------------------------------------------------------------

    def request_mode(self, mode: Mode | None, described: str) -> int:
        """DO_SET_MODE, SET_MODE and the commands that imply a mode. `mode` None: one that this vehicle does not have.

        As on PX4 a disarmed vehicle takes any mode, an armed one only what it can fly; landing is never refused, except
        after a termination.
        """
        if mode is None:
            self._report(mavlink.MAV_SEVERITY_WARNING, f"Mode refused: {described} is not available")
            return DENIED
        if self.armed and self.mode is Mode.TERMINATION and mode is not Mode.TERMINATION:
            self._report(mavlink.MAV_SEVERITY_WARNING, f"{modes.TABLE[mode].name} refused: flight terminated")
            return TEMPORARILY_REJECTED
        reason = self.cannot_fly(mode) if self.armed and mode is not Mode.LAND else None
        if reason:
            self._report(mavlink.MAV_SEVERITY_WARNING, f"{modes.TABLE[mode].name} refused: {reason}")
            return TEMPORARILY_REJECTED
        self._overridden |= self._tripped.keys()
        self._choose(mode)
        return ACCEPTED

    def request_arm(self, arm: bool, force: bool, now_us: int, by: str = "external command") -> int:
        """COMPONENT_ARM_DISARM. `force` disarms in the air; it never skips the checks before arming, as on PX4."""
        if not arm:
            if self.armed and not self.situation.landed and not force:
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
        self.sticks_at_arming = self.sticks_fresh()
        self.battery_at_arming = self.situation.battery_level
        self._has_flown = False
        self._landed_since_us = None
        self._report(mavlink.MAV_SEVERITY_INFO, f"Armed by {by}")
        return ACCEPTED

    def complete(self, mode: Mode, next_mode: Mode) -> None:
        """The navigator has done what `mode` is for, and goes on in `next_mode` (COM_TAKEOFF_ACT)."""
        if self.intended is mode:
            self._choose(next_mode)

    # --- checks ------------------------------------------------------------------------------------------------------

    def arming_refusal(self) -> str | None:
        """Why the vehicle would not arm now; None when it would."""
        return self.mode_refusal() or self.situation.health_refusal

    def mode_refusal(self) -> str | None:
        """As `arming_refusal`, the sensors' health left out."""
        info = modes.TABLE[self.intended]
        if not info.can_arm:
            return f"mode {info.name} does not allow arming"
        if self.intended is Mode.OFFBOARD and not self.stream_fresh():
            return self._stream_text()
        if self.intended is Mode.MISSION and self.situation.mission_refusal:
            return self.situation.mission_refusal
        return "no connection to the ground station" if _gcs_lost(self) else None

    def cannot_fly(self, mode: Mode) -> str | None:
        """Why this vehicle, armed, cannot fly in `mode` now; None when it can."""
        control = modes.TABLE[mode].control
        if mode is Mode.OFFBOARD and not self.stream_fresh():
            return self._stream_text()
        if control is Control.STICKS and not self.sticks_fresh():
            return self._sticks_text()
        if mode is Mode.MISSION:
            return self.situation.mission_refusal
        if mode is Mode.RTL and not self.home_set:
            return "no home position"
        return None

    def stream_fresh(self) -> bool:
        age = self.situation.setpoint_age_us
        return age is not None and age < int(self.parameters["COM_OF_LOSS_T"] * 1e6)

    def sticks_fresh(self) -> bool:
        age = self.situation.sticks_age_us
        return age is not None and age < int(self.parameters["COM_RC_LOSS_T"] * 1e6)

    def _stream_text(self) -> str:
        age, need = self.situation.setpoint_age_us, self.parameters["COM_OF_LOSS_T"]
        if age is None:
            return "no setpoint received yet"
        return f"last setpoint {age / 1e6:.2f} s ago, need < {need:.2f} s"

    def _sticks_text(self) -> str:
        age, need = self.situation.sticks_age_us, self.parameters["COM_RC_LOSS_T"]
        if age is None:
            return "no MANUAL_CONTROL received yet"
        return f"last MANUAL_CONTROL {age / 1e6:.2f} s ago, need < {need:.2f} s"

    # --- what goes on by itself --------------------------------------------------------------------------------------

    def _watch_failsafes(self, now_us: int) -> None:
        if self.mode is Mode.TERMINATION:  # never clears: rotors that have stopped in the air do not start again
            return
        worst = Action.NONE
        for row in FAILSAFES:
            if not row.tripped(self):
                worst = max(worst, self._clear(row))
                continue
            if row.name in self._overridden:
                continue
            since_us = self._tripped.get(row.name, (now_us, _A.NONE))[0]
            action = self._possible(row.action(self))
            if action is _A.RETURN and self.intended in (Mode.LAND, Mode.RTL):
                action = _A.WARN  # PX4: a landing goes on, and a return does not stop to begin again
            if row.deferred and action in (_A.RETURN, _A.LAND):
                hold_us = int(self.parameters["COM_FAIL_ACT_T"] * 1e6)
                if now_us - since_us < hold_us:
                    action = _A.HOLD
            if row.name not in self._tripped or self._tripped[row.name][1] is not action:
                self._tripped[row.name] = (since_us, action)
                self._announce(row, action)
            worst = max(worst, action)
        if worst is _A.DISARM:
            self._disarm("failsafe")
        elif worst in ACTION_MODES:
            self.mode = ACTION_MODES[worst]
            self._acting = True
        elif not self._latched():
            self.mode = self.intended
            self._acting = False

    def _announce(self, row: Failsafe, action: Action) -> None:
        if action is _A.NONE:
            return
        if action is _A.WARN:
            self._report(mavlink.MAV_SEVERITY_WARNING, f"Warning: {row.name}")
        else:
            self._report(mavlink.MAV_SEVERITY_CRITICAL, f"Failsafe activated: {row.name}, {action.name.lower()}")

    def _clear(self, row: Failsafe) -> Action:
        """The cause has gone: what still holds all the same, until the user chooses or the vehicle disarms."""
        self._overridden.discard(row.name)
        known = self._tripped.get(row.name)
        if known is None:
            return _A.NONE
        held_only = row.deferred and known[1] is _A.HOLD
        if known[1] in ACTION_MODES and self.failsafe and not row.ends_with_cause and not held_only:
            return known[1]
        del self._tripped[row.name]
        if row.regained:
            self._report(mavlink.MAV_SEVERITY_INFO, row.regained)
        return _A.NONE

    def _latched(self) -> bool:
        """A row whose cause has gone still holds its mode, until the user chooses or the vehicle disarms."""
        return any(action in ACTION_MODES for _, action in self._tripped.values()) and self.failsafe

    def _possible(self, action: Action) -> Action:
        """The action, or the next worse one that can run."""
        while (mode := ACTION_MODES.get(action)) is not None and self.cannot_fly(mode):
            action = Action(action + 1)
        return action

    def _watch_landing(self, now_us: int) -> None:
        if not self.armed:
            return
        if not self.situation.landed:
            self._has_flown = True
            self._landed_since_us = None
            return
        if self._landed_since_us is None:
            self._landed_since_us = now_us
        parameter = "COM_DISARM_LAND" if self._has_flown else "COM_DISARM_PRFLT"
        limit_s = self.parameters[parameter]
        if limit_s >= 0.0 and now_us - self._landed_since_us >= int(limit_s * 1e6):
            self._disarm("landing" if self._has_flown else "auto preflight disarming")

    def _watch_ground(self, now_us: int) -> None:
        if not (self.situation.landed and self.intended in (Mode.LAND, Mode.RTL)):
            self._grounded_since_us = None
        elif self._grounded_since_us is None:
            self._grounded_since_us = now_us
        elif now_us - self._grounded_since_us >= GROUNDED_MODE_US:
            self._choose(Mode.LOITER)

    def _choose(self, mode: Mode) -> None:
        self.intended = self.mode = mode
        self._acting = False
        self._tripped = {name: known for name, known in self._tripped.items() if name not in self._overridden}

    def _disarm(self, by: str) -> None:
        self.armed = False
        landing = self.mode in (Mode.LAND, Mode.RTL, Mode.ORBIT, Mode.TERMINATION)
        self._tripped.clear()
        self._overridden.clear()
        self._choose(Mode.LOITER if landing or not modes.TABLE[self.intended].can_arm else self.intended)
        self._report(mavlink.MAV_SEVERITY_INFO, f"Disarmed by {by}")


# --- the fail-safes --------------------------------------------------------------------------------------------------


def _offboard_lost(commander: Commander) -> bool:
    return commander.intended is Mode.OFFBOARD and not commander.stream_fresh()


def _offboard_action(commander: Commander) -> Action:
    action = OFFBOARD_LOSS_ACTION[int(commander.parameters["COM_OBL_RC_ACT"])]
    if action in (_A.POSITION, _A.ALTITUDE, _A.STABILIZED) and not commander.sticks_fresh():
        return LINK_LOSS_ACTION[int(commander.parameters["NAV_RCL_ACT"])]
    return action


def _sticks_lost(commander: Commander) -> bool:
    """Only in the modes that are flown by them, unless they were missing when the vehicle armed, as on PX4."""
    flown = modes.TABLE[commander.intended].control is Control.STICKS
    return flown and commander.sticks_at_arming and not commander.sticks_fresh()


def _sticks_action(commander: Commander) -> Action:
    return LINK_LOSS_ACTION[int(commander.parameters["NAV_RCL_ACT"])]


def _gcs_lost(commander: Commander) -> bool:
    age = commander.situation.gcs_age_us
    if commander.parameters["NAV_DLL_ACT"] == 0 or commander.mode is Mode.LAND:
        return False
    return age is None or age >= int(commander.parameters["COM_DL_LOSS_T"] * 1e6)


def _gcs_action(commander: Commander) -> Action:
    return LINK_LOSS_ACTION[int(commander.parameters["NAV_DLL_ACT"])]


def _battery_at(level: int) -> Callable[[Commander], bool]:
    """A level that the battery has sunk to since arming: one that was low then is the user's own decision."""

    def tripped(commander: Commander) -> bool:
        return commander.situation.battery_level >= level > commander.battery_at_arming

    return tripped


def _battery_action(level: int) -> Callable[[Commander], Action]:
    def action(commander: Commander) -> Action:
        by_level = BATTERY_ACTION.get(int(commander.parameters["COM_LOW_BAT_ACT"]), BATTERY_ACTION[0])
        return by_level[level - 1]

    return action


def _fence_breached(commander: Commander) -> bool:
    return commander.situation.fence_breach is not None and commander.parameters["GF_ACTION"] > 0


def _fence_action(commander: Commander) -> Action:
    return FENCE_ACTION[int(commander.parameters["GF_ACTION"])]


FAILSAFES: tuple[Failsafe, ...] = (
    Failsafe(
        "off-board signal lost", _offboard_lost, _offboard_action, deferred=False, ends_with_cause=True,
        regained="Off-board stream regained",
    ),
    Failsafe(
        "manual control lost", _sticks_lost, _sticks_action, deferred=True, ends_with_cause=False,
        regained="Manual control regained",
    ),
    Failsafe(
        "connection to ground station lost", _gcs_lost, _gcs_action, deferred=True, ends_with_cause=False,
        regained="Connection to ground station regained",
    ),
    Failsafe("low battery", _battery_at(1), _battery_action(1), deferred=True, ends_with_cause=False),
    Failsafe("critical battery", _battery_at(2), _battery_action(2), deferred=True, ends_with_cause=False),
    Failsafe("emergency battery level", _battery_at(3), _battery_action(3), deferred=True, ends_with_cause=False),
    Failsafe("geofence breached", _fence_breached, _fence_action, deferred=False, ends_with_cause=False),
)  # fmt: skip
