"""Missions as a client uploads, starts, watches, interrupts and changes them, flown from the ground and in the air."""

from __future__ import annotations

from itertools import pairwise
from math import hypot, nan, radians
from typing import Any

import numpy as np
import pytest

from mavsitl.dialect import mavlink
from tests.autopilot.conftest import GCS, OFFBOARD, Client, flight
from tests.autopilot.copter import (
    ACCEPTED,
    DENIED,
    HOLD,
    LAND,
    MISSION,
    MISSION_FRAME,
    REJECTED,
    RETURN,
    TERMINATION,
    distance,
    fence_circle,
    flying,
    go_to,
    item,
    reached,
    set_parameter,
    track,
    upload,
    waypoint,
)

NOT_STARTED, ACTIVE, PAUSED, COMPLETE = 2, 3, 4, 5
START = mavlink.MAV_CMD_MISSION_START
SET_CURRENT = mavlink.MAV_CMD_DO_SET_MISSION_CURRENT
FENCE = 1


def ready() -> Client:
    client = Client(flight())
    client.run(0.2)
    return client


def takeoff(client: Client, height_m: float = 4.0) -> dict[str, Any]:
    return item(client, mavlink.MAV_CMD_NAV_TAKEOFF, height_m=height_m)


def plain(client: Client, command: int, *params: float) -> dict[str, Any]:
    return item(client, command, *params, frame=MISSION_FRAME)


def begin(client: Client, items: list[dict[str, Any]]) -> Client:
    assert upload(client, items) == mavlink.MAV_MISSION_ACCEPTED
    client.run(0.3)
    assert client.result(START, 0, 0) == ACCEPTED
    client.tick()
    assert client.armed
    assert client.flight_mode == MISSION
    return client


def current(client: Client) -> Any:
    return client.last("MISSION_CURRENT", OFFBOARD)


def until_complete(client: Client, limit_s: float) -> float:
    return client.run_until(lambda: current(client).mission_state == COMPLETE, limit_s)


def when_reached(client: Client, seq: int) -> float:
    """Seconds at which the item was first told as reached."""
    return next(
        time_us / 1e6
        for time_us, port, message in client.inbox
        if port == OFFBOARD and message.get_type() == "MISSION_ITEM_REACHED" and message.seq == seq
    )


def test_a_square_with_hold_heading_speed_and_return() -> None:
    client = ready()
    set_parameter(client, "RTL_RETURN_ALT", 5.0)
    set_parameter(client, "RTL_DESCEND_ALT", 5.0)
    begin(
        client,
        [
            takeoff(client, 5.0),
            waypoint(client, 10, 0, 5, hold_s=3.0),
            plain(client, mavlink.MAV_CMD_DO_CHANGE_SPEED, 1.0, 2.0),
            waypoint(client, 10, 10, 5, yaw_deg=90.0),
            waypoint(client, 0, 10, 5),
            plain(client, mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH),
        ],
    )
    rows: list[tuple[float, ...]] = []
    client.run_until(
        lambda: not client.armed, 90.0,
        lambda: rows.append((client.now_us / 1e6, current(client).seq, client.last("ATTITUDE", 0).yaw, *client.truth)),
    )  # fmt: skip
    path = np.array(rows)
    assert reached(client) == [0, 1, 2, 3, 4, 5]
    assert current(client).mission_state == COMPLETE
    assert client.flight_mode == MISSION
    assert distance(client, 0.0, 0.0, 0.0) < 0.1
    assert client.texts() == ["Armed by mission start", "Disarmed by landing"]
    for corner in ((10, 0), (10, 10), (0, 10)):
        assert np.hypot(path[:, 3] - corner[0], path[:, 4] - corner[1]).min() < 2.0  # NAV_ACC_RAD
    to_second = path[path[:, 1] == 3]
    assert np.hypot(to_second[:, 6], to_second[:, 7]).max() == pytest.approx(2.0, abs=0.15)
    first = path[path[:, 1] == 1]
    assert np.hypot(first[:, 6], first[:, 7]).max() > 2.5
    assert first[first[:, 3] > 8.0][:, 0][[0, -1]] @ [-1, 1] > 3.0  # it held
    assert to_second[-1, 2] == pytest.approx(radians(90.0), abs=radians(10.0))
    away = path[(path[:, 1] >= 1) & (path[:, 1] <= 4)]
    assert np.abs(away[:, 5] - 5.0).max() < 0.4


