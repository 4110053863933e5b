"""The paper's controller as an off-board process: telemetry in, observer, reference, PID, PIDNN, setpoint out.

Sans-IO.
"""

from __future__ import annotations

from collections.abc import Callable
from math import acos, cos, degrees, exp, radians, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavsitl.codec import packer
from mavsitl.control.filters import FirstOrder
from mavsitl.control.inner_loop import InnerLoop
from mavsitl.control.pid import PositionLoop
from mavsitl.control.wind_observer import WindObserver, model_acceleration
from mavsitl.dialect import mavlink
from mavsitl.frames import Quaternion, Vector, flip_euler
from mavsitl.log import topics
from mavsitl.log.block import Block, ned
from mavsitl.log.ulog import Recorder
from mavsitl.node import Node
from mavsitl.quaternion import from_euler
from mavsitl.scenario import Flight, ScenarioError
from mavsitl.services.statustext import Joiner
from mavsitl_ground import demand
from mavsitl_ground.observer import Observer
from mavsitl_ground.reference import reference_for
from mavsitl_ground.sequence import ENDED, Handshake, Phase

Array = NDArray[np.float64]

SYSTEM_ID = 250
COMPONENT_ID = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
HEARTBEAT_INTERVAL_US = 1_000_000

HEARTBEAT = packer(mavlink.MAVLink_heartbeat_message)
COMMAND_LONG = packer(mavlink.MAVLink_command_long_message)

STATE_MESSAGES = {
    "odometry": (mavlink.MAVLINK_MSG_ID_ODOMETRY,),
    "split": (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED),
}
SYS_STATE_INTERVAL_US = 200_000

CRASHED_HEIGHT_M = 0.5
CRASHED_TILT_COS = cos(radians(60.0))
CRASHED_BELOW_M = 1.0
CRASHED_TIME_US = 1_000_000
"""So long, over ground, lower than that, and tilted beyond that or so far below the reference though it has flown."""


