"""TIMESYNC and PING: answers, what is no request, and what the asker makes of the answers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.services.base import NOTHING, Peer
from mavsitl.services.bucket import FairBuckets, TokenBucket
from mavsitl.services.timesync import ClockOffset, PingClient, PingServer, TimesyncClient, TimesyncServer
from tests.services.lossy import CLIENT, SERVER, LossyLink

INT64 = st.integers(-(2**63), 2**63 - 1)


def timesync(tc1: int, ts1: int) -> Any:
    return mavlink.MAVLink_timesync_message(tc1, ts1)


# --- the side that answers


@given(ts1=INT64, now_us=st.integers(0, 2**62))
def test_a_request_is_answered_with_our_clock_and_its_stamp(ts1: int, now_us: int) -> None:
    (answer,) = TimesyncServer().receive(timesync(0, ts1), CLIENT, now_us)
    assert answer.ts1 == ts1
    assert answer.tc1 == min(max(now_us * 1000, 1), 2**63 - 1)
    assert (getattr(answer, "target_system", 245), getattr(answer, "target_component", 190)) == CLIENT
    (frame,) = parse(encode(answer, 0, *SERVER))
    assert (frame.message.tc1, frame.message.ts1) == (answer.tc1, ts1)


@given(tc1=INT64.filter(lambda value: value != 0), ts1=INT64)
def test_an_answer_is_never_answered(tc1: int, ts1: int) -> None:
    assert not TimesyncServer().receive(timesync(tc1, ts1), CLIENT, 5)


def test_two_servers_do_not_talk_for_ever() -> None:
    first, second = TimesyncServer(), TimesyncServer()
    (answer,) = first.receive(timesync(0, 7), CLIENT, 0)  # even at time 0 the answer is none that asks
    assert not second.receive(answer, SERVER, 0)


def test_a_flood_is_answered_at_a_bounded_rate() -> None:
    server = TimesyncServer(rate_hz=100.0, burst=10)
    answers = sum(len(server.receive(timesync(0, k), CLIENT, k * 50)) for k in range(20_000))  # one second
    assert 109 <= answers <= 111
    assert server.refused == 20_000 - answers
    assert len(server.receive(timesync(0, 1), CLIENT, 3_000_000)) == 1


# --- the estimate


def test_slow_exchanges_do_not_move_the_estimate() -> None:
    clock = ClockOffset()
    for k in range(64):
        sent = k * 100_000_000
        there, back = 1_000_000, 1_000_000
        if k % 3 == 0:
            there += 8_000_000  # a queue, one way: the plain mean would be 4 ms off
        clock.update(sent, sent + there + 5_000_000_000, sent + there + back)
    assert clock.offset_ns == 5_000_000_000
    assert clock.round_trip_ns == 2_000_000
    assert clock.median_round_trip_ns == 2_000_000
    assert (clock.exchanges, clock.restarts) == (64, 0)


@given(
    offset=st.integers(-(10**15), 10**15),
    trips=st.lists(st.tuples(st.integers(0, 10**8), st.integers(0, 10**8)), min_size=1, max_size=40),
)
def test_the_estimate_is_within_half_of_some_round_trip(offset: int, trips: list[tuple[int, int]]) -> None:
    clock = ClockOffset()
    for k, (there, back) in enumerate(trips):
        sent = k * 10**9
        clock.update(sent, sent + there + offset, sent + there + back)
    assert clock.restarts == 0
    assert clock.offset_ns is not None
    worst = max(there + back for there, back in trips[-ClockOffset.WINDOW :])
    assert abs(clock.offset_ns - offset) <= worst / 2 + 1


def test_a_clock_that_begins_anew_is_found_after_three_exchanges() -> None:
    clock = ClockOffset()
    for k in range(20):
        clock.update(k * 10**9, k * 10**9 + 500_000, k * 10**9 + 1_000_000)
    for k in range(20, 23):
        assert clock.offset_ns == 0
        clock.update(k * 10**9, k * 10**9 + 500_000 - 7 * 10**9, k * 10**9 + 1_000_000)
    assert clock.offset_ns == -7 * 10**9
    assert clock.restarts == 1
    assert clock.remote_us(8_000_000) == 1_000_000


def test_one_wild_answer_is_no_restart() -> None:
    clock = ClockOffset()
    for k in range(20):
        remote = 10**17 if k == 10 else k * 10**9 + 500_000
        clock.update(k * 10**9, remote, k * 10**9 + 1_000_000)
    assert (clock.offset_ns, clock.restarts) == (0, 0)


def test_an_answer_before_its_request_is_no_exchange() -> None:
    clock = ClockOffset()
    clock.update(10, 10, 9)
    assert (clock.exchanges, clock.offset_ns, clock.remote_us(0)) == (0, None, None)


# --- the side that asks


class ShiftedServer:
    """A TIMESYNC and PING server whose clock is ahead of the link's."""

    def __init__(self, ahead_us: int) -> None:
        self.ahead_us = ahead_us
        self.timesync = TimesyncServer()
        self.ping = PingServer()

    def receive(self, message: Any, sender: Peer, now_us: int) -> Sequence[Any]:
        server = self.timesync if type(message).id == mavlink.MAVLINK_MSG_ID_TIMESYNC else self.ping
        return server.receive(message, sender, now_us + self.ahead_us)

    def step(self, now_us: int) -> Sequence[Any]:
        return NOTHING


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_the_clock_is_found(loss: float) -> None:
    client = TimesyncClient(SERVER, interval_us=100_000)
    link = LossyLink(ShiftedServer(123_456_789), client, loss=loss, seed=3)
    link.run(lambda: client.clock.exchanges >= 10)
    assert client.clock.offset_ns == 123_456_789_000
    assert client.clock.round_trip_ns == 8_000_000  # 2 ms each way, seen at steps of 4 ms
    assert client.clock.remote_us(1_000_000) == 124_456_789
    assert (link.lost > 0) == (loss > 0)
    requests = sum(who == "client" for who, _ in link.sent)
    assert requests >= 10 if loss == 0.0 else requests > 10


