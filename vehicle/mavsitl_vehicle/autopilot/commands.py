"""MAV_CMD to what it does: one table, by COMMAND_LONG and COMMAND_INT alike. Each row ends in one MAV_RESULT.

A refusal is followed by a STATUSTEXT with its reason and number. The list in the docs is made from `TABLE`.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite, nan, radians
from typing import TYPE_CHECKING, NamedTuple

from mavsitl.dialect import mavlink
from mavsitl.services.command import Command
from mavsitl.wire_units import from_deg_e7
from mavsitl_vehicle import failures
from mavsitl_vehicle.autopilot import modes, telemetry
from mavsitl_vehicle.autopilot.commander import (
    ACCEPTED,
    DENIED,
    FORCE_MAGIC,
    TEMPORARILY_REJECTED,
    UNSUPPORTED,
)  # fmt: skip
from mavsitl_vehicle.autopilot.modes import Mode
from mavsitl_vehicle.failures import Kind, Unit

if TYPE_CHECKING:
    from mavsitl_vehicle.autopilot.autopilot import Autopilot
    from mavsitl_vehicle.autopilot.ports import Port

FRAME_UNSUPPORTED = 9
"""MAV_RESULT_COMMAND_UNSUPPORTED_MAV_FRAME, which the dialect does not name."""

AMSL_FRAMES = (mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_FRAME_GLOBAL_INT)
RELATIVE_FRAMES = (
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
    mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT, mavlink.MAV_FRAME_GLOBAL_TERRAIN_ALT_INT,
)  # fmt: skip
"""Over flat ground terrain altitude is relative altitude."""

UNKNOWN_INT = 2**31 - 1
"""COMMAND_INT's NaN in x and y."""

LARGEST = 1e10
"""No parameter of a command means anything beyond; infinities are. Integer coordinates are below."""

MIN_TAKEOFF_M, MAX_TAKEOFF_M = 0.3, 200.0
"""Of a take-off altitude that is below ours above the sea, and so meant relative to the ground."""
BELOW_MARGIN_M = 1.0
MAX_SPEED_M_S = 20.0
MAX_ORBIT_RADIUS_M, MIN_ORBIT_RADIUS_M = 1000.0, 1.0


class Place(NamedTuple):
    """Where a command points: degrees, NaN where it does not say; altitude AMSL in metres, NaN where it does not."""

    latitude_deg: float
    longitude_deg: float
    altitude_amsl_m: float

    @property
    def has_position(self) -> bool:
        return isfinite(self.latitude_deg) and isfinite(self.longitude_deg)


Handler = Callable[["Autopilot", Command, int, "Port"], int]


class Row(NamedTuple):
    handler: Handler
    text: str
    """For the docs: what it does here, and where PX4 differs."""


