"""The paper's controller as an off-board process: telemetry in, observer, reference, PID, PIDNN, setpoint out.

Sans-IO.
"""

from __future__ import annotations

from collections.abc import Callable
from math import acos, cos, degrees, exp, radians, sqrt
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from mavsitl.codec import Frame, packer
from mavsitl.compiled import direct
from mavsitl.control.arrays import Floats, Record, record
from mavsitl.control.filters import FirstOrder
from mavsitl.control.inner_loop import InnerLoop
from mavsitl.control.pid import PositionLoop
from mavsitl.control.wind_observer import WindObserver
from mavsitl.dialect import mavlink
from mavsitl.frames import Vector, flip_quaternion, flip_vector
from mavsitl.log.ulog import Recorder
from mavsitl.node import Node
from mavsitl.quaternion import IDENTITY, from_yaw
from mavsitl.scenario import Flight, ScenarioError
from mavsitl.services.statustext import Joiner
from mavsitl_ground import cycle
from mavsitl_ground.cycle import Demand
from mavsitl_ground.demand import SENDS, Send
from mavsitl_ground.laws import Law, carry_over
from mavsitl_ground.monitor import Monitor
from mavsitl_ground.observer import Observer
from mavsitl_ground.record import block
from mavsitl_ground.reference import reference_for
from mavsitl_ground.sequence import ENDED, NOW, Handshake, Phase

if TYPE_CHECKING:
    from mavsitl.controllers import ControllerError
    from mavsitl_ground.seat import Seat

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
        settings = flight.scenario.controller
        self._flight = flight
        self.reference = reference_for(flight.scenario.reference, offset_nwu_m)
        self.law: Law | None = None if settings.level == "attitude" else settings.law
        """The attitude law that is here; None: it is aboard, or there is none."""
        self._cycles: dict[Law | None, Callable[..., Demand]] = {}
        self._take_seat(_at_rest(flight))

    def _take_seat(self, memory: Record) -> None:
        """At rest, with the memory of the law, which is compiled, or read from the cache, where it flies first."""
        self._memory = memory
        self._at_rest = memory.copy()
        if self.law not in self._cycles:
            state, row = Observer(self._flight.scenario.controller.telemetry).state, np.zeros(cycle.COLUMNS)
            self._cycles[self.law] = direct(
                _CYCLES[self.law], memory, state, self.reference.now, row, 0, 0, 0, 0, 0
            )  # fmt: skip
            self.reset()
        self._cycle = self._cycles[self.law]

    def reset(self) -> None:
        """At rest at the start of a flight: integrators empty, nets as the identical PID, rotors at hover."""
        self._memory[:] = self._at_rest

    @property
    def learns(self) -> bool:
        """A PIDNN is here, not aboard or nowhere: rows of the log have its weights."""
        return self.law == "pidnn"

    @property
    def desired_rad(self) -> Vector:
        """phi_d, theta_d, psi_d."""
        return _numbers(self._memory[0]["desired"])

    @property
    def control(self) -> tuple[float, Vector]:
        """U_1 in N and W_1..W_3 in m/s^2."""
        return float(self._memory[0]["thrust_n"]), _numbers(self._memory[0]["wind"])

    @property
    def weights(self) -> tuple[list[float], list[float]] | None:
        """(9,) the nets' output weights, net after net, and what they start from; None: no nets here."""
        if not self.learns:
            return None
        law = self._memory[0]["law"]
        return law["weights"][:, :, 0].T.ravel().tolist(), law["initial"].T.ravel().tolist()

    @property
    def gains(self) -> list[float] | None:
        """(9,) of the PID, axis after axis; None: no PID here."""
        return None if self.law != "pid" else self._memory[0]["law"]["gains"].T.ravel().tolist()

    def prepare(self) -> None:
        """Before the flight, where the law may be changed in it: both laws are compiled."""
        if self.law is not None:
            for law in (_OTHER[self.law], self.law):
                self.fly_by(law)
            self.reset()

    def fly_by(self, law: Law) -> None:
        """Go on with this attitude law. Raises `ValueError` where the attitude is not controlled here."""
        if self.law is None:
            raise ValueError("the attitude is controlled aboard: there is no law to change")
        if law == self.law:
            return
        before, scenario = self._memory, self._flight.scenario
        scenario = msgspec.structs.replace(scenario, controller=msgspec.structs.replace(scenario.controller, law=law))
        self.law = law
        self._take_seat(_at_rest(msgspec.structs.replace(self._flight, scenario=scenario)))
        carry_over(before, self._memory)

    def update(
        self, time_s: float, state: Observer, row: Floats, frames: int, lost: int, rejected: int, age_us: int
    ) -> Demand:
        """One control cycle at flight time `time_s`; fills `row`, (cycle.COLUMNS,), where the last four are columns."""
        self.reference.move(time_s)
        control = self._cycle
        return control(
            self._memory, state.state, self.reference.now, row,
            state.stamp_us, frames, lost, rejected, age_us,
        )  # fmt: skip


