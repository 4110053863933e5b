"""The flight modes: one table, PX4's numbers. The list and the diagram in the docs are made from it."""

from __future__ import annotations

from enum import Enum, Flag, auto
from typing import NamedTuple

from mavsitl.dialect import mavlink


class Mode(Enum):
    __hash__ = object.__hash__  # Enum's own is slow, and each member is one object

    MANUAL = auto()
    ALTCTL = auto()
    POSCTL = auto()
    MISSION = auto()
    LOITER = auto()
    RTL = auto()
    ACRO = auto()
    DESCEND = auto()
    TERMINATION = auto()
    OFFBOARD = auto()
    STABILIZED = auto()
    TAKEOFF = auto()
    LAND = auto()
    ORBIT = auto()


class Control(Enum):
    """Who makes a mode's setpoints."""

    STICKS = auto()
    """MANUAL_CONTROL, see `sticks.py`."""
    NAVIGATOR = auto()
    """The vehicle itself, see `navigator.py`."""
    STREAM = auto()
    """An off-board program, see `setpoints.py`."""
    NOBODY = auto()
    """The rotors stand still."""


class Need(Flag):
    """What must be there for a mode to be flown."""

    NOTHING = 0
    ATTITUDE = auto()
    HEIGHT = auto()
    VELOCITY = auto()
    POSITION = auto()
    """These four: valid estimates."""
    HOME = auto()
    MISSION = auto()
    """One that can be flown."""
    STREAM = auto()
    """Setpoints of an off-board program, and the estimates that they themselves need."""
    STICKS = auto()
    LIMITS = auto()
    """Wind and flight time within COM_WIND_MAX and COM_FLT_TIME_MAX: for the choice of the mode, not while it flies."""


class ModeInfo(NamedTuple):
    """PX4's numbers and rules of one mode."""

    name: str
    """As mavros and the log say it."""
    title: str
    """AVAILABLE_MODES.mode_name, where the mode is not a standard one; as QGroundControl shows it."""
    main_mode: int
    sub_mode: int
    nav_state: int
    """vehicle_status.nav_state, for the log."""
    control: Control
    standard_mode: int
    """MAV_STANDARD_MODE"""
    needs: Need
    """PX4's mode requirements."""
    stabilized: bool
    """An attitude loop runs: MAV_MODE_FLAG_STABILIZE_ENABLED."""
    can_arm: bool
    """PX4's mode_req_prevent_arming, inverted."""
    selectable: bool = True
    """A user may ask for it; otherwise only a command with its own parameters or a fail-safe leads there."""
    advanced: bool = True
    """MAV_MODE_PROPERTY_ADVANCED: not for beginners."""

    @property
    def base_mode(self) -> int:
        """MAV_MODE_FLAG bits besides CUSTOM_MODE_ENABLED and SAFETY_ARMED."""
        flags = mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED if self.stabilized else 0
        if self.control is Control.STICKS:
            flags |= mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
        elif self.control in (Control.NAVIGATOR, Control.STREAM):
            flags |= mavlink.MAV_MODE_FLAG_GUIDED_ENABLED | mavlink.MAV_MODE_FLAG_AUTO_ENABLED
        return int(flags)


def _row(
    name: str, title: str, numbers: tuple[int, int, int], control: Control, needs: Need, *, standard: int = 0,
    can_arm: bool = True, stabilized: bool = True, selectable: bool = True, advanced: bool = True,
) -> ModeInfo:  # fmt: skip
    return ModeInfo(name, title, *numbers, control, standard, needs, stabilized, can_arm, selectable, advanced)


_STICKS, _AUTO = Control.STICKS, Control.NAVIGATOR
_LEVEL = Need.ATTITUDE
_WHERE = Need.ATTITUDE | Need.HEIGHT | Need.VELOCITY | Need.POSITION

