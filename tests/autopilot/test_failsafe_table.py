"""Every row of `commander.FAILSAFES`, by the commander alone in simulated time: when it acts, how, what ends it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import radians
from typing import Any, NamedTuple

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot.commander import (
    ACCEPTED,
    ACTION_MODES,
    FAILSAFES,
    LEAVING,
    Action,
    By,
    Commander,
    Failsafe,
    Situation,
)
from mavsitl_vehicle.autopilot.modes import TABLE as MODES
from mavsitl_vehicle.autopilot.modes import Control, Mode, Need
from mavsitl_vehicle.autopilot.parameters import TABLE
from msgspec.structs import asdict, replace

from mavsitl.dialect import mavlink

LOOK_US = 12_000
SECOND_US = 1_000_000
WELL = Situation(
    landed=False, setpoint_age_us=0, sticks_age_us=0, gcs_age_us=0, mission_refusal=None, mission_failure=None
)
ROWS = {row.name: row for row in FAILSAFES}
SLACK_S = 0.1


class Cause(NamedTuple):
    """How a row is tripped."""

    mode: Mode
    parameters: dict[str, float]
    situation: Callable[[int], dict[str, Any]]
    """Microseconds since the cause to what changes in `Situation`."""
    after_s: float = 0.0
    """What the parameters say: from the cause to the action."""
    kill: bool = False


def steady(**changes: Any) -> Callable[[int], dict[str, Any]]:
    return lambda since_us: changes


CAUSES: dict[str, Cause] = {
    "off-board signal lost": Cause(
        Mode.OFFBOARD, {"COM_OF_LOSS_T": 0.7}, lambda since_us: {"setpoint_age_us": since_us}, 0.7
    ),
    "manual control lost": Cause(Mode.LOITER, {"COM_RC_LOSS_T": 0.8}, lambda us: {"sticks_age_us": us}, 0.8),
    "connection to ground station lost": Cause(
        Mode.LOITER, {"COM_DL_LOSS_T": 6}, lambda us: {"gcs_age_us": us}, 6.0
    ),
    "low battery": Cause(Mode.LOITER, {}, steady(battery_level=1)),
    "critical battery": Cause(Mode.LOITER, {}, steady(battery_level=2)),
    "emergency battery level": Cause(Mode.LOITER, {}, steady(battery_level=3)),
    "geofence breached": Cause(Mode.LOITER, {}, steady(fence_breach="too far")),
    "both links lost after the mission": Cause(
        Mode.MISSION, {"COM_RC_IN_MODE": 4, "COM_DL_LOSS_T": 7},
        lambda us: {"gcs_age_us": us, "mission_finished": True}, 7.0,
    ),
    "battery unhealthy": Cause(Mode.LOITER, {}, lambda us: {"battery_age_us": us}, 5.0),
    "remaining flight time low": Cause(Mode.LOITER, {}, steady(return_margin_s=-0.1)),
    "flight time nearly over": Cause(
        Mode.LOITER, {"COM_FLT_TIME_MAX": 10}, lambda us: {"airborne_s": min(5.0 + us / 1e6, 9.5)}, 4.0
    ),
    "maximum flight time exceeded": Cause(
        Mode.LOITER, {"COM_FLT_TIME_MAX": 10}, lambda us: {"airborne_s": 8.0 + us / 1e6}, 2.0
    ),
    "strong wind": Cause(Mode.LOITER, {"COM_WIND_WARN": 8}, steady(wind_m_s=8.1)),
    "wind limit exceeded": Cause(Mode.LOITER, {"COM_WIND_MAX": 12}, steady(wind_m_s=12.1)),
    "mission failure": Cause(Mode.MISSION, {}, steady(mission_failure="no mission", mission_refusal="no mission")),
    "position accuracy low": Cause(Mode.LOITER, {"COM_POS_LOW_EPH": 3}, steady(position_error_m=3.1)),
    "attitude estimate lost": Cause(Mode.LOITER, {}, steady(attitude_valid=False)),
    "height estimate lost": Cause(Mode.LOITER, {}, steady(height_valid=False)),
    "velocity estimate lost": Cause(Mode.LOITER, {}, steady(velocity_valid=False)),
    "position estimate lost": Cause(Mode.LOITER, {}, steady(position_valid=False)),
    "attitude failure (roll)": Cause(
        Mode.LOITER, {"FD_FAIL_R": 50, "FD_FAIL_R_TTRI": 0.4}, steady(roll_rad=radians(-51)), 0.4
    ),
    "attitude failure (pitch)": Cause(
        Mode.LOITER, {"FD_FAIL_P": 50, "FD_FAIL_P_TTRI": 0.4}, steady(pitch_rad=radians(51)), 0.4
    ),
    "altitude loss": Cause(Mode.LOITER, {"FD_ALT_LOSS": 4, "FD_ALT_LOSS_T": 0.6}, steady(altitude_loss_m=4.1), 0.6),
    "motor failure": Cause(Mode.LOITER, {"FD_ACT_EN": 1, "MOTFAIL_TIME": 0.5}, steady(motor_failure=0b10), 0.5),
    "kill switch engaged": Cause(Mode.LOITER, {"COM_KILL_DISARM": 2}, steady(), 2.0, kill=True),
}  # fmt: skip
"""By the row's name. What is not named is as in `WELL`."""


