"""A small fleet in one object, for the tests of the plant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import msgspec
import numpy as np
from mavsitl_vehicle.plant import parameters as rows
from mavsitl_vehicle.plant.body import body_derivative
from mavsitl_vehicle.plant.lanes import scratch
from mavsitl_vehicle.plant.parameters import parameters_of, plant_parameters
from mavsitl_vehicle.plant.state import Array, Body, Rotors, initial_state
from mavsitl_vehicle.plant.step import linear_acceleration, rk4_step, wind_of

from mavsitl.airframes import Airframe
from mavsitl.scenario import Offnominal, load_airframe

PAPER = load_airframe("paper")
REALISTIC = load_airframe("realistic")
HOVER_RAD_S = PAPER.hover_rotor_speed_rad_s


def airframe(base: Airframe = PAPER, **changes: object) -> Airframe:
    return msgspec.structs.replace(base, **changes)


class Fleet:
    def __init__(
        self,
        base: Airframe = PAPER,
        *,
        offnominal: Offnominal | None = None,
        ground: bool = False,
        height_m: float = 100.0,
        rotor_speed_rad_s: float = HOVER_RAD_S,
        n: int = 1,
    ) -> None:
        self.x = initial_state((0.0, 0.0, height_m), 0.0, rotor_speed_rad_s, n)
        self.parameters = plant_parameters(base, offnominal or Offnominal(), ground, n)
        self.wind = np.zeros((3, n))
        self.held = np.zeros(n, dtype=np.bool_)
        self.command = np.full((4, n), rotor_speed_rad_s)

    def run(self, seconds: float, dt_s: float = 1.0e-3, command: Callable[[float], Array] | None = None) -> None:
        block = scratch(self.x.shape[1])
        for k in range(round(seconds / dt_s)):
            if command is not None:
                self.command[:] = command(k * dt_s)
            rk4_step(self.x, self.command, self.wind, self.parameters, dt_s, self.held, block)

    def acceleration(self) -> Array:
        out = np.empty((3, self.x.shape[1]))
        linear_acceleration(self.x, self.wind, self.parameters, self.held, out)
        return out

    def inertia(self) -> Array:
        return self.parameters[rows.INERTIA : rows.INERTIA + 3, 0]


def body_slope(fleet: Fleet, body: Sequence[float], rotors: Sequence[float] | Array) -> Array:
    """`body_derivative` of the fleet's first vehicle: 13 rows in, 13 out, in the fleet's wind."""
    state = cast("Body", tuple(float(value) for value in body))
    speeds = cast("Rotors", tuple(float(value) for value in rotors))
    return np.array(list(body_derivative(state, speeds, wind_of(fleet.wind, 0), parameters_of(fleet.parameters, 0))))


def rotation(q: Array) -> Array:
    """R of eq 6 from a quaternion (w, x, y, z), written apart from the kernels."""
    w, v = q[0], q[1:]
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross)
