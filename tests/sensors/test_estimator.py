"""The estimator in flight: how it begins, what it does without GPS and after, late measurements, the same bits."""

from __future__ import annotations

import os
import subprocess
import sys
from math import radians, sqrt
from typing import Any

import msgspec
import numpy as np
import pytest
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.failures import Kind, Unit
from mavsitl_vehicle.sensors import ekf, imu
from mavsitl_vehicle.sensors.status import SensorHealth
from mavsitl_vehicle.simulation import Simulation

from mavsitl.scenario import Imu, load
from tests.sensors.rig import PERIOD_S, Rig, up
from tests.sensors.same_bits import fly

VALID = {"attitude_valid": True, "height_valid": True, "velocity_valid": True, "position_valid": True}


# --- how it begins


@pytest.mark.parametrize("scenario", ["takeoff-hover", "hover-wind"])
def test_within_a_second_at_rest_it_knows_enough_to_arm(scenario: str) -> None:
    """On the ground and in the clamp; the gyro's bias to a hundredth of what it was."""
    rig = Rig(scenario=scenario)
    assert not any((rig.status.attitude_valid, rig.status.height_valid, rig.status.position_valid))
    rig.rest(1.0)
    assert {name: getattr(rig.status, name) for name in VALID} == VALID
    assert rig.status.sensors == SensorHealth()
    bias = rig.sensed.imu.state[imu.BIAS : imu.BIAS + 3]
    assert np.abs(bias).max() > radians(0.2)
    assert np.abs(rig.sensed.x[ekf.GYRO_BIAS : ekf.GYRO_BIAS + 3] - bias).max() < radians(0.02)
    assert np.abs(rig.position_error).max() < 0.03  # the local frame is where it begins


def test_in_the_clamp_with_rotors_running_it_stays_aligned() -> None:
    rig = Rig(scenario="hover-wind")
    rig.rest(1.0)
    rig.simulation.demand[:] = 0.0
    rig.simulation.demand[0], rig.simulation.demand[1], rig.simulation.demand[11] = 3.0, 1.0, 0.5
    for _ in range(2500):
        rig.simulation.advance(-1.0)
    assert (rig.simulation.x[13:] > 50.0).all()
    assert rig.status.position_valid
    assert np.abs(rig.position_error).max() < 0.03
    assert np.abs(rig.simulation.estimate[3:6]).max() < 0.01


def test_it_does_not_begin_while_the_gyro_says_that_it_turns() -> None:
    rig = Rig(parameters={"SIM_GYR_BIAS_Z": 1.0})
    rig.rest(2.0)
    assert not rig.status.attitude_valid
    rig.parameters.set("SIM_GYR_BIAS_Z", 0.0)
    rig.rest(1.0)
    assert rig.status.attitude_valid


def test_begun_anew_elsewhere_gps_and_barometer_tell_where() -> None:
    rig = up()
    rig.simulation.put_back(0)
    rig.rest(1.0)
    assert np.abs(rig.position_error).max() < 0.03
    rig.simulation.x[:3, 0] += (7.0, -4.0, 2.0)
    rig.simulation.restart_estimator()
    assert rig.status.position_valid  # until its next look
    rig.rest(0.1)
    assert not rig.status.position_valid
    rig.rest(1.0)
    assert rig.status.position_valid
    assert 4.0 * rig.status.eph_m > np.abs(rig.position_error[:2]).max()
    assert np.abs(rig.position_error).max() < 1.0


# --- without GPS