SAID = {"motor failure": "motor 2 failure"}
"""Where it is not the row's name."""


class Flight:
    """A commander in the air, stepped as the autopilot does, LOOK_US apart."""

    def __init__(self, mode: Mode = Mode.LOITER, **parameters: float) -> None:
        self.values = {name: row.default for name, row in TABLE.items()} | parameters
        self.said: list[str] = []
        self.commander = Commander(self.values, lambda severity, text: self.said.append(text))
        self.commander.home_set = True
        self.now_us = 0
        self.cause_us: int | None = None
        self.changes: Callable[[int], dict[str, Any]] = steady()
        self.row = ""
        """Whose warnings count; empty: everybody's."""
        self.commander.step(0, replace(WELL, landed=True))
        assert self.commander.request_arm(True, False, 0) == ACCEPTED
        self.run(10.0)  # beyond what counts from the arming
        assert self.commander.request_mode(mode, "") == ACCEPTED
        self.run(0.1)
        assert self.commander.mode is mode
        assert self.said == ["Armed by external command"]

    def happens(self, changes: Callable[[int], dict[str, Any]] | None) -> None:
        """From now on; None: all is well again."""
        self.changes = changes or steady()
        self.cause_us = self.now_us

    def step(self) -> None:
        self.now_us += LOOK_US
        since_us = 0 if self.cause_us is None else self.now_us - self.cause_us
        self.commander.step(self.now_us, replace(WELL, **self.changes(since_us)))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * SECOND_US / LOOK_US)):
            self.step()

    def until(self, condition: Callable[[], bool], limit_s: float) -> float:
        start_us = self.now_us
        while not condition():
            assert self.now_us - start_us <= limit_s * SECOND_US, (limit_s, self.said)
            self.step()
        return (self.now_us - start_us) / SECOND_US

    def news(self) -> list[str]:
        """What was said since the arming, of the row alone where there is one."""
        return [text for text in self.said[1:] if self.row in text]

    def done(self) -> Action:
        """What the fail-safes have brought about, as it shows."""
        if not self.commander.armed:
            return Action.DISARM
        if self.commander.failsafe:
            return next(action for action, mode in ACTION_MODES.items() if mode is self.commander.mode)
        return Action.WARN if any(text.startswith("Warning: ") for text in self.news()) else Action.NONE


def trip(name: str, **parameters: float) -> Flight:
    cause = CAUSES[name]
    flight = Flight(cause.mode, **{**cause.parameters, **parameters})
    flight.happens(cause.situation)
    flight.row = SAID.get(name, name)
    if cause.kill:
        flight.commander.request_kill(True)
    return flight


def by_value() -> Iterator[Any]:
    """(row, parameter or "", value, the action that follows)"""
    for row in FAILSAFES:
        if isinstance(row.action, By):
            for value, action in sorted(row.action.actions.items()):
                if row.action.parameter != "NAV_RCL_ACT" or value:  # the parameter has no 0
                    yield pytest.param(row, row.action.parameter, value, action, id=f"{row.name}-{value}")
        else:
            yield pytest.param(row, "", 0, None, id=row.name)


FIXED = {
    "both links lost after the mission": Action.RETURN,
    "battery unhealthy": Action.WARN,
    "flight time nearly over": Action.WARN,
    "maximum flight time exceeded": Action.RETURN,
    "strong wind": Action.WARN,
    "mission failure": Action.RETURN,
    "attitude estimate lost": Action.TERMINATE,
    "height estimate lost": Action.DESCEND,
    "velocity estimate lost": Action.DESCEND,
    "position estimate lost": Action.DESCEND,
    "attitude failure (roll)": Action.WARN,
    "attitude failure (pitch)": Action.WARN,
    "altitude loss": Action.WARN,
    "kill switch engaged": Action.DISARM,
}
"""What the rows do that no parameter chooses, long after arming."""


def test_this_file_knows_every_row() -> None:
    assert list(CAUSES) == [row.name for row in FAILSAFES]
    assert set(FIXED) == {row.name for row in FAILSAFES if not isinstance(row.action, By)}


