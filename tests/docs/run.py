"""Does what a page says, block by block, in a folder of its own. The rules: docs/explanation/documentation.md."""

from __future__ import annotations

import argparse
import ast
import configparser
import importlib.util
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]  # MyST brings it, without types

from mavsitl import cli, scenario, testing
from mavsitl.cli.common import load, settings_of
from mavsitl.errors import MavsitlError, UsageError
from tests.docs.blocks import ROOT, Block
from tests.docs.shell import Command, commands, differs

SHORT: dict[str, tuple[str, ...]] = {
    "fly": ("--in-memory", "--no-report", "--duration", "1"),
    "sweep": ("--no-report", "--seeds", "2", "--jobs", "1", "--set", "duration_s=1"),
    "tune": ("--duration", "1", "--seeds", "1001-1001", "--held-out", "1", "--evaluations", "2", "--jobs", "1"),
    "scenarios": (),
    "chaos": (),
    "report": (),
    "log": (),
}
"""Commands that are carried out, each with what is put behind its own arguments: the last one counts."""

ASKING = ("link", "inject", "param")
"""Commands to a vehicle that runs; here it is one of the block's."""

READ_ONLY = ("vehicle", "ground")
"""They run until they are ended: their scenario is loaded with all that is set."""

PORTS = {"14540": "offboard_port", "14550": "gcs_port", "14580": "offboard_own", "18570": "gcs_own"}
"""PX4's ports in a block beside a vehicle, and where this vehicle has them."""

EXTRAS = ("mavsdk", "mavsdk_grpc", "pymavlink", "pyarrow", "distributed", "mcap", "pandas")
"""What a block may import that need not be installed; it is then left out, and its page's test is skipped."""

BASE = "hover-wind"
"""The scenario that a TOML block without a title is put over."""

PATIENCE_S = 120.0


class BlockError(AssertionError):
    """What the page says there is not so."""

    def __init__(self, block: Block, text: str, line: int = 0) -> None:
        super().__init__(f"{block.page}:{block.line + line}: {text}")


