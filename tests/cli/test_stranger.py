"""What somebody meets who types a word wrong, has a narrow terminal, or wants no colours."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from mavsitl.cli import main

pty = pytest.importorskip("pty", reason="no pseudo-terminals on this system")

COLOUR = re.compile(r"\x1b\[(?:\d+;)*(?:3[0-8]|4[0-8]|9[0-7]|10[0-7])(?:;\d+)*m")
"""Of text or ground; bold and faint are none."""


def at_a_terminal(*arguments: str, columns: int = 100, **environment: str) -> str:
    """What a command writes to a terminal of so many columns."""
    theirs, ours = pty.openpty()
    plain = {name: value for name, value in os.environ.items() if name not in ("NO_COLOR", "FORCE_COLOR", "COLUMNS")}
    with subprocess.Popen(
        [sys.executable, "-m", "mavsitl", *arguments], stdin=ours, stdout=ours, stderr=ours,
        env={**plain, "TERM": "xterm-256color", "COLUMNS": f"{columns}", **environment},
    ):  # fmt: skip
        os.close(ours)
        written = b""
        try:
            while some := os.read(theirs, 65536):
                written += some
        except OSError:  # Linux ends it so
            pass
        os.close(theirs)
    return written.decode()


# --- colours ----------------------------------------------------------------------------------------------------------

FLY = ("fly", "steps-calm", "--in-memory", "--duration", "1", "--no-report", "--run-dir")


def test_a_terminal_gets_colours(tmp_path: Path) -> None:
    assert COLOUR.search(at_a_terminal(*FLY, str(tmp_path)))


def test_no_color_turns_them_off_there(tmp_path: Path) -> None:
    said = at_a_terminal(*FLY, str(tmp_path), NO_COLOR="1")
    assert "Position steps in calm air" in said
    assert not COLOUR.search(said)


def test_a_pipe_gets_no_escape_at_all(tmp_path: Path) -> None:
    said = subprocess.run(
        [sys.executable, "-m", "mavsitl", *FLY, str(tmp_path)], capture_output=True, check=True, text=True
    )
    assert "Position steps in calm air" in said.stdout
    assert "\x1b" not in said.stdout + said.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
@pytest.mark.parametrize("arguments", [["scenarios"], ["scenarios", "--json"]])
def test_a_full_disk_is_a_line_and_no_traceback(arguments: list[str]) -> None:
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(
            [sys.executable, "-m", "mavsitl", *arguments], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert ended.returncode == 1
    assert ended.stderr == "mavsitl scenarios: output cannot be written: No space left on device\n"


# --- a wrong word -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["fly", "hover-wind", "--set", "controller.lwa=pid"], "lwa: unknown key; did you mean law? allowed here: "),
        (["fly", "hover-wind", "--set", "controller.law=pidn"], "law: 'pidn' is not allowed; did you mean pidnn, pid?"),
        (["fly", "hover-wind", "--set", 'wind=[{model="gst"}]'], ".model: 'gst' is not allowed; did you mean gust?"),
        (["fly", "hover-wind", "--controller", "geometrc"], "did you mean geometric? allowed: pidnn, pid, "),
        (["fly", "hover-wind", "--set", "wind.speed=3"], "unknown key; did you mean speed_20ft_m_s? allowed here: "),
        (["fly", "--count", "3"], "--count: name one scenario, such as formation-spiral; 4 were to fly"),
        (["fly", "nowhere.toml"], "nowhere.toml: no such file; a name without .toml is one of the shipped scenarios"),
        (["fly", "--duration", "long"], "--duration: 'long' is not allowed; allowed: a finite number above 0"),
        (["fly", "--seed", "-1"], "--seed: '-1' is not allowed; allowed: a whole number from 0"),
        (["sweep", "hover-wind", "--seeds", "few"], "sweep: seeds: 'few' is not allowed; allowed: N for 1 to N"),
        (["sweep", "hover-wind", "--seeds", "1,few"], "mavsitl sweep: seeds 1,few: 'few' is not allowed"),
        (["link", "--loss", "20"], "--loss: '20' is not allowed; allowed: a finite number from 0 to 1"),
        (["param", "gte", "A"], "argument {get,set,list}: 'gte' is not allowed; did you mean get?"),
    ],
)  # fmt: skip
def test_it_is_told_what_was_meant(arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["log", "info", "nowhere"], "mavsitl log info: nowhere: no such file or folder"),
        (["log", "info", "."], "mavsitl log info: .: a folder without logs"),
        (["log", "info", "text"], "mavsitl log info: text: neither a ULog nor a tlog"),
        (["log", "convert", "nowhere", "out.xyz"], "log convert: out.xyz: its ending says the format; allowed: "),
        (["log", "diff", "nowhere", "nowhere"], "mavsitl log diff: nowhere: no such file or folder"),
        (["view", "nowhere"], "nowhere: no such folder"),
        (["view", "."], ".: nothing to replay"),
        (["report", "."], "run.json: not found; expected the folder of a run"),
    ],
)  # fmt: skip
def test_a_wrong_path_is_a_wrong_argument(
    arguments: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("text").write_text("not a log, but a text")
    assert main(arguments) == 2
    assert told in capsys.readouterr().err


@pytest.mark.sockets
@pytest.mark.parametrize("command", ["vehicle", "ground"])
def test_nobody_says_that_it_runs_before_it_has_its_port(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        where = {"vehicle": ["--gcs-port", f"{port}", "--no-state"], "ground": ["--link", f"udpin:127.0.0.1:{port}"]}
        assert main([command, *where[command]]) == 1
    said = capsys.readouterr()
    assert "in use" in said.err
    assert "Ctrl-C ends it" not in said.out


# --- a controller with a mistake in it --------------------------------------------------------------------------------

WRONG = """\
import numpy as np


class Mine:
    def update(self, time_s, state, reference):
        return np.linalg.inv(np.zeros((3, 3)))  # fails in NumPy's own code
"""


def test_a_mistake_in_a_controller_is_its_line_and_no_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.py").write_text(WRONG)
    run = tmp_path / "run"
    flown = ["fly", "hover-wind", "--in-memory", "--controller", f"{tmp_path / 'mine.py'}:Mine"]
    assert main([*flown, "--run-dir", str(run)]) == 1
    said = capsys.readouterr().out
    assert "LinAlgError: Singular matrix (mine.py, line 6)" in said
    assert said.count("lost \N{BLACK UP-POINTING TRIANGLE}") == 6  # not "0.00", as of six numbers that were beaten
    assert ": 0 of 6 states at or below" in (run / "report.html").read_text()


# --- a narrow terminal ------------------------------------------------------------------------------------------------


def test_a_narrow_terminal_has_the_titles_of_scenarios(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    assert main(["scenarios"]) == 0
    said = capsys.readouterr().out
    assert "Hover hit by a gust" in said
    assert max(map(len, said.splitlines())) <= 60


def test_no_number_of_a_log_is_broken_in_a_narrow_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = str(tmp_path / "run")
    assert main([*FLY, run]) == 0
    capsys.readouterr()
    monkeypatch.setenv("COLUMNS", "60")
    assert main(["log", "info", run]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith(" ")]
    topics = [line for line in rows if re.match(r" vehicle_attitude .*\d\.\d{3}\s*$", line)]
    assert len(topics) == 1
    assert not any(re.fullmatch(r"\s+\d\s*", line) for line in rows)
