"""`mavsitl sweep`: what is refused before anything flies, what is left behind, and how it goes on after a kill."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

from mavsitl import cli, scenario, wings
from mavsitl.campaign import fly, grid, optional, store, sweep, workers
from mavsitl.campaign.fly import Row
from mavsitl.campaign.grid import Case
from mavsitl.campaign.store import Journal, columns
from mavsitl.campaign.summary import summarize
from mavsitl.cli.common import EXIT_FAILED, EXIT_OK, EXIT_SIGNAL, EXIT_USAGE
from mavsitl.cli.sweep import _told
from mavsitl.report import sweep as page
from mavsitl.report.html import REPORT_FILE
from mavsitl.report.run import scenario_digest
from tests.campaign.flights import measured
from tests.campaign.test_summary import row

GRID = ("--set", "duration_s=2", "--set", "wind.speed_20ft_m_s=0,10", "--compare", "controller.law=pid,pidnn")


@pytest.fixture(scope="module")
def parquet() -> Any:
    return pytest.importorskip("pyarrow.parquet")


def run(folder: Path, *arguments: str) -> int:
    return cli.main(["sweep", "hover-wind", "--output", str(folder), "--jobs", "1", *arguments])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "wind.speed=1,2"], "wind[0].speed: unknown key; did you mean speed_20ft_m_s? allowed here: model, "),
        (["--set", "controller.law=pid,lqr"], "controller.law: 'lqr' is not allowed; allowed: 'pid', 'pidnn'"),
        (["--set", "duration_s=1,2", "--set", "duration_s=3"], "duration_s: given 2 times; allowed: once, with all"),
        (["--compare", "controller.law=pid"], "--compare controller.law: one value alone; allowed: two or more"),
        (["--set", "duration_s"], "duration_s: not KEY=VALUE or KEY=A,B,C"),
        (["--seeds", "1,1"], "seeds 1,1: one is there twice"),
        (["--scheduler", "tcp://127.0.0.1:9"], "--jobs: not with --scheduler"),
    ],
)
def test_what_is_wrong_is_named_before_anything_flies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: Sequence[str], message: str
) -> None:
    assert run(tmp_path / "new", *arguments) == EXIT_USAGE
    assert message in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_scheduler_s_address_has_a_form(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["sweep", "hover-wind", "--scheduler", "here:8786"]) == EXIT_USAGE
    assert "'here:8786' is not allowed; allowed: tcp://HOST:PORT" in capsys.readouterr().err


def test_without_pyarrow_nothing_flies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optional, "find_spec", lambda name: None)
    assert run(tmp_path / "new", "--seeds", "1") == EXIT_FAILED
    assert "pip install 'mavsitl[sweep]'" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_sweep_leaves_rows_and_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str], parquet: Any) -> None:
    assert run(tmp_path, *GRID, "--seeds", "2", "--json") == EXIT_OK
    said = capsys.readouterr()
    told = msgspec.json.decode(said.out)
    assert (told["flights"], told["flown"], told["lost"], told["failed"]) == (8, 8, 0, 0)
    assert [cell["labels"] for cell in told["cells"]] == [
        {"wind.speed_20ft_m_s": speed, "controller.law": law} for speed in (0, 10) for law in ("pid", "pidnn")
    ]
    assert {each["key"] for each in told["comparisons"]} == {"wind.speed_20ft_m_s", "controller.law"}

    table = parquet.read_table(tmp_path / sweep.RESULTS_FILE)
    rows = table.to_pylist()
    assert [(r["wind.speed_20ft_m_s"], r["controller.law"], r["seed"]) for r in rows] == [
        (speed, law, seed) for speed in (0, 10) for law in ("pid", "pidnn") for seed in (1, 2)
    ]
    assert {r["status"] for r in rows} == {"flown"}
    flight = scenario.load(
        "hover-wind", {"duration_s": 2, "wind.speed_20ft_m_s": 10, "controller.law": "pidnn", "seed": 2}
    )
    flown = fly.fly(grid.case(flight))
    assert rows[-1]["scenario_digest"] == scenario_digest(flight)
    assert flown.rmse == tuple(rows[-1][f"rmse_{state}"] for state in store.STATES)
    assert (rows[-1]["rmse_position_m"], rows[-1]["wire_hash"]) == (flown.position_m, flown.wire_hash)
    facts = {name.decode(): value.decode() for name, value in table.schema.metadata.items()}
    assert facts["mavsitl.scenario_toml"] == scenario.text_of("hover-wind")
    assert facts["mavsitl.scenario_digest"] == scenario_digest(scenario.load("hover-wind", {"duration_s": 2}))
    assert facts["mavsitl.command"].startswith("mavsitl ")
    assert facts["mavsitl.code"] == grid.source_digest()
    assert msgspec.json.decode(facts["mavsitl.settings"])["controller.law"] == ["pid", "pidnn"]
    html = (tmp_path / REPORT_FILE).read_text("utf-8")
    assert html.count("<figure") == html.count("<svg") == 6
    assert "law pidnn against pid" in html
    assert not list(tmp_path.glob(".*"))


def test_the_same_again_flies_nothing_and_more_flies_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, parquet: Any
) -> None:
    """Whatever a key is called: a value that was fixed and is swept now is the same flight."""
    few = ("--set", "duration_s=2", "--set", "controller.law=pid", "--no-report")
    assert run(tmp_path, *few, "--seeds", "2") == EXIT_OK
    before = {r["key"] for r in parquet.read_table(tmp_path / sweep.RESULTS_FILE).to_pylist()}
    flown: list[int] = []
    really = fly.fly

    def noted(case: Case) -> Row:
        flown.append(case.seed)
        return really(case)

    monkeypatch.setattr(fly, "fly", noted)
    assert run(tmp_path, *few, "--seeds", "2") == EXIT_OK
    assert flown == []
    assert run(tmp_path, "--set", "duration_s=2", "--set", "controller.law=pidnn,pid", "--seeds", "2-3") == EXIT_OK
    assert flown == [2, 3, 3]
    assert "1 of 4 were flown before" in capsys.readouterr().out
    rows = parquet.read_table(tmp_path / sweep.RESULTS_FILE).to_pylist()
    assert [(r["controller.law"], r["seed"], r["key"] in before) for r in rows] == [
        ("pidnn", 2, False), ("pidnn", 3, False), ("pid", 2, True), ("pid", 3, False),
    ]  # fmt: skip


def test_other_code_and_another_scenario_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.toml").write_text('title = "Mine"\nduration_s = 2.0\n')
    mine = str(tmp_path / "mine.toml")

    def plan(seeds: str = "4") -> sweep.Plan:
        return sweep.plan(mine, ["offnominal.mass_scale=1,1.1"], [], seeds)

    with Journal(None) as journal:
        assert sweep.known(plan(), journal) == (0, 0, 0)
        for case in plan("2").cases:
            journal.add(Row(case.key, "mine", case.seed, "lost", 1.0, labels=case.labels, wire_hash="something",
                            scenario_digest=scenario_digest(case.flight)))  # fmt: skip
        assert sweep.known(plan(), journal) == (4, 0, 0)
        monkeypatch.setattr(grid, "source_digest", lambda: "tomorrow's")
        assert sweep.known(plan(), journal) == (0, 4, 0)
        monkeypatch.undo()
        (tmp_path / "mine.toml").write_text('title = "Mine"\nduration_s = 3.0\n')
        assert sweep.known(plan(), journal) == (0, 0, 4)
    told = _told(sweep.Known(1, 2, 3), 9, tmp_path)
    assert [text.partition(",")[0] for text in told] == [
        f"1 of 9 were flown before ({tmp_path})",
        "2 of 9 were flown before by other code",
        "3 of 9 were flown before with other settings or another scenario file",
    ]


def test_lost_and_failed_flights_are_rows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, parquet: Any
) -> None:
    """A lost one is a result; one that failed by an error is one too, and says so at the end."""
    rotors = "offnominal.rotor_thrust_scale=[1,1,1,1],[0,1,1,1]"
    monkeypatch.setenv("COLUMNS", "200")
    assert run(tmp_path, "--set", "duration_s=5", "--set", rotors, "--seeds", "1") == EXIT_OK
    assert "0 of 1 (1 lost)" in " ".join(capsys.readouterr().out.split())
    good, lost = parquet.read_table(tmp_path / sweep.RESULTS_FILE).to_pylist()
    assert (good["status"], lost["status"], lost["rmse_position_m"]) == ("flown", "lost", None)
    assert lost["offnominal.rotor_thrust_scale"] == "[0,1,1,1]"
    assert "reference" in lost["message"]
    assert "Not flown to the end" in (tmp_path / REPORT_FILE).read_text("utf-8")

    def find(group: str) -> Any:
        raise LookupError("nobody")

    monkeypatch.setattr(wings, "find", find)
    assert run(tmp_path, "--set", "duration_s=4", "--seeds", "2") == EXIT_FAILED
    assert "2 of 2 failed: LookupError: nobody" in " ".join(capsys.readouterr().out.split())
    rows = parquet.read_table(tmp_path / sweep.RESULTS_FILE).to_pylist()
    assert [(r["status"], r["message"]) for r in rows] == [("failed", "LookupError: nobody")] * 2


def test_a_flight_whose_worker_was_lost_is_flown_again(tmp_path: Path) -> None:
    plan = sweep.plan("hover-calm", ["duration_s=2"], [], "1")
    with Journal(tmp_path / "rows.jsonl") as journal:
        journal.add(fly.not_flown(plan.cases[0], "out of memory"))
        assert sweep.known(plan, journal) == (0, 0, 0)
        assert [each.status for each in sweep.fly(plan, journal, workers.Here())] == ["flown"]
        assert [each.status for each in sweep.rows(plan, journal)] == ["flown"]
        assert list(sweep.fly(plan, journal, workers.Here())) == []
    with Journal(tmp_path / "rows.jsonl") as journal:  # the later line holds
        assert sweep.known(plan, journal).flown == 1


class Sweeping:
    """`mavsitl sweep` as a process of its own, with two workers."""

    def __init__(self, folder: Path, log: Path) -> None:
        command = [sys.executable, "-m", "mavsitl", "sweep", "hover-wind", *GRID, "--seeds", "3", "--jobs", "2"]
        self.journal = folder / sweep.JOURNAL_FILE
        with log.open("wb") as file:
            self.process = subprocess.Popen([*command, "--output", str(folder)], stdout=file, stderr=file)

    def until(self, rows: int) -> None:
        end_s = time.monotonic() + 120.0
        while self.rows() < rows:
            assert self.process.poll() is None, "it ended"
            assert time.monotonic() < end_s, "it does not fly"
            time.sleep(0.02)

    def rows(self) -> int:
        return self.journal.read_bytes().count(b"\n") if self.journal.exists() else 0

    def children(self) -> list[int]:
        file = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        return [int(pid) for pid in file.read_text().split()]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="looks for the workers in /proc")
def test_a_killed_sweep_goes_on_where_it_was(tmp_path: Path, parquet: Any) -> None:
    """SIGKILL in the middle: no row is lost or doubled, no worker stays, and the end is that of a sweep not killed."""
    folder = tmp_path / "swept"
    killed = Sweeping(folder, tmp_path / "killed.txt")
    try:
        killed.until(3)
        orphans = killed.children()
        assert len(orphans) >= 2
    finally:
        killed.process.kill()
        killed.process.wait()
    kept = killed.rows()
    assert 3 <= kept < 12
    assert not (folder / sweep.RESULTS_FILE).exists()
    end_s = time.monotonic() + 30.0
    while any(map(alive, orphans)):
        assert time.monotonic() < end_s, "workers outlive their sweep"
        time.sleep(0.02)
    again = Sweeping(folder, tmp_path / "again.txt")
    assert again.process.wait(timeout=240.0) == 0, (tmp_path / "again.txt").read_text()
    assert f"{kept} of 12 were flown before" in " ".join((tmp_path / "again.txt").read_text().split())
    assert again.rows() == 12
    rows = parquet.read_table(folder / sweep.RESULTS_FILE).to_pylist()
    assert len({r["key"] for r in rows}) == 12
    plan = sweep.plan("hover-wind", [GRID[1], GRID[3]], [GRID[5]], "3")
    for index in (0, 11):
        flown = measured(fly.fly(plan.cases[index]))
        assert {name: values[0] for name, values in columns([flown], plan.grid.keys).items()} == rows[index] | {
            "cpu_s": 0.0
        }


@pytest.mark.skipif(os.name != "posix", reason="by a signal")
def test_ctrl_c_says_how_to_go_on(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    sweeping = Sweeping(tmp_path / "swept", log)
    try:
        sweeping.until(1)
        sweeping.process.send_signal(signal.SIGINT)
        assert sweeping.process.wait(timeout=60.0) == EXIT_SIGNAL + signal.SIGINT
    finally:
        sweeping.process.kill()
        sweeping.process.wait()
    said = " ".join(log.read_text().split())
    assert "of 12 are in" in said
    assert "the same command goes on with the rest" in said
    assert "Traceback" not in said


def test_columns_of_mixed_labels_are_json() -> None:
    rows = [row(1, 0.1, gain=1, law="pid", odd=1), row(2, None, "lost", gain=2.5, law="pidnn", odd="x")]
    table = columns(rows, ["gain", "law", "odd"])
    assert (table["gain"], table["law"], table["odd"]) == ([1.0, 2.5], ["pid", "pidnn"], ["1", '"x"'])
    assert table["rmse_position_m"] == [0.1, None]


def test_a_page_of_every_kind_of_sweep_is_drawn() -> None:
    """One cell, no seed that both flew, many cells, and markup in a label."""
    facts = dict.fromkeys(
        (
            "command",
            "version",
            "created_utc",
            "scenario",
            "scenario_digest",
            "settings",
            "seeds",
            "code",
            "scenario_toml",
        ),
        "?",
    )
    alone = [row(1, 0.1)]
    unpaired = [row(1, 0.1, law="pid"), row(1, None, "lost", law="<b>")]
    curves = [row(seed, 0.1 * gain * seed, gain=gain, law=law) for gain in (1, 2, 3) for law in "ab" for seed in (1, 2)]
    many = [row(seed, 0.1, gain=gain) for gain in range(61) for seed in (1, 2)]
    figures = []
    for rows, keys, compared in (
        (alone, [], []), (unpaired, ["law"], ["law"]), (curves, ["gain", "law"], ["law"]), (many, ["gain"], []),
        (curves, ["gain", "law"], ["gain", "law"]),
    ):  # fmt: skip
        html = page.render(rows, summarize(rows, keys, compared), keys, facts)
        figures.append(html.count("<figure"))
        assert "<b>" not in html
    assert figures == [2, 2, 6, 2, 10]
