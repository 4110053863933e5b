"""Flying a mission: each item of the plan as a task of the navigator, and when it is done."""

from __future__ import annotations

from math import atan2, hypot, isfinite, nan, radians
from typing import Protocol

from mavsitl.dialect import mavlink
from mavsitl.frames import Vector
from mavsitl_vehicle.autopilot.navigator import Navigator
from mavsitl_vehicle.autopilot.plan import (
    Action,
    ChangeSpeed,
    Delay,
    FlyTo,
    Land,
    LoiterTime,
    LoiterToAltitude,
    LoiterUnlimited,
    ReturnToLaunch,
    SetHome,
    SetRoi,
    Takeoff,
    VehiclePlan,
    takeoff_before,
)  # fmt: skip
from mavsitl_vehicle.autopilot.position import Values
from mavsitl_vehicle.autopilot.setpoints import State

NOT_STARTED: int = mavlink.MISSION_STATE_NOT_STARTED
ACTIVE: int = mavlink.MISSION_STATE_ACTIVE
COMPLETE: int = mavlink.MISSION_STATE_COMPLETE
ADVANCE_US = 100_000
"""Between two items at least: a loop of items that take no time floods nobody with MISSION_ITEM_REACHED."""
YAW_TIMEOUT_US = 5_000_000
"""A heading that is not reached does not hold the mission up for longer."""


class World(Protocol):
    """What a mission needs besides the plan: the earth, and home."""

    @property
    def home_altitude_amsl_m(self) -> float: ...

    @property
    def ground_altitude_amsl_m(self) -> float: ...

    @property
    def mission_refusal(self) -> str | None: ...

    @property
    def on_ground(self) -> bool: ...

    def height_of(self, altitude_amsl_m: float, /) -> float: ...

    def local_at(self, latitude_deg: float, longitude_deg: float, /) -> tuple[float, float]: ...

    def set_home_here(self) -> None: ...

    def set_home(
        self, latitude_deg: float, longitude_deg: float, altitude_amsl_m: float, yaw_deg: float, /
    ) -> None: ...