def test_a_mission_that_begins_with_a_waypoint_climbs_first() -> None:
    """MAVSDK's missions have no take-off."""
    client = ready()
    begin(client, [waypoint(client, 8, 0, 4), waypoint(client, 8, -4, 4), item(client, mavlink.MAV_CMD_NAV_LAND)])
    path = track(client, 14.0)
    aside = np.hypot(path[:, 0], path[:, 1])
    assert path[aside > 0.5][0, 2] > 3.7
    client.run_until(lambda: not client.armed, 30.0)
    assert reached(client) == [0, 1, 2]
    assert hypot(client.truth[0] - 8.0, client.truth[1] + 4.0) < 2.1


def test_land_at_a_place() -> None:
    client = ready()
    begin(client, [takeoff(client, 3.0), item(client, mavlink.MAV_CMD_NAV_LAND, 0, 0, 0, nan, at=(6.0, 3.0))])
    rows: list[list[float]] = []
    client.run_until(lambda: not client.armed, 40.0, lambda: rows.append(client.truth))
    path = np.array(rows)
    far = np.hypot(path[:, 0] - 6.0, path[:, 1] - 3.0) > 1.2
    assert path[far & (path[:, 0] > 1.0), 2].min() > 2.5
    assert distance(client, 6.0, 3.0, 0.0) < 0.3
    assert reached(client) == [0, 1]
    assert client.arm() == ACCEPTED  # the complete mission can begin anew
    client.run_until(lambda: client.truth[2] > 2.0, 6.0)


def test_loiters_and_delays_take_their_time() -> None:
    client = ready()
    begin(
        client,
        [
            takeoff(client, 3.0),
            item(client, mavlink.MAV_CMD_NAV_LOITER_TIME, 4.0, 0, 0, nan, at=(4.0, 0.0), height_m=3.0),
            plain(client, mavlink.MAV_CMD_NAV_DELAY, 2.5),
            item(client, mavlink.MAV_CMD_NAV_LOITER_TO_ALT, 0, 0, 0, 0, at=(4.0, 4.0), height_m=6.0),
            waypoint(client, 0, 4, 6),
        ],
    )
    arrived_s = client.run_until(lambda: distance(client, 4.0, 0.0, 3.0) < 2.0, 20.0) + 0.2
    assert arrived_s > 3.0
    here_s = client.now_us / 1e6
    until_complete(client, 40.0)
    assert reached(client) == [0, 1, 2, 3, 4]
    assert when_reached(client, 1) - here_s == pytest.approx(4.0, abs=0.4)
    assert when_reached(client, 2) - when_reached(client, 1) == pytest.approx(2.5, abs=0.02)
    client.run(5.0)
    assert distance(client, 0.0, 4.0, 6.0) < 0.1  # all the way, and stays
    assert hypot(*client.truth[3:6]) < 0.05
    assert client.flight_mode == MISSION


def test_a_jump_is_taken_as_often_as_it_says() -> None:
    client = ready()
    begin(
        client,
        [
            takeoff(client, 3.0),
            waypoint(client, 4, 0, 3),
            waypoint(client, 0, 0, 3),
            plain(client, mavlink.MAV_CMD_DO_JUMP, 1.0, 2.0),
            waypoint(client, 0, 4, 3),
        ],
    )
    until_complete(client, 60.0)
    flown = [seq for seq in reached(client) if seq != 3]
    assert flown == [0, 1, 2, 1, 2, 1, 2, 4]


