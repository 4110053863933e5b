"""What the page shows: named values of each vehicle, rows for the charts, texts; and what of it is new to a client.

Sans-IO. Positions are NED in metres, attitudes FRD -> NED quaternions, as on the wire; angles of rows are degrees.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from math import degrees, isfinite
from typing import Any, TypeAlias

from mavsitl import monitor
from mavsitl.codec import Message
from mavsitl.dialect import mavlink
from mavsitl.geodesy import Origin
from mavsitl.px4_modes import CUSTOM_MODES, NAV_STATES
from mavsitl.quaternion import to_euler

__all__ = [
    "COLUMNS",
    "MAX_TEXTS",
    "NAV_STATES",
    "ROWS",
    "ROW_INTERVAL_US",
    "WINDOW_S",
    "Model",
    "Row",
    "Seen",
    "Vehicle",
    "hear",
    "look",
    "mode_name",
    "put_link",
    "row_of",
    "shorten",
]

Value: TypeAlias = Any
"""What JSON has."""
Row: TypeAlias = list[float | None]

COLUMNS = (
    "time_s", "north_m", "east_m", "down_m", "north_wanted_m", "east_wanted_m", "down_wanted_m",
    "roll_deg", "pitch_deg", "yaw_deg", "roll_wanted_deg", "pitch_wanted_deg", "yaw_wanted_deg",
    *(f"{net}_{output}" for net in ("roll", "pitch", "yaw") for output in "pid"), "latency_ms", "loss_percent",
)  # fmt: skip
"""Of a row. The nets' weights are shares of what they start from."""

WINDOW_S = 60.0
ROW_INTERVAL_US = 50_000
ROWS = round(WINDOW_S * 1e6 / ROW_INTERVAL_US)
MAX_TEXTS = 200

SILENT_US = 3_000_000
"""A vehicle, or a ground, that has not been heard for so long is shown as gone: PX4's COM_DL_LOSS_T is longer."""
STALE_US = 1_000_000
"""A reference, or a wanted attitude, is shown for so long after it was told."""
RESTART_US = 1_000_000
"""A vehicle's clock that goes back by more has begun anew."""

SENSORS = {
    mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO: "gyro",
    mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL: "accelerometer",
    mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG: "magnetometer",
    mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE: "barometer",
    mavlink.MAV_SYS_STATUS_SENSOR_GPS: "GPS",
    mavlink.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS: "motors",
    mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER: "sticks",
    mavlink.MAV_SYS_STATUS_SENSOR_BATTERY: "battery",
    mavlink.MAV_SYS_STATUS_AHRS: "attitude estimate",
}
"""Bits of SYS_STATUS that are named on the page where they are enabled and unhealthy."""


class Loss:
    """The loss of a link over the last second, by its counts since the start."""

    def __init__(self) -> None:
        self.percent: float | None = None
        """None: not known yet."""
        self._before: tuple[int, float, float] | None = None

    def count(self, received: float, lost: float, now_us: int) -> None:
        before = self._before
        if before is not None and received >= before[1]:
            if now_us - before[0] < STALE_US:
                return
            came, went = received - before[1], max(lost - before[2], 0.0)
            self.percent = round(100.0 * went / (came + went), 1) if came + went > 0.0 else None
        self._before = now_us, received, lost


