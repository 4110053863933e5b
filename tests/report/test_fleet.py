"""A fleet's run: what run.json has of it, and the one page for all of them."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from mavsitl.cli import main
from mavsitl.log.flight import FlightData
from mavsitl.report import fleet_figures
from mavsitl.report.fleet import Track, Tracks, load_tracks, measure, render, summary
from mavsitl.report.html import write_report
from mavsitl.report.run import (
    CollisionRecord,
    FleetRecord,
    RunError,
    VehicleRecord,
    load_run,
    new_run,
    record,
    write_run,
)
from mavsitl.scenario import load
from tests.report.test_html import Checker

COUNT = 3


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of three vehicles that fly for 2 s."""
    folder: Path = tmp_path_factory.mktemp("fleet") / "run"
    assert main(["fly", "formation-spiral", "--count", f"{COUNT}", "--duration", "2", "--run-dir", str(folder)]) == 0
    return folder


def fleet_of(run: Path) -> FleetRecord:
    found = load_run(run).flights[0].fleet
    assert found is not None
    return found


def test_run_json_has_each_vehicle_s_numbers_as_its_logs_have_them(run: Path) -> None:
    (flight,) = load_run(run).flights
    assert (flight.folder, flight.paper_case, flight.duration_s) == ("formation-spiral", None, 2.0)
    vehicles = fleet_of(run).vehicles
    assert [each.system_id for each in vehicles] == [1, 2, 3]
    flights = [FlightData.from_folder(run / each.folder, duration_s=2.0) for each in vehicles]
    for vehicle, data in zip(vehicles, flights, strict=True):
        error_m = np.linalg.norm(data.position_error_nwu_m(), axis=1)
        assert vehicle.rms_m == pytest.approx(np.sqrt(np.mean(error_m**2)))
        assert vehicle.worst_m == pytest.approx(np.max(error_m))
        assert vehicle.flight_time_s == pytest.approx(2.0, abs=0.03)
        assert vehicle.finished
        assert vehicle.lost == ""
    # In a grid the second is east of the first, the third south of it; all fly from about the same time on.
    for vehicle, others in zip(vehicles, ({2, 3}, {1}, {1}), strict=True):
        assert vehicle.nearest in others
        assert vehicle.nearest_m is not None
        assert 2.0 < vehicle.nearest_m < 4.2
    assert len({each.wire_hash for each in vehicles}) == COUNT


def test_the_least_separation_is_that_of_the_true_positions(run: Path) -> None:
    vehicles = fleet_of(run).vehicles
    one, two = (FlightData.from_folder(run / vehicle.folder, duration_s=2.0) for vehicle in vehicles[:2])
    rows = min(one.time_s.size, two.time_s.size)
    apart_m = np.linalg.norm(one.position_nwu_m[:rows] - two.position_nwu_m[:rows], axis=1)
    assert vehicles[1].nearest == 1
    assert vehicles[1].nearest_m is not None
    assert vehicles[1].nearest_m <= apart_m.min() + 0.05  # flights need not begin in the same tick; landing counts


def test_the_page_is_whole_and_needs_nothing_from_elsewhere(run: Path) -> None:
    page = (run / "report.html").read_text("utf-8")
    checker = Checker()
    checker.feed(page)
    checker.close()
    assert checker.open == []
    assert len(checker.ids) == len(set(checker.ids))
    assert {address[1:] for address in checker.addresses} <= set(checker.ids)
    assert "<script" not in page
    for vehicle in fleet_of(run).vehicles:
        assert vehicle.wire_hash in page
    assert page.count("<figure") == 4
    assert "no collision" in page
    assert "Impaired links" not in page


def test_the_page_is_made_again_from_the_logs(run: Path) -> None:
    before = (run / "report.html").read_bytes()
    (run / "report.html").unlink()
    assert main(["report", str(run)]) == 0
    assert (run / "report.html").read_bytes() == before
    assert not [each for each in run.iterdir() if each.name not in ("report.html", "run.json", "formation-spiral")]


