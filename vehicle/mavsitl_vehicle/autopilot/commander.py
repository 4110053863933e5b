"""Arming, modes and fail-safes: what PX4's commander decides, as one state machine that is stepped with the time.

The user's choice is `intended`; what flies is `mode`, which a fail-safe may set. Both tables are here: `FAILSAFES` says
what trips, what it does and what ends it; `modes.TABLE` what each mode is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from math import inf, radians
from operator import attrgetter
from typing import NamedTuple

from msgspec import Struct

from mavsitl.dialect import mavlink
from mavsitl_vehicle.autopilot import modes
from mavsitl_vehicle.autopilot.modes import Control, Mode, Need
from mavsitl_vehicle.autopilot.position import Values

ACCEPTED: int = mavlink.MAV_RESULT_ACCEPTED
TEMPORARILY_REJECTED: int = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
DENIED: int = mavlink.MAV_RESULT_DENIED
UNSUPPORTED: int = mavlink.MAV_RESULT_UNSUPPORTED

FORCE_MAGIC = (21196, 2989)
"""param2 of MAV_CMD_COMPONENT_ARM_DISARM that forces: PX4's number, and the one MAVProxy and QGroundControl send."""

GROUNDED_MODE_US = 1_000_000
"""LAND and RTL chosen on the ground are shown for so long, then the vehicle is back in AUTO.LOITER, which can arm."""

BATTERY_TIMEOUT_US = 5_000_000
"""A battery that has not been measured for so long is unhealthy."""
NEARLY = 0.9
"""Share of COM_FLT_TIME_MAX at which the end of the flight is announced."""
BREAKER_ON = 121212
"""CBRK_FLIGHTTERM: the failure detector does not terminate a flight."""
LOW_THROTTLE, CENTRED_THROTTLE = 0.1, 0.6
"""Largest throttles (0 to 1) with which stick modes arm: those whose throttle is thrust, those where it is climb."""

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
    DESCEND = 8
    DISARM = 9
    TERMINATE = 10


ACTION_MODES = {
    Action.POSITION: Mode.POSCTL,
    Action.ALTITUDE: Mode.ALTCTL,
    Action.STABILIZED: Mode.STABILIZED,
    Action.HOLD: Mode.LOITER,
    Action.RETURN: Mode.RTL,
    Action.LAND: Mode.LAND,
    Action.DESCEND: Mode.DESCEND,
    Action.TERMINATE: Mode.TERMINATION,
}

LEAVING = (Action.RETURN, Action.LAND, Action.DESCEND)
"""What COM_FAIL_ACT_T of holding may come before."""

_A = Action
_NONE = Action.NONE
OFFBOARD_LOSS_ACTION = {
    0: _A.POSITION, 1: _A.ALTITUDE, 2: _A.STABILIZED, 3: _A.RETURN, 4: _A.LAND, 5: _A.HOLD, 6: _A.TERMINATE,
    7: _A.DISARM,
}  # fmt: skip
"""COM_OBL_RC_ACT. The stick modes without sticks become NAV_RCL_ACT."""
LINK_LOSS_ACTION = {0: _A.NONE, 1: _A.HOLD, 2: _A.RETURN, 3: _A.LAND, 5: _A.TERMINATE, 6: _A.DISARM}
"""NAV_DLL_ACT, NAV_RCL_ACT"""
LIMIT_ACTION = {0: _A.NONE, 1: _A.WARN, 2: _A.HOLD, 3: _A.RETURN, 4: _A.TERMINATE, 5: _A.LAND}
"""GF_ACTION, COM_WIND_MAX_ACT, COM_POS_LOW_ACT"""
FLIGHT_TIME_ACTION = {0: _A.NONE, 1: _A.WARN, 3: _A.RETURN}
"""COM_FLTT_LOW_ACT"""
MOTOR_ACTION = {0: _A.WARN, 1: _A.HOLD, 2: _A.LAND, 3: _A.RETURN, 4: _A.TERMINATE}
"""COM_ACT_FAIL_ACT"""
BATTERY_ACTION = {
    0: (_A.WARN, _A.WARN, _A.WARN),
    2: (_A.WARN, _A.LAND, _A.LAND),
    3: (_A.WARN, _A.RETURN, _A.LAND),
}
"""COM_LOW_BAT_ACT to the action at the low, critical and emergency level."""

