"""The vehicle's plan: table of commands, actions, progress with jumps, feasibility, persistence, real clients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from math import inf, isnan, nan
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot import plan
from mavsitl_vehicle.autopilot.fence import Fence, FenceLimits, FenceProblem, read_zones
from mavsitl_vehicle.autopilot.plan import (
    COMMANDS,
    ChangeSpeed,
    Delay,
    Effect,
    FeasibilityContext,
    FlyTo,
    Home,
    Land,
    LoiterTime,
    LoiterToAltitude,
    LoiterUnlimited,
    MissionProgress,
    PlanError,
    ReturnToLaunch,
    SetHome,
    SetRoi,
    Skip,
    Takeoff,
    VehiclePlan,
    action,
    check_mission_item,
    feasibility,
    from_document,
    settle,
    takeoff_before,
    to_document,
    validate_plan,
)

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.geodesy import Origin
from mavsitl.services.mission import FENCE, MISSION, NOWHERE, RALLY, MissionItem, MissionServer, check_item, same_plan

CLIENT = (255, 190)
VEHICLE = (1, 1)
ORIGIN = Origin(47.3977418, 8.5455939, 488.0)
HOME = Home(47.3977418, 8.5455939, 488.0)
ACCEPTED, UNSUPPORTED, UNSUPPORTED_FRAME = 0, 3, 2
PARAM1, PARAM2, PARAM5, PARAM6, PARAM7 = 6, 7, 10, 11, 12
NO_MISSION, NOT_STARTED, ACTIVE, PAUSED, COMPLETE = 1, 2, 3, 4, 5
X, Y = 473_980_000, 85_460_000

TAKEOFF, WAYPOINT, LAND, RTL, JUMP, SPEED, CAMERA = 22, 16, 21, 20, 177, 178, 2000


def item(
    command: int = WAYPOINT, *params: float, frame: int = 6, x: int = X, y: int = Y, z: float = 10.0, go: int = 1
) -> MissionItem:
    p1, p2, p3, p4 = (*params, *(0.0, 0.0, 0.0, nan)[len(params) :])
    return MissionItem(command, frame, p1, p2, p3, p4, x, y, z, go)


def bare(command: int, *params: float) -> MissionItem:
    """An item without a position."""
    return item(command, *params, frame=2, x=0, y=0, z=0.0)


def jump(seq: float, times: float) -> MissionItem:
    return bare(JUMP, seq, times)


def act(one: MissionItem) -> plan.Action:
    assert check_mission_item(one) == ACCEPTED
    return action(one, HOME.altitude_amsl_m, 2.5)


# --- the table


@pytest.mark.parametrize(
    "command",
    [
        *(16, 17, 19, 20, 21, 22, 31, 93, 112, 113, 114, 115, 177, 178, 179, 195, 197, 201),
        *(203, 205, 206, 530, 1000, 2000, 2001, 2500, 2501),
    ],
)
def test_commands_that_clients_send_are_accepted(command: int) -> None:
    frames = (6,) if COMMANDS[command].place is not plan.Place.NONE else (2, 5, 6)
    params = {178: (1.0, 5.0), 177: (0.0, 1.0)}.get(command, (0.0, 0.0))
    for frame in frames:
        assert check_mission_item(item(command, *params, frame=frame)) == ACCEPTED


@pytest.mark.parametrize("command", [0, 18, 82, 84, 85, 92, 181, 183, 211, 400, 3000, 31000, 65535])
def test_other_commands_are_unsupported(command: int) -> None:
    assert check_mission_item(item(command)) == UNSUPPORTED


@pytest.mark.parametrize(
    ("one", "result"),
    [
        (item(frame=2), UNSUPPORTED_FRAME),
        (item(TAKEOFF, frame=2), UNSUPPORTED_FRAME),
        (item(x=NOWHERE), PARAM5),
        (item(y=NOWHERE), PARAM6),
        (item(TAKEOFF, x=NOWHERE), PARAM5),
        (item(LAND, y=NOWHERE), PARAM6),
        (item(z=nan), PARAM7),
        (item(19, 5.0, z=nan), PARAM7),
        (item(z=1e9), PARAM7),
        (item(TAKEOFF, z=nan), ACCEPTED),
        (item(LAND, z=nan), ACCEPTED),
        (item(TAKEOFF, x=NOWHERE, y=NOWHERE), ACCEPTED),
        (item(LAND, x=0, y=0), ACCEPTED),
        (item(x=0, y=0), ACCEPTED),
        (item(WAYPOINT, nan, nan, nan, nan), ACCEPTED),
        (item(19, nan), PARAM1),
        (item(19, -1.0), PARAM1),
        (bare(93, -1.0), PARAM1),
        (bare(93, nan), PARAM1),
        (jump(nan, 1), PARAM1),
        (jump(-1, 1), PARAM1),
        (jump(1.5, 1), PARAM1),
        (jump(1, nan), PARAM2),
        (jump(1, -2), PARAM2),
        (jump(1, -1), ACCEPTED),
        (bare(SPEED, 1, 0), PARAM2),
        (bare(SPEED, 1, nan), PARAM2),
        (bare(SPEED, 4, 5), PARAM1),
        (bare(SPEED, nan, 5), ACCEPTED),
        (bare(SPEED, 1, -2), ACCEPTED),
        (bare(179, 1), ACCEPTED),
        (bare(179, 0), UNSUPPORTED_FRAME),
        (bare(179, nan), PARAM1),
        (bare(201, 0), ACCEPTED),
        (bare(201, 3), UNSUPPORTED_FRAME),
        (bare(201, 4), PARAM1),
    ],
)
def test_parameters_are_checked(one: MissionItem, result: int) -> None:
    assert check_mission_item(one) == result


def test_jumps_lead_into_the_mission() -> None:
    assert validate_plan(MISSION, [item(), jump(1, 1), jump(2, 1)]) == (ACCEPTED, 0)
    assert validate_plan(MISSION, [item(), jump(1, 1), jump(3, 1)]) == (PARAM1, 2)


# --- actions


@pytest.mark.parametrize(
    ("one", "expected"),
    [
        (item(WAYPOINT, 3.0, 2.0, 0.0, 90.0), FlyTo(47.398, 8.546, 498.0, 3.0, 2.0, 90.0)),
        (item(WAYPOINT, nan, nan, 0.0, nan, frame=5, z=510.0), FlyTo(47.398, 8.546, 510.0, 0.0, None, None)),
        (item(WAYPOINT, -1.0, 0.0, x=0, y=0), FlyTo(0.0, 0.0, 498.0, 0.0, None, None)),
        (item(TAKEOFF, z=20.0), Takeoff(47.398, 8.546, 508.0, None)),
        (item(TAKEOFF, x=0, y=0, z=nan), Takeoff(None, None, 490.5, None)),
        (item(TAKEOFF, x=NOWHERE, y=NOWHERE, frame=5, z=500.0), Takeoff(None, None, 500.0, None)),
        (item(LAND, 0, 0, 0, 45.0), Land(47.398, 8.546, 45.0)),
        (item(LAND, x=0, y=0), Land(None, None, None)),
        (bare(RTL), ReturnToLaunch()),
        (item(19, 12.5), LoiterTime(47.398, 8.546, 498.0, 12.5, None)),
        (item(17, x=NOWHERE, y=NOWHERE), LoiterUnlimited(None, None, 498.0, None)),
        (item(31, z=30.0), LoiterToAltitude(47.398, 8.546, 518.0)),
        (bare(93, 4.0), Delay(4.0)),
        (bare(SPEED, 1, 7.5), ChangeSpeed(1, 7.5)),
        (bare(SPEED, nan, -2), ChangeSpeed(1, None)),
        (bare(SPEED, 1, -1), Skip(178, "DO_CHANGE_SPEED")),
        (bare(179, 1), SetHome(None, None, None)),
        (item(179, 0.0), SetHome(47.398, 8.546, 498.0)),
        (item(195), SetRoi(47.398, 8.546, 498.0)),
        (item(201, 3.0), SetRoi(47.398, 8.546, 498.0)),
        (bare(201, 0), SetRoi(None, None, None)),
        (bare(201, 1), Skip(201, "DO_SET_ROI")),
        (bare(197), SetRoi(None, None, None)),
        (bare(CAMERA), Skip(2000, "IMAGE_START_CAPTURE")),
    ],
)
def test_actions(one: MissionItem, expected: plan.Action) -> None:
    assert act(one) == expected


def test_every_command_of_the_table_has_an_action_of_its_kind() -> None:
    params = {178: (1.0, 5.0), 177: (0.0, 1.0), 201: (3.0,)}
    for command, info in COMMANDS.items():
        done = act(item(command, *params.get(command, ())))
        assert isinstance(done, Skip) == (info.effect in (Effect.SKIP, Effect.JUMP)), command


def test_a_mission_without_takeoff_climbs_first() -> None:
    assert takeoff_before(act(item(z=20.0)), 488.0, 2.5) == Takeoff(None, None, 508.0, None)
    assert takeoff_before(act(item(z=1.0)), 488.0, 2.5) == Takeoff(None, None, 490.5, None)
    for one in (item(TAKEOFF), item(LAND), bare(RTL), bare(93, 1.0)):
        assert takeoff_before(act(one), 488.0, 2.5) is None


# --- progress


def fly(items: Sequence[MissionItem], limit: int = 100) -> list[int]:
    """Every item in the order in which it is done, to the end of the mission."""
    progress = replace(plan.begin(items), state=ACTIVE)
    done: list[int] = []
    while len(done) < limit:
        step = settle(items, progress)
        done += step.done
        progress = step.progress
        if progress.state == COMPLETE:
            assert progress.jumps == ()
            break
        if COMMANDS[items[progress.seq].command].effect is Effect.FLY:
            done.append(progress.seq)
            progress = plan.advance(items, progress)
    return done


def test_straight_on() -> None:
    assert fly([item(TAKEOFF), bare(SPEED, 1, 5), item(), bare(CAMERA), item(LAND)]) == [0, 1, 2, 3, 4]
    assert fly([item(), bare(CAMERA), bare(CAMERA)]) == [0, 1, 2]
    assert fly([bare(CAMERA)]) == [0]


def test_jumps_are_taken_so_many_times() -> None:
    assert fly([item(), item(), jump(0, 2), item()]) == [0, 1, 0, 1, 0, 1, 3]
    assert fly([item(), jump(0, 0), item()]) == [0, 2]
    assert fly([item(), jump(3, 1), item(), item()]) == [0, 3]
    assert fly([jump(1, 1), item()]) == [1]
    assert fly([item(), item(), jump(0, 1)]) == [0, 1, 0, 1]


def test_nested_jumps_count_each_for_itself() -> None:
    # As on PX4, the inner count is not set back by the outer jump.
    assert fly([item(), jump(0, 2), item(), jump(0, 1), item()]) == [0, 0, 0, 2, 0, 2, 4]


def test_a_jump_for_ever() -> None:
    assert fly([item(), item(), jump(0, -1)], limit=11) == [0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0]


@pytest.mark.parametrize(
    "items",
    [
        [jump(0, -1)],
        [jump(1, -1), jump(0, -1), item()],
        [item(), jump(1, 65535), item()],
        [jump(2, -1), item(), jump(0, -1)],
    ],
)
def test_jumps_among_themselves_end(items: list[MissionItem]) -> None:
    assert len(fly(items, limit=50)) <= 2


def test_a_loop_of_instantaneous_items_is_bounded_per_call() -> None:
    items = [bare(CAMERA), jump(0, -1)]
    step = settle(items, replace(plan.begin(items), state=ACTIVE))
    assert step.done == (0,) * plan.INSTANT_ITEMS_PER_SETTLE
    assert step.progress.state == ACTIVE


def test_settle_is_idempotent_where_something_is_flown() -> None:
    items = [bare(CAMERA), item(), jump(0, 3)]
    step = settle(items, replace(plan.begin(items), state=ACTIVE))
    assert (step.progress.seq, step.done) == (1, (0,))
    assert settle(items, step.progress) == (step.progress, ())


@pytest.mark.parametrize("state", [NO_MISSION, NOT_STARTED, PAUSED, COMPLETE])
def test_nothing_moves_while_not_active(state: int) -> None:
    items = [bare(CAMERA), item()]
    progress = MissionProgress(0, state)
    assert settle(items, progress) == (progress, ())
    assert plan.advance(items, progress) == progress


def test_autocontinue_off_waits() -> None:
    items = [item(go=0), item()]
    progress = replace(plan.begin(items), state=ACTIVE)
    waiting = plan.advance(items, progress)
    assert (waiting.seq, waiting.waiting, waiting.state) == (0, True, ACTIVE)
    assert settle(items, waiting).progress == waiting
    assert plan.advance(items, waiting) == replace(progress, seq=1)


def test_jump_to() -> None:
    items = [item(), jump(0, 1), item()]
    progress = MissionProgress(2, ACTIVE, ((1, 1),), True)
    assert plan.jump_to(items, progress, 0) == MissionProgress(0, ACTIVE, ((1, 1),), False)
    assert plan.jump_to(items, progress, 1, reset_jumps=True) == MissionProgress(1, ACTIVE)
    assert plan.jump_to(items, replace(progress, state=COMPLETE), 0, True) == MissionProgress(0, NOT_STARTED)
    for seq in (-1, 3, 65535):
        assert plan.jump_to(items, progress, seq) is None
    assert plan.jump_to([], MissionProgress(), 0) is None


def test_following_looks_past_jumps_and_what_has_no_position() -> None:
    items = [item(), bare(CAMERA), item(195), bare(93, 1), jump(5, 1), item(), bare(RTL), item(LAND, x=0, y=0)]
    assert plan.following(items, MissionProgress(0, ACTIVE)) == 5
    assert plan.following(items, MissionProgress(5, ACTIVE)) is None
    assert plan.following([item(), item(), jump(0, 1)], MissionProgress(1, ACTIVE)) == 0
    assert plan.following([item(), item(), jump(0, 1)], MissionProgress(1, ACTIVE, ((2, 1),))) is None
    assert plan.following([bare(93, 1), jump(0, -1)], MissionProgress(0, ACTIVE)) is None


any_item = st.builds(
    MissionItem,
    command=st.sampled_from(sorted(COMMANDS)),
    frame=st.sampled_from([2, 5, 6]),
    param1=st.one_of(st.integers(0, 8).map(float), st.floats(width=32)),
    param2=st.one_of(st.integers(-1, 3).map(float), st.floats(width=32)),
    param3=st.just(0.0),
    param4=st.floats(width=32),
    x=st.sampled_from([0, X, X + 5000, NOWHERE]),
    y=st.sampled_from([0, Y, NOWHERE]),
    z=st.floats(-100, 1000, width=32),
    autocontinue=st.sampled_from([0, 1, 1]),
)


@given(st.lists(any_item, max_size=12))
def test_any_accepted_mission_can_be_flown_and_judged(items: list[MissionItem]) -> None:
    items = [one for one in items if check_item(MISSION, one) == ACCEPTED and check_mission_item(one) == ACCEPTED]
    if validate_plan(MISSION, items)[0] != ACCEPTED:
        return
    vehicle = VehiclePlan()
    vehicle.stores.replace(MISSION, items)
    for finding in vehicle.feasibility(context()):
        assert finding.text
    vehicle.start()
    for _ in range(60):
        turn = vehicle.turn(488.0, 2.5)
        assert len(turn.instants) <= plan.INSTANT_ITEMS_PER_SETTLE
        if turn.fly is not None:
            assert turn.seq == vehicle.status().seq
            assert COMMANDS[items[turn.seq].command].effect is Effect.FLY
            assert turn.fly == action(items[turn.seq], 488.0, 2.5) or isnan(items[turn.seq].z)
            vehicle.following(488.0, 2.5)
            vehicle.advance()
        elif vehicle.progress.waiting:
            assert vehicle.start()
        assert 0 <= vehicle.status().seq < max(len(items), 1)
    assert same_plan(from_document(vehicle.to_document())[0][MISSION], items)


# --- feasibility


def context(**changes: Any) -> FeasibilityContext:
    return FeasibilityContext(landed=True, home=HOME, projection=ORIGIN)._replace(**changes)


def at(north_m: float, west_m: float, command: int = WAYPOINT, z: float = 10.0, frame: int = 6) -> MissionItem:
    latitude_deg, longitude_deg = ORIGIN.to_global(north_m, west_m)
    return item(command, x=round(latitude_deg * 1e7), y=round(longitude_deg * 1e7), z=z, frame=frame)


GOOD = [at(0, 0, TAKEOFF), at(30, 0), at(30, 30), at(0, 0, LAND, 0.0)]


def test_good_missions() -> None:
    assert feasibility(GOOD, context()) == []
    assert feasibility(GOOD[1:3], context()) == []  # MAVSDK: no take-off, no landing
    assert feasibility([*GOOD[:3], bare(RTL)], context()) == []
    assert feasibility([bare(CAMERA), bare(93, 1.0), *GOOD], context()) == []
    assert feasibility([GOOD[3]], context(landed=False)) == []


@pytest.mark.parametrize(
    ("items", "changes", "seq", "text"),
    [
        ([], {}, None, "there is no mission"),
        (GOOD, {"home": None}, None, "home is not known yet"),
        ([GOOD[3], GOOD[1]], {}, 0, "item 0: begins with a landing, on the ground"),
        ([bare(CAMERA), GOOD[3]], {}, 1, "item 1: begins with a landing, on the ground"),
        ([at(0, 0, TAKEOFF, 0.0)], {}, 0, "item 0: take-off to 0.0 m above home, need > 0 m"),
        ([at(0, 0, TAKEOFF, 480.0, 5)], {}, 0, "item 0: take-off to -8.0 m above home, need > 0 m"),
        ([at(9, 0), GOOD[0]], {}, 1, "item 1: take-off must be the first position, item 0 is NAV_WAYPOINT"),
        ([item(), jump(5, 1)], {}, 1, "item 1: jump to item 5, there are 2"),
        ([item(), bare(CAMERA), jump(1, 1)], {}, 2, "item 2: jump to item 1 passes nothing that is flown"),
        ([item(), jump(1, -1)], {}, 1, "item 1: jump to item 1 passes nothing that is flown"),
        (GOOD[1:], {"takeoff_land_required": 1}, None, "no take-off, MIS_TKO_LAND_REQ is 1"),
        (GOOD[:2], {"takeoff_land_required": 2}, None, "no landing, MIS_TKO_LAND_REQ is 2"),
        (GOOD[:2], {"takeoff_land_required": 3}, None, "no landing, MIS_TKO_LAND_REQ is 3"),
        (GOOD[:2], {"takeoff_land_required": 4}, None, "take-off without landing, MIS_TKO_LAND_REQ is 4"),
        (GOOD[1:], {"takeoff_land_required": 5}, None, "landing without take-off, MIS_TKO_LAND_REQ is 5"),
        (
            GOOD[:2],
            {"takeoff_land_required": 5, "landed": False},
            None,
            "no landing, MIS_TKO_LAND_REQ is 5",
        ),
        (
            GOOD[:2],
            {"limits": FenceLimits(20.0)},
            1,
            "item 1: outside the geofence: 30.0 m from home, limit 20.0 m",
        ),
        (
            [GOOD[0], at(5, 0, z=508.5, frame=5)],
            {"limits": FenceLimits(0.0, 20.0)},
            1,
            "item 1: outside the geofence: 20.5 m above home, limit 20.0 m",
        ),
        (
            [item(TAKEOFF, x=0, y=0, z=25.0)],
            {"limits": FenceLimits(0.0, 20.0)},
            0,
            "item 0: outside the geofence: 25.0 m above home, limit 20.0 m",
        ),
    ],
)
def test_missions_that_are_refused(items: list[MissionItem], changes: dict[str, Any], seq: int, text: str) -> None:
    assert feasibility(items, context(**changes)) == [(True, seq, text)]


def test_waypoint_outside_the_zones() -> None:
    zones = read_zones([at(0, 0, 5003)._replace(param1=25.0, param2=0.0)])
    assert not isinstance(zones, FenceProblem)
    fence = Fence(zones, ORIGIN)
    assert feasibility([at(20, 0)], context(fence=fence)) == []
    (finding,) = feasibility([at(20, 0), at(30, 0)], context(fence=fence))
    assert finding == (True, 1, "item 1: outside the geofence: 5.0 m outside inclusion circle 0")


def test_a_far_first_waypoint_is_a_warning() -> None:
    (finding,) = feasibility([at(11_000, 0), at(12_000, 0)], context())
    assert finding == (False, 0, "item 0: first waypoint 11000 m from home, more than 10000 m")
    assert feasibility([at(11_000, 0)], context(first_waypoint_m=0.0)) == []


# --- persistence


def _through_a_file(document: Mapping[str, Any]) -> Any:
    """As the state folder has it."""
    return msgspec.json.decode(msgspec.json.encode(document))


def test_round_trip_through_a_file() -> None:
    plans = {
        MISSION: (item(WAYPOINT, 0.1, nan, -0.0, nan), item(x=NOWHERE, command=LAND, y=NOWHERE, z=nan)),
        FENCE: tuple(item(5001, 3.0, 0.0, x=X + n * n, y=Y + n) for n in range(3)),
        RALLY: (item(5100),),
    }
    back, seq = from_document(_through_a_file(to_document(plans, 1)))
    assert seq == 1
    for mission_type, items in plans.items():
        assert same_plan(back[mission_type], items)


def test_a_vehicle_comes_back_with_its_plan() -> None:
    first, second = VehiclePlan(), VehiclePlan()
    first.stores.replace(MISSION, GOOD)
    first.stores.replace(RALLY, [item(5100)])
    first.jump_to(2)
    second.load_document(_through_a_file(first.to_document()))
    assert second.status() == first.status() == (2, 4, NOT_STARTED, 2)
    for mission_type in (MISSION, FENCE, RALLY):
        assert same_plan(second.stores.items(mission_type), first.stores.items(mission_type))
        assert second.stores.id(mission_type) == first.stores.id(mission_type)
    assert second.rally_points(488.0) == ((47.398, 8.546, 498.0),)


def _changed(path: tuple[Any, ...], value: Any) -> dict[str, Any]:
    document = to_document({MISSION: [item(), item()], FENCE: [item(5003, 5.0)]})
    target = document
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    return document


@pytest.mark.parametrize(
    "document",
    [
        {},
        _changed(("current",), 2),
        _changed(("current",), -1),
        _changed(("current",), True),
        _changed(("current",), None),
        _changed(("mission",), None),
        _changed(("mission",), [None]),
        _changed(("mission",), [{}]),
        _changed(("mission",), [{}] * 2001),
        _changed(("mission", 1, "command"), 65536),
        _changed(("mission", 1, "command"), 18),
        _changed(("mission", 1, "command"), 16.0),
        _changed(("mission", 1, "command"), True),
        _changed(("mission", 1, "frame"), 3),
        _changed(("mission", 1, "x"), 2**31),
        _changed(("mission", 1, "x"), 900_000_001),
        _changed(("mission", 1, "x"), None),
        _changed(("mission", 1, "z"), "10"),
        _changed(("mission", 1, "z"), None),
        _changed(("mission", 1, "z"), inf),
        _changed(("mission", 1, "z"), 10**400),
        _changed(("mission", 1, "more"), 1),
        _changed(("fence", 0, "param1"), -5.0),
        _changed(("fence", 0, "command"), 5001),
        _changed(("rally",), [item()._asdict() | {"param4": 0.0}]),
    ],
)
def test_bad_documents_raise_plan_error_and_change_nothing(document: dict[str, Any]) -> None:
    vehicle = VehiclePlan()
    vehicle.stores.replace(MISSION, GOOD)
    with pytest.raises(PlanError):
        vehicle.load_document(document)
    assert same_plan(vehicle.mission, GOOD)


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(("x", "command", "z")), inner),
    max_leaves=8,
)


@given(st.fixed_dictionaries(dict.fromkeys(("mission", "fence", "rally", "current"), _JSON)))
def test_any_document_is_a_plan_or_a_plan_error(document: dict[str, Any]) -> None:
    with suppress(PlanError):
        plans, seq = from_document(document)
        assert seq == 0
        assert not any(plans.values())


# --- the vehicle's own plan


def test_a_flight() -> None:
    vehicle = VehiclePlan()
    assert vehicle.status() == (0, 65535, NO_MISSION, 2)
    assert not vehicle.start()
    vehicle.stores.replace(MISSION, [item(TAKEOFF), bare(SPEED, 1, 3), item(go=0), item(LAND), bare(CAMERA)])
    assert vehicle.status() == (0, 5, NOT_STARTED, 2)
    assert vehicle.turn(488.0, 2.5) == ((), None, None)
    vehicle.in_mission_mode = True
    assert vehicle.start()
    assert vehicle.turn(488.0, 2.5) == ((), 0, Takeoff(47.398, 8.546, 498.0, None))
    assert vehicle.status() == (0, 5, ACTIVE, 1)
    revision = vehicle.revision
    assert vehicle.turn(488.0, 2.5).seq == 0
    assert vehicle.revision == revision
    vehicle.advance()
    turn = vehicle.turn(488.0, 2.5)
    assert (turn.instants, turn.seq) == ((ChangeSpeed(1, 3.0),), 2)
    assert vehicle.revision > revision
    assert vehicle.following(488.0, 2.5) == Land(47.398, 8.546, None)
    vehicle.pause()
    assert vehicle.status() == (2, 5, PAUSED, 1)
    vehicle.advance()
    assert vehicle.turn(488.0, 2.5) == ((), None, None)
    assert vehicle.start()
    assert vehicle.turn(488.0, 2.5) == ((), 2, turn.fly)
    vehicle.advance()
    assert vehicle.turn(488.0, 2.5) == ((), None, None)  # autocontinue 0
    vehicle.advance()
    assert vehicle.status() == (2, 5, ACTIVE, 1)
    vehicle.start()
    assert vehicle.turn(488.0, 2.5).seq == 3
    vehicle.advance()
    assert vehicle.turn(488.0, 2.5) == ((Skip(CAMERA, "IMAGE_START_CAPTURE"),), None, None)
    assert vehicle.status() == (4, 5, COMPLETE, 1)
    assert vehicle.stores.reached_since(0) == [0, 1, 2, 3, 4]
    vehicle.start()
    assert vehicle.turn(488.0, 2.5).seq == 0


def test_the_same_mission_uploaded_again_in_flight_goes_on() -> None:
    vehicle = VehiclePlan()
    vehicle.stores.replace(MISSION, GOOD)
    vehicle.jump_to(2)
    vehicle.start()
    vehicle.stores.replace(MISSION, GOOD)
    assert vehicle.status()[:3] == (2, 4, ACTIVE)
    vehicle.stores.replace(MISSION, GOOD[:3])
    assert vehicle.status()[:3] == (0, 3, NOT_STARTED)
    vehicle.jump_to(2)
    vehicle.stores.replace(MISSION, GOOD[:3])
    assert vehicle.status()[:3] == (0, 3, NOT_STARTED)
    vehicle.stores.replace(MISSION, ())
    assert vehicle.status()[:3] == (0, 65535, NO_MISSION)
    vehicle.stores.replace(MISSION, GOOD, 3)
    assert vehicle.status()[:3] == (3, 4, NOT_STARTED)


# --- what clients send


class Ground:
    """Speaks for a client; every message goes over the wire's encoding."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.changes: list[int] = []
        self.vehicle = VehiclePlan(lambda severity, text: self.texts.append(text), changed=self.changes.append)
        self.server = MissionServer(self.vehicle.stores, current_interval_us=None)
        self.now_us = 0

    def say(self, message: Any) -> Any:
        (frame,) = parse(encode(message, 0, *CLIENT))
        self.now_us += 4_000
        (answer,) = self.server.receive(frame.message, CLIENT, self.now_us)
        return parse(encode(answer, 0, *VEHICLE))[0].message

    def upload(self, messages: Sequence[Any], mission_type: int = MISSION) -> int:
        answer = self.say(mavlink.MAVLink_mission_count_message(*VEHICLE, len(messages), mission_type))
        while not isinstance(answer, mavlink.MAVLink_mission_ack_message):
            answer = self.say(messages[answer.seq])
        assert answer.mission_type == mission_type
        return int(answer.type)

    def download(self, mission_type: int = MISSION) -> list[Any]:
        answer = self.say(mavlink.MAVLink_mission_request_list_message(*VEHICLE, mission_type))
        return [
            self.say(mavlink.MAVLink_mission_request_int_message(*VEHICLE, seq, mission_type))
            for seq in range(answer.count)
        ]

    def actions(self) -> list[plan.Action]:
        """All that a flight would do, in order."""
        done: list[plan.Action] = []
        assert self.vehicle.start()
        while self.vehicle.progress.state == ACTIVE:
            turn = self.vehicle.turn(HOME.altitude_amsl_m, 2.5)
            done += turn.instants
            if turn.fly is not None:
                done.append(turn.fly)
                self.vehicle.advance()
        return done


