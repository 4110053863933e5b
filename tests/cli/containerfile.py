"""Carry out the Containerfile without a container engine: ``python -m tests.cli.containerfile`` (Linux, as root).

Each stage is a copy-on-write view of this machine's own files (overlayfs, in memory), in which a fresh virtual
environment stands for the Python of the base image. The instructions are carried out in it one by one; then the
image's command is started in a network namespace of its own, asked by the image's health check, and ended by SIGTERM.
So it shows that the steps work, with what they install and as whom they run, and not that an engine builds an image.

Prints each step with its seconds, and ends with exit code 1 where one fails. Everything is gone when it ends.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "Containerfile"

PYTHON = "/opt/python-of-the-base-image"

WORDS = (
    "FROM", "WORKDIR", "COPY", "RUN", "ENV", "USER", "LABEL", "EXPOSE", "VOLUME", "HEALTHCHECK", "ENTRYPOINT", "CMD",
)  # fmt: skip

READY_S = 60.0


@dataclass(frozen=True)
class Instruction:
    word: str
    rest: str

    @property
    def arguments(self) -> list[str]:
        """Of the JSON form, or else of the words."""
        _, bracket, behind = self.rest.partition("[")
        arguments: list[str] = json.loads(bracket + behind) if bracket else shlex.split(self.rest)
        return arguments

    def option(self, name: str) -> str | None:
        begin = f"--{name}="
        return next((word[len(begin) :] for word in shlex.split(self.rest) if word.startswith(begin)), None)


def parse(text: str) -> list[Instruction]:
    """The instructions, each in one line. Raises `ValueError` for one that `Build` does not carry out."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    instructions = []
    for line in "\n".join(lines).replace("\\\n", " ").splitlines():
        word, _, rest = line.partition(" ")
        if word not in WORDS:
            raise ValueError(f"{word}: not known here")
        instructions.append(Instruction(word, " ".join(rest.split())))
    return instructions


def included(context: Path) -> list[str]:
    """What .dockerignore lets through, top level names."""
    lines = (context / ".dockerignore").read_text().splitlines()
    return [line[1:] for line in lines if line.startswith("!")]


@dataclass
class Stage:
    """A file system that instructions change, and what the next command in it finds."""

    root: Path
    user: str = "root"
    folder: str = "/"
    variables: dict[str, str] = field(default_factory=dict)

    def command(self, words: Sequence[str]) -> list[str]:
        home = "/root" if self.user == "root" else f"/home/{self.user}"
        path = f"{PYTHON}/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
        variables = {"PATH": path, "HOME": home, **self.variables}
        return [
            "chroot", f"--userspec={self.user}:{self.user}", "--groups=", str(self.root),
            "env", "-i", "-C", self.folder, *(f"{name}={value}" for name, value in variables.items()), *words,
        ]  # fmt: skip

    def run(self, *words: str) -> None:
        done = subprocess.run(
            self.command(words), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
        )
        if done.returncode:
            raise SystemExit(f"{shlex.join(words)}\n{done.stdout}exit code {done.returncode}")

    def path(self, inside: str) -> Path:
        return self.root / f"{Path(self.folder) / inside}".lstrip("/")


