"""Telemetry: every message's units and signs by hand, delivered rates, profiles, values at their limits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import inf, isnan, nan, pi, sqrt
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot import modes, telemetry
from mavsitl_vehicle.autopilot.battery import Battery
from mavsitl_vehicle.autopilot.health import Health
from mavsitl_vehicle.autopilot.modes import Mode
from mavsitl_vehicle.autopilot.setpoints import PositionSetpoint
from mavsitl_vehicle.autopilot.sticks import Axes
from mavsitl_vehicle.autopilot.telemetry import (
    BY_ID,
    NEVER,
    STREAMS,
    Accuracy,
    AttitudeTarget,
    FlightTimes,
    Home,
    Metadata,
    Mission,
    Profile,
    Schedule,
    Subject,
    Wind,
    accuracy,
    atmosphere,
    request,
)
from mavsitl_vehicle.sensors.status import EstimatorStatus, Readings, known

from mavsitl import __version__
from mavsitl.codec import parse
from mavsitl.dialect import mavlink
from mavsitl.frames import Vector
from mavsitl.geodesy import Origin
from mavsitl.node import Node
from mavsitl.scenario import Noise, load_airframe

TICK_US = 4000
LEVEL = (1.0, 0.0, 0.0, 0.0)
NOW_US = 12_345_678
BOOT_US = 1_700_000_000_000_000

# Position 1 north, 2 west, 3 up; velocity 3, 4, 0.5; level, facing north; rates 0.125, 0.375, 0.625 FLU.
STATE = (1.0, 2.0, 3.0, 3.0, 4.0, 0.5, *LEVEL, 0.125, 0.375, 0.625)


@dataclass
class Chief:
    mode: Mode = Mode.LOITER
    intended: Mode = Mode.LOITER
    armed: bool = True
    failsafe: bool = False
    refusal: str | None = None

    def arming_refusal(self) -> str | None:
        return self.refusal


@dataclass
class Told:
    """A `Subject` of plain values."""

    system_id: int = 1
    unix_boot_us: int = BOOT_US
    load: float = 0.25
    commander: Chief = field(default_factory=Chief)
    landed_state: int = mavlink.MAV_LANDED_STATE_IN_AIR
    health: Health = field(default_factory=Health)
    battery: Battery = field(default_factory=lambda: Battery(load_airframe("paper")))
    estimate: Sequence[float] = STATE
    estimator_status: EstimatorStatus = field(default_factory=lambda: known(Noise()))
    accuracy: Accuracy = field(default_factory=lambda: accuracy(known(Noise())))
    readings: Readings | None = None
    specific_force_flu_m_s2: Vector = (0.1, 0.2, 9.80665)
    truth: Sequence[float] = (*STATE, 100.0, 200.0, 300.0, 400.0)
    true_wind: Vector = (0.0, 0.0, 0.5)
    outputs: Sequence[float] = (0.1, 0.2, 0.3, 0.4)
    silent_escs: int = 0
    origin: Origin = field(default_factory=lambda: Origin(47.397742, 8.545594, 488.0))
    home: Home | None = field(default_factory=lambda: Home((10.0, 20.0, 1.0), pi / 2.0, 1000))
    attitude_target: AttitudeTarget | None = field(
        default_factory=lambda: AttitudeTarget((sqrt(0.75), 0.0, 0.5, 0.0), (0.1, 0.2, 0.3), 0.55)
    )
    position_target: PositionSetpoint | None = field(
        default_factory=lambda: PositionSetpoint((1.0, 2.0, 3.0), (0.1, 0.2, 0.3), (0.4, 0.5, 0.6), 0.7, 0.8)
    )
    wind: Wind | None = field(default_factory=lambda: Wind((1.0, 2.0, 3.0), 0.25, 0.16))
    sticks: Axes | None = field(default_factory=lambda: Axes(pitch=0.2, roll=0.5, yaw=-1.0, throttle=0.75))
    mission: Mission = field(default_factory=lambda: Mission(2, 5, mavlink.MISSION_STATE_ACTIVE, True))
    flight_times: FlightTimes = field(default_factory=lambda: FlightTimes(1_000_000, 2_000_000, 3_000_000, 4))
    metadata: Metadata | None = field(default_factory=lambda: Metadata("mftp://general.json", 0xDEADBEEF))


def sent(subject: Subject, name: str, index: int = 0, now_us: int = NOW_US) -> list[Any]:
    """What REQUEST_MESSAGE of `name` brings, through the wire."""
    node = Node(1, 1)
    served = request(subject, node, getattr(mavlink, f"MAVLINK_MSG_ID_{name}"), index, now_us)
    messages = [frame.message for datagram in node.datagrams() for frame in parse(datagram)]
    assert served == bool(messages)
    return messages


def one(subject: Subject, name: str, index: int = 0) -> Any:
    (message,) = sent(subject, name, index)
    assert message.get_type() == name
    return message


def near(*values: float) -> Any:
    return pytest.approx(values, rel=1e-6, abs=1e-7)


# --- identity and state


@pytest.mark.parametrize(
    ("chief", "base_mode", "custom_mode", "status"),
    [
        (Chief(armed=False), 0x1D, 0x03040000, mavlink.MAV_STATE_STANDBY),
        (Chief(armed=False, refusal="no"), 0x1D, 0x03040000, mavlink.MAV_STATE_UNINIT),
        (Chief(Mode.OFFBOARD), None, 0x00060000, mavlink.MAV_STATE_ACTIVE),
        (Chief(Mode.LAND, failsafe=True), 0x9D, 0x06040000, mavlink.MAV_STATE_CRITICAL),
        (Chief(Mode.TERMINATION, failsafe=True), None, 0x000A0000, mavlink.MAV_STATE_FLIGHT_TERMINATION),
    ],
)
def test_heartbeat(chief: Chief, base_mode: int | None, custom_mode: int, status: int) -> None:
    m = one(Told(commander=chief), "HEARTBEAT")
    assert (m.type, m.autopilot, m.mavlink_version) == (2, 12, 3)
    assert (m.custom_mode, m.system_status) == (custom_mode, status)
    assert m.base_mode & 1
    assert bool(m.base_mode & 128) == chief.armed
    assert base_mode in (None, m.base_mode)


def test_sys_status() -> None:
    pack = Battery(load_airframe("paper"))
    pack.charge, pack.voltage_v, pack.current_a = 0.895, 11.8, 3.456
    m = one(Told(battery=pack), "SYS_STATUS")
    assert (m.load, m.voltage_battery, m.current_battery, m.battery_remaining) == (250, 11800, 346, 90)
    assert m.onboard_control_sensors_enabled & ~m.onboard_control_sensors_health == 0
    assert m.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_PREARM_CHECK
    m = one(Told(health=Health(mode_refusal="no")), "SYS_STATUS")
    assert m.onboard_control_sensors_enabled & mavlink.MAV_SYS_STATUS_PREARM_CHECK
    assert not m.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_PREARM_CHECK


def test_states_and_times() -> None:
    told = Told(commander=Chief(Mode.RTL, Mode.OFFBOARD))
    assert one(told, "EXTENDED_SYS_STATE").landed_state == mavlink.MAV_LANDED_STATE_IN_AIR
    m = one(told, "CURRENT_MODE")
    assert (m.standard_mode, m.custom_mode, m.intended_custom_mode) == (5, 0x05040000, 0x00060000)
    m = one(told, "MISSION_CURRENT")
    assert (m.seq, m.total, m.mission_state, m.mission_mode) == (2, 5, mavlink.MISSION_STATE_ACTIVE, 1)
    m = one(Told(mission=Mission()), "MISSION_CURRENT")
    assert (m.seq, m.total, m.mission_state, m.mission_mode) == (0, 0, mavlink.MISSION_STATE_NO_MISSION, 2)
    m = one(told, "SYSTEM_TIME")
    assert (m.time_unix_usec, m.time_boot_ms) == (BOOT_US + NOW_US, 12345)
    assert one(Told(unix_boot_us=0), "SYSTEM_TIME").time_unix_usec == 0
    m = one(told, "FLIGHT_INFORMATION")
    assert (m.arming_time_utc, m.takeoff_time_utc, m.flight_uuid, m.landing_time) == (1_000_000, 2_000_000, 4, 3000)


def test_autopilot_version() -> None:
    m = one(Told(system_id=7), "AUTOPILOT_VERSION")
    assert m.flight_sw_version.to_bytes(4, "big") == bytes((1, 17, 0, 255))
    assert m.capabilities == telemetry.CAPABILITIES
    assert m.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    assert m.uid & 0xFF == 7
    assert bytes(m.uid2[:8]) == m.uid.to_bytes(8, "big")
    major, minor, patch = (int(part) for part in __version__.split(".")[:3])
    assert bytes(m.flight_custom_version) == bytes((patch, minor, major, 0, 0, 0, 0, 0))


def test_available_modes() -> None:
    everything = sent(Told(), "AVAILABLE_MODES")
    assert [m.mode_index for m in everything] == list(range(1, len(modes.LISTED) + 1))
    assert {m.number_modes for m in everything} == {len(modes.LISTED)}
    by_custom = {m.custom_mode: m for m in everything}
    hold, land, offboard = by_custom[0x03040000], by_custom[0x06040000], by_custom[0x00060000]
    assert (hold.standard_mode, hold.mode_name, hold.properties) == (0, "Hold", 0)
    assert (land.standard_mode, land.mode_name) == (mavlink.MAV_STANDARD_MODE_LAND, "")
    assert (offboard.mode_name, offboard.properties) == ("Offboard", mavlink.MAV_MODE_PROPERTY_ADVANCED)
    assert by_custom[0x000A0000].properties & mavlink.MAV_MODE_PROPERTY_NOT_USER_SELECTABLE
    for index, each in enumerate(everything, 1):
        assert one(Told(), "AVAILABLE_MODES", index).custom_mode == each.custom_mode
    for index in (-1, len(modes.LISTED) + 1, 2**31):
        assert sent(Told(), "AVAILABLE_MODES", index) == []
    assert one(Told(), "AVAILABLE_MODES_MONITOR").seq == 0


# --- attitude and position

R = sqrt(0.5)
HAND = [
    # name, FLU -> NWU, FRD -> NED, (roll, pitch, yaw) on the wire, heading in degrees
    ("level, north", LEVEL, LEVEL, (0.0, 0.0, 0.0), 0),
    ("facing west: +90 deg about z up", (R, 0.0, 0.0, R), (R, 0.0, 0.0, -R), (0.0, 0.0, -pi / 2), 270),
    ("facing east", (R, 0.0, 0.0, -R), (R, 0.0, 0.0, R), (0.0, 0.0, pi / 2), 90),
    ("right wing down 90 deg", (R, R, 0.0, 0.0), (R, R, 0.0, 0.0), (pi / 2, 0.0, 0.0), 0),
    # 60 deg about y, which points left: the nose goes down
    ("nose down 60 deg", (sqrt(0.75), 0.0, 0.5, 0.0), (sqrt(0.75), 0.0, -0.5, 0.0), (0.0, -pi / 3, 0.0), 0),
]


@pytest.mark.parametrize(("name", "flu", "frd", "euler", "heading"), HAND)
def test_attitude_by_hand(
    name: str, flu: tuple[float, ...], frd: tuple[float, ...], euler: tuple[float, ...], heading: int
) -> None:
    state = (*STATE[:6], *flu, *STATE[10:])
    told = Told(estimate=state, truth=(*state, 0.0, 0.0, 0.0, 0.0))
    rates = (0.125, -0.375, -0.625)
    m = one(told, "ATTITUDE")
    assert m.time_boot_ms == 12345
    assert (m.roll, m.pitch, m.yaw) == near(*euler)
    assert (m.rollspeed, m.pitchspeed, m.yawspeed) == rates
    m = one(told, "ATTITUDE_QUATERNION")
    assert (m.q1, m.q2, m.q3, m.q4) == near(*frd)
    assert (m.rollspeed, m.pitchspeed, m.yawspeed) == rates
    m = one(told, "ODOMETRY")
    assert m.q == near(*frd)
    assert (m.rollspeed, m.pitchspeed, m.yawspeed) == rates
    m = one(told, "HIL_STATE_QUATERNION")
    assert m.attitude_quaternion == near(*frd)
    assert (m.rollspeed, m.pitchspeed, m.yawspeed) == rates
    assert one(told, "GLOBAL_POSITION_INT").hdg == heading * 100
    assert one(told, "VFR_HUD").heading == heading


def test_position_by_hand() -> None:
    told = Told()
    m = one(told, "LOCAL_POSITION_NED")
    assert (m.x, m.y, m.z, m.vx, m.vy, m.vz) == (1.0, -2.0, -3.0, 3.0, -4.0, -0.5)
    m = one(told, "ODOMETRY")
    assert (m.frame_id, m.child_frame_id, m.time_usec) == (1, 1, NOW_US)
    assert (m.x, m.y, m.z, m.vx, m.vy, m.vz) == (1.0, -2.0, -3.0, 3.0, -4.0, -0.5)
    noise = Noise()
    assert [m.pose_covariance[i] for i in (0, 6, 11)] == near(*[noise.position_m**2] * 3)
    assert [m.pose_covariance[i] for i in (15, 18, 20)] == near(*[(noise.attitude_deg * pi / 180.0) ** 2] * 3)
    assert [m.velocity_covariance[i] for i in (0, 6, 11)] == near(*[noise.velocity_m_s**2] * 3)
    assert [m.velocity_covariance[i] for i in (15, 18, 20)] == near(*[(noise.rate_deg_s * pi / 180.0) ** 2] * 3)
    assert all(isnan(value) for i, value in enumerate(m.pose_covariance) if i not in (0, 6, 11, 15, 18, 20))


NORTH_1_M_DEG_E7 = 89.93  # 1 m of 6371 km
EAST_1_M_DEG_E7 = 132.85  # the same, by cos(47.397742 deg)


def test_global_position_by_hand() -> None:
    """One metre north and two west of the origin: 90 up in latitude, 266 down in longitude."""
    lat, lon = 473977420 + NORTH_1_M_DEG_E7, 85455940 - 2 * EAST_1_M_DEG_E7
    m = one(Told(), "GLOBAL_POSITION_INT")
    assert (m.lat, m.lon) == pytest.approx((lat, lon), abs=1)
    assert (m.alt, m.relative_alt) == (491_000, 2_000)
    assert (m.vx, m.vy, m.vz) == (300, -400, -50)
    assert one(Told(home=None), "GLOBAL_POSITION_INT").relative_alt == 3_000
    m = one(Told(), "GPS_RAW_INT")
    assert (m.lat, m.lon, m.alt) == (pytest.approx(lat, abs=1), pytest.approx(lon, abs=1), 491_000)
    assert (m.fix_type, m.satellites_visible, m.vel) == (3, 10, 500)
    assert m.cog == pytest.approx(30_687)  # 3 north, 4 west: 360 - 53.13 deg
    assert (m.eph, m.epv, m.h_acc, m.vel_acc) == (70, 110, 5, 5)
    m = one(Told(), "HIL_STATE_QUATERNION")
    assert (m.lat, m.lon, m.alt) == (pytest.approx(lat, abs=1), pytest.approx(lon, abs=1), 491_000)
    assert (m.vx, m.vy, m.vz, m.true_airspeed) == (300, -400, -50, 500)
    assert (m.xacc, m.yacc, m.zacc) == (10, -20, -1000)


def test_a_receiver_without_a_fix_says_so() -> None:
    m = one(Told(health=Health(gps=False)), "GPS_RAW_INT")
    assert (m.fix_type, m.satellites_visible, m.lat, m.lon) == (1, 0, 0, 0)
    assert (m.eph, m.epv, m.vel, m.cog) == (65535,) * 4


def test_heights_and_speeds() -> None:
    m = one(Told(), "ALTITUDE")
    assert (m.altitude_monotonic, m.altitude_amsl, m.altitude_local, m.altitude_relative) == (491.0, 491.0, 3.0, 2.0)
    assert isnan(m.altitude_terrain)
    assert isnan(m.bottom_clearance)
    m = one(Told(), "VFR_HUD")
    assert (m.airspeed, m.groundspeed, m.alt, m.climb, m.throttle) == (0.0, 5.0, 491.0, 0.5, 55)
    assert one(Told(commander=Chief(armed=False)), "VFR_HUD").throttle == 0
    assert one(Told(attitude_target=None), "VFR_HUD").throttle == 0


def test_home_and_origin() -> None:
    """Home 10 north, 20 west, 1 up, facing west: yaw -90 deg about z down."""
    m = one(Told(), "HOME_POSITION")
    expected = (473977420 + 10 * NORTH_1_M_DEG_E7, 85455940 - 20 * EAST_1_M_DEG_E7)
    assert (m.latitude, m.longitude) == pytest.approx(expected, abs=1)
    assert (m.altitude, m.x, m.y, m.z, m.time_usec) == (489_000, 10.0, -20.0, -1.0, 1000)
    assert m.q == near(R, 0.0, 0.0, -R)
    assert sent(Told(home=None), "HOME_POSITION") == []
    m = one(Told(), "GPS_GLOBAL_ORIGIN")
    assert (m.latitude, m.longitude, m.altitude, m.time_usec) == (473977420, 85455940, 488_000, NOW_US)


def test_estimator_and_wind() -> None:
    m = one(Told(), "ESTIMATOR_STATUS")
    assert m.flags == 0b11_0011_1111
    assert (m.pos_horiz_accuracy, m.pos_vert_accuracy) == near(0.005, 0.005)
    assert one(Told(health=Health(position=False)), "ESTIMATOR_STATUS").flags == 0b1010_0101
    m = one(Told(), "WIND_COV")
    assert (m.wind_x, m.wind_y, m.wind_z, m.wind_alt) == (1.0, -2.0, -3.0, 491.0)
    assert (m.var_horiz, m.var_vert, m.horiz_accuracy, m.vert_accuracy) == near(0.25, 0.16, 0.5, 0.4)
    assert sent(Told(wind=None), "WIND_COV") == []


# --- sensors and actuators


def test_imu_by_hand() -> None:
    """Facing west the field, which points north and down, comes from the right: +y in FRD."""
    m = one(Told(), "HIGHRES_IMU")
    assert (m.xacc, m.yacc, m.zacc) == near(0.1, -0.2, -9.80665)
    assert (m.xgyro, m.ygyro, m.zgyro) == (0.125, -0.375, -0.625)
    assert (m.xmag, m.ymag, m.zmag) == pytest.approx((0.2031, 0.0, 0.4416), abs=1e-4)
    assert (m.abs_pressure, m.temperature, m.pressure_alt) == pytest.approx((955.64, 11.81, 491.0), abs=0.01)
    west = Told(estimate=(*STATE[:6], R, 0.0, 0.0, R, *STATE[10:]))
    m = one(west, "HIGHRES_IMU")
    assert (m.xmag, m.ymag, m.zmag) == pytest.approx((0.0, 0.2031, 0.4416), abs=1e-4)


def test_atmosphere_by_iso_2533() -> None:
    assert atmosphere(0.0) == near(1013.25, 15.0)
    assert atmosphere(1000.0) == pytest.approx((898.746, 8.5), abs=0.01)
    assert atmosphere(5000.0) == pytest.approx((540.199, -17.5), abs=0.02)
    m = one(Told(), "SCALED_PRESSURE")
    assert (m.press_abs, m.temperature) == (pytest.approx(955.64, abs=0.01), 1181)


def test_battery_status() -> None:
    pack = Battery(load_airframe("paper"))
    pack.update((180.0,) * 4, True, 360.0)
    m = one(Told(battery=pack), "BATTERY_STATUS")
    assert (m.id, m.voltages[0], m.voltages[1:], m.voltages_ext) == (
        0,
        round(pack.voltage_v * 1e3),
        [65535] * 9,
        [0] * 4,
    )
    assert m.current_battery == round(pack.current_a * 100)
    assert m.current_consumed == round(pack.current_a * 100)  # 0.1 h, in mAh
    assert m.energy_consumed == round(pack.voltage_v * pack.current_a * 3.6)  # hJ
    assert (m.temperature, m.charge_state) == (32767, mavlink.MAV_BATTERY_CHARGE_STATE_OK)
    assert m.time_remaining == pytest.approx(pack.charge * 2.2 / pack.current_a * 3600.0, abs=1)
    pack.charge = 0.06
    assert one(Told(battery=pack), "BATTERY_STATUS").charge_state == mavlink.MAV_BATTERY_CHARGE_STATE_CRITICAL


def test_outputs() -> None:
    m = one(Told(), "SERVO_OUTPUT_RAW")
    assert (m.servo1_raw, m.servo2_raw, m.servo3_raw, m.servo4_raw, m.servo5_raw) == (1100, 1200, 1300, 1400, 0)
    assert one(Told(commander=Chief(armed=False)), "SERVO_OUTPUT_RAW").servo1_raw == 900
    (wrapped,) = sent(Told(), "SERVO_OUTPUT_RAW", now_us=2**32 + 7)
    assert wrapped.time_usec == 7
    m = one(Told(), "ACTUATOR_OUTPUT_STATUS")
    assert (m.active, m.actuator[:5]) == (0b1111, near(0.1, 0.2, 0.3, 0.4, 0.0))
    m = one(Told(), "RC_CHANNELS")
    assert (m.chancount, m.chan1_raw, m.chan2_raw, m.chan3_raw, m.chan4_raw) == (4, 1750, 1400, 1750, 1000)
    assert (m.chan5_raw, m.rssi) == (65535, 255)
    assert sent(Told(sticks=None), "RC_CHANNELS") == []


@pytest.mark.skipif(not hasattr(mavlink, "MAVLINK_MSG_ID_ESC_STATUS"), reason="not in this dialect")
def test_speed_controllers() -> None:
    """100 rad/s are 955 rpm; at 400 rad/s d omega^3 / 0.6 = 93.02 W from 12.6 V."""
    m = one(Told(), "ESC_STATUS")
    assert m.rpm == [955, 1910, 2865, 3820]
    assert m.voltage == near(*[12.6] * 4)
    assert m.current[3] == pytest.approx(93.02 / 12.6, rel=1e-3)
    assert one(Told(commander=Chief(armed=False)), "ESC_STATUS").current == [0.0] * 4
    m = one(Told(), "ESC_INFO")
    assert (m.counter, m.count, m.info, m.temperature) == (123, 4, 0b1111, [32767] * 4)


@pytest.mark.skipif(not hasattr(mavlink, "MAVLINK_MSG_ID_COMPONENT_METADATA"), reason="not in this dialect")
def test_component_metadata() -> None:
    m = one(Told(), "COMPONENT_METADATA")
    assert (m.uri, m.file_crc) == ("mftp://general.json", 0xDEADBEEF)
    assert sent(Told(metadata=None), "COMPONENT_METADATA") == []


@pytest.mark.skipif(not hasattr(mavlink, "MAVLINK_MSG_ID_PROTOCOL_VERSION"), reason="not in this dialect")
def test_protocol_version() -> None:
    m = one(Told(), "PROTOCOL_VERSION")
    assert (m.version, m.min_version, m.max_version) == (200, 100, 200)


def test_attitude_target() -> None:
    m = one(Told(), "ATTITUDE_TARGET")
    assert (m.type_mask, m.thrust) == (0, pytest.approx(0.55))
    assert m.q == near(sqrt(0.75), 0.0, -0.5, 0.0)
    assert (m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate) == near(0.1, -0.2, -0.3)
    rates_only = AttitudeTarget(None, (0.1, 0.2, nan), 0.5)
    m = one(Told(attitude_target=rates_only), "ATTITUDE_TARGET")
    assert (m.type_mask, m.q, m.body_yaw_rate) == (128 | 4, [1.0, 0.0, 0.0, 0.0], 0.0)
    assert sent(Told(attitude_target=None), "ATTITUDE_TARGET") == []


def test_position_targets() -> None:
    m = one(Told(), "POSITION_TARGET_LOCAL_NED")
    assert (m.coordinate_frame, m.type_mask) == (1, 0)
    assert (m.x, m.y, m.z, m.vx, m.vy, m.vz) == near(1.0, -2.0, -3.0, 0.1, -0.2, -0.3)
    assert (m.afx, m.afy, m.afz, m.yaw, m.yaw_rate) == near(0.4, -0.5, -0.6, -0.7, -0.8)
    m = one(Told(), "POSITION_TARGET_GLOBAL_INT")
    expected = (473977420 + NORTH_1_M_DEG_E7, 85455940 - 2 * EAST_1_M_DEG_E7)
    assert (m.lat_int, m.lon_int) == pytest.approx(expected, abs=1)
    assert (m.coordinate_frame, m.type_mask, m.alt) == (5, 0, 491.0)
    assert (m.vx, m.vy, m.vz, m.yaw) == near(0.1, -0.2, -0.3, -0.7)
    velocity = PositionSetpoint((nan, nan, 3.0), (1.0, 2.0, nan), (nan, nan, nan), nan, 0.5)
    m = one(Told(position_target=velocity), "POSITION_TARGET_LOCAL_NED")
    assert m.type_mask == 1 | 2 | 32 | 64 | 128 | 256 | 1024
    assert isnan(m.x)
    assert m.z == -3.0
    m = one(Told(position_target=velocity), "POSITION_TARGET_GLOBAL_INT")
    assert (m.type_mask, m.lat_int, m.lon_int) == (1 | 2 | 32 | 64 | 128 | 256 | 1024, 0, 0)
    for name in ("POSITION_TARGET_LOCAL_NED", "POSITION_TARGET_GLOBAL_INT"):
        assert sent(Told(position_target=None), name) == []


def test_the_simulators_own() -> None:
    m = one(Told(true_wind=(1.0, 2.0, 0.5)), "DEBUG_VECT")
    assert (m.name, m.time_usec, m.x, m.y, m.z) == ("WIND_TRUE", NOW_US, 1.0, -2.0, -0.5)
    assert one(Told(), "VIBRATION").clipping_0 == 0


# --- limits


def wild_subject(value: float) -> Told:
    """Everything is `value`, attitudes too unless it is huge: a quaternion's squares would not fit the wire."""
    state = (*(value,) * 6, *(LEVEL if 1e9 < abs(value) < inf else (value,) * 4), value, value, value)
    pack = Battery(load_airframe("paper"))
    pack.voltage_v = pack.current_a = pack.consumed_ah = pack.consumed_j = value
    limit = 1e9 if value == value else value  # of a rotor speed: its cube is sent
    three = (value, value, value)
    status = EstimatorStatus(True, True, True, True, False, *(value,) * 11)
    return Told(
        unix_boot_us=2**62,
        load=value,
        battery=pack,
        estimate=state,
        estimator_status=status,
        accuracy=accuracy(status),
        specific_force_flu_m_s2=three,
        truth=(*state, *(min(max(value, -limit), limit),) * 4),
        true_wind=three,
        outputs=(value,) * 4,
        home=Home(three, value if abs(value) < inf else 0.0, 2**63),
        attitude_target=AttitudeTarget((value,) * 4, three, value),
        position_target=PositionSetpoint(three, three, three, value, value),
        wind=Wind(three, abs(value), abs(value)),
        sticks=Axes(value, value, value, value),
        mission=Mission(10**9, -5, 3, True),
        flight_times=FlightTimes(2**63, 2**63, 2**63, 2**63),
    )


