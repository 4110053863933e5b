"""`mavsitl view`."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavsitl import process
from mavsitl.cli.common import EXIT_OK, PORT, UsageError, command, print_json, whole
from mavsitl.cli.ends import COUNT, Status

if TYPE_CHECKING:
    from mavsitl.link.address import Address
    from mavsitl.view.demo import Demo
    from mavsitl.view.server import Source

PAGE_PORT = 8550

VIEW_HELP = """\
Show vehicles in the browser: in 3D with trail, reference and wind, with strip charts, mode, fail-safe and texts, and
with buttons for a demonstration. The page comes from a small server of this program's, on loopback, and loads nothing
from outside. It is a ground station: it speaks to the vehicle's own port for ground stations and needs nothing from it
but MAVLink, so it shows a PX4 SITL vehicle as well.

With RUN, the folder of a run or of its logs, it plays that back: pause, speed, and any time of the flight.
"""

VIEW_EXAMPLES = """\
examples:
  mavsitl view --demo                                a vehicle, a ground and the page; Ctrl-C ends all three
  mavsitl view --demo formation-spiral --count 9
  mavsitl view                                       a vehicle that runs
  mavsitl view --count 9                             instances 0 to 8, each on its own port
  mavsitl view --listen udpin:127.0.0.1:14550        beside PX4 SITL, which speaks first
  mavsitl view runs/20260101T120000Z                 play a run back
