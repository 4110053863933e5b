"""The sample project in an environment that has mavsitl from its wheel, without a network.

`python -m tests.downstream` does the same as a user would, with a network and a cold cache of kernels.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.downstream import steps

pytestmark = pytest.mark.skipif(
    find_spec("hatchling") is None or find_spec("pip") is None,
    reason="a wheel is built without a network by hatchling (the extra dev) and pip of this environment",
)

MAVSDK = find_spec("mavsdk") is not None


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Outside of the tree, or the tree could be found from where the tests run."""
    assert not tmp_path.is_relative_to(steps.ROOT)
    return tmp_path


def test_a_file_that_the_wheel_lacks_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    [wheel] = steps.build(folder / "wheels", steps.PROJECT, isolated=False)
    source = steps.PROJECT / "src" / "wind_hold"
    monkeypatch.setattr(steps, "PACKAGES", {"wind_hold": source, "more": steps.PROJECT / "scenarios"})
    with pytest.raises(steps.StepError, match=r"lacks more/roof\.toml$"):
        steps.check_wheel(wheel)


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ("== 1 failed, 10 passed in 3.00s ==", "more than passed tests"),
        (
            "PytestAssertRewriteWarning: Module already imported\n== 11 passed, 1 warning in 3.00s ==",
            "more than passed",
        ),
        ("== 11 passed in 3.00s ==", "tests that passed left"),
    ],
)
def test_what_is_no_clean_pass(folder: Path, said: str, why: str) -> None:
    (folder / ".mavsitl-logs" / "a-test").mkdir(parents=True)
    with pytest.raises(steps.StepError, match=why):
        steps.passes(said, folder)


def test_a_command_that_does_not_end_is_ended_with_what_it_started(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(steps, "PATIENCE_S", 0.2)
    with pytest.raises(steps.StepError, match=r"not at its end after 0\.2 s"):
        steps.run(["bash", "-c", "sleep 1000 & sleep 1000"], folder)


@pytest.mark.sockets
def test_a_project_of_a_users(folder: Path) -> None:
    wheels = steps.build(folder / "wheels", steps.ROOT, steps.PROJECT, isolated=False)
    assert steps.check_wheel(wheels[0]) > 200

    environment = steps.Environment.create(folder / "venv", pip=False)
    environment.install_offline(*wheels)
    environment.see_dependencies()
    found = environment.probe()
    assert "wind-hold" in found["controllers"]
    assert "wind-hold" not in found["shipped"]
    # The tree stays out of sight: neither its tests nor what an editable install would lead to.
    told = steps.run([environment.python, "-c", "import sys; print(sys.path); import tests.downstream"], folder, code=1)
    assert "No module named 'tests" in told
    assert str(steps.ROOT / "vehicle") not in told

    project = steps.copy_project(folder)
    without = () if MAVSDK else ("--ignore", "tests/test_survey.py")
    said = steps.run([environment.python, "-m", "pytest", "-n", "2", *without], project, environment.variables())
    assert steps.passes(said, project) >= 8
    assert steps.meant_to_fail(environment, project)
