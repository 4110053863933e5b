"""The flight modes: one table, PX4's numbers. The diagram in the docs is drawn from it."""

from __future__ import annotations

from enum import Enum, auto
from typing import NamedTuple

from mavsitl.dialect import mavlink


class Mode(Enum):
    LOITER = auto()
    LAND = auto()
    OFFBOARD = auto()


class ModeInfo(NamedTuple):
    name: str
    main_mode: int
    sub_mode: int
    nav_state: int
    """vehicle_status.nav_state, for the log."""
    base_mode: int
    """MAV_MODE_FLAG bits besides CUSTOM_MODE_ENABLED and SAFETY_ARMED."""
    can_arm: bool


_AUTO_FLAGS = (
    mavlink.MAV_MODE_FLAG_AUTO_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED | mavlink.MAV_MODE_FLAG_GUIDED_ENABLED
)

TABLE: dict[Mode, ModeInfo] = {
    Mode.LOITER: ModeInfo("AUTO.LOITER", 4, 3, 4, _AUTO_FLAGS, True),
    Mode.LAND: ModeInfo("AUTO.LAND", 4, 6, 18, _AUTO_FLAGS, False),
    Mode.OFFBOARD: ModeInfo("OFFBOARD", 6, 0, 14, _AUTO_FLAGS, True),
}

_BY_NUMBERS = {(info.main_mode, info.sub_mode): mode for mode, info in TABLE.items()}


def custom_mode(mode: Mode) -> int:
    """HEARTBEAT.custom_mode: main mode in bits 16-23, sub mode in bits 24-31."""
    info = TABLE[mode]
    return info.main_mode << 16 | info.sub_mode << 24


def find(main_mode: int, sub_mode: int) -> Mode | None:
    """The mode that PX4's numbers name, or None where this vehicle has none of that kind."""
    return _BY_NUMBERS.get((main_mode, sub_mode))