EXCEPTION_BITS = {
    Mode.MISSION: 1, Mode.OFFBOARD: 4,
    **dict.fromkeys((Mode.LOITER, Mode.TAKEOFF, Mode.LAND, Mode.RTL, Mode.DESCEND, Mode.ORBIT), 2),
}  # fmt: skip
"""Of COM_RCL_EXCEPT and COM_DLL_EXCEPT, by the mode that the user chose."""


class Situation(Struct, frozen=True):
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
    attitude_valid: bool = True
    height_valid: bool = True
    velocity_valid: bool = True
    position_valid: bool = True
    """The estimates that modes need."""
    stream_needs: Need = Need.ATTITUDE
    """The estimates that the newest off-board setpoint needs."""
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    altitude_loss_m: float = 0.0
    """Fallen so far below the highest point since it was at its setpoint; 0 where no height is flown."""
    motor_failure: int = 0
    """Bit n: motor n + 1 does not do what it is told."""
    battery_age_us: int = 0
    """Since the battery was measured."""
    battery_charge: float = 1.0
    return_margin_s: float = inf
    """The battery's remaining time less that of a return."""
    airborne_s: float = 0.0
    """Since the take-off."""
    wind_m_s: float = 0.0
    """As estimated; 0: not known."""
    position_error_m: float = 0.0
    """1 sigma of the horizontal position."""
    mission_failure: str | None = None
    """As `mission_refusal`, but for a mission under way, and without what the fence has to say: that is its own row."""
    mission_finished: bool = False
    throttle: float = 0.0
    """Of the sticks, 0 to 1."""

    @property
    def estimates_valid(self) -> bool:
        return self.attitude_valid and self.height_valid and self.velocity_valid and self.position_valid


@dataclass(frozen=True)
class By:
    """A row's action, as the value of one parameter says."""

    parameter: str
    actions: Mapping[int, Action]

    def __call__(self, commander: Commander) -> Action:
        return self.actions[int(commander.parameters[self.parameter])]


class Failsafe(NamedTuple):
    """One row: a cause, and what follows."""

    name: str
    tripped: Callable[[Commander], bool]
    action: Callable[[Commander], Action]
    """`By` a parameter, or a function whose docstring says what follows."""
    looks_at: tuple[str, ...] = ()
    """Parameters that decide whether it trips."""
    after: str = ""
    """Parameter: seconds that the cause must have lasted, where its threshold is none itself."""
    deferred: bool = True
    """A return or landing is preceded by COM_FAIL_ACT_T of holding, in which the user may take over."""
    ends_with_cause: bool = False
    """The user's mode returns with the signal; otherwise a mode change or disarming ends it."""
    overruled: bool = True
    """By the user's choice of a mode; otherwise only by one in which it does not trip."""
    sticks_end_hold: bool = True
    """Moved sticks take over from its Hold, too."""
    regained: str = ""
    """Said when the cause has gone."""
    said: Callable[[Commander], str] | None = None
    """The cause in this case; None: `name`."""


