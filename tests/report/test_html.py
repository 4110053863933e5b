"""The page: self-contained, repeatable, right about who is paired with whom, for any set of flights."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mavsitl import scenario
from mavsitl.log.flight import FlightData
from mavsitl.log.topics import GROUND_TOPICS, VEHICLE_TOPICS
from mavsitl.log.ulog import MemoryRecorder, UlogWriter
from mavsitl.report import figures
from mavsitl.report.html import Shown, _groups, _titles, render, show, write_report
from mavsitl.report.run import RunError, new_run, record, write_run
from tests.log.synthetic import Made, write


def flown(name: str, made: Made, overrides: dict[str, Any] | None = None) -> Shown:
    vehicle, ground = MemoryRecorder(), MemoryRecorder()
    write(made, vehicle, ground)
    about = record(scenario.load(name, overrides), folder=name, wire_hash="cd" * 16, real_time_factor=12.5)
    return show(about, FlightData.from_recorders(vehicle, ground))


def page(*flights: Shown) -> str:
    return render(new_run("mavsitl run <all>", "2026-01-02T03:04:05", tuple(f.record for f in flights)), list(flights))


@pytest.fixture(scope="module")
def hover() -> tuple[Shown, Shown]:
    return flown("hover-calm", Made(seconds=6.0)), flown("hover-wind", Made(seconds=6.0, windy=True))


@pytest.fixture(scope="module")
def hover_page(hover: tuple[Shown, Shown]) -> str:
    return page(hover[1], hover[0])


class Checker(HTMLParser):
    """Collects ids and addresses and sees that every element is closed."""

    VOID = frozenset({"meta", "br", "link", "img", "hr"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)
        for key, value in attrs:
            if key == "id":
                self.ids.append(value or "")
            if key in {"href", "xlink:href", "src"}:
                self.addresses.append(value or "")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_is_whole_and_needs_nothing_from_elsewhere(hover_page: str) -> None:
    checker = Checker()
    checker.feed(hover_page)
    checker.close()
    assert checker.open == []
    assert len(checker.ids) == len(set(checker.ids))
    assert {address[1:] for address in checker.addresses} <= set(checker.ids)
    assert all(address.startswith("#") for address in checker.addresses)
    assert set(re.findall(r"https?://[^\"' ]+", hover_page)) <= {"http://www.w3.org/1999/xlink"}
    assert set(re.findall(r"url\(#([^)]+)\)", hover_page)) <= set(checker.ids)
    assert "<script" not in hover_page
    assert "mavsitl run &lt;all&gt;" in hover_page


def test_the_same_flight_gives_the_same_page_under_any_settings() -> None:
    import matplotlib

    flight = flown("hover-calm", Made(seconds=1.0))
    text = page(flight)
    with matplotlib.rc_context({"lines.linewidth": 9.0, "font.size": 30.0, "svg.hashsalt": None}):
        assert page(flight) == text


def captions(text: str) -> list[tuple[str, str]]:
    found = re.findall(r"<figcaption>(.*?)(?: <span>counterpart of the paper’s (.*?)</span>)?</figcaption>", text)
    return [(caption, counterpart) for caption, counterpart in found]


def test_calm_and_wind_of_one_path_share_figures_named_after_the_papers(hover_page: str) -> None:
    assert captions(hover_page) == [
        ("Wind along x, y and z at the vehicle", "Fig. 6"),
        ("Altitude", "Fig. 7"),
        ("Horizontal position", "Fig. 8"),
        ("Attitude and its tracking error, calm", "Fig. 9"),
        ("Attitude and its tracking error, wind", "Fig. 10"),
        *[
            (f"{what}, {air}", "")
            for what in (
                "PIDNN output weights",
                "Rotor speeds (1 rear, 2 right, 3 front, 4 left)",
                "Control demand (eq 12)",
                "Link to the ground",
            )
            for air in ("calm", "wind")
        ],
    ]
    assert "against the paper’s Table 3" in hover_page
    assert hover_page.count("ended after 6.0 s of 60 s") == 2


def test_the_spiral_has_its_own_figures() -> None:
    spiral = [flown(f"spiral-{air}", Made(spiral=True, seconds=4.0, windy=air == "wind")) for air in ("calm", "wind")]
    found = [counterpart for _, counterpart in captions(page(*spiral)) if counterpart]
    assert found == ["Fig. 6", "Fig. 11", "Fig. 12", "Fig. 13", "Fig. 14"]


def test_the_verdicts_are_the_rows(hover: tuple[Shown, Shown], hover_page: str) -> None:
    rows = [row for flight in hover for row in flight.rows]
    for verdict in ("beaten", "met", "missed"):
        assert hover_page.count(f'title="{verdict}"') == sum(row.verdict == verdict for row in rows)
    reached = sum(row.verdict != "missed" for row in rows)
    assert f"2 flights: {reached} of 12 states at or below" in hover_page


def test_the_oracle_is_loud_and_only_where_it_was_used(hover_page: str) -> None:
    oracle = flown("hover-wind", Made(seconds=1.0, windy=True), {"controller.wind_information": "oracle"})
    assert "ORACLE" not in hover_page
    text = page(oracle)
    assert text.count('<span class="badge">ORACLE</span>') == 3
    assert "handed the true wind in hover-wind." in text


def test_flights_that_are_not_the_papers_stand_alone_without_its_numbers() -> None:
    flight = flown("hover-calm", Made(seconds=2.0, learning=False), {"duration_s": 2.0, "controller.law": "pid"})
    text = page(flight)
    assert "paper’s Table" not in text
    assert "counterpart" not in text
    assert "ended after" not in text
    assert "PIDNN output weights" not in text
    assert "1 flight</h1>" in text


def test_equal_titles_are_told_apart(hover: tuple[Shown, Shown]) -> None:
    again = [
        flown(f"hover-{air}", Made(seconds=1.0, windy=air == "wind"), {"controller.law": "pid"})
        for air in ("calm", "wind")
    ]
    titles = _titles(_groups([*hover, *again]))
    assert titles == [f"Set-point hover ({law}, body_rate, observer, paper, seed 1)" for law in ("pidnn", "pid")]


def test_a_flight_that_was_lost_is_still_drawn() -> None:
    flight = flown("hover-calm", Made(seconds=2.0))
    flight.data.position_nwu_m[100:] = np.inf
    flight.data.attitude_deg[100:] = np.nan
    lost = show(flight.record, flight.data)
    assert [row.verdict for row in lost.rows] == ["missed"] * 6
    assert "0 of 6 states" in page(lost)


def test_decimation_keeps_the_peaks() -> None:
    time = np.arange(10_000.0)
    values = np.sin(time)
    values[[1234, 7777]] = (50.0, -50.0)
    values[5000:5100] = np.nan
    few, kept = figures.decimate(time, values)
    assert few.size <= figures.POINTS
    assert np.all(np.diff(few) > 0)
    assert (np.nanmax(kept), np.nanmin(kept)) == (50.0, -50.0)
    assert np.isnan(kept).any()
    assert figures.decimate(time[:100], values[:100])[0].size == 100


def test_a_run_folder_becomes_a_report(tmp_path: Path) -> None:
    about = record(scenario.load("hover-wind"), folder="one", wire_hash="ef" * 16, real_time_factor=None)
    write_run(tmp_path, new_run("mavsitl run hover-wind", "2026-01-02T03:04:05Z", (about,)))
    (tmp_path / "one").mkdir()
    with pytest.raises(RunError, match=r"flight hover-wind: .*vehicle\.ulg: cannot be read: No such file"):
        write_report(tmp_path)
    with (
        UlogWriter(tmp_path / "one" / "vehicle.ulg", {}, {}, topics=VEHICLE_TOPICS) as vehicle,
        UlogWriter(tmp_path / "one" / "ground.ulg", {}, {}, topics=GROUND_TOPICS) as ground,
    ):
        write(Made(seconds=1.0, windy=True), vehicle, ground)
    path = write_report(tmp_path)
    assert path == tmp_path / "report.html"
    text = path.read_text("utf-8")
    assert "ef" * 16 in text
    assert "2026-01-02 03:04:05 UTC" in text
    assert "not measured" in text
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["one", "report.html", "run.json"]
