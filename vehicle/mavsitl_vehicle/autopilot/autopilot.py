"""One autopilot: MAVLink in, decisions, MAVLink out. It sees the vehicle by `estimate` and acts by a `Setpoint`."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, inf, isfinite, nan, radians
from typing import NamedTuple, Protocol

from mavsitl.codec import Frame, Message, reader
from mavsitl.dialect import mavlink
from mavsitl.frames import Vector
from mavsitl.geodesy import Origin
from mavsitl.quaternion import to_euler
from mavsitl.routing import Router
from mavsitl.scenario import Flight
from mavsitl.services.command import Command
from mavsitl.services.statustext import TextLimiter, chunks
from mavsitl_vehicle.autopilot import modes, setpoints, telemetry
from mavsitl_vehicle.autopilot.battery import Battery, Level
from mavsitl_vehicle.autopilot.battery import settings as battery_settings
from mavsitl_vehicle.autopilot.commander import ACCEPTED, Commander, Situation
from mavsitl_vehicle.autopilot.course import MissionCourse
from mavsitl_vehicle.autopilot.failure_detector import AltitudeLoss
from mavsitl_vehicle.autopilot.health import Health, Validity, summary
from mavsitl_vehicle.autopilot.landing import IN_AIR, LANDING, TAKING_OFF, LandDetector
from mavsitl_vehicle.autopilot.modes import Control, Mode, Need
from mavsitl_vehicle.autopilot.navigator import Navigator
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.autopilot.pilot import Pilot
from mavsitl_vehicle.autopilot.plan import COMPLETE as MISSION_COMPLETE
from mavsitl_vehicle.autopilot.plan_watch import PlanWatch
from mavsitl_vehicle.autopilot.ports import COMPONENT_ID, Port, Shared, component_metadata
from mavsitl_vehicle.autopilot.position import PositionControl
from mavsitl_vehicle.autopilot.setpoints import (
    AttitudeSetpoint,
    PositionSetpoint,
    RateSetpoint,
    Refusal,
    Setpoint,
    State,
)  # fmt: skip
from mavsitl_vehicle.autopilot.sticks import Axes
from mavsitl_vehicle.autopilot.telemetry import AttitudeTarget, FlightTimes, Frozen, Home
from mavsitl_vehicle.failures import INSTANCES, Failures, Kind, Unit, has_sensors, may_fall_silent
from mavsitl_vehicle.sensors.status import EstimatorStatus, Readings, known

LIFT_MARGIN_M = 0.1
"""An off-board position so far above the vehicle asks to leave the ground."""
UPRIGHT_TILT_RAD = radians(60.0)
"""PX4's FD_FAIL_R and FD_FAIL_P: beyond this the vehicle has fallen over."""
MAX_TEXTS = 50
"""STATUSTEXTs that wait for the end of a period; what is beyond them is lost."""
ANSWERS_HZ, ANSWERS_BURST = 2.0, 10.0
"""Texts of one kind that commands, modes and plans are answered by."""
LOOK_US = 20_000
"""So often the commander decides; PX4's at most every 10 ms. A command, or a stream that returns, makes it look at
once."""
KNOWN_FACTOR = 2.5
"""PX4: what is known may become so much worse than what is to be known anew."""
WATCH_US = 40_000
"""So often fence, plan and the way back are looked at in flight."""
HOUSEKEEPING_US = 100_000
"""Battery, fence, health: what needs no control period."""
SLOW_BATTERY_US = 20_000_000
"""Between two measurements of a battery that is slow."""

_ALL_VALID = Validity()

_read_attitude_target = reader(
    mavlink.MAVLink_set_attitude_target_message, "time_boot_ms", *setpoints.ATTITUDE_TARGET_FIELDS, flat=True
)


class Shown(NamedTuple):
    """The state of which each change is told at once."""

    mode: Mode
    armed: bool
    failsafe: bool
    landed_state: int
    """MAV_LANDED_STATE"""


class Body(Protocol):
    """What the autopilot reads of the simulated vehicle besides its estimate; looked at only where it is sent."""

    @property
    def truth(self) -> Sequence[float]: ...
    @property
    def true_wind(self) -> Vector: ...
    @property
    def outputs(self) -> Sequence[float]: ...
    @property
    def rotor_speeds_rad_s(self) -> Sequence[float]: ...
    @property
    def specific_force_flu_m_s2(self) -> Vector: ...
    @property
    def rate_setpoint_flu_rad_s(self) -> Vector: ...
    @property
    def readings(self) -> Readings | None: ...


class Journal(Protocol):
    """Hears what happens, for the log."""

    def text(self, severity: int, text: str) -> None:
        """A STATUSTEXT."""

    def command(self, command: Command, result: int) -> None:
        """It was executed, with that MAV_RESULT."""

    def valid(self, valid: Validity) -> None:
        """The estimate, or no longer, from now on."""


