"""The vehicle's log: what it writes of itself each period, and when."""

from __future__ import annotations

from functools import partial
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from mavsitl.dialect import mavlink
from mavsitl.geodesy import Origin
from mavsitl.log import topics
from mavsitl.log.block import Array, Block, Window, columns, ned
from mavsitl.log.ulog import Recorder
from mavsitl.scenario import Flight
from mavsitl_vehicle import tick
from mavsitl_vehicle.autopilot import modes
from mavsitl_vehicle.autopilot.autopilot import Shown
from mavsitl_vehicle.autopilot.health import Health
from mavsitl_vehicle.autopilot.telemetry import atmosphere, estimator_flags
from mavsitl_vehicle.failures import Change, has_sensors
from mavsitl_vehicle.sensors import ekf, imu
from mavsitl_vehicle.sensors.estimator import SensedEstimator
from mavsitl_vehicle.sensors.status import EstimatorStatus

if TYPE_CHECKING:
    from mavsitl_vehicle.simulation import Simulation
    from mavsitl_vehicle.vehicle import Vehicle

PORTS_US = 1_000_000
"""Between two rows of the ports' counters."""


class Record:
    """The vehicle's log: truth beside estimate every tick, states when they change."""

    def __init__(self, recorder: Recorder, flight: Flight, simulation: Simulation, column: int, aboard: bool) -> None:
        """`column`: the vehicle's of the simulation; `aboard`: the nets are, so their weights are logged here."""
        largest = flight.airframe.max_rotor_speed_rad_s
        truth, rotors, estimate = tick.LOG_TRUTH, tick.LOG_ROTORS, tick.LOG_ESTIMATE
        self._window = Window(
            recorder,
            (
                (topics.LOCAL_POSITION_TRUTH, columns(truth, truth + 6)),
                (topics.ATTITUDE_TRUTH, columns(truth + 6, truth + 10)),
                (topics.ANGULAR_VELOCITY_TRUTH, columns(truth + 10, truth + 13)),
                (topics.LOCAL_POSITION, columns(estimate, estimate + 6)),
                (topics.ATTITUDE, columns(estimate + 6, estimate + 10)),
                (topics.ANGULAR_VELOCITY, columns(estimate + 10, estimate + 13)),
                (topics.WIND_TRUTH, columns(tick.LOG_WIND, tick.LOG_WIND + 3)),
                (topics.ACTUATOR_MOTORS, lambda v: v[:, rotors : rotors + 4] / largest),
                (topics.ROTOR_STATUS, columns(rotors, tick.LOG_SATURATED + 1)),
                (topics.RATES_SETPOINT, columns(tick.LOG_RATE_SETPOINT, tick.LOG_THRUST_BODY + 3)),
            ),
            partial(simulation.logged, column),
        )
        self._sensors = SensorRecord(recorder, flight) if has_sensors(flight.scenario) else None
        self._weights = recorder.topic(topics.PIDNN_WEIGHTS) if aboard else None
        self._status = recorder.topic(topics.VEHICLE_STATUS)
        self._land = recorder.topic(topics.LAND_DETECTED)
        self._failures = recorder.topic(topics.INJECTED_FAILURE)
        self._recorder = recorder
        self._ports_due_us = 0
        self._shown: Shown | None = None

    def failed(self, now_us: int, severity: int, change: Change) -> None:
        """A failure was injected or cleared."""
        self._recorder.message(now_us, severity, change.text)
        self._failures.append(now_us, change.unit, change.instance, change.kind, change.value)

    def note(self, now_us: int, severity: int, text: str) -> None:
        self._recorder.message(now_us, severity, text)

    def write(self, now_us: int, vehicle: Vehicle) -> None:
        """The vehicle's step to `now_us` is done."""
        autopilot = vehicle.autopilot
        self._window.take(now_us)
        if self._sensors is not None and vehicle.simulation.sensed is not None:
            self._sensors.write(now_us, vehicle.simulation.sensed, autopilot.health)
        if self._weights is not None and vehicle.weights is not None:
            self._weights.append(now_us, *vehicle.weights[:, :, 0].T.ravel().tolist())
        if now_us >= self._ports_due_us:
            self._ports_due_us = now_us + PORTS_US
            self._write_ports(now_us, vehicle)
        if autopilot.shown is not self._shown and autopilot.shown is not None:
            self._write_state(now_us, autopilot.shown)

    def _write_state(self, now_us: int, shown: Shown) -> None:
        """Of what is shown the log tells what it does not tell already."""
        before, self._shown = self._shown, shown
        if before is None or shown[:3] != before[:3]:
            self._status.append(
                now_us, topics.ARMED if shown.armed else topics.DISARMED, modes.TABLE[shown.mode].nav_state,
                int(shown.failsafe),
            )  # fmt: skip
        landed = int(shown.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND)
        if before is None or landed != int(before.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND):
            self._land.append(now_us, landed, landed)

    def _write_ports(self, now_us: int, vehicle: Vehicle) -> None:
        for topic, port in zip(topics.TELEMETRY_STATUS, vehicle.autopilot.ports, strict=False):
            node, counted = port.node, port.node.counters
            lost = sum(source.lost for source in node.sources.values())
            dropped = counted.oversize + counted.abandoned
            self._recorder.topic(topic).append(
                now_us, counted.frames, lost, counted.rejected, dropped,
                counted.bad_crc, counted.bad_length, counted.unknown_id, counted.incompatible, counted.unsupported,
            )  # fmt: skip


