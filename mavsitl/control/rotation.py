"""`mavsitl.quaternion` for compiled functions: the same text, compiled, and what numba's library leaves out of it."""

from __future__ import annotations

import math

from mavsitl import quaternion
from mavsitl.compiled import compiled, inlined
from mavsitl.frames import Quaternion

to_euler = compiled(quaternion.to_euler)
from_euler = compiled(quaternion.from_euler)
euler_rates = compiled(quaternion.euler_rates)
rotate = compiled(quaternion.rotate)

_HALF_OF_THE_BITS = 134217729.0  # 2^27 + 1: parts a float64 into two of 26 bits, whose products are exact


@inlined
def _square(a: float) -> tuple[float, float]:
    """a a as a rounded product and its rounding error."""
    shifted = _HALF_OF_THE_BITS * a
    high = shifted - (shifted - a)
    low = a - high
    product = a * a
    return product, high * high - product + 2.0 * high * low + low * low


@inlined
def norm(w: float, x: float, y: float, z: float) -> float:
    """``math.hypot(w, x, y, z)``, to the last bit, which numba has for two arguments alone; for norms near 1."""
    total, rest = 0.0, 0.0
    for part in (w, x, y, z):
        product, error = _square(part)
        before, total = total, total + product
        added = total - before
        rest += (before - (total - added)) + (product - added) + error
    root = math.sqrt(total + rest)
    product, error = _square(root)
    # One Newton step, with root^2 to twice the digits.
    return root + (total - product + (rest - error)) / (2.0 * root)


@inlined
def normalise(w: float, x: float, y: float, z: float) -> Quaternion:
    """`mavsitl.quaternion.normalise` where the norm is known to be near 1."""
    length = norm(w, x, y, z)
    return w / length, x / length, y / length, z / length
