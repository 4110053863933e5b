"""Each failure of a sensor does what its row of `failures.TABLE` says."""

from __future__ import annotations

from math import radians

import numpy as np
import pytest
from mavsitl_vehicle.failures import SENSORS, TABLE, Kind, Unit
from mavsitl_vehicle.sensors import imu
from mavsitl_vehicle.sensors.slow import SlowSensor
from numpy.typing import NDArray

from tests.sensors.rig import PERIOD_S, Rig, up

Array = NDArray[np.float64]

IMU = {Unit.GYRO: slice(imu.GYRO, imu.GYRO + 3), Unit.ACCEL: slice(imu.ACCEL, imu.ACCEL + 3)}
GARBAGE = {Unit.GYRO: imu.GARBAGE_GYRO_RAD_S, Unit.ACCEL: imu.GARBAGE_ACCEL_M_S2}
WRONG = {Unit.GYRO: radians(20.0), Unit.ACCEL: 3.0}
SLOW_SENSORS = (Unit.GPS, Unit.BARO, Unit.MAG)


def test_every_sensor_has_every_kind() -> None:
    assert {(unit, kind) for unit in SENSORS for kind in Kind if kind is not Kind.OK} <= set(TABLE)


# --- gyro and accelerometer: what the rate loop and the filter see at rest


def samples(unit: Unit, kind: Kind, ticks: int = 500) -> tuple[Array, Array]:
    """After 0.4 s of health: the newest sample of each period (ticks, 3), and how many came in it (ticks,)."""
    rig = Rig(scenario="hover-calm", rates__physics_hz=250)  # a sample a period
    rig.rest(0.4)
    rig.break_(unit, kind)
    values, fresh = np.empty((ticks, 3)), np.empty(ticks)
    for tick in range(ticks):
        rig.rest(PERIOD_S)
        values[tick] = rig.sensed.imu.state[IMU[unit], 0]
        fresh[tick] = rig.sensed.imu.state[imu.FRESH + (unit is Unit.ACCEL), 0]
    return values, fresh


@pytest.mark.parametrize("unit", IMU)
def test_imu_off_and_stuck(unit: Unit) -> None:
    off, none = samples(unit, Kind.OFF)
    stuck, all_ = samples(unit, Kind.STUCK)
    assert (off == off[0]).all()
    assert (stuck == stuck[0]).all()
    assert (off[0] == stuck[0]).all()
    assert not none.any()
    assert (all_ == 1.0).all()


@pytest.mark.parametrize("unit", IMU)
def test_imu_garbage_and_wrong(unit: Unit) -> None:
    well, _ = samples(unit, Kind.OK)
    garbage, _ = samples(unit, Kind.GARBAGE)
    wrong, _ = samples(unit, Kind.WRONG)
    assert np.std(garbage, axis=0) == pytest.approx(GARBAGE[unit], rel=0.1)
    assert wrong - well == pytest.approx(WRONG[unit])


@pytest.mark.parametrize("unit", IMU)
def test_imu_slow_late_and_intermittent(unit: Unit) -> None:
    well, _ = samples(unit, Kind.OK)
    slow, came = samples(unit, Kind.SLOW)
    assert came.sum() == pytest.approx(50.0 * 500 * PERIOD_S, abs=1)
    assert len(np.unique(slow[:, 0])) == pytest.approx(came.sum(), abs=1)
    late, _ = samples(unit, Kind.DELAYED)
    steps = round(imu.DELAY_S / PERIOD_S)
    assert (late[steps:] == well[:-steps]).all()
    seldom, there = samples(unit, Kind.INTERMITTENT)
    assert 0.25 < there.mean() < 0.75
    assert (seldom[there == 1.0] == well[there == 1.0]).all()
    gone = np.flatnonzero(there == 0.0)
    gone = gone[gone > 0]
    assert (seldom[gone] == seldom[gone - 1]).all()


def test_the_rate_loop_sees_the_gyros_failure() -> None:
    """A gyro that says 20 deg/s too much makes the vehicle turn the other way until the filter knows."""
    well, wrong = up(), up()
    wrong.break_(Unit.GYRO, Kind.WRONG)
    well.fly(0.1)
    wrong.fly(0.1)
    turned = wrong.simulation.x[10:13, 0] - well.simulation.x[10:13, 0]
    assert (turned[:2] < -radians(5.0)).all()


