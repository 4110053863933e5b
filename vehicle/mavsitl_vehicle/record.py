"""The vehicle's log: what it writes of itself each period, now and then, and when something happens."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from math import hypot, inf, nan
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mavsitl.dialect import mavlink
from mavsitl.frames import flip_vector
from mavsitl.geodesy import Origin
from mavsitl.log import topics
from mavsitl.log.block import Array, Block, Group, Window, columns, ned
from mavsitl.log.ulog import Recorder
from mavsitl.scenario import Flight
from mavsitl.services.command import Command
from mavsitl_vehicle import tick
from mavsitl_vehicle.autopilot import modes, telemetry
from mavsitl_vehicle.autopilot.autopilot import Autopilot, Shown
from mavsitl_vehicle.autopilot.commander import Commander
from mavsitl_vehicle.autopilot.health import Validity
from mavsitl_vehicle.autopilot.ports import COMPONENT_ID
from mavsitl_vehicle.failures import Change, has_sensors
from mavsitl_vehicle.sensors import ekf, imu
from mavsitl_vehicle.sensors.estimator import SensedEstimator
from mavsitl_vehicle.sensors.status import EstimatorStatus, GpsReading

if TYPE_CHECKING:
    from mavsitl_vehicle.simulation import Simulation
    from mavsitl_vehicle.vehicle import Vehicle

LOOK_US, SLOW_US, SECOND_US = 100_000, 500_000, 1_000_000
"""Between two rows of setpoints of position and of sticks; of battery, flags and GPS; of wind and the ports."""
GLOBAL_US, INTEGRAL_US, TORQUE_US = 200_000, 20_000, 8_000
"""Between two rows of global positions, of the rate loop's integrals, and of torque and thrust."""


def _to_wire(largest_rad_s: float) -> Array:
    """(tick.LOG_WIDTH,): times this the kernel's log is NED and FRD, and its commanded speeds shares of the largest."""
    signs = np.ones(tick.LOG_WIDTH)
    vectors = (0, 3, 10, 17, 20, 27, tick.LOG_WIND, tick.LOG_RATE_SETPOINT, tick.LOG_TORQUE, tick.LOG_RATE_INTEGRAL)
    for vector in vectors:
        signs[vector + 1 : vector + 3] = -1.0
    for quaternion in (6, 23, tick.LOG_ATTITUDE):
        signs[quaternion + 2 : quaternion + 4] = -1.0
    signs[[tick.LOG_THRUST, tick.LOG_YAW_RATE]] = -1.0
    signs[tick.LOG_COMMANDED : tick.LOG_COMMANDED + 4] = 1.0 / largest_rad_s
    return signs


def _flown(*kinds: float) -> Callable[[Array], NDArray[np.bool_]]:
    return lambda v: reduce(np.logical_or, [v[:, tick.LOG_KIND] == kind for kind in kinds])


_ATTITUDE_FLOWN = _flown(tick.ATTITUDE_KIND)
_RATES_FLOWN = _flown(tick.ATTITUDE_KIND, tick.RATE_KIND)
_TURNING = _flown(tick.ATTITUDE_KIND, tick.RATE_KIND, tick.TORQUE_KIND)


def _thrust(v: Array) -> Array:
    """PX4's thrust_body: (0, 0, -thrust), (k, 3)."""
    thrust = np.zeros((len(v), 3))
    thrust[:, 2] = v[:, tick.LOG_THRUST]
    return thrust


def _attitude_setpoint(v: Array) -> Array:
    w, x, y, z = v[:, tick.LOG_ATTITUDE : tick.LOG_ATTITUDE + 4].T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.column_stack((roll, pitch, yaw, _thrust(v), w, x, y, z, v[:, tick.LOG_YAW_RATE]))