class HoldDelay:
    """The time that a return or landing is put off (COM_FAIL_ACT_T).

    What is spent of it comes back at a quarter of the speed, so that a cause that comes and goes puts off nothing for
    ever.
    """

    def __init__(self) -> None:
        self.left_us = 0
        self._budget_us = self._full_us = 0

    def advance(self, elapsed_us: int, full_us: int, *, used: bool) -> None:
        """`used`: it put off an action during `elapsed_us`. `full_us`: what the parameter says now."""
        if full_us != self._full_us:
            self._budget_us = self._full_us = full_us
        self.left_us = max(self.left_us - elapsed_us, 0)
        change_us = -elapsed_us if used else elapsed_us // 4
        self._budget_us = min(max(self._budget_us + change_us, 0), full_us)

    def begin(self) -> None:
        """An action waits from now on, unless one does already."""
        if self.left_us == 0:
            self.left_us = self._budget_us

    def end(self) -> None:
        self.left_us = 0


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
        self.kill_engaged = False
        """The rotors stand still whatever flies."""
        self.now_us = 0
        self._kill_latched = False
        self._tripped: dict[str, Action] = {}
        """Name of a row to the action reported."""
        self._since_us: dict[str, int] = {}
        """Name of a row with `after` to the time when its cause began."""
        self._overridden: set[str] = set()
        self.failsafe = False
        """A fail-safe, not the user, has set the mode, be it the one that the user had chosen."""
        self._worst = Action.NONE
        self._delay = HoldDelay()
        self._delaying = False
        self._watched_us = 0

    @property
    def overruled(self) -> bool:
        """A fail-safe's cause is there, and the user has chosen a mode since."""
        return bool(self._overridden)

    def step(self, now_us: int, situation: Situation) -> None:
        self.situation = situation
        self.now_us = now_us
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
        if self.mode is Mode.TERMINATION and mode is not Mode.TERMINATION:
            self._report(mavlink.MAV_SEVERITY_WARNING, f"{modes.TABLE[mode].name} refused: flight terminated")
            return TEMPORARILY_REJECTED
        reason = (self.cannot_fly(mode) or self._beyond_limits(mode)) if self.armed and mode is not Mode.LAND else None
        if reason:
            self._report(mavlink.MAV_SEVERITY_WARNING, f"{modes.TABLE[mode].name} refused: {reason}")
            return TEMPORARILY_REJECTED
        self._overridden |= self._tripped.keys() - _NOT_OVERRULED
        self._delay.end()
        self._choose(mode)
        return ACCEPTED

    def request_takeover(self) -> bool:
        """The sticks were moved: in flight they take over from an automatic mode, or OFFBOARD (COM_RC_OVERRIDE).

        Not while a fail-safe holds to give the user time, nor from a Hold that only a mode change ends (a geofence's).
        """
        bit = {Control.NAVIGATOR: 1, Control.STREAM: 2}.get(modes.TABLE[self.mode].control, 0)
        allowed = bit & int(self.parameters["COM_RC_OVERRIDE"])
        if not allowed or not self.armed or self.situation.landed or self.kill_engaged:
            return False
        if self.failsafe and self.mode is Mode.LOITER and (self._delaying or not self._sticks_end_hold()):
            return False
        for mode in (Mode.POSCTL, Mode.ALTCTL, Mode.STABILIZED):
            if self.cannot_fly(mode) is None:
                self._report(mavlink.MAV_SEVERITY_INFO, "Pilot took over using sticks")
                return self.request_mode(mode, "") == ACCEPTED
        return False

    def request_kill(self, engage: bool, *, latch: bool = False) -> int:
        """The kill switch: the rotors stop at once, and the vehicle disarms when COM_KILL_DISARM has passed.

        `latch`: only a reboot releases it.
        """
        if self._kill_latched and not engage:
            self._report(mavlink.MAV_SEVERITY_WARNING, "Kill stays engaged until a reboot")
            return TEMPORARILY_REJECTED
        self._kill_latched |= latch
        if engage != self.kill_engaged:
            self.kill_engaged = engage
            self._report(mavlink.MAV_SEVERITY_EMERGENCY, "Kill engaged" if engage else "Kill disengaged")
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
        reason = self.arming_refusal() or self._throttle_refusal()
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
        refusal = self.mode_refusal() or self.situation.health_refusal
        if refusal is None and not self.situation.estimates_valid:
            refusal = self._missing(modes.TABLE[self.intended].needs & _ESTIMATES)
        return refusal

    def mode_refusal(self) -> str | None:
        """As `arming_refusal`, the sensors' health and the estimates left out."""
        info, p = modes.TABLE[self.intended], self.parameters
        if self.mode is Mode.TERMINATION:
            return "flight termination active, a reboot ends it"
        if self.kill_engaged:
            return "kill switch engaged"
        if not p["COM_ARMABLE"]:
            return "vehicle is in safety configuration (COM_ARMABLE)"
        if not info.can_arm:
            return f"mode {info.name} does not allow arming"
        if self.intended is Mode.OFFBOARD and (reason := self._stream_refusal()):
            return reason
        if self.situation.mission_refusal and (self.intended is Mode.MISSION or p["COM_ARM_MIS_REQ"]):
            return self.situation.mission_refusal
        if self.situation.battery_charge < p["COM_ARM_BAT_MIN"]:
            return f"battery at {self.situation.battery_charge:.0%}, need {p['COM_ARM_BAT_MIN']:.0%} (COM_ARM_BAT_MIN)"
        if reason := self._beyond_limits(self.intended):
            return reason
        return "no connection to the ground station" if p["NAV_DLL_ACT"] > 0 and not self.gcs_fresh() else None

    def cannot_fly(self, mode: Mode) -> str | None:
        """Why this vehicle, armed, cannot fly in `mode` now; None when it can."""
        return self._missing(modes.TABLE[mode].needs)

    def _missing(self, needs: Need) -> str | None:
        for check in _checks_of(needs):
            if reason := check(self):
                return reason
        return None

    def _beyond_limits(self, mode: Mode) -> str | None:
        """Why wind and flight time do not allow `mode` to be chosen; None where they do."""
        if Need.LIMITS not in modes.TABLE[mode].needs:
            return None
        if _wind_beyond("COM_WIND_MAX")(self):
            return f"wind {self.situation.wind_m_s:.1f} m/s, COM_WIND_MAX is {self.parameters['COM_WIND_MAX']:g}"
        return "maximum flight time exceeded" if _flown_for(1.0)(self) else None

    def _throttle_refusal(self) -> str | None:
        if modes.TABLE[self.intended].control is not Control.STICKS or not self.sticks_fresh():
            return None
        if self.intended in (Mode.ALTCTL, Mode.POSCTL):
            return "throttle above center" if self.situation.throttle > CENTRED_THROTTLE else None
        return "high throttle" if self.situation.throttle > LOW_THROTTLE else None

    def stream_fresh(self) -> bool:
        age = self.situation.setpoint_age_us
        return age is not None and age < int(self.parameters["COM_OF_LOSS_T"] * 1e6)

    def sticks_fresh(self) -> bool:
        age = self.situation.sticks_age_us
        return age is not None and age < int(self.parameters["COM_RC_LOSS_T"] * 1e6)

    def gcs_fresh(self) -> bool:
        age = self.situation.gcs_age_us
        return age is not None and age < int(self.parameters["COM_DL_LOSS_T"] * 1e6)

    def stream_usable(self) -> bool:
        """Setpoints come, and the estimates that they need are there."""
        return self.stream_fresh() and (self.situation.estimates_valid or self._stream_refusal() is None)

    def _stream_refusal(self) -> str | None:
        if not self.stream_fresh():
            return self._stream_text()
        return self._missing(self.situation.stream_needs)

    def _sticks_refusal(self) -> str | None:
        return None if self.sticks_fresh() else self._sticks_text()

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
        elapsed_us, self._watched_us = now_us - self._watched_us, now_us
        if self.mode is Mode.TERMINATION:  # never clears: rotors that have stopped in the air do not start again
            return
        self._delay.advance(elapsed_us, int(self.parameters["COM_FAIL_ACT_T"] * 1e6), used=self._delaying)
        if self._worst > _A.HOLD:
            self._delay.end()  # acting already: what comes next need not wait
        self._delaying = False
        worst = _NONE
        remembered = bool(self._tripped or self._since_us or self._overridden)
        for tripped, row in _WATCHED:
            if tripped(self):
                action = self._act(row) if self._lasts(row, now_us) else self._clear(row)
            elif remembered:
                self._since_us.pop(row.name, None)
                action = self._clear(row)
            else:
                continue
            if action > worst:
                worst = action
        self._worst = worst
        if worst is _NONE:
            self.mode = self.intended
            self.failsafe = False
        elif worst is _A.DISARM:
            self._disarm("failsafe")
        elif worst in ACTION_MODES:
            self.mode = ACTION_MODES[worst]
            self.failsafe = True
            if self.intended is Mode.ORBIT:
                self.intended = Mode.LOITER  # as on PX4: a circle is not taken up again
        else:
            self.mode = self.intended
            self.failsafe = False

    def _lasts(self, row: Failsafe, now_us: int) -> bool:
        """The cause has been there for as long as it must."""
        if not row.after:
            return True
        return now_us - self._since_us.setdefault(row.name, now_us) >= int(self.parameters[row.after] * 1e6)

    def _act(self, row: Failsafe) -> Action:
        if row.name in self._overridden:
            return _A.NONE
        action = self._possible(row.action(self))
        if action is _A.RETURN and self.intended in (Mode.LAND, Mode.RTL):
            action = _A.WARN  # PX4: a landing goes on, and a return does not stop to begin again
        if row.deferred and action in LEAVING and self.intended is not Mode.LAND:
            if row.name not in self._tripped and self._worst <= _A.HOLD:
                self._delay.begin()
            if self._delay.left_us and self.cannot_fly(Mode.LOITER) is None:
                self._delaying = True
                action = _A.HOLD
        self._note(row, action)
        return action

    def _note(self, row: Failsafe, action: Action) -> None:
        """What the row does now; said where it is another thing than before."""
        if self._tripped.get(row.name) is action:
            return
        self._tripped[row.name] = action
        cause = row.name if row.said is None else row.said(self)
        if action is _A.WARN:
            self._report(mavlink.MAV_SEVERITY_WARNING, f"Warning: {cause}")
        elif action is not _A.NONE:
            self._report(mavlink.MAV_SEVERITY_CRITICAL, f"Failsafe activated: {cause}, {action.name.lower()}")

    def _clear(self, row: Failsafe) -> Action:
        """No cause, or none yet: what still holds all the same, until the user chooses or the vehicle disarms."""
        known = self._tripped.get(row.name)
        self._overridden.discard(row.name)
        if known is None:
            return _A.NONE
        held_only = row.deferred and known is _A.HOLD
        if known in ACTION_MODES and self.failsafe and not row.ends_with_cause and not held_only:
            action = self._possible(known)
            self._note(row, action)
            return action
        del self._tripped[row.name]
        if row.regained:
            self._report(mavlink.MAV_SEVERITY_INFO, row.regained)
        return _A.NONE

    def _possible(self, action: Action) -> Action:
        """The action, or the next worse one that can run; at the end of that is the termination."""
        while (mode := ACTION_MODES.get(action)) is not None and self.cannot_fly(mode):
            action = _A.TERMINATE if action is _A.DESCEND else Action(action + 1)
        return action

    def _sticks_end_hold(self) -> bool:
        return all(row.sticks_end_hold for row in FAILSAFES if self._tripped.get(row.name) is _A.HOLD)

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
        self.failsafe = self._delaying = False
        self._worst = _A.NONE
        self._tripped = {name: known for name, known in self._tripped.items() if name not in self._overridden}

    def _disarm(self, by: str) -> None:
        self.armed = False
        landing = self.mode in (Mode.LAND, Mode.RTL, Mode.ORBIT, Mode.DESCEND)
        self._tripped.clear()
        self._since_us.clear()
        self._overridden.clear()
        self._delay.end()
        if self.mode is Mode.TERMINATION:
            self._choose(Mode.TERMINATION)
        else:
            self._choose(Mode.LOITER if landing or not modes.TABLE[self.intended].can_arm else self.intended)
        self._report(mavlink.MAV_SEVERITY_INFO, f"Disarmed by {by}")


