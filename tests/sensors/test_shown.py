"""What ground stations see of sensors and filter: health, arming, ESTIMATOR_STATUS, GPS_RAW_INT and the rest."""

from __future__ import annotations

from math import atan2, hypot, nan, radians
from typing import Any

import numpy as np
import pytest
from mavsitl_vehicle.failures import Kind, Unit
from mavsitl_vehicle.sensors import imu

from mavsitl import drivers, scenario, wings
from mavsitl.dialect import mavlink
from mavsitl.ends import NullRecorder
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.scenario import ScenarioError, load
from tests.autopilot.conftest import Client

SENSORS = {
    Unit.GYRO: mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO,
    Unit.ACCEL: mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL,
    Unit.MAG: mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG,
    Unit.BARO: mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE,
    Unit.GPS: mavlink.MAV_SYS_STATUS_SENSOR_GPS,
}
HORIZONTAL = mavlink.ESTIMATOR_POS_HORIZ_ABS | mavlink.ESTIMATOR_VELOCITY_HORIZ


def client(**changes: Any) -> Client:
    overrides = {key.replace("__", "."): value for key, value in changes.items()}
    return Client(load("takeoff-hover", {"estimator.kind": "ekf", **overrides}))


def request(one: Client, name: str) -> Any:
    message_id = getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
    assert one.result(mavlink.MAV_CMD_REQUEST_MESSAGE, message_id, 0, 0, 0, 0, 0, 0) == mavlink.MAV_RESULT_ACCEPTED
    return one.last(name)


def test_arming_waits_for_the_filter() -> None:
    one = client()
    one.hold()
    one.run(0.2)
    assert one.arm() == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    one.run(0.8)
    assert any("attitude estimate invalid" in text for text in one.texts())
    assert one.arm() == mavlink.MAV_RESULT_ACCEPTED


@pytest.mark.parametrize("unit", SENSORS)
def test_a_dead_sensor_is_unhealthy_and_keeps_the_vehicle_on_the_ground(unit: Unit) -> None:
    one = client()
    one.run(2.0)
    assert request(one, "SYS_STATUS").onboard_control_sensors_health & SENSORS[unit]
    one.vehicle.failures.set(unit, Kind.OFF)
    one.run(1.0)
    assert not request(one, "SYS_STATUS").onboard_control_sensors_health & SENSORS[unit]
    assert one.arm() == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    one.vehicle.failures.set(unit, Kind.OK)
    one.run(1.0)
    assert request(one, "SYS_STATUS").onboard_control_sensors_health & SENSORS[unit]


def test_estimator_status_tells_flags_ratios_and_accuracies() -> None:
    one = client()
    one.run(2.0)
    m, status = request(one, "ESTIMATOR_STATUS"), one.vehicle.simulation.estimator_status
    assert m.flags & HORIZONTAL == HORIZONTAL
    assert m.flags & mavlink.ESTIMATOR_ATTITUDE
    assert not m.flags & mavlink.ESTIMATOR_CONST_POS_MODE
    ratios = (m.vel_ratio, m.pos_horiz_ratio, m.pos_vert_ratio, m.mag_ratio)
    assert ratios == pytest.approx(
        (status.velocity_ratio, status.position_ratio, status.height_ratio, status.mag_ratio), rel=1e-6
    )
    assert 0.0 < max(ratios) < 1.0
    assert (m.pos_horiz_accuracy, m.pos_vert_accuracy) == pytest.approx((status.eph_m, status.epv_m))
    one.vehicle.parameters.set("SIM_GPS_GLITCH_N", 50.0)
    one.run(0.5)
    m = request(one, "ESTIMATOR_STATUS")
    assert m.flags & mavlink.ESTIMATOR_GPS_GLITCH
    assert m.pos_horiz_ratio > 1.0
    one.vehicle.parameters.set("SIM_GPS_GLITCH_N", 0.0)
    one.vehicle.failures.set(Unit.GPS, Kind.OFF)
    one.run(5.5)
    m = request(one, "ESTIMATOR_STATUS")
    assert not m.flags & HORIZONTAL
    assert m.flags & mavlink.ESTIMATOR_CONST_POS_MODE


