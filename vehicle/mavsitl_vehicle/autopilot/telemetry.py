"""Telemetry: one table of streams, and a schedule per link. Wire units and NED/FRD signs are made here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from heapq import heapify, heapreplace
from math import atan2, hypot, inf, nan, pi, sqrt
from struct import Struct
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias

import msgspec

from mavsitl import __version__
from mavsitl.codec import EncodeError, Packer, packer
from mavsitl.dialect import mavlink
from mavsitl.frames import Quaternion, Vector, flip_quaternion, flip_vector
from mavsitl.geodesy import Origin
from mavsitl.node import Node
from mavsitl.quaternion import conjugate, from_yaw, rotate, to_euler
from mavsitl.wire_units import (
    INT16_MAX,
    UINT8_MAX,
    UINT16_MAX,
    UINT32_MAX,
    boot_ms,
    centi_celsius,
    centiamperes,
    centimetres_per_s,
    centimetres_per_s_unsigned,
    deg_e7,
    heading_cdeg,
    heading_deg,
    milli_g,
    millimetres,
    millimetres_unsigned,
    millivolts,
    whole,
)
from mavsitl_vehicle.autopilot import health as healths
from mavsitl_vehicle.autopilot import modes
from mavsitl_vehicle.autopilot.battery import Battery
from mavsitl_vehicle.autopilot.health import Health
from mavsitl_vehicle.autopilot.modes import Mode
from mavsitl_vehicle.autopilot.setpoints import PositionSetpoint
from mavsitl_vehicle.autopilot.sticks import Axes
from mavsitl_vehicle.sensors.status import EstimatorStatus, GpsReading, Readings

# --- what is told ----------------------------------------------------------------------------------------------------


class Home(NamedTuple):
    position_nwu_m: Vector
    yaw_rad: float
    """Heading when it was set, NWU: positive to the left."""
    set_us: int


class AttitudeTarget(NamedTuple):
    """What the attitude loops follow."""

    attitude: Quaternion | None
    """FLU -> NWU; None: only rates are held."""
    omega_flu_rad_s: Vector
    """Setpoint of the rate loop; NaN where there is none."""
    thrust: float
    """Collective, 0 to 1."""


class Wind(NamedTuple):
    """A wind estimate."""

    velocity_nwu_m_s: Vector
    variance_horizontal_m2_s2: float
    variance_vertical_m2_s2: float


class Mission(NamedTuple):
    """Progress, as MISSION_CURRENT has it."""

    sequence: int = 0
    total: int = 0
    state: int = mavlink.MISSION_STATE_NO_MISSION
    active: bool = False
    """AUTO.MISSION is flown."""


class FlightTimes(NamedTuple):
    """Of the present or last flight, microseconds since boot; 0: not yet."""

    armed_us: int = 0
    took_off_us: int = 0
    landed_us: int = 0
    number: int = 0
    """1 for the first flight since boot."""


class Metadata(NamedTuple):
    """COMPONENT_METADATA: where the general file is, and its CRC-32."""

    uri: str
    crc: int


class Accuracy(msgspec.Struct, frozen=True):
    """1-sigma of the estimate, and ODOMETRY's covariances made of it: upper right triangles, row by row, packed."""

    position_m: float
    velocity_m_s: float
    pose_covariance: bytes
    velocity_covariance: bytes


_DIAGONAL = (0, 6, 11, 15, 18, 20)
_TRIANGLE = Struct("<21f")
_FLOAT32_MAX = (2.0 - 2.0**-23) * 2.0**127


def accuracy(status: EstimatorStatus) -> Accuracy:
    """Of an estimate that is known so well. As from PX4, only the variances are told."""
    pose, velocity = [nan] * 21, [nan] * 21
    h, v, tilt = status.eph_m, status.evh_m_s, status.tilt_rad
    sigmas = (h, h, status.epv_m, tilt, tilt, status.heading_rad)
    rates = (v, v, status.evv_m_s, status.rate_rad_s, status.rate_rad_s, status.rate_rad_s)
    for index, sigma, sigma_rate in zip(_DIAGONAL, sigmas, rates, strict=True):
        pose[index], velocity[index] = sigma * sigma, sigma_rate * sigma_rate
    return Accuracy(h, v, _packed(pose), _packed(velocity))


def _packed(triangle: list[float]) -> bytes:
    """What is beyond float32's range is infinite."""
    return _TRIANGLE.pack(*(inf if value > _FLOAT32_MAX else value for value in triangle))


class CommanderView(Protocol):
    @property
    def mode(self) -> Mode:
        """What flies."""

    @property
    def intended(self) -> Mode:
        """What the user chose."""

    @property
    def armed(self) -> bool: ...

    @property
    def failsafe(self) -> bool: ...

    def arming_refusal(self) -> str | None:
        """Why the vehicle would not arm now; None when it would."""


class Subject(Protocol):
    """Everything that the samplers read, and nothing else. World NWU, body FLU."""

    @property
    def system_id(self) -> int: ...

    @property
    def unix_boot_us(self) -> int:
        """UNIX time at boot; 0: unknown."""

    @property
    def load(self) -> float:
        """Share of the processor's time used, 0 to 1."""

    @property
    def commander(self) -> CommanderView: ...

    @property
    def landed_state(self) -> int:
        """MAV_LANDED_STATE"""

    @property
    def health(self) -> Health: ...

    @property
    def battery(self) -> Battery: ...

    @property
    def estimate(self) -> Sequence[float]:
        """(13,) position m, velocity m/s, quaternion FLU -> NWU, omega FLU rad/s."""

    @property
    def accuracy(self) -> Accuracy: ...

    @property
    def estimator_status(self) -> EstimatorStatus: ...

    @property
    def readings(self) -> Readings | None:
        """Of the sensors; None: there are none, and what they would measure is made of the estimate."""

    @property
    def specific_force_flu_m_s2(self) -> Vector:
        """What the accelerometer measures: at rest and level (0, 0, g)."""

    @property
    def truth(self) -> Sequence[float]:
        """(17,) as `estimate`, then rotor speeds rad/s."""

    @property
    def true_wind(self) -> Vector:
        """m/s NWU."""

    @property
    def outputs(self) -> Sequence[float]:
        """(4,) of the rotors, 0 to 1."""

    @property
    def silent_escs(self) -> int:
        """Speed controllers without telemetry, bit i - 1 for rotor i."""

    @property
    def origin(self) -> Origin: ...

    @property
    def home(self) -> Home | None: ...

    @property
    def attitude_target(self) -> AttitudeTarget | None:
        """None: the rotors stand still, or torques are flown."""

    @property
    def position_target(self) -> PositionSetpoint | None:
        """None: no position loop runs."""

    @property
    def wind(self) -> Wind | None:
        """None: not estimated, and then not sent."""

    @property
    def sticks(self) -> Axes | None:
        """None: none come, and then none are sent."""

    @property
    def mission(self) -> Mission: ...

    @property
    def flight_times(self) -> FlightTimes: ...

    @property
    def metadata(self) -> Metadata | None: ...


