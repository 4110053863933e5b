"""The commands. The only place that prints."""

from __future__ import annotations

import argparse
import math
import os
import re
import shlex
import signal
import sys
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavsitl import __version__, process

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress as RichProgress

    from mavsitl.ask import Reply, Task
    from mavsitl.campaign.fly import Row
    from mavsitl.campaign.store import Journal
    from mavsitl.campaign.summary import Summary
    from mavsitl.campaign.sweep import Known, Plan
    from mavsitl.campaign.workers import Workers
    from mavsitl.check import Heard, PortReport, Report
    from mavsitl.ends import Outcome, VehicleLinks
    from mavsitl.fleet import FleetOutcome
    from mavsitl.link.address import Address
    from mavsitl.realtime import Wish
    from mavsitl.report.run import FlightRecord
    from mavsitl.scenario import Flight
    from mavsitl.tune.run import Tuning
    from mavsitl.tune.search import Trial

PAPER_SCENARIOS = ("hover-calm", "hover-wind", "spiral-calm", "spiral-wind")

DEADLINE_S = 10.0
CHECK_S = 3.0
MAX_VEHICLES = 250
"""In one process: system ids end at 255, and ground stations take the highest."""
SLOWEST_SPEED = 0.5
"""Clients miss a HEARTBEAT after 3 s of wall clock."""

EXIT_OK, EXIT_FAILED, EXIT_USAGE = 0, 1, 2
EXIT_SIGNAL = 128
"""And the signal's number, as shells say it: 130 is Ctrl-C."""

DESCRIPTION = """\
A quadrotor in Dryden wind and an off-board controller, two processes that meet on MAVLink 2 over UDP alone.

  mavsitl fly          fly the paper's four experiments and write a report
  mavsitl vehicle      a vehicle alone, in real time, on PX4 SITL's ports
  mavsitl ground       the paper's controller alone, for that vehicle or any PX4-like one
  mavsitl check        who is on the ports, and does it answer: when nothing arrives
  mavsitl link         make the links of a flying vehicle bad, and good again
  mavsitl inject       break a part of a flying vehicle
  mavsitl param        read and set parameters
  mavsitl sweep        fly a grid of settings and seeds, and compare
  mavsitl tune         search a controller's gains, and judge them on other seeds
"""

EPILOG = """\
Exit codes: 0 done; 1 the run failed (the message says which end and why) or a vehicle was lost; 2 wrong arguments or
scenario; 130 interrupted by Ctrl-C, 143 by SIGTERM, 129 by the terminal's end. A vehicle or a ground in real time runs
until it is told to end: for these two a signal is the end, and 0. However it ends, logs and state are complete.
Documentation: docs/index.md. Each command's own --help says more.
"""

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
  mavsitl fly --in-memory                            one process, no sockets, the same bytes
  mavsitl fly formation-spiral --count 9             nine vehicles and their controllers in one process
"""

TUNE_HELP = """\
Search the gains and learning rates of a controller over whole flights in memory. Each candidate flies every scenario
under the same few seeds; what is found is then judged against the start on seeds that the search has not seen. Without
a scenario the paper's four experiments are flown together.

  error      of each scenario and state the RMSE over the paper's number in Tables 3 and 4, or in a scenario that is
             none of the paper's over 0.1 m and 0.5 degrees, or with --against start over what the gains to begin with
             have there; of these ratios the 4-norm: the worst count most
  effort     RMS of the rotors' speeds about their mean, rad/s
  searched   the least error x effort^W, W being --effort-weight, with no RMSE above --no-worse times that of the gains
             to begin with, and no number of the paper's missed that those reach; a lost flight is worse than any that
             was flown

The search starts at the gains that the scenarios have, and is SciPy's COBYQA. --tune KEY=LOW:HIGH names what is turned
and how far, with :log or :linear behind it for how the range is divided; without a range it is a fifth of the value to
five times that; without --tune it is every gain, filter, learning rate and observer bandwidth that the controller
reads. An array such as controller.learning.rate is turned as one, or item by item: controller.learning.rate[0].

The folder gets each scenario with the gains found, tune.json with every candidate, report.html, one self-contained
page, and rows.jsonl, every flight so far: the same command goes on where it was ended. Ctrl-C gives the best so far.

SEEDS is N for 1 to N, or FIRST-LAST, or N,N,N; those to search on and those to judge by have none in common.
"""

TUNE_EXAMPLES = """\
examples:
  mavsitl tune                                       the paper's controller on the paper's four experiments
  mavsitl tune hover-wind-realistic --jobs 8 --evaluations 300
  mavsitl tune my.toml --tune controller.position.k_p_per_s2=1:20 --tune controller.learning.rate=1:100:log
  mavsitl tune hover-wind --search-duration 20 --effort-weight 0.5 --output runs/gentle
  mavsitl tune my.toml --against start --no-worse 1.02    better, and nothing worse by more than 2 %
  mavsitl tune --seeds 2001-2008 --held-out 50 --scheduler tcp://192.0.2.7:8786

Exit codes: 0 done, whether something better was found or not; 1 it cannot go on; 2 wrong arguments; 130 interrupted.
"""

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

CHAOS_HELP = """\
List what mavsitl vehicle --chaos makes the vehicle do wrong, for tests of ground stations and SDKs: acknowledgements
that are lost, late, doubled, refused; transfers of parameters, missions and files that break; silence.

A mode is written NAME[:ARGUMENT...][@PORT], for example ack-late:2.5:NAV_TAKEOFF@gcs; PORT is all, offboard or gcs.
Arguments may be left out from the right; an empty one is the default.
"""

GROUND_HELP = """\
The paper's off-board controller in real time. It waits for a vehicle, streams setpoints, asks for OFFBOARD, arms, flies
the scenario's reference, and lands or disarms. A vehicle that falls silent or restarts is waited for and flown again.
"""

GROUND_EXAMPLES = """\
examples:
  mavsitl ground hover-wind                          listens on udpin:127.0.0.1:14540, as PX4's users expect
  mavsitl ground hover-wind --link udpin:0.0.0.0:14540
  mavsitl ground spiral-calm --link udpout:192.0.2.9:14580 --system 3
  mavsitl ground formation-spiral --count 9          for nine vehicles, at udpin:127.0.0.1:14540 to 14548
"""

CHECK_HELP = """\
Say what arrives at MAVLink ports, from whom, and whether it answers. For a few seconds mavsitl check listens where
PX4-like vehicles send to, UDP 14550 (ground stations) and 14540 (off-board programs), as a ground station would. It
shows every source with its address, system and component id, vehicle type, mode, rates, losses and bad frames, sends
its own HEARTBEAT (system 253), asks every vehicle for its AUTOPILOT_VERSION, and names what is wrong.

It listens on loopback. --listen opens other endpoints in place of the two; the notation is that of the MAVLink tools:
  udpin:HOST:PORT    be sent to at that address of this machine; 0.0.0.0 is every network
  udpout:HOST:PORT   send there first, from a free port
  tcp:HOST:PORT      connect to a server, for example mavsitl vehicle --tcp-port 5760
  tcpin:HOST:PORT    be a server

Beside a running ground station or program: two programs cannot listen at one UDP port, and what was sent to the other
cannot be seen from here. While such a program has 14550 or 14540, mavsitl check says which, and calls the vehicle at
its own port, 18570 or 14580, instead. A mavsitl vehicle serves several clients and answers; it then sends this one
the same streams as the other. PX4 serves only the first partner that spoke to it and stays silent.

It needs no mavsitl at the other end, and changes nothing in a vehicle. But a vehicle takes it for a ground station:
where NAV_DLL_ACT is set, its going is a lost ground station. --quiet sends nothing.
"""

CHECK_EXAMPLES = """\
examples:
  mavsitl check                                      PX4's two ports on this machine, for 3 s
  mavsitl check --all                                with every kind of message and its rate
  mavsitl check --for 10 --listen udpin:0.0.0.0:14550
  mavsitl check --listen udpout:127.0.0.1:18570      a mavsitl vehicle, beside a running QGroundControl
  mavsitl check --listen tcp:127.0.0.1:5760 --json

Exit codes: 0 a vehicle was heard and answers (with --quiet: was heard); 1 otherwise; 2 wrong arguments.
"""

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

SWEEP_HELP = """\
Fly every combination of the settings with every seed: whole flights in memory, on all cores of this machine or on a
Dask cluster. Each flight is a row: flown, lost (too far from its reference), or failed, with what went wrong.