class Build:
    """`stages` by name, the last one is the image; `last` has of each word its last instruction."""

    def __init__(self, space: Path) -> None:
        self._space = space
        self.stages: dict[str, Stage] = {}
        self.last: dict[str, Instruction] = {}
        self.stage = Stage(space)

    def carry_out(self, instruction: Instruction) -> None:
        self.last[instruction.word] = instruction
        arguments = [word for word in instruction.arguments if not word.startswith("--")]
        match instruction.word:
            case "FROM":
                self._begin(arguments[2] if len(arguments) == 3 else "image")
                self.last = {}
            case "WORKDIR":
                self.stage.folder = arguments[0]
                self.stage.path(".").mkdir(parents=True, exist_ok=True)
            case "COPY":
                self._copy(arguments, instruction.option("from"))
            case "RUN":
                self.stage.run("sh", "-c", instruction.rest)
            case "ENV":
                self.stage.variables |= dict(word.split("=", 1) for word in arguments)
            case "USER":
                self.stage.user = arguments[0]

    def _begin(self, name: str) -> None:
        """This machine's files, and a Python that has nothing installed; all users may look for it below /root."""
        folder = self._space / name
        for each in ("root", "upper", "work"):
            (folder / each).mkdir(parents=True)
        layers = f"lowerdir=/,upperdir={folder / 'upper'},workdir={folder / 'work'}"
        root = folder / "root"
        mount("overlay", root, "-o", layers)
        mount("proc", root / "proc")
        mount("tmpfs", root / "dev")  # not this machine's own
        for device, minor in (("null", 3), ("zero", 5), ("random", 8), ("urandom", 9)):
            os.mknod(root / "dev" / device, 0o666 | stat.S_IFCHR, os.makedev(1, minor))
            (root / "dev" / device).chmod(0o666)
        (root / "dev" / "shm").mkdir(mode=0o1777)
        (root / "root").chmod(0o711)
        self.stage = self.stages[name] = Stage(root)
        self.stage.run(os.path.realpath(sys.executable), "-m", "venv", PYTHON)

    def _copy(self, arguments: Sequence[str], stage: str | None) -> None:
        *sources, target = arguments
        into = self.stage.path(target)
        for source in sources:
            if stage is None and source.split("/")[0] not in included(ROOT):
                raise SystemExit(f"COPY {source}: .dockerignore keeps it out")
            origin = ROOT / source if stage is None else self.stages[stage].path(source)
            if origin.is_dir():
                shutil.copytree(origin, into, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
            else:
                shutil.copy(origin, into / origin.name if into.is_dir() else into)

    def try_out(self) -> None:
        """The image's command until its health check is content, and then its end. Nothing but loopback."""
        command = self.stage.command([*self.last["ENTRYPOINT"].arguments, *self.last["CMD"].arguments])
        begun = perf_counter()
        inside = ["unshare", "--net", "sh", "-c", 'ip link set lo up; exec "$@"', "sh", *command]
        with subprocess.Popen(inside, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
            try:
                asked = self.stage.command(self.last["HEALTHCHECK"].arguments)
                while subprocess.run(
                    ["nsenter", f"--net=/proc/{process.pid}/ns/net", *asked], stdout=subprocess.DEVNULL, check=False
                ).returncode:
                    if perf_counter() - begun > READY_S or process.poll() is not None:
                        raise SystemExit("the health check does not pass")
                print(f"healthy after {perf_counter() - begun:.1f} s")
            finally:
                process.send_signal(signal.SIGTERM)
                said, _ = process.communicate(timeout=30.0)
            print(said, end="")
        if process.returncode:
            raise SystemExit(f"ended by SIGTERM with exit code {process.returncode}")
        for name in ("vehicle.ulg", "link.tlog"):
            log = self.stage.path(f"/logs/{name}")
            if not log.stat().st_size or log.stat().st_uid == 0:
                raise SystemExit(f"{log}: empty, or written by root")


def mount(kind: str, where: Path, *options: str) -> None:
    subprocess.run(["mount", "-t", kind, *options, kind, str(where)], check=True)


def build(space: Path) -> None:
    """In a mount namespace that ends with the process, so that nothing has to be taken down."""
    mount("tmpfs", space)
    work = Build(space)
    instructions = parse(FILE.read_text())
    for number, instruction in enumerate(instructions, 1):
        print(f"[{number}/{len(instructions)}] {instruction.word} {instruction.rest}"[:110], flush=True)
        begun = perf_counter()
        work.carry_out(instruction)
        print(f"        {perf_counter() - begun:.1f} s", flush=True)
    work.try_out()
    print("all steps done")


def main() -> None:
    if len(sys.argv) > 1:
        build(Path(sys.argv[1]))
        return
    space = tempfile.mkdtemp()
    program = [sys.executable, "-m", "tests.cli.containerfile", space]
    code = subprocess.run(
        ["unshare", "--mount", "--propagation", "private", *program], cwd=ROOT, check=False
    ).returncode
    Path(space).rmdir()  # empty: what was mounted there is gone; never a recursive removal here
    raise SystemExit(code)


if __name__ == "__main__":
    main()
