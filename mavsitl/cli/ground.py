"""`mavsitl ground`."""

from __future__ import annotations

import argparse
from functools import partial
from typing import TYPE_CHECKING, Any

from mavsitl import process
from mavsitl.cli.common import (
    EXIT_FAILED,
    EXIT_OK,
    SYSTEM,
    UsageError,
    add_controller,
    add_scenario,
    command,
    endpoint,
    load,
    settings_of,
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
    from mavsitl.link.address import Address
    from mavsitl.realtime import Wish
    from mavsitl.scenario import Flight


GROUND_HELP = """\
The paper's off-board controller in real time. It waits for a vehicle, streams setpoints, asks for OFFBOARD, arms, flies
the scenario's reference, and lands or disarms. A vehicle that falls silent or restarts is waited for and flown again.
"""

GROUND_EXAMPLES = """\
examples:
  mavsitl ground hover-wind                          listens on udpin:127.0.0.1:14540, as PX4's users expect
  mavsitl ground hover-wind --link udpin:0.0.0.0:14540
  mavsitl ground spiral-calm --link udpout:192.0.2.9:14580 --system 3
  mavsitl ground hover-wind --controller my.py:MyController
  mavsitl ground --monitor udpout:127.0.0.1:14560    tell mavsitl view what only the ground knows
  mavsitl ground formation-spiral --count 9          for nine vehicles, at udpin:127.0.0.1:14540 to 14548
"""


def add(commands: Any) -> None:
    parser = command(commands, "ground", "start the off-board controller alone", GROUND_HELP, GROUND_EXAMPLES)
    add_scenario(parser, "its controller and reference")
    add_controller(parser)
    group = parser.add_argument_group("link")
    group.add_argument(
        "--link",
        metavar="ENDPOINT",
        help="udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or tcpin:HOST:PORT "
        "(default: udpin:127.0.0.1:14540 + I; from I = 10 on udpout:127.0.0.1:14580 + I)",
    )
    group.add_argument(
        "--system",
        type=SYSTEM,
        metavar="ID",
        help="fly only the vehicle with this system id (default: the first heard; with --count, of the first: I + 1)",
    )
    group.add_argument(
        "--count", type=COUNT, metavar="N", help="fly N vehicles in the scenario's formation, each on its own port"
    )
    group.add_argument(
        "--one-link", action="store_true", default=None, help="with --count: all of them are heard at --link"
    )
    group.add_argument(
        "--instance", type=whole(0, 254), default=0, metavar="I",
        help="adds I to the default's port; with --count, of the first vehicle (default: 0)",
    )  # fmt: skip
    group.add_argument(
        "--vehicle",
        metavar="HOST:PORT",
        help="lock-step only: the vehicle's off-board port (default: 127.0.0.1:14580)",
    )
    group.add_argument(
        "--monitor", metavar="ENDPOINT",
        help="tell reference, weights, link and more there, and change the law by CTRL_LAW (default: none; "
        "mavsitl view listens for udpout:127.0.0.1:14560)",
    )  # fmt: skip
    add_end_options(parser)
    parser.set_defaults(run=_ground)


@process.starting()
@tells_logs
def _ground(options: argparse.Namespace) -> int:
    from mavsitl import ends
    from mavsitl.link.address import parse_address

    flight = load(options.scenario, settings_of(options))
    address = parse_address(options.link) if options.link else ends.ground_address(options.instance)
    monitor = parse_address(options.monitor) if options.monitor else None
    check_effect(options, "ground", ("--seed",))
    check_lockstep(
        options,
        real_time_only=("--realtime", "--best-effort", "--monitor"),
        lockstep_only=("--deadline", "--cpu", "--vehicle"),
    )
    wish = wish_for_real_time(options)
    first_id = options.system if options.system is not None else options.instance + 1
    if count := check_fleet(options, first_id):
        return _ground_fleet(options, flight, address, first_id, count, wish, monitor)
    status = Status(options.status == "json", options.run_dir)
    if options.lockstep:
        if not address.kind.startswith("udp"):
            raise UsageError(f"--link {options.link}: with --lockstep it is udpin:HOST:PORT")
        remote = endpoint(options.vehicle or f"127.0.0.1:{ends.OFFBOARD_PORT}", "--vehicle")
        outcome = ends.ground_lockstep(
            flight, (address.host, address.port), remote, options.run_dir,
            vehicle_system_id=options.system, wing=options.wing,
            deadline_s=options.deadline or DEADLINE_S, cpu=options.cpu,
            report=status.say, progress=status.progress,
        )  # fmt: skip
    else:
        text = f"ground ({flight.name}): waiting for a vehicle on {address}; Ctrl-C ends it"
        outcome = ends.ground_realtime(
            flight, address, options.run_dir,
            vehicle_system_id=options.system, wing=options.wing, report=status.say, stop=status.stop, progress=None,
            wish=wish, monitor=monitor, bound=partial(status.start, text),
        )  # fmt: skip
    status.end(outcome)
    return EXIT_OK if outcome.finished or status.stopped else EXIT_FAILED


def _ground_fleet(
    options: argparse.Namespace,
    flight: Flight,
    first: Address,
    system_id: int,
    count: int,
    wish: Wish,
    monitor: Address | None,
) -> int:
    """`first`: where the first vehicle, or all of them, are heard."""
    from mavsitl import ends
    from mavsitl.link.address import Address

    links = 1 if options.one_link else count
    if first.port + links - 1 > 65535:
        raise UsageError(f"--link {first}: {count} vehicles would need ports up to {first.port + links - 1}")
    addresses = [
        Address(first.kind, first.host, first.port + j) if options.link else ends.ground_address(options.instance + j)
        for j in range(links)
    ]
    status = Status(options.status == "json", options.run_dir)
    where = first if links == 1 else f"{first} to {addresses[-1]}"
    text = (
        f"ground ({flight.name}): waiting for vehicles {system_id} to {system_id + count - 1} on {where}; "
        "Ctrl-C ends it"
    )
    outcome = ends.ground_fleet(
        flight, addresses, options.run_dir, count=count, first_system_id=system_id, wing=options.wing,
        report=status.say, stop=status.stop, wish=wish, monitor=monitor, bound=partial(status.start, text),
    )  # fmt: skip
    status.end_fleet(outcome)
    return EXIT_OK if outcome.finished or status.stopped else EXIT_FAILED