class Vehicle:
    """One vehicle as the page shows it.

    Attributes:
        values: by name, ready for JSON; what is not known is absent or None.
        rows: for the charts, the youngest last; as many as `WINDOW_S` holds.
        rows_made: rows since the beginning of `chapter`, those included that are not kept any more.
        chapter: another number each time that the rows begin anew: the vehicle restarted, a replay was moved.
    """

    def __init__(self, number: int, model: Model) -> None:
        self.number = number
        self.values: dict[str, Value] = {}
        self.changed: dict[str, int] = {}
        """The number of each value's last change, as `Model.change` gives them."""
        self.rows: deque[Row] = deque(maxlen=ROWS)
        self.rows_made = 0
        self.chapter = model.next_chapter()
        self.time_us = -1
        """Its clock, at the newest state."""
        self.heard_us: dict[str, int] = {}
        """When each kind of news came last, on the station's clock."""
        self.link = Loss()
        """Of its link to the ground, or to here."""
        self._model = model
        self._row_due_us = 0

    def put(self, name: str, value: Value) -> None:
        """Set a value; it is sent if it is another than before."""
        if self.values.get(name) != value or name not in self.values:
            self.values[name] = value
            self.changed[name] = self._model.change()

    def begin(self, rows: Iterable[Row] = ()) -> None:
        """Rows begin anew, with these."""
        self.rows.clear()
        self.rows_made = 0
        self.chapter = self._model.next_chapter()
        self._row_due_us = 0
        self.put("chapter", self.chapter)
        for row in rows:
            self.add(row)

    def add(self, row: Row) -> None:
        self.rows.append(row)
        self.rows_made += 1

    def rows_after(self, number: int) -> list[Row]:
        """Those made after the first `number`, as far as they are kept."""
        new = min(self.rows_made - number, len(self.rows))
        return list(islice(self.rows, len(self.rows) - new, None)) if new > 0 else []

    def at(self, time_us: int) -> None:
        """Its clock shows this. A clock that went back is another life: rows and what was known begin anew."""
        if time_us < self.time_us - RESTART_US:
            self.begin()
            self.heard_us.clear()
            for name in ("reference", "wanted", "truth", "weights", "wind"):
                self.put(name, None)
        elif time_us <= self.time_us:
            return
        self.time_us = time_us
        self.put("time_s", round(time_us * 1e-6, 2))
        if time_us >= self._row_due_us:
            self._row_due_us = max(self._row_due_us + ROW_INTERVAL_US, time_us + ROW_INTERVAL_US // 4)
            self.add(row_of(self.values))

    def fresh(self, kind: str, now_us: int, limit_us: int) -> bool:
        """Whether news of that kind came within `limit_us`."""
        heard_us = self.heard_us.get(kind)
        return heard_us is not None and now_us - heard_us <= limit_us


def row_of(values: dict[str, Value]) -> Row:
    """The charts' row of what is known now: see `COLUMNS`."""
    link = values.get("link") or {}
    return [
        values.get("time_s"), *(values.get("position") or _NOWHERE), *(values.get("reference") or _NOWHERE),
        *_angles(values.get("attitude")), *_angles(values.get("wanted")), *(values.get("weights") or _NO_WEIGHTS),
        link.get("latency_ms"), link.get("loss_percent"),
    ]  # fmt: skip


_NOWHERE: Row = [None] * 3
_NO_WEIGHTS: Row = [None] * 9


def _angles(quaternion: Sequence[float] | None) -> Row:
    if quaternion is None:
        return [None, None, None]
    w, x, y, z = quaternion
    return [round(degrees(angle), 2) for angle in to_euler((w, x, y, z))]


def _short(value: float) -> float | None:
    """To a tenth of a millimetre; what is not a number is not known."""
    return round(value, 4) if isfinite(value) else None


def shorten(values: Sequence[float]) -> list[float] | None:
    """A vector for JSON; None where one of its numbers is none."""
    return [round(value, 4) for value in values] if all(map(isfinite, values)) else None


class Seen:
    """What a client has been sent. All is new to one that has just come."""

    def __init__(self) -> None:
        self.changes = 0
        """The last change of a value."""
        self.texts = 0
        self.texts_chapter: int | None = None
        self.selected: int | None = None
        """The vehicle whose rows are sent."""
        self.chapter: tuple[int, int] | None = None
        """(vehicle, its chapter) of the rows that were sent."""
        self.rows = 0


class Model:
    """Vehicles by system id, texts, and values of the whole."""

    def __init__(self) -> None:
        self._changes = 0
        self.vehicles: dict[int, Vehicle] = {}
        self.world: dict[str, Value] = {}
        self._chapters = 0
        self._world_changed: dict[str, int] = {}
        self._texts: deque[dict[str, Value]] = deque(maxlen=MAX_TEXTS)
        self._texts_made = 0
        self._texts_chapter = 0
        """Another number each time that all are forgotten: a replay is moved."""

    def change(self) -> int:
        """The number of one more change of a value, from 1."""
        self._changes += 1
        return self._changes

    def next_chapter(self) -> int:
        """A number that no chapter had."""
        self._chapters += 1
        return self._chapters

    def vehicle(self, number: int) -> Vehicle:
        """That one; a new one where it is not known."""
        known = self.vehicles.get(number)
        if known is None:
            known = self.vehicles[number] = Vehicle(number, self)
        return known

    def put(self, name: str, value: Value) -> None:
        """A value of the whole."""
        if self.world.get(name) != value or name not in self.world:
            self.world[name] = value
            self._world_changed[name] = self.change()

    def say(self, vehicle: int, severity: int, text: str, time_s: float | None) -> None:
        """A text; `severity` is MAV_SEVERITY."""
        self._texts_made += 1
        self._texts.append(
            {"number": self._texts_made, "vehicle": vehicle, "severity": severity, "text": text, "time_s": time_s}
        )

    def forget_texts(self) -> None:
        self._texts.clear()
        self._texts_chapter = self.next_chapter()

    def clear(self) -> None:
        """No vehicles any more: another flight is replayed."""
        self.vehicles.clear()
        self.forget_texts()
        self.put("chapter", self.next_chapter())

    def news(self, seen: Seen) -> dict[str, Value]:
        """What `seen` has not seen; empty: nothing. It has, from now on."""
        news: dict[str, Value] = {}
        world = {name: self.world[name] for name, change in self._world_changed.items() if change > seen.changes}
        if world:
            news["world"] = world
        vehicles = {}
        for number, vehicle in self.vehicles.items():
            changed = {name: vehicle.values[name] for name, change in vehicle.changed.items() if change > seen.changes}
            if changed:
                vehicles[number] = changed
        if vehicles:
            news["vehicles"] = vehicles
        if seen.texts_chapter != self._texts_chapter:
            news["forget_texts"] = True
        if self._texts_made > seen.texts:
            news["texts"] = [text for text in self._texts if text["number"] > seen.texts]
        self._add_rows(news, seen)
        seen.changes, seen.texts, seen.texts_chapter = self._changes, self._texts_made, self._texts_chapter
        return news

    def _add_rows(self, news: dict[str, Value], seen: Seen) -> None:
        vehicle = self.vehicles.get(seen.selected) if seen.selected is not None else None
        if vehicle is None:
            return
        chapter = (vehicle.number, vehicle.chapter)
        whole = chapter != seen.chapter
        rows = vehicle.rows_after(0 if whole else seen.rows)
        if rows or whole:
            news["rows"] = {"vehicle": vehicle.number, "whole": whole, "rows": rows}
        seen.chapter, seen.rows = chapter, vehicle.rows_made


# --- messages --------------------------------------------------------------------------------------------------------


def _heartbeat(vehicle: Vehicle, message: Message, now_us: int) -> None:
    armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    vehicle.put("armed", armed)
    vehicle.put("mode", _mode(message))
    vehicle.put("failsafe", message.system_status in _FAILSAFE_STATES)
    vehicle.put("terminated", message.system_status == mavlink.MAV_STATE_FLIGHT_TERMINATION)
    vehicle.put("ready", armed or message.system_status == mavlink.MAV_STATE_STANDBY)


_FAILSAFE_STATES = (mavlink.MAV_STATE_CRITICAL, mavlink.MAV_STATE_EMERGENCY)


def _mode(message: Message) -> str:
    if message.autopilot != mavlink.MAV_AUTOPILOT_PX4:
        return f"mode {message.custom_mode}"
    return mode_name(message.custom_mode)


def mode_name(custom_mode: int) -> str:
    """PX4's main mode in bits 16-23, sub mode in bits 24-31."""
    main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    return CUSTOM_MODES.get((main, sub)) or f"mode {main}.{sub}"


def _current_mode(vehicle: Vehicle, message: Message, now_us: int) -> None:
    vehicle.put("intended", mode_name(message.intended_custom_mode))


def _extended_sys_state(vehicle: Vehicle, message: Message, now_us: int) -> None:
    vehicle.put("landed", _LANDED.get(message.landed_state))


_LANDED = {
    mavlink.MAV_LANDED_STATE_ON_GROUND: "on the ground",
    mavlink.MAV_LANDED_STATE_IN_AIR: "in the air",
    mavlink.MAV_LANDED_STATE_TAKEOFF: "taking off",
    mavlink.MAV_LANDED_STATE_LANDING: "landing",
}


def _sys_status(vehicle: Vehicle, message: Message, now_us: int) -> None:
    ill = message.onboard_control_sensors_enabled & ~message.onboard_control_sensors_health
    vehicle.put("unhealthy", [name for bit, name in SENSORS.items() if ill & bit])
    voltage, remaining = message.voltage_battery, message.battery_remaining
    known = voltage != _NO_VOLTAGE
    vehicle.put("battery", {
        "voltage_v": round(voltage * 1e-3, 1) if known else None, "percent": remaining if remaining >= 0 else None,
    })  # fmt: skip


_NO_VOLTAGE = 0xFFFF


def _attitude(vehicle: Vehicle, message: Message, now_us: int) -> None:
    attitude = shorten((message.q1, message.q2, message.q3, message.q4))
    if attitude is not None:
        vehicle.put("attitude", attitude)
        vehicle.at(message.time_boot_ms * 1000)


def _position(vehicle: Vehicle, message: Message, now_us: int) -> None:
    position = shorten((message.x, message.y, message.z))
    velocity = shorten((message.vx, message.vy, message.vz))
    if position is not None and velocity is not None:
        vehicle.put("position", position)
        vehicle.put("velocity", velocity)


def _origin(vehicle: Vehicle, message: Message, now_us: int) -> None:
    if abs(message.latitude) <= 90e7:
        vehicle.put("origin", [message.latitude, message.longitude, message.altitude])


def _truth(vehicle: Vehicle, message: Message, now_us: int) -> None:
    """HIL_STATE_QUATERNION: where it is whatever it believes, to a centimetre."""
    known = vehicle.values.get("origin")
    attitude = shorten(message.attitude_quaternion)
    if known is None or attitude is None:
        return
    origin = Origin(known[0] * 1e-7, known[1] * 1e-7, known[2] * 1e-3)
    north, west = origin.to_local(message.lat * 1e-7, message.lon * 1e-7)
    position = shorten((north, -west, origin.altitude_amsl_m - message.alt * 1e-3))
    vehicle.put("truth", None if position is None else {"position": position, "attitude": attitude})


def _wanted(vehicle: Vehicle, message: Message, now_us: int) -> None:
    """The attitude that is followed."""
    if not message.type_mask & mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE:
        vehicle.put("wanted", shorten(message.q))
        vehicle.heard_us["wanted"] = now_us


def _reference(vehicle: Vehicle, message: Message, now_us: int) -> None:
    if not message.type_mask & _NO_POSITION:
        vehicle.put("reference", shorten((message.x, message.y, message.z)))
        vehicle.heard_us["reference"] = now_us


_NO_POSITION = (
    mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE
)


def _wind_estimate(vehicle: Vehicle, message: Message, now_us: int) -> None:
    if not vehicle.fresh("true wind", now_us, SILENT_US):
        _put_wind(vehicle, (message.wind_x, message.wind_y, message.wind_z), "estimated")


def _true_wind(vehicle: Vehicle, message: Message, now_us: int) -> None:
    if message.name == "WIND_TRUE":
        vehicle.heard_us["true wind"] = now_us
        _put_wind(vehicle, (message.x, message.y, message.z), "true")


def _put_wind(vehicle: Vehicle, velocity: tuple[float, float, float], source: str) -> None:
    ned = shorten(velocity)
    vehicle.put("wind", None if ned is None else {"velocity": ned, "source": source})


Handler: TypeAlias = Callable[[Vehicle, Message, int], None]

FROM_AUTOPILOT: dict[int, Handler] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: _heartbeat,
    mavlink.MAVLINK_MSG_ID_CURRENT_MODE: _current_mode,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: _extended_sys_state,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: _sys_status,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: _attitude,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: _position,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: _origin,
    mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION: _truth,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET: _wanted,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: _reference,
    mavlink.MAVLINK_MSG_ID_WIND_COV: _wind_estimate,
    mavlink.MAVLINK_MSG_ID_DEBUG_VECT: _true_wind,
}
"""What a vehicle says."""


