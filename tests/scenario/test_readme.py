"""What README.md tells a newcomer to type is what CI runs and what the project has."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import pytest

from mavsitl import scenario
from tests import check

README = (check.ROOT / "README.md").read_text("utf-8")
CI = (check.ROOT / ".ci" / "run").read_text("utf-8")
CONSTRAINTS = [
    line for line in (check.ROOT / "constraints.txt").read_text("utf-8").splitlines() if not line.startswith("#")
]


def commands(readme: str) -> list[str]:
    """Each line of each sh block."""
    return [line for block in re.findall(r"^```sh\n(.*?)^```", readme, re.M | re.S) for line in block.splitlines()]


def test_ci_runs_the_readmes_test_command() -> None:
    from_readme = [line for line in commands(README) if "tests.check" in line and "venv" in line]
    from_ci = [line for line in CI.splitlines() if "tests.check" in line]
    assert len(from_readme) == 1
    assert from_readme == from_ci


def test_the_readmes_first_commands_install_with_the_pins_and_fly() -> None:
    fly, vehicle = (line for line in commands(README) if line.startswith("git clone"))
    assert "-c constraints.txt" in fly
    assert fly.endswith("mavsitl fly")
    assert vehicle == fly.removesuffix("fly") + "vehicle"


def test_the_readme_names_every_shipped_scenario_it_names_rightly() -> None:
    named = {
        word for line in commands(README) for word in re.findall(r"mavsitl (?:fly|vehicle|ground) ([a-z0-9-]+)", line)
    }
    assert named
    assert named <= set(scenario.names())


def test_the_readmes_links_lead_somewhere() -> None:
    links = [link for link in re.findall(r"\]\(([^)#]+)[^)]*\)", README) if "://" not in link]
    assert links
    assert [link for link in links if not (check.ROOT / link).exists()] == []


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_constraints_are_exact_versions_of_every_requirement() -> None:
    for line in CONSTRAINTS:
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+", line), line
    project = tomllib.loads((check.ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    required = [
        *project["dependencies"],
        *(line for extra in project["optional-dependencies"].values() for line in extra),
    ]
    pinned = {normal(line.partition("==")[0]) for line in CONSTRAINTS}
    pinned.add(project["name"])  # an extra may bring another of its own
    assert {normal(re.split(r"[<>=!~ \[]", line)[0]) for line in required} <= pinned


PASSES = check.Step("passes", ("-c", "print('unseen')"))
FAILS = check.Step("fails", ("-c", "print('the reason'); raise SystemExit(3)"), fix=("-c", ""))


def test_check_goes_on_after_a_failure_shows_its_output_and_fails(capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    assert check.main([], steps=(FAILS, PASSES)) == 1
    output = capfdbinary.readouterr().out.decode()
    assert "\nthe reason\n" in output
    assert "\nunseen\n" not in output
    assert re.search(r"^fails +FAILED \(3\) +\d+\.\d s\npasses +ok +\d+\.\d s$", output, re.M)


def test_check_passes_when_all_do_and_runs_only_what_is_asked(capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    assert check.main(["--only", "passes"], steps=(FAILS, PASSES)) == 0
    assert b"fails" not in capfdbinary.readouterr().out
    assert check.main(["--fix"], steps=(FAILS, PASSES)) == 0


def test_check_shows_what_a_live_step_prints(capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    live = check.Step("live", ("-c", "print('12 passed')"), live=True)
    assert check.main([], steps=(live,)) == 0
    assert b"12 passed\n" in capfdbinary.readouterr().out


def test_check_refuses_an_unknown_step() -> None:
    with pytest.raises(SystemExit):
        check.main(["--only", "nothing"])


def test_the_last_step_is_pytest_in_this_environment() -> None:
    assert check.STEPS[-1].command[:2] == ("-m", "pytest")
    assert check.STEPS[-1].live
    assert Path(sys.executable).parent == check.SCRIPTS
