"""SYS_STATUS bits and the pre-arm summary: what MAVSDK and QGroundControl read from them."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot import health
from mavsitl_vehicle.autopilot.health import Health, bits, refusals, summary

FLAGS = [name for name in Health._fields if name != "mode_refusal"]


def test_a_sound_vehicle_is_ready() -> None:
    present, enabled, well = bits(Health())
    assert refusals(Health()) == ()
    assert summary(Health()) is None
    # MAVSDK: gyro 1, accelerometer 2, magnetometer 4 present and healthy; GPS 0x20 present, enabled, healthy; PREARM.
    assert present & 0x7 == well & 0x7 == 0x7
    assert present & enabled & well & 0x20
    assert present & enabled & well & 0x10000000
    assert well & 0x100000  # no fence is no breach: MAVProxy
    assert not (present | enabled) & 0x100000
    assert not (present | enabled | well) & 0x10000  # no stick receiver


@pytest.mark.parametrize(
    ("fault", "bit", "reason"),
    [
        ("gyro", 0x1, "gyro fault"),
        ("accelerometer", 0x2, "accelerometer fault"),
        ("magnetometer", 0x4, "magnetometer fault"),
        ("barometer", 0x8, "barometer fault"),
        ("gps", 0x20, "no GPS fix"),
        ("motors", 0x8000, "motor fault"),
        ("battery", 0x2000000, "low battery"),
        ("attitude", 0x200000, "attitude estimate invalid"),
        ("height", 0x2000, "height estimate invalid"),
        ("position", 0x4000, "no valid position estimate"),
    ],
)
def test_one_fault(fault: str, bit: int, reason: str) -> None:
    values: dict[str, Any] = {fault: False}
    sick = Health(**values)
    assert refusals(sick) == (reason,)
    present, enabled, well = bits(sick)
    assert present & enabled & bit
    assert not well & (bit | health.PREARM)
    assert bits(Health()).health & ~well == bit | health.PREARM | (0x800 | 0x1000 if fault == "attitude" else 0)


def test_what_the_mode_needs() -> None:
    assert refusals(Health(home=False)) == ("home position not set",)
    blind = Health(gps=False, position=False, home=False, position_needed=False)
    assert refusals(blind) == ()
    assert not bits(blind).enabled & (0x20 | 0x4000)
    assert bits(blind).present & 0x20
    waiting = Health(sticks_needed=True)
    assert refusals(waiting) == ("no manual control input",)
    assert bits(waiting).enabled & 0x10000
    assert not bits(waiting).health & 0x10000
    flying = bits(Health(sticks=True, sticks_needed=True))
    assert flying.present & flying.enabled & flying.health & 0x10000
    assert refusals(Health(mode_refusal="mode AUTO.LAND does not allow arming")) == (
        "mode AUTO.LAND does not allow arming",
    )


def test_a_breached_fence() -> None:
    inside, outside = bits(Health(fence=True)), bits(Health(fence=True, fence_breached=True))
    assert inside.present & inside.enabled & inside.health & 0x100000
    assert outside.present & outside.enabled & 0x100000
    assert not outside.health & (0x100000 | health.PREARM)


def test_every_reason_is_told_the_gravest_first() -> None:
    assert summary(Health(gps=False, gyro=False)) == "gyro fault, no GPS fix"


@given(st.fixed_dictionaries({name: st.booleans() for name in FLAGS}))
def test_ready_means_that_nothing_enabled_is_unhealthy(flags: dict[str, Any]) -> None:
    """QGroundControl lists what is enabled and not healthy as an error."""
    state = Health(**flags)
    present, enabled, well = bits(state)
    assert bool(well & health.PREARM) == (refusals(state) == ())
    if refusals(state) == ():
        assert enabled & ~well == 0
    assert 0 <= present | enabled | well < 2**32