class PageRun:
    """One page's folder, namespace and last output; `missing` names extras that blocks would have needed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names: dict[str, Any] = {"__name__": "__main__"}
        self.printed = ""
        self.missing: list[str] = []

    def run(self, block: Block) -> None:
        """Raises `BlockError`."""
        if "not run" in block.marks:
            if not block.marks["not run"]:
                raise BlockError(block, "'not run:' without a reason")
            self.parse_only(block)
        elif "output" in block.marks:
            if difference := differs(block.text, self.printed):
                raise BlockError(block, f"the block before it prints something else\n{difference}")
        elif "file" in block.marks:
            self.write(block)
        elif block.language not in LANGUAGES:
            allowed = ", ".join(sorted(LANGUAGES))
            raise BlockError(block, f"nobody can run {block.language!r}; allowed: {allowed}, or a comment '% not run:'")
        else:
            LANGUAGES[block.language](self, block)

    def write(self, block: Block) -> None:
        path = self.folder / block.marks["file"]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(block.text, "utf-8")
        if path.suffix == ".toml" and path.name != "pyproject.toml":
            self.toml(block)

    # Data

    def toml(self, block: Block) -> None:
        """A whole scenario, or keys to be put over one."""
        try:
            data = tomllib.loads(block.text)
        except tomllib.TOMLDecodeError as error:
            raise BlockError(block, f"no TOML: {error}") from error
        try:
            if "mass_kg" in data:
                path = self.folder / f"block-{block.line}.toml"
                path.write_text(block.text, "utf-8")
                scenario.load_airframe(str(path))
            elif "title" in data and "fragment of" not in block.marks:
                path = self.folder / f"block-{block.line}.toml"
                path.write_text(block.text, "utf-8")
                scenario.load(str(path))
            else:
                scenario.load(block.marks.get("fragment of", BASE), data)
        except scenario.ScenarioError as error:
            raise BlockError(block, f"no scenario: {error}") from error

    def data(self, block: Block) -> None:
        readers: dict[str, Callable[[str], Any]] = {
            "json": json.loads,
            "yaml": yaml.safe_load,
            "ini": lambda text: configparser.ConfigParser().read_string(text),
        }
        try:
            readers[block.language](block.text)
        except (ValueError, yaml.YAMLError, configparser.Error) as error:
            raise BlockError(block, f"no {block.language}: {error}") from error

    # Python

    def python(self, block: Block) -> None:
        tree = ast.parse(block.text)
        missing = [name for name in imported(tree) if name in EXTRAS and importlib.util.find_spec(name) is None]
        if missing:
            self.missing += missing
        elif any(isinstance(node, ast.FunctionDef) and node.name.startswith("test_") for node in tree.body):
            path = self.folder / f"test_block_{block.line}.py"
            path.write_text(block.text, "utf-8")
            self.program(block, [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", path.name])
        elif "beside" in block.marks:
            with beside(block) as ports:
                self.program(block, [sys.executable, "-c", with_ports(block.text, ports)])
        elif any(isinstance(node, ast.If) and ast.unparse(node.test) == "__name__ == '__main__'" for node in tree.body):
            path = self.folder / f"program_{block.line}.py"
            path.write_text(block.text, "utf-8")
            self.program(block, [sys.executable, path.name])
        else:
            # Lines of the traceback are the page's.
            code = compile("\n" * block.line + block.text, str(ROOT / block.page), "exec")
            with self.printing():
                exec(code, self.names)

    # Shell

    def shell(self, block: Block) -> None:
        found = commands(block.text, block.language)
        with ExitStack() as vehicles:
            running: Mapping[str, int] = {}
            if "beside" in block.marks or any(is_asking(command) for command in found):
                running = vehicles.enter_context(beside(block))
            for command in found:
                self.command(block, command, running)

    def parse_only(self, block: Block) -> None:
        if block.language in ("sh", "console"):
            for command in commands(block.text, block.language):
                if command.program == "mavsitl":
                    parsed(block, command)

    def command(self, block: Block, command: Command, running: Mapping[str, int]) -> None:
        if command.program == "mavsitl":
            self.mavsitl(block, command, running)
        elif command.program in ("python", "python3") and command.arguments[:1] == ["-m"]:
            if importlib.util.find_spec(command.arguments[1]) is None:
                raise BlockError(block, f"there is no module {command.arguments[1]}", command.line)
        elif command.program in ("python", "python3") and command.arguments:
            self.program(block, [sys.executable, *command.arguments])
        elif command.program == "pytest":
            self.program(block, [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *command.arguments])
        elif command.program == "cp":
            source, target = command.arguments
            shutil.copy(ROOT / source if (ROOT / source).exists() else self.folder / source, self.folder / target)
        elif command.program != "sleep":
            raise BlockError(block, f"{command.words[0]}: not run here; say '% not run: REASON'", command.line)
        if command.shown and (difference := differs(command.shown, self.printed)):
            raise BlockError(block, f"prints something else\n{difference}", command.line)

    def mavsitl(self, block: Block, command: Command, running: Mapping[str, int]) -> None:
        options = parsed(block, command)
        self.printed = ""
        arguments = expanded(command.arguments, self.folder)
        name = getattr(options, "command", None)
        if command.environment or name is None or "--scheduler" in arguments:
            return
        if name in READ_ONLY:
            with self.in_folder():
                self.guarded(block, command, lambda: load(options.scenario, settings_of(options)))
        elif running and (name in ASKING or name == "check"):
            option = "--listen" if name == "check" else "--endpoint"
            port = running["18570"] if not getattr(options, "gcs", False) else running["14580"]
            address = f"udpout:127.0.0.1:{port}"
            self.execute(block, command, [*without(arguments, option, "--instance"), option, address])
        elif name in SHORT:
            self.execute(block, command, [*arguments, *SHORT[name]])

    def execute(self, block: Block, command: Command, arguments: Sequence[str]) -> None:
        with self.printing() as errors:
            code = self.guarded(block, command, lambda: cli.main(arguments))
        if code != int(block.marks.get("exit", "0")):
            text = f"mavsitl {' '.join(arguments)}: exit code {code}\n{self.printed}{errors.getvalue()}"
            raise BlockError(block, text, command.line)

    def guarded(self, block: Block, command: Command, call: Callable[[], Any]) -> Any:
        try:
            return call()
        except (MavsitlError, SystemExit) as error:
            raise BlockError(block, f"{' '.join(command.words)}: {error}", command.line) from error

    def program(self, block: Block, words: Sequence[str]) -> None:
        path = os.pathsep.join([str(ROOT), str(ROOT / "vehicle"), str(ROOT / "ground")])
        result = subprocess.run(
            words,
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([path, os.environ.get("PYTHONPATH", "")])},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            timeout=PATIENCE_S,
            check=False,
        )
        self.printed = result.stdout
        if result.returncode != int(block.marks.get("exit", "0")):
            raise BlockError(block, f"exit code {result.returncode}\n{result.stdout}{result.stderr}")

    @contextmanager
    def in_folder(self) -> Iterator[None]:
        before = Path.cwd()
        os.chdir(self.folder)
        try:
            yield
        finally:
            os.chdir(before)

    @contextmanager
    def printing(self) -> Iterator[io.StringIO]:
        """In the page's folder, with what is printed in `printed`; yields what is said on stderr."""
        numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
        handlers = {number: signal.getsignal(number) for number in numbers}
        out, errors = io.StringIO(), io.StringIO()
        try:
            with self.in_folder(), redirect_stdout(out), redirect_stderr(errors):
                yield errors
        finally:
            self.printed = out.getvalue()
            for number, handler in handlers.items():
                signal.signal(number, handler)


