"""The ULog topics that the vehicle and the ground write: one table, one row layout each.

Topics with a PX4 name keep PX4's field names and its frames, NED and FRD, and of its fields those that are known here.
`control_demand`, `pidnn_weights`, `rotor_status`, `injected_failure` and `link_status` have no counterpart in PX4; they
keep the paper's frame, NWU and FLU. docs/reference/logs.md is made from this module.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
import numpy.typing as npt

# ULog type: (struct code, numpy type), little-endian.
_TYPES: dict[str, tuple[str, str]] = {
    "float": ("f", "<f4"),
    "double": ("d", "<f8"),
    "uint8_t": ("B", "u1"),
    "uint16_t": ("H", "<u2"),
    "uint32_t": ("I", "<u4"),
    "uint64_t": ("Q", "<u8"),
    "int32_t": ("i", "<i4"),
}
_FIELD = re.compile(r"(?P<type>[a-z0-9_]+?)(?:\[(?P<count>[1-9][0-9]*)\])? (?P<name>[a-z][a-z0-9_]*)")

DATA_MESSAGE = ord("D")

EVERY, CHANGE, SECOND = "every period", "at a change", "1 Hz"
"""Rates of topics."""


@dataclass(frozen=True)
class Topic:
    """One ULog topic. `fields` are ULog declarations, e.g. ``"float[4] q"``; ``uint64_t timestamp`` (us) leads.

    Topics of one name with the same fields are told apart by their `instance`, ULog's multi id.

    Raises ValueError for a declaration that is not one of the types above.
    """

    name: str
    fields: tuple[str, ...]
    instance: int = 0
    text: str = field(default="", compare=False)
    """For the docs: what a row says, where names and frames do not."""
    rate: str = field(default=EVERY, compare=False)
    """For the docs: when there is a row."""

    @cached_property
    def key(self) -> str:
        """Its name in tables of topics: ``name``, ``name.1``, ..."""
        return f"{self.name}.{self.instance}" if self.instance else self.name

    def __post_init__(self) -> None:
        for declaration in self.fields:
            _parse(self.name, declaration)

    @cached_property
    def columns(self) -> tuple[tuple[str, str, int | None], ...]:
        """(name, ULog type, array length or None for a scalar), timestamp first."""
        return (("timestamp", "uint64_t", None), *(_parse(self.name, each) for each in self.fields))

    @cached_property
    def ulog_format(self) -> str:
        """The body of the ULog format message."""
        return f"{self.name}:uint64_t timestamp;" + "".join(f"{each};" for each in self.fields)

    @cached_property
    def message(self) -> struct.Struct:
        """A whole ULog data message: size, type, message id, timestamp, then the fields flat."""
        return struct.Struct("<HBH" + "".join(_TYPES[kind][0] * (count or 1) for _, kind, count in self.columns))

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """The same data message as a packed numpy structure."""
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = [("ulog_header", "V5")]
        for name, kind, count in self.columns:
            code = _TYPES[kind][1]
            fields.append((name, code) if count is None else (name, code, (count,)))
        return np.dtype(fields)

    @cached_property
    def _runs(self) -> tuple[tuple[str, str, int], ...]:
        """Neighbours of one type as one array, after the timestamp: (name, numpy type, width)."""
        kinds = [kind for _, kind, count in self.columns[1:] for _ in range(count or 1)]
        groups = enumerate(groupby(kinds))
        return tuple((f"run{number}", _TYPES[kind][1], len(list(group))) for number, (kind, group) in groups)

    @cached_property
    def _packed(self) -> np.dtype[Any]:
        """`dtype`'s bytes, by runs: a row is filled with fewer calls."""
        return np.dtype([("ulog_header", "V5"), ("timestamp", "<u8"), *((n, t, (w,)) for n, t, w in self._runs)])

    def header(self, message_id: int) -> np.void:
        """What a row begins with."""
        return np.void(struct.pack("<HBH", self.dtype.itemsize - 3, DATA_MESSAGE, message_id))

    def pack_into(
        self,
        buffer: bytearray,
        offset: int,
        header: np.void,
        timestamps_us: npt.NDArray[np.uint64],
        values: npt.NDArray[np.float64],
    ) -> None:
        """k ULog data messages: `timestamps_us` (k,), `values` (k, fields flat).

        Beyond float32's range is infinite; numpy warns of it unless the caller has it ignore overflows, which is not
        done here because it costs as much as a topic.
        """
        if values.shape[1] != self._width:
            raise ValueError(f"{self.name}: {values.shape[1]} values a row, it has {self._width}")
        rows = np.frombuffer(buffer, self._packed, len(timestamps_us), offset)
        rows["ulog_header"] = header
        rows["timestamp"] = timestamps_us
        at = 0
        for name, _, width in self._runs:
            rows[name] = values[:, at : at + width]
            at += width

    @cached_property
    def _width(self) -> int:
        return sum(width for _, _, width in self._runs)

    def arrays(self, buffer: bytes | bytearray | memoryview, count: int) -> dict[str, npt.NDArray[Any]]:
        """The first `count` rows of `buffer`, copied: scalars (count,), arrays (count, length)."""
        rows = np.frombuffer(buffer, self.dtype, count)
        return {name: rows[name].copy() for name, _, _ in self.columns}