@pytest.mark.parametrize("value", [nan, inf, -inf, 1e38, -1e38, 1e9, -1e9, 0.0])
@pytest.mark.parametrize("name", [stream.name for stream in STREAMS])
def test_extreme_values_fit_the_wire(name: str, value: float) -> None:
    message_id = getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
    for now_us in (0, 2**40, 2**62):
        node = Node(1, 1)
        assert request(wild_subject(value), node, message_id, 0, now_us)
        assert all(parse(datagram) for datagram in node.datagrams())


@pytest.mark.parametrize("name", [stream.name for stream in STREAMS])
def test_what_no_float32_holds_is_left_out_and_counted(name: str) -> None:
    message_id = getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
    node, schedule = Node(1, 1), Schedule("lockstep")
    done = request(wild_subject(1e300), node, message_id, 0, 0)
    assert done == bool(node.datagrams())
    for stream in STREAMS:
        schedule.set_interval(stream.message_id, NEVER, 0)
    schedule.set_interval(message_id, 1000, 0)
    schedule.run(wild_subject(1e300), node, 10_000_000)
    assert schedule.unsendable == (0 if done else 1)
    assert done == bool(node.datagrams())


@given(st.integers(-(2**40), 2**40), st.integers(-(2**40), 2**40), st.integers(0, 2**40))
def test_any_request_is_answered_or_refused(message_id: int, index: int, now_us: int) -> None:
    node = Node(1, 1)
    done = request(Told(), node, message_id, index, now_us)
    assert done == bool(node.datagrams())
    if message_id not in BY_ID:
        assert not done