_OTHER: dict[Law, Law] = {"pid": "pidnn", "pidnn": "pid"}
_CYCLES = {None: cycle.attitude_cycle, "pid": cycle.pid_cycle, "pidnn": cycle.net_cycle}


def _at_rest(flight: Flight) -> Record:
    """What the compiled cycle keeps for itself, before the first period: settings, the laws' records, outputs."""
    scenario, airframe = flight.scenario, flight.airframe
    settings = scenario.controller
    period_s = scenario.rates.control_period_us / 1e6
    outer = PositionLoop(
        settings.altitude, settings.position, airframe.mass_kg, airframe.gravity_m_s2,
        radians(settings.tilt_limit_deg), airframe.max_thrust_n, period_s,
    )  # fmt: skip
    inner = InnerLoop(settings, airframe, period_s)
    tau = airframe.rotor_time_constant_s
    area = np.pi * airframe.rotor_radius_m**2
    coupling = airframe.wind_coupling * sqrt(8.0 * airframe.air_density_kg_m3 * area) / airframe.mass_kg
    vector = np.zeros((3, 1))
    return record(
        period_s=period_s,
        level=cycle.LEVELS.index(settings.level),
        whole_attitude=settings.level == "attitude" and settings.inner == "stock",
        lead_s=_attitude_lag_s(flight) if settings.level == "attitude" else 0.0,
        rate_gain=_rate_gain(flight) if settings.level == "body_rate" else (1.0, 1.0, 1.0),
        acceleration_limit=inner.limit,
        max_thrust_n=airframe.max_thrust_n,
        mass_kg=airframe.mass_kg,
        gravity_m_s2=airframe.gravity_m_s2,
        wind_source=cycle.WIND_SOURCES.index(settings.wind_information),
        coupling=coupling,
        thrust_share=1.0 - exp(-period_s / tau) if tau > 0.0 else 1.0,
        # From period to period.
        stamp_us=-1,
        thrust_n=airframe.weight_n,
        acting_n=[airframe.weight_n],
        position=outer.record(),
        filter=FirstOrder(settings.angle_filter_rad_s, period_s, rows=2).record(),
        observer=WindObserver(settings.wind_observer.horizontal_rad_s, settings.wind_observer.vertical_rad_s).record(),
        law=inner.law.record(),
        wind=vector,  # W_1..W_3; the observer's state
        desired=vector,  # phi_d, theta_d, psi_d; the filter's state
        desired_rates=vector,
        # Filled in each period.
        model=vector,
        yaw=[0.0],
        direct=vector,
    )


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
        monitored: bool = False,
    ) -> None:
        """`report` gets a line at each step of the handshake and each STATUSTEXT of the vehicle.

        `offset_nwu_m`: the vehicle's place in a formation, by which the reference is moved. `monitored`: there is a
        `monitor`, and the law may be changed by it.
        """
        scenario = flight.scenario
        self.period_us = scenario.rates.control_period_us
        self._scenario = scenario
        self._node = Node(SYSTEM_ID, COMPONENT_ID)
        self._observer = Observer(scenario.controller.telemetry)
        self._report = report
        self._controller: Controller | Seat
        self._send_demand: Send
        if own := bool(scenario.controller.own):
            from mavsitl_ground.seat import Seat  # here, for few need it

            self._controller = Seat(flight, offset_nwu_m, self._on_broken)
            self._send_demand = self._controller.send
        else:
            self._controller = Controller(flight, offset_nwu_m)
            self._send_demand = SENDS[scenario.controller.level]
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
        self.monitor: Monitor | None = None
        if monitored:
            self._controller.prepare()
            self.monitor = Monitor(self)
        weights = self._controller.learns or (monitored and self.law is not None)
        self._rows = block(recorder, flight, with_weights=weights, own=own)
        self._log_gains()
        self._now_us = 0
        self._due_us = NOW
        """Until then, and until something comes but the state, nothing is to be done but control."""

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
        x, y, z = self._controller.reference.now["position"][0, :, 0].tolist()
        return x, y, z

    @property
    def vehicle_time_us(self) -> int:
        """The vehicle's clock at the newest state; -1 before the first."""
        return self._observer.stamp_us

    @property
    def counters(self) -> Any:
        return self._node.counters

    # What the monitor tells.

    @property
    def vehicle_system_id(self) -> int | None:
        """None before one is found."""
        target = self._handshake.target
        return None if target is None else target[0]

    @property
    def phase_number(self) -> int:
        return self._handshake.phase.value

    @property
    def reference_nwu(self) -> tuple[Vector, Vector, float]:
        """Position m, velocity m/s and yaw rad, as of the last period."""
        now = self._controller.reference.now[0]
        return _numbers(now["position"]), _numbers(now["velocity"]), float(now["yaw"][0])

    @property
    def desired_rad(self) -> Vector:
        """phi_d, theta_d, psi_d."""
        return self._controller.desired_rad

    @property
    def control(self) -> tuple[float, Vector]:
        """U_1 in N and W_1..W_3 in m/s^2."""
        return self._controller.control

    @property
    def weights(self) -> tuple[list[float], list[float]] | None:
        """(9,) the nets' output weights, net after net, and what they start from; None: no nets here."""
        return self._controller.weights

    def link(self, now_us: int) -> tuple[int, int, int, int]:
        """Frames received, lost, rejected, and the age of the state in us."""
        counters, source = self._node.counters, self._node.sources.get(self._handshake.target or (0, 0))
        lost = 0 if source is None else source.lost
        return counters.frames, lost, counters.rejected, self._observer.age_us(now_us) or 0

    @property
    def law(self) -> Law | None:
        """Of the attitude; None: it is controlled aboard."""
        return self._controller.law

    def fly_by(self, law: Law) -> None:
        """Change the attitude law. Raises as `Controller.fly_by`."""
        if law != self._controller.law:
            self._controller.fly_by(law)
            self._log_gains()
            self._report(f"the attitude is flown by {law.upper()}")

    def _log_gains(self) -> None:
        """Where the log has weights and no net is seated, they are the PID's gains."""
        gains = self._controller.gains
        if gains is not None:
            self._rows.preset(slice(cycle.WEIGHTS, cycle.COLUMNS), np.array(gains))

    def receive(self, port: int, datagram: bytes) -> int:
        """One datagram from the link; the number of valid frames in it."""
        frames = self._node.receive(datagram)
        for frame in frames:
            take = self._observer.handlers.get(frame.message_id)
            if take is None:
                self._on_message(frame)
            elif self._handshake.accepts(frame.system_id, frame.component_id):
                stamp_us = self._observer.stamp_us
                take(frame)
                self._handshake.on_state(self._observer.stamp_us > stamp_us, self._now_us)
        return len(frames)

    def _on_message(self, frame: Frame) -> None:
        """What is no state: the handshake's, and texts."""
        self._due_us = NOW
        handshake = self._handshake
        if frame.message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            handshake.on_heartbeat(frame.message, frame.system_id, frame.component_id, self._now_us)
        elif handshake.accepts(frame.system_id, frame.component_id):
            handshake.on_message(frame, self._now_us)
            if frame.message_id == mavlink.MAVLINK_MSG_ID_STATUSTEXT:
                sender = (frame.system_id, frame.component_id)
                for text in self._texts.receive(frame.message, sender, self._now_us):
                    self._report(f"vehicle: {text.text}")

    def step(self, now_us: int) -> None:
        """At least every control period, and after each datagram: control on new state, handshake, heartbeat."""
        self._now_us = now_us
        state = self._observer
        if now_us >= self._due_us or state.restarted:
            self._attend(now_us)
        age_us = state.take(now_us)
        if age_us is not None:
            if self._scenario.ground_contact:
                self._watch_crash(now_us)
            self._control(now_us, age_us)
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

    def _attend(self, now_us: int) -> None:
        """Texts, handshake, and what they mean for the flight."""
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
        self._due_us = NOW if self._texts.waiting else handshake.due_us

    def datagrams(self, port: int, *, combine: bool) -> list[bytes]:
        return self._node.datagrams(combine)

    def _control(self, now_us: int, age_us: int) -> None:
        """On a new state, `age_us` old."""
        handshake, state = self._handshake, self._observer
        target = handshake.target
        if target is None or handshake.phase in ENDED:
            return
        stamp_us, released_us = state.stamp_us, self._released_us
        if released_us is None or not (handshake.in_control or handshake.phase is Phase.STOP):
            self._controller.reset()
            self._send_demand(self._node, target, stamp_us, self._idle())
            return
        time_s = (stamp_us - released_us) / 1e6
        counters, source = self._node.counters, self._node.sources.get(target)
        demand = self._controller.update(
            time_s, state, self._rows.row(stamp_us),
            counters.frames, 0 if source is None else source.lost, counters.rejected, age_us,
        )  # fmt: skip
        send_demand = self._send_demand
        send_demand(self._node, target, stamp_us, demand)
        if time_s >= self._scenario.duration_s and handshake.phase is Phase.FLY:
            handshake.finish(now_us)
            self._due_us = NOW

    def _idle(self) -> Demand:
        """Before the flight and while not in control: level, no rates; it keeps the stream, and lock-step, going."""
        thrust = self._hover_thrust if self._handshake.armed else 0.0
        if self._scenario.controller.level == "attitude":
            yaw_rad = float(self._observer.angles_rad[2, 0])
            return flip_quaternion(*from_yaw(yaw_rad)), 0.0, 0.0, 0.0, thrust
        return IDENTITY, *flip_vector(0.0, 0.0, 0.0), thrust

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
        below_m = float(self._controller.reference.now["position"][0, 2, 0]) - height_m
        sunk = self._has_flown and handshake.in_control and below_m > CRASHED_BELOW_M
        if not (upright < CRASHED_TILT_COS or sunk):
            self._down_since_us = None
        elif self._down_since_us is None:
            self._down_since_us = state.stamp_us
        elif state.stamp_us - self._down_since_us >= CRASHED_TIME_US:
            text = f"the vehicle is on the ground, {below_m:.1f} m below its reference"
            handshake.crash(f"{text}, tilted by {degrees(acos(upright)):.0f} deg", now_us)
            self._due_us = NOW

    def _on_broken(self, error: ControllerError) -> None:
        """A controller of the user's own has failed."""
        self._report(f"{error}; the vehicle is to land\n{error.trace}".rstrip())
        self._handshake.fail(str(error), self._now_us)
        self._due_us = NOW

    def _send_command(self, command: int, confirmation: int, params: tuple[float, ...]) -> None:
        system_id, component_id = self._handshake.target or (0, 0)
        self._node.send(COMMAND_LONG, system_id, component_id, command, confirmation, *params)


def _numbers(column: Any) -> Vector:
    x, y, z = column[:, 0].tolist()
    return x, y, z


def build(flight: Flight, recorder: Any, *, count: int | None = None, **options: Any) -> Any:
    """The entry point `mavsitl.ground`: a ground core for the bridge's drivers; with `count` a `Formation`.

    `recorder` is one of these, for a formation as many.
    """
    if count is None:
        return Ground(flight, recorder, **options)
    from mavsitl_ground.formation import Formation  # here, for it is made of grounds

    return Formation(flight, recorder, count=count, **options)