def _parse(topic: str, field: str) -> tuple[str, str, int | None]:
    match = _FIELD.fullmatch(field)
    if match is None or match["type"] not in _TYPES:
        raise ValueError(
            f"{topic}: {field!r} is not '<type> <name>' or '<type>[n] <name>' with a type of {', '.join(_TYPES)}"
        )
    return match["name"], match["type"], int(match["count"]) if match["count"] else None


_POSITION = ("float x", "float y", "float z", "float vx", "float vy", "float vz")
_ATTITUDE = ("float[4] q",)
_RATE = ("float[3] xyz",)
_GLOBAL = ("double lat", "double lon", "float alt")

# Vehicle: what is, and what it takes for that
LOCAL_POSITION_TRUTH = Topic("vehicle_local_position_groundtruth", _POSITION)
ATTITUDE_TRUTH = Topic("vehicle_attitude_groundtruth", _ATTITUDE)
ANGULAR_VELOCITY_TRUTH = Topic("vehicle_angular_velocity_groundtruth", _RATE)
GLOBAL_POSITION_TRUTH = Topic("vehicle_global_position_groundtruth", _GLOBAL, rate="5 Hz")
LOCAL_POSITION = Topic(
    "vehicle_local_position",
    (*_POSITION, "uint8_t xy_valid", "uint8_t z_valid", "uint8_t v_xy_valid", "uint8_t v_z_valid"),
    text="What is not valid is not flown by.",
)
ATTITUDE = Topic("vehicle_attitude", _ATTITUDE)
ANGULAR_VELOCITY = Topic("vehicle_angular_velocity", _RATE)
GLOBAL_POSITION = Topic(
    "vehicle_global_position", (*_GLOBAL, "uint8_t lat_lon_valid", "uint8_t alt_valid"), rate="5 Hz"
)
WIND_TRUTH = Topic("wind_groundtruth", ("float windspeed_north", "float windspeed_east", "float windspeed_down"))
WIND = Topic(
    "wind",
    ("float windspeed_north", "float windspeed_east", "float variance_north", "float variance_east"),
    text="As estimated in flight; not in lock-step.",
    rate=SECOND,
)
CPULOAD = Topic(
    "cpuload",
    ("float load", "float ram_usage"),
    text="Share of a processor that the process takes; memory is not measured (NaN). Not in lock-step.",
    rate=SECOND,
)

