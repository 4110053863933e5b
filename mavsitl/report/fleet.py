"""A fleet's flight measured from its logs, and its page: all vehicles in each figure, one row of a table for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import blake2b
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt

from mavsitl import frames
from mavsitl.fleet import FleetOutcome
from mavsitl.log import topics
from mavsitl.log.errors import LogError
from mavsitl.log.flight import GROUND_LOG, VEHICLE_LOG, Array, FlightData, FlightError, release_us_of
from mavsitl.log.ulog import read
from mavsitl.report import fleet_figures, tables
from mavsitl.report.figures import with_ids
from mavsitl.report.html import template
from mavsitl.report.metrics import Rmse
from mavsitl.report.run import CollisionRecord, FleetRecord, Run, RunError, VehicleRecord
from mavsitl.scenario import Fleet

__all__ = ["Track", "Tracks", "end_of", "fleet_record", "load_tracks", "measure", "render", "summary", "wire_hash"]

_PAIRS_AT_ONCE = 1_000_000
"""Distances between vehicles that are in memory together."""


@dataclass(frozen=True, eq=False)
class Track:
    """One vehicle's flight, k samples from its release on; time is the fleet's, whose 0 is the first release of all."""

    system_id: int
    time_s: Array
    """(k,)"""
    position_nwu_m: Array
    """(k, 3) truth."""
    reference_nwu_m: Array
    """(k, 3)"""
    square_errors: Array
    """(6,) mean squares of the errors that `metrics.rmse` takes, m2 and deg2."""

    @property
    def error_m(self) -> Array:
        """(k,) distance from the reference."""
        distance: Array = np.linalg.norm(self.position_nwu_m - self.reference_nwu_m, axis=1)
        return distance


@dataclass(frozen=True, eq=False)
class Tracks:
    """What a fleet's logs tell."""

    vehicles: tuple[Track, ...]
    """In the order of their system ids; k = 0 of one that was never released."""
    start_s: float
    """The first release in simulated time."""
    time_s: Array
    """(t,) of the separations, the fleet's time: from the first release to the last row of any log."""
    nearest_m: Array
    """(t, n) from each vehicle to the one nearest to it; NaN outside of its log, and of one that is alone."""
    nearest: npt.NDArray[np.int64]
    """(t, n) the system id of that one; where there is none, any."""

    def rmse(self) -> Rmse:
        """Over all vehicles, each of which counts as it has flown."""
        weights = [track.time_s.size for track in self.vehicles]
        squares = [track.square_errors for track in self.vehicles]
        if not sum(weights):
            return Rmse(*[float("nan")] * 6)
        return Rmse(*np.sqrt(np.average(squares, axis=0, weights=weights)).tolist())


@dataclass(frozen=True)
class Measured:
    """The numbers of one vehicle: see `run.VehicleRecord`."""

    flight_time_s: float
    rms_m: float | None
    worst_m: float | None
    nearest_m: float | None
    nearest: int | None


def load_tracks(folders: Mapping[int, Path], duration_s: float) -> Tracks:
    """From each vehicle's folder, by system id; flights are cut that long after their release. Raises `RunError`."""
    flown: dict[int, tuple[int, FlightData | None]] = {}
    truth: list[tuple[npt.NDArray[np.int64], Array]] = []
    for system_id, folder in folders.items():
        try:
            vehicle, ground = read(folder / VEHICLE_LOG), read(folder / GROUND_LOG)
            table = vehicle[topics.LOCAL_POSITION_TRUTH.key]
        except LogError as error:
            raise RunError(f"vehicle {system_id}: {error}") from error
        except KeyError as error:
            raise RunError(f"vehicle {system_id}: {folder / VEHICLE_LOG}: no {error} was logged") from error
        truth.append((table["timestamp"].astype(np.int64), _position_nwu_m(table)))
        try:
            flight = FlightData.from_tables(vehicle, ground, duration_s=duration_s)
            flown[system_id] = release_us_of(vehicle), flight
        except FlightError:  # it was never released
            flown[system_id] = int(table["timestamp"][-1]), None
    start_us = min(release_us for release_us, _ in flown.values())
    vehicles = tuple(
        _track(system_id, flight, (release_us - start_us) / 1e6) for system_id, (release_us, flight) in flown.items()
    )
    stamps, nearest_m, nearest = _separations(truth, start_us)
    return Tracks(
        vehicles=vehicles,
        start_s=start_us / 1e6,
        time_s=(stamps - start_us) / 1e6,
        nearest_m=nearest_m,
        nearest=np.array(list(folders))[nearest],
    )


def _position_nwu_m(table: Any) -> Array:
    columns = (table[name].astype(np.float64) for name in ("x", "y", "z"))
    position: Array = np.column_stack(frames.flip_vector(*columns))
    return position


def _track(system_id: int, flight: FlightData | None, after_s: float) -> Track:
    if flight is None:
        return Track(system_id, np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(6))
    errors = flight.position_error_nwu_m(), flight.attitude_error_deg()
    return Track(
        system_id, flight.time_s + after_s, flight.position_nwu_m, flight.position_reference_nwu_m,
        np.concatenate([np.mean(np.square(each), axis=0) for each in errors]),
    )  # fmt: skip