@pytest.mark.parametrize(
    ("unit", "invalid"),
    [
        (Unit.GYRO, {"attitude_valid", "velocity_valid", "position_valid", "height_valid"}),
        (Unit.ACCEL, {"velocity_valid", "position_valid", "height_valid"}),
    ],
)
def test_without_imu_samples_the_estimate_is_not_valid_at_once(unit: Unit, invalid: set[str]) -> None:
    rig = Rig()
    rig.rest(1.0)
    rig.break_(unit, Kind.OFF)
    rig.rest(0.09)
    assert rig.status.attitude_valid
    rig.rest(0.05)
    names = {"attitude_valid", "velocity_valid", "position_valid", "height_valid"}
    assert {name for name in names if not getattr(rig.status, name)} == invalid
    assert not (rig.status.sensors.gyro if unit is Unit.GYRO else rig.status.sensors.accelerometer)
    rig.break_(unit, Kind.OK)
    rig.rest(1.0)
    assert all(getattr(rig.status, name) for name in names)
    assert np.abs(rig.position_error).max() < 0.2


# --- GPS, barometer, magnetometer: what comes


def sensor(rig: Rig, unit: Unit) -> SlowSensor:
    return {Unit.GPS: rig.sensed.gps, Unit.BARO: rig.sensed.barometer, Unit.MAG: rig.sensed.magnetometer}[unit]


def measurements(unit: Unit, kind: Kind, seconds: float = 12.0) -> list[tuple[float, Array]]:
    """(time since the failure, values) of what comes, after 1 s of health."""
    rig = Rig(scenario="hover-calm", rates__physics_hz=250)
    rig.rest(1.0)
    rig.break_(unit, kind)
    one, found = sensor(rig, unit), []
    for tick in range(round(seconds / PERIOD_S)):
        rig.rest(PERIOD_S)
        found += [(tick * PERIOD_S, came.values[:, 0]) for each, came in rig.sensed.came if each is one]
    return found


@pytest.mark.parametrize("unit", SLOW_SENSORS)
def test_off_ends_what_comes(unit: Unit) -> None:
    delay_s = 0.1 if unit is Unit.GPS else 0.0
    assert [time_s for time_s, _ in measurements(unit, Kind.OFF, 2.0) if time_s > delay_s] == []


@pytest.mark.parametrize("unit", SLOW_SENSORS)
def test_stuck_goes_on_and_does_not_change(unit: Unit) -> None:
    well, stuck = measurements(unit, Kind.OK, 2.0), measurements(unit, Kind.STUCK, 2.0)
    assert len(stuck) == len(well)
    assert all((values == stuck[-1][1]).all() for _, values in stuck[1:])
    assert any((values != well[-1][1]).any() for _, values in well[1:-1])


@pytest.mark.parametrize("unit", SLOW_SENSORS)
def test_wrong_is_an_offset_and_garbage_is_noise(unit: Unit) -> None:
    well = measurements(unit, Kind.OK)
    one = sensor(Rig(), unit)
    offsets = np.array([b - a for (_, a), (_, b) in zip(well, measurements(unit, Kind.WRONG), strict=True)][2:])
    assert offsets == pytest.approx(np.broadcast_to(one.WRONG, offsets.shape))  # type: ignore[attr-defined]
    assert np.abs(offsets).max() > 0.1
    noise = np.array([b - a for (_, a), (_, b) in zip(well, measurements(unit, Kind.GARBAGE), strict=True)][2:])
    assert np.std(noise, axis=0) == pytest.approx(np.array(one.GARBAGE), rel=0.3)  # type: ignore[attr-defined]


