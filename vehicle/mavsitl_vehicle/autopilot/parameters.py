"""The vehicle's parameters: PX4's names where the meaning is PX4's, `SIM_*` for the simulation's own.

`TABLE` is the one place where a parameter is defined: the values that are allowed, the MAVLink answers, the docs page
and the component metadata come from it. Defaults are PX4 1.17's; where they differ, the row's note says from what.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple, TypeAlias
from zlib import crc32

from mavsitl.dialect import mavlink
from mavsitl.scenario import ScenarioError
from mavsitl.services.parameter import Refused
from mavsitl_vehicle import failures

INT32_MIN, INT32_MAX = -(2**31), 2**31 - 1

LONGEST_GOOD_MS, LARGEST_KBIT_S = 1e7, 1e6
"""Of the links' settings, which a scenario does not limit."""

Live: TypeAlias = Literal["now", "arming", "boot"]
"""When a new value counts: from the next tick, from the next arming, from the next start of the vehicle."""

UsedBy: TypeAlias = Literal["vehicle", "client"]
"""Who reads it: the vehicle acts on it, or it is only there because clients ask for it."""

Listener: TypeAlias = Callable[[str, float], None]
"""(name, new value)"""

Guard: TypeAlias = Callable[[str, float], str | None]
"""(name, value that the table allows): why a client cannot set it now, or None."""


