"""The program by MAVSDK, against a vehicle in a thread with UDP ports of its own."""

import pytest
from wind_hold.survey import NoVehicle, Survey


@pytest.mark.mavsitl(speed=5)
def test_it_flies_its_waypoints_and_lands(vehicle_udp, assert_flight):
    waypoints = [(3.0, 0.0), (3.0, 3.0)]
    with Survey(vehicle_udp.offboard_url) as survey:
        assert survey.fly(waypoints) == waypoints
    vehicle_udp.wait_until(lambda state: not state.armed, within_s=30)
    check = assert_flight(vehicle_udp)
    check.reaches((3.0, 3.0, -3.0), within_m=0.5).entered("OFFBOARD").never_failsafe().lands()


@pytest.mark.mavsitl(speed=5)
def test_it_flies_on_after_an_outage(vehicle_udp, faults, assert_flight):
    faults.outage(0.5, at_s=5.0)
    with Survey(vehicle_udp.offboard_url) as survey:
        assert survey.fly([(3.0, 0.0)]) == [(3.0, 0.0)]
    assert_flight(vehicle_udp).lands()


def test_nobody_there(monkeypatch):
    monkeypatch.setattr("wind_hold.survey.PATIENCE_S", 0.5)
    with pytest.raises(NoVehicle):
        Survey("udpout://127.0.0.1:9")
