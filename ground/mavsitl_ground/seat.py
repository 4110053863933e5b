"""Where a controller of the user's own sits: telemetry to its terms, its demand to the wire, and to the log.

It stands in for `mavsitl_ground.controller.Controller`, which is the paper's.
"""

from __future__ import annotations

from collections.abc import Callable
from math import nan
from typing import Any

import numpy as np

from mavsitl import controllers
from mavsitl.control.arrays import Floats
from mavsitl.controllers import (
    AttitudeDemand,
    ControllerError,
    PositionDemand,
    RateDemand,
    Reference,
    State,
    number,
    unit,
    vector,
)
from mavsitl.frames import Quaternion, Vector, flip_euler, flip_quaternion, flip_vector
from mavsitl.log import topics
from mavsitl.node import Node
from mavsitl.quaternion import IDENTITY, to_euler
from mavsitl.scenario import Flight
from mavsitl_ground import cycle
from mavsitl_ground.cycle import Demand
from mavsitl_ground.demand import Target, send_attitude, send_position, send_rates
from mavsitl_ground.laws import Law
from mavsitl_ground.observer import Observer
from mavsitl_ground.reference import reference_for

controllers.not_theirs(__file__)

OWN = cycle.COLUMNS
"""A row has the columns of the paper's controller, of which this fills what it knows; then what the controller logs."""


