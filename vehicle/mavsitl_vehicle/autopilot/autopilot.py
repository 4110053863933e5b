"""One autopilot: MAVLink in, decisions, MAVLink out. It sees the vehicle by `estimate` and acts by `Demand`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import hypot
from typing import Any, NamedTuple

from mavsitl.codec import Message
from mavsitl.dialect import mavlink
from mavsitl.frames import Vector
from mavsitl.node import Node
from mavsitl.quaternion import to_euler
from mavsitl.scenario import Flight
from mavsitl.services.command import Command, CommandServer
from mavsitl_vehicle.autopilot import commander as commanding
from mavsitl_vehicle.autopilot import modes, setpoints, telemetry
from mavsitl_vehicle.autopilot.commander import Commander, Situation
from mavsitl_vehicle.autopilot.modes import Mode
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.autopilot.position import PositionControl
from mavsitl_vehicle.autopilot.setpoints import Refusal, Setpoint

COMPONENT_ID = mavlink.MAV_COMP_ID_AUTOPILOT1

TAKEOFF_THRUST_SHARE = 0.9
"""Of the hover thrust: above it, a spooled-up vehicle on the ground counts as taking off."""
LANDED_HEIGHT_M = 0.05
LANDED_SPEED_M_S = 0.15
AIRBORNE_HEIGHT_M = 0.15
LANDING_TIME_US = 300_000
LANDING_FILTER_S = 0.3

REFUSAL_TEXT_INTERVAL_US = 1_000_000
"""At most one STATUSTEXT on refused setpoints in this time: a bad stream must not flood its own link."""


class Port(NamedTuple):
    """One link of the autopilot: its MAVLink endpoint and its telemetry schedule."""

    name: str
    node: Node
    schedule: telemetry.Schedule


class Autopilot:
    """Sans-IO. `receive` datagrams, `decide` once a tick before the physics, `report` once a tick after it."""

    def __init__(self, flight: Flight, system_id: int, port_names: Sequence[str]) -> None:
        scenario, airframe = flight.scenario, flight.airframe
        self.system_id = system_id
        self.parameters = Parameters(airframe.parameters, scenario.parameters)
        self.commander = Commander(self.parameters, self._queue_text)
        self.ports = tuple(
            Port(name, Node(system_id, COMPONENT_ID), telemetry.Schedule(offboard=name == "offboard"))
            for name in port_names
        )
        self.estimate: list[float] = [0.0] * 13
        """Position NWU m, velocity NWU m/s, quaternion FLU -> NWU, omega FLU rad/s: what telemetry says."""
        self.true_wind: Vector = (0.0, 0.0, 0.0)
        self.landed_state: int = mavlink.MAV_LANDED_STATE_ON_GROUND
        self.held = scenario.start.clamp
        self.released_us: int | None = None
        """When the clamp opened or the take-off began; the flight's time zero."""
        self.setpoint: Setpoint | None = None
        self.setpoint_us: int | None = None
        self.token_us = -1
        """Stamp of the newest off-board setpoint, refused ones included: what lock-step waits for."""
        self.refused_setpoints = 0
        self.foreign_messages = 0
        self._hover_thrust = 1.0 / airframe.thrust_to_weight
        period_s = scenario.rates.control_period_us / 1e6
        self._position_control = PositionControl(self.parameters, airframe.gravity_m_s2, self._hover_thrust, period_s)
        self._position_mode: Mode | None = None
        self._texts: list[tuple[int, int, str]] = []
        """(id that joins its chunks, MAV_SEVERITY, text)"""
        self._text_id = 0
        self._refusal_text_us = -REFUSAL_TEXT_INTERVAL_US
        self._shown: tuple[Mode, bool, bool, int] | None = None
        self._still_since_us: int | None = None
        self._smooth = (0.0, 0.0, 0.0, 0.0)
        """Height and velocity for the landing detector, with the sensors' noise filtered out."""
        self._smoothing = min(period_s / LANDING_FILTER_S, 1.0)
        self._commands = CommandServer(self._execute)
        self._handlers: dict[int, Callable[[Any, int, int], None]] = {
            mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET: self._on_attitude_target,
            mavlink.MAVLINK_MSG_ID_SET_ACTUATOR_CONTROL_TARGET: self._on_actuator_control_target,
            mavlink.MAVLINK_MSG_ID_SET_MODE: self._on_set_mode,
        }
        self._execution: dict[int, Callable[[Command, int, Port], int]] = {
            mavlink.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_disarm,
            mavlink.MAV_CMD_DO_SET_MODE: self._do_set_mode,
            mavlink.MAV_CMD_NAV_LAND: self._nav_land,
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_message_interval,
            mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_message_interval,
            mavlink.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: self._request_capabilities,
        }
        self._command_port = self.ports[0] if self.ports else None

    # --- messages in -------------------------------------------------------------------------------------------------

    def receive(self, port_index: int, datagram: bytes, now_us: int) -> int:
        """Take one datagram from a link; the number of valid MAVLink frames in it. Never raises on what is in it."""
        port = self.ports[port_index]
        frames = port.node.receive(datagram)
        for frame in frames:
            message = frame.message
            if type(message).id in (mavlink.MAVLINK_MSG_ID_COMMAND_LONG, mavlink.MAVLINK_MSG_ID_COMMAND_INT):
                if self._is_ours(port, frame):
                    self._command_port = port
                    command, result = self._commands.receive(message, frame.system_id, frame.component_id, now_us)
                    port.node.send(telemetry.COMMAND_ACK, command, result, 0, 0, frame.system_id, frame.component_id)
            elif (handler := self._handlers.get(type(message).id)) and self._is_ours(port, frame):
                handler(message, now_us, frame.system_id)
        return len(frames)

    def _is_ours(self, port: Port, frame: Any) -> bool:
        if port.node.addressed_to(frame):
            return True
        self.foreign_messages += 1
        return False

    def _on_attitude_target(self, message: Message, now_us: int, system_id: int) -> None:
        self.token_us = message.time_boot_ms * 1000
        self._take(setpoints.from_attitude_target(message), now_us)

    def _on_actuator_control_target(self, message: Message, now_us: int, system_id: int) -> None:
        self.token_us = message.time_usec
        self._take(setpoints.from_actuator_control_target(message), now_us)

    def _take(self, setpoint: Setpoint | Refusal, now_us: int) -> None:
        if isinstance(setpoint, Refusal):
            self.refused_setpoints += 1
            if now_us - self._refusal_text_us >= REFUSAL_TEXT_INTERVAL_US:
                self._refusal_text_us = now_us
                self._queue_text(mavlink.MAV_SEVERITY_WARNING, setpoint.text)
        else:
            self.setpoint, self.setpoint_us = setpoint, now_us

    def _on_set_mode(self, message: Message, now_us: int, system_id: int) -> None:
        """SET_MODE (11) has no acknowledgement; PX4's main mode is in byte 2, its sub mode in byte 3 of custom_mode."""
        main_mode, sub_mode = message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF
        self._request_mode(main_mode, sub_mode, now_us)

    # --- commands ----------------------------------------------------------------------------------------------------

    def _execute(self, command: Command, now_us: int) -> int:
        handler = self._execution.get(command.id)
        if handler is None or self._command_port is None:
            self._queue_text(mavlink.MAV_SEVERITY_WARNING, f"Command {command.id} is not supported")
            return commanding.UNSUPPORTED
        return handler(command, now_us, self._command_port)

    def _deny(self, text: str) -> int:
        self._queue_text(mavlink.MAV_SEVERITY_WARNING, text)
        return commanding.DENIED

    def _arm_disarm(self, command: Command, now_us: int, port: Port) -> int:
        wanted = command.integer(1)
        if wanted not in (0, 1):
            return self._deny(f"Arm/disarm refused: param1 is {command.params[0]:g}, need 0 or 1")
        force = command.integer(2) in commanding.FORCE_MAGIC
        self._look(now_us)
        return self.commander.request_arm(wanted == 1, force, now_us)

    def _do_set_mode(self, command: Command, now_us: int, port: Port) -> int:
        base, main_mode, sub_mode = command.integer(1), command.integer(2), command.integer(3)
        if base is None or not base & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED or main_mode is None:
            return self._deny("Mode refused: param1 needs bit 0 (custom mode), param2 PX4's main mode")
        return self._request_mode(main_mode, sub_mode or 0, now_us)

    def _request_mode(self, main_mode: int, sub_mode: int, now_us: int) -> int:
        self._look(now_us)
        return self.commander.request_mode(modes.find(main_mode, sub_mode), f"main {main_mode} sub {sub_mode}")

    def _nav_land(self, command: Command, now_us: int, port: Port) -> int:
        self._look(now_us)
        return self.commander.request_mode(Mode.LAND, "land")

    def _set_message_interval(self, command: Command, now_us: int, port: Port) -> int:
        message_id, interval_us = command.integer(1), command.integer(2)
        if message_id not in telemetry.BY_ID:
            return self._deny(f"Message interval refused: no stream of message {command.params[0]:g}")
        if interval_us is None or not -1 <= interval_us <= telemetry.MAX_INTERVAL_US:
            return self._deny(
                f"Message interval refused: {command.params[1]:g} us, need -1 to {telemetry.MAX_INTERVAL_US}"
            )
        if message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT and interval_us != 0:
            return self._deny("Message interval refused: HEARTBEAT stays at its rate")
        if interval_us == -1:
            port.schedule.set_interval(message_id, telemetry.NEVER, now_us)
        else:
            port.schedule.set_interval(message_id, interval_us or port.schedule.default_us(message_id), now_us)
        return commanding.ACCEPTED

    def _get_message_interval(self, command: Command, now_us: int, port: Port) -> int:
        message_id = command.integer(1)
        if message_id is None or not 0 <= message_id <= 65535:
            return self._deny(f"Message interval refused: no message {command.params[0]:g}")
        if message_id in telemetry.BY_ID:
            interval_us = port.schedule.interval_us(message_id) or -1
        else:
            interval_us = 0  # MAVLink: not available
        port.node.send(telemetry.MESSAGE_INTERVAL, message_id, interval_us)
        return commanding.ACCEPTED

    def _request_message(self, command: Command, now_us: int, port: Port) -> int:
        message_id = command.integer(1)
        if message_id not in telemetry.BY_ID:
            return self._deny(f"Request refused: message {command.params[0]:g} is not served")
        telemetry.BY_ID[message_id].send(self, port.node, now_us)
        return commanding.ACCEPTED

    def _request_capabilities(self, command: Command, now_us: int, port: Port) -> int:
        telemetry.send_autopilot_version(self, port.node, now_us)
        return commanding.ACCEPTED

    # --- a tick ------------------------------------------------------------------------------------------------------

    def decide(self, now_us: int) -> Setpoint | None:
        """Before the physics: step the commander, and the setpoint for the inner loops; None stops the rotors."""
        self._look(now_us)
        commander = self.commander
        if not commander.armed:
            self._position_mode = None
            return None
        on_ground = self.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND
        if commander.mode is Mode.OFFBOARD:
            self._position_mode = None
            waiting = on_ground and not self.held and not commander.spooled_up(now_us)
            return None if waiting else self.setpoint
        if on_ground:
            self._position_mode = None
            return None
        e = self.estimate
        if self._position_mode is not commander.mode:
            _, _, yaw_rad = to_euler((e[6], e[7], e[8], e[9]))
            self._position_control.engage((e[0], e[1], e[2]), yaw_rad, afresh=self._position_mode is None)
            self._position_mode = commander.mode
        descend = commander.mode is Mode.LAND
        return self._position_control.update((e[0], e[1], e[2]), (e[3], e[4], e[5]), descend)

    def observe(self, now_us: int) -> None:
        """After the physics, with the new estimate: is it on the ground, in the clamp, taking off, in the air?"""
        commander = self.commander
        share, e = self._smoothing, self.estimate
        z, vx, vy, vz = self._smooth
        self._smooth = (
            z + share * (e[2] - z),
            vx + share * (e[3] - vx),
            vy + share * (e[4] - vy),
            vz + share * (e[5] - vz),
        )
        if not commander.armed:
            if self.landed_state != mavlink.MAV_LANDED_STATE_ON_GROUND and not self.held:
                self._update_landed(now_us)
            return
        if self.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND:
            thrust = self.setpoint.thrust if self.setpoint is not None else 0.0
            ready = commander.spooled_up(now_us) and commander.mode is Mode.OFFBOARD
            if ready and thrust >= TAKEOFF_THRUST_SHARE * self._hover_thrust:
                self.landed_state = mavlink.MAV_LANDED_STATE_IN_AIR if self.held else mavlink.MAV_LANDED_STATE_TAKEOFF
                self.held = False
                self.released_us = now_us
                self._still_since_us = None
        else:
            self._update_landed(now_us)

    def _update_landed(self, now_us: int) -> None:
        z, vx, vy, vz = self._smooth
        if z > AIRBORNE_HEIGHT_M:
            self.landed_state = mavlink.MAV_LANDED_STATE_IN_AIR
            self._still_since_us = None
            return
        still = z < LANDED_HEIGHT_M and abs(vz) < LANDED_SPEED_M_S and hypot(vx, vy) < LANDED_SPEED_M_S
        landing = self.commander.mode is Mode.LAND or not self.commander.armed
        if not (still and landing):
            self._still_since_us = None
        elif self._still_since_us is None:
            self._still_since_us = now_us
        elif now_us - self._still_since_us >= LANDING_TIME_US:
            self.landed_state = mavlink.MAV_LANDED_STATE_ON_GROUND

    def report(self, now_us: int) -> None:
        """Telemetry that is due, texts, and at once what changed: HEARTBEAT and EXTENDED_SYS_STATE are pushed."""
        shown = (self.commander.mode, self.commander.armed, self.commander.failsafe, self.landed_state)
        changed = self._shown is not None and shown != self._shown
        self._shown = shown
        texts, self._texts = self._texts, []
        for port in self.ports:
            for text_id, severity, text in texts:
                telemetry.send_text(port.node, severity, text, text_id)
            if changed:
                telemetry.send_heartbeat(self, port.node, now_us)
                telemetry.send_extended_sys_state(self, port.node, now_us)
            port.schedule.run(self, port.node, now_us)

    def _look(self, now_us: int) -> None:
        age = None if self.setpoint_us is None else now_us - self.setpoint_us
        landed = self.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND
        self.commander.step(now_us, Situation(landed=landed, setpoint_age_us=age))

    def _queue_text(self, severity: int, text: str) -> None:
        self._text_id = self._text_id % 65535 + 1
        self._texts.append((self._text_id, severity, text))