# --- schedules


def names_sent(
    schedule: Schedule, seconds: float, *, tick_us: int = TICK_US, from_us: int = 0, subject: Told | None = None
) -> list[tuple[int, str]]:
    """(tick's time, name) of all that goes out."""
    node, told = Node(1, 1), subject or Told()
    out: list[tuple[int, str]] = []
    for now_us in range(from_us, from_us + round(seconds * 1e6), tick_us):
        schedule.run(told, node, now_us)
        out.extend((now_us, parse(datagram)[0].message.get_type()) for datagram in node.datagrams())
    return out


PROFILES: tuple[Profile, ...] = ("gcs", "offboard", "lockstep")


@pytest.mark.parametrize("profile", PROFILES)
def test_default_rates(profile: Profile) -> None:
    counts = Counter(name for _, name in names_sent(Schedule(profile), 20.0))
    for stream in STREAMS:
        interval_us = Schedule(profile).default_us(stream.message_id)
        expected = 20e6 / interval_us if interval_us else 0.0
        assert counts.pop(stream.name, 0) == pytest.approx(expected, rel=0.02, abs=1), stream.name
    assert not counts


def test_profiles_keep_their_budgets() -> None:
    """The most in any one second, and in any one tick; the ground station's link is for clients written in Python."""
    for profile, in_a_second, in_a_tick in (("gcs", 150, 3), ("offboard", 450, 5), ("lockstep", 180, 7)):
        ticks = Counter(now_us // TICK_US for now_us, _ in names_sent(Schedule(profile), 10.0))  # type: ignore[arg-type]
        first, window = sum(ticks[tick] for tick in range(250)), []
        for tick in range(250, 2500):
            first += ticks[tick] - ticks[tick - 250]
            window.append(first)
        assert max(window) <= in_a_second
        assert max(ticks.values()) <= in_a_tick


def test_the_lockstep_profile_is_the_flight_controllers_own() -> None:
    assert {name for _, name in names_sent(Schedule("lockstep"), 2.0)} == {
        "HEARTBEAT",
        "SYS_STATUS",
        "EXTENDED_SYS_STATE",
        "ATTITUDE",
        "ATTITUDE_QUATERNION",
        "LOCAL_POSITION_NED",
        "ODOMETRY",
    }


def test_offboard_rates_are_px4s() -> None:
    better = {"HOME_POSITION"}
    for stream in STREAMS:
        if stream.offboard_hz and stream.name not in better:
            assert stream.offboard_hz == stream.px4_offboard_hz, stream.name
        assert stream.name not in better or stream.offboard_hz >= stream.px4_offboard_hz


@pytest.mark.parametrize("profile", PROFILES)
def test_every_stream_begins_within_a_quarter_second(profile: Profile) -> None:
    begun = names_sent(Schedule(profile, start_us=10_000_000), 0.26, from_us=10_000_000)
    expected = {s.name for s in STREAMS if Schedule(profile).default_us(s.message_id) != NEVER}
    assert {name for _, name in begun} == expected
    assert begun[0] == (10_000_000, "HEARTBEAT")


@pytest.mark.parametrize("hz", [0.2, 1, 3, 7, 30, 33, 60, 90, 99, 123, 200, 240, 250])
@pytest.mark.parametrize("tick_us", [4000, 10_000])
def test_an_interval_is_delivered(hz: float, tick_us: int) -> None:
    """Within 2 %, whatever the tick; never more than once a tick."""
    schedule = Schedule("gcs")
    schedule.set_interval(mavlink.MAVLINK_MSG_ID_ODOMETRY, round(1e6 / hz), 0)
    got = [at for at, name in names_sent(schedule, 20.0, tick_us=tick_us) if name == "ODOMETRY"]
    assert len(got) == pytest.approx(20.0 * min(hz, 1e6 / tick_us), rel=0.02, abs=1)
    assert len(set(got)) == len(got)


@given(st.integers(1, 2**31 - 1), st.lists(st.integers(1, 3_000_000), min_size=1, max_size=30))
def test_no_burst_and_no_drift(interval_us: int, steps: list[int]) -> None:
    """However uneven the ticks: at most one a tick, and exactly where a point of the grid has passed."""
    schedule, node, told = Schedule("lockstep"), Node(1, 1), Told()
    for stream in STREAMS:
        schedule.set_interval(stream.message_id, NEVER, 0)
    schedule.set_interval(mavlink.MAVLINK_MSG_ID_ATTITUDE, interval_us, 0)
    now_us, last_us = 0, -1
    for step in (0, *steps):
        now_us += step
        schedule.run(told, node, now_us)
        passed = now_us // interval_us - (last_us // interval_us if last_us >= 0 else -1)
        assert len(node.datagrams()) == min(passed, 1)
        last_us = now_us


def test_stop_and_default() -> None:
    schedule = Schedule("offboard")
    attitude = mavlink.MAVLINK_MSG_ID_ATTITUDE
    schedule.set_interval(attitude, NEVER, 0)
    assert "ATTITUDE" not in {name for _, name in names_sent(schedule, 0.5)}
    assert schedule.interval_us(attitude) == NEVER
    schedule.set_interval(attitude, schedule.default_us(attitude), 500_000)
    assert len([0 for _, name in names_sent(schedule, 1.0, from_us=500_000) if name == "ATTITUDE"]) == 100
    with pytest.raises(KeyError):
        schedule.default_us(9999)


def test_what_there_is_not_is_not_streamed() -> None:
    silent = replace(Told(), home=None, wind=None, sticks=None, attitude_target=None, position_target=None)
    names = {name for _, name in names_sent(Schedule("offboard"), 2.0, subject=silent)}
    assert not names & {
        "HOME_POSITION",
        "WIND_COV",
        "RC_CHANNELS",
        "ATTITUDE_TARGET",
        "POSITION_TARGET_LOCAL_NED",
        "POSITION_TARGET_GLOBAL_INT",
    }
    assert {"ATTITUDE", "GLOBAL_POSITION_INT"} <= names