def _phase(vehicle: Vehicle, message: Message, now_us: int) -> None:
    vehicle.put("ground", monitor.PHASES.get(message.custom_mode, "unknown"))


def _array(vehicle: Vehicle, message: Message, now_us: int) -> None:
    numbers = tuple(message.data)
    if message.name == monitor.WEIGHTS.name:
        weights, initial = numbers[:9], numbers[9:18]
        vehicle.heard_us["weights"] = now_us
        vehicle.put("weights", [_short(w / w0) if w0 else None for w, w0 in zip(weights, initial, strict=True)])
    elif message.name == monitor.LINK.name:
        received, lost, _, age_ms = numbers[:4]
        put_link(vehicle, "off-board", received, lost, age_ms, now_us)


def put_link(vehicle: Vehicle, which: str, received: float, lost: float, latency_ms: float | None, now_us: int) -> None:
    """How a link does: counts since the start, and the latency as whoever measures it has it."""
    vehicle.link.count(received, lost, now_us)
    latency = None if latency_ms is None else _short(latency_ms)
    vehicle.put("link", {"of": which, "latency_ms": latency, "loss_percent": vehicle.link.percent})
    vehicle.heard_us[which] = now_us


FROM_GROUND: dict[int, Handler] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: _phase,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: _reference,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET: _wanted,
    mavlink.MAVLINK_MSG_ID_DEBUG_FLOAT_ARRAY: _array,
}
"""What the ground says of a vehicle, on its monitor link."""