def test_the_actions_are_in_px4s_order() -> None:
    assert [action.name for action in Action] == [
        "NONE", "WARN", "POSITION", "ALTITUDE", "STABILIZED", "HOLD", "RETURN", "LAND", "DESCEND", "DISARM",
        "TERMINATE",
    ]  # fmt: skip


@pytest.mark.parametrize("row", FAILSAFES, ids=lambda row: row.name)
def test_every_value_of_its_parameter_has_an_action(row: Failsafe) -> None:
    if isinstance(row.action, By):
        assert set(TABLE[row.action.parameter].values) <= set(row.action.actions)
    for name in (*row.looks_at, row.after) if row.after else row.looks_at:
        assert TABLE[name].used_by == "vehicle"


@pytest.mark.parametrize(("row", "parameter", "value", "action"), list(by_value()))
def test_when_and_what(row: Failsafe, parameter: str, value: int, action: Action | None) -> None:
    cause = CAUSES[row.name]
    wanted = FIXED[row.name] if action is None else action
    flight = trip(row.name, **({parameter: value} if parameter else {}))
    if wanted is Action.NONE:
        flight.run(cause.after_s + 8.0)
        assert (flight.done(), flight.news()) == (Action.NONE, [])
        return
    flight.run(max(cause.after_s - 0.02, 0.0))
    assert flight.done() is Action.NONE
    first = Action.HOLD if row.deferred and wanted in LEAVING else wanted
    left_s = flight.until(lambda: flight.done() is not Action.NONE, SLACK_S + 0.02)
    assert left_s <= SLACK_S + 0.02
    assert flight.done() is first
    name = flight.row
    assert flight.news()[-1] == (
        f"Warning: {name}" if first is Action.WARN else f"Failsafe activated: {name}, {first.name.lower()}"
    )
    if first is not wanted:
        flight.run(4.9)
        assert flight.done() is Action.HOLD
        flight.until(lambda: flight.done() is not Action.HOLD, SLACK_S + 0.1)
        assert flight.news()[-1] == f"Failsafe activated: {name}, {wanted.name.lower()}"
    flight.run(20.0)
    assert flight.done() is wanted
    spoken = 1 if first is wanted else 2
    assert len(flight.news()) == spoken


ENDS = [row for row in FAILSAFES if row.name not in ("attitude estimate lost", "kill switch engaged")]


@pytest.mark.parametrize("row", ENDS, ids=lambda row: row.name)
def test_what_ends_it(row: Failsafe) -> None:
    """Its cause, where the table says so; otherwise, and always, the user's own choice of a mode."""
    cause = CAUSES[row.name]
    acting = {}
    if isinstance(row.action, By):
        best = next(
            v for v, action in row.action.actions.items() if action in (Action.LAND, Action.RETURN, Action.WARN)
        )
        acting = {row.action.parameter: best}
    flight = trip(row.name, **acting)
    flight.run(cause.after_s + 6.0)
    reached = flight.done()
    assert reached in (Action.WARN, Action.RETURN, Action.LAND, Action.DESCEND)
    flight.happens(None)
    flight.run(0.2)
    if row.ends_with_cause or reached is Action.WARN:
        assert (flight.commander.mode, flight.commander.failsafe) == (cause.mode, False)
        return
    assert flight.done() is reached
    assert flight.commander.request_mode(Mode.LOITER, "") == ACCEPTED
    flight.run(0.5)
    assert (flight.commander.mode, flight.commander.failsafe) == (Mode.LOITER, False)
    flight.happens(cause.situation)  # once more: it acts once more
    if cause.mode is not Mode.MISSION:
        flight.run(cause.after_s + 6.0)
        assert flight.done() is reached


@pytest.mark.parametrize("row", FAILSAFES, ids=lambda row: row.name)
def test_the_users_choice_overrules_it_while_its_cause_lasts(row: Failsafe) -> None:
    cause = CAUSES[row.name]
    acting = {row.action.parameter: max(row.action.actions)} if isinstance(row.action, By) else {}
    flight = trip(row.name, **acting)
    flight.run(cause.after_s + 6.0)
    if flight.done() in (Action.DISARM, Action.TERMINATE):
        assert flight.commander.request_mode(Mode.STABILIZED, "") == (
            ACCEPTED if flight.done() is Action.DISARM else mavlink.MAV_RESULT_TEMPORARILY_REJECTED
        )
        return
    sticks_gone = row.name == "manual control lost"
    assert flight.commander.request_mode(Mode.LAND if sticks_gone else Mode.STABILIZED, "") == ACCEPTED
    flight.run(8.0)
    assert flight.commander.mode is (Mode.LAND if sticks_gone else Mode.STABILIZED)
    assert not flight.commander.failsafe


# --- worse ones, and those that cannot run


