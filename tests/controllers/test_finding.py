"""A controller is found by file, module or entry point, and whatever is wrong with it is said before it flies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mavsitl import controllers
from mavsitl.controllers import ControllerError
from mavsitl.scenario import ScenarioError, load

GOOD = """\
from mavsitl.controllers import AttitudeDemand


class Mine:
    def __init__(self, airframe, period_s, seed, gain=3.0):
        self.asked = airframe.mass_kg, period_s, seed, gain

    def update(self, time_s, state, reference):
        return AttitudeDemand((1, 0, 0, 0), 7.0)
"""


def made(name: str, **overrides: Any) -> Any:
    return controllers.make(load("hover-calm", {**controllers.settings(name), **overrides}))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(GOOD)
    return path


def test_by_file_and_what_it_asks_for(file: Path) -> None:
    assert made(f"{file}:Mine", seed=7).asked == (0.723, 0.004, 7, 3.0)


def test_a_relative_file_is_meant_from_here_and_in_a_scenario_from_there(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(file.parent)
    assert controllers.settings("mine.py:Mine") == {"controller.own": f"{file}:Mine"}
    (file.parent / "mine.toml").write_text('title = "mine"\n[controller]\nown = "mine.py:Mine"\n')
    monkeypatch.chdir(Path("/"))
    assert load(str(file.parent / "mine.toml")).scenario.controller.own == f"{file}:Mine"


def test_by_module() -> None:
    assert type(made("mavsitl_ground.stock:Stock")).__name__ == "Stock"


def test_by_entry_point() -> None:
    assert set(controllers.shipped()) == {"pidnn", "pid", "stock", "geometric", "indi"}
    for name in set(controllers.shipped()) - set(controllers.PAPER):
        assert callable(made(name).update)


def test_the_papers_own_have_their_place_in_the_scenario() -> None:
    assert controllers.settings("pid") == {"controller.law": "pid", "controller.own": ""}


def test_a_changed_file_is_loaded_anew(file: Path) -> None:
    made(f"{file}:Mine")
    file.write_text(GOOD.replace("gain=3.0", "gain=4.0"))
    assert made(f"{file}:Mine").asked[3] == 4.0


WRONG = {
    "no update": ("class Mine: pass", r"Mine has no method update\(time_s, state, reference\)"),
    "too few arguments": ("class Mine:\n def update(self, state): pass", r"update\(state\) cannot be called as"),
    "no such name": ("class Other:\n def update(self, t, s, r): pass", "no 'Mine' there; there: Other"),
    "unknown argument": (
        "class Mine:\n def __init__(self, mass): pass\n def update(self, t, s, r): pass",
        "asks for 'mass' at construction; allowed: airframe, period_s, seed",
    ),
    "no class": ("Mine = 3", "Mine is int '3'; needed: a class or a function"),
    "fails at construction": (
        "class Mine:\n def __init__(self): 1 / 0\n def update(self, t, s, r): pass",
        r"cannot be made: ZeroDivisionError: division by zero \(mine.py, line 2\)",
    ),
    "no Python": ("class Mine(", "cannot be loaded: SyntaxError"),
    "reset that asks": (
        "class Mine:\n def update(self, t, s, r): pass\n def reset(self, why): pass",
        r"reset\(why\) cannot be called as reset\(\)",
    ),
}


@pytest.mark.parametrize(("text", "said"), WRONG.values(), ids=WRONG.keys())
def test_what_is_wrong_is_said(file: Path, text: str, said: str) -> None:
    file.write_text(text)
    with pytest.raises(ControllerError, match=said):
        made(f"{file}:Mine")


def test_names_of_nothing(file: Path) -> None:
    with pytest.raises(ControllerError, match=r"no such file: no\.py"):
        controllers.settings("no.py:Mine")
    with pytest.raises(ControllerError, match=r"which controller of that file\? Needed: FILE.py:NAME; there: Mine"):
        controllers.settings(str(file))
    with pytest.raises(ControllerError, match="'other' is no controller; allowed: pidnn, pid, geometric"):
        controllers.settings("other")
    with pytest.raises(ControllerError, match="cannot be loaded: ModuleNotFoundError"):
        made("no_such_module_at_all:Mine")


def test_the_traceback_is_of_their_code_alone(file: Path) -> None:
    file.write_text("class Mine:\n def __init__(self): self.no()\n def update(self, t, s, r): pass")
    with pytest.raises(ControllerError) as failed:
        made(f"{file}:Mine")
    assert failed.value.trace.startswith(f'Traceback (most recent call last):\n  File "{file}", line 2, in __init__')
    assert "controllers.py" not in failed.value.trace


def test_settings_without_effect_are_refused(file: Path) -> None:
    with pytest.raises(ScenarioError, match=r"makes nothing of controller\.inner and controller\.wind_information"):
        made(f"{file}:Mine", **{"controller.wind_information": "oracle"})


def test_the_digest_is_of_the_file_and_what_it_imports_from_beside_it(file: Path) -> None:
    def digest() -> str:
        return controllers.source_digest(f"{file}:Mine")

    first = digest()
    (file.parent / "unused.py").write_text("x = 1")
    assert digest() == first
    file.write_text(f"import helper\nfrom package import part\n{GOOD}")
    second = digest()
    assert second != first
    (file.parent / "helper.py").write_text("x = 1")
    third = digest()
    assert third != second
    package = file.parent / "package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "part.py").write_text("from . import deeper")
    (package / "deeper.py").write_text("x = 1")
    fourth = digest()
    assert fourth != third
    (package / "deeper.py").write_text("x = 2")
    assert digest() != fourth