# --- what modes need -------------------------------------------------------------------------------------------------


def _home_refusal(commander: Commander) -> str | None:
    return None if commander.home_set else "no home position"


def _estimate_refusal(name: str) -> Callable[[Commander], str | None]:
    text = f"{name} estimate invalid"

    def check(commander: Commander) -> str | None:
        return None if getattr(commander.situation, f"{name}_valid") else text

    return check


_ESTIMATES = Need.ATTITUDE | Need.HEIGHT | Need.VELOCITY | Need.POSITION
_CHECKS: tuple[tuple[Need, Callable[[Commander], str | None]], ...] = (
    (Need.ATTITUDE, _estimate_refusal("attitude")),
    (Need.HEIGHT, _estimate_refusal("height")),
    (Need.VELOCITY, _estimate_refusal("velocity")),
    (Need.POSITION, _estimate_refusal("position")),
    (Need.HOME, _home_refusal),
    (Need.MISSION, lambda commander: commander.situation.mission_refusal),
    (Need.STREAM, Commander._stream_refusal),
    (Need.STICKS, Commander._sticks_refusal),
)
"""A need, and why it is not met; None: it is."""


@cache
def _checks_of(needs: Need) -> tuple[Callable[[Commander], str | None], ...]:
    return tuple(check for need, check in _CHECKS if need in needs)


