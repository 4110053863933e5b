"""What a process does about its own memory and garbage: a quick start, and no pause and no ballast once it flies."""

from __future__ import annotations

import gc
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["flying", "one_blas_thread", "starting"]

_MADV_DONTNEED = 4

_MAPPING = re.compile(r"([0-9a-f]+)-([0-9a-f]+) (\S{4}) \S+ \S+ \S+\s*(.*)")
"""The first line of a mapping in /proc/PID/smaps: its addresses, its rights, and its file."""


def one_blas_thread() -> None:
    """Before numpy is imported: no kernel here calls a BLAS, and OpenBLAS makes a thread for each core, with buffers.

    What the user has set stays. Processes that this one starts inherit it.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@contextmanager
def starting() -> Iterator[None]:
    """Until `flying` no garbage is collected: what is loaded is kept, and looking it through is a sixth of a start."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@contextmanager
def flying() -> Iterator[None]:
    """Within it all is loaded that will be: garbage is collected, and what there is now is no more looked through.

    That would take 60 ms at a time, fifteen control periods. The compiler's pages go.
    """
    gc.freeze()
    gc.enable()
    _let_go("libllvmlite")
    try:
        yield
    finally:
        gc.unfreeze()


def _let_go(library: str) -> None:
    """Unmap the pages of a library's text and constants; they come back from the file when they are touched.

    Compiled kernels are loaded by LLVM, and the system maps LLVM's file in large pieces around each touch: 65 MB of
    which nothing is needed in flight. Only what was never written is let go: MADV_DONTNEED would undo a change.
    """
    if sys.platform != "linux":
        return
    unchanged = [
        (begin, end) for begin, end, rights, file, anonymous_kb in _mappings()
        if library in file and rights in ("r-xp", "r--p") and not anonymous_kb
    ]  # fmt: skip
    if not unchanged:
        return
    import ctypes  # here and not above: it would come before the first HEARTBEAT

    madvise = ctypes.CDLL(None).madvise
    madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
    for begin, end in unchanged:
        madvise(begin, end - begin, _MADV_DONTNEED)  # an error leaves them where they are


def _mappings() -> Iterator[tuple[int, int, str, str, int]]:
    """(begin, end, rights, file, kB that were written) of each mapping of this process."""
    mapping: re.Match[str] | None = None
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if found := _MAPPING.match(line):
            mapping = found
        elif line.startswith("Anonymous:") and mapping is not None:
            yield int(mapping[1], 16), int(mapping[2], 16), mapping[3], mapping[4], int(line.split()[1])