def test_only_the_answers_to_our_requests_of_whom_we_asked_count_and_once() -> None:
    client = TimesyncClient(SERVER)
    (request,) = client.step(1_000_000)
    assert (request.tc1, request.ts1) == (0, 1_000_000_000)
    client.receive(timesync(5, request.ts1 + 1), SERVER, 1_002_000)  # another's
    client.receive(timesync(5, request.ts1), (9, 9), 1_002_000)  # a stranger's
    client.receive(timesync(0, request.ts1), SERVER, 1_002_000)  # no answer
    client.receive(timesync(-5, request.ts1), SERVER, 1_002_000)
    assert client.clock.exchanges == 0
    client.receive(timesync(5, request.ts1), SERVER, 1_002_000)
    client.receive(timesync(5, request.ts1), SERVER, 1_900_000)
    assert client.clock.exchanges == 1


def test_after_a_pause_one_request_is_due() -> None:
    client = TimesyncClient(SERVER, interval_us=100_000)
    assert len(client.step(0)) == 1
    assert not client.step(99_999)
    assert len(client.step(5_000_000)) == 1
    assert not client.step(5_000_001)


@pytest.mark.parametrize("interval_us", [0, -1])
def test_intervals_are_above_zero(interval_us: int) -> None:
    with pytest.raises(ValueError, match="interval_us"):
        TimesyncClient(SERVER, interval_us)
    with pytest.raises(ValueError, match="interval_us"):
        PingClient(interval_us)


# --- ping


@given(time_usec=st.integers(0, 2**64 - 1), seq=st.integers(0, 2**32 - 1))
def test_a_ping_to_everybody_comes_back(time_usec: int, seq: int) -> None:
    (answer,) = PingServer().receive(mavlink.MAVLink_ping_message(time_usec, seq, 0, 0), CLIENT, 5)
    assert (answer.time_usec, answer.seq) == (time_usec, seq)
    assert (answer.target_system, answer.target_component) == CLIENT


