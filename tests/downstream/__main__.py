"""What a user of mavsitl's wheel does, in clean environments with a network: ``python -m tests.downstream``.

The sample project by the commands of docs/examples/github-actions.yml, and the one of the tutorial on tests in CI by
that page's own. The compiled kernels begin cold for each, as on a new machine; pip has its cache. Prints each step with
its seconds, and ends with exit code 1 where one fails. Everything is gone when it ends, unless `--keep` names a folder.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

from ruamel.yaml import YAML

from tests.docs import blocks
from tests.downstream import steps
from tests.downstream.steps import ROOT, Environment, StepError, run

TUTORIAL = "docs/tutorials/test-in-ci.md"
EXAMPLE = "docs/examples/github-actions.yml"
WORKERS = 2


class Table:
    """Steps as they are done."""

    def __init__(self) -> None:
        self.failed = False

    def __call__(self, what: str, step: Callable[[], Any]) -> Any:
        """Carry a step out; the line says what it gives, where that is a text."""
        print(f"{what:56s}", end="", flush=True)
        begun = perf_counter()
        try:
            given = step()
        except StepError as error:
            self.failed = True
            print(f"{perf_counter() - begun:8.1f} s  FAILED\n{error}", flush=True)
            raise
        print(f"{perf_counter() - begun:8.1f} s  {given if isinstance(given, str) else ''}".rstrip(), flush=True)
        return given


def workflow(text: str) -> dict[str, dict[str, str]]:
    """The commands of a workflow's jobs, by their steps' names, or else by themselves."""
    jobs: dict[str, Any] = YAML(typ="safe").load(text)["jobs"]
    return {
        job: {step.get("name", step["run"]): step["run"] for step in content["steps"] if "run" in step}
        for job, content in jobs.items()
    }


def shell(script: str, environment: Environment, folder: Path, home: Path, *, apart: bool = False, **more: Any) -> str:
    """As GitHub's runner has it: `bash -e`, with the environment active and `home` for what is kept between runs.

    `apart`: with PX4's ports free, in a network namespace.
    """
    words = ["bash", "-e", "-o", "pipefail", "-c", f"ip link set lo up\n{script}" if apart else script]
    variables = environment.variables(
        PIP_CONSTRAINT=str(steps.CONSTRAINTS), PYTEST_XDIST_AUTO_NUM_WORKERS=str(WORKERS),
        XDG_CACHE_HOME=str(home / "cache"), XDG_DATA_HOME=str(home / "data"), PIP_CACHE_DIR=pip_cache(), **more,
    )  # fmt: skip
    return run(["unshare", "--net", *words] if apart else words, folder, variables)


def quiet(*arguments: Any, **more: Any) -> None:
    """What an installation prints does not go into the table."""
    shell(*arguments, **more)


def pip_cache() -> str:
    return run([sys.executable, "-m", "pip", "cache", "dir"], ROOT).strip().splitlines()[-1]


def sample(table: Table, wheel: Path, folder: Path) -> None:
    """The sample project is the repository that the example is the workflow of."""
    jobs = workflow((ROOT / EXAMPLE).read_text("utf-8"))
    named = {"MAVSITL": f"mavsitl @ {wheel.as_uri()}"}
    environment: Environment = table("a clean environment", lambda: Environment.create(folder / "venv"))
    project = steps.copy_project(folder)
    tests, program = jobs["pytest"], jobs["program"]
    table(tests["Install"], lambda: quiet(tests["Install"], environment, project, folder, **named))

    def probe() -> str:
        found = environment.probe()
        if "wind-hold" not in set(found["controllers"]) - set(found["shipped"]):
            raise StepError(f"wind-hold is not among the controllers: {found['controllers']}")
        count = sum(name.endswith(".toml") for name in found["scenarios"])
        return f"{count} scenarios, all of it from the wheel"

    def fly() -> str:
        return f"{steps.passes(shell(tests['Fly'], environment, project, folder), project)} passed"

    table("what it has is the wheel's", probe)
    table(f"{tests['Fly']}  (cold kernels)", fly)
    table(f"{tests['Fly']}  (warm)", fly)
    table("pytest tests/meant_to_fail.py", lambda: f"its logs: {steps.meant_to_fail(environment, project)}")

    def beside_a_vehicle() -> str:
        if shutil.which("unshare") is None or os.geteuid() != 0:
            return "NOT DONE: needs root, for a network of its own in which PX4's ports are free"
        said = shell(program["Fly"], environment, project, folder, apart=True)
        if "and landed" not in said:
            raise StepError(f"the program has not landed:\n{said}")
        return said.strip().splitlines()[-1]

    table("mavsitl vehicle & python examples/takeoff_and_land.py", beside_a_vehicle)


def tutorial(table: Table, wheel: Path, folder: Path) -> None:
    """The repository of the page: its files, its other tests each in a file of its own, and its workflow's commands."""
    environment: Environment = table("the tutorial's environment", lambda: Environment.create(folder / "venv"))
    project = folder / "my-controller"
    project.mkdir()
    script = {}
    for block in blocks.of_page(TUTORIAL):
        if "file" in block.marks:
            (project / block.marks["file"]).write_text(block.text, "utf-8")
        elif block.language == "python":
            (project / f"test_line_{block.line}.py").write_text(block.text, "utf-8")
        elif block.language == "yaml":
            [script] = workflow(block.text).values()
    install, fly = script.values()
    # The page's `mavsitl` is this wheel: pip takes what is there.
    with_ours = f"pip install -q '{wheel}' mavsdk"
    table(
        f"{install}  (with this wheel, and mavsdk)",
        lambda: quiet(f"{with_ours}\n{install}", environment, project, folder),
    )
    table("what it has is the wheel's", environment.probe)

    def tests() -> str:
        return f"{steps.passes(shell(fly, environment, project, folder), project)} passed"

    table(f"{fly}  (the page's tests, cold kernels)", tests)


@contextmanager
def place(keep: Path | None) -> Iterator[Path]:
    if keep is not None:
        keep.mkdir(parents=True)
        yield keep.resolve()
        return
    with tempfile.TemporaryDirectory(prefix="mavsitl-downstream-") as folder:
        yield Path(folder).resolve()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.downstream", description=__doc__)
    parser.add_argument("--keep", type=Path, metavar="DIR", help="a new folder, which is left")
    parser.add_argument("--only", choices=("sample", "tutorial"), help="one of the two projects")
    options = parser.parse_args()
    table = Table()
    begun = perf_counter()
    with place(options.keep) as folder:
        if folder.is_relative_to(ROOT):
            parser.error(f"--keep: {folder} is in the tree, which its tests are not to see")
        try:
            [wheel] = table("pip wheel .", lambda: steps.build(folder / "wheels", ROOT, isolated=True))
            table("what is in the wheel", lambda: f"{steps.check_wheel(wheel)} files, as in the tree")
            for name, journey in (("sample", sample), ("tutorial", tutorial)):
                if options.only in (None, name):
                    (folder / name).mkdir()
                    journey(table, wheel, folder / name)
        except StepError:
            print("a step failed")
    print(f"{'all':56s}{perf_counter() - begun:8.1f} s")
    return 1 if table.failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