def test_json_and_no_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["fly", "formation-spiral", "--count", "2", "--duration", "1", "--json", "--no-report"]
    assert main([*arguments, "--run-dir", str(tmp_path)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert not (tmp_path / "report.html").exists()
    assert told["event"] == "end"
    (flight,) = told["flights"]
    kept = json.loads((tmp_path / "run.json").read_text())["flights"][0]
    assert flight["flight"] == kept
    assert [each["state"] for each in flight["rmse"]] == ["x / m", "y / m", "z / m", "φ / °", "θ / °", "ψ / °"]
    assert all(each["ours"] > 0.0 for each in flight["rmse"])
    assert [each["wire_hash"] for each in told["vehicles"]] == [
        each["wire_hash"] for each in kept["fleet"]["vehicles"]
    ]  # fmt: skip


LINE = [
    "--set", 'fleet.formation="line"', "--set", "fleet.spacing_m=0.7", "--set", "fleet.collision_m=0.65",
    "--set", 'fleet.on_collision="crash"',
]  # fmt: skip


def test_vehicles_that_collide_and_crash_are_lost_and_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["fly", "formation-spiral", "--count", "3", "--duration", "3", *LINE, "--run-dir", str(tmp_path)]
    assert main(arguments) == 1
    fleet = fleet_of(tmp_path)
    collided = {each for pair in fleet.collisions for each in (pair.vehicle, pair.other)}
    assert collided
    for vehicle in fleet.vehicles:
        assert vehicle.lost.startswith("collided with vehicle ") == (vehicle.system_id in collided)
        assert vehicle.finished == (not vehicle.lost)
    first = fleet.collisions[0]
    told = capsys.readouterr().out
    assert f"collision of vehicles {first.vehicle} and {first.other} at t = {first.time_s:.2f} s" in told
    assert f"vehicle {first.vehicle} was lost after" in told
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "All rotors of both failed" in page
    assert f"lost: collided with vehicle {first.other}" in page


def test_a_flight_that_is_interrupted_leaves_its_page_as_it_was(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = (run / "report.html").read_bytes()

    def stopped(*arguments: Any) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr("mavsitl.report.fleet.render", stopped)
    with pytest.raises(KeyboardInterrupt):
        write_report(run)
    assert (run / "report.html").read_bytes() == before


def test_a_fleet_s_record_leads_nowhere_else(run: Path, tmp_path: Path) -> None:
    known = load_run(run)
    (flight,) = known.flights
    fleet = fleet_of(run)
    for folder, reason in (("../x", "outside the run's folder"), ("formation-spiral/x", "no folder")):
        vehicles = (msgspec.structs.replace(fleet.vehicles[0], folder=folder),)
        changed = msgspec.structs.replace(flight, fleet=msgspec.structs.replace(fleet, vehicles=vehicles))
        (tmp_path / "formation-spiral").mkdir(exist_ok=True)
        write_run(tmp_path, new_run("test", "2026-01-01T00:00:00Z", (changed,)))
        with pytest.raises(RunError, match=reason):
            load_run(tmp_path)
    write_run(tmp_path, new_run("test", "2026-01-01T00:00:00Z", (flight, flight)))
    with pytest.raises(RunError, match="2 flights; expected one, for it is a fleet's"):
        load_run(tmp_path)


def test_a_log_that_is_missing_is_named(run: Path, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"vehicle 7: .*vehicle\.ulg: cannot be read"):
        load_tracks({7: tmp_path}, 2.0)


def circles(count: int, seconds: float = 20.0, hz: float = 250.0) -> Tracks:
    """Vehicles on circles, in a row 3 m apart, the last of them never released."""
    time_s = np.arange(0.0, seconds, 1.0 / hz)
    tracks = []
    for j in range(count):
        centre = np.array([0.0, -3.0 * j, 1.0])
        reference = centre + np.column_stack((np.cos(time_s), np.sin(time_s), 0.0 * time_s))
        path = reference + 0.1 * np.column_stack((np.sin(7 * time_s + j), np.cos(5 * time_s + j), 0.0 * time_s))
        rows = slice(0, 0) if j == count - 1 else slice(None)
        tracks.append(Track(j + 1, time_s[rows], path[rows], reference[rows], np.ones(6)))
    nearest = np.tile(np.arange(2, count + 2), (time_s.size, 1))
    return Tracks(tuple(tracks), 0.5, time_s, np.full((time_s.size, count), 3.0) + np.sin(9 * time_s)[:, None], nearest)


def recorded(tracks: Tracks, collisions: Sequence[CollisionRecord] = ()) -> FleetRecord:
    counts = dict.fromkeys(("sent", "delivered", "lost", "outage", "queue_drops", "corrupted", "duplicated"), 10.0)
    delays = {"late": 0.0, "delay_p50_ms": 20.0, "delay_p99_ms": 40.0, "delay_max_ms": 60.0}
    links = {"link": {"to_ground": {**counts, **delays}, "to_vehicle": {**counts, **delays}}}
    vehicles = tuple(
        VehicleRecord(
            system_id=track.system_id, folder="x", wire_hash=f"{track.system_id:032x}",
            finished=bool(track.time_s.size), links=links, **asdict(each),
        )
        for track, each in zip(tracks.vehicles, measure(tracks), strict=True)
    )  # fmt: skip
    return FleetRecord(
        formation="line", spacing_m=3.0, shared_wind=False, collision_m=0.5, on_collision="report", vehicles=vehicles,
        collisions=tuple(collisions),
    )  # fmt: skip


def test_the_page_of_a_hundred_stays_small_and_its_legends_short() -> None:
    tracks = circles(100)
    fleet = recorded(tracks, [CollisionRecord(time_s=4.0 + j, vehicle=1, other=2, distance_m=0.4) for j in range(9)])
    about = record(load("formation-spiral"), folder="x", wire_hash="ab" * 16, real_time_factor=None, fleet=fleet)
    page = render(new_run("mavsitl fly", "2026-01-02T03:04:05Z", (about,)), tracks)
    assert len(page) < 3_000_000  # 100 vehicles of 5000 samples would be 50 MB
    assert page.count("<tr>") >= 100 + 200 + 9
    assert page.count("scroll tall") == 3
    assert "not flown to its end" in page
    assert page.count("<figure") == 5
    names = [name for *_, name in fleet_figures._lines(tracks) if name]
    assert names == ["vehicle 1", "vehicle 25", "vehicle 50", "vehicle 75"]


@pytest.mark.parametrize("count", [1, 2, fleet_figures.FEW, fleet_figures.FEW + 1])
def test_each_of_a_few_has_a_colour_of_its_own(count: int) -> None:
    assert len(set(fleet_figures.colours(count))) == count


def test_one_vehicle_alone_has_no_separation() -> None:
    tracks = circles(2)
    alone = Tracks(tracks.vehicles[:1], 0.0, tracks.time_s, np.full((tracks.time_s.size, 1), math.nan),
                   np.zeros((tracks.time_s.size, 1), np.int64))  # fmt: skip
    (numbers,) = measure(alone)
    assert (numbers.nearest_m, numbers.nearest) == (None, None)
    assert numbers.rms_m == pytest.approx(0.1, rel=0.01)
    fleet = recorded(alone)
    assert [each.svg.count("<svg") for each in fleet_figures.drawings(alone, fleet)] == [1] * 4  # with the links'
    assert summary(fleet) == [
        "1 of 1 flown as planned",
        f"RMSE {numbers.rms_m:.3f} m (median; at most {numbers.rms_m:.3f} m)",
    ]
