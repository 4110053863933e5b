"""What a tuning found: rows for terminal and page, and its files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec

import mavsitl
from mavsitl.keep import replace_file, replace_json
from mavsitl.report.metrics import LABELS, UNITS, paper_case
from mavsitl.report.sweep_tables import bounds
from mavsitl.report.tables import number
from mavsitl.scenario import Flight, Waypoints, load
from mavsitl.tune import toml
from mavsitl.tune.objective import Score, growth, scale
from mavsitl.tune.paired import Paired
from mavsitl.tune.run import Tuning
from mavsitl.tune.space import ITEM

JSON_FILE = "tune.json"

WORST_STATE = "worst RMSE, after / before"
"""Of all scenarios and states the largest ratio."""


@dataclass(frozen=True)
class Measure:
    """A line of the judgement."""

    name: str
    seeds: str
    """E.g. ``searched: 1001 to 1003``."""
    before: float
    after: float
    paired: Paired | None
    """On the held-out seeds."""


@dataclass(frozen=True)
class Gain:
    """What became of a dial."""

    key: str
    before: float
    after: float
    low: float
    high: float

    @property
    def at_bound(self) -> bool:
        """Within a hundredth of its range's end: a wider range might be better."""
        return self.after <= self.low * 1.01 or self.after >= self.high * 0.99


@dataclass(frozen=True)
class State:
    """The RMSE of one state in one scenario."""

    scenario: str
    state: str
    """E.g. ``x / m``."""
    before: float
    after: float
    scale: float
    """What it is divided by for the error."""
    paper: bool
    """Whether that is the paper's number."""


def span(seeds: tuple[int, ...]) -> str:
    """E.g. ``1 to 20``."""
    if len(seeds) > 2 and seeds == tuple(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds))


def measures(tuning: Tuning) -> Iterator[Measure]:
    searched = f"searched: {span(tuning.plan.seeds)}"
    start, best = tuning.start.score, tuning.best.score
    yield Measure("error", searched, start.error, best.error, None)
    yield Measure("effort / (rad/s)", searched, start.effort, best.effort, None)
    yield Measure(WORST_STATE, searched, 1.0, float(growth(best.rmse, start.rmse).max()), None)
    judged = tuning.judged
    if judged is not None:
        held_out = f"held out: {span(tuning.plan.held_out)}"
        yield Measure("error", held_out, judged.before.error, judged.after.error, judged.error)
        yield Measure("effort / (rad/s)", held_out, judged.before.effort, judged.after.effort, judged.effort)
        yield Measure(WORST_STATE, held_out, 1.0, float(growth(judged.after.rmse, judged.before.rmse).max()), None)


def gains(tuning: Tuning) -> list[Gain]:
    values = zip(tuning.space.dials, tuning.start.values, tuning.best.values, strict=True)
    return [Gain(dial.key, before, after, dial.low, dial.high) for dial, before, after in values]


def states(tuning: Tuning) -> list[State]:
    """On the held-out seeds, or on the search's where it came to no judgement."""
    before, after = _scores(tuning)
    rows = []
    for index, name in enumerate(tuning.plan.names):
        scenario = load(name, tuning.plan.settings).scenario
        for i, (label, unit, divisor) in enumerate(zip(LABELS, UNITS, scale(scenario), strict=True)):
            rows.append(
                State(
                    titles(tuning)[index],
                    f"{label} / {unit}",
                    before.rmse[index][i],
                    after.rmse[index][i],
                    divisor,
                    paper_case(scenario) is not None,
                )
            )
    return rows


def _scores(tuning: Tuning) -> tuple[Score, Score]:
    if tuning.judged is None:
        return tuning.start.score, tuning.best.score
    return tuning.judged.before, tuning.judged.after


def titles(tuning: Tuning) -> list[str]:
    """A name for each scenario, of which no two are the same."""
    plain = [load(name, tuning.plan.settings).name for name in tuning.plan.names]
    return [f"{name}-{index}" if plain.count(name) > 1 else name for index, name in enumerate(plain, start=1)]


def verdict(tuning: Tuning) -> str:
    """One sentence."""
    judged = tuning.judged
    if judged is None:
        return "Interrupted before it was judged on held-out seeds: the gains are the best so far."
    if tuning.best.number == 0:
        return f"Nothing better than the start was found in {len(tuning.trials)} evaluations."
    if judged.after.lost or judged.before.lost:
        return f"On the held-out seeds {judged.before.lost} flights were lost before, and {judged.after.lost} after."
    change = f"error x {bounds(judged.error.ratio)}, effort x {bounds(judged.effort.ratio)}"
    return f"Held-out seeds {span(tuning.plan.held_out)}, medians with 95 % intervals: {change}."


def write(tuning: Tuning, folder: Path, command: str) -> list[Path]:
    """Scenarios with the gains found, a file each, and `tune.json` with everything; their paths. Raises `OSError`."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, title in zip(tuning.plan.names, titles(tuning), strict=True):
        paths.append(folder / f"{title}.toml")
        replace_file(paths[-1], scenario_text(tuning, name, folder, command).encode())
    paths.append(folder / JSON_FILE)
    record = {
        "version": mavsitl.__version__, "command": command, "plan": tuning.plan, "dials": tuning.space.dials,
        "limits": tuning.limits, "trials": tuning.trials, "chosen": tuning.best.number, "held_out": tuning.judged,
    }  # fmt: skip
    replace_json(paths[-1], record)
    return paths


def scenario_text(tuning: Tuning, name: str, folder: Path, command: str) -> str:
    """A TOML file that flies what was chosen, and says where its gains are from."""
    plan = tuning.plan
    flight = load(name, plan.settings | tuning.space.overrides(tuning.best.values))
    head = [f"Gains by mavsitl {mavsitl.__version__}:", f"  {command}", verdict(tuning)]
    head += [
        f"{each.seeds}: {each.name} {number(each.before)} before, {number(each.after)} after"
        for each in measures(tuning)
    ]
    notes: dict[str, list[str]] = {}
    for gain in gains(tuning):
        item = ITEM.fullmatch(gain.key)
        place = f"[{item['index']}] " if item else ""
        text = f"{place}was {gain.before:g}" if gain.after != gain.before else f"{place}as it was"
        notes.setdefault(item["key"] if item else gain.key, []).append(text)
    remarks = {key: ", ".join(texts) for key, texts in notes.items()}
    return toml.write(_from(flight, name, folder).scenario, head="\n".join(head), notes=remarks)


def _from(flight: Flight, name: str, folder: Path) -> Flight:
    """With its paths as they are seen from `folder`."""
    scenario = flight.scenario
    if scenario.airframe.endswith(".toml"):
        airframe = os.path.relpath(Path(name).parent / scenario.airframe, folder)
        scenario = msgspec.structs.replace(scenario, airframe=airframe)
    if isinstance(scenario.reference, Waypoints):
        file = os.path.relpath(scenario.reference.file, folder)
        scenario = msgspec.structs.replace(scenario, reference=msgspec.structs.replace(scenario.reference, file=file))
    return msgspec.structs.replace(flight, scenario=scenario)