def test_gps_raw_int_is_the_receivers() -> None:
    one = client()
    one.run(2.0)
    m, fix = request(one, "GPS_RAW_INT"), one.vehicle.simulation.readings
    assert fix is not None
    assert fix.gps is not None
    north, west = one.vehicle.autopilot.origin.to_local(m.lat / 1e7, m.lon / 1e7)
    assert (north, west) == pytest.approx(fix.gps.position_nwu_m[:2], abs=0.02)
    assert hypot(north, west) > 0.1  # its slow error
    assert m.alt / 1e3 == pytest.approx(488.0 + fix.gps.position_nwu_m[2], abs=1e-3)
    assert (m.fix_type, m.satellites_visible) == (mavlink.GPS_FIX_TYPE_3D_FIX, 10)
    assert m.h_acc == pytest.approx(1005, abs=1)
    assert one.now_us - m.time_usec == pytest.approx(150_000, abs=50_001)
    one.vehicle.parameters.set("SIM_GPS_USED", 3)
    one.run(0.5)
    m = request(one, "GPS_RAW_INT")
    assert (m.fix_type, m.satellites_visible) == (mavlink.GPS_FIX_TYPE_NO_FIX, 0)


def test_highres_imu_and_scaled_pressure_are_the_sensors() -> None:
    one = client()
    one.run(2.0)
    m, readings = request(one, "HIGHRES_IMU"), one.vehicle.simulation.readings
    assert readings is not None
    assert readings.mag_flu_gauss is not None
    assert readings.baro_height_m is not None
    p, q, r = readings.gyro_flu_rad_s
    assert (m.xgyro, m.ygyro, m.zgyro) == pytest.approx((p, -q, -r))
    assert max(abs(p), abs(q), abs(r)) > radians(0.1)  # the bias is in it
    assert m.zacc == pytest.approx(-readings.accel_flu_m_s2[2])
    assert atan2(-m.ymag, m.xmag) == pytest.approx(0.0, abs=0.1)
    assert m.pressure_alt == pytest.approx(488.0 + readings.baro_height_m, abs=1e-3)
    assert request(one, "SCALED_PRESSURE").press_abs == pytest.approx(m.abs_pressure, abs=0.1)
    one.vehicle.failures.set(Unit.GYRO, Kind.STUCK)
    one.run(0.1)
    first = request(one, "HIGHRES_IMU").xgyro
    one.run(0.1)
    assert request(one, "HIGHRES_IMU").xgyro == first
    assert first == pytest.approx(float(one.vehicle.simulation.sensed.imu.state[imu.GYRO, 0]))  # type: ignore[union-attr]


def test_odometrys_covariances_are_the_filters() -> None:
    one = client()
    one.run(2.0)
    m, status = request(one, "ODOMETRY"), one.vehicle.simulation.estimator_status
    assert m.pose_covariance[0] == pytest.approx(status.eph_m**2, rel=1e-5)
    assert m.pose_covariance[11] == pytest.approx(status.epv_m**2, rel=1e-5)
    assert m.pose_covariance[20] == pytest.approx(status.heading_rad**2, rel=1e-5)
    assert m.velocity_covariance[0] == pytest.approx(status.evh_m_s**2, rel=1e-5)


def test_it_takes_off_and_lands_by_itself_without_knowing_where_the_ground_is() -> None:
    """AUTO.TAKEOFF, hold, AUTO.LAND with a barometer that drifts: it disarms on the ground."""
    one = client(estimator__barometer__drift_m_rt_s=0.1, parameters={"COM_DISARM_LAND": 1.0})
    one.run(1.0)
    assert one.result(mavlink.MAV_CMD_NAV_TAKEOFF, nan, nan, nan, nan, nan, nan, nan) == mavlink.MAV_RESULT_ACCEPTED
    assert one.arm() == mavlink.MAV_RESULT_ACCEPTED
    one.run_until(lambda: one.truth[2] > 2.0, 15.0)
    one.run(5.0)
    assert not one.landed
    assert one.land() == mavlink.MAV_RESULT_ACCEPTED
    one.run_until(lambda: not one.armed, 30.0)
    assert one.truth[2] < 0.05
    assert one.landed