The folder gets rows.jsonl, row by row, then results.parquet and report.html. A sweep that was interrupted or killed
goes on with the same command. A flight is known by its scenario, airframe, seed and the code that flies: where one of
these has changed it is flown again, else it is not.

  --set KEY=A,B,C            these values; an array or table of TOML is one value
  --set KEY=START:STOP:STEP  a range, STOP included: 0:10:5 is 0, 5, 10
  --set KEY=A                this value in every flight
  --seeds N                  seeds 1 to N; also N,N,N and FIRST-LAST

A key with two values is compared seed by seed: the same seed is the same air and the same noise.
"""

SWEEP_EXAMPLES = """\
examples:
  mavsitl sweep hover-wind --set wind.speed_20ft_m_s=0,5,10 --seeds 50
  mavsitl sweep hover-wind --set controller.law=pid,pidnn --seeds 50 --jobs 4
  mavsitl sweep spiral-wind --set offnominal.mass_scale=0.8:1.4:0.1 --compare controller.law=pid,pidnn
  mavsitl sweep my.toml --compare controller.learning.rate=[0,0,0],[1,1,1],[10,10,10] --seeds 20
  mavsitl sweep hover-wind --seeds 1000 --scheduler tcp://192.0.2.7:8786

Exit codes: 0 every flight has its row, lost ones too; 1 some failed by an error, or the sweep did; 2 wrong arguments;
130 interrupted.
"""

ASK_EPILOG = """
Exit codes: 0 done; 1 refused, or no answer (the message says by whom and what to do); 2 wrong arguments.
"""

ANSWER_S = 5.0

LINK_DIRECTIONS = {"both": 0.0, "to-ground": 1.0, "to-vehicle": 2.0}

LINK_OPTIONS = {
    "direction": "DIR", "latency": "LAT", "jitter": "JIT", "loss": "LOSS", "burst": "BURST", "good": "GOOD",
    "reorder": "REORD", "duplicate": "DUP", "corrupt": "CORR", "bandwidth": "BW", "down": "DOWN",
}  # fmt: skip
"""Option to the end of the parameter's name, in the order in which they are set: an outage last."""


class UsageError(ValueError):
    """Arguments that do not go together."""


class Interrupted(KeyboardInterrupt):
    """A signal that ends the program, wherever it is."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def _interrupt(number: int, frame: Any) -> None:
    raise Interrupted(number)


def _on_signals(handler: Callable[[int, Any], None]) -> None:
    """Ctrl-C, the usual request to end, and the end of the terminal, unless that is ignored (nohup)."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # the last where the system has it
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


class _Formatter(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=32, width=110)


def main(arguments: Sequence[str] | None = None) -> int:
    """The `mavsitl` command; returns its exit code."""
    parser = build_parser()
    options = parser.parse_args(arguments)
    run: Callable[[argparse.Namespace], int] | None = getattr(options, "run", None)
    if run is None:
        parser.print_help()
        return EXIT_USAGE
    process.one_blas_thread()
    try:
        return run(options)
    except KeyboardInterrupt as interrupt:
        print(f"mavsitl {options.command}: interrupted", file=sys.stderr)
        return EXIT_SIGNAL + (interrupt.number if isinstance(interrupt, Interrupted) else signal.SIGINT)
    except BrokenPipeError:
        # The reader of our output went away; point stdout elsewhere so that the interpreter's last flush is quiet.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_FAILED
    except Exception as error:
        code = _exit_code(error)
        if code is None:
            raise
        print(f"mavsitl {options.command}: {error}", file=sys.stderr)
        return code


def _exit_code(error: Exception) -> int | None:
    """Of an error whose text is for the user; None for any other. They are loaded here: most runs have none."""
    from mavsitl.campaign.errors import CampaignError, GridError
    from mavsitl.chaos.table import ChaosError
    from mavsitl.ends import ExposedError
    from mavsitl.link.address import AddressError
    from mavsitl.link.base import LinkError
    from mavsitl.log.errors import LogError
    from mavsitl.pair import PairError
    from mavsitl.realtime import RealTimeError
    from mavsitl.report.run import RunError
    from mavsitl.scenario import ScenarioError
    from mavsitl.wings import WingError

    if isinstance(error, (UsageError, ExposedError, ScenarioError, GridError, ChaosError, AddressError, WingError)):
        return EXIT_USAGE
    failed = (LinkError, LogError, PairError, RealTimeError, RunError, CampaignError)
    return EXIT_FAILED if isinstance(error, failed) else None


def build_parser() -> argparse.ArgumentParser:
    """The whole command line; the reference page of the docs is made from it."""
    parser = argparse.ArgumentParser("mavsitl", description=DESCRIPTION, epilog=EPILOG, formatter_class=_Formatter)
    parser.add_argument("--version", action="version", version=f"mavsitl {__version__}")
    commands = parser.add_subparsers(title="commands", dest="command", metavar="COMMAND")
    _add_fly(commands)
    _add_vehicle(commands)
    _add_ground(commands)
    _add_check(commands)
    _add_link(commands)
    _add_inject(commands)
    _add_param(commands)
    _add_sweep(commands)
    _add_tune(commands)
    _add_report(commands)
    _add_scenarios(commands)
    _add_chaos(commands)
    return parser


def _command(commands: Any, name: str, summary: str, description: str, epilog: str = "") -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=summary, description=description, epilog=epilog, formatter_class=_Formatter
    )
    return parser


def _whole(least: int, most: int) -> Callable[[str], int]:
    """The type of an option that takes a whole number within bounds."""

    def read(text: str) -> int:
        if not (text.isascii() and text.isdigit() and least <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"{text!r} is not allowed; allowed: a whole number from {least} to {most}")
        return int(text)

    return read


def _above_zero(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; allowed: a finite number above 0")
    return value


def _not_negative(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; allowed: a finite number, 0 or more")
    return value


def _at_least_1(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 1.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; allowed: a finite number, 1 or more")
    return value


def _speed(text: str) -> float:
    value = _above_zero(text)
    if value < SLOWEST_SPEED:
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; allowed: {SLOWEST_SPEED:g} or more")
    return value


_PORT = _whole(0, 65535)
_SYSTEM = _whole(1, 255)
_COUNT = _whole(1, MAX_VEHICLES)


def _add_scenario_options(parser: argparse.ArgumentParser, *, seed: bool = True) -> None:
    """`seed`: False for a command that flies many seeds."""
    group = parser.add_argument_group("scenario")
    if seed:
        group.add_argument("--seed", type=int, metavar="N", help="seed of wind and noise (scenario key: seed)")
    group.add_argument("--airframe", metavar="NAME", help="paper, realistic, full-coupling or a .toml file (airframe)")
    group.add_argument("--law", choices=("pidnn", "pid"), help="attitude law (controller.law)")
    group.add_argument("--level", choices=("attitude", "body_rate", "torque"), help="command level (controller.level)")
    group.add_argument(
        "--wind-information",
        choices=("oracle", "observer", "none"),
        help="source of W1..W3 (controller.wind_information)",
    )
    group.add_argument("--duration", type=float, metavar="S", help="flight time in seconds (duration_s)")
    group.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="any key of the scenario, dotted, with a TOML value; may be repeated",
    )  # fmt: skip


def _add_scenario(parser: argparse.ArgumentParser, what: str) -> None:
    """The one scenario of a process that stands alone; `what` it takes from it."""
    parser.add_argument(
        "scenario", nargs="?", default="takeoff-hover", metavar="SCENARIO", help=f"{what} (default: takeoff-hover)"
    )
    _add_scenario_options(parser)


def _add_fly(commands: Any) -> None:
    parser = _command(
        commands, "fly", "fly scenarios with two processes in lock-step, and report", FLY_HELP, FLY_EXAMPLES
    )
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help="a shipped scenario's name or a .toml file")
    _add_scenario_options(parser)
    group = parser.add_argument_group("run")
    group.add_argument("--run-dir", type=Path, metavar="DIR", help="run folder (default: runs/<UTC time>)")
    group.add_argument("--in-memory", action="store_true", help="both ends in one process, no sockets; the same bytes")
    group.add_argument(
        "--count", type=_COUNT, metavar="N",
        help="a formation of N vehicles, each with its controller, in one process; logs and a table, no report",
    )  # fmt: skip
    group.add_argument("--no-report", action="store_true", help="logs and tables only")
    group.add_argument("--json", action="store_true", help="print the result as JSON and nothing else")
    parser.set_defaults(run=_fly)


def _add_tune(commands: Any) -> None:
    parser = _command(
        commands, "tune", "search a controller's gains, and judge them on other seeds", TUNE_HELP, TUNE_EXAMPLES
    )
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help="a shipped scenario's name or a .toml file")
    _add_scenario_options(parser, seed=False)
    group = parser.add_argument_group("search")
    group.add_argument(
        "--tune", action="append", default=[], metavar="KEY[=LOW:HIGH]", dest="keys",
        help="a key of controller or parameters, and its range; may be repeated",
    )  # fmt: skip
    group.add_argument(
        "--evaluations", type=_whole(1, 1_000_000), default=150, metavar="N", help="candidates (default: 150)"
    )
    group.add_argument(
        "--effort-weight", type=_not_negative, default=0.3, metavar="W",
        help="what 1 %% of effort has to buy, in %% of error (default: 0.3)",
    )  # fmt: skip
    group.add_argument(
        "--against", choices=("paper", "start"), default="paper",
        help="what each RMSE is divided by: the paper's number, or that of the gains to begin with (default: paper)",
    )  # fmt: skip
    group.add_argument(
        "--no-worse", type=_at_least_1, metavar="F",
        help="no RMSE of any scenario and state above F times that of the gains to begin with, and none of the paper's "
        "numbers missed that those reach (default: no bound)",
    )  # fmt: skip
    group.add_argument(
        "--seeds", default="1001-1003", metavar="SEEDS", help="flown by each candidate (default: 1001-1003)"
    )
    group.add_argument("--held-out", default="20", metavar="SEEDS", help="judged by (default: 20, which is 1 to 20)")
    group.add_argument(
        "--search-duration", type=_above_zero, metavar="S",
        help="fly so much of each flight in the search; judged is the whole (default: all of it)",
    )  # fmt: skip
    group.add_argument(
        "--search-seed", type=_whole(0, 2**31), default=1, metavar="N", help="of the search itself (default: 1)"
    )
    group = parser.add_argument_group("run")
    _add_run_options(group, "runs/tune-SCENARIO); what is there is gone on with")
    group.add_argument("--json", action="store_true", help="print tune.json and nothing else")
    parser.set_defaults(run=_tune)