def test_an_item_without_autocontinue_waits() -> None:
    client = ready()
    first = waypoint(client, 4, 0, 3)
    first["autocontinue"] = 0
    begin(client, [takeoff(client, 3.0), first, waypoint(client, 0, 0, 3)])
    client.run(15.0)
    assert current(client).seq == 1
    assert current(client).mission_state == ACTIVE
    assert distance(client, 4.0, 0.0, 3.0) < 0.2
    assert client.result(SET_CURRENT, 2.0) == ACCEPTED
    until_complete(client, 10.0)


def test_a_region_of_interest_turns_the_nose() -> None:
    client = ready()
    begin(
        client,
        [
            takeoff(client, 3.0),
            item(client, mavlink.MAV_CMD_DO_SET_ROI_LOCATION, at=(0.0, -50.0), height_m=0.0),
            waypoint(client, 10, 0, 3, hold_s=6.0),
        ],
    )
    client.run(14.0)
    assert client.last("ATTITUDE", 0).yaw == pytest.approx(radians(101.3), abs=0.1)


def test_pause_and_continue() -> None:
    client = ready()
    begin(client, [takeoff(client, 3.0), waypoint(client, 20, 0, 3), waypoint(client, 20, 5, 3)])
    client.run_until(lambda: client.truth[0] > 4.0, 20.0)
    assert client.result(mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 0) == ACCEPTED
    client.tick()
    assert client.flight_mode == HOLD
    client.run(0.15)
    assert current(client).mission_state == PAUSED
    client.run(6.0)
    stopped = client.truth[0]
    assert stopped < 14.0
    assert hypot(*client.truth[3:6]) < 0.05
    assert client.result(mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 1) == ACCEPTED
    client.run(0.15)
    assert (client.flight_mode, current(client).mission_state, current(client).seq) == (MISSION, ACTIVE, 1)
    until_complete(client, 20.0)
    assert reached(client) == [0, 1, 2]


def test_set_current_in_flight_by_message_and_by_command() -> None:
    client = ready()
    begin(client, [takeoff(client, 3.0), *(waypoint(client, 15, 5 * k, 3) for k in range(4))])
    client.run_until(lambda: current(client).seq == 1, 10.0)
    assert client.result(SET_CURRENT, 3.0) == ACCEPTED
    client.run(0.15)
    assert current(client).seq == 3
    before = len(client.all("MISSION_CURRENT", OFFBOARD))
    client.send(mavlink.MAVLink_mission_set_current_message(1, 1, 4))
    client.tick()
    assert len(client.all("MISSION_CURRENT", OFFBOARD)) > before  # answered at once
    assert current(client).seq == 4
    until_complete(client, 20.0)
    assert reached(client) == [0, 4]
    assert client.result(SET_CURRENT, 9.0) == DENIED
    assert client.result(SET_CURRENT, nan) == DENIED
    client.tick()
    assert client.texts()[-1].startswith("Mission item refused: no item ")


def test_another_mission_in_flight_is_flown_from_its_beginning() -> None:
    client = ready()
    begin(client, [takeoff(client, 3.0), waypoint(client, 20, 0, 3), waypoint(client, 20, 9, 3)])
    client.run_until(lambda: client.truth[0] > 4.0, 20.0)
    assert upload(client, [waypoint(client, 0, -8, 5), waypoint(client, 4, -8, 5)]) == 0
    client.run(0.15)
    assert (current(client).seq, current(client).total, current(client).mission_state) == (0, 2, ACTIVE)
    until_complete(client, 30.0)
    client.run(3.0)
    assert distance(client, 4.0, -8.0, 5.0) < 0.2
    assert client.flight_mode == MISSION


