"""`mavsitl link`, `inject` and `param`: a question or wish to a vehicle that runs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mavsitl.cli.common import (
    EXIT_FAILED,
    EXIT_OK,
    SYSTEM,
    UsageError,
    above_zero,
    add_json,
    command,
    not_negative,
    print_json,
    share,
    whole,
)
from mavsitl.errors import did_you_mean

if TYPE_CHECKING:
    from mavsitl.ask import Reply, Task


ASK_EPILOG = """
Exit codes: 0 done; 1 refused, or no answer (the message says by whom and what to do); 2 wrong arguments.
"""

ANSWER_S = 5.0

LINK_HELP = """\
Show what is done to the messages on a link of a running vehicle, or change it, for what is sent from now on. Without
--gcs it is the off-board link, spoken to over the ground stations' port; with --gcs it is the ground stations' links,
UDP and TCP, spoken to over the off-board port: who cuts the link that he speaks on cannot mend it.

These are the parameters SIM_LINK_* and SIM_GLINK_*. What a link has from its scenario stays where nothing is said
here; --reset makes it perfect except for the scenario's outages and its changes to come.
"""

LINK_EXAMPLES = """\
examples:
  mavsitl link                                       the present settings
  mavsitl link --latency 40 --jitter 10 --loss 0.05
  mavsitl link --burst 200 --direction to-vehicle
  mavsitl link --down                                an outage, until
  mavsitl link --up
  mavsitl link --gcs --reset
"""

LINK_DIRECTIONS = {"both": 0.0, "to-ground": 1.0, "to-vehicle": 2.0}

LINK_OPTIONS = {
    "direction": "DIR", "latency": "LAT", "jitter": "JIT", "loss": "LOSS", "burst": "BURST", "good": "GOOD",
    "reorder": "REORD", "duplicate": "DUP", "corrupt": "CORR", "bandwidth": "BW", "down": "DOWN",
}  # fmt: skip
"""Option to the end of the parameter's name, in the order in which they are set: an outage last."""

INJECT_HELP = """\
Break a part of a running vehicle, or mend it, by MAV_CMD_INJECT_FAILURE, which PX4 has in its simulations too. UNIT and
TYPE are MAVLink's FAILURE_UNIT and FAILURE_TYPE, INSTANCE counts from 1; 0 is all. SYS_FAILURE_EN must be 1. What a
vehicle cannot do it answers with UNSUPPORTED.
"""

INJECT_EXAMPLES = """\
examples:
  mavsitl param set SYS_FAILURE_EN=1
  mavsitl inject gps off
  mavsitl inject motor off 2
  mavsitl inject gps ok
  mavsitl inject --list
"""

PARAM_HELP = """\
Read and set parameters of a running vehicle, by the parameter protocol. Several are set in the order given, up to the
first that is refused.
"""

PARAM_EXAMPLES = """\
examples:
  mavsitl param get COM_OF_LOSS_T NAV_DLL_ACT
  mavsitl param set COM_OF_LOSS_T=0.5
  mavsitl param list "SIM_*"
"""


def add_link(commands: Any) -> None:
    parser = command(
        commands, "link", "make the links of a running vehicle bad, and good again", LINK_HELP,
        LINK_EXAMPLES + ASK_EPILOG,
    )  # fmt: skip
    parser.add_argument("--gcs", action="store_true", help="the ground stations' links (default: the off-board link)")
    group = parser.add_argument_group("settings")
    for option, metavar, text in (
        ("--latency", "MS", "delay each way"),
        ("--jitter", "MS", "of the delay: 1 sigma, or half the width, by the scenario's distribution"),
        ("--loss", "P", "share of messages lost, each for itself, 0 to 1"),
        ("--burst", "MS", "mean length of a burst of losses; 0: none"),
        ("--good", "MS", "mean time between two bursts"),
        ("--reorder", "P", "share held back, so that later ones overtake"),
        ("--duplicate", "P", "share that comes twice"),
        ("--corrupt", "P", "share with flipped bits"),
        ("--bandwidth", "KBIT_S", "0: unlimited"),
    ):
        group.add_argument(option, type=share if metavar == "P" else not_negative, metavar=metavar, help=text)
    group.add_argument("--direction", choices=tuple(LINK_DIRECTIONS), help="for which all of these hold")
    outage = group.add_mutually_exclusive_group()
    outage.add_argument("--down", dest="down", action="store_const", const=1.0, help="nothing comes through")
    outage.add_argument("--up", dest="down", action="store_const", const=0.0, help="the end of --down")
    group.add_argument("--reset", action="store_true", help="first make it perfect")
    _add_ask_options(parser, "udpout:127.0.0.1:18570 + I; with --gcs 14580 + I")
    parser.set_defaults(run=_link)