class Frozen:
    """A `Subject` whose state stays as it is, however the vehicle goes on: telemetry that hangs.

    Mode, arming, landed state, home, mission and times stay true: they are the commander's, not the estimator's.
    """

    _KEPT = (
        "estimate", "accuracy", "estimator_status", "readings", "truth", "true_wind", "outputs",
        "specific_force_flu_m_s2", "health", "attitude_target", "position_target", "wind", "sticks",
    )  # fmt: skip

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        self.battery = copy(subject.battery)
        for name in self._KEPT:
            setattr(self, name, getattr(subject, name))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._subject, name)


Sampler: TypeAlias = Callable[[Any, Node, int], bool]
"""(subject, node, now_us) -> sent; the subject is a `Subject`. False: there is nothing to say now."""
IndexedSampler: TypeAlias = Callable[[Any, Node, int, int], bool]
"""As `Sampler`, with REQUEST_MESSAGE's param2 as the last argument."""

HZ = 1_000_000
NEVER = 0
ON_REQUEST = 0

CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | mavlink.MAV_PROTOCOL_CAPABILITY_FTP
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_GLOBAL_INT
    | mavlink.MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
    | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
    | mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY
)
"""What is served, and nothing more: clients act on these bits."""

MAX_INTERVAL_US = 2**31 - 1
"""The longest that MESSAGE_INTERVAL can report."""

# --- identity and state ----------------------------------------------------------------------------------------------


def _pack(name: str) -> Any:
    """The packer of a message by its name in lower case; None where the dialect has no such message."""
    message_class = getattr(mavlink, f"MAVLink_{name}_message", None)
    return None if message_class is None else packer(message_class)


HEARTBEAT: Packer = _pack("heartbeat")
COMMAND_ACK: Packer = _pack("command_ack")
MESSAGE_INTERVAL: Packer = _pack("message_interval")

_TYPE: int = mavlink.MAV_TYPE_QUADROTOR
_AUTOPILOT: int = mavlink.MAV_AUTOPILOT_PX4
_CUSTOM_ENABLED: int = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
_SAFETY_ARMED: int = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
_MAVLINK_VERSION = 3


def send_heartbeat(subject: Subject, node: Node, now_us: int) -> bool:
    commander = subject.commander
    mode = commander.mode
    base = _CUSTOM_ENABLED | modes.TABLE[mode].base_mode
    if commander.armed:
        base |= _SAFETY_ARMED
    if mode is Mode.TERMINATION:
        state = mavlink.MAV_STATE_FLIGHT_TERMINATION
    elif commander.armed:
        state = mavlink.MAV_STATE_CRITICAL if commander.failsafe else mavlink.MAV_STATE_ACTIVE
    else:
        state = mavlink.MAV_STATE_STANDBY if commander.arming_refusal() is None else mavlink.MAV_STATE_UNINIT
    node.send(HEARTBEAT, _TYPE, _AUTOPILOT, base, modes.custom_mode(mode), state, _MAVLINK_VERSION)
    return True


_SYS_STATUS = _pack("sys_status")


def send_sys_status(subject: Subject, node: Node, now_us: int) -> bool:
    bits, battery = healths.bits(subject.health), subject.battery
    node.send(
        _SYS_STATUS, bits.present, bits.enabled, bits.health, whole(subject.load * 1e3, 0, 1000),
        millivolts(battery.voltage_v), centiamperes(battery.current_a), whole(battery.remaining_percent, 0, 100, -1),
        0, 0, 0, 0, 0, 0, 0, 0, 0,
    )  # fmt: skip
    return True


_EXTENDED_SYS_STATE = _pack("extended_sys_state")


def send_extended_sys_state(subject: Subject, node: Node, now_us: int) -> bool:
    node.send(_EXTENDED_SYS_STATE, mavlink.MAV_VTOL_STATE_UNDEFINED, subject.landed_state)
    return True


_CURRENT_MODE = _pack("current_mode")


def send_current_mode(subject: Subject, node: Node, now_us: int) -> bool:
    commander = subject.commander
    mode = commander.mode
    standard = modes.TABLE[mode].standard_mode
    node.send(_CURRENT_MODE, standard, modes.custom_mode(mode), modes.custom_mode(commander.intended))
    return True


_AVAILABLE_MODES = _pack("available_modes")


def _mode_rows() -> list[tuple[Any, ...]]:
    rows: list[tuple[Any, ...]] = []
    for index, mode in enumerate(modes.LISTED, 1):
        info = modes.TABLE[mode]
        properties = mavlink.MAV_MODE_PROPERTY_ADVANCED if info.advanced else 0
        if not info.selectable:
            properties |= mavlink.MAV_MODE_PROPERTY_NOT_USER_SELECTABLE
        # A standard mode has its name from the standard.
        title = b"" if info.standard_mode else info.title.encode()
        rows.append((len(modes.LISTED), index, info.standard_mode, modes.custom_mode(mode), properties, title))
    return rows


_MODE_ROWS = _mode_rows()


def send_available_modes(subject: Subject, node: Node, now_us: int, index: int = 0) -> bool:
    """The `index`-th mode from 1, or all for 0."""
    if not 0 <= index <= len(_MODE_ROWS):
        return False
    for row in _MODE_ROWS if index == 0 else _MODE_ROWS[index - 1 : index]:
        node.send(_AVAILABLE_MODES, *row)
    return True