class Controller:
    """The paper's nested loops (fig 3) for one vehicle, from state to demand.

    No message, no clock but the vehicle's stamp.
    """

    def __init__(self, flight: Flight, offset_nwu_m: Vector = (0.0, 0.0, 0.0)) -> None:
        """`offset_nwu_m` moves the reference.

        Raises `ScenarioError` where the airframe does not say what the command level needs.
        """
        scenario, airframe = flight.scenario, flight.airframe
        settings = scenario.controller
        self._airframe = airframe
        self._settings = settings
        self._period_s = scenario.rates.control_period_us / 1e6
        self._reference = reference_for(scenario.reference, offset_nwu_m)
        self._outer = PositionLoop(
            settings.altitude, settings.position, airframe.mass_kg, airframe.gravity_m_s2,
            radians(settings.tilt_limit_deg), airframe.max_thrust_n, self._period_s,
        )  # fmt: skip
        self._filter = FirstOrder(settings.angle_filter_rad_s, self._period_s, rows=2)
        self._inner = InnerLoop(settings, airframe, self._period_s)
        self._wind_observer = WindObserver(
            settings.wind_observer.horizontal_rad_s, settings.wind_observer.vertical_rad_s
        )
        self._rate_gain = _rate_gain(flight) if settings.level == "body_rate" else (1.0, 1.0, 1.0)
        self._whole_attitude = settings.level == "attitude" and settings.inner == "stock"
        self._yaw_rad = np.zeros(1)
        self._lead_s = _attitude_lag_s(flight) if settings.level == "attitude" else 0.0
        tau = airframe.rotor_time_constant_s
        self._thrust_share = 1.0 - exp(-self._period_s / tau) if tau > 0.0 else 1.0
        area = np.pi * airframe.rotor_radius_m**2
        self._coupling = airframe.wind_coupling * sqrt(8.0 * airframe.air_density_kg_m3 * area) / airframe.mass_kg
        self._wanted = np.zeros(9)
        self._position = self._wanted[0:3, np.newaxis]
        self._velocity = self._wanted[3:6, np.newaxis]
        self._acceleration = self._wanted[6:9, np.newaxis]
        self._model = np.zeros((3, 1))
        self._desired = np.zeros((3, 1))
        self._desired_rates = np.zeros((3, 1))
        self._tilt = np.zeros((2, 1))
        self._no_wind = np.zeros((3, 1))
        self._acting_thrust = np.array([airframe.weight_n])
        self.wind_acceleration = self._no_wind
        """W_1..W_3 as used, m/s^2 NWU (3, 1)."""
        self.reference = self._reference.sample(0.0)
        """Position m, velocity m/s, acceleration m/s^2 (NWU) and yaw rad as last used."""
        self.thrust_n = airframe.weight_n
        self.omega_acceleration = np.zeros((3, 1))
        """What the inner loop asked for, rad/s^2 FLU (3, 1)."""
        self.reset()
        self.update(0.0, Observer())  # compiles, or reads the cache, before the clock runs
        self.reset()

    @property
    def desired_rad(self) -> Array:
        """phi_d, theta_d, psi_d as handed to the inner loop (3, 1)."""
        return self._desired

    @property
    def weights(self) -> Array | None:
        """The PIDNN's output weights (3 outputs, 3 axes, 1); None for the PID."""
        return self._inner.weights

    def reset(self) -> None:
        """At rest at the start of a flight: integrators empty, nets as the identical PID, rotors at hover."""
        self._outer.reset()
        self._filter.reset()
        self._inner.reset()
        self._wind_observer.reset()
        self._acting_n = self._acting_thrust[0] = self._airframe.weight_n
        self.thrust_n = self._airframe.weight_n
        self._stamp_us = -1
        self.wind_acceleration = self._no_wind

    def update(self, time_s: float, state: Observer) -> None:
        """One control cycle at flight time `time_s`; fills thrust_n, desired_rad and omega_acceleration."""
        self.reference = self._reference.sample(time_s)
        position, velocity, acceleration, yaw = self.reference
        self._wanted[:] = (*position, *velocity, *acceleration)
        self.wind_acceleration = self._wind(state)
        thrust, phi, theta = self._outer.update(
            state.position_nwu_m, state.velocity_nwu_m_s, state.quaternion,
            self._position, self._velocity, self._acceleration, self._yaw(state, yaw), self.wind_acceleration,
        )  # fmt: skip
        self._tilt[0, 0], self._tilt[1, 0] = phi[0], theta[0]
        self._filter.update(self._tilt)
        self._desired[:2] = self._filter.value
        self._desired_rates[:2] = self._filter.rate
        self._desired[2, 0] = yaw
        self.thrust_n = float(thrust[0])
        if self._settings.level != "attitude":
            self.omega_acceleration = self._inner.update(
                state.angles_rad, state.angle_rates_rad_s, self._desired, self._desired_rates
            )

    def _yaw(self, state: Observer, reference_rad: float) -> Array:
        """The yaw at which the tilt is flown: the reference's where all is sent as one attitude, else the measured."""
        if not self._whole_attitude:
            measured: Array = state.angles_rad[2]
            return measured
        self._yaw_rad[0] = reference_rad
        return self._yaw_rad

    def _wind(self, state: Observer) -> Array:
        """W_1..W_3 of eq 11 by the scenario's source; the model includes the rotors' lag where the airframe has one."""
        acting_n = self._acting_n + self._thrust_share * (self.thrust_n - self._acting_n)
        self._acting_n = self._acting_thrust[0] = acting_n
        source = self._settings.wind_information
        if source == "oracle":
            if state.true_wind_nwu_m_s is None:
                return self._no_wind
            return self._coupling * sqrt(max(acting_n, 0.0)) * state.true_wind_nwu_m_s
        if source == "none":
            return self._no_wind
        airframe = self._airframe
        model_acceleration(state.quaternion, self._acting_thrust, airframe.mass_kg, airframe.gravity_m_s2, self._model)
        period_s = self._period_s if self._stamp_us < 0 else (state.stamp_us - self._stamp_us) / 1e6
        self._stamp_us = state.stamp_us
        return self._wind_observer.update(state.velocity_nwu_m_s, self._model, period_s)

    def rates_flu_rad_s(self, state: Observer) -> Vector:
        """Level `body_rate`: the rates that make a proportional rate loop give the wanted angular acceleration."""
        p, q, r = state.omega_flu_rad_s[:, 0].tolist()
        to_p, to_q, to_r = self.omega_acceleration[:, 0].tolist()
        k_p, k_q, k_r = self._rate_gain
        return p + to_p / k_p, q + to_q / k_q, r + to_r / k_r

    def attitude(self) -> Quaternion:
        """Level `attitude`: the desired angles, leading by the known lag of the loop aboard, FLU -> NWU.

        The loop aboard gets no angle rates over the wire, so without the lead it would follow phi_d late.
        """
        phi, theta, psi = self._desired[:, 0].tolist()
        phi_rate, theta_rate, _ = self._desired_rates[:, 0].tolist()
        return from_euler(phi + self._lead_s * phi_rate, theta + self._lead_s * theta_rate, psi)

    def torque_shares(self) -> list[float]:
        shares: list[float] = self._inner.torque_shares(self.omega_acceleration)[:, 0].tolist()
        return shares


