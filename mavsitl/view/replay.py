"""A run's logs played back: the same values, rows and texts that a live flight has, at any speed, from any time on.

Sans-IO but for the files, which are read once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mavsitl.dialect import mavlink
from mavsitl.log import topics
from mavsitl.log.content import VEHICLE_FOLDER
from mavsitl.log.errors import LogError, NoLogError
from mavsitl.log.flight import GROUND_LOG, VEHICLE_LOG
from mavsitl.log.topics import Topic
from mavsitl.log.ulog import read
from mavsitl.px4_modes import NAV_STATES
from mavsitl.quaternion import from_euler
from mavsitl.report.run import RUN_FILE, FlightRecord, load_run
from mavsitl.services.statustext import printable
from mavsitl.view.model import ROW_INTERVAL_US, ROWS, Model, Row, Vehicle, put_link, row_of, shorten

__all__ = ["SPEEDS", "Recorded", "Replay", "Track", "find_flights"]

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)

HZ = 33.0

Table: TypeAlias = Mapping[str, npt.NDArray[Any]]
Tables: TypeAlias = Mapping[str, Table]


@dataclass(frozen=True)
class Recorded:
    """A flight of which there are logs: each vehicle's folder by its system id."""

    name: str
    folders: Mapping[int, Path]


def find_flights(path: Path) -> list[Recorded]:
    """The flights of a run's folder, in its order; or of a folder with logs, of one vehicle or of a fleet.

    Raises `LogError` where there are none, and `RunError` for a damaged run.
    """
    if (path / RUN_FILE).is_file():
        flights = load_run(path).flights
        titles = [flight.title for flight in flights]
        return [
            Recorded(title if titles.count(title) == 1 else f"{title} ({flight.folder})", _folders(path, flight))
            for title, flight in zip(titles, flights, strict=True)
        ]
    found = _flight(path)
    if found is not None:
        return [found]
    if not path.is_dir():
        raise NoLogError(f"{path}: no such folder; expected that of a run, with {RUN_FILE} or {VEHICLE_LOG} in it")
    below = [flight for entry in sorted(path.iterdir()) if entry.is_dir() and (flight := _flight(entry)) is not None]
    if not below:
        raise NoLogError(f"{path}: nothing to replay; expected {RUN_FILE}, {VEHICLE_LOG} or a fleet's vehicle-0 in it")
    return below


def _folders(run: Path, flight: FlightRecord) -> dict[int, Path]:
    if flight.fleet is None:
        return {1: run / flight.folder}
    return {vehicle.system_id: run / vehicle.folder for vehicle in flight.fleet.vehicles}


def _flight(folder: Path) -> Recorded | None:
    if (folder / VEHICLE_LOG).is_file():
        return Recorded(folder.resolve().name, {1: folder})
    if not folder.is_dir():
        return None
    fleet = {
        int(match[1]) + 1: entry
        for entry in folder.iterdir()
        if (match := VEHICLE_FOLDER.fullmatch(entry.name)) and (entry / VEHICLE_LOG).is_file()
    }
    return Recorded(folder.resolve().name, dict(sorted(fleet.items()))) if fleet else None


class _Held:
    """Columns of a topic, each row until the next."""

    def __init__(self, tables: Tables, topic: Topic | str, *columns: str) -> None:
        """Empty where the log has no such topic, or not all of the columns."""
        table = tables.get(topic if isinstance(topic, str) else topic.key, {})
        known = bool(table) and all(column in table for column in columns)
        self._stamps = table["timestamp"].astype(np.int64) if known else np.zeros(0, np.int64)
        self._rows = np.zeros((0, 0))
        if known:
            self._rows = np.column_stack([table[column].astype(np.float64) for column in columns])

    def __bool__(self) -> bool:
        return bool(len(self._stamps))

    @property
    def first(self) -> list[float]:
        row: list[float] = self._rows[0].tolist()
        return row

    def at(self, time_us: int, within_us: int | None = None) -> list[float] | None:
        """The last row at or before that time; None before the first, or where it is older than `within_us`."""
        index = int(np.searchsorted(self._stamps, time_us, side="right")) - 1
        if index < 0 or (within_us is not None and time_us - int(self._stamps[index]) > within_us):
            return None
        row: list[float] = self._rows[index].tolist()
        return row


STALE_US = 1_000_000


