"""A block of LANES vehicles side by side, for the processor's vector registers.

A block is a flat array: row i of lane l is at i * LANES + l. With a constant number of lanes in one array the compiler
sees that nothing overlaps, and makes vectors of a loop over the lanes; of columns of (rows, n) it makes none.
"""

from __future__ import annotations

import numpy as np

from mavsitl.compiled import fused
from mavsitl_vehicle.plant.parameters import N_PARAMETERS, Column
from mavsitl_vehicle.plant.state import N_STATES, ROTOR, Array, Body, Rotors, Wind

LANES = 16
"""Two registers of eight numbers, or four of four, so that one's arithmetic hides the other's latency."""

# Rows of a block: the state first, then what else a step reads, then what it gives.
COMMAND = N_STATES
WIND = COMMAND + 4
PARAMETERS = WIND + 3
HELD = PARAMETERS + N_PARAMETERS
"""1 for a held vehicle."""
AFTER = HELD + 1
"""The state after the step."""
TOUCHES = AFTER + N_STATES
"""1 for a vehicle that came within the ground's reach."""
BLOCK_SIZE = (TOUCHES + 1) * LANES


def scratch(n: int) -> Array | None:
    """A block for stepping a fleet of `n`; None for one that has not LANES vehicles.

    With None a kernel is compiled without lanes, in half the time.
    """
    return np.empty(BLOCK_SIZE) if n >= LANES else None


@fused
def gather(block: Array, row: int, rows: int, source: Array, first: int) -> None:
    """Vehicles `first` and on of `source` (rows, n) into the rows from `row` on."""
    for i in range(rows):
        for lane in range(LANES):
            block[(row + i) * LANES + lane] = source[i, first + lane]


@fused
def scatter(block: Array, row: int, rows: int, target: Array, first: int) -> None:
    """The way back."""
    for i in range(rows):
        for lane in range(LANES):
            target[i, first + lane] = block[(row + i) * LANES + lane]


@fused
def body_in(block: Array, lane: int) -> Body:
    return (
        block[lane],
        block[LANES + lane],
        block[2 * LANES + lane],
        block[3 * LANES + lane],
        block[4 * LANES + lane],
        block[5 * LANES + lane],
        block[6 * LANES + lane],
        block[7 * LANES + lane],
        block[8 * LANES + lane],
        block[9 * LANES + lane],
        block[10 * LANES + lane],
        block[11 * LANES + lane],
        block[12 * LANES + lane],
    )


@fused
def four_in(block: Array, row: int, lane: int) -> Rotors:
    """Rotor speeds or commands."""
    at = row * LANES + lane
    return block[at], block[at + LANES], block[at + 2 * LANES], block[at + 3 * LANES]


@fused
def wind_in(block: Array, lane: int) -> Wind:
    at = WIND * LANES + lane
    return block[at], block[at + LANES], block[at + 2 * LANES]


@fused
def parameters_in(block: Array, lane: int) -> Column:
    b, n = block, LANES
    at = PARAMETERS * n + lane
    return (
        b[at], b[at + n], b[at + 2 * n], b[at + 3 * n], b[at + 4 * n], b[at + 5 * n], b[at + 6 * n], b[at + 7 * n],
        b[at + 8 * n], b[at + 9 * n], b[at + 10 * n], b[at + 11 * n], b[at + 12 * n], b[at + 13 * n], b[at + 14 * n],
        b[at + 15 * n], b[at + 16 * n], b[at + 17 * n], b[at + 18 * n], b[at + 19 * n], b[at + 20 * n],
        b[at + 21 * n], b[at + 22 * n], b[at + 23 * n], b[at + 24 * n], b[at + 25 * n], b[at + 26 * n],
        b[at + 27 * n], b[at + 28 * n], b[at + 29 * n],
    )  # fmt: skip


@fused
def put_after(block: Array, lane: int, body: Body, rotors: Rotors) -> None:
    """A step's result into the rows AFTER."""
    at = AFTER * LANES + lane
    block[at], block[at + LANES], block[at + 2 * LANES] = body[0], body[1], body[2]
    block[at + 3 * LANES], block[at + 4 * LANES], block[at + 5 * LANES] = body[3], body[4], body[5]
    block[at + 6 * LANES], block[at + 7 * LANES] = body[6], body[7]
    block[at + 8 * LANES], block[at + 9 * LANES] = body[8], body[9]
    block[at + 10 * LANES], block[at + 11 * LANES], block[at + 12 * LANES] = body[10], body[11], body[12]
    at += ROTOR * LANES
    block[at], block[at + LANES], block[at + 2 * LANES], block[at + 3 * LANES] = rotors
