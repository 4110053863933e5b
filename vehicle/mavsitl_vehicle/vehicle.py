"""The vehicle: simulation and autopilot as one sans-IO core that a driver of the bridge runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mavsitl.dialect import mavlink
from mavsitl.frames import flip_quaternion
from mavsitl.log import topics
from mavsitl.log.block import Array, Block, ned
from mavsitl.log.ulog import Recorder
from mavsitl.scenario import Flight
from mavsitl_vehicle import tick
from mavsitl_vehicle.autopilot import modes
from mavsitl_vehicle.autopilot.autopilot import Autopilot
from mavsitl_vehicle.autopilot.modes import Mode
from mavsitl_vehicle.autopilot.seated import SeatedLaw
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint, Setpoint
from mavsitl_vehicle.simulation import Simulation


class Vehicle:
    """One vehicle. `receive` datagrams at any time; `step` once a control period; then take each port's `datagrams`."""

    def __init__(
        self,
        flight: Flight,
        recorder: Recorder,
        *,
        seed: int,
        system_id: int = 1,
        ports: Sequence[str] = ("offboard",),
        lockstep: bool = False,
    ) -> None:
        """`ports` name the links in order: "offboard", "gcs".

        In `lockstep` the state is streamed every tick from the first.
        """
        self.period_us = flight.scenario.rates.control_period_us
        self.autopilot = Autopilot(flight, system_id, ports)
        self.simulation = Simulation(flight, self.autopilot.parameters, seed)
        self._flight = flight
        self._seated = SeatedLaw(flight) if flight.scenario.controller.inner == "pidnn" else None
        self._record = _Record(recorder, flight, aboard=self._seated is not None)
        self._now_us = -self.period_us
        self._done = False
        if lockstep:
            for port in self.autopilot.ports:
                for message_id in _STATE_MESSAGES[flight.scenario.controller.telemetry]:
                    port.schedule.set_interval(message_id, self.period_us, 0)

    @property
    def token_us(self) -> int:
        """The stamp that the newest off-board setpoint echoes; lock-step advances when it is the tick's own."""
        return self.autopilot.token_us

    @property
    def weights(self) -> Array | None:
        """Output weights (3 outputs P I D, 3 axes, 1) of the PIDNN aboard; None where none is seated."""
        return None if self._seated is None else self._seated.weights

    @property
    def finished(self) -> bool:
        """It has flown and is disarmed again."""
        return self._done

    @property
    def succeeded(self) -> bool:
        """As `finished`: for a vehicle every landing is one."""
        return self._done

    @property
    def flight_time_s(self) -> float:
        """Since the release; negative before it."""
        released = self.autopilot.released_us
        return -1.0 if released is None else (self._now_us - released) / 1e6

    @property
    def counters(self) -> Any:
        """Frames received and refused, by reason, of the first port."""
        return self.autopilot.ports[0].node.counters

    def receive(self, port: int, datagram: bytes) -> int:
        """One datagram from a link; the number of valid frames in it."""
        return self.autopilot.receive(port, datagram, self._now_us)

    def step(self, now_us: int) -> None:
        """Fly from the last step to `now_us`, one control period later, and say what is to be said there."""
        autopilot, simulation = self.autopilot, self.simulation
        first = self._now_us < 0
        self._now_us = now_us
        if not first:
            simulation.held[0] = autopilot.held
            setpoint = autopilot.decide(now_us - self.period_us)
            simulation.set_demand(0, self._inner_law(setpoint))
            released_us = autopilot.released_us
            flown_s = -1.0 if released_us is None else (now_us - self.period_us - released_us) / 1e6
            simulation.advance(flown_s)
        estimate = simulation.estimate[:, 0].tolist()
        autopilot.estimate = estimate
        wind = simulation.wind[:, 0].tolist()
        autopilot.true_wind = (wind[0], wind[1], wind[2])
        autopilot.observe(now_us)
        autopilot.report(now_us)
        self._record.write(now_us, self)
        if autopilot.released_us is not None and not autopilot.commander.armed:
            self._done = True
            self._after_flight()

    def _after_flight(self) -> None:
        """Ready for the next: where the flight began in a clamp, the clamp takes the vehicle back."""
        if self._flight.scenario.start.clamp:
            self.simulation.put_back()
            self.autopilot.held = True
            self.autopilot.landed_state = mavlink.MAV_LANDED_STATE_ON_GROUND
        if self.autopilot.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND:
            self.autopilot.released_us = None

    def datagrams(self, port: int, *, combine: bool) -> list[bytes]:
        """What goes out on a link: one message a datagram, or all of a tick in one (`combine`)."""
        return self.autopilot.ports[port].node.datagrams(combine=combine)

    def _inner_law(self, setpoint: Setpoint | None) -> Setpoint | None:
        """With the PIDNN aboard, an attitude setpoint becomes a torque by it; all else passes."""
        law = self._seated
        if (
            law is None
            or not isinstance(setpoint, AttitudeSetpoint)
            or self.autopilot.commander.mode is not Mode.OFFBOARD
        ):
            return setpoint
        if self.autopilot.released_us is None:
            law.reset()
        return law.update(setpoint, self.autopilot.setpoint_us or 0, self.simulation.estimate[:, 0])


_STATE_MESSAGES = {
    "odometry": (mavlink.MAVLINK_MSG_ID_ODOMETRY,),
    "split": (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED),
}


# vehicle_status.arming_state
DISARMED, ARMED = 1, 2

# Columns of the vehicle's log block.
_TRUTH = slice(0, 17)
_ESTIMATE = slice(17, 30)
_WIND = slice(30, 33)
_INNER = slice(33, 37)
_THRUST = 37
_WIDTH = 38


class _Record:
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
        self._last_status: tuple[bool, Mode, bool] | None = None
        self._last_land: int | None = None

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
            self._status.append(now_us, ARMED if commander.armed else DISARMED, nav_state, int(commander.failsafe))
        landed = int(autopilot.released_us is None or autopilot.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND)
        if landed != self._last_land:
            self._last_land = landed
            self._land.append(now_us, landed, landed)


def _thrust_frd(thrust: Array) -> Array:
    """PX4's thrust_body: (0, 0, -thrust), (k, 3)."""
    zero = np.zeros_like(thrust)
    return np.column_stack((zero, zero, -thrust))


def build(flight: Flight, recorder: Recorder, **options: Any) -> Vehicle:
    """The entry point `mavsitl.vehicle`: a vehicle core for the bridge's drivers."""
    return Vehicle(flight, recorder, **options)