def _separations(
    truth: Sequence[tuple[npt.NDArray[np.int64], Array]], start_us: int
) -> tuple[npt.NDArray[np.int64], Array, npt.NDArray[np.int64]]:
    """(t,) stamps from `start_us` on, (t, n) distances to the nearest other, (t, n) its column."""
    stamps = np.unique(np.concatenate([each for each, _ in truth]))
    stamps = stamps[stamps >= start_us]
    count = len(truth)
    nearest_m, nearest = np.full((stamps.size, count), np.nan), np.zeros((stamps.size, count), np.int64)
    if count < 2:
        return stamps, nearest_m, nearest
    positions = np.full((stamps.size, count, 3), np.nan)
    for column, (own, position) in enumerate(truth):
        later = own >= start_us
        positions[np.searchsorted(stamps, own[later]), column] = position[later]
    step = max(_PAIRS_AT_ONCE // count**2, 1)
    alone = np.eye(count, dtype=bool)
    for begin in range(0, stamps.size, step):
        rows = slice(begin, begin + step)
        square = np.zeros((positions[rows].shape[0], count, count))
        for axis in range(3):
            along = positions[rows, :, axis]
            square += np.square(along[:, :, None] - along[:, None, :])
        square[:, alone] = np.nan
        square = np.where(np.isnan(square), np.inf, square)
        nearest[rows] = np.argmin(square, axis=2)
        least = np.min(square, axis=2)
        nearest_m[rows] = np.where(np.isinf(least), np.nan, np.sqrt(least))
    return stamps, nearest_m, nearest


def measure(tracks: Tracks) -> list[Measured]:
    """In the order of the vehicles."""
    found = []
    for column, track in enumerate(tracks.vehicles):
        flew = bool(track.time_s.size)
        error_m = track.error_m
        apart_m = tracks.nearest_m[:, column]
        row = int(np.nanargmin(apart_m)) if np.isfinite(apart_m).any() else None
        found.append(
            Measured(
                flight_time_s=float(track.time_s[-1] - track.time_s[0]) if flew else 0.0,
                rms_m=float(np.sqrt(np.mean(np.square(error_m)))) if flew else None,
                worst_m=float(np.max(error_m)) if flew else None,
                nearest_m=None if row is None else float(apart_m[row]),
                nearest=None if row is None else int(tracks.nearest[row, column]),
            )
        )
    return found


def fleet_record(
    settings: Fleet, outcome: FleetOutcome, folders: Mapping[int, str], measured: Sequence[Measured]
) -> FleetRecord:
    """What `run.json` says of a fleet. `folders`: each vehicle's, relative to the run's, by system id."""
    vehicles = tuple(
        VehicleRecord(
            system_id=flown.system_id,
            folder=folders[flown.system_id],
            wire_hash=flown.wire_hash,
            finished=flown.finished,
            lost=flown.lost,
            links={place: {name: dict(each) for name, each in both.items()} for place, both in flown.link.items()},
            **asdict(numbers),
        )
        for flown, numbers in zip(outcome.vehicles, measured, strict=True)
    )
    return FleetRecord(
        formation=settings.formation,
        spacing_m=settings.spacing_m,
        shared_wind=settings.shared_wind,
        collision_m=settings.collision_m,
        on_collision=settings.on_collision,
        vehicles=vehicles,
        collisions=tuple(CollisionRecord(**each._asdict()) for each in outcome.collisions),
    )


def wire_hash(vehicles: Sequence[VehicleRecord]) -> str:
    """One digest of theirs."""
    return blake2b("".join(each.wire_hash for each in vehicles).encode(), digest_size=16).hexdigest()


def summary(fleet: FleetRecord) -> list[str]:
    """The whole in a few words: outcomes, errors, separation, collisions."""
    vehicles = fleet.vehicles
    flown = [each for each in vehicles if each.finished and not each.lost]
    lost = [each for each in vehicles if each.lost]
    said = [f"{len(flown)} of {len(vehicles)} flown as planned"]
    if lost:
        said.append(f"{len(lost)} lost")
    if errors := [each.rms_m for each in vehicles if each.rms_m is not None]:
        said.append(f"RMSE {median(errors):.3f} m (median; at most {max(errors):.3f} m)")
    apart = [(each.nearest_m, each.system_id, each.nearest) for each in vehicles if each.nearest_m is not None]
    if apart:
        least_m, one, other = min(apart)
        said.append(f"least separation {least_m:.2f} m (vehicles {one} and {other})")
    if fleet.collision_m and len(vehicles) > 1:
        count = len(fleet.collisions)
        said.append("no collision" if not count else f"{count} collision{'' if count == 1 else 's'}")
    return said


def end_of(vehicle: VehicleRecord) -> str:
    """How its flight ended, for a person."""
    if vehicle.lost:
        return f"lost: {vehicle.lost}"
    return "as planned" if vehicle.finished else "not flown to its end"


def render(run: Run, tracks: Tracks) -> str:
    """The page of a fleet's run as text."""
    flight = run.flights[0]
    fleet = flight.fleet
    if fleet is None:
        raise ValueError("a run without a fleet")
    drawings = fleet_figures.drawings(tracks, fleet)
    return template("fleet.html.j2").render(
        run=run,
        flight=flight,
        fleet=fleet,
        end_of=end_of,
        summary=summary(fleet),
        rmse=tables.rows(tracks.rmse(), None),
        links=[(vehicle, row) for vehicle in fleet.vehicles for row in tables.link_rows(vehicle.links)],
        drawings=[(with_ids(each.svg, f"f{index}-"), each) for index, each in enumerate(drawings)],
    )
