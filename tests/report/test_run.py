"""run.json: written whole, read strictly."""

from __future__ import annotations

from pathlib import Path

import pytest

from mavsitl import scenario
from mavsitl.report.run import Run, RunError, load_run, new_run, record, scenario_digest, write_run


def made(folder: str = "one") -> Run:
    flight = record(scenario.load("hover-wind"), folder=folder, wire_hash="ab" * 16, real_time_factor=None)
    return new_run("mavsitl run hover-wind", "2026-01-02T03:04:05", (flight,))


def test_a_run_comes_back_as_written(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "run"
    path = write_run(folder, made())
    (folder / "one").mkdir()
    assert load_run(folder) == made()
    assert [entry.name for entry in sorted(folder.iterdir())] == ["one", "run.json"]
    flight = load_run(folder).flights[0]
    assert (flight.name, flight.paper_case, flight.wind) == ("hover-wind", "hover-wind", ("dryden-paper",))
    assert path.read_text("utf-8").endswith("}\n")


def test_a_run_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    write_run(tmp_path, made())
    before = (tmp_path / "run.json").read_bytes()
    (tmp_path / ".run.json.tmp").mkdir()
    with pytest.raises(RunError, match=r"run\.json: cannot be written: (Is a directory|Operation not permitted)"):
        write_run(tmp_path, made("two"))
    assert (tmp_path / "run.json").read_bytes() == before


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"seed": 1', '"seed": "1"', r"run\.json: not a run of mavsitl .*flights\[0\]\.seed"),
        ('"version"', '"versio"', r"run\.json: not a run of mavsitl .*versio"),
        ("}", "", r"run\.json: damaged, expected JSON"),
        ('"folder": "one"', '"folder": "../one"', "outside the run's folder"),
        ('"folder": "one"', '"folder": "two"', "no folder 'two'; expected one beside run.json"),
        ('"paper_case": "hover-wind"', '"paper_case": "hover"', "'hover' is not one of hover-calm, hover-wind"),
    ],
)
def test_damaged_runs_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = write_run(tmp_path, made())
    (tmp_path / "one").mkdir()
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new), "utf-8")
    with pytest.raises(RunError, match=message):
        load_run(tmp_path)


def test_a_folder_without_a_run_says_what_was_expected(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"run\.json: not found; expected the folder of a run"):
        load_run(tmp_path)


def test_the_digest_follows_what_is_flown_only(tmp_path: Path) -> None:
    shipped = scenario.load("hover-wind")
    copied = tmp_path / "another-name.toml"
    from importlib import resources

    copied.write_bytes((resources.files("mavsitl") / "scenarios" / "hover-wind.toml").read_bytes())
    assert scenario_digest(scenario.load(str(copied))) == scenario_digest(shipped)
    assert scenario_digest(scenario.load("hover-wind", {"seed": 2})) != scenario_digest(shipped)
    assert scenario_digest(scenario.load("hover-wind", {"airframe": "realistic"})) != scenario_digest(shipped)
