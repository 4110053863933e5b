"""`mavsitl check`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from mavsitl.cli.common import EXIT_FAILED, EXIT_OK, above_zero, add_json, command, print_json

if TYPE_CHECKING:
    from rich.console import Console

    from mavsitl.check import Heard, PortReport, Report


CHECK_S = 3.0

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


def add(commands: Any) -> None:
    parser = command(commands, "check", "say who is on the ports and whether it answers", CHECK_HELP, CHECK_EXAMPLES)
    parser.add_argument(
        "--listen", action="append", metavar="ENDPOINT",
        help="instead of udpin:127.0.0.1:14550 and udpin:127.0.0.1:14540; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--for", type=above_zero, default=CHECK_S, metavar="S", dest="duration_s",
        help=f"seconds to listen (default: {CHECK_S:g}; Ctrl-C ends it early)",
    )  # fmt: skip
    parser.add_argument("--quiet", action="store_true", help="listen only: send no HEARTBEAT and ask nothing")
    parser.add_argument("--all", action="store_true", help="list every kind of message of every source")
    add_json(parser, "the report")
    parser.set_defaults(run=_check)


def _check(options: argparse.Namespace) -> int:
    from mavsitl import ends
    from mavsitl.cli import screen
    from mavsitl.link.address import parse_address

    endpoints = None if options.listen is None else [parse_address(text) for text in options.listen]
    console = screen.console()
    if options.json or not console.is_terminal:
        report = ends.check(endpoints, duration_s=options.duration_s, ask=not options.quiet)
    else:
        with console.status(f"listening for {options.duration_s:g} s"):
            report = ends.check(endpoints, duration_s=options.duration_s, ask=not options.quiet)
    if options.json:
        print_json(report)
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
    from mavsitl.cli import screen

    seen = f"{port.datagrams} datagrams, {port.frames} good frames" if port.datagrams else "nothing came"
    console.print(f"[bold]{port.ear.endpoint}[/]  {seen}")
    if port.heard:
        columns = ("from", "id", "what", "MAVLink", "rate", "lost", "answer")
        table = screen.table(*columns, right=("rate", "lost"), whole=("from",))
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
    from mavsitl.cli import screen

    name = f"{heard.system_id}/{heard.component_id} at {heard.address}"
    if everything:
        numbers = ("id", "number", "1/s", "B/s")
        table = screen.table(f"messages of {name}", *numbers, right=numbers)
        for kind in heard.kinds:
            table.add_row(kind.name, f"{kind.id}", f"{kind.messages}", f"{kind.per_s:.1f}", f"{kind.bytes_per_s:.0f}")
        console.print(table)
        return
    most = ", ".join(f"{kind.name} {kind.per_s:.1f}" for kind in heard.kinds[:4])
    rest = len(heard.kinds) - 4
    console.print(f"[dim]{name}, per second: {most}{f', and {rest} more kinds (--all)' if rest > 0 else ''}[/]")
