"""One control cycle of the vehicle, compiled: rate loop, allocation, rotors, wind and rigid body at the physics rate.

Everything random comes in as standard normals, so that a tick is a pure function of its arguments.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mavsitl.compiled import compiled, inlined
from mavsitl.control.allocation import allocate
from mavsitl_vehicle.autopilot.attitude import attitude_error, quaternion_product
from mavsitl_vehicle.plant.parameters import N_PARAMETERS
from mavsitl_vehicle.plant.step import rk4_step
from mavsitl_vehicle.sensors import imu
from mavsitl_vehicle.wind.field import wind_step

Array = NDArray[np.float64]

# Rows of `demand` (DEMAND_ROWS, n), what the autopilots ask of the inner loops. It lies in memory vehicle by vehicle,
# which `asked` (n, DEMAND_ROWS) is: each packs its own in one call.
KIND = 0
ATTITUDE = 1  # 1:5, quaternion FLU -> NWU
RATE = 5  # 5:8, rad/s FLU; NaN: keep the present rate
TORQUE = 8  # 8:11, shares of the largest torque, FLU
THRUST = 11  # collective, 0..1
YAW_RATE = 12  # yaw feed-forward about the world's z axis, rad/s; NaN: none
DEMAND_ROWS = 13

STOPPED, TORQUE_KIND, RATE_KIND, ATTITUDE_KIND = 0.0, 1.0, 2.0, 3.0

# Rows of `gains`, each vehicle's own (GAIN_ROWS, n).
ATTITUDE_P = 0  # 0:3
RATE_P = 3  # 3:6
RATE_I = 6  # 6:9
RATE_D = 9  # 9:12
RATE_INTEGRAL_LIMIT = 12  # 12:15
RATE_MAX = 15  # 15:18, rad/s
YAW_WEIGHT = 18
MAX_TORQUE = 19  # 19:22, N m
MAX_THRUST = 22  # N
THRUST_COEFFICIENT = 23
DRAG_COEFFICIENT = 24
ARM = 25
MAX_ROTOR_SPEED = 26
GYRO_SIGMA = 27  # rad/s
GAIN_ROWS = 28

# Rows of `estimate` (ESTIMATE_ROWS, n): position NWU m, velocity NWU m/s, quaternion FLU -> NWU, omega FLU rad/s.
ESTIMATE_ROWS = 13
MEASURE_NORMALS = 12
GYRO_NORMALS = 3

# Rows of `inner` (INNER_ROWS, n), the inner loops' state and what they report.
RATE_INTEGRAL = 0  # 0:3, torque share
LAST_GYRO = 3  # 3:6, rad/s
RATE_SETPOINT = 6  # 6:9, rad/s
SATURATED = 9  # allocation's saturation bits, OR-ed over the tick
INNER_ROWS = 10

# Rows of `motors` (MOTOR_ROWS, n), what becomes of the commands to rotors 1..4.
SPEED_SHARE = 0  # 0:4, of the commanded speed
FIXED_SPEED = 4  # 4:8, rad/s whatever is commanded; NaN: as commanded
FOLLOW = 8  # 8:12, share of the way to the command that is gone in a physics step; 1: all of it
COMMANDED = 12  # 12:16, filled in: the allocation's speeds, rad/s
MOTOR_ROWS = 16

# Blocks of rows of `rows` (ROWS, n), all that the physics and the inner loops keep: one array is one argument.
X = 0  # 0:17, the truth: position NWU m, velocity NWU m/s, quaternion FLU -> NWU, omega FLU rad/s, rotor speeds rad/s
X_ROWS = 17
ESTIMATE_AT = X + X_ROWS
WIND_AT = ESTIMATE_AT + ESTIMATE_ROWS  # 3, m/s NWU
INNER_AT = WIND_AT + 3
MOTORS_AT = INNER_AT + INNER_ROWS
COMMAND_AT = MOTORS_AT + MOTOR_ROWS  # 4, rotor speeds rad/s
VELOCITY_AT = COMMAND_AT + 4  # 3, the truth's at the beginning of the tick
TIME_AT = VELOCITY_AT + 3  # flight's time at the beginning of the tick, s; by which gusts go
GAINS_AT = TIME_AT + 1
SIGMA_AT = GAINS_AT + GAIN_ROWS  # 4, noise of position m, velocity m/s, attitude rad, rate rad/s
PLANT_AT = SIGMA_AT + 4
ROWS = PLANT_AT + N_PARAMETERS

# Columns of a row of the log, each topic's beside each other, NED and FRD.
LOG_TRUTH = 0  # 0:13, position, velocity, quaternion, omega, as of `rows`
LOG_ROTORS = LOG_TRUTH + 13  # 4, rad/s
LOG_SATURATED = LOG_ROTORS + 4
LOG_ESTIMATE = LOG_SATURATED + 1  # 13
LOG_WIND = LOG_ESTIMATE + 13  # 3
LOG_RATE_SETPOINT = LOG_WIND + 3  # 3
LOG_THRUST_BODY = LOG_RATE_SETPOINT + 3  # 3, of which the last is written
LOG_WIDTH = LOG_THRUST_BODY + 3


@compiled
def rate_setpoint(demand: Array, estimate: Array, gains: Array, inner: Array, j: int) -> None:
    """The attitude loop, once a tick: fills vehicle j's rate setpoint from its attitude setpoint (stock cascade)."""
    ex, ey, ez = attitude_error(
        estimate[6, j], estimate[7, j], estimate[8, j], estimate[9, j],
        demand[ATTITUDE, j], demand[ATTITUDE + 1, j], demand[ATTITUDE + 2, j], demand[ATTITUDE + 3, j],
        gains[YAW_WEIGHT, j],
    )  # fmt: skip
    yaw_gain = gains[ATTITUDE_P + 2, j] / gains[YAW_WEIGHT, j] if gains[YAW_WEIGHT, j] > 1e-4 else 0.0
    p, q, r = gains[ATTITUDE_P, j] * ex, gains[ATTITUDE_P + 1, j] * ey, yaw_gain * ez
    feed = demand[YAW_RATE, j]
    if feed == feed:
        w, x, y, z = estimate[6, j], estimate[7, j], estimate[8, j], estimate[9, j]
        p += feed * 2.0 * (x * z - w * y)  # the world's z axis in body axes
        q += feed * 2.0 * (y * z + w * x)
        r += feed * (1.0 - 2.0 * (x * x + y * y))
    inner[RATE_SETPOINT, j] = min(max(p, -gains[RATE_MAX, j]), gains[RATE_MAX, j])
    inner[RATE_SETPOINT + 1, j] = min(max(q, -gains[RATE_MAX + 1, j]), gains[RATE_MAX + 1, j])
    inner[RATE_SETPOINT + 2, j] = min(max(r, -gains[RATE_MAX + 2, j]), gains[RATE_MAX + 2, j])


