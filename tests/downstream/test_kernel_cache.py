"""Kernels that one installation has compiled serve the next of the same sources, and no other."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from pathlib import Path

import pytest
from numba import config

from mavsitl import kernel_cache
from tests.downstream import steps

PROGRAM = """
import json, pathlib, sys
import platformdirs
platformdirs.user_cache_path = lambda name: pathlib.Path(sys.argv[1])
from mavsitl.control import allocation
allocation.wrench(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
stats = allocation.wrench.stats
print(json.dumps([allocation.__file__, len(stats.cache_hits), len(stats.cache_misses)]))
"""


def installed(folder: Path) -> Path:
    for package, source in steps.PACKAGES.items():
        shutil.copytree(source, folder / package, ignore=shutil.ignore_patterns("__pycache__", "page"))
    return folder


def counts(place: Path, cache: Path) -> tuple[int, int]:
    """Hits and misses of one kernel, in a process that has mavsitl from `place`."""
    env = steps.clean(PYTHONPATH=str(place))
    env.pop("NUMBA_CACHE_DIR", None)
    file, hits, misses = json.loads(steps.run([sys.executable, "-c", PROGRAM, cache], cache.parent, env))
    assert Path(file).is_relative_to(place)
    return hits, misses


def test_another_place_meets_them_and_another_text_does_not(tmp_path: Path) -> None:
    first, second = installed(tmp_path / "first"), installed(tmp_path / "second")
    cache = tmp_path / "cache"
    assert counts(first, cache) == (0, 1)
    assert counts(second, cache) == (1, 0)
    assert len(list((cache / "compiled").iterdir())) == 1
    with (second / "mavsitl_vehicle" / "tick.py").open("a", encoding="utf-8") as file:
        file.write("# another text of what a kernel may call\n")
    assert counts(second, cache) == (0, 1)
    assert counts(first, cache) == (1, 0)


def test_kernels_that_nobody_uses_make_room_for_new_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config, "CACHE_DIR", "")
    ago = {"long": 1.1 * kernel_cache.KEPT_S, "used": 1.1 * kernel_cache.KEPT_S, "lately": 0.9 * kernel_cache.KEPT_S}
    for name, age_s in ago.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "kernel.nbi").touch()
        os.utime(tmp_path / name, times=(time.time() - age_s,) * 2)
    kernel_cache.set_up(tmp_path / "used")
    assert {each.name for each in tmp_path.iterdir()} == {"long", "used", "lately"}
    kernel_cache.set_up(tmp_path / "new")
    assert {each.name for each in tmp_path.iterdir()} == {"used", "lately", "new"}
