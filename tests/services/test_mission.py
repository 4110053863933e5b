"""The mission protocol: transfers on a link that loses frames, each rule by itself, two clients, nonsense."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from math import inf, isnan, nan
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.services.mission import (
    DENIED,
    ERROR,
    FENCE,
    INVALID_PARAM1,
    INVALID_PARAM5_X,
    INVALID_PARAM6_Y,
    INVALID_PARAM7,
    INVALID_SEQUENCE,
    MISSION,
    NO_SPACE,
    NOWHERE,
    RALLY,
    UNSUPPORTED,
    UNSUPPORTED_FRAME,
    MissionClient,
    MissionItem,
    MissionServer,
    MissionStatus,
    MissionStores,
    item_from_message,
    item_message,
    same_plan,
)
from tests.services.lossy import CLIENT, SERVER, LossyLink

ACCEPTED = mavlink.MAV_MISSION_ACCEPTED
OTHER = (246, 191)
ALL = 255

Request = mavlink.MAVLink_mission_request_int_message
FloatRequest = mavlink.MAVLink_mission_request_message
Ack = mavlink.MAVLink_mission_ack_message
Count = mavlink.MAVLink_mission_count_message
ItemInt = mavlink.MAVLink_mission_item_int_message
Item = mavlink.MAVLink_mission_item_message
Current = mavlink.MAVLink_mission_current_message


def waypoint(number: int = 0, **fields: Any) -> MissionItem:
    item = MissionItem(16, 6, 0.0, 0.0, 0.0, nan, 473_977_418 + number, 85_455_939 - number, 10.0 + number)
    return item._replace(**fields)


def polygon(count: int = 4) -> list[MissionItem]:
    corners = ((0, 0), (0, 9000), (9000, 9000), (9000, 0), (4000, -4000))
    return [
        MissionItem(5001, 5, float(count), 0.0, 0.0, 0.0, 473_977_000 + x, 85_455_000 + y, 0.0) for x, y in corners
    ][:count]


def rally(number: int = 0) -> MissionItem:
    return MissionItem(5100, 6, 0.0, 0.0, 0.0, 0.0, 473_970_000 + number, 85_450_000, 20.0)


PLANS = {MISSION: [waypoint(n) for n in range(25)], FENCE: polygon(), RALLY: [rally(n) for n in range(5)]}


class Bench:
    """A server that is spoken to by hand."""

    def __init__(self, stores: MissionStores | None = None) -> None:
        self.texts: list[str] = []
        self.stores = stores or MissionStores(report=lambda severity, text: self.texts.append(text))
        self.server = MissionServer(self.stores, current_interval_us=None)
        self.now_us = 1_000_000

    def say(self, message: Any, sender: tuple[int, int] = CLIENT) -> list[Any]:
        (frame,) = parse(encode(message, 0, *sender))
        return list(self.server.receive(frame.message, sender, self.now_us))

    def wait(self, seconds: float) -> list[Any]:
        """What the server says by itself until then, stepped every 10 ms."""
        out: list[Any] = []
        for _ in range(round(seconds * 100)):
            self.now_us += 10_000
            out.extend(self.server.step(self.now_us))
        return out

    def count(self, count: int, mission_type: int = MISSION, sender: tuple[int, int] = CLIENT) -> list[Any]:
        return self.say(Count(*SERVER, count, mission_type), sender)

    def item(
        self,
        item: MissionItem,
        seq: int,
        mission_type: int = MISSION,
        current: int = 0,
        as_float: bool = False,
        sender: tuple[int, int] = CLIENT,
    ) -> list[Any]:
        message = item_message(item, SERVER, mission_type, seq, False, as_float)
        message.current = current
        return self.say(message, sender)

    def upload(self, items: Sequence[MissionItem], mission_type: int = MISSION) -> int:
        """Without loss; the MAV_MISSION_RESULT."""
        answer = self.count(len(items), mission_type)
        while type(answer[0]) is Request:
            answer = self.item(items[answer[0].seq], answer[0].seq, mission_type)
        return result_of(answer)


def result_of(answer: Sequence[Any], target: tuple[int, int] = CLIENT, mission_type: int | None = None) -> int:
    """The result of the one MISSION_ACK there is."""
    (ack,) = answer
    assert type(ack) is Ack
    assert (ack.target_system, ack.target_component) == target
    if mission_type is not None:
        assert ack.mission_type == mission_type
    return int(ack.type)


def request_of(answer: Sequence[Any]) -> tuple[Any, int]:
    (request,) = answer
    assert (request.target_system, request.target_component) == CLIENT
    return type(request), request.seq


# --- transfers on a link


def link(loss: float, seed: int = 1, stores: MissionStores | None = None) -> tuple[LossyLink, MissionStores, Any]:
    stores = stores or MissionStores()
    client = MissionClient(SERVER)
    return LossyLink(MissionServer(stores), client, loss, seed), stores, client


@pytest.mark.parametrize("mission_type", [MISSION, FENCE, RALLY])
@pytest.mark.parametrize(("loss", "seed"), [(0.0, 1), (0.2, 1), (0.2, 2), (0.2, 3)])
def test_upload_download_clear(mission_type: int, loss: float, seed: int) -> None:
    bench, stores, client = link(loss, seed)
    items = PLANS[mission_type]
    client.upload(mission_type, items)
    bench.run(lambda: not client.busy)
    assert client.result == ACCEPTED
    assert same_plan(stores.items(mission_type), items)
    client.download(mission_type)
    bench.run(lambda: not client.busy)
    assert client.result == ACCEPTED
    assert same_plan(client.items, items)
    client.clear(mission_type)
    bench.run(lambda: not client.busy)
    assert client.result == ACCEPTED
    assert stores.items(mission_type) == ()
    client.download(mission_type)
    bench.run(lambda: not client.busy)
    assert (client.result, client.items) == (ACCEPTED, [])
    assert bool(bench.lost) == (loss > 0.0)
    assert [type(other) for other in (MISSION, FENCE, RALLY) if stores.items(other)] == []


def test_without_loss_every_message_is_sent_once() -> None:
    bench, _, client = link(0.0)
    client.upload(MISSION, PLANS[MISSION])
    bench.run(lambda: not client.busy)
    kinds = [type(message) for _, message in bench.sent if type(message) is not Current]
    assert kinds == [Count, *[Request, ItemInt] * 25, Ack]
    bench.sent.clear()
    client.download(MISSION)
    bench.run(lambda: not client.busy)
    kinds = [type(message) for _, message in bench.sent if type(message) is not Current]
    assert kinds == [mavlink.MAVLink_mission_request_list_message, Count, *[Request, ItemInt] * 25, Ack]


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_set_current(loss: float) -> None:
    bench, stores, client = link(loss, seed=5)
    stores.replace(MISSION, PLANS[MISSION])
    client.set_current(7)
    bench.run(lambda: not client.busy)
    assert client.result == ACCEPTED
    assert client.current.seq == 7
    client.set_current(25)
    bench.run(lambda: not client.busy)
    assert client.result == INVALID_SEQUENCE
    assert stores.status().seq == 7


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_a_refused_upload_is_told_and_keeps_the_old_plan(loss: float) -> None:
    bench, stores, client = link(loss, seed=4)
    stores.replace(MISSION, [waypoint(99)])
    client.upload(MISSION, [waypoint(), waypoint(x=900_000_001), waypoint()])
    bench.run(lambda: not client.busy)
    assert client.result == INVALID_PARAM5_X
    assert same_plan(stores.items(MISSION), [waypoint(99)])
    client.upload(MISSION, [waypoint()] * 2001)
    bench.run(lambda: not client.busy)
    assert client.result == NO_SPACE
    assert same_plan(stores.items(MISSION), [waypoint(99)])


def test_a_client_believes_no_acceptance_before_its_last_item_went_out() -> None:
    client = MissionClient(SERVER)
    client.upload(MISSION, [waypoint(), waypoint()])
    client.step(0)
    for seq, done in ((0, False), (1, True)):
        client.receive(Request(*CLIENT, seq, MISSION), SERVER, 0)
        client.receive(Ack(*CLIENT, ACCEPTED, FENCE), SERVER, 0)
        client.receive(Ack(*CLIENT, ACCEPTED, MISSION), OTHER, 0)
        assert client.busy
        client.receive(Ack(*CLIENT, ACCEPTED, MISSION), SERVER, 0)
        assert client.busy is not done
    assert client.result == ACCEPTED


def test_a_client_gives_up_on_a_dead_link() -> None:
    bench, _, client = link(1.0)
    client.download(MISSION)
    seconds = bench.run(lambda: not client.busy)
    assert client.timed_out
    assert client.result is None
    assert seconds == pytest.approx(5.0, abs=0.1)


def test_a_client_that_knows_floats_alone() -> None:
    bench = Bench()
    bench.count(3)
    answer = bench.wait(0.5)[-1:]
    while type(answer[0]) is FloatRequest:
        answer = bench.item(waypoint(answer[0].seq), answer[0].seq, as_float=True)
    assert result_of(answer) == ACCEPTED
    for stored, meant in zip(bench.stores.items(MISSION), [waypoint(n) for n in range(3)], strict=True):
        assert stored.frame == 6
        assert abs(stored.x - meant.x) <= 40  # float32 degrees near 47: 3.8e-6
        assert abs(stored.y - meant.y) <= 10


# --- the upload's rules


def test_retry_each_quarter_second_and_give_up_after_five_seconds_without_progress() -> None:
    bench = Bench()
    bench.upload([waypoint(99)])
    assert request_of(bench.count(3)) == (Request, 0)
    assert bench.wait(0.24) == []
    assert request_of(bench.wait(0.01)) == (Request, 0)
    bench.wait(4.0)
    assert request_of(bench.item(waypoint(), 0)) == (Request, 1)
    asked = bench.wait(4.99)  # progress made: the five seconds begin anew
    assert len(asked) == 19
    assert {message.seq for message in asked} == {1}
    assert result_of(bench.wait(0.01)) == mavlink.MAV_MISSION_OPERATION_CANCELLED
    assert bench.server.timeouts == 1
    assert "item 1 of 3" in bench.texts[-1]
    assert same_plan(bench.stores.items(MISSION), [waypoint(99)])
    assert bench.wait(1.0) == []
    assert bench.upload([waypoint()]) == ACCEPTED


def test_two_unanswered_requests_fall_back_to_float_and_the_answer_decides() -> None:
    bench = Bench()
    assert request_of(bench.count(3)) == (Request, 0)
    assert [request_of([message]) for message in bench.wait(1.0)] == [
        (Request, 0),
        (FloatRequest, 0),
        (FloatRequest, 0),
        (Request, 0),
    ]
    assert request_of(bench.item(waypoint(), 0, as_float=True)) == (FloatRequest, 1)
    assert request_of(bench.item(waypoint(), 1)) == (Request, 2)
    # It can do integers: what is missing now was lost, and floats would only cost digits.
    assert {type(message) for message in bench.wait(4.0)} == {Request}


def test_ack_unsupported_changes_the_kind_of_request() -> None:
    bench = Bench()
    bench.count(1)
    assert request_of(bench.say(Ack(*SERVER, UNSUPPORTED, MISSION))) == (FloatRequest, 0)
    assert request_of(bench.say(Ack(*SERVER, UNSUPPORTED, MISSION))) == (Request, 0)
    assert bench.say(Ack(*SERVER, UNSUPPORTED, FENCE)) == []


@pytest.mark.parametrize("result", [mavlink.MAV_MISSION_OPERATION_CANCELLED, ERROR])
def test_a_client_may_leave_an_upload(result: int) -> None:
    bench = Bench()
    bench.count(2)
    bench.item(waypoint(), 0)
    assert bench.say(Ack(*SERVER, result, MISSION)) == []
    assert bench.wait(6.0) == []
    assert bench.stores.items(MISSION) == ()
    assert request_of(bench.count(1)) == (Request, 0)


def test_an_early_accepted_from_the_client_changes_nothing() -> None:
    bench = Bench()
    bench.count(1)
    assert bench.say(Ack(*SERVER, ACCEPTED, MISSION)) == []
    assert result_of(bench.item(waypoint(), 0)) == ACCEPTED


def test_repeated_count_begins_again() -> None:
    bench = Bench()
    for _ in range(3):
        assert request_of(bench.count(3)) == (Request, 0)
    bench.item(waypoint(1), 0)
    bench.item(waypoint(2), 1)
    assert request_of(bench.count(2)) == (Request, 0)
    bench.item(waypoint(3), 0)
    assert result_of(bench.item(waypoint(4), 1)) == ACCEPTED
    assert same_plan(bench.stores.items(MISSION), [waypoint(3), waypoint(4)])


def test_count_alone_is_no_progress() -> None:
    bench = Bench()
    bench.count(3)
    for _ in range(9):
        bench.wait(0.5)
        bench.count(3)
    assert result_of([bench.wait(0.5)[-1]]) == mavlink.MAV_MISSION_OPERATION_CANCELLED


def test_wrong_and_repeated_items() -> None:
    bench = Bench()
    bench.count(3)
    assert bench.item(waypoint(5), 1) == []
    assert request_of(bench.item(waypoint(0), 0)) == (Request, 1)
    assert bench.item(waypoint(0), 0) == []  # the echo of a repeated request
    bench.now_us += 150_000
    assert request_of(bench.item(waypoint(0), 0)) == (Request, 1)  # the client missed our request
    assert bench.item(waypoint(5), 2) == []
    assert request_of(bench.item(waypoint(1), 1)) == (Request, 2)
    assert bench.item(waypoint(0), 0) == []
    assert result_of(bench.item(waypoint(2), 2)) == ACCEPTED
    assert same_plan(bench.stores.items(MISSION), [waypoint(n) for n in range(3)])


def test_repeated_last_item_brings_the_lost_ack_again() -> None:
    bench = Bench()
    bench.count(2)
    bench.item(waypoint(0), 0)
    assert result_of(bench.item(waypoint(1), 1)) == ACCEPTED
    assert bench.item(waypoint(1), 1) == []  # an echo
    assert bench.item(waypoint(0), 0) == []
    bench.now_us += 500_000
    assert result_of(bench.item(waypoint(1), 1)) == ACCEPTED
    bench.count(1)
    bench.item(waypoint(frame=1), 0)
    bench.now_us += 500_000
    assert result_of(bench.item(waypoint(frame=1), 0)) == UNSUPPORTED_FRAME
    bench.now_us += 6_000_000
    assert result_of(bench.item(waypoint(), 0)) == ERROR


def test_an_item_of_another_plan_does_not_disturb() -> None:
    bench = Bench()
    bench.count(1, FENCE)
    assert result_of(bench.item(waypoint(), 0), mission_type=MISSION) == ERROR
    assert bench.stores.items(MISSION) == ()
    assert bench.stores.transaction is not None


def test_guided_items_of_ardupilot_are_unsupported() -> None:
    bench = Bench()
    for current in (2, 3):
        assert result_of(bench.item(waypoint(), 0, current=current)) == UNSUPPORTED


def test_the_plan_changes_with_the_last_item_alone() -> None:
    changes: list[tuple[int, int]] = []
    bench = Bench(MissionStores(changed=lambda *change: changes.append(change)))
    bench.upload([waypoint(99)])
    bench.count(3)
    bench.item(waypoint(0), 0)
    bench.item(waypoint(1), 1, current=1)
    assert same_plan(bench.stores.items(MISSION), [waypoint(99)])
    assert changes == [(MISSION, 0)]
    bench.item(waypoint(2), 2)
    assert changes == [(MISSION, 0), (MISSION, 1)]


def test_no_space_answers_the_count() -> None:
    bench = Bench()
    for mission_type, limit in ((MISSION, 2000), (FENCE, 64), (RALLY, 32)):
        assert result_of(bench.count(limit + 1, mission_type), mission_type=mission_type) == NO_SPACE
        assert str(limit) in bench.texts[-1]
        assert bench.stores.transaction is None
        assert request_of(bench.count(limit, mission_type)) == (Request, 0)


@pytest.mark.parametrize("mission_type", [MISSION, FENCE, RALLY])
def test_count_zero_clears(mission_type: int) -> None:
    bench = Bench()
    assert bench.upload(PLANS[mission_type], mission_type) == ACCEPTED
    assert result_of(bench.count(0, mission_type), mission_type=mission_type) == ACCEPTED
    assert bench.stores.items(mission_type) == ()
    assert bench.stores.id(mission_type) == 0


@pytest.mark.parametrize(
    ("mission_type", "item", "result"),
    [
        *[(MISSION, waypoint(frame=frame), UNSUPPORTED_FRAME) for frame in (1, 4, 7, 8, 10, 11, 21, 255)],
        (FENCE, polygon()[0]._replace(frame=2), UNSUPPORTED_FRAME),
        (RALLY, rally()._replace(frame=2), UNSUPPORTED_FRAME),
        (MISSION, waypoint(param1=inf), INVALID_PARAM1),
        (MISSION, waypoint(param2=-inf), INVALID_PARAM1 + 1),
        (MISSION, waypoint(param3=inf), INVALID_PARAM1 + 2),
        (MISSION, waypoint(param4=inf), INVALID_PARAM1 + 3),
        (MISSION, waypoint(x=900_000_001), INVALID_PARAM5_X),
        (MISSION, waypoint(x=-900_000_001), INVALID_PARAM5_X),
        (MISSION, waypoint(y=1_800_000_001), INVALID_PARAM6_Y),
        (MISSION, waypoint(y=-(2**31)), INVALID_PARAM6_Y),
        (MISSION, waypoint(z=inf), INVALID_PARAM7),
        (FENCE, polygon()[0]._replace(x=NOWHERE), INVALID_PARAM5_X),
        (FENCE, polygon()[0]._replace(y=NOWHERE), INVALID_PARAM6_Y),
        (RALLY, rally()._replace(x=NOWHERE), INVALID_PARAM5_X),
        (RALLY, rally()._replace(z=nan), INVALID_PARAM7),
        (MISSION, polygon()[0], ERROR),
        (MISSION, rally(), ERROR),
        (FENCE, waypoint(), UNSUPPORTED),
        (FENCE, rally(), UNSUPPORTED),
        (RALLY, waypoint(), UNSUPPORTED),
    ],
)
def test_each_refusal_at_its_item(mission_type: int, item: MissionItem, result: int) -> None:
    bench = Bench()
    good = PLANS[mission_type][0]
    bench.count(3, mission_type)
    assert request_of(bench.item(good, 0, mission_type)) == (Request, 1)
    assert result_of(bench.item(item, 1, mission_type), mission_type=mission_type) == result
    assert f"item 1: {mavlink.enums['MAV_MISSION_RESULT'][result].name[12:]}" in bench.texts[-1]
    assert bench.stores.transaction is None
    assert bench.stores.items(mission_type) == ()


@pytest.mark.parametrize(
    ("x", "y", "result"),
    [
        (91.0, 8.0, INVALID_PARAM5_X),
        (inf, 8.0, INVALID_PARAM5_X),
        (1e30, 8.0, INVALID_PARAM5_X),
        (47.0, -181.0, INVALID_PARAM6_Y),
        (47.0, -inf, INVALID_PARAM6_Y),
        (47.0, 1e30, INVALID_PARAM6_Y),
    ],
)
def test_float_coordinates_that_are_none(x: float, y: float, result: int) -> None:
    bench = Bench()
    bench.count(1)
    assert result_of(bench.say(Item(*SERVER, 0, 3, 16, 0, 1, 0, 0, 0, nan, x, y, 10.0, MISSION))) == result


def test_the_owners_rules() -> None:
    stores = MissionStores(
        check=lambda mission_type, seq, item: UNSUPPORTED if item.command == 18 else ACCEPTED,
        validate=lambda mission_type, items: (mavlink.MAV_MISSION_INVALID, 1) if items[1].z > 50.0 else (ACCEPTED, 0),
    )
    bench = Bench(stores)
    assert bench.upload([waypoint(), waypoint(command=18)]) == UNSUPPORTED
    assert bench.upload([waypoint(), waypoint(z=51.0)]) == mavlink.MAV_MISSION_INVALID
    assert stores.items(MISSION) == ()
    assert bench.upload([waypoint(), waypoint()]) == ACCEPTED


# --- frames and coordinates


@pytest.mark.parametrize(("sent", "stored", "as_float"), [(0, 5, 0), (3, 6, 3), (5, 5, 0), (6, 6, 3), (2, 2, 2)])
def test_frames(sent: int, stored: int, as_float: int) -> None:
    bench = Bench()
    assert bench.upload([waypoint(frame=sent)]) == ACCEPTED
    (item,) = bench.say(Request(*SERVER, 0, MISSION))
    assert (type(item), item.frame, item.x, item.y) == (ItemInt, stored, 473_977_418, 85_455_939)
    (item,) = bench.say(FloatRequest(*SERVER, 0, MISSION))
    assert (type(item), item.frame) == (Item, as_float)
    scale = 1.0 if sent == 2 else 1e7
    assert item.x == pytest.approx(473_977_418 / scale, rel=1e-7)


def test_open_coordinates_survive() -> None:
    message = Item(*SERVER, 0, 3, 22, 0, 1, 0, 0, 0, nan, nan, nan, nan, MISSION)
    item = item_from_message(message)
    assert isinstance(item, MissionItem)
    assert (item.x, item.y) == (NOWHERE, NOWHERE)
    back = item_message(item, CLIENT, MISSION, 0, False, as_float=True)
    assert isnan(back.x)
    assert isnan(back.y)


coordinates = st.integers(-(2**31), 2**31 - 1)
floats = st.floats(width=32, allow_infinity=False)


@given(
    st.builds(
        MissionItem,
        command=st.integers(0, 65535),
        frame=st.sampled_from([2, 5, 6]),
        param1=floats,
        param2=floats,
        param3=floats,
        param4=floats,
        x=coordinates,
        y=coordinates,
        z=floats,
        autocontinue=st.integers(0, 255),
    )
)
def test_items_round_trip_the_wire_exactly(item: MissionItem) -> None:
    (frame,) = parse(encode(item_message(item, SERVER, MISSION, 3, True), 0, *CLIENT))
    back = item_from_message(frame.message)
    assert isinstance(back, MissionItem)
    assert same_plan([back], [item])


# --- download


def test_download_of_nothing() -> None:
    bench = Bench()
    (count,) = bench.say(mavlink.MAVLink_mission_request_list_message(*SERVER, FENCE))
    assert (type(count), count.count, count.mission_type) == (Count, 0, FENCE)
    assert bench.stores.transaction is None
    # dronekit asks all the same.
    assert result_of(bench.say(FloatRequest(*SERVER, 0, FENCE)), mission_type=FENCE) == INVALID_SEQUENCE


def test_download_item_by_item() -> None:
    bench = Bench()
    bench.upload([waypoint(n) for n in range(3)])
    bench.say(mavlink.MAVLink_mission_set_current_message(*SERVER, 1))
    (count,) = bench.say(mavlink.MAVLink_mission_request_list_message(*SERVER, MISSION))
    assert count.count == 3
    for seq in (0, 1, 1, 2):
        (item,) = bench.say(Request(*SERVER, seq, MISSION))
        assert (item.seq, item.current) == (seq, int(seq == 1))
        assert same_plan([item_from_message(item)], [waypoint(seq)])  # type: ignore[list-item]
    assert result_of(bench.say(Request(*SERVER, 3, MISSION))) == INVALID_SEQUENCE
    assert bench.say(Ack(*SERVER, ACCEPTED, MISSION)) == []
    assert bench.stores.transaction is None


def test_a_silent_download_is_forgotten() -> None:
    bench = Bench()
    bench.upload(PLANS[MISSION])
    bench.say(mavlink.MAVLink_mission_request_list_message(*SERVER, MISSION))
    assert bench.wait(4.9) == []
    assert result_of(bench.count(1, sender=OTHER), OTHER) == DENIED
    assert bench.wait(0.2) == []
    assert type(bench.count(1, sender=OTHER)[0]) is Request


# --- clearing, the current item, what is not supported


@pytest.mark.parametrize("mission_type", [MISSION, FENCE, RALLY, ALL])
def test_clear(mission_type: int) -> None:
    bench = Bench()
    for kind, items in PLANS.items():
        assert bench.upload(items, kind) == ACCEPTED
    answer = bench.say(mavlink.MAVLink_mission_clear_all_message(*SERVER, mission_type))
    assert result_of(answer, mission_type=mission_type) == ACCEPTED
    for kind in PLANS:
        assert bool(bench.stores.items(kind)) == (mission_type not in (kind, ALL))
        assert bool(bench.stores.id(kind)) == (mission_type not in (kind, ALL))


def test_set_current_out_of_range_is_not_answered_by_mission_current() -> None:
    bench = Bench()
    bench.upload(PLANS[MISSION])
    (current,) = bench.say(mavlink.MAVLink_mission_set_current_message(*SERVER, 24))
    assert (type(current), current.seq, current.total) == (Current, 24, 25)
    # MAVSDK repeats itself at once on every MISSION_CURRENT with another item.
    assert result_of(bench.say(mavlink.MAVLink_mission_set_current_message(*SERVER, 25))) == INVALID_SEQUENCE
    assert "25" in bench.texts[-1]


@pytest.mark.parametrize("mission_type", [3, 17, 254])
def test_unknown_plans_are_unsupported(mission_type: int) -> None:
    bench = Bench()
    for message in (
        Count(*SERVER, 1, mission_type),
        mavlink.MAVLink_mission_request_list_message(*SERVER, mission_type),
        mavlink.MAVLink_mission_clear_all_message(*SERVER, mission_type),
        Request(*SERVER, 0, mission_type),
    ):
        assert result_of(bench.say(message), mission_type=mission_type) == UNSUPPORTED
    assert result_of(bench.say(Count(*SERVER, 1, ALL)), mission_type=ALL) == UNSUPPORTED


def test_partial_lists_are_unsupported() -> None:
    bench = Bench()
    for message_class in (
        mavlink.MAVLink_mission_request_partial_list_message,
        mavlink.MAVLink_mission_write_partial_list_message,
    ):
        assert result_of(bench.say(message_class(*SERVER, 0, 3, RALLY)), mission_type=RALLY) == UNSUPPORTED


def test_ids_change_with_the_plan() -> None:
    bench = Bench()
    seen = set()
    for items in ([waypoint(0)], [waypoint(1)], [waypoint(1), waypoint(1)], [waypoint(0, autocontinue=0)]):
        bench.upload(items)
        seen.add(bench.stores.id(MISSION))
    assert len(seen) == 4
    assert 0 not in seen
    bench.upload([waypoint(0)])
    assert bench.stores.id(MISSION) in seen


# --- two clients


def test_another_client_is_denied_while_one_uploads() -> None:
    bench = Bench()
    second = Bench(bench.stores)  # on another link
    bench.count(2)
    bench.item(waypoint(0), 0)
    for other in (bench, second):
        for mission_type in (MISSION, FENCE):
            assert result_of(other.count(1, mission_type, OTHER), OTHER, mission_type) == DENIED
        for message in (
            mavlink.MAVLink_mission_request_list_message(*SERVER, MISSION),
            mavlink.MAVLink_mission_clear_all_message(*SERVER, ALL),
            Request(*SERVER, 0, MISSION),
        ):
            assert result_of(other.say(message, OTHER), OTHER) == DENIED
        assert result_of(other.item(waypoint(5), 1, sender=OTHER), OTHER) == DENIED
    # The same ids on another link are another client.
    assert result_of(second.count(1)) == DENIED
    assert second.say(Ack(*SERVER, mavlink.MAV_MISSION_OPERATION_CANCELLED, MISSION)) == []
    assert result_of(bench.item(waypoint(1), 1)) == ACCEPTED
    assert same_plan(bench.stores.items(MISSION), [waypoint(0), waypoint(1)])
    assert type(second.count(1)[0]) is Request


def test_a_download_gives_way_when_its_last_item_is_out() -> None:
    bench = Bench()
    bench.upload([waypoint(0), waypoint(1)])
    bench.say(mavlink.MAVLink_mission_request_list_message(*SERVER, MISSION))
    bench.say(Request(*SERVER, 0, MISSION))
    assert result_of(bench.count(1, sender=OTHER), OTHER) == DENIED
    bench.say(Request(*SERVER, 1, MISSION))
    assert type(bench.count(1, sender=OTHER)[0]) is Request
    # The first client missed its last item: it gets it, of the plan as it was.
    bench.item(waypoint(7), 0, sender=OTHER)
    (item,) = bench.say(Request(*SERVER, 1, MISSION))
    assert item.x == waypoint(1).x


def test_no_item_of_a_plan_that_is_gone_is_served() -> None:
    """DroneKit asks for item 0 whatever the count is."""
    bench = Bench()
    bench.upload([waypoint(0)])
    bench.say(mavlink.MAVLink_mission_request_list_message(*SERVER, MISSION))
    bench.say(Request(*SERVER, 0, MISSION))
    bench.say(Ack(*SERVER, ACCEPTED, MISSION))
    assert result_of(bench.say(mavlink.MAVLink_mission_clear_all_message(*SERVER, MISSION))) == ACCEPTED
    (count,) = bench.say(mavlink.MAVLink_mission_request_list_message(*SERVER, MISSION))
    assert count.count == 0
    assert result_of(bench.say(FloatRequest(*SERVER, 0, MISSION))) == INVALID_SEQUENCE


def test_a_transaction_of_a_dead_link_does_not_last() -> None:
    bench = Bench()
    second = Bench(bench.stores)
    bench.count(2)
    second.now_us += 4_999_999
    assert result_of(second.count(1)) == DENIED
    second.now_us += 1
    assert request_of(second.count(1)) == (Request, 0)


@pytest.mark.parametrize("seed", range(3))
def test_two_clients_that_fight_both_get_through(seed: int) -> None:
    stores = MissionStores()
    plans = {CLIENT: [waypoint(n) for n in range(8)], OTHER: [waypoint(100 + n) for n in range(8)]}
    links = []
    for items in plans.values():
        client = MissionClient(SERVER)
        client.upload(MISSION, items)
        links.append((LossyLink(MissionServer(stores), client, 0.2, seed), client, items))
    done: list[Any] = []
    denied = 0
    for _ in range(40_000):
        for bench, client, items in links:
            bench.run(_once())
            if client.busy or client.result == ACCEPTED:
                continue
            denied += client.result == DENIED
            client.upload(MISSION, items)
        done = [client for _, client, _ in links if client.result == ACCEPTED]
        assert stores.items(MISSION) == () or any(same_plan(stores.items(MISSION), plan) for plan in plans.values())
        if len(done) == 2:
            break
    assert len(done) == 2
    assert denied > 0


def _once() -> Any:
    calls = iter((False, True))
    return lambda: next(calls)


# --- what is told unasked


def test_mission_current_each_second_and_on_change() -> None:
    stores = MissionStores()
    server = MissionServer(stores)
    times = []
    for now_us in range(0, 4_000_000, 4_000):
        for message in server.step(now_us):
            assert type(message) is Current
            times.append((now_us / 1e6, message.seq, message.total, message.mission_state))
        if now_us == 2_500_000:
            stores.replace(MISSION, PLANS[MISSION])
    assert times == [(0.0, 0, 0, 1), (1.0, 0, 0, 1), (2.0, 0, 0, 1), (2.504, 0, 25, 2), (3.504, 0, 25, 2)]


def test_reached_is_told_on_every_link_and_repeated() -> None:
    stores = MissionStores(status=lambda: MissionStatus(1, 3, 3, 1))
    stores.replace(MISSION, PLANS[MISSION])
    servers = [MissionServer(stores), MissionServer(stores)]
    stores.reached(0)
    stores.reached(1)
    for server in servers:
        told = []
        for now_us in range(0, 30_000_000, 100_000):
            told += [m.seq for m in server.step(now_us) if type(m) is mavlink.MAVLink_mission_item_reached_message]
        assert told == [0, 1, *[1] * 10]
    stores.reached(2)
    assert len(servers[0].step(31_000_000)) == 2
    stores.replace(MISSION, PLANS[MISSION])  # a new mission: nothing of it was reached
    assert [type(message) for message in servers[0].step(32_000_000)] == [Current]
    assert servers[1].step(33_000_000)[-1].get_type() == "MISSION_CURRENT"


# --- nonsense

_CLASSES = [
    Count,
    Request,
    FloatRequest,
    ItemInt,
    Item,
    Ack,
    mavlink.MAVLink_mission_request_list_message,
    mavlink.MAVLink_mission_clear_all_message,
    mavlink.MAVLink_mission_set_current_message,
    mavlink.MAVLink_mission_request_partial_list_message,
    mavlink.MAVLink_mission_write_partial_list_message,
    Current,
    mavlink.MAVLink_heartbeat_message,
]
_RANGES = {
    "B": st.one_of(st.integers(0, 6), st.integers(0, 255)),
    "H": st.one_of(st.integers(0, 3), st.sampled_from([16, 5001, 65535])),
    "h": st.integers(-(2**15), 2**15 - 1),
    "I": st.integers(0, 2**32 - 1),
    "i": coordinates,
    "f": st.floats(width=32),
}


@st.composite
def messages(draw: Any) -> Any:
    message_class = draw(st.sampled_from(_CLASSES))
    codes = dict(zip(message_class.ordered_fieldnames, message_class.native_format.decode()[1:], strict=True))
    return message_class(**{name: draw(_RANGES[codes[name]]) for name in message_class.fieldnames})


@given(
    st.lists(
        st.tuples(messages(), st.sampled_from([CLIENT, OTHER]), st.booleans(), st.sampled_from([0, 4_000, 3_000_000])),
        max_size=40,
    )
)
def test_nonsense_never_raises_and_keeps_the_rules(said: list[tuple[Any, tuple[int, int], bool, int]]) -> None:
    stores = MissionStores()
    servers = MissionServer(stores), MissionServer(stores)
    client = MissionClient(SERVER)
    client.download(MISSION)
    now_us = 0
    for message, sender, second, later_us in said:
        now_us += later_us
        (frame,) = parse(encode(message, 0, *sender))
        answers = [*servers[second].receive(frame.message, sender, now_us), *servers[second].step(now_us)]
        assert len(answers) <= 4
        for answer in answers:
            encode(answer, 0, *SERVER)
        for answer in (*client.receive(frame.message, SERVER, now_us), *client.step(now_us)):
            encode(answer, 0, *CLIENT)
        for mission_type, limit in stores.limits.items():
            assert len(stores.items(mission_type)) <= limit
        assert stores.transaction is None or len(stores.transaction.buffer) < stores.transaction.count


def test_nan_of_any_bits_is_the_same_plan() -> None:
    (odd,) = struct.unpack("<f", struct.pack("<I", 0xFFC00001))
    plan = [MissionItem(16, 5, 0.0, nan, 0.0, nan, 1, 2, 3.0, 1)]
    assert same_plan(plan, [plan[0]._replace(param2=odd, param4=-nan)])
    assert not same_plan(plan, [plan[0]._replace(param2=0.0)])