class Seat:
    """One vehicle's controller, the object that `controller.own` names.

    Whatever goes wrong in it is told once, and from then on it is not asked any more: the vehicle is to land.
    """

    learns = False
    law: Law | None = None
    weights: tuple[list[float], list[float]] | None = None
    gains: list[float] | None = None
    """These are of the paper's laws, which are not here."""

    def __init__(self, flight: Flight, offset_nwu_m: Vector, failed: Callable[[ControllerError], None]) -> None:
        """`offset_nwu_m` moves the reference; `failed` is told what went wrong. Raises `ControllerError`."""
        self.reference = reference_for(flight.scenario.reference, offset_nwu_m)
        self._flight = flight
        self._name = flight.scenario.controller.own
        self._failed = failed
        self._mass_kg, self._gravity_m_s2 = flight.airframe.mass_kg, flight.airframe.gravity_m_s2
        self._max_thrust_n = flight.airframe.max_thrust_n
        self._idle: Demand = (IDENTITY, *flip_vector(0.0, 0.0, 0.0), 1.0 / flight.airframe.thrust_to_weight)
        self._controller = controllers.make(flight)
        self._used = False
        self._send: Callable[[Node, Target, int], None] = lambda node, target, stamp_us: None
        self._answered: Demand = self._idle
        self.desired_rad: Vector = (0.0, 0.0, 0.0)
        """Roll, pitch and yaw of the newest demand."""
        self._thrust_n = nan
        self.broken = False
        """It has failed."""

    def reset(self) -> None:
        """As at the start of a flight."""
        if not self._used or self.broken:
            return
        self._used = False
        try:
            if hasattr(self._controller, "reset"):
                self._controller.reset()
            else:
                self._controller = controllers.make(self._flight)
        except Exception as error:
            self._fail(error, "reset")

    @property
    def control(self) -> tuple[float, Vector]:
        """U_1 in N; what the controller knows of the wind is its own."""
        return self._thrust_n, (nan, nan, nan)

    def prepare(self) -> None:
        """There is no law to change."""

    def fly_by(self, law: Law) -> None:
        """Raises `ValueError`: the paper's laws are not here."""
        raise ValueError("the attitude is controlled by a controller of one's own: there is no law to change")

    def update(
        self, time_s: float, state: Observer, row: Floats, frames: int, lost: int, rejected: int, age_us: int
    ) -> Demand:
        """One control cycle, as `Controller.update`; what it gives is for `send`."""
        self.reference.move(time_s)
        now = self.reference.now
        reference = Reference(
            _fixed(now["position"]), _fixed(now["velocity"]), _fixed(now["acceleration"]), float(now["yaw"][0, 0])
        )
        x, y, z = reference.acceleration.tolist()
        still = AttitudeDemand.along(
            (self._mass_kg * x, self._mass_kg * y, self._mass_kg * (z + self._gravity_m_s2)), reference.yaw
        )
        attitude, thrust = unit("reference", still.quaternion), nan
        row[:] = nan
        self._answered = self._idle
        if not self.broken:
            self._used = True
            told = State(
                _fixed(state.state["position"]), _fixed(state.state["velocity"]), _fixed(state.state["quaternion"]),
                _fixed(state.state["omega"]), age_us * 1e-6,
            )  # fmt: skip
            try:
                demand = self._controller.update(time_s, told, reference)
                attitude, thrust = self._take(demand, attitude)
                self._log(row)
            except Exception as error:
                self._fail(error, f"update at {time_s:.3f} s")
        self.desired_rad, self._thrust_n = to_euler(attitude), thrust * self._max_thrust_n
        position, velocity = reference.position.tolist(), reference.velocity.tolist()
        row[cycle.POSITION : cycle.POSITION + 3] = flip_vector(*position)
        row[cycle.VELOCITY : cycle.VELOCITY + 3] = flip_vector(*velocity)
        row[cycle.YAW] = -reference.yaw
        row[cycle.DESIRED : cycle.DESIRED + 3] = flip_euler(*self.desired_rad)
        row[cycle.THRUST_BODY : cycle.THRUST_BODY + 3] = 0.0, 0.0, -thrust
        row[cycle.U1] = self._thrust_n
        row[cycle.LINK : cycle.LINK + 4] = frames, lost, rejected, age_us
        return self._answered

    def send(self, node: Node, target: Target, stamp_us: int, demand: Demand) -> None:
        """The newest answer, or another demand: of rates, before the flight and while not in control."""
        if demand is self._answered and demand is not self._idle:
            self._send(node, target, stamp_us)
        else:
            send_rates(node, target, stamp_us, demand)

    def _take(self, demand: Any, still: Quaternion) -> tuple[Quaternion, float]:
        """Make an answer of it; the attitude that it is after, and its thrust, 0 to 1, NaN where it has none.

        `still`: the attitude of one that says none. Raises `ControllerError` for what is no demand.
        """
        match demand:
            case AttitudeDemand():
                attitude, thrust = unit("quaternion", demand.quaternion), self._share(demand.thrust)
                answer: Demand = (flip_quaternion(*attitude), 0.0, 0.0, 0.0, thrust)
                self._send = lambda node, target, stamp_us: send_attitude(node, target, stamp_us, answer)
            case RateDemand():
                attitude = still if demand.quaternion is None else unit("quaternion", demand.quaternion)
                thrust = self._share(demand.thrust)
                answer = (IDENTITY, *flip_vector(*vector("omega", demand.omega)), thrust)
                self._send = lambda node, target, stamp_us: send_rates(node, target, stamp_us, answer)
            case PositionDemand():
                attitude, thrust = still, nan
                position, velocity, acceleration = (
                    None if values is None else flip_vector(*vector(name, values))
                    for name, values in (
                        ("position", demand.position), ("velocity", demand.velocity),
                        ("acceleration", demand.acceleration),
                    )
                )  # fmt: skip
                if position is velocity is acceleration is None:
                    raise ControllerError("PositionDemand() asks for nothing; needed: a position, a velocity, ...")
                yaw = -number("yaw", demand.yaw)
                self._send = lambda node, target, stamp_us: send_position(
                    node, target, stamp_us, position, velocity, acceleration, yaw
                )
                answer = (IDENTITY, 0.0, 0.0, 0.0, thrust)
            case _:
                raise ControllerError(
                    f"update gave {type(demand).__name__}; needed: AttitudeDemand, RateDemand or PositionDemand"
                )
        self._answered = answer
        return attitude, thrust

    def _share(self, thrust_n: Any) -> float:
        return min(max(number("thrust", thrust_n) / self._max_thrust_n, 0.0), 1.0)

    def _log(self, row: Floats) -> None:
        if not hasattr(self._controller, "log"):
            return
        values = np.asarray(self._controller.log(), dtype=np.float64).ravel()
        if len(values) > topics.MOST_LOGGED:
            raise ControllerError(f"log() gave {len(values)} numbers; allowed: {topics.MOST_LOGGED} at most")
        row[OWN : OWN + len(values)] = values

    def _fail(self, error: Exception, where: str) -> None:
        self.broken = True
        self._answered = self._idle
        self._failed(controllers.failure(f"the controller {self._name} failed in {where}", error))


def _fixed(field: Any) -> Floats:
    """A record's vector (1, k, 1) as (k,), that neither the next message nor the controller changes."""
    values: Floats = field[0, :, 0].copy()
    values.flags.writeable = False
    return values
