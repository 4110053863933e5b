"""The vehicle's plan: which mission commands it knows, whether a mission can be flown, and where in it the vehicle is.

`COMMANDS` is the one table of what a mission may hold. `action` turns an item into what the navigator has to do, with
altitudes above mean sea level. `MissionProgress` is where the vehicle is, an immutable value moved by `settle`,
`advance` and `jump_to`. `VehiclePlan` keeps plans and progress; the mission servers and the navigator share it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from math import hypot, isfinite, isinf, isnan, nan
from typing import Any, NamedTuple

from mavsitl.dialect import mavlink
from mavsitl.services.mission import (
    DEFAULT_LIMITS,
    FENCE,
    MISSION,
    NOWHERE,
    RALLY,
    MissionItem,
    MissionStatus,
    MissionStores,
    Report,
    check_item,
    same_plan,
)
from mavsitl.wire_units import from_deg_e7
from mavsitl_vehicle.autopilot.fence import (
    NO_LIMITS,
    Fence,
    FenceLimits,
    FenceProblem,
    Projection,
    check_fence_item,
    read_zones,
)

__all__ = [
    "COMMANDS",
    "Action",
    "ChangeSpeed",
    "CommandInfo",
    "Delay",
    "Effect",
    "FeasibilityContext",
    "Finding",
    "FlyTo",
    "Home",
    "Land",
    "LoiterTime",
    "LoiterToAltitude",
    "LoiterUnlimited",
    "MissionProgress",
    "PlanError",
    "RallyPoint",
    "ReturnToLaunch",
    "SetHome",
    "SetRoi",
    "Skip",
    "Step",
    "Takeoff",
    "Turn",
    "VehiclePlan",
    "action",
    "advance",
    "begin",
    "check_any_item",
    "check_mission_item",
    "feasibility",
    "following",
    "from_document",
    "jump_to",
    "rally_points",
    "settle",
    "takeoff_before",
    "to_document",
    "validate_plan",
]

ACCEPTED: int = mavlink.MAV_MISSION_ACCEPTED
UNSUPPORTED: int = mavlink.MAV_MISSION_UNSUPPORTED
UNSUPPORTED_FRAME: int = mavlink.MAV_MISSION_UNSUPPORTED_FRAME
INVALID_PARAM1: int = mavlink.MAV_MISSION_INVALID_PARAM1
INVALID_PARAM2: int = mavlink.MAV_MISSION_INVALID_PARAM2
INVALID_PARAM5_X: int = mavlink.MAV_MISSION_INVALID_PARAM5_X
INVALID_PARAM6_Y: int = mavlink.MAV_MISSION_INVALID_PARAM6_Y
INVALID_PARAM7: int = mavlink.MAV_MISSION_INVALID_PARAM7

FRAME_MISSION: int = mavlink.MAV_FRAME_MISSION
FRAME_RELATIVE: int = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT

NO_MISSION: int = mavlink.MISSION_STATE_NO_MISSION
NOT_STARTED: int = mavlink.MISSION_STATE_NOT_STARTED
ACTIVE: int = mavlink.MISSION_STATE_ACTIVE
PAUSED: int = mavlink.MISSION_STATE_PAUSED
COMPLETE: int = mavlink.MISSION_STATE_COMPLETE

TOTAL_UNKNOWN = 65535
"""MISSION_CURRENT.total where there is no mission."""
MAX_ALTITUDE_M = 100_000.0
"""Beyond it an altitude is a mistake."""
INSTANT_ITEMS_PER_SETTLE = 32
"""Instantaneous items done in one call, which bounds the work of a tick whatever a mission's jumps are."""

# ------------------------------------------------------------------------------------------------------------- commands


class Effect(Enum):
    """What a mission command does to the flight."""

    FLY = "flown"
    """takes its time"""
    INSTANT = "done at once"
    JUMP = "jump"
    """goes to another item"""
    SKIP = "accepted and skipped"


class Place(Enum):
    """Whether parameters 5 to 7 are a position."""

    NONE = "none"
    HERE = "or here"
    """latitude and longitude both 0 or both left open: where the vehicle is"""
    NEEDED = "needed"


class CommandInfo(NamedTuple):
    """`params`: what the parameters mean to this vehicle; the others are not looked at."""

    effect: Effect
    place: Place
    params: str = ""


_FLY, _INSTANT, _SKIP = Effect.FLY, Effect.INSTANT, Effect.SKIP
_NONE, _HERE, _NEEDED = Place.NONE, Place.HERE, Place.NEEDED

