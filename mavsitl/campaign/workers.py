"""Who flies: this process, processes of this machine, or a Dask cluster. Results come as they are ready.

A worker that dies takes one case with it, which is given to another. A case that kills its worker again is given up,
and the rest goes on.
"""

from __future__ import annotations

import multiprocessing
import os
import platform
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from multiprocessing import connection
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar
from uuid import uuid4

import mavsitl
from mavsitl.campaign import fly, optional
from mavsitl.campaign.errors import WorkerError
from mavsitl.campaign.fly import Row
from mavsitl.campaign.grid import Case, source_digest

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.context import SpawnProcess

S = TypeVar("S")
T = TypeVar("T")

TRIES = 2
"""Of a case whose process dies."""
ENDING_S = 5.0
"""Wall clock for a process to end by itself."""

_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "NUMBA")
_ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in _LIBRARIES}


class Workers(Protocol):
    """Whoever flies. A context manager: at its end what it started is ended."""

    def map(
        self, function: Callable[[S], T], items: Iterable[S], lost: Callable[[S, str], T] | None = None
    ) -> Iterator[tuple[int, T]]:
        """(number of the item, result) as they come; `function` is a module's, and it and the items are pickled.

        `lost`: the result of an item that no worker survives, from the item and what is known; None: `WorkerError`.
        An exception of `function` is raised.
        """

    def __enter__(self) -> Workers: ...
    def __exit__(self, *exception: object) -> None: ...


def fly_all(cases: Sequence[Case], workers: Workers) -> Iterator[Row]:
    """A row for each case, as they come. Cases of the same key are flown once, with the first one's labels."""
    once = list({each.key: each for each in reversed(cases)}.values())[::-1]

    def lost(data: bytes, text: str) -> bytes:
        return fly.encode(fly.not_flown(fly.decode(data, Case), text))

    for _, data in workers.map(fly.fly_encoded, map(fly.encode, once), lost):
        yield fly.decode(data, Row)


def cores() -> int:
    """Those that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def local(jobs: int) -> Workers:
    """This process alone for 1, else so many of this machine."""
    return Here() if jobs == 1 else Local(jobs)


class Here:
    """This process."""

    def map(
        self, function: Callable[[S], T], items: Iterable[S], lost: Callable[[S, str], T] | None = None
    ) -> Iterator[tuple[int, T]]:
        for index, item in enumerate(items):
            yield index, function(item)

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *exception: object) -> None:
        pass


class Local:
    """Processes of this machine, one thread each. They are started when there is work, and stay until the end.

    They end with this process, however it ends.
    """

    def __init__(self, jobs: int) -> None:
        if jobs < 1:
            raise ValueError(f"jobs: {jobs} is not allowed; allowed: 1 or more")
        self._jobs = jobs
        self._idle: list[_Process] = []

    def __enter__(self) -> Local:
        return self

    def __exit__(self, *exception: object) -> None:
        for process in self._idle:
            process.close()
        self._idle.clear()

    def map(
        self, function: Callable[[S], T], items: Iterable[S], lost: Callable[[S, str], T] | None = None
    ) -> Iterator[tuple[int, T]]:
        remaining = enumerate(items)
        again: deque[tuple[int, S]] = deque()
        deaths: dict[int, int] = {}
        busy: dict[Connection, tuple[_Process, int, S]] = {}
        try:
            while True:
                while len(busy) < self._jobs:
                    task = again.popleft() if again else next(remaining, None)
                    if task is None:
                        break
                    process = self._idle.pop() if self._idle else _Process()
                    busy[process.pipe] = (process, *task)
                    process.give(function, task[1])
                if not busy:
                    return
                for pipe in connection.wait(list(busy)):
                    process, index, item = busy.pop(pipe)  # type: ignore[call-overload]
                    try:
                        good, result = process.take()
                    except (EOFError, OSError):
                        how = process.close()
                        deaths[index] = deaths.get(index, 0) + 1
                        if deaths[index] < TRIES:
                            again.append((index, item))
                            continue
                        text = f"the process that flew it ended {TRIES} times, {how}"
                        if lost is None:
                            raise WorkerError(text) from None
                        yield index, lost(item, text)
                        continue
                    self._idle.append(process)
                    if not good:
                        raise result
                    yield index, result
        finally:  # also of an iterator that is given up: what they are at is nobody's any more
            for process, _, _ in busy.values():
                process.kill()


class _Process:
    """One worker, and the end of its pipe that is here."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would copy numba's and rich's threads in mid-air
        self.pipe, other = context.Pipe()
        self._process: SpawnProcess = context.Process(target=_work, args=(other,), daemon=True)
        with _one_thread():
            self._process.start()
        other.close()

    def give(self, function: Callable[[Any], Any], item: Any) -> None:
        with suppress(BrokenPipeError):  # it is dead, as will be seen when it should answer
            self.pipe.send((function, item))

    def take(self) -> tuple[bool, Any]:
        """Whether it went well, and the result or the exception. Raises EOFError or OSError of one that is dead."""
        answer: tuple[bool, Any] = self.pipe.recv()
        return answer

    def close(self) -> str:
        """One that is idle or dead: it ends. How it did."""
        self.pipe.close()
        self._process.join(ENDING_S)
        if self._process.exitcode is None:
            self._process.kill()
            self._process.join()
        code = self._process.exitcode or 0
        self._process.close()
        return f"by signal {-code}" if code < 0 else f"with exit code {code}"

    def kill(self) -> None:
        """One that is at work."""
        self._process.kill()
        self.close()