_AVAILABLE_MODES_MONITOR = _pack("available_modes_monitor")


def send_available_modes_monitor(subject: Subject, node: Node, now_us: int) -> bool:
    """The list never changes."""
    node.send(_AVAILABLE_MODES_MONITOR, 0)
    return True


_MISSION_CURRENT = _pack("mission_current")
_IN_MISSION_MODE, _SUSPENDED = 1, 2


def send_mission_current(subject: Subject, node: Node, now_us: int) -> bool:
    """Without a mission 0 of 0, as PX4."""
    mission = subject.mission
    node.send(
        _MISSION_CURRENT, whole(mission.sequence, 0, UINT16_MAX), whole(mission.total, 0, UINT16_MAX - 1),
        mission.state, _IN_MISSION_MODE if mission.active else _SUSPENDED,
    )  # fmt: skip
    return True


_AUTOPILOT_VERSION = _pack("autopilot_version")
_FLIGHT_SW_VERSION = 1 << 24 | 17 << 16 | 0 << 8 | 255
"""PX4 1.17.0 release: the version whose behaviour this vehicle shows, because clients gate on PX4's numbers."""


def _middleware_version() -> int:
    major, minor, patch = (int(part) for part in __version__.split(".")[:3])
    return major << 24 | minor << 16 | patch << 8 | 255


_MIDDLEWARE_SW_VERSION = _middleware_version()
_OWN_VERSION = _MIDDLEWARE_SW_VERSION.to_bytes(4, "little")[1:] + bytes(5)
"""flight_custom_version: patch, minor, major, which clients show as the vendor's version, and no git hash."""


def send_autopilot_version(subject: Subject, node: Node, now_us: int) -> bool:
    uid = 0x6D61_7673_6974_6C00 | subject.system_id
    node.send(
        _AUTOPILOT_VERSION,
        CAPABILITIES, _FLIGHT_SW_VERSION, _MIDDLEWARE_SW_VERSION, 0, 0,
        _OWN_VERSION, bytes(8), bytes(8), 0, 0, uid, uid.to_bytes(8, "big") + bytes(10),
    )  # fmt: skip
    return True


_PROTOCOL_VERSION = _pack("protocol_version")


def send_protocol_version(subject: Subject, node: Node, now_us: int) -> bool:
    """MAVLink 2 goes out, both versions are taken; no hashes."""
    node.send(_PROTOCOL_VERSION, 200, 100, 200, bytes(8), bytes(8))
    return True


_COMPONENT_METADATA = _pack("component_metadata")


def send_component_metadata(subject: Subject, node: Node, now_us: int) -> bool:
    metadata = subject.metadata
    if metadata is None:
        return False
    node.send(_COMPONENT_METADATA, boot_ms(now_us), metadata.crc, metadata.uri.encode())
    return True


_FLIGHT_INFORMATION = _pack("flight_information")


def send_flight_information(subject: Subject, node: Node, now_us: int) -> bool:
    """Times since boot; `flight_uuid` is the flight's number, as the message's definition has it."""
    times = subject.flight_times
    node.send(
        _FLIGHT_INFORMATION,
        boot_ms(now_us), times.armed_us, times.took_off_us, times.number, boot_ms(times.landed_us),
    )  # fmt: skip
    return True


_SYSTEM_TIME = _pack("system_time")


def send_system_time(subject: Subject, node: Node, now_us: int) -> bool:
    base = subject.unix_boot_us
    node.send(_SYSTEM_TIME, base + now_us if base else 0, boot_ms(now_us))
    return True


# --- attitude and position -------------------------------------------------------------------------------------------

_ATTITUDE = _pack("attitude")


def send_attitude(subject: Subject, node: Node, now_us: int) -> bool:
    e = subject.estimate
    roll, pitch, yaw = to_euler((e[6], e[7], -e[8], -e[9]))
    node.send(_ATTITUDE, boot_ms(now_us), roll, pitch, yaw, e[10], -e[11], -e[12])
    return True


_ATTITUDE_QUATERNION = _pack("attitude_quaternion")
_NO_OFFSET = (0.0, 0.0, 0.0, 0.0)


def send_attitude_quaternion(subject: Subject, node: Node, now_us: int) -> bool:
    e = subject.estimate
    node.send(
        _ATTITUDE_QUATERNION, boot_ms(now_us), e[6], e[7], -e[8], -e[9], e[10], -e[11], -e[12], _NO_OFFSET
    )  # fmt: skip
    return True


_LOCAL_POSITION_NED = _pack("local_position_ned")


def send_local_position_ned(subject: Subject, node: Node, now_us: int) -> bool:
    e = subject.estimate
    node.send(_LOCAL_POSITION_NED, boot_ms(now_us), e[0], -e[1], -e[2], e[3], -e[4], -e[5])
    return True


_ODOMETRY = _pack("odometry")
_LOCAL_NED: int = mavlink.MAV_FRAME_LOCAL_NED
_BY_AUTOPILOT: int = mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT


def send_odometry(subject: Subject, node: Node, now_us: int) -> bool:
    """PX4's frames: pose in LOCAL_NED, velocity in LOCAL_NED (child_frame_id), body rates in FRD."""
    quality = subject.accuracy
    x, y, z, vx, vy, vz, q0, q1, q2, q3, p, q, r = subject.estimate
    frame = _ODOMETRY(
        node.sequence, node.system_id, node.component_id, now_us, _LOCAL_NED, _LOCAL_NED,
        x, -y, -z, (q0, q1, -q2, -q3), vx, -vy, -vz, p, -q, -r,
        quality.pose_covariance, quality.velocity_covariance, 0, _BY_AUTOPILOT, 100,
    )  # fmt: skip
    node.queue(frame)
    return True


def _heading_rad(q: Sequence[float]) -> float:
    """Clockwise from north, of rows 6:10."""
    return -to_euler((q[6], q[7], q[8], q[9]))[2]


def _home_height_m(subject: Subject) -> float:
    home = subject.home
    return 0.0 if home is None else home.position_nwu_m[2]


_GLOBAL_POSITION_INT = _pack("global_position_int")


