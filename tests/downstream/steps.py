"""A clean environment that has mavsitl from its wheel, and what is looked at in it. POSIX only."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import venv
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PROJECT = Path(__file__).with_name("project")
CONSTRAINTS = ROOT / "constraints.txt"

PACKAGES = {"mavsitl": ROOT / "mavsitl"} | {
    f"mavsitl_{wing}": ROOT / wing / f"mavsitl_{wing}" for wing in ("vehicle", "ground")
}
"""Where each has its files in the tree."""

PROBE = """
import importlib, importlib.metadata, importlib.resources, json, sys
from mavsitl import controllers, scenario
from mavsitl.testing import plugin
names = sorted(each.name for each in importlib.resources.files("mavsitl").joinpath("scenarios").iterdir())
for name in names:
    if name.endswith(".toml"):
        scenario.load(name.removesuffix(".toml"))
print(json.dumps({
    "files": {name: importlib.import_module(name).__file__ for name in sys.argv[1:]},
    "plugin": plugin.__file__,
    "scenarios": names,
    "controllers": sorted(controllers.installed()),
    "shipped": sorted(controllers.shipped()),
}))
"""
"""Run in an environment: where it has what, and that every shipped scenario can be loaded, with its airframe."""


PATIENCE_S = 600.0
"""For one command, on a machine that is busy; an installation downloads."""


class StepError(AssertionError):
    """A command of a step failed, or what it left is not what it should be."""


def clean(**more: str) -> dict[str, str]:
    """Our variables without those by which a Python would find this tree, or this run of pytest."""
    gone = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "PYTEST_ADDOPTS", "PYTEST_PLUGINS", "PYTEST_CURRENT_TEST")
    kept = {
        name: value
        for name, value in os.environ.items()
        if name not in gone and not name.startswith(("PYTEST_XDIST", "COV_"))
    }
    return kept | {"PYTHONNOUSERSITE": "1", "PIP_DISABLE_PIP_VERSION_CHECK": "1"} | more


def run(words: Sequence[str | Path], folder: Path, env: dict[str, str] | None = None, code: int = 0) -> str:
    """What a command prints, on both of its outputs. Raises `StepError` where it ends with another exit code.

    What it has left running, and what runs for longer than `PATIENCE_S`, is ended with all that it started.
    """
    shown = " ".join(str(word) for word in words)
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            [str(word) for word in words], cwd=folder, env=clean() if env is None else env, start_new_session=True,
            stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            ended = f"exit code {process.wait(PATIENCE_S)}"
        except subprocess.TimeoutExpired:
            ended = f"not at its end after {PATIENCE_S:g} s"
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        output.seek(0)
        said = output.read().decode("utf-8", "replace")
    if ended != f"exit code {code}":
        raise StepError(f"{shown}\n{said}{ended}; {code} was expected")
    return said


def build(into: Path, *sources: Path, isolated: bool) -> list[Path]:
    """A wheel of each. Not `isolated`: with the build backend of this environment, and without a network."""
    options = () if isolated else ("--no-build-isolation", "--no-index")
    run([sys.executable, "-m", "pip", "wheel", "-q", *options, "--no-deps", "-w", into, *sources], into.parent)
    found = sorted(into.glob("*.whl"))
    if len(found) != len(sources):
        raise StepError(f"{len(sources)} wheels were to be built; there are {[path.name for path in found]}")
    return found


def check_wheel(wheel: Path) -> int:
    """It has every file of the three packages and nothing beside them; how many that are."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    info = {name for name in names if name.partition("/")[0].endswith(".dist-info")}
    wanted = {
        f"{package}/{path.relative_to(folder).as_posix()}"
        for package, folder in PACKAGES.items()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    if missing := sorted(wanted - names):
        raise StepError(f"{wheel.name} lacks {', '.join(missing)}")
    if more := sorted(names - info - wanted):
        raise StepError(f"{wheel.name} has more than the packages: {', '.join(more)}")
    for licence in ("LICENSE", "LICENSE-three", "LICENSE-uplot"):
        if not any(name.lower().endswith(f"/{licence.lower()}") for name in info):
            raise StepError(f"{wheel.name} has no {licence}; it has {', '.join(sorted(info))}")
    return len(wanted)


@dataclass(frozen=True)
class Environment:
    """A virtual environment, in which nobody installs but the methods of this."""

    folder: Path

    @classmethod
    def create(cls, folder: Path, *, pip: bool = True) -> Environment:
        venv.create(folder, with_pip=pip, symlinks=True)
        return cls(folder)

    @property
    def scripts(self) -> Path:
        return self.folder / "bin"

    @property
    def python(self) -> Path:
        return self.scripts / "python"

    @property
    def packages(self) -> Path:
        scheme = {"base": str(self.folder), "platbase": str(self.folder)}
        return Path(sysconfig.get_path("purelib", "venv", scheme))

    def variables(self, **more: str) -> dict[str, str]:
        """As after `activate`."""
        return clean(
            VIRTUAL_ENV=str(self.folder), PATH=f"{self.scripts}{os.pathsep}{os.environ.get('PATH', '')}", **more
        )

    def install_offline(self, *wheels: Path) -> None:
        """By the pip of this environment, with nothing that they need: `see_dependencies` lends that."""
        pip: list[str | Path] = [sys.executable, "-m", "pip", "--python", self.python]
        run([*pip, "install", "-q", "--no-deps", "--no-index", *wheels], self.folder)

    def see_dependencies(self) -> None:
        """All that the running environment has, behind its own.

        The folders are plain lines of a .pth file: Python does not read the .pth files that are in them, and by those
        an editable install is found. So mavsitl's tree stays out of sight.
        """
        folders = dict.fromkeys(sysconfig.get_path(name) for name in ("purelib", "platlib"))
        (self.packages / "dependencies.pth").write_text("".join(f"{folder}\n" for folder in folders), "utf-8")

    def probe(self) -> dict[str, Any]:
        """`PROBE`'s answer. Raises `StepError` where something of mavsitl's is not this environment's own."""
        said = run([self.python, "-c", PROBE, *PACKAGES], self.folder)
        found: dict[str, Any] = json.loads(said)
        for file in (*found["files"].values(), found["plugin"]):
            if not Path(file).is_relative_to(self.packages):
                raise StepError(f"{file} is not of {self.packages}")
        own = {path.name for path in (PACKAGES["mavsitl"] / "scenarios").iterdir()} - {"__pycache__"}
        if set(found["scenarios"]) - {"__pycache__"} != own:
            raise StepError(f"scenarios: {found['scenarios']}, in the tree {sorted(own)}")
        return found


def copy_project(into: Path) -> Path:
    """The sample project without what its tests have left in it."""
    target = into / "wind-hold"
    shutil.copytree(PROJECT, target, ignore=shutil.ignore_patterns("__pycache__", ".mavsitl-logs", ".pytest_cache"))
    return target


def passes(said: str, project: Path) -> int:
    """What pytest said of the sample's tests, and what they left; how many passed. Raises `StepError`."""
    outcome = re.search(r"=+ (\d+) passed in ", said)
    if outcome is None or "warnings summary" in said or "Warning" in said:
        raise StepError(f"more than passed tests:\n{said}")
    left = [path for path in (project / ".mavsitl-logs").rglob("*") if path.name != ".gitignore"]
    if left:
        raise StepError(f"tests that passed left {', '.join(map(str, left))}")
    return int(outcome[1])


def meant_to_fail(environment: Environment, project: Path) -> str:
    """The sample's test that fails: its message, and its logs. Raises `StepError` where one of them does not help."""
    said = run([environment.python, "-m", "pytest", "tests/meant_to_fail.py"], project, environment.variables(), code=1)
    folder = ".mavsitl-logs/tests.meant_to_fail.test_it_stays_without_a_rotor/flight"
    for wanted in (
        "FlightAssertionError: roof (seed 1): stays within 0.5 m of its reference",
        "faults      motor 3 off: from 2.00 s on",
        "Failure injected: motor 3 off",
        f"mavsitl log info {folder}/vehicle.ulg",
        "meant_to_fail.py:10: FlightAssertionError",
        "= mavsitl logs =",
    ):
        if wanted not in said:
            raise StepError(f"{wanted!r} is not in what the failed test says:\n{said}")
    told = run([environment.scripts / "mavsitl", "log", "info", f"{folder}/vehicle.ulg"], project)
    if "vehicle_attitude" not in told:
        raise StepError(f"mavsitl log info shows no vehicle_attitude:\n{told}")
    return folder
