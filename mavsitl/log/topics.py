"""The ULog topics that the vehicle and the ground write: one table, one row layout each.

Topics with a PX4 name keep PX4's field names and its frames, NED and FRD. `control_demand`, `pidnn_weights`,
`rotor_status`, `injected_failure` and `link_status` have no counterpart in PX4; they keep the paper's frame, NWU and
FLU.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from functools import cached_property
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


@dataclass(frozen=True)
class Topic:
    """One ULog topic. `fields` are ULog declarations, e.g. ``"float[4] q"``; ``uint64_t timestamp`` (us) leads.

    Topics of one name with the same fields are told apart by their `instance`, ULog's multi id.

    Raises ValueError for a declaration that is not one of the types above.
    """

    name: str
    fields: tuple[str, ...]
    instance: int = 0

    @property
    def key(self) -> str:
        """Its name in tables of topics: ``name``, ``name.1``, ..."""
        return f"{self.name}.{self.instance}" if self.instance else self.name

    def __post_init__(self) -> None:
        for field in self.fields:
            _parse(self.name, field)

    @cached_property
    def columns(self) -> tuple[tuple[str, str, int | None], ...]:
        """(name, ULog type, array length or None for a scalar), timestamp first."""
        return (("timestamp", "uint64_t", None), *(_parse(self.name, field) for field in self.fields))

    @cached_property
    def ulog_format(self) -> str:
        """The body of the ULog format message."""
        return f"{self.name}:uint64_t timestamp;" + "".join(f"{field};" for field in self.fields)

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

    def pack(self, message_id: int, timestamps_us: npt.NDArray[np.uint64], values: npt.NDArray[np.float64]) -> bytes:
        """k ULog data messages: `timestamps_us` (k,), `values` (k, fields flat). Beyond float32's range is infinite."""
        rows = np.empty(len(timestamps_us), self.dtype)
        rows["ulog_header"] = np.void(struct.pack("<HBH", self.dtype.itemsize - 3, DATA_MESSAGE, message_id))
        rows["timestamp"] = timestamps_us
        at = 0
        with np.errstate(over="ignore"):
            for name, _, count in self.columns[1:]:
                width = count or 1
                part = values[:, at : at + width]
                rows[name] = part if count is not None else part[:, 0]
                at += width
        if at != values.shape[1]:
            raise ValueError(f"{self.name}: {values.shape[1]} values a row, it has {at}")
        return rows.tobytes()

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

# Vehicle
LOCAL_POSITION_TRUTH = Topic("vehicle_local_position_groundtruth", _POSITION)
ATTITUDE_TRUTH = Topic("vehicle_attitude_groundtruth", _ATTITUDE)
ANGULAR_VELOCITY_TRUTH = Topic("vehicle_angular_velocity_groundtruth", _RATE)
LOCAL_POSITION = Topic("vehicle_local_position", _POSITION)
ATTITUDE = Topic("vehicle_attitude", _ATTITUDE)
ANGULAR_VELOCITY = Topic("vehicle_angular_velocity", _RATE)
WIND_TRUTH = Topic("wind_groundtruth", ("float windspeed_north", "float windspeed_east", "float windspeed_down"))
ACTUATOR_MOTORS = Topic("actuator_motors", ("float[4] control",))
"""Rotor speed / largest rotor speed."""
ROTOR_STATUS = Topic("rotor_status", ("float[4] speed_rad_s", "uint8_t saturated"))
RATES_SETPOINT = Topic("vehicle_rates_setpoint", ("float roll", "float pitch", "float yaw", "float[3] thrust_body"))
VEHICLE_STATUS = Topic("vehicle_status", ("uint8_t arming_state", "uint8_t nav_state", "uint8_t failsafe"))
DISARMED, ARMED = 1, 2
"""Of arming_state."""
LAND_DETECTED = Topic("vehicle_land_detected", ("uint8_t landed", "uint8_t ground_contact"))
"""Written at every change; the first row with landed = 0 is the release."""
INJECTED_FAILURE = Topic("injected_failure", ("uint8_t unit", "uint8_t instance", "uint8_t type", "float value"))
"""Written at every change: FAILURE_UNIT, the instance from 1, FAILURE_TYPE, and its size or NaN."""

TELEMETRY_STATUS = tuple(
    Topic(
        "telemetry_status",
        (
            "uint32_t rx_message_count", "uint32_t rx_message_lost_count", "uint32_t rx_parse_errors",
            "uint32_t rx_packet_drop_count", "uint32_t bad_crc", "uint32_t bad_length", "uint32_t unknown_id",
            "uint32_t incompatible", "uint32_t unsupported",
        ),
        instance,
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
    place: {direction: Topic(f"{place}_{direction}", _CHANNEL) for direction in ("to_ground", "to_vehicle")}
    for place in ("link", "gcs_link", "tcp_link")
}
"""An impaired link's directions, once a second: counts of messages since the start, as in
`mavsitl.link.impaired.Statistics`, and the delays of those that came in that second."""

# Sensors and filter, where the vehicle has them: PX4's names, a row as each measures
SENSOR_COMBINED = Topic(
    "sensor_combined",
    (
        "float[3] gyro_rad",
        "uint32_t gyro_integral_dt",
        "float[3] accelerometer_m_s2",
        "uint32_t accelerometer_integral_dt",
    ),
)
"""Means over a control period."""
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
    ),
)
AIR_DATA = Topic("vehicle_air_data", ("uint64_t timestamp_sample", "float baro_alt_meter", "float baro_pressure_pa"))
MAGNETOMETER = Topic("vehicle_magnetometer", ("uint64_t timestamp_sample", "float[3] magnetometer_ga"))
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
)
"""solution_status_flags: MAVLink's ESTIMATOR_STATUS_FLAGS."""
SENSOR_BIAS = Topic("estimator_sensor_bias", ("float[3] gyro_bias", "float[3] accel_bias"))
"""What the filter takes for the IMU's bias."""

# Whichever end the nets are seated in
PIDNN_WEIGHTS = Topic("pidnn_weights", ("float[3] roll", "float[3] pitch", "float[3] yaw"))
"""Output weights P, I, D."""

# Ground
TRAJECTORY_SETPOINT = Topic("trajectory_setpoint", ("float[3] position", "float[3] velocity", "float yaw"))
ATTITUDE_SETPOINT = Topic(
    "vehicle_attitude_setpoint", ("float roll_body", "float pitch_body", "float yaw_body", "float[3] thrust_body")
)
"""The commanded angles, rad: what the attitude RMSE is taken against. thrust_body is FRD: (0, 0, -thrust)."""
CONTROL_DEMAND = Topic("control_demand", ("float[4] u", "float[3] wind_acceleration"))
"""U_1..U_4 (eq 12) in N, N, N, N m and W_1..W_3 in m/s^2, NWU."""
LINK_STATUS = Topic("link_status", ("uint32_t received", "uint32_t lost", "uint32_t bad", "uint32_t state_age_us"))
"""Counts since the start: frames received, lost by sequence number, and refused; age of the state used, us."""

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
)
GROUND_TOPICS = (TRAJECTORY_SETPOINT, ATTITUDE_SETPOINT, CONTROL_DEMAND, PIDNN_WEIGHTS, LINK_STATUS, OWN_CONTROLLER)
TOPICS = tuple(dict.fromkeys(VEHICLE_TOPICS + GROUND_TOPICS))
