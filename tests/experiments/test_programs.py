"""The experiment programs in their short form, and the parts on which their figures stand."""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import Any

import msgspec
import pytest

from mavsitl import controllers
from mavsitl.campaign.fly import Row, fly
from mavsitl.report.metrics import PAPER_TABLES
from tests.experiments import engine, failures, learning, limits, links, results, score, stability

SHORT: dict[str, Any] = {"duration_s": 2.0}


def test_results_has_24_numbers_of_the_default_cell(capsys: pytest.CaptureFixture[str]) -> None:
    assert results.main(["--quick", "--jobs", "1"]) == 0
    page = capsys.readouterr().out
    assert "| `paper/body_rate/pidnn/observer` |" in page
    rows = [line for line in page.splitlines() if line.startswith(tuple(f"| {case} " for case in PAPER_TABLES))]
    assert len(rows) == 24
    assert "Flights lost" not in page


def test_results_has_every_cell_and_the_default_one_first() -> None:
    names = [cell.name for cell in results.cells()]
    assert names[0] == "paper/body_rate/pidnn/observer"
    assert len(set(names)) == 2 * 7 * 3
    for cell in results.cells():
        flight = engine.job("hover-wind", cell.overrides, 1).flight
        airframe, level, law, wind = cell.name.split("/")
        controller = flight.scenario.controller
        assert (flight.scenario.airframe, controller.level, controller.wind_information) == (airframe, level, wind)
        assert law == (controller.law if controller.inner == "pidnn" or level != "attitude" else "stock")


def test_results_marks_what_is_missed_and_what_was_lost() -> None:
    exact = {case: [Row("", case, 1, "flown", 60.0, paper.values())] for case, paper in PAPER_TABLES.items()}
    assert all(number.met for number in results.numbers(exact))
    x, *others = PAPER_TABLES["hover-wind"].values()
    exact["hover-wind"] = [msgspec.structs.replace(exact["hover-wind"][0], rmse=(2.0 * x, *others))]
    exact["spiral-calm"] = [Row("", "spiral-calm", 1, "lost", 3.0)]
    found = results.numbers(exact)
    assert [number.name for number in found if not number.met][:2] == ["hover-wind x", "spiral-calm x"]
    assert "**2.00**" in results.absolute(found)
    assert results.ratios(found).count("**lost**") == 6


def test_results_refuses_a_pattern_that_matches_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        results.main(["--cells", "moon/*"])
    assert "nothing matches 'moon/*'" in capsys.readouterr().err


def test_learning_writes_its_page_and_figure(tmp_path: Path) -> None:
    output = tmp_path / "learning.md"
    assert learning.main(["--quick", "--jobs", "1", "--output", str(output)]) == 0
    page = output.read_text("utf-8")
    assert page.count("| nominal | PID") == len(learning.RATES) + len(learning.BANDWIDTHS)
    assert page.count("| half bandwidth | PIDNN") == len(learning.RATES)
    assert "none" not in page
    figure = (tmp_path / learning.FIGURE).read_text("utf-8")
    assert figure.lstrip().startswith("<?xml")
    assert "<svg" in figure


def test_learning_pairs_seeds_and_leaves_lost_ones_out() -> None:
    def outcome(seed: int, tilt: float | None) -> Row:
        values = None if tilt is None else (3.0, 4.0, 0.0, tilt, 0.0, 1.0)
        return Row("", "hover-wind", seed, "flown" if values else "lost", 60.0, values, None, (0.5, 1.5))

    mine = [outcome(1, 1.0), outcome(2, 3.0), outcome(3, None)]
    pid = [outcome(1, 2.0), outcome(2, 4.0), outcome(3, 1.0)]
    found = learning.compare("ideal rotors", "nominal", "PIDNN, rate 1", mine, pid)
    assert found.ratios["tilt"] == (0.5, 0.75)
    assert found.ratios["position"] == (1.0, 1.0)
    assert found.p_value == pytest.approx(0.5)  # two pairs of one sign: 2 of 4 sign patterns are as extreme
    assert (found.lost, found.pid_lost) == (1, 0)
    same = learning.compare("ideal rotors", "nominal", "PIDNN, rate 1", pid, pid)
    assert same.p_value == 1.0


def test_half_the_bandwidth_is_a_quarter_an_eighth_and_a_half() -> None:
    shipped = engine.job("hover-wind", {}, 1).flight.scenario.controller.yaw
    slow = engine.job("hover-wind", learning.scaled("hover-wind", 0.5), 1).flight.scenario.controller.yaw
    pairs = zip(msgspec.structs.astuple(slow), msgspec.structs.astuple(shipped), strict=True)
    assert [a / b for a, b in pairs] == pytest.approx([1 / 4, 1 / 8, 1 / 2])