def item_int(
    seq: int, frame: int, command: int, params: Sequence[float], x: int, y: int, z: float, kind: int = 0
) -> Any:
    current = int(kind == MISSION and seq == 0)
    return mavlink.MAVLink_mission_item_int_message(*VEHICLE, seq, frame, command, current, 1, *params, x, y, z, kind)


def test_a_plan_of_qgroundcontrol() -> None:
    ground = Ground()
    sent = [
        item_int(0, 3, TAKEOFF, (0, 0, 0, nan), X, Y, 15.0),
        item_int(1, 2, SPEED, (1, 4.0, -1, 0), 0, 0, 0.0),
        item_int(2, 3, WAYPOINT, (0, 0, 0, nan), X + 1000, Y, 15.0),
        item_int(3, 2, 530, (0, 0, nan, nan), 0, 0, nan),
        item_int(4, 3, 19, (5, 1, 50, nan), X + 1000, Y + 1000, 20.0),
        item_int(5, 2, RTL, (0, 0, 0, 0), 0, 0, 0.0),
    ]
    assert ground.upload(sent) == ACCEPTED
    assert ground.changes == [MISSION]
    assert ground.actions() == [
        Takeoff(47.398, 8.546, 503.0, None),
        ChangeSpeed(1, 4.0),
        FlyTo(47.3981, 8.546, 503.0, 0.0, None, None),
        Skip(530, "SET_CAMERA_MODE"),
        LoiterTime(47.3981, 8.5461, 508.0, 5.0, None),
        ReturnToLaunch(),
    ]
    back = ground.download()
    assert [one.frame for one in back] == [6, 2, 6, 2, 6, 2]
    for one, other in zip(sent, back, strict=True):
        assert (one.command, one.x, one.y, one.autocontinue) == (other.command, other.x, other.y, other.autocontinue)
        for name in ("param1", "param2", "param3", "param4", "z"):
            assert getattr(other, name) == pytest.approx(getattr(one, name), nan_ok=True)