# Vehicle: what is wanted
LOCAL_POSITION_SETPOINT = Topic(
    "vehicle_local_position_setpoint",
    (*_POSITION, "float[3] acceleration", "float yaw", "float yawspeed"),
    text="What the position control aboard follows, while it flies; NaN where it is free.",
    rate="10 Hz",
)
RATES_SETPOINT = Topic(
    "vehicle_rates_setpoint",
    ("float roll", "float pitch", "float yaw", "float[3] thrust_body"),
    text="While a rate loop flies.",
)
RATE_STATUS = Topic(
    "rate_ctrl_status",
    ("float rollspeed_integ", "float pitchspeed_integ", "float yawspeed_integ"),
    text="Integrals of the rate loop, shares of the largest torque.",
    rate="50 Hz",
)
TORQUE_SETPOINT = Topic(
    "vehicle_torque_setpoint",
    _RATE,
    text="Shares of the largest torque, before allocation; while the rotors turn.",
    rate="125 Hz",
)
THRUST_SETPOINT = Topic(
    "vehicle_thrust_setpoint", _RATE, text="(0, 0, -thrust), 0 to 1; while the rotors turn.", rate="125 Hz"
)
ACTUATOR_MOTORS = Topic(
    "actuator_motors", ("float[4] control",), text="Commanded rotor speed / largest rotor speed, by allocation."
)
ROTOR_STATUS = Topic(
    "rotor_status",
    ("float[4] speed_rad_s", "uint8_t saturated"),
    text="Speeds as they are; `saturated` is not 0 where allocation was at a limit.",
)

# Vehicle: states
VEHICLE_STATUS = Topic(
    "vehicle_status",
    (
        "uint8_t arming_state", "uint8_t nav_state", "uint8_t failsafe", "uint8_t nav_state_user_intention",
        "uint8_t failsafe_and_user_took_over", "uint8_t vehicle_type", "uint8_t system_type", "uint8_t system_id",
        "uint8_t component_id",
    ),
    text="PX4's numbers.",
    rate=CHANGE,
)  # fmt: skip
DISARMED, ARMED = 1, 2
"""Of arming_state."""
ROTARY_WING = 1
"""Of vehicle_type."""
LAND_DETECTED = Topic(
    "vehicle_land_detected",
    ("uint8_t landed", "uint8_t ground_contact"),
    text="The first row with `landed` 0 is the release.",
    rate=CHANGE,
)
FAILSAFE_FLAGS = Topic(
    "failsafe_flags",
    (
        "uint8_t attitude_invalid", "uint8_t local_altitude_invalid", "uint8_t local_position_invalid",
        "uint8_t local_velocity_invalid", "uint8_t global_position_invalid", "uint8_t auto_mission_missing",
        "uint8_t offboard_control_signal_lost", "uint8_t home_position_invalid", "uint8_t manual_control_signal_lost",
        "uint8_t gcs_connection_lost", "uint8_t battery_warning", "uint8_t geofence_breached",
        "uint8_t mission_failure", "uint8_t fd_motor_failure",
    ),
    text="Causes, whether or not the mode minds them.",
    rate="at a change, seen within 0.5 s",
)  # fmt: skip
HOME_POSITION = Topic(
    "home_position",
    ("double lat", "double lon", "float alt", "float x", "float y", "float z", "float yaw"),
    rate="at a change, seen within 0.5 s",
)
BATTERY_STATUS = Topic(
    "battery_status",
    (
        "float voltage_v", "float current_a", "float discharged_mah", "float remaining", "float time_remaining_s",
        "uint8_t connected", "uint8_t cell_count", "uint8_t warning", "uint16_t capacity",
    ),
    rate="2 Hz",
)  # fmt: skip
MANUAL_CONTROL = Topic(
    "manual_control_setpoint",
    (
        "float roll", "float pitch", "float yaw", "float throttle", "float aux1", "float aux2", "uint8_t valid",
        "uint8_t data_source", "uint8_t sticks_moving",
    ),
    text="Of MANUAL_CONTROL while it comes. The throttle is -1 to 1; no auxiliary channel is read, they are NaN.",
    rate="10 Hz",
)  # fmt: skip
MANUAL_FROM_MAVLINK = 2
"""Of data_source."""
COMMAND = Topic(
    "vehicle_command",
    (
        "float param1", "float param2", "float param3", "float param4", "double param5", "double param6",
        "float param7", "uint32_t command", "uint8_t source_system", "uint16_t source_component",
        "uint8_t from_external",
    ),
    text="As sent: COMMAND_INT's coordinates are in 1e-7 degrees. A repetition is not executed, and has no row.",
    rate="each",
)  # fmt: skip
COMMAND_ACK = Topic(
    "vehicle_command_ack",
    ("uint32_t command", "uint8_t result", "uint8_t target_system", "uint16_t target_component"),
    text="`result` is a MAV_RESULT.",
    rate="each",
)
INJECTED_FAILURE = Topic(
    "injected_failure",
    ("uint8_t unit", "uint8_t instance", "uint8_t type", "float value"),
    text="FAILURE_UNIT, the instance from 1, FAILURE_TYPE, and its size or NaN.",
    rate=CHANGE,
)