# --- the fail-safes --------------------------------------------------------------------------------------------------


def _offboard_lost(commander: Commander) -> bool:
    return commander.intended is Mode.OFFBOARD and not commander.stream_usable()


def _with_sticks(commander: Commander, action: Action) -> Action:
    """The stick modes without sticks: NAV_RCL_ACT."""
    if action in (_A.POSITION, _A.ALTITUDE, _A.STABILIZED) and not commander.sticks_fresh():
        return LINK_LOSS_ACTION[int(commander.parameters["NAV_RCL_ACT"])]
    return action


class _ByWithSticks(By):
    """The same, and NAV_RCL_ACT where sticks are needed and missing."""

    def __call__(self, commander: Commander) -> Action:
        return _with_sticks(commander, super().__call__(commander))


def _excepted(commander: Commander, parameter: str) -> bool:
    return bool(EXCEPTION_BITS.get(commander.intended, 0) & int(commander.parameters[parameter]))


def _sticks_lost(commander: Commander) -> bool:
    """In every mode that is not excepted, unless they were missing when the vehicle armed, as on PX4."""
    if not commander.sticks_at_arming or commander.sticks_fresh():
        return False
    return commander.parameters["COM_RC_IN_MODE"] != 4 and not _excepted(commander, "COM_RCL_EXCEPT")


