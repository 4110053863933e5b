"""The commands. The only place that prints: a module for each, or for those of a kind."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable, Sequence

from mavsitl import __version__, process
from mavsitl.cli import ask, check, fly, ground, lists, sweep, tune, vehicle, view
from mavsitl.cli.common import EXIT_FAILED, EXIT_SIGNAL, EXIT_USAGE, Formatter, Interrupted, UsageError

DESCRIPTION = (
    "A quadrotor in Dryden wind and an off-board controller, two processes that meet on MAVLink 2 over UDP alone."
)

EPILOG = """\
Exit codes: 0 done; 1 the run failed (the message says which end and why) or a vehicle was lost; 2 wrong arguments or
scenario; 130 interrupted by Ctrl-C, 143 by SIGTERM, 129 by the terminal's end. A vehicle or a ground in real time runs
until it is told to end: for these two a signal is the end, and 0. However it ends, logs and state are complete.
Documentation: docs/index.md. Each command's own --help says more.
"""


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
    parser = argparse.ArgumentParser("mavsitl", description=DESCRIPTION, epilog=EPILOG, formatter_class=Formatter)
    parser.add_argument("--version", action="version", version=f"mavsitl {__version__}")
    commands = parser.add_subparsers(title="commands", dest="command", metavar="COMMAND")
    for add in (
        fly.add, vehicle.add, ground.add, check.add, ask.add_link, ask.add_inject, ask.add_param, sweep.add, tune.add,
        view.add, lists.add_report, lists.add_scenarios, lists.add_chaos,
    ):  # fmt: skip
        add(commands)
    return parser