def parsed(block: Block, command: Command) -> argparse.Namespace:
    """What the command line's own parser makes of it."""
    if {"-h", "--help", "--version"} & set(command.arguments):
        return argparse.Namespace()
    errors = io.StringIO()
    try:
        with redirect_stderr(errors):
            return cli.build_parser().parse_args(without_redirection(command.arguments))
    except (UsageError, SystemExit) as error:
        said = errors.getvalue() or str(error)
        raise BlockError(block, f"{' '.join(command.words)}\n{said}", command.line) from error


def without_redirection(arguments: Sequence[str]) -> list[str]:
    return list(arguments[: arguments.index(">")] if ">" in arguments else arguments)


def is_asking(command: Command) -> bool:
    return command.program == "mavsitl" and command.arguments[:1] != [] and command.arguments[0] in ASKING


def expanded(arguments: Sequence[str], folder: Path) -> list[str]:
    """As a shell would: names with a star are those of the files that there are."""
    found = []
    for argument in without_redirection(arguments):
        matches = (
            sorted(path.relative_to(folder).as_posix() for path in folder.glob(argument)) if "/*" in argument else []
        )
        found += matches or [argument]
    return found


def without(arguments: Sequence[str], *options: str) -> list[str]:
    """Without these options and their values."""
    found: list[str] = []
    skip = False
    for argument in arguments:
        if not skip and argument not in options:
            found.append(argument)
        skip = argument in options
    return found


def imported(tree: ast.Module) -> Iterator[str]:
    """The packages that a program imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module.partition(".")[0]


@contextmanager
def beside(block: Block) -> Iterator[dict[str, int]]:
    """The vehicle of `beside: mavsitl vehicle [SCENARIO] [--speed X]`, on free ports: each by PX4's number."""
    words = block.marks.get("beside", "mavsitl vehicle").split()
    options = parsed(block, Command(0, [], words))
    with testing.vehicle(options.scenario, speed=options.speed or 1.0) as vehicle:
        yield {port: getattr(vehicle, name) for port, name in PORTS.items()}


def with_ports(program: str, ports: Mapping[str, int]) -> str:
    for port, own in ports.items():
        program = program.replace(port, str(own))
    return program


LANGUAGES: dict[str, Callable[[PageRun, Block], None]] = {
    "python": PageRun.python,
    "toml": PageRun.toml,
    "sh": PageRun.shell,
    "console": PageRun.shell,
    "json": PageRun.data,
    "yaml": PageRun.data,
    "ini": PageRun.data,
    "text": lambda run, block: None,
}
"""What is done with a block, by its language. `text` is for people: drawings, what other programs show."""
