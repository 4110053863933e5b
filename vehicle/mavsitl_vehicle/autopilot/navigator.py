"""What the vehicle does by itself: take off, hold, go somewhere, circle, return, land, and the items of a mission.

A step machine without a clock of its own: it is told which mode flies and where the vehicle is, and gives one
`PositionSetpoint` a control period. World NWU, metres over the local origin; headings counter-clockwise from north.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, auto
from math import atan2, cos, hypot, inf, isfinite, nan, pi, radians, sin, tan
from typing import Protocol

from mavsitl.frames import Vector
from mavsitl_vehicle.autopilot.modes import Mode
from mavsitl_vehicle.autopilot.position import Values
from mavsitl_vehicle.autopilot.setpoints import FREE, PositionSetpoint, State
from mavsitl_vehicle.autopilot.trajectory import SERVO_PER_S, Trajectory, landing_speed, takeoff_climb_limit

REACHED_SHARE = 0.95
"""Of a take-off's height: then it is done, as clients see it by relative_alt."""
REACHED_M = 0.3
"""Vertical distance that counts as arrived."""
YAW_REACHED_RAD = radians(10.0)
MIN_TAKEOFF_HEIGHT_M = 0.5
DEFAULT_ORBIT_RADIUS_M, DEFAULT_ORBIT_SPEED_M_S = 10.0, 2.0
ORBIT_ACCELERATION_M_S2 = 3.0
"""Largest centripetal acceleration of an orbit."""
BLIND_DESCENT_M_S2 = 0.3
"""Less acceleration than hovering takes: the descent where not even the height is known, as PX4's."""
ORBIT_GAIN_PER_S = 0.5
"""Distance from the circle to the speed back to it."""


class Task(Enum):
    """What is being done, whichever mode asked for it."""

    HOLD = auto()
    TAKEOFF = auto()
    GO = auto()
    DESCEND = auto()
    SINK = auto()
    ORBIT = auto()
    RETURN = auto()


class Home(Protocol):
    @property
    def position_nwu_m(self) -> Vector: ...

    @property
    def yaw_rad(self) -> float: ...


class Course(Protocol):
    """A mission as the navigator flies it, see `mission.py`."""

    def begin(self, navigator: Navigator, now_us: int) -> None:
        """The mode has become AUTO.MISSION: take up the current item."""

    def step(self, navigator: Navigator, state: State, now_us: int) -> None:
        """Look whether the item is done, and take up the next."""

    def pause(self) -> None:
        """Another mode flies."""


class ReturnPhase(Enum):
    CLIMB = auto()
    CRUISE = auto()
    LOWER = auto()
    WAIT = auto()
    LAND = auto()


