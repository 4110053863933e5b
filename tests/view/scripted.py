"""A demonstration by script, as a person would give it, and how often the page is renewed:

    python -m tests.view.scripted --pictures pictures      take-off, gust, outage, recovery, change of law, landing
    python -m tests.view.scripted --rate 1 --rate 50       states a second that the page is sent

`mavsitl view --demo` is run as a process, and the page looked at in a headless Chromium. What is demanded is printed
beside what was seen; the exit code is 1 where that falls short. Pictures are kept as ``01-flying.png`` and so on.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from mavsitl.link.udp import LOOPBACK, UdpLink
from mavsitl.view.live import Station
from mavsitl.view.server import LiveSource
from tests.view.browser import Tab, browser
from tests.view.flights import flying, serving

PATIENCE_S = 180.0
DEMANDED_HZ = {1: 30.0, 50: 10.0}
"""By the number of vehicles."""
COUNTED_S = 10.0

MODE = "document.querySelector('.badge.mode')?.textContent"
WIND = (
    "parseFloat([...document.querySelectorAll('#readouts dt')]"
    ".find((term) => term.textContent === 'wind').nextSibling.textContent)"
)
COUNT = f"""new Promise((resolve) => {{
  const socket = new WebSocket(`ws://${{location.host}}/live`);
  let states = 0;
  let moved = 0;
  socket.onmessage = (event) => {{
    const vehicles = Object.values(JSON.parse(event.data).vehicles ?? {{}}).filter((values) => values.attitude);
    states += vehicles.length > 0;
    moved += vehicles.length;
  }};
  setTimeout(() => {{ socket.close(); resolve([states, moved]); }}, {COUNTED_S * 1e3});
}})"""


def badge(text: str) -> str:
    return f"[...document.querySelectorAll('.badge')].some((badge) => badge.textContent.includes({json.dumps(text)}))"


@contextmanager
def demonstration(*arguments: str) -> Iterator[str]:
    """The page's address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "mavsitl", "view", "--demo", *arguments, "--port", "0", "--json"],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        said = ""
        while "}" not in said:
            line = process.stdout.readline()
            if not line:
                raise RuntimeError(process.communicate()[1])
            said += line
        yield json.loads(said)["address"]
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=30.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


class Script:
    """Steps with pictures."""

    def __init__(self, tab: Tab, pictures: Path | None) -> None:
        self._tab = tab
        self._pictures = pictures
        self._taken = 0

    def see(self, what: str, expression: str) -> None:
        self._tab.wait(expression, PATIENCE_S)
        print(f"seen: {what}", flush=True)

    def press(self, name: str, words: str) -> None:
        """A button by what is written on it; `words`: how it is called when it is done."""
        self._tab.press("#buttons button", name)
        self._tab.wait(f"document.getElementById('outcome').textContent === {json.dumps(words + ': done')}", PATIENCE_S)
        print(f"pressed: {words}", flush=True)

    def keep(self, name: str) -> None:
        self._taken += 1
        if self._pictures is not None:
            self._pictures.mkdir(parents=True, exist_ok=True)
            (self._pictures / f"{self._taken:02}-{name}.png").write_bytes(self._tab.picture())


def fly(tab: Tab, pictures: Path | None) -> None:
    """The whole of it, with a ground. Raises `TimeoutError` where something is not seen."""
    with demonstration() as address:
        tab.open(address)
        script = Script(tab, pictures)
        script.see("flying off-board", f"{MODE} === 'OFFBOARD' && {badge('in the air')} && {badge('ground: fly')}")
        script.see("weights of the nets", "document.querySelectorAll('.chart .none')[2].hidden")
        script.keep("flying")
        script.press("Gust 8 m/s", "Gust")
        script.see("wind of more than 6 m/s", f"{WIND} > 6")
        script.keep("gust")
        script.press("Link outage", "Link outage")
        script.see("another mode, by a fail-safe", f"{MODE} !== 'OFFBOARD' && {badge('fail-safe')}")
        script.keep("outage")
        script.press("Link outage", "Link up")
        script.see("off-board again", f"{MODE} === 'OFFBOARD' && !({badge('fail-safe')})")
        script.keep("recovery")
        script.press("PID", "PID")
        script.see("the law", "[...document.querySelectorAll('.badge')].some((badge) => badge.textContent === 'PID')")
        script.press("PIDNN", "PIDNN")
        script.press("Land", "Land")
        script.see("on the ground and disarmed", f"{badge('disarmed')} && {badge('on the ground')}")
        script.keep("landed")


def fly_short(tab: Tab, pictures: Path | None) -> None:
    """By the vehicle alone, three times as fast, in this process: a busy machine makes it slower and nothing else."""
    link = UdpLink((LOOPBACK, 0))
    source = LiveSource(Station(1, with_monitor=False), [link])
    try:
        with serving(source) as address, flying(1, int(link.address[1]), speed=3.0):
            tab.open(address)
            script = Script(tab, pictures)
            script.press("Take off", "Take off")
            script.see("in the air", f"{badge('in the air')} && {badge('armed')}")
            script.press("Gust 8 m/s", "Gust")
            script.see("wind of more than 4 m/s", f"{WIND} > 4")
            script.keep("gust")
            script.press("Land", "Land")
            script.see("on the ground and disarmed", f"{badge('disarmed')} && {badge('on the ground')}")
            script.keep("landed")
    finally:
        link.close()


def rate_hz(vehicles: int) -> tuple[float, float]:
    """News with states a second, and states of each vehicle a second."""
    arguments = () if vehicles == 1 else ("formation-spiral", "--count", str(vehicles))
    with browser() as opened, demonstration(*arguments) as address:
        tab = opened.tab()
        tab.look((420, 320))  # to draw in software takes the processor from whom it is about
        tab.open(address)
        tab.wait(f"document.querySelectorAll('#vehicles button').length === {vehicles}", PATIENCE_S)
        states, moved = tab.value(COUNT)
        return states / COUNTED_S, moved / COUNTED_S / vehicles


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.view.scripted", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="keep pictures there")
    parser.add_argument("--short", action="store_true", help="by the vehicle alone, in this process")
    parser.add_argument("--dark", action="store_true", help="in dark colours")
    parser.add_argument("--rate", type=int, action="append", metavar="N", help="only count, of N vehicles; repeatable")
    options = parser.parse_args(arguments)
    if not options.rate:
        with browser() as opened:
            tab = opened.tab()
            tab.look((800, 600) if options.short else (1280, 720), dark=options.dark)
            (fly_short if options.short else fly)(tab, options.pictures)
            for error in tab.errors:
                print(f"the page: {error}")
            return 1 if tab.errors else 0
    good = True
    for vehicles in options.rate:
        news, states = rate_hz(vehicles)
        demanded = DEMANDED_HZ.get(vehicles)
        enough = demanded is None or news >= 0.95 * demanded
        good = good and enough
        print(
            f"{vehicles:3d} vehicles: {news:5.1f} pictures a second, {states:5.1f} states of each; demanded "
            f"{'nothing' if demanded is None else f'{demanded:g}'}{'' if enough else '  SHORT'}",
            flush=True,
        )
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