@pytest.mark.parametrize("first", FAILSAFES, ids=lambda row: row.name)
def test_a_worse_one_wins_whatever_came_first(first: Failsafe) -> None:
    """A breached fence that terminates, on top of each other row."""
    if first.name == "geofence breached":
        pytest.skip("that is the other one")
    cause = CAUSES[first.name]
    flight = trip(first.name, GF_ACTION=4)
    flight.run(cause.after_s + 1.0)
    if flight.done() in (Action.DISARM, Action.TERMINATE):
        return
    flight.changes = lambda since_us: {**cause.situation(since_us), "fence_breach": "too far"}
    took_s = flight.until(lambda: flight.commander.mode is Mode.TERMINATION, SLACK_S)
    assert took_s <= SLACK_S


LOST: list[tuple[dict[str, Any], Action]] = [
    ({}, Action.RETURN),
    ({"position_valid": False}, Action.DESCEND),
    ({"velocity_valid": False}, Action.DESCEND),
    ({"height_valid": False}, Action.DESCEND),
    ({"attitude_valid": False}, Action.TERMINATE),
]


@pytest.mark.parametrize(("lost", "action"), LOST)
def test_what_cannot_be_flown_gives_way(lost: dict[str, Any], action: Action) -> None:
    """RTL, LAND, DESCEND, TERMINATE; there is no holding first where Hold itself cannot be flown."""
    flight = Flight(COM_FLT_TIME_MAX=60, COM_FAIL_ACT_T=0)
    flight.happens(steady(airborne_s=61.0, **lost))
    flight.run(SLACK_S)
    assert flight.done() is action


def test_a_return_without_a_home_lands() -> None:
    flight = Flight(COM_FLT_TIME_MAX=60, COM_FAIL_ACT_T=0)
    flight.commander.home_set = False
    flight.happens(steady(airborne_s=61.0))
    flight.run(SLACK_S)
    assert flight.done() is Action.LAND


def test_a_return_that_loses_its_position_on_the_way_descends_and_stays_down() -> None:
    flight = Flight(NAV_DLL_ACT=2)
    flight.happens(steady(gcs_age_us=60 * SECOND_US))
    flight.run(6.0)
    assert flight.done() is Action.RETURN
    flight.happens(steady(gcs_age_us=60 * SECOND_US, position_valid=False))
    flight.run(SLACK_S)
    assert flight.done() is Action.DESCEND
    flight.happens(steady(position_valid=False))  # the station is back; what it began holds
    flight.run(SLACK_S)
    assert flight.done() is Action.DESCEND


FALLBACKS: list[tuple[Mode, dict[str, Any], Mode]] = [
    (Mode.POSCTL, {"position_valid": False}, Mode.ALTCTL),
    (Mode.POSCTL, {"velocity_valid": False}, Mode.ALTCTL),
    (Mode.POSCTL, {"height_valid": False}, Mode.STABILIZED),
    (Mode.ALTCTL, {"height_valid": False}, Mode.STABILIZED),
    (Mode.ALTCTL, {"position_valid": False}, Mode.ALTCTL),
    (Mode.STABILIZED, {"position_valid": False, "height_valid": False}, Mode.STABILIZED),
    (Mode.STABILIZED, {"attitude_valid": False}, Mode.TERMINATION),
    (Mode.ACRO, {"attitude_valid": False, "height_valid": False}, Mode.ACRO),
    (Mode.POSCTL, {"position_valid": False, "sticks_age_us": None}, Mode.DESCEND),
    (Mode.MISSION, {"position_valid": False}, Mode.DESCEND),
    (Mode.LAND, {"position_valid": False}, Mode.DESCEND),
    (Mode.RTL, {"position_valid": False}, Mode.DESCEND),
    (Mode.TAKEOFF, {"position_valid": False}, Mode.DESCEND),
]


@pytest.mark.parametrize(("mode", "lost", "falls_to"), FALLBACKS)
def test_each_mode_falls_back_as_far_as_it_must(mode: Mode, lost: dict[str, Any], falls_to: Mode) -> None:
    flight = Flight(mode, COM_RCL_EXCEPT=7)
    flight.happens(steady(**lost))
    flight.run(SLACK_S)
    assert flight.commander.mode is falls_to
    if falls_to is Mode.TERMINATION or "sticks_age_us" in lost:  # what lost sticks began holds
        return
    flight.happens(None)
    flight.run(SLACK_S)
    assert flight.commander.mode is mode


