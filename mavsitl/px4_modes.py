"""PX4's flight modes by number: what a log and a HEARTBEAT say, and what a command asks for."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["CUSTOM_MODES", "MODES", "NAV_STATES", "Numbers"]


class Numbers(NamedTuple):
    """How PX4 counts a mode."""

    nav_state: int
    """vehicle_status.nav_state"""
    main_mode: int
    """Bits 16 to 23 of HEARTBEAT.custom_mode, and DO_SET_MODE's second parameter."""
    sub_mode: int
    """Bits 24 to 31, and its third."""


MODES = {
    "MANUAL": Numbers(0, 1, 0),
    "ALTCTL": Numbers(1, 2, 0),
    "POSCTL": Numbers(2, 3, 0),
    "AUTO.MISSION": Numbers(3, 4, 4),
    "AUTO.LOITER": Numbers(4, 4, 3),
    "AUTO.RTL": Numbers(5, 4, 5),
    "ACRO": Numbers(10, 5, 0),
    "AUTO.DESCEND": Numbers(12, 4, 6),
    "TERMINATION": Numbers(13, 10, 0),
    "OFFBOARD": Numbers(14, 6, 0),
    "STABILIZED": Numbers(15, 7, 0),
    "AUTO.TAKEOFF": Numbers(17, 4, 2),
    "AUTO.LAND": Numbers(18, 4, 6),
    "ORBIT": Numbers(21, 3, 1),
}
"""By the names of mavros. PX4 shows AUTO.DESCEND by AUTO.LAND's main and sub mode; nobody can ask for it."""

NAV_STATES = {numbers.nav_state: name for name, numbers in MODES.items()}

CUSTOM_MODES = {(numbers.main_mode, numbers.sub_mode): name for name, numbers in MODES.items()}
"""What a HEARTBEAT's main and sub mode say: of two modes that share them, the one that can be asked for."""