class MissionCourse:
    """The navigator's `Course` over a `VehiclePlan`."""

    def __init__(self, plan: VehiclePlan, parameters: Values, world: World) -> None:
        self._plan = plan
        self._parameters = parameters
        self._world = world
        self._revision = -1
        self._action: Action | None = None
        self._lifting: Takeoff | None = None
        """The climb from the ground that comes before an item which has none."""
        self._reached_us: int | None = None
        self._arrived_us: int | None = None
        self._yaw_rad = nan
        self._lowering = False
        self._roi: Vector | None = None
        self._advanced_us = -ADVANCE_US

    def begin(self, navigator: Navigator, now_us: int) -> None:
        self._plan.in_mission_mode = True
        if self._plan.progress.state in (NOT_STARTED, COMPLETE):
            self._roi = None
        self._plan.start()
        self._revision = -1

    def pause(self) -> None:
        self._plan.in_mission_mode = False
        self._plan.pause()

    def step(self, navigator: Navigator, state: State, now_us: int) -> None:
        if self._plan.revision != self._revision:
            self._take_up(navigator, state, now_us)
        if self._roi is not None:
            x, y, _ = state.position_nwu_m
            navigator.look_at(atan2(self._roi[1] - y, self._roi[0] - x))
        action = self._action
        if action is None:
            return
        if self._lifting is not None:
            if navigator.takeoff_done(state):
                self._lifting = None
                self._start(action, navigator, state, now_us)
        elif self._done(action, navigator, state, now_us) and now_us - self._advanced_us >= ADVANCE_US:
            self._advanced_us = now_us
            self._plan.advance()

    def _take_up(self, navigator: Navigator, state: State, now_us: int) -> None:
        """The plan says something else than before: carry out what is done at once, begin what is flown."""
        if self._plan.progress.state == NOT_STARTED and self._world.mission_refusal is None:
            self._roi = None
            self._plan.start()  # another mission was uploaded in flight
        turn = self._plan.turn(self._world.home_altitude_amsl_m, self._parameters["MIS_TAKEOFF_ALT"])
        self._revision = self._plan.revision
        for instant in turn.instants:
            self._do(instant, navigator)
        self._reached_us = self._arrived_us = None
        self._lifting = None
        self._lowering = False
        self._action = turn.fly
        if turn.fly is None:
            progress = self._plan.progress
            if progress.state == ACTIVE and not progress.waiting:
                self._revision = -1  # more instantaneous items than one call does: on in the next period
            # Complete, or waiting at an item that does not continue: it goes all the way to that item.
            if self._plan.progress.state not in (ACTIVE, COMPLETE):
                navigator.hold()
            return
        if self._world.on_ground:
            height = self._parameters["MIS_TAKEOFF_ALT"]
            self._lifting = takeoff_before(turn.fly, self._world.ground_altitude_amsl_m, height)
        if self._lifting is not None:
            navigator.take_off(self._world.height_of(self._lifting.altitude_amsl_m), None)
        else:
            self._start(turn.fly, navigator, state, now_us)

    def _start(self, action: Action, navigator: Navigator, state: State, now_us: int) -> None:
        world = self._world
        self._yaw_rad = nan
        if isinstance(action, Takeoff):
            position = self._where(action.latitude_deg, action.longitude_deg)
            navigator.take_off(world.height_of(action.altitude_amsl_m), position, _yaw(action.yaw_deg))
        elif isinstance(action, FlyTo | LoiterTime | LoiterUnlimited):
            x, y = self._where(action.latitude_deg, action.longitude_deg) or state.position_nwu_m[:2]
            self._yaw_rad = _yaw(action.yaw_deg)
            heading = self._yaw_rad
            if not isfinite(heading):
                heading = self._heading_to(x, y, state)
            navigator.fly_to((x, y, world.height_of(action.altitude_amsl_m)), heading)
        elif isinstance(action, LoiterToAltitude):
            x, y = self._where(action.latitude_deg, action.longitude_deg) or state.position_nwu_m[:2]
            navigator.fly_to((x, y, state.position_nwu_m[2]), self._heading_to(x, y, state))
        elif isinstance(action, Land):
            position = self._where(action.latitude_deg, action.longitude_deg)
            if position is None:
                navigator.descend()
                self._lowering = True
            else:
                navigator.fly_to((*position, state.position_nwu_m[2]), _yaw(action.yaw_deg))
        elif isinstance(action, ReturnToLaunch):
            navigator.begin_return(state)
        elif isinstance(action, Delay):
            self._reached_us = now_us

    def _done(self, action: Action, navigator: Navigator, state: State, now_us: int) -> bool:
        parameters = self._parameters
        if isinstance(action, Takeoff):
            if not navigator.takeoff_done(state):
                return False
            position = self._where(action.latitude_deg, action.longitude_deg)
            if position is None:
                return True
            if self._arrived_us is None:
                self._arrived_us = now_us
                navigator.fly_to((*position, self._world.height_of(action.altitude_amsl_m)))
            return navigator.reached(state, parameters["NAV_ACC_RAD"])
        if isinstance(action, FlyTo):
            acceptance = action.acceptance_m if action.acceptance_m is not None else parameters["NAV_ACC_RAD"]
            return self._stayed(action.hold_s, acceptance, navigator, state, now_us)
        if isinstance(action, LoiterTime):
            return self._stayed(action.hold_s, parameters["NAV_ACC_RAD"], navigator, state, now_us)
        if isinstance(action, LoiterToAltitude):
            if not navigator.reached(state, parameters["NAV_ACC_RAD"]):
                return False
            if not self._lowering:
                self._lowering = True
                x, y, _ = navigator.aim_nwu_m
                navigator.fly_to((x, y, self._world.height_of(action.altitude_amsl_m)))
                return False
            return True
        if isinstance(action, Land):
            if not self._lowering and navigator.reached(state, 1.0):
                self._lowering = True
                navigator.descend(self._where(action.latitude_deg, action.longitude_deg))
            return self._lowering and self._world.on_ground
        if isinstance(action, ReturnToLaunch):
            navigator.step_return(state, now_us)
            return self._world.on_ground
        if isinstance(action, Delay):
            return self._reached_us is not None and now_us - self._reached_us >= action.hold_s * 1e6
        return False  # LoiterUnlimited

    def _stayed(self, hold_s: float, acceptance_m: float, navigator: Navigator, state: State, now_us: int) -> bool:
        """Within the acceptance radius, the heading reached if one was asked for, and held for its time."""
        if self._arrived_us is None:
            if not navigator.reached(state, acceptance_m):
                return False
            self._arrived_us = now_us
        if self._reached_us is None:
            turned = navigator.yaw_reached(state, self._yaw_rad) or now_us - self._arrived_us >= YAW_TIMEOUT_US
            if not turned:
                return False
            self._reached_us = now_us
        return now_us - self._reached_us >= hold_s * 1e6

    def _do(self, action: Action, navigator: Navigator) -> None:
        if isinstance(action, ChangeSpeed):
            navigator.set_speed(action.kind, nan if action.speed_m_s is None else action.speed_m_s)
        elif isinstance(action, SetHome):
            if action.latitude_deg is None or action.longitude_deg is None or action.altitude_amsl_m is None:
                self._world.set_home_here()
            else:
                self._world.set_home(action.latitude_deg, action.longitude_deg, action.altitude_amsl_m, nan)
        elif isinstance(action, SetRoi):
            where = self._where(action.latitude_deg, action.longitude_deg)
            if where is None or action.altitude_amsl_m is None:
                self._roi = None
            else:
                self._roi = (*where, self._world.height_of(action.altitude_amsl_m))

    def _where(self, latitude_deg: float | None, longitude_deg: float | None) -> tuple[float, float] | None:
        if latitude_deg is None or longitude_deg is None:
            return None
        return self._world.local_at(latitude_deg, longitude_deg)

    def _heading_to(self, x: float, y: float, state: State) -> float:
        """Along the way, where it is long enough to have a direction."""
        px, py, _ = state.position_nwu_m
        return atan2(y - py, x - px) if hypot(x - px, y - py) > 1.0 else nan


def _yaw(yaw_deg: float | None) -> float:
    """From clockwise degrees; None and NaN: free."""
    return nan if yaw_deg is None else -radians(yaw_deg)