def test_stability_shows_both_laws(capsys: pytest.CaptureFixture[str]) -> None:
    assert stability.main(["--quick", "--jobs", "1"]) == 0
    page = capsys.readouterr().out
    assert "| `hover-wind` | 2 of 2 |" in page
    assert page.count("| ideal rotors |") == len(stability.RATES) * len(stability.BOUNDS) * len(stability.DELTAS)


def test_stability_shows_when_a_law_diverged() -> None:
    lost = [Row("", "hover-wind", seed, "lost", 100.0 * seed, None, None, (1.0, 9.0)) for seed in (1, 2, 3)]
    row = stability.printed_row(("ideal rotors", 10.0, "printed", "known"), lost)
    assert row[4:] == ["3 of 3", "100", "200", "300", "9"]


@pytest.mark.sockets
def test_limits_changes_one_thing_at_a_time(capsys: pytest.CaptureFixture[str]) -> None:
    lags = [case for case in limits.cases() if case.group == "lag"]
    flights = [engine.job("hover-wind", case.overrides, 1, case.airframe).flight for case in lags]
    assert [flight.airframe.rotor_time_constant_s for flight in flights] == [0.0, 0.005, 0.01, 0.02, 0.03]
    assert len({msgspec.json.encode(flight.scenario) for flight in flights}) == 1
    assert limits.main(["--quick", "--jobs", "1"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    assert len(rows) == len(limits.cases()) + 3


def test_a_link_does_not_change_what_is_measured() -> None:
    """Channels that do nothing leave the sums as they are; what the ground does not hear of is measured, too."""
    perfect = fly(engine.job("hover-wind", SHORT, 1))
    through = fly(engine.job("hover-wind", SHORT | links.both(queue_bytes=9000), 1))
    assert through.flown
    assert through.rmse == perfect.rmse
    silent = {"duration_s": 4.0, "link.to_vehicle.loss": 1.0, "link.to_ground.loss": 0.0}
    assert fly(engine.job("hover-wind", silent, 1)).status == "failed"  # never armed
    outage = [{"start_s": 1.0, "duration_s": 1000.0}]
    gone = SHORT | {"duration_s": 60.0, "controller.level": "torque"} | links.both(outages=outage)
    lost = fly(engine.job("hover-wind", gone, 1))
    assert lost.status == "lost"
    assert lost.largest is not None
    assert max(map(abs, lost.largest)) > 1.0


def test_links_has_every_link_and_level(capsys: pytest.CaptureFixture[str]) -> None:
    assert links.main(["--quick", "--jobs", "1"]) == 0
    page = capsys.readouterr().out
    rows = [line for line in page.splitlines() if line.startswith(tuple(f"| {link} |" for link in links.LINKS))]
    assert len(rows) == len(links.LINKS)
    assert all(row.count("|") == len(links.LEVELS) + 2 for row in rows)
    values = [cell.split() for cell in rows[0].split("|")[2:-1]]
    assert all(float(metres) < 0.1 and unit == "m," and angle.endswith("°") for metres, unit, angle in values)
    assert "lost" in rows[2]


def test_failures_measures_a_fall_and_a_flight() -> None:
    fallen, weak = (
        failures.fly(engine.job(name, {"duration_s": duration_s}, 1))
        for name, duration_s in ((failures.FAILURE, 20.0), (failures.LOSS, 12.0))
    )
    assert fallen.lost
    assert 1.0 < fallen.fall_s < 8.0
    assert 9.8 < fallen.altitude_m < 10.5
    assert fallen.sink_m_s > 10.0 / fallen.fall_s
    assert not weak.lost
    assert weak.fall_s == weak.drift_m == inf
    assert weak.rmse_before_m < weak.rmse_after_m < 0.2
    assert failures.lost([fallen, weak]) == "1 of 2"
    assert failures.median([fallen, weak], "rmse_after_m") == "–"
    assert failures.median([fallen, weak, weak], "rmse_after_m") != "–"


def test_links_counts_lost_flights_beside_the_median() -> None:
    flown = [Row("", "hover-wind", seed, "flown", 60.0, (0.3, 0.4, 0.0, 0.0, 3.0, 4.0)) for seed in (1, 2)]
    lost = Row("", "hover-wind", 3, "lost", 3.0)
    assert links.cell(flown) == "0.500 m, 5.00°"
    assert links.cell([*flown, lost]) == "0.500 m, 5.00° (1 of 3 lost)"
    assert links.cell([flown[0], lost, lost]) == "lost"


def test_score_has_every_shipped_controller(capsys: pytest.CaptureFixture[str]) -> None:
    assert score.main(["--quick", "--jobs", "1"]) == 0
    page = capsys.readouterr().out
    assert "| `stock` | **100** |" in page
    assert all(f"| `{name}` | **" in page for name in controllers.shipped())
    assert "0 of 6 |" in page
