"""Impaired links in the report: the table, the figure, run.json."""

from __future__ import annotations

from pathlib import Path

from mavsitl import scenario
from mavsitl.log.flight import FlightData
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.report import figures
from mavsitl.report.html import render, show
from mavsitl.report.run import load_run, new_run, record, write_run
from mavsitl.report.tables import link_rows
from tests.log.synthetic import Made, write
from tests.log.test_links import drive


def flown(*, bad: bool) -> tuple[FlightData, dict[str, dict[str, dict[str, float]]]]:
    vehicle, ground = MemoryRecorder(), MemoryRecorder()
    write(Made(seconds=3.0), vehicle, ground)
    links = {"link": drive(vehicle).statistics()} if bad else {}
    return FlightData.from_recorders(vehicle, ground, duration_s=3.0), links


def page(*, bad: bool) -> str:
    data, links = flown(bad=bad)
    about = record(
        scenario.load("hover-calm"), folder="one", wire_hash="ab" * 16, real_time_factor=None, links=links,
        dropped={"bad_crc": 3, "unsupported": 1} if bad else {},
    )  # fmt: skip
    return render(new_run("mavsitl fly", "2026-01-02T03:04:05", (about,)), [show(about, data)])


def test_shares_are_of_what_was_sent() -> None:
    _, links = flown(bad=True)
    to_ground, to_vehicle = link_rows(links)
    assert (to_ground.link, to_vehicle.link) == ("off-board, to ground", "off-board, to vehicle")
    assert (to_ground.sent, to_ground.lost, to_ground.outage) == (1500, 0.0, 125 / 1500)
    assert 0.4 < to_vehicle.lost < 0.6
    assert to_ground.delivered == 1500 - 125 - 10  # ten are on their way
    assert str(to_ground).startswith("off-board, to ground: 1500 sent, 0.0 % lost, 8.3 % in outages, delay 1")
    assert link_rows({}) == []


def test_a_link_on_which_nothing_was_sent_is_a_row_too() -> None:
    counts = dict.fromkeys(
        ("sent", "delivered", "lost", "outage", "queue_drops", "corrupted", "duplicated", "reordered", "late",
         "delay_p50_ms", "delay_p99_ms", "delay_max_ms"), 0.0,
    )  # fmt: skip
    [row] = link_rows({"gcs_link": {"to_vehicle": counts}})
    assert (row.link, row.lost) == ("ground stations, to vehicle", 0.0)


def test_the_page_has_a_table_and_a_figure_of_a_bad_link_alone() -> None:
    bad, good = page(bad=True), page(bad=False)
    assert "Off-board link: loss and delay" in bad
    assert '<h2 id="links">' in bad
    assert "off-board, to vehicle</th><td>1500</td>" in bad
    assert "bad crc 3, unsupported 1" in bad
    for text in ("Off-board link: loss and delay", '<h2 id="links">', "input dropped"):
        assert text not in good


def test_outages_are_shaded_where_they_were() -> None:
    data, _ = flown(bad=True)
    drawn = figures.channels(data, "calm")
    assert drawn is not None
    # One outage, in the first second after the release, on both axes; its shade is half of a whole second's.
    assert drawn.svg.count("opacity: 0.125") == 2


def test_run_json_keeps_what_the_links_did(tmp_path: Path) -> None:
    _, links = flown(bad=True)
    about = record(
        scenario.load("hover-calm"), folder="one", wire_hash="ab" * 16, real_time_factor=None, links=links,
        dropped={"bad_crc": 3},
    )  # fmt: skip
    (tmp_path / "one").mkdir()
    write_run(tmp_path, new_run("mavsitl fly", "2026-01-02T03:04:05", (about,)))
    [kept] = load_run(tmp_path).flights
    assert kept == about
    assert kept.links["link"]["to_ground"]["outage"] == 125