def test_a_mission_of_mavsdk() -> None:
    ground = Ground()
    sent = [
        item_int(0, 6, WAYPOINT, (0.0, 1.0, 0, nan), X, Y, 10.0),
        item_int(1, 2, 178, (1, 5.0, -1, 0), 0, 0, nan),
        item_int(2, 2, 1001, (-2, -2, -3, -3), 0, 0, nan),
        item_int(3, 2, 1000, (20.0, 60.0, nan, nan), 12, 0, 0.0),
        item_int(4, 6, WAYPOINT, (0.5, 1.0, 0, nan), X + 1000, Y, 10.0),
        item_int(5, 2, 93, (3.0, -1, -1, -1), 0, 0, nan),
        item_int(6, 2, 2000, (0, 0, 1, 1), 0, 0, nan),
    ]
    assert ground.upload(sent) == ACCEPTED
    back = ground.download()
    # MAVSDK takes a waypoint in frame 6 alone.
    assert [one.frame for one in back if one.command == WAYPOINT] == [6, 6]
    assert back[3].x == 12
    done = ground.actions()
    assert done[0] == FlyTo(47.398, 8.546, 498.0, 0.0, 1.0, None)
    assert [type(one) for one in done] == [FlyTo, ChangeSpeed, Skip, Skip, FlyTo, Delay, Skip]
    # Its progress needs each item reported, the last instantaneous ones too.
    assert ground.vehicle.stores.reached_since(0) == list(range(7))
    assert ground.vehicle.status()[:3] == (6, 7, COMPLETE)