def send_global_position_int(subject: Subject, node: Node, now_us: int) -> bool:
    e, origin = subject.estimate, subject.origin
    lat, lon = origin.to_global(e[0], e[1])
    node.send(
        _GLOBAL_POSITION_INT, boot_ms(now_us), deg_e7(lat), deg_e7(lon), millimetres(origin.altitude_amsl_m + e[2]),
        millimetres(e[2] - _home_height_m(subject)),
        centimetres_per_s(e[3]), centimetres_per_s(-e[4]), centimetres_per_s(-e[5]), heading_cdeg(_heading_rad(e)),
    )  # fmt: skip
    return True


_GPS_RAW_INT = _pack("gps_raw_int")
HDOP, VDOP = 0.7, 1.1
_HDOP_CENTI, _VDOP_CENTI = round(100 * HDOP), round(100 * VDOP)
_SATELLITES = 10
_NO_YAW = 0


def gps_of_estimate(subject: Subject) -> GpsReading | None:
    """What a receiver says that is as good as the estimate, without sensors; None: it has no fix."""
    if not subject.health.gps:
        return None
    e, quality = subject.estimate, subject.accuracy
    return GpsReading(
        (e[0], e[1], e[2]), (e[3], e[4], e[5]), _SATELLITES,
        quality.position_m, quality.position_m, quality.velocity_m_s, 0,
    )  # fmt: skip


def send_gps_raw_int(subject: Subject, node: Node, now_us: int) -> bool:
    """As the receiver tells it; without sensors it is as good as the estimate. With a fault it has no fix."""
    readings = subject.readings
    fix = gps_of_estimate(subject) if readings is None else readings.gps
    if fix is None:
        node.send(
            _GPS_RAW_INT, now_us, mavlink.GPS_FIX_TYPE_NO_FIX, 0, 0, 0, UINT16_MAX, UINT16_MAX, UINT16_MAX, UINT16_MAX,
            0,
        )  # fmt: skip
        return True
    origin = subject.origin
    (x, y, z), (vx, vy, _) = fix.position_nwu_m, fix.velocity_nwu_m_s
    lat, lon = origin.to_global(x, y)
    altitude_mm = millimetres(origin.altitude_amsl_m + z)
    node.send(
        _GPS_RAW_INT, max(now_us - fix.age_us, 0), mavlink.GPS_FIX_TYPE_3D_FIX, deg_e7(lat), deg_e7(lon), altitude_mm,
        _HDOP_CENTI, _VDOP_CENTI, centimetres_per_s_unsigned(hypot(vx, vy)), heading_cdeg(atan2(-vy, vx)),
        fix.satellites, altitude_mm, millimetres_unsigned(fix.eph_m), millimetres_unsigned(fix.epv_m),
        millimetres_unsigned(fix.evs_m_s), 0, _NO_YAW,
    )  # fmt: skip
    return True


_VFR_HUD = _pack("vfr_hud")
_NO_AIRSPEED_SENSOR = 0.0


def send_vfr_hud(subject: Subject, node: Node, now_us: int) -> bool:
    """Airspeed 0 without a sensor: PX4's NaN upsets clients."""
    e, target = subject.estimate, subject.attitude_target
    throttle = target.thrust if target is not None and subject.commander.armed else 0.0
    node.send(
        _VFR_HUD, _NO_AIRSPEED_SENSOR, hypot(e[3], e[4]), heading_deg(_heading_rad(e)),
        whole(throttle * 100.0, 0, 100), subject.origin.altitude_amsl_m + e[2], e[5],
    )  # fmt: skip
    return True


_ALTITUDE = _pack("altitude")


def send_altitude(subject: Subject, node: Node, now_us: int) -> bool:
    """No terrain sensor, so the last two are unknown."""
    height = subject.estimate[2]
    amsl = subject.origin.altitude_amsl_m + height
    node.send(_ALTITUDE, now_us, amsl, amsl, height, height - _home_height_m(subject), nan, nan)
    return True


_HOME_POSITION = _pack("home_position")


def send_home_position(subject: Subject, node: Node, now_us: int) -> bool:
    home, origin = subject.home, subject.origin
    if home is None:
        return False
    x, y, z = home.position_nwu_m
    lat, lon = origin.to_global(x, y)
    node.send(
        _HOME_POSITION, deg_e7(lat), deg_e7(lon), millimetres(origin.altitude_amsl_m + z), *flip_vector(x, y, z),
        flip_quaternion(*from_yaw(home.yaw_rad)), 0.0, 0.0, 0.0, home.set_us,
    )  # fmt: skip
    return True


_GPS_GLOBAL_ORIGIN = _pack("gps_global_origin")


def send_gps_global_origin(subject: Subject, node: Node, now_us: int) -> bool:
    origin = subject.origin
    node.send(
        _GPS_GLOBAL_ORIGIN,
        deg_e7(origin.latitude_deg), deg_e7(origin.longitude_deg), millimetres(origin.altitude_amsl_m), now_us,
    )  # fmt: skip
    return True


_ESTIMATOR_STATUS = _pack("estimator_status")
_ATTITUDE_FLAGS: int = mavlink.ESTIMATOR_ATTITUDE
_HEIGHT_FLAGS: int = mavlink.ESTIMATOR_VELOCITY_VERT | mavlink.ESTIMATOR_POS_VERT_ABS
_POSITION_FLAGS: int = (
    mavlink.ESTIMATOR_VELOCITY_HORIZ
    | mavlink.ESTIMATOR_POS_HORIZ_REL
    | mavlink.ESTIMATOR_POS_HORIZ_ABS
    | mavlink.ESTIMATOR_PRED_POS_HORIZ_REL
    | mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS
)


def estimator_flags(health: Health, status: EstimatorStatus) -> int:
    """ESTIMATOR_STATUS_FLAGS"""
    flags: int = (
        (_ATTITUDE_FLAGS if health.attitude else 0)
        | (_HEIGHT_FLAGS if health.height else 0)
        | (_POSITION_FLAGS if health.position else mavlink.ESTIMATOR_CONST_POS_MODE)
        | (mavlink.ESTIMATOR_GPS_GLITCH if status.position_ratio > 1.0 else 0)
    )
    return flags


