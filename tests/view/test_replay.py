"""A replay shows what the logs hold, from any time on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from mavsitl import ends, scenario
from mavsitl.cli import main
from mavsitl.log.errors import LogError
from mavsitl.log.ulog import read
from mavsitl.report.run import RUN_FILE, RunError, load_run, new_run, record, write_run
from mavsitl.view.model import COLUMNS, Seen
from mavsitl.view.replay import Replay, find_flights

SECONDS = 6.0


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two flights."""
    folder = tmp_path_factory.mktemp("run")
    records = []
    for name in ("hover-wind", "thrust-loss"):
        flight = scenario.load(name, {"duration_s": SECONDS})
        outcome = ends.in_memory(flight, folder / name, report=lambda text: None, progress=None)
        records.append(record(flight, folder=name, wire_hash=outcome.wire_hash, real_time_factor=None))
    write_run(folder, new_run("test", "2026-01-01T00:00:00Z", tuple(records)))
    return folder


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    flight = scenario.load("formation-spiral", {"duration_s": 2.0})
    ends.fleet_in_memory(flight, folder / flight.name, count=3, report=lambda text: None, progress=None)
    return folder


def at(replay: Replay, time_s: float) -> dict[str, Any]:
    replay.seek(time_s)
    return replay.model.vehicles[1].values


def test_it_finds_the_flights_of_a_run_a_folder_and_a_fleet(run: Path, fleet: Path) -> None:
    titles = [scenario.load(name).scenario.title for name in ("hover-wind", "thrust-loss")]
    assert [flight.name for flight in find_flights(run)] == titles
    (one,) = find_flights(run / "hover-wind")
    assert one.folders == {1: run / "hover-wind"}
    (nine,) = find_flights(fleet)
    assert nine.name == "formation-spiral"
    assert list(nine.folders) == [1, 2, 3]
    (nine,) = find_flights(fleet / "formation-spiral")
    assert list(nine.folders) == [1, 2, 3]


def test_a_fleet_s_run_is_one_flight_of_its_vehicles(tmp_path: Path) -> None:
    arguments = ["fly", "formation-spiral", "--count", "2", "--duration", "1", "--no-report"]
    assert main([*arguments, "--run-dir", str(tmp_path)]) == 0
    (flight,) = find_flights(tmp_path)
    assert flight.name == "Spirals in formation"
    assert flight.folders == {number: tmp_path / f"formation-spiral/vehicle-{number - 1}" for number in (1, 2)}
    replay = Replay([flight])
    replay.seek(1.0)
    assert all(replay.model.vehicles[number].values["attitude"] for number in (1, 2))


def test_flights_of_one_title_are_told_apart_by_their_folders(run: Path, tmp_path: Path) -> None:
    known = load_run(run).flights[0]
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    twice = tuple(msgspec.structs.replace(known, folder=name) for name in ("one", "two"))
    write_run(tmp_path, new_run("test", "2026-01-01T00:00:00Z", twice))
    assert [flight.name for flight in find_flights(tmp_path)] == [f"{known.title} (one)", f"{known.title} (two)"]


def test_where_there_is_nothing_it_says_what_is_expected(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"nothing to replay; expected run\.json, vehicle\.ulg"):
        find_flights(tmp_path)
    with pytest.raises(LogError, match="no such folder"):
        find_flights(tmp_path / "none")
    (tmp_path / RUN_FILE).write_text("{")
    with pytest.raises(RunError, match="damaged"):
        find_flights(tmp_path)


def test_a_damaged_log_is_named(tmp_path: Path) -> None:
    (tmp_path / "vehicle.ulg").write_bytes(b"no log at all, of no kind")
    with pytest.raises(LogError, match=r"vehicle\.ulg"):
        Replay(find_flights(tmp_path))


def test_what_is_shown_is_what_was_logged(run: Path) -> None:
    replay = Replay(find_flights(run))
    tables, ground = read(run / "hover-wind" / "vehicle.ulg"), read(run / "hover-wind" / "ground.ulg")
    begin_us = int(tables["vehicle_attitude"]["timestamp"][0])
    for time_s in (3.0, 4.3, 5.5):
        values = at(replay, time_s)
        stamp_us = begin_us + round(time_s * 1e6)

        def held(table: dict[str, Any], column: str, stamp_us: int = stamp_us) -> Any:
            row = int(np.searchsorted(table["timestamp"], stamp_us, side="right")) - 1
            return table[column][row].tolist()

        place = [held(tables["vehicle_local_position"], name) for name in "xyz"]
        assert values["position"] == pytest.approx(place, abs=1e-4)
        assert values["attitude"] == pytest.approx(held(tables["vehicle_attitude"], "q"), abs=1e-4)
        assert values["reference"] == pytest.approx(held(ground["trajectory_setpoint"], "position"), abs=1e-4)
        assert values["mode"] == "OFFBOARD"
        assert values["armed"]
        assert values["wind"]["source"] == "true"
        assert len(values["weights"]) == 9
        assert values["link"]["of"] == "off-board"
    assert replay.model.world["duration_s"] > SECONDS