def test_without_gps_it_reckons_on_and_says_so_after_the_time_out() -> None:
    rig = up()
    before = rig.status
    rig.break_(Unit.GPS, Kind.OFF)
    took = rig.until(10.0, position_valid=False)
    assert took == pytest.approx(5.0 + 0.1, abs=0.12)  # EKF2_NOAID_TOUT, from the last fix; one came every 0.1 s
    status = rig.status
    assert (status.velocity_valid, status.height_valid, status.attitude_valid) == (False, True, True)
    assert status.dead_reckoning
    assert not status.sensors.gps
    assert status.eph_m > 2.0 * before.eph_m
    assert status.evh_m_s > 2.0 * before.evh_m_s
    rig.fly(10.0)
    assert np.abs(rig.position_error[:2]).max() < 4.0 * rig.status.eph_m
    assert np.abs(rig.position_error[2]) < 1.0  # the barometer goes on
    rig.break_(Unit.GPS, Kind.OK)
    assert rig.until(1.0, **VALID) < 0.3
    rig.fly(3.0)
    assert not rig.status.dead_reckoning
    assert rig.status.evh_m_s < 2.0 * before.evh_m_s


def test_the_time_out_is_a_parameter() -> None:
    rig = up()
    rig.parameters.set("EKF2_NOAID_TOUT", 1_000_000)
    rig.break_(Unit.GPS, Kind.OFF)
    assert rig.until(3.0, position_valid=False) == pytest.approx(1.1, abs=0.12)


def test_a_spoofed_position_is_refused_at_first_and_believed_after_seven_seconds() -> None:
    rig = up()
    rig.parameters.set("SIM_GPS_GLITCH_N", 20.0)
    rig.fly(1.0)
    assert rig.status.position_ratio > 1.0
    assert rig.status.position_valid  # its velocity still fits
    assert np.abs(rig.position_error).max() < 0.3
    rig.fly(7.0)
    assert rig.status.resets == 1
    assert rig.status.position_ratio < 1.0
    assert rig.position_error[0] == pytest.approx(20.0, abs=1.0)


def test_slow_spoofing_that_the_velocity_does_not_show_is_taken_for_the_receivers_slow_error() -> None:
    rig = up()
    for second in range(1, 31):
        rig.parameters.set("SIM_GPS_GLITCH_E", 0.1 * second)
        rig.fly(1.0)
    assert rig.status.resets == 0
    assert rig.status.position_ratio < 1.0
    assert np.abs(rig.position_error).max() < 0.8
    assert rig.sensed.x[ekf.GPS_OFFSET + 1, 0] - rig.sensed.gps._drift[1, 0] == pytest.approx(-3.0, abs=0.8)


def test_jamming_costs_satellites_and_accuracy_and_at_last_the_fix() -> None:
    rig = up()
    assert rig.sensed.readings().gps is not None
    rig.parameters.set("SIM_GPS_JAM", 0.3)
    rig.fly(3.0)
    reading = rig.sensed.readings().gps
    assert reading is not None
    assert reading.satellites == 7
    assert reading.evs_m_s == pytest.approx(0.05 * 10.0)
    assert rig.status.position_valid
    rig.parameters.set("SIM_GPS_JAM", 0.5)
    rig.fly(1.0)
    assert not rig.status.sensors.gps  # five satellites: a fix, and not a good one
    assert rig.sensed.readings().gps is not None
    rig.parameters.set("SIM_GPS_JAM", 1.0)
    rig.fly(1.0)
    assert rig.sensed.readings().gps is None
    rig.until(6.0, position_valid=False)


# --- late measurements


def error_while_moving(delay_ms: float, *, late: bool = False) -> float:
    """RMS of the position's error on a circle with 3 m/s, m; `late` by a delay that the filter does not know."""
    rig = Rig(estimator__gps__delay_ms=delay_ms, estimator__gps__horizontal_drift_m=0.01)
    rig.rest(1.0)
    rig.fly(4.0)
    if late:
        rig.break_(Unit.GPS, Kind.DELAYED)
    errors = []
    for tick in range(round(12.0 / PERIOD_S)):
        angle = 1.0 * tick * PERIOD_S
        rig.tick((3.0 * np.sin(angle), 3.0 * np.cos(angle), 5.0))
        errors.append(float(np.linalg.norm(rig.position_error[:2])))
    return sqrt(np.mean(np.square(errors[1000:])))


