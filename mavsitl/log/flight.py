"""One flight as arrays in the paper's frame, joined from the vehicle's log and the ground's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from math import inf
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from mavsitl import frames
from mavsitl.dialect import mavlink
from mavsitl.errors import MavsitlError
from mavsitl.log import topics
from mavsitl.log.errors import Failed
from mavsitl.log.topics import Topic
from mavsitl.log.ulog import MemoryRecorder, UlogWriter, information, read
from mavsitl.scenario import Flight

Array: TypeAlias = npt.NDArray[np.float64]
Tables: TypeAlias = Mapping[str, Mapping[str, npt.NDArray[Any]]]

VEHICLE_LOG = "vehicle.ulg"
GROUND_LOG = "ground.ulg"
ENDS = {"vehicle": (VEHICLE_LOG, topics.VEHICLE_TOPICS), "ground": (GROUND_LOG, topics.GROUND_TOPICS)}
"""Of each end its ULog and what may be in it."""


def open_ulog(
    folder: Path, end: Literal["vehicle", "ground"], flight: Flight, failed: Failed | None = None,
    boot_us: int | None = None,
) -> UlogWriter:  # fmt: skip
    """An end's ULog in a folder that is there. The vehicle itself says which parameters it has.

    `failed`: of `UlogWriter`; `boot_us`: of `information`.
    """
    name, wanted = ENDS[end]
    parameters = {} if end == "vehicle" else flight.airframe.parameters | flight.scenario.parameters
    return UlogWriter(folder / name, information(flight, boot_us), parameters, topics=wanted, failed=failed)


class FlightError(MavsitlError, ValueError):
    """The logs hold no flight; the message says what is missing."""


@dataclass(frozen=True)
class LinkStatistics:
    """The ground's end of the link: running counts of frames since its start, and the age of the state it used."""

    received: Array
    """(k,)"""
    lost: Array
    """(k,)"""
    bad: Array
    """(k,)"""
    state_age_ms: Array
    """(k,)"""


@dataclass(frozen=True)
class Broken:
    """A failure while it lasted, on the flight's clock; one from before the flight has begun before 0."""

    what: str
    """E.g. ``motor 3 wrong (0.8)``."""
    start_s: float
    end_s: float
    """Infinite: it stayed."""


@dataclass(frozen=True)
class Status:
    """What flew from `time_s` on, on the flight's clock."""

    time_s: float
    armed: bool
    nav_state: int
    """PX4's."""
    failsafe: bool


@dataclass(frozen=True, eq=False)
class ChannelLog:
    """One direction of an impaired link, as logged once a second: k rows, of which each tells of the time before it."""

    time_s: Array
    """(k,) from the release."""
    sent: Array
    """(k,) messages since the row before; the three below are of these."""
    lost: Array
    """(k,) by chance, for the queue was full, or corrupted."""
    outage: Array
    """(k,)"""
    delay_p50_ms: Array
    """(k,) of those that came since the row before; NaN where none came."""
    delay_p99_ms: Array
    """(k,)"""