def send_estimator_status(subject: Subject, node: Node, now_us: int) -> bool:
    """Ratios of 0 where no filter runs; those of sensors that are not there are unknown."""
    status = subject.estimator_status
    node.send(
        _ESTIMATOR_STATUS, now_us, estimator_flags(subject.health, status), status.velocity_ratio,
        status.position_ratio, status.height_ratio, status.mag_ratio, nan, nan, status.eph_m, status.epv_m,
    )  # fmt: skip
    return True


_WIND_COV = _pack("wind_cov")


def send_wind_cov(subject: Subject, node: Node, now_us: int) -> bool:
    """The vehicle's own estimate; where there is none nothing is sent, as on PX4."""
    wind = subject.wind
    if wind is None:
        return False
    node.send(
        _WIND_COV, now_us, *flip_vector(*wind.velocity_nwu_m_s),
        wind.variance_horizontal_m2_s2, wind.variance_vertical_m2_s2,
        subject.origin.altitude_amsl_m + subject.estimate[2],
        sqrt(wind.variance_horizontal_m2_s2), sqrt(wind.variance_vertical_m2_s2),
    )  # fmt: skip
    return True


# --- sensors ---------------------------------------------------------------------------------------------------------

_SEA_LEVEL_HPA = 1013.25
_SEA_LEVEL_K, _LAPSE_K_M = 288.15, 0.0065
_PRESSURE_EXPONENT = 5.25588
_ZERO_C_K = 273.15


def atmosphere(altitude_amsl_m: float) -> tuple[float, float]:
    """(pressure hPa, temperature deg C) of the standard atmosphere, ISO 2533, whose lapse is followed up to 11 km."""
    kelvin = _SEA_LEVEL_K - _LAPSE_K_M * min(max(altitude_amsl_m, -5000.0), 11_000.0)
    return _SEA_LEVEL_HPA * float((kelvin / _SEA_LEVEL_K) ** _PRESSURE_EXPONENT), kelvin - _ZERO_C_K


_HIGHRES_IMU = _pack("highres_imu")
_FIELDS_UPDATED = 0b1_1011_1111_1111
"""All but differential pressure."""


def _sensed(subject: Subject) -> tuple[Vector, Vector, Vector, float]:
    """Rate rad/s, specific force m/s^2 and field gauss (FLU), and the altitude that the barometer shows, m."""
    readings, e, origin = subject.readings, subject.estimate, subject.origin
    field, height = None, None
    if readings is None:
        rate, force = (e[10], e[11], e[12]), subject.specific_force_flu_m_s2
    else:
        rate, force = readings.gyro_flu_rad_s, readings.accel_flu_m_s2
        field, height = readings.mag_flu_gauss, readings.baro_height_m
    if field is None:
        field = rotate(conjugate((e[6], e[7], e[8], e[9])), origin.magnetic_field_nwu_gauss)
    return rate, force, field, origin.altitude_amsl_m + (e[2] if height is None else height)


def send_highres_imu(subject: Subject, node: Node, now_us: int) -> bool:
    """FRD; the accelerometer measures specific force, -g about z at rest."""
    (p, q, r), (ax, ay, az), (mx, my, mz), altitude = _sensed(subject)
    pressure, temperature = atmosphere(altitude)
    node.send(
        _HIGHRES_IMU, now_us, ax, -ay, -az, p, -q, -r, mx, -my, -mz,
        pressure, 0.0, altitude, temperature, _FIELDS_UPDATED,
    )  # fmt: skip
    return True


_SCALED_PRESSURE = _pack("scaled_pressure")


def send_scaled_pressure(subject: Subject, node: Node, now_us: int) -> bool:
    pressure, temperature = atmosphere(_sensed(subject)[3])
    node.send(_SCALED_PRESSURE, boot_ms(now_us), pressure, 0.0, centi_celsius(temperature), 0)
    return True


_VIBRATION = _pack("vibration")


def send_vibration(subject: Subject, node: Node, now_us: int) -> bool:
    """The simulated sensors neither shake nor clip."""
    node.send(_VIBRATION, now_us, 0.0, 0.0, 0.0, 0, 0, 0)
    return True


_BATTERY_STATUS = _pack("battery_status")
_NO_CELLS = (UINT16_MAX,) * 9


def send_battery_status(subject: Subject, node: Node, now_us: int) -> bool:
    """The pack's voltage stands in the first cell, as PX4 does without cell voltages."""
    battery = subject.battery
    remaining_s = battery.remaining_s
    node.send(
        _BATTERY_STATUS, 0, mavlink.MAV_BATTERY_FUNCTION_ALL, mavlink.MAV_BATTERY_TYPE_LIPO, INT16_MAX,
        (millivolts(battery.voltage_v), *_NO_CELLS), centiamperes(battery.current_a),
        whole(battery.consumed_ah * 1e3, 0, 2**31 - 1), whole(battery.consumed_j / 100.0, 0, 2**31 - 1),
        whole(battery.remaining_percent, 0, 100, -1),
        0 if remaining_s is None else whole(remaining_s, 1, 2**31 - 1),
        mavlink.MAV_BATTERY_CHARGE_STATE_OK + battery.level, (0, 0, 0, 0), mavlink.MAV_BATTERY_MODE_UNKNOWN, 0,
    )  # fmt: skip
    return True


_RC_CHANNELS = _pack("rc_channels")
_STICK_CHANNELS = 4
_UNUSED_CHANNELS = (UINT16_MAX,) * (18 - _STICK_CHANNELS)


def _stick_us(value: float) -> int:
    return whole(1500.0 + 500.0 * value, 1000, 2000, 1500)


def send_rc_channels(subject: Subject, node: Node, now_us: int) -> bool:
    """Roll, pitch, throttle, yaw on channels 1 to 4, pitch pulled back above 1500; no radio, so no signal strength."""
    sticks = subject.sticks
    if sticks is None:
        return False
    node.send(
        _RC_CHANNELS, boot_ms(now_us), _STICK_CHANNELS,
        _stick_us(sticks.roll), _stick_us(-sticks.pitch), _stick_us(2.0 * sticks.throttle - 1.0), _stick_us(sticks.yaw),
        *_UNUSED_CHANNELS, UINT8_MAX,
    )  # fmt: skip
    return True


