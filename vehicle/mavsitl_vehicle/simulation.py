"""The physical side of the vehicle wing: n vehicles' plant, wind, sensors and inner loops, tick by tick."""

from __future__ import annotations

from math import nan, radians

import msgspec
import numpy as np

from mavsitl import seeds
from mavsitl.frames import Vector
from mavsitl.quaternion import conjugate, rotate, to_euler
from mavsitl.scenario import DrydenMil, Flight, Gust, Steady, Wind
from mavsitl_vehicle import tick
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint, RateSetpoint, Setpoint
from mavsitl_vehicle.failures import Failures, has_sensors
from mavsitl_vehicle.motors import MotorFailures
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

WARM_UP_US = 1_000_000
"""In so much time at rest a filter uses everything that it has."""


class Simulation:
    """Arrays have the fleet axis last: `x` (17, n) the truth, `estimate` (13, n) what sensors say, `wind` (3, n).

    Attributes:
        sensed: sensors and filter; None: the estimate is the truth with white noise.
        at_rest: (n,) the vehicle knows that it does not move: on the ground, or in the clamp.
    """

    def __init__(
        self, flight: Flight, parameters: Parameters, seed: int, n: int = 1, failures: Failures | None = None
    ) -> None:
        """`failures` break the sensors of all `n` vehicles, and vehicle 0's motors; None: nothing is broken."""
        scenario = flight.scenario
        self.n = n
        self._flight = flight
        self._parameters = parameters
        self.substeps = scenario.rates.substeps
        self.dt_s = 1.0 / scenario.rates.physics_hz
        self._start = initial_state(scenario.start.position_nwu_m, radians(scenario.start.yaw_deg), 0.0, n)
        self.x = self._start.copy()
        self.plant = self._plant()
        self.field = WindField(scenario.wind, n, self.dt_s)
        self.wind = np.zeros((3, n))
        self.estimate = np.zeros((tick.ESTIMATE_ROWS, n))
        self.demand = np.zeros((tick.DEMAND_ROWS, n))
        self.demand[tick.ATTITUDE] = 1.0
        self.inner = np.zeros((tick.INNER_ROWS, n))
        self.held = np.full(n, scenario.start.clamp)
        self.at_rest = np.ones(n, dtype=np.bool_)
        self.gains = _gains(flight, parameters)
        self.sigma = self._sigma()
        self._velocity = self.x[3:6].copy()
        """At the beginning of the tick."""
        self._command = np.zeros((4, n))
        self.motors = MotorFailures(Failures() if failures is None else failures, seed, self.dt_s, self.gains, n)
        self._gust: Gust | None = None
        self._stalled_inner: tick.Array | None = None
        self._wind_generators = [seeds.generator(seed, "vehicle", j, "wind") for j in range(n)]
        self._sensor_generators = [seeds.generator(seed, "vehicle", j, "sensors") for j in range(n)]
        per_reset = self.field.normals_for_reset
        self.field.reset(np.stack([g.standard_normal(per_reset) for g in self._wind_generators], axis=-1))
        self._tick = 0
        self._scenario_rows = self.field.normals_per_step
        if winds := self._parameter_winds():
            self._set_winds(winds)
        self._sensor_block = np.zeros((0, 0, n))
        self._wind_block = np.zeros((0, 0, n))
        self.sensed: SensedEstimator | None = None
        self._white = known(scenario.noise)
        if has_sensors(scenario):
            self.sensed = self._make_sensed(seed, failures or Failures())
            self.sensed.present(self.estimate)
        self._draw()
        if self.sensed is None:
            self._measure()
        self._warm_up()

    def set_demand(self, j: int, setpoint: Setpoint | None) -> None:
        """What vehicle `j`'s inner loops follow during the next tick; None stops its rotors."""
        demand = self.demand
        if setpoint is None:
            demand[tick.KIND, j] = tick.STOPPED
            return
        demand[tick.THRUST, j] = setpoint.thrust
        if isinstance(setpoint, AttitudeSetpoint):
            demand[tick.KIND, j] = tick.ATTITUDE_KIND
            demand[tick.ATTITUDE : tick.ATTITUDE + 4, j] = setpoint.attitude
            demand[tick.YAW_RATE, j] = setpoint.yaw_rate_rad_s
        elif isinstance(setpoint, RateSetpoint):
            demand[tick.KIND, j] = tick.RATE_KIND
            demand[tick.RATE : tick.RATE + 3, j] = setpoint.omega_flu_rad_s
            demand[tick.YAW_RATE, j] = nan
        else:
            demand[tick.KIND, j] = tick.TORQUE_KIND
            demand[tick.TORQUE : tick.TORQUE + 3, j] = setpoint.torque

    @property
    def estimator_status(self) -> EstimatorStatus:
        """Vehicle 0's."""
        return self._white if self.sensed is None else self.sensed.status

    @property
    def readings(self) -> Readings | None:
        """Vehicle 0's; None: there are no sensors."""
        return None if self.sensed is None else self.sensed.readings()

    def put_back(self) -> None:
        """At rest at the start pose, rotors still; time, wind and sensors go on, a filter begins anew."""
        self.x[:] = self._start
        if self.sensed is not None:
            self.sensed.restart(at_start=True)

    def restart_estimator(self) -> None:
        """The vehicle boots where it stands."""
        if self.sensed is not None:
            self.sensed.restart(at_start=False)

    def set_upright(self) -> None:
        """Level and at rest where it lies, with the heading it has, rotors still."""
        for j in range(self.n):
            w, x, y, z = self.x[6:10, j].tolist()
            yaw_rad = to_euler((w, x, y, z))[2]
            here: Vector = tuple(self.x[0:3, j].tolist())
            self.x[:, j] = initial_state(here, yaw_rad, 0.0, 1)[:, 0]
        if self.sensed is None:
            self._measure()

    def set_parameter(self, name: str) -> None:
        """Take up a parameter that was changed in flight; those that are none of the simulation's change nothing."""
        if name.startswith("MC_"):
            self.gains = _gains(self._flight, self._parameters)
        elif name == "SIM_NOISE_SCALE":
            self.sigma = self._sigma()
            self.gains = _gains(self._flight, self._parameters)
            if self.sensed is not None:
                self.sensed.set_noise()
        elif name.startswith(("SIM_GYR_", "SIM_ACC_")):
            if self.sensed is not None:
                self.sensed.set_noise()
        elif name == "SIM_MASS_SCALE":
            self.plant = self._plant()
        elif name.startswith("SIM_WIND_"):
            self._set_winds(self._parameter_winds())
            self._draw()

    def specific_force(self, j: int) -> Vector:
        """What an accelerometer at the centre measures, mean over the last tick, m/s^2 FLU: (0, 0, g) at rest."""
        period_s = self.substeps * self.dt_s
        ax, ay, az = ((self.x[3:6, j] - self._velocity[:, j]) / period_s).tolist()
        w, x, y, z = self.x[6:10, j].tolist()
        return rotate(conjugate((w, x, y, z)), (ax, ay, az + self._flight.airframe.gravity_m_s2))

    def _plant(self) -> tick.Array:
        scenario = self._flight.scenario
        offnominal = scenario.offnominal
        scale = offnominal.mass_scale * self._parameters["SIM_MASS_SCALE"]
        offnominal = msgspec.structs.replace(offnominal, mass_scale=scale)
        return plant_parameters(self._flight.airframe, offnominal, scenario.ground_contact, self.n)

    def _sigma(self) -> tick.Array:
        noise = self._flight.scenario.noise
        sigma = [noise.position_m, noise.velocity_m_s, radians(noise.attitude_deg), radians(noise.rate_deg_s)]
        return np.array(sigma) * self._parameters["SIM_NOISE_SCALE"]

    def _parameter_winds(self) -> tuple[Wind, ...]:
        """SIM_WIND_*: a mean wind, and turbulence, on top of the scenario's."""
        p = self._parameters
        from_deg = p["SIM_WIND_DIR"]
        winds: list[Wind] = []
        if p["SIM_WIND_SPD"] > 0.0:
            x, y, z = (p["SIM_WIND_SPD"] * mil_axes(from_deg)[0]).tolist()
            winds.append(Steady(velocity_nwu_m_s=(x, y, z)))
        if p["SIM_WIND_TURB"]:
            winds.append(DrydenMil(speed_20ft_m_s=p["SIM_WIND_W20"], altitude_m=TURBULENCE_HEIGHT_M, from_deg=from_deg))
        return tuple(winds)

    def _set_winds(self, added: tuple[Wind, ...]) -> None:
        """The scenario's winds, whose turbulence goes on, and `added`, whose turbulence begins stationary."""
        extra = WindField(added, self.n, self.dt_s)
        rows = extra.normals_for_reset
        extra.reset(np.stack([g.standard_normal(rows) for g in self._wind_generators], axis=-1))
        field = WindField(self._flight.scenario.wind + added, self.n, self.dt_s)
        kept = self._scenario_rows
        field.state[:kept] = self.field.state[:kept]
        field.state[kept:] = extra.state
        self.field = field
        if self._gust is not None:
            field.add(self._gust)

    def blow(self, gust: Gust | None) -> None:
        """A gust on top of everything else, in place of the one before; None: it is over."""
        if self._gust is not None:
            self.field.drop_last()
        self._gust = gust
        if gust is not None:
            self.field.add(gust)

    def stall(self, stalled: bool) -> None:
        """The inner loops stand still: the rotors keep what they were commanded last."""
        if stalled:
            self._stalled_inner = self.inner.copy()
            self.motors.hold(self._command[:, 0])
        elif self._stalled_inner is not None:
            self.inner[:], self._stalled_inner = self._stalled_inner, None
            self.motors.hold(None)

    def advance(self, flight_time_s: float) -> None:
        """One control period: the inner loops and the physics at the physics rate, then the sensors.

        `flight_time_s`: since the release, negative before it; gusts go by it.
        """
        row = self._tick % BLOCK_TICKS
        if row == 0 and self._tick:
            self._draw()
        self._velocity[:] = self.x[3:6]
        self._tick += 1
        field = self.field
        if self.motors.busy:
            self.motors.step((self._tick - 1) * self.substeps * self.dt_s, self.x[13:17, 0])
        if self.sensed is not None:
            self._advance_sensed(self.sensed, row, flight_time_s)
            return
        tick.advance(
            self.x, self.estimate, self.demand, self.gains, self.inner, self.held, self.plant, self.motors.rows,
            self._command, field.state, field.coefficients, self.wind, self._wind_block[row], self._sensor_block[row],
            self.sigma, flight_time_s, self.dt_s, self.substeps,
        )  # fmt: skip

    def _advance_sensed(self, sensed: SensedEstimator, row: int, flight_time_s: float) -> None:
        field, unit = self.field, sensed.imu
        tick.advance_sensed(
            self.x, self.estimate, self.demand, self.gains, self.inner, self.held, self.plant, self.motors.rows,
            self._command, field.state, field.coefficients, self.wind, self._wind_block[row], self._sensor_block[row],
            unit.state, unit.late, unit.settings, unit.added, *sensed.failure_kinds(),
            flight_time_s, self.dt_s, self.substeps,
        )  # fmt: skip
        sensed.update(self.x, self.at_rest, self.estimate)

    def _make_sensed(self, seed: int, failures: Failures) -> SensedEstimator:
        return SensedEstimator(self._flight, self._parameters, failures, seed, self.x, self.dt_s)

    def _draw(self) -> None:
        wind_rows = self.substeps * self.field.normals_per_step
        if self.sensed is None:
            sensor_rows = self.substeps * tick.GYRO_NORMALS + tick.MEASURE_NORMALS
            generators = self._sensor_generators
        else:
            sensor_rows = (self.substeps + 1) * imu.NORMALS
            generators = self.sensed.imu.generators
        self._wind_block = np.stack(
            [g.standard_normal((BLOCK_TICKS, wind_rows)) for g in self._wind_generators], axis=-1
        )
        self._sensor_block = np.stack([g.standard_normal((BLOCK_TICKS, sensor_rows)) for g in generators], axis=-1)

    def _warm_up(self) -> None:
        """Run each kernel once on copies, so that compiling, or reading the cache, is done before the clock runs."""
        x, estimate, demand, inner = self.x.copy(), self.estimate.copy(), self.demand.copy(), self.inner.copy()
        if self.sensed is not None:
            self._warm_up_sensed(x, estimate, demand, inner)
            return
        for kind in (tick.STOPPED, tick.ATTITUDE_KIND):
            demand[tick.KIND] = kind
            tick.advance(
                x, estimate, demand, self.gains, inner, self.held, self.plant, self.motors.rows.copy(),
                self._command.copy(),
                self.field.state.copy(), self.field.coefficients, self.wind.copy(),
                self._wind_block[0], self._sensor_block[0], self.sigma, 0.0, self.dt_s, self.substeps,
            )  # fmt: skip

    def _warm_up_sensed(self, x: tick.Array, estimate: tick.Array, demand: tick.Array, inner: tick.Array) -> None:
        sensed, field = self._make_sensed(0, Failures()), self.field
        unit, held = sensed.imu, np.ones(self.n, dtype=np.bool_)
        unit.added[:] = 0.0  # nothing that would keep it from beginning
        unit.state[imu.BIAS : imu.BIAS + 6] = 0.0
        while sensed.now_us < WARM_UP_US:
            for kind in (tick.STOPPED, tick.ATTITUDE_KIND):
                demand[tick.KIND] = kind
                tick.advance_sensed(
                    x, estimate, demand, self.gains, inner, held, self.plant, self.motors.rows.copy(),
                    self._command.copy(),
                    field.state.copy(), field.coefficients, self.wind.copy(), self._wind_block[0],
                    self._sensor_block[0], unit.state, unit.late, unit.settings, unit.added, 0, 0,
                    0.0, self.dt_s, self.substeps,
                )  # fmt: skip
            sensed.update(x, held, estimate)

    def _measure(self) -> None:
        normals = np.stack([g.standard_normal(tick.MEASURE_NORMALS) for g in self._sensor_generators], axis=-1)
        tick.measure(self.x, self.sigma, normals, self.estimate)


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
