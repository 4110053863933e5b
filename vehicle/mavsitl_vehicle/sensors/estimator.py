"""Sensors and filter of one simulation: what is measured goes in each control period, the vehicle's state comes out."""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heappop, heappush
from math import radians, sqrt

import numpy as np
from numpy.typing import NDArray

from mavsitl.geodesy import Origin
from mavsitl.scenario import Flight
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.failures import Failures, Kind, Unit
from mavsitl_vehicle.sensors import ekf, imu
from mavsitl_vehicle.sensors.ekf import Array
from mavsitl_vehicle.sensors.faults import Coin
from mavsitl_vehicle.sensors.imu import Imu
from mavsitl_vehicle.sensors.slow import FIX_SATELLITES, Barometer, Gps, Magnetometer, Measurement, SlowSensor
from mavsitl_vehicle.sensors.status import EstimatorStatus, GpsReading, Readings, SensorHealth

ALIGN_US = 400_000
"""At rest for so long, the filter begins."""
REST_RAD_S = radians(5.0)
"""The gyro's mean moves by less than this between the halves of the alignment, or the vehicle is not at rest."""
REST_M_S2 = 0.3
REST_PERIOD_US = 200_000
"""At rest, velocity zero and the gyro's mean are fused so often (PX4's zero velocity and zero gyro updates)."""
REST_VELOCITY_M_S = 0.001
START_POSITION_M = 0.01
"""1 sigma of the start pose, which is where the local frame is."""
WIDE = 5.0
"""The attitude of the alignment is taken for so many times as uncertain before gravity and field are fused with it."""
WILD = 5.0
"""A GPS offset of more sigma than this is none: what went wrong before a reset is in it."""
UNKNOWN_M = 1e3
UNKNOWN_M_S = 30.0
UNKNOWN_GAUSS = 0.5

LEAST_GYRO_NOISE, LEAST_ACCEL_NOISE = 1e-6, 1e-5
LEAST_NOISE, LEAST_MAG_NOISE = 1e-3, 1e-4
"""The filter takes no sensor for better than this, m or m/s, gauss: exact ones would leave it no covariance."""

LOST_ATTITUDE_RAD = 0.3
"""After a gap in the gyro's samples."""
USED_SATELLITES = 6
"""EKF2_REQ_NSATS: a fix of fewer is not used."""
IMU_TIMEOUT_US = 100_000
SENSOR_TIMEOUT_US = 500_000
DEAD_RECKONING_US = 1_000_000
"""PX4's no_aid_timeout_max: without GPS for so long, position and velocity are dead reckoning."""
RESET_US = 7_000_000
"""PX4's reset_timeout_max: refused for so long, GPS or magnetometer are believed again, whatever they say."""
HEIGHT_RESET_US = 5_000_000
"""PX4's hgt_fusion_timeout_max; without height for so long it is not valid either."""
VALID_TILT_RAD = radians(10.0)
STATUS_US = 20_000

# Rows of `test` and of `fused_us`.
GPS_VELOCITY, GPS_POSITION, GPS_HEIGHT, BARO, MAG = range(5)
TESTS = 5

_E_Z = ekf.E_POSITION + 2


