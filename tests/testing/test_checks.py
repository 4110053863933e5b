"""Assertions on a flight: each passes and fails, and a failure says when, how far, in which mode and what was said."""

from __future__ import annotations

import re
from typing import Any

import pytest

from mavsitl.testing import Flight, FlightAssertionError, Vehicle, assert_flight


@pytest.fixture(scope="module")
def calm() -> Flight:
    return Flight("takeoff-hover", overrides={"duration_s": 12.0}).run()


@pytest.fixture(scope="module")
def broken() -> Flight:
    """Its front rotor stops 10 m up after 1 s."""
    flight = Flight("hover-wind", overrides={"duration_s": 4.0, "start.position_nwu_m": [0.0, 0.0, 10.0],
                                             "reference.position_nwu_m": [0.0, 0.0, 10.0]})  # fmt: skip
    flight.faults.inject("motor", "off", instance=3, at_s=1.0)
    return flight.run()


@pytest.fixture(scope="module")
def silent() -> Flight:
    """Nothing reaches the vehicle any more from 5 s on."""
    flight = Flight("takeoff-hover", overrides={"duration_s": 9.0})
    flight.faults.link(down=True, direction="to_vehicle", at_s=5.0)
    flight.run_until(8.0)
    return flight


def test_a_good_flight_passes_all_in_one_chain(calm: Flight) -> None:
    check = assert_flight(calm).completes().lands().never_failsafe().mode_was("offboard", "AUTO.LOITER")
    check.stays_within(0.3, after_s=3.0, until_s=7.9).stays_within(20.0, of=(0, 0, 0)).stays_above(0.3, after_s=3.0)
    check.reaches((0.0, 0.0, -1.0), within_m=0.1, after_s=8.0).entered("OFFBOARD", by_s=1.0).tilt_below(10.0)
    check.rmse_below(x=0.1, y=0.1, z=0.5, phi=1.0, theta=1.0, psi=1.0)
    check.says("ARMED by").says(re.compile("^Armed")).never_says("failsafe").never_says(
        "armed", after_s=1.0, until_s=5.0
    )


def test_the_whole_text_of_a_failure(broken: Flight) -> None:
    with pytest.raises(FlightAssertionError) as failure:
        assert_flight(broken).stays_within(0.5, after_s=0.5)
    lines = str(failure.value).splitlines()
    patterns = [
        r"hover-wind \(seed 1\): stays within 0\.5 m of its reference from 0\.5 s on",
        r"  from 1\.\d\d s on it was not, for 2\.\d\d s in all",
        r"  the most was [\d.]+ m away, at 4\.00 s \(north [+-][\d.]+, east [+-][\d.]+, down [+-][\d.]+ m\)",
        r"  mode        AUTO\.LOITER from -1\.51 s, OFFBOARD from -1\.00 s",
        r"  fail-safes  none",
        r"  faults      motor 3 off: from 1\.00 s on",
        r"  said           -1\.00 s  Armed by external command",
        r"                  1\.00 s  Failure injected: motor 3 off",
    ]
    assert len(lines) == len(patterns)
    for line, pattern in zip(lines, patterns, strict=True):
        assert re.fullmatch(pattern, line), line
    assert failure.value.craft is broken
    assert failure.value.time_s is not None
    assert 1.0 < failure.value.time_s < 2.0


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (lambda c: c.reaches((5.0, 0.0, -10.0)), r"it came as near as [\d.]+ m, at [\d.]+ s, at \("),
        (lambda c: c.stays_above(9.9, after_s=0.5), r"the most was [\d.]+ m too low, at 4\.00 s"),
        (lambda c: c.tilt_below(30.0), r"tilts by less than 30 deg\n  from 1\.\d\d s on it was not"),
        (
            lambda c: c.rmse_below(x=0.001, z=100.0),
            r"has an RMSE of x < 0\.001, z < 100\n  x is [\d.]+ m, [\d.]+ times",
        ),
        (lambda c: c.entered("AUTO.RTL"), r"enters AUTO\.RTL\n  it was in OFFBOARD"),
        (lambda c: c.mode_was("AUTO.LAND"), r"at 0\.00 s it was in OFFBOARD"),
        (lambda c: c.says("injected: motor 2"), r"the nearest is 'Failure injected: motor 3 off'"),
        (lambda c: c.says(re.compile("xyz")), "says 'xyz'\n  nothing like it was said"),
        (lambda c: c.never_says("motor 3"), r"at 1\.00 s: Failure injected: motor 3 off"),
        (lambda c: c.had_failsafe(), "it had none of that kind"),
        (lambda c: c.stays_within(1.0, after_s=100.0), "it did not fly then"),
        (lambda c: c.stays_within(1.0, of=(0, 0, 0), after_s=100.0), "it did not fly then"),
    ],
)
def test_what_is_not_so_is_told(broken: Flight, wrong: Any, told: str) -> None:
    with pytest.raises(FlightAssertionError, match=told):
        wrong(assert_flight(broken))


def test_fail_safes_and_what_ended_the_flight(silent: Flight) -> None:
    assert_flight(silent).had_failsafe("off-board signal lost").entered("AUTO.RTL").never_failsafe(until_s=5.5)
    with pytest.raises(FlightAssertionError, match=r"has no fail-safe\n  at 6\.\d\d s: Failsafe activated: off-board"):
        assert_flight(silent).never_failsafe()
    with pytest.raises(FlightAssertionError, match=r"at 6\.\d\d s it was in AUTO\.RTL"):
        assert_flight(silent).mode_was("OFFBOARD")
    with pytest.raises(FlightAssertionError, match=r"it has not ended: say run\(\) before"):
        assert_flight(silent).completes()
    with pytest.raises(FlightAssertionError, match=r"it is in the air, at [\d.]+ m\n  it is armed"):
        assert_flight(silent).lands()


def test_a_lost_vehicle_does_not_complete() -> None:
    flight = Flight("rotor-failure", overrides={"duration_s": 14.0}).run()
    with pytest.raises(
        FlightAssertionError, match=r"(?s)ends as planned\n  it did not.*ended       lost: the vehicle is on"
    ):
        assert_flight(flight).completes()


def test_a_flight_that_has_not_begun_fails_every_check_of_it() -> None:
    flight = Flight("hover-calm")
    for check in ("stays_within", "tilt_below", "stays_above"):
        with pytest.raises(FlightAssertionError, match="it did not fly then"):
            getattr(assert_flight(flight), check)(1.0)
    with pytest.raises(FlightAssertionError, match="it was not flown"):
        assert_flight(flight).rmse_below(x=1.0)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (lambda c: c.stays_within(1.0), r"has no reference; say of=\(north, east, down\)"),
        (lambda c: c.rmse_below(x=1.0), "has no RMSE"),
        (lambda c: c.rmse_below(roll=1.0), "roll is not allowed; allowed: x, y, z, phi, theta, psi"),
        (lambda c: c.rmse_below(), "nothing is asserted"),
        (lambda c: c.completes(), "only a Flight has an end"),
    ],
)
def test_a_mistake_in_the_test_is_no_failure_of_the_flight(wrong: Any, told: str) -> None:
    with pytest.raises(TypeError, match=told):
        wrong(assert_flight(Vehicle()))
