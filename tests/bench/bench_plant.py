"""Time the plant's step: ``python tests/bench/bench_plant.py``. Four steps of 1 ms as in a control cycle."""

from __future__ import annotations

from timeit import repeat

import numpy as np
from mavsitl_vehicle.plant.lanes import scratch
from mavsitl_vehicle.plant.parameters import plant_parameters
from mavsitl_vehicle.plant.state import Array, initial_state
from mavsitl_vehicle.plant.step import rk4_step
from numpy.typing import NDArray

from mavsitl.compiled import compiled
from mavsitl.scenario import Offnominal, load_airframe

SUBSTEPS = 4
CALLS = 20_000


@compiled
def cycles(calls: int, x: Array, command: Array, wind: Array, parameters: Array, held: NDArray[np.bool_]) -> None:
    block = scratch(x.shape[1])
    for _ in range(calls):
        for _ in range(SUBSTEPS):
            rk4_step(x, command, wind, parameters, 1.0e-3, held, block)


def measure(name: str, n: int, flying: bool) -> float:
    """Nanoseconds per vehicle and step, the best of seven."""
    airframe = load_airframe(name)
    speed = airframe.hover_rotor_speed_rad_s if flying else 0.0
    x = initial_state((0.0, 0.0, 1.0e4 if flying else 0.0), 0.3, speed, n)
    command = np.full((4, n), speed)
    wind = np.full((3, n), 1.0 if flying else 0.0)
    parameters = plant_parameters(airframe, Offnominal(), True, n)
    held = np.zeros(n, dtype=np.bool_)
    calls = CALLS // n

    def run() -> None:
        cycles(calls, x, command, wind, parameters, held)

    run()
    return min(repeat(run, number=1, repeat=7)) / (calls * SUBSTEPS * n) * 1.0e9


def main() -> None:
    for name in ("paper", "realistic"):
        for n in (1, 16):
            for flying in (True, False):
                where = "air" if flying else "ground"
                print(f"{name:10} n = {n:2} {where:6} {measure(name, n, flying):6.0f} ns per vehicle step")


if __name__ == "__main__":
    main()
