"""What the page is told: values and rows out of messages, once to each client, in memory that is bounded."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_ground.sequence import Phase
from mavsitl_vehicle.autopilot import modes

from mavsitl import monitor
from mavsitl.dialect import mavlink
from mavsitl.quaternion import from_euler
from mavsitl.view import model as models
from mavsitl.view.model import COLUMNS, MAX_TEXTS, ROWS, Model, Seen, Vehicle, hear, look


def attitude(time_ms: int, roll_deg: float = 0.0) -> Any:
    q = from_euler(math.radians(roll_deg), 0.0, 0.0)
    return mavlink.MAVLink_attitude_quaternion_message(time_ms, *q, 0.0, 0.0, 0.0)


def position(time_ms: int, north: float, east: float = 0.0, down: float = 0.0) -> Any:
    return mavlink.MAVLink_local_position_ned_message(time_ms, north, east, down, 0.0, 0.0, 0.0)


def reference(north: float) -> Any:
    return mavlink.MAVLink_position_target_local_ned_message(0, 1, 0, north, 0.0, -1.0, 0, 0, 0, 0, 0, 0, 0, 0)


def heartbeat(custom_mode: int = 6 << 16, *, armed: bool = True, state: int = mavlink.MAV_STATE_ACTIVE) -> Any:
    base = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
    return mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, base | 1, custom_mode, state, 3)


def test_modes_have_the_names_that_the_vehicle_gives_them() -> None:
    for mode, info in modes.TABLE.items():
        if mode is not modes.Mode.DESCEND:  # which looks like LAND outside
            assert models.mode_name(modes.custom_mode(mode)) == info.name
        assert models.NAV_STATES[info.nav_state] == info.name
    assert models.mode_name(99 << 16) == "mode 99.0"


def test_a_row_has_the_pages_columns() -> None:
    model = Model()
    vehicle = model.vehicle(1)
    hear(vehicle, position(0, 1.0, 2.0, -3.0), 0)
    hear(vehicle, reference(1.5), 0)
    hear(vehicle, attitude(1000, 10.0), 0)
    row = dict(zip(COLUMNS, vehicle.rows[-1], strict=True))
    assert row["time_s"] == 1.0
    assert (row["north_m"], row["east_m"], row["down_m"]) == (1.0, 2.0, -3.0)
    assert (row["north_wanted_m"], row["down_wanted_m"]) == (1.5, -1.0)
    assert row["roll_deg"] == pytest.approx(10.0, abs=0.01)
    assert row["roll_wanted_deg"] is None
    assert row["roll_p"] is None


def test_state_of_a_heartbeat() -> None:
    vehicle = Model().vehicle(1)
    hear(vehicle, heartbeat(state=mavlink.MAV_STATE_CRITICAL), 0)
    assert vehicle.values["mode"] == "OFFBOARD"
    assert vehicle.values["armed"]
    assert vehicle.values["failsafe"]
    hear(vehicle, heartbeat(armed=False, state=mavlink.MAV_STATE_UNINIT), 0)
    assert not vehicle.values["failsafe"]
    assert not vehicle.values["ready"]


def test_the_truth_is_placed_by_the_origin() -> None:
    vehicle = Model().vehicle(1)
    lat, lon = 473977418, 85455939
    truth = mavlink.MAVLink_hil_state_quaternion_message(
        0, [1.0, 0.0, 0.0, 0.0], 0, 0, 0, lat + 1000, lon, 490_000, 0, 0, 0, 0, 0, 0, 0, 0
    )
    hear(vehicle, truth, 0)
    assert "truth" not in vehicle.values  # where it is cannot be said yet
    hear(vehicle, mavlink.MAVLink_gps_global_origin_message(lat, lon, 488_000, 0), 0)
    hear(vehicle, truth, 0)
    assert vehicle.values["truth"]["position"] == pytest.approx([11.12, 0.0, -2.0], abs=0.01)


def test_the_grounds_word_goes_before_the_vehicles() -> None:
    vehicle = Model().vehicle(1)
    hear(vehicle, reference(1.0), 0)
    hear(vehicle, reference(2.0), 0, by_ground=True)
    hear(vehicle, reference(1.0), 500_000)
    assert vehicle.values["reference"][0] == 2.0
    hear(vehicle, reference(1.0), 1_500_000)  # the ground says nothing any more
    assert vehicle.values["reference"][0] == 1.0


def test_silence_is_shown() -> None:
    vehicle = Model().vehicle(1)
    hear(vehicle, heartbeat(), 0)
    hear(vehicle, reference(1.0), 0)
    phase = mavlink.MAVLink_heartbeat_message(18, mavlink.MAV_AUTOPILOT_INVALID, 1, Phase.FLY.value, 4, 3)
    hear(vehicle, phase, 0, by_ground=True)
    look(vehicle, 900_000)
    assert vehicle.values["online"]
    assert vehicle.values["ground"] == "FLY"
    assert vehicle.values["reference"] is not None
    look(vehicle, 3_100_000)
    assert not vehicle.values["online"]
    assert vehicle.values["ground"] is None
    assert vehicle.values["reference"] is None


def test_loss_is_that_of_the_last_second() -> None:
    vehicle = Model().vehicle(1)
    for second, (received, lost) in enumerate(((100, 50), (190, 60), (290, 60))):
        array = [float(received), float(lost), 0.0, 12.5, *[0.0] * 54]
        message = mavlink.MAVLink_debug_float_array_message(0, b"LINK", monitor.LINK.id, array)
        message.name = "LINK"
        hear(vehicle, message, second * 1_000_000, by_ground=True)
        expected = (None, 10.0, 0.0)[second]
        assert vehicle.values["link"] == {"of": "off-board", "latency_ms": 12.5, "loss_percent": expected}


def test_a_restart_begins_a_new_chapter() -> None:
    vehicle = Model().vehicle(1)
    for k in range(100):
        hear(vehicle, attitude(60_000 + 50 * k), 0)
    hear(vehicle, reference(1.0), 0)
    chapter = vehicle.chapter
    hear(vehicle, attitude(500), 0)
    assert vehicle.chapter != chapter
    assert len(vehicle.rows) == 1
    assert vehicle.values["reference"] is None


def test_a_late_message_is_no_restart() -> None:
    vehicle = Model().vehicle(1)
    hear(vehicle, attitude(60_000), 0)
    hear(vehicle, attitude(59_500), 0)
    assert vehicle.values["time_s"] == 60.0


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True, width=32), min_size=10, max_size=10))
def test_no_number_of_a_stranger_reaches_the_page_that_is_none(numbers: list[float]) -> None:
    """JSON has no NaN: a page that is sent one shows nothing any more."""
    model = Model()
    vehicle = model.vehicle(1)
    a, b, c, d, e, f, g, h, i, j = numbers
    for message in (
        mavlink.MAVLink_attitude_quaternion_message(1000, a, b, c, d, e, f, g),
        mavlink.MAVLink_local_position_ned_message(1000, a, b, c, d, e, f),
        mavlink.MAVLink_position_target_local_ned_message(1000, 1, 0, a, b, c, d, e, f, g, h, i, j, a),
        mavlink.MAVLink_attitude_target_message(1000, 0, [a, b, c, d], e, f, g, h),
        mavlink.MAVLink_wind_cov_message(1000, a, b, c, d, e, f, g, h),
    ):
        hear(vehicle, message, 0)
    seen = Seen()
    seen.selected = 1
    json.loads(json.dumps(model.news(seen), allow_nan=False))


# --- what is sent


def client(selected: int | None = None) -> Seen:
    seen = Seen()
    seen.selected = selected
    return seen


def test_only_what_changed_is_sent() -> None:
    model = Model()
    vehicle = model.vehicle(1)
    vehicle.put("mode", "OFFBOARD")
    vehicle.put("armed", True)
    seen = client()
    assert model.news(seen)["vehicles"][1].keys() == {"mode", "armed"}
    assert model.news(seen) == {}
    vehicle.put("mode", "OFFBOARD")
    vehicle.put("armed", False)
    assert model.news(seen) == {"vehicles": {1: {"armed": False}}}
    assert model.news(client())["vehicles"][1] == {"mode": "OFFBOARD", "armed": False}  # one that has just come


def test_two_clients_are_told_the_same_whatever_their_pace() -> None:
    model = Model()
    vehicle = model.vehicle(1)
    often, seldom = client(1), client(1)
    known: list[dict[str, Any]] = [{}, {}]
    rows: list[list[Any]] = [[], []]
    for tick in range(50):
        hear(vehicle, position(50 * tick, 0.1 * tick), 0)
        hear(vehicle, attitude(50 * (tick + 1)), 0)
        for index, (seen, every) in enumerate(((often, 1), (seldom, 7))):
            if tick % every == 0 or tick == 49:
                news = model.news(seen)
                known[index].update(news.get("vehicles", {}).get(1, {}))
                rows[index] += news.get("rows", {}).get("rows", [])
    assert known[0] == known[1] == vehicle.values
    assert rows[0] == rows[1] == list(vehicle.rows)


def test_rows_go_to_who_selected_the_vehicle_whole_at_first() -> None:
    model = Model()
    for number in (1, 2):
        vehicle = model.vehicle(number)
        for k in range(5):
            hear(vehicle, attitude(1000 + 50 * k), 0)
    seen = client()
    assert "rows" not in model.news(seen)
    seen.selected = 2
    news = model.news(seen)["rows"]
    assert (news["vehicle"], news["whole"], len(news["rows"])) == (2, True, 5)
    hear(model.vehicle(2), attitude(2000), 0)
    news = model.news(seen)["rows"]
    assert (news["whole"], len(news["rows"])) == (False, 1)
    seen.selected = 1
    assert model.news(seen)["rows"]["whole"]
    seen.selected = 7  # there is none
    assert "rows" not in model.news(seen)


def test_memory_is_bounded() -> None:
    model = Model()
    vehicle = model.vehicle(1)
    for k in range(3 * ROWS):
        hear(vehicle, attitude(50 * (k + 1)), 0)
        model.say(1, 6, f"text {k}", None)
    assert len(vehicle.rows) == ROWS
    news = model.news(client(1))
    assert len(news["rows"]["rows"]) == ROWS
    assert len(news["texts"]) == MAX_TEXTS
    assert news["texts"][-1]["text"] == f"text {3 * ROWS - 1}"


def test_texts_are_told_once_and_forgotten_by_a_replay_that_is_moved() -> None:
    model = Model()
    seen = client()
    model.say(1, 4, "one", 0.5)
    assert [text["text"] for text in model.news(seen)["texts"]] == ["one"]
    assert "texts" not in model.news(seen)
    model.forget_texts()
    model.say(1, 4, "two", 0.1)
    news = model.news(seen)
    assert news["forget_texts"]
    assert [text["text"] for text in news["texts"]] == ["two"]
    assert "forget_texts" not in model.news(seen)


def test_another_flight_begins_with_nothing() -> None:
    model = Model()
    model.vehicle(1).put("mode", "OFFBOARD")
    before = client(1)
    model.news(before)
    model.clear()
    vehicle: Vehicle = model.vehicle(1)
    vehicle.put("mode", "AUTO.LAND")
    news = model.news(before)
    assert "chapter" in news["world"]
    assert news["vehicles"] == {1: {"mode": "AUTO.LAND"}}
    assert news["rows"]["whole"]
