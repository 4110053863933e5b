"""Where numba keeps the compiled kernels: by what they are, not by where they are installed.

numba names a folder by the path of a function's source file. So a second environment, another checkout, or tests that
run in a new environment each time would compile again what there is.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

from numba import config
from numba.core import caching

PACKAGES = ("mavsitl", "mavsitl_vehicle", "mavsitl_ground")


KEPT_S = 30 * 86400.0
"""Kernels that nobody has used for so long are removed when others come in."""


class BySource:
    """A folder for each of our modules in `numba.config.CACHE_DIR`, which is named by a digest of all that compiles.

    That name says what numba's stamp of a source file would: whether what is kept is of this text. The methods are
    those that numba asks its own locators for.
    """

    def __init__(self, function: Any) -> None:
        self._base = Path(config.CACHE_DIR)
        self._module: str = function.__module__
        self._line: int = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Any, file: str) -> BySource | None:
        """None for a function that is not ours and where nothing can be written; numba then asks its own locators."""
        if function.__module__.partition(".")[0] not in PACKAGES:
            return None
        found = cls(function)
        try:
            found.ensure_cache_path()
        except OSError:
            return None
        return found

    def ensure_cache_path(self) -> None:
        """Raises OSError where nothing can be written."""
        folder = Path(self.get_cache_path())
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()

    def get_cache_path(self) -> str:
        return str(self._base / self._module)

    def get_source_stamp(self) -> str:
        return self._base.name

    def get_disambiguator(self) -> str:
        return str(self._line)


def set_up(folder: Path) -> None:
    """Kernels that are defined from now on are kept in `folder`, beside those of other texts."""
    config.CACHE_DIR = str(folder)
    _mark_used(folder)
    # numba does not document the list: with a version that has it no more, paths count as they always did.
    locators = getattr(caching.CacheImpl, "_locator_classes", [])
    if BySource not in locators:
        locators.insert(0, BySource)


def _mark_used(folder: Path) -> None:
    """The time of the last use of kernels is their folder's; what is `KEPT_S` old goes when there is a new folder."""
    try:
        if folder.is_dir():
            os.utime(folder)
            return
        folder.mkdir(parents=True)
        oldest_s = folder.stat().st_mtime - KEPT_S
        unused = [each for each in folder.parent.iterdir() if each.stat().st_mtime < oldest_s]
    except OSError:
        return  # read-only, or another process tidies up: numba says what it cannot write
    for each in unused:
        shutil.rmtree(each, ignore_errors=True)
