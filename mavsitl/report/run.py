"""A run's folder: `run.json` beside one folder for each flight."""

from __future__ import annotations

from hashlib import blake2b
from pathlib import Path
from typing import Annotated

import msgspec

import mavsitl
from mavsitl.errors import EXIT_USAGE, MavsitlError
from mavsitl.keep import replace_json
from mavsitl.report.metrics import PAPER_TABLES, paper_case
from mavsitl.scenario import Controller, Flight

RUN_FILE = "run.json"


class RunError(MavsitlError, ValueError):
    """A run's folder is not as it should be; the message names the file and what was expected."""


class NoRunError(RunError):
    """What was named is no run's folder."""

    exit_code = EXIT_USAGE


class VehicleRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One vehicle of a fleet. `folder` is relative to the run's and holds `vehicle.ulg` and `ground.ulg`."""

    system_id: int
    folder: str
    wire_hash: str
    finished: bool
    """It flew to the planned end."""
    lost: str = ""
    """How it was lost in flight; empty: it was not."""
    flight_time_s: float
    """0: it was never released."""
    rms_m: float | None
    """Distance of the true position from the reference, from the release on; None: it was never released."""
    worst_m: float | None
    nearest_m: float | None
    """Least distance to another vehicle, from the fleet's first release on; None: there is no other."""
    nearest: int | None
    """That vehicle's system id."""
    links: dict[str, dict[str, dict[str, float]]] = {}
    """As of `FlightRecord`."""


class CollisionRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Two vehicles, by system id, came nearer than the fleet's `collision_m`."""

    time_s: float
    """Simulated."""
    vehicle: int
    other: int
    distance_m: float


class FleetRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a flight of many has beside that of one: the scenario's `[fleet]`, and each vehicle."""

    formation: str
    spacing_m: float
    shared_wind: bool
    collision_m: float
    on_collision: str
    vehicles: tuple[VehicleRecord, ...]
    """In the order of their system ids."""
    collisions: tuple[CollisionRecord, ...] = ()


class FlightRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What was flown. `folder` is relative to the run's and holds `vehicle.ulg` and `ground.ulg`; of a fleet a folder
    for each vehicle, and `lost`, `links` are the vehicles', `wire_hash` is the digest of theirs.
    """

    name: str
    title: str
    folder: str
    seed: int
    airframe: str
    level: str
    law: str
    wind_information: str
    wire_hash: str
    real_time_factor: Annotated[float, msgspec.Meta(ge=0.0)] | None
    """Simulated over wall-clock time; None where it was not measured."""
    scenario_digest: str
    duration_s: Annotated[float, msgspec.Meta(gt=0.0)]
    paper_case: str | None = None
    """The key of `PAPER_TABLES` that the flight answers to."""
    wind: tuple[str, ...] = ()
    """Wind models; empty in calm air."""
    lost: str = ""
    """How the vehicle was lost in flight; empty: it was not."""
    links: dict[str, dict[str, dict[str, float]]] = {}
    """What the vehicle's impaired links did, by place and direction: `mavsitl.link.impaired.Statistics`."""
    dropped: dict[str, int] = {}
    """Input of the vehicle that was not taken, by reason: `mavsitl.codec.Counters`."""
    fleet: FleetRecord | None = None
    """None: a single vehicle flew."""


class Run(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    version: str
    command: str
    created_utc: str
    flights: tuple[FlightRecord, ...]


def new_run(command: str, created_utc: str, flights: tuple[FlightRecord, ...]) -> Run:
    """A run of this version of mavsitl; `created_utc` is text (ISO 8601), the caller having the clock."""
    return Run(version=mavsitl.__version__, command=command, created_utc=created_utc, flights=flights)


def record(
    flight: Flight,
    *,
    folder: str,
    wire_hash: str,
    real_time_factor: float | None,
    lost: str = "",
    links: dict[str, dict[str, dict[str, float]]] | None = None,
    dropped: dict[str, int] | None = None,
    fleet: FleetRecord | None = None,
) -> FlightRecord:
    """What `run.json` says of a flight. The paper has no fleets: one is compared with none of its tables."""
    scenario = flight.scenario
    return FlightRecord(
        name=flight.name,
        title=scenario.title,
        folder=folder,
        seed=scenario.seed,
        airframe=scenario.airframe,
        level="own" if scenario.controller.own else scenario.controller.level,
        law=_law(scenario.controller),
        wind_information="own" if scenario.controller.own else scenario.controller.wind_information,
        wire_hash=wire_hash,
        real_time_factor=real_time_factor,
        scenario_digest=scenario_digest(flight),
        duration_s=scenario.duration_s,
        paper_case=None if fleet else paper_case(scenario),
        wind=tuple(str(model.__struct_config__.tag) for model in scenario.wind),
        lost=lost,
        links=links or {},
        dropped=dropped or {},
        fleet=fleet,
    )


def _law(controller: Controller) -> str:
    if controller.own:
        return controller.own
    return "stock" if controller.level == "attitude" and controller.inner == "stock" else controller.law


def scenario_digest(flight: Flight) -> str:
    """16 hexadecimal digits of the scenario with its airframe, defaults filled in, whatever the file is called."""
    text = msgspec.json.encode((flight.scenario, flight.airframe), order="deterministic")
    return blake2b(text, digest_size=8).hexdigest()


def write_run(folder: Path, run: Run) -> Path:
    """Write `run.json` whole or not at all, making the folder. Raises `RunError`."""
    path = folder / RUN_FILE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        replace_json(path, run)
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def load_run(folder: Path) -> Run:
    """Read `run.json`. Raises `RunError` for a missing or damaged file and for a flight folder that leads elsewhere."""
    path = folder / RUN_FILE
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise NoRunError(f"{path}: not found; expected the folder of a run, with {RUN_FILE} in it") from error
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror or error}") from error
    try:
        run = msgspec.json.decode(data, type=Run)
    except msgspec.ValidationError as error:
        raise RunError(f"{path}: not a run of mavsitl {mavsitl.__version__}: {error}") from error
    except msgspec.DecodeError as error:
        raise RunError(f"{path}: damaged, expected JSON: {error}") from error
    if len(run.flights) > 1 and any(flight.fleet for flight in run.flights):
        raise RunError(f"{path}: {len(run.flights)} flights; expected one, for it is a fleet's")
    for flight in run.flights:
        vehicles = flight.fleet.vehicles if flight.fleet else ()
        for name in (flight.folder, *(vehicle.folder for vehicle in vehicles)):
            inside = (folder / name).resolve()
            if not inside.is_relative_to(folder.resolve()):
                raise RunError(f"{path}: flight {flight.name}: folder {name!r} is outside the run's folder")
            if not inside.is_dir():
                raise RunError(f"{path}: flight {flight.name}: no folder {name!r}; expected one beside {RUN_FILE}")
        if flight.paper_case is not None and flight.paper_case not in PAPER_TABLES:
            allowed = ", ".join(PAPER_TABLES)
            raise RunError(f"{path}: flight {flight.name}: paper_case {flight.paper_case!r} is not one of {allowed}")
    return run