def test_a_geofence_of_mavsdk() -> None:
    ground = Ground()
    corners = ((-1000, -1000), (-1000, 1000), (1000, 1000), (1000, -1000))
    sent = [item_int(seq, 5, 5001, (4, 0, 0, 0), X + x, Y + y, 0.0, FENCE) for seq, (x, y) in enumerate(corners)]
    sent.append(item_int(4, 5, 5004, (5.0, 0, 0, 0), X, Y, 0.0, FENCE))
    for message in sent:
        message.autocontinue = 0
    assert ground.upload(sent, FENCE) == ACCEPTED
    assert [one.autocontinue for one in ground.download(FENCE)] == [0] * 5
    fence = ground.vehicle.fence(ORIGIN)
    home = (X / 1e7, Y / 1e7)
    assert fence.breach_at(*home, 10.0, home) is not None
    assert fence.breach_at(home[0] + 8e-5, home[1], 10.0, home) is None
    assert fence.breach_at(home[0] + 12e-5, home[1], 10.0, home) is not None
    assert ground.upload(sent[:3], FENCE) == PARAM1
    assert "item 2" in ground.texts[-1]
    assert len(ground.vehicle.stores.items(FENCE)) == 5


def test_bad_missions_are_refused_at_the_item() -> None:
    ground = Ground()
    good = item_int(0, 3, WAYPOINT, (0, 0, 0, nan), X, Y, 15.0)
    for bad, result in (
        (item_int(1, 3, 18, (1, 0, 0, nan), X, Y, 15.0), UNSUPPORTED),
        (item_int(1, 2, WAYPOINT, (0, 0, 0, nan), X, Y, 15.0), UNSUPPORTED_FRAME),
        (item_int(1, 10, WAYPOINT, (0, 0, 0, nan), X, Y, 15.0), UNSUPPORTED_FRAME),
        (item_int(1, 3, WAYPOINT, (0, 0, 0, nan), NOWHERE, Y, 15.0), PARAM5),
        (item_int(1, 3, WAYPOINT, (0, 0, 0, nan), X, NOWHERE, 15.0), PARAM6),
        (item_int(1, 3, WAYPOINT, (0, 0, 0, nan), X, Y, nan), PARAM7),
        (item_int(1, 2, JUMP, (3, 1, 0, 0), 0, 0, 0.0), PARAM1),
        (item_int(1, 3, 5001, (4, 0, 0, 0), X, Y, 0.0), 1),
    ):
        assert ground.upload([good, bad]) == result
        assert "item 1" in ground.texts[-1]
    assert ground.vehicle.mission == ()


