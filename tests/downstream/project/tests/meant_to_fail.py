"""What a failure tells, by `pytest tests/meant_to_fail.py`: a vehicle without a rotor is to stay where it is."""

import pytest


@pytest.mark.mavsitl(scenario="scenarios/roof.toml", controller="wind-hold")
def test_it_stays_without_a_rotor(flight, faults, assert_flight):
    faults.inject("motor", "off", instance=3, at_s=2.0)
    flight.run()
    assert_flight(flight).stays_within(0.5)
