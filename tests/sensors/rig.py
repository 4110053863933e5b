"""A vehicle that flies by its filter, with the truth beside it: no link and no modes between."""

from __future__ import annotations

from math import nan
from typing import Any

import numpy as np
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.autopilot.position import PositionControl
from mavsitl_vehicle.autopilot.setpoints import PositionSetpoint, State
from mavsitl_vehicle.failures import Failures, Kind, Unit
from mavsitl_vehicle.sensors import ekf, imu
from mavsitl_vehicle.sensors.estimator import SensedEstimator
from mavsitl_vehicle.sensors.status import EstimatorStatus
from mavsitl_vehicle.simulation import Simulation
from numpy.typing import NDArray

from mavsitl.quaternion import conjugate, multiply
from mavsitl.scenario import load
from tests.autopilot.fly import GAINS, VALUES

Array = NDArray[np.float64]

PERIOD_S = 0.004
NOWHERE = (nan, nan, nan)


class Rig:
    """One vehicle, or `n` of which the first is steered, at rest on the ground.

    `changes` are scenario keys with "__" for dots.
    """

    def __init__(self, *, seed: int = 1, n: int = 1, scenario: str = "takeoff-hover", **changes: Any) -> None:
        overrides = {key.replace("__", "."): value for key, value in changes.items()}
        flight = load(scenario, {"estimator.kind": "ekf", **overrides})
        frame = flight.airframe
        self.failures = Failures()
        self.parameters = Parameters(frame.parameters, flight.scenario.parameters)
        self.simulation = Simulation(flight, self.parameters, seed, n, self.failures)
        self.parameters.subscribe(lambda name, value: self.simulation.set_parameter(0, name))
        self.control = PositionControl(
            VALUES | GAINS["paper"], frame.gravity_m_s2, 1.0 / frame.thrust_to_weight, PERIOD_S
        )
        self.time_s = 0.0

    @property
    def sensed(self) -> SensedEstimator:
        assert self.simulation.sensed is not None
        return self.simulation.sensed

    @property
    def status(self) -> EstimatorStatus:
        return self.simulation.estimator_status

    @property
    def position_error(self) -> Array:
        error: Array = self.simulation.estimate[:3, 0] - self.simulation.x[:3, 0]
        return error

    def break_(self, unit: Unit, kind: Kind) -> None:
        self.failures.set(unit, kind)

    def rest(self, seconds: float) -> None:
        """On the ground or in the clamp, rotors still."""
        self.simulation.at_rest[:] = True
        for j in range(self.simulation.n):
            self.simulation.set_demand(j, None)
        for _ in range(round(seconds / PERIOD_S)):
            self.simulation.advance(-1.0)
            self.time_s += PERIOD_S

    def tick(self, position_nwu_m: tuple[float, float, float], yaw_rad: float = 0.0) -> None:
        """One control period towards a position, by the estimate."""
        self.simulation.at_rest[:] = False
        self.simulation.held[:] = False
        state = State.of(self.simulation.estimate[:, 0].tolist())
        target = PositionSetpoint(position_nwu_m, NOWHERE, NOWHERE, yaw_rad, nan)
        self.simulation.set_demand(0, self.control.update(target, state, np.inf))
        self.simulation.advance(self.time_s)
        self.time_s += PERIOD_S

    def fly(self, seconds: float, position_nwu_m: tuple[float, float, float] = (0.0, 0.0, 5.0)) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            self.tick(position_nwu_m)

    def until(self, seconds: float, **what: Any) -> float:
        """Hover until the status says `what`; how long it took. Fails after `seconds`."""
        start_s = self.time_s
        while not all(getattr(self.status, name) == value for name, value in what.items()):
            assert self.time_s - start_s < seconds, f"{what} not within {seconds} s: {self.status}"
            self.tick((0.0, 0.0, 5.0))
        return self.time_s - start_s


def up(**changes: Any) -> Rig:
    """Aligned and hovering 5 m above the start."""
    rig = Rig(**changes)
    rig.rest(1.0)
    rig.fly(6.0)
    return rig


class Watch:
    """The filter's error against the truth at the filter's own time, which is `depth` periods ago."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._truths: list[Array] = []

    def note(self) -> None:
        """After each tick."""
        sensed, x = self._rig.sensed, self._rig.simulation.x[:, 0]
        truth = np.concatenate(
            (
                x[:10], sensed.imu.state[imu.BIAS : imu.BIAS + 6, 0], sensed.gps._drift[:, 0],
                sensed.barometer._offset[:, 0], sensed.magnetometer._offset[:, 0],
            )
        )  # fmt: skip
        self._truths.append(truth)
        del self._truths[: -1 - sensed.depth]

    def error(self) -> Array:
        """(ERROR_ROWS,) true less estimated."""
        estimate, truth = self._rig.sensed.x[:, 0], self._truths[0]
        w, x, y, z = multiply(tuple(truth[6:10].tolist()), conjugate(tuple(estimate[6:10].tolist())))
        turned = 2.0 * np.array([x, y, z]) * (1.0 if w >= 0.0 else -1.0)
        error: Array = np.concatenate(
            (truth[:6] - estimate[:6], turned, truth[10:] - estimate[ekf.GYRO_BIAS : ekf.STATE_ROWS])
        )
        return error

    def covariance(self) -> Array:
        covariance: Array = self._rig.sensed.p[:, :, 0]
        return covariance

    def nees(self, rows: slice = slice(0, ekf.ERROR_ROWS)) -> float:
        """Normalised estimation error squared: chi-squared with as many degrees of freedom as rows."""
        error = self.error()[rows]
        return float(error @ np.linalg.solve(self.covariance()[rows, rows], error))