# --- actuators and targets -------------------------------------------------------------------------------------------

_SERVO_OUTPUT_RAW = _pack("servo_output_raw")
_DISARMED_PWM_US = 900
_NO_SERVOS = (0,) * 12


def send_servo_output_raw(subject: Subject, node: Node, now_us: int) -> bool:
    """1000 to 2000 us, and PX4's 900 while disarmed; rotor 1 rear, 2 right, 3 front, 4 left."""
    if subject.commander.armed:
        o1, o2, o3, o4 = (whole(1000.0 + 1000.0 * output, 1000, 2000, 1000) for output in subject.outputs)
    else:
        o1 = o2 = o3 = o4 = _DISARMED_PWM_US
    node.send(_SERVO_OUTPUT_RAW, now_us & UINT32_MAX, 0, o1, o2, o3, o4, *_NO_SERVOS)
    return True


_ACTUATOR_OUTPUT_STATUS = _pack("actuator_output_status")
_FOUR_ACTIVE = 0b1111
_NO_OUTPUTS = (0.0,) * 28


def send_actuator_output_status(subject: Subject, node: Node, now_us: int) -> bool:
    """`active` is a bit per output and the outputs 0 to 1, as MAVLink has it; PX4 sends their number and PWM."""
    node.send(_ACTUATOR_OUTPUT_STATUS, now_us, _FOUR_ACTIVE, (*subject.outputs, *_NO_OUTPUTS))
    return True


_RPM_PER_RAD_S = 30.0 / pi
_RPM_LIMIT = 2**31 - 1
_ESC_STATUS = _pack("esc_status")


def send_esc_status(subject: Subject, node: Node, now_us: int) -> bool:
    battery, speeds, armed = subject.battery, subject.truth[13:17], subject.commander.armed
    volts = battery.voltage_v
    node.send(
        _ESC_STATUS, 0, now_us,
        [whole(speed * _RPM_PER_RAD_S, -_RPM_LIMIT, _RPM_LIMIT) for speed in speeds],
        (volts, volts, volts, volts),
        [battery.power_w(speed) / volts if armed and volts > 0.0 else 0.0 for speed in speeds],
    )  # fmt: skip
    return True


_ESC_INFO = _pack("esc_info")
_ESC_PERIOD_US = 100_000
_NO_TEMPERATURES = (INT16_MAX,) * 4


def send_esc_info(subject: Subject, node: Node, now_us: int) -> bool:
    """Four speed controllers that report ten times a second unless they fail; no temperature sensor."""
    online = _FOUR_ACTIVE & ~subject.silent_escs
    node.send(
        _ESC_INFO, 0, now_us, now_us // _ESC_PERIOD_US & UINT16_MAX, 4, 0, online,
        (0, 0, 0, 0), (0, 0, 0, 0), _NO_TEMPERATURES,
    )  # fmt: skip
    return True


_ATTITUDE_TARGET = _pack("attitude_target")
_ATTITUDE_IGNORE: int = mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
_RATE_IGNORES = (
    mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE,
    mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE,
    mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_YAW_RATE_IGNORE,
)


def send_attitude_target(subject: Subject, node: Node, now_us: int) -> bool:
    """What the loops follow now. What they do not follow is in `type_mask`, where PX4 always says 0."""
    target = subject.attitude_target
    if target is None:
        return False
    p, q, r = flip_vector(*target.omega_flu_rad_s)
    mask = 0
    if p != p:
        mask, p = _RATE_IGNORES[0], 0.0
    if q != q:
        mask, q = mask | _RATE_IGNORES[1], 0.0
    if r != r:
        mask, r = mask | _RATE_IGNORES[2], 0.0
    if target.attitude is None:
        mask |= _ATTITUDE_IGNORE
        attitude: Quaternion = (1.0, 0.0, 0.0, 0.0)
    else:
        attitude = flip_quaternion(*target.attitude)
    node.send(_ATTITUDE_TARGET, boot_ms(now_us), mask, attitude, p, q, r, target.thrust)
    return True


_POSITION_TARGET_LOCAL_NED = _pack("position_target_local_ned")
_POSITION_TARGET_GLOBAL_INT = _pack("position_target_global_int")
_TARGET_IGNORES = (1, 2, 4, 8, 16, 32, 64, 128, 256, 1024, 2048)
"""POSITION_TARGET_TYPEMASK of x, y, z, vx, vy, vz, ax, ay, az, yaw, yaw rate."""
_NO_HORIZONTAL = 1 | 2
_GLOBAL_INT: int = mavlink.MAV_FRAME_GLOBAL_INT


def _ned_target(target: PositionSetpoint) -> tuple[tuple[float, ...], int]:
    """The eleven numbers in NED and their type mask."""
    x, y, z = target.position_nwu_m
    vx, vy, vz = target.velocity_nwu_m_s
    ax, ay, az = target.acceleration_nwu_m_s2
    values = (x, -y, -z, vx, -vy, -vz, ax, -ay, -az, -target.yaw_rad, -target.yaw_rate_rad_s)
    return values, sum(bit for value, bit in zip(values, _TARGET_IGNORES, strict=True) if value != value)


def send_position_target_local_ned(subject: Subject, node: Node, now_us: int) -> bool:
    """What is not asked is NaN and masked, as on PX4."""
    target = subject.position_target
    if target is None:
        return False
    values, mask = _ned_target(target)
    node.send(_POSITION_TARGET_LOCAL_NED, boot_ms(now_us), _LOCAL_NED, mask, *values)
    return True


def send_position_target_global_int(subject: Subject, node: Node, now_us: int) -> bool:
    """Altitude above mean sea level; latitude and longitude 0 and masked where no position is held."""
    target, origin = subject.position_target, subject.origin
    if target is None:
        return False
    values, mask = _ned_target(target)
    lat, lon = origin.to_global(values[0], -values[1])
    if mask & _NO_HORIZONTAL:
        mask |= _NO_HORIZONTAL
    node.send(
        _POSITION_TARGET_GLOBAL_INT, boot_ms(now_us), _GLOBAL_INT, mask, deg_e7(lat), deg_e7(lon),
        origin.altitude_amsl_m - values[2], *values[3:],
    )  # fmt: skip
    return True