def test_a_known_delay_costs_little_and_an_unknown_one_much() -> None:
    at_once, known = error_while_moving(0.0), error_while_moving(300.0)
    assert known < 0.3
    assert known < at_once + 0.1
    assert error_while_moving(100.0, late=True) > 3.0 * known


# --- the sensors' numbers


def test_the_imus_noise_has_the_density_of_its_settings() -> None:
    """Allan's way: the mean over a period scatters by the density over the root of the period."""
    for scale in (1.0, 3.0):
        rig = Rig(estimator__imu__gyro_bias_walk_deg_s_rt_s=0.0, parameters={"SIM_NOISE_SCALE": scale})
        deltas = []
        for _ in range(1000):
            rig.rest(PERIOD_S)
            deltas.append(rig.sensed.imu.state[imu.DELTA : imu.DELTA + 6, 0] / PERIOD_S)
        spread = np.std(deltas, axis=0)
        assert spread[:3] == pytest.approx(scale * radians(0.006) / sqrt(PERIOD_S), rel=0.15)
        assert spread[3:] == pytest.approx(scale * 0.0015 / sqrt(PERIOD_S), rel=0.15)


def test_the_imu_measures_what_the_body_does() -> None:
    """Without noise and bias the strapdown over the IMU's integrals is the plant's motion."""
    quiet: dict[str, Any] = {f"estimator__imu__{key}": 0.0 for key in msgspec.structs.asdict(Imu())}
    rig = Rig(**quiet)
    rig.rest(1.0)
    x = np.zeros((ekf.STATE_ROWS, 1))
    x[:10] = rig.simulation.x[:10]
    for tick in range(1000):
        rig.tick((3.0 * np.sin(0.01 * tick), 2.0, 5.0), yaw_rad=0.002 * tick)
        delta = rig.sensed.imu.state[imu.DELTA : imu.DELTA + 6]
        ekf.strapdown(x, delta[:3], delta[3:], PERIOD_S, 9.81, 0)
    assert np.abs(rig.simulation.x[3:6]).max() > 0.5
    assert x[6:10] == pytest.approx(rig.simulation.x[6:10], abs=1e-4)
    assert x[3:6] == pytest.approx(rig.simulation.x[3:6], abs=0.01)
    assert x[:3] == pytest.approx(rig.simulation.x[:3], abs=0.02)


# --- the same bits


def test_unjitted_is_jitted() -> None:
    here = fly()
    plain = subprocess.run(
        [sys.executable, "-m", "tests.sensors.same_bits"],
        env={**os.environ, "MAVSITL_JIT": "0"},
        check=True,
        capture_output=True,
    ).stdout
    assert plain == here


def test_a_seed_is_a_flight() -> None:
    assert fly(3) == fly(3)
    assert fly(3) != fly(4)


def test_a_lane_of_a_fleet_is_the_vehicle_alone() -> None:
    alone, fleet = up(), up(n=3)
    for one, of_three in (
        (alone.simulation.estimate, fleet.simulation.estimate),
        (alone.sensed.x, fleet.sensed.x),
        (alone.sensed.p, fleet.sensed.p),
    ):
        assert (one[..., 0] == of_three[..., 0]).all()
    assert fleet.sensed.x[ekf.GYRO_BIAS, 1] != fleet.sensed.x[ekf.GYRO_BIAS, 0]


# --- white noise


def test_white_noise_is_always_valid_and_has_no_sensors() -> None:
    flight = load("hover-wind")
    simulation = Simulation(flight, Parameters(flight.airframe.parameters), 1)
    status = simulation.estimator_status
    assert {name: getattr(status, name) for name in VALID} == VALID
    assert (status.eph_m, status.evv_m_s) == (0.005, 0.005)
    assert status.tilt_rad == pytest.approx(radians(0.02))
    assert simulation.readings is None
    simulation.advance(0.0)
    assert simulation.estimator_status is status