@pytest.mark.parametrize(
    ("needs", "kept"),
    [
        (Need.NOTHING, True),
        (Need.ATTITUDE, True),
        (Need.ATTITUDE | Need.HEIGHT, True),
        (Need.ATTITUDE | Need.VELOCITY, True),
        (Need.ATTITUDE | Need.POSITION, False),
    ],
)
def test_offboard_minds_only_what_its_setpoints_need(needs: Need, kept: bool) -> None:
    flight = Flight(Mode.OFFBOARD, COM_OBL_RC_ACT=4)
    flight.happens(steady(position_valid=False, stream_needs=needs))
    flight.run(SLACK_S)
    assert flight.commander.mode is (Mode.OFFBOARD if kept else Mode.DESCEND)
    assert flight.commander.request_mode(Mode.OFFBOARD, "") == (
        ACCEPTED if kept else mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    )
    flight.happens(None)
    flight.run(SLACK_S)
    assert flight.commander.mode is Mode.OFFBOARD


# --- what rows leave alone


EXCEPTIONS = [
    (Mode.MISSION, 1), (Mode.LOITER, 2), (Mode.RTL, 2), (Mode.TAKEOFF, 2), (Mode.ORBIT, 2), (Mode.OFFBOARD, 4),
]  # fmt: skip


@pytest.mark.parametrize(("mode", "bit"), EXCEPTIONS)
@pytest.mark.parametrize(
    ("parameter", "lost"), [("COM_RCL_EXCEPT", {"sticks_age_us": None}), ("COM_DLL_EXCEPT", {"gcs_age_us": None})]
)
def test_excepted_modes_do_not_mind_a_lost_link(mode: Mode, bit: int, parameter: str, lost: dict[str, Any]) -> None:
    for mask in (bit, 7 - bit):
        flight = Flight(mode, NAV_DLL_ACT=1, NAV_RCL_ACT=1, **{parameter: mask})
        flight.happens(steady(**lost))
        flight.run(SLACK_S)
        assert flight.commander.failsafe == (mask != bit)


def test_no_exception_covers_the_modes_that_are_flown_by_sticks() -> None:
    flight = Flight(Mode.POSCTL, COM_RCL_EXCEPT=31, NAV_RCL_ACT=1)
    flight.happens(steady(sticks_age_us=None))
    flight.run(SLACK_S)
    assert flight.done() is Action.HOLD


def test_a_landing_does_not_mind_the_ground_station_and_is_not_turned_into_a_return() -> None:
    flight = Flight(Mode.LAND, NAV_DLL_ACT=2)
    flight.happens(steady(gcs_age_us=None, sticks_age_us=None, battery_level=3))
    flight.run(10.0)
    assert flight.commander.mode is Mode.LAND
    assert not any("ground station" in text for text in flight.said)


@pytest.mark.parametrize("field", ["roll_rad", "pitch_rad"])
def test_a_flip_soon_after_arming_locks_the_rotors(field: str) -> None:
    """Within COM_SPOOLUP_TIME + COM_LKDOWN_TKO, whatever the breaker says; later it is the breaker's."""
    for armed_s, breaker, wanted in (
        (0.2, 121212, Action.DISARM), (3.5, 0, Action.DISARM), (3.95, 121212, Action.WARN), (3.95, 0, Action.TERMINATE),
    ):  # fmt: skip
        flight = Flight(Mode.LOITER, CBRK_FLIGHTTERM=breaker)
        flight.commander.request_arm(False, True, flight.now_us)
        assert flight.commander.request_arm(True, False, flight.now_us) == ACCEPTED
        flight.run(armed_s)
        flight.happens(steady(**{field: 2.0}))
        flight.until(lambda flight=flight: flight.done() is not Action.NONE, 0.3 + SLACK_S)  # type: ignore[misc]
        assert flight.done() is wanted
        assert flight.now_us - flight.commander.armed_at_us >= 0.3 * SECOND_US


@pytest.mark.parametrize(
    ("mode", "needs", "seen"),
    [
        (Mode.ACRO, Need.ATTITUDE, False), (Mode.STABILIZED, Need.ATTITUDE, True),
        (Mode.OFFBOARD, Need.ATTITUDE, True), (Mode.OFFBOARD, Need.NOTHING, False),
    ],
)  # fmt: skip
def test_modes_that_turn_by_rates_may_flip(mode: Mode, needs: Need, seen: bool) -> None:
    flight = Flight(mode)
    flight.happens(steady(roll_rad=3.0, stream_needs=needs))
    flight.run(1.0)
    assert (flight.news() == ["Warning: attitude failure (roll)"]) == seen


def test_a_tilt_that_comes_and_goes_is_no_flip() -> None:
    flight = Flight(CBRK_FLIGHTTERM=0)
    for _ in range(10):
        flight.happens(steady(roll_rad=1.2))
        flight.run(0.25)
        flight.happens(None)
        flight.run(0.05)
    assert flight.done() is Action.NONE


