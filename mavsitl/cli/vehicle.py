"""`mavsitl vehicle`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavsitl import process
from mavsitl.cli.common import (
    EXIT_OK,
    PORT,
    SLOWEST_SPEED,
    SYSTEM,
    UsageError,
    add_scenario,
    command,
    endpoint,
    load,
    settings_of,
    speed_factor,
    whole,
)
from mavsitl.cli.ends import (
    COUNT,
    DEADLINE_S,
    Status,
    add_end_options,
    check_effect,
    check_fleet,
    check_lockstep,
    tells_logs,
    wish_for_real_time,
)

if TYPE_CHECKING:
    from mavsitl.ends import VehicleLinks
    from mavsitl.realtime import Wish
    from mavsitl.scenario import Flight


VEHICLE_HELP = """\
A simulated PX4-like vehicle in real time. Like PX4 SITL it binds UDP 18570 and sends to 14550 (ground stations), binds
14580 and sends to 14540 (off-board and companion computers), and speaks first. Whoever sends a valid MAVLink frame to
either port is answered too. It binds loopback; --bind opens it to a network, where plain MAVLink has no authentication:
everybody who can reach the port can fly the vehicle. So it needs signed messages there, or --insecure.
"""

VEHICLE_EXAMPLES = """\
examples:
  mavsitl vehicle                                    a vehicle on the ground, in calm air, on PX4's ports
  mavsitl vehicle hover-wind --instance 1            a second one: ports 18571, 14581, system id 2
  mavsitl vehicle hover-wind --bind 0.0.0.0 --insecure --offboard-remote 192.0.2.7:14540
  mavsitl vehicle --chaos ack-first-lost --chaos ftp-drops:0.3@gcs
  mavsitl vehicle formation-spiral --count 9         nine in one process: system ids 1 to 9, ports 14580 to 14588
  mavsitl vehicle formation-spiral --count 9 --one-link   nine behind the first one's ports
"""


def add(commands: Any) -> None:
    parser = command(commands, "vehicle", "start a vehicle alone", VEHICLE_HELP, VEHICLE_EXAMPLES)
    add_scenario(parser, "its airframe, air, start")
    group = parser.add_argument_group("link")
    group.add_argument(
        "--instance",
        type=whole(0, 254),
        default=0,
        metavar="I",
        help="adds I to the ports and to the system id, as PX4's instances",
    )
    group.add_argument(
        "--system", type=SYSTEM, metavar="ID", help="MAVLink system id, 1 to 255 (default: instance + 1)"
    )
    group.add_argument(
        "--count", type=COUNT, metavar="N",
        help="N vehicles in this process, the instances I and after it: each further one adds 1 to ports and system id",
    )  # fmt: skip
    group.add_argument(
        "--one-link", action="store_true", default=None,
        help="with --count: all behind the first one's ports, told apart by system id",
    )  # fmt: skip
    group.add_argument(
        "--bind", default="127.0.0.1", metavar="HOST", help="local address of all links (default: 127.0.0.1)"
    )
    group.add_argument(
        "--insecure", action="store_true",
        help="with --bind: open to a network without signed messages, to everybody who can reach it",
    )  # fmt: skip
    group.add_argument(
        "--offboard-port", type=PORT, metavar="N", help="local port of the off-board link (default: 14580 + I)"
    )
    group.add_argument(
        "--offboard-remote",
        metavar="HOST:PORT",
        help="where it sends first (default: 127.0.0.1:14540 + I, at most 14549)",
    )
    group.add_argument(
        "--gcs-port", type=PORT, metavar="N", help="local port of the ground-station link (default: 18570 + I)"
    )
    group.add_argument("--gcs-remote", metavar="HOST:PORT", help="where it sends first (default: 127.0.0.1:14550)")
    group.add_argument(
        "--tcp-port", type=PORT, metavar="N", help="also a TCP server for ground stations, e.g. 5760 (default: none)"
    )
    add_end_options(parser)
    group = parser.add_argument_group("state")
    group.add_argument(
        "--state-dir", type=Path, metavar="DIR",
        help="keeps parameters, missions and the card (default: in the user's data folder, by system id)",
    )  # fmt: skip
    group.add_argument("--no-state", action="store_true", default=None, help="begin fresh and keep nothing")
    parser.add_argument(
        "--speed",
        type=speed_factor,
        metavar="X",
        help=f"simulated over wall time, {SLOWEST_SPEED:g} or more: slower, the 1 Hz HEARTBEAT "
        "would count as lost (default: 1)",
    )
    parser.add_argument(
        "--chaos", action="append", metavar="MODE",
        help="misbehave in this way, NAME[:ARGUMENT...][@PORT]; 'mavsitl chaos' lists all; may be repeated",
    )  # fmt: skip
    parser.add_argument("--until-disarmed", action="store_true", default=None, help="end after the first flight")
    parser.set_defaults(run=_vehicle)


@process.starting()
@tells_logs
def _vehicle(options: argparse.Namespace) -> int:
    from mavsitl import ends

    flight = _with_chaos(load(options.scenario, settings_of(options)), options.chaos or ())
    instance = options.instance
    system_id = options.system if options.system is not None else instance + 1
    offboard_remote = options.offboard_remote or f"127.0.0.1:{ends.offboard_remote_port(instance)}"
    links = ends.VehicleLinks(
        bind=options.bind,
        offboard_port=options.offboard_port if options.offboard_port is not None else ends.OFFBOARD_PORT + instance,
        offboard_remote=endpoint(offboard_remote, "--offboard-remote"),
        gcs_port=options.gcs_port if options.gcs_port is not None else ends.GCS_PORT + instance,
        gcs_remote=endpoint(options.gcs_remote or f"127.0.0.1:{ends.GCS_REMOTE_PORT}", "--gcs-remote"),
        tcp_port=options.tcp_port,
        insecure=options.insecure,
    )
    check_effect(options, "vehicle", ("--duration", "--wind-information"))
    if options.insecure and ends.is_loopback(links.bind):
        raise UsageError("--insecure: only with --bind and an address that is not loopback")
    check_lockstep(
        options,
        real_time_only=(
            "--speed", "--until-disarmed", "--gcs-port", "--gcs-remote", "--tcp-port", "--state-dir", "--no-state",
            "--chaos", "--realtime", "--best-effort",
        ),
        lockstep_only=("--deadline", "--cpu"),
    )  # fmt: skip
    wish = wish_for_real_time(options)
    if count := check_fleet(options, system_id):
        return _fleet(options, flight, links, system_id, count, wish)
    status = Status(options.status == "json", options.run_dir)
    if options.lockstep:
        outcome = ends.vehicle_lockstep(
            flight,
            links,
            options.run_dir,
            system_id=system_id,
            wing=options.wing,
            deadline_s=options.deadline or DEADLINE_S,
            cpu=options.cpu,
            report=status.say,
            progress=status.progress,
        )
    else:
        text = (
            f"vehicle {system_id} ({flight.name}): off-board {links.bind}:{links.offboard_port} -> {offboard_remote}, "
            f"ground station {links.bind}:{links.gcs_port} -> {links.gcs_remote[0]}:{links.gcs_remote[1]}; "
            "Ctrl-C ends it"
        )
        outcome = ends.vehicle_realtime(
            flight, links, options.run_dir, system_id=system_id, wing=options.wing, speed=options.speed or 1.0,
            until_finished=bool(options.until_disarmed), state=_state_folder(options, system_id),
            report=status.say, stop=status.stop, progress=None, wish=wish,
            bound=partial(_tell_start, status, flight, text),
        )  # fmt: skip
    status.end(outcome)
    return EXIT_OK


def _tell_start(status: Status, flight: Flight, text: str) -> None:
    status.start(text)
    for window in flight.scenario.chaos:
        status.say(f"misbehaves: {window.mode} on port {window.port}")


def _with_chaos(flight: Flight, modes: Sequence[str]) -> Flight:
    """The scenario's, and these from the start on. Raises `ChaosError`."""
    if not modes:
        return flight
    import msgspec

    from mavsitl.chaos.table import parse
    from mavsitl.scenario import ChaosWindow

    entries = [{"mode": mode.partition("@")[0], "port": parse(mode).port} for mode in modes]
    added = msgspec.convert(entries, tuple[ChaosWindow, ...])
    scenario = msgspec.structs.replace(flight.scenario, chaos=flight.scenario.chaos + added)
    return msgspec.structs.replace(flight, scenario=scenario)