def execute(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    """Do it; the MAV_RESULT of its COMMAND_ACK. What it requests by message goes out on `port`."""
    row = TABLE.get(command.id)
    if row is None:
        autopilot.warn("unsupported", f"Command {command.id} is not supported")
        return UNSUPPORTED
    for number, value in enumerate(command.params, 1):
        if abs(value) > LARGEST:  # NaN is not: it asks for the default
            return _deny(autopilot, f"Command {command.id} refused: param{number} is {value:g}")
    return row.handler(autopilot, command, now_us, port)


def _deny(autopilot: Autopilot, text: str, result: int = DENIED) -> int:
    autopilot.warn(text.partition(":")[0], text)
    return result


def place(autopilot: Autopilot, command: Command) -> Place | str:
    """Parameters 5 to 7 as a place, or why they are none. COMMAND_LONG: degrees, and metres above the sea."""
    latitude, longitude, altitude = command.params[4:7]
    frame = command.frame
    if frame is not None:
        if frame not in AMSL_FRAMES and frame not in RELATIVE_FRAMES:
            return f"frame {frame}"
        latitude = nan if latitude == UNKNOWN_INT else from_deg_e7(latitude)
        longitude = nan if longitude == UNKNOWN_INT else from_deg_e7(longitude)
        if frame in RELATIVE_FRAMES:
            altitude += autopilot.home_altitude_amsl_m
    if isfinite(latitude) and not abs(latitude) <= 90.0:
        return f"latitude {latitude:g} deg"
    if isfinite(longitude) and not abs(longitude) <= 180.0:
        return f"longitude {longitude:g} deg"
    if isfinite(altitude) and abs(altitude) > 1e5:
        return f"altitude {altitude:g} m"
    return Place(latitude, longitude, altitude if isfinite(altitude) else nan)


def _refuse_place(autopilot: Autopilot, what: str, why: str) -> int:
    result = FRAME_UNSUPPORTED if why.startswith("frame") else DENIED
    return _deny(autopilot, f"{what} refused: {why} is not supported", result)


# --- arming and modes ------------------------------------------------------------------------------------------------


def _arm_disarm(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    wanted = command.integer(1)
    if wanted not in (0, 1):
        return _deny(autopilot, f"Arm/disarm refused: param1 is {command.params[0]:g}, need 0 or 1")
    force = command.integer(2) in FORCE_MAGIC
    autopilot.look(now_us)
    return autopilot.commander.request_arm(wanted == 1, force, now_us)


def _set_mode(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    base, main_mode, sub_mode = command.integer(1), command.integer(2), command.integer(3)
    if base is None or not 0 <= base <= 255:
        return _deny(autopilot, f"Mode refused: param1 is {command.params[0]:g}, need MAV_MODE_FLAG bits")
    if not base & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return autopilot.request_mode(modes.from_base_mode(base), f"base mode {base}", now_us)
    if main_mode is None:
        return _deny(autopilot, f"Mode refused: param2 is {command.params[1]:g}, need PX4's main mode")
    described = f"main {main_mode} sub {sub_mode or 0}"
    return autopilot.request_mode(modes.find(main_mode, sub_mode or 0), described, now_us)


def _set_standard_mode(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    standard = command.integer(1)
    mode = None if standard is None else modes.find_standard(standard)
    return autopilot.request_mode(mode, f"standard mode {command.params[0]:g}", now_us)


def _terminate(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    wanted = command.integer(1)
    if wanted not in (0, 1, 2):
        return _deny(autopilot, f"Termination refused: param1 is {command.params[0]:g}, need 0, 1 or 2")
    if wanted != 1:
        return autopilot.commander.request_kill(wanted == 2)
    if not autopilot.commander.armed:
        return _deny(autopilot, "Termination refused: not armed")
    return autopilot.request_mode(Mode.TERMINATION, "termination", now_us)


def _land(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    return autopilot.request_mode(Mode.LAND, "land", now_us)


def _return(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    return autopilot.request_mode(Mode.RTL, "return", now_us)


# --- going somewhere -------------------------------------------------------------------------------------------------


def _takeoff(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    where = place(autopilot, command)
    if isinstance(where, str):
        return _refuse_place(autopilot, "Take-off", where)
    if where.latitude_deg == 0.0 and where.longitude_deg == 0.0:  # MAVProxy, dronekit: here
        where = where._replace(latitude_deg=nan, longitude_deg=nan)
    ours = autopilot.altitude_amsl_m
    altitude = where.altitude_amsl_m
    if isfinite(altitude) and altitude <= ours - BELOW_MARGIN_M:
        if not MIN_TAKEOFF_M <= altitude <= MAX_TAKEOFF_M or command.frame is not None:
            return _deny(
                autopilot, f"Take-off refused: {altitude:.1f} m is below us, {ours:.1f} m", TEMPORARILY_REJECTED
            )
        altitude += autopilot.ground_altitude_amsl_m
    result = autopilot.request_mode(Mode.TAKEOFF, "take-off", now_us)
    if result == ACCEPTED:
        yaw = command.params[3]
        autopilot.navigator.set_takeoff(
            autopilot.height_of(altitude) if isfinite(altitude) else None,
            autopilot.local_at(where.latitude_deg, where.longitude_deg) if where.has_position else None,
            -radians(yaw) if isfinite(yaw) and command.params[3] != 0.0 else None,
        )
    return result


def _reposition(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    flags = command.integer(2)
    if flags is None or flags & ~1:
        return _deny(autopilot, f"Reposition refused: param2 is {command.params[1]:g}, need 1", UNSUPPORTED)
    if flags == 0 and autopilot.commander.mode is not Mode.LOITER:
        return _deny(autopilot, "Reposition refused: param2 bit 0 (change mode) is not set", UNSUPPORTED)
    where = place(autopilot, command)
    if isinstance(where, str):
        return _refuse_place(autopilot, "Reposition", where)
    if not autopilot.commander.armed:
        return _deny(autopilot, "Reposition refused: not armed", TEMPORARILY_REJECTED)
    if autopilot.on_ground:
        return _deny(autopilot, "Reposition refused: landed", TEMPORARILY_REJECTED)
    x, y = autopilot.local_at(where.latitude_deg, where.longitude_deg) if where.has_position else (nan, nan)
    z = autopilot.height_of(where.altitude_amsl_m)
    if reason := autopilot.breach_at(x, y, z):
        return _deny(autopilot, f"Reposition refused: {reason}")
    result = autopilot.request_mode(Mode.LOITER, "hold", now_us, stop=False)
    if result == ACCEPTED:
        speed, yaw = command.params[0], command.params[3]
        autopilot.navigator.go_to(
            (x, y, z),
            yaw_rad=-yaw if isfinite(yaw) else nan,
            speed_m_s=min(speed, MAX_SPEED_M_S) if isfinite(speed) and speed > 0.0 else nan,
        )
    return result


def _change_altitude(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    altitude, frame = command.params[0], command.integer(2)
    if not isfinite(altitude) or abs(altitude) > 1e5:
        return _deny(autopilot, f"Change of altitude refused: {altitude:g} m")
    if frame in RELATIVE_FRAMES:
        altitude += autopilot.home_altitude_amsl_m
    elif frame not in AMSL_FRAMES:
        return _deny(autopilot, f"Change of altitude refused: frame {command.params[1]:g}", FRAME_UNSUPPORTED)
    params = (nan, 1.0, nan, nan, nan, nan, altitude)
    return _reposition(autopilot, command._replace(params=params, frame=None), now_us, port)


def _orbit(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    radius, speed = command.params[0], command.params[1]
    where = place(autopilot, command)
    if isinstance(where, str):
        return _refuse_place(autopilot, "Orbit", where)
    if not autopilot.commander.armed or autopilot.on_ground:
        return _deny(autopilot, "Orbit refused: not flying", TEMPORARILY_REJECTED)
    if isfinite(radius) and not MIN_ORBIT_RADIUS_M <= abs(radius) <= MAX_ORBIT_RADIUS_M:
        return _deny(
            autopilot, f"Orbit refused: radius {radius:g} m, need {MIN_ORBIT_RADIUS_M:g} to {MAX_ORBIT_RADIUS_M:g}"
        )
    centre = autopilot.local_at(where.latitude_deg, where.longitude_deg) if where.has_position else None
    height = autopilot.height_of(where.altitude_amsl_m)
    result = autopilot.request_mode(Mode.ORBIT, "orbit", now_us)
    if result == ACCEPTED:
        autopilot.navigator.set_orbit(centre, height, radius, speed)
    return result


def _change_speed(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    kind, speed = command.integer(1), command.params[1]
    if kind not in (0, 1, 2, 3):
        return _deny(autopilot, f"Speed refused: type {command.params[0]:g}, need 0 to 3")
    if not isfinite(speed) or speed > MAX_SPEED_M_S or (speed <= 0.0 and speed not in (-1.0, -2.0)):
        return _deny(autopilot, f"Speed refused: {speed:g} m/s, need above 0 to {MAX_SPEED_M_S:g}, or -1, -2")
    autopilot.navigator.set_speed(kind, speed if speed > 0.0 else nan)
    return ACCEPTED


def _set_home(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    if command.params[0] > 0.5:
        autopilot.set_home_here()
        return ACCEPTED
    where = place(autopilot, command)
    if isinstance(where, str):
        return _refuse_place(autopilot, "Home", where)
    if not (where.has_position and isfinite(where.altitude_amsl_m)):
        return _deny(autopilot, "Home refused: latitude, longitude and altitude are needed")
    yaw = command.params[3]
    autopilot.set_home(where.latitude_deg, where.longitude_deg, where.altitude_amsl_m, yaw if isfinite(yaw) else nan)
    return ACCEPTED


# --- missions --------------------------------------------------------------------------------------------------------


def _mission_start(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    autopilot.look(now_us)
    if reason := autopilot.commander.situation.mission_refusal:
        return _deny(autopilot, f"Mission start refused: {reason}")
    first = command.params[0]
    if not isfinite(first):
        first = -1.0
    if first > 0.0 and not autopilot.jump_to(int(first)):
        return _deny(autopilot, f"Mission start refused: no item {first:g}")
    result = autopilot.request_mode(Mode.MISSION, "mission", now_us)
    if result != ACCEPTED:
        return result
    return autopilot.commander.request_arm(True, False, now_us, "mission start")


def _pause_continue(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    wanted = command.integer(1)
    if wanted not in (0, 1):
        return _deny(autopilot, f"Pause/continue refused: param1 is {command.params[0]:g}, need 0 or 1")
    return autopilot.request_mode(Mode.MISSION if wanted else Mode.LOITER, "pause/continue", now_us)


def _set_mission_current(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    sequence = command.integer(1)
    if sequence is None or not autopilot.jump_to(max(sequence, 0) if sequence == -1 else sequence):
        return _deny(autopilot, f"Mission item refused: no item {command.params[0]:g}")
    return ACCEPTED


# --- messages --------------------------------------------------------------------------------------------------------


def _set_message_interval(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    message_id, asked_us = command.integer(1), command.params[1]
    if message_id not in telemetry.BY_ID:
        return _deny(autopilot, f"Message interval refused: no stream of message {command.params[0]:g}")
    # The field is a float: MAVSDK asks for 15 Hz by 66666.7 us.
    interval_us = round(asked_us) if isfinite(asked_us) else None
    if interval_us is None or not -1 <= interval_us <= telemetry.MAX_INTERVAL_US:
        return _deny(
            autopilot, f"Message interval refused: {command.params[1]:g} us, need -1 to {telemetry.MAX_INTERVAL_US}"
        )
    if message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT and interval_us != 0:
        return _deny(autopilot, "Message interval refused: HEARTBEAT stays at its rate")
    if interval_us == -1:
        port.schedule.set_interval(message_id, telemetry.NEVER, now_us)
    else:
        port.schedule.set_interval(message_id, interval_us or port.schedule.default_us(message_id), now_us)
    return ACCEPTED


def _get_message_interval(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    message_id = command.integer(1)
    if message_id is None or not 0 <= message_id <= 65535:
        return _deny(autopilot, f"Message interval refused: no message {command.params[0]:g}")
    send_interval(port, message_id)
    return ACCEPTED


def send_interval(port: Port, message_id: int) -> None:
    """MESSAGE_INTERVAL: -1 for a stream that is off, 0 for a message that is not served."""
    interval_us = (port.schedule.interval_us(message_id) or -1) if message_id in telemetry.BY_ID else 0
    port.node.send(telemetry.MESSAGE_INTERVAL, message_id, interval_us)


def _request_message(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    message_id, index = command.integer(1), command.integer(2)
    if message_id == mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL and index is not None and 0 <= index <= 65535:
        send_interval(port, index)
        return ACCEPTED
    if message_id is None or not telemetry.request(port.subject, port.node, message_id, index or 0, now_us):
        return _deny(autopilot, f"Request refused: message {command.params[0]:g} is not served")
    return ACCEPTED


def _request_one(message_id: int) -> Handler:
    def handler(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
        if not telemetry.request(port.subject, port.node, message_id, 0, now_us):
            return _deny(autopilot, f"Request refused: message {message_id} is not served")
        return ACCEPTED

    return handler


# --- the rest --------------------------------------------------------------------------------------------------------


def _reboot(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    wanted = command.integer(1)
    if wanted == 0:
        return ACCEPTED
    if wanted != 1:
        return _deny(autopilot, f"Reboot refused: param1 is {command.params[0]:g}, need 0 or 1", UNSUPPORTED)
    if autopilot.commander.armed:
        return _deny(autopilot, "Reboot refused: armed")
    if not autopilot.on_ground:
        return _deny(autopilot, "Reboot refused: in the air")
    if autopilot.lockstep:
        return _deny(autopilot, "Reboot refused: in lock-step the clock goes on")
    autopilot.reboot_requested = True
    return ACCEPTED


def _calibrate(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    if autopilot.commander.armed:
        return _deny(autopilot, "Calibration refused: armed", TEMPORARILY_REJECTED)
    if not any(isfinite(value) and value != 0.0 for value in command.params):
        return ACCEPTED  # PX4: the end of an RC calibration
    return _deny(autopilot, "Calibration refused: simulated sensors need none", UNSUPPORTED)


def _storage(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    if autopilot.commander.armed:
        return _deny(autopilot, "Storage refused: armed", TEMPORARILY_REJECTED)
    wanted = command.integer(1)
    if wanted in (0, 1):  # read, write: every change is written anyway
        return ACCEPTED
    if wanted in (2, 4):
        autopilot.parameters.reset()
        return ACCEPTED
    return _deny(autopilot, f"Storage refused: param1 is {command.params[0]:g}", UNSUPPORTED)


def _prearm_checks(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    autopilot.look(now_us)
    if reason := autopilot.commander.arming_refusal():
        autopilot.warn("prearm", f"Preflight Fail: {reason}")
    return ACCEPTED


def _inject_failure(autopilot: Autopilot, command: Command, now_us: int, port: Port) -> int:
    if not autopilot.parameters["SYS_FAILURE_EN"]:
        return _deny(autopilot, "Failure injection refused: SYS_FAILURE_EN is 0")
    unit, kind, instance = (command.integer(index) for index in (1, 2, 3))
    if unit is None:
        return _deny(autopilot, f"Failure injection refused: param1 is {command.params[0]:g}, need a FAILURE_UNIT")
    if kind is None:
        return _deny(autopilot, f"Failure injection refused: param2 is {command.params[1]:g}, need a FAILURE_TYPE")
    if problem := failures.unsupported(unit, kind, sensors=autopilot.has_sensors):
        return _deny(autopilot, f"Failure injection refused: {problem}", UNSUPPORTED)
    if instance is None:
        return _deny(autopilot, f"Failure injection refused: param3 is {command.params[2]:g}, need 0 (all) or more")
    problem = failures.instance_problem(Unit(unit), instance)
    if failures.silences(unit, kind) and not autopilot.may_fall_silent:
        problem = failures.NO_SILENCE
    if problem:
        return _deny(autopilot, f"Failure injection refused: {problem}")
    autopilot.failures.set(Unit(unit), Kind(kind), instance)
    return ACCEPTED


_M = mavlink
TABLE: dict[int, Row] = {
    _M.MAV_CMD_COMPONENT_ARM_DISARM: Row(_arm_disarm, "param2 21196 (PX4) or 2989 forces a disarming, no arming"),
    _M.MAV_CMD_DO_SET_MODE: Row(_set_mode, "one acknowledgement; PX4 sends two"),
    _M.MAV_CMD_DO_SET_STANDARD_MODE: Row(_set_standard_mode, "as AVAILABLE_MODES lists them"),
    _M.MAV_CMD_DO_FLIGHTTERMINATION: Row(
        _terminate, "1: armed only, the rotors stop for good; 2, 0: the kill switch on and off, as PX4's lockdown"
    ),
    _M.MAV_CMD_NAV_TAKEOFF: Row(
        _takeoff,
        "altitude above the sea; COMMAND_LONG: over the ground where that is below; NaN: MIS_TAKEOFF_ALT; 0/0: here",
    ),
    _M.MAV_CMD_NAV_LAND: Row(_land, "always taken; lands where it is"),
    _M.MAV_CMD_NAV_RETURN_TO_LAUNCH: Row(_return, "AUTO.RTL"),
    _M.MAV_CMD_DO_REPOSITION: Row(
        _reposition, "param2 bit 0 needed unless holding; NaN: here; refused outside a fence"
    ),
    _M.MAV_CMD_DO_CHANGE_ALTITUDE: Row(_change_altitude, "as DO_REPOSITION"),
    _M.MAV_CMD_DO_ORBIT: Row(_orbit, "radius negative: counter-clockwise; looks at the centre"),
    _M.MAV_CMD_DO_CHANGE_SPEED: Row(_change_speed, "-1, -2: back to the parameters"),
    _M.MAV_CMD_DO_SET_HOME: Row(_set_home, "param1 1: here"),
    _M.MAV_CMD_MISSION_START: Row(_mission_start, "AUTO.MISSION, and arms"),
    _M.MAV_CMD_DO_PAUSE_CONTINUE: Row(_pause_continue, "AUTO.LOITER, AUTO.MISSION"),
    _M.MAV_CMD_DO_SET_MISSION_CURRENT: Row(_set_mission_current, "-1: from the beginning"),
    _M.MAV_CMD_SET_MESSAGE_INTERVAL: Row(_set_message_interval, "this link only; HEARTBEAT cannot be stopped"),
    _M.MAV_CMD_GET_MESSAGE_INTERVAL: Row(_get_message_interval, "MESSAGE_INTERVAL"),
    _M.MAV_CMD_REQUEST_MESSAGE: Row(_request_message, "every message of the table above; param2 is its index"),
    _M.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: Row(
        _request_one(_M.MAVLINK_MSG_ID_AUTOPILOT_VERSION), "AUTOPILOT_VERSION"
    ),
    _M.MAV_CMD_GET_HOME_POSITION: Row(_request_one(_M.MAVLINK_MSG_ID_HOME_POSITION), "HOME_POSITION"),
    _M.MAV_CMD_REQUEST_FLIGHT_INFORMATION: Row(
        _request_one(_M.MAVLINK_MSG_ID_FLIGHT_INFORMATION), "FLIGHT_INFORMATION"
    ),
    _M.MAV_CMD_REQUEST_PROTOCOL_VERSION: Row(_request_one(300), "denied: the dialect has no PROTOCOL_VERSION"),
    _M.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: Row(_reboot, "disarmed only; clock and state begin anew, the sockets stay"),
    _M.MAV_CMD_PREFLIGHT_CALIBRATION: Row(_calibrate, "refused: simulated sensors need none"),
    _M.MAV_CMD_PREFLIGHT_STORAGE: Row(_storage, "2 and 4 reset the parameters; disarmed only"),
    _M.MAV_CMD_RUN_PREARM_CHECKS: Row(_prearm_checks, "says what keeps it from arming"),
    _M.MAV_CMD_INJECT_FAILURE: Row(_inject_failure, "SYS_FAILURE_EN 1 needed; by the table of failures"),
}