def _attitude_lag_s(flight: Flight) -> float:
    """Lag of the attitude loop aboard behind a ramp, s: 1 / MC_ROLL_P for the stock one, none for the PIDNN (eq 28)."""
    if flight.scenario.controller.inner == "pidnn":
        return 0.0
    parameters = flight.airframe.parameters | flight.scenario.parameters
    roll, pitch = (parameters.get(f"MC_{axis}_P", 0.0) for axis in ("ROLL", "PITCH"))
    if not roll > 0.0 or roll != pitch:
        raise ScenarioError(
            f"{flight.name}: parameters.MC_ROLL_P, MC_PITCH_P: level 'attitude' needs both, equal and above 0, "
            "in the airframe or the scenario"
        )
    return 1.0 / roll


def _rate_gain(flight: Flight) -> Vector:
    """Angular acceleration per rad/s of rate error of the vehicle's rate loop, 1/s, from its MC_*RATE_P."""
    airframe, gains = flight.airframe, list[float]()
    parameters = airframe.parameters | flight.scenario.parameters
    for axis, torque, inertia in zip(
        ("ROLL", "PITCH", "YAW"), airframe.max_torque_n_m, airframe.inertia_kg_m2, strict=True
    ):
        name = f"MC_{axis}RATE_P"
        if not parameters.get(name, 0.0) > 0.0:
            raise ScenarioError(
                f"{flight.name}: parameters.{name}: level 'body_rate' needs it in the airframe or the scenario"
            )
        gains.append(parameters[name] * torque / inertia)
    return gains[0], gains[1], gains[2]


