"""Whole tunings of short flights: what is written, repeated, interrupted and lost."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mavsitl import cli, scenario
from mavsitl.campaign import workers
from mavsitl.campaign.fly import Row, fly
from mavsitl.campaign.grid import Case, case
from mavsitl.campaign.store import Journal
from mavsitl.report.metrics import PAPER_TABLES
from mavsitl.report.tune import render
from mavsitl.tune import flights, result, run
from mavsitl.tune.objective import TuneError, growth, six

KEYS = ("controller.position.k_p_per_s2=2:40", "controller.learning.rate=1:100:log")
SHORT: dict[str, Any] = {"duration_s": 1.0}
ARGUMENTS = (
    "tune", "hover-wind", "spiral-calm", "--duration", "1", "--search-duration", "0.5", "--seeds", "1001,",
    "--held-out", "2", "--evaluations", "4", "--jobs", "1", *(part for key in KEYS for part in ("--tune", key)),
)  # fmt: skip


@pytest.fixture(autouse=True)
def _handlers() -> Iterator[None]:
    """The command sets signal handlers of its own."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def plan(**changes: Any) -> run.Plan:
    usual: dict[str, Any] = {
        "names": ("hover-wind",), "settings": SHORT, "asked": KEYS, "evaluations": 4, "seeds": (1001,),
        "held_out": (1, 2),
    }  # fmt: skip
    return run.Plan(**(usual | changes))


def direct(cases: Sequence[Case]) -> Iterator[Row]:
    return workers.fly_all(cases, workers.local(1))


def carried_out(plan: run.Plan) -> run.Tuning:
    tuning = run.begin(plan)
    run.carry_out(tuning, direct, lambda trial: None)
    return tuning


def test_the_command_leaves_scenarios_that_fly_with_what_was_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([*ARGUMENTS, "--output", str(tmp_path / "run")]) == 0
    said = capsys.readouterr().out
    record = json.loads((tmp_path / "run" / "tune.json").read_text("utf-8"))
    values = record["trials"][record["chosen"]]["values"]
    for name in ("hover-wind", "spiral-calm"):
        file = tmp_path / "run" / f"{name}.toml"
        assert str(file) in said.replace("\n", "")
        flight = scenario.load(str(file))
        assert flight.scenario.controller.position.k_p_per_s2 == values[0]
        assert flight.scenario.controller.learning.rate == (values[1],) * 3
        assert flight.scenario.wind == scenario.load(name).scenario.wind
        assert fly(case(flight, 1)).flown
        text = file.read_text("utf-8")
        assert "held out: 1, 2: error" in text
        assert f"k_p_per_s2 = {values[0]!r}  # " in text
    page = (tmp_path / "run" / "report.html").read_text("utf-8")
    assert page.count("<svg") == 2
    assert "controller.learning.rate" in page
    rows = (tmp_path / "run" / "rows.jsonl").read_text("utf-8").splitlines()
    candidates, judged = 4, 1 if record["chosen"] == 0 else 2
    assert len(record["trials"]) == candidates
    assert json.loads(rows[0])["labels"] == {"controller.position.k_p_per_s2": 11.56, "controller.learning.rate": 13.4}
    assert len(rows) == 2 * (candidates + 1) + 2 * 2 * judged  # and the start's whole flights, to measure by


