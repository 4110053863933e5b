"""A vehicle that estimates its state, hovering, when a sensor fails: PX4's own tests ask the same of PX4."""

from __future__ import annotations

from math import dist

import pytest
from mavsitl_vehicle.autopilot.modes import Mode
from mavsitl_vehicle.failures import Kind, Unit

from mavsitl.scenario import load
from tests.autopilot.conftest import Client
from tests.autopilot.copter import take_off

HEIGHT_M = 5.0


def hovering() -> Client:
    client = Client(load("takeoff-hover", {"estimator.kind": "ekf"}))
    client.run(2.0)
    take_off(client, HEIGHT_M)
    client.run(3.0)
    return client


@pytest.mark.parametrize(
    ("unit", "kind", "within_m"),
    [
        (Unit.MAG, Kind.OFF, 0.6),
        (Unit.MAG, Kind.STUCK, 0.6),
        (Unit.BARO, Kind.OFF, 0.6),
        (Unit.BARO, Kind.STUCK, 0.8),
    ],
)
def test_it_goes_on_without_one_of_two_sources(unit: Unit, kind: Kind, within_m: float) -> None:
    client = hovering()
    begun = client.truth[:3]
    client.vehicle.failures.set(unit, kind)
    farthest = 0.0
    for _ in range(300):
        client.run(0.1)
        farthest = max(farthest, dist(client.truth[:3], begun))
    assert client.vehicle.autopilot.commander.mode.name == "LOITER"
    assert client.armed
    assert farthest < within_m


def test_without_gps_it_descends_lands_and_disarms_within_30_s() -> None:
    client = hovering()
    client.vehicle.failures.set(Unit.GPS, Kind.OFF)
    begun_us = client.now_us
    client.run_until(lambda: client.vehicle.autopilot.commander.mode.name == "DESCEND", 6.0)
    assert (client.now_us - begun_us) / 1e6 == pytest.approx(5.0, abs=0.3)  # EKF2_NOAID_TOUT
    client.run_until(lambda: not client.armed, 25.0)
    assert client.truth[2] < 0.1
    assert "Failsafe activated: position estimate lost, descend" in client.texts()


def test_a_position_known_worse_than_the_limit_is_lost_and_must_be_better_to_return() -> None:
    client = hovering()
    known_m = client.vehicle.autopilot.estimator_status.eph_m
    client.vehicle.parameters.put("COM_POS_FS_EPH", known_m / 2.0)  # 2.5 times of it are allowed to what is known
    client.run(0.5)
    assert client.vehicle.autopilot.commander.mode.name == "LOITER"
    client.vehicle.parameters.put("COM_POS_FS_EPH", known_m / 3.0)
    client.run(0.5)
    assert client.vehicle.autopilot.commander.mode.name == "DESCEND"
    client.vehicle.parameters.put("COM_POS_FS_EPH", known_m / 2.0)
    client.run(0.5)
    assert not client.vehicle.autopilot.valid.position
    client.vehicle.parameters.put("COM_POS_FS_EPH", known_m * 1.5)
    client.run(0.5)
    assert client.vehicle.autopilot.valid.position


def test_gps_that_returns_gives_the_position_back() -> None:
    client = hovering()
    client.vehicle.failures.set(Unit.GPS, Kind.OFF)
    client.run(4.0)
    client.vehicle.failures.set(Unit.GPS, Kind.OK)
    client.run(3.0)
    assert client.vehicle.autopilot.commander.mode.name == "LOITER"
    assert client.vehicle.autopilot.valid.position


@pytest.mark.parametrize(("unit", "mode"), [(Unit.GYRO, Mode.TERMINATION), (Unit.ACCEL, Mode.DESCEND)])
def test_without_an_inertial_sensor_the_worst_that_can_still_be_flown_acts_at_once(unit: Unit, mode: Mode) -> None:
    client = hovering()
    client.vehicle.failures.set(unit, Kind.OFF)
    client.run(0.25)
    assert client.vehicle.autopilot.commander.mode is mode
    assert client.vehicle.autopilot.commander.failsafe
