"""What fail-safes may and may not do to the mode that is flown: the commander alone, step by step."""

from __future__ import annotations

import pytest
from mavsitl_vehicle.autopilot.commander import ACCEPTED, TEMPORARILY_REJECTED, Commander, Situation
from mavsitl_vehicle.autopilot.modes import Mode
from mavsitl_vehicle.autopilot.parameters import TABLE
from msgspec.structs import replace

SECOND_US = 1_000_000
WELL = Situation(landed=False, setpoint_age_us=0, sticks_age_us=0, gcs_age_us=0, mission_refusal=None)
GCS_LOST = replace(WELL, gcs_age_us=None)


def flying(mode: Mode, said: list[str] | None = None, **parameters: float) -> Commander:
    """Armed and in the air in `mode`; `said` takes what it reports."""
    texts = [] if said is None else said
    values = {name: row.default for name, row in TABLE.items()} | parameters
    commander = Commander(values, lambda severity, text: texts.append(text))
    commander.home_set = True
    commander.step(0, replace(WELL, landed=True))
    assert commander.request_arm(True, False, 0) == ACCEPTED
    commander.step(0, WELL)
    assert commander.request_mode(mode, "") == ACCEPTED
    commander.step(0, WELL)
    assert commander.mode is mode
    return commander


@pytest.mark.parametrize(
    "situation", [replace(WELL, battery_level=3), replace(WELL, fence_breach="far away"), GCS_LOST], ids=str
)
def test_a_terminated_flight_stays_terminated(situation: Situation) -> None:
    said: list[str] = []
    commander = flying(Mode.TERMINATION, said, NAV_DLL_ACT=2, COM_LOW_BAT_ACT=3, GF_ACTION=2)
    for second in range(1, 20):
        commander.step(second * SECOND_US, situation)
    assert commander.mode is Mode.TERMINATION
    for mode in (Mode.LOITER, Mode.LAND, Mode.OFFBOARD):
        assert commander.request_mode(mode, "") == TEMPORARILY_REJECTED
    assert said[-1] == "OFFBOARD refused: flight terminated"
    commander.step(20 * SECOND_US, situation)
    assert commander.mode is Mode.TERMINATION
    assert commander.request_mode(Mode.TERMINATION, "") == ACCEPTED
    assert commander.request_arm(False, True, 20 * SECOND_US) == ACCEPTED
    assert (commander.armed, commander.mode) == (False, Mode.TERMINATION)
    assert commander.request_arm(True, True, 21 * SECOND_US) == TEMPORARILY_REJECTED
    assert said[-1] == "Arming denied: flight termination active, a reboot ends it"


def test_a_termination_by_a_fail_safe_outlives_its_cause() -> None:
    commander = flying(Mode.POSCTL, GF_ACTION=4)
    commander.step(SECOND_US, replace(WELL, fence_breach="far away"))
    assert commander.mode is Mode.TERMINATION
    commander.step(2 * SECOND_US, WELL)
    assert commander.mode is Mode.TERMINATION
    assert commander.request_mode(Mode.LAND, "") == TEMPORARILY_REJECTED


@pytest.mark.parametrize("mode", [Mode.LAND, Mode.RTL])
def test_a_return_is_not_begun_in_a_landing_or_a_return(mode: Mode) -> None:
    said: list[str] = []
    commander = flying(mode, said, GF_ACTION=3, COM_LOW_BAT_ACT=3)
    for second in range(1, 10):
        commander.step(second * SECOND_US, replace(WELL, fence_breach="far away", battery_level=2))
        assert commander.mode is mode
    assert "Warning: geofence breached" in said
    commander.step(10 * SECOND_US, replace(WELL, battery_level=3))
    commander.step(20 * SECOND_US, replace(WELL, battery_level=3))
    assert commander.mode is Mode.LAND  # which a low battery may still ask for
