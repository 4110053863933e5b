"""Seeds are a tree by name: a generator's stream depends on the run's seed and its own name, not on what else draws."""

from __future__ import annotations

from zlib import crc32

import numpy as np


def generator(seed: int, *path: str | int) -> np.random.Generator:
    """The generator of one leaf, e.g. ``generator(7, "vehicle", 0, "wind")``."""
    key = tuple(part if isinstance(part, int) else crc32(part.encode()) for part in path)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(entropy=seed, spawn_key=key)))