COMMANDS: dict[int, CommandInfo] = {
    mavlink.MAV_CMD_NAV_WAYPOINT: CommandInfo(
        _FLY, _NEEDED, "1 hold s, 2 acceptance radius m (0: NAV_ACC_RAD), 4 yaw deg (NaN: free)"
    ),
    mavlink.MAV_CMD_NAV_LOITER_UNLIM: CommandInfo(_FLY, _HERE, "4 yaw deg"),
    mavlink.MAV_CMD_NAV_LOITER_TIME: CommandInfo(_FLY, _HERE, "1 time s, 4 yaw deg"),
    mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH: CommandInfo(_FLY, _NONE),
    mavlink.MAV_CMD_NAV_LAND: CommandInfo(_FLY, _HERE, "4 yaw deg"),
    mavlink.MAV_CMD_NAV_TAKEOFF: CommandInfo(_FLY, _HERE, "4 yaw deg, 7 altitude m (NaN: MIS_TAKEOFF_ALT)"),
    mavlink.MAV_CMD_NAV_LOITER_TO_ALT: CommandInfo(_FLY, _HERE),
    mavlink.MAV_CMD_NAV_DELAY: CommandInfo(_FLY, _NONE, "1 delay s"),
    mavlink.MAV_CMD_DO_JUMP: CommandInfo(Effect.JUMP, _NONE, "1 item, 2 times (-1: for ever)"),
    mavlink.MAV_CMD_DO_CHANGE_SPEED: CommandInfo(
        _INSTANT, _NONE, "1 kind (0 air, 1 ground, 2 climb, 3 descent), 2 speed m/s (-1 no change, -2 default)"
    ),
    mavlink.MAV_CMD_DO_SET_HOME: CommandInfo(_INSTANT, _NEEDED, "1 here (1) or at the position (0)"),
    mavlink.MAV_CMD_DO_SET_ROI_LOCATION: CommandInfo(_INSTANT, _NEEDED),
    mavlink.MAV_CMD_DO_SET_ROI_NONE: CommandInfo(_INSTANT, _NONE),
    mavlink.MAV_CMD_DO_SET_ROI: CommandInfo(_INSTANT, _NEEDED, "1 kind (0 none, 3 position; 1 and 2 are skipped)"),
    mavlink.MAV_CMD_DO_LAND_START: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_DO_SET_ROI_WPNEXT_OFFSET: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_DO_CONTROL_VIDEO: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_DO_DIGICAM_CONTROL: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_DO_MOUNT_CONFIGURE: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_DO_MOUNT_CONTROL: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_DO_SET_CAM_TRIGG_DIST: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_DO_SET_CAM_TRIGG_INTERVAL: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_SET_CAMERA_MODE: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_SET_CAMERA_ZOOM: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_SET_CAMERA_FOCUS: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_SET_CAMERA_SOURCE: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_IMAGE_START_CAPTURE: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_IMAGE_STOP_CAPTURE: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_DO_TRIGGER_CONTROL: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_VIDEO_START_CAPTURE: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_VIDEO_STOP_CAPTURE: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_CONDITION_DELAY: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_CONDITION_CHANGE_ALT: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_CONDITION_DISTANCE: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_CONDITION_YAW: CommandInfo(_SKIP, _NONE),
    mavlink.MAV_CMD_CONDITION_GATE: CommandInfo(_SKIP, _NONE),
}
"""What a mission may hold; every other command is answered MAV_MISSION_UNSUPPORTED."""

_SPEED_KINDS = (0, 1, 2, 3)
_UNCHANGED, _DEFAULT = -1.0, -2.0
_ROI_NONE: int = mavlink.MAV_ROI_NONE
_ROI_LOCATION: int = mavlink.MAV_ROI_LOCATION
_ROI_KINDS = (_ROI_NONE, mavlink.MAV_ROI_WPNEXT, mavlink.MAV_ROI_WPINDEX, _ROI_LOCATION)


def _name(command: int) -> str:
    entry = mavlink.enums["MAV_CMD"].get(command)
    return entry.name.removeprefix("MAV_CMD_") if entry is not None else f"command {command}"


def _place(item: MissionItem) -> Place:
    """Whether this item has a position: two commands have one for some of their kinds only."""
    if item.command == mavlink.MAV_CMD_DO_SET_HOME and item.param1 == 1.0:
        return Place.NONE
    if item.command == mavlink.MAV_CMD_DO_SET_ROI and item.param1 != _ROI_LOCATION:
        return Place.NONE
    return COMMANDS[item.command].place


def _is_here(item: MissionItem) -> bool:
    return (item.x, item.y) in ((0, 0), (NOWHERE, NOWHERE))


def _has_position(item: MissionItem) -> bool:
    place = _place(item)
    return place is Place.NEEDED or (place is Place.HERE and not _is_here(item))


def check_mission_item(item: MissionItem) -> int:
    """MAV_MISSION_RESULT of one mission item by the table `COMMANDS`, after the checks that hold for every vehicle."""
    if item.command not in COMMANDS:
        return UNSUPPORTED
    result = _check_params(item)
    if result != ACCEPTED:
        return result
    place = _place(item)
    if place is Place.NONE:
        return ACCEPTED
    if item.frame == FRAME_MISSION:
        return UNSUPPORTED_FRAME
    if not (place is Place.HERE and _is_here(item)):
        if item.x == NOWHERE:
            return INVALID_PARAM5_X
        if item.y == NOWHERE:
            return INVALID_PARAM6_Y
    if isnan(item.z):
        open_altitude = (mavlink.MAV_CMD_NAV_TAKEOFF, mavlink.MAV_CMD_NAV_LAND)
        return ACCEPTED if item.command in open_altitude else INVALID_PARAM7
    return ACCEPTED if abs(item.z) <= MAX_ALTITUDE_M else INVALID_PARAM7


