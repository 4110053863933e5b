"""The command `mavsitl`, the only place that prints: a module for each of its commands, or for those of a kind.

What several share: `common` (arguments, exit codes, signals), `ends` (a process that runs alone), `campaigns` (many
flights), `screen` (what a person sees). A command's module says what is asked and what is answered; how is elsewhere.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable, Sequence

from mavsitl import __version__, process
from mavsitl.cli import ask, check, fly, ground, lists, report, sweep, tune, vehicle
from mavsitl.cli.common import EXIT_FAILED, EXIT_SIGNAL, EXIT_USAGE, Formatter, Interrupted
from mavsitl.errors import MavsitlError

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
        _tell(options.command, "interrupted", interrupt)
        return EXIT_SIGNAL + (interrupt.number if isinstance(interrupt, Interrupted) else signal.SIGINT)
    except BrokenPipeError:
        # The reader of our output went away; point stdout elsewhere so that the interpreter's last flush is quiet.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_FAILED
    except MavsitlError as error:
        _tell(options.command, str(error), error)
        return error.exit_code


def _tell(command: str, text: str, error: BaseException) -> None:
    """The error's text and its notes, a line each."""
    print(f"mavsitl {command}: {text}", *getattr(error, "__notes__", ()), sep="\n", file=sys.stderr)


def build_parser() -> argparse.ArgumentParser:
    """The whole command line; the reference page of the docs is made from it."""
    parser = argparse.ArgumentParser("mavsitl", description=DESCRIPTION, epilog=EPILOG, formatter_class=Formatter)
    parser.add_argument("--version", action="version", version=f"mavsitl {__version__}")
    commands = parser.add_subparsers(title="commands", dest="command", metavar="COMMAND")
    for add in (
        fly.add, vehicle.add, ground.add, check.add, ask.add_link, ask.add_inject, ask.add_param, sweep.add, tune.add,
        report.add, lists.add_scenarios, lists.add_chaos,
    ):  # fmt: skip
        add(commands)
    return parser
