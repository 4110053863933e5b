"""This process and processes of this machine: the same rows, whatever happens to a process."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mavsitl.campaign import fly, workers
from mavsitl.campaign.errors import WorkerError
from mavsitl.campaign.workers import Here, Local, Workers, fly_all
from tests.campaign import flights
from tests.campaign.flights import measured, short

posix = pytest.mark.skipif(sys.platform == "win32", reason="by signals")


@pytest.fixture(scope="module")
def two() -> Iterator[Local]:
    with Local(2) as made:
        yield made


def test_processes_give_the_bits_that_this_one_gives(two: Local) -> None:
    cases = [short(name, seed, flown=name) for name in ("hover-wind", "spiral-wind") for seed in (1, 2)]
    here = {row.key: measured(row) for row in fly_all(cases, Here())}
    there = {row.key: measured(row) for row in fly_all(cases, two)}
    assert set(here) == {case.key for case in cases}
    assert here == there


def test_a_case_that_is_there_twice_is_flown_once() -> None:
    rows = list(fly_all([short("hover-calm", 1, copy=1), short("hover-calm", 1, copy=2)], Here()))
    assert [row.labels for row in rows] == [{"copy": 1}]


@pytest.mark.parametrize("jobs", [1, 2])
def test_map_numbers_what_it_gives(jobs: int) -> None:
    with workers.local(jobs) as crew:
        assert sorted(crew.map(flights.square, range(7))) == [(n, n * n) for n in range(7)]


def test_processes_have_one_thread_each(two: Local) -> None:
    assert list(two.map(flights.one_thread, [1])) == [(0, "1")]


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_a_task_raises_is_raised(jobs: int) -> None:
    with workers.local(jobs) as crew:
        with pytest.raises(ArithmeticError, match="not 3"):
            list(crew.map(flights.refuse, [3]))
        assert list(crew.map(flights.square, [2])) == [(0, 4)]


@posix
def test_a_process_that_dies_has_its_case_repeated(two: Local, tmp_path: Path) -> None:
    fuses = [tmp_path / name for name in "ab"]
    for fuse in fuses:
        fuse.touch()
    assert sorted(two.map(flights.die_once, [str(fuse) for fuse in fuses])) == [(0, "done"), (1, "done")]


@posix
def test_a_case_that_kills_is_given_up_and_the_rest_goes_on(two: Local) -> None:
    told: list[tuple[int, str]] = []

    def lost(number: int, text: str) -> int:
        told.append((number, text))
        return -1

    assert sorted(two.map(flights.die_on_3, range(6), lost)) == [(n, -1 if n == 3 else n) for n in range(6)]
    assert told == [(3, "the process that flew it ended 2 times, by signal 9")]
    with pytest.raises(WorkerError, match="by signal 9"):
        list(two.map(flights.die_on_3, [3]))


def test_a_flight_that_took_its_worker_with_it_is_a_row() -> None:
    class Deadly(Here):
        def map(self, function, items, lost=None):  # type: ignore[no-untyped-def]
            for index, item in enumerate(items):
                assert lost is not None
                yield index, lost(item, "the process that flew it ended 2 times, by signal 9")

    crew: Workers = Deadly()
    case = short("hover-calm", 4, law="pid")
    (row,) = fly_all([case], crew)
    assert (row.key, row.seed, row.status, row.labels) == (case.key, 4, "failed", {"law": "pid"})
    assert row.message.endswith("by signal 9")
    assert row.scenario_digest == fly.fly(case).scenario_digest


def test_an_iterator_that_is_given_up_leaves_no_process() -> None:
    before = set(multiprocessing.active_children())
    with Local(2) as crew:
        for _ in crew.map(flights.square, range(100)):
            break
    assert set(multiprocessing.active_children()) <= before


def test_a_wrong_number_of_processes_is_refused() -> None:
    with pytest.raises(ValueError, match="jobs: 0 is not allowed; allowed: 1 or more"):
        Local(0)
