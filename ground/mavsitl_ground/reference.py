"""References: where the vehicle should be at a time, with velocity, acceleration and yaw; world NWU."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from math import cos, floor, isfinite, pi, radians, sin, sqrt
from pathlib import Path
from typing import TypeAlias

import numpy as np

from mavsitl.compiled import compiled
from mavsitl.control.arrays import Floats, Record, record
from mavsitl.scenario import Figure8, Hover, Reference, ScenarioError, Spiral, Steps, Vector3, Waypoints

Sample: TypeAlias = tuple[Vector3, Vector3, Vector3, float]
"""Position in m, velocity in m/s, acceleration in m/s^2 (NWU), yaw in rad."""

STILL: Vector3 = (0.0, 0.0, 0.0)
COLUMNS = ("x", "y", "z", "yaw", "hold")
UNITS = ("metres", "metres", "metres", "degrees", "seconds, at least 0")

# Columns of a row of `legs`: from a time on, at an even speed from a position and a yaw.
START = 0
POSITION = 1  # 1:4
VELOCITY = 4  # 4:7
YAW = 7
YAW_RATE = 8


@compiled
def legs(table: Floats, time_s: float, out: Record) -> None:
    """The last row that has begun; before all, the first."""
    leg, end = 0, table.shape[0]
    while end - leg > 1:
        middle = (leg + end) // 2
        if table[middle, START] <= time_s:
            leg = middle
        else:
            end = middle
    since = time_s - table[leg, START]
    to = out[0]
    for axis in range(3):
        velocity = table[leg, VELOCITY + axis]
        to["position"][axis, 0] = table[leg, POSITION + axis] + velocity * since
        to["velocity"][axis, 0] = velocity
        to["acceleration"][axis, 0] = 0.0
    to["yaw"][0] = table[leg, YAW] + table[leg, YAW_RATE] * since


@compiled
def spiral(table: Floats, time_s: float, out: Record) -> None:
    """Section 5.2: X_d = [r sin(w t), r cos(w t), v t], with its derivatives; yaw 0."""
    radius, rate, climb = table[0, 0], table[0, 1], table[0, 2]
    angle = rate * time_s
    x = radius * sin(angle)
    y = radius * cos(angle)
    square = -rate * rate
    position, velocity, acceleration = out[0]["position"], out[0]["velocity"], out[0]["acceleration"]
    position[0, 0], position[1, 0], position[2, 0] = x, y, climb * time_s
    velocity[0, 0], velocity[1, 0], velocity[2, 0] = rate * y, -rate * x, climb
    acceleration[0, 0], acceleration[1, 0], acceleration[2, 0] = square * x, square * y, 0.0
    out[0]["yaw"][0] = 0.0


@compiled
def figure_8(table: Floats, time_s: float, out: Record) -> None:
    """A Gerono lemniscate, x = L/2 sin s, y = W/2 sin 2s, entered from its centre; yaw 0.

    The phase s starts at rest: over the ramp its rate rises as 3 u^2 - 2 u^3 to 2 pi / period, so that position,
    velocity and acceleration are continuous from the start on (with a ramp of 0 the velocity jumps at 0).
    """
    x, y, z, rate, ramp = table[0, 0], table[0, 1], table[0, 2], table[0, 3], table[0, 4]
    if time_s < ramp:
        u = time_s / ramp
        phase = rate * ramp * u * u * u * (1.0 - 0.5 * u)
        speed = rate * u * u * (3.0 - 2.0 * u)
        change = rate / ramp * 6.0 * u * (1.0 - u)
    else:
        phase = rate * (time_s - 0.5 * ramp)
        speed = rate
        change = 0.0
    sine = sin(phase)
    cosine = cos(phase)
    sine_2 = 2.0 * sine * cosine
    cosine_2 = 1.0 - 2.0 * sine * sine
    square = speed * speed
    position, velocity, acceleration = out[0]["position"], out[0]["velocity"], out[0]["acceleration"]
    position[0, 0], position[1, 0], position[2, 0] = x * sine, y * sine_2, z
    velocity[0, 0], velocity[1, 0], velocity[2, 0] = x * cosine * speed, 2.0 * y * cosine_2 * speed, 0.0
    acceleration[0, 0] = x * (cosine * change - sine * square)
    acceleration[1, 0] = y * (2.0 * cosine_2 * change - 4.0 * sine_2 * square)
    acceleration[2, 0] = 0.0
    out[0]["yaw"][0] = 0.0


class ReferencePath:
    """A scenario's reference: a compiled function of time over a table, and its newest sample."""

    def __init__(
        self,
        law: Callable[[Floats, float, Record], None],
        table: Sequence[Sequence[float]],
        offset_nwu_m: Vector3 = STILL,
    ) -> None:
        """`offset_nwu_m` moves the path, in metres: to a place of a formation."""
        self._law = law
        self._offset = None if offset_nwu_m == STILL else np.array(offset_nwu_m)
        self._table = np.array(table, dtype=np.float64)
        self._constant = law is legs and len(table) == 1
        vector = np.zeros((3, 1))
        self.now = record(position=vector, velocity=vector, acceleration=vector, yaw=[0.0])
        """Position m, velocity m/s, acceleration m/s^2, NWU, (3, 1) each, and yaw rad, (1,), of the last `move`."""
        self._sample(0.0)

    def move(self, time_s: float) -> None:
        """`now` as of `time_s` after the start of the flight; before it, as at 0."""
        if not self._constant:
            self._sample(max(time_s, 0.0))

    def _sample(self, time_s: float) -> None:
        self._law(self._table, time_s, self.now)
        if self._offset is not None:
            self.now["position"][0, :, 0] += self._offset

    def sample(self, time_s: float) -> Sample:
        """The reference at one time, as tuples."""
        self.move(time_s)
        vectors = (self.now[name][0, :, 0].tolist() for name in ("position", "velocity", "acceleration"))
        (x, y, z), (v_x, v_y, v_z), (a_x, a_y, a_z) = vectors
        return (x, y, z), (v_x, v_y, v_z), (a_x, a_y, a_z), float(self.now["yaw"][0, 0])


