"""`mavsitl scenarios` and `mavsitl chaos`: lists of what there is."""

from __future__ import annotations

import argparse
from typing import Any

from mavsitl.cli.common import EXIT_OK, add_json, command, print_json

LEAST_WIDTH = {"level": 100, "airframe": 90, "reference": 76}
"""Columns of a terminal from which on this is listed of a scenario, too: its title is more worth."""

CHAOS_HELP = """\
List what mavsitl vehicle --chaos makes the vehicle do wrong, for tests of ground stations and SDKs: acknowledgements
that are lost, late, doubled, refused; transfers of parameters, missions and files that break; silence.

A mode is written NAME[:ARGUMENT...][@PORT], for example ack-late:2.5:NAV_TAKEOFF@gcs; PORT is all, offboard or gcs.
Arguments may be left out from the right; an empty one is the default.
"""


def add_scenarios(commands: Any) -> None:
    parser = command(
        commands, "scenarios", "list the shipped scenarios", "List the shipped scenarios with what they fly."
    )
    add_json(parser, "the scenarios, each with all its keys,")
    parser.set_defaults(run=_scenarios)


def add_chaos(commands: Any) -> None:
    parser = command(commands, "chaos", "list what a vehicle can do wrong on MAVLink", CHAOS_HELP)
    add_json(parser, "the modes")
    parser.set_defaults(run=_chaos)


def _scenarios(options: argparse.Namespace) -> int:
    from mavsitl import scenario

    flights = [scenario.load(name) for name in scenario.names()]
    if options.json:
        print_json({f.name: f.scenario for f in flights})
        return EXIT_OK
    from mavsitl.cli import screen

    console = screen.console()
    names = ("scenario", "title", "airframe", "wind", "reference", "level")
    columns = [name for name in names if console.width >= LEAST_WIDTH.get(name, 0)]
    table = screen.table(*columns, whole=set(columns) - {"title"})
    for flight in flights:
        s = flight.scenario
        wind = " + ".join(str(model.__struct_config__.tag) for model in s.wind) or "calm"
        reference = str(s.reference.__struct_config__.tag)
        cells = dict(zip(names, (flight.name, s.title, s.airframe, wind, reference, s.controller.level), strict=True))
        table.add_row(*(cells[name] for name in columns))
    console.print(table)
    return EXIT_OK


def _chaos(options: argparse.Namespace) -> int:
    from mavsitl.chaos.table import TABLE

    if options.json:
        rows = [
            {
                "name": name, "group": row.group, "does": row.text, "mocklink": row.mocklink,
                "arguments": [{"name": each.name, "default": each.default} for each in row.arguments],
            }
            for name, row in TABLE.items()
        ]  # fmt: skip
        print_json(rows)
        return EXIT_OK
    from mavsitl.cli import screen

    console = screen.console()
    for group in dict.fromkeys(row.group for row in TABLE.values()):
        table = screen.table("mode", "what goes wrong", title=group, whole=("mode",))
        for name, row in TABLE.items():
            if row.group == group:
                defaults = ", ".join(f"{each.name} {each.default}" for each in row.arguments if each.default)
                table.add_row(row.usage(name).replace("[", r"\["), row.text + (f" ({defaults})" if defaults else ""))
        console.print(table)
    return EXIT_OK