@dataclass(frozen=True, eq=False)
class FlightData:
    """k samples from the release on; world NWU, body FLU, Euler angles Z-Y-X as phi, theta, psi.

    What the other side or a rarer topic tells is the last row at or before the sample's time, NaN before the first.
    """

    time_s: Array
    """(k,) from the release."""
    position_nwu_m: Array
    """(k, 3) truth."""
    position_reference_nwu_m: Array
    """(k, 3)"""
    velocity_nwu_m_s: Array
    """(k, 3) truth."""
    attitude_deg: Array
    """(k, 3) truth."""
    attitude_reference_deg: Array
    """(k, 3) the commanded angles."""
    wind_nwu_m_s: Array
    """(k, 3) truth; 0 without a wind topic."""
    rotor_speed_rad_s: Array | None
    """(k, 4)"""
    weights: Array | None
    """(k, 3, 3): net (roll, pitch, yaw), output weight (P, I, D)."""
    demand: Array | None
    """(k, 4): U_1..U_4 in N, N, N, N m."""
    link: LinkStatistics | None
    saturated_share: float | None
    """Share of the samples with a rotor at its limit, 0 to 1."""
    channels: Mapping[str, ChannelLog] = field(default_factory=dict)
    """The off-board link's directions, "to_ground" and "to_vehicle", where it was impaired."""
    broken: tuple[Broken, ...] = ()
    """Failures that were injected, by their beginning."""
    statuses: tuple[Status, ...] = ()
    """The one at the release and each later one."""

    @classmethod
    def from_recorders(
        cls, vehicle: MemoryRecorder, ground: MemoryRecorder, *, duration_s: float | None = None
    ) -> FlightData:
        """From what the two ends recorded in memory. See `from_tables`."""
        return cls.from_tables(vehicle.tables(), ground.tables(), duration_s=duration_s)

    @classmethod
    def from_folder(cls, folder: Path, *, duration_s: float | None = None) -> FlightData:
        """From `vehicle.ulg` and `ground.ulg` in a folder. Raises `LogError` for a file, else as `from_tables`."""
        vehicle, ground = read(folder / VEHICLE_LOG), read(folder / GROUND_LOG)
        try:
            return cls.from_tables(vehicle, ground, duration_s=duration_s)
        except FlightError as error:
            raise FlightError(f"{folder}: {error}") from error

    @classmethod
    def from_tables(cls, vehicle: Tables, ground: Tables, *, duration_s: float | None = None) -> FlightData:
        """Join on equal timestamps, which both ends write in the vehicle's clock; from the release to the end.

        The release is the first `vehicle_land_detected` row with landed = 0. With `duration_s` the flight is
        cut that long after it. Raises `FlightError` when there was no release, a needed topic is missing or no
        timestamps are equal.
        """
        position, attitude = _need(vehicle, topics.LOCAL_POSITION_TRUTH), _need(vehicle, topics.ATTITUDE_TRUTH)
        reference, commanded = _need(ground, topics.TRAJECTORY_SETPOINT), _need(ground, topics.ATTITUDE_SETPOINT)
        stamps = position["timestamp"]
        for table in (attitude, reference, commanded):
            stamps = np.intersect1d(stamps, table["timestamp"])
        release_us = release_us_of(vehicle)
        stamps = stamps[stamps >= release_us]
        if duration_s is not None:
            stamps = stamps[stamps <= release_us + round(duration_s * 1e6)]
        if not stamps.size:
            raise FlightError("vehicle and ground have no equal timestamp after the release")

        def equal(table: Mapping[str, npt.NDArray[Any]], *columns: str) -> Any:
            rows = np.searchsorted(table["timestamp"], stamps)
            return np.column_stack([table[column][rows].astype(np.float64) for column in columns])

        def held(tables: Tables, topic: Topic, *columns: str) -> Any:
            return _held(tables, topic, stamps, columns)

        wind = held(vehicle, topics.WIND_TRUTH, "windspeed_north", "windspeed_east", "windspeed_down")
        link = held(ground, topics.LINK_STATUS, "received", "lost", "bad", "state_age_us")
        weights = held(ground, topics.PIDNN_WEIGHTS, "roll", "pitch", "yaw")
        if weights is None:
            weights = held(vehicle, topics.PIDNN_WEIGHTS, "roll", "pitch", "yaw")
        saturated = held(vehicle, topics.ROTOR_STATUS, "saturated")
        return cls(
            time_s=(stamps - np.uint64(release_us)).astype(np.float64) * 1e-6,
            position_nwu_m=_vector(equal(position, "x", "y", "z")),
            position_reference_nwu_m=_vector(equal(reference, "position")),
            velocity_nwu_m_s=_vector(equal(position, "vx", "vy", "vz")),
            attitude_deg=_euler_deg(equal(attitude, "q")),
            attitude_reference_deg=_flipped_euler_deg(equal(commanded, "roll_body", "pitch_body", "yaw_body")),
            wind_nwu_m_s=np.zeros((stamps.size, 3)) if wind is None else _vector(wind),
            rotor_speed_rad_s=held(vehicle, topics.ROTOR_STATUS, "speed_rad_s"),
            weights=None if weights is None else weights.reshape(-1, 3, 3),
            demand=held(ground, topics.CONTROL_DEMAND, "u"),
            link=None if link is None else LinkStatistics(link[:, 0], link[:, 1], link[:, 2], link[:, 3] * 1e-3),
            saturated_share=None if saturated is None else _share(saturated[:, 0]),
            channels=_channels(vehicle, release_us, int(stamps[-1])),
            broken=_broken(vehicle, release_us),
            statuses=_statuses(vehicle, release_us),
        )

    @property
    def has_wind(self) -> bool:
        return bool(np.any(np.nan_to_num(self.wind_nwu_m_s) != 0.0))

    def attitude_error_deg(self) -> Array:
        """(k, 3) angle minus commanded angle, in [-180, 180)."""
        error: Array = (self.attitude_deg - self.attitude_reference_deg + 180.0) % 360.0 - 180.0
        return error

    def position_error_nwu_m(self) -> Array:
        """(k, 3) position minus reference."""
        return self.position_nwu_m - self.position_reference_nwu_m


def _need(tables: Tables, topic: Topic) -> Mapping[str, npt.NDArray[Any]]:
    table = tables.get(topic.name)
    if table is None:
        raise FlightError(f"no {topic.name} was logged")
    return table


def release_us_of(vehicle: Tables) -> int:
    """When the vehicle's log says that it flew first. Raises `FlightError` where it never did."""
    table = _need(vehicle, topics.LAND_DETECTED)
    airborne = np.flatnonzero(table["landed"] == 0)
    if not airborne.size:
        raise FlightError(f"the vehicle was never released: no {topics.LAND_DETECTED.name} with landed = 0")
    return int(table["timestamp"][airborne[0]])