def _check_params(item: MissionItem) -> int:
    if item.command in (mavlink.MAV_CMD_NAV_LOITER_TIME, mavlink.MAV_CMD_NAV_DELAY):
        return ACCEPTED if item.param1 >= 0.0 else INVALID_PARAM1
    if item.command == mavlink.MAV_CMD_DO_JUMP:
        if not (isfinite(item.param1) and item.param1 >= 0.0 and item.param1 == int(item.param1)):
            return INVALID_PARAM1
        if not (isfinite(item.param2) and item.param2 >= -1.0 and item.param2 == int(item.param2)):
            return INVALID_PARAM2
    elif item.command == mavlink.MAV_CMD_DO_CHANGE_SPEED:
        if not isnan(item.param1) and item.param1 not in _SPEED_KINDS:
            return INVALID_PARAM1
        if not (item.param2 > 0.0 or item.param2 in (_UNCHANGED, _DEFAULT)):
            return INVALID_PARAM2
    elif item.command == mavlink.MAV_CMD_DO_SET_HOME:
        return ACCEPTED if item.param1 in (0.0, 1.0) else INVALID_PARAM1
    elif item.command == mavlink.MAV_CMD_DO_SET_ROI:
        return ACCEPTED if item.param1 in _ROI_KINDS else INVALID_PARAM1
    return ACCEPTED


def check_any_item(mission_type: int, seq: int, item: MissionItem) -> int:
    """MAV_MISSION_RESULT of one item of any of the three plans."""
    if mission_type == MISSION:
        return check_mission_item(item)
    if mission_type == RALLY:
        return ACCEPTED if abs(item.z) <= MAX_ALTITUDE_M else INVALID_PARAM7
    return check_fence_item(item)


def validate_plan(mission_type: int, items: Sequence[MissionItem]) -> tuple[int, int]:
    """MAV_MISSION_RESULT of a plan whose items are good one by one, and the item to blame.

    A fence's polygons must be complete, and a mission's jumps must lead into the mission.
    """
    if mission_type == FENCE:
        zones = read_zones(items)
        if isinstance(zones, FenceProblem):
            return zones.result, zones.seq
    elif mission_type == MISSION:
        for seq, item in enumerate(items):
            if item.command == mavlink.MAV_CMD_DO_JUMP and item.param1 >= len(items):
                return INVALID_PARAM1, seq
    return ACCEPTED, 0


# -------------------------------------------------------------------------------------------------------------- actions


class Home(NamedTuple):
    latitude_deg: float
    longitude_deg: float
    altitude_amsl_m: float


class FlyTo(NamedTuple):
    """Be within `acceptance_m` (None: NAV_ACC_RAD) for `hold_s`; `yaw_deg` is clockwise from north, None: free."""

    latitude_deg: float
    longitude_deg: float
    altitude_amsl_m: float
    hold_s: float
    acceptance_m: float | None
    yaw_deg: float | None


class Takeoff(NamedTuple):
    """Climb; latitude and longitude None: straight up. Reached by altitude alone."""

    latitude_deg: float | None
    longitude_deg: float | None
    altitude_amsl_m: float
    yaw_deg: float | None


class Land(NamedTuple):
    """Go there at the present altitude and land; None: land here."""

    latitude_deg: float | None
    longitude_deg: float | None
    yaw_deg: float | None


class ReturnToLaunch(NamedTuple):
    pass


class LoiterTime(NamedTuple):
    """Stay there (None: here) for `hold_s` from when it is reached."""

    latitude_deg: float | None
    longitude_deg: float | None
    altitude_amsl_m: float
    hold_s: float
    yaw_deg: float | None


class LoiterUnlimited(NamedTuple):
    latitude_deg: float | None
    longitude_deg: float | None
    altitude_amsl_m: float
    yaw_deg: float | None


class LoiterToAltitude(NamedTuple):
    """Go there (None: here) at the present altitude, then climb or sink; done when the altitude is reached."""

    latitude_deg: float | None
    longitude_deg: float | None
    altitude_amsl_m: float


class Delay(NamedTuple):
    """Stay as you are."""

    hold_s: float


class ChangeSpeed(NamedTuple):
    """`kind`: MAVLink's SPEED_TYPE (0 air and 1 ground are one here, 2 climb, 3 descent). None: the default again."""

    kind: int
    speed_m_s: float | None


class SetHome(NamedTuple):
    """All None: here."""

    latitude_deg: float | None
    longitude_deg: float | None
    altitude_amsl_m: float | None


class SetRoi(NamedTuple):
    """Point the nose there; all None: no more."""

    latitude_deg: float | None
    longitude_deg: float | None
    altitude_amsl_m: float | None


class Skip(NamedTuple):
    """Nothing to do for this vehicle."""

    command: int
    name: str


