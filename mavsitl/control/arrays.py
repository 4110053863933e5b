"""What the laws share: their array type and the choice of vehicles along the fleet axis."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Floats: TypeAlias = npt.NDArray[np.float64]
"""C-contiguous float64; another layout is correct too but compiles a second kernel on its first call."""

Counts: TypeAlias = npt.NDArray[np.int64]


Record: TypeAlias = npt.NDArray[np.void]
"""One record, (1,): named numbers, arrays and records in one piece of memory."""


_layouts: dict[np.dtype[np.void], np.dtype[np.void]] = {}
"""Each layout once: numba knows a layout that is the same object in no time, and compares an equal one by field."""


def record(**fields: Any) -> Record:
    """A record of copies of these numbers, arrays and records, under their names.

    One argument of a compiled function in the place of many: each array costs a call 50 ns. The function takes element
    0 and what it needs by name, ``own = memory[0]; own["integral"]``; compiled or not, that is no copy.
    """
    parts = {name: np.asarray(value) for name, value in fields.items()}
    parts = {name: part.reshape(()) if part.dtype.names else part for name, part in parts.items()}
    layout = np.dtype([(name, part.dtype, part.shape) for name, part in parts.items()], align=True)
    made = np.zeros(1, _layouts.setdefault(layout, layout))
    for name, part in parts.items():
        made[name][0] = part
    return made


def at(vehicle: int | None) -> int | slice:
    """Index along the fleet axis: one vehicle, or all of them for None."""
    return slice(None) if vehicle is None else vehicle
