"""What goes wrong with a craft under test: it begins, acts, ends and is told; what there is not is refused at once."""

from __future__ import annotations

from typing import Any

import pytest

from mavsitl.chaos import ChaosError
from mavsitl.scenario import ScenarioError
from mavsitl.testing import FaultError, Flight, Vehicle, assert_flight


def said(vehicle: Vehicle | Flight) -> list[tuple[float, str]]:
    return [(round(text.time_s, 2), text.text) for text in vehicle.texts]


def test_a_failure_comes_and_goes_by_the_clock_of_the_craft() -> None:
    flight = Flight("hover-calm", overrides={"duration_s": 4.0})
    fault = flight.faults.inject("motor", "wrong", instance=2, value=0.9, at_s=1.0, for_s=1.5)
    assert str(fault) == "motor 2 wrong: not begun"
    flight.run()
    injected = "Failure injected: motor 2 wrong, 90 % of the thrust"
    assert [each for each in said(flight) if "Failure" in each[1]] == [
        (1.0, injected), (2.5, "Failure cleared: motor 2")
    ]  # fmt: skip
    assert str(fault) == "motor 2 wrong: from 1.00 s to 2.50 s"
    (broken,) = flight.data.broken
    assert (broken.what, round(broken.start_s, 6), round(broken.end_s, 6)) == ("motor 2 wrong (0.9)", 1.0, 2.5)

    vehicle = Vehicle()
    vehicle.run(2.0)
    with vehicle.faults.inject("battery", "off"):
        assert vehicle.core.parameters["SIM_FAIL_BAT"] == 1
        vehicle.run(1.0)
    assert vehicle.core.parameters["SIM_FAIL_BAT"] == 0


def test_flight_time_may_be_meant_of_a_vehicle_and_simulated_time_of_a_flight() -> None:
    vehicle = Vehicle()
    fault = vehicle.faults.inject("motor", "slow", instance=1, at_s=0.5, clock="flight")
    vehicle.run(2.0)
    assert fault.began_s is None
    vehicle.takeoff(1.0)
    assert fault.began_s is not None
    assert fault.began_s > 2.5

    flight = Flight("hover-calm", overrides={"duration_s": 1.0})
    early = flight.faults.inject("motor", "slow", instance=1, at_s=0.5, clock="simulated")
    flight.run()
    assert early.began_s == -1.0


def test_a_link_gets_worse_key_by_key_and_well_again() -> None:
    vehicle = Vehicle(overrides={"link.to_ground.latency_ms": 30.0})
    both = vehicle._channels["offboard"]
    vehicle.run(0.1)
    with vehicle.faults.link(loss=1.0, direction="to_ground"):
        assert (both.to_ground.impairment.loss, both.to_ground.impairment.latency_ms) == (1.0, 30.0)
        assert both.to_vehicle.impairment.loss == 0.0
        vehicle.run(0.1)  # for what was on its way
        count = len(vehicle.messages())
        vehicle.run(1.0)
        assert len(vehicle.messages()) == count
        assert vehicle.messages(port="gcs")
    assert both.to_ground.impairment.loss == 0.0
    vehicle.run(1.0)
    assert vehicle.messages()


def test_an_outage_is_over_after_its_time_and_the_vehicle_has_noticed() -> None:
    flight = Flight("takeoff-hover", overrides={"duration_s": 14.0})
    flight.faults.outage(2.0, at_s=5.0)
    flight.run()
    assert flight._channels["offboard"].to_vehicle.statistics.outage > 0
    assert not flight._channels["offboard"].to_vehicle.impairment.down
    assert_flight(flight).had_failsafe("off-board signal lost", after_s=5.0, by_s=7.0)


def test_chaos_on_a_port_for_a_time() -> None:
    vehicle = Vehicle()
    vehicle.faults.chaos("heartbeat-lost", port="gcs", at_s=2.0, for_s=3.0)
    vehicle.run(7.0)
    stamps = [arrived.time_us / 1e6 for arrived in vehicle._inbox if arrived.frame.message.get_type() == "HEARTBEAT"
              and arrived.port == "gcs"]  # fmt: skip
    assert not [stamp for stamp in stamps if 2.0 < stamp <= 5.0]
    assert {round(stamp) for stamp in stamps} >= {1, 6}
    assert len(vehicle.messages("HEARTBEAT")) >= 6