def add_inject(commands: Any) -> None:
    parser = command(commands, "inject", "break a part of a running vehicle", INJECT_HELP, INJECT_EXAMPLES + ASK_EPILOG)
    parser.add_argument("unit", nargs="?", metavar="UNIT", help="for example gps, motor, battery, mavlink; see --list")
    parser.add_argument("type", nargs="?", metavar="TYPE", help="ok mends it; off, stuck, garbage, wrong, slow, ...")
    parser.add_argument(
        "number", nargs="?", type=whole(0, 255), default=0, metavar="INSTANCE", help="1 the first; 0: all (default)"
    )
    parser.add_argument("--list", action="store_true", help="list the names of units and types")
    _add_ask_options(parser, "udpout:127.0.0.1:18570 + I")
    parser.set_defaults(run=_inject)


def add_param(commands: Any) -> None:
    parser = command(
        commands, "param", "read and set parameters of a running vehicle", PARAM_HELP, PARAM_EXAMPLES + ASK_EPILOG
    )
    parser.add_argument(
        "action",
        choices=("get", "set", "list"),
        metavar="{get,set,list}",
        help="list: all, or what matches a pattern",
    )
    parser.add_argument("names", nargs="*", metavar="NAME[=VALUE]", help="with list a pattern such as 'SIM_*'")
    _add_ask_options(parser, "udpout:127.0.0.1:18570 + I")
    parser.set_defaults(run=_param)


def _add_ask_options(parser: argparse.ArgumentParser, default: str) -> None:
    group = parser.add_argument_group("vehicle")
    group.add_argument(
        "--endpoint", metavar="ENDPOINT",
        help=f"udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or tcpin:HOST:PORT (default: {default})",
    )  # fmt: skip
    group.add_argument(
        "--instance", type=whole(0, 254), default=0, metavar="I", help="adds I to the default's port (default: 0)"
    )
    group.add_argument("--system", type=SYSTEM, metavar="ID", help="only this vehicle (default: the first heard)")
    group.add_argument(
        "--timeout", type=above_zero, default=ANSWER_S, metavar="S",
        help=f"seconds to wait for the vehicle, and for each answer (default: {ANSWER_S:g})",
    )  # fmt: skip
    add_json(parser, "the reply")


def _link(options: argparse.Namespace) -> int:
    from msgspec.structs import replace

    from mavsitl import ends
    from mavsitl.ask import ParameterTask
    from mavsitl.link.settings import PREFIXES, initial
    from mavsitl.scenario import LinkModel

    prefix = PREFIXES["gcs_link" if options.gcs else "link"]
    wanted: dict[str, float] = {}
    if options.reset:
        perfect = initial(LinkModel())
        wanted = {name: perfect[name] for name in LINK_OPTIONS.values()}
    for option, name in LINK_OPTIONS.items():
        value = getattr(options, option)
        if value is not None:
            wanted[name] = LINK_DIRECTIONS[value] if option == "direction" else value
    names = list(wanted) or list(LINK_OPTIONS.values())
    task = ParameterTask([(prefix + name, wanted.get(name)) for name in names])
    reply = _ask(options, task, ends.OFFBOARD_PORT if options.gcs else None)
    if not reply.ok and reply.vehicle is not None and wanted.get("DOWN"):
        other = options.instance + (ends.OFFBOARD_PORT if options.gcs else ends.GCS_PORT)
        hint = f"an outage of the link that is spoken on has no answer; over --endpoint udpout:127.0.0.1:{other} it has"
        reply = replace(reply, problem=f"{reply.problem} ({hint})")

    def show() -> None:
        for option, name in LINK_OPTIONS.items():
            value = reply.parameters.get(prefix + name)
            if value is not None:
                told = f"{value:g}"
                if option == "direction":
                    told = next((text for text, number in LINK_DIRECTIONS.items() if number == value), told)
                print(f"{prefix + name:16s} {option:10s} {told}")

    return _tell(options, reply, show)