def test_float_item_without_coordinates() -> None:
    ground = Ground()
    message = mavlink.MAVLink_mission_item_message(*VEHICLE, 0, 3, WAYPOINT, 1, 1, 0, 0, 0, nan, nan, 8.5, 10.0, 0)
    assert ground.upload([message]) == PARAM5


WPL = """QGC WPL 110
0	1	3	22	0	0	0	nan	47.3980000	8.5460000	15.0	1
1	0	2	178	1	4	-1	0	0	0	0	1
2	0	3	16	2	1	0	nan	47.3981000	8.5460000	15.0	1
3	0	2	177	2	1	0	0	0	0	0	1
4	0	3	21	0	0	0	nan	47.3980000	8.5460000	0	1
"""


def test_items_of_pymavlinks_loader(tmp_path: Any) -> None:
    mavwp = pytest.importorskip("pymavlink.mavwp")
    path = tmp_path / "mission.txt"
    path.write_text(WPL)
    loader = mavwp.MAVWPLoader(*VEHICLE)
    assert loader.load(str(path)) == 5
    ground = Ground()
    sent = []
    for number in range(loader.count()):
        message = loader.wp(number)
        message.mission_type = MISSION
        # The loader's class is that of its own dialect.
        sent.append(mavlink.MAVLink_mission_item_message(*(getattr(message, name) for name in message.fieldnames)))
    assert ground.upload(sent) == ACCEPTED
    assert [type(one) for one in ground.actions()] == [Takeoff, ChangeSpeed, FlyTo, FlyTo, Land]
    held = ground.vehicle.mission[2]
    assert (held.frame, held.param1, held.param2) == (6, 2.0, 1.0)
    assert abs(held.x - 473_981_000) <= 40
    # Loaded again from what the vehicle gives, as `wp save` does.
    again = mavwp.MAVWPLoader(*VEHICLE)
    for seq in range(5):
        again.add(ground.say(mavlink.MAVLink_mission_request_message(*VEHICLE, seq, MISSION)))
    assert [(one.command, one.frame) for one in again.wpoints] == [(22, 3), (178, 2), (16, 3), (177, 2), (21, 3)]
    assert again.wp(2).x == pytest.approx(47.3981, abs=4e-6)
