"""The page in a headless Chromium, before real vehicles and a real server. Skipped where there is no Chromium."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from mavsitl import ends, scenario
from mavsitl.codec import encode
from mavsitl.link.udp import LOOPBACK, UdpLink
from mavsitl.services.statustext import chunks
from mavsitl.view.live import Station
from mavsitl.view.replay import Replay, find_flights
from mavsitl.view.server import LiveSource, ReplaySource
from tests.view.browser import Browser, Tab, browser, program
from tests.view.flights import flying, serving

pytestmark = [
    pytest.mark.sockets,
    pytest.mark.skipif(program() is None, reason="no Chromium here"),
]

SMALL = (800, 600)
"""Drawing in software takes its time by the pixel."""


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    with browser() as opened:
        yield opened


@pytest.fixture
def tab(chromium: Browser) -> Tab:
    made = chromium.tab()
    made.look(SMALL)
    return made


def chips(tab: Tab) -> str:
    return "[...document.querySelectorAll('#vehicles button')].map((b) => b.textContent).join()"


def test_two_vehicles_a_button_a_restart_and_a_hostile_text(tab: Tab) -> None:
    link = UdpLink((LOOPBACK, 0))
    port = int(link.address[1])
    source = LiveSource(Station(1, with_monitor=False), [link])
    hostile = "<img src=x onerror=\"document.title='owned'\"><b>bold</b>"
    try:
        with serving(source) as address, flying(1, port):
            tab.open(address)
            tab.wait(f"{chips(tab)} === 'Vehicle 1'")
            with flying(2, port):
                tab.wait(f"{chips(tab)} === 'Vehicle 1,Vehicle 2'")
                # A button flies the vehicle that is chosen, and that alone.
                tab.press("#vehicles button", "Vehicle 2")
                tab.press("#buttons button", "Arm")
                tab.wait("document.getElementById('outcome').textContent === 'Arm: done'")
                tab.wait("[...document.querySelectorAll('.badge')].some((b) => b.textContent === 'armed')")
                tab.press("#vehicles button", "Vehicle 1")
                tab.wait("[...document.querySelectorAll('.badge')].some((b) => b.textContent === 'disarmed')")
                tab.press("#vehicles button", "Vehicle 2")
            tab.wait(f"{chips(tab)} === 'Vehicle 1,Vehicle 2 silent'")
            with flying(2, port):  # another life of the same vehicle
                tab.wait(f"{chips(tab)} === 'Vehicle 1,Vehicle 2'")
                tab.wait("[...document.querySelectorAll('.badge')].some((b) => b.textContent === 'disarmed')")
                # Charts are drawn: a canvas each, and numbers in the legends.
                assert tab.value("document.querySelectorAll('.chart canvas').length") == 4
                tab.wait("[...document.querySelectorAll('.chart .key b')].some((b) => /[0-9]/.test(b.textContent))")
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
                    for sequence, message in enumerate(chunks(2, hostile, 7)):
                        stranger.sendto(encode(message, sequence, 1, 1), (LOOPBACK, port))
                tab.wait("document.querySelector('#texts ol').textContent.includes('<b>bold</b>')")
                assert tab.value("document.querySelectorAll('#texts ol b, #texts ol img').length") == 0
                assert tab.value("document.title") == "mavsitl view"
    finally:
        link.close()
    assert tab.errors == [] or all("WebSocket" in error for error in tab.errors)


def test_it_finds_the_server_again(tab: Tab) -> None:
    link = UdpLink((LOOPBACK, 0))
    try:
        with flying(1, int(link.address[1])):
            with serving(LiveSource(Station(1, with_monitor=False), [link])) as address:
                tab.open(address)
                tab.wait(f"{chips(tab)} === 'Vehicle 1'")
            tab.wait("document.getElementById('connection').textContent === 'trying to connect'")
            port = urlsplit(address).port
            assert port is not None
            with serving(LiveSource(Station(1, with_monitor=False), [link]), port):
                tab.wait("document.getElementById('connection').textContent === 'connected'")
                tab.wait(f"{chips(tab)} === 'Vehicle 1'")
                tab.wait("document.getElementById('notice').hidden")
    finally:
        link.close()


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("run")
    flight = scenario.load("hover-wind", {"duration_s": 6.0})
    ends.in_memory(flight, folder, report=lambda text: None, progress=None)
    with serving(ReplaySource(Replay(find_flights(Path(folder))))) as address:
        yield address


def test_a_replay_is_paused_moved_and_played_on(tab: Tab, replayed: str) -> None:
    tab.open(replayed)
    tab.press("#player button", "❚❚ Pause")
    tab.wait("[...document.querySelectorAll('#player button')].some((b) => b.textContent === '▶ Play')")
    tab.value(
        "(() => { const slider = document.querySelector('#player input'); slider.value = '4';"
        "slider.dispatchEvent(new Event('input')); })()"
    )
    tab.wait("document.querySelector('#player .clock').textContent.startsWith('0:04.0')")
    tab.wait("document.querySelector('#readouts').textContent.includes('0:04.0')")
    assert tab.value("document.getElementById('buttons').hidden")  # nothing can be commanded that has been
    tab.press("#player button", "▶ Play")
    tab.wait("document.querySelector('#player .clock').textContent > '0:04.5'")
    assert tab.errors == []


@pytest.mark.parametrize("dark", [False, True])
def test_light_and_dark_by_the_system_and_by_the_switch(tab: Tab, replayed: str, dark: bool) -> None:
    def is_dark() -> bool:
        colour = tab.value("getComputedStyle(document.body).backgroundColor")
        return sum(int(part) for part in colour.removeprefix("rgb(").rstrip(")").split(",")) < 300

    tab.look(SMALL, dark=dark)
    tab.open(replayed)
    tab.value("localStorage.clear()")
    tab.open(replayed)
    assert is_dark() is dark
    for _, wanted in (("light", False), ("dark", True), ("auto", dark)):
        tab.value("document.getElementById('theme').click()")
        assert is_dark() is wanted
    assert tab.errors == []


@pytest.mark.parametrize("size", [(1280, 720), (1920, 1080), (420, 900)])
def test_nothing_sticks_out_at_any_size(tab: Tab, replayed: str, size: tuple[int, int]) -> None:
    tab.look(size)
    tab.open(replayed)
    tab.wait("document.querySelector('#vehicles button')")
    width = tab.value("document.documentElement.scrollWidth")
    assert width <= size[0]
    if size[0] > 860:
        assert tab.value("document.documentElement.scrollHeight") <= size[1]
        cut = tab.value(
            "[...document.querySelectorAll('#controls, .chart header')]"
            ".filter((e) => e.scrollHeight > e.clientHeight + 1).length"
        )
        assert cut == 0


def test_all_can_be_reached_by_the_keyboard_and_has_a_name(tab: Tab, replayed: str) -> None:
    tab.open(replayed)
    tab.wait("document.querySelector('#vehicles button')")
    nameless = tab.value(
        "[...document.querySelectorAll('button, input, select')].filter((e) =>"
        " !(e.textContent.trim() || e.getAttribute('aria-label'))).length"
    )
    assert nameless == 0
    unreachable = tab.value(
        "[...document.querySelectorAll('button, input, select, canvas[role=img]')].filter((e) => e.tabIndex < 0).length"
    )
    assert unreachable == 0