def test_the_same_mission_uploaded_again_goes_on() -> None:
    client = ready()
    items = [takeoff(client, 3.0), waypoint(client, 20, 0, 3), waypoint(client, 20, 9, 3)]
    begin(client, items)
    client.run_until(lambda: current(client).seq == 1, 20.0)
    assert upload(client, items) == 0
    client.run(1.0)
    assert (current(client).seq, current(client).mission_state) == (1, ACTIVE)


def test_a_mission_cleared_in_flight_holds_and_returns() -> None:
    client = ready()
    begin(client, [takeoff(client, 3.0), waypoint(client, 20, 0, 3)])
    client.run_until(lambda: client.truth[0] > 4.0, 20.0)
    client.send(mavlink.MAVLink_mission_clear_all_message(1, 1, 0))
    client.run(4.8)
    assert client.truth[0] < 14.0
    assert hypot(*client.truth[3:6]) < 0.05
    assert client.truth[2] == pytest.approx(3.0, abs=0.1)
    assert (client.flight_mode, client.critical) == (HOLD, True)
    client.run(0.3)  # COM_FAIL_ACT_T
    assert client.flight_mode == RETURN
    assert client.texts()[-1] == "Failsafe activated: mission failure, return"


def test_progress_is_told_on_both_links() -> None:
    client = ready()
    client.run(1.2)
    assert (current(client).total, current(client).mission_state) == (65535, 1)
    upload(client, [takeoff(client, 3.0), waypoint(client, 4, 0, 3)])
    client.run(0.15)
    assert (current(client).seq, current(client).total, current(client).mission_state) == (0, 2, NOT_STARTED)
    client.result(START, 0, 0)
    client.run(1.0)
    until_complete(client, 20.0)
    client.run(12.0)
    for port in (OFFBOARD, GCS):
        states = [message.mission_state for message in client.all("MISSION_CURRENT", port)]
        assert [states[0], *(b for a, b in pairwise(states) if a != b)] == [1, 2, 3, 5]
        told = [message.seq for message in client.all("MISSION_ITEM_REACHED", port)]
        assert sorted(set(told)) == [0, 1]
        assert 1 <= told.count(0) <= 11  # once, and repeats a second apart while it is the newest
        assert told == sorted(told)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda c: [], "Mission start refused: there is no mission"),
        (lambda c: [item(c, mavlink.MAV_CMD_NAV_LAND)], "begins with a landing, on the ground"),
        (lambda c: [takeoff(c, -3.0)], "take-off to -3.0 m above home"),
        (lambda c: [waypoint(c, 5, 0, 3), takeoff(c)], "take-off must be the first position"),
        (lambda c: [takeoff(c), plain(c, mavlink.MAV_CMD_DO_JUMP, 1.0, -1.0)], "passes nothing that is flown"),
    ],
)
def test_what_cannot_be_flown_is_not_started(make: Any, text: str) -> None:
    client = ready()
    items = make(client)
    if items:
        assert upload(client, items) == mavlink.MAV_MISSION_ACCEPTED
    client.run(0.3)
    assert client.result(START, 0, 0) == DENIED
    client.tick()
    assert not client.armed
    assert text in client.texts()[-1]
    assert client.mode(*MISSION) == ACCEPTED  # disarmed, a mode is only shown
    assert client.arm() == REJECTED
    client.tick()
    assert client.texts()[-1].startswith("Arming denied: ")
    assert not client.armed


def test_a_waypoint_outside_the_fence_is_told_and_not_flown() -> None:
    client = ready()
    assert upload(client, [fence_circle(client, 15.0)], FENCE) == 0
    assert upload(client, [takeoff(client), waypoint(client, 30, 0, 4)]) == 0
    client.run(0.3)
    assert "item 1: outside the geofence" in client.texts()[-1]
    assert client.result(START, 0, 0) == DENIED
    set_parameter(client, "GF_ACTION", 0)
    client.run(0.3)
    assert client.result(START, 0, 0) == ACCEPTED


