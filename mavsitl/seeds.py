"""Seeds are a tree by name: a generator's stream depends on the run's seed and its own name, not on what else draws."""

from __future__ import annotations

from zlib import crc32

import numpy as np


def generator(seed: int, *path: str | int) -> np.random.Generator:
    """The generator of one leaf, e.g. ``generator(7, "vehicle", 0, "wind")``."""
    return np.random.Generator(np.random.PCG64(_sequence(seed, path)))


def of_vehicle(seed: int, vehicle: int) -> int:
    """For what draws by a seed of its own beside a vehicle of a fleet, such as its links; the first has the run's."""
    return seed if vehicle == 0 else int(_sequence(seed, ("vehicle", vehicle)).generate_state(1)[0])


def _sequence(seed: int, path: tuple[str | int, ...]) -> np.random.SeedSequence:
    key = tuple(part if isinstance(part, int) else crc32(part.encode()) for part in path)
    return np.random.SeedSequence(entropy=seed, spawn_key=key)
