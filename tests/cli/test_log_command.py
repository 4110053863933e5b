"""`mavsitl log`: what it prints, its JSON and its exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mavsitl.cli import main
from tests.log.conftest import fly


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("runs") / "hover-wind")


def test_info_says_what_is_in_each_log(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["log", "info", str(run)]) == 0
    said = capsys.readouterr().out
    for part in ("vehicle.ulg", "ground.ulg", "link.tlog", "vehicle_attitude_groundtruth", "Armed by external command"):
        assert part in said
    assert main(["log", "info", "--parameters", str(run / "vehicle.ulg")]) == 0
    assert "MC_ROLL_P" in capsys.readouterr().out


def test_info_as_json(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["log", "info", "--json", str(run)]) == 0
    vehicle, ground, wire = json.loads(capsys.readouterr().out)
    assert (vehicle["kind"], ground["kind"], wire["kind"]) == ("ULog", "ULog", "tlog")
    attitude = next(topic for topic in vehicle["topics"] if topic["name"] == "vehicle_attitude")
    assert attitude["rate_hz"] == pytest.approx(250.0)
    assert attitude["longest_gap_s"] == pytest.approx(0.004)
    assert vehicle["cut_bytes"] == 0
    assert vehicle["parameters"]["MAV_TYPE"] == 2
    assert {(source["system"], source["lost"]) for source in wire["sources"]} == {(1, 0), (250, 0)}


def test_info_of_a_cut_log_says_so(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut = tmp_path / "cut.ulg"
    cut.write_bytes((run / "vehicle.ulg").read_bytes()[:-7])
    assert main(["log", "info", str(cut)]) == 0
    assert "cut: " in capsys.readouterr().out


def test_convert_says_what_it_wrote(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.csv"
    assert main(["log", "convert", str(run), str(out), "--topic", "wind_groundtruth", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said == {"out": str(out), "bytes": out.stat().st_size, "topics": ["wind_groundtruth"]}
    assert main(["log", "convert", str(run), str(tmp_path / "a.xml")]) == 2
    assert "its ending says the format" in capsys.readouterr().err


def test_diff_s_exit_codes_are_those_of_diff(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = str(fly(tmp_path, seed=2))
    assert main(["log", "diff", str(run), str(run)]) == 0
    assert capsys.readouterr().out == "the same to the byte\n"
    assert main(["log", "diff", str(run), other]) == 1
    assert "they part at 0.000000 s" in capsys.readouterr().out
    assert main(["log", "diff", str(run), str(tmp_path / "none")]) == 2
    assert "no such file or folder" in capsys.readouterr().err
    assert main(["log", "diff", "--json", str(run), other]) == 1
    said = json.loads(capsys.readouterr().out)
    assert said["equal"] is False
    assert said["difference"]["information"] == {"seed": ["1", "2"]}


def test_log_alone_prints_its_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["log"]) == 2
    assert "convert" in capsys.readouterr().out