@compiled
def inner_loops(
    gyro: Array,
    demand: Array,
    gains: Array,
    inner: Array,
    held: NDArray[np.bool_],
    dt_s: float,
    command: Array,
) -> None:
    """Rate PID (PX4's form) and allocation (eq 12 inverted) for one physics step.

    `gyro` (3, n) is what the rate loop measures, rad/s FLU. Fills `command` (4, n), rotor speeds.
    """
    for j in range(gyro.shape[1]):
        kind = demand[KIND, j]
        if kind == STOPPED:
            for i in range(3):
                inner[RATE_INTEGRAL + i, j] = 0.0
                inner[LAST_GYRO + i, j] = gyro[i, j]
            for i in range(4):
                command[i, j] = 0.0
            continue
        torque = (0.0, 0.0, 0.0)
        if kind == TORQUE_KIND:
            for i in range(3):
                inner[RATE_INTEGRAL + i, j] = 0.0
                inner[LAST_GYRO + i, j] = gyro[i, j]
            torque = (
                demand[TORQUE, j] * gains[MAX_TORQUE, j],
                demand[TORQUE + 1, j] * gains[MAX_TORQUE + 1, j],
                demand[TORQUE + 2, j] * gains[MAX_TORQUE + 2, j],
            )
        else:
            share = (0.0, 0.0, 0.0)
            for i in range(3):
                rate = gyro[i, j]
                setpoint = inner[RATE_SETPOINT + i, j]
                error = setpoint - rate if setpoint == setpoint else 0.0
                acceleration = (rate - inner[LAST_GYRO + i, j]) / dt_s
                value = gains[RATE_P + i, j] * error + inner[RATE_INTEGRAL + i, j] - gains[RATE_D + i, j] * acceleration
                if not held[j]:
                    limit = gains[RATE_INTEGRAL_LIMIT + i, j]
                    integral = inner[RATE_INTEGRAL + i, j] + gains[RATE_I + i, j] * error * dt_s
                    inner[RATE_INTEGRAL + i, j] = min(max(integral, -limit), limit)
                inner[LAST_GYRO + i, j] = rate
                if i == 0:
                    share = (value, share[1], share[2])
                elif i == 1:
                    share = (share[0], value, share[2])
                else:
                    share = (share[0], share[1], value)
            torque = (
                share[0] * gains[MAX_TORQUE, j],
                share[1] * gains[MAX_TORQUE + 1, j],
                share[2] * gains[MAX_TORQUE + 2, j],
            )
        o1, o2, o3, o4, saturated = allocate(
            demand[THRUST, j] * gains[MAX_THRUST, j], torque[0], torque[1], torque[2],
            gains[THRUST_COEFFICIENT, j], gains[DRAG_COEFFICIENT, j], gains[ARM, j], gains[MAX_ROTOR_SPEED, j],
        )  # fmt: skip
        command[0, j], command[1, j], command[2, j], command[3, j] = o1, o2, o3, o4
        inner[SATURATED, j] = float(int(inner[SATURATED, j]) | saturated)


