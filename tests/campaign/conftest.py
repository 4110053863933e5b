"""A Dask cluster of real processes on loopback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import pytest

START_S = 60.0


class Cluster:
    """A scheduler, and workers that can be killed one by one."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._processes: list[subprocess.Popen[bytes]] = []
        self.workers: list[subprocess.Popen[bytes]] = []
        file = folder / "scheduler.json"
        self._start("scheduler", ["--port", "0", "--scheduler-file", str(file)])
        self.address: str = msgspec.json.decode(_content(file))["address"]

    def have(self, count: int) -> None:
        """So many workers of one thread, new ones for those that are dead."""
        self.workers = [process for process in self.workers if process.poll() is None]
        while len(self.workers) < count:
            arguments = [self.address, "--nthreads", "1", "--no-nanny", "--local-directory", str(self._folder)]
            self.workers.append(self._start("worker", arguments))

    def kill_scheduler(self) -> None:
        self._processes[0].kill()
        self._processes[0].wait()

    def close(self) -> None:
        for process in reversed(self._processes):
            process.kill()
            process.wait()

    def _start(self, what: str, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--host", "127.0.0.1", "--no-dashboard"]
        settings = {**os.environ, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1"}
        with (self._folder / f"{what}-{len(self._processes)}.log").open("wb") as log:
            process = subprocess.Popen([*command, *arguments], stdout=log, stderr=log, env=settings)
        self._processes.append(process)
        return process


def _content(file: Path) -> bytes:
    """Of a file that another process writes in one go, soon."""
    end_s = time.monotonic() + START_S
    while not (file.exists() and file.stat().st_size):
        assert time.monotonic() < end_s, f"{file} was not written"
        time.sleep(0.02)
    return file.read_bytes()


@pytest.fixture(autouse=True)
def _handlers() -> Iterator[None]:
    """`mavsitl sweep` sets signal handlers of its own."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def dask(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A scheduler without workers. It gives a task up when the second worker has died under it, not the fourth."""
    pytest.importorskip("distributed")
    made = Cluster(tmp_path_factory.mktemp("dask"))
    try:
        yield made
    finally:
        made.close()
