"""What the laws share: their array type and the choice of vehicles along the fleet axis."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Floats: TypeAlias = npt.NDArray[np.float64]
"""C-contiguous float64; another layout is correct too but compiles a second kernel on its first call."""

Counts: TypeAlias = npt.NDArray[np.int64]


def at(vehicle: int | None) -> int | slice:
    """Index along the fleet axis: one vehicle, or all of them for None."""
    return slice(None) if vehicle is None else vehicle