Action = (
    FlyTo
    | Takeoff
    | Land
    | ReturnToLaunch
    | LoiterTime
    | LoiterUnlimited
    | LoiterToAltitude
    | Delay
    | ChangeSpeed
    | SetHome
    | SetRoi
    | Skip
)


def _altitude_amsl_m(item: MissionItem, home_altitude_amsl_m: float) -> float:
    return home_altitude_amsl_m + item.z if item.frame == FRAME_RELATIVE else item.z


def _open(value: float) -> float | None:
    return None if isnan(value) else value


def action(item: MissionItem, home_altitude_amsl_m: float, takeoff_height_m: float) -> Action:
    """What to do for an item that `check_mission_item` accepts.

    Args:
        item: of a mission.
        home_altitude_amsl_m: what altitudes of frame 6 count from.
        takeoff_height_m: above home, for a take-off that names no altitude (MIS_TAKEOFF_ALT).

    A DO_JUMP gives `Skip`: `settle` resolves jumps and never stops at one.
    """
    command = item.command
    altitude_amsl_m = _altitude_amsl_m(item, home_altitude_amsl_m)
    latitude_deg, longitude_deg = from_deg_e7(item.x), from_deg_e7(item.y)
    here = _is_here(item)
    where: tuple[float | None, float | None] = (None, None) if here else (latitude_deg, longitude_deg)
    yaw_deg = _open(item.param4)
    if command == mavlink.MAV_CMD_NAV_WAYPOINT:
        hold_s = item.param1 if item.param1 > 0.0 else 0.0
        acceptance_m = item.param2 if item.param2 > 0.0 else None
        return FlyTo(latitude_deg, longitude_deg, altitude_amsl_m, hold_s, acceptance_m, yaw_deg)
    if command == mavlink.MAV_CMD_NAV_TAKEOFF:
        if isnan(item.z):
            altitude_amsl_m = home_altitude_amsl_m + takeoff_height_m
        return Takeoff(*where, altitude_amsl_m, yaw_deg)
    if command == mavlink.MAV_CMD_NAV_LAND:
        return Land(*where, yaw_deg)
    if command == mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
        return ReturnToLaunch()
    if command == mavlink.MAV_CMD_NAV_LOITER_TIME:
        return LoiterTime(*where, altitude_amsl_m, item.param1, yaw_deg)
    if command == mavlink.MAV_CMD_NAV_LOITER_UNLIM:
        return LoiterUnlimited(*where, altitude_amsl_m, yaw_deg)
    if command == mavlink.MAV_CMD_NAV_LOITER_TO_ALT:
        return LoiterToAltitude(*where, altitude_amsl_m)
    if command == mavlink.MAV_CMD_NAV_DELAY:
        return Delay(item.param1)
    if command == mavlink.MAV_CMD_DO_CHANGE_SPEED and item.param2 != _UNCHANGED:
        kind = 1 if isnan(item.param1) else int(item.param1)
        return ChangeSpeed(kind, None if item.param2 == _DEFAULT else item.param2)
    if command == mavlink.MAV_CMD_DO_SET_HOME:
        if item.param1 == 1.0:
            return SetHome(None, None, None)
        return SetHome(latitude_deg, longitude_deg, altitude_amsl_m)
    if command == mavlink.MAV_CMD_DO_SET_ROI_LOCATION or (
        command == mavlink.MAV_CMD_DO_SET_ROI and item.param1 == _ROI_LOCATION
    ):
        return SetRoi(latitude_deg, longitude_deg, altitude_amsl_m)
    if command == mavlink.MAV_CMD_DO_SET_ROI_NONE or (
        command == mavlink.MAV_CMD_DO_SET_ROI and item.param1 == _ROI_NONE
    ):
        return SetRoi(None, None, None)
    return Skip(command, _name(command))


def takeoff_before(first: Action, ground_altitude_amsl_m: float, takeoff_height_m: float) -> Takeoff | None:
    """The take-off that comes before `first` on the ground; None where it needs none.

    Missions of MAVSDK begin with a waypoint: PX4 climbs to its altitude first, at least MIS_TAKEOFF_ALT above ground.
    """
    lowest_amsl_m = ground_altitude_amsl_m + takeoff_height_m
    if isinstance(first, FlyTo | LoiterTime | LoiterUnlimited | LoiterToAltitude):
        return Takeoff(None, None, max(first.altitude_amsl_m, lowest_amsl_m), None)
    return None


class RallyPoint(NamedTuple):
    latitude_deg: float
    longitude_deg: float
    altitude_amsl_m: float


def rally_points(items: Sequence[MissionItem], home_altitude_amsl_m: float) -> tuple[RallyPoint, ...]:
    """Where a return may end besides home."""
    return tuple(
        RallyPoint(from_deg_e7(item.x), from_deg_e7(item.y), _altitude_amsl_m(item, home_altitude_amsl_m))
        for item in items
    )


# ------------------------------------------------------------------------------------------------------------- progress