TELEMETRY_STATUS = tuple(
    Topic(
        "telemetry_status",
        (
            "uint32_t rx_message_count", "uint32_t rx_message_lost_count", "uint32_t rx_parse_errors",
            "uint32_t rx_packet_drop_count", "uint32_t bad_crc", "uint32_t bad_length", "uint32_t unknown_id",
            "uint32_t incompatible", "uint32_t unsupported",
        ),
        instance,
        text="The ports in order: off-board, ground stations over UDP, over TCP. Counts since the start.",
        rate=SECOND,
    )
    for instance in range(3)
)  # fmt: skip
"""The vehicle's ports in order (off-board, ground stations over UDP, over TCP), once a second. Counts since the start:
good frames; those missing by their sequence numbers; what looked like a frame and was none, which the last but one are
the kinds of; datagrams of which a part or all was not looked at; good frames that nobody here handles. The first four
have PX4's names."""

_CHANNEL = (
    "uint32_t sent", "uint32_t delivered", "uint32_t lost", "uint32_t outage", "uint32_t queue_drops",
    "uint32_t corrupted", "uint32_t duplicated", "uint32_t reordered", "uint32_t late",
    "float delay_p50_ms", "float delay_p99_ms", "float delay_max_ms",
)  # fmt: skip
CHANNELS = {
    place: {
        direction: Topic(
            f"{place}_{direction}",
            _CHANNEL,
            text="An impaired link's direction: messages since the start, delays of this second's.",
            rate=SECOND,
        )
        for direction in ("to_ground", "to_vehicle")
    }
    for place in ("link", "gcs_link", "tcp_link")
}
"""An impaired link's directions, once a second: counts of messages since the start, as in
`mavsitl.link.impaired.Statistics`, and the delays of those that came in that second."""

# Sensors and filter, where the vehicle has them: PX4's names, a row as each measures
MEASURED = "as it measures"
SENSOR_COMBINED = Topic(
    "sensor_combined",
    (
        "float[3] gyro_rad",
        "uint32_t gyro_integral_dt",
        "float[3] accelerometer_m_s2",
        "uint32_t accelerometer_integral_dt",
    ),
    text="Means over a control period. Of a vehicle with sensors.",
)
GPS_POSITION = Topic(
    "vehicle_gps_position",
    (
        "uint64_t timestamp_sample",
        "double latitude_deg",
        "double longitude_deg",
        "double altitude_msl_m",
        "float eph",
        "float epv",
        "float s_variance_m_s",
        "float vel_n_m_s",
        "float vel_e_m_s",
        "float vel_d_m_s",
        "uint8_t fix_type",
        "uint8_t satellites_used",
        "float hdop",
        "float vdop",
        "float vel_m_s",
        "uint64_t time_utc_usec",
    ),
    text="The receiver's; without sensors what GPS_RAW_INT says, at 2 Hz. `time_utc_usec` is 0 in lock-step.",
    rate=MEASURED,
)
AIR_DATA = Topic(
    "vehicle_air_data",
    ("uint64_t timestamp_sample", "float baro_alt_meter", "float baro_pressure_pa"),
    text="Of a vehicle with sensors.",
    rate=MEASURED,
)
MAGNETOMETER = Topic(
    "vehicle_magnetometer",
    ("uint64_t timestamp_sample", "float[3] magnetometer_ga"),
    text="Of a vehicle with sensors.",
    rate=MEASURED,
)
ESTIMATOR_STATUS = Topic(
    "estimator_status",
    (
        "float pos_horiz_accuracy",
        "float pos_vert_accuracy",
        "float vel_test_ratio",
        "float pos_test_ratio",
        "float hgt_test_ratio",
        "float mag_test_ratio",
        "uint16_t solution_status_flags",
    ),
    text="Of a vehicle with sensors. `solution_status_flags`: MAVLink's ESTIMATOR_STATUS_FLAGS.",
    rate=CHANGE,
)
SENSOR_BIAS = Topic(
    "estimator_sensor_bias",
    ("float[3] gyro_bias", "float[3] accel_bias"),
    text="What the filter takes for the IMU's bias.",
    rate=CHANGE,
)