def _gcs_lost(commander: Commander) -> bool:
    if commander.parameters["NAV_DLL_ACT"] == 0 or commander.intended is Mode.LAND or commander.gcs_fresh():
        return False
    return not _excepted(commander, "COM_DLL_EXCEPT")


def _nobody_after_mission(commander: Commander) -> bool:
    """A finished mission that neither sticks nor ground station would ever end."""
    if commander.intended is not Mode.MISSION or not commander.situation.mission_finished:
        return False
    p = commander.parameters
    ignored = p["COM_RC_IN_MODE"] == 4 or _excepted(commander, "COM_RCL_EXCEPT")
    return ignored and p["NAV_DLL_ACT"] == 0 and not commander.gcs_fresh()


def _battery_at(level: int) -> Callable[[Commander], bool]:
    """A level that the battery has sunk to since arming: one that was low then is the user's own decision."""

    def tripped(commander: Commander) -> bool:
        return commander.situation.battery_level >= level > commander.battery_at_arming

    return tripped


def _battery_action(level: int) -> By:
    return By("COM_LOW_BAT_ACT", {value: actions[level - 1] for value, actions in BATTERY_ACTION.items()})


def _battery_unhealthy(commander: Commander) -> bool:
    return commander.situation.battery_age_us >= BATTERY_TIMEOUT_US


def _unhealthy_action(commander: Commander) -> Action:
    """disarm within COM_SPOOLUP_TIME of arming, then warn"""
    return _A.WARN if commander.spooled_up(commander.now_us) else _A.DISARM


def _time_low(commander: Commander) -> bool:
    return commander.situation.return_margin_s <= 0.0


def _flown_for(share: float) -> Callable[[Commander], bool]:
    def tripped(commander: Commander) -> bool:
        limit_s = commander.parameters["COM_FLT_TIME_MAX"]
        return limit_s > 0 and commander.situation.airborne_s >= share * limit_s

    return tripped