# --- the simulator's own ---------------------------------------------------------------------------------------------

_HIL_STATE_QUATERNION = _pack("hil_state_quaternion")


def send_hil_state_quaternion(subject: Subject, node: Node, now_us: int) -> bool:
    """The truth, for viewers: airspeed against the true wind, specific force in mG."""
    x, origin = subject.truth, subject.origin
    lat, lon = origin.to_global(x[0], x[1])
    wx, wy, wz = subject.true_wind
    airspeed = centimetres_per_s_unsigned(hypot(x[3] - wx, x[4] - wy, x[5] - wz))
    ax, ay, az = subject.specific_force_flu_m_s2
    node.send(
        _HIL_STATE_QUATERNION, now_us, (x[6], x[7], -x[8], -x[9]), x[10], -x[11], -x[12],
        deg_e7(lat), deg_e7(lon), millimetres(origin.altitude_amsl_m + x[2]),
        centimetres_per_s(x[3]), centimetres_per_s(-x[4]), centimetres_per_s(-x[5]), airspeed, airspeed,
        milli_g(ax), milli_g(-ay), milli_g(-az),
    )  # fmt: skip
    return True


_DEBUG_VECT = _pack("debug_vect")


def send_true_wind(subject: Subject, node: Node, now_us: int) -> bool:
    """DEBUG_VECT "WIND_TRUE": the simulator's own wind, NED m/s. No real vehicle has it; sent only on request."""
    x, y, z = subject.true_wind
    node.send(_DEBUG_VECT, b"WIND_TRUE", now_us, x, -y, -z)
    return True


# --- the table -------------------------------------------------------------------------------------------------------


class Stream(NamedTuple):
    """One row. Rates in Hz, 0: only on request. PX4's are those of PX4 SITL 1.17's two links."""

    name: str
    send: Sampler
    gcs_hz: float
    """Default on the ground-station link."""
    offboard_hz: float
    """Default on the off-board link."""
    px4_gcs_hz: float
    px4_offboard_hz: float
    note: str = ""
    send_index: IndexedSampler | None = None
    """For messages of which REQUEST_MESSAGE's param2 names one."""

    @property
    def message_id(self) -> int:
        return int(getattr(mavlink, f"MAVLINK_MSG_ID_{self.name}"))


def _in_dialect(name: str) -> bool:
    return hasattr(mavlink, f"MAVLINK_MSG_ID_{name}")


STREAMS: tuple[Stream, ...] = tuple(
    stream
    for stream in (
        Stream("HEARTBEAT", send_heartbeat, 1, 1, 1, 1, "also at once when mode, arming or fail-safe change"),
        Stream("ATTITUDE", send_attitude, 20, 100, 50, 100),
        Stream("ATTITUDE_QUATERNION", send_attitude_quaternion, 10, 50, 50, 50),
        Stream("LOCAL_POSITION_NED", send_local_position_ned, 10, 30, 50, 30),
        Stream("ODOMETRY", send_odometry, ON_REQUEST, 30, 0, 30),
        Stream("GLOBAL_POSITION_INT", send_global_position_int, 10, 50, 50, 50),
        Stream("HIGHRES_IMU", send_highres_imu, ON_REQUEST, 50, 0, 50, "magnetic field of an axial dipole"),
        Stream("GPS_RAW_INT", send_gps_raw_int, 5, 8, 5, 8, "PX4: as the receiver measures, 8 Hz"),
        Stream("ATTITUDE_TARGET", send_attitude_target, 5, 10, 50, 10, "type_mask says what is followed; PX4: 0"),
        Stream("POSITION_TARGET_LOCAL_NED", send_position_target_local_ned, 5, 10, 50, 10, "while position is held"),
        Stream("POSITION_TARGET_GLOBAL_INT", send_position_target_global_int, 1, 10, 1, 10, "while position is held"),
        Stream("VFR_HUD", send_vfr_hud, 4, 10, 4, 10, "airspeed 0 without a sensor; PX4: NaN"),
        Stream("ALTITUDE", send_altitude, 2, 10, 1, 10),
        Stream("SERVO_OUTPUT_RAW", send_servo_output_raw, 2, 10, 50, 10, "rotor 1 rear, 2 right, 3 front, 4 left"),
        Stream("ESC_STATUS", send_esc_status, 1, 10, 1, 10),
        Stream("ESC_INFO", send_esc_info, 1, 10, 1, 10),
        Stream("WIND_COV", send_wind_cov, 1, 10, 0.5, 10, "where the wind is estimated"),
        Stream("RC_CHANNELS", send_rc_channels, 5, 20, 20, 20, "while MANUAL_CONTROL comes; PX4: of a radio"),
        Stream("SYS_STATUS", send_sys_status, 1, 5, 1, 5),
        Stream("EXTENDED_SYS_STATE", send_extended_sys_state, 1, 5, 1, 5, "also at once on change"),
        Stream("SYSTEM_TIME", send_system_time, 1, 1, 0, 1),
        Stream("HOME_POSITION", send_home_position, 1, 1, 0.5, 0.5, "once home is set"),
        Stream("GPS_GLOBAL_ORIGIN", send_gps_global_origin, 1, 1, 1, 1),
        Stream("ESTIMATOR_STATUS", send_estimator_status, 0.5, 1, 0.5, 1, "without a filter: ratios 0"),
        Stream("SCALED_PRESSURE", send_scaled_pressure, 1, 1, 1, 1, "standard atmosphere"),
        Stream("MISSION_CURRENT", send_mission_current, ON_REQUEST, ON_REQUEST, 1, 1),
        Stream("BATTERY_STATUS", send_battery_status, 0.5, 0.5, 0.5, 0.5),
        Stream("CURRENT_MODE", send_current_mode, 0.5, 0.5, 0.5, 0.5),
        Stream("VIBRATION", send_vibration, 0.1, 0.5, 0.1, 0.5, "always 0"),
        Stream("HIL_STATE_QUATERNION", send_hil_state_quaternion, ON_REQUEST, ON_REQUEST, 0, 0, "the truth"),
        Stream(
            "ACTUATOR_OUTPUT_STATUS", send_actuator_output_status, ON_REQUEST, ON_REQUEST, 0, 0,
            "MAVLink's units: a bit per active output, 0 to 1; PX4: their number, PWM",
        ),
        Stream("AVAILABLE_MODES_MONITOR", send_available_modes_monitor, ON_REQUEST, ON_REQUEST, 0, 0, "never changes"),
        Stream(
            "AVAILABLE_MODES", send_available_modes, ON_REQUEST, ON_REQUEST, 0, 0, "param2: the mode, 0 all",
            send_available_modes,
        ),
        Stream("AUTOPILOT_VERSION", send_autopilot_version, ON_REQUEST, ON_REQUEST, 0, 0, "speaks as PX4 1.17.0"),
        Stream("PROTOCOL_VERSION", send_protocol_version, ON_REQUEST, ON_REQUEST, 0, 0),
        Stream("COMPONENT_METADATA", send_component_metadata, ON_REQUEST, ON_REQUEST, 0, 0),
        Stream("FLIGHT_INFORMATION", send_flight_information, ON_REQUEST, ON_REQUEST, 0, 0),
        Stream("DEBUG_VECT", send_true_wind, ON_REQUEST, ON_REQUEST, 1, 10, "WIND_TRUE, the simulator's own wind, NED"),
    )
    if _in_dialect(stream.name)
)  # fmt: skip
"""Every message that can be streamed or requested, as far as the dialect has it, the most urgent first.

PX4's rate of a message that it sends only when it has news is the most it sends.
"""