class Navigator:
    """`enter` when a mode of its own begins to fly, `update` once a period while it does."""

    def __init__(
        self, parameters: Values, gravity_m_s2: float, period_s: float, course: Course, say: Callable[[str], None]
    ) -> None:
        self.home: Home | None = None
        self.rally_nwu_m: tuple[Vector, ...] = ()
        """Where a return may end besides home; the heights are the least of the way there."""
        self.landing = False
        """It descends to touch down: what the landing detector may believe."""
        self.finished: Mode | None = None
        """The mode whose task was completed, until `enter`."""
        self._parameters = parameters
        self._gravity = gravity_m_s2
        self._motion = Trajectory(parameters, period_s)
        self._course = course
        self._say = say
        self._mode: Mode | None = None
        self._task = Task.HOLD
        self._takeoff_height: float | None = None
        self._takeoff_position: tuple[float, float] | None = None
        self._takeoff_yaw_rad: float | None = None
        self._interrupted: tuple[float, tuple[float, float] | None] | None = None
        """Height and place of a take-off that a fail-safe broke off."""
        self._takeoff_asked = False
        """By parameters of its own, which no take-off has followed yet."""
        self._target_height = 0.0
        self._ground_height = 0.0
        self._lift_us: int | None = None
        self._ramping = False
        """The mode began on the ground: its first climb is a take-off's."""
        self._speed = nan
        self._climb = nan
        self._sink = nan
        self._go_speed = nan
        self._pending_go: tuple[Vector, float, float] | None = None
        self._orbit: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
        """Centre x, y, height, radius (negative: counter-clockwise seen from above), speed."""
        self._pending_orbit: tuple[tuple[float, float] | None, float, float, float] | None = None
        self._return = ReturnPhase.CLIMB
        self._return_xy_m = (0.0, 0.0)
        self._return_yaw_rad = nan
        self._wait_us = 0

    # --- what a command asks for, before or while its mode flies -----------------------------------------------------

    def set_takeoff(
        self, height_m: float | None, position_xy_m: tuple[float, float] | None, yaw_rad: float | None
    ) -> None:
        """NAV_TAKEOFF's parameters; None: MIS_TAKEOFF_ALT over the ground, straight up, the heading it has."""
        self._takeoff_height, self._takeoff_position, self._takeoff_yaw_rad = height_m, position_xy_m, yaw_rad
        self._takeoff_asked = True

    def go_to(self, position_nwu_m: Vector, yaw_rad: float = nan, speed_m_s: float = nan) -> None:
        """DO_REPOSITION in AUTO.LOITER: fly there and hold. NaN: here, this height, the heading as it is."""
        if self._mode is Mode.LOITER:
            self._fly_to(position_nwu_m, yaw_rad, speed_m_s)
        else:
            self._pending_go = (position_nwu_m, yaw_rad, speed_m_s)

    def set_orbit(
        self, centre_xy_m: tuple[float, float] | None, height_m: float, radius_m: float, speed_m_s: float
    ) -> None:
        """DO_ORBIT: clockwise seen from above for a positive radius. None, NaN: around here, this height, defaults."""
        self._pending_orbit = (centre_xy_m, height_m, radius_m, speed_m_s)

    def set_speed(self, kind: int, speed_m_s: float) -> None:
        """DO_CHANGE_SPEED: SPEED_TYPE 0 and 1 horizontal, 2 climb, 3 descent; NaN: the parameters' again."""
        if kind == 2:
            self._climb = speed_m_s
        elif kind == 3:
            self._sink = speed_m_s
        else:
            self._speed = speed_m_s
        if self._task in (Task.GO, Task.RETURN):
            self._aim_again()

    # --- a period ----------------------------------------------------------------------------------------------------

    def enter(
        self,
        mode: Mode,
        state: State,
        acceleration_nwu_m_s2: Vector,
        on_ground: bool,
        now_us: int,
        *,
        by_failsafe: bool = False,
    ) -> None:
        """`mode` flies from now on, from the vehicle's own motion: no jump.

        A take-off that a fail-safe interrupts (`by_failsafe`) goes on to its own height when the fail-safe has ended.
        """
        if self._mode is Mode.TAKEOFF and self._task is Task.TAKEOFF and by_failsafe:
            self._interrupted = (self._target_height, self._takeoff_position)
        if self._mode is Mode.MISSION and mode is not Mode.MISSION:
            self._course.pause()
        arrived = self.finished is Mode.TAKEOFF and mode is Mode.LOITER and self._pending_go is None
        self._mode = mode
        self.finished = None
        if mode is not Mode.TAKEOFF and not by_failsafe:
            self._interrupted = None
        if mode is not Mode.TAKEOFF:
            self._takeoff_height = self._takeoff_yaw_rad = None
            self._takeoff_asked = False
        if mode in (Mode.TAKEOFF, Mode.RTL, Mode.LAND, Mode.DESCEND):
            self._forget_speeds()
        if arrived:
            self._stay_up()
            return
        self._motion.engage(state, acceleration_nwu_m_s2)
        self._hold()
        self._ramping = on_ground
        if on_ground:
            self._ground_height = state.position_nwu_m[2]
            self._lift_us = None
        if mode is Mode.TAKEOFF:
            self._begin_takeoff(state)
        elif mode is Mode.LOITER:
            if self._pending_go is not None:
                self._fly_to(*self._pending_go)
        elif mode is Mode.LAND:
            self.descend()
        elif mode is Mode.DESCEND:
            self._task = Task.SINK
            self.landing = True
        elif mode is Mode.RTL:
            self.begin_return(state)
        elif mode is Mode.ORBIT:
            self._begin_orbit(state)
        elif mode is Mode.MISSION:
            self._course.begin(self, now_us)
        self._pending_go = self._pending_orbit = None

    def leave(self) -> None:
        """Somebody else flies."""
        if self._mode is Mode.MISSION:
            self._course.pause()
        self._mode = None
        self.landing = False
        self.finished = None
        self._interrupted = None
        self._pending_go = self._pending_orbit = None
        self._forget_speeds()

    def stand(self, state: State, now_us: int) -> None:
        """A period on the ground, in which a mission's first item is taken up, and a landing is seen to be done."""
        if not self.wants_lift():
            self._motion.engage(state)
            self._ramping = True
            self._lift_us = None
        if self._mode is Mode.MISSION:
            self._course.step(self, state, now_us)

    def wants_lift(self) -> bool:
        """On the ground: should the rotors lift?"""
        return self._task in (Task.TAKEOFF, Task.GO)

    def update(self, state: State, now_us: int) -> tuple[PositionSetpoint, float]:
        """The setpoint and the largest climb, m/s: while it lifts off, the ramp's."""
        if self._mode is Mode.MISSION:
            self._course.step(self, state, now_us)
        elif self._mode is Mode.RTL:
            self.step_return(state, now_us)
        elif self._mode is Mode.TAKEOFF:
            if self._takeoff_asked:  # NAV_TAKEOFF once more
                self._begin_takeoff(state)
            if self.takeoff_done(state):
                self.finished = Mode.TAKEOFF
        elif self._mode is Mode.ORBIT and self._pending_orbit is not None:
            self._begin_orbit(state)
            self._pending_orbit = None
        if self._task is Task.SINK:
            return self._sinking(state), inf
        if self._task is Task.ORBIT:
            self._circle(state)
        elif self._task is Task.DESCEND:
            self._motion.climb(-landing_speed(state.position_nwu_m[2] - self._ground_under(), self._parameters))
        limit = inf
        if self._ramping and self.wants_lift():
            if self._lift_us is None:
                self._lift_us = now_us
            limit = takeoff_climb_limit((now_us - self._lift_us) / 1e6, self._gravity, self._parameters)
        return self._motion.update(state.position_nwu_m), limit

    # --- tasks, for the modes and for a mission's items --------------------------------------------------------------

    def hold(self) -> None:
        """Brake and stay."""
        self._motion.stop()
        self._hold()

    def fly_to(self, position_nwu_m: Vector, yaw_rad: float = nan) -> None:
        """At the speeds in force, and stay."""
        self._fly_to(position_nwu_m, yaw_rad, nan)

    def take_off(self, height_m: float, position_xy_m: tuple[float, float] | None, yaw_rad: float = nan) -> None:
        """Straight up, and then to the position where one is given."""
        self._task = Task.TAKEOFF
        self.landing = False
        self._target_height = height_m
        self._motion.turn_to(yaw_rad)
        speed = self._parameters["MPC_TKO_SPEED"]
        self._motion.go_to((nan, nan, height_m), climb_m_s=speed)
        self._takeoff_position = position_xy_m

    def descend(self, position_xy_m: tuple[float, float] | None = None) -> None:
        """Sink to the ground, here or over a position that is reached already."""
        self._task = Task.DESCEND
        self.landing = True
        if position_xy_m is not None:
            self._motion.go_to((*position_xy_m, nan), speed_m_s=self._speed)

    def reached(self, state: State, acceptance_m: float) -> bool:
        """Is the vehicle where it was sent, in height too?"""
        x, y, z = self._motion.aim_nwu_m
        px, py, pz = state.position_nwu_m
        return hypot(px - x, py - y) <= acceptance_m and abs(pz - z) <= max(REACHED_M, acceptance_m * 0.25)

    def yaw_reached(self, state: State, yaw_rad: float) -> bool:
        """NaN is reached anywhere."""
        error = state.yaw_rad - yaw_rad
        return not isfinite(error) or abs(atan2(sin(error), cos(error))) <= YAW_REACHED_RAD

    def takeoff_done(self, state: State) -> bool:
        height = self._target_height - self._ground_height
        return state.position_nwu_m[2] - self._ground_height >= REACHED_SHARE * height

    @property
    def aim_nwu_m(self) -> Vector:
        """The point flown to."""
        return self._motion.aim_nwu_m

    def look_at(self, yaw_rad: float) -> None:
        """Turn the nose, on the way too."""
        self._motion.turn_to(yaw_rad)

    # --- the modes' own ----------------------------------------------------------------------------------------------

    def _hold(self) -> None:
        self._task = Task.HOLD
        self.landing = False

    def _fly_to(self, position_nwu_m: Vector, yaw_rad: float, speed_m_s: float) -> None:
        self._task = Task.GO
        self.landing = False
        self._go_speed = speed_m_s
        x, y, z = position_nwu_m
        if not (isfinite(x) and isfinite(y)) and not isfinite(z):
            self._motion.stop()
            self._hold()
        elif not isfinite(z):
            self._motion.climb(0.0)
        self._motion.go_to(
            position_nwu_m, yaw_rad, speed_m_s=speed_m_s if isfinite(speed_m_s) else self._speed,
            climb_m_s=self._climb, sink_m_s=self._sink,
        )  # fmt: skip

    def _aim_again(self) -> None:
        speed = self._go_speed if isfinite(self._go_speed) else self._speed
        self._motion.go_to(self._motion.aim_nwu_m, speed_m_s=speed, climb_m_s=self._climb, sink_m_s=self._sink)

    def _begin_takeoff(self, state: State) -> None:
        base = self._ground_under()
        if self._interrupted is not None and not self._takeoff_asked:
            self._takeoff_height, self._takeoff_position = self._interrupted
        self._interrupted = None
        height = self._takeoff_height
        if height is None:
            height = base + self._parameters["MIS_TAKEOFF_ALT"]
        here = state.position_nwu_m[2]
        if height < here + MIN_TAKEOFF_HEIGHT_M:
            height = here + MIN_TAKEOFF_HEIGHT_M if here - base < MIN_TAKEOFF_HEIGHT_M else here
            self._say(f"Already higher than the take-off altitude, using {height - base:.1f} m over the ground")
        yaw = self._takeoff_yaw_rad
        self.take_off(height, self._takeoff_position, nan if yaw is None else yaw)
        self._takeoff_height = self._takeoff_yaw_rad = None
        self._takeoff_asked = False

    def _stay_up(self) -> None:
        """A take-off has arrived, all but its last share: on to its very height, or to the place that it named."""
        position, self._takeoff_position = self._takeoff_position, None
        self._hold()
        if position is not None:
            self._fly_to((*position, self._target_height), nan, nan)

    def _forget_speeds(self) -> None:
        """DO_CHANGE_SPEED holds for what is flown until somebody else flies, or another flight, a return begins."""
        self._speed = self._climb = self._sink = nan

    def _sinking(self, state: State) -> PositionSetpoint:
        """Level, wherever the wind takes it; downwards by the height, or without one by less thrust than it hovers."""
        if not isfinite(state.velocity_nwu_m_s[2]):
            return PositionSetpoint(acceleration_nwu_m_s2=(0.0, 0.0, -BLIND_DESCENT_M_S2))
        self._motion.climb(-landing_speed(state.position_nwu_m[2] - self._ground_under(), self._parameters))
        motion = self._motion.update(state.position_nwu_m)
        return PositionSetpoint(
            (nan, nan, motion.position_nwu_m[2]), (nan, nan, motion.velocity_nwu_m_s[2]),
            (0.0, 0.0, motion.acceleration_nwu_m_s2[2]), motion.yaw_rad, motion.yaw_rate_rad_s,
        )  # fmt: skip

    def begin_return(self, state: State) -> None:
        """Climb to RTL_RETURN_ALT, go to home or the nearest rally point, sink to RTL_DESCEND_ALT, wait, land."""
        home = self.home
        if home is None:
            self.descend()
            return
        self._return_xy_m, self._return_yaw_rad, height = self._way_back(home, state)
        self._return = ReturnPhase.CLIMB
        self._return_by((nan, nan, height))

    def return_time_s(self, state: State) -> float:
        """Of a return from here to the ground, at the parameters' speeds; 0 without a home.

        As PX4 counts it: RTL_TIME_FACTOR times the way, and RTL_TIME_MARGIN.
        """
        home, p = self.home, self._parameters
        if home is None:
            return 0.0
        (px, py), _, height = self._way_back(home, state)
        x, y, z = state.position_nwu_m
        lower = min(height, home.position_nwu_m[2] + p["RTL_DESCEND_ALT"])
        way_s = (height - z) / p["MPC_Z_V_AUTO_UP"]
        way_s += hypot(x - px, y - py) / min(p["MPC_XY_CRUISE"], p["MPC_XY_VEL_MAX"])
        way_s += (height - lower) / p["MPC_Z_V_AUTO_DN"] + max(p["RTL_LAND_DELAY"], 0.0)
        way_s += max(lower - self._ground_under(), 0.0) / p["MPC_LAND_SPEED"]
        return p["RTL_TIME_FACTOR"] * way_s + p["RTL_TIME_MARGIN"]

    def _way_back(self, home: Home, state: State) -> tuple[tuple[float, float], float, float]:
        """Where a return from here ends (north, west), with which yaw, and the height of the way there."""
        x, y, z = state.position_nwu_m
        places = ((home.position_nwu_m, home.yaw_rad), *((rally, nan) for rally in self.rally_nwu_m))
        (px, py, least), yaw_rad = min(places, key=lambda place: hypot(x - place[0][0], y - place[0][1]))
        height = max(home.position_nwu_m[2] + self._return_height(hypot(x - px, y - py)), least, z)
        return (px, py), yaw_rad, height

    def _return_height(self, away_m: float) -> float:
        """Above home: RTL_RETURN_ALT; nearer than RTL_MIN_DIST no more than the cone of RTL_CONE_ANG asks for."""
        p = self._parameters
        height, angle = p["RTL_RETURN_ALT"], p["RTL_CONE_ANG"]
        if away_m > p["RTL_MIN_DIST"] or angle <= 0.0:
            return height
        cone = away_m / tan(radians(angle)) if angle < 90.0 else 0.0
        return min(height, max(cone, p["RTL_DESCEND_ALT"] if angle >= 90.0 else 2.0 * p["NAV_ACC_RAD"]))

    def _return_by(self, position_nwu_m: Vector, yaw_rad: float = nan) -> None:
        """A leg of the return. As on PX4 a return never lifts a vehicle that stands on the ground."""
        self._fly_to(position_nwu_m, yaw_rad, nan)
        self._task = Task.RETURN

    def step_return(self, state: State, now_us: int) -> None:
        """On to the next phase of a return, where this one is done."""
        home = self.home
        if home is None or self._return is ReturnPhase.LAND:
            return
        (hx, hy), hz = self._return_xy_m, home.position_nwu_m[2]
        x, y, z = state.position_nwu_m
        acceptance = self._parameters["NAV_ACC_RAD"]
        phase = self._return
        if phase is ReturnPhase.CLIMB and abs(z - self.aim_nwu_m[2]) < REACHED_M:
            bearing = atan2(hy - y, hx - x) if hypot(hx - x, hy - y) > acceptance else nan
            self._return_by((hx, hy, self.aim_nwu_m[2]), bearing)
            self._return = ReturnPhase.CRUISE
        elif phase is ReturnPhase.CRUISE and self.reached(state, min(acceptance, 1.0)):
            lower = min(z, hz + self._parameters["RTL_DESCEND_ALT"])
            self._return_by((hx, hy, lower), self._return_yaw_rad)
            self._return = ReturnPhase.LOWER
        elif phase is ReturnPhase.LOWER and self.reached(state, acceptance):
            self._wait_us = now_us
            self._return = ReturnPhase.WAIT
        elif phase is ReturnPhase.WAIT:
            delay_s = self._parameters["RTL_LAND_DELAY"]
            if 0.0 <= delay_s <= (now_us - self._wait_us) / 1e6:
                self._return = ReturnPhase.LAND
                self.descend((hx, hy))

    def _begin_orbit(self, state: State) -> None:
        centre, height, radius, speed = self._pending_orbit or (None, nan, nan, nan)
        x, y, z = state.position_nwu_m
        radius = radius if isfinite(radius) and radius != 0.0 else DEFAULT_ORBIT_RADIUS_M
        cx, cy = centre if centre is not None else (x, y)
        speed = abs(speed) if isfinite(speed) and speed != 0.0 else DEFAULT_ORBIT_SPEED_M_S
        speed = min(speed, (ORBIT_ACCELERATION_M_S2 * abs(radius)) ** 0.5)
        self._orbit = (cx, cy, height if isfinite(height) else z, radius, speed)
        self._task = Task.ORBIT
        self.landing = False

    def _circle(self, state: State) -> None:
        """Along the tangent, with the way back to the circle added, looking at the centre."""
        cx, cy, height, radius, speed = self._orbit
        rx, ry = state.position_nwu_m[0] - cx, state.position_nwu_m[1] - cy
        away = hypot(rx, ry)
        ux, uy = (rx / away, ry / away) if away > 0.1 else (1.0, 0.0)
        turn = -1.0 if radius > 0.0 else 1.0  # clockwise seen from above is negative about the z axis
        back = min(max(ORBIT_GAIN_PER_S * (abs(radius) - away), -speed), speed)
        along = (max(speed * speed - back * back, 0.0)) ** 0.5
        back -= along * along / (abs(radius) * SERVO_PER_S)  # the motion follows its velocity by that lag
        self._motion.steer((back * ux - turn * along * uy, back * uy + turn * along * ux))
        self._motion.go_to((nan, nan, height), climb_m_s=self._climb, sink_m_s=self._sink)
        self._motion.turn_to(atan2(-uy, -ux), turn * along / abs(radius))

    def _ground_under(self) -> float:
        """Flat ground: where it last stood, or home's height."""
        return self._ground_height


def heading_deg(yaw_rad: float) -> float:
    """Clockwise from north, 0 to 360, of a counter-clockwise angle."""
    return -yaw_rad * 180.0 / pi % 360.0


__all__ = ["FREE", "Course", "Home", "Navigator", "Task", "heading_deg"]