def test_it_plays_at_its_speed_and_stops_at_the_end(run: Path) -> None:
    replay = Replay(find_flights(run))
    replay.step(1_000_000)
    assert replay.model.world["at_s"] == 0.0
    replay.step(2_000_000)
    assert replay.model.world["at_s"] == pytest.approx(1.0)
    replay.set_speed(2.0)
    replay.step(2_500_000)
    assert replay.model.world["at_s"] == pytest.approx(2.0)
    replay.play(False)
    replay.step(9_000_000)
    assert replay.model.world["at_s"] == pytest.approx(2.0)
    replay.play(True)
    replay.step(99_000_000)
    assert replay.model.world["at_s"] == replay.model.world["duration_s"]
    assert not replay.model.world["playing"]
    replay.play(True)
    assert replay.model.world["at_s"] == 0.0
    with pytest.raises(ValueError, match=r"allowed: 0\.1, 0\.25"):
        replay.set_speed(3.0)


def test_rows_are_the_same_whether_played_or_sought(run: Path) -> None:
    played, sought = Replay(find_flights(run)), Replay(find_flights(run))
    for tick in range(1, 91):
        played.step(tick * 33_333)
    time_s = played.model.world["at_s"]
    sought.seek(time_s)
    one, other = played.model.vehicles[1], sought.model.vehicles[1]
    assert abs(len(one.rows) - len(other.rows)) <= 1
    count = min(len(one.rows), len(other.rows))
    assert list(one.rows)[:count] == list(other.rows)[:count]
    assert len(one.rows[0]) == len(COLUMNS)
    before = one.chapter
    played.seek(1.0)
    assert one.chapter != before
    assert one.rows[-1][0] == pytest.approx(1.0, abs=0.06)


def test_seeking_beyond_the_flight_stays_in_it(run: Path) -> None:
    replay = Replay(find_flights(run))
    for wild in (-5.0, 1e9, float("nan"), float("inf")):
        replay.seek(wild)
        assert 0.0 <= replay.model.world["at_s"] <= replay.model.world["duration_s"]


def test_another_flight_of_the_run(run: Path) -> None:
    replay = Replay(find_flights(run))
    seen = Seen()
    seen.selected = 1
    replay.model.news(seen)
    replay.open(replay.model.world["flights"][1])
    news = replay.model.news(seen)
    assert "chapter" in news["world"]
    assert news["rows"]["whole"]
    with pytest.raises(KeyError):
        replay.open("none of them")


def test_a_fleet_is_played_together(fleet: Path) -> None:
    replay = Replay(find_flights(fleet))
    replay.seek(3.0)
    places = [vehicle.values["position"] for vehicle in replay.model.vehicles.values()]
    assert len(places) == 3
    assert abs(places[1][1] - places[0][1]) > 2.0


def test_texts_come_when_their_time_does(run: Path) -> None:
    replay = Replay(find_flights(run))
    replay._texts = [(replay._begin_us + 1_000_000, 1, 4, "one"), (replay._begin_us + 3_000_000, 1, 6, "two")]

    def said(seen: Seen) -> list[str]:
        return [text["text"] for text in replay.model.news(seen).get("texts", [])]

    replay.seek(0.5)
    assert said(Seen()) == []
    replay.seek(2.0)
    assert said(Seen()) == ["one"]
    replay.seek(4.0)
    assert said(Seen()) == ["one", "two"]
    replay.seek(0.5)
    assert said(Seen()) == []


def test_a_log_without_a_ground_is_shown_too(run: Path, tmp_path: Path) -> None:
    (tmp_path / "vehicle.ulg").write_bytes((run / "hover-wind" / "vehicle.ulg").read_bytes())
    values = at(Replay(find_flights(tmp_path)), 2.0)
    assert values["position"] is not None
    assert values["reference"] is None
    assert values["weights"] is None