"""

VIEW_EPILOG = """
What only the ground knows (reference, weights, its link) is shown where it is started with --monitor
udpout:127.0.0.1:14560. Bound to another address than loopback (--bind) the page has a token in its address, and who
does not have it is refused. HTTP is not encrypted: who can read on the way can have it. --no-buttons makes a page that
can only be looked at.
"""


def add(commands: Any) -> None:
    parser = command(
        commands, "view", "show vehicles in the browser, live or from logs", VIEW_HELP, VIEW_EXAMPLES + VIEW_EPILOG
    )
    parser.add_argument("recorded", nargs="?", type=Path, metavar="RUN", help="play these logs back")
    group = parser.add_argument_group("link")
    group.add_argument(
        "--listen", action="append", metavar="ENDPOINT",
        help="where vehicles are: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or tcpin:HOST:PORT; may be repeated "
        "(default: udpout:127.0.0.1:18570 + I)",
    )  # fmt: skip
    group.add_argument(
        "--instance", type=whole(0, 254), default=0, metavar="I", help="adds I to the default's port (default: 0)"
    )
    group.add_argument(
        "--count", type=COUNT, metavar="N", help="the instances I and after it, N in all; with --demo a formation of N"
    )
    group.add_argument(
        "--monitor", metavar="ENDPOINT",
        help="where a ground tells what only it knows, or none (default: udpin:127.0.0.1:14560)",
    )  # fmt: skip
    group = parser.add_argument_group("page")
    group.add_argument(
        "--port", type=PORT, default=PAGE_PORT, metavar="N", help=f"of the page; 0: one that is free ({PAGE_PORT})"
    )
    group.add_argument(
        "--bind", default="127.0.0.1", metavar="HOST",
        help="local address of the page; beyond loopback with a token (default: 127.0.0.1)",
    )  # fmt: skip
    group.add_argument("--no-browser", action="store_true", help="only print the address")
    group.add_argument("--no-buttons", action="store_true", help="a page that commands nothing")
    group.add_argument("--json", action="store_true", help="print the address as JSON, for a program")
    group = parser.add_argument_group("demonstration")
    group.add_argument(
        "--demo", nargs="?", const="demo", metavar="SCENARIO",
        help="start a vehicle and a ground as well, on free ports, and end them too (default: the scenario demo)",
    )  # fmt: skip
    group.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="with --demo: any key of the scenario, dotted, with a TOML value; may be repeated",
    )  # fmt: skip
    group.add_argument("--run-dir", type=Path, metavar="DIR", help="with --demo: write logs there, to be played back")
    parser.set_defaults(run=_view)


def _view(options: argparse.Namespace) -> int:
    _check(options)
    process.one_blas_thread()
    import asyncio

    from mavsitl.view import server

    status = Status(as_json=False)
    with ExitStack() as stack:
        demo = _demo(options, status, stack)
        source = _source(options, demo, stack)
        page = server.Page(source, options.bind, options.port)
        asyncio.run(
            server.run(
                page, source, stop=status.stop, started=lambda: _tell(options, page.address),
                chore=(lambda: None) if demo is None else demo.step,
            )
        )  # fmt: skip
    return EXIT_OK


def _check(options: argparse.Namespace) -> None:
    """An option that would have no effect is refused."""
    live = (("--listen", options.listen), ("--instance", options.instance), ("--monitor", options.monitor))
    for name, value in live:
        if value and options.recorded is not None:
            raise UsageError(f"{name}: not with RUN, which is played back from its logs")
        if value and options.demo is not None:
            raise UsageError(f"{name}: not with --demo, which has free ports of its own")
    if options.recorded is not None and (options.demo is not None or options.count is not None):
        raise UsageError(f"{'--demo' if options.demo is not None else '--count'}: not with RUN")
    if options.demo is None and (options.settings or options.run_dir is not None):
        raise UsageError(f"{'--set' if options.settings else '--run-dir'}: only with --demo")
    if options.listen and (options.instance or options.count is not None):
        raise UsageError("--listen: names the ports itself; not with --instance or --count")


def _demo(options: argparse.Namespace, status: Status, stack: ExitStack) -> Demo | None:
    if options.demo is None:
        return None
    from mavsitl.cli.common import load
    from mavsitl.view.demo import Demo

    load(options.demo, options.settings)  # says what is wrong with it
    demo = Demo(options.demo, options.settings, count=options.count, run_dir=options.run_dir, report=status.say)
    stack.callback(demo.close)
    demo.start()
    return demo


def _source(options: argparse.Namespace, demo: Demo | None, stack: ExitStack) -> Source:
    from mavsitl import ends
    from mavsitl.link.address import Address, parse_address
    from mavsitl.link.endpoint import open_link
    from mavsitl.monitor import PORT as MONITOR_PORT
    from mavsitl.view import server
    from mavsitl.view.live import Station
    from mavsitl.view.replay import Replay, find_flights

    if options.recorded is not None:
        return server.ReplaySource(Replay(find_flights(options.recorded)))
    host = "127.0.0.1"
    monitor: Address | None = Address("udpin", host, MONITOR_PORT)
    if demo is not None:
        addresses = [Address("udpout", host, demo.gcs_port)]
        monitor = Address("udpin", host, demo.monitor_port)
    elif options.listen:
        addresses = [parse_address(text) for text in options.listen]
    else:
        first = ends.GCS_PORT + options.instance
        addresses = [Address("udpout", host, first + j) for j in range(options.count or 1)]
    if options.monitor is not None:
        monitor = None if options.monitor == "none" else parse_address(options.monitor)
    links = []
    for address, option in [
        *((each, "--listen ENDPOINT") for each in addresses),
        *([] if monitor is None else [(monitor, "--monitor ENDPOINT, or --monitor none")]),
    ]:
        link = open_link(address, port_option=option, host_option=option)
        stack.callback(link.close)
        links.append(link)
    station = Station(len(addresses), with_monitor=monitor is not None, buttons=not options.no_buttons)
    return server.LiveSource(station, links)


def _tell(options: argparse.Namespace, address: str) -> None:
    """Where the page is; and show it."""
    from mavsitl.ends import is_loopback

    exposed = not is_loopback(options.bind)
    if options.json:
        print_json({"address": address, "exposed": exposed, "buttons": not options.no_buttons})
    else:
        print(f"{address}\nCtrl-C ends it", flush=True)
    if exposed:
        what = "look at the vehicles" if options.no_buttons else "fly the vehicles"
        print(f"open to the network: who has this address, with its token, can {what}", file=sys.stderr, flush=True)
    sys.stdout.flush()
    if not options.no_browser and not options.json and _has_screen():
        import webbrowser

        webbrowser.open(address)


def _has_screen() -> bool:
    """A browser in a window can be opened; one of text in this terminal would be no help."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