def test_mission_mode_is_refused_in_the_air_without_one() -> None:
    client = flying(3.0)
    assert client.mode(*MISSION) == REJECTED
    client.tick()
    assert client.flight_mode == HOLD
    assert client.texts()[-1] == "AUTO.MISSION refused: there is no mission"


@pytest.mark.parametrize(
    ("action", "mode"), [(0, HOLD), (1, HOLD), (2, HOLD), (3, RETURN), (4, TERMINATION), (5, LAND)]
)
def test_a_fence_that_closes_around_the_vehicle(action: int, mode: tuple[int, int]) -> None:
    """The vehicle is out there already; what GF_ACTION says happens within a tenth of a second."""
    client = flying(4.0)
    set_parameter(client, "GF_ACTION", action)
    go_to(client, 20.0, 0.0, 4.0)
    client.run(9.0)
    since_us = client.now_us
    assert upload(client, [fence_circle(client, 10.0)], FENCE) == 0
    client.run(0.15)
    assert client.flight_mode == mode
    status = client.heartbeat.system_status
    assert status == {0: 4, 1: 4, 4: mavlink.MAV_STATE_FLIGHT_TERMINATION}.get(action, mavlink.MAV_STATE_CRITICAL)
    told = [text for text in client.texts() if "geofence breached" in text]
    assert len(told) == (0 if action == 0 else 1)
    assert client.now_us - since_us < 4e5
    health = mavlink.MAV_SYS_STATUS_GEOFENCE
    client.run(1.1)
    assert bool(client.last("SYS_STATUS", GCS).onboard_control_sensors_health & health) == (action == 0)


def test_a_flight_out_of_the_fence_is_turned_back() -> None:
    client = flying(4.0)
    set_parameter(client, "GF_ACTION", 3)
    set_parameter(client, "GF_MAX_HOR_DIST", 15.0)
    assert go_to(client, 40.0, 0.0, 4.0) == DENIED
    client.tick()
    assert client.texts()[-1].startswith("Reposition refused: ")
    client.run(0.2, client.attitude)
    client.offboard()
    forward = mavlink.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, 0xDC7, 0, 0, 0, 4.0, 0, 0, 0, 0, 0, 0, 0
    )  # fmt: skip
    client.run_until(lambda: client.flight_mode == RETURN, 10.0, lambda: client.send(forward))
    assert client.truth[0] == pytest.approx(15.0, abs=0.6)
    client.run_until(lambda: not client.armed, 90.0, lambda: client.send(forward))
    assert distance(client, 0.0, 0.0, 0.0) < 0.3


def test_a_mission_item_sent_as_commands_that_are_skipped_counts_as_reached() -> None:
    client = ready()
    begin(
        client,
        [
            takeoff(client, 3.0),
            plain(client, mavlink.MAV_CMD_IMAGE_START_CAPTURE, 0, 1, 1, 0),
            plain(client, mavlink.MAV_CMD_DO_SET_CAM_TRIGG_DIST, 0),
            waypoint(client, 4, 0, 3),
        ],
    )
    until_complete(client, 20.0)
    assert reached(client) == [0, 1, 2, 3]


def test_a_landing_in_the_middle_of_a_mission_takes_off_again() -> None:
    client = ready()
    set_parameter(client, "COM_DISARM_LAND", -1.0)
    begin(
        client,
        [
            takeoff(client, 2.0), item(client, mavlink.MAV_CMD_NAV_LAND, 0, 0, 0, nan, at=(4.0, 0.0)),
            plain(client, mavlink.MAV_CMD_NAV_DELAY, 2.0), waypoint(client, 0, 0, 3),
        ],
    )  # fmt: skip
    client.run(0.2)
    client.run_until(lambda: current(client).seq == 2, 25.0)
    assert client.landed
    client.run(1.0)
    assert client.truth[2] < 0.02
    until_complete(client, 20.0)
    assert reached(client) == [0, 1, 2, 3]
    assert client.truth[2] == pytest.approx(3.0, abs=0.3)