BY_ID = {stream.message_id: stream for stream in STREAMS}


def request(subject: Subject, node: Node, message_id: int, index: int, now_us: int) -> bool:
    """REQUEST_MESSAGE: send it once, `index` being param2. False: not served, no such index, or nothing to say now."""
    stream = BY_ID.get(message_id)
    if stream is None:
        return False
    try:
        if stream.send_index is not None:
            return stream.send_index(subject, node, now_us, index)
        return stream.send(subject, node, now_us)
    except EncodeError:
        return False


# --- schedules -------------------------------------------------------------------------------------------------------

Profile: TypeAlias = Literal["gcs", "offboard", "lockstep"]

_LOCKSTEP_HZ = {
    "HEARTBEAT": 1, "SYS_STATUS": 5, "EXTENDED_SYS_STATE": 5, "ATTITUDE": 10, "ATTITUDE_QUATERNION": 10,
    "LOCAL_POSITION_NED": 10, "ODOMETRY": 30,
}  # fmt: skip
"""What a lock-step peer flies by: each further message would cost every simulated second."""

STAGGER_US = 250_000
"""By when every stream has begun."""
_AT_ONCE = ("HEARTBEAT", "SYS_STATUS")
"""What a client waits for: that the vehicle is there, and that it is ready to arm."""
GOLDEN = 0.618_033_988_749_895
"""Multiples of it, modulo 1, fill an interval evenly however many there are."""

_FOREVER = (2**63, -1, 1, send_heartbeat)
"""Ends the queue, so that it is never empty."""


class Schedule:
    """When each stream of one link is due. Intervals in microseconds; 0 is off.

    Every stream keeps to its own grid of due times, which does not drift with the ticks it is sent in; a stream that
    fell behind sends once and waits for the next point of its grid. The grids of the default streams begin staggered.

    Attributes:
        due_us: when the first of them is.
        unsendable: messages left out because a value did not fit the wire (beyond what a float32 holds).
    """

    def __init__(self, profile: Profile = "lockstep", *, start_us: int = 0, most_hz: float | None = None) -> None:
        """`start_us`: when the link opens. `most_hz`: default streams are no faster, and begin together then."""
        self._profile: Profile = profile
        self._most_hz = inf if most_hz is None else most_hz
        self._streams = STREAMS
        self._interval = {stream.message_id: self.default_us(stream.message_id) for stream in self._streams}
        self._queue: list[tuple[int, int, int, Sampler]] = [_FOREVER]
        self.unsendable = 0
        for order, stream in enumerate(self._streams):
            interval_us = self._interval[stream.message_id]
            if interval_us != NEVER:
                at_once = profile == "lockstep" or most_hz is not None or stream.name in _AT_ONCE
                share = 0.0 if at_once else order * GOLDEN % 1.0
                due_us = start_us + int(share * min(interval_us, STAGGER_US))
                self._queue.append((due_us, order, interval_us, stream.send))
        heapify(self._queue)
        self.due_us = self._queue[0][0]

    def default_us(self, message_id: int) -> int:
        """The profile's interval of a message that is served. Raises `KeyError` for others."""
        stream = BY_ID[message_id]
        match self._profile:
            case "gcs":
                hz = stream.gcs_hz
            case "offboard":
                hz = stream.offboard_hz
            case "lockstep":
                hz = _LOCKSTEP_HZ.get(stream.name, NEVER)
        hz = min(hz, self._most_hz)
        return round(HZ / hz) if hz else NEVER

    def interval_us(self, message_id: int) -> int:
        """The interval in force of a message that is served. Raises `KeyError` for others."""
        return self._interval[message_id]

    def set_interval(self, message_id: int, interval_us: int, now_us: int) -> None:
        """Stream a message that is served from now on, or stop it with `NEVER`. Raises `KeyError` for others."""
        order = next(order for order, stream in enumerate(self._streams) if stream.message_id == message_id)
        self._interval[message_id] = interval_us
        self._queue = [entry for entry in self._queue if entry[1] != order]
        if interval_us != NEVER:
            self._queue.append((now_us, order, interval_us, self._streams[order].send))
        heapify(self._queue)
        self.due_us = self._queue[0][0]

    def run(self, subject: Subject, node: Node, now_us: int) -> None:
        """Send what is due."""
        queue = self._queue
        while queue[0][0] <= now_us:
            due_us, order, interval_us, send = queue[0]
            due_us += interval_us
            if due_us <= now_us:
                due_us += ((now_us - due_us) // interval_us + 1) * interval_us
            heapreplace(queue, (due_us, order, interval_us, send))
            try:
                send(subject, node, now_us)
            except EncodeError:
                self.unsendable += 1
        self.due_us = queue[0][0]