_ONLY_IF_NO_GROUND = (
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED,
)
"""The vehicle's word counts where no ground that is in control tells better."""


def hear(vehicle: Vehicle, message: Message, now_us: int, *, by_ground: bool = False) -> None:
    """Take a message of the vehicle, or of its ground, in. Of those that are not shown nothing is taken."""
    message_id = type(message).id
    if by_ground:
        handler = FROM_GROUND.get(message_id)
        vehicle.heard_us["ground"] = now_us
        if message_id in _ONLY_IF_NO_GROUND:
            vehicle.heard_us["control"] = now_us
    else:
        handler = FROM_AUTOPILOT.get(message_id)
        vehicle.heard_us["vehicle"] = now_us
        if message_id in _ONLY_IF_NO_GROUND and vehicle.fresh("control", now_us, STALE_US):
            return
    if handler is not None:
        handler(vehicle, message, now_us)


def look(vehicle: Vehicle, now_us: int) -> None:
    """What silence means: at each update."""
    vehicle.put("online", vehicle.fresh("vehicle", now_us, SILENT_US))
    if vehicle.values.get("ground") is not None and not vehicle.fresh("ground", now_us, SILENT_US):
        vehicle.put("ground", None)
        vehicle.put("law", None)
    for name in ("reference", "wanted", "weights"):
        if vehicle.values.get(name) is not None and not vehicle.fresh(name, now_us, STALE_US):
            vehicle.put(name, None)