def _inject(options: argparse.Namespace) -> int:
    from mavsitl import ask
    from mavsitl.dialect import mavlink

    units, kinds = ask.failure_units(), ask.failure_kinds()
    if options.list:
        if options.json:
            print_json({"units": units, "types": kinds})
        else:
            print(f"units: {', '.join(units)}\ntypes: {', '.join(kinds)}")
        return EXIT_OK
    for what, name, known in (("UNIT", options.unit, units), ("TYPE", options.type, kinds)):
        if name is None:
            raise UsageError(f"{what}: missing; allowed: {', '.join(known)}")
        if name not in known:
            meant = did_you_mean(name, known)
            raise UsageError(f"{what}: {name!r} is not allowed; {meant}allowed: {', '.join(known)}")
    params = (float(units[options.unit]), float(kinds[options.type]), float(options.number))
    reply = _ask(options, ask.CommandTask(mavlink.MAV_CMD_INJECT_FAILURE, *params))
    which = f" {options.number}" if options.number else ""
    return _tell(options, reply, lambda: print(f"{options.unit}{which} {options.type}: {reply.result.lower()}"))


def _param(options: argparse.Namespace) -> int:
    from fnmatch import fnmatchcase

    from msgspec.structs import replace

    from mavsitl.ask import ListTask, ParameterTask

    if options.action == "list":
        if len(options.names) > 1:
            raise UsageError(f"list: one pattern at most, not {len(options.names)}")
        task: Task = ListTask()
    else:
        if not options.names:
            raise UsageError(f"{options.action}: name at least one parameter")
        try:
            task = ParameterTask([_wish(text, options.action == "set") for text in options.names])
        except ValueError as error:
            raise UsageError(str(error)) from error
    reply = _ask(options, task)
    if options.action == "list" and options.names:
        pattern = options.names[0]
        found = {name: value for name, value in reply.parameters.items() if fnmatchcase(name, pattern)}
        problem = reply.problem or ("" if found else f"vehicle {reply.vehicle} has no parameter like {pattern!r}")
        reply = replace(reply, ok=not problem, parameters=found, problem=problem)

    def show() -> None:
        for name, value in reply.parameters.items():
            print(f"{name:16s} {value:.7g}" if isinstance(value, float) else f"{name:16s} {value}")

    return _tell(options, reply, show)


def _wish(text: str, to_set: bool) -> tuple[str, float | None]:
    name, equals, value = text.partition("=")
    if not to_set:
        if equals:
            raise UsageError(f"{text}: get takes a name alone; mavsitl param set {text} sets it")
        return name, None
    if not equals:
        raise UsageError(f"{text}: not NAME=VALUE")
    try:
        return name, int(value)
    except ValueError:
        pass
    try:
        number = float(value)
    except ValueError:
        raise UsageError(f"{text}: {value!r} is not a number") from None
    return name, number


def _ask(options: argparse.Namespace, task: Task, port: int | None = None) -> Reply:
    """The vehicle's answer; `port`: of loopback, plus the instance, where no endpoint is named."""
    from msgspec.structs import replace

    from mavsitl import ends
    from mavsitl.link.address import parse_address

    if options.endpoint is not None and options.instance:
        raise UsageError("--instance: not with --endpoint, which names the port itself")
    port = ends.GCS_PORT if port is None else port
    address = parse_address(options.endpoint or f"udpout:127.0.0.1:{port + options.instance}")
    reply = ends.ask(task, address, system_id=options.system, patience_s=options.timeout)
    return reply if reply.ok else replace(reply, problem=f"{address}: {reply.problem}")


def _tell(options: argparse.Namespace, reply: Reply, done: Callable[[], None]) -> int:
    """Print the reply; `done` prints what a person wants to see of one that is good."""
    if options.json:
        print_json(reply)
        return EXIT_OK if reply.ok else EXIT_FAILED
    if reply.ok:
        done()
    for text in reply.texts:
        print(f"vehicle {reply.vehicle} says: {text}", file=sys.stdout if reply.ok else sys.stderr)
    if not reply.ok:
        print(f"mavsitl {options.command}: {reply.problem}", file=sys.stderr)
    return EXIT_OK if reply.ok else EXIT_FAILED
