"""One self-contained `report.html` for a run: no script, no font, no picture from elsewhere."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mavsitl.keep import replace_file
from mavsitl.log.flight import FlightData, FlightError
from mavsitl.log.ulog import LogError
from mavsitl.px4_modes import NAV_STATES
from mavsitl.report import figures, metrics, tables
from mavsitl.report.figures import CALM, WIND, Drawing
from mavsitl.report.run import FlightRecord, Run, RunError, load_run

if TYPE_CHECKING:
    from jinja2 import Template

REPORT_FILE = "report.html"

# Counterparts in the paper, by path: (figure of calm air, figure of wind) or one for both.
_PAIRS = {"hover": "Set-point hover", "spiral": "Path following: spiral"}
_ATTITUDE = {"hover": ("Fig. 9", "Fig. 10"), "spiral": ("Fig. 13", "Fig. 14")}


@dataclass(frozen=True)
class Shown:
    """A flight with what the page says of it."""

    record: FlightRecord
    data: FlightData
    rmse: metrics.Rmse
    maximum: metrics.MaximumError
    rows: list[tables.Row]

    @property
    def air(self) -> str:
        return "wind" if self.windy else "calm"

    @property
    def windy(self) -> bool:
        return bool(self.record.wind) or self.data.has_wind

    @property
    def colour(self) -> str:
        return WIND if self.windy else CALM

    @property
    def path(self) -> str:
        """``hover`` or ``spiral`` for a flight of the paper's, else empty."""
        return (self.record.paper_case or "").partition("-")[0]

    @property
    def links(self) -> list[tables.LinkRow]:
        """Of the impaired links; empty where none was."""
        return tables.link_rows(self.record.links)

    @property
    def broken(self) -> list[str]:
        """Each failure and when, and what the flight did from the first on; empty where nothing failed."""
        data = self.data
        during = [each for each in data.broken if each.start_s <= data.time_s[-1]]
        if not during:
            return []
        lines = [
            f"{each.what} from {each.start_s:.1f} s on"
            if each.end_s > data.time_s[-1]
            else f"{each.what} from {each.start_s:.1f} s to {each.end_s:.1f} s"
            for each in during
        ]
        since = metrics.aftermath(data, during[0].start_s)
        lines.append(
            f"position error at most {since.position_m:.2f} m, altitude lost {since.altitude_m:.2f} m, "
            f"tilt at most {since.tilt_deg:.0f}°, yaw rate at most {since.yaw_rate_deg_s:.0f}°/s"
        )
        lines += [
            f"{NAV_STATES.get(status.nav_state, f'nav_state {status.nav_state}')}"
            f"{', fail-safe' if status.failsafe else ''}{'' if status.armed else ', disarmed'}"
            f" at {status.time_s:.1f} s"
            for status in data.statuses
            if status.time_s > during[0].start_s
        ]
        return lines

    @property
    def cut_short(self) -> bool:
        return bool(self.data.time_s[-1] < self.record.duration_s - 0.1)


def write_report(run_folder: Path) -> Path:
    """Write `report.html` into the folder of a run and return its path. Raises `RunError` naming what is wrong."""
    run = load_run(run_folder)
    if run.flights and (record := run.flights[0]).fleet is not None:
        from mavsitl.report import fleet  # here, for it needs `template`

        folders = {vehicle.system_id: run_folder / vehicle.folder for vehicle in record.fleet.vehicles}
        return write_page(run_folder, fleet.render(run, fleet.load_tracks(folders, record.duration_s)))
    return write_page(run_folder, render(run, [_load(run_folder, record) for record in run.flights]))


def write_page(folder: Path, page: str) -> Path:
    """`report.html` whole or as it was before; its path. Raises `RunError`."""
    path = folder / REPORT_FILE
    try:
        replace_file(path, page.encode())
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def show(record: FlightRecord, data: FlightData) -> Shown:
    """A flight measured."""
    rmse = metrics.rmse(data)
    return Shown(
        record, data, rmse, metrics.maximum_error(data), tables.rows(rmse, record.paper_case, lost=bool(record.lost))
    )


def render(run: Run, flights: list[Shown]) -> str:
    """The page as text."""
    groups = _groups(flights)
    sections = zip(_titles(groups), groups, strict=True)
    compared = [row for flight in flights for row in flight.rows if row.verdict is not None]
    return template("template.html.j2").render(
        run=run,
        sections=[_section(number, title, group) for number, (title, group) in enumerate(sections)],
        flights=flights,
        compared=len(compared),
        reached=sum(row.verdict != "missed" for row in compared),
        oracles=[flight for flight in flights if flight.record.wind_information == "oracle"],
        symbols=tables.SYMBOLS,
    )


