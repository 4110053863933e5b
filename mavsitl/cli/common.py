"""What the commands share: exit codes, signals, types of arguments, the scenario's options, where a run's files are."""

from __future__ import annotations

import argparse
import math
import shlex
import signal
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Of these each command takes what it raises and returns from here.
from mavsitl.errors import EXIT_FAILED as EXIT_FAILED
from mavsitl.errors import EXIT_OK as EXIT_OK
from mavsitl.errors import EXIT_USAGE as EXIT_USAGE
from mavsitl.errors import UsageError as UsageError

if TYPE_CHECKING:
    from mavsitl.scenario import Flight


PAPER_SCENARIOS = ("hover-calm", "hover-wind", "spiral-calm", "spiral-wind")

SLOWEST_SPEED = 0.5
"""Clients miss a HEARTBEAT after 3 s of wall clock."""

EXIT_SIGNAL = 128
"""And the signal's number, as shells say it: 130 is Ctrl-C."""


class Interrupted(KeyboardInterrupt):
    """A signal that ends the program, wherever it is."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def interrupt(number: int, frame: Any) -> None:
    raise Interrupted(number)


def on_signals(handler: Callable[[int, Any], None]) -> None:
    """Ctrl-C, the usual request to end, and the end of the terminal, unless that is ignored (nohup)."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # the last where the system has it
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


@contextmanager
def leaving(note: Callable[[], str]) -> Iterator[None]:
    """Where this ends early, by an error or a signal, `note` is asked for a line to be told with it; empty: none."""
    try:
        yield
    except BaseException as ended:
        if text := note():
            ended.add_note(text)
        raise


@contextmanager
def logs_in(folder: Path | None) -> Iterator[None]:
    """Where this ends early, the user is told of the folder if anything was written there; None: there is no folder."""

    def written() -> dict[Path, int]:
        files = () if folder is None else folder.rglob("*")
        return {file: file.stat().st_mtime_ns for file in files}

    before = written()
    with leaving(lambda: "" if written() == before else f"logs so far: {folder}"):
        yield


def run_folder(named: Path | None, stamp: str) -> Path:
    """Of a run that began at `stamp` (`clock.utc_stamp`)."""
    return named or Path("runs") / stamp.replace(":", "").replace("-", "")


def command_line() -> str:
    """How this program was called, to be kept with what it writes."""
    return "mavsitl " + shlex.join(sys.argv[1:])


def command(commands: Any, name: str, summary: str, description: str, epilog: str = "") -> argparse.ArgumentParser:
    """A command of its own below `commands`: `summary` is its line in the list, the others are its help."""
    parser: argparse.ArgumentParser = commands.add_parser(name, help=summary, description=description, epilog=epilog)
    return parser


def add_json(group: Any, what: str) -> None:
    """The option of a command that prints one value for a program; `what` it is."""
    group.add_argument("--json", action="store_true", help=f"print {what} as JSON and nothing else")


def whole(least: int, most: int) -> Callable[[str], int]:
    """The type of an option that takes a whole number within bounds."""

    def read(text: str) -> int:
        if not (text.isascii() and text.isdigit() and least <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"{text!r} is not allowed; allowed: a whole number from {least} to {most}")
        return int(text)

    return read


def _number(allowed: Callable[[float], bool], said: str) -> Callable[[str], float]:
    """The type of an option that takes a finite number."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and allowed(value)):
            raise argparse.ArgumentTypeError(f"{text!r} is not allowed; allowed: a finite number{said}")
        return value

    return read


above_zero = _number(lambda value: value > 0.0, " above 0")
not_negative = _number(lambda value: value >= 0.0, ", 0 or more")
at_least_1 = _number(lambda value: value >= 1.0, ", 1 or more")
share = _number(lambda value: 0.0 <= value <= 1.0, " from 0 to 1")


def speed_factor(text: str) -> float:
    value = above_zero(text)
    if value < SLOWEST_SPEED:
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; allowed: {SLOWEST_SPEED:g} or more")
    return value


PORT = whole(0, 65535)

LARGEST_SEED = 2**63 - 1
"""TOML's integers end there."""

SYSTEM = whole(1, 255)


def add_scenario_options(parser: argparse.ArgumentParser, *, seed: bool = True) -> None:
    """`seed`: False for a command that flies many seeds."""
    group = parser.add_argument_group("scenario")
    if seed:
        group.add_argument(
            "--seed", type=whole(0, LARGEST_SEED), metavar="N", help="seed of wind and noise (scenario key: seed)"
        )
    group.add_argument("--airframe", metavar="NAME", help="paper, realistic, full-coupling or a .toml file (airframe)")
    group.add_argument("--law", choices=("pidnn", "pid"), help="attitude law (controller.law)")
    group.add_argument("--level", choices=("attitude", "body_rate", "torque"), help="command level (controller.level)")
    group.add_argument(
        "--wind-information",
        choices=("oracle", "observer", "none"),
        help="source of W1..W3 (controller.wind_information)",
    )
    group.add_argument("--duration", type=above_zero, metavar="S", help="flight time in seconds (duration_s)")
    group.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="any key of the scenario, dotted, with a TOML value; may be repeated",
    )  # fmt: skip


def add_scenario(parser: argparse.ArgumentParser, what: str) -> None:
    """The one scenario of a process that stands alone; `what` it takes from it."""
    parser.add_argument(
        "scenario", nargs="?", default="takeoff-hover", metavar="SCENARIO", help=f"{what} (default: takeoff-hover)"
    )
    add_scenario_options(parser)


def settings_of(options: argparse.Namespace) -> list[str]:
    """All scenario options as KEY=VALUE, the form in which they are handed on to the processes."""
    settings = list(options.settings)
    named = {
        "seed": getattr(options, "seed", None), "airframe": options.airframe,
        "controller.law": options.law, "controller.level": options.level,
        "controller.wind_information": options.wind_information, "duration_s": options.duration,
    }  # fmt: skip
    if getattr(options, "controller", None) is not None:
        from mavsitl import controllers

        if options.law is not None:
            raise UsageError("--law: not with --controller, which says the law")
        chosen = controllers.settings(options.controller)
        if chosen.get("controller.own") and options.level is not None:
            raise UsageError("--level: not with a controller of your own, whose demands say the level")
        named |= chosen
    for key, value in named.items():
        if value is not None:
            settings.append(f'{key}="{value}"' if isinstance(value, str) else f"{key}={value}")
    return settings


def add_controller(parser: argparse.ArgumentParser) -> None:
    """After `add_scenario_options`, of a command that flies."""
    parser.add_argument(
        "--controller", metavar="NAME",
        help="your own controller, FILE.py:NAME or MODULE:NAME, or an installed one: "
        "pidnn, pid, stock, geometric, indi, ... (controller.own)",
    )  # fmt: skip


def load(name: str, settings: Sequence[str]) -> Flight:
    from mavsitl import scenario

    return scenario.load(name, overrides_of(settings))


def overrides_of(settings: Sequence[str]) -> dict[str, Any]:
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


def endpoint(text: str, option: str) -> tuple[str, int]:
    from mavsitl.link.address import AddressError, parse_address

    try:
        address = parse_address(f"udpout:{text}")
    except AddressError as error:
        raise AddressError(f"{option} {text}: not HOST:PORT ({error})") from error
    return address.host, address.port


def print_json(value: Any) -> None:
    """For a program: indented JSON of structs, dictionaries and lists, and nothing else on stdout."""
    import msgspec

    print(msgspec.json.format(msgspec.json.encode(value), indent=2).decode())
