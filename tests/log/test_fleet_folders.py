"""The folder of a fleet's run, or of its flight, is the logs of its vehicles: all where all can be shown, else one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from mavsitl.cli import main
from mavsitl.log.content import RUN_LOGS, VEHICLE_FOLDER, flights_of, is_fleet, load, logs_of
from mavsitl.log.convert import outputs
from mavsitl.log.errors import LogError
from mavsitl.log.info import inspect

COUNT = 3


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("fleet") / "run"
    arguments = ["fly", "formation-spiral", "--count", f"{COUNT}", "--duration", "1", "--no-report"]
    assert main([*arguments, "--run-dir", str(folder)]) == 0
    return folder


@pytest.fixture(autouse=True)
def _wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows and paths are not broken, whatever terminal the tests run on."""
    monkeypatch.setenv("COLUMNS", "300")


def vehicles(fleet: Path) -> tuple[Path, ...]:
    return tuple(fleet / "formation-spiral" / f"vehicle-{j}" for j in range(COUNT))


def test_a_fleet_s_folders_are_found_from_the_run_and_from_the_flight(fleet: Path) -> None:
    assert flights_of(fleet) == flights_of(fleet / "formation-spiral") == vehicles(fleet)
    assert flights_of(vehicles(fleet)[1]) == vehicles(fleet)[1:2]
    assert is_fleet(flights_of(fleet))
    assert [each.name for each in logs_of(vehicles(fleet)[0])] == list(RUN_LOGS)


def test_vehicles_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for j in (10, 9, 0, 100):
        (tmp_path / f"vehicle-{j}").mkdir()
        (tmp_path / f"vehicle-{j}" / "link.tlog").touch()
    assert [VEHICLE_FOLDER.fullmatch(each.name) for each in flights_of(tmp_path)]
    assert [each.name for each in flights_of(tmp_path)] == ["vehicle-0", "vehicle-9", "vehicle-10", "vehicle-100"]


def test_a_folder_of_runs_is_none(fleet: Path) -> None:
    """Or `mavsitl log info runs` would read every log that there is."""
    assert flights_of(fleet.parent) == ()
    with pytest.raises(LogError, match="a folder without logs"):
        logs_of(fleet.parent)


def test_info_has_every_log_of_every_vehicle(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = [str(folder / name) for folder in vehicles(fleet) for name in RUN_LOGS]
    assert [info.path for info in inspect(fleet)] == wanted
    assert main(["log", "info", "--json", str(fleet / "formation-spiral")]) == 0
    assert [info["path"] for info in json.loads(capsys.readouterr().out)] == wanted


def test_info_shows_a_row_for_each_vehicle(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["log", "info", str(fleet)]) == 0
    told = capsys.readouterr().out
    rows = [line.split() for line in told.splitlines() if line.strip().startswith("vehicle-")]
    assert [row[:2] for row in rows] == [[f"vehicle-{j}", "3"] for j in range(COUNT)]
    assert all("whole" in row for row in rows)
    assert f"{COUNT} vehicles" in told
    assert f"mavsitl log info {vehicles(fleet)[0]}" in told
    assert main(["log", "info", "--parameters", str(fleet)]) == 0
    assert capsys.readouterr().out.count("link.tlog") == COUNT


def test_info_tells_a_cut_log_and_the_gravest_text(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "run"
    arguments = ["fly", "formation-spiral", "--count", "2", "--duration", "1", "--no-report", "--run-dir", str(copy)]
    near = ["--set", "fleet.spacing_m=0.6", "--set", "fleet.collision_m=0.59", "--set", 'fleet.formation="line"']
    assert main([*arguments, *near]) == 0
    log = copy / "formation-spiral" / "vehicle-1" / "vehicle.ulg"
    log.write_bytes(log.read_bytes()[:-1])
    capsys.readouterr()
    assert main(["log", "info", str(copy)]) == 0
    first, second = (line for line in capsys.readouterr().out.splitlines() if line.strip().startswith("vehicle-"))
    assert "whole" in first
    assert "cut" in second
    assert "WARNING: Collision with vehicle 2" in first


def test_convert_gives_each_vehicle_a_file(fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "spiral.csv.zip"
    assert main(["log", "convert", str(fleet), str(out), "--topic", "vehicle_attitude", "--json"]) == 0
    written = json.loads(capsys.readouterr().out)
    files = [tmp_path / "spiral" / f"vehicle-{j}.csv.zip" for j in range(COUNT)]
    assert [each["out"] for each in written] == [str(file) for file in files]
    assert not out.exists()
    assert main(["log", "convert", str(fleet), str(tmp_path / "all.ulg")]) == 0
    for j, folder in enumerate(vehicles(fleet)):
        tables = load(tmp_path / "all" / f"vehicle-{j}.ulg").tables
        for name in ("vehicle_attitude", "trajectory_setpoint"):
            end = "ground.ulg" if name == "trajectory_setpoint" else "vehicle.ulg"
            assert len(tables[name]["timestamp"]) == len(load(folder / end).tables[name]["timestamp"])


def test_of_one_flight_the_output_is_the_file_that_was_named(fleet: Path, tmp_path: Path) -> None:
    one = vehicles(fleet)[0]
    assert outputs(one, tmp_path / "x.ulg") == {one: tmp_path / "x.ulg"}
    with pytest.raises(LogError, match="its ending says the format"):
        outputs(fleet, tmp_path / "x.txt")
    (tmp_path / "taken").touch()
    with pytest.raises(LogError, match="no folder can be made there"):
        outputs(fleet, tmp_path / "taken.ulg")


def test_flights_of_a_run_are_converted_side_by_side(fleet: Path, tmp_path: Path) -> None:
    for name in ("hover", "spiral"):
        shutil.copytree(vehicles(fleet)[0], tmp_path / "run" / name)
    files = outputs(tmp_path / "run", tmp_path / "out.jsonl")
    assert list(files.values()) == [tmp_path / "out" / "hover.jsonl", tmp_path / "out" / "spiral.jsonl"]


def test_diff_compares_one_with_one(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, other, _ = vehicles(fleet)
    assert main(["log", "diff", str(fleet), str(fleet)]) == 2
    told = capsys.readouterr().err
    assert "a fleet of 3 vehicles, choose one; allowed: " in told
    assert str(other) in told
    assert main(["log", "diff", str(one), str(other)]) == 1


def test_of_very_many_the_first_and_the_last_are_named(tmp_path: Path) -> None:
    for j in range(100):
        (tmp_path / f"vehicle-{j}").mkdir()
        (tmp_path / f"vehicle-{j}" / "vehicle.ulg").touch()
    with pytest.raises(LogError, match=r"100 vehicles.*vehicle-6, \.\.\., .*vehicle-99$"):
        logs_of(tmp_path)