def template(name: str) -> Template:
    """One of this package's, with escaping on and the filter `number`."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    def read(name: str) -> str:
        return resources.files("mavsitl.report").joinpath(name).read_text("utf-8")

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, loader=FunctionLoader(read)
    )
    environment.filters["number"] = tables.number
    environment.filters["ratio"] = tables.ratio
    return environment.get_template(name)


def _load(run_folder: Path, record: FlightRecord) -> Shown:
    try:
        return show(record, FlightData.from_folder(run_folder / record.folder, duration_s=record.duration_s))
    except (FlightError, LogError) as error:
        raise RunError(f"flight {record.name}: {error}") from error


def _groups(flights: list[Shown]) -> list[list[Shown]]:
    """Calm and windy flights of the same path under the same control stand together; all others alone, in order."""
    alike: dict[tuple[object, ...], list[Shown]] = defaultdict(list)
    for flight in flights:
        r = flight.record
        alike[(_path_key(flight), r.airframe, r.level, r.law, r.wind_information, r.seed)].append(flight)
    groups = []
    for group in alike.values():
        if len(group) == 2 and group[0].windy != group[1].windy:
            groups.append(sorted(group, key=lambda flight: flight.windy))
        else:
            groups += [[flight] for flight in group]
    return groups


def _path_key(flight: Shown) -> tuple[object, ...]:
    """One of the paper's paths, or the reference once a second, to the millimetre."""
    seconds = np.arange(0.0, flight.record.duration_s, 1.0)
    data = flight.data
    rows = np.clip(np.searchsorted(data.time_s, seconds - 1e-9), 0, data.time_s.size - 1)
    return (
        (flight.path,)
        if flight.path
        else tuple(np.round(np.nan_to_num(data.position_reference_nwu_m[rows]), 3).ravel().tolist())
    )


def _titles(groups: list[list[Shown]]) -> list[str]:
    """One for each group; what was flown is added where two would be the same."""
    plain = []
    for group in groups:
        own = " / ".join(flight.record.title for flight in group)
        plain.append(_PAIRS.get(group[0].path, own) if len(group) == 2 else own)
    told = []
    for title, group in zip(plain, groups, strict=True):
        record = group[0].record
        how = f" ({record.law}, {record.level}, {record.wind_information}, {record.airframe}, seed {record.seed})"
        told.append(title + how if plain.count(title) > 1 else title)
    return told


def _section(number: int, title: str, group: list[Shown]) -> dict[str, Any]:
    drawings = [drawing for drawing in _drawings(group) if drawing is not None]
    return {
        "id": f"flight-{number}",
        "title": title,
        "table": {"hover": "Table 3", "spiral": "Table 4"}.get(group[0].path, ""),
        "flights": group,
        "drawings": [
            (figures.with_ids(drawing.svg, f"s{number}-{index}-"), drawing) for index, drawing in enumerate(drawings)
        ],
    }


def _drawings(group: list[Shown]) -> list[Drawing | None]:
    path = group[0].path
    lines = [(flight.air, flight.colour, flight.data) for flight in sorted(group, key=lambda flight: not flight.windy)]
    drawn: list[Drawing | None] = [
        figures.wind(flight.data, "Fig. 6" if flight.path else "") for flight in group if flight.windy
    ]
    moving = any(np.ptp(flight.data.position_reference_nwu_m, axis=0).any() for flight in group)
    if moving:
        drawn.append(figures.path_3d(lines, "Fig. 11" if path else ""))
        drawn.append(figures.position(lines, "Fig. 12" if path else ""))
    else:
        drawn.append(figures.altitude(lines, "Fig. 7" if path else ""))
        drawn.append(figures.horizontal(lines, "Fig. 8" if path else ""))
    for flight in group:
        counterpart = _ATTITUDE[path][flight.windy] if path else ""
        drawn.append(figures.attitude(flight.data, flight.colour, flight.air, counterpart))
    drawn += [figures.weights(flight.data, flight.air) for flight in group]
    drawn += [figures.rotors(flight.data, flight.colour, flight.air) for flight in group]
    drawn += [figures.demand(flight.data, flight.colour, flight.air) for flight in group]
    drawn += [figures.link(flight.data, flight.colour, flight.air) for flight in group]
    drawn += [figures.channels(flight.data, flight.air) for flight in group]
    return drawn