def _state_folder(options: argparse.Namespace, system_id: int) -> Path | None:
    if options.no_state:
        if options.state_dir is not None:
            raise UsageError("--state-dir: not with --no-state")
        return None
    if options.state_dir is not None:
        folder: Path = options.state_dir
        return folder
    from platformdirs import user_data_path

    return user_data_path("mavsitl", appauthor=False) / f"vehicle-{system_id}"


def _fleet(
    options: argparse.Namespace, flight: Flight, first: VehicleLinks, system_id: int, count: int, wish: Wish
) -> int:
    """`first`: the links of the first vehicle."""
    import dataclasses

    from mavsitl import ends

    if options.tcp_port is not None and not options.one_link:
        raise UsageError("--tcp-port: with --count only with --one-link")
    host, port = first.offboard_remote

    def remote(j: int) -> int:
        return port + j if options.offboard_remote else ends.offboard_remote_port(options.instance + j)

    links = [
        dataclasses.replace(
            first, offboard_port=first.offboard_port + j, offboard_remote=(host, remote(j)), gcs_port=first.gcs_port + j
        )
        for j in range(1 if options.one_link else count)
    ]
    last = links[-1]
    for name, used in (
        ("--offboard-port", last.offboard_port),
        ("--offboard-remote", last.offboard_remote[1]),
        ("--gcs-port", last.gcs_port),
    ):
        if used > 65535:
            raise UsageError(f"{name}: {count} vehicles would need ports up to {used}; allowed: up to 65535")
    status = Status(options.status == "json", options.run_dir)
    where = "all on one link" if options.one_link else "each further one's ports 1 higher"
    text = (
        f"vehicles {system_id} to {system_id + count - 1} ({flight.name}): "
        f"off-board {first.bind}:{first.offboard_port} -> {host}:{port}, ground station {first.bind}:{first.gcs_port} "
        f"-> {first.gcs_remote[0]}:{first.gcs_remote[1]}, {where}; Ctrl-C ends it"
    )
    outcome = ends.fleet_realtime(
        flight, links, options.run_dir, count=count, system_id=system_id, wing=options.wing,
        speed=options.speed or 1.0, until_finished=bool(options.until_disarmed),
        states=_fleet_states(options, system_id, count), report=status.say, stop=status.stop, progress=None, wish=wish,
        bound=partial(_tell_start, status, flight, text),
    )  # fmt: skip
    status.end_fleet(outcome)
    return EXIT_OK


def _fleet_states(options: argparse.Namespace, system_id: int, count: int) -> list[Path | None]:
    """Of each vehicle: in ``instance-<I>`` of a folder that is named, else where it would be of each alone."""
    folders: list[Path | None] = []
    for each in range(system_id, system_id + count):
        folder = _state_folder(options, each)
        folders.append(folder if folder is None or options.state_dir is None else folder / f"instance-{each - 1}")
    return folders