def test_a_reboot_begins_the_filter_anew() -> None:
    one = client()
    one.run(1.0)
    assert request(one, "ESTIMATOR_STATUS").flags & mavlink.ESTIMATOR_ATTITUDE
    assert one.result(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1, 0, 0, 0, 0, 0, 0) == mavlink.MAV_RESULT_ACCEPTED
    one.run(0.2)
    assert not one.vehicle.autopilot.estimator_status.attitude_valid
    one.run(1.0)
    assert one.vehicle.autopilot.estimator_status.position_valid


# --- the log


def test_each_measurement_is_logged_when_it_came() -> None:
    flight = load("hover-wind-ekf", {"duration_s": 2.0})
    recorder = MemoryRecorder()
    vehicle = wings.find(wings.VEHICLE_GROUP)(flight, recorder, seed=1, lockstep=True)
    drivers.fly_in_memory(vehicle, wings.find(wings.GROUND_GROUP)(flight, NullRecorder()), max_time_s=20.0)
    log = recorder.tables()
    seconds = float(log["vehicle_local_position"]["timestamp"][-1]) / 1e6
    for name, hz in (("vehicle_gps_position", 10.0), ("vehicle_air_data", 50.0), ("vehicle_magnetometer", 50.0)):
        assert len(log[name]["timestamp"]) == pytest.approx(hz * seconds, abs=3), name
    assert len(log["sensor_combined"]["timestamp"]) == pytest.approx(250.0 * seconds, abs=3)
    late = log["vehicle_gps_position"]["timestamp"] - log["vehicle_gps_position"]["timestamp_sample"]
    assert (late == 100_000).all()
    flags = log["estimator_status"]["solution_status_flags"]
    assert flags[0] & HORIZONTAL == 0
    assert flags[-1] & HORIZONTAL == HORIZONTAL
    assert np.abs(log["estimator_sensor_bias"]["gyro_bias"][-1]).max() > radians(0.1)
    assert np.mean(log["sensor_combined"]["accelerometer_m_s2"][:50, 2]) == pytest.approx(-9.81, abs=0.2)


def test_with_white_noise_there_are_no_such_rows() -> None:
    flight, recorder = load("hover-calm", {"duration_s": 0.5}), MemoryRecorder()
    vehicle = wings.find(wings.VEHICLE_GROUP)(flight, recorder, seed=1, lockstep=True)
    drivers.fly_in_memory(vehicle, wings.find(wings.GROUND_GROUP)(flight, NullRecorder()), max_time_s=20.0)
    assert "sensor_combined" not in recorder.tables()


# --- scenarios


@pytest.mark.parametrize("name", scenario.names())
def test_every_shipped_scenario_flies_with_the_filter(name: str) -> None:
    flight = load(name, {"estimator.kind": "ekf", "duration_s": 4.0, "failures": []})
    recorder = MemoryRecorder()
    vehicle = wings.find(wings.VEHICLE_GROUP)(flight, recorder, seed=2, lockstep=True)
    ground = wings.find(wings.GROUND_GROUP)(flight, NullRecorder())
    drivers.fly_in_memory(vehicle, ground, max_time_s=60.0)
    assert ground.succeeded
    log = recorder.tables()
    truth, estimate = log["vehicle_local_position_groundtruth"], log["vehicle_local_position"]
    assert max(np.abs(truth[axis] - estimate[axis]).max() for axis in "xyz") < 0.5


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"estimator.kind": "ekf", "noise.position_m": 0.1}, "noise: is of estimator.kind 'white-noise'"),
        ({"estimator.gps.rate_hz": 5.0}, "estimator: settings of sensors need estimator.kind 'ekf'"),
        ({"estimator.kind": "ekf", "estimator.gps.rate_hz": 500.0}, "estimator.gps.rate_hz: 500 is not allowed"),
        ({"estimator.kind": "ekf", "estimator.gps.delay_ms": 900.0}, "estimator.gps.delay_ms: 900.0 is not allowed"),
        ({"estimator.kind": "kalman"}, "estimator.kind: 'kalman' is not allowed; allowed: 'ekf', 'white-noise'"),
    ],
)
def test_settings_of_the_other_kind_are_refused(overrides: dict[str, Any], words: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load("hover-calm", overrides)
    assert words in str(caught.value)
