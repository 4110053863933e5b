"""What a vehicle writes of itself: PX4's topics with the numbers that were flown, and what its log's readers need."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mavsitl_vehicle.autopilot.health import Validity
from pyulog.core import ULog
from pyulog.px4 import PX4ULog

from mavsitl import scenario
from mavsitl.dialect import mavlink
from mavsitl.log import topics
from mavsitl.log.content import flat, joined
from mavsitl.log.ulog import MemoryRecorder
from tests.autopilot.conftest import Client, flight
from tests.autopilot.copter import HOLD, go_to, parameter, sticks, take_off
from tests.log.conftest import fly

FLIGHT_REVIEW = {
    "vehicle_status": ("nav_state", "failsafe", "failsafe_and_user_took_over"),
    "vehicle_local_position": ("x", "y", "z", "vx", "vy", "vz", "xy_valid", "z_valid", "v_xy_valid", "v_z_valid"),
    "vehicle_local_position_groundtruth": ("x", "y"),
    "vehicle_local_position_setpoint": ("x", "y", "z", "vx", "vy", "vz"),
    "vehicle_global_position": ("lat", "lon", "alt"),
    "vehicle_gps_position": (
        "latitude_deg", "longitude_deg", "altitude_msl_m", "eph", "epv", "hdop", "vdop", "s_variance_m_s",
        "satellites_used", "fix_type", "time_utc_usec",
    ),
    "vehicle_attitude": ("q[0]", "q[3]"),
    "vehicle_attitude_groundtruth": ("q[0]", "q[3]"),
    "vehicle_attitude_setpoint": ("q_d[0]", "q_d[3]", "yaw_sp_move_rate"),
    "vehicle_angular_velocity": ("xyz[0]", "xyz[2]"),
    "vehicle_angular_velocity_groundtruth": ("xyz[0]", "xyz[2]"),
    "vehicle_rates_setpoint": ("roll", "pitch", "yaw"),
    "rate_ctrl_status": ("rollspeed_integ", "pitchspeed_integ", "yawspeed_integ"),
    "vehicle_torque_setpoint": ("xyz[0]", "xyz[2]"),
    "vehicle_thrust_setpoint": ("xyz[0]", "xyz[2]"),
    "actuator_motors": ("control[0]", "control[3]"),
    "battery_status": ("voltage_v", "current_a", "discharged_mah", "remaining"),
    "failsafe_flags": ("offboard_control_signal_lost", "battery_warning"),
}  # fmt: skip
"""The fields by which its `configured_plots.py` draws what a multicopter has."""


def test_a_run_has_what_flight_review_draws(run: Path) -> None:
    tables = joined(run).tables
    for topic, fields in FLIGHT_REVIEW.items():
        if topic != "vehicle_local_position_setpoint":  # of a run the ground's reference: see test_convert.py
            assert set(fields) <= flat(tables[topic]).keys(), topic
    fast = ("vehicle_attitude", "vehicle_angular_velocity", "vehicle_torque_setpoint", "actuator_motors")
    for topic in fast:  # spectra are drawn from 100 Hz on
        assert np.median(np.diff(tables[topic]["timestamp"].astype(np.int64))) <= 10_000


def test_what_pyulog_and_flight_review_ask_of_the_file(run: Path) -> None:
    log = ULog(str(run / "vehicle.ulg"))
    assert log.get_version_info_str() == "v0.1.0"
    assert log.msg_info_dict["sys_name"] == "mavsitl"
    assert log.msg_info_dict["ver_data_format"] == 2  # positions are degrees
    assert "boot_time_utc_us" not in log.msg_info_dict  # in lock-step nothing depends on the time of day
    px4 = PX4ULog(log)
    px4.add_roll_pitch_yaw()
    assert px4.get_mav_type() == "Quadrotor"
    assert log.initial_parameters["SYS_AUTOSTART"] == 5001
    assert len(log.initial_parameters) > 250
    assert all(message.message for message in log.logged_messages)


def test_equal_flights_write_equal_logs(run: Path, tmp_path: Path) -> None:
    again = fly(tmp_path / "again")
    for name in ("vehicle.ulg", "ground.ulg", "link.tlog"):
        assert (again / name).read_bytes() == (run / name).read_bytes()


def airborne() -> tuple[Client, MemoryRecorder]:
    client = take_off(Client(flight()))
    log = client.vehicle._recorder
    assert isinstance(log, MemoryRecorder)
    return client, log


@pytest.fixture(scope="module")
def flown() -> MemoryRecorder:
    """Take-off, a reposition, a parameter, sticks."""
    client, log = airborne()
    go_to(client, 2.0, -3.0, 2.5)
    client.send(parameter("MPC_XY_VEL_MAX", 3.0))
    client.run(3.0)
    client.run(1.0, sticks(client))
    return log


def test_setpoints_of_the_vehicle_s_own_loops_are_logged(flown: MemoryRecorder) -> None:
    position = flown.arrays(topics.LOCAL_POSITION_SETPOINT)
    assert position["x"][-1] == pytest.approx(2.0, abs=0.3)
    assert position["y"][-1] == pytest.approx(3.0, abs=0.3)  # east
    assert position["z"][-1] == pytest.approx(-2.5, abs=0.2)  # down
    attitude, wanted = flown.arrays(topics.ATTITUDE), flown.arrays(topics.ATTITUDE_SETPOINT)
    assert wanted["timestamp"].size
    rows = np.searchsorted(attitude["timestamp"], wanted["timestamp"])
    along = np.abs(np.sum(attitude["q"][rows] * wanted["q_d"], axis=1))
    assert np.degrees(2.0 * np.arccos(np.clip(along, 0.0, 1.0))).max() < 15.0  # it follows
    w, x, y, z = wanted["q_d"].T.astype(float)
    np.testing.assert_allclose(wanted["roll_body"], np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), atol=1e-5)
    rates = flown.arrays(topics.RATES_SETPOINT)
    np.testing.assert_array_equal(rates["timestamp"], wanted["timestamp"])
    np.testing.assert_array_equal(rates["thrust_body"], wanted["thrust_body"])
    assert rates["thrust_body"][-1, 2] < -0.2
    torque = flown.arrays(topics.TORQUE_SETPOINT)
    assert set(np.diff(torque["timestamp"].astype(np.int64))) == {8000}
    assert 0.0 < np.abs(torque["xyz"]).max() < 1.0
    assert set(np.diff(flown.arrays(topics.RATE_STATUS)["timestamp"].astype(np.int64))) == {20_000}


def test_positions_on_the_globe_are_those_on_the_plane(flown: MemoryRecorder) -> None:
    local, globe = flown.arrays(topics.LOCAL_POSITION_TRUTH), flown.arrays(topics.GLOBAL_POSITION_TRUTH)
    assert set(np.diff(globe["timestamp"].astype(np.int64))) == {200_000}
    rows = np.searchsorted(local["timestamp"], globe["timestamp"])
    origin = scenario.load("takeoff-hover").scenario.start
    north_m = np.radians(globe["lat"] - origin.latitude_deg) * 6_371_000.0
    east_m = np.radians(globe["lon"] - origin.longitude_deg) * 6_371_000.0 * np.cos(np.radians(origin.latitude_deg))
    np.testing.assert_allclose(north_m, local["x"][rows], atol=1e-3)
    np.testing.assert_allclose(east_m, local["y"][rows], atol=1e-3)
    np.testing.assert_allclose(globe["alt"], origin.altitude_amsl_m - local["z"][rows], atol=1e-3)


def test_commands_texts_and_parameters_are_logged(flown: MemoryRecorder) -> None:
    commands, answers = flown.arrays(topics.COMMAND), flown.arrays(topics.COMMAND_ACK)
    assert mavlink.MAV_CMD_NAV_TAKEOFF in commands["command"]
    assert mavlink.MAV_CMD_DO_REPOSITION in commands["command"]
    np.testing.assert_array_equal(commands["command"], answers["command"])
    assert set(answers["result"]) == {mavlink.MAV_RESULT_ACCEPTED}
    assert any(text == "Armed by external command" for _, _, text in flown.messages)
    assert ("MPC_XY_VEL_MAX", 3.0) in flown.changes
    assert flown.parameters["MAV_TYPE"] == 2


def test_states_have_px4_s_numbers(flown: MemoryRecorder) -> None:
    status = flown.arrays(topics.VEHICLE_STATUS)
    assert {17, 4} <= set(status["nav_state"])  # take-off, hold
    assert set(status["system_type"]) == {mavlink.MAV_TYPE_QUADROTOR}
    assert status["arming_state"][-1] == topics.ARMED
    assert HOLD == (4, 3)
    battery = flown.arrays(topics.BATTERY_STATUS)
    assert battery["discharged_mah"][-1] > battery["discharged_mah"][0] == 0.0
    assert 0.9 < battery["remaining"][-1] < 1.0
    stick = flown.arrays(topics.MANUAL_CONTROL)
    assert stick["timestamp"].size >= 9
    assert (stick["throttle"][-1], stick["roll"][-1]) == (0.0, 0.0)
    flags = flown.arrays(topics.FAILSAFE_FLAGS)
    assert flags["manual_control_signal_lost"][0] == 1
    assert flags["manual_control_signal_lost"][-1] == 0
    fix = flown.arrays(topics.GPS_POSITION)
    assert set(fix["fix_type"]) == {mavlink.GPS_FIX_TYPE_3D_FIX}
    assert flown.arrays(topics.HOME_POSITION)["lat"].size


def test_validity_counts_from_the_row_on_that_has_it() -> None:
    client, log = airborne()
    record, before = client.vehicle._record, client.vehicle._record._window.newest_us
    record.valid(Validity(position=False))
    client.run(0.1)
    position = log.arrays(topics.LOCAL_POSITION)
    lost = position["timestamp"] > before
    assert lost.any()
    np.testing.assert_array_equal(position["xy_valid"], (~lost).astype(np.uint8))
    assert position["z_valid"].all()