def test_a_battery_without_news_at_the_spool_up_disarms() -> None:
    flight = Flight()
    flight.commander.request_arm(False, True, flight.now_us)
    flight.commander.request_arm(True, False, flight.now_us)
    flight.happens(steady(battery_age_us=6 * SECOND_US))
    flight.run(SLACK_S)
    assert flight.done() is Action.DISARM


# --- the time of holding


def test_a_cause_that_comes_and_goes_puts_nothing_off_for_ever() -> None:
    """2 s there, 1 s gone: of each 2 s spent only a quarter of a second comes back."""
    flight = Flight(NAV_DLL_ACT=2, COM_FAIL_ACT_T=5)
    reached: list[Action] = []
    while Action.RETURN not in reached:
        assert len(reached) < 5
        flight.happens(steady(gcs_age_us=60 * SECOND_US))
        flight.run(2.0)
        reached.append(flight.done())
        flight.happens(None)
        flight.run(1.0)
    assert reached[0] is Action.HOLD


def test_the_time_comes_back() -> None:
    flight = Flight(NAV_DLL_ACT=2, COM_FAIL_ACT_T=4)
    lost = steady(gcs_age_us=60 * SECOND_US)
    flight.happens(lost)
    flight.run(2.0)
    flight.happens(None)
    flight.run(2.5)  # what was left of this delay passes, 0.6 s of the 2 come back
    flight.happens(lost)
    assert flight.until(lambda: flight.done() is Action.RETURN, 6.0) == pytest.approx(2.6, abs=0.15)
    assert flight.commander.request_mode(Mode.LOITER, "") == ACCEPTED
    flight.happens(None)
    flight.run(16.0)
    flight.happens(lost)
    assert flight.until(lambda: flight.done() is Action.RETURN, 6.0) == pytest.approx(4.0, abs=0.1)


def test_who_flies_by_a_failsafe_already_holds_no_more() -> None:
    flight = Flight(NAV_DLL_ACT=2, COM_LOW_BAT_ACT=2)
    flight.happens(steady(gcs_age_us=60 * SECOND_US))
    flight.run(6.0)
    assert flight.done() is Action.RETURN
    flight.happens(steady(gcs_age_us=60 * SECOND_US, battery_level=2))
    flight.run(SLACK_S)
    assert flight.done() is Action.LAND


# --- taking over


def test_moved_sticks_take_over_from_a_return_and_not_while_it_holds() -> None:
    flight = Flight(NAV_DLL_ACT=2)
    flight.happens(steady(gcs_age_us=60 * SECOND_US))
    flight.run(2.0)
    assert not flight.commander.request_takeover()
    assert flight.done() is Action.HOLD
    flight.run(4.0)
    assert flight.done() is Action.RETURN
    assert flight.commander.request_takeover()
    flight.run(1.0)
    assert (flight.commander.mode, flight.commander.failsafe) == (Mode.POSCTL, False)
    assert "Pilot took over using sticks" in flight.said


@pytest.mark.parametrize(
    ("mode", "override", "taken"),
    [
        (Mode.LOITER, 1, True), (Mode.MISSION, 1, True), (Mode.LOITER, 2, False), (Mode.OFFBOARD, 1, False),
        (Mode.OFFBOARD, 2, True), (Mode.STABILIZED, 3, False),
    ],
)  # fmt: skip
def test_where_sticks_take_over(mode: Mode, override: int, taken: bool) -> None:
    flight = Flight(mode, COM_RC_OVERRIDE=override)
    assert flight.commander.request_takeover() == taken
    assert flight.commander.mode is (Mode.POSCTL if taken else mode)


def test_sticks_take_over_in_the_best_mode_there_is() -> None:
    for lost, mode in (({"position_valid": False}, Mode.ALTCTL), ({"height_valid": False}, Mode.STABILIZED)):
        flight = Flight()
        flight.happens(steady(**lost))
        flight.run(SLACK_S)
        assert flight.done() is Action.DESCEND
        assert flight.commander.request_takeover()
        flight.run(SLACK_S)
        assert flight.commander.mode is mode


@pytest.mark.parametrize("name", ["geofence breached", "wind limit exceeded", "position accuracy low"])
def test_some_holds_are_ended_by_a_mode_switch_only(name: str) -> None:
    row = ROWS[name]
    assert isinstance(row.action, By)
    flight = trip(name, **{row.action.parameter: 2})
    flight.run(6.0)
    assert flight.done() is Action.HOLD
    assert not flight.commander.request_takeover()
    assert flight.commander.request_mode(Mode.POSCTL, "") == ACCEPTED
    flight.run(1.0)
    assert flight.commander.mode is Mode.POSCTL