@dataclass(frozen=True, slots=True)
class MissionProgress:
    """Where the vehicle is in its mission.

    Attributes:
        seq: the item that is flown or comes next.
        state: MISSION_STATE.
        jumps: (seq of a DO_JUMP, times it was taken), ordered by seq.
        waiting: the item is done and its `autocontinue` is 0: only `jump_to`, or starting again, goes on.
    """

    seq: int = 0
    state: int = NO_MISSION
    jumps: tuple[tuple[int, int], ...] = ()
    waiting: bool = False


class Step(NamedTuple):
    """`done`: the instantaneous items passed on the way, in order, to be carried out now."""

    progress: MissionProgress
    done: tuple[int, ...] = ()


def begin(items: Sequence[MissionItem], seq: int = 0) -> MissionProgress:
    """A mission that is there and not started."""
    if not items:
        return MissionProgress()
    return MissionProgress(seq=min(max(seq, 0), len(items) - 1), state=NOT_STARTED)


def _resolve(items: Sequence[MissionItem], seq: int, jumps: dict[int, int]) -> int:
    """The first item from `seq` on that is no jump; counts in `jumps`. May be beyond the end."""
    seen: set[int] = set()
    while seq < len(items) and items[seq].command == mavlink.MAV_CMD_DO_JUMP:
        item = items[seq]
        repeats = item.param2
        taken = jumps.get(seq, 0)
        # A jump met again with nothing but jumps between would go round for ever: it is passed.
        if seq in seen or (repeats >= 0.0 and taken >= repeats) or not 0.0 <= item.param1 < len(items):
            seq += 1
            continue
        seen.add(seq)
        if repeats >= 0.0:
            jumps[seq] = taken + 1
        seq = int(item.param1)
    return seq


def settle(items: Sequence[MissionItem], progress: MissionProgress) -> Step:
    """Go on from `progress.seq` to an item that is flown, past jumps and instantaneous items.

    Beyond the last item the mission is complete and stays at its last item. After `INSTANT_ITEMS_PER_SETTLE` it rests
    at an instantaneous item, and the next call goes on.
    """
    if progress.state != ACTIVE or progress.waiting:
        return Step(progress)
    jumps = dict(progress.jumps)
    done: list[int] = []
    seq = _resolve(items, progress.seq, jumps)
    while (
        seq < len(items)
        and COMMANDS[items[seq].command].effect is not Effect.FLY
        and len(done) < INSTANT_ITEMS_PER_SETTLE
    ):
        done.append(seq)
        seq = _resolve(items, seq + 1, jumps)
    if seq >= len(items):
        return Step(replace(progress, seq=max(len(items) - 1, 0), state=COMPLETE, jumps=()), tuple(done))
    return Step(replace(progress, seq=seq, jumps=tuple(sorted(jumps.items()))), tuple(done))


def advance(items: Sequence[MissionItem], progress: MissionProgress) -> MissionProgress:
    """The item that is flown is done: on to the one after it, for `settle` to look at.

    Where its `autocontinue` is 0 the mission waits, and a second call goes on. After the last item it is complete.
    """
    if progress.state != ACTIVE or not items:
        return progress
    if not items[progress.seq].autocontinue and not progress.waiting:
        return replace(progress, waiting=True)
    if progress.seq + 1 >= len(items):
        return replace(progress, state=COMPLETE, jumps=(), waiting=False)
    return replace(progress, seq=progress.seq + 1, waiting=False)


def jump_to(
    items: Sequence[MissionItem], progress: MissionProgress, seq: int, reset_jumps: bool = False
) -> MissionProgress | None:
    """The mission goes on at `seq` (which may be a jump or an instantaneous item); None where there is no such item."""
    if not 0 <= seq < len(items):
        return None
    state = NOT_STARTED if progress.state in (COMPLETE, NO_MISSION) else progress.state
    return replace(progress, seq=seq, state=state, waiting=False, jumps=() if reset_jumps else progress.jumps)


def following(items: Sequence[MissionItem], progress: MissionProgress) -> int | None:
    """The next item with a position after the current one, jumps resolved; None where there is none."""
    jumps = dict(progress.jumps)
    seq = _resolve(items, progress.seq + 1, jumps)
    for _ in items:
        if seq >= len(items):
            return None
        if _has_position(items[seq]) and COMMANDS[items[seq].command].effect is Effect.FLY:
            return seq
        seq = _resolve(items, seq + 1, jumps)
    return None


# ---------------------------------------------------------------------------------------------------------- feasibility


class Finding(NamedTuple):
    """`fatal`: the mission is not flown. `seq` is the item, None: the mission as a whole."""

    fatal: bool
    seq: int | None
    text: str