# Whichever end the nets are seated in
PIDNN_WEIGHTS = Topic(
    "pidnn_weights", ("float[3] roll", "float[3] pitch", "float[3] yaw"), text="Output weights P, I, D."
)

# Ground, and of the attitude the vehicle too
TRAJECTORY_SETPOINT = Topic(
    "trajectory_setpoint", ("float[3] position", "float[3] velocity", "float yaw"), text="The reference."
)
ATTITUDE_SETPOINT = Topic(
    "vehicle_attitude_setpoint",
    (
        "float roll_body", "float pitch_body", "float yaw_body", "float[3] thrust_body",
        "float[4] q_d", "float yaw_sp_move_rate",
    ),
    text="The vehicle's: what its attitude loop follows, while it flies. The ground's: the commanded angles, which the "
    "attitude RMSE is taken against.",
)  # fmt: skip
"""Angles in rad, Z-Y-X; thrust_body is FRD: (0, 0, -thrust)."""
CONTROL_DEMAND = Topic(
    "control_demand",
    ("float[4] u", "float[3] wind_acceleration"),
    text="U_1..U_4 (eq 12) in N, N, N, N m and W_1..W_3 in m/s^2.",
)
LINK_STATUS = Topic(
    "link_status",
    ("uint32_t received", "uint32_t lost", "uint32_t bad", "uint32_t state_age_us"),
    text="Counts since the start: frames received, lost by sequence number, and refused; age of the state used.",
)

MOST_LOGGED = 8
"""Numbers in a row of the next."""
OWN_CONTROLLER = Topic("own_controller", (f"float[{MOST_LOGGED}] value",))
"""What a controller of the user's own has logged, in its own terms; NaN where it has fewer."""

VEHICLE_TOPICS = (
    LOCAL_POSITION_TRUTH,
    ATTITUDE_TRUTH,
    ANGULAR_VELOCITY_TRUTH,
    LOCAL_POSITION,
    ATTITUDE,
    ANGULAR_VELOCITY,
    WIND_TRUTH,
    ACTUATOR_MOTORS,
    ROTOR_STATUS,
    RATES_SETPOINT,
    VEHICLE_STATUS,
    LAND_DETECTED,
    PIDNN_WEIGHTS,
    *TELEMETRY_STATUS,
    *(topic for directions in CHANNELS.values() for topic in directions.values()),
    INJECTED_FAILURE,
    SENSOR_COMBINED,
    GPS_POSITION,
    AIR_DATA,
    MAGNETOMETER,
    ESTIMATOR_STATUS,
    SENSOR_BIAS,
    ATTITUDE_SETPOINT,
    LOCAL_POSITION_SETPOINT,
    RATE_STATUS,
    TORQUE_SETPOINT,
    THRUST_SETPOINT,
    GLOBAL_POSITION,
    GLOBAL_POSITION_TRUTH,
    WIND,
    CPULOAD,
    BATTERY_STATUS,
    FAILSAFE_FLAGS,
    HOME_POSITION,
    MANUAL_CONTROL,
    COMMAND,
    COMMAND_ACK,
)
GROUND_TOPICS = (TRAJECTORY_SETPOINT, ATTITUDE_SETPOINT, CONTROL_DEMAND, PIDNN_WEIGHTS, LINK_STATUS, OWN_CONTROLLER)
TOPICS = tuple(dict.fromkeys(VEHICLE_TOPICS + GROUND_TOPICS))