class Record:
    """The vehicle's log: truth beside estimate every tick, states when they change, and what is slow now and then."""

    def __init__(self, recorder: Recorder, flight: Flight, simulation: Simulation, column: int, aboard: bool) -> None:
        """`column`: the vehicle's of the simulation; `aboard`: the nets are, so their weights are logged here."""
        scenario, start = flight.scenario, flight.scenario.start
        self._origin = Origin(start.latitude_deg, start.longitude_deg, start.altitude_amsl_m)
        self._valid = Validity()
        to_wire = _to_wire(flight.airframe.max_rotor_speed_rad_s)

        def newest(count: int) -> Array:
            return simulation.logged(column, count) * to_wire

        self._window = Window(recorder, self._groups(), newest, scenario.rates.control_period_us)
        self._sensors = SensorRecord(recorder, flight) if has_sensors(scenario) else None
        self._weights = recorder.topic(topics.PIDNN_WEIGHTS) if aboard else None
        self._status = recorder.topic(topics.VEHICLE_STATUS)
        self._land = recorder.topic(topics.LAND_DETECTED)
        self._failures = recorder.topic(topics.INJECTED_FAILURE)
        self._recorder = recorder
        self._shown: Shown | None = None
        self._look_us: float = 0 if recorder.keeps else inf
        self._slow_us = self._second_us = 0
        """When there is something to look at next."""
        self._flags: tuple[int, ...] = ()
        self._home: telemetry.Home | None = None
        self._sticks_us: int | None = None
        """As logged last."""

    def _groups(self) -> tuple[Group, ...]:
        """Of the kernel's rows, NED and FRD."""
        rates, torque, integral = tick.LOG_RATE_SETPOINT, tick.LOG_TORQUE, tick.LOG_RATE_INTEGRAL
        return (
            Group(
                (
                    (topics.LOCAL_POSITION_TRUTH, columns(0, 6)),
                    (topics.ATTITUDE_TRUTH, columns(6, 10)),
                    (topics.ANGULAR_VELOCITY_TRUTH, columns(10, 13)),
                    (topics.LOCAL_POSITION, self._local_position),
                    (topics.ATTITUDE, columns(23, 27)),
                    (topics.ANGULAR_VELOCITY, columns(27, 30)),
                    (topics.WIND_TRUTH, columns(tick.LOG_WIND, tick.LOG_WIND + 3)),
                    (topics.ACTUATOR_MOTORS, columns(tick.LOG_COMMANDED, tick.LOG_COMMANDED + 4)),
                    (topics.ROTOR_STATUS, lambda v: np.column_stack((v[:, 13:17], v[:, tick.LOG_SATURATED]))),
                )
            ),
            Group(((topics.ATTITUDE_SETPOINT, _attitude_setpoint),), _ATTITUDE_FLOWN),
            Group(((topics.RATES_SETPOINT, lambda v: np.hstack((v[:, rates : rates + 3], _thrust(v)))),), _RATES_FLOWN),
            Group(((topics.RATE_STATUS, columns(integral, integral + 3)),), _RATES_FLOWN, INTEGRAL_US),
            Group(
                ((topics.TORQUE_SETPOINT, columns(torque, torque + 3)), (topics.THRUST_SETPOINT, _thrust)),
                _TURNING,
                TORQUE_US,
            ),
            Group(
                (
                    (topics.GLOBAL_POSITION, self._global_estimate),
                    (topics.GLOBAL_POSITION_TRUTH, lambda v: self._global(v[:, 0:3])),
                ),
                every_us=GLOBAL_US,
            ),
        )

    def _local_position(self, v: Array) -> Array:
        rows = np.empty((len(v), 10))
        rows[:, :6] = v[:, 17:23]
        valid = self._valid
        rows[:, 6:] = valid.position, valid.height, valid.velocity, valid.height
        return rows

    def _global_estimate(self, v: Array) -> Array:
        rows = np.empty((len(v), 5))
        rows[:, :3] = self._global(v[:, 17:20])
        rows[:, 3:] = self._valid.position, self._valid.height
        return rows

    def _global(self, positions: Array) -> Array:
        """Latitude and longitude in degrees, altitude in m, (k, 3) of positions NED."""
        origin = self._origin
        return np.array([(*origin.to_global(x, -y), origin.altitude_amsl_m - z) for x, y, z in positions.tolist()])

    # --- what happens between rows: `autopilot.Journal` --------------------------------------------------------------

    # It bears the time of the last row.

    def text(self, severity: int, text: str) -> None:
        """A STATUSTEXT."""
        self._recorder.message(self._window.newest_us, severity, text)

    def valid(self, valid: Validity) -> None:
        """Of the estimate, from the next row on."""
        if valid != self._valid:
            self._window.drain()
            self._valid = valid

    def command(self, command: Command, result: int) -> None:
        """It was executed, with that MAV_RESULT."""
        p, now_us = command.params, self._window.newest_us
        self._recorder.topic(topics.COMMAND).append(now_us, *p, command.id, command.system_id, command.component_id, 1)
        self._recorder.topic(topics.COMMAND_ACK).append(
            now_us, command.id, result, command.system_id, command.component_id
        )

    def parameter(self, name: str, value: float) -> None:
        """It was changed."""
        self._recorder.parameter(name, value)

    def failed(self, now_us: int, change: Change) -> None:
        """A failure was injected or cleared."""
        self._failures.append(now_us, change.unit, change.instance, change.kind, change.value)

    # --- rows --------------------------------------------------------------------------------------------------------

    def write(self, now_us: int, vehicle: Vehicle) -> None:
        """The vehicle's step to `now_us` is done."""
        autopilot = vehicle.autopilot
        self._window.take(now_us)
        if self._sensors is not None and vehicle.simulation.sensed is not None:
            self._sensors.write(now_us, vehicle, vehicle.simulation.sensed)
        if self._weights is not None and vehicle.weights is not None:
            self._weights.append(now_us, *vehicle.weights[:, :, 0].T.ravel().tolist())
        if now_us >= self._look_us:
            self._look(now_us, vehicle)
        if autopilot.shown is not self._shown and autopilot.shown is not None:
            self._write_state(now_us, autopilot, autopilot.shown)

    def _look(self, now_us: int, vehicle: Vehicle) -> None:
        """At what needs no row each period."""
        self._look_us = now_us + LOOK_US
        self._write_setpoints(now_us, vehicle.autopilot)
        if now_us >= self._slow_us:
            self._slow_us = now_us + SLOW_US
            self._write_slow(now_us, vehicle)
        if now_us >= self._second_us:
            self._second_us = now_us + SECOND_US
            self._write_ports(now_us, vehicle)
            self._write_wind(now_us, vehicle)
            if vehicle.autopilot.load > 0.0:
                self._recorder.topic(topics.CPULOAD).append(now_us, vehicle.autopilot.load, nan)

    def _write_state(self, now_us: int, autopilot: Autopilot, shown: Shown) -> None:
        """Of what is shown the log tells what it does not tell already."""
        before, self._shown = self._shown, shown
        commander = autopilot.commander
        if before is None or shown[:3] != before[:3]:
            self._status.append(
                now_us, topics.ARMED if shown.armed else topics.DISARMED, modes.TABLE[shown.mode].nav_state,
                int(shown.failsafe), modes.TABLE[commander.intended].nav_state, int(commander.overruled),
                topics.ROTARY_WING, mavlink.MAV_TYPE_QUADROTOR, autopilot.system_id, COMPONENT_ID,
            )  # fmt: skip
        landed = int(shown.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND)
        if before is None or landed != int(before.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND):
            self._land.append(now_us, landed, landed)

    def _write_setpoints(self, now_us: int, autopilot: Autopilot) -> None:
        setpoint, pilot = autopilot.position_setpoint, autopilot.pilot
        if setpoint is not None:
            self._recorder.topic(topics.LOCAL_POSITION_SETPOINT).append(
                now_us, *flip_vector(*setpoint.position_nwu_m), *flip_vector(*setpoint.velocity_nwu_m_s),
                *flip_vector(*setpoint.acceleration_nwu_m_s2), -setpoint.yaw_rad, -setpoint.yaw_rate_rad_s,
            )  # fmt: skip
        if pilot.received_us != self._sticks_us:
            self._sticks_us, axes = pilot.received_us, pilot.axes
            self._recorder.topic(topics.MANUAL_CONTROL).append(
                now_us, axes.roll, axes.pitch, axes.yaw, 2.0 * axes.throttle - 1.0, nan, nan, 1,
                topics.MANUAL_FROM_MAVLINK, int(pilot.moved),
            )  # fmt: skip

    def _write_slow(self, now_us: int, vehicle: Vehicle) -> None:
        autopilot, topic = vehicle.autopilot, self._recorder.topic
        battery, home = autopilot.battery, autopilot.home
        left_s = battery.remaining_s
        topic(topics.BATTERY_STATUS).append(
            now_us, battery.voltage_v, battery.current_a, 1000.0 * battery.consumed_ah, battery.charge,
            nan if left_s is None else left_s, 1, battery.cells, battery.level, round(1000.0 * battery.capacity_ah),
        )  # fmt: skip
        flags = _flags(autopilot.commander)
        if flags != self._flags:
            self._flags = flags
            topic(topics.FAILSAFE_FLAGS).append(now_us, *flags)
        if home is not None and home is not self._home:
            self._home = home
            x, y, z = home.position_nwu_m
            topic(topics.HOME_POSITION).append(
                now_us, *self._origin.to_global(x, y), self._origin.altitude_amsl_m + z, x, -y, -z, -home.yaw_rad
            )
        if self._sensors is None and (fix := telemetry.gps_of_estimate(autopilot)) is not None:
            topic(topics.GPS_POSITION).append(now_us, now_us, *_gps_row(self._origin, fix, vehicle))

    def _write_wind(self, now_us: int, vehicle: Vehicle) -> None:
        wind = vehicle.autopilot.wind
        if wind is not None:
            x, y, _ = wind.velocity_nwu_m_s
            variance = wind.variance_horizontal_m2_s2
            self._recorder.topic(topics.WIND).append(now_us, x, -y, variance, variance)

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

    def write(self, now_us: int, vehicle: Vehicle, sensed: SensedEstimator) -> None:
        if not sensed.now_us:
            return
        self._imu.row(now_us)[:] = sensed.imu.state[imu.DELTA : imu.DELTA + 6, 0] / self._period_s
        origin = self._origin
        for sensor, came in sensed.came:
            age_us = sensed.now_us - came.stamp_us
            sampled_us = max(now_us - age_us, 0)
            if sensor is sensed.gps:
                position, velocity = came.values[:3, 0].tolist(), came.values[3:, 0].tolist()
                fix = sensed.gps_reading(came) or GpsReading(position, velocity, came.satellites, inf, inf, inf, age_us)
                self._gps.append(now_us, sampled_us, *_gps_row(origin, fix, vehicle))
            elif sensor is sensed.barometer:
                altitude = origin.altitude_amsl_m + float(came.values[0, 0])
                self._air.append(now_us, sampled_us, altitude, 100.0 * telemetry.atmosphere(altitude)[0])
            else:
                mx, my, mz = came.values[:, 0].tolist()
                self._mag.append(now_us, sampled_us, mx, -my, -mz)
        status = sensed.status
        if status is not self._shown:
            self._shown = status
            self._status.append(
                now_us, status.eph_m, status.epv_m, status.velocity_ratio, status.position_ratio, status.height_ratio,
                status.mag_ratio, telemetry.estimator_flags(vehicle.autopilot.health, status),
            )  # fmt: skip
            bx, by, bz, ax, ay, az = sensed.x[ekf.GYRO_BIAS : ekf.GYRO_BIAS + 6, 0].tolist()
            self._bias.append(now_us, bx, -by, -bz, ax, -ay, -az)


