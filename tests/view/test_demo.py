"""The processes of a demonstration: one flight after the other, an end to both, and the words of one that fails."""

from __future__ import annotations

import io
import subprocess
import tempfile
from collections.abc import Iterator
from typing import Any

import pytest

from mavsitl.pair import PairError
from mavsitl.view.demo import END_STEPS, Demo


class Process:
    """One that ends when it is told to, unless it is deaf."""

    made: list[Process]

    def __init__(self, command: list[str], *, stderr: Any, **options: Any) -> None:
        self.end = command[3]
        self.stderr = stderr
        self.code: int | None = None
        self.deaf = False
        Process.made.append(self)

    def poll(self) -> int | None:
        return self.code

    def terminate(self) -> None:
        if not self.deaf:
            self.code = 0

    def kill(self) -> None:
        self.code = -9

    def wait(self, timeout: float | None = None) -> int:
        assert self.code is not None
        return self.code


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Demo, list[Process]]]:
    Process.made = []
    monkeypatch.setattr(subprocess, "Popen", Process)
    monkeypatch.setattr(tempfile, "TemporaryFile", io.BytesIO)
    made = Demo("demo", ("seed=3",))
    made.start()
    yield made, Process.made
    made.close()


def running(processes: list[Process]) -> list[str]:
    return [process.end for process in processes if process.code is None]


def test_both_run_until_the_end(started: tuple[Demo, list[Process]]) -> None:
    show, processes = started
    for _ in range(5):
        show.step()
    assert running(processes) == ["vehicle", "ground"]
    show.close()
    assert running(processes) == []
    assert len(processes) == 2


def test_when_the_ground_has_ended_both_begin_anew(started: tuple[Demo, list[Process]]) -> None:
    show, processes = started
    processes[1].code = 1  # the vehicle was lost
    show.step()
    show.step()
    assert running(processes) == ["vehicle", "ground"]
    assert len(processes) == 4


def test_a_vehicle_that_does_not_end_is_killed_and_nobody_waits(started: tuple[Demo, list[Process]]) -> None:
    show, processes = started
    processes[0].deaf = True
    processes[1].code = 0
    for _ in range(END_STEPS + 2):
        show.step()
    assert processes[0].code == -9
    assert running(processes) == ["vehicle", "ground"]


def test_what_a_process_says_when_it_fails_is_told(started: tuple[Demo, list[Process]]) -> None:
    show, processes = started
    processes[0].stderr.write(b"mavsitl vehicle: port 14580 is in use\n")
    processes[0].code = 1
    with pytest.raises(PairError, match="vehicle: mavsitl vehicle: port 14580 is in use"):
        show.step()
