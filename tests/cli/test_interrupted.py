"""Ctrl-C and SIGTERM in the middle: where the logs are is told, and they can be read up to that moment."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from pyulog import ULog

from mavsitl import ends
from mavsitl.campaign import sweep
from mavsitl.cli import main

SIGNALS = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])


@pytest.fixture(autouse=True)
def _handlers() -> Iterator[None]:
    """The commands set handlers of their own."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def signalled(call: Callable[..., Any], number: signal.Signals) -> Callable[..., Any]:
    """The same flight, with the signal when it is 1.5 s old."""

    def flown(*arguments: Any, progress: Callable[[float], None], **options: Any) -> Any:
        def move(time_s: float) -> None:
            progress(time_s)
            if time_s > 1.5:
                signal.raise_signal(number)

        return call(*arguments, progress=move, **options)

    return flown


@SIGNALS
@pytest.mark.parametrize(
    ("function", "arguments", "logs"),
    [
        ("in_memory", ["hover-calm", "--in-memory"], ["hover-calm/vehicle.ulg", "hover-calm/ground.ulg"]),
        ("fleet_in_memory", ["formation-spiral", "--count", "2"], []),
    ],
)
def test_fly(
    function: str, arguments: list[str], logs: list[str], number: signal.Signals,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(ends, function, signalled(getattr(ends, function), number))
    assert main(["fly", *arguments, "--run-dir", str(tmp_path)]) == 128 + number
    assert capsys.readouterr().err.endswith(f"mavsitl fly: interrupted\nlogs so far: {tmp_path}\n")
    written = [tmp_path / name for name in logs] or list(tmp_path.rglob("*.ulg"))
    assert len(written) >= 2
    for path in written:
        log = ULog(str(path))
        assert not log.file_corruption
        assert log.last_timestamp > 1_400_000


def test_fly_as_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(ends, "in_memory", signalled(ends.in_memory, signal.SIGTERM))
    assert main(["fly", "hover-calm", "--in-memory", "--json", "--run-dir", str(tmp_path)]) == 143
    assert json.loads(capsys.readouterr().out) == {
        "event": "error", "command": "mavsitl fly", "error": "interrupted", "notes": [f"logs so far: {tmp_path}"],
        "exit_code": 143,
    }  # fmt: skip


@SIGNALS
def test_sweep(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = sweep.fly

    def interrupted(*arguments: Any) -> Iterator[Any]:
        for flown, row in enumerate(real(*arguments)):
            if flown == 2:
                signal.raise_signal(number)
            yield row

    monkeypatch.setattr(sweep, "fly", interrupted)
    arguments = ["sweep", "hover-calm", "--set", "duration_s=0.5", "--seeds", "4", "--output", str(tmp_path)]
    assert main(arguments) == 128 + number
    told = f"mavsitl sweep: interrupted\n2 of 4 are in {tmp_path}; the same command goes on with the rest\n"
    assert capsys.readouterr().err.endswith(told)
    assert len((tmp_path / "rows.jsonl").read_text().splitlines()) >= 2


@SIGNALS
@pytest.mark.sockets
def test_a_ground_that_waits(number: signal.Signals, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mavsitl", "ground", "--link", "udpin:127.0.0.1:0", "--run-dir", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("ground (takeoff-hover): waiting")
            assert process.stdout.readline() == f"logs: {tmp_path}\n"
            process.send_signal(number)
            rest = process.stdout.read()
        finally:
            process.kill()
    assert process.returncode == 0
    assert rest.endswith(f"logs: {tmp_path}\n")


def test_a_flight_that_is_lost_says_what_to_look_at(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fly", "rotor-failure", "--in-memory", "--duration", "2", "--run-dir", str(tmp_path)]) == 1
    said = capsys.readouterr().out
    assert f"report: {tmp_path / 'report.html'}\n" in said
    assert "rotor-failure was lost after " in said
    assert f"look at: mavsitl log info {tmp_path / 'rotor-failure'}\n" in said