TABLE: dict[Mode, ModeInfo] = {
    Mode.MANUAL: _row("MANUAL", "Manual", (1, 0, 0), _STICKS, _LEVEL | Need.STICKS),
    Mode.ALTCTL: _row(
        "ALTCTL", "Altitude", (2, 0, 1), _STICKS, _LEVEL | Need.HEIGHT | Need.STICKS, standard=4, advanced=False
    ),
    Mode.POSCTL: _row("POSCTL", "Position", (3, 0, 2), _STICKS, _WHERE | Need.STICKS, standard=1, advanced=False),
    Mode.MISSION: _row(
        "AUTO.MISSION", "Mission", (4, 4, 3), _AUTO, _WHERE | Need.MISSION | Need.LIMITS, standard=6, advanced=False
    ),
    Mode.LOITER: _row("AUTO.LOITER", "Hold", (4, 3, 4), _AUTO, _WHERE | Need.LIMITS, advanced=False),
    Mode.RTL: _row(
        "AUTO.RTL", "Return", (4, 5, 5), _AUTO, _WHERE | Need.HOME, standard=5, can_arm=False, advanced=False
    ),
    Mode.ACRO: _row("ACRO", "Acro", (5, 0, 10), _STICKS, Need.STICKS, stabilized=False),
    Mode.DESCEND: _row(
        "AUTO.DESCEND", "Descend", (4, 6, 12), _AUTO, _LEVEL, can_arm=False, selectable=False, advanced=False
    ),
    Mode.TERMINATION: _row(
        "TERMINATION", "Termination", (10, 0, 13), Control.NOBODY, Need.NOTHING,
        can_arm=False, stabilized=False, selectable=False,
    ),
    Mode.OFFBOARD: _row("OFFBOARD", "Offboard", (6, 0, 14), Control.STREAM, _LEVEL | Need.STREAM),
    Mode.STABILIZED: _row("STABILIZED", "Stabilized", (7, 0, 15), _STICKS, _LEVEL | Need.STICKS),
    Mode.TAKEOFF: _row("AUTO.TAKEOFF", "Takeoff", (4, 2, 17), _AUTO, _WHERE, standard=8, advanced=False),
    Mode.LAND: _row("AUTO.LAND", "Land", (4, 6, 18), _AUTO, _WHERE, standard=7, can_arm=False, advanced=False),
    Mode.ORBIT: _row(
        "ORBIT", "Orbit", (3, 1, 21), _AUTO, _WHERE | Need.LIMITS,
        standard=2, can_arm=False, selectable=False, advanced=False,
    ),
}  # fmt: skip
"""In the order of PX4's nav_state, which is the order of AVAILABLE_MODES. PX4 shows DESCEND by AUTO.LAND's numbers."""

LISTED = tuple(mode for mode in TABLE if mode is not Mode.DESCEND)
"""In AVAILABLE_MODES, where numbers name one mode each."""

_SELECTABLE = {mode: info for mode, info in TABLE.items() if info.selectable}
_BY_NUMBERS = {(info.main_mode, info.sub_mode): mode for mode, info in _SELECTABLE.items()}
_BY_NUMBERS[4, 0] = Mode.MISSION  # PX4: AUTO without a sub mode
_BY_STANDARD = {info.standard_mode: mode for mode, info in _SELECTABLE.items() if info.standard_mode}


def custom_mode(mode: Mode) -> int:
    """HEARTBEAT.custom_mode: main mode in bits 16-23, sub mode in bits 24-31."""
    info = TABLE[mode]
    return info.main_mode << 16 | info.sub_mode << 24


def find(main_mode: int, sub_mode: int) -> Mode | None:
    """The mode that PX4's numbers name, or None where a user cannot choose one of that kind."""
    return _BY_NUMBERS.get((main_mode, sub_mode))


def find_standard(standard_mode: int) -> Mode | None:
    """The mode for a MAV_STANDARD_MODE, or None."""
    return _BY_STANDARD.get(standard_mode)


def from_base_mode(base_mode: int) -> Mode | None:
    """What PX4 makes of MAV_MODE_FLAG bits alone, without the custom bit."""
    if base_mode & mavlink.MAV_MODE_FLAG_AUTO_ENABLED:
        return Mode.MISSION
    if not base_mode & mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED:
        return None
    if base_mode & mavlink.MAV_MODE_FLAG_GUIDED_ENABLED:
        return Mode.POSCTL
    return Mode.STABILIZED if base_mode & mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED else Mode.MANUAL
