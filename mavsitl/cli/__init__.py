"""The command `mavsitl`, the only place that prints: a module for each of its commands, or for those of a kind.

What several share: `common` (arguments, exit codes, signals), `ends` (a process that runs alone), `campaigns` (many
flights), `screen` (what a person sees). A command's module says what is asked and what is answered; how is elsewhere.
"""

from __future__ import annotations

import argparse
import errno
import os
import signal
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise

from mavsitl import __version__, process
from mavsitl.cli import ask, bench, check, completion, fly, ground, lists, log, report, sweep, tune, vehicle, view
from mavsitl.cli.common import EXIT_FAILED, EXIT_SIGNAL, EXIT_USAGE, Interrupted
from mavsitl.cli.parser import ParseError, Parser
from mavsitl.errors import MavsitlError

DESCRIPTION = (
    "A quadrotor in Dryden wind and an off-board controller, two processes that meet on MAVLink 2 over UDP alone."
)

EPILOG = """\
start here:
  mavsitl fly hover-wind     a flight in the wind, in a few seconds, and its report
  mavsitl vehicle            a vehicle for QGroundControl, MAVSDK and others, on PX4's ports
  mavsitl check              is one there, and does it answer?
  mavsitl COMMAND --help     what a command takes, with examples

Exit codes: 0 done; 1 the run failed (the message says which end and why) or a vehicle was lost; 2 wrong arguments,
scenario or path; 130 interrupted by Ctrl-C, 143 by SIGTERM, 129 by the terminal's end. A vehicle or a ground in real
time runs until it is told to end: for these two a signal is the end, and 0. However it ends, logs and state are
complete.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """The `mavsitl` command; its exit code. Raises `SystemExit` after --help and --version, as argparse does."""
    given = sys.argv[1:] if arguments is None else arguments
    parser = build_parser()
    called = parser.prog
    if "_ARGCOMPLETE" in os.environ:
        completion.complete(parser)
    try:
        options = parser.parse_args(given)
        run: Callable[[argparse.Namespace], int] | None = getattr(options, "run", None)
        if run is None:
            parser.print_help()
            return EXIT_USAGE
        called = " ".join(filter(None, (parser.prog, options.command, getattr(options, "log_command", None))))
        process.one_blas_thread()
        return run(options)
    except KeyboardInterrupt as interrupt:
        code = EXIT_SIGNAL + (interrupt.number if isinstance(interrupt, Interrupted) else signal.SIGINT)
        return _tell(called, "interrupted", interrupt, code, as_json=_for_a_program(given))
    except BrokenPipeError:  # the reader of our output went away
        _silence()
        return EXIT_FAILED
    except MavsitlError as error:
        if isinstance(error, ParseError):
            called = error.prog
        return _tell(called, f"{error}", error, error.exit_code, as_json=_for_a_program(given))
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        _silence()
        return _tell(called, f"output cannot be written: {error.strerror}", error, EXIT_FAILED, as_json=False)


def _silence() -> None:
    """Point stdout elsewhere, so that the interpreter's last flush does not fail once more."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _for_a_program(arguments: Sequence[str]) -> bool:
    """Told from the arguments as they are: those that cannot be parsed are answered as JSON, too."""
    return not {"--json", "--status=json"}.isdisjoint(arguments) or ("--status", "json") in pairwise(arguments)


def _tell(called: str, text: str, error: BaseException, code: int, *, as_json: bool) -> int:
    """The error's text on stderr, with its notes in a line each; for a program an object on stdout has them."""
    notes: list[str] = getattr(error, "__notes__", [])
    print(f"{called}: {text}", *([] if as_json else notes), sep="\n", file=sys.stderr)
    if as_json:
        import msgspec

        told = {"event": "error", "command": called, "error": text, "notes": notes, "exit_code": code}
        print(msgspec.json.encode(told).decode(), flush=True)
    return code


def build_parser() -> Parser:
    """The whole command line; the reference page of the docs is made from it."""
    parser = Parser("mavsitl", description=DESCRIPTION, epilog=EPILOG)
    parser.add_argument("--version", action="version", version=f"mavsitl {__version__}")
    commands = parser.add_subparsers(title="commands", prog=parser.prog, dest="command", metavar="COMMAND")
    for add in (
        fly.add, vehicle.add, ground.add, check.add, ask.add_link, ask.add_inject, ask.add_param, sweep.add, tune.add,
        bench.add, view.add, report.add, log.add, lists.add_scenarios, lists.add_chaos, completion.add,
    ):  # fmt: skip
        add(commands)
    return parser
