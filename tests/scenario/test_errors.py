"""Bad scenario and airframe files: each refusal names the file, the key and what is allowed there."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl import scenario
from mavsitl.scenario import DrydenPaper, ScenarioError, Steps

LAW = "controller.law: 'lqr' is not allowed; allowed: 'pid', 'pidnn'"
MODELS = "'steady', 'gust', 'dryden-paper', 'dryden-mil'"
KINDS = "'hover', 'spiral', 'steps', 'figure-8', 'waypoints'"
STEP_AT = "{ time_s = %d, position_nwu_m = [0, 0, 1] }"

# TOML below a title, and the whole of the message after the file's name.
REFUSED = {
    "unknown key at the top": (
        "mass_kg = 1.0",
        "mass_kg: unknown key; allowed here: title, description, duration_s, seed,",
    ),
    "unknown key in a table": (
        "[rates]\nphysics = 1",
        "rates.physics: unknown key; did you mean physics_hz? allowed here: physics_hz, control_hz",
    ),
    "unknown key two tables down": (
        "[controller.learning]\nrates = 1",
        "controller.learning.rates: unknown key; did you mean rate? allowed here: rate, projection,",
    ),
    "unknown key in an array of tables": (
        '[[wind]]\nmodel = "dryden-paper"\n[[wind]]\nmodel = "steady"\nvelocity_nwu_m_s = [1, 0, 0]\nspeed = 1',
        "wind[1].speed: unknown key; allowed here: model, velocity_nwu_m_s",
    ),
    "unknown key in a step": (
        '[reference]\nkind = "steps"\nsteps = [{ time_s = 0, position_nwu_m = [0, 0, 1], heading = 1 }]',
        "reference.steps[0].heading: unknown key; allowed here: time_s, position_nwu_m, yaw_deg",
    ),
    "unit of another key": (
        "[noise]\nattitude_rad = 0.1",
        "noise.attitude_rad: unknown key; did you mean attitude_deg? allowed here: position_m, velocity_m_s",
    ),
    "key of another reference": (
        '[reference]\nkind = "hover"\nradius_m = 1',
        "reference.radius_m: unknown key; allowed here: kind, position_nwu_m, yaw_deg",
    ),
    "text for a number": ('duration_s = "60"', "duration_s: '60' is not allowed; allowed: number > 0"),
    "boolean for a number": ("duration_s = true", "duration_s: true is not allowed; allowed: number > 0"),
    "date for a number": ("duration_s = 2026-01-01", "duration_s: 2026-01-01 is not allowed; allowed: number > 0"),
    "number for a boolean": ("ground_contact = 1", "ground_contact: 1 is not allowed; allowed: true, false"),
    "number for text": ("airframe = 3", "airframe: 3 is not allowed; allowed: text"),
    "fraction for a whole number": ("seed = 1.5", "seed: 1.5 is not allowed; allowed: whole number >= 0"),
    "negative seed": ("seed = -1", "seed: -1 is not allowed; allowed: whole number >= 0"),
    "value for a table": ("rates = 250", "rates: 250 is not allowed; allowed: table of physics_hz, control_hz"),
    "table for a value": ("[duration_s]\nvalue = 1", "duration_s: a table is not allowed; allowed: number > 0"),
    "table for an array of tables": (
        '[wind]\nmodel = "dryden-paper"',
        f"wind: a table is not allowed; allowed: array: table with model = {MODELS}",
    ),
    "text in an array of tables": (
        'wind = ["dryden-paper"]',
        f"wind[0]: 'dryden-paper' is not allowed; allowed: table with model = {MODELS}",
    ),
    "two coordinates": (
        "[start]\nposition_nwu_m = [0, 0]",
        "start.position_nwu_m: an array of 2 is not allowed; allowed: array of 3: number",
    ),
    "four coordinates in a step": (
        '[reference]\nkind = "steps"\nsteps = [{ time_s = 0, position_nwu_m = [0, 0, 1, 0] }]',
        "reference.steps[0].position_nwu_m: an array of 4 is not allowed; allowed: array of 3: number",
    ),
    "text in an array": (
        '[start]\nposition_nwu_m = [0, "one", 0]',
        "start.position_nwu_m[1]: 'one' is not allowed; allowed: number",
    ),
    "one value for a pair": (
        "[controller.learning]\nprojection = 0.5",
        "controller.learning.projection: 0.5 is not allowed; allowed: array of 2: number >= 0 and <= 1, number >= 1",
    ),
    "pair out of bounds": (
        "[controller.learning]\nprojection = [0.5, 0.9]",
        "controller.learning.projection[1]: 0.9 is not allowed; allowed: number >= 1",
    ),
    "no steps": (
        '[reference]\nkind = "steps"\nsteps = []',
        "reference.steps: an array of 0 is not allowed; allowed: array of at least 1: table of time_s,",
    ),
    "nan": ("[noise]\nposition_m = nan", "noise.position_m: nan is not allowed; allowed: number >= 0"),
    "infinite duration": ("duration_s = inf", "duration_s: inf is not allowed; allowed: number > 0"),
    "nan in an array": (
        "[start]\nposition_nwu_m = [0, nan, 0]",
        "start.position_nwu_m[1]: nan is not allowed; allowed: number",
    ),
    "nan parameter": ("[parameters]\nMC_ROLL_P = nan", "parameters.MC_ROLL_P: nan is not allowed; allowed: number"),
    "text parameter": ('[parameters]\nMC_ROLL_P = "6"', "parameters.MC_ROLL_P: '6' is not allowed; allowed: number"),
    "too large for a float": (
        f"duration_s = 1{'0' * 400}",
        "duration_s: a whole number of more than 40 digits is not allowed; allowed: number > 0",
    ),
    "unknown wind model": ('[[wind]]\nmodel = "karman"', f"wind[0].model: 'karman' is not allowed; allowed: {MODELS}"),
    "no wind model": ("[[wind]]\naltitude_m = 1", f"wind[0].model: missing; allowed: {MODELS}"),
    "wind model of another type": (
        "[[wind]]\nmodel = []",
        f"wind[0].model: an array of 0 is not allowed; allowed: {MODELS}",
    ),
    "unknown reference": ('[reference]\nkind = "loop"', f"reference.kind: 'loop' is not allowed; allowed: {KINDS}"),
    "missing wind key": (
        '[[wind]]\nmodel = "dryden-mil"\naltitude_m = 6',
        "wind[0].speed_20ft_m_s: missing; allowed: number >= 0",
    ),
    "above the model's range": (
        '[[wind]]\nmodel = "dryden-mil"\nspeed_20ft_m_s = 5\naltitude_m = 400',
        "wind[0].altitude_m: 400 is not allowed; allowed: number > 0 and <= 304.8",
    ),
    "unknown law": ('[controller]\nlaw = "lqr"', LAW),
    "law of another type": ("[controller]\nlaw = 1", "controller.law: 1 is not allowed; allowed: 'pid', 'pidnn'"),
    "unknown level": (
        '[controller]\nlevel = "velocity"',
        "controller.level: 'velocity' is not allowed; allowed: 'attitude', 'body_rate', 'torque'",
    ),
    "missing gain": (
        "[controller.yaw]\nk_p_per_s2 = 1\nk_i_per_s3 = 1",
        "controller.yaw.k_d_per_s: missing; allowed: number >= 0",
    ),
    "long text": (
        f'[controller]\nlaw = "{"x" * 999}"',
        f"controller.law: '{'x' * 40}...' is not allowed; allowed: 'pid', 'pidnn'",
    ),
    "rates that do not divide": (
        "[rates]\nphysics_hz = 1000\ncontrol_hz = 400",
        "rates.physics_hz: 1000 is not a multiple of rates.control_hz (400)",
    ),
    "cycle between milliseconds": (
        "[rates]\nphysics_hz = 1200\ncontrol_hz = 400",
        "rates.control_hz: one cycle of 400 Hz is not a whole number of milliseconds; allowed: 10, 20, 25, 40, 50,",
    ),
    "step between microseconds": (
        "[rates]\nphysics_hz = 15000\ncontrol_hz = 250",
        "rates.physics_hz: one step of 15000 Hz is not a whole number of microseconds",
    ),
    "rate below its range": (
        "[rates]\ncontrol_hz = 1",
        "rates.control_hz: 1 is not allowed; allowed: whole number >= 10 and <= 1000",
    ),
    "inner loop at the wrong level": (
        '[controller]\ninner = "pidnn"',
        "controller.inner: 'pidnn' needs controller.level 'attitude', not 'body_rate'",
    ),
    "unknown key of a link": (
        "[link.to_ground]\nlatency_s = 0.1",
        "link.to_ground.latency_s: unknown key; did you mean latency_ms? allowed here: latency_ms, jitter_ms,",
    ),
    "unknown direction of a link": (
        "[link.up]\nlatency_ms = 1",
        "link.up: unknown key; allowed here: to_ground, to_vehicle",
    ),
    "loss in percent": (
        "[link.to_vehicle]\nloss = 20",
        "link.to_vehicle.loss: 20 is not allowed; allowed: number >= 0 and <= 1",
    ),
    "latency beyond its range": (
        "[link.to_vehicle]\nlatency_ms = 20000",
        "link.to_vehicle.latency_ms: 20000 is not allowed; allowed: number >= 0 and <= 10000",
    ),
    "queue shorter than a message": (
        "[link.to_vehicle]\nqueue_bytes = 100",
        "link.to_vehicle.queue_bytes: 100 is not allowed; allowed: whole number >= 280 and <= 1e+06",
    ),
    "unknown distribution": (
        '[link.to_ground]\ndistribution = "pareto"',
        "link.to_ground.distribution: 'pareto' is not allowed; allowed: 'gamma', 'normal', 'uniform'",
    ),
    "uniform delays before the sending": (
        '[link.to_ground]\ndistribution = "uniform"\nlatency_ms = 5\njitter_ms = 10',
        "link.to_ground.jitter_ms: 10 is not allowed; allowed: at most latency_ms (5) with distribution 'uniform'",
    ),
    "gamma without a mean": (
        '[link.to_ground]\ndistribution = "gamma"\njitter_ms = 10',
        "link.to_ground.latency_ms: 0 is not allowed; allowed: > 0 with distribution 'gamma' and jitter",
    ),
    "outage without an end": (
        "[link.to_ground]\noutages = [{ start_s = 1 }]",
        "link.to_ground.outages[0].duration_s: missing; allowed: number > 0",
    ),
    "steps out of order": (
        f'[reference]\nkind = "steps"\nsteps = [{STEP_AT % 2}, {STEP_AT % 1}]',
        "reference.steps: time_s must increase from step to step",
    ),
}


@pytest.mark.parametrize(("body", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_refused_with_file_key_and_what_is_allowed(tmp_path: Path, body: str, message: str) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(f'title = "mine"\n{body}\n', "utf-8")
    with pytest.raises(ScenarioError) as refusal:
        scenario.load(str(file))
    assert str(refusal.value).startswith(f"{file}: {message}")


def test_a_title_is_required(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("", "utf-8")
    with pytest.raises(ScenarioError) as refusal:
        scenario.load(str(file))
    assert str(refusal.value) == f"{file}: title: missing; allowed: text"


AIRFRAME_REFUSED = {
    "negative mass": ("mass_kg = 0.723", "mass_kg = -0.723", "mass_kg: -0.723 is not allowed; allowed: number > 0"),
    "no mass": ("mass_kg = 0.723", "", "mass_kg: missing; allowed: number > 0"),
    "mass in grams": (
        "mass_kg = 0.723",
        "mass_g = 723",
        "mass_g: unknown key; did you mean mass_kg? allowed here: title, mass_kg, arm_m,",
    ),
    "a moment of inertia of nan": (
        "[8.678e-3, 8.678e-3,",
        "[8.678e-3, nan,",
        "inertia_kg_m2[1]: nan is not allowed; allowed: number > 0",
    ),
    "two moments of inertia": (
        "[8.678e-3, 8.678e-3,",
        "[8.678e-3,",
        "inertia_kg_m2: an array of 2 is not allowed; allowed: array of 3: number > 0",
    ),
    "too weak to fly": (
        "thrust_to_weight = 2.0",
        "thrust_to_weight = 1.0",
        "thrust_to_weight: 1.0 is not allowed; allowed: number > 1",
    ),
}


@pytest.mark.parametrize(("text", "instead", "message"), AIRFRAME_REFUSED.values(), ids=AIRFRAME_REFUSED.keys())
def test_airframe_refused(tmp_path: Path, text: str, instead: str, message: str) -> None:
    paper = (resources.files("mavsitl") / "airframes" / "paper.toml").read_text("utf-8")
    assert text in paper
    (tmp_path / "bad.toml").write_text(paper.replace(text, instead), "utf-8")
    (tmp_path / "mine.toml").write_text('title = "mine"\nairframe = "bad.toml"\n', "utf-8")
    with pytest.raises(ScenarioError) as refusal:
        scenario.load(str(tmp_path / "mine.toml"))
    assert str(refusal.value).startswith(f"{tmp_path / 'bad.toml'}: {message}")


def test_unknown_scenario_name_lists_the_shipped_ones() -> None:
    with pytest.raises(
        ScenarioError, match=r"^hoover: no such shipped file .* shipped scenarios: .*hover-calm, .*spiral-wind"
    ):
        scenario.load("hoover")


def test_unknown_airframe_name_lists_the_shipped_ones() -> None:
    with pytest.raises(ScenarioError, match=r"^brick: no such shipped file .* shipped airframes: .*paper, realistic"):
        scenario.load("hover-calm", {"airframe": "brick"})


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    file = tmp_path / "none.toml"
    with pytest.raises(ScenarioError) as refusal:
        scenario.load(str(file))
    assert str(refusal.value).startswith(f"{file}: no such file; ")


def test_a_folder_is_not_a_file(tmp_path: Path) -> None:
    file = tmp_path / "folder.toml"
    file.mkdir()
    with pytest.raises(ScenarioError) as refusal:
        scenario.load(str(file))
    assert str(refusal.value).startswith(f"{file}: cannot be read: ")


def test_a_file_that_is_not_utf_8(tmp_path: Path) -> None:
    file = tmp_path / "latin.toml"
    file.write_bytes('title = "Böe"'.encode("latin-1"))
    with pytest.raises(ScenarioError) as refusal:
        scenario.load(str(file))
    assert str(refusal.value).startswith(f"{file}: not UTF-8 text, ")


@pytest.mark.parametrize("text", ["title = ", "title: mine", '{"title": "mine"}', 'title = "a"\ntitle = "b"', "\0"])
def test_a_file_that_is_not_toml(tmp_path: Path, text: str) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(text, "utf-8")
    with pytest.raises(ScenarioError) as refusal:
        scenario.load(str(file))
    assert str(refusal.value).startswith(f"{file}: not valid TOML: ")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("controller.law", "lqr", LAW),
        ("controller.lawn", "pid", "controller.lawn: unknown key; did you mean law? allowed here: law, level,"),
        ("title.size", 1, "title.size: 'title' is not a table, so it has no key to set"),
        ("duration_s", float("nan"), "duration_s: nan is not allowed; allowed: number > 0"),
        ("start[0].clamp", True, "start[0].clamp: 'start' is no array, so it has no element 0"),
        ("start[x].clamp", True, "start[x].clamp: 'start[x]' is no part of a key; allowed: NAME or NAME[0]"),
    ],
)
def test_overrides_are_held_to_the_same_rules(key: str, value: object, message: str) -> None:
    with pytest.raises(ScenarioError) as refusal:
        scenario.load("hover-calm", {key: value})
    assert str(refusal.value).startswith(f"hover-calm (shipped): {message}")


def test_overrides_reach_into_arrays_of_tables(tmp_path: Path) -> None:
    """By the index, as messages have it, or without where there is one alone."""
    one = scenario.load("hover-wind", {"wind.speed_20ft_m_s": 3.0})
    assert one.scenario.wind == scenario.load("hover-wind", {"wind[0].speed_20ft_m_s": 3.0}).scenario.wind
    assert one.scenario.wind == (DrydenPaper(speed_20ft_m_s=3.0),)
    steps = scenario.load("steps-calm", {"reference.steps[1].yaw_deg": 12.0}).scenario.reference
    assert isinstance(steps, Steps)
    assert [step.yaw_deg == 12.0 for step in steps.steps].index(True) == 1
    text = 'title = "Calm"\nwind = []\n'
    (tmp_path / "calm.toml").write_text(text)
    for name, key, message in (
        ("steps-calm", "reference.steps.yaw_deg", "'reference.steps' has 6 element(s); allowed: reference.steps[0],"),
        ("hover-wind", "wind[1].altitude_m", "'wind' has 1 element(s); allowed: wind[0]"),
        (str(tmp_path / "calm.toml"), "wind.altitude_m", "'wind' is empty, so it has no element to set"),
    ):
        with pytest.raises(ScenarioError) as refusal:
            scenario.load(name, {key: 1.0})
        assert f": {key}: {message}" in str(refusal.value)


KEYS = [
    "title",
    "seed",
    "rates",
    "physics_hz",
    "start",
    "position_nwu_m",
    "wind",
    "model",
    "reference",
    "kind",
    "steps",
]
KEYS += ["link", "to_ground", "latency_ms", "jitter_ms", "distribution", "bursts", "outages"]
KEYS += ["parameters", "controller", "law", "learning", "projection", "altitude", "yaw", "k_p_per_s2", "duration_s"]
leaves = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.sampled_from(["hover", "steps", "steady", "dryden-mil", "pid", ""])
)
values = st.recursive(
    leaves, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(KEYS), inner, max_size=4)
)


@given(st.dictionaries(st.sampled_from(KEYS), values, max_size=6))
def test_whatever_the_file_holds_it_loads_or_is_refused(overrides: dict[str, object]) -> None:
    try:
        flight = scenario.load("hover-calm", overrides)
    except ScenarioError as refusal:
        message = str(refusal)
        assert message.startswith("hover-calm (shipped): ")
        assert "Expected" not in message, "the checker let through what only msgspec noticed"
    else:
        assert flight.scenario.duration_s > 0.0
