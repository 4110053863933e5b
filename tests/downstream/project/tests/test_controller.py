"""The controller in whole flights, in simulated time: the same flights each time."""

import pytest
from wind_hold.controller import WindHold


@pytest.mark.mavsitl(scenario="hover-wind", controller="wind-hold")
def test_a_minute_in_wind_over_a_bad_link(flight, faults, assert_flight):
    """By the name under which the package registers it."""
    faults.link(loss=0.2)
    flight.run()
    assert flight.time_s > 60.0
    check = assert_flight(flight)
    check.completes().never_failsafe().stays_within(0.5, after_s=5)


@pytest.mark.mavsitl(controller=WindHold)
class TestOnTheRoof:
    """The project's own scenario; by the class itself."""

    @pytest.fixture
    def scenario(self):
        return "scenarios/roof.toml"

    def test_a_gust_is_caught(self, flight, assert_flight):
        flight.run_until(8.0)
        assert_flight(flight).stays_within(0.5, after_s=4)
        flight.run()
        assert_flight(flight).completes().stays_within(0.5, after_s=11)

    def test_a_weak_rotor(self, flight, faults, assert_flight):
        flight.run_until(4.0)
        with faults.parameters(SIM_MOT2_EFF=0.85):
            flight.run_until(9.0)
        assert_flight(flight.run()).completes().tilt_below(40).never_failsafe()


@pytest.mark.mavsitl(
    scenario="hover-wind",
    controller=WindHold,
    overrides={"duration_s": 5.0, "offnominal.mass_scale": 1.2},
)
def test_a_fifth_heavier_with_any_seed(flight):
    for seed in (1, 2, 3):
        assert flight.variant(seed=seed).run().rmse.z_m < 0.3


@pytest.mark.mavsitl(scenario="hover-calm", overrides={"duration_s": 5.0})
def test_a_scenario_can_be_asked(scenario):
    assert scenario.scenario.duration_s == 5.0
    assert WindHold(scenario.airframe, 0.004).mass_kg == scenario.airframe.mass_kg