@pytest.mark.parametrize("name", ["wind limit exceeded", "maximum flight time exceeded"])
def test_beyond_wind_and_flight_time_no_mode_is_chosen_that_stays_up(name: str) -> None:
    flight = trip(name)
    flight.run(CAUSES[name].after_s + SLACK_S)
    for mode in (Mode.MISSION, Mode.LOITER, Mode.ORBIT):
        assert flight.commander.request_mode(mode, "") == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    for mode in (Mode.RTL, Mode.LAND, Mode.POSCTL, Mode.OFFBOARD):
        assert flight.commander.request_mode(mode, "") == ACCEPTED


def test_an_orbit_is_not_taken_up_again() -> None:
    flight = Flight(Mode.ORBIT, COM_RC_LOSS_T=0.5)
    flight.happens(steady(sticks_age_us=None))
    flight.run(1.0)
    flight.happens(None)
    flight.run(1.0)
    assert (flight.commander.mode, flight.commander.failsafe) == (Mode.LOITER, False)


# --- kill


def test_a_kill_that_is_taken_back_in_time_does_not_disarm() -> None:
    flight = Flight()
    flight.commander.request_kill(True)
    flight.run(4.5)
    flight.commander.request_kill(False)
    flight.run(3.0)
    assert flight.commander.armed
    assert flight.news() == ["Kill engaged", "Kill disengaged"]
    flight.commander.request_kill(True)
    assert flight.until(lambda: not flight.commander.armed, 6.0) == pytest.approx(5.0, abs=SLACK_S)


def test_a_latched_kill_stays_and_does_not_arm() -> None:
    flight = Flight()
    assert flight.commander.request_kill(True, latch=True) == ACCEPTED
    assert flight.commander.request_kill(False) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert flight.commander.kill_engaged
    flight.run(6.0)
    assert flight.commander.request_arm(True, False, flight.now_us) == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
    assert flight.said[-1] == "Arming denied: kill switch engaged"


# --- arming


ARMING: list[tuple[Mode, dict[str, float], dict[str, Any], str | None]] = [
    (Mode.LOITER, {}, {}, None),
    (Mode.LOITER, {"COM_ARMABLE": 0}, {}, "vehicle is in safety configuration (COM_ARMABLE)"),
    (Mode.LOITER, {"COM_ARM_MIS_REQ": 1}, {"mission_refusal": "no mission"}, "no mission"),
    (Mode.LOITER, {}, {"mission_refusal": "no mission"}, None),
    (
        Mode.LOITER,
        {"COM_ARM_BAT_MIN": 0.5},
        {"battery_charge": 0.4},
        "battery at 40%, need 50% (COM_ARM_BAT_MIN)",
    ),
    (Mode.LOITER, {"COM_WIND_MAX": 10}, {"wind_m_s": 11.0}, "wind 11.0 m/s, COM_WIND_MAX is 10"),
    (Mode.LOITER, {}, {"position_valid": False}, "position estimate invalid"),
    (Mode.STABILIZED, {}, {"position_valid": False}, None),
    (Mode.STABILIZED, {}, {"attitude_valid": False}, "attitude estimate invalid"),
    (Mode.STABILIZED, {}, {"throttle": 0.11}, "high throttle"),
    (Mode.ACRO, {}, {"throttle": 0.5}, "high throttle"),
    (Mode.ALTCTL, {}, {"throttle": 0.5}, None),
    (Mode.POSCTL, {}, {"throttle": 0.61}, "throttle above center"),
    (Mode.LOITER, {}, {"throttle": 1.0}, None),
    (Mode.OFFBOARD, {}, {"position_valid": False, "stream_needs": Need.POSITION}, "position estimate invalid"),
    (Mode.OFFBOARD, {}, {"position_valid": False}, None),
]


@pytest.mark.parametrize(("mode", "parameters", "changes", "refusal"), ARMING)
def test_arming(mode: Mode, parameters: dict[str, float], changes: dict[str, Any], refusal: str | None) -> None:
    said: list[str] = []
    values = {name: row.default for name, row in TABLE.items()} | parameters
    commander = Commander(values, lambda severity, text: said.append(text))
    commander.request_mode(mode, "")
    commander.step(0, replace(WELL, landed=True, **changes))
    assert (commander.request_arm(True, False, 0) == ACCEPTED) == (refusal is None)
    assert said[-1] == ("Armed by external command" if refusal is None else f"Arming denied: {refusal}")


# --- whatever happens