class Ground:
    """The off-board process' core: MAVLink endpoint, handshake, controller and log. A driver of the bridge runs it."""

    def __init__(
        self,
        flight: Flight,
        recorder: Recorder,
        *,
        report: Callable[[str], None] = lambda text: None,
        vehicle_system_id: int | None = None,
        offset_nwu_m: Vector = (0.0, 0.0, 0.0),
    ) -> None:
        """`report` gets a line at each step of the handshake and each STATUSTEXT of the vehicle.

        `offset_nwu_m`: the vehicle's place in a formation, by which the reference is moved.
        """
        scenario = flight.scenario
        self.period_us = scenario.rates.control_period_us
        self._scenario = scenario
        self._level = scenario.controller.level
        self._node = Node(SYSTEM_ID, COMPONENT_ID)
        self._observer = Observer(scenario.controller.telemetry)
        self._controller = Controller(flight, offset_nwu_m)
        self._report = report
        self._texts = Joiner()
        messages = [(message_id, self.period_us) for message_id in STATE_MESSAGES[scenario.controller.telemetry]]
        messages.append((mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, SYS_STATE_INTERVAL_US))
        required: frozenset[int] = frozenset()
        if scenario.controller.wind_information == "oracle":
            messages.append((mavlink.MAVLINK_MSG_ID_DEBUG_VECT, self.period_us))
            required = frozenset((mavlink.MAVLINK_MSG_ID_DEBUG_VECT,))  # without it the oracle would know nothing
        self._handshake = Handshake(
            self._send_command,
            messages,
            land=scenario.ground_contact,
            required=required,
            system_id=vehicle_system_id,
            report=report,
        )
        self._hover_thrust = 1.0 / flight.airframe.thrust_to_weight
        self._max_thrust_n = flight.airframe.max_thrust_n
        self._released_us: int | None = None
        self._down_since_us: int | None = None
        self._has_flown = False
        self._heartbeat_us = -HEARTBEAT_INTERVAL_US
        self._record = _Record(
            recorder, flight, with_weights=self._level != "attitude" and self._controller.weights is not None
        )
        self._now_us = 0

    @property
    def phase(self) -> str:
        return self._handshake.phase.name

    @property
    def finished(self) -> bool:
        return self._handshake.phase in ENDED

    @property
    def succeeded(self) -> bool:
        return self._handshake.phase is Phase.DONE

    @property
    def lost(self) -> str:
        """How the vehicle was lost in flight; empty: it was not."""
        return self._handshake.lost

    @property
    def flight_time_s(self) -> float:
        """By the vehicle's clock since the release; negative before it."""
        return -1.0 if self._released_us is None else (self._observer.stamp_us - self._released_us) / 1e6

    @property
    def in_control(self) -> bool:
        """The vehicle flies and follows."""
        return self._handshake.in_control

    @property
    def position_nwu_m(self) -> Vector:
        """Of the vehicle, as last told."""
        x, y, z = self._observer.position_nwu_m[:, 0].tolist()
        return x, y, z

    @property
    def reference_nwu_m(self) -> Vector:
        """Where it was to be when it was last controlled."""
        return self._controller.reference[0]

    @property
    def vehicle_time_us(self) -> int:
        """The vehicle's clock at the newest state; -1 before the first."""
        return self._observer.stamp_us

    @property
    def counters(self) -> Any:
        return self._node.counters

    def receive(self, port: int, datagram: bytes) -> int:
        """One datagram from the link; the number of valid frames in it."""
        frames = self._node.receive(datagram)
        handshake = self._handshake
        for frame in frames:
            message = frame.message
            if type(message).id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
                handshake.on_heartbeat(message, frame.system_id, frame.component_id, self._now_us)
            elif handshake.accepts(frame.system_id, frame.component_id):
                stamp_us = self._observer.stamp_us
                self._observer.receive(message)
                handshake.clock_goes_on = handshake.clock_goes_on or self._observer.stamp_us > stamp_us
                handshake.on_message(message, self._now_us)
                if type(message).id == mavlink.MAVLINK_MSG_ID_STATUSTEXT:
                    sender = (frame.system_id, frame.component_id)
                    for text in self._texts.receive(message, sender, self._now_us):
                        self._report(f"vehicle: {text.text}")
        return len(frames)

    def step(self, now_us: int) -> None:
        """At least every control period, and after each datagram: control on new state, handshake, heartbeat."""
        self._now_us = now_us
        for text in self._texts.step(now_us):
            self._report(f"vehicle: {text.text}")
        handshake, state = self._handshake, self._observer
        before = handshake.phase
        restarted = state.restarted
        if restarted:
            handshake.lose("its clock went back, it has restarted", now_us)
        handshake.step(now_us)
        if restarted or (handshake.phase is Phase.SEARCH and before is not Phase.SEARCH):
            self._observer.reset()
            self._controller.reset()
            self._released_us = None
        if handshake.phase is Phase.FLY and self._released_us is None:
            self._released_us = state.stamp_us
        if state.fresh and state.valid(now_us):
            state.take()
            if self._scenario.ground_contact:
                self._watch_crash(now_us)
            self._control(now_us)
        if now_us - self._heartbeat_us >= HEARTBEAT_INTERVAL_US and not self.finished:
            self._heartbeat_us = now_us
            self._node.send(
                HEARTBEAT,
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
                mavlink.MAV_AUTOPILOT_INVALID,
                0,
                0,
                mavlink.MAV_STATE_ACTIVE,
                3,
            )

    def datagrams(self, port: int, *, combine: bool) -> list[bytes]:
        return self._node.datagrams(combine=combine)

    def _control(self, now_us: int) -> None:
        handshake, state, controller = self._handshake, self._observer, self._controller
        target = handshake.target
        if target is None or self.finished:
            return
        if self._released_us is None or not (handshake.in_control or handshake.phase is Phase.STOP):
            controller.reset()
            thrust = self._hover_thrust if handshake.armed else 0.0
            self._send_idle(target, thrust)
            return
        time_s = (state.stamp_us - self._released_us) / 1e6
        controller.update(time_s, state)
        thrust = controller.thrust_n / self._max_thrust_n
        if self._level == "attitude":
            demand.send_attitude(self._node, target, state.stamp_us, controller.attitude(), thrust)
        elif self._level == "body_rate":
            demand.send_rates(self._node, target, state.stamp_us, controller.rates_flu_rad_s(state), thrust)
        else:
            demand.send_torque(self._node, target, state.stamp_us, controller.torque_shares(), thrust)
        source = self._node.sources.get(target)
        lost = 0 if source is None else source.lost
        self._record.write(now_us, state, controller, thrust, self._node.counters, lost)
        if handshake.phase is Phase.FLY and time_s >= self._scenario.duration_s:
            handshake.finish(now_us)

    def _watch_crash(self, now_us: int) -> None:
        state, handshake = self._observer, self._handshake
        height_m = float(state.position_nwu_m[2, 0])
        low = height_m < CRASHED_HEIGHT_M
        flies = handshake.phase is Phase.FLY
        self._has_flown = flies and (self._has_flown or height_m > CRASHED_HEIGHT_M + CRASHED_BELOW_M)
        if not low or handshake.lost or handshake.phase not in (Phase.FLY, Phase.STOP):
            self._down_since_us = None
            return
        phi, theta, _ = state.angles_rad[:, 0].tolist()
        upright = cos(phi) * cos(theta)
        below_m = self._controller.reference[0][2] - height_m
        sunk = self._has_flown and handshake.in_control and below_m > CRASHED_BELOW_M
        if not (upright < CRASHED_TILT_COS or sunk):
            self._down_since_us = None
        elif self._down_since_us is None:
            self._down_since_us = state.stamp_us
        elif state.stamp_us - self._down_since_us >= CRASHED_TIME_US:
            text = f"the vehicle is on the ground, {below_m:.1f} m below its reference"
            handshake.crash(f"{text}, tilted by {degrees(acos(upright)):.0f} deg", now_us)

    def _send_idle(self, target: tuple[int, int], thrust: float) -> None:
        """Before the flight and while not in control: level, no rates; it keeps the stream, and lock-step, going."""
        stamp_us = self._observer.stamp_us
        if self._level == "attitude":
            yaw_rad = float(self._observer.angles_rad[2, 0])
            demand.send_attitude(self._node, target, stamp_us, from_euler(0.0, 0.0, yaw_rad), thrust)
        elif self._level == "body_rate":
            demand.send_rates(self._node, target, stamp_us, (0.0, 0.0, 0.0), thrust)
        else:
            demand.send_torque(self._node, target, stamp_us, (0.0, 0.0, 0.0), thrust)

    def _send_command(self, command: int, confirmation: int, params: tuple[float, ...]) -> None:
        system_id, component_id = self._handshake.target or (0, 0)
        self._node.send(COMMAND_LONG, system_id, component_id, command, confirmation, *params)