def _flags(commander: Commander) -> tuple[int, ...]:
    """Of failsafe_flags."""
    now = commander.situation
    return (
        not now.attitude_valid, not now.height_valid, not now.position_valid, not now.velocity_valid,
        not now.position_valid, now.mission_refusal is not None, not commander.stream_fresh(),
        not commander.home_set, not commander.sticks_fresh(), not commander.gcs_fresh(), now.battery_level,
        now.fence_breach is not None, commander.mode is modes.Mode.MISSION and now.mission_failure is not None,
        now.motor_failure != 0,
    )  # fmt: skip


def _gps_row(origin: Origin, fix: GpsReading, vehicle: Vehicle) -> tuple[float, ...]:
    """From `latitude_deg` on; a fix that is no good is one of infinite uncertainty."""
    (x, y, z), (vx, vy, vz) = fix.position_nwu_m, fix.velocity_nwu_m_s
    booted_us = vehicle.autopilot.unix_boot_us
    return (
        *origin.to_global(x, y), origin.altitude_amsl_m + z, fix.eph_m, fix.epv_m, fix.evs_m_s, vx, -vy, -vz,
        mavlink.GPS_FIX_TYPE_3D_FIX if fix.eph_m < inf else mavlink.GPS_FIX_TYPE_NO_FIX, fix.satellites,
        telemetry.HDOP, telemetry.VDOP, hypot(vx, vy), booted_us + vehicle.clock_us if booted_us else 0,
    )  # fmt: skip