AGES = st.sampled_from([None, 0, 400_000, 2_000_000, 20_000_000])
STREAM_NEEDS = (Need.NOTHING, Need.ATTITUDE, Need.ATTITUDE | Need.POSITION | Need.HEIGHT)
SITUATIONS = st.builds(
    Situation,
    landed=st.booleans(), setpoint_age_us=AGES, sticks_age_us=AGES, gcs_age_us=AGES,
    mission_refusal=st.sampled_from([None, "no mission"]), health_refusal=st.sampled_from([None, "gyro fault"]),
    battery_level=st.integers(0, 3), fence_breach=st.sampled_from([None, None, "too far"]),
    attitude_valid=st.sampled_from([True, True, True, False]), height_valid=st.booleans(),
    velocity_valid=st.booleans(), position_valid=st.booleans(), stream_needs=st.sampled_from(STREAM_NEEDS),
    roll_rad=st.sampled_from([0.0, 2.0]), pitch_rad=st.sampled_from([0.0, -1.5]),
    altitude_loss_m=st.sampled_from([0.0, 30.0]), motor_failure=st.integers(0, 15),
    battery_age_us=st.sampled_from([0, 6_000_000]), battery_charge=st.floats(0.0, 1.0),
    return_margin_s=st.sampled_from([100.0, -1.0]), airborne_s=st.floats(0.0, 200.0), wind_m_s=st.floats(0.0, 30.0),
    position_error_m=st.floats(0.0, 50.0), mission_failure=st.sampled_from([None, "no mission"]),
    mission_finished=st.booleans(), throttle=st.floats(0.0, 1.0),
)  # fmt: skip
CHOSEN = sorted(
    {row.action.parameter for row in FAILSAFES if isinstance(row.action, By)}
    | {"CBRK_FLIGHTTERM", "COM_RC_IN_MODE", "FD_ACT_EN"}
)
PARAMETERS = st.fixed_dictionaries(
    {name: st.sampled_from(sorted(TABLE[name].values)) for name in CHOSEN}
    | {"COM_FAIL_ACT_T": st.sampled_from([0.0, 5.0]), "COM_FLT_TIME_MAX": st.sampled_from([-1, 100])}
    | {"COM_WIND_MAX": st.sampled_from([-1.0, 20.0]), "COM_RCL_EXCEPT": st.integers(0, 31)}
    | {"FD_ALT_LOSS": st.sampled_from([0.0, 10.0]), "COM_POS_LOW_EPH": st.sampled_from([-1.0, 20.0])}
)
EVENTS = st.one_of(
    SITUATIONS,
    st.sampled_from(list(Mode)),
    st.sampled_from(["arm", "disarm", "force", "kill", "revive", "sticks"]),
    st.integers(1, 700).map(lambda looks: looks),
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(PARAMETERS, st.lists(EVENTS, max_size=25))
def test_whatever_happens(parameters: dict[str, float], events: list[Any]) -> None:
    """Nothing raises; a termination stays; who is disarmed is in no fail-safe; what flies has its estimates."""
    values = {name: row.default for name, row in TABLE.items()} | parameters
    said: list[str] = []
    commander = Commander(values, lambda severity, text: said.append(text))
    commander.home_set = True
    situation, now_us, terminated = replace(WELL, landed=True), 0, False
    for event in events:
        looks = 1
        match event:
            case Situation():
                situation = event
            case Mode():
                commander.request_mode(event, "")
            case "arm":
                commander.request_arm(True, False, now_us)
            case "disarm" | "force":
                commander.request_arm(False, event == "force", now_us)
            case "kill" | "revive":
                commander.request_kill(event == "kill")
            case "sticks":
                commander.request_takeover()
            case _:
                looks = event
        for _ in range(looks):
            now_us += LOOK_US
            commander.step(now_us, situation)
            assert not (terminated and commander.mode is not Mode.TERMINATION)
            terminated = commander.mode is Mode.TERMINATION
            assert not commander.failsafe or commander.armed
            if commander.failsafe:
                assert commander.mode in ACTION_MODES.values()
                assert commander.cannot_fly(commander.mode) is None
            if commander.armed:
                needs = MODES[commander.mode].needs
                assert situation.attitude_valid or Need.ATTITUDE not in needs
                assert situation.height_valid or Need.HEIGHT not in needs
                assert situation.velocity_valid or Need.VELOCITY not in needs
                assert situation.position_valid or Need.POSITION not in needs
    assert all(len(text) < 200 for text in said)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    PARAMETERS, SITUATIONS,
    st.sampled_from([mode for mode, info in MODES.items() if info.control is not Control.NOBODY]),
)  # fmt: skip
def test_one_situation_only_ever_gets_worse(parameters: dict[str, float], situation: Situation, mode: Mode) -> None:
    """While nothing changes and nobody chooses, what is done about it never becomes less."""
    flight = Flight(mode, **parameters)
    flight.changes = lambda since_us: asdict(replace(situation, landed=False))
    reached = Action.NONE
    for _ in range(700):
        flight.step()
        done = flight.done()
        assert done >= reached or reached is Action.WARN
        reached = max(done, reached)
        if not flight.commander.armed or flight.commander.mode is Mode.TERMINATION:
            break
