"""`mavsitl log info`, `convert` and `diff`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavsitl.cli.common import EXIT_OK, EXIT_USAGE, UsageError, add_json, command, not_negative, print_json
from mavsitl.log.endings import ENDINGS

if TYPE_CHECKING:
    from rich.console import Console

    from mavsitl.log.diff import Difference
    from mavsitl.log.info import LogInfo

EXIT_DIFFER = 1
"""As of diff(1), and 2 is trouble."""

SHOWN = 10
"""Columns of a topic, parameters or texts that are listed of a difference."""

WIDE = 80
"""Columns of a terminal from which on it is listed when a topic begins and ends; --json always has it."""

HELP = """\
What is in a log, a log in another format, and where two flights part. LOG is a ULog (.ulg), a tlog, or the folder of a
run or of one vehicle of a fleet; docs/howto/logs.md says with what else they open.
"""
LOG_EXAMPLES = """\
examples:
  mavsitl log info hover                   # of each log in the folder of a run
  mavsitl log convert hover hover.ulg      # both ends in one file, for PlotJuggler and Flight Review
  mavsitl log convert hover hover.mcap     # for Foxglove
  mavsitl log diff hover hover-again
"""
INFO = """\
Topics with rates and gaps, parameters, texts, and how the log ended; of a tlog messages, who sent them, and losses. Of
a run's folder, each log in it; of a fleet's, a row for each vehicle.
"""
CONVERT = """\
Write a log in the format that the ending of OUT says. Of a run's folder its ULogs are joined: a topic that both ends
have is the vehicle's, the ground's has the next instance (vehicle_attitude_setpoint.1).

