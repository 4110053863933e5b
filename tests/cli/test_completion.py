"""`mavsitl completion`, asked by the shells themselves."""

from __future__ import annotations

import json
import os
import pty
import select
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mavsitl import cli, scenario

BASH = """\
eval "$(mavsitl completion bash)"
COMP_LINE={line!r}
COMP_POINT=${{#COMP_LINE}}
COMP_WORDS=($COMP_LINE)
COMP_TYPE=9
_python_argcomplete mavsitl
printf '%s\\n' "${{COMPREPLY[@]}}"
"""

ZSH = """\
PS1=READY PS2= RPS1=
autoload -Uz compinit && compinit -u -D
eval "$(mavsitl completion zsh)"
"""


def shell(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed")
    return found


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """With the `mavsitl` of this interpreter's environment, and without the user's own settings of a shell."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return os.environ | {"PATH": path, "HOME": str(tmp_path), "TERM": "dumb"}


def in_bash(line: str, environment: dict[str, str]) -> list[str]:
    done = subprocess.run(
        [shell("bash"), "--norc", "-c", BASH.format(line=line)],
        env=environment, stdout=subprocess.PIPE, text=True, timeout=60.0, check=True,
    )  # fmt: skip
    return [each.strip() for each in done.stdout.splitlines()]


def test_bash_completes_commands_options_and_names(environment: dict[str, str], tmp_path: Path) -> None:
    def of(line: str) -> list[str]:
        return in_bash(line, environment)

    assert of("mavsitl scen") == ["scenarios"]
    assert of("mavsitl fly --wind") == ["--wind-information"]
    assert of("mavsitl fly --level ") == ["attitude", "body_rate", "torque"]
    assert of("mavsitl fly hover-c") == ["hover-calm"]
    assert of("mavsitl tune spiral-calm hover-c") == ["hover-calm"]
    assert of("mavsitl vehicle --airframe re") == ["realistic"]
    assert of("mavsitl vehicle --chaos ack-first") == ["ack-first-lost"]
    assert of("mavsitl inject mot") == ["motor"]
    assert "off" in of("mavsitl inject motor o")
    assert of("mavsitl param get COM_OF_LOSS") == ["COM_OF_LOSS_T"]
    assert of("mavsitl param get COM_OF_LOSS_T NAV_DLL_A") == ["NAV_DLL_ACT"]
    assert of("mavsitl param set COM_OF_LOSS") == ["COM_OF_LOSS_T="]
    own = tmp_path / "own.toml"
    own.touch()
    assert of(f"mavsitl fly {tmp_path}/ow") == [str(own)]


def test_all_shipped_scenarios_are_offered(environment: dict[str, str], tmp_path: Path) -> None:
    line = "mavsitl ground "
    offered = in_bash(line, environment)
    assert set(scenario.names()) <= set(offered)


def test_fish_completes(environment: dict[str, str]) -> None:
    script = 'mavsitl completion fish | source; complete -C "mavsitl fly hover-c"; complete -C "mavsitl inj"'
    done = subprocess.run(
        [shell("fish"), "--no-config", "-c", script],
        env=environment, stdout=subprocess.PIPE, text=True, timeout=60.0, check=True,
    )  # fmt: skip
    names = [line.split("\t")[0].strip() for line in done.stdout.splitlines()]
    assert names == ["hover-calm", "inject"]


def test_zsh_completes_at_a_terminal(environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / ".zshrc").write_text(ZSH)
    pid, terminal = pty.fork()
    if pid == 0:
        os.execvpe(shell("zsh"), ["zsh", "-i", "-d"], environment)
    try:
        told = until(terminal, "READY")
        os.write(terminal, b"mavsitl fly hover-ca\t")
        told = until(terminal, "hover-calm")
        assert "hover-calm" in told
    finally:
        os.close(terminal)  # which is its end: the terminal hangs up
        os.waitpid(pid, 0)


def until(terminal: int, text: str) -> str:
    """What comes from the terminal, up to the text."""
    told = ""
    while text not in told:
        assert select.select([terminal], [], [], 60.0)[0], f"no {text!r} in {told!r}"
        told += os.read(terminal, 4096).decode(errors="replace")
    return told


@pytest.mark.parametrize("name", ["bash", "zsh", "fish"])
def test_the_script_is_all_that_is_printed(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["completion", name]) == 0
    script = capsys.readouterr().out
    assert "mavsitl" in script
    assert cli.main(["completion", name, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"shell": name, "script": script.removesuffix("\n")}


def test_no_command_loads_it_that_is_not_asked() -> None:
    program = "import sys, mavsitl.cli; mavsitl.cli.build_parser(); sys.exit('argcomplete' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60.0)