def _add_vehicle(commands: Any) -> None:
    parser = _command(commands, "vehicle", "start a vehicle alone", VEHICLE_HELP, VEHICLE_EXAMPLES)
    _add_scenario(parser, "its airframe, air, start")
    group = parser.add_argument_group("link")
    group.add_argument(
        "--instance",
        type=_whole(0, 254),
        default=0,
        metavar="I",
        help="adds I to the ports and to the system id, as PX4's instances",
    )
    group.add_argument(
        "--system", type=_SYSTEM, metavar="ID", help="MAVLink system id, 1 to 255 (default: instance + 1)"
    )
    group.add_argument(
        "--count", type=_COUNT, metavar="N",
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
        "--offboard-port", type=_PORT, metavar="N", help="local port of the off-board link (default: 14580 + I)"
    )
    group.add_argument(
        "--offboard-remote",
        metavar="HOST:PORT",
        help="where it sends first (default: 127.0.0.1:14540 + I, at most 14549)",
    )
    group.add_argument(
        "--gcs-port", type=_PORT, metavar="N", help="local port of the ground-station link (default: 18570 + I)"
    )
    group.add_argument("--gcs-remote", metavar="HOST:PORT", help="where it sends first (default: 127.0.0.1:14550)")
    group.add_argument(
        "--tcp-port", type=_PORT, metavar="N", help="also a TCP server for ground stations, e.g. 5760 (default: none)"
    )
    _add_end_options(parser)
    group = parser.add_argument_group("state")
    group.add_argument(
        "--state-dir", type=Path, metavar="DIR",
        help="keeps parameters, missions and the card (default: in the user's data folder, by system id)",
    )  # fmt: skip
    group.add_argument("--no-state", action="store_true", default=None, help="begin fresh and keep nothing")
    parser.add_argument(
        "--speed",
        type=_speed,
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


def _add_ground(commands: Any) -> None:
    parser = _command(commands, "ground", "start the off-board controller alone", GROUND_HELP, GROUND_EXAMPLES)
    _add_scenario(parser, "its controller and reference")
    group = parser.add_argument_group("link")
    group.add_argument(
        "--link",
        metavar="ENDPOINT",
        help="udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or tcpin:HOST:PORT "
        "(default: udpin:127.0.0.1:14540 + I; from I = 10 on udpout:127.0.0.1:14580 + I)",
    )
    group.add_argument(
        "--system",
        type=_SYSTEM,
        metavar="ID",
        help="fly only the vehicle with this system id (default: the first heard; with --count, of the first: I + 1)",
    )
    group.add_argument(
        "--count", type=_COUNT, metavar="N", help="fly N vehicles in the scenario's formation, each on its own port"
    )
    group.add_argument(
        "--one-link", action="store_true", default=None, help="with --count: all of them are heard at --link"
    )
    group.add_argument(
        "--instance", type=_whole(0, 254), default=0, metavar="I",
        help="adds I to the default's port; with --count, of the first vehicle (default: 0)",
    )  # fmt: skip
    group.add_argument(
        "--vehicle",
        metavar="HOST:PORT",
        help="lock-step only: the vehicle's off-board port (default: 127.0.0.1:14580)",
    )
    _add_end_options(parser)
    parser.set_defaults(run=_ground)


def _add_end_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("run")
    group.add_argument(
        "--lockstep", action="store_true", help="simulated time, with a partner that also runs --lockstep"
    )
    group.add_argument(
        "--deadline",
        type=_above_zero,
        metavar="S",
        help="lock-step: a partner silent for so long is an error (default: 10)",
    )
    group.add_argument(
        "--cpu",
        type=_whole(0, 4095),
        metavar="N",
        help="lock-step: run on this CPU from the first exchange on; the same for both is fastest",
    )
    group.add_argument(
        "--realtime", action="store_true", default=None,
        help="keep the time on a busy machine: a real-time priority and locked memory (Linux, where it is allowed)",
    )  # fmt: skip
    group.add_argument(
        "--best-effort", action="store_true", default=None,
        help="with --realtime: go on without what is not allowed, and say what that is",
    )  # fmt: skip
    group.add_argument("--run-dir", type=Path, metavar="DIR", help="write logs there (default: none)")
    group.add_argument("--wing", metavar="NAME", help="another installed vehicle or controller, by its entry point")
    group.add_argument(
        "--status", choices=("text", "json"), default="text", help="json: one object a line on stdout, for programs"
    )


def _add_check(commands: Any) -> None:
    parser = _command(commands, "check", "say who is on the ports and whether it answers", CHECK_HELP, CHECK_EXAMPLES)
    parser.add_argument(
        "--listen", action="append", metavar="ENDPOINT",
        help="instead of udpin:127.0.0.1:14550 and udpin:127.0.0.1:14540; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--for", type=_above_zero, default=CHECK_S, metavar="S", dest="duration_s",
        help=f"seconds to listen (default: {CHECK_S:g}; Ctrl-C ends it early)",
    )  # fmt: skip
    parser.add_argument("--quiet", action="store_true", help="listen only: send no HEARTBEAT and ask nothing")
    parser.add_argument("--all", action="store_true", help="list every kind of message of every source")
    parser.add_argument("--json", action="store_true", help="print the report as JSON and nothing else")
    parser.set_defaults(run=_check)


def _add_link(commands: Any) -> None:
    parser = _command(
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
        group.add_argument(option, type=_not_negative, metavar=metavar, help=text)
    group.add_argument("--direction", choices=tuple(LINK_DIRECTIONS), help="for which all of these hold")
    outage = group.add_mutually_exclusive_group()
    outage.add_argument("--down", dest="down", action="store_const", const=1.0, help="nothing comes through")
    outage.add_argument("--up", dest="down", action="store_const", const=0.0, help="the end of --down")
    group.add_argument("--reset", action="store_true", help="first make it perfect")
    _add_ask_options(parser, "udpout:127.0.0.1:18570 + I; with --gcs 14580 + I")
    parser.set_defaults(run=_link)


def _add_inject(commands: Any) -> None:
    parser = _command(
        commands, "inject", "break a part of a running vehicle", INJECT_HELP, INJECT_EXAMPLES + ASK_EPILOG
    )
    parser.add_argument("unit", nargs="?", metavar="UNIT", help="for example gps, motor, battery, mavlink; see --list")
    parser.add_argument("type", nargs="?", metavar="TYPE", help="ok mends it; off, stuck, garbage, wrong, slow, ...")
    parser.add_argument(
        "instance", nargs="?", type=_whole(0, 255), default=0, metavar="INSTANCE", help="1 the first; 0: all (default)"
    )
    parser.add_argument("--list", action="store_true", help="list the names of units and types")
    _add_ask_options(parser, "udpout:127.0.0.1:18570 + I")
    parser.set_defaults(run=_inject)


def _add_param(commands: Any) -> None:
    parser = _command(
        commands, "param", "read and set parameters of a running vehicle", PARAM_HELP, PARAM_EXAMPLES + ASK_EPILOG
    )
    parser.add_argument("action", choices=("get", "set", "list"), help="list: all, or those that match a pattern")
    parser.add_argument("names", nargs="*", metavar="NAME[=VALUE]", help="with list a pattern such as 'SIM_*'")
    _add_ask_options(parser, "udpout:127.0.0.1:18570 + I")
    parser.set_defaults(run=_param)


def _add_sweep(commands: Any) -> None:
    parser = _command(commands, "sweep", "fly a grid of settings and seeds, and compare", SWEEP_HELP, SWEEP_EXAMPLES)
    parser.add_argument("scenario", metavar="SCENARIO", help="a shipped scenario's name or a .toml file")
    group = parser.add_argument_group("grid")
    group.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUES", dest="settings",
        help="any key of the scenario, dotted, with its values; may be repeated",
    )  # fmt: skip
    group.add_argument(
        "--compare", action="append", default=[], metavar="KEY=VALUES",
        help="as --set, and each further value is compared with the first, seed by seed; may be repeated",
    )  # fmt: skip
    group.add_argument("--seeds", default="10", metavar="SEEDS", help="default: 10, which is 1 to 10")
    group = parser.add_argument_group("run")
    _add_run_options(group, "runs/sweep-SCENARIO); flights that it has are not flown again")
    group.add_argument("--no-report", action="store_true", help="results and tables only")
    group.add_argument("--json", action="store_true", help="print the summary as JSON and nothing else")
    parser.set_defaults(run=_sweep)


def _add_run_options(group: Any, default: str) -> None:
    """Who flies a campaign, and the folder of it."""
    group.add_argument("--jobs", type=_whole(1, 4096), metavar="N", help="processes (default: one for each core)")
    group.add_argument(
        "--scheduler", type=_scheduler, metavar="ADDRESS",
        help="of a Dask cluster, tcp://HOST:PORT, in place of processes",
    )  # fmt: skip
    group.add_argument("--output", type=Path, metavar="DIR", help=f"folder (default: {default}")


def _scheduler(text: str) -> str:
    if not re.fullmatch(r"(tcp|tls|ucx|wss?)://\S+:\d+", text):
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; allowed: tcp://HOST:PORT or tls://HOST:PORT")
    return text


def _add_ask_options(parser: argparse.ArgumentParser, default: str) -> None:
    group = parser.add_argument_group("vehicle")
    group.add_argument(
        "--endpoint", metavar="ENDPOINT",
        help=f"udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or tcpin:HOST:PORT (default: {default})",
    )  # fmt: skip
    group.add_argument(
        "--instance", type=_whole(0, 254), default=0, metavar="I", help="adds I to the default's port (default: 0)"
    )
    group.add_argument("--system", type=_SYSTEM, metavar="ID", help="only this vehicle (default: the first heard)")
    group.add_argument(
        "--timeout", type=_above_zero, default=ANSWER_S, metavar="S",
        help=f"seconds to wait for the vehicle, and for each answer (default: {ANSWER_S:g})",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the reply as JSON and nothing else")


def _add_report(commands: Any) -> None:
    parser = _command(
        commands, "report", "draw the report of runs again", "Draw report.html of each run folder again, from its logs."
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="a run folder, with run.json in it")
    parser.set_defaults(run=_report)


def _add_scenarios(commands: Any) -> None:
    parser = _command(
        commands, "scenarios", "list the shipped scenarios", "List the shipped scenarios with what they fly."
    )
    parser.add_argument("--json", action="store_true", help="as JSON")
    parser.set_defaults(run=_scenarios)


def _add_chaos(commands: Any) -> None:
    parser = _command(commands, "chaos", "list what a vehicle can do wrong on MAVLink", CHAOS_HELP)
    parser.add_argument("--json", action="store_true", help="as JSON")
    parser.set_defaults(run=_chaos)


# --- commands --------------------------------------------------------------------------------------------------------


def _settings(options: argparse.Namespace) -> list[str]:
    """All scenario options as KEY=VALUE, the form in which they are handed on to the processes."""
    settings = list(options.settings)
    named = {
        "seed": getattr(options, "seed", None), "airframe": options.airframe,
        "controller.law": options.law, "controller.level": options.level,
        "controller.wind_information": options.wind_information, "duration_s": options.duration,
    }  # fmt: skip
    for key, value in named.items():
        if value is not None:
            settings.append(f'{key}="{value}"' if isinstance(value, str) else f"{key}={value}")
    return settings


def _load(name: str, settings: Sequence[str]) -> Flight:
    from mavsitl import scenario

    return scenario.load(name, _overrides(settings))


def _overrides(settings: Sequence[str]) -> dict[str, Any]:
    """What --set and the named options change. Raises `ScenarioError`."""
    from mavsitl import scenario

    overrides: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals or not key:
            raise scenario.ScenarioError(f"--set {setting}: not KEY=VALUE")
        try:
            overrides[key.strip()] = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            overrides[key.strip()] = text
    return overrides


def _endpoint(text: str, option: str) -> tuple[str, int]:
    from mavsitl.link.address import AddressError, parse_address

    try:
        address = parse_address(f"udpout:{text}")
    except AddressError as error:
        raise AddressError(f"{option} {text}: not HOST:PORT ({error})") from error
    return address.host, address.port


def _fly(options: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from mavsitl import pair
    from mavsitl.clock import utc_stamp
    from mavsitl.report import run as runs

    _on_signals(_interrupt)
    settings = _settings(options)
    names = options.scenarios or list(PAPER_SCENARIOS)
    flights = [_load(name, settings) for name in names]
    if options.count is not None:
        return _fly_fleet(options, flights)
    created = utc_stamp()
    folder: Path = options.run_dir or Path("runs") / created.replace(":", "").replace("-", "")
    console = Console(stderr=options.json)
    records: list[FlightRecord] = []
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[said]}"), TimeElapsedColumn(),
        console=console, disable=not console.is_terminal,
    )  # fmt: skip
    try:
        with bar:
            for index, (name, flight) in enumerate(zip(names, flights, strict=True)):
                alone = [other.name for other in flights].count(flight.name) == 1
                title = flight.name if alone else f"{flight.name}-{index + 1}"
                task = bar.add_task(f"{title:20s}", total=flight.scenario.duration_s, said="starting")
                flown = _fly_one(name, flight, settings, folder / title, options.in_memory, bar, task, pair)
                records.append(runs.record(flight, folder=title, **flown))
                runs.write_run(folder, runs.new_run("mavsitl " + " ".join(sys.argv[1:]), created, tuple(records)))
    except KeyboardInterrupt:
        console.print(f"interrupted; the logs so far are in {folder}")
        raise
    return _show(console, options, folder, records)


def _fly_fleet(options: argparse.Namespace, flights: list[Flight]) -> int:
    """A formation in memory; there is no page for one, each vehicle's logs have a folder."""
    from rich.console import Console

    from mavsitl import ends
    from mavsitl.clock import utc_stamp

    if len(flights) != 1:
        raise UsageError(f"--count: one scenario, not {len(flights)}")
    (flight,) = flights
    folder: Path = options.run_dir or Path("runs") / utc_stamp().replace(":", "").replace("-", "")
    console = Console(stderr=True)
    with console.status(f"{flight.name}, {options.count} vehicles") as shown:

        def move(time_s: float) -> None:
            shown.update(f"{flight.name}, {options.count} vehicles: {max(time_s, 0.0):.1f} s")

        outcome = ends.fleet_in_memory(
            flight, folder / flight.name, count=options.count, report=lambda text: None, progress=move
        )
    if options.json:
        import msgspec

        event = outcome.as_event() | {"folder": str(folder)}
        print(msgspec.json.format(msgspec.json.encode(event), indent=2).decode())
    else:
        for line in _fleet_table(outcome):
            print(line)
        print(f"logs: {folder}")
    return EXIT_FAILED if outcome.lost or not outcome.finished else EXIT_OK


def _fly_one(
    name: str, flight: Flight, settings: list[str], folder: Path, memory: bool, bar: RichProgress, task: Any, pair: Any
) -> dict[str, Any]:
    """One flight; what `run.record` wants to know of it."""

    def move(time_s: float) -> None:
        bar.update(task, completed=max(time_s, 0.0), said=f"{max(time_s, 0.0):5.1f} s")

    def on_event(end: str, event: dict[str, Any]) -> None:
        if event["event"] == "progress" and end == "vehicle":
            move(event["flight_time_s"])
        elif event["event"] == "report":
            bar.update(task, said=event["text"])

    if memory:
        from mavsitl import ends

        outcome = ends.in_memory(flight, folder, report=lambda text: bar.update(task, said=text), progress=move)
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


def _show(console: Any, options: argparse.Namespace, folder: Path, records: list[FlightRecord]) -> int:
    from rich.table import Table

    from mavsitl.log.flight import FlightData
    from mavsitl.report import tables
    from mavsitl.report.metrics import rmse

    results = []
    lost = []
    for record in records:
        data = FlightData.from_folder(folder / record.folder, duration_s=record.duration_s)
        rows = tables.rows(rmse(data), record.paper_case)
        results.append((record, rows))
        if record.lost:
            lost.append((record, float(data.time_s[-1])))
    if options.json:
        _print_json(folder, results)
    else:
        for record, rows in results:
            facts = (
                f"{record.law}, {record.level}, wind information: {_loud(record.wind_information)}, seed {record.seed}"
            )
            console.print(f"\n[bold]{record.title}[/]  {facts}", soft_wrap=True, highlight=False)
            table = Table()
            for column in ("RMSE", "ours", "paper", "ours / paper"):
                table.add_column(column, justify="left" if column == "RMSE" else "right")
            for row in rows:
                paper = "" if row.paper is None else tables.number(row.paper)
                ratio = (
                    "" if row.ratio is None or row.verdict is None else f"{row.ratio:.2f} {tables.SYMBOLS[row.verdict]}"
                )
                style = {"beaten": "green", "met": "green", "missed": "yellow"}.get(row.verdict or "", "")
                table.add_row(row.state, tables.number(row.ours), paper, f"[{style}]{ratio}[/]" if style else ratio)
            console.print(table)
            for link in tables.link_rows(record.links):
                console.print(f"link {link}", soft_wrap=True, highlight=False)
    if not options.no_report:
        from mavsitl.report.html import write_report

        page = write_report(folder)
        console.print(f"report: {page}", soft_wrap=True, highlight=False)
    console.print(f"logs:   {folder}", soft_wrap=True, highlight=False)
    for record, end_s in lost:
        console.print(
            f"[bold red]{record.name} was lost after {end_s:.1f} s:[/] {record.lost}", soft_wrap=True, highlight=False
        )
    return EXIT_FAILED if lost else EXIT_OK


def _tune(options: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from mavsitl.campaign import workers
    from mavsitl.campaign.grid import parse_seeds
    from mavsitl.campaign.store import Journal
    from mavsitl.tune import flights, run

    _on_signals(_interrupt)
    if options.jobs is not None and options.scheduler is not None:
        raise UsageError("--jobs: not with --scheduler, whose workers are what they are")
    plan = run.Plan(
        names=tuple(options.scenarios or PAPER_SCENARIOS), settings=_overrides(_settings(options)),
        asked=tuple(options.keys), evaluations=options.evaluations, against=options.against,
        no_worse=options.no_worse, effort_weight=options.effort_weight,
        seeds=parse_seeds(options.seeds), held_out=parse_seeds(options.held_out),
        search_duration_s=options.search_duration, seed=options.search_seed,
    )  # fmt: skip
    tuning = run.begin(plan)
    name = Path(plan.names[0]).stem if len(plan.names) == 1 else "several" if options.scenarios else "paper"
    folder: Path = options.output or Path("runs") / f"tune-{name}"
    command = "mavsitl " + shlex.join(sys.argv[1:])
    console = Console(stderr=options.json, highlight=False)
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    bar = Progress(
        TextColumn("{task.description}"), *columns, TextColumn("{task.fields[said]}"),
        console=Console(stderr=True, highlight=False),
    )  # fmt: skip
    each = run.searched(tuning).each
    jobs = options.jobs or min(workers.cores(), each)
    crew = workers.Dask(options.scheduler) if options.scheduler else workers.local(jobs)
    with Journal(folder / "rows.jsonl") as journal, crew, bar:
        task = bar.add_task("tune", total=run.flights_of(tuning), said="")

        def said(trial: Trial) -> None:
            if trial.number == 0 and trial.score.lost:
                text = f"the gains to begin with lose {trial.score.lost} of {each} flights: {trial.score.message}"
                bar.console.print(text, soft_wrap=True, markup=False)
            best = tuning.best.score
            found = "all lost" if best.lost else f"best error {best.error:.4g}, effort {best.effort:.4g}"
            bar.update(task, said=f"{trial.number + 1} tried, {found}")

        try:
            run.carry_out(tuning, flights.kept(journal, crew, lambda: bar.advance(task)), said)
        except KeyboardInterrupt:
            bar.stop()
            if tuning.trials:
                _show_tuning(console, options, tuning, folder, command)
            console.print(f"interrupted; the same command goes on from {folder}", soft_wrap=True, markup=False)
            raise
    return _show_tuning(console, options, tuning, folder, command)


def _show_tuning(console: Any, options: argparse.Namespace, tuning: Tuning, folder: Path, command: str) -> int:
    from rich.markup import escape
    from rich.table import Table

    from mavsitl.report import tune as report
    from mavsitl.report.sweep_tables import bounds, probability
    from mavsitl.report.tables import number
    from mavsitl.tune import result

    paths = [*result.write(tuning, folder, command), report.write(tuning, folder, command)]
    if options.json:
        print((folder / result.JSON_FILE).read_text("utf-8"), end="")
        return EXIT_OK
    table = Table("measure", "seeds", title="before and after", title_justify="left", title_style="bold")
    for column in ("before", "after", "ratio, seed by seed", "p"):
        table.add_column(column, justify="right")
    for row in result.measures(tuning):
        cells = [row.name, row.seeds, number(row.before), number(row.after)]
        if row.paired is not None:
            cells += [bounds(row.paired.ratio), probability(row.paired.p_value)]
        table.add_row(*(escape(cell) for cell in cells))
    console.print(table)
    table = Table("key", title="gains", title_justify="left", title_style="bold")
    for column in ("before", "after", "range", ""):
        table.add_column(column, justify="right")
    for gain in result.gains(tuning):
        bound = "at its bound" if gain.at_bound else ""
        key = gain.key.replace("[", r"\[")
        table.add_row(key, f"{gain.before:.4g}", f"{gain.after:.4g}", f"{gain.low:.4g} to {gain.high:.4g}", bound)
    console.print(table)
    console.print(result.verdict(tuning), soft_wrap=True, markup=False)
    for path in paths:
        console.print(str(path), soft_wrap=True, markup=False)
    return EXIT_OK


def _loud(source: str) -> str:
    return "ORACLE (true wind)" if source == "oracle" else source


def _print_json(folder: Path, results: list[Any]) -> None:
    import msgspec

    flights = [
        {
            "flight": record,
            "rmse": [{"state": row.state, "ours": row.ours, "paper": row.paper, "ratio": row.ratio} for row in rows],
        }
        for record, rows in results
    ]
    print(msgspec.json.format(msgspec.json.encode({"folder": str(folder), "flights": flights}), indent=2).decode())


class _Status:
    """What an end tells while it runs: lines for a person, or JSON objects for a program. Also its stop flag."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._signal = 0
        _on_signals(self._stop)

    @property
    def stopped(self) -> bool:
        return self._signal != 0

    def _stop(self, number: int, frame: Any) -> None:
        if self._signal:
            raise Interrupted(number)
        self._signal = number

    def stop(self) -> bool:
        return self.stopped

    def progress(self, flight_time_s: float) -> None:
        if self._signal:
            raise Interrupted(self._signal)
        if self._as_json:
            self._print({"event": "progress", "flight_time_s": flight_time_s})

    def say(self, text: str) -> None:
        if self._as_json:
            self._print({"event": "report", "text": text})
        else:
            print(text, flush=True)

    def end(self, outcome: Outcome) -> None:
        if self._as_json:
            self._print({
                "event": "end", "simulated_s": outcome.simulated_s, "wall_s": outcome.wall_s, "speed": outcome.speed,
                "wire_hash": outcome.wire_hash, "finished": outcome.finished,
                "frames": outcome.frames, "rejected": outcome.rejected,
                **({} if outcome.lateness_us is None else {
                    "lateness_us": outcome.lateness_us, "rebased": outcome.rebased, "lost_s": outcome.lost_s,
                }),
                **({"lost": outcome.lost} if outcome.lost else {}),
                "dropped": outcome.dropped, **outcome.links,
            })  # fmt: skip
            return
        print(
            f"{outcome.simulated_s:.1f} s in {outcome.wall_s:.1f} s, {outcome.speed:.2f} x real time; "
            f"{outcome.frames} frames in"
        )
        if outcome.lost:
            print(f"lost: {outcome.lost}")
        if outcome.dropped:
            print("dropped: " + ", ".join(f"{name} {count}" for name, count in outcome.dropped.items()))
        for place, directions in outcome.links.items():
            for direction, counts in directions.items():
                shown = ", ".join(f"{name} {value:g}" for name, value in counts.items() if value)
                print(f"{place} {direction}: {shown}")
        if outcome.lateness_us is not None:
            p50, p99 = outcome.lateness_us
            print(
                f"tick lateness p50 {p50:.0f} us, p99 {p99:.0f} us; "
                f"schedule moved {outcome.rebased} times, {outcome.lost_s:.1f} s given up"
            )

    def end_fleet(self, outcome: FleetOutcome) -> None:
        if self._as_json:
            self._print(outcome.as_event())
            return
        for line in _fleet_table(outcome):
            print(line)

    def _print(self, event: dict[str, Any]) -> None:
        import msgspec

        sys.stdout.write(msgspec.json.encode(event).decode() + "\n")
        sys.stdout.flush()


def _fleet_table(outcome: FleetOutcome) -> list[str]:
    """For a person: each vehicle in a line, and what is of all."""
    total = f"{outcome.simulated_s:.1f} s in {outcome.wall_s:.1f} s, {outcome.speed:.2f} x real time"
    lines = [f"{total}; {outcome.frames} frames in, {len(outcome.vehicles)} vehicles"]
    if any(each.rms_m is not None for each in outcome.vehicles):
        lines.append(f"{'vehicle':>7} {'flown s':>8} {'rms m':>7} {'worst m':>8}  end")
        for each in outcome.vehicles:
            error = f"{'-':>7} {'-':>8}" if each.rms_m is None else f"{each.rms_m:7.3f} {each.worst_m:8.3f}"
            end = f"lost: {each.lost}" if each.lost else "as planned" if each.finished else "not flown to its end"
            lines.append(f"{each.system_id:7d} {each.flight_time_s:8.1f} {error}  {end}")
    for collision in outcome.collisions:
        lines.append(
            f"collision of vehicles {collision.vehicle} and {collision.other} at t = {collision.time_s:.2f} s: "
            f"{collision.distance_m:.2f} m"
        )
    if outcome.dropped:
        lines.append("dropped: " + ", ".join(f"{name} {count}" for name, count in outcome.dropped.items()))
    for each in outcome.vehicles:
        for place, directions in each.link.items():
            for direction, counts in directions.items():
                shown = ", ".join(f"{name} {value:g}" for name, value in counts.items() if value)
                lines.append(f"vehicle {each.system_id}, {place} {direction}: {shown}")
    if outcome.lateness_us is not None:
        p50, p99 = outcome.lateness_us
        lines.append(
            f"tick lateness p50 {p50:.0f} us, p99 {p99:.0f} us; "
            f"schedule moved {outcome.rebased} times, {outcome.lost_s:.1f} s given up"
        )
    return lines


def _check_effect(options: argparse.Namespace, end: str, names: Sequence[str]) -> None:
    """Scenario options that this end does not look at. In lock-step both ends are given all of them."""
    for name in names:
        if getattr(options, name[2:].replace("-", "_")) is not None and not options.lockstep:
            raise UsageError(f"{name}: has no effect on the {end}, give it to the other end")


def _check_lockstep(
    options: argparse.Namespace, *, real_time_only: Sequence[str], lockstep_only: Sequence[str]
) -> None:
    """An option that would have no effect is refused, not ignored."""
    names, needed = (real_time_only, "not with") if options.lockstep else (lockstep_only, "only with")
    for name in names:
        if getattr(options, name[2:].replace("-", "_")) is not None:
            raise UsageError(f"{name}: {needed} --lockstep")


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


def _fleet_states(options: argparse.Namespace, system_id: int, count: int) -> list[Path | None]:
    """Of each vehicle: in ``instance-<I>`` of a folder that is named, else where it would be of each alone."""
    folders: list[Path | None] = []
    for each in range(system_id, system_id + count):
        folder = _state_folder(options, each)
        folders.append(folder if folder is None or options.state_dir is None else folder / f"instance-{each - 1}")
    return folders


def _check_fleet(options: argparse.Namespace, system_id: int) -> int:
    """The number of vehicles of a fleet; 0: it is no fleet."""
    if options.count is None:
        if options.one_link:
            raise UsageError("--one-link: only with --count")
        return 0
    if options.lockstep:
        raise UsageError("--count: not with --lockstep; mavsitl fly --count flies a formation in lock-step")
    count: int = options.count
    if system_id + count - 1 > MAX_VEHICLES:
        last = system_id + count - 1
        raise UsageError(f"--count {count}: system ids {system_id} to {last}; allowed: up to {MAX_VEHICLES}")
    return count


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
    status = _Status(options.status == "json")
    where = "all on one link" if options.one_link else "each further one's ports 1 higher"
    status.say(
        f"vehicles {system_id} to {system_id + count - 1} ({flight.name}): "
        f"off-board {first.bind}:{first.offboard_port} -> {host}:{port}, ground station {first.bind}:{first.gcs_port} "
        f"-> {first.gcs_remote[0]}:{first.gcs_remote[1]}, {where}; Ctrl-C ends it"
    )
    for window in flight.scenario.chaos:
        status.say(f"misbehaves: {window.mode} on port {window.port}")
    outcome = ends.fleet_realtime(
        flight, links, options.run_dir, count=count, system_id=system_id, wing=options.wing,
        speed=options.speed or 1.0, until_finished=bool(options.until_disarmed),
        states=_fleet_states(options, system_id, count), report=status.say, stop=status.stop, progress=None, wish=wish,
    )  # fmt: skip
    status.end_fleet(outcome)
    return EXIT_OK


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


@process.starting()
def _vehicle(options: argparse.Namespace) -> int:
    from mavsitl import ends

    flight = _with_chaos(_load(options.scenario, _settings(options)), options.chaos or ())
    instance = options.instance
    system_id = options.system if options.system is not None else instance + 1
    offboard_remote = options.offboard_remote or f"127.0.0.1:{ends.offboard_remote_port(instance)}"
    links = ends.VehicleLinks(
        bind=options.bind,
        offboard_port=options.offboard_port if options.offboard_port is not None else ends.OFFBOARD_PORT + instance,
        offboard_remote=_endpoint(offboard_remote, "--offboard-remote"),
        gcs_port=options.gcs_port if options.gcs_port is not None else ends.GCS_PORT + instance,
        gcs_remote=_endpoint(options.gcs_remote or f"127.0.0.1:{ends.GCS_REMOTE_PORT}", "--gcs-remote"),
        tcp_port=options.tcp_port,
        insecure=options.insecure,
    )
    _check_effect(options, "vehicle", ("--duration", "--wind-information"))
    if options.insecure and ends.is_loopback(links.bind):
        raise UsageError("--insecure: only with --bind and an address that is not loopback")
    _check_lockstep(
        options,
        real_time_only=(
            "--speed", "--until-disarmed", "--gcs-port", "--gcs-remote", "--tcp-port", "--state-dir", "--no-state",
            "--chaos", "--realtime", "--best-effort",
        ),
        lockstep_only=("--deadline", "--cpu"),
    )  # fmt: skip
    wish = _wish_for_real_time(options)
    if count := _check_fleet(options, system_id):
        return _fleet(options, flight, links, system_id, count, wish)
    status = _Status(options.status == "json")
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
        status.say(
            f"vehicle {system_id} ({flight.name}): off-board {links.bind}:{links.offboard_port} -> {offboard_remote}, "
            f"ground station {links.bind}:{links.gcs_port} -> {links.gcs_remote[0]}:{links.gcs_remote[1]}; "
            "Ctrl-C ends it"
        )
        for window in flight.scenario.chaos:
            status.say(f"misbehaves: {window.mode} on port {window.port}")
        outcome = ends.vehicle_realtime(
            flight, links, options.run_dir, system_id=system_id, wing=options.wing, speed=options.speed or 1.0,
            until_finished=bool(options.until_disarmed), state=_state_folder(options, system_id),
            report=status.say, stop=status.stop, progress=None, wish=wish,
        )  # fmt: skip
    status.end(outcome)
    return EXIT_OK


def _wish_for_real_time(options: argparse.Namespace) -> Wish:
    from mavsitl.realtime import Wish

    if options.best_effort and not options.realtime:
        raise UsageError("--best-effort: only with --realtime")
    if not options.realtime:
        return Wish.ORDINARY
    speed = getattr(options, "speed", None) or 1.0
    if speed > 1.0:
        raise UsageError(
            f"--realtime: not with --speed {speed:g}: a vehicle faster than the machine would hold its core "
            "from everything else; allowed: 1 or less"
        )
    return Wish.BEST_EFFORT if options.best_effort else Wish.DEMANDED


@process.starting()
def _ground(options: argparse.Namespace) -> int:
    from mavsitl import ends
    from mavsitl.link.address import parse_address

    flight = _load(options.scenario, _settings(options))
    address = parse_address(options.link) if options.link else ends.ground_address(options.instance)
    _check_effect(options, "ground", ("--seed",))
    _check_lockstep(
        options, real_time_only=("--realtime", "--best-effort"), lockstep_only=("--deadline", "--cpu", "--vehicle")
    )
    wish = _wish_for_real_time(options)
    first_id = options.system if options.system is not None else options.instance + 1
    if count := _check_fleet(options, first_id):
        return _ground_fleet(options, flight, address, first_id, count, wish)
    status = _Status(options.status == "json")
    if options.lockstep:
        if not address.kind.startswith("udp"):
            raise UsageError(f"--link {options.link}: with --lockstep it is udpin:HOST:PORT")
        remote = _endpoint(options.vehicle or f"127.0.0.1:{ends.OFFBOARD_PORT}", "--vehicle")
        outcome = ends.ground_lockstep(
            flight, (address.host, address.port), remote, options.run_dir,
            vehicle_system_id=options.system, wing=options.wing,
            deadline_s=options.deadline or DEADLINE_S, cpu=options.cpu,
            report=status.say, progress=status.progress,
        )  # fmt: skip
    else:
        status.say(f"ground ({flight.name}): waiting for a vehicle on {address}; Ctrl-C ends it")
        outcome = ends.ground_realtime(
            flight, address, options.run_dir,
            vehicle_system_id=options.system, wing=options.wing, report=status.say, stop=status.stop, progress=None,
            wish=wish,
        )  # fmt: skip
    status.end(outcome)
    return EXIT_OK if outcome.finished or status.stopped else EXIT_FAILED


def _ground_fleet(
    options: argparse.Namespace, flight: Flight, first: Address, system_id: int, count: int, wish: Wish
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
    status = _Status(options.status == "json")
    where = first if links == 1 else f"{first} to {addresses[-1]}"
    status.say(
        f"ground ({flight.name}): waiting for vehicles {system_id} to {system_id + count - 1} on {where}; "
        "Ctrl-C ends it"
    )
    outcome = ends.ground_fleet(
        flight, addresses, options.run_dir, count=count, first_system_id=system_id, wing=options.wing,
        report=status.say, stop=status.stop, wish=wish,
    )  # fmt: skip
    status.end_fleet(outcome)
    return EXIT_OK if outcome.finished or status.stopped else EXIT_FAILED


def _check(options: argparse.Namespace) -> int:
    from rich.console import Console

    from mavsitl import ends
    from mavsitl.link.address import parse_address

    endpoints = None if options.listen is None else [parse_address(text) for text in options.listen]
    console = Console(highlight=False)
    if options.json or not console.is_terminal:
        report = ends.check(endpoints, duration_s=options.duration_s, ask=not options.quiet)
    else:
        with console.status(f"listening for {options.duration_s:g} s"):
            report = ends.check(endpoints, duration_s=options.duration_s, ask=not options.quiet)
    if options.json:
        import msgspec

        print(msgspec.json.format(msgspec.json.encode(report), indent=2).decode())
    else:
        _show_check(console, report, everything=options.all)
    return EXIT_OK if report.ok else EXIT_FAILED


def _show_check(console: Console, report: Report, *, everything: bool) -> None:
    from rich.markup import escape
    from rich.table import Table

    for port in report.ports:
        if not port.ear.error:
            _show_port(console, port, everything=everything)
    if report.vehicle_ports:
        by_holder: dict[str, list[str]] = {}
        for held in report.vehicle_ports:
            by_holder.setdefault(held.holder, []).append(f"{held.port}")
        bound = "; ".join(f"{', '.join(numbers)}{f' by {who}' if who else ''}" for who, numbers in by_holder.items())
        console.print(f"[dim]vehicle ports bound on this machine: {escape(bound)}[/]\n")
    findings = Table.grid(padding=(0, 1))
    marks = {"good": "[bold green]ok[/]", "problem": "[bold red]!![/]", "note": "[cyan]note[/]"}
    for level, mark in marks.items():
        for finding in report.findings:
            if finding.level == level:
                findings.add_row(mark, escape(finding.text))
    console.print(findings)
    if report.ok:
        console.print(f"\n[bold green]A vehicle was heard{' and answers' if report.asked else ''}.[/]")
    else:
        console.print(f"\n[bold red]No vehicle {'that answers' if report.asked else 'was heard'}.[/]")


def _show_port(console: Console, port: PortReport, *, everything: bool) -> None:
    from rich import box
    from rich.table import Table

    seen = f"{port.datagrams} datagrams, {port.frames} good frames" if port.datagrams else "nothing came"
    console.print(f"[bold]{port.ear.endpoint}[/]  {seen}")
    if port.heard:
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        for name in ("from", "id", "what", "MAVLink", "rate", "lost", "answer"):
            table.add_column(name, justify="right" if name in ("rate", "lost") else "left", no_wrap=name == "from")
        for heard in port.heard:
            table.add_row(*_heard_cells(heard))
        console.print(table)
    for heard in port.heard:
        _show_kinds(console, heard, everything=everything)
    console.print()


def _heard_cells(heard: Heard) -> tuple[str, ...]:
    if heard.vehicle:
        what = f"{_spoken(heard.type)}, {_spoken(heard.autopilot)}\n"
        what += f"{heard.mode}, {'armed' if heard.armed else 'disarmed'}"
    else:
        what = "ground station" if heard.ground_station else _spoken(heard.type) or "[red]no HEARTBEAT[/]"
    wire = "+".join(f"{version}" for version in heard.mavlink_versions)
    if heard.signed:
        wire += "\nsigned" if heard.signed == heard.messages else "\npart signed"
    answer = {
        "answered": f"[green]{heard.version}[/]", "acknowledged": "[green]acknowledged[/]",
        "refused": f"[yellow]{heard.result}[/]", "none": "[red]none[/]", "not asked": "",
    }[heard.answer]  # fmt: skip
    if heard.answer_ms is not None:
        answer += f"\n{heard.answer_ms:.0f} ms"
    lost = f"[red]{heard.loss:.1%}[/]" if heard.lost else "0"
    rates = f"{heard.per_s:.1f} msg/s\n{heard.bytes_per_s / 1e3:.1f} kB/s"
    return heard.address, f"{heard.system_id}/{heard.component_id}", what, wire, rates, lost, answer


def _spoken(name: str) -> str:
    return name if name == "PX4" else name.replace("_", " ").lower()


def _show_kinds(console: Console, heard: Heard, *, everything: bool) -> None:
    from rich.table import Table

    name = f"{heard.system_id}/{heard.component_id} at {heard.address}"
    if everything:
        table = Table(f"messages of {name}", "id", "number", "1/s", "B/s")
        for column in table.columns[1:]:
            column.justify = "right"
        for kind in heard.kinds:
            table.add_row(kind.name, f"{kind.id}", f"{kind.messages}", f"{kind.per_s:.1f}", f"{kind.bytes_per_s:.0f}")
        console.print(table)
        return
    most = ", ".join(f"{kind.name} {kind.per_s:.1f}" for kind in heard.kinds[:4])
    rest = len(heard.kinds) - 4
    console.print(f"[dim]{name}, per second: {most}{f', and {rest} more kinds (--all)' if rest > 0 else ''}[/]")


def _ask(options: argparse.Namespace, task: Task, port: int | None = None) -> Reply:
    """The vehicle's answer; `port`: of loopback, plus the instance, where no endpoint is named."""
    from mavsitl import ends
    from mavsitl.link.address import parse_address

    if options.endpoint is not None and options.instance:
        raise UsageError("--instance: not with --endpoint, which names the port itself")
    port = ends.GCS_PORT if port is None else port
    address = parse_address(options.endpoint or f"udpout:127.0.0.1:{port + options.instance}")
    reply = ends.ask(task, address, system_id=options.system, patience_s=options.timeout)
    return reply if reply.ok else _replace(reply, problem=f"{address}: {reply.problem}")


def _tell(options: argparse.Namespace, reply: Reply, done: Callable[[], None]) -> int:
    """Print the reply; `done` prints what a person wants to see of one that is good."""
    if options.json:
        import msgspec

        print(msgspec.json.format(msgspec.json.encode(reply), indent=2).decode())
        return EXIT_OK if reply.ok else EXIT_FAILED
    if reply.ok:
        done()
    for text in reply.texts:
        print(f"vehicle {reply.vehicle} says: {text}", file=sys.stdout if reply.ok else sys.stderr)
    if not reply.ok:
        print(f"mavsitl {options.command}: {reply.problem}", file=sys.stderr)
    return EXIT_OK if reply.ok else EXIT_FAILED


def _replace(reply: Reply, **changes: Any) -> Reply:
    import msgspec

    return msgspec.structs.replace(reply, **changes)


def _link(options: argparse.Namespace) -> int:
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
        reply = _replace(reply, problem=f"{reply.problem} ({hint})")

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
            import msgspec

            print(msgspec.json.format(msgspec.json.encode({"units": units, "types": kinds}), indent=2).decode())
        else:
            print(f"units: {', '.join(units)}\ntypes: {', '.join(kinds)}")
        return EXIT_OK
    for what, name, known in (("UNIT", options.unit, units), ("TYPE", options.type, kinds)):
        if name is None:
            raise UsageError(f"{what}: missing; allowed: {', '.join(known)}")
        if name not in known:
            raise UsageError(f"{what}: {name!r} is not allowed; allowed: {', '.join(known)}")
    params = (float(units[options.unit]), float(kinds[options.type]), float(options.instance))
    reply = _ask(options, ask.CommandTask(mavlink.MAV_CMD_INJECT_FAILURE, *params))
    which = f" {options.instance}" if options.instance else ""
    return _tell(options, reply, lambda: print(f"{options.unit}{which} {options.type}: {reply.result.lower()}"))


def _param(options: argparse.Namespace) -> int:
    from fnmatch import fnmatchcase

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
        reply = _replace(reply, ok=not problem, parameters=found, problem=problem)

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


def _sweep(options: argparse.Namespace) -> int:
    from rich.console import Console

    from mavsitl.campaign import optional, sweep
    from mavsitl.campaign.store import Journal
    from mavsitl.clock import utc_stamp

    _on_signals(_interrupt)
    if options.jobs is not None and options.scheduler is not None:
        raise UsageError("--jobs: not with --scheduler, whose workers are what they are")
    plan = sweep.plan(options.scenario, options.settings, options.compare, options.seeds)
    optional.need("pyarrow")  # before anything flies
    facts = sweep.metadata(plan, "mavsitl " + shlex.join(sys.argv[1:]), utc_stamp())
    name = plan.cases[0].flight.name
    folder: Path = options.output or Path("runs") / f"sweep-{name}"
    console = Console(stderr=options.json, highlight=False)
    console.print(f"[bold]{name}[/]  {plan}", soft_wrap=True)
    with Journal(folder / sweep.JOURNAL_FILE) as journal:
        known = sweep.known(plan, journal)
        for text in _told(known, len(plan.cases), folder):
            console.print(text, soft_wrap=True, markup=False)
        missing = len(plan.cases) - known.flown
        if missing:
            with _crew(options, missing) as crew:
                _fly_missing(plan, journal, crew, known.flown, folder)
        rows = sweep.rows(plan, journal)
    results = sweep.save(plan, rows, folder, facts)
    summary = sweep.summary(plan, rows)
    page = None
    if not options.no_report:
        from mavsitl.report import sweep as report

        page = report.write(folder, rows, summary, plan.grid.keys, facts)
    if options.json:
        _print_sweep_json(results, rows, summary)
    else:
        _show_sweep(console, summary)
    for what, path in (("results", results), ("report", page)):
        if path is not None:
            console.print(f"{what + ':':8s} {path}", soft_wrap=True, markup=False)
    failed = [row for row in rows if row.status == "failed"]
    if failed:
        said = sorted({row.message for row in failed})
        console.print(f"{len(failed)} of {len(rows)} failed: {said[0]}", soft_wrap=True, markup=False, style="bold red")
    return EXIT_FAILED if failed else EXIT_OK


def _crew(options: argparse.Namespace, missing: int) -> Workers:
    from mavsitl.campaign import workers

    if options.scheduler is None:
        return workers.local(min(options.jobs or workers.cores(), missing))
    import logging

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what goes wrong comes as our own error
    return workers.Dask(options.scheduler)


def _told(known: Known, total: int, folder: Path) -> list[str]:
    """What of a sweep need not be flown again, and what has to, and why."""
    told = []
    if known.flown:
        told.append(f"{known.flown} of {total} were flown before ({folder})")
    if known.other_code:
        told.append(f"{known.other_code} of {total} were flown before by other code, and are flown again")
    if known.other_scenario:
        told.append(
            f"{known.other_scenario} of {total} were flown before with other settings or another scenario file, "
            "and are flown again"
        )
    return told


def _fly_missing(plan: Plan, journal: Journal, crew: Workers, before: int, folder: Path) -> None:
    """With a progress bar on stderr."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from mavsitl.campaign import sweep

    console = Console(stderr=True, highlight=False)
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    total, done = len(plan.cases), before
    counts = {"lost": 0, "failed": 0}
    with Progress(*columns, TextColumn("{task.fields[said]}"), console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("flights", total=total, completed=before, said="")
        try:
            for row in sweep.fly(plan, journal, crew):
                done += 1
                if not row.flown:
                    counts[row.status] += 1
                said = ", ".join(f"{count} {status}" for status, count in counts.items() if count)
                bar.update(task, advance=1, said=said)
        except BaseException:
            bar.stop()
            console.print(
                f"{done} of {total} are in {folder}; the same command goes on with the rest",
                soft_wrap=True, markup=False,
            )  # fmt: skip
            raise


def _print_sweep_json(results: Path, rows: Sequence[Row], summary: Summary) -> None:
    import msgspec

    counts = {status: sum(row.status == status for row in rows) for status in ("flown", "lost", "failed")}
    shown = {"results": str(results), "flights": len(rows), **counts, **msgspec.to_builtins(summary)}
    print(msgspec.json.format(msgspec.json.encode(shown), indent=2).decode())


def _show_sweep(console: Console, summary: Summary) -> None:
    from rich import box
    from rich.table import Table

    from mavsitl.report import sweep_tables

    shown = [("medians, 95 % intervals", sweep_tables.cell_header(summary), sweep_tables.cell_rows(summary))]
    if summary.comparisons:
        header, rows = list(sweep_tables.COMPARISON_HEADER), sweep_tables.comparison_rows(summary)
        shown.append(("seed by seed: median difference and ratio, Wilcoxon's p", header, rows))
    for title, header, rows in shown:
        table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
        for column in header:
            table.add_column(column, justify="left" if column in ("", "measure") else "right")
        for cells in rows:
            table.add_row(*cells)
        console.print(table)


def _report(options: argparse.Namespace) -> int:
    from mavsitl.report.html import write_report

    for folder in options.runs:
        print(write_report(folder))
    return EXIT_OK


def _scenarios(options: argparse.Namespace) -> int:
    from mavsitl import scenario

    flights = [scenario.load(name) for name in scenario.names()]
    if options.json:
        import msgspec

        print(msgspec.json.format(msgspec.json.encode({f.name: f.scenario for f in flights}), indent=2).decode())
        return EXIT_OK
    from rich.console import Console
    from rich.table import Table

    table = Table("scenario", "title", "airframe", "wind", "reference", "level")
    for flight in flights:
        s = flight.scenario
        wind = " + ".join(str(model.__struct_config__.tag) for model in s.wind) or "calm"
        table.add_row(
            flight.name, s.title, s.airframe, wind, str(s.reference.__struct_config__.tag), s.controller.level
        )
    Console().print(table)
    return EXIT_OK


def _chaos(options: argparse.Namespace) -> int:
    from mavsitl.chaos.table import TABLE

    if options.json:
        import msgspec

        rows = [
            {
                "name": name, "group": row.group, "does": row.text, "mocklink": row.mocklink,
                "arguments": [{"name": each.name, "default": each.default} for each in row.arguments],
            }
            for name, row in TABLE.items()
        ]  # fmt: skip
        print(msgspec.json.format(msgspec.json.encode(rows), indent=2).decode())
        return EXIT_OK
    from rich.console import Console
    from rich.table import Table

    console = Console()
    for group in dict.fromkeys(row.group for row in TABLE.values()):
        table = Table("mode", "what goes wrong", title=group, title_justify="left", title_style="bold", expand=True)
        table.columns[0].no_wrap = True
        for name, row in TABLE.items():
            if row.group == group:
                defaults = ", ".join(f"{each.name} {each.default}" for each in row.arguments if each.default)
                table.add_row(row.usage(name).replace("[", r"\["), row.text + (f" ({defaults})" if defaults else ""))
        console.print(table)
    return EXIT_OK