class SensedEstimator:
    """Sensors and filters of vehicles with one set of parameters and failures; status and readings are the first's.

    `update` after each control period's physics, whose IMU samples `tick.advance_sensed` took.
    """

    def __init__(
        self, flight: Flight, parameters: Parameters, failures: Failures, seed: int, x: Array, dt_s: float,
        vehicles: Sequence[int],
    ) -> None:  # fmt: skip
        """`x` (17, n) at rest; `vehicles`: the numbers in the fleet of its columns, by which their errors are drawn."""
        scenario = flight.scenario
        settings, n = scenario.estimator, x.shape[1]
        self._settings = settings
        self._parameters = parameters
        self._failures = failures
        self._gravity = flight.airframe.gravity_m_s2
        self.period_us = scenario.rates.control_period_us
        self._period_s = self.period_us / 1e6
        start = scenario.start
        field = Origin(start.latitude_deg, start.longitude_deg, start.altitude_amsl_m).magnetic_field_nwu_gauss
        self._field = np.array(field)
        self._start = x[0:3].copy()
        self.imu = Imu(settings.imu, self._gravity, dt_s, self._period_s, seed, vehicles)
        self.gps = Gps(settings.gps, parameters, failures, seed, vehicles)
        self.barometer = Barometer(settings.barometer, parameters, failures, seed, vehicles)
        self.magnetometer = Magnetometer(settings.magnetometer, field, parameters, failures, seed, vehicles)
        self._coins = {unit: Coin(unit, seed, vehicles[0]) for unit in (Unit.GYRO, Unit.ACCEL)}
        self.now_us = 0

        self.x = np.zeros((ekf.STATE_ROWS, n))
        self.p = np.zeros((ekf.ERROR_ROWS, ekf.ERROR_ROWS, n))
        self._slow: tuple[SlowSensor, ...] = (self.gps, self.barometer, self.magnetometer)
        self.depth = -(-max(sensor.delay_us for sensor in self._slow) // self.period_us)
        """Intervals between the filter's time and now."""
        self._ring = np.zeros((self.depth, 6, n))
        self._head = 0
        self._now = np.zeros((ekf.STATE_ROWS, n))
        self._due = np.zeros((6, n))
        self._waiting: list[tuple[int, int, SlowSensor, Measurement]] = []
        """A heap by stamp: what came and is newer than the filter."""
        self._count = 0
        self.came: list[tuple[SlowSensor, Measurement]] = []
        """What came in this period."""
        self.aligned = False
        self._located = False
        """The filter has begun before, so that the offsets of GPS and barometer are known."""
        self._sums = np.zeros((2, 6, n))
        """Of the delta angles and velocities, in the two halves of the alignment."""
        self._seen: dict[SlowSensor, list[Array]] = {}
        self._align_us = 0
        self._rest_sum = np.zeros((6, n))
        self._rest_us = 0
        self.test = np.zeros((TESTS, n))
        self.fused_us = np.full((TESTS, n), -(2**40))
        self._gyro_us = self._accel_us = 0
        self.resets = 0
        self._status_us = 0

        imu_settings, gps, baro, mag = settings.imu, settings.gps, settings.barometer, settings.magnetometer
        process = np.zeros(ekf.PROCESS_ROWS)
        process[ekf.GYRO_NOISE] = max(radians(imu_settings.gyro_noise_deg_s_rt_hz), LEAST_GYRO_NOISE)
        process[ekf.ACCEL_NOISE] = max(imu_settings.accel_noise_m_s2_rt_hz, LEAST_ACCEL_NOISE)
        process[ekf.GYRO_WALK] = radians(imu_settings.gyro_bias_walk_deg_s_rt_s)
        process[ekf.ACCEL_WALK] = imu_settings.accel_bias_walk_m_s2_rt_s
        process[ekf.BARO_WALK] = baro.drift_m_rt_s
        process[ekf.GPS_DRIFT_H] = gps.horizontal_drift_m**2
        process[ekf.GPS_DRIFT_V] = gps.vertical_drift_m**2
        process[ekf.GPS_DRIFT_TIME] = gps.drift_time_s
        self.process = process
        """What the filter knows of the sensors: their noise without SIM_NOISE_SCALE."""
        h, v, speed = (
            max(sigma, LEAST_NOISE) ** 2
            for sigma in (gps.horizontal_noise_m, gps.vertical_noise_m, gps.velocity_noise_m_s)
        )
        self._gps_variance = np.array([h, h, v, speed, speed, speed])
        self._baro_variance = np.array([max(baro.noise_m, LEAST_NOISE) ** 2])
        self._mag_variance = max(mag.noise_gauss, LEAST_MAG_NOISE) ** 2
        self.set_noise()
        self.status = self._make_status()
        self._restart_alignment()
        self.imu.start(x)
        self._coarse(self.imu.state[imu.ACCEL : imu.ACCEL + 3], self.magnetometer.measure(x))

    def set_noise(self) -> None:
        """SIM_NOISE_SCALE and SIM_GYR_BIAS_*, SIM_ACC_BIAS_* have changed."""
        p = self._parameters
        self.imu.set_noise(p["SIM_NOISE_SCALE"])
        for row, name in enumerate(("GYR", "ACC")):
            for i, (axis, sign) in enumerate((("X", 1.0), ("Y", -1.0), ("Z", -1.0))):
                self.imu.added[3 * row + i] = sign * p[f"SIM_{name}_BIAS_{axis}"]

    def restart(self, *, at_start: bool) -> None:
        """Begin anew, at rest: at the start pose, or somewhere that GPS and barometer tell."""
        self._located = self._located and not at_start
        self._restart_alignment()

    def failure_kinds(self) -> tuple[int, int]:
        """Of gyro and accelerometer in the period to come, for `imu.sample`."""
        return self._imu_kind(Unit.GYRO), self._imu_kind(Unit.ACCEL)

    def _imu_kind(self, unit: Unit) -> int:
        kind = self._failures.of(unit)
        if kind is Kind.INTERMITTENT:
            return int(Kind.OK if self._coins[unit].there(self.now_us) else Kind.OFF)
        return int(kind)

    # --- a control period --------------------------------------------------------------------------------------------

    def update(self, x: Array, at_rest: NDArray[np.bool_], estimate: Array) -> None:
        """Slow sensors measure the truth `x` (17, n); the filter goes on by a period; fills `estimate` (13, n).

        `at_rest` (n,): the vehicles know that they do not move, on the ground or in the clamp.
        """
        self.now_us += self.period_us
        now_us, state = self.now_us, self.imu.state
        if state[imu.FRESH, 0] > 0.0:
            if now_us - self._gyro_us > IMU_TIMEOUT_US:
                ekf.forget(self.p, ekf.E_ATTITUDE, 3, LOST_ATTITUDE_RAD**2)
            self._gyro_us = now_us
        if state[imu.FRESH + 1, 0] > 0.0:
            if now_us - self._accel_us > IMU_TIMEOUT_US:
                ekf.forget(self.p, ekf.E_VELOCITY, 3, UNKNOWN_M_S**2)
                ekf.forget(self.p, ekf.E_POSITION, 3, UNKNOWN_M**2)
            self._accel_us = now_us
        delta = state[imu.DELTA : imu.DELTA + 6]
        ekf.advance(
            self.x, self.p, self._ring, self._head, delta, self.aligned, self._period_s, self._gravity, self.process,
            self._due,
        )  # fmt: skip
        if self.depth:
            self._head = (self._head + 1) % self.depth
        self.came.clear()
        for sensor in self._slow:
            came = sensor.step(x, now_us)
            if came is not None:
                self.came.append((sensor, came))
                self._count += 1
                heappush(self._waiting, (came.stamp_us, self._count, sensor, came))
        if self.aligned:
            horizon_us = now_us - self.depth * self.period_us
            while self._waiting and self._waiting[0][0] <= horizon_us:
                _, _, sensor, each = heappop(self._waiting)
                self._fuse(sensor, each)
            if at_rest.all():
                self._rest(delta)
            elif self._rest_us:
                self._rest_us = 0
        else:
            self._align(delta)
        state[imu.CORRECTION : imu.CORRECTION + 3] = self.x[ekf.GYRO_BIAS : ekf.GYRO_BIAS + 3]
        self.present(estimate)
        if now_us >= self._status_us:
            self._status_us = now_us + STATUS_US
            self.status = self._make_status()

    def present(self, estimate: Array) -> None:
        """Fill `estimate` (13, n) with the state now."""
        gyro = self.imu.state[imu.GYRO : imu.GYRO + 3]
        ekf.present(self.x, self._ring, self._head, gyro, self._period_s, self._gravity, self._now, estimate)

    # --- at rest -----------------------------------------------------------------------------------------------------

    def _restart_alignment(self) -> None:
        self.aligned = False
        self._restart_us = self.now_us
        """What was measured before counts for nothing: the vehicle may have been elsewhere."""
        self._align_us = 0
        self._sums[:] = 0.0
        self._seen = {sensor: [] for sensor in self._slow}

    def _coarse(self, force: Array, field: Array) -> None:
        """Attitude from one look at gravity and field, (3, n) each: TRIAD. Where it stands until the filter begins."""
        x = self.x
        if not self._located:
            x[ekf.POSITION : ekf.POSITION + 3] = self._start
        x[ekf.VELOCITY : ekf.VELOCITY + 3] = 0.0
        for j in range(x.shape[1]):
            up = force[:, j] / np.linalg.norm(force[:, j])
            west = np.cross(up, field[:, j])
            west /= np.linalg.norm(west)
            north = np.cross(west, up)
            x[ekf.QUATERNION : ekf.QUATERNION + 4, j] = _quaternion(np.array((north, west, up)))

    def _align(self, delta: Array) -> None:
        """Gather what the sensors show at rest; after `ALIGN_US` the filter begins with it."""
        half = 0 if self._align_us < ALIGN_US // 2 else 1
        self._sums[half] += delta
        self._align_us += self.period_us
        while self._waiting:
            stamp_us, _, sensor, each = heappop(self._waiting)
            if stamp_us > self._restart_us and (sensor is not self.gps or each.satellites >= USED_SATELLITES):
                self._seen[sensor].append(each.values)
        if self._align_us < ALIGN_US:
            return
        # two halves, of which the first has what is over
        first = -(-(ALIGN_US // 2) // self.period_us) * self._period_s
        means = self._sums / np.array([first, self._align_us / 1e6 - first])[:, None, None]
        moved = np.abs(means[1] - means[0]).max(axis=1)
        rate = np.abs(means[:, :3]).max()
        fields = self._seen[self.magnetometer]
        imu_well = self.now_us - min(self._gyro_us, self._accel_us) <= IMU_TIMEOUT_US
        if not imu_well or not fields or moved[:3].max() > REST_RAD_S or moved[3:].max() > REST_M_S2 or rate > 0.5:
            self._restart_alignment()
            return
        self._begin(self._sums.sum(axis=0) / (self._align_us / 1e6))

    def _begin(self, means: Array) -> None:
        """`means` (6, n): rate and specific force at rest."""
        settings, x, p = self._settings, self.x, self.p
        seconds = self._align_us / 1e6
        fields = self._seen[self.magnetometer]
        field = np.mean(fields, axis=0)
        if not self._located:
            p[:] = 0.0
            x[ekf.ACCEL_BIAS :] = 0.0
            for row, count, sigma in (
                (ekf.E_POSITION, 3, START_POSITION_M),
                (ekf.E_ACCEL_BIAS, 3, settings.imu.accel_bias_m_s2),
                (ekf.E_GPS_OFFSET, 2, settings.gps.horizontal_drift_m),
                (ekf.E_GPS_OFFSET + 2, 1, settings.gps.vertical_drift_m),
                (ekf.E_BARO_OFFSET, 1, max(settings.barometer.offset_m, settings.barometer.noise_m)),
                (ekf.E_MAG_OFFSET, 3, settings.magnetometer.offset_gauss),
            ):
                ekf.forget(p, row, count, sigma**2)
        else:
            ekf.forget(p, ekf.E_POSITION, 3, UNKNOWN_M**2)
        self._coarse(means[3:] - x[ekf.ACCEL_BIAS : ekf.ACCEL_BIAS + 3], field - x[ekf.MAG_OFFSET :])
        ekf.forget(p, ekf.E_VELOCITY, 3, REST_VELOCITY_M_S**2)
        # Wide enough to count for nothing, and no wider: far from it, the measurements are not linear in the heading.
        tilt_rad = WIDE * (0.002 + settings.imu.accel_bias_m_s2 / self._gravity)
        north, dip = abs(float(self._field[0])), abs(float(self._field[2]))
        own = settings.magnetometer.offset_gauss + settings.magnetometer.noise_gauss
        heading_rad = min((WIDE * own + dip * tilt_rad) / max(north, 1e-3), 0.5)
        ekf.forget(p, ekf.E_ATTITUDE, 2, tilt_rad**2)
        ekf.forget(p, ekf.E_ATTITUDE + 2, 1, heading_rad**2)
        x[ekf.GYRO_BIAS : ekf.GYRO_BIAS + 3] = means[:3]
        ekf.forget(
            p, ekf.E_GYRO_BIAS, 3,
            self.process[ekf.GYRO_NOISE] ** 2 / seconds + self.process[ekf.GYRO_WALK] ** 2 * seconds,
        )  # fmt: skip
        force_variance = self.process[ekf.ACCEL_NOISE] ** 2 / seconds + self.process[ekf.ACCEL_WALK] ** 2 * seconds
        ekf.fuse_at_rest(x, p, means[3:], force_variance, self._gravity)
        ekf.fuse_magnetometer(x, p, field, self._field, self._mag_variance / len(fields), 0.0, self.test[MAG])
        fixes, heights = self._seen[self.gps], self._seen[self.barometer]
        if fixes:
            ekf.fuse_direct(
                x, p, ekf.E_POSITION, ekf.E_GPS_OFFSET, 3, np.mean(fixes, axis=0)[:3],
                self._gps_variance[:3] / len(fixes), 0.0, self.test[GPS_POSITION],
            )  # fmt: skip
            self.fused_us[[GPS_VELOCITY, GPS_POSITION, GPS_HEIGHT]] = self.now_us
        if heights:
            ekf.fuse_direct(
                x, p, _E_Z, ekf.E_BARO_OFFSET, 1, np.mean(heights, axis=0),
                self._baro_variance / len(heights), 0.0, self.test[BARO],
            )  # fmt: skip
            self.fused_us[BARO] = self.now_us
        self.fused_us[MAG] = self.now_us
        self.aligned = self._located = True
        self._rest_us = 0

    def _rest(self, delta: Array) -> None:
        """Velocity zero and the gyro's mean, now and then."""
        if self._rest_us == 0:
            self._rest_sum[:] = 0.0
        self._rest_sum += delta
        self._rest_us += self.period_us
        if self._rest_us < REST_PERIOD_US:
            return
        seconds = self._rest_us / 1e6
        rate = self._rest_sum[:3] / seconds
        self._rest_us = 0
        if np.abs(rate - self.x[ekf.GYRO_BIAS : ekf.GYRO_BIAS + 3]).max() > REST_RAD_S:
            return
        zero, unused = np.zeros_like(rate), np.zeros(rate.shape[1])
        ekf.fuse_direct(
            self.x, self.p, ekf.E_VELOCITY, -1, 3, zero, np.full(3, REST_VELOCITY_M_S**2), 0.0, unused
        )  # fmt: skip
        ekf.fuse_gyro_at_rest(self.x, self.p, rate, self.process[ekf.GYRO_NOISE] ** 2 / seconds)

    # --- measurements ------------------------------------------------------------------------------------------------

    def _fuse(self, sensor: SlowSensor, each: Measurement) -> None:
        parameters, z = self._parameters, each.values
        if sensor is self.barometer:
            self._fuse_rows(
                BARO, _E_Z, ekf.E_BARO_OFFSET, z, self._baro_variance, parameters["EKF2_BARO_GATE"], HEIGHT_RESET_US
            )
        elif sensor is self.magnetometer:
            test = self.test[MAG]
            ekf.fuse_magnetometer(
                self.x, self.p, z, self._field, self._mag_variance, parameters["EKF2_MAG_GATE"], test
            )  # fmt: skip
            self._note(MAG, RESET_US)
        elif each.satellites >= USED_SATELLITES:
            variance = self._gps_variance * each.noise**2
            p_gate, v_gate = parameters["EKF2_GPS_P_GATE"], parameters["EKF2_GPS_V_GATE"]
            position, offset = ekf.E_POSITION, ekf.E_GPS_OFFSET
            self._fuse_rows(GPS_VELOCITY, ekf.E_VELOCITY, -1, z[3:], variance[3:], v_gate, RESET_US)
            self._fuse_rows(GPS_POSITION, position, offset, z[:2], variance[:2], p_gate, RESET_US)
            self._fuse_rows(GPS_HEIGHT, _E_Z, offset + 2, z[2:3], variance[2:3], p_gate, RESET_US)

    def _fuse_rows(
        self, test: int, row: int, offset: int, z: Array, variance: Array, gate: float, limit_us: int
    ) -> None:
        """`ekf.fuse_direct`; what was refused for `limit_us` is begun anew and believed."""
        ekf.fuse_direct(self.x, self.p, row, offset, len(z), z, variance, gate, self.test[test])
        for j in self._note(test, limit_us):
            one, unused = slice(j, j + 1), np.zeros(1)
            ekf.fuse_direct(
                self.x[:, one], self.p[:, :, one], row, offset, len(z), z[:, one], variance, 0.0, unused
            )  # fmt: skip

    def _note(self, test: int, limit_us: int) -> list[int]:
        """Which vehicles fused it; where it was refused for `limit_us`, what it measures is forgotten: those."""
        fused = self.test[test] <= 1.0
        self.fused_us[test, fused] = self.now_us
        if fused.all():
            return []
        late: list[int] = np.flatnonzero(self.now_us - self.fused_us[test] > limit_us).tolist()
        for j in late:
            self._forget(test, j)
            self.fused_us[test, j] = self.now_us
            self.resets += 1
        return late

    def _forget(self, test: int, j: int) -> None:
        """A height sensor that is refused while the other one is fused has another offset; else the height is wrong."""
        p = self.p[:, :, j]
        if test == MAG:
            ekf.forget(p, ekf.E_MAG_OFFSET, 3, UNKNOWN_GAUSS**2)
        elif test == GPS_VELOCITY:
            ekf.forget(p, ekf.E_VELOCITY, 3, UNKNOWN_M_S**2)
        elif test == GPS_POSITION:
            ekf.forget(p, ekf.E_POSITION, 2, UNKNOWN_M**2)
            if (
                np.abs(self.x[ekf.GPS_OFFSET : ekf.GPS_OFFSET + 2, j]).max()
                > WILD * self._settings.gps.horizontal_drift_m
            ):
                self.x[ekf.GPS_OFFSET : ekf.GPS_OFFSET + 2, j] = 0.0
                ekf.forget(p, ekf.E_GPS_OFFSET, 2, self.process[ekf.GPS_DRIFT_H])
        else:
            other, offset = (BARO, ekf.E_GPS_OFFSET + 2) if test == GPS_HEIGHT else (GPS_HEIGHT, ekf.E_BARO_OFFSET)
            if self.now_us - self.fused_us[other, j] <= DEAD_RECKONING_US:
                ekf.forget(p, offset, 1, UNKNOWN_M**2)
            else:
                ekf.forget(p, _E_Z, 1, UNKNOWN_M**2)
                ekf.forget(p, ekf.E_VELOCITY + 2, 1, UNKNOWN_M_S**2)

    # --- what it says of itself --------------------------------------------------------------------------------------

    def _make_status(self) -> EstimatorStatus:
        now_us, p, test = self.now_us, self.p, self.test
        sensors = self._health(now_us)
        horizontal_us = now_us - int(self.fused_us[[GPS_VELOCITY, GPS_POSITION], 0].max())
        vertical_us = now_us - int(self.fused_us[[GPS_HEIGHT, BARO], 0].max())
        d = [sqrt(max(p[i, i, 0], 0.0)) for i in range(ekf.E_GYRO_BIAS + 3)]
        tilt_rad = max(d[ekf.E_ATTITUDE], d[ekf.E_ATTITUDE + 1])
        running = self.aligned and sensors.gyro
        moving = running and sensors.accelerometer
        aided = moving and horizontal_us <= self._parameters["EKF2_NOAID_TOUT"]
        noise_rad_s = float(self.imu.settings[imu.GYRO_SIGMA])
        return EstimatorStatus(
            running and tilt_rad <= VALID_TILT_RAD,
            moving and vertical_us <= HEIGHT_RESET_US,
            aided,
            aided,
            self.aligned and horizontal_us > DEAD_RECKONING_US,
            max(d[0], d[1]), d[2], max(d[3], d[4]), d[5], tilt_rad, d[ekf.E_ATTITUDE + 2],
            sqrt(d[ekf.E_GYRO_BIAS] ** 2 + noise_rad_s**2),
            float(test[GPS_VELOCITY, 0]), float(test[GPS_POSITION, 0]),
            float(max(test[GPS_HEIGHT, 0], test[BARO, 0])), float(test[MAG, 0]), sensors, self.resets,
        )  # fmt: skip

    def _health(self, now_us: int) -> SensorHealth:
        newest = self.gps.newest
        return SensorHealth(
            now_us - self._gyro_us <= IMU_TIMEOUT_US,
            now_us - self._accel_us <= IMU_TIMEOUT_US,
            self.magnetometer.fresh(now_us, SENSOR_TIMEOUT_US),
            self.barometer.fresh(now_us, SENSOR_TIMEOUT_US),
            newest is not None and newest.satellites >= USED_SATELLITES and self.gps.fresh(now_us, SENSOR_TIMEOUT_US),
        )

    def readings(self) -> Readings:
        """Vehicle 0's."""
        state = self.imu.state
        gyro, accel = state[imu.GYRO : imu.GYRO + 3, 0].tolist(), state[imu.ACCEL : imu.ACCEL + 3, 0].tolist()
        field, height, fix = self.magnetometer.newest, self.barometer.newest, self.gps.newest
        return Readings(
            tuple(gyro),
            tuple(accel),
            None if field is None else tuple(field.values[:, 0].tolist()),
            None if height is None else float(height.values[0, 0]),
            None if fix is None or not self.gps.fresh(self.now_us, SENSOR_TIMEOUT_US) else self.gps_reading(fix),
        )

    def gps_reading(self, fix: Measurement) -> GpsReading | None:
        """Of vehicle 0; None: no fix."""
        if fix.satellites < FIX_SATELLITES:
            return None
        gps = self._settings.gps
        x, y, z, vx, vy, vz = fix.values[:, 0].tolist()
        return GpsReading(
            (x, y, z), (vx, vy, vz), fix.satellites,
            sqrt((gps.horizontal_noise_m * fix.noise) ** 2 + gps.horizontal_drift_m**2),
            sqrt((gps.vertical_noise_m * fix.noise) ** 2 + gps.vertical_drift_m**2),
            gps.velocity_noise_m_s * fix.noise, self.now_us - fix.stamp_us,
        )  # fmt: skip


def _quaternion(rows: Array) -> Array:
    """Of the rotation matrix whose rows are the world's axes in the body: scalar first, body to world."""
    m = rows
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    q = np.array(
        [
            [trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [0.0, m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [0.0, 0.0, m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [0.0, 0.0, 0.0, m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    q = np.triu(q) + np.triu(q, 1).T
    best: Array = np.linalg.eigh(q)[1][:, -1]
    return best if best[0] >= 0.0 else -best
