"""Numba behind one decorator, so that each compiled text is also plain Python.

``@compiled`` is ``numba.njit(cache=True)`` without fast-math: a compiled function gives, bit for bit, what its text
gives un-jitted. Set ``MAVSITL_JIT=0`` to run the text itself (slow; for debuggers and for the test that holds the two
together).

Numba's cache does not notice a change in a function that a cached function calls. The cache therefore lives in a folder
named by a digest of every source file of the packages and modules that compile: a changed text never meets a stale
cache, and the same text in another environment meets this one (`mavsitl.kernel_cache`).
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])

JIT = os.environ.get("MAVSITL_JIT", "1") != "0"
_COMPILING = ("mavsitl.control", "mavsitl.quaternion", "mavsitl_vehicle", "mavsitl_ground")


def _source_digest() -> str:
    digest = hashlib.blake2b(digest_size=8)
    for name in _COMPILING:
        spec = find_spec(name)
        if spec is None:
            continue
        files = [
            file for folder in spec.submodule_search_locations or () for file in sorted(Path(folder).rglob("*.py"))
        ]
        for file in files or [Path(spec.origin or "")]:
            digest.update(file.read_bytes())
    digest.update(Path(__file__).read_bytes())
    return digest.hexdigest()


def _import_numba() -> Any:
    """numba without scipy, until a kernel needs it; the module.

    numba imports scipy for a look at its version, and its `_check_blas` imports all of scipy.linalg to know whether
    there is a BLAS: 0.1 s and 17 MB for what no kernel here calls. Here it takes the BLAS for granted. numba asks again
    when a kernel with a matrix product is compiled; there scipy is imported, or missed, as ever.
    """
    scipy_is_loaded = "scipy" in sys.modules
    if not scipy_is_loaded:
        sys.modules["scipy"] = None  # type: ignore[assignment]  # an import of it raises ImportError
    try:
        import numba
        from numba.np import linalg
    finally:
        if not scipy_is_loaded:
            del sys.modules["scipy"]
    ensure_blas = getattr(linalg, "ensure_blas", None)  # where a later numba has none, there is nothing to put off
    linalg.ensure_blas = lambda: None
    try:
        import numba.np.arraymath
    finally:
        linalg.ensure_blas = ensure_blas
    return numba


def _set_up_cache() -> None:
    numba = _import_numba()
    if "NUMBA_CACHE_DIR" not in os.environ:
        import platformdirs

        from mavsitl import kernel_cache

        name = f"{_source_digest()}-numba-{numba.__version__}"
        kernel_cache.set_up(platformdirs.user_cache_path("mavsitl") / "compiled" / name)


def compiled(function: F) -> F:
    """Compile `function` with numba on its first call, cached on disk; the text un-jitted under ``MAVSITL_JIT=0``."""
    if not JIT:
        return function
    import numba

    return cast("F", numba.njit(cache=True, fastmath=False, error_model="numpy")(function))


def inlined(function: F) -> F:
    """As `compiled`, for a small function that compiled ones call: it becomes part of their text.

    Compiling it apart would take longer; for large ones see `fused`.
    """
    if not JIT:
        return function
    import numba

    return cast("F", numba.njit(inline="always", cache=True, fastmath=False, error_model="numpy")(function))


def fused(function: F) -> F:
    """As `compiled`, and LLVM puts its code into every compiled function that calls it: for large ones.

    It more than halves the time of a physics step. `inlined` would compile the text anew with each caller.
    """
    if not JIT:
        return function
    import numba

    return cast("F", numba.njit(cache=True, fastmath=False, error_model="numpy", forceinline=True)(function))


if JIT:
    _set_up_cache()


def direct(function: F, *arguments: Any) -> F:
    """The code of a `compiled` function for arguments of the types of these, with which it is called once.

    numba looks at the type of every argument in every call, which for a record takes as long as a law's step. Here
    nobody looks: all later calls have to have the same types, of arrays also the layout. It is for what is called in
    every period, by the one place that makes its arguments.
    """
    function(*arguments)
    if not JIT:
        return function
    import numba

    types = tuple(numba.typeof(argument) for argument in arguments)
    found = cast("Any", function).overloads[types]
    # numba does not document it: of a version that has it no more, calls take longer and do the same.
    return cast("F", getattr(found, "entry_point", function))
