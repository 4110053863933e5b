"""References: where the vehicle should be at a time, with velocity, acceleration and yaw; world NWU."""

from __future__ import annotations

import csv
from bisect import bisect_right
from math import cos, floor, isfinite, pi, radians, sin, sqrt
from pathlib import Path
from typing import Protocol, TypeAlias

from mavsitl.scenario import Figure8, Hover, Reference, ScenarioError, Spiral, Steps, Vector3

Sample: TypeAlias = tuple[Vector3, Vector3, Vector3, float]
"""Position in m, velocity in m/s, acceleration in m/s^2 (NWU), yaw in rad."""

STILL: Vector3 = (0.0, 0.0, 0.0)
COLUMNS = ("x", "y", "z", "yaw", "hold")
UNITS = ("metres", "metres", "metres", "degrees", "seconds, at least 0")


class Path3(Protocol):
    """A reference path."""

    def sample(self, time_s: float) -> Sample:
        """The reference `time_s` after the start of the flight; before it, as at 0."""


class HoldPath:
    """One position for ever."""

    def __init__(self, position_nwu_m: Vector3, yaw_rad: float) -> None:
        self._sample: Sample = (position_nwu_m, STILL, STILL, yaw_rad)

    def sample(self, time_s: float) -> Sample:
        return self._sample


class ShiftedPath:
    """Another path, moved to a place of a formation."""

    def __init__(self, path: Path3, offset_nwu_m: Vector3) -> None:
        self._path = path
        self._offset = offset_nwu_m

    def sample(self, time_s: float) -> Sample:
        (x, y, z), velocity, acceleration, yaw = self._path.sample(time_s)
        dx, dy, dz = self._offset
        return (x + dx, y + dy, z + dz), velocity, acceleration, yaw


class SpiralPath:
    """Section 5.2: X_d = [r sin(w t), r cos(w t), v t], with its derivatives; yaw 0."""

    def __init__(self, spiral: Spiral) -> None:
        self._radius = spiral.radius_m
        self._rate = spiral.rate_rad_s
        self._climb = spiral.climb_m_s

    def sample(self, time_s: float) -> Sample:
        if time_s < 0.0:
            time_s = 0.0
        rate = self._rate
        angle = rate * time_s
        x = self._radius * sin(angle)
        y = self._radius * cos(angle)
        square = -rate * rate
        return (x, y, self._climb * time_s), (rate * y, -rate * x, self._climb), (square * x, square * y, 0.0), 0.0


class StepsPath:
    """Holds each position from its time on; before the first step's time, the first position."""

    def __init__(self, steps: Steps) -> None:
        self._times = [step.time_s for step in steps.steps][1:]
        self._samples: list[Sample] = [
            (step.position_nwu_m, STILL, STILL, radians(step.yaw_deg)) for step in steps.steps
        ]

    def sample(self, time_s: float) -> Sample:
        return self._samples[bisect_right(self._times, time_s)]


class Figure8Path:
    """A Gerono lemniscate, x = L/2 sin s, y = W/2 sin 2s, entered from its centre; yaw 0.

    The phase s starts at rest: over the ramp its rate rises as 3 u^2 - 2 u^3 to 2 pi / period, so that position,
    velocity and acceleration are continuous from the start on (with a ramp of 0 the velocity jumps at 0).
    """

    def __init__(self, figure: Figure8) -> None:
        self._x = figure.length_m / 2.0
        self._y = figure.width_m / 2.0
        self._z = figure.altitude_m
        self._rate = 2.0 * pi / figure.period_s
        self._ramp = figure.ramp_s

    def sample(self, time_s: float) -> Sample:
        if time_s < 0.0:
            time_s = 0.0
        rate = self._rate
        ramp = self._ramp
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
        x = self._x
        y = self._y
        return (
            (x * sine, y * sine_2, self._z),
            (x * cosine * speed, 2.0 * y * cosine_2 * speed, 0.0),
            (x * (cosine * change - sine * square), y * (2.0 * cosine_2 * change - 4.0 * sine_2 * square), 0.0),
            0.0,
        )


class WaypointPath:
    """Straight legs at one speed through rows (x, y, z in m NWU, yaw in rad, hold in s), from the first row at time 0.

    Each row is held for its time; on a leg the yaw turns evenly, the short way, from row to row (at once where two rows
    have the same position). The speed is constant: the velocity jumps at corners and the acceleration is 0 everywhere.
    """

    def __init__(self, rows: list[tuple[float, float, float, float, float]], speed_m_s: float) -> None:
        # Segments: start time, position there, velocity, yaw there, yaw rate.
        self._segments: list[tuple[float, Vector3, Vector3, float, float]] = []
        time = 0.0
        for index, (x, y, z, yaw, hold) in enumerate(rows):
            here = (x, y, z)
            last = index == len(rows) - 1
            if hold > 0.0 or last:
                self._segments.append((time, here, STILL, yaw, 0.0))
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
                self._segments.append((time, here, velocity, yaw, turn / duration))
                time += duration
        self._starts = [segment[0] for segment in self._segments[1:]]

    def sample(self, time_s: float) -> Sample:
        if time_s < 0.0:
            time_s = 0.0
        start, position, velocity, yaw, turn = self._segments[bisect_right(self._starts, time_s)]
        if velocity is STILL:
            return position, STILL, STILL, yaw
        since = time_s - start
        x, y, z = position
        v_x, v_y, v_z = velocity
        return (x + v_x * since, y + v_y * since, z + v_z * since), velocity, STILL, yaw + turn * since


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


def reference_for(reference: Reference, offset_nwu_m: Vector3 = STILL) -> Path3:
    """The path that a scenario's reference describes, moved by `offset_nwu_m` in metres.

    Raises `ScenarioError` for a waypoint file that is not one.
    """
    path = _path(reference)
    return path if offset_nwu_m == STILL else ShiftedPath(path, offset_nwu_m)


def _path(reference: Reference) -> Path3:
    if isinstance(reference, Hover):
        return HoldPath(reference.position_nwu_m, radians(reference.yaw_deg))
    if isinstance(reference, Spiral):
        return SpiralPath(reference)
    if isinstance(reference, Steps):
        return StepsPath(reference)
    if isinstance(reference, Figure8):
        return Figure8Path(reference)
    return WaypointPath(read_waypoints(reference.file), reference.speed_m_s)
