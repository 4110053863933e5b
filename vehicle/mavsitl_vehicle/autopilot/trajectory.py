"""Smooth motion for the automatic and the stick-flown modes: speed, acceleration and jerk limited, every tick anew.

The state (position, velocity, acceleration) follows from its own last value and the present aim only, so an aim may
change at any tick without a jump. Towards a point the speed is read off a braking curve, distance over speed
d(v) = v^2 / (2 B) + v / k, whose deceleration B v / (v + B / k) rises from 0 at the point to B far out; the velocity
follows it by a servo whose acceleration, sqrt(2 J |dv|) for large errors dv, is the most that the jerk J can take back
in time. World NWU; no clock, no message.
"""

from __future__ import annotations

from math import copysign, hypot, inf, isfinite, nan, pi, radians, remainder, sqrt

from mavsitl.frames import Vector
from mavsitl_vehicle.autopilot.position import Values
from mavsitl_vehicle.autopilot.setpoints import PositionSetpoint, State

SERVO_PER_S = 6.0
"""Velocity error to acceleration, for small errors."""
LAST_APPROACH_PER_S = 3.0
"""Largest k of the braking curve: distance to speed, close to the aim."""
JERK_SHARE = 0.8
"""Share of the jerk that the servo counts on."""
REST_M_S = 0.01
REST_M_S2 = 0.05
"""At rest, as far as a lock is concerned."""
LEASH_M = 2.0
"""The motion waits, from half of this on and fully here, for a vehicle that has fallen behind it."""

_POINT, _SPEED, _BRAKE = range(3)