def _wind_beyond(parameter: str) -> Callable[[Commander], bool]:
    def tripped(commander: Commander) -> bool:
        wind_m_s = commander.situation.wind_m_s
        return wind_m_s > 0.0 and wind_m_s > commander.parameters[parameter] > 0.0

    return tripped


def _fence_breached(commander: Commander) -> bool:
    return commander.situation.fence_breach is not None and commander.parameters["GF_ACTION"] > 0


def _mission_failed(commander: Commander) -> bool:
    return commander.situation.mission_failure is not None and commander.intended is Mode.MISSION


def _position_inaccurate(commander: Commander) -> bool:
    if commander.intended is not Mode.LOITER and commander.intended is not Mode.MISSION:
        return False
    situation = commander.situation
    return situation.position_valid and situation.position_error_m > commander.parameters["COM_POS_LOW_EPH"] > 0.0


def _estimate_lost(need: Need, name: str) -> Callable[[Commander], bool]:
    valid = attrgetter(f"{name}_valid")

    def tripped(commander: Commander) -> bool:
        return not valid(commander.situation) and need in modes.TABLE[commander.intended].needs

    return tripped


def _fallback_action(commander: Commander) -> Action:
    """POSCTL: altitude, ALTCTL: stabilized, both without sticks: NAV_RCL_ACT; else return; what cannot be flown gives
    way to the next worse
    """
    action = {Mode.POSCTL: _A.ALTITUDE, Mode.ALTCTL: _A.STABILIZED}.get(commander.intended, _A.RETURN)
    return _with_sticks(commander, action)


def _tilted(axis: str, parameter: str) -> Callable[[Commander], bool]:
    """Not where the mode turns the vehicle by rates: ACRO, and OFFBOARD with rates."""
    angle_rad = attrgetter(f"{axis}_rad")

    def tripped(commander: Commander) -> bool:
        limit_deg = commander.parameters[parameter]
        if not limit_deg or not abs(angle_rad(commander.situation)) > radians(limit_deg):
            return False
        if commander.mode is Mode.OFFBOARD:
            return Need.ATTITUDE in commander.situation.stream_needs
        return modes.TABLE[commander.mode].stabilized

    return tripped


def _detector_action(commander: Commander) -> Action:
    """disarm within COM_SPOOLUP_TIME + COM_LKDOWN_TKO of arming; then warn, or terminate if CBRK_FLIGHTTERM is 0"""
    p = commander.parameters
    if commander.now_us - commander.armed_at_us < int((p["COM_SPOOLUP_TIME"] + p["COM_LKDOWN_TKO"]) * 1e6):
        return _A.DISARM
    return _A.WARN if p["CBRK_FLIGHTTERM"] == BREAKER_ON else _A.TERMINATE


def _altitude_lost(commander: Commander) -> bool:
    loss_m = commander.situation.altitude_loss_m
    return loss_m > 0.0 and loss_m > commander.parameters["FD_ALT_LOSS"] > 0.0


def _motor_failed(commander: Commander) -> bool:
    return commander.situation.motor_failure != 0 and commander.parameters["FD_ACT_EN"] != 0


def _motors_said(commander: Commander) -> str:
    mask = commander.situation.motor_failure
    motors = ", ".join(f"{bit + 1}" for bit in range(mask.bit_length()) if mask >> bit & 1)
    return f"motor {motors} failure"


def _always(action: Action) -> Callable[[Commander], Action]:
    def constant(commander: Commander) -> Action:
        return action

    constant.__doc__ = action.name.lower()
    return constant


def _killed(commander: Commander) -> bool:
    return commander.kill_engaged


