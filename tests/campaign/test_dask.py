"""A Dask scheduler and its workers, real processes on loopback: the same rows, whatever happens to a worker."""

from __future__ import annotations

from pathlib import Path

import pytest

from mavsitl import cli
from mavsitl.campaign import optional, workers
from mavsitl.campaign.errors import MissingError, WorkerError
from mavsitl.campaign.workers import Dask, Here, fly_all
from mavsitl.cli.common import EXIT_FAILED, EXIT_OK
from mavsitl.pair import free_ports
from tests.campaign import flights
from tests.campaign.conftest import Cluster
from tests.campaign.flights import measured, short

pytestmark = pytest.mark.sockets


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine a worker's start takes long."""
    monkeypatch.setattr(workers, "CONNECT_S", 60.0)


def test_a_cluster_without_workers_is_named(dask: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "CONNECT_S", 0.2)
    with pytest.raises(WorkerError, match=r"has no worker; .* dask worker tcp://"):
        Dask(dask.address)


def test_a_cluster_gives_the_bits_that_this_process_gives(dask: Cluster) -> None:
    cases = [short(name, seed, flown=name) for name in ("hover-wind", "spiral-wind") for seed in (1, 2)]
    here = {row.key: measured(row) for row in fly_all(cases, Here())}
    dask.have(2)
    with Dask(dask.address) as crew:
        there = {row.key: measured(row) for row in fly_all(cases, crew)}
    assert here == there
    assert all(row.wire_hash for row in there.values())


def test_many_small_tasks_are_numbered(dask: Cluster) -> None:
    dask.have(2)
    with Dask(dask.address) as crew:
        assert sorted(crew.map(flights.square, range(50))) == [(n, n * n) for n in range(50)]
        for _ in crew.map(flights.square, range(50)):
            break  # the rest is cancelled
        assert list(crew.map(flights.square, [7])) == [(0, 49)]


def test_a_sweep_on_a_cluster_leaves_what_one_here_leaves(dask: Cluster, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    dask.have(2)
    command = ["sweep", "hover-calm", "--set", "duration_s=1", "--seeds", "3", "--no-report"]
    for name, crew in (("here", ["--jobs", "1"]), ("there", ["--scheduler", dask.address])):
        assert cli.main([*command, *crew, "--output", str(tmp_path / name)]) == EXIT_OK
    here, there = (
        parquet.read_table(tmp_path / name / "results.parquet").drop_columns("cpu_s") for name in ("here", "there")
    )
    assert here.num_rows == 3
    assert here.equals(there)


def test_what_a_task_raises_is_raised_here(dask: Cluster) -> None:
    dask.have(1)
    with Dask(dask.address) as crew, pytest.raises(ArithmeticError, match="not 3"):
        list(crew.map(flights.refuse, [3]))


def test_another_source_at_a_worker_is_named(dask: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the beginning, and of a worker that comes later."""
    dask.have(1)
    with Dask(dask.address) as crew:
        wrong = {**workers.about(), "source": "of yesterday"}
        monkeypatch.setattr(workers, "about", lambda: wrong)
        with pytest.raises(WorkerError, match=r"a worker on .* source \w+, .*, and here is .* of yesterday"):
            list(crew.map(flights.square, [1]))
    monkeypatch.undo()
    monkeypatch.setattr(workers, "source_digest", lambda: "of yesterday")
    with pytest.raises(WorkerError, match=r"tcp://127\.0\.0\.1:\d+ has .*, and here is .* of yesterday, "):
        Dask(dask.address)


def test_a_lost_worker_s_flights_are_flown_by_another(dask: Cluster) -> None:
    dask.have(2)
    with Dask(dask.address) as crew:
        crew.wait_for(2)
        rows = fly_all([short("hover-calm", seed) for seed in range(1, 7)], crew)
        seen = [next(rows)]
        dask.workers[0].kill()
        seen += rows
    assert sorted(row.seed for row in seen) == [1, 2, 3, 4, 5, 6]
    assert {row.status for row in seen} == {"flown"}


def test_a_task_that_kills_its_workers_is_given_up(dask: Cluster) -> None:
    dask.have(2)
    with Dask(dask.address) as crew:
        crew.wait_for(2)
        ((_, text),) = crew.map(flights.die_told, [3], lambda number, text: text)
        assert text.startswith("every Dask worker that flew it was lost")
        dask.have(0)
        for process in dask.workers:
            process.wait(timeout=60.0)
        dask.have(1)
        assert list(crew.map(flights.square, [4])) == [(0, 16)]


def test_a_scheduler_that_goes_is_named(tmp_path: Path) -> None:
    made = Cluster(tmp_path)
    try:
        made.have(1)
        with Dask(made.address) as crew:
            rows = fly_all([short("hover-calm", seed) for seed in range(1, 100)], crew)
            next(rows)
            made.kill_scheduler()
            with pytest.raises(WorkerError, match=rf"the Dask scheduler at {made.address} went away"):
                list(rows)
    finally:
        made.close()


def test_no_scheduler_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "CONNECT_S", 0.2)
    (port,) = free_ports(1)
    address = f"tcp://127.0.0.1:{port}"
    command = ["sweep", "hover-calm", "--seeds", "1", "--output", str(tmp_path), "--scheduler", address]
    assert cli.main(command) == EXIT_FAILED
    assert f"no Dask scheduler answers at {address}" in capsys.readouterr().err


def test_without_dask_the_message_has_the_line_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optional, "find_spec", lambda name: None)
    with pytest.raises(MissingError, match=r"distributed is not installed.*: pip install 'mavsitl\[sweep\]'"):
        Dask("tcp://127.0.0.1:1")
