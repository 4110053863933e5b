"""The battery: voltage, current and charge by hand, the ways to drain it, the warnings."""

from __future__ import annotations

from math import sqrt

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot import battery as batteries
from mavsitl_vehicle.autopilot.battery import Battery, Level, Settings, open_circuit_v

from mavsitl.scenario import load_airframe

PAPER = load_airframe("paper")
STILL = (0.0, 0.0, 0.0, 0.0)
HOVER = (PAPER.hover_rotor_speed_rad_s,) * 4


def test_a_full_pack_at_rest() -> None:
    pack = Battery(PAPER)
    assert (pack.voltage_v, pack.current_a, pack.charge) == pytest.approx((12.6, 0.0, 1.0))
    assert (pack.remaining_percent, pack.remaining_s, pack.level) == (100, None, Level.FINE)


def test_hover_power_by_hand() -> None:
    """omega = sqrt(m g / 4 b) = 182.5 rad/s; d omega^3 = 5.301 W a rotor; by 0.6, and 5 W besides: 40.34 W."""
    pack = Battery(PAPER)
    assert pack.power_w(HOVER[0]) * 0.6 == pytest.approx(5.301, abs=1e-3)
    pack.update(HOVER, True, 0.004)
    power = 4.0 * 5.301 / 0.6 + 5.0
    assert pack.voltage_v * pack.current_a == pytest.approx(power, rel=1e-3)
    # P = 3 (4.2 - 0.005 I) I
    current = (4.2 - sqrt(4.2**2 - 4.0 * 0.005 * power / 3.0)) / 0.01
    assert pack.current_a == pytest.approx(current, rel=1e-3)
    assert pack.voltage_v == pytest.approx(3.0 * (4.2 - 0.005 * current), rel=1e-6)


def test_a_minute_of_hover_takes_its_charge() -> None:
    pack = Battery(PAPER)
    for _ in range(600):
        pack.update(HOVER, True, 0.1)
    assert pack.consumed_ah == pytest.approx(pack.current_a * 60.0 / 3600.0, rel=0.01)
    assert pack.charge == pytest.approx(1.0 - pack.consumed_ah / 2.2, rel=1e-9)
    assert pack.consumed_j == pytest.approx(40.34 * 60.0, rel=1e-3)
    assert pack.remaining_s == pytest.approx(pack.charge * 2.2 * 3600.0 / pack.current_a, rel=0.01)


def test_disarmed_it_keeps_its_charge() -> None:
    pack = Battery(PAPER)
    pack.update(HOVER, True, 60.0)
    charge = pack.charge
    pack.update(STILL, False, 3600.0)
    assert (pack.charge, pack.current_a) == (charge, 0.0)
    assert pack.voltage_v == pytest.approx(3.0 * open_circuit_v(charge))
    pack.refill()
    assert (pack.charge, pack.consumed_ah, pack.remaining_s) == (1.0, 0.0, None)


def test_drain_faster_than_life() -> None:
    """SIM_BAT_DRAIN: from full to empty in so many seconds of hover, down to SIM_BAT_MIN_PCT."""
    pack = Battery(PAPER, Settings(drain_s=60.0, floor=0.3))
    for _ in range(30):
        pack.update(HOVER, True, 1.0)
    assert pack.charge == pytest.approx(0.5)
    assert pack.remaining_s == pytest.approx(30.0)
    pack.update(STILL, True, 1.0)  # of 40.34 W in hover 5 W are left
    assert pack.charge == pytest.approx(0.5 - 5.0 / 40.34 / 60.0, abs=1e-5)
    for _ in range(60):
        pack.update(HOVER, True, 1.0)
    assert pack.charge == pytest.approx(0.3)
    pack.settings = Settings(drain_s=60.0, floor=0.6)  # raised in flight, as on PX4
    pack.update(HOVER, True, 1.0)
    assert pack.charge == pytest.approx(0.6)


def test_switched_off_it_keeps_its_charge_under_load() -> None:
    pack = Battery(PAPER, Settings(enabled=False, drain_s=1.0))
    pack.update(HOVER, True, 60.0)
    assert (pack.charge, pack.remaining_s) == (1.0, None)
    assert pack.current_a > 0.0


@pytest.mark.parametrize(
    ("charge", "level", "percent"),
    [
        (1.0, Level.FINE, 100),
        (0.15, Level.FINE, 15),
        (0.149, Level.LOW, 15),
        (0.07, Level.LOW, 8),
        (0.069, Level.CRITICAL, 7),
        (0.05, Level.CRITICAL, 5),
        (0.049, Level.EMERGENCY, 5),
        (0.001, Level.EMERGENCY, 1),
        (0.0, Level.EMERGENCY, 0),
    ],
)
def test_warnings_and_percent(charge: float, level: Level, percent: int) -> None:
    pack = Battery(PAPER)
    pack.charge = charge
    assert pack.level is level
    assert pack.remaining_percent == percent


def test_more_than_the_pack_can_give() -> None:
    """The most of P = n (U0 - R I) I: half the voltage, I = U0 / 2 R."""
    weak = Battery(msgspec.structs.replace(PAPER, battery_cell_resistance_ohm=2.0))
    weak.update(HOVER, True, 0.004)
    assert weak.current_a == pytest.approx(4.2 / 4.0)
    assert weak.voltage_v == pytest.approx(6.3)
    ideal = Battery(msgspec.structs.replace(PAPER, battery_cell_resistance_ohm=0.0))
    ideal.update(HOVER, True, 0.004)
    assert ideal.voltage_v == pytest.approx(12.6)


def test_settings_come_from_parameters() -> None:
    values = {
        "BAT_LOW_THR": 0.3,
        "BAT_CRIT_THR": 0.2,
        "BAT_EMERGEN_THR": 0.1,
        "SIM_BAT_ENABLE": 0.0,
        "SIM_BAT_DRAIN": 120.0,
        "SIM_BAT_MIN_PCT": 40.0,
    }
    assert batteries.settings(values) == Settings(0.3, 0.2, 0.1, False, 120.0, 0.4)
    assert batteries.described(PAPER) == {
        "BAT1_N_CELLS": 3.0,
        "BAT1_V_CHARGED": 4.2,
        "BAT1_V_EMPTY": 3.6,
        "BAT1_CAPACITY": 2200.0,
        "BAT1_R_INTERNAL": 0.005,
    }


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_the_discharge_curve_rises(a: float, b: float) -> None:
    assert 3.3 <= open_circuit_v(a) <= 4.2
    assert (open_circuit_v(a) - open_circuit_v(b)) * (a - b) >= 0.0


@given(st.lists(st.tuples(st.floats(0.0, 1e4), st.booleans(), st.floats(0.0, 1e4)), max_size=20))
def test_whatever_the_rotors_do_the_charge_stays_in_range(steps: list[tuple[float, bool, float]]) -> None:
    pack = Battery(PAPER)
    for speed, armed, dt_s in steps:
        before = pack.charge
        pack.update((speed,) * 4, armed, dt_s)
        assert 0.0 <= pack.charge <= before
        assert 0.0 < pack.voltage_v <= 12.6 + 1e-9
        assert pack.current_a >= 0.0