{formats}
OUT is there whole, or as it was before. Of a fleet, or of a run of several flights, each gets a file of its own: of
OUT spiral.mcap they are spiral/vehicle-0.mcap and so on.
"""
DIFF = """\
Compare two logs, or two runs, topic by topic: whether they are the same to the byte, or from when on and by how much
they differ. Rows are compared where both have one of the same time. A boot time differs without being a difference.
"""
DIFF_EXIT = "Exit codes: 0 equal, 1 they differ, 2 a log cannot be read.\n"


def add(commands: Any) -> None:
    parser = command(commands, "log", "look into logs, convert and compare them", HELP, LOG_EXAMPLES)
    parser.set_defaults(run=lambda options: _help(parser))
    kinds = parser.add_subparsers(title="commands", dest="log_command", metavar="COMMAND", help="what to do")

    info = command(kinds, "info", "what is in a log", INFO)
    info.add_argument(
        "logs", nargs="+", type=Path, metavar="LOG", help="a .ulg, a .tlog, or the folder of a run or fleet"
    )
    info.add_argument("--parameters", action="store_true", help="list every parameter")
    add_json(info, "all of it")
    info.set_defaults(run=_info)

    convert = command(
        kinds,
        "convert",
        "write a log in another format",
        CONVERT.format(formats="".join(f"  {each:13} {text}\n" for each, text in ENDINGS.items())),
    )
    convert.add_argument("log", type=Path, metavar="LOG", help="a .ulg, a .tlog, or the folder of a run")
    convert.add_argument(
        "out", type=Path, metavar="OUT", help="the file to write, or of several flights their folder and ending"
    )
    convert.add_argument(
        "--topic", action="append", default=[], metavar="NAME",
        help="write this one; may be repeated (default: all); mavsitl log info names them",
    )  # fmt: skip
    add_json(convert, "what was written")
    convert.set_defaults(run=_convert)

    diff = command(kinds, "diff", "where two flights part", DIFF, DIFF_EXIT)
    diff.add_argument("one", type=Path, metavar="LOG", help="the one")
    diff.add_argument("other", type=Path, metavar="LOG", help="the other: a .ulg, a .tlog, or the folder of a run")
    diff.add_argument(
        "--tolerance", type=not_negative, default=0.0, metavar="X",
        help="numbers that differ by no more are equal (default: 0)",
    )  # fmt: skip
    add_json(diff, "the differences")
    diff.set_defaults(run=_diff)


def _help(parser: argparse.ArgumentParser) -> int:
    parser.print_help()
    return EXIT_USAGE


def _info(options: argparse.Namespace) -> int:
    from mavsitl.log.content import is_fleet
    from mavsitl.log.info import inspect

    found = [inspect(path) for path in options.logs]
    if options.json:
        print_json([info for infos in found for info in infos])
        return EXIT_OK
    from mavsitl.cli import screen

    console = screen.console()
    for infos in found:
        if is_fleet(list({Path(info.path).parent: None for info in infos})) and not options.parameters:
            _show_fleet(console, infos)
            continue
        for info in infos:
            _show(console, info, all_parameters=options.parameters)
    return EXIT_OK


_LEVELS = ("EMERGENCY", "ALERT", "CRITICAL", "ERROR", "WARNING")
"""Of texts that a row for a vehicle tells, the gravest first."""


def _show_fleet(console: Console, infos: Sequence[LogInfo]) -> None:
    """A row for each vehicle."""
    from rich.markup import escape

    from mavsitl.cli import screen

    vehicles: dict[Path, list[LogInfo]] = {}
    for info in infos:
        vehicles.setdefault(Path(info.path).parent, []).append(info)
    folder, first = next(iter(vehicles)).parent, next(iter(vehicles)).name
    screen.line(console, f"{folder}: {len(vehicles)} vehicles", "bold")
    numbers = ("logs", "MB", "duration / s", "topics", "frames lost", "texts")
    table = screen.table("folder", *numbers, "ended", "gravest text", right=numbers, whole=("folder",))
    for path, logs in vehicles.items():
        texts = [text for info in logs for text in info.texts]
        grave = sorted((text for text in texts if text.level in _LEVELS), key=lambda text: _LEVELS.index(text.level))
        table.add_row(
            path.name, str(len(logs)), f"{sum(info.size_bytes for info in logs) / 1e6:.2f}",
            f"{max(info.duration_s for info in logs):.3f}", str(sum(len(i.topics) for i in logs if i.kind == "ULog")),
            str(sum(source.lost for info in logs for source in info.sources)), str(len(texts)),
            "cut" if any(info.cut_bytes for info in logs) else "whole",
            escape(f"{grave[0].level}: {grave[0].text}") if grave else "",
        )  # fmt: skip
    console.print(table)
    screen.line(console, f"one of them: mavsitl log info {folder / first}")


def _show(console: Console, info: LogInfo, *, all_parameters: bool) -> None:
    from rich.markup import escape

    from mavsitl.cli import screen

    ended = f"cut: {info.cut_bytes} bytes of a message are left over" if info.cut_bytes else "whole"
    console.print(f"[bold]{escape(info.path)}[/]")
    console.print(
        f"{info.kind}, {info.size_bytes / 1e6:.2f} MB, {info.duration_s:.3f} s from {info.start_s:.3f} s, {ended}"
    )
    about = [f"{key} {value}" for key, value in sorted(info.information.items())]
    if about:
        console.print(escape(", ".join(about)))
    if info.kind == "tlog":
        console.print(f"{info.bad_frames} frames that are no good")
        names = ("system", "component", "frames", "lost")
        sources = screen.table(*names, right=names)
        for source in info.sources:
            sources.add_row(*(str(each) for each in (source.system, source.component, source.frames, source.lost)))
        console.print(sources)
    what = "topic" if info.kind == "ULog" else "message"
    numbers = ["rows", "Hz", "longest gap / s", *(["from / s", "to / s"] if console.width >= WIDE else [])]
    table = screen.table(what, *numbers, right=numbers, whole=(what,))
    for topic in info.topics:
        rate = "" if topic.rate_hz is None else f"{topic.rate_hz:.4g}"
        gap = "" if topic.longest_gap_s is None else f"{topic.longest_gap_s:.3f}"
        cells = (str(topic.rows), rate, gap, f"{topic.first_s:.3f}", f"{topic.last_s:.3f}")
        table.add_row(topic.name, *cells[: len(numbers)])
    console.print(table)
    if info.dropouts_s:
        console.print(f"dropouts: {info.dropouts_s:.3f} s")
    if info.parameters:
        changed = {name: f"{info.parameters[name]:g} (default {value:g})" for name, value in info.defaults.items()}
        shown = {name: f"{value:g}" for name, value in info.parameters.items()} | changed if all_parameters else changed
        console.print(f"{len(info.parameters)} parameters, {len(changed)} of them not at their default")
        for name, text in sorted(shown.items()):
            console.print(f"  {name} {text}")
    for change in info.changes:
        console.print(f"  {change.time_s:.3f} s: {change.name} becomes {change.value:g}")
    if info.texts:
        console.print("texts")
    for each in info.texts:
        console.print(f"  {each.time_s:.3f} s {each.level}: {escape(each.text)}")
    console.print()


def _convert(options: argparse.Namespace) -> int:
    from mavsitl.log.convert import convert, outputs

    written = []
    files = outputs(options.log, options.out)
    for log, out in files.items():
        topics = convert(log, out, options.topic)
        written.append({"out": str(out), "bytes": out.stat().st_size, "topics": topics})
        if not options.json:
            print(f"{out}: {len(topics)} topics, {out.stat().st_size / 1e6:.2f} MB")
    if options.json:
        print_json(written[0] if len(files) == 1 else written)
    return EXIT_OK


def _diff(options: argparse.Namespace) -> int:
    from mavsitl.log.diff import compare
    from mavsitl.log.errors import LogError

    try:
        found = compare(options.one, options.other, options.tolerance)
    except LogError as error:
        raise UsageError(f"{error}") from error
    if options.json:
        print_json({"equal": found.equal, "parted_s": found.parted_s, "difference": found})
    else:
        _show_difference(found)
    return EXIT_OK if found.equal else EXIT_DIFFER


def _show_difference(found: Difference) -> None:
    from mavsitl.cli import screen

    console = screen.console()
    if found.equal:
        console.print("the same to the byte" if found.same_bytes else f"equal: {found.equal_topics} topics")
        return
    screen.line(console, f"1: {found.logs[0]}\n2: {found.logs[1]}")
    for key, (one, other) in found.information.items():
        screen.line(console, f"{key}: {one} and {other}")
    for name, values in list(found.parameters.items())[:SHOWN]:
        console.print(name, *("not there" if value is None else f"{value:g}" for value in values))
    if found.parted_s is not None:
        console.print(f"they part at {found.parted_s:.6f} s; {found.equal_topics} topics are equal")
    numbers = ("from / s", "rows", "largest difference")
    table = screen.table("topic", "column", *numbers, right=numbers)
    for topic in found.topics:
        if topic.only_in is not None:
            table.add_row(topic.name, f"only in {topic.only_in}", f"{topic.first_s:.6f}", str(sum(topic.rows)), "")
            continue
        one_has, other_has = topic.rows
        if not one_has == other_has == topic.common:
            table.add_row(topic.name, f"{one_has} and {other_has} rows", "", f"{topic.common} common", "")
        for column, number in topic.columns_only_in:
            table.add_row(topic.name, f"{column} only in {number}", "", "", "")
        for each in topic.columns[:SHOWN]:
            largest = "" if each.largest is None else f"{each.largest:.4g}"
            table.add_row(topic.name, each.name, f"{each.first_s:.6f}", f"{each.rows} of {topic.common}", largest)
    console.print(table)
    for number, text in found.texts[:SHOWN]:
        screen.line(console, f"only in {number}: {text}")
