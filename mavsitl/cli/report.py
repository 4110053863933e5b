"""`mavsitl report`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mavsitl.cli.common import EXIT_OK, add_json, command, print_json


def add(commands: Any) -> None:
    parser = command(
        commands, "report", "draw the report of runs again", "Draw report.html of each run folder again, from its logs."
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="a run folder, with run.json in it")
    add_json(parser, "the paths of the reports")
    parser.set_defaults(run=_report)


def _report(options: argparse.Namespace) -> int:
    from mavsitl.report.html import write_report

    pages = []
    for folder in options.runs:
        pages.append(f"{write_report(folder)}")
        if not options.json:
            print(pages[-1])
    if options.json:
        print_json({"reports": pages})
    return EXIT_OK