class SensorRecord:
    """What the sensors measured, each row when it came, and what the filter makes of it."""

    def __init__(self, recorder: Recorder, flight: Flight) -> None:
        scenario = flight.scenario
        period_us, start = scenario.rates.control_period_us, scenario.start
        self._period_s = period_us / 1e6
        self._origin = Origin(start.latitude_deg, start.longitude_deg, start.altitude_amsl_m)

        def combined(v: Array) -> Array:
            dt = np.full(len(v), period_us)
            return np.column_stack((ned(v[:, :3]), dt, ned(v[:, 3:]), dt))

        self._imu = Block(recorder, 6, ((topics.SENSOR_COMBINED, combined),))
        self._gps = recorder.topic(topics.GPS_POSITION)
        self._air = recorder.topic(topics.AIR_DATA)
        self._mag = recorder.topic(topics.MAGNETOMETER)
        self._status = recorder.topic(topics.ESTIMATOR_STATUS)
        self._bias = recorder.topic(topics.SENSOR_BIAS)
        self._shown: EstimatorStatus | None = None

    def write(self, now_us: int, sensed: SensedEstimator, health: Health) -> None:
        if not sensed.now_us:
            return
        self._imu.row(now_us)[:] = sensed.imu.state[imu.DELTA : imu.DELTA + 6, 0] / self._period_s
        origin = self._origin
        for sensor, came in sensed.came:
            sampled_us = max(now_us - (sensed.now_us - came.stamp_us), 0)
            if sensor is sensed.gps:
                fix = sensed.gps_reading(came)
                (x, y, z), (vx, vy, vz) = came.values[:3, 0].tolist(), came.values[3:, 0].tolist()
                eph, epv, evs = (inf, inf, inf) if fix is None else (fix.eph_m, fix.epv_m, fix.evs_m_s)
                kind = mavlink.GPS_FIX_TYPE_NO_FIX if fix is None else mavlink.GPS_FIX_TYPE_3D_FIX
                self._gps.append(
                    now_us, sampled_us, *origin.to_global(x, y), origin.altitude_amsl_m + z, eph, epv, evs,
                    vx, -vy, -vz, kind, came.satellites,
                )  # fmt: skip
            elif sensor is sensed.barometer:
                altitude = origin.altitude_amsl_m + float(came.values[0, 0])
                self._air.append(now_us, sampled_us, altitude, 100.0 * atmosphere(altitude)[0])
            else:
                mx, my, mz = came.values[:, 0].tolist()
                self._mag.append(now_us, sampled_us, mx, -my, -mz)
        status = sensed.status
        if status is not self._shown:
            self._shown = status
            self._status.append(
                now_us, status.eph_m, status.epv_m, status.velocity_ratio, status.position_ratio, status.height_ratio,
                status.mag_ratio, estimator_flags(health, status),
            )  # fmt: skip
            bx, by, bz, ax, ay, az = sensed.x[ekf.GYRO_BIAS : ekf.GYRO_BIAS + 6, 0].tolist()
            self._bias.append(now_us, bx, -by, -bz, ax, -ay, -az)
