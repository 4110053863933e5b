"""`mavsitl view` as a command: its mistakes, and how it begins and ends. The page has tests of its own."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from mavsitl import ends, scenario
from mavsitl.cli import main
from mavsitl.link.udp import LOOPBACK

PATIENCE_S = 120.0

MISTAKES: dict[str, tuple[list[str], tuple[str, ...]]] = {
    "replay of a demo": (["view", ".", "--demo"], ("--demo", "not with RUN")),
    "replay of links": (["view", ".", "--listen", "udpin:127.0.0.1:1"], ("--listen", "not with RUN")),
    "links of a demo": (["view", "--demo", "--instance", "1"], ("--instance", "not with --demo")),
    "settings of none": (["view", "--set", "seed=3"], ("--set", "only with --demo")),
    "logs of none": (["view", "--run-dir", "."], ("--run-dir", "only with --demo")),
    "counted endpoints": (["view", "--listen", "udpin:127.0.0.1:1", "--count", "2"], ("--listen", "--count")),
    "endpoint": (["view", "--listen", "14550"], ("'14550'", "udpin:HOST:PORT")),
    "monitor": (["view", "--monitor", "yes"], ("'yes'", "udpin:HOST:PORT")),
    "port": (["view", "--port", "-1"], ("--port", "from 0 to 65535")),
    "demo": (["view", "--demo", "hover-clam"], ("hover-clam", "hover-calm")),
    "demo's key": (["view", "--demo", "--set", "wnd=3"], ("wnd",)),
    "ground's monitor": (["ground", "--monitor", "yes"], ("'yes'", "udpin:HOST:PORT")),
    "monitor in lock-step": (["ground", "--lockstep", "--monitor", "udpout:127.0.0.1:1"], ("--monitor", "not with")),
}


@pytest.mark.parametrize(("arguments", "words"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_named(arguments: list[str], words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        code: int = main(arguments)
    except SystemExit as ended:
        code = int(ended.code or 0)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    said = capsys.readouterr().err
    assert code == 2
    assert [word for word in words if word not in said] == []
    assert "Traceback" not in said


@contextmanager
def running(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], dict[str, Any]]]:
    """The command, and what it printed of where it is."""
    process = subprocess.Popen(
        [sys.executable, "-m", "mavsitl", "view", *arguments, "--port", "0", "--json"],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        lines = ""
        while "}" not in lines:
            line = process.stdout.readline()
            assert line or process.poll() is None, process.communicate()[1]
            lines += line
        yield process, json.loads(lines)
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("run")
    flight = scenario.load("hover-calm", {"duration_s": 1.0})
    ends.in_memory(flight, made, report=lambda text: None, progress=None)
    return made


@pytest.mark.sockets
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_it_is_told_to_end(folder: Path, number: int) -> None:
    with running(str(folder)) as (process, said):
        assert said["exposed"] is False
        with urllib.request.urlopen(said["address"], timeout=PATIENCE_S) as answer:
            assert b"mavsitl view" in answer.read()
        process.send_signal(number)
        _, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0
        assert errors == ""


@pytest.mark.sockets
def test_beyond_loopback_it_says_so_and_has_a_token(folder: Path) -> None:
    with running(str(folder), "--bind", "0.0.0.0", "--no-buttons") as (process, said):
        assert said["exposed"] is True
        assert "/?token=" in said["address"]
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE_S)
        assert "open to the network" in errors
        assert "look at the vehicles" in errors


@pytest.mark.sockets
def test_a_port_that_is_taken_is_named_with_its_option(folder: Path) -> None:
    with socket.socket() as page, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as monitor:
        for holder in (page, monitor):
            holder.bind((LOOPBACK, 0))
        page.listen()
        for arguments, option in (
            ([str(folder), "--port", str(page.getsockname()[1])], "--port N"),
            (["--port", "0", "--monitor", f"udpin:127.0.0.1:{monitor.getsockname()[1]}"], "--monitor none"),
        ):
            done = subprocess.run(
                [sys.executable, "-m", "mavsitl", "view", "--no-browser", *arguments],
                stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, timeout=PATIENCE_S,
            )  # fmt: skip
            assert done.returncode == 1
            assert "is in use" in done.stderr
            assert option in done.stderr


@pytest.mark.sockets
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")
def test_a_demonstration_ends_what_it_started() -> None:
    with running("--demo") as (process, _):
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        assert len(children) == 2
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0
        assert [child for child in children if Path(f"/proc/{child}").exists()] == []


@pytest.mark.sockets
def test_a_demonstration_that_fails_says_why() -> None:
    """A ground that cannot fly the scenario: its words are those of the command."""
    done = subprocess.run(
        [sys.executable, "-m", "mavsitl", "view", "--demo", "hover-wind", "--port", "0", "--no-browser",
         "--set", 'controller.level="attitude"', "--set", "parameters.MC_ROLL_P=1.0"],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 1
    assert "MC_ROLL_P" in done.stderr