@pytest.mark.parametrize("target", [SERVER, (1, 0), (0, 1), CLIENT])
def test_a_ping_with_a_target_is_not_answered(target: Peer) -> None:
    assert not PingServer().receive(mavlink.MAVLink_ping_message(1, 2, *target), CLIENT, 5)


def test_a_flood_of_pings_is_answered_at_a_bounded_rate() -> None:
    server = PingServer(rate_hz=100.0, burst=10)
    request = mavlink.MAVLink_ping_message(1, 2, 0, 0)
    answers = sum(len(server.receive(request, CLIENT, k * 50)) for k in range(20_000))
    assert 109 <= answers <= 111
    assert server.refused == 20_000 - answers
    answers = sum(len(server.receive(request, (k % 250, 2), 10**6 + k * 50)) for k in range(20_000))
    assert answers <= FairBuckets.SHARES * 110 + 1


def test_who_asks_too_much_takes_nothing_from_the_others() -> None:
    server = PingServer(rate_hz=100.0, burst=10)
    request = mavlink.MAVLink_ping_message(1, 2, 0, 0)
    answered = 0
    for k in range(20_000):
        server.receive(request, (66, 1), k * 50)
        if k % 1000 == 0:
            answered += len(server.receive(request, CLIENT, k * 50))
    assert answered == 20


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_round_trips_are_measured(loss: float) -> None:
    client = PingClient(interval_us=100_000)
    link = LossyLink(ShiftedServer(10**9), client, loss=loss, seed=5)
    link.run(lambda: SERVER in client.echoes and client.echoes[SERVER].answers >= 10)
    assert set(client.echoes) == {SERVER}
    assert client.echoes[SERVER].median_us == 8_000


def test_each_answer_counts_once_and_strangers_are_bounded() -> None:
    client = PingClient()
    (request,) = client.step(1_000)
    assert (request.target_system, request.target_component) == (0, 0)
    answer = mavlink.MAVLink_ping_message(request.time_usec, request.seq, 245, 190)
    client.receive(mavlink.MAVLink_ping_message(request.time_usec, request.seq, 0, 0), SERVER, 2_000)  # a request
    client.receive(mavlink.MAVLink_ping_message(request.time_usec + 1, request.seq, 245, 190), SERVER, 2_000)
    client.receive(answer, SERVER, 500)  # before it was asked
    assert not client.echoes
    client.receive(answer, SERVER, 2_000)
    client.receive(answer, SERVER, 3_000)
    assert client.echoes[SERVER].answers == 1
    for system_id in range(2, 200):
        client.receive(answer, (system_id, 1), 2_000)
    assert len(client.echoes) == PingClient.MAX_ECHOES


def test_requests_without_answer_are_bounded() -> None:
    client = PingClient(interval_us=1)
    requests = [client.step(k)[0] for k in range(100)]
    client.receive(mavlink.MAVLink_ping_message(requests[0].time_usec, requests[0].seq, 245, 190), SERVER, 200)
    assert not client.echoes
    client.receive(mavlink.MAVLink_ping_message(requests[-1].time_usec, requests[-1].seq, 245, 190), SERVER, 200)
    assert client.echoes[SERVER].answers == 1


# --- the bucket


@pytest.mark.parametrize(("rate_hz", "burst"), [(0.0, 1.0), (-1.0, 1.0), (1.0, 0.5), (float("nan"), 1.0)])
def test_a_bucket_that_never_gives_is_refused(rate_hz: float, burst: float) -> None:
    with pytest.raises(ValueError, match="rate_hz"):
        TokenBucket(rate_hz, burst)


def test_a_bucket_gains_with_time_and_holds_no_more_than_its_burst() -> None:
    bucket = TokenBucket(rate_hz=1.0, burst=2)
    assert [bucket.take(0) for _ in range(3)] == [True, True, False]
    assert not bucket.take(999_999)
    assert bucket.take(1_000_000)
    assert [bucket.take(100_000_000) for _ in range(3)] == [True, True, False]
    assert not bucket.take(0)  # the clock went back
    assert not bucket.take(500_000)
    assert bucket.take(1_000_000)