def _broken(vehicle: Tables, release_us: int) -> tuple[Broken, ...]:
    table = vehicle.get(topics.INJECTED_FAILURE.name)
    if table is None:
        return ()
    running: dict[tuple[int, int], Broken] = {}
    found: list[Broken] = []
    columns = (table[name].tolist() for name in ("timestamp", "unit", "instance", "type", "value"))
    for stamp_us, unit, instance, kind, value in zip(*columns, strict=True):
        time_s = (stamp_us - release_us) * 1e-6
        if before := running.pop((unit, instance), None):
            found[found.index(before)] = replace(before, end_s=time_s)
        if kind != mavlink.FAILURE_TYPE_OK:
            size = f" ({value:g})" if value == value else ""
            what = f"{_spoken('FAILURE_UNIT', unit)} {instance} {_spoken('FAILURE_TYPE', kind)}{size}"
            running[unit, instance] = Broken(what, time_s, inf)
            found.append(running[unit, instance])
    return tuple(found)


def _spoken(enum: str, value: int) -> str:
    """``motor`` for FAILURE_UNIT_SYSTEM_MOTOR."""
    entry = mavlink.enums[enum].get(value)
    if entry is None:
        return f"{enum} {value}"
    name: str = entry.name.removeprefix(f"{enum}_").removeprefix("SENSOR_").removeprefix("SYSTEM_")
    return name.removesuffix("_SIGNAL").lower()


def _statuses(vehicle: Tables, release_us: int) -> tuple[Status, ...]:
    table = vehicle.get(topics.VEHICLE_STATUS.name)
    if table is None:
        return ()
    columns = (table[name].tolist() for name in ("timestamp", "arming_state", "nav_state", "failsafe"))
    rows = [
        Status((stamp_us - release_us) * 1e-6, state == topics.ARMED, nav_state, bool(failsafe))
        for stamp_us, state, nav_state, failsafe in zip(*columns, strict=True)
    ]
    first = sum(row.time_s <= 0.0 for row in rows)
    return tuple(rows[max(first - 1, 0) :])


def _held(tables: Tables, topic: Topic, stamps: npt.NDArray[Any], columns: tuple[str, ...]) -> Any:
    """(k, columns) of the last row at or before each stamp; None when the topic was not logged."""
    table = tables.get(topic.name)
    if table is None:
        return None
    rows = np.searchsorted(table["timestamp"], stamps, side="right") - 1
    values = np.column_stack([table[column].astype(np.float64) for column in columns])[rows]
    values[rows < 0] = np.nan
    return values


def _share(flags: Array) -> float | None:
    known = flags[~np.isnan(flags)]
    return float(np.mean(known != 0.0)) if known.size else None


def _channels(vehicle: Tables, release_us: int, end_us: int) -> dict[str, ChannelLog]:
    """From the first row after the release to the first at or after the end."""
    found = {}
    for direction, topic in topics.CHANNELS["link"].items():
        table = vehicle.get(topic.key)
        if table is None:
            continue
        stamps = table["timestamp"].astype(np.int64)
        first, last = np.searchsorted(stamps, release_us, side="right"), np.searchsorted(stamps, end_us)
        rows = slice(int(first), int(last) + 1)
        came = _increments(table, rows, "delivered") > 0.0
        found[direction] = ChannelLog(
            time_s=(stamps[rows] - release_us).astype(np.float64) * 1e-6,
            sent=_increments(table, rows, "sent"),
            lost=sum((_increments(table, rows, name) for name in _NOT_TAKEN), start=np.zeros(came.size)),
            outage=_increments(table, rows, "outage"),
            delay_p50_ms=np.where(came, table["delay_p50_ms"][rows].astype(np.float64), np.nan),
            delay_p99_ms=np.where(came, table["delay_p99_ms"][rows].astype(np.float64), np.nan),
        )
    return found


_NOT_TAKEN = ("lost", "queue_drops", "corrupted")


def _increments(table: Mapping[str, npt.NDArray[Any]], rows: slice, column: str) -> Array:
    """By how much a count grew up to each row, from the row before it."""
    grown: Array = np.diff(table[column].astype(np.float64), prepend=0.0)[rows]
    return grown


# The functions of `frames` are sign flips, so they take columns as well as numbers.


def _vector(ned: Any) -> Array:
    columns: Array = np.column_stack(frames.flip_vector(ned[:, 0], ned[:, 1], ned[:, 2]))
    return columns


def _flipped_euler_deg(angles_rad: Any) -> Array:
    flipped = frames.flip_euler(angles_rad[:, 0], angles_rad[:, 1], angles_rad[:, 2])
    angles: Array = np.degrees(np.column_stack(flipped))
    return angles


def _euler_deg(quaternion_ned: Any) -> Array:
    """Z-Y-X angles of (k, 4) attitudes FRD -> NED, as those of FLU -> NWU."""
    w, x, y, z = (np.asarray(c) for c in frames.flip_quaternion(*(quaternion_ned[:, i] for i in range(4))))
    phi = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    theta = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    psi = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    angles: Array = np.degrees(np.column_stack((phi, theta, psi)))
    return angles


def equal(one: FlightData, other: FlightData) -> bool:
    """Whether two flights hold the same numbers, NaN equal to NaN."""

    def same(a: object, b: object) -> bool:
        if isinstance(a, LinkStatistics) and isinstance(b, LinkStatistics):
            return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
        if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
            return np.array_equal(a, b, equal_nan=True)
        return a == b

    return all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