# Columns of the ground's log block.
_REFERENCE = slice(0, 7)  # position, velocity, yaw
_DESIRED = slice(7, 10)
_THRUST = 10
_U1 = 11
_ACCELERATION = slice(12, 15)
_WIND = slice(15, 18)
_LINK = slice(18, 22)
_WEIGHTS = slice(22, 31)  # (P, I, D) x (roll, pitch, yaw)
_WIDTH = 31


class _Record:
    """The ground's log, on the vehicle's clock: what was wanted, commanded and learned in each cycle."""

    def __init__(self, recorder: Recorder, flight: Flight, with_weights: bool) -> None:
        airframe = flight.airframe
        # Angular acceleration to U_2, U_3 (forces) and U_4 (torque).
        per_u = np.array(airframe.inertia_kg_m2) / (airframe.arm_m, airframe.arm_m, 1.0)
        self._with_weights = with_weights
        columns = [
            (topics.TRAJECTORY_SETPOINT, lambda v: np.hstack((ned(v[:, 0:3]), ned(v[:, 3:6]), -v[:, 6:7]))),
            (topics.ATTITUDE_SETPOINT, _attitude_setpoint),
            (
                topics.CONTROL_DEMAND,
                lambda v: np.hstack((v[:, _U1, np.newaxis], v[:, _ACCELERATION] * per_u, v[:, _WIND])),
            ),
            (topics.LINK_STATUS, lambda v: v[:, _LINK]),
        ]
        if with_weights:
            by_net = [0, 3, 6, 1, 4, 7, 2, 5, 8]  # from (P, I, D) x (roll, pitch, yaw) to a net after another
            columns.append((topics.PIDNN_WEIGHTS, lambda v: v[:, _WEIGHTS][:, by_net]))
        self._block = Block(recorder, _WIDTH, columns)

    def write(
        self, now_us: int, state: Observer, controller: Controller, thrust: float, counters: Any, lost: int
    ) -> None:
        row = self._block.row(state.stamp_us)
        position, velocity, _, yaw = controller.reference
        row[_REFERENCE] = (*position, *velocity, yaw)
        row[_DESIRED] = controller.desired_rad[:, 0]
        row[_THRUST] = thrust
        row[_U1] = controller.thrust_n
        row[_ACCELERATION] = controller.omega_acceleration[:, 0]
        row[_WIND] = controller.wind_acceleration[:, 0]
        row[_LINK] = (counters.frames, lost, counters.rejected, state.age_us(now_us) or 0)
        if self._with_weights and controller.weights is not None:
            row[_WEIGHTS] = controller.weights.reshape(9)


def _attitude_setpoint(values: Array) -> Array:
    """phi_d, theta_d, psi_d in FRD and PX4's thrust_body, (k, 6)."""
    zero = np.zeros(len(values))
    return np.column_stack((*flip_euler(*values[:, _DESIRED].T), zero, zero, -values[:, _THRUST]))


def build(flight: Flight, recorder: Any, *, count: int | None = None, **options: Any) -> Any:
    """The entry point `mavsitl.ground`: a ground core for the bridge's drivers; with `count` a `Formation`.

    `recorder` is one of these, for a formation as many.
    """
    if count is None:
        return Ground(flight, recorder, **options)
    from mavsitl_ground.formation import Formation  # here, for it is made of grounds

    return Formation(flight, recorder, count=count, **options)