class FeasibilityContext(NamedTuple):
    """What a mission is judged against.

    Attributes:
        landed: the vehicle stands on the ground.
        home: None while unknown.
        projection: the local plane of the fence.
        fence: the zones; None: no fence at all.
        limits: GF_MAX_HOR_DIST, GF_MAX_VER_DIST.
        first_waypoint_m: MIS_DIST_1WP, from home; 0: not looked at.
        takeoff_land_required: MIS_TKO_LAND_REQ, 0 to 5 as PX4 counts.
        takeoff_height_m: MIS_TAKEOFF_ALT.
    """

    landed: bool
    home: Home | None
    projection: Projection
    fence: Fence | None = None
    limits: FenceLimits = NO_LIMITS
    first_waypoint_m: float = 10_000.0
    takeoff_land_required: int = 0
    takeoff_height_m: float = 2.5


def feasibility(items: Sequence[MissionItem], context: FeasibilityContext) -> list[Finding]:
    """Why a mission cannot be flown from here, or what looks wrong with it. Empty: all is well.

    After PX4's FeasibilityChecker: home known, no landing first on the ground, take-off above home and first, take-off
    and landing there if MIS_TKO_LAND_REQ asks for them, all positions inside the fence; a first waypoint far from home
    is a warning. Besides, a jump must not go round without an item that is flown.
    """
    if not items:
        return [Finding(True, None, "there is no mission")]
    if context.home is None:
        return [Finding(True, None, "home is not known yet")]
    return [
        *_check_takeoff_and_landing(items, context, context.home),
        *_check_jumps(items),
        *_check_positions(items, context, context.home),
    ]


def _check_takeoff_and_landing(items: Sequence[MissionItem], context: FeasibilityContext, home: Home) -> list[Finding]:
    findings: list[Finding] = []
    flown = [seq for seq, item in enumerate(items) if COMMANDS[item.command].effect is Effect.FLY]
    lands = any(items[seq].command == mavlink.MAV_CMD_NAV_LAND for seq in flown)
    takes_off = False
    located: int | None = None
    if context.landed and flown and items[flown[0]].command == mavlink.MAV_CMD_NAV_LAND:
        findings.append(Finding(True, flown[0], f"item {flown[0]}: begins with a landing, on the ground"))
    for seq in flown:
        item = items[seq]
        if item.command == mavlink.MAV_CMD_NAV_TAKEOFF:
            takes_off = True
            target = action(item, home.altitude_amsl_m, context.takeoff_height_m)
            height_m = target.altitude_amsl_m - home.altitude_amsl_m if isinstance(target, Takeoff) else 0.0
            if height_m <= 0.0:
                findings.append(Finding(True, seq, f"item {seq}: take-off to {height_m:.1f} m above home, need > 0 m"))
            if located is not None:
                name = _name(items[located].command)
                text = f"item {seq}: take-off must be the first position, item {located} is {name}"
                findings.append(Finding(True, seq, text))
        if located is None and COMMANDS[item.command].place is not Place.NONE:
            located = seq
    required = context.takeoff_land_required
    if required in (1, 3) and not takes_off:
        findings.append(Finding(True, None, f"no take-off, MIS_TKO_LAND_REQ is {required}"))
    if (required in (2, 3) or (required == 5 and not context.landed)) and not lands:
        findings.append(Finding(True, None, f"no landing, MIS_TKO_LAND_REQ is {required}"))
    if (required == 4 or (required == 5 and context.landed)) and takes_off != lands:
        have, lack = ("take-off", "landing") if takes_off else ("landing", "take-off")
        findings.append(Finding(True, None, f"{have} without {lack}, MIS_TKO_LAND_REQ is {required}"))
    return findings


def _check_jumps(items: Sequence[MissionItem]) -> list[Finding]:
    findings: list[Finding] = []
    flown_before = [0]
    for item in items:
        flown_before.append(flown_before[-1] + (COMMANDS[item.command].effect is Effect.FLY))
    for seq, item in enumerate(items):
        if item.command != mavlink.MAV_CMD_DO_JUMP or item.param2 == 0.0:
            continue
        target = int(item.param1)
        if target >= len(items):
            findings.append(Finding(True, seq, f"item {seq}: jump to item {target}, there are {len(items)}"))
        elif target <= seq and flown_before[seq] == flown_before[target]:
            findings.append(Finding(True, seq, f"item {seq}: jump to item {target} passes nothing that is flown"))
    return findings


def _check_positions(items: Sequence[MissionItem], context: FeasibilityContext, home: Home) -> list[Finding]:
    findings: list[Finding] = []
    home_north_m, home_west_m = context.projection.to_local(home.latitude_deg, home.longitude_deg)
    no_zones = Fence((), context.projection)
    fence = context.fence if context.fence is not None else no_zones
    first = True
    for seq, item in enumerate(items):
        info = COMMANDS[item.command]
        if info.effect is not Effect.FLY or info.place is Place.NONE:
            continue
        height_m = _altitude_amsl_m(item, home.altitude_amsl_m) - home.altitude_amsl_m
        if item.command == mavlink.MAV_CMD_NAV_LAND or isnan(height_m):
            height_m = 0.0
        if _is_here(item) and info.place is Place.HERE:
            # Where that will be is not known before; how high is.
            breach = no_zones.breach(home_north_m, home_west_m, height_m, home_north_m, home_west_m, context.limits)
        else:
            north_m, west_m = context.projection.to_local(from_deg_e7(item.x), from_deg_e7(item.y))
            from_home_m = hypot(north_m - home_north_m, west_m - home_west_m)
            limit_m = context.first_waypoint_m
            if first and 0.0 < limit_m <= from_home_m:
                text = f"item {seq}: first waypoint {from_home_m:.0f} m from home, more than {limit_m:.0f} m"
                findings.append(Finding(False, seq, text))
            first = False
            breach = fence.breach(north_m, west_m, height_m, home_north_m, home_west_m, context.limits)
        if breach is not None:
            findings.append(Finding(True, seq, f"item {seq}: outside the geofence: {breach.text}"))
    return findings