@compiled
def fail_motors(x: Array, demand: Array, motors: Array, command: Array) -> None:
    """From the allocation's speeds in `command` (4, n) to those that the rotors really get; a stopped one stays so."""
    for j in range(x.shape[1]):
        for i in range(4):
            speed = command[i, j]
            motors[COMMANDED + i, j] = speed
            if demand[KIND, j] == STOPPED:
                continue
            speed *= motors[SPEED_SHARE + i, j]
            follow = motors[FOLLOW + i, j]
            if follow < 1.0:
                speed = x[13 + i, j] + follow * (speed - x[13 + i, j])
            fixed = motors[FIXED_SPEED + i, j]
            command[i, j] = fixed if fixed == fixed else speed


@compiled
def measure(x: Array, sigma: Array, normals: Array, estimate: Array) -> None:
    """Gaussian white noise on every feedback variable: estimate (13, n) from truth and `normals` (12, n).

    `sigma` (4, n): position m, velocity m/s, attitude rad, rate rad/s. The attitude's noise is a small
    rotation in body axes.
    """
    for j in range(x.shape[1]):
        for i in range(3):
            estimate[i, j] = x[i, j] + sigma[0, j] * normals[i, j]
            estimate[3 + i, j] = x[3 + i, j] + sigma[1, j] * normals[3 + i, j]
            estimate[10 + i, j] = x[10 + i, j] + sigma[3, j] * normals[9 + i, j]
        half = 0.5 * sigma[2, j]
        hx, hy, hz = half * normals[6, j], half * normals[7, j], half * normals[8, j]
        norm = np.sqrt(1.0 + hx * hx + hy * hy + hz * hz)
        w, qx, qy, qz = quaternion_product(
            x[6, j], x[7, j], x[8, j], x[9, j], 1.0 / norm, hx / norm, hy / norm, hz / norm
        )
        estimate[6, j], estimate[7, j], estimate[8, j], estimate[9, j] = w, qx, qy, qz


@compiled
def outer_loop(demand: Array, estimate: Array, gains: Array, inner: Array) -> None:
    """Once a tick: the rate setpoint that the rate loop follows during it."""
    for j in range(demand.shape[1]):
        inner[SATURATED, j] = 0.0
        if demand[KIND, j] == ATTITUDE_KIND:
            rate_setpoint(demand, estimate, gains, inner, j)
        elif demand[KIND, j] == RATE_KIND:
            for i in range(3):
                inner[RATE_SETPOINT + i, j] = demand[RATE + i, j]


@inlined
def _log_vector(source: Array, at: int, row: Array, to: int, j: int) -> None:
    row[to, j], row[to + 1, j], row[to + 2, j] = source[at, j], -source[at + 1, j], -source[at + 2, j]


@compiled
def write_log(rows: Array, asked: Array, row: Array) -> None:
    """Fill `row` (LOG_WIDTH, n) of the log with what is now."""
    for j in range(row.shape[1]):
        for at, to in ((X, LOG_TRUTH), (ESTIMATE_AT, LOG_ESTIMATE)):
            _log_vector(rows, at, row, to, j)
            _log_vector(rows, at + 3, row, to + 3, j)
            row[to + 6, j] = rows[at + 6, j]
            _log_vector(rows, at + 7, row, to + 7, j)
            _log_vector(rows, at + 10, row, to + 10, j)
        for i in range(4):
            row[LOG_ROTORS + i, j] = rows[X + 13 + i, j]
        row[LOG_SATURATED, j] = rows[INNER_AT + SATURATED, j]
        _log_vector(rows, WIND_AT, row, LOG_WIND, j)
        _log_vector(rows, INNER_AT + RATE_SETPOINT, row, LOG_RATE_SETPOINT, j)
        row[LOG_THRUST_BODY + 2, j] = -asked[j, THRUST]