def _work(pipe: Connection) -> None:
    """The life of a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which says what is to end
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    while True:
        try:
            function, item = pipe.recv()
        except EOFError:
            return
        try:
            answer = (True, function(item))
        except Exception as error:
            answer = (False, error)
        pipe.send(answer)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Processes started meanwhile have no threads in their libraries: there is one process a core."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(_ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


CONNECT_S = 10.0
"""Wall clock for a Dask scheduler to answer, and for its first worker to be there."""
AHEAD = 4
"""Tasks handed to a cluster for each of its threads: none waits for the client, and few are left at an interruption."""


class Dask:
    """The workers of an existing Dask cluster. A worker that is lost has its task given to another, by Dask.

    They need the same mavsitl with the same source. Raises `WorkerError`.
    """

    def __init__(self, address: str) -> None:
        """`address` of the scheduler, ``tcp://HOST:PORT``."""
        optional.need("distributed")
        from distributed import Client

        self._address = address
        try:
            self._client = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise WorkerError(f"no Dask scheduler answers at {address}: {error}") from error
        try:
            self._check_workers()
        except BaseException:
            self._client.close()
            raise

    def __enter__(self) -> Dask:
        return self

    def __exit__(self, *exception: object) -> None:
        self._client.close()

    @property
    def threads(self) -> int:
        """Of all workers that are there now."""
        return sum(self._client.nthreads().values())

    def map(
        self, function: Callable[[S], T], items: Iterable[S], lost: Callable[[S, str], T] | None = None
    ) -> Iterator[tuple[int, T]]:
        from distributed import CancelledError, KilledWorker, as_completed

        mine = about()
        remaining = enumerate(items)
        under_way: dict[Any, tuple[int, S]] = {}
        coming = as_completed(loop=self._client.loop)

        def give(count: int) -> None:
            for index, item in islice(remaining, count):
                future = self._client.submit(_checked, mine, function, item, key=f"mavsitl-{uuid4().hex}")
                under_way[future] = (index, item)
                coming.add(future)

        try:
            give(max(AHEAD * self.threads, 1))
            for future in coming:
                index, item = under_way.pop(future)
                try:
                    result = future.result()
                except KilledWorker as error:
                    text = f"every Dask worker that flew it was lost: {error}"
                    if lost is None:
                        raise WorkerError(text) from error
                    result = lost(item, text)
                except CancelledError as error:
                    raise WorkerError(f"the Dask scheduler at {self._address} went away") from error
                give(1)
                yield index, result
        finally:
            if under_way:
                with suppress(OSError, TimeoutError):  # of a scheduler that is gone
                    self._client.cancel(list(under_way), force=True)

    def wait_for(self, count: int) -> None:
        """So many workers. Raises `WorkerError` where they do not come."""
        try:
            self._client.wait_for_workers(count, timeout=CONNECT_S)
        except TimeoutError as error:
            missing = "has no worker" if count == 1 else f"has fewer than {count} workers"
            raise WorkerError(
                f"the Dask scheduler at {self._address} {missing}; one is started by: "
                f"dask worker {self._address} --nthreads 1"
            ) from error

    def _check_workers(self) -> None:
        """Of those that are there; one that comes later is checked when it gets its first task."""
        self.wait_for(1)
        try:
            found: dict[str, About] = self._client.run(about)
        except Exception as error:
            raise WorkerError(
                f"a worker of {self._address} cannot load mavsitl {mavsitl.__version__} ({error}); "
                "install the same version in the workers' environment"
            ) from error
        for worker, its in found.items():
            _compare(about(), its, worker)


About: TypeAlias = dict[str, str]


def about() -> About:
    """What has to be the same for a flight to be the same: this process's."""
    return {
        "mavsitl": mavsitl.__version__,
        "source": source_digest()[:12],
        "Python": f"{sys.version_info.major}.{sys.version_info.minor}",
    }


def _compare(ours: About, its: About, worker: str) -> None:
    if its != ours:
        there, here = (", ".join(f"{name} {value}" for name, value in each.items()) for each in (its, ours))
        raise WorkerError(f"{worker} has {there}, and here is {here}; install the same in both places")


def _checked(expected: About, function: Callable[[S], T], item: S) -> T:
    """On a worker of the cluster."""
    _compare(expected, about(), f"a worker on {platform.node()}")
    return function(item)