@pytest.mark.parametrize("unit", SLOW_SENSORS)
def test_slow_late_and_intermittent(unit: Unit) -> None:
    well = measurements(unit, Kind.OK)
    assert len(measurements(unit, Kind.SLOW)) == pytest.approx(len(well) / 10, abs=2)
    late = dict(measurements(unit, Kind.DELAYED))
    healthy = {round(time_s, 3): values for time_s, values in well}
    for time_s, values in late.items():
        if time_s > 1.0:
            assert (values == healthy[round(time_s - 0.5, 3)]).all()
    assert 0.2 < len(measurements(unit, Kind.INTERMITTENT)) / len(well) < 0.8


# --- what it means in flight


def test_without_the_barometer_gps_holds_the_height() -> None:
    rig = up()
    rig.break_(Unit.BARO, Kind.OFF)
    rig.fly(8.0)
    assert not rig.status.sensors.barometer
    assert rig.status.height_valid
    assert abs(rig.position_error[2]) < 0.5


def test_a_wrong_height_is_refused_and_then_another_offset() -> None:
    rig = up()
    rig.break_(Unit.BARO, Kind.WRONG)
    rig.fly(1.0)
    assert rig.status.height_ratio > 1.0
    rig.fly(6.0)
    assert rig.status.height_ratio < 1.0
    assert rig.status.resets == 1
    assert abs(rig.position_error[2]) < 0.5


def test_without_any_height_it_is_not_valid_after_five_seconds() -> None:
    rig = up()
    rig.break_(Unit.BARO, Kind.OFF)
    rig.break_(Unit.GPS, Kind.OFF)
    assert rig.until(7.0, height_valid=False) == pytest.approx(5.05, abs=0.12)
    assert rig.status.attitude_valid
    rig.break_(Unit.BARO, Kind.OK)
    rig.until(1.0, height_valid=True)


@pytest.mark.parametrize("kind", [Kind.OFF, Kind.STUCK, Kind.GARBAGE, Kind.WRONG])
def test_the_flight_goes_on_without_a_good_magnetometer(kind: Kind) -> None:
    """PX4's own tests "continue on mag lost" and "stuck"."""
    rig = up()
    rig.break_(Unit.MAG, kind)
    rig.fly(10.0)
    assert rig.status.attitude_valid
    assert rig.status.sensors.magnetometer is (kind is not Kind.OFF)
    assert np.abs(rig.position_error).max() < 0.5
    assert np.linalg.norm(rig.simulation.x[:2, 0]) < 0.7


def test_gps_garbage_is_refused() -> None:
    rig = up()
    rig.break_(Unit.GPS, Kind.GARBAGE)
    rig.fly(5.0)
    assert np.abs(rig.position_error).max() < 3.0


def test_an_accelerometer_that_returns_is_caught_by_gps() -> None:
    """It says free fall for a while, and the velocity runs off; with its first fix GPS has it again."""
    rig = up()
    rig.break_(Unit.ACCEL, Kind.OFF)
    rig.sensed.imu.state[imu.ACCEL : imu.ACCEL + 3] = 0.0
    rig.fly(0.5)
    assert not rig.status.position_valid
    assert abs(rig.simulation.estimate[5, 0] - rig.simulation.x[5, 0]) > 0.5
    rig.break_(Unit.ACCEL, Kind.OK)
    rig.fly(0.5)
    assert rig.status.position_valid
    assert np.abs(rig.simulation.estimate[3:6, 0] - rig.simulation.x[3:6, 0]).max() < 0.2
    rig.fly(3.0)
    assert np.abs(rig.position_error).max() < 0.6


@pytest.mark.parametrize("unit", sorted(SENSORS))
@pytest.mark.parametrize("kind", [kind for kind in Kind if kind is not Kind.OK])
def test_whatever_fails_the_filter_stays_finite(unit: Unit, kind: Kind) -> None:
    """In the air, and often soon on the ground: no exception, no NaN, a covariance that is still one."""
    rig = up()
    rig.break_(unit, kind)
    rig.fly(8.0)
    rig.break_(unit, Kind.OK)
    rig.fly(1.0)
    p = rig.sensed.p[:, :, 0]
    assert np.isfinite(rig.simulation.estimate).all()
    scale = 1.0 / np.sqrt(np.diagonal(p))
    assert np.linalg.eigvalsh(p * np.outer(scale, scale)).min() > 0.0