@compiled
def advance(
    rows: Array,
    asked: Array,
    held: NDArray[np.bool_],
    wind_state: Array,
    wind_coefficients: Array,
    wind_normals: Array,
    sensor_normals: Array,
    log: Array,
    block: Array | None,
    tick: int,
    dt_s: float,
    substeps: int,
) -> None:
    """Tick number `tick` from 0: `substeps` physics steps, the noise of the estimate, and a row of the log; in place.

    `rows` (ROWS, n), `asked` (n, DEMAND_ROWS) the demands, `log` (k, LOG_WIDTH, n), of which row (tick + 1) % k is
    filled. Of `wind_normals` (m, substeps * normals_per_step, n) and `sensor_normals` (m, substeps * 3 + 12, n) the
    rows tick % m are consumed in order. `block` is `lanes.scratch(n)`.
    """
    x, estimate, wind = rows[X : X + X_ROWS], rows[ESTIMATE_AT:WIND_AT], rows[WIND_AT:INNER_AT]
    inner, motors, command = rows[INNER_AT:MOTORS_AT], rows[MOTORS_AT:COMMAND_AT], rows[COMMAND_AT:VELOCITY_AT]
    gains, sigma, plant = rows[GAINS_AT:SIGMA_AT], rows[SIGMA_AT:PLANT_AT], rows[PLANT_AT:ROWS]
    demand = asked.T
    n = x.shape[1]
    for i in range(3):
        for j in range(n):
            rows[VELOCITY_AT + i, j] = x[3 + i, j]
    outer_loop(demand, estimate, gains, inner)
    gyro = np.empty((3, n))
    now_s = np.empty(n)
    winds, noise = wind_normals[tick % wind_normals.shape[0]], sensor_normals[tick % sensor_normals.shape[0]]
    per_step = winds.shape[0] // substeps
    for k in range(substeps):
        for j in range(n):
            now_s[j] = rows[TIME_AT, j] + k * dt_s
        wind_step(wind_state, wind_coefficients, winds[k * per_step : (k + 1) * per_step], now_s, wind)
        for j in range(n):
            for i in range(3):
                gyro[i, j] = x[10 + i, j] + gains[GYRO_SIGMA, j] * noise[k * GYRO_NORMALS + i, j]
        inner_loops(gyro, demand, gains, inner, held, dt_s, command)
        fail_motors(x, demand, motors, command)
        rk4_step(x, command, wind, plant, dt_s, held, block)
    measure(x, sigma, noise[substeps * GYRO_NORMALS :], estimate)
    write_log(rows, asked, log[(tick + 1) % log.shape[0]])


@compiled
def advance_sensed(
    rows: Array,
    asked: Array,
    held: NDArray[np.bool_],
    wind_state: Array,
    wind_coefficients: Array,
    wind_normals: Array,
    imu_normals: Array,
    imu_state: Array,
    imu_late: Array,
    imu_settings: Array,
    imu_added: Array,
    gyro_kind: int,
    accel_kind: int,
    block: Array | None,
    tick: int,
    dt_s: float,
    substeps: int,
) -> None:
    """As `advance`, with the rate loop on the IMU's samples. The filter's estimate is read alone; no log is filled.

    Of `imu_normals` (m, substeps * 6 + 6, n) row tick % m is consumed in order; what the IMU integrated is in
    `imu_state`.
    """
    x, estimate, wind = rows[X : X + X_ROWS], rows[ESTIMATE_AT:WIND_AT], rows[WIND_AT:INNER_AT]
    inner, motors, command = rows[INNER_AT:MOTORS_AT], rows[MOTORS_AT:COMMAND_AT], rows[COMMAND_AT:VELOCITY_AT]
    gains, plant = rows[GAINS_AT:SIGMA_AT], rows[PLANT_AT:ROWS]
    demand = asked.T
    n = x.shape[1]
    for i in range(3):
        for j in range(n):
            rows[VELOCITY_AT + i, j] = x[3 + i, j]
    outer_loop(demand, estimate, gains, inner)
    gyro = np.empty((3, n))
    now_s = np.empty(n)
    before = np.empty((7, n))
    winds, noise = wind_normals[tick % wind_normals.shape[0]], imu_normals[tick % imu_normals.shape[0]]
    per_step = winds.shape[0] // substeps
    imu.begin(imu_state, imu_settings, noise[substeps * imu.NORMALS :])
    for k in range(substeps):
        for j in range(n):
            now_s[j] = rows[TIME_AT, j] + k * dt_s
        wind_step(wind_state, wind_coefficients, winds[k * per_step : (k + 1) * per_step], now_s, wind)
        imu.corrected_gyro(imu_state, gyro)
        inner_loops(gyro, demand, gains, inner, held, dt_s, command)
        fail_motors(x, demand, motors, command)
        for j in range(n):
            for i in range(7):
                before[i, j] = x[3 + i, j]
        rk4_step(x, command, wind, plant, dt_s, held, block)
        imu.sample(
            imu_state, imu_late, imu_settings, imu_added, gyro_kind, accel_kind, before, x,
            noise[k * imu.NORMALS : (k + 1) * imu.NORMALS], dt_s,
        )  # fmt: skip