class Trajectory:
    """One vehicle's motion. `engage`, then say where to (`go_to`, `steer`, `climb`, `stop`, `turn_to`), then `update`.

    Horizontal and vertical motion are aimed separately and each keeps its aim until it is given another. Limits, read
    at every update: MPC_XY_CRUISE, MPC_ACC_HOR, MPC_JERK_AUTO; MPC_Z_V_AUTO_UP and _DN, MPC_ACC_UP_MAX and
    MPC_ACC_DOWN_MAX; steered horizontally MPC_ACC_HOR_MAX; steered in either way MPC_JERK_MAX; MPC_YAWRAUTO_MAX
    and _ACC.
    """

    def __init__(self, parameters: Values, period_s: float) -> None:
        self._parameters = parameters
        self._period_s = period_s
        self._position: list[float] = [0.0, 0.0, 0.0]
        self._velocity: list[float] = [0.0, 0.0, 0.0]
        self._acceleration: list[float] = [0.0, 0.0, 0.0]
        self._aims = [_BRAKE, _BRAKE]
        self._target: list[float] = [0.0, 0.0, 0.0]
        self._asked: list[float] = [0.0, 0.0, 0.0]
        """Velocity, where it is steered."""
        self._speed = nan
        self._climb = nan
        self._sink = nan
        self._yaw_rad = 0.0
        self._yaw_rate_rad_s = 0.0
        self._yaw_target_rad = 0.0
        self._yaw_target_rate_rad_s = 0.0

    def engage(self, state: State, acceleration_nwu_m_s2: Vector = (0.0, 0.0, 0.0)) -> None:
        """Begin at the vehicle's own motion and brake. Components that are not known begin at the last motion's."""
        known = (state.position_nwu_m, state.velocity_nwu_m_s, acceleration_nwu_m_s2)
        for values, new in zip((self._position, self._velocity, self._acceleration), known, strict=True):
            values[:] = [b if isfinite(b) else a for a, b in zip(values, new, strict=True)]
        p = self._parameters
        ax, ay, az = self._acceleration
        scale = min(1.0, p["MPC_ACC_HOR"] / max(hypot(ax, ay), 1e-9))
        self._acceleration = [scale * ax, scale * ay, min(max(az, -p["MPC_ACC_DOWN_MAX"]), p["MPC_ACC_UP_MAX"])]
        yaw = state.yaw_rad
        if isfinite(yaw):
            self._yaw_rad = yaw
        self._yaw_rate_rad_s = self._yaw_target_rate_rad_s = 0.0
        self._yaw_target_rad = self._yaw_rad
        self.stop()

    def go_to(
        self,
        position_nwu_m: Vector,
        yaw_rad: float = nan,
        *,
        speed_m_s: float = nan,
        climb_m_s: float = nan,
        sink_m_s: float = nan,
    ) -> None:
        """Fly to a point and stay. NaN: x and y, z or the yaw keep the aim they have, a speed its parameter's."""
        x, y, z = position_nwu_m
        if isfinite(x) and isfinite(y):
            self._target[0], self._target[1] = x, y
            self._aims[0] = _POINT
            self._speed = speed_m_s
        if isfinite(z):
            self._target[2] = z
            self._aims[1] = _POINT
            self._climb, self._sink = climb_m_s, sink_m_s
        self.turn_to(yaw_rad)

    def steer(self, velocity_xy_m_s: tuple[float, float]) -> None:
        """Horizontal velocity (north, west); 0 brakes, and holds the vehicle's position once it has stopped."""
        if velocity_xy_m_s == (0.0, 0.0) and self._aims[0] == _POINT:
            return
        self._aims[0] = _SPEED
        self._asked[0], self._asked[1] = velocity_xy_m_s

    def climb(self, rate_m_s: float) -> None:
        """Vertical velocity, upwards; 0 brakes, and holds the vehicle's height once it has stopped."""
        if rate_m_s == 0.0 and self._aims[1] == _POINT:
            return
        self._aims[1] = _SPEED
        self._asked[2] = rate_m_s

    def stop(self) -> None:
        """Brake, and hold the point where that ends."""
        self._aims = [_BRAKE, _BRAKE]

    def turn_to(self, yaw_rad: float, rate_rad_s: float = 0.0) -> None:
        """Turn the shorter way, to a yaw that itself turns at `rate_rad_s`; NaN keeps the yaw aimed at."""
        if isfinite(yaw_rad):
            self._yaw_target_rad = yaw_rad
            self._yaw_target_rate_rad_s = rate_rad_s

    @property
    def aim_nwu_m(self) -> Vector:
        """The point flown to; where it brakes or is steered, where it is."""
        xy = self._target if self._aims[0] == _POINT else self._position
        z = self._target if self._aims[1] == _POINT else self._position
        return xy[0], xy[1], z[2]

    @property
    def resting(self) -> bool:
        """The motion has come to an end at its aim: below `REST_M_S` and within 5 cm, horizontally and vertically."""
        away = hypot(*(a - b for a, b in zip(self.aim_nwu_m, self._position, strict=True)))
        return hypot(*self._velocity) < REST_M_S and away < 0.05

    def update(self, position_nwu_m: Vector) -> PositionSetpoint:
        """One control period; where the vehicle is decides on the pace. A steered axis gives no position."""
        dt = self._period_s * self._pace(position_nwu_m)
        pace = dt / self._period_s
        self._horizontal(dt, position_nwu_m)
        self._vertical(dt, position_nwu_m)
        self._turn()
        px, py, pz = self._position
        vx, vy, vz = self._velocity
        ax, ay, az = self._acceleration
        if self._aims[0] == _SPEED:
            px = py = nan
        if self._aims[1] == _SPEED:
            pz = nan
        square = pace * pace
        return PositionSetpoint(
            (px, py, pz),
            (pace * vx, pace * vy, pace * vz),
            (square * ax, square * ay, square * az),
            self._yaw_rad,
            self._yaw_rate_rad_s,
        )

    def _pace(self, position_nwu_m: Vector) -> float:
        """Share of time that passes for the motion: 1 unless the vehicle is far behind it."""
        lead = 0.0
        for i in range(3):
            if self._aims[i // 2] != _SPEED:
                away = self._position[i] - position_nwu_m[i]
                if isfinite(away):
                    lead += away * away
        lead = sqrt(lead)
        return 1.0 if lead <= 0.5 * LEASH_M else max(2.0 - 2.0 * lead / LEASH_M, 0.0)

    def _horizontal(self, dt: float, measured: Vector) -> None:
        p, v, a = self._position, self._velocity, self._acceleration
        values = self._parameters
        aim = self._aims[0]
        limit, jerk = values["MPC_ACC_HOR"], values["MPC_JERK_AUTO"]
        if aim == _POINT:
            speed = _chosen(self._speed, values["MPC_XY_CRUISE"], values["MPC_XY_VEL_MAX"])
            wx, wy = _towards(
                self._target[0] - p[0], self._target[1] - p[1], v[0], v[1], a[0], a[1], speed, limit, limit, jerk
            )
        else:
            vx = vy = 0.0
            if aim == _SPEED:
                vx, vy = self._asked[0], self._asked[1]
                limit, jerk = values["MPC_ACC_HOR_MAX"], values["MPC_JERK_MAX"]
            wx, wy = _servo(vx - v[0], vy - v[1], limit, jerk)
        ex, ey = wx - a[0], wy - a[1]
        change = hypot(ex, ey)
        share = min(1.0, jerk * dt / change) if change > 0.0 else 0.0
        nx, ny = a[0] + share * ex, a[1] + share * ey
        for i, new in ((0, nx), (1, ny)):
            p[i] += (v[i] + 0.25 * (a[i] + new) * dt) * dt
            v[i] += 0.5 * (a[i] + new) * dt
            a[i] = new
        if aim == _SPEED:
            p[:2] = (b if isfinite(b) else c for b, c in zip(measured[:2], p[:2], strict=True))
        wanted = self._asked[0] == 0.0 and self._asked[1] == 0.0
        stopping = aim == _BRAKE or (aim == _SPEED and wanted)
        if stopping and hypot(v[0], v[1]) < REST_M_S and hypot(a[0], a[1]) < REST_M_S2:
            self._aims[0] = _POINT
            self._speed = nan
            self._target[:2] = p[:2]

    def _vertical(self, dt: float, measured: Vector) -> None:
        p, v, a = self._position[2], self._velocity[2], self._acceleration[2]
        values = self._parameters
        aim = self._aims[1]
        jerk = values["MPC_JERK_AUTO"]
        up, down = values["MPC_ACC_UP_MAX"], values["MPC_ACC_DOWN_MAX"]
        if aim == _POINT:
            away = self._target[2] - p
            if away >= 0.0:
                speed = _chosen(self._climb, values["MPC_Z_V_AUTO_UP"], values["MPC_Z_VEL_MAX_UP"])
                wanted, _ = _towards(away, 0.0, v, 0.0, a, 0.0, speed, down, up, jerk)
            else:
                speed = _chosen(self._sink, values["MPC_Z_V_AUTO_DN"], values["MPC_Z_VEL_MAX_DN"])
                wanted, _ = _towards(away, 0.0, v, 0.0, a, 0.0, speed, up, down, jerk)
        else:
            asked = 0.0
            if aim == _SPEED:
                asked, jerk = self._asked[2], values["MPC_JERK_MAX"]
            wanted, _ = _servo(asked - v, 0.0, max(up, down), jerk)
        wanted = min(max(wanted, -down), up)
        new = a + min(max(wanted - a, -jerk * dt), jerk * dt)
        p += (v + 0.25 * (a + new) * dt) * dt
        v += 0.5 * (a + new) * dt
        if aim == _SPEED and isfinite(measured[2]):
            p = measured[2]
        self._position[2], self._velocity[2], self._acceleration[2] = p, v, new
        stopping = aim == _BRAKE or (aim == _SPEED and self._asked[2] == 0.0)
        if stopping and abs(v) < REST_M_S and abs(new) < REST_M_S2:
            self._aims[1] = _POINT
            self._climb = self._sink = nan
            self._target[2] = p

    def _turn(self) -> None:
        error = remainder(self._yaw_target_rad - self._yaw_rad, 2.0 * pi)
        largest = radians(self._parameters["MPC_YAWRAUTO_MAX"])
        acceleration = radians(self._parameters["MPC_YAWRAUTO_ACC"])
        step = acceleration * self._period_s
        # Half the acceleration to brake with leaves the other half to correct: no overshoot on the tick's grid.
        wanted = copysign(min(sqrt(acceleration * abs(error)), 4.0 * abs(error)), error)
        wanted = min(max(wanted + self._yaw_target_rate_rad_s, -largest), largest)
        self._yaw_rate_rad_s += min(max(wanted - self._yaw_rate_rad_s, -step), step)
        self._yaw_rad = remainder(self._yaw_rad + self._yaw_rate_rad_s * self._period_s, 2.0 * pi)


def landing_speed(height_m: float, parameters: Values) -> float:
    """Descent rate in m/s at a height over the ground: MPC_Z_V_AUTO_DN down to MPC_LAND_ALT1, MPC_LAND_SPEED from ALT2.

    An unknown height descends at the lower rate.
    """
    fast, slow = parameters["MPC_Z_V_AUTO_DN"], parameters["MPC_LAND_SPEED"]
    high, low = parameters["MPC_LAND_ALT1"], parameters["MPC_LAND_ALT2"]
    if not height_m > low:
        return min(fast, slow)
    share = 1.0 if height_m >= high else (height_m - low) / (high - low)
    return min(fast, slow + share * (fast - slow)) if fast > slow else fast


def takeoff_climb_limit(since_s: float, gravity_m_s2: float, parameters: Values) -> float:
    """Cap of the climb, m/s, `since_s` after the rotors may lift: from no thrust to free within MPC_TKO_RAMP_T."""
    ramp_s = parameters["MPC_TKO_RAMP_T"]
    if since_s >= ramp_s:
        return inf
    start = -gravity_m_s2 / max(parameters["MPC_Z_VEL_P_ACC"], 0.01)
    return start + (parameters["MPC_TKO_SPEED"] - start) * max(since_s, 0.0) / ramp_s


def _chosen(asked: float, default: float, largest: float) -> float:
    return min(asked, largest) if asked > 0.0 else min(default, largest)


def _towards(
    ex: float, ey: float, vx: float, vy: float, ax: float, ay: float,
    speed: float, braking: float, limit: float, jerk: float,
) -> tuple[float, float]:  # fmt: skip
    """Acceleration that brings the motion to rest at the point (ex, ey) away."""
    k = min(LAST_APPROACH_PER_S, 2.0 * jerk / braking)
    distance = hypot(ex, ey)
    if distance < 1e-6:
        return _servo(-vx, -vy, limit, jerk)
    ux, uy = ex / distance, ey / distance
    closing = ux * vx + uy * vy
    if closing > 0.0:
        # The braking that the curve wants at this speed takes a while to build up, and no road is left for that.
        ramp_s = max(braking * closing / (closing + braking / k) + ux * ax + uy * ay, 0.0) / jerk
        distance = max(distance - 0.5 * closing * ramp_s, 0.0)
    root = sqrt(1.0 + 2.0 * distance * k * k / braking)
    wanted = braking / k * (root - 1.0)
    fx = fy = 0.0
    if wanted < speed:
        slope = k / root
        fx, fy = -slope * closing * ux, -slope * closing * uy
    else:
        wanted = speed
    sx, sy = _servo(wanted * ux - vx, wanted * uy - vy, limit, jerk)
    return _within(sx + fx, sy + fy, max(limit, braking))


def _servo(dx: float, dy: float, limit: float, jerk: float) -> tuple[float, float]:
    """Acceleration for a velocity error: proportional when small, what the jerk can take back when large."""
    size = hypot(dx, dy)
    if size == 0.0:
        return 0.0, 0.0
    usable = JERK_SHARE * jerk
    knee = usable / (SERVO_PER_S * SERVO_PER_S)
    wanted = SERVO_PER_S * size if size <= knee else sqrt(usable * (2.0 * size - knee))
    share = min(wanted, limit) / size
    return share * dx, share * dy


def _within(x: float, y: float, limit: float) -> tuple[float, float]:
    size = hypot(x, y)
    if size <= limit:
        return x, y
    return x * limit / size, y * limit / size