# ---------------------------------------------------------------------------------------------------------- persistence


class PlanError(ValueError):
    """A stored plan that cannot be used; the text says why."""


_KEYS = {MISSION: "mission", FENCE: "fence", RALLY: "rally"}
_FLOATS = ("param1", "param2", "param3", "param4", "z")


def to_document(plans: Mapping[int, Sequence[MissionItem]], seq: int = 0) -> dict[str, Any]:
    """The three plans and the current item as what JSON is made of, but for NaN, which a file has as null."""
    document: dict[str, Any] = {"current": seq}
    for mission_type, key in _KEYS.items():
        document[key] = [item._asdict() for item in plans.get(mission_type, ())]
    return document


def _read_item(where: str, entry: object) -> MissionItem:
    if not isinstance(entry, dict) or set(entry) != set(MissionItem._fields):
        raise PlanError(f"{where}: needs exactly {', '.join(MissionItem._fields)}")
    values: list[float] = []
    for name in MissionItem._fields:
        value = entry[name]
        if name in _FLOATS:
            value = nan if value is None else value
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise PlanError(f"{where}: {name} is no number")
            try:
                value = float(value)
            except OverflowError:
                raise PlanError(f"{where}: {name} is too large") from None
            if isinf(value):
                raise PlanError(f"{where}: {name} is infinite")
        elif isinstance(value, bool) or not isinstance(value, int):
            raise PlanError(f"{where}: {name} is no integer")
        values.append(value)
    item = MissionItem._make(values)
    if not (0 <= item.command <= 65535 and 0 <= item.autocontinue <= 255 and item.frame in (2, 5, 6)):
        raise PlanError(f"{where}: command {item.command}, frame {item.frame}, autocontinue {item.autocontinue}")
    if not all(-(2**31) <= value <= NOWHERE for value in (item.x, item.y)):
        raise PlanError(f"{where}: x or y is no 32-bit integer")
    return item


def from_document(
    document: Mapping[str, object], limits: Mapping[int, int] = DEFAULT_LIMITS
) -> tuple[dict[int, tuple[MissionItem, ...]], int]:
    """The plans by mission type, and the current item, checked as an upload is.

    Raises:
        PlanError: it is no such document, or a plan in it would be refused as an upload.
    """
    plans: dict[int, tuple[MissionItem, ...]] = {}
    for mission_type, key in _KEYS.items():
        entries = document.get(key)
        if not isinstance(entries, list) or len(entries) > limits[mission_type]:
            raise PlanError(f"{key}: needs a list of at most {limits[mission_type]} items")
        items = tuple(_read_item(f"{key}[{seq}]", entry) for seq, entry in enumerate(entries))
        for seq, item in enumerate(items):
            result = check_item(mission_type, item) or check_any_item(mission_type, seq, item)
            if result != ACCEPTED:
                raise PlanError(f"{key}[{seq}]: refused with MAV_MISSION_RESULT {result}")
        result, blamed = validate_plan(mission_type, items)
        if result != ACCEPTED:
            raise PlanError(f"{key}[{blamed}]: refused with MAV_MISSION_RESULT {result}")
        plans[mission_type] = items
    current = document.get("current")
    if isinstance(current, bool) or not isinstance(current, int) or not 0 <= current < max(len(plans[MISSION]), 1):
        raise PlanError("current: no item of the mission")
    return plans, current


# ---------------------------------------------------------------------------------------------------- the vehicle's own


class Turn(NamedTuple):
    """What the navigator does now.

    Attributes:
        instants: to be carried out at once, in order.
        seq: the item to fly; None where the mission waits, is complete or not active.
        fly: what to do for it; None with `seq`.
    """

    instants: tuple[Action, ...]
    seq: int | None
    fly: Action | None


def _ignore(*_: object) -> None:
    pass