FAILSAFES: tuple[Failsafe, ...] = (
    Failsafe(
        "off-board signal lost", _offboard_lost, _ByWithSticks("COM_OBL_RC_ACT", OFFBOARD_LOSS_ACTION),
        ("COM_OF_LOSS_T",), deferred=False, ends_with_cause=True, regained="Off-board stream regained",
    ),
    Failsafe(
        "manual control lost", _sticks_lost, By("NAV_RCL_ACT", LINK_LOSS_ACTION),
        ("COM_RC_LOSS_T", "COM_RCL_EXCEPT", "COM_RC_IN_MODE"), regained="Manual control regained",
    ),
    Failsafe(
        "connection to ground station lost", _gcs_lost, By("NAV_DLL_ACT", LINK_LOSS_ACTION),
        ("COM_DL_LOSS_T", "COM_DLL_EXCEPT"), regained="Connection to ground station regained",
    ),
    Failsafe("low battery", _battery_at(1), _battery_action(1), ("BAT_LOW_THR",)),
    Failsafe("critical battery", _battery_at(2), _battery_action(2), ("BAT_CRIT_THR",)),
    Failsafe("emergency battery level", _battery_at(3), _battery_action(3), ("BAT_EMERGEN_THR",)),
    Failsafe(
        "geofence breached", _fence_breached, By("GF_ACTION", LIMIT_ACTION), ("GF_MAX_HOR_DIST", "GF_MAX_VER_DIST"),
        deferred=False, sticks_end_hold=False,
    ),
    Failsafe(
        "both links lost after the mission", _nobody_after_mission, _always(_A.RETURN),
        ("COM_DL_LOSS_T", "NAV_DLL_ACT", "COM_RCL_EXCEPT", "COM_RC_IN_MODE"),
    ),
    Failsafe("battery unhealthy", _battery_unhealthy, _unhealthy_action, ends_with_cause=True),
    Failsafe("remaining flight time low", _time_low, By("COM_FLTT_LOW_ACT", FLIGHT_TIME_ACTION)),
    Failsafe("flight time nearly over", _flown_for(NEARLY), _always(_A.WARN), ("COM_FLT_TIME_MAX",)),
    Failsafe("maximum flight time exceeded", _flown_for(1.0), _always(_A.RETURN), ("COM_FLT_TIME_MAX",)),
    Failsafe("strong wind", _wind_beyond("COM_WIND_WARN"), _always(_A.WARN), ("COM_WIND_WARN",)),
    Failsafe(
        "wind limit exceeded", _wind_beyond("COM_WIND_MAX"), By("COM_WIND_MAX_ACT", LIMIT_ACTION), ("COM_WIND_MAX",),
        sticks_end_hold=False,
    ),
    Failsafe("mission failure", _mission_failed, _always(_A.RETURN), ends_with_cause=True),
    Failsafe(
        "position accuracy low", _position_inaccurate, By("COM_POS_LOW_ACT", LIMIT_ACTION), ("COM_POS_LOW_EPH",),
        ends_with_cause=True, sticks_end_hold=False,
    ),
    *(
        Failsafe(
            f"{name} estimate lost", _estimate_lost(need, name), _fallback_action, deferred=False,
            ends_with_cause=True, overruled=False,
        )
        for need, name in (
            (Need.ATTITUDE, "attitude"), (Need.HEIGHT, "height"), (Need.VELOCITY, "velocity"),
            (Need.POSITION, "position"),
        )
    ),
    *(
        Failsafe(
            f"attitude failure ({axis})", _tilted(axis, f"FD_FAIL_{letter}"), _detector_action,
            (f"FD_FAIL_{letter}",), after=f"FD_FAIL_{letter}_TTRI", ends_with_cause=True,
        )
        for axis, letter in (("roll", "R"), ("pitch", "P"))
    ),
    Failsafe(
        "altitude loss", _altitude_lost, _detector_action, ("FD_ALT_LOSS",), after="FD_ALT_LOSS_T",
        ends_with_cause=True,
    ),
    Failsafe(
        "motor failure", _motor_failed, By("COM_ACT_FAIL_ACT", MOTOR_ACTION), ("FD_ACT_EN",), after="MOTFAIL_TIME",
        said=_motors_said,
    ),
    Failsafe("kill switch engaged", _killed, _always(_A.DISARM), after="COM_KILL_DISARM"),
)  # fmt: skip
"""New rows go to the end: the reference lists them in this order."""

_WATCHED = tuple((row.tripped, row) for row in FAILSAFES)
_NOT_OVERRULED = {row.name for row in FAILSAFES if not row.overruled}