class Track:
    """One vehicle's logs: its values at any time.

    Attributes:
        begin_us, end_us: of its log, on its clock.
        rows: for the charts, every `ROW_INTERVAL_US` from `begin_us` on.
    """

    def __init__(self, vehicle: Tables, ground: Tables, texts: Sequence[tuple[int, int, str]] = ()) -> None:
        """`texts`: (time us, MAV_SEVERITY, text) in order. Raises `LogError` where there is no attitude."""
        attitude = _Held(vehicle, topics.ATTITUDE, "q") or _Held(vehicle, topics.ATTITUDE_TRUTH, "q")
        if not attitude:
            raise LogError(f"no {topics.ATTITUDE.name} in the log: nothing to show")
        key = topics.ATTITUDE.key if topics.ATTITUDE.key in vehicle else topics.ATTITUDE_TRUTH.key
        stamps = vehicle[key]["timestamp"]
        self.begin_us, self.end_us = int(stamps[0]), int(stamps[-1])
        self.texts = tuple(texts)
        place = ("x", "y", "z")
        speed = ("vx", "vy", "vz")
        self._attitude = attitude
        self._position = _Held(vehicle, topics.LOCAL_POSITION, *place) or _Held(
            vehicle, topics.LOCAL_POSITION_TRUTH, *place
        )
        self._velocity = _Held(vehicle, topics.LOCAL_POSITION, *speed) or _Held(
            vehicle, topics.LOCAL_POSITION_TRUTH, *speed
        )
        self._true_position = _Held(vehicle, topics.LOCAL_POSITION_TRUTH, *place)
        self._true_attitude = _Held(vehicle, topics.ATTITUDE_TRUTH, "q")
        wind = ("windspeed_north", "windspeed_east", "windspeed_down")
        self._wind = _Held(vehicle, topics.WIND_TRUTH, *wind)
        self._status = _Held(vehicle, topics.VEHICLE_STATUS, "arming_state", "nav_state", "failsafe")
        self._landed = _Held(vehicle, topics.LAND_DETECTED, "landed")
        self._reference = _Held(ground, topics.TRAJECTORY_SETPOINT, "position")
        self._wanted = _Held(ground, topics.ATTITUDE_SETPOINT, "roll_body", "pitch_body", "yaw_body")
        nets = ("roll", "pitch", "yaw")
        self._weights = _Held(ground, topics.PIDNN_WEIGHTS, *nets) or _Held(vehicle, topics.PIDNN_WEIGHTS, *nets)
        self._link = _Held(ground, topics.LINK_STATUS, "received", "lost", "state_age_us")
        self._battery = _Held(vehicle, "battery_status", "voltage_v", "remaining")
        self._failures = vehicle.get(topics.INJECTED_FAILURE.key)
        self.rows = self._make_rows()

    def _make_rows(self) -> list[Row]:
        scratch = Vehicle(0, Model())
        rows = []
        for time_us in range(self.begin_us, self.end_us + 1, ROW_INTERVAL_US):
            self.show(scratch, time_us)
            rows.append(row_of(scratch.values))
        return rows

    @classmethod
    def load(cls, folder: Path) -> Track:
        """From the logs in a folder. Raises `LogError`, naming the file."""
        path = folder / VEHICLE_LOG
        ground = folder / GROUND_LOG
        try:
            return cls(read(path), read(ground) if ground.is_file() else {}, _texts(path))
        except LogError as error:
            raise error if str(folder) in str(error) else LogError(f"{path}: {error}") from error

    def show(self, vehicle: Vehicle, time_us: int) -> None:
        """Put what was known at `time_us`."""
        put = vehicle.put
        vehicle.time_us = time_us
        put("time_s", round(time_us * 1e-6, 2))
        put("attitude", _short(self._attitude.at(time_us)))
        put("position", _short(self._position.at(time_us)))
        put("velocity", _short(self._velocity.at(time_us)))
        position, attitude = _short(self._true_position.at(time_us)), _short(self._true_attitude.at(time_us))
        put("truth", {"position": position, "attitude": attitude} if position and attitude else None)
        wind = _short(self._wind.at(time_us))
        put("wind", wind and {"velocity": wind, "source": "true"})
        put("reference", _short(self._reference.at(time_us, STALE_US)))
        angles = self._wanted.at(time_us, STALE_US)
        put("wanted", None if angles is None else _short(from_euler(*angles)))
        weights = self._weights.at(time_us, STALE_US)
        put("weights", weights and [_share(w, w0) for w, w0 in zip(weights, self._weights.first, strict=True)])
        status = self._status.at(time_us)
        if status is not None:
            armed, nav_state, failsafe = status
            put("armed", armed == topics.ARMED)
            put("ready", True)
            put("mode", NAV_STATES.get(int(nav_state), f"nav_state {nav_state:g}"))
            put("failsafe", bool(failsafe))
            put("terminated", nav_state == _TERMINATION)
        landed = self._landed.at(time_us)
        put("landed", None if landed is None else "on the ground" if landed[0] else "in the air")
        counts = self._link.at(time_us, STALE_US)
        if counts is not None:
            put_link(vehicle, "off-board", counts[0], counts[1], counts[2] * 1e-3, time_us)
        battery = self._battery.at(time_us)
        if battery is not None:
            put("battery", {"voltage_v": round(battery[0], 1), "percent": round(100.0 * battery[1])})
        put("parameters", self._broken(time_us))
        put("online", True)

    def _broken(self, time_us: int) -> dict[str, float]:
        """Motors that have failed, by the parameters that show it."""
        table = self._failures
        found: dict[str, float] = {}
        if table is not None:
            for row in np.flatnonzero(table["timestamp"] <= time_us):
                if table["unit"][row] == mavlink.FAILURE_UNIT_SYSTEM_MOTOR:
                    kind = int(table["type"][row])
                    found[f"SIM_FAIL_MOT{table['instance'][row]}"] = float(kind != mavlink.FAILURE_TYPE_OK)
        return found


