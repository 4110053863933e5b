"""The physical side of the vehicle wing: n vehicles' plant, wind, sensors and inner loops, tick by tick."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from math import radians

import msgspec
import numpy as np

from mavsitl import seeds
from mavsitl.compiled import direct
from mavsitl.frames import Vector
from mavsitl.log.block import BLOCK_ROWS
from mavsitl.quaternion import conjugate, rotate, to_euler
from mavsitl.scenario import DrydenMil, Flight, Gust, Steady, Wind
from mavsitl_vehicle import tick
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint, RateSetpoint, Setpoint
from mavsitl_vehicle.failures import Failures, has_sensors
from mavsitl_vehicle.motors import MotorFailures
from mavsitl_vehicle.plant.lanes import scratch
from mavsitl_vehicle.plant.parameters import plant_parameters
from mavsitl_vehicle.plant.state import initial_state
from mavsitl_vehicle.sensors import imu
from mavsitl_vehicle.sensors.estimator import SensedEstimator
from mavsitl_vehicle.sensors.status import EstimatorStatus, Readings, known
from mavsitl_vehicle.wind.field import WindField, mil_axes

TURBULENCE_HEIGHT_M = 6.096
"""20 ft: where SIM_WIND_W20 is given, and its turbulence taken."""

BLOCK_TICKS = 250
"""Normals are drawn for this many ticks at once."""

# Rows of `asked` from KIND to the last that a kind of demand has; between them are zeros.
_PACK_ATTITUDE = struct.Struct("=d 4d 24x 24x d d").pack_into
_PACK_RATE = struct.Struct("=d 32x 3d 24x d").pack_into
_PACK_TORQUE = struct.Struct("=d 32x 24x 3d d").pack_into
_DEMAND_BYTES = 8 * tick.DEMAND_ROWS

WARM_UP_US = 1_000_000
"""In so much time at rest a filter uses everything that it has."""


class Simulation:
    """Arrays have the fleet axis last: `x` (17, n) the truth, `estimate` (13, n) what sensors say, `wind` (3, n).

    What is per vehicle takes its column `j`. Columns are independent: a vehicle's parameters, failures and random
    numbers change nothing of another's.

    Attributes:
        sensed: sensors and filter; None: the estimate is the truth with white noise.
        held: (n,) in the clamp.
        estimates: the columns of `estimate` as lists.
        at_rest: (n,) the vehicle knows that it does not move: on the ground, or in the clamp.
    """

    def __init__(
        self,
        flight: Flight,
        parameters: Parameters | Sequence[Parameters],
        seed: int,
        n: int = 1,
        failures: Failures | Sequence[Failures] | None = None,
        *,
        first: int = 0,
        positions_nwu_m: Sequence[Vector] | None = None,
        shared_wind: bool = False,
    ) -> None:
        """`parameters` and `failures` are one for all `n` vehicles or each one's own; None: nothing is broken.

        The columns are the vehicles `first` and after it of the fleet, by which random numbers are drawn.
        `positions_nwu_m` are where they start, None: all at the scenario's start. With `shared_wind` the scenario's
        turbulence is the same for all. Raises `ValueError` for sensors of vehicles that have parameters of their own:
        these take a simulation each.
        """
        scenario = flight.scenario
        self.n = n
        self._flight = flight
        self._parameters = [parameters] * n if isinstance(parameters, Parameters) else list(parameters)
        if failures is None or isinstance(failures, Failures):
            failures = [Failures() if failures is None else failures] * n
        vehicles = range(first, first + n)
        self.substeps = scenario.rates.substeps
        self.dt_s = 1.0 / scenario.rates.physics_hz
        self._start = initial_state(scenario.start.position_nwu_m, radians(scenario.start.yaw_deg), 0.0, n)
        if positions_nwu_m is not None:
            self._start[0:3] = np.array(positions_nwu_m).T
        rows = self._rows = np.zeros((tick.ROWS, n))
        self.x = rows[tick.X : tick.X + tick.X_ROWS]
        self.x[:] = self._start
        self.estimate = rows[tick.ESTIMATE_AT : tick.WIND_AT]
        self.wind = rows[tick.WIND_AT : tick.INNER_AT]
        self.inner = rows[tick.INNER_AT : tick.MOTORS_AT]
        self._motor_rows = rows[tick.MOTORS_AT : tick.COMMAND_AT]
        self._command = rows[tick.COMMAND_AT : tick.VELOCITY_AT]
        self._velocity = rows[tick.VELOCITY_AT : tick.TIME_AT]
        self._velocity[:] = self.x[3:6]
        self._flight_time_s = rows[tick.TIME_AT]
        self.gains = rows[tick.GAINS_AT : tick.SIGMA_AT]
        self.sigma = rows[tick.SIGMA_AT : tick.PLANT_AT]
        self.plant = rows[tick.PLANT_AT :]
        self._by_vehicle = self.estimate.T
        self.estimates: list[list[float]] = self._by_vehicle.tolist()
        self._asked = np.zeros((n, tick.DEMAND_ROWS))
        self._asked_bytes = self._asked.data.cast("B")
        self.demand = self._asked.T
        self.demand[tick.ATTITUDE] = 1.0
        self._log = np.zeros((BLOCK_ROWS, tick.LOG_WIDTH, n))
        """The row of what is now is number `_tick`, modulo its length."""
        self._block = scratch(n)
        self.held = np.full(n, scenario.start.clamp)
        self.at_rest = np.ones(n, dtype=np.bool_)
        for j in range(n):
            self.plant[:, j] = self._plant(j)[:, 0]
            self.gains[:, j] = _gains(flight, self._parameters[j])
            self.sigma[:, j] = self._sigma(j)
        largest = flight.airframe.max_rotor_speed_rad_s
        self.motors = [
            MotorFailures(failures[j], seed, self.dt_s, largest, self._motor_rows[:, j], vehicle)
            for j, vehicle in enumerate(vehicles)
        ]
        self._gusts: dict[int, Gust] = {}
        self._stalled_inner: dict[int, tick.Array] = {}
        self._wind_generators = [seeds.generator(seed, "vehicle", j, "wind") for j in vehicles]
        self._sensor_generators = [seeds.generator(seed, "vehicle", j, "sensors") for j in vehicles]
        self._shared_wind = seeds.generator(seed, "fleet", "wind") if shared_wind else None
        self.field = WindField(scenario.wind, n, self.dt_s)
        per_reset = self.field.normals_for_reset
        if self._shared_wind is None:
            normals = np.stack([g.standard_normal(per_reset) for g in self._wind_generators], axis=-1)
        else:
            normals = np.repeat(self._shared_wind.standard_normal(per_reset)[:, None], n, axis=1)
        self.field.reset(normals)
        self._tick = 0
        self._scenario_rows = self.field.normals_per_step
        self._own_winds: dict[int, tuple[Wind, ...]] = {}
        for j in range(n):
            if winds := self._parameter_winds(j):
                self._set_winds(j, winds)
        self.sensed: SensedEstimator | None = None
        self._white = known(scenario.noise)
        if has_sensors(scenario):
            if any(each is not self._parameters[0] for each in self._parameters):
                raise ValueError("sensors of vehicles with parameters of their own: these take a simulation each")
            self.sensed = self._make_sensed(seed, failures[0], vehicles)
            self.sensed.present(self.estimate)
        self._wind_normals = _Normals(self._draw_wind, n, n + shared_wind)
        self._sensor_normals = _Normals(self._draw_sensors, n, n)
        self._size_normals()
        if self.sensed is None:
            for j in range(n):
                self._measure(j)
        self._warm_up()
        self._present()

    def set_demand(self, j: int, setpoint: Setpoint | None) -> None:
        """What vehicle `j`'s inner loops follow during the next tick; None stops its rotors."""
        asked, at = self._asked_bytes, j * _DEMAND_BYTES
        if isinstance(setpoint, RateSetpoint):
            p, q, r = setpoint.omega_flu_rad_s
            _PACK_RATE(asked, at, tick.RATE_KIND, p, q, r, setpoint.thrust)
        elif isinstance(setpoint, AttitudeSetpoint):
            w, x, y, z = setpoint.attitude
            _PACK_ATTITUDE(asked, at, tick.ATTITUDE_KIND, w, x, y, z, setpoint.thrust, setpoint.yaw_rate_rad_s)
        elif setpoint is None:
            self.demand[tick.KIND, j] = tick.STOPPED
        else:
            roll, pitch, yaw = setpoint.torque
            _PACK_TORQUE(asked, at, tick.TORQUE_KIND, roll, pitch, yaw, setpoint.thrust)

    @property
    def estimator_status(self) -> EstimatorStatus:
        """Of sensors, the first column's."""
        return self._white if self.sensed is None else self.sensed.status

    @property
    def readings(self) -> Readings | None:
        """The first column's; None: there are no sensors."""
        return None if self.sensed is None else self.sensed.readings()

    def put_back(self, j: int) -> None:
        """At rest at the start pose, rotors still; time, wind and sensors go on, a filter begins anew."""
        self.x[:, j] = self._start[:, j]
        if self.sensed is not None:
            self.sensed.restart(at_start=True)

    def restart_estimator(self) -> None:
        """The vehicle boots where it stands."""
        if self.sensed is not None:
            self.sensed.restart(at_start=False)

    def set_upright(self, j: int) -> None:
        """Level and at rest where it lies, with the heading it has, rotors still."""
        w, x, y, z = self.x[6:10, j].tolist()
        yaw_rad = to_euler((w, x, y, z))[2]
        here: Vector = tuple(self.x[0:3, j].tolist())
        self.x[:, j] = initial_state(here, yaw_rad, 0.0, 1)[:, 0]
        if self.sensed is None:
            self._measure(j)

    def set_parameter(self, j: int, name: str) -> None:
        """Take up one of `j`'s that was changed in flight; those that are none of the simulation's change nothing."""
        if name.startswith("MC_"):
            self.gains[:, j] = _gains(self._flight, self._parameters[j])
        elif name == "SIM_NOISE_SCALE":
            self.sigma[:, j] = self._sigma(j)
            self.gains[:, j] = _gains(self._flight, self._parameters[j])
            if self.sensed is not None:
                self.sensed.set_noise()
        elif name.startswith(("SIM_GYR_", "SIM_ACC_")):
            if self.sensed is not None:
                self.sensed.set_noise()
        elif name == "SIM_MASS_SCALE":
            self.plant[:, j] = self._plant(j)[:, 0]
        elif name.startswith("SIM_WIND_"):
            self._set_winds(j, self._parameter_winds(j))
            self._size_normals()
            self._wind_normals.redraw(j)
            self._sensor_normals.redraw(j)

    def specific_force(self, j: int) -> Vector:
        """What an accelerometer at the centre measures, mean over the last tick, m/s^2 FLU: (0, 0, g) at rest."""
        period_s = self.substeps * self.dt_s
        ax, ay, az = ((self.x[3:6, j] - self._velocity[:, j]) / period_s).tolist()
        w, x, y, z = self.x[6:10, j].tolist()
        return rotate(conjugate((w, x, y, z)), (ax, ay, az + self._flight.airframe.gravity_m_s2))

    def _plant(self, j: int) -> tick.Array:
        """(N_PARAMETERS, 1)"""
        scenario = self._flight.scenario
        offnominal = scenario.offnominal
        scale = offnominal.mass_scale * self._parameters[j]["SIM_MASS_SCALE"]
        offnominal = msgspec.structs.replace(offnominal, mass_scale=scale)
        return plant_parameters(self._flight.airframe, offnominal, scenario.ground_contact, 1)

    def _sigma(self, j: int) -> tick.Array:
        noise = self._flight.scenario.noise
        sigma = [noise.position_m, noise.velocity_m_s, radians(noise.attitude_deg), radians(noise.rate_deg_s)]
        return np.array(sigma) * self._parameters[j]["SIM_NOISE_SCALE"]

    def _parameter_winds(self, j: int) -> tuple[Wind, ...]:
        """SIM_WIND_*: a mean wind, and turbulence, on top of the scenario's."""
        p = self._parameters[j]
        from_deg = p["SIM_WIND_DIR"]
        winds: list[Wind] = []
        if p["SIM_WIND_SPD"] > 0.0:
            x, y, z = (p["SIM_WIND_SPD"] * mil_axes(from_deg)[0]).tolist()
            winds.append(Steady(velocity_nwu_m_s=(x, y, z)))
        if p["SIM_WIND_TURB"]:
            winds.append(DrydenMil(speed_20ft_m_s=p["SIM_WIND_W20"], altitude_m=TURBULENCE_HEIGHT_M, from_deg=from_deg))
        return tuple(winds)

    def _set_winds(self, j: int, own: tuple[Wind, ...]) -> None:
        """What blows on `j` alone: its turbulence begins stationary; everything else goes on."""
        begun = WindField(own, 1, self.dt_s)
        begun.reset(self._wind_generators[j].standard_normal(begun.normals_for_reset)[:, None])
        self._own_winds[j] = own
        before, field = self.field, WindField(self._flight.scenario.wind, self.n, self.dt_s, self._own_winds)
        kept = min(before.normals_per_step, field.normals_per_step)
        field.state[:kept] = before.state[:kept]
        field.state[self._scenario_rows : self._scenario_rows + len(begun.state), j] = begun.state[:, 0]
        self.field = field
        for vehicle, gust in self._gusts.items():
            field.blow(vehicle, gust)

    def blow(self, j: int, gust: Gust | None) -> None:
        """A gust on `j`, on top of everything else, in place of the one before; None: it is over."""
        self._gusts.pop(j, None)
        if gust is not None:
            self._gusts[j] = gust
        self.field.blow(j, gust)

    def stall(self, j: int, stalled: bool) -> None:
        """The inner loops stand still: the rotors keep what they were commanded last."""
        if stalled:
            self._stalled_inner[j] = self.inner[:, j].copy()
            self.motors[j].hold(self._command[:, j])
        elif j in self._stalled_inner:
            self.inner[:, j] = self._stalled_inner.pop(j)
            self.motors[j].hold(None)

    def advance(self, flight_time_s: float | tick.Array) -> None:
        """One control period: the inner loops and the physics at the physics rate, then the sensors.

        `flight_time_s`, of all or (n,) each one's: since the release, negative before it; gusts go by it.
        """
        number = self._tick
        if number:
            row = number % BLOCK_TICKS
            if row in self._wind_normals.due:
                self._wind_normals.go_on(row)
            if row in self._sensor_normals.due:
                self._sensor_normals.go_on(row)
        field = self.field
        if field.gusty:
            self._flight_time_s[:] = flight_time_s
        for j, motors in enumerate(self.motors):
            if motors.busy:
                motors.step(number * self.substeps * self.dt_s, self.x[13:17, j])
        self._tick = number + 1
        if self.sensed is not None:
            self._advance_sensed(self.sensed, number)
            return
        advance = self._advance
        advance(
            self._rows, self._asked, self.held, field.state, field.coefficients, self._wind_normals.block,
            self._sensor_normals.block, self._log, self._block, number, self.dt_s, self.substeps,
        )  # fmt: skip
        self.estimates = self._by_vehicle.tolist()

    def logged(self, j: int, count: int) -> tick.Array:
        """(count, tick.LOG_WIDTH) of vehicle `j`: now, and the ticks before it, the oldest first; not to be kept."""
        end = self._tick % BLOCK_ROWS + 1
        begin, log = end - count, self._log[:, :, j]
        return log[begin:end] if begin >= 0 else np.concatenate((log[begin:], log[:end]))

    def _advance_sensed(self, sensed: SensedEstimator, number: int) -> None:
        field, unit = self.field, sensed.imu
        tick.advance_sensed(
            self._rows, self._asked, self.held, field.state, field.coefficients, self._wind_normals.block,
            self._sensor_normals.block, unit.state, unit.late, unit.settings, unit.added, *sensed.failure_kinds(),
            self._block, number, self.dt_s, self.substeps,
        )  # fmt: skip
        sensed.update(self.x, self.at_rest, self.estimate)
        self._present()

    def _present(self) -> None:
        """The estimate as lists, and the log's row of what is now."""
        self.estimates = self.estimate.T.tolist()
        tick.write_log(self._rows, self._asked, self._log[self._tick % BLOCK_ROWS])

    def _make_sensed(self, seed: int, failures: Failures, vehicles: Sequence[int]) -> SensedEstimator:
        return SensedEstimator(self._flight, self._parameters[0], failures, seed, self.x, self.dt_s, vehicles)

    # --- random numbers ----------------------------------------------------------------------------------------------

    def _size_normals(self) -> None:
        self._wind_normals.size(self.substeps, self.field.normals_per_step)
        if self.sensed is None:
            self._sensor_normals.size(1, self.substeps * tick.GYRO_NORMALS + tick.MEASURE_NORMALS)
        else:
            self._sensor_normals.size(1, (self.substeps + 1) * imu.NORMALS)

    def _draw_wind(self, j: int, steps: tick.Array) -> None:
        """For each step those of the scenario's winds, then those of the vehicle's own; `j` = n is the shared wind."""
        common = self._scenario_rows
        if j == self.n:
            assert self._shared_wind is not None
            normals = self._shared_wind.standard_normal((*steps.shape[:2], common))
            steps[:, :, :common] = normals[..., None]
            return
        begin, end = common if self._shared_wind else 0, common + self.field.own_normals[j]
        steps[:, :, begin:end, j] = self._wind_generators[j].standard_normal((*steps.shape[:2], end - begin))

    def _draw_sensors(self, j: int, steps: tick.Array) -> None:
        generators = self._sensor_generators if self.sensed is None else self.sensed.imu.generators
        steps[:, :, :, j] = generators[j].standard_normal(steps.shape[:3])

    def _warm_up(self) -> None:
        """Run each kernel once on copies, so that compiling, or reading the cache, is done before the clock runs."""
        rows, asked = self._rows.copy(), self._asked.copy()
        if self.sensed is not None:
            self._warm_up_sensed(rows, asked)
            return
        self._advance = direct(
            tick.advance,
            rows, asked, self.held, self.field.state.copy(), self.field.coefficients, self._wind_normals.block,
            self._sensor_normals.block, self._log.copy(), self._block, 0, self.dt_s, self.substeps,
        )  # fmt: skip

    def _warm_up_sensed(self, rows: tick.Array, asked: tick.Array) -> None:
        sensed, field = self._make_sensed(0, Failures(), range(self.n)), self.field
        unit, held = sensed.imu, np.ones(self.n, dtype=np.bool_)
        x, estimate = rows[tick.X : tick.X + tick.X_ROWS], rows[tick.ESTIMATE_AT : tick.WIND_AT]
        unit.added[:] = 0.0  # nothing that would keep it from beginning
        unit.state[imu.BIAS : imu.BIAS + 6] = 0.0
        while sensed.now_us < WARM_UP_US:
            for kind in (tick.STOPPED, tick.ATTITUDE_KIND):
                asked[:, tick.KIND] = kind
                tick.advance_sensed(
                    rows, asked, held, field.state.copy(), field.coefficients, self._wind_normals.block,
                    self._sensor_normals.block, unit.state, unit.late, unit.settings, unit.added, 0, 0,
                    self._block, 0, self.dt_s, self.substeps,
                )  # fmt: skip
            sensed.update(x, held, estimate)

    def _measure(self, j: int) -> None:
        estimate = np.zeros((tick.ESTIMATE_ROWS, 1))
        normals = self._sensor_generators[j].standard_normal(tick.MEASURE_NORMALS)[:, None]
        tick.measure(self.x[:, j : j + 1].copy(), self.sigma[:, j : j + 1].copy(), normals, estimate)
        self.estimate[:, j] = estimate[:, 0]
        self.estimates = self.estimate.T.tolist()


