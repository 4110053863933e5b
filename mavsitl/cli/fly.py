"""`mavsitl fly`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavsitl.cli.common import (
    EXIT_FAILED,
    EXIT_OK,
    PAPER_SCENARIOS,
    UsageError,
    add_controller,
    add_json,
    add_scenario_options,
    command,
    command_line,
    interrupt,
    load,
    logs_in,
    on_signals,
    print_json,
    run_folder,
    settings_of,
)
from mavsitl.cli.ends import COUNT

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

    from mavsitl.report.run import FleetRecord, FlightRecord
    from mavsitl.report.tables import Row
    from mavsitl.scenario import Flight


FLY_HELP = """\
Fly scenarios: for each, a vehicle process and a ground process are started, connected over UDP on loopback, and run in
lock-step faster than real time. Without a scenario the paper's four experiments are flown: hover and spiral, each in
calm air and in Dryden wind.

The run folder gets, for each flight, vehicle.ulg and ground.ulg (PX4's log format), link.tlog (every datagram), and for
all together run.json and report.html, one self-contained page.
"""

FLY_EXAMPLES = """\
examples:
  mavsitl fly                                        the paper's four experiments
  mavsitl fly hover-wind --law pid                   one of them with the plain PID
  mavsitl fly my.toml --seed 7 --level attitude      a file of your own
  mavsitl fly hover-wind --set noise.position_m=0.02 --set offnominal.mass_scale=1.3
  mavsitl fly spiral-wind --controller my.py:MyController
  mavsitl fly --in-memory                            one process, no sockets, the same bytes
  mavsitl fly formation-spiral --count 9             nine vehicles and their controllers in one process
"""


def add(commands: Any) -> None:
    parser = command(
        commands, "fly", "fly scenarios with two processes in lock-step, and report", FLY_HELP, FLY_EXAMPLES
    )
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help="a shipped scenario's name or a .toml file")
    add_scenario_options(parser)
    add_controller(parser)
    group = parser.add_argument_group("run")
    group.add_argument("--run-dir", type=Path, metavar="DIR", help="run folder (default: runs/<UTC time>)")
    group.add_argument("--in-memory", action="store_true", help="both ends in one process, no sockets; the same bytes")
    group.add_argument(
        "--count", type=COUNT, metavar="N",
        help="a formation of N vehicles, each with its controller, in one process",
    )  # fmt: skip
    group.add_argument("--no-report", action="store_true", help="logs and tables only")
    add_json(group, "the result")
    parser.set_defaults(run=_fly)


def _fly(options: argparse.Namespace) -> int:
    from mavsitl import controllers
    from mavsitl.cli import screen
    from mavsitl.clock import utc_stamp
    from mavsitl.report import run as runs

    on_signals(interrupt)
    settings = settings_of(options)
    names = options.scenarios or list(PAPER_SCENARIOS)
    flights = [load(name, settings) for name in names]
    for flight in flights:
        if flight.scenario.controller.own:
            controllers.make(flight)  # before anything is started
    if options.count is not None:
        return _fly_fleet(options, flights)
    created = utc_stamp()
    folder = run_folder(options.run_dir, created)
    console = screen.console(stderr=options.json)
    records: list[FlightRecord] = []
    with logs_in(folder):
        with screen.flight_progress(console) as bar:
            for index, (name, flight) in enumerate(zip(names, flights, strict=True)):
                alone = [other.name for other in flights].count(flight.name) == 1
                title = flight.name if alone else f"{flight.name}-{index + 1}"
                task = bar.add_task(f"{title:20s}", total=flight.scenario.duration_s, said="starting")
                flown = _fly_one(name, flight, settings, folder / title, options.in_memory, bar, task)
                records.append(runs.record(flight, folder=title, **flown))
                runs.write_run(folder, runs.new_run(command_line(), created, tuple(records)))
        return _show(console, options, folder, records)


def _fly_fleet(options: argparse.Namespace, flights: list[Flight]) -> int:
    """A formation in memory."""
    from mavsitl import ends
    from mavsitl.cli import screen
    from mavsitl.clock import utc_stamp
    from mavsitl.report import fleet, tables
    from mavsitl.report import run as runs
    from mavsitl.report.html import write_page

    if len(flights) != 1:
        raise UsageError(f"--count: name one scenario, such as formation-spiral; {len(flights)} were to fly")
    (flight,) = flights
    created = utc_stamp()
    folder = run_folder(options.run_dir, created)
    title = f"{flight.name}, {options.count} vehicles"
    console = screen.console(stderr=options.json)
    with logs_in(folder), screen.console(stderr=True).status(title) as shown:

        def move(time_s: float) -> None:
            shown.update(f"{title}: {max(time_s, 0.0):.1f} s")

        outcome = ends.fleet_in_memory(
            flight, folder / flight.name, count=options.count, report=lambda text: None, progress=move
        )
        shown.update(f"{title}: reading the logs")
        names = {each.system_id: f"{flight.name}/vehicle-{each.system_id - 1}" for each in outcome.vehicles}
        paths = {number: folder / name for number, name in names.items()}
        tracks = fleet.load_tracks(paths, flight.scenario.duration_s)
        flown = fleet.fleet_record(flight.scenario.fleet, outcome, names, fleet.measure(tracks))
        record = runs.record(
            flight, folder=flight.name, wire_hash=fleet.wire_hash(flown.vehicles), real_time_factor=outcome.speed,
            dropped=outcome.dropped, fleet=flown,
        )  # fmt: skip
        run = runs.new_run(command_line(), created, (record,))
        runs.write_run(folder, run)
        page = None if options.no_report else write_page(folder, fleet.render(run, tracks))
    if options.json:
        results = _as_json([(record, tables.rows(tracks.rmse(), None))])
        print_json(outcome.as_event() | {"folder": str(folder), "flights": results})
    else:
        _show_fleet(console, record, flown)
    if page is not None:
        screen.line(console, f"report: {page}")
    screen.line(console, f"logs:   {folder}")
    lost = [vehicle for vehicle in flown.vehicles if vehicle.lost]
    for vehicle in lost:
        said = f"vehicle {vehicle.system_id} was lost after {vehicle.flight_time_s:.1f} s: {vehicle.lost}"
        screen.line(console, f"{said}\nlook at: mavsitl log info {folder / vehicle.folder}", "bold red")
    return EXIT_FAILED if lost or not outcome.finished else EXIT_OK


def _fly_one(
    name: str, flight: Flight, settings: list[str], folder: Path, in_memory: bool, bar: Progress, task: TaskID
) -> dict[str, Any]:
    """One flight; what `run.record` wants to know of it."""
    from mavsitl import pair

    def move(time_s: float) -> None:
        bar.update(task, completed=max(time_s, 0.0), said=f"{max(time_s, 0.0):5.1f} s")

    def say(text: str) -> None:
        """A line beside the bar; what has more, a traceback, above it."""
        bar.update(task, said=text.partition("\n")[0])
        if "\n" in text:
            bar.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def on_event(end: str, event: dict[str, Any]) -> None:
        if event["event"] == "progress" and end == "vehicle":
            move(event["flight_time_s"])
        elif event["event"] == "report":
            say(event["text"])

    if in_memory:
        from mavsitl import ends

        outcome = ends.in_memory(flight, folder, report=say, progress=move)
        if not outcome.finished and not outcome.lost:
            raise pair.PairError(f"{flight.name}: the flight did not end as planned")
        wire_hash, speed, lost = outcome.wire_hash, outcome.speed, outcome.lost
        dropped, links = outcome.dropped, outcome.links
    else:
        result = pair.fly(name, settings, folder, on_event)
        said, lost = result.vehicle, result.ground.get("lost", "")
        wire_hash, speed, dropped = said["wire_hash"], said["speed"], said["dropped"]
        links = {"link": said["link"]} if "link" in said else {}
    if lost:
        bar.update(task, said="lost")
    else:
        bar.update(task, completed=flight.scenario.duration_s, said=f"{speed:.0f} x real time")
    return {
        "wire_hash": wire_hash, "real_time_factor": speed, "lost": lost, "links": links, "dropped": dropped,
    }  # fmt: skip


def _show(console: Console, options: argparse.Namespace, folder: Path, records: list[FlightRecord]) -> int:
    """What came of the flights, from their logs: tables or JSON, the page, and where all of it is."""
    from mavsitl.cli import screen
    from mavsitl.log.flight import FlightData
    from mavsitl.report import tables
    from mavsitl.report.metrics import rmse

    results = []
    lost = []
    for record in records:
        data = FlightData.from_folder(folder / record.folder, duration_s=record.duration_s)
        results.append((record, tables.rows(rmse(data), record.paper_case, lost=bool(record.lost))))
        if record.lost:
            said = f"{record.name} was lost after {data.time_s[-1]:.1f} s: {record.lost}"
            lost.append(f"{said}\nlook at: mavsitl log info {folder / record.folder}")
    if options.json:
        print_json({"folder": str(folder), "flights": _as_json(results)})
    else:
        for record, rows in results:
            _show_flight(console, record, rows)
    if not options.no_report:
        from mavsitl.report.html import write_report

        screen.line(console, f"report: {write_report(folder)}")
    screen.line(console, f"logs:   {folder}")
    for text in lost:
        screen.line(console, text, "bold red")
    return EXIT_FAILED if lost else EXIT_OK


def _show_flight(console: Console, record: FlightRecord, rows: list[Row]) -> None:
    """Its root mean square errors beside the paper's, and what its links did."""
    from rich.markup import escape

    from mavsitl.cli import screen
    from mavsitl.report import tables

    wind = "ORACLE (true wind)" if record.wind_information == "oracle" else record.wind_information
    facts = f"{record.law}, {record.level}, wind information: {wind}, seed {record.seed}"
    console.print(f"\n[bold]{escape(record.title)}[/]  {facts}", soft_wrap=True)
    columns = ("RMSE", "ours") if record.paper_case is None else ("RMSE", "ours", "paper", "ours / paper")
    table = screen.table(*columns, right=columns[1:])
    for row in rows:
        cells = [row.state, tables.number(row.ours)]
        if row.paper is not None and row.ratio is not None and row.verdict is not None:
            style = {"beaten": "green", "met": "green", "missed": "yellow"}[row.verdict]
            cells += [tables.number(row.paper), f"[{style}]{tables.ratio(row.ratio)} {tables.SYMBOLS[row.verdict]}[/]"]
        table.add_row(*cells)
    console.print(table)
    for link in tables.link_rows(record.links):
        screen.line(console, f"link {link}")


def _show_fleet(console: Console, record: FlightRecord, flown: FleetRecord) -> None:
    """A row for each vehicle, and what came of all."""
    from rich.markup import escape

    from mavsitl.cli import screen
    from mavsitl.report import fleet, tables

    speed = f"{record.real_time_factor:.1f} x real time"
    console.print(f"\n[bold]{escape(record.title)}[/]  {record.law}, {record.level}, seed {record.seed}, {speed}")
    numbers = ("vehicle", "flown / s", "RMSE / m", "worst / m", "nearest / m", "to")
    impaired = any(vehicle.links for vehicle in flown.vehicles)
    links = ("lost to ground / %", "to vehicle / %") if impaired else ()
    table = screen.table(*numbers, *links, "end", right=(*numbers, *links))
    for vehicle in flown.vehicles:
        lost = [f"{100.0 * (row.lost + row.outage):.1f}" for row in tables.link_rows(vehicle.links)]
        table.add_row(
            str(vehicle.system_id), f"{vehicle.flight_time_s:.1f}",
            *("-" if each is None else tables.number(each) for each in (vehicle.rms_m, vehicle.worst_m)),
            "-" if vehicle.nearest_m is None else tables.number(vehicle.nearest_m), str(vehicle.nearest or "-"),
            *(lost if impaired else ()), escape(fleet.end_of(vehicle)),
        )  # fmt: skip
    console.print(table)
    for each in flown.collisions:
        where = f"vehicles {each.vehicle} and {each.other} at t = {each.time_s:.2f} s: {each.distance_m:.2f} m"
        screen.line(console, f"collision of {where}")
    screen.line(console, ", ".join(fleet.summary(flown)))


def _as_json(results: list[tuple[FlightRecord, list[Row]]]) -> list[dict[str, Any]]:
    return [
        {
            "flight": record,
            "rmse": [{"state": row.state, "ours": row.ours, "paper": row.paper, "ratio": row.ratio} for row in rows],
        }
        for record, rows in results
    ]