class Parameter(NamedTuple):
    """A row of `TABLE`."""

    name: str
    type: Literal["INT32", "REAL32"]
    default: float
    minimum: float
    maximum: float
    unit: str
    group: str
    text: str
    long: str = ""
    values: Mapping[int, str] = {}
    """An enumeration: no other value is allowed."""
    bits: Mapping[int, str] = {}
    """A bit mask: bit number to meaning."""
    decimals: int = 0
    live: Live = "now"
    volatile: bool = False
    """Says how the vehicle is, not how it is set up: neither in the hash nor in the file."""
    read_only: bool = False
    """Clients cannot set it; the vehicle does."""
    category: Literal["Standard", "System", "Developer"] = "Standard"
    used_by: UsedBy = "vehicle"
    note: str = ""
    """How it differs from PX4's parameter of that name."""

    @property
    def reboot_required(self) -> bool:
        return self.live == "boot"

    @property
    def is_integer(self) -> bool:
        return self.type == "INT32"

    @property
    def allowed(self) -> str:
        """The values that it takes, in words."""
        unit = f" {self.unit}" if self.unit else ""
        if self.values:
            return ", ".join(str(value) for value in sorted(self.values))
        whole = "whole numbers " if self.is_integer else ""
        return f"{whole}{_shown(self.minimum)} to {_shown(self.maximum)}{unit}"

    def problem(self, value: object) -> str | None:
        """Why `value` is not allowed, or None. Limits are compared in the type that the wire carries."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            return f"{type(value).__name__} is not a number; allowed: {self.allowed}"
        if self.is_integer:
            fits = value == value and abs(value) <= 2**31 and value == int(value)
            fits = fits and (int(value) in self.values if self.values else self.minimum <= value <= self.maximum)
        else:
            try:
                fits = _single(self.minimum) <= _single(value) <= _single(self.maximum)
            except (OverflowError, struct.error):  # struct's own for integers that no float can hold
                fits = False
        if fits:
            return None
        unit = f" {self.unit}" if self.unit else ""
        return f"{_shown(value)}{unit} is not allowed; allowed: {self.allowed}"


def _single(value: float) -> float:
    """The float32 next to `value`. Raises OverflowError or struct.error where there is none."""
    single: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return single


def _shown(value: float) -> str:
    if isinstance(value, int):
        return str(value) if abs(value) < 10**20 else f"an integer of {value.bit_length()} bits"
    return f"{value:g}"


# The helpers below write rows; the group is filled in by `_group`.


def _real(
    name: str, default: float, low: float, high: float, unit: str, text: str, long: str = "", *, decimals: int = 2,
    live: Live = "now", used_by: UsedBy = "vehicle", note: str = "",
) -> Parameter:  # fmt: skip
    return Parameter(
        name, "REAL32", float(default), float(low), float(high), unit, "", text, long,
        decimals=decimals, live=live, used_by=used_by, note=note,
    )  # fmt: skip


def _int(
    name: str, default: int, low: int, high: int, unit: str, text: str, long: str = "", *, live: Live = "now",
    volatile: bool = False, read_only: bool = False, category: Literal["Standard", "System", "Developer"] = "Standard",
    used_by: UsedBy = "vehicle", note: str = "",
) -> Parameter:  # fmt: skip
    return Parameter(
        name, "INT32", default, low, high, unit, "", text, long, live=live, volatile=volatile, read_only=read_only,
        category=category, used_by=used_by, note=note,
    )  # fmt: skip


def _choice(
    name: str, default: int, values: Mapping[int, str], text: str, long: str = "", *, live: Live = "now",
    used_by: UsedBy = "vehicle", note: str = "",
) -> Parameter:  # fmt: skip
    return Parameter(
        name, "INT32", default, min(values), max(values), "", "", text, long, values=values, live=live,
        used_by=used_by, note=note,
    )  # fmt: skip


def _switch(
    name: str, default: int, text: str, long: str = "", *, live: Live = "now", used_by: UsedBy = "vehicle",
    note: str = "",
) -> Parameter:  # fmt: skip
    return _choice(name, default, {0: "Off", 1: "On"}, text, long, live=live, used_by=used_by, note=note)


def _event(row: Parameter) -> Parameter:
    """What happens to the vehicle, not how it is set up: 0 at every start."""
    return row._replace(volatile=True)


def _failure(name: str) -> Parameter:
    unit, instance = failures.PARAMETERS[name]
    several = f" {instance}" if failures.INSTANCES.get(unit, 1) > 1 else ""
    known = {kind.value: failures.named(kind).capitalize() for kind in failures.kinds(unit)}
    text = f"Failure of the {failures.named(unit)}{several}, FAILURE_TYPE"
    return _event(_choice(name, 0, known | {0: "OK"}, text, "Shows it whoever asked for it."))


def _mask(
    name: str, default: int, bits: Mapping[int, str], text: str, long: str = "", *, used_by: UsedBy = "vehicle",
    note: str = "",
) -> Parameter:  # fmt: skip
    return Parameter(
        name, "INT32", default, 0, sum(1 << bit for bit in bits), "", "", text, long, bits=bits, used_by=used_by,
        note=note,
    )  # fmt: skip


def _link(prefix: str, whose: str) -> tuple[Parameter, ...]:
    """The settings of one link; the ends of the names are those of `mavsitl.link.settings`."""
    rows = (
        _real(f"{prefix}_LAT", 0, 0, 10_000, "ms", f"Latency of {whose}, each way", decimals=1),
        _real(f"{prefix}_JIT", 0, 0, 10_000, "ms", f"Jitter of {whose}",
              "1 sigma, or half the width, by the scenario's distribution.", decimals=1),
        _real(f"{prefix}_LOSS", 0, 0, 1, "", f"Share of messages lost on {whose}, each for itself", decimals=3),
        _real(f"{prefix}_BURST", 0, 0, 10_000, "ms", f"Mean length of a burst of losses on {whose}; 0: none",
              decimals=0),
        _real(f"{prefix}_GOOD", 2000, 1, LONGEST_GOOD_MS, "ms", f"Mean time between two bursts on {whose}", decimals=0),
        _real(f"{prefix}_REORD", 0, 0, 1, "", f"Share of messages held back on {whose}",
              "By the scenario's reorder_ms, 20 ms by default.", decimals=3),
        _real(f"{prefix}_DUP", 0, 0, 1, "", f"Share of messages that come twice on {whose}", decimals=3),
        _real(f"{prefix}_CORR", 0, 0, 1, "", f"Share of messages with flipped bits on {whose}", decimals=3),
        _real(f"{prefix}_BW", 0, 0, LARGEST_KBIT_S, "kbit/s", f"Bandwidth of {whose}; 0: unlimited", decimals=0),
        _switch(f"{prefix}_DOWN", 0, f"Outage of {whose}",
                "Who speaks on that link cannot switch it on again: it is done over the other one."),
        _choice(f"{prefix}_DIR", 0, {0: "Both", 1: "To the ground", 2: "To the vehicle"},
                f"Direction of {whose} for which the others hold", "The other direction is as in the scenario."),
    )  # fmt: skip
    return tuple(row._replace(volatile=True) for row in rows)


def _group(group: str, *rows: Parameter) -> tuple[Parameter, ...]:
    return tuple(row._replace(group=group) for row in rows)


_FLIGHT_MODES = {
    -1: "None", 0: "Manual", 1: "Altitude", 2: "Position", 3: "Mission", 4: "Hold", 5: "Return", 6: "Acro",
    7: "Offboard", 8: "Stabilized", 10: "Take-off", 11: "Land",
}  # fmt: skip
_CHANNELS = {0: "None", **{channel: f"Channel {channel}" for channel in range(1, 19)}}
_ROTATIONS = {0: "None", 2: "Yaw 90°", 4: "Yaw 180°", 6: "Yaw 270°"}
_LOSS_ACTIONS = {0: "None", 1: "Hold", 2: "Return", 3: "Land", 5: "Terminate", 6: "Disarm"}

# fmt: off
_ROWS: Iterable[tuple[Parameter, ...]] = (
    _group(
        "System",
        _int("SYS_AUTOSTART", 5001, 0, 9_999_999, "", "Airframe number", "5001 is PX4's generic quadrotor with a plus "
             "layout. Ground stations take 0 for a vehicle that is not set up.", live="boot", used_by="client",
             note="PX4: 0, set by its start-up script"),
        _choice("SYS_AUTOCONFIG", 0, {0: "Keep the parameters", 1: "Defaults at the next start"},
                "Put the parameters back to their defaults at the next start", live="boot", used_by="client"),
        _int("SYS_PARAM_VER", 1, 0, INT32_MAX, "", "Version of the airframe's parameter set", used_by="client"),
        _switch("SYS_FAILURE_EN", 0, "Let MAV_CMD_INJECT_FAILURE break things",
                "By the scenario and by SIM_FAIL_* they break without it.", note="PX4's SITL start-up script sets 1"),
        _int("SYS_HAS_MAG", 1, 0, 4, "", "Number of magnetometers", live="boot", used_by="client"),
        _switch("SYS_HAS_GPS", 1, "There is a GPS receiver", live="boot", used_by="client"),
        _switch("SYS_HAS_BARO", 1, "There is a barometer", live="boot", used_by="client"),
        _choice("SYS_HITL", 0, {0: "Off"}, "Hardware in the loop", "This vehicle is a simulation already.",
                live="boot", used_by="client"),
    ),
    _group(
        "MAVLink",
        _int("MAV_SYS_ID", 1, 1, 255, "", "MAVLink system id", read_only=True,
             note="set by --system; PX4: 1 to 250, by a reboot"),
        _int("MAV_COMP_ID", 1, 1, 1, "", "MAVLink component id", live="boot", used_by="client", note="PX4: 1 to 250"),
        _choice("MAV_TYPE", 2, {2: "Quadrotor"}, "Vehicle type in HEARTBEAT", live="boot", used_by="client",
                note="PX4: 0, set by its start-up script"),
        _choice("MAV_PROTO_VER", 2, {2: "MAVLink 2"}, "MAVLink version that is sent", live="boot", used_by="client"),
        _switch("MAV_HASH_CHK_EN", 1, "Send _HASH_CHECK first, so that a ground station can use its cache",
                used_by="client", note="always on here"),
        _choice("MAV_SIGN_CFG", 0, {0: "Off", 1: "All links but USB", 2: "All links"},
                "On which links unsigned messages are refused",
                "Only where a key was set by SETUP_SIGNING. 1 leaves out links on loopback, trusted as USB is.",
                note="not in PX4 1.17"),
        _int("MAV_RADIO_TOUT", 5, 1, 250, "s", "Silence after which a reported radio counts as gone", used_by="client"),
    ),
    _group(
        "Commander",
        _choice("COM_RC_IN_MODE", 1, {0: "Remote control", 1: "Joystick", 2: "Both, with fall-back",
                                      3: "Both, the first that comes", 4: "None"},
                "Where the sticks are", "There is no radio receiver here: 1 to 3 mean a MAVLink joystick; with 0 and "
                "4 nobody has sticks, MANUAL_CONTROL is not taken, and with 4 none are missed.",
                note="PX4: 3; its SITL start-up script sets 1"),
        _real("COM_RC_LOSS_T", 0.5, 0, 35, "s", "Sticks count as lost after this silence", decimals=1),
        _mask("COM_RC_OVERRIDE", 1, {0: "In automatic modes", 1: "In OFFBOARD"}, "Where moving a stick takes over",
              "In flight: POSCTL follows, or the best stick mode that can be flown. Not while a fail-safe holds."),
        _real("COM_RC_STICK_OV", 30, 5, 80, "%", "Stick movement that takes over", "Away from where the stick was "
              "about a second before.", decimals=0),
        _mask("COM_RCL_EXCEPT", 0, {0: "Mission", 1: "Hold", 2: "OFFBOARD", 3: "External modes", 4: "Altitude cruise"},
              "Modes that do not mind the loss of the sticks", "Hold stands for the automatic modes but missions."),
        _int("COM_DL_LOSS_T", 10, 5, 300, "s", "The ground station counts as lost after this silence"),
        _mask("COM_DLL_EXCEPT", 0, {0: "Mission", 1: "Hold", 2: "OFFBOARD"},
              "Modes that do not mind the loss of the ground station",
              "Hold stands for the automatic modes but missions."),
        _real("COM_OF_LOSS_T", 1, 0, 60, "s", "Off-board stream counts as lost after this silence"),
        _choice("COM_OBL_RC_ACT", 0, {0: "Position", 1: "Altitude", 2: "Stabilized", 3: "Return", 4: "Land", 5: "Hold",
                                      6: "Terminate", 7: "Disarm"},
                "What follows the loss of the off-board stream",
                "Without sticks, 0 to 2 fall through to NAV_RCL_ACT."),
        _real("COM_DISARM_LAND", 2, -1, 20, "s", "Auto-disarm after landing; negative: never", decimals=1),
        _real("COM_DISARM_PRFLT", 10, -1, 60, "s", "Auto-disarm when armed and not taken off; negative: never",
              decimals=1),
        _real("COM_SPOOLUP_TIME", 1, 0, 30, "s", "From arming to rotors at speed", decimals=1),
        _real("COM_KILL_DISARM", 5, 0, 30, "s", "From the kill switch to disarming", "The rotors stop at once.",
              decimals=1),
        _real("COM_FAIL_ACT_T", 5, 0, 25, "s", "Hold before a fail-safe acts: time to take over",
              "What was spent of it comes back at a quarter of the speed.", decimals=1),
        _real("COM_LKDOWN_TKO", 3, -1, 5, "s", "A flip so soon after arming and COM_SPOOLUP_TIME disarms", decimals=1),
        _choice("COM_ACT_FAIL_ACT", 0, {0: "Warn", 1: "Hold", 2: "Land", 3: "Return", 4: "Terminate"},
                "What follows the failure of a motor", "Where FD_ACT_EN is on."),
        _choice("COM_LOW_BAT_ACT", 0, {0: "Warn", 2: "Land", 3: "Return at critical, land at emergency"},
                "What follows a low battery", note="PX4's SITL start-up script sets 3"),
        _choice("COM_TAKEOFF_ACT", 0, {0: "Hold", 1: "Mission, if there is one"}, "What follows AUTO.TAKEOFF",
              used_by="client"),
        _switch("COM_ARMABLE", 1, "Arming is allowed", "Off keeps the vehicle safe while somebody works on it."),
        _choice("COM_ARM_WO_GPS", 1, {0: "Refuse", 1: "Warn", 2: "Allow"}, "Arming without a position fix",
              used_by="client"),
        _switch("COM_ARM_MIS_REQ", 0, "Arming needs a valid mission"),
        _real("COM_ARM_BAT_MIN", -1, -1, 0.9, "norm", "Least battery for arming; negative: no check"),
        _choice("COM_PREARM_MODE", 0, {0: "Off"}, "Actuators that move before arming", used_by="client"),
        _switch("COM_MOT_TEST_EN", 1, "Motors may be tested from a ground station", used_by="client"),
        _int("COM_FLT_TIME_MAX", -1, -1, 1_000_000, "s", "Return after this time in the air; -1: never",
             "A warning comes at nine tenths of it. Beyond it Hold, missions and orbits cannot be chosen."),
        _choice("COM_FLTT_LOW_ACT", 0, {0: "None", 1: "Warn", 3: "Return"},
                "What follows when the battery lasts no longer than a return",
                "The battery's time at its mean drain, the return's by RTL_TIME_FACTOR and RTL_TIME_MARGIN.",
                note="PX4: 3; its SITL start-up script sets 0"),
        _real("COM_WIND_MAX", -1, -1, 100, "m/s", "Wind that COM_WIND_MAX_ACT answers; negative: none",
              "Of the vehicle's own estimate, horizontally; there is none in lock-step. Beyond it Hold, missions and "
              "orbits cannot be chosen.", decimals=1),
        _choice("COM_WIND_MAX_ACT", 0, {0: "None", 1: "Warn", 2: "Hold", 3: "Return", 4: "Terminate", 5: "Land"},
                "What follows more wind than COM_WIND_MAX"),
        _real("COM_WIND_WARN", -1, -1, 100, "m/s", "Wind that is warned of; negative: none", decimals=1),
        _real("COM_POS_FS_EPH", 5, -1, 400, "m", "1 sigma of the position beyond which it is lost; negative: no limit",
              "Once it is known, up to 2.5 times of it.", decimals=0),
        _real("COM_VEL_FS_EVH", 1, 0, 10, "m/s", "1 sigma of the horizontal velocity beyond which it is lost",
              "Once it is known, up to 2.5 times of it.", decimals=1),
        _real("COM_POS_LOW_EPH", -1, -1, 1000, "m", "1 sigma of the position that COM_POS_LOW_ACT answers; negative: "
              "none", "In Hold and missions.", decimals=1),
        _choice("COM_POS_LOW_ACT", 3, {0: "None", 1: "Warn", 2: "Hold", 3: "Return", 4: "Terminate", 5: "Land"},
                "What follows a position that is known no better than COM_POS_LOW_EPH"),
        _int("COM_FLIGHT_UUID", 0, 0, INT32_MAX, "", "Number of the next flight", volatile=True, read_only=True,
             category="System", used_by="client"),
        *(_choice(f"COM_FLTMODE{slot}", -1, _FLIGHT_MODES, f"Flight mode of switch position {slot}",
                  used_by="client") for slot in range(1, 7)),
    ),
    _group(
        "Failure Detector",
        _int("FD_FAIL_R", 60, 0, 180, "deg", "Roll that counts as lost control; 0: no check", "Not in ACRO, nor with "
             "off-board rates. What follows: COM_LKDOWN_TKO, CBRK_FLIGHTTERM."),
        _int("FD_FAIL_P", 60, 0, 180, "deg", "Pitch that counts as lost control; 0: no check", "As FD_FAIL_R."),
        _real("FD_FAIL_R_TTRI", 0.3, 0.02, 5, "s", "FD_FAIL_R must be exceeded this long"),
        _real("FD_FAIL_P_TTRI", 0.3, 0.02, 5, "s", "FD_FAIL_P must be exceeded this long"),
        _real("FD_ALT_LOSS", 0, 0, 200, "m", "Fall below the height flown that counts as lost control; 0: no check",
              "What follows: COM_LKDOWN_TKO, CBRK_FLIGHTTERM.", decimals=1, note="not in PX4 1.17"),
        _real("FD_ALT_LOSS_T", 1, 0.02, 5, "s", "FD_ALT_LOSS must be exceeded this long", note="not in PX4 1.17"),
        _switch("FD_ACT_EN", 0, "The failure of a motor is acted on", "By COM_ACT_FAIL_ACT."),
    ),
    _group(
        "Motor Failure",
        _real("MOTFAIL_TIME", 1, 0.01, 10, "s", "A motor must fail this long before it is acted on"),
    ),
    _group(
        "Circuit Breaker",
        _choice("CBRK_FLIGHTTERM", 121212, {0: "A flip or fall terminates the flight", 121212: "It is only warned of"},
                "Breaker of the flight termination by FD_FAIL_R, FD_FAIL_P and FD_ALT_LOSS",
                note="PX4: every number but 121212 is 0"),
    ),
    _group(
        "Manual Control",
        _real("MAN_KILL_GEST_T", -1, -1, 15, "s", "Both sticks in their lower outer corners so long stop the rotors",
              "Until a reboot; COM_KILL_DISARM disarms. Negative: never."),
    ),
    _group(
        "Navigation",
        _choice("NAV_DLL_ACT", 0, _LOSS_ACTIONS, "What follows the loss of the ground station"),
        _choice("NAV_RCL_ACT", 2, {key: text for key, text in _LOSS_ACTIONS.items() if key},
                "What follows the loss of the sticks"),
        _real("NAV_ACC_RAD", 2, 0.05, 200, "m", "A waypoint is reached within this distance", decimals=1,
              note="PX4: 10; its multicopters have 2"),
        _real("NAV_MC_ALT_RAD", 0.8, 0.05, 200, "m", "A waypoint's height is reached within this distance",
              decimals=1, used_by="client"),
        _real("NAV_LOITER_RAD", 80, -10_000, 10_000, "m", "Radius of circles flown by fixed wings", decimals=1,
              used_by="client"),
        _choice("NAV_TRAFF_AVOID", 0, {0: "Off", 1: "Warn"}, "What follows other traffic", used_by="client",
                note="PX4: 1; no transponder here"),
    ),
    _group(
        "Return Mode",
        _choice("RTL_TYPE", 0, {0: "Home or nearest rally point"}, "Where the vehicle returns to",
                note="PX4: 0 to 5", used_by="client"),
        _real("RTL_RETURN_ALT", 30, 0, 1000, "m", "Height above the destination on the way back", decimals=1,
              note="PX4: 60; its multicopters have 30"),
        _real("RTL_DESCEND_ALT", 10, 0, 1000, "m", "Height above the destination where it waits before landing",
              decimals=1, note="PX4: 30; its multicopters have 10"),
        _real("RTL_LAND_DELAY", 0, -1, 3600, "s", "Wait at RTL_DESCEND_ALT; negative: for ever", decimals=1),
        _real("RTL_MIN_DIST", 10, 0.5, 10_000, "m", "Nearer than this, it returns at the height of RTL_CONE_ANG",
              decimals=1),
        _int("RTL_CONE_ANG", 45, 0, 90, "deg", "Half angle of the cone that limits the climb before the return",
             "0: always climb to RTL_RETURN_ALT; 90: to RTL_DESCEND_ALT only."),
        _real("RTL_TIME_FACTOR", 1.1, 1, 2, "", "Factor on the estimated time of a return", "For COM_FLTT_LOW_ACT.",
              decimals=1),
        _int("RTL_TIME_MARGIN", 100, 0, 3600, "s", "Margin on the estimated time of a return", "For COM_FLTT_LOW_ACT."),
    ),
    _group(
        "Mission",
        _real("MIS_TAKEOFF_ALT", 2.5, 0, 1000, "m", "Height of a take-off that names none", decimals=1),
        _real("MIS_DIST_1WP", 10_000, -1, 100_000, "m", "A mission that begins farther away is warned of; 0: never",
              decimals=0),
        _real("MIS_YAW_TMT", -1, -1, 20, "s", "How long a waypoint waits for its heading; negative: it does not",
              decimals=1, used_by="client"),
        _real("MIS_YAW_ERR", 12, 0, 90, "deg", "Heading error with which a waypoint is content", decimals=1,
              used_by="client"),
        _choice("MIS_TKO_LAND_REQ", 0, {0: "Nothing", 1: "A take-off", 2: "A landing", 3: "Both", 4: "Both or neither"},
                "What a mission must have", note="PX4 has 5, for VTOL"),
        _real("MIS_COMMAND_TOUT", 0, 0, 3600, "s", "How long a mission waits for a payload", decimals=1,
              used_by="client"),
    ),
    _group(
        "Geofence",
        _choice("GF_ACTION", 2, {0: "None", 1: "Warn", 2: "Hold", 3: "Return", 4: "Terminate", 5: "Land"},
                "What follows a breach"),
        _choice("GF_SOURCE", 0, {0: "Estimate", 1: "GPS"}, "The position that is checked", used_by="client"),
        _real("GF_MAX_HOR_DIST", 0, 0, 10_000, "m", "Largest horizontal distance from home; 0: no limit", decimals=0),
        _real("GF_MAX_VER_DIST", 0, 0, 10_000, "m", "Largest height above home; 0: no limit", decimals=0),
        _switch("GF_PREDICT", 0, "Act before a breach", used_by="client"),
    ),
    _group(
        "Battery",
        _real("BAT_LOW_THR", 0.15, 0.12, 0.5, "norm", "Below this share the battery is low"),
        _real("BAT_CRIT_THR", 0.07, 0.05, 0.5, "norm", "Below this share the battery is critical"),
        _real("BAT_EMERGEN_THR", 0.05, 0.03, 0.5, "norm", "Below this share the battery is an emergency"),
        _real("BAT_AVRG_CURRENT", 15, 0, 500, "A", "Current in flight, as expected before it is measured",
              used_by="client"),
        _choice("BAT1_SOURCE", 0, {-1: "None", 0: "Power module", 1: "MAVLink", 2: "ESC"},
                "Where the battery is measured", live="boot", used_by="client"),
        _int("BAT1_N_CELLS", 4, 1, 16, "", "Cells in series", live="boot",
             note="PX4: 0; its SITL start-up script sets 4"),
        _real("BAT1_V_CHARGED", 4.05, 3, 5, "V", "Voltage of a full cell", live="boot"),
        _real("BAT1_V_EMPTY", 3.6, 2, 5, "V", "Voltage of an empty cell", live="boot"),
        _real("BAT1_CAPACITY", -1, -1, 100_000, "mAh", "Capacity; negative: not known", decimals=0, live="boot"),
        _real("BAT1_R_INTERNAL", -1, -1, 0.2, "Ohm", "Resistance of a cell; negative: not known", decimals=4,
              live="boot"),
        _real("BAT1_V_DIV", -1, -1, 1000, "", "Voltage divider of the power module", decimals=4, live="boot",
              used_by="client"),
        _real("BAT1_A_PER_V", -1, -1, 1000, "", "Amperes per volt of the power module", decimals=4, live="boot",
              used_by="client"),
    ),
    _group(
        "Multicopter Rate Control",
        _real("MC_ROLLRATE_P", 0.32, 0, 5, "", "Roll rate error (rad/s) to torque (1 = MAX)", decimals=3,
              note="PX4: 0.15"),
        _real("MC_ROLLRATE_I", 0, 0, 5, "", "Integral of the roll rate error to torque", decimals=3, note="PX4: 0.2"),
        _real("MC_ROLLRATE_D", 0, 0, 0.1, "", "Roll acceleration to torque", decimals=4, note="PX4: 0.003"),
        _real("MC_ROLLRATE_K", 1, 0.01, 5, "", "Factor on P, I and D of the roll rate"),
        _real("MC_PITCHRATE_P", 0.32, 0, 5, "", "Pitch rate error (rad/s) to torque (1 = MAX)", decimals=3,
              note="PX4: 0.15"),
        _real("MC_PITCHRATE_I", 0, 0, 5, "", "Integral of the pitch rate error to torque", decimals=3,
              note="PX4: 0.2"),
        _real("MC_PITCHRATE_D", 0, 0, 0.1, "", "Pitch acceleration to torque", decimals=4, note="PX4: 0.003"),
        _real("MC_PITCHRATE_K", 1, 0.01, 5, "", "Factor on P, I and D of the pitch rate"),
        _real("MC_YAWRATE_P", 4, 0, 50, "", "Yaw rate error (rad/s) to torque (1 = MAX)", note="PX4: 0.2"),
        _real("MC_YAWRATE_I", 0, 0, 50, "", "Integral of the yaw rate error to torque", note="PX4: 0.1"),
        _real("MC_YAWRATE_D", 0, 0, 0.1, "", "Yaw acceleration to torque", decimals=4),
        _real("MC_YAWRATE_K", 1, 0.01, 5, "", "Factor on P, I and D of the yaw rate"),
        _real("MC_RR_INT_LIM", 0.3, 0, 1, "", "Limit of the roll rate integral"),
        _real("MC_PR_INT_LIM", 0.3, 0, 1, "", "Limit of the pitch rate integral"),
        _real("MC_YR_INT_LIM", 0.3, 0, 1, "", "Limit of the yaw rate integral"),
    ),
    _group(
        "Multicopter Attitude Control",
        _real("MC_ROLL_P", 6.5, 0, 30, "1/s", "Roll angle error to roll rate", note="PX4: 4"),
        _real("MC_PITCH_P", 6.5, 0, 30, "1/s", "Pitch angle error to pitch rate", note="PX4: 4"),
        _real("MC_YAW_P", 2.8, 0, 10, "1/s", "Yaw angle error to yaw rate"),
        _real("MC_YAW_WEIGHT", 0.4, 0, 1, "", "Share of yaw in the attitude error, against roll and pitch"),
        _real("MC_ROLLRATE_MAX", 220, 0, 1800, "deg/s", "Largest roll rate that the attitude loop asks for",
              decimals=1),
        _real("MC_PITCHRATE_MAX", 220, 0, 1800, "deg/s", "Largest pitch rate that the attitude loop asks for",
              decimals=1),
        _real("MC_YAWRATE_MAX", 200, 0, 1800, "deg/s", "Largest yaw rate that the attitude loop asks for", decimals=1),
    ),
    _group(
        "Multicopter Acro Mode",
        _real("MC_ACRO_R_MAX", 100, 0, 1800, "deg/s", "Roll rate at full stick in ACRO", decimals=1),
        _real("MC_ACRO_P_MAX", 100, 0, 1800, "deg/s", "Pitch rate at full stick in ACRO", decimals=1),
        _real("MC_ACRO_Y_MAX", 100, 0, 1800, "deg/s", "Yaw rate at full stick in ACRO", decimals=1),
        _real("MC_ACRO_EXPO", 0, 0, 1, "", "Share of a cubic curve in the roll and pitch sticks", used_by="client"),
        _real("MC_ACRO_EXPO_Y", 0, 0, 1, "", "Share of a cubic curve in the yaw stick", used_by="client"),
    ),
    _group(
        "Multicopter Position Control",
        _real("MPC_XY_P", 0.95, 0, 2, "1/s", "Horizontal position error to velocity"),
        _real("MPC_XY_VEL_P_ACC", 1.8, 0, 15, "1/s", "Horizontal velocity error to acceleration"),
        _real("MPC_XY_VEL_I_ACC", 0.4, 0, 60, "1/s^2", "Integral of the horizontal velocity error"),
        _real("MPC_XY_VEL_D_ACC", 0.2, 0, 2, "", "Horizontal acceleration to acceleration"),
        _real("MPC_XY_VEL_MAX", 12, 0, 20, "m/s", "Largest horizontal velocity", decimals=1),
        _real("MPC_XY_CRUISE", 5, 0.5, 20, "m/s", "Horizontal velocity in automatic modes", decimals=1),
        _real("MPC_Z_P", 1, 0, 2, "1/s", "Vertical position error to velocity"),
        _real("MPC_Z_VEL_P_ACC", 4, 0, 15, "1/s", "Vertical velocity error to acceleration"),
        _real("MPC_Z_VEL_I_ACC", 2, 0, 30, "1/s^2", "Integral of the vertical velocity error"),
        _real("MPC_Z_VEL_D_ACC", 0, 0, 2, "", "Vertical acceleration to acceleration"),
        _real("MPC_Z_VEL_MAX_UP", 3, 0.5, 8, "m/s", "Largest climb", decimals=1),
        _real("MPC_Z_VEL_MAX_DN", 1.5, 0.5, 4, "m/s", "Largest descent", decimals=1),
        _real("MPC_Z_V_AUTO_UP", 3, 0.5, 8, "m/s", "Climb in automatic modes", decimals=1),
        _real("MPC_Z_V_AUTO_DN", 1.5, 0.5, 4, "m/s", "Descent in automatic modes", decimals=1),
        _real("MPC_TILTMAX_AIR", 45, 20, 89, "deg", "Largest tilt in the position loop", decimals=0),
        _real("MPC_TILTMAX_LND", 12, 5, 89, "deg", "Largest tilt while taking off", decimals=0, used_by="client"),
        _real("MPC_ACC_HOR", 3, 2, 15, "m/s^2", "Horizontal acceleration in automatic modes", decimals=1),
        _real("MPC_ACC_HOR_MAX", 5, 2, 15, "m/s^2", "Largest horizontal acceleration with sticks", decimals=1),
        _real("MPC_ACC_UP_MAX", 4, 2, 15, "m/s^2", "Largest upward acceleration", decimals=1),
        _real("MPC_ACC_DOWN_MAX", 3, 2, 15, "m/s^2", "Largest downward acceleration", decimals=1),
        _real("MPC_JERK_AUTO", 4, 1, 80, "m/s^3", "Jerk in automatic modes", decimals=1),
        _real("MPC_JERK_MAX", 8, 0.5, 500, "m/s^3", "Largest jerk with sticks", decimals=1),
        _real("MPC_VEL_MANUAL", 10, 0.5, 20, "m/s", "Horizontal velocity at full stick in POSCTL", decimals=1,
              note="PX4: not below 3"),
        _real("MPC_VEL_MAN_SIDE", -1, -1, 20, "m/s", "The same sideways; negative: MPC_VEL_MANUAL", decimals=1,
              used_by="client"),
        _real("MPC_VEL_MAN_BACK", -1, -1, 20, "m/s", "The same backwards; negative: MPC_VEL_MANUAL", decimals=1,
              used_by="client"),
        _choice("MPC_POS_MODE", 0, {0: "Stick is velocity", 4: "Stick is acceleration"}, "What the sticks ask for",
                note="PX4: 4", used_by="client"),
        _real("MPC_HOLD_MAX_XY", 0.8, 0, 3, "m/s", "Slower than this, a released stick holds the position",
              used_by="client"),
        _real("MPC_HOLD_MAX_Z", 0.6, 0, 3, "m/s", "Slower than this, a released stick holds the height",
              used_by="client"),
        _real("MAN_DEADZONE", 0.1, 0, 1, "norm", "Dead zone of the sticks", note="before PX4 1.17: MPC_HOLD_DZ"),
        _real("MPC_MAN_TILT_MAX", 35, 1, 70, "deg", "Tilt at full stick in STABILIZED and ALTCTL", decimals=0),
        _real("MPC_MAN_Y_MAX", 150, 0, 400, "deg/s", "Yaw rate at full stick", decimals=0),
        _real("MPC_MAN_Y_TAU", 0.08, 0, 5, "s", "Filter on the yaw stick; 0: none", used_by="client"),
        _real("MPC_MANTHR_MIN", 0.08, 0, 1, "norm", "Thrust at the lowest stick in STABILIZED"),
        _choice("MPC_THR_CURVE", 0, {0: "Hover at the middle", 1: "Linear"}, "Stick to thrust in STABILIZED",
                note="PX4 has 2"),
        _real("MPC_THR_MIN", 0.12, 0.05, 0.5, "norm", "Least thrust of the position loop"),
        _real("MPC_THR_MAX", 1, 0, 1, "norm", "Largest thrust of the position loop"),
        _real("MPC_THR_HOVER", 0.5, 0.1, 0.8, "norm", "Thrust that hovers"),
        _real("MPC_THR_XY_MARG", 0.3, 0, 0.5, "norm", "Thrust kept for horizontal control at full climb"),
        _real("MPC_TKO_SPEED", 1.5, 0.5, 5, "m/s", "Climb of a take-off", note="PX4: not below 1"),
        _real("MPC_TKO_RAMP_T", 3, 0, 5, "s", "Time in which a take-off's thrust rises", decimals=1),
        _real("MPC_LAND_SPEED", 0.7, 0.6, 5, "m/s", "Descent in AUTO.LAND", decimals=1),
        _real("MPC_LAND_CRWL", 0.3, 0.1, 5, "m/s", "Descent below MPC_LAND_ALT3", decimals=1, used_by="client"),
        _real("MPC_LAND_ALT1", 10, 0, 122, "m", "Below this height a landing slows down", decimals=1),
        _real("MPC_LAND_ALT2", 5, 0, 122, "m", "Below this height a landing has MPC_LAND_SPEED", decimals=1),
        _real("MPC_LAND_ALT3", 1, 0, 122, "m", "Below this height a landing has MPC_LAND_CRWL",
              "PX4 needs a distance sensor for it.", decimals=1, used_by="client"),
        _choice("MPC_LAND_RC_HELP", 0, {0: "Off"}, "Sticks move a landing sideways", used_by="client"),
        _choice("MPC_YAW_MODE", 0, {0: "To the waypoint", 1: "To home", 2: "Away from home", 3: "Along the path",
                                    4: "To the waypoint, turn first", 5: "As it is"},
                "Heading in automatic modes", used_by="client"),
        _real("MPC_YAWRAUTO_MAX", 60, 5, 360, "deg/s", "Largest yaw rate in automatic modes", decimals=0),
        _real("MPC_YAWRAUTO_ACC", 20, 5, 360, "deg/s^2", "Largest yaw acceleration in automatic modes", decimals=0),
    ),
    _group(
        "Sensors",
        _int("CAL_ACC0_ID", 1310988, 0, INT32_MAX, "", "Accelerometer that was calibrated", used_by="client",
             note="PX4: 0; its SITL start-up script sets this number"),
        _int("CAL_GYRO0_ID", 1310988, 0, INT32_MAX, "", "Gyroscope that was calibrated", used_by="client",
             note="PX4: 0; its SITL start-up script sets this number"),
        _int("CAL_MAG0_ID", 197388, 0, INT32_MAX, "", "Magnetometer that was calibrated", used_by="client",
             note="PX4: 0; its SITL start-up script sets this number"),
        _choice("CAL_MAG0_ROT", -1, {-1: "Internal", **_ROTATIONS}, "Rotation of the magnetometer", live="boot",
                used_by="client"),
        *(_int(f"CAL_MAG{index}_ID", 0, 0, INT32_MAX, "", f"Magnetometer {index}; 0: there is none", used_by="client")
          for index in (1, 2)),
        *(_choice(f"CAL_MAG{index}_ROT", -1, {-1: "Internal", **_ROTATIONS}, f"Rotation of magnetometer {index}",
                  live="boot", used_by="client") for index in (1, 2)),
        _int("CAL_MAG_SIDES", 63, 0, 63, "", "Sides shown to a calibration, as a bit mask", used_by="client"),
        _choice("SENS_BOARD_ROT", 0, _ROTATIONS, "Rotation of the board in the vehicle", live="boot",
                used_by="client", note="PX4: 41 rotations"),
        _real("SENS_BOARD_X_OFF", 1e-6, -45, 45, "deg", "Roll of the board", decimals=1, used_by="client",
              note="PX4: 0; its SITL start-up script sets 0.000001, which counts as levelled"),
        _real("SENS_BOARD_Y_OFF", 0, -45, 45, "deg", "Pitch of the board", decimals=1, used_by="client"),
        _real("SENS_BOARD_Z_OFF", 0, -45, 45, "deg", "Yaw of the board", decimals=1, used_by="client"),
    ),
    _group(
        "EKF2",
        _int("EKF2_NOAID_TOUT", 5_000_000, 500_000, 10_000_000, "us",
             "Position and velocity are not valid any more after so long without GPS",
             "These act with estimator.kind = \"ekf\" alone."),
        _real("EKF2_GPS_P_GATE", 5, 1, 100, "SD", "A GPS position farther off than this is refused", decimals=1),
        _real("EKF2_GPS_V_GATE", 5, 1, 100, "SD", "A GPS velocity farther off than this is refused", decimals=1),
        _real("EKF2_BARO_GATE", 5, 1, 100, "SD", "A barometer's height farther off than this is refused", decimals=1),
        _real("EKF2_MAG_GATE", 3, 1, 100, "SD", "A magnetic field farther off than this is refused", decimals=1),
    ),
    _group(
        "Radio",
        *(_choice(f"RC_MAP_{name}", 0, _CHANNELS, f"Channel of {text}", used_by="client") for name, text in (
            ("ROLL", "roll"), ("PITCH", "pitch"), ("YAW", "yaw"), ("THROTTLE", "throttle"),
            ("FLTMODE", "the mode switch"), ("RETURN_SW", "the return switch"), ("LOITER_SW", "the hold switch"),
            ("OFFB_SW", "the OFFBOARD switch"), ("KILL_SW", "the kill switch"), ("ARM_SW", "the arming switch"),
            ("AUX1", "auxiliary input 1"), ("AUX2", "auxiliary input 2"))),
        _int("RC_CHAN_CNT", 0, 0, 18, "", "Channels that were calibrated", used_by="client"),
    ),
    _group(
        "Simulation",
        _real("SIM_WIND_SPD", 0, 0, 40, "m/s", "Mean wind, added to the scenario's", decimals=1),
        _real("SIM_WIND_DIR", 0, -360, 360, "deg", "Where the mean wind comes from, clockwise from north", decimals=0),
        _switch("SIM_WIND_TURB", 0, "Dryden turbulence (MIL-F-8785C) of SIM_WIND_W20, added to the scenario's"),
        _real("SIM_WIND_W20", 10, 0.1, 40, "m/s", "Wind at 20 ft (6 m), which sets the turbulence's intensity",
              decimals=1),
        _real("SIM_NOISE_SCALE", 1, 0, 100, "", "Factor on the scenario's sensor noise",
              "Of the EKF's sensors, on the noise of each measurement; the filter is not told."),
        _int("SIM_GPS_USED", 10, 0, 50, "", "Satellites that the receiver uses",
             "Below 4 it has no fix, below 6 the filter does not use it. This and those below act with "
             "estimator.kind = \"ekf\" alone."),
        _real("SIM_GPS_JAM", 0, 0, 1, "norm", "Jamming: share of the satellites lost; noise up to 31 times as large"),
        *(_real(f"SIM_GPS_GLITCH_{axis}", 0, -100_000, 100_000, "m", f"GPS spoofed: offset {text}", decimals=1)
          for axis, text in (("N", "north"), ("E", "east"), ("D", "down"))),
        _real("SIM_BARO_OFF_P", 0, -10_000, 10_000, "Pa", "Added to the barometer's pressure", decimals=1),
        *(_real(f"SIM_MAG_OFFSET_{axis}", 0, -10, 10, "gauss", f"Added to the magnetometer's {axis} (FRD)", decimals=3)
          for axis in "XYZ"),
        *(_real(f"SIM_GYR_BIAS_{axis}", 0, -10, 10, "rad/s", f"Added to the gyro's {axis} (FRD)", decimals=3,
                note="ArduPilot: SIM_GYR1_BIAS") for axis in "XYZ"),
        *(_real(f"SIM_ACC_BIAS_{axis}", 0, -50, 50, "m/s^2", f"Added to the accelerometer's {axis} (FRD)", decimals=2,
                note="ArduPilot: SIM_ACC1_BIAS") for axis in "XYZ"),
        _real("SIM_MASS_SCALE", 1, 0.2, 5, "", "Factor on the vehicle's mass, which the controller does not know",
              "On top of the scenario's offnominal.mass_scale."),
        _switch("SIM_BAT_ENABLE", 1, "The battery drains", "Off: it stays as it is."),
        _real("SIM_BAT_DRAIN", 0, 0, 86_400, "s", "Time from full to empty in hover; 0: by capacity", decimals=0),
        _real("SIM_BAT_MIN_PCT", 50, 0, 100, "%", "The battery stops draining here", decimals=1),
        *_link("SIM_LINK", "the off-board link"),
        *_link("SIM_GLINK", "the ground stations' links"),
        *(_failure(name) for name in failures.PARAMETERS),
        *(_event(_real(name, 1, 0, 1, "norm", f"Share of its thrust that motor {motor} has",
                       "Below 1 it is the failure `wrong`, at 0 `off`."))
          for name, motor in failures.EFFICIENCIES.items()),
        _event(_real("SIM_CPU_STALL", 0, 0, 60, "s", "The autopilot does not run for so long",
                     "The rotors keep what they were commanded last; nothing is sent, and what comes is lost. It "
                     "returns to 0 by itself.", decimals=3)),
        _event(_real("SIM_CLK_JUMP", 0, -1e8, 1e8, "s", "The clock of SYSTEM_TIME goes wrong by so much",
                     "The time since boot, TIMESYNC and control go on as they are.", decimals=3)),
        _real("SIM_GUST_SPD", 3, 0, 40, "m/s", "Peak of the gust that SIM_GUST_TRIG starts", decimals=1),
        _real("SIM_GUST_DIR", 0, -360, 360, "deg", "Where that gust comes from, clockwise from north", decimals=0),
        _real("SIM_GUST_LEN", 2, 0.01, 60, "s", "From calm to that gust's peak; it falls as slowly", decimals=2),
        _event(_switch("SIM_GUST_TRIG", 0, "A 1-cosine gust blows, on top of all other wind",
                       "1 starts it, in flight only; it returns to 0 when the gust is over, and 0 ends it.")),
    ),
)
# fmt: on

TABLE: dict[str, Parameter] = {row.name: row for group in _ROWS for row in group}


class Layer(NamedTuple):
    """Values that replace defaults, and the file or place that they are from, for messages."""

    source: str
    values: Mapping[str, float]


class Parameters:
    """The values in force: the table's defaults, under the layers of airframe and scenario, under what was set since.

    An INT32 is held as an int. A REAL32 is held as given, and is float32 on the wire, in the hash and for the limits;
    writing back what was read changes nothing.
    """

    def __init__(self, *layers: Layer | Mapping[str, float]) -> None:
        """Later layers win. Raises `ScenarioError` for a name or a value that the table does not allow."""
        self.names: tuple[str, ...] = tuple(sorted(TABLE))
        """In the order of the wire's indices."""
        self._indices = {name: index for index, name in enumerate(self.names)}
        self._defaults = {name: TABLE[name].default for name in self.names}
        self._listeners: list[Listener] = []
        self._guards: list[Guard] = []
        self._hash: int | None = None
        self._locked: dict[str, str] = {}
        for layer in layers:
            source, values = layer if isinstance(layer, Layer) else ("", layer)
            for name, value in values.items():
                self._defaults[name] = checked(f"{source}: " if source else "", name, value)
        self._values = dict(self._defaults)
        self.values: Mapping[str, float] = MappingProxyType(self._values)
        """As this object itself by name; faster to read."""

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int | None:
        """Position in `names`; None: no such parameter."""
        return self._indices.get(name)

    def is_integer(self, name: str) -> bool:
        return TABLE[name].is_integer

    def as_dict(self) -> dict[str, float]:
        """All values: int for INT32, float for REAL32."""
        return dict(self._values)

    @property
    def defaults(self) -> Mapping[str, float]:
        """Those of this airframe and scenario."""
        return MappingProxyType(self._defaults)

    def changed(self) -> dict[str, float]:
        """What differs from the defaults of this airframe and scenario, volatile ones left out: what a file keeps."""
        return {
            name: value
            for name, value in self._values.items()
            if value != self._defaults[name] and not TABLE[name].volatile
        }

    def set(self, name: str, value: float) -> Refused | None:
        """A client's wish: None where it is done, otherwise why not. Nothing changes then."""
        row = TABLE.get(name)
        if row is None:
            return Refused(mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST, f"{name[:16]!a}: no such parameter")
        if row.read_only:
            return Refused(mavlink.MAV_PARAM_ERROR_READ_ONLY, f"{name}: is read-only")
        if name in self._locked:
            return Refused(mavlink.MAV_PARAM_ERROR_READ_ONLY, f"{name}: {self._locked[name]}")
        problem = row.problem(value)
        if problem is not None:
            return Refused(mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE, f"{name}: {problem}")
        for guard in self._guards:
            if problem := guard(name, value):
                return Refused(mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE, f"{name}: {problem}")
        self._store(row, value)
        return None

    def lock(self, names: Iterable[str], reason: str) -> None:
        """Clients cannot set these in this flight; `reason` is what they are told."""
        self._locked.update(dict.fromkeys(names, reason))

    def put(self, name: str, value: float) -> None:
        """The vehicle's own write, read-only parameters included. Raises ValueError for a value that is not allowed."""
        problem = TABLE[name].problem(value)
        if problem is not None:
            raise ValueError(f"{name}: {problem}")
        self._store(TABLE[name], value)

    def restore(self, values: Mapping[str, object]) -> list[str]:
        """Values from a file. What the table does not allow is left out; the texts say what and why."""
        texts = []
        for name, value in values.items():
            row = TABLE.get(name)
            if row is None or row.volatile or row.read_only:
                texts.append(f"{name[:16]!a}: is no parameter that is kept")
                continue
            problem = row.problem(value)
            if problem is not None:
                texts.append(f"{name}: {problem}")
            elif isinstance(value, int | float):
                self._store(row, value)
        return texts

    def reset(self) -> None:
        """Back to the defaults of this airframe and scenario."""
        for name in self.changed():
            self._store(TABLE[name], self._defaults[name])

    def subscribe(self, listener: Listener) -> Callable[[], None]:
        """`listener(name, value)` is called after each change, not for a value that was there already, until the
        function that is returned is called.
        """
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def guard(self, guard: Guard) -> None:
        """Ask `guard` before a client's value is taken."""
        self._guards.append(guard)

    def hash(self) -> int:
        """PX4's `_HASH_CHECK`: names and four-byte values in sorted order, volatile ones left out.

        CRC-32 with polynomial 0xEDB88320, initial value 0 and no final inversion.
        """
        if self._hash is None:
            state = 0xFFFFFFFF  # zlib inverts before and after: this begins at 0
            for name in self.names:
                row = TABLE[name]
                if not row.volatile:
                    state = crc32(name.encode(), state)
                    state = crc32(_packed(row, self._values[name]), state)
            self._hash = state ^ 0xFFFFFFFF
        return self._hash

    def _store(self, row: Parameter, value: float) -> None:
        stored = int(value) if row.is_integer else float(value)
        if _packed(row, stored) == _packed(row, self._values[row.name]):
            return
        self._values[row.name] = stored
        self._hash = None
        for listener in tuple(self._listeners):
            listener(row.name, stored)


def _packed(row: Parameter, value: float) -> bytes:
    return struct.pack("<i" if row.is_integer else "<f", value)


def checked(where: str, name: str, value: float) -> float:
    """The value as the table has it. Raises `ScenarioError`, which begins with `where`, if it does not allow it."""
    row = TABLE.get(name)
    if row is None:
        raise ScenarioError(f"{where}parameters.{name}: no such parameter; known: {', '.join(TABLE)}")
    problem = row.problem(value)
    if problem is not None:
        raise ScenarioError(f"{where}parameters.{name}: {problem}")
    return int(value) if row.is_integer else float(value)