_TERMINATION = next(number for number, name in NAV_STATES.items() if name == "TERMINATION")


def _short(numbers: Sequence[float] | None) -> list[float] | None:
    return None if numbers is None else shorten(numbers)


def _share(weight: float, initial: float) -> float | None:
    share = weight / initial if initial else nan
    return round(share, 4) if isfinite(share) else None


def _texts(path: Path) -> list[tuple[int, int, str]]:
    """What the log has of texts: (time us, MAV_SEVERITY, text)."""
    from pyulog.core import ULog

    log = ULog(str(path), message_name_filter_list=[], disable_str_exceptions=True)
    texts = [(int(each.timestamp), each.log_level - ord("0"), printable(each.message)) for each in log.logged_messages]
    return sorted(texts)


class Replay:
    """Plays one flight of a run at a time.

    Attributes:
        model: what the page shows; `playing`, `speed`, `at_s`, `duration_s`, `flight` and `flights` are among its
            values of the whole.
    """

    hz = HZ

    def __init__(self, flights: Sequence[Recorded]) -> None:
        """Begins to play the first. Raises `LogError`."""
        self._flights = flights
        self._by_name = {flight.name: flight for flight in flights}
        self._tracks: dict[int, Track] = {}
        self._shown_rows: dict[int, int] = {}
        self._texts: list[tuple[int, int, int, str]] = []
        self._texts_told = 0
        self._begin_us = self._end_us = 0
        self._at_us = 0.0
        self._speed = 1.0
        self._playing = True
        self._now_us: int | None = None
        self.model = Model()
        self.model.put("kind", "replay")
        self.model.put("buttons", False)
        self.model.put("flights", [flight.name for flight in flights])
        self.model.put("speeds", SPEEDS)
        self.open(flights[0].name)

    def open(self, name: str) -> None:
        """Play this flight from its beginning. Raises `KeyError` for a name that is none, `LogError`."""
        flight = self._by_name[name]
        self._tracks = {number: Track.load(folder) for number, folder in flight.folders.items()}
        self._begin_us = min(track.begin_us for track in self._tracks.values())
        self._end_us = max(track.end_us for track in self._tracks.values())
        self._texts = sorted(
            (time_us, number, severity, text)
            for number, track in self._tracks.items()
            for time_us, severity, text in track.texts
        )
        self.model.clear()
        self.model.put("flight", name)
        self.model.put("duration_s", round((self._end_us - self._begin_us) * 1e-6, 2))
        self.seek(0.0)
        self.play(True)

    def play(self, on: bool) -> None:
        """Play or pause; at the end playing begins anew."""
        if on and self._at_us >= self._end_us:
            self.seek(0.0)
        self._playing = on
        self._tell()

    def set_speed(self, speed: float) -> None:
        """One of `SPEEDS`. Raises `ValueError`."""
        if speed not in SPEEDS:
            raise ValueError(f"speed {speed:g}; allowed: {', '.join(f'{each:g}' for each in SPEEDS)}")
        self._speed = speed
        self._tell()

    def seek(self, at_s: float) -> None:
        """Go to that time after the beginning, within the flight; rows and texts are those up to there."""
        wanted_us = self._begin_us + (at_s * 1e6 if isfinite(at_s) else 0.0)
        self._at_us = min(max(wanted_us, self._begin_us), self._end_us)
        self.model.forget_texts()
        self._texts_told = 0
        for number, track in self._tracks.items():
            rows = self._rows_by_now(track)
            self.model.vehicle(number).begin(track.rows[max(rows - ROWS, 0) : rows])
            self._shown_rows[number] = rows
        self._show()

    def step(self, now_us: int) -> None:
        """The wall clock shows this: play on."""
        passed_us = 0 if self._now_us is None else now_us - self._now_us
        self._now_us = now_us
        if self._playing and passed_us > 0:
            self._at_us += passed_us * self._speed
            if self._at_us >= self._end_us:
                self._at_us = self._end_us
                self._playing = False
            self._show()

    def _show(self) -> None:
        time_us = int(self._at_us)
        for number, track in self._tracks.items():
            vehicle = self.model.vehicle(number)
            rows = self._rows_by_now(track)
            for row in track.rows[self._shown_rows[number] : rows]:
                vehicle.add(row)
            self._shown_rows[number] = rows
            track.show(vehicle, min(max(time_us, track.begin_us), track.end_us))
        while self._texts_told < len(self._texts) and self._texts[self._texts_told][0] <= time_us:
            said_us, number, severity, text = self._texts[self._texts_told]
            self.model.say(number, severity, text, round(said_us * 1e-6, 2))
            self._texts_told += 1
        self._tell()

    def _tell(self) -> None:
        self.model.put("playing", self._playing)
        self.model.put("speed", self._speed)
        self.model.put("at_s", round((self._at_us - self._begin_us) * 1e-6, 2))

    def _rows_by_now(self, track: Track) -> int:
        return min(max(int(self._at_us - track.begin_us) // ROW_INTERVAL_US + 1, 0), len(track.rows))
