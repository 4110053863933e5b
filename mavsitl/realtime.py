"""What Linux gives a process whose time counts: fine timers, and for `--realtime` priority and locked memory.

Priority and timers are of the thread that asks, so the threads that write files stay what they were. What is allowed is
checked before the process has said a word, and taken when its clock starts: what is loaded and compiled until then must
not hold a core from others.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import Enum
from pathlib import Path
from typing import Any

from mavsitl.errors import MavsitlError

__all__ = ["PRIORITY", "RealTimeError", "Wish", "check", "claim", "fine_timers"]

PRIORITY = 20
"""Of SCHED_FIFO's 1 to 99: above all that is not real-time, below the kernel's threads for interrupts at 50."""

_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_CAP_IPC_LOCK = 14

_NO_FIFO = (
    f"a real-time priority (SCHED_FIFO {PRIORITY}) is not allowed here. For a user: a line "
    f"'@GROUP - rtprio {PRIORITY}' in /etc/security/limits.d/ and a new login; for a service: LimitRTPRIO={PRIORITY}; "
    f"in a container: --cap-add SYS_NICE, or --ulimit rtprio={PRIORITY}"
)
_NO_LOCK = (
    "locking memory (mlockall) is not allowed here. For a user: a line '@GROUP - memlock unlimited' in "
    "/etc/security/limits.d/ and a new login; for a service: LimitMEMLOCK=infinity; in a container: "
    "--ulimit memlock=-1, or --cap-add IPC_LOCK"
)
_NOT_LINUX = "a real-time priority and locked memory are had on Linux only"


class Wish(Enum):
    """What a process asks for."""

    ORDINARY = "ordinary"
    DEMANDED = "demanded"
    BEST_EFFORT = "best effort"


class RealTimeError(MavsitlError):
    """`--realtime` was asked for and is not allowed; the text says how to allow it."""


def fine_timers() -> None:
    """Let sleeps of this thread end when they are due: Linux adds up to 50 us to them, to wake for several at once."""
    if sys.platform == "linux":
        _libc().prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)  # ns; every thread may


def check(wish: Wish) -> None:
    """Raises `RealTimeError` where something is demanded that is not allowed. Nothing is changed."""
    if wish is Wish.DEMANDED and (missing := _refused()):
        raise _error(missing)


@contextmanager
def claim(wish: Wish, report: Callable[[str], None]) -> Iterator[None]:
    """Within it this thread has a real-time priority, and the process's memory stays in memory.

    With `Wish.BEST_EFFORT` it goes on without what is not allowed, and `report` is told; where a real-time priority is
    not, the thread gets the best ordinary one that is. Otherwise raises `RealTimeError`.
    """
    undo: list[Callable[[], object]] = []
    try:
        if wish is not Wish.ORDINARY:
            missing = _take(undo)
            if missing and wish is Wish.DEMANDED:
                raise _error(missing)
            for text in missing:
                report(f"--realtime: goes on, but {text}")
        yield
    finally:
        for each in undo:
            each()


def _error(missing: list[str]) -> RealTimeError:
    return RealTimeError(f"--realtime: {'; and '.join(missing)}. Or say --best-effort to go on without")


def _refused() -> list[str]:
    if sys.platform != "linux":
        return [_NOT_LINUX]
    found = []
    try:
        _to_fifo()
    except PermissionError:
        found.append(_NO_FIFO)
    else:
        _to_other()
    if not _may_lock():
        found.append(_NO_LOCK)
    return found


def _take(undo: list[Callable[[], object]]) -> list[str]:
    """What was refused; `undo` gets what takes back the rest."""
    if sys.platform != "linux":
        return [_NOT_LINUX]
    missing = []
    try:
        _to_fifo()
        undo.append(_to_other)
    except PermissionError:
        missing.append(_NO_FIFO)
        nice = os.getpriority(os.PRIO_PROCESS, 0)
        if _to_least_nice(nice):
            undo.append(lambda: os.setpriority(os.PRIO_PROCESS, 0, nice))
    # ONFAULT: what is never touched, most of what the libraries map, is not read in for that. And no lock under a
    # limit: an allocation beyond it would fail.
    if _may_lock() and _libc().mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) == 0:
        undo.append(_libc().munlockall)
    else:
        missing.append(_NO_LOCK)
    return missing


def _to_fifo() -> None:
    """Threads and processes that this thread makes are ordinary ones again. Raises `PermissionError`."""
    if sys.platform == "linux":
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))


def _to_other() -> None:
    if sys.platform == "linux":  # to take RESET_ON_FORK back is a privilege of its own
        os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))


def _to_least_nice(nice: int) -> bool:
    """As far as RLIMIT_NICE lets one; whether that is better than `nice`."""
    if sys.platform != "linux":
        return False
    import resource

    limit = resource.getrlimit(resource.RLIMIT_NICE)[0]
    least = -20 if limit == resource.RLIM_INFINITY else max(-20, 20 - limit)
    if least < nice:
        with suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, 0, least)
            return True
    return False


def _may_lock() -> bool:
    """Without a limit: the addresses of the libraries alone are 700 MB, whether they are used or not."""
    if sys.platform != "linux":
        return False
    import resource

    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY:
        return True
    status = Path("/proc/self/status").read_text()
    (effective,) = (line for line in status.splitlines() if line.startswith("CapEff:"))
    return bool(int(effective.split()[1], 16) >> _CAP_IPC_LOCK & 1)


def _libc() -> Any:
    import ctypes  # here and not above: it would come before the first HEARTBEAT

    return ctypes.CDLL(None)
