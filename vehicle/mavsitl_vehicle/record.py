"""The vehicle's log: what it writes of itself each period, and when."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mavsitl.dialect import mavlink
from mavsitl.frames import flip_quaternion
from mavsitl.log import topics
from mavsitl.log.block import Array, Block, ned
from mavsitl.log.ulog import Recorder
from mavsitl.scenario import Flight
from mavsitl_vehicle import tick
from mavsitl_vehicle.autopilot import modes
from mavsitl_vehicle.autopilot.modes import Mode
from mavsitl_vehicle.failures import Change

if TYPE_CHECKING:
    from mavsitl_vehicle.vehicle import Vehicle

# Columns of the vehicle's log block.
_TRUTH = slice(0, 17)
_ESTIMATE = slice(17, 30)
_WIND = slice(30, 33)
_INNER = slice(33, 37)
_THRUST = 37
_WIDTH = 38


class Record:
    """The vehicle's log: truth beside estimate every tick, states when they change."""

    def __init__(self, recorder: Recorder, flight: Flight, aboard: bool) -> None:
        """`aboard`: the nets are, so their weights are logged here."""
        largest = flight.airframe.max_rotor_speed_rad_s
        self._block = Block(
            recorder,
            _WIDTH,
            (
                (topics.LOCAL_POSITION_TRUTH, lambda v: np.hstack((ned(v[:, 0:3]), ned(v[:, 3:6])))),
                (topics.ATTITUDE_TRUTH, lambda v: np.column_stack(flip_quaternion(*v[:, 6:10].T))),
                (topics.ANGULAR_VELOCITY_TRUTH, lambda v: ned(v[:, 10:13])),
                (topics.LOCAL_POSITION, lambda v: np.hstack((ned(v[:, 17:20]), ned(v[:, 20:23])))),
                (topics.ATTITUDE, lambda v: np.column_stack(flip_quaternion(*v[:, 23:27].T))),
                (topics.ANGULAR_VELOCITY, lambda v: ned(v[:, 27:30])),
                (topics.WIND_TRUTH, lambda v: ned(v[:, _WIND])),
                (topics.ACTUATOR_MOTORS, lambda v: v[:, 13:17] / largest),
                (topics.ROTOR_STATUS, lambda v: np.column_stack((v[:, 13:17], v[:, 36]))),
                (topics.RATES_SETPOINT, lambda v: np.column_stack((ned(v[:, 33:36]), _thrust_frd(v[:, _THRUST])))),
            ),
        )
        self._weights = recorder.topic(topics.PIDNN_WEIGHTS) if aboard else None
        self._status = recorder.topic(topics.VEHICLE_STATUS)
        self._land = recorder.topic(topics.LAND_DETECTED)
        self._failures = recorder.topic(topics.INJECTED_FAILURE)
        self._recorder = recorder
        self._last_status: tuple[bool, Mode, bool] | None = None
        self._last_land: int | None = None

    def failed(self, now_us: int, severity: int, change: Change) -> None:
        """A failure was injected or cleared."""
        self._recorder.message(now_us, severity, change.text)
        self._failures.append(now_us, change.unit, change.instance, change.kind, change.value)

    def note(self, now_us: int, severity: int, text: str) -> None:
        self._recorder.message(now_us, severity, text)

    def write(self, now_us: int, vehicle: Vehicle) -> None:
        simulation, autopilot = vehicle.simulation, vehicle.autopilot
        row = self._block.row(now_us)
        row[_TRUTH] = simulation.x[:, 0]
        row[_ESTIMATE] = simulation.estimate[:, 0]
        row[_WIND] = simulation.wind[:, 0]
        row[_INNER] = simulation.inner[tick.RATE_SETPOINT : tick.SATURATED + 1, 0]
        row[_THRUST] = simulation.demand[tick.THRUST, 0]
        if self._weights is not None and vehicle.weights is not None:
            self._weights.append(now_us, *vehicle.weights[:, :, 0].T.ravel().tolist())
        commander = autopilot.commander
        status = (commander.armed, commander.mode, commander.failsafe)
        if status != self._last_status:
            self._last_status = status
            nav_state = modes.TABLE[commander.mode].nav_state
            self._status.append(
                now_us, topics.ARMED if commander.armed else topics.DISARMED, nav_state, int(commander.failsafe)
            )
        landed = int(autopilot.land.released_us is None or autopilot.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND)
        if landed != self._last_land:
            self._last_land = landed
            self._land.append(now_us, landed, landed)


def _thrust_frd(thrust: Array) -> Array:
    """PX4's thrust_body: (0, 0, -thrust), (k, 3)."""
    zero = np.zeros_like(thrust)
    return np.column_stack((zero, zero, -thrust))