class Autopilot:
    """Sans-IO. `receive` datagrams, `decide` once a tick before the physics, `observe` and `report` after it."""

    def __init__(
        self,
        flight: Flight,
        system_id: int,
        port_names: Sequence[str],
        parameters: Parameters,
        body: Body,
        shared: Shared,
        *,
        lockstep: bool = False,
        unix_boot_us: int = 0,
        failures: Failures | None = None,
        forwards: bool = True,
        stream_hz: float | None = None,
        journal: Journal | None = None,
    ) -> None:
        """`failures`: what is broken of the battery, the sticks, the links and, by what it is told, the motors.

        `forwards`: frames of others are passed on from link to link. `stream_hz`: default streams are no faster.
        """
        scenario, airframe = flight.scenario, flight.airframe
        self.system_id = system_id
        self.journal = journal
        self.unix_boot_us = self._true_unix_boot_us = unix_boot_us
        self.load = 0.0
        self.failures = Failures() if failures is None else failures
        self.has_sensors = has_sensors(scenario)
        self.may_fall_silent = may_fall_silent(scenario, lockstep=lockstep)
        self.parameters = parameters
        self.body = body
        self.plan = shared.plan
        values = self._values = parameters.values
        self.commander = Commander(values, self.say)
        self.estimate: list[float] = [0.0] * 6 + [1.0] + [0.0] * 6
        """Position NWU m, velocity NWU m/s, quaternion FLU -> NWU, omega FLU rad/s: what telemetry says."""
        self._status = known(scenario.noise)
        self.accuracy = telemetry.accuracy(self._status)
        self.valid = Validity()
        """Which parts of the estimate are good for flying."""
        start = scenario.start
        self.origin = Origin(start.latitude_deg, start.longitude_deg, start.altitude_amsl_m)
        self.home: Home | None = None
        self._home_moved = False
        self.battery = Battery(airframe, battery_settings(values))
        self.setpoint: Setpoint | PositionSetpoint | None = None
        """The newest off-board one."""
        self.setpoint_us: int | None = None
        self.token_us = -1
        """Stamp of the newest off-board setpoint, refused ones included: what lock-step waits for."""
        self.refused_setpoints = 0
        self.reboot_requested = False
        self.flight_times = FlightTimes()
        self.wind: telemetry.Wind | None = None
        """As estimated; None: not known."""
        self.health = Health()
        self._healthy = self.health
        """The same, whatever the mode says; and why that does not allow arming."""
        self._health_refusal: str | None = None
        self.attitude_setpoint: Setpoint | None = None
        """What the inner loops follow."""
        self.position_setpoint: PositionSetpoint | None = None
        self.lockstep = lockstep
        self._hover_thrust = 1.0 / airframe.thrust_to_weight
        self._gravity = airframe.gravity_m_s2
        period_s = scenario.rates.control_period_us / 1e6
        self._position_control = PositionControl(values, self._gravity, self._hover_thrust, period_s)
        self.navigator = Navigator(values, self._gravity, period_s, MissionCourse(shared.plan, values, self), self._say)
        self.pilot = Pilot(values, self._gravity, self._hover_thrust, period_s)
        self.land = LandDetector(self._hover_thrust, period_s, clamped=start.clamp, knows_height=not self.has_sensors)
        self._armed_at_us = 0
        self._flown: Mode | None = None
        """The mode flown in the last period; None: disarmed."""
        self._control = Control.NOBODY
        """Who makes the setpoints of that mode."""
        self._halted = False
        """A fail-safe holds the vehicle."""
        self._cascade = False
        """The position cascade flew in the last period."""
        self._texts: list[Message] = []
        self._text_id = 0
        self._limiter = TextLimiter()
        self._answers = TextLimiter(ANSWERS_HZ, ANSWERS_BURST)
        self._now_us = 0
        self._watched_us = 0
        self._news: tuple[object, ...] = ()
        """What the commander has to look at once it changes."""
        self._battery_us = 0
        """When the battery was measured."""
        self._return_margin_s = inf
        self._altitude_loss = AltitudeLoss()
        self.shown: Shown | None = None
        """What `report` said last: the same object until that changes."""
        self._reported: tuple[object, ...] = ()
        """What it was made of."""
        self._gcs_us: int | None = None
        self._links_failed = False
        self._look_us = 0
        self._due_us = 0
        """When the first of all that is looked at now and then is due."""
        self._commanded_us = 0
        self._housekept_us = -HOUSEKEEPING_US
        self._plan_watch = PlanWatch(shared.plan, self.origin, values, lambda text: self.warn("mission", text))
        self._fence_breach: str | None = None
        self.stream_hz = stream_hz
        self._forwards = forwards and len(port_names) > 1
        self._router = Router(len(port_names), (system_id, COMPONENT_ID))
        self.ports = tuple(Port(name, index, self, shared, lockstep=lockstep) for index, name in enumerate(port_names))
        self._handlers = {
            mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET: self._on_attitude_target,
            mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED: self._on_position_target_local_ned,
            mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT: self._on_position_target_global_int,
            mavlink.MAVLINK_MSG_ID_SET_ACTUATOR_CONTROL_TARGET: self._on_actuator_control_target,
            mavlink.MAVLINK_MSG_ID_MANUAL_CONTROL: self._on_manual_control,
            mavlink.MAVLINK_MSG_ID_SET_MODE: self._on_set_mode,
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._on_heartbeat,
            mavlink.MAVLINK_MSG_ID_SET_GPS_GLOBAL_ORIGIN: self._on_set_origin,
        }

    # --- messages in -------------------------------------------------------------------------------------------------

    def receive(self, port_index: int, datagram: bytes, now_us: int, at_us: int | None = None) -> int:
        """Take one datagram from a link; the number of frames in it that tell who sent it.

        Never raises on its content: what no handler foresaw ends that message, and is counted in `Counters.errors`.

        Where signatures are demanded, a frame that is let in without one tells nothing. `now_us` is the last tick's
        time, `at_us` when the datagram came; None: then.
        """
        port = self.ports[port_index]
        if port.down:
            return 0
        node = port.node
        frames = node.receive(datagram)
        self._now_us = now_us
        several = self._forwards
        signed_only = node.signing is not None and node.signing.active
        for frame in frames if node.tamper is None else node.tamper.incoming(frames):
            if several and (frame.signed or not signed_only):
                self._router.note(port_index, (frame.system_id, frame.component_id), now_us)
            if node.addressed_to(frame):
                try:
                    handler = self._handlers.get(frame.message_id)
                    if handler is not None:
                        handler(frame, now_us)
                    elif not port.receive(frame.message, (frame.system_id, frame.component_id), now_us, at_us):
                        node.counters.unsupported += 1
                except Exception as error:
                    self._on_error(error, frame, port)
            if several:
                for other in self._router.destinations(port_index, frame, now_us):
                    if not self.ports[other].down:
                        self.ports[other].forward(frame.raw, now_us)
        return sum(frame.signed for frame in frames) if signed_only else len(frames)

    def _on_error(self, error: Exception, frame: Frame, port: Port) -> None:
        """A bug of ours that a message found: the flight goes on without that message, and the bug is seen."""
        port.node.counters.errors += 1
        name = frame.message.get_type()
        text = self._limiter.admit("error", f"{name} dropped: {type(error).__name__}", self._now_us)
        if text is not None:
            import logging

            logging.getLogger("mavsitl").error("%s", text, exc_info=error)
            self.queue_text(mavlink.MAV_SEVERITY_ERROR, text)

    def _on_attitude_target(self, frame: Frame, now_us: int) -> None:
        fields = _read_attitude_target(frame)
        self.token_us = fields[0] * 1000
        self._take(setpoints.from_attitude_target(*fields[1:]), now_us)

    def _on_actuator_control_target(self, frame: Frame, now_us: int) -> None:
        message = frame.message
        self.token_us = message.time_usec
        self._take(setpoints.from_actuator_control_target(message), now_us)

    def _on_position_target_local_ned(self, frame: Frame, now_us: int) -> None:
        message = frame.message
        self.token_us = message.time_boot_ms * 1000
        self._take(setpoints.from_position_target_local_ned(message, State.of(self.estimate)), now_us)

    def _on_position_target_global_int(self, frame: Frame, now_us: int) -> None:
        message = frame.message
        self.token_us = message.time_boot_ms * 1000
        home = self.home_altitude_amsl_m
        self._take(setpoints.from_position_target_global_int(message, self.origin, home), now_us)

    def _take(self, setpoint: Setpoint | PositionSetpoint | Refusal, now_us: int) -> None:
        if isinstance(setpoint, Refusal):
            self.refused_setpoints += 1
            self.warn("setpoint", setpoint.text)
        else:
            self.setpoint, self.setpoint_us = setpoint, now_us
            if self.commander.failsafe:
                self._look_at(now_us)

    def _on_manual_control(self, frame: Frame, now_us: int) -> None:
        message = frame.message
        if message.target not in (0, self.system_id) or self.failures.of(Unit.RC) is not Kind.OK:
            return
        if self._values["COM_RC_IN_MODE"] in (0, 4):
            return
        if self.pilot.receive(message, now_us):
            if self.pilot.kill_asked(now_us):
                self.commander.request_kill(True, latch=True)
            if self.pilot.moved and self._control in (Control.NAVIGATOR, Control.STREAM):
                self._step_commander(now_us)
                self.commander.request_takeover()

    def _on_set_mode(self, frame: Frame, now_us: int) -> None:
        """SET_MODE (11) has no acknowledgement; PX4's main mode is in byte 2, its sub mode in byte 3 of custom_mode."""
        message = frame.message
        if message.base_mode & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            main_mode, sub_mode = message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF
            self.request_mode(modes.find(main_mode, sub_mode), f"main {main_mode} sub {sub_mode}", now_us)
        else:
            self.request_mode(modes.from_base_mode(message.base_mode), f"base mode {message.base_mode}", now_us)

    def _on_heartbeat(self, frame: Frame, now_us: int) -> None:
        message = frame.message
        if message.type == mavlink.MAV_TYPE_GCS:
            self._gcs_us = now_us

    def _on_set_origin(self, frame: Frame, now_us: int) -> None:
        """As on PX4 the origin of a vehicle with GPS is the GPS's: said, not changed."""
        self.warn("origin", "Origin refused: it is the simulator's")

    # --- what the estimator knows ------------------------------------------------------------------------------------

    @property
    def estimator_status(self) -> EstimatorStatus:
        """How well `estimate` is known, from whoever sets both."""
        return self._status

    @estimator_status.setter
    def estimator_status(self, status: EstimatorStatus) -> None:
        if status is not self._status:
            self._status = status
            self.accuracy = telemetry.accuracy(status)
            self.valid = self._validity(status)
            if self.journal is not None:
                self.journal.valid(self.valid)

    def _validity(self, status: EstimatorStatus) -> Validity:
        """As the estimator says, within COM_VEL_FS_EVH and COM_POS_FS_EPH."""
        p, before = self._values, self.valid
        velocity_m_s, position_m = (
            p[name] * (KNOWN_FACTOR if known_before else 1.0)
            for name, known_before in (("COM_VEL_FS_EVH", before.velocity), ("COM_POS_FS_EPH", before.position))
        )
        return Validity(
            status.attitude_valid,
            status.height_valid,
            status.velocity_valid and status.evh_m_s <= velocity_m_s,
            status.position_valid and (position_m < 0.0 or status.eph_m <= position_m),
        )

    # --- what commands need ------------------------------------------------------------------------------------------

    @property
    def mission_refusal(self) -> str | None:
        """Why AUTO.MISSION would not fly; None when it would."""
        return self._plan_watch.mission_refusal

    @property
    def on_ground(self) -> bool:
        return self.land.on_ground

    @property
    def failed_motors(self) -> int:
        """As the speed controllers reveal it, bit i - 1 for motor i: no telemetry, or no current while armed."""
        if not self.failures.active:
            return 0
        return self.silent_escs | (self._motors_with(Kind.OFF) if self.commander.armed else 0)

    @property
    def silent_escs(self) -> int:
        """Speed controllers without telemetry, bit i - 1 for motor i."""
        return self._motors_with(Kind.STUCK)

    def _motors_with(self, kind: Kind) -> int:
        motors = range(1, INSTANCES[Unit.MOTOR] + 1)
        return sum(1 << motor - 1 for motor in motors if self.failures.of(Unit.MOTOR, motor) is kind)

    @property
    def altitude_amsl_m(self) -> float:
        return self.origin.altitude_amsl_m + self.estimate[2]

    @property
    def home_altitude_amsl_m(self) -> float:
        home_height = 0.0 if self.home is None else self.home.position_nwu_m[2]
        return self.origin.altitude_amsl_m + home_height

    @property
    def ground_altitude_amsl_m(self) -> float:
        """Of the ground it stands on or took off from: flat."""
        return self.origin.altitude_amsl_m

    def height_of(self, altitude_amsl_m: float) -> float:
        """Above the local origin; NaN stays."""
        return altitude_amsl_m - self.origin.altitude_amsl_m

    def local_at(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        return self.origin.to_local(latitude_deg, longitude_deg)

    def breach_at(self, x_m: float, y_m: float, z_m: float) -> str | None:
        """Why the fence would not allow this position (NaN: the vehicle's); None where it would, or acts not at all."""
        self._refresh_plan()
        if not self._plan_watch.acts:
            return None
        x, y, z = (a if isfinite(a) else b for a, b in zip((x_m, y_m, z_m), self.estimate[:3], strict=True))
        return self._plan_watch.breach((x, y, z))

    def request_mode(self, mode: Mode | None, described: str, now_us: int, *, stop: bool = True) -> int:
        """The MAV_RESULT. Hold, asked for while holding, ends a DO_REPOSITION under way, unless `stop` is False."""
        self.look(now_us)
        result = self.commander.request_mode(mode, described)
        if stop and result == ACCEPTED and mode is Mode.LOITER is self._flown:
            self.navigator.hold()
        return result

    def jump_to(self, sequence: int) -> bool:
        return self.plan.jump_to(sequence)

    def set_home_here(self) -> None:
        x, y, z = self.estimate[:3]
        self._set_home((x, y, z), State.of(self.estimate).yaw_rad)

    def set_home(self, latitude_deg: float, longitude_deg: float, altitude_amsl_m: float, yaw_deg: float) -> None:
        """`yaw_deg` clockwise from north; NaN: the heading it has."""
        x, y = self.origin.to_local(latitude_deg, longitude_deg)
        yaw = -radians(yaw_deg) if isfinite(yaw_deg) else State.of(self.estimate).yaw_rad
        self._set_home((x, y, self.height_of(altitude_amsl_m)), yaw)

    def _set_home(self, position_nwu_m: Vector, yaw_rad: float) -> None:
        self.home = self.navigator.home = Home(position_nwu_m, yaw_rad, self._now_us)
        self.commander.home_set = True
        self._home_moved = True

    def jump_clock(self, jump_s: float) -> None:
        """UNIX time, where it is known, is wrong by so much from now on; nothing goes by it but SYSTEM_TIME."""
        if self._true_unix_boot_us:
            self.unix_boot_us = self._true_unix_boot_us + round(jump_s * 1e6)

    # --- texts -------------------------------------------------------------------------------------------------------

    def queue_text(self, severity: int, text: str) -> None:
        """A STATUSTEXT for every link."""
        if len(self._texts) >= MAX_TEXTS:
            return
        self._text_id = self._text_id % 65535 + 1
        self._texts += chunks(severity, text, self._text_id)
        if self.journal is not None:
            self.journal.text(severity, text)

    def say(self, severity: int, text: str) -> None:
        """A text that a request may cause again and again: what is before its first colon speaks at a bounded rate."""
        admitted = self._answers.admit(text.partition(":")[0], text, self._now_us)
        if admitted is not None:
            self.queue_text(severity, admitted)

    def warn(self, reason: str, text: str) -> None:
        """A warning that a hostile or broken peer may cause: each reason speaks at a bounded rate."""
        admitted = self._limiter.admit(reason, text, self._now_us)
        if admitted is not None:
            self.queue_text(mavlink.MAV_SEVERITY_WARNING, admitted)

    def warn_parameter(self, text: str) -> None:
        """A refused parameter; the server limits the rate."""
        self.queue_text(mavlink.MAV_SEVERITY_WARNING, text)

    def _say(self, text: str) -> None:
        self.queue_text(mavlink.MAV_SEVERITY_INFO, text)

    # --- what telemetry shows ----------------------------------------------------------------------------------------

    @property
    def metadata(self) -> telemetry.Metadata:
        return component_metadata()

    @property
    def landed_state(self) -> int:
        """MAV_LANDED_STATE: in the air, with what the vehicle itself is about."""
        state = self.land.state
        if state == IN_AIR:
            if self.navigator.landing:
                return LANDING
            if self.commander.mode is Mode.TAKEOFF:
                return TAKING_OFF
        return state

    @property
    def true_wind(self) -> Vector:
        return self.body.true_wind

    @property
    def truth(self) -> Sequence[float]:
        return self.body.truth

    @property
    def outputs(self) -> Sequence[float]:
        return self.body.outputs

    @property
    def specific_force_flu_m_s2(self) -> Vector:
        return self.body.specific_force_flu_m_s2

    @property
    def readings(self) -> Readings | None:
        return self.body.readings

    @property
    def attitude_target(self) -> AttitudeTarget | None:
        setpoint = self.attitude_setpoint
        if isinstance(setpoint, AttitudeSetpoint):
            return AttitudeTarget(setpoint.attitude, self.body.rate_setpoint_flu_rad_s, setpoint.thrust)
        if isinstance(setpoint, RateSetpoint):
            return AttitudeTarget(None, setpoint.omega_flu_rad_s, setpoint.thrust)
        return None

    @property
    def position_target(self) -> PositionSetpoint | None:
        return self.position_setpoint

    @property
    def sticks(self) -> Axes | None:
        return self.pilot.axes if self.commander.sticks_fresh() else None

    @property
    def mission(self) -> telemetry.Mission:
        status = self.plan.status()
        return telemetry.Mission(status.seq, status.total, status.state, status.mode == 1)

    # --- a tick ------------------------------------------------------------------------------------------------------

    def look(self, now_us: int) -> None:
        """Before a request: a plan that was uploaded just now counts."""
        if self._plan_watch.stale:
            self._refresh_plan()
        self._step_commander(now_us)

    def _step_commander(self, now_us: int) -> None:
        """With what is known now."""
        self._now_us = now_us
        self._look_us = now_us + LOOK_US
        elapsed_s = (now_us - self._commanded_us) / 1e6
        self._commanded_us = now_us
        setpoint_us, sticks_us, gcs_us = self.setpoint_us, self.pilot.received_us, self._gcs_us
        if sticks_us is not None and self.failures.of(Unit.RC) is Kind.STUCK:
            sticks_us = self.pilot.received_us = now_us
        w, x, y, z = self.estimate[6:10]
        roll_rad, pitch_rad, _ = to_euler((w, x, y, z))
        took_off_us, valid, wind = self.flight_times.took_off_us, self.valid, self.wind
        armed = self.commander.armed
        self.commander.step(
            now_us,
            Situation(
                self.land.on_ground,
                None if setpoint_us is None else now_us - setpoint_us,
                None if sticks_us is None else now_us - sticks_us,
                None if gcs_us is None else now_us - gcs_us,
                self.mission_refusal,
                None if armed else self._health_refusal,
                int(self.battery.level),
                self._fence_breach,
                *valid,
                self._stream_needs,
                roll_rad,
                pitch_rad,
                self._lost_altitude_m(elapsed_s),
                self.failed_motors,
                now_us - self._battery_us,
                self.battery.charge,
                self._return_margin_s,
                (now_us - took_off_us) / 1e6 if armed and took_off_us else 0.0,
                hypot(*wind.velocity_nwu_m_s[:2]) if wind is not None else 0.0,
                self.accuracy.position_m,
                self._plan_watch.mission_failure,
                self.plan.progress.state == MISSION_COMPLETE,
                self.pilot.axes.throttle,
            ),
        )

    @property
    def _stream_needs(self) -> Need:
        """The estimates without which the newest off-board setpoint cannot be flown."""
        setpoint = self.setpoint
        if isinstance(setpoint, PositionSetpoint):
            return setpoint_needs(setpoint)
        return Need.ATTITUDE if isinstance(setpoint, AttitudeSetpoint) else Need.NOTHING

    def _lost_altitude_m(self, elapsed_s: float) -> float:
        if not self._values["FD_ALT_LOSS"]:
            return 0.0
        target = self.position_setpoint or PositionSetpoint()
        height_m = self._state().position_nwu_m[2]
        return self._altitude_loss.update(height_m, target.position_nwu_m[2], target.velocity_nwu_m_s[2], elapsed_s)

    def _state(self) -> State:
        """The estimate; what is not valid of it is not known."""
        state, valid = State.of(self.estimate), self.valid
        if valid == _ALL_VALID:
            return state
        (x, y, z), (vx, vy, vz), attitude = state
        return State(
            (x if valid.position else nan, y if valid.position else nan, z if valid.height else nan),
            (vx if valid.velocity else nan, vy if valid.velocity else nan, vz if valid.height else nan),
            attitude if valid.attitude else (nan, nan, nan, nan),
        )

    def decide(self, now_us: int) -> Setpoint | None:
        """Before the physics: step the commander, and the setpoint for the inner loops; None stops the rotors."""
        if now_us >= self._due_us or (self._flown is None and self.commander.armed):
            self._look_around(now_us)
        commander = self.commander
        if self._flown is not None and not (commander.armed and commander.armed_at_us == self._armed_at_us):
            self._stand_down(now_us)  # also where it was disarmed and armed again since the last period
        if not commander.armed:
            return None
        mode = commander.mode
        halted = commander.failsafe and mode is Mode.LOITER
        if mode is not self._flown:
            self._switch(mode, now_us)
        elif halted and not self._halted:
            self.navigator.hold()  # on its way somewhere, by DO_REPOSITION
        self._halted = halted
        if commander.kill_engaged:
            self._rest()
            self.attitude_setpoint = None
            return None
        control = self._control
        if control is Control.STREAM:
            setpoint = self._follow_stream(now_us)
        elif control is Control.NAVIGATOR:
            setpoint = self._navigate(now_us)
        elif control is Control.STICKS:
            setpoint = self._fly_by_sticks(mode, now_us)
        else:
            setpoint = None
        self.attitude_setpoint = setpoint
        return setpoint

    def _look_around(self, now_us: int) -> None:
        """What is looked at now and then, where its time has come."""
        if now_us - self._housekept_us >= HOUSEKEEPING_US:
            self._keep_house(now_us)
        if now_us - self._watched_us >= WATCH_US and self.commander.armed:
            self._watch_plan(now_us)
        if now_us >= self._look_us:
            self._step_commander(now_us)
        self._due_us = min(self._housekept_us + HOUSEKEEPING_US, self._look_us)
        if self.commander.armed:
            self._due_us = min(self._due_us, self._watched_us + WATCH_US)

    def _look_at(self, now_us: int) -> None:
        """The commander has something to look at."""
        self._look_us = self._due_us = now_us

    def _follow_stream(self, now_us: int) -> Setpoint | None:
        setpoint = self.setpoint
        on_ground = self.land.on_ground
        if on_ground and not self.land.held and not self.commander.spooled_up(now_us):
            return None
        if not isinstance(setpoint, PositionSetpoint):
            self._cascade = False
            self.position_setpoint = None
            return setpoint
        state = self._state()
        if on_ground and not _asks_to_lift(setpoint, state):
            self._rest()
            return None
        return self._fly_position(setpoint, state, inf)

    def _navigate(self, now_us: int) -> Setpoint | None:
        state = self._state()
        on_ground = self.land.on_ground
        if on_ground:
            ready = self.commander.spooled_up(now_us)
            if ready:
                self.navigator.stand(state, now_us)
            if not (ready and self.navigator.wants_lift()):
                self._rest()
                return None
        target, climb_limit = self.navigator.update(state, now_us)
        finished = self.navigator.finished
        if finished is Mode.TAKEOFF:
            self.commander.complete(Mode.TAKEOFF, Mode.LOITER)
        return self._fly_position(target, state, climb_limit)

    def _fly_by_sticks(self, mode: Mode, now_us: int) -> Setpoint | None:
        present = self.commander.sticks_fresh()
        if self.land.on_ground:
            lift = present and self.pilot.wants_lift(mode)
            if not (lift and self.commander.spooled_up(now_us)):
                self._rest()
                return None
        state = self._state()
        setpoint = self.pilot.update(mode, state, state.position_nwu_m[2], present=present)
        if isinstance(setpoint, PositionSetpoint):
            return self._fly_position(setpoint, state, inf)
        self._cascade = False
        self.position_setpoint = None
        return setpoint

    def _fly_position(self, target: PositionSetpoint, state: State, climb_limit_m_s: float) -> AttitudeSetpoint:
        if not self._cascade:
            flown = self.attitude_setpoint
            self._position_control.engage(flown if isinstance(flown, AttitudeSetpoint) else None)
            self._cascade = True
        self.position_setpoint = target
        return self._position_control.update(target, state, climb_limit_m_s)

    def _rest(self) -> None:
        """On the ground: rotors still, nothing integrates."""
        self._position_control.reset()
        self._cascade = False
        self.position_setpoint = None

    def _switch(self, mode: Mode, now_us: int) -> None:
        """Another mode flies from now on."""
        state = self._state()
        control = modes.TABLE[mode].control
        if self._flown is None:
            self._arm(now_us)
        self._flown = mode
        self._control = control
        if control is Control.NAVIGATOR:
            acceleration = self._position_control.acceleration_setpoint_nwu_m_s2 if self._cascade else (0.0, 0.0, 0.0)
            self.navigator.enter(mode, state, acceleration, self.on_ground, now_us, by_failsafe=self.commander.failsafe)
        else:
            self.navigator.leave()
            if control is Control.STICKS:
                self.pilot.engage(mode, state)
        self._cascade = False  # its next setpoint begins at the one that is flown

    def _arm(self, now_us: int) -> None:
        self._armed_at_us = self.commander.armed_at_us
        self.set_home_here()
        self.flight_times = FlightTimes(max(now_us, 1), 0, 0, self.flight_times.number + 1)

    def _stand_down(self, now_us: int) -> None:
        self._flown = None
        self.attitude_setpoint = self.position_setpoint = None
        self._rest()
        self.navigator.leave()
        self.flight_times = self.flight_times._replace(landed_us=max(now_us, 1))

    def _keep_house(self, now_us: int) -> None:
        """What is looked at ten times a second: battery, fence, mission, health."""
        self._housekept_us = now_us
        if self.home is None:
            self.set_home_here()
        slow = self.failures.of(Unit.BATTERY) is Kind.SLOW
        if now_us - self._battery_us >= (SLOW_BATTERY_US if slow else 0):
            self.battery.update(
                self.body.rotor_speeds_rad_s, self.commander.armed,
                max(now_us - self._battery_us, HOUSEKEEPING_US) / 1e6,
                self.failures.of(Unit.BATTERY), self.failures.value(Unit.BATTERY),
            )  # fmt: skip
            self._battery_us = now_us
        self._refresh_plan()
        x, y, z = self.estimate[:3]
        self._fence_breach = self._plan_watch.breach((x, y, z))
        needs, valid, sensors = modes.TABLE[self.commander.intended].needs, self.valid, self._status.sensors
        health = Health(
            gyro=sensors.gyro,
            accelerometer=sensors.accelerometer,
            magnetometer=sensors.magnetometer,
            barometer=sensors.barometer,
            gps=sensors.gps,
            battery=self.battery.level < Level.CRITICAL,
            motors=not self.failed_motors,
            attitude=valid.attitude,
            height=valid.height or Need.HEIGHT not in needs,
            position=valid.position and valid.velocity,
            upright=_upright(self.estimate[7], self.estimate[8]),
            home=self.home is not None,
            sticks=self.commander.sticks_fresh(),
            fence=self._plan_watch.fenced,
            fence_breached=self._fence_breach is not None and self._plan_watch.acts,
            position_needed=Need.POSITION in needs,
        )
        if health != self._healthy:
            self._healthy = health
            self._health_refusal = summary(health)
        mode_refusal = self.commander.mode_refusal()
        self.health = health if mode_refusal is None else health._replace(mode_refusal=mode_refusal)

    def _watch_plan(self, now_us: int) -> None:
        """What fail-safes must not wait for until the house is kept."""
        self._watched_us = now_us
        if self._plan_watch.stale:
            self._refresh_plan()
        x, y, z = self.estimate[:3]
        self._fence_breach = self._plan_watch.breach((x, y, z))
        remaining_s = self.battery.remaining_s
        self._return_margin_s = inf
        if self._values["COM_FLTT_LOW_ACT"] > 0 and remaining_s is not None and not self.on_ground:
            self._return_margin_s = remaining_s - self.navigator.return_time_s(self._state())
        news = (self.battery.level, self._fence_breach, self._plan_watch.mission_failure, self._return_margin_s <= 0.0)
        if news != self._news:
            self._news = news
            self._look_at(now_us)

    def _refresh_plan(self) -> None:
        watch = self._plan_watch
        watch.refresh(None if self.home is None else self.home.position_nwu_m, self.land.on_ground)
        self.navigator.rally_nwu_m = watch.rally_nwu_m

    def observe(self, now_us: int) -> None:
        """After the physics, with the new estimate: is it on the ground, in the clamp, taking off, in the air?"""
        setpoint, land, commander = self.attitude_setpoint, self.land, self.commander
        took_off = land.update(
            now_us,
            self.estimate,
            0.0 if setpoint is None else setpoint.thrust,
            commander.armed,
            land.on_ground and commander.spooled_up(now_us),
            self.navigator.landing,
        )
        if took_off:
            self.flight_times = self.flight_times._replace(took_off_us=max(now_us, 1))

    def report(self, now_us: int) -> None:
        """Telemetry that is due, texts, and at once what changed: HEARTBEAT, EXTENDED_SYS_STATE, HOME_POSITION."""
        changed = self._changed()
        texts = self._texts
        if texts:
            self._texts = []
        home_moved = self._home_moved
        if home_moved:
            self._home_moved, home_moved = False, not self.lockstep
        if self.failures.active or self._links_failed:
            self._fail_links()
        for port in self.ports:
            node = port.node
            waiting = node.queued if port.down else 0
            for text in texts:
                node.send_message(text)
            if changed:
                telemetry.send_heartbeat(self, node, now_us)
                telemetry.send_extended_sys_state(self, node, now_us)
                if not self.lockstep:
                    telemetry.send_current_mode(self, node, now_us)
            if now_us >= port.due_us:
                port.step(now_us)
            schedule = port.schedule
            if now_us >= schedule.due_us:
                schedule.run(port.subject, node, now_us)
            if home_moved:
                telemetry.request(self, node, mavlink.MAVLINK_MSG_ID_HOME_POSITION, 0, now_us)
            if port.down:
                node.lose(waiting)

    def _changed(self) -> bool:
        """Whether what is told at once is another than in the last report."""
        commander = self.commander
        mode, armed, failsafe = commander.mode, commander.armed, commander.failsafe
        state = mode, armed, failsafe, self.land.state, self.navigator.landing
        if state == self._reported:
            return False
        self._reported = state
        before, shown = self.shown, Shown(mode, armed, failsafe, self.landed_state)
        if shown == before:
            return False
        self.shown = shown
        return before is not None

    def _fail_links(self) -> None:
        """What counts on each link until the next period: an answer to the command that breaks it still goes."""
        self._links_failed = False
        for port in self.ports:
            kind = self.failures.of(Unit.MAVLINK, port.instance)
            port.down = kind is Kind.OFF
            frozen = kind is Kind.STUCK
            if frozen != isinstance(port.subject, Frozen):
                port.subject = Frozen(self) if frozen else self
            self._links_failed = self._links_failed or port.down or frozen


def _upright(x: float, y: float) -> bool:
    """Tilted by less than UPRIGHT_TILT_RAD, by the x and y of the attitude quaternion."""
    return 1.0 - 2.0 * (x * x + y * y) > cos(UPRIGHT_TILT_RAD)


def setpoint_needs(setpoint: PositionSetpoint) -> Need:
    """The estimates without which it cannot be flown."""
    needs = Need.ATTITUDE
    x, y, z = setpoint.position_nwu_m
    vx, vy, vz = setpoint.velocity_nwu_m_s
    if isfinite(x) or isfinite(y):
        needs |= Need.POSITION | Need.VELOCITY
    if isfinite(vx) or isfinite(vy):
        needs |= Need.VELOCITY
    return needs | Need.HEIGHT if isfinite(z) or isfinite(vz) else needs


def _asks_to_lift(setpoint: PositionSetpoint, state: State) -> bool:
    """Off-board on the ground: a height above it, or a climb, asked for."""
    height, climb, push = setpoint.position_nwu_m[2], setpoint.velocity_nwu_m_s[2], setpoint.acceleration_nwu_m_s2[2]
    if isfinite(height):
        return height > state.position_nwu_m[2] + LIFT_MARGIN_M
    return (climb if isfinite(climb) else push if isfinite(push) else nan) > 0.0
