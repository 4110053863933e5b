"""Writing beside the control loop: a thread that is slow, fails, or is overtaken, and files replaced in one move."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from mavsitl.keep import INTERVAL_US, Document, Keeper, Work, carry_out, replace_file

PATIENCE_S = 30.0


class Slow:
    """Work that takes until it is let go."""

    def __init__(self, error: OSError | None = None) -> None:
        self.begun = threading.Event()
        self.let_go = threading.Event()
        self._error = error

    def write(self) -> None:
        self.begun.set()
        assert self.let_go.wait(PATIENCE_S)
        if self._error is not None:
            raise self._error


class Core:
    """Hands out what the test puts there."""

    def __init__(self) -> None:
        self.waiting: list[Work] = []
        self.asked_us: list[int] = []
        self.told: list[tuple[Work, OSError | None]] = []

    def unsaved(self, now_us: int) -> Sequence[Work]:
        self.asked_us.append(now_us)
        work, self.waiting = self.waiting, []
        return work

    def saved(self, work: Work, error: OSError | None, now_us: int) -> None:
        self.told.append((work, error))


def step_until_told(keeper: Keeper, core: Core, number: int, now_us: int) -> None:
    for _ in range(10_000):
        keeper.step(now_us)
        if len(core.told) >= number:
            return
        threading.Event().wait(0.001)
    raise AssertionError("the thread does not write")


def test_a_slow_disk_does_not_hold_up_who_asks() -> None:
    core = Core()
    keeper = Keeper(core)
    first, second = Slow(), Slow()
    core.waiting = [first]
    keeper.step(0)
    assert first.begun.wait(PATIENCE_S)
    core.waiting = [second]
    for now_us in range(0, 10 * INTERVAL_US, 4000):
        keeper.step(now_us)  # returns, and hands out nothing more
    assert core.asked_us == [0]
    first.let_go.set()
    second.let_go.set()
    step_until_told(keeper, core, 2, 10 * INTERVAL_US)
    assert core.told == [(first, None), (second, None)]
    keeper.close(0)


def test_it_looks_at_once_and_then_at_most_ten_times_a_second() -> None:
    """A storm of changes is a few writes; the first change is written without delay."""
    core = Core()
    keeper = Keeper(core)
    keeper.step(0)
    keeper.step(4000)
    assert core.asked_us == [0, 4000]  # nothing was found, so it goes on looking
    work = Slow()
    work.let_go.set()
    core.waiting = [work]
    keeper.step(8000)
    step_until_told(keeper, core, 1, 8000)
    for now_us in range(12_000, 8000 + INTERVAL_US, 4000):
        keeper.step(now_us)
    assert core.asked_us == [0, 4000, 8000]
    keeper.step(8000 + INTERVAL_US)
    assert core.asked_us[-1] == 8000 + INTERVAL_US
    keeper.close(0)


def test_a_failure_is_told_and_the_thread_goes_on() -> None:
    core = Core()
    keeper = Keeper(core)
    failure = OSError(28, "No space left on device")
    bad, good = Slow(failure), Slow()
    bad.let_go.set()
    good.let_go.set()
    core.waiting = [bad, good]
    keeper.step(0)
    step_until_told(keeper, core, 2, 0)
    assert core.told == [(bad, failure), (good, None)]
    keeper.close(0)


def test_closing_waits_for_what_is_under_way_and_writes_the_rest(tmp_path: Path) -> None:
    core = Core()
    keeper = Keeper(core)
    slow, last = Slow(), Document(tmp_path / "deep" / "a.json", b"last")
    core.waiting = [slow]
    keeper.step(0)
    assert slow.begun.wait(PATIENCE_S)
    core.waiting = [last]
    threading.Timer(0.05, slow.let_go.set).start()
    keeper.close(0)
    assert core.told == [(slow, None), (last, None)]
    assert (tmp_path / "deep" / "a.json").read_bytes() == b"last"
    keeper.close(0)
    before = threading.active_count()
    Keeper(Core()).close(0)  # a vehicle that keeps nothing has no thread
    assert threading.active_count() == before


def test_files_that_share_a_folder_do_not_meet(tmp_path: Path) -> None:
    core = Core()
    core.waiting = [Document(tmp_path / f"{k}.json", bytes([k])) for k in range(5)]
    carry_out(core)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {f"{k}.json": bytes([k]) for k in range(5)}


def test_a_file_is_replaced_and_not_written_into(tmp_path: Path) -> None:
    """Whoever has the old one open reads on; a hard link keeps it."""
    path = tmp_path / "a.json"
    replace_file(path, b"old")
    (tmp_path / "kept").hardlink_to(path)
    with path.open("rb") as reader:
        replace_file(path, b"new")
        assert reader.read() == b"old"
    assert path.read_bytes() == b"new"
    assert (tmp_path / "kept").read_bytes() == b"old"
    with pytest.raises(FileNotFoundError):
        replace_file(tmp_path / "none" / "a.json", b"")