class _Normals:
    """Standard normals for `BLOCK_TICKS` at a time. The next block's are drawn vehicle by vehicle meanwhile, so that no
    tick draws all of a fleet's.

    Attributes:
        block: (BLOCK_TICKS, rows, n), a row of it for each tick.
        due: by tick of a block, who draws then: the first for this block, at its beginning, the others for the next.
    """

    def __init__(self, draw: Callable[[int, tick.Array], None], n: int, count: int) -> None:
        """`draw(each, steps)` fills what is `each`'s, of `count`, in steps (BLOCK_TICKS, steps a tick, rows, n)."""
        self._draw = draw
        self._n, self._count = n, count
        self.due: dict[int, list[int]] = {}
        for each in range(count):
            self.due.setdefault(BLOCK_TICKS * each // count, []).append(each)
        self._now = self._next = np.zeros((0, 0, 0, n))
        self._ahead: set[int] = set()
        """Those that have drawn for the next block."""
        self.block = np.zeros((0, 0, n))

    def size(self, steps: int, rows: int) -> None:
        """What is drawn already stays, unless there was nothing."""
        before = self._now, self._next
        if before[0].shape[1:3] == (steps, rows):
            return
        shape = (BLOCK_TICKS, steps, rows, self._n)
        self._now, self._next = np.zeros(shape), np.zeros(shape)
        if not before[0].shape[0]:
            for each in range(self._count):
                self._draw(each, self._now)
        else:
            kept = min(rows, before[0].shape[2])
            for old, new in zip(before, (self._now, self._next), strict=True):
                new[:, :, :kept] = old[:, :, :kept]
        self._show()

    def redraw(self, each: int) -> None:
        """From now on other ones."""
        self._draw(each, self._now)
        if each in self._ahead:
            self._draw(each, self._next)

    def go_on(self, row: int) -> None:
        """Before tick `row` of a block, one that is in `due`; not before the first of all."""
        if row == 0:
            self._now, self._next = self._next, self._now
            self._ahead.clear()
            self._show()
        for each in self.due[row]:
            if row:
                self._ahead.add(each)
            self._draw(each, self._next if row else self._now)

    def _show(self) -> None:
        ticks, steps, rows, n = self._now.shape
        self.block = self._now.reshape(ticks, steps * rows, n)


def _gains(flight: Flight, parameters: Parameters) -> tick.Array:
    airframe, p = flight.airframe, parameters
    gains = np.zeros(tick.GAIN_ROWS)
    gains[tick.ATTITUDE_P : tick.ATTITUDE_P + 3] = p["MC_ROLL_P"], p["MC_PITCH_P"], p["MC_YAW_P"]
    for row, letter in ((tick.RATE_P, "P"), (tick.RATE_I, "I"), (tick.RATE_D, "D")):
        gains[row : row + 3] = [
            p[f"MC_{axis}RATE_K"] * p[f"MC_{axis}RATE_{letter}"] for axis in ("ROLL", "PITCH", "YAW")
        ]
    gains[tick.RATE_INTEGRAL_LIMIT : tick.RATE_INTEGRAL_LIMIT + 3] = [
        p[f"MC_{axis}_INT_LIM"] for axis in ("RR", "PR", "YR")
    ]
    gains[tick.RATE_MAX : tick.RATE_MAX + 3] = [radians(p[f"MC_{axis}RATE_MAX"]) for axis in ("ROLL", "PITCH", "YAW")]
    gains[tick.YAW_WEIGHT] = p["MC_YAW_WEIGHT"]
    gains[tick.MAX_TORQUE : tick.MAX_TORQUE + 3] = airframe.max_torque_n_m
    gains[tick.MAX_THRUST] = airframe.max_thrust_n
    gains[tick.THRUST_COEFFICIENT] = airframe.thrust_coefficient_n_s2
    gains[tick.DRAG_COEFFICIENT] = airframe.drag_coefficient_n_m_s2
    gains[tick.ARM] = airframe.arm_m
    gains[tick.MAX_ROTOR_SPEED] = airframe.max_rotor_speed_rad_s
    gains[tick.GYRO_SIGMA] = radians(flight.scenario.noise.rate_deg_s) * p["SIM_NOISE_SCALE"]
    return gains