def test_a_gust_pushes_and_only_in_flight() -> None:
    flight = Flight("hover-calm", overrides={"duration_s": 6.0})
    flight.faults.gust(8.0, from_deg=0.0, rise_s=0.5, at_s=2.0)
    flight.run()
    assert flight.data.wind_nwu_m_s[:, 0].min() == pytest.approx(-8.0, abs=0.1)
    south = flight.truth.position_ned_m[:, 0]
    assert south[flight.truth.time_s < 2.0].min() > -0.05 > south.min()
    with pytest.raises(FaultError, match="SIM_GUST_TRIG: the vehicle is not flying"):
        Vehicle().faults.gust(5.0)


def test_parameters_are_set_and_put_back() -> None:
    vehicle = Vehicle()
    before = vehicle.core.parameters["COM_OF_LOSS_T"]
    with vehicle.faults.parameters(COM_OF_LOSS_T=5.0):
        assert vehicle.core.parameters["COM_OF_LOSS_T"] == 5.0
    assert vehicle.core.parameters["COM_OF_LOSS_T"] == before


def test_clear_ends_what_is_there_and_what_is_to_come() -> None:
    vehicle = Vehicle()
    vehicle.faults.inject("motor", "off", instance=1)
    vehicle.faults.link(down=True)
    vehicle.faults.chaos("ack-lost")
    later = vehicle.faults.inject("battery", "off", at_s=1.0)
    vehicle.faults.clear()
    vehicle.run(2.0)
    assert later.began_s is None
    assert not vehicle.core.failures.active
    assert vehicle.core.chaos.active == ()
    assert not vehicle._channels["offboard"].to_ground.impairment.down
    vehicle.faults.clear()


def test_a_failure_of_the_link_itself_acts_on_it() -> None:
    """MAVLink's failure unit, by the vehicle's own overlay."""
    vehicle = Vehicle()
    vehicle.faults.inject("mavlink", "delayed", instance=1)
    vehicle.send(b"")
    vehicle.run(2.0)
    newest = vehicle.last("ATTITUDE")
    assert newest is not None
    assert newest.time_boot_ms == pytest.approx(1500, abs=30)


@pytest.mark.parametrize(
    ("wrong", "error", "told"),
    [
        (lambda f: f.inject("motr"), ScenarioError, "faults.inject: unit: 'motr' is not allowed; did you mean motor"),
        (lambda f: f.inject("motor", "delayed"), FaultError, "motor delayed is not supported; allowed: 0 ok"),
        (lambda f: f.inject("motor", instance=5), FaultError, "motor has no instance 5"),
        (lambda f: f.inject("motor", "wrong", value=2.0), FaultError, "2 is not allowed for motor wrong"),
        (lambda f: f.inject("gps", at_s=3.0), FaultError, 'gps needs estimator.kind = "ekf"'),
        (lambda f: f.link(los=0.1), ScenarioError, "faults.link: los: unknown key"),
        (lambda f: f.link(loss=1.1, at_s=5.0), ScenarioError, "faults.link: loss: 1.1 is not allowed"),
        (lambda f: f.link(), FaultError, "nothing is to change"),
        (lambda f: f.link(loss=0.1, port="tcp"), FaultError, "port: 'tcp' is not allowed; allowed: 'offboard', 'gcs'"),
        (lambda f: f.link(loss=0.1, direction="up"), ScenarioError, "direction: 'up' is not allowed"),
        (lambda f: f.chaos("ack-lots", at_s=1.0), ChaosError, "did you mean ack-lost"),
        (lambda f: f.chaos("ack-lost", port="tcp"), ChaosError, "port 'tcp' is not allowed"),
        (lambda f: f.parameters(COM_OF_LOST_T=1.0), FaultError, "no parameter COM_OF_LOST_T"),
        (lambda f: f.inject("motor", at_s=-1.0), FaultError, "at_s: -1.0 is not allowed"),
        (lambda f: f.inject("motor", at_s=1.0, clock="wall"), FaultError, "clock: 'wall' is not allowed"),
        (lambda f: f.outage(float("nan")), FaultError, "for_s: nan is not allowed"),
    ],
)
def test_what_there_is_not_is_refused_at_once(wrong: Any, error: type[Exception], told: str) -> None:
    vehicle = Vehicle()
    with pytest.raises(error, match=told):
        wrong(vehicle.faults)
    assert vehicle.faults.told() == []