class VehiclePlan:
    """Plans and progress of one vehicle, shared by the mission servers of its links and the navigator.

    The navigator calls `start` on entering mission mode, `turn` in every tick there, `advance` when the item is done,
    and `pause` on leaving. `revision` changes whenever something else is to be flown than before.

    Attributes:
        stores: for `mavsitl.services.mission.MissionServer`.
        progress: where the vehicle is.
        in_mission_mode: told in MISSION_CURRENT.mission_mode; the owner sets it.
        revision: counts uploads, jumps, starts and items done.
    """

    def __init__(
        self,
        report: Report = _ignore,
        limits: Mapping[int, int] = DEFAULT_LIMITS,
        changed: Callable[[int], None] = _ignore,
    ) -> None:
        """`report(severity, text)` goes out as STATUSTEXT, `changed(mission_type)` is called after a plan changed."""
        self.progress = MissionProgress()
        self.in_mission_mode = False
        self.revision = 0
        self._changed = changed
        self._mission: tuple[MissionItem, ...] = ()
        self.stores = MissionStores(
            limits,
            check=check_any_item,
            validate=validate_plan,
            changed=self._on_changed,
            set_current=self.jump_to,
            status=self.status,
            report=report,
        )

    @property
    def mission(self) -> tuple[MissionItem, ...]:
        return self._mission

    def status(self) -> MissionStatus:
        """For MISSION_CURRENT."""
        total = len(self._mission) or TOTAL_UNKNOWN
        return MissionStatus(self.progress.seq, total, self.progress.state, 1 if self.in_mission_mode else 2)

    def feasibility(self, context: FeasibilityContext) -> list[Finding]:
        """See `feasibility`."""
        return feasibility(self._mission, context)

    def fence(self, projection: Projection) -> Fence:
        """The fence in force on a local plane; make it anew when `stores.id(FENCE)` or the plane changes."""
        zones = read_zones(self.stores.items(FENCE))
        # Stored fences have been validated.
        return Fence(() if isinstance(zones, FenceProblem) else zones, projection)

    def rally_points(self, home_altitude_amsl_m: float) -> tuple[RallyPoint, ...]:
        """See `rally_points`."""
        return rally_points(self.stores.items(RALLY), home_altitude_amsl_m)

    def start(self) -> bool:
        """Fly: go on where it was paused or waits, from the beginning where it was complete. False: no mission."""
        if not self._mission:
            return False
        progress = begin(self._mission) if self.progress.state == COMPLETE else self.progress
        progress = replace(progress, state=ACTIVE)
        self._move(advance(self._mission, progress) if progress.waiting else progress)
        return True

    def pause(self) -> None:
        """Mission mode was left: an active mission is paused where it is."""
        if self.progress.state == ACTIVE:
            self._move(replace(self.progress, state=PAUSED))

    def jump_to(self, seq: int, reset_jumps: bool = False) -> bool:
        """MISSION_SET_CURRENT and MAV_CMD_DO_SET_MISSION_CURRENT; False where there is no such item."""
        progress = jump_to(self._mission, self.progress, seq, reset_jumps)
        if progress is None:
            return False
        self._move(progress)
        return True

    def turn(self, home_altitude_amsl_m: float, takeoff_height_m: float) -> Turn:
        """Go past jumps and instantaneous items, which count as reached, to the item that is flown."""
        step = settle(self._mission, self.progress)
        if step.progress != self.progress:
            self._move(step.progress)
        for seq in step.done:
            self.stores.reached(seq)
        instants = tuple(action(self._mission[seq], home_altitude_amsl_m, takeoff_height_m) for seq in step.done)
        progress = self.progress
        if progress.state != ACTIVE or progress.waiting:
            return Turn(instants, None, None)
        item = self._mission[progress.seq]
        if COMMANDS[item.command].effect is not Effect.FLY:
            return Turn(instants, None, None)
        return Turn(instants, progress.seq, action(item, home_altitude_amsl_m, takeoff_height_m))

    def advance(self) -> None:
        """The item that is flown is done: it is reported as reached, and the next `turn` gives what comes then."""
        if self.progress.state != ACTIVE or self.progress.waiting:
            return
        self.stores.reached(self.progress.seq)
        self._move(advance(self._mission, self.progress))

    def following(self, home_altitude_amsl_m: float, takeoff_height_m: float) -> Action | None:
        """What is flown to after the current item, for the heading and for not stopping; None: nothing."""
        seq = following(self._mission, self.progress)
        return None if seq is None else action(self._mission[seq], home_altitude_amsl_m, takeoff_height_m)

    def to_document(self) -> dict[str, Any]:
        """See `to_document`."""
        plans = {mission_type: self.stores.items(mission_type) for mission_type in _KEYS}
        return to_document(plans, self.progress.seq)

    def load_document(self, document: Mapping[str, object]) -> None:
        """Put stored plans into force. Raises `PlanError`, and then nothing has changed."""
        plans, seq = from_document(document, self.stores.limits)
        for mission_type, items in plans.items():
            self.stores.replace(mission_type, items, seq if mission_type == MISSION else 0)

    def _move(self, progress: MissionProgress) -> None:
        self.progress = progress
        self.revision += 1

    def _on_changed(self, mission_type: int, start_seq: int) -> None:
        if mission_type == MISSION:
            items = self.stores.items(MISSION)
            # The same mission uploaded once more in flight does not send the vehicle back to its beginning.
            keep = self.progress.state in (ACTIVE, PAUSED) and same_plan(items, self._mission)
            self._mission = items
            if not keep:
                self._move(begin(items, start_seq))
        self._changed(mission_type)