def test_the_same_command_gives_the_same_and_goes_on_after_a_kill(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    monkeypatch.setattr("sys.argv", ["mavsitl", *ARGUMENTS])
    assert cli.main([*ARGUMENTS, "--output", str(one)]) == 0
    rows = (one / "rows.jsonl").read_bytes().splitlines(keepends=True)
    other.mkdir()
    (other / "rows.jsonl").write_bytes(b"".join(rows[:5]) + rows[5][:40])
    assert cli.main([*ARGUMENTS, "--output", str(other)]) == 0
    for name in ("tune.json", "report.html", "hover-wind.toml", "spiral-calm.toml"):
        assert (one / name).read_bytes() == (other / name).read_bytes()
    again = (other / "rows.jsonl").read_bytes().splitlines(keepends=True)
    assert again[:5] == rows[:5]
    assert len(again) == len(rows)


def test_a_flight_that_is_kept_is_not_flown_again(tmp_path: Path) -> None:
    tuning = run.begin(plan())
    with Journal(tmp_path / "rows.jsonl") as journal:
        run.carry_out(tuning, flights.kept(journal, workers.local(1)), lambda trial: None)
    told: list[None] = []

    class Nobody(workers.Here):
        def map(self, function: Any, items: Any, lost: Any = None) -> Iterator[Any]:
            assert not list(items)
            yield from ()

    again = run.begin(plan())
    with Journal(tmp_path / "rows.jsonl") as journal:
        run.carry_out(again, flights.kept(journal, Nobody(), lambda: told.append(None)), lambda trial: None)
    assert again == tuning
    assert len(told) == run.flights_of(tuning)
    assert len(told) == 4 + 2 * 2


def test_ctrl_c_gives_the_best_so_far(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    real, flown = workers.fly_all, []

    def interrupted(cases: Sequence[Case], crew: workers.Workers) -> Iterator[Row]:
        for row in real(cases, crew):
            flown.append(row)
            if len(flown) == 7:
                raise KeyboardInterrupt
            yield row

    monkeypatch.setattr(flights, "fly_all", interrupted)
    assert cli.main([*ARGUMENTS, "--output", str(tmp_path)]) == 130
    said = capsys.readouterr().err
    assert f"the same command goes on from {tmp_path}" in said
    assert f"the best so far: {tmp_path / 'report.html'}" in said
    record = json.loads((tmp_path / "tune.json").read_text("utf-8"))
    assert [each["number"] for each in record["trials"]] == [0, 1]
    assert record["held_out"] is None
    assert "the gains are the best so far" in (tmp_path / "hover-wind.toml").read_text("utf-8")
    assert scenario.load(str(tmp_path / "hover-wind.toml")).scenario.duration_s == 1.0
    assert "flatter what was found" in (tmp_path / "report.html").read_text("utf-8")


def test_a_start_that_is_lost_is_said_and_left_behind(tmp_path: Path) -> None:
    """The default gains on rotors with a lag are unstable; less of them is not."""
    settings = {"airframe": "realistic", "duration_s": 15.0, "controller.roll_pitch.k_p_per_s2": 6000.0}
    asked = ("controller.roll_pitch.k_p_per_s2=200:6000", "controller.roll_pitch.k_d_per_s=20:200")
    tuning = carried_out(plan(settings=settings, asked=asked, evaluations=8, held_out=(1,)))
    assert tuning.start.score.lost == 1
    assert tuning.start.score.message.startswith("hover-wind, seed 1001: ")
    assert tuning.best.score.lost == 0
    assert tuning.judged is not None
    assert (tuning.judged.before.lost, tuning.judged.after.lost) == (1, 0)
    assert "1 flights were lost before, and 0 after" in result.verdict(tuning)
    assert "lost a flight and are not shown" in render(tuning, "x")


def test_where_everything_is_lost_there_is_a_page_all_the_same(tmp_path: Path) -> None:
    settings = {"offnominal.rotor_thrust_scale": [0.0, 1.0, 1.0, 1.0], "duration_s": 10.0}
    tuning = carried_out(plan(settings=settings, evaluations=2, held_out=(1,)))
    assert tuning.best.number == 0
    assert "Nothing better than the start was found" in result.verdict(tuning)
    assert "2 lost a flight" in render(tuning, "x")
    assert len(result.write(tuning, tmp_path, "x")) == 2


def test_held_out_flights_are_whole_and_on_seeds_that_were_not_searched() -> None:
    tuning = run.begin(plan(search_duration_s=0.5, seeds=(1001, 1002), held_out=(1, 2, 3)))
    seen: list[Case] = []

    def fly_all(cases: Sequence[Case]) -> Iterator[Row]:
        seen.extend(cases)
        return direct(cases)

    run.carry_out(tuning, fly_all, lambda trial: None)
    assert {(each.seed, each.flight.scenario.duration_s) for each in seen} == {
        *((seed, length) for seed in (1001, 1002) for length in (0.5, 1.0)),  # the start's whole flight is the measure
        *((seed, 1.0) for seed in (1, 2, 3)),
    }


def test_a_part_of_a_flight_is_measured_as_the_whole_would_be() -> None:
    """The spiral begins a metre beside its path, which weighs more in a shorter flight."""
    whole = carried_out(plan(names=("spiral-calm",), settings={"duration_s": 4.0}, evaluations=1))
    part = carried_out(plan(names=("spiral-calm",), settings={"duration_s": 4.0}, evaluations=1, search_duration_s=2.0))
    assert part.start.score.rmse[0][1] > 1.3 * whole.start.score.rmse[0][1]
    assert part.start.score.error == pytest.approx(whole.start.score.error)


def test_against_the_start_each_number_is_measured_by_what_the_first_gains_have() -> None:
    """So their error is 1 in the search, at whatever length, and about 1 on other seeds."""
    tuning = carried_out(plan(against="start", search_duration_s=0.5, held_out=(1, 2)))
    assert tuning.start.score.error == pytest.approx(1.0)
    assert tuning.judged is not None
    assert tuning.judged.before.error == pytest.approx(1.0, abs=0.5)
    other = max(tuning.trials[1:], key=lambda trial: trial.score.error).score
    ratios = np.array(other.rmse) / np.array(tuning.start.score.rmse)
    assert other.error == pytest.approx(np.mean(ratios**4) ** 0.25)


def test_what_makes_a_number_worse_than_allowed_is_not_chosen() -> None:
    """The softer, the less the rotors have to do and the further it is from its path."""
    asked = ("controller.position.k_p_per_s2=2:40", "controller.wind_observer.horizontal_rad_s=1:20")
    settings = {"duration_s": 4.0}
    free, bound = (
        carried_out(
            plan(settings=settings, asked=asked, against="start", effort_weight=5.0, evaluations=12, no_worse=f)
        )
        for f in (None, 1.05)
    )
    assert growth(free.best.score.rmse, free.start.score.rmse).max() > 1.05
    assert growth(bound.best.score.rmse, bound.start.score.rmse).max() <= 1.05
    assert not bound.allowed(free.best)
    assert bound.best.score.objective(5.0) > free.best.score.objective(5.0)
    assert "not allowed" in render(bound, "x")
    assert "not allowed" not in render(free, "x")


def test_no_number_of_the_papers_that_the_start_reaches_is_allowed_to_be_missed() -> None:
    """In the paper's scenarios; where the start misses it, and elsewhere, it is the start alone that counts."""
    paper = PAPER_TABLES["hover-wind"].values()
    shares = (0.9, 1.0, 1.1, 0.5, 0.8, 2.0)
    start = six(np.multiply(paper, shares))
    both = plan(names=("hover-wind", "hover-gust"), settings={}, no_worse=1.5)
    of_paper, of_another = run._limits(both, (start, start), (paper, paper))
    assert np.divide(of_paper, paper) == pytest.approx([1.0, 1.0, 1.65, 0.75, 1.0, 3.0])
    assert np.divide(of_another, paper) == pytest.approx(1.5 * np.array(shares))
    assert run._limits(plan(), (start,), (paper,)) == ()


@pytest.mark.parametrize("asked", [{"against": "start"}, {"no_worse": 1.1}])
def test_nothing_is_compared_with_a_start_that_is_lost(asked: dict[str, Any]) -> None:
    settings = {"offnominal.rotor_thrust_scale": [0.0, 1.0, 1.0, 1.0], "duration_s": 10.0}
    with pytest.raises(TuneError, match=r"the gains to begin with lose a flight.*: hover-wind, seed 1001: "):
        carried_out(plan(settings=settings, evaluations=2, held_out=(1,), **asked))


def test_a_file_of_ones_own_keeps_its_airframe_and_waypoints(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    airframe = (Path(scenario.__file__).parent / "airframes" / "paper.toml").read_text("utf-8")
    (tmp_path / "mine" / "frame.toml").write_text(airframe, "utf-8")
    (tmp_path / "mine" / "way.csv").write_text("x,y,z,yaw,hold\n0,0,1,0,1\n1,0,1,0,1\n", "utf-8")
    file = tmp_path / "mine" / "own.toml"
    file.write_text(
        'title = "Own"\nduration_s = 1.0\nairframe = "frame.toml"\nground_contact = false\n[start]\nclamp = true\n'
        'position_nwu_m = [0.0, 0.0, 1.0]\n[reference]\nkind = "waypoints"\nfile = "way.csv"\n',
        "utf-8",
    )
    tuning = carried_out(plan(names=(str(file),), settings={}, evaluations=2, held_out=(1,)))
    result.write(tuning, tmp_path / "out", "mavsitl tune own.toml")
    written = scenario.load(str(tmp_path / "out" / "own.toml"))
    assert written.airframe == scenario.load(str(file)).airframe
    assert fly(case(written, 1)).flown


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--tune", "controller.position.kp=1:2"), "controller.position has no 'kp'"),
        (("--evaluations", "0"), "'0' is not allowed"),
        (("--no-worse", "0.9"), "'0.9' is not allowed; allowed: a finite number, 1 or more"),
        (("--against", "me"), "--against: 'me' is not allowed; allowed: paper, start"),
        (("--seeds", "7-9", "--held-out", "9"), "seed 7 is in both"),
        (("--set", "controller.law=lqr"), "controller.law: 'lqr' is not allowed"),
    ],
)
def test_wrong_arguments_end_it_before_anything_flies(
    arguments: tuple[str, ...], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = cli.main(["tune", "hover-wind", *arguments, "--output", str(tmp_path / "run")])
    except SystemExit as end:
        code = int(end.code or 0)
    assert code == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