def _leg(
    start_s: float, position: Vector3, yaw_rad: float, velocity: Vector3 = STILL, yaw_rate: float = 0.0
) -> tuple[float, ...]:
    return start_s, *position, *velocity, yaw_rad, yaw_rate


def _waypoint_legs(rows: list[tuple[float, float, float, float, float]], speed_m_s: float) -> list[tuple[float, ...]]:
    """Straight legs at one speed through rows (x, y, z in m NWU, yaw in rad, hold in s), from the first row at time 0.

    Each row is held for its time; on a leg the yaw turns evenly, the short way, from row to row (at once where two rows
    have the same position). The speed is constant: the velocity jumps at corners and the acceleration is 0 everywhere.
    """
    legs: list[tuple[float, ...]] = []
    time = 0.0
    for index, (x, y, z, yaw, hold) in enumerate(rows):
        here = (x, y, z)
        last = index == len(rows) - 1
        if hold > 0.0 or last:
            legs.append(_leg(time, here, yaw))
            time += hold
        if last:
            break
        to_x, to_y, to_z, to_yaw, _ = rows[index + 1]
        way = (to_x - x, to_y - y, to_z - z)
        duration = sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]) / speed_m_s
        if duration > 0.0:
            turn = to_yaw - yaw
            turn -= 2.0 * pi * floor((turn + pi) / (2.0 * pi))
            velocity = (way[0] / duration, way[1] / duration, way[2] / duration)
            legs.append(_leg(time, here, yaw, velocity, turn / duration))
            time += duration
    return legs


def read_waypoints(file: str) -> list[tuple[float, float, float, float, float]]:
    """The rows of a waypoint file: x, y, z in m NWU, yaw in rad, hold in s.

    CSV, UTF-8, three to five columns (yaw and hold are 0 where left out), comma separated; a first row of their
    names ``x,y,z,yaw,hold``, empty lines and lines that start with # are passed over.

    Raises `ScenarioError` with file, row and column.
    """
    try:
        with Path(file).open(encoding="utf-8-sig", newline="") as stream:
            lines = list(csv.reader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ScenarioError(f"{file}: cannot be read: {error}") from error
    rows: list[tuple[float, float, float, float, float]] = []
    header_allowed = True
    for number, cells in enumerate(lines, start=1):
        names = [cell.strip() for cell in cells]
        if not any(names) or names[0].startswith("#"):
            continue
        header = header_allowed and tuple(name.lower() for name in names) == COLUMNS[: len(names)]
        header_allowed = False
        if header:
            continue
        if not 3 <= len(names) <= len(COLUMNS):
            raise ScenarioError(f"{file}: row {number}: {len(names)} columns; allowed: 3 to 5, {','.join(COLUMNS)}")
        values = [0.0] * len(COLUMNS)
        for index, text in enumerate(names):
            allowed = f"allowed: a finite number ({UNITS[index]})"
            try:
                value = float(text)
            except ValueError as error:
                raise ScenarioError(f"{file}: row {number}, column {COLUMNS[index]}: {text!r}; {allowed}") from error
            if not isfinite(value) or (index == 4 and value < 0.0):
                raise ScenarioError(f"{file}: row {number}, column {COLUMNS[index]}: {text!r}; {allowed}")
            values[index] = value
        rows.append((values[0], values[1], values[2], radians(values[3]), values[4]))
    if not rows:
        raise ScenarioError(f"{file}: no waypoint; at least one row {','.join(COLUMNS)} is needed")
    return rows


def reference_for(reference: Reference, offset_nwu_m: Vector3 = STILL) -> ReferencePath:
    """The path that a scenario's reference describes, moved by `offset_nwu_m` in metres.

    Raises `ScenarioError` for a waypoint file that is not one.
    """
    return ReferencePath(*_path(reference), offset_nwu_m)


def _path(reference: Reference) -> tuple[Callable[[Floats, float, Record], None], list[tuple[float, ...]]]:
    """A law, and its table."""
    match reference:
        case Hover():
            return legs, [_leg(0.0, reference.position_nwu_m, radians(reference.yaw_deg))]
        case Steps():
            return legs, [_leg(s.time_s, s.position_nwu_m, radians(s.yaw_deg)) for s in reference.steps]
        case Waypoints():
            return legs, _waypoint_legs(read_waypoints(reference.file), reference.speed_m_s)
        case Spiral():
            return spiral, [(reference.radius_m, reference.rate_rad_s, reference.climb_m_s)]
        case Figure8():
            x, y, rate = reference.length_m / 2.0, reference.width_m / 2.0, 2.0 * pi / reference.period_s
            return figure_8, [(x, y, reference.altitude_m, rate, reference.ramp_s)]
