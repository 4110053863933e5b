"""The model of a bad link: each effect within bounds that a fair generator passes, its repeatability, its memory.

Bounds on counts are five standard deviations of the binomial; the seeds are fixed, so a pass is a pass for ever.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl.codec import MAX_DATAGRAM_BYTES, packer, parse
from mavsitl.dialect import mavlink
from mavsitl.link.base import LinkError
from mavsitl.link.exchange import EXCHANGE_BYTES, HELLO, pack, unpack
from mavsitl.link.framing import split_frames
from mavsitl.link.impaired import MAX_IN_FLIGHT, Channel, Channels, ImpairedLink, channels_for
from mavsitl.link.memory import memory_pair
from mavsitl.scenario import Bursts, Impairment, LinkModel, Outage

ATTITUDE = packer(mavlink.MAVLink_attitude_message)
PERIOD_US = 4000
N = 20_000


def frame(number: int) -> bytes:
    """One whose number can be read back, as its stamp."""
    return ATTITUDE(number & 0xFF, 1, 1, number, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)


FRAME_BYTES = len(frame(1 << 24))


def channel(seed: int = 1, **settings: Any) -> Channel:
    return Channel(Impairment(**settings), seed, "to_ground")


def run(tested: Channel, count: int = N, period_us: int = PERIOD_US) -> list[tuple[int, bytes]]:
    """One frame a period, looked at every period, then until all are there: (time, datagram) in order of arrival."""
    came = []
    now_us = 0
    number = 0
    while number < count or tested.in_flight:
        if number < count:
            tested.send(frame(number), now_us)
            number += 1
        came += [(now_us, datagram) for datagram in tested.due(now_us)]
        now_us += period_us
    return came


def numbers(came: list[tuple[int, bytes]]) -> list[int]:
    return [each.message.time_boot_ms for _, datagram in came for each in parse(datagram)]


def delays_us(came: list[tuple[int, bytes]]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([now_us - PERIOD_US * number for (now_us, _), number in zip(came, numbers(came), strict=True)])


def spread(share: float, count: int = N) -> float:
    """Five standard deviations of a share."""
    return 5.0 * sqrt(share * (1.0 - share) / count)


def test_the_default_does_nothing() -> None:
    tested = channel()
    assert run(tested, 100) == [(PERIOD_US * number, frame(number)) for number in range(100)]
    assert tested.statistics.as_dict() == {
        "sent": 100, "delivered": 100, "lost": 0, "outage": 0, "queue_drops": 0, "corrupted": 0, "duplicated": 0,
        "reordered": 0, "late": 0, "delay_p50_ms": 0.0, "delay_p99_ms": 0.0, "delay_max_ms": 0.0,
    }  # fmt: skip
    assert channels_for(LinkModel(), 1) is None
    assert channels_for(LinkModel(to_vehicle=Impairment(loss=0.1)), 1) is not None


def test_a_constant_latency_ends_at_the_next_look() -> None:
    tested = channel(latency_ms=10.0)
    assert set(delays_us(run(tested, 100))) == {12_000.0}
    tested.send(frame(0), 1_000_000)
    assert tested.due(1_009_999) == []
    assert tested.due(1_010_000) == [frame(0)]
    assert tested.statistics.delay.max_us == 10_000.0


@pytest.mark.parametrize("distribution", ["uniform", "normal", "gamma"])
def test_jitter_has_the_mean_and_the_width_that_were_asked_for(distribution: str) -> None:
    """Looked at every 10 us, far between, so that the delay is seen as it is."""
    tested = channel(latency_ms=20.0, jitter_ms=5.0, distribution=distribution)
    delays = []
    for number in range(4000):
        tested.send(frame(number), 0)
    for now_us in range(0, 100_000, 10):
        delays += [now_us] * len(tested.due(now_us))
    values = np.array(delays) / 1e3
    assert len(values) == 4000
    sigma = 5.0 / sqrt(3.0) if distribution == "uniform" else 5.0
    assert abs(values.mean() - 20.0) < 5.0 * sigma / sqrt(4000) + 0.01
    assert abs(values.std() / sigma - 1.0) < 0.08
    if distribution == "uniform":
        assert values.min() >= 15.0
        assert values.max() <= 25.01
    skewness = float(np.mean(((values - values.mean()) / values.std()) ** 3))
    assert abs(skewness - (0.5 if distribution == "gamma" else 0.0)) < 0.2
    assert tested.statistics.delay.p50_us / 1e3 == pytest.approx(np.median(values), rel=0.14)


def test_a_normal_delay_is_cut_at_zero() -> None:
    delays = delays_us(run(channel(latency_ms=1.0, jitter_ms=10.0), 2000))
    assert delays.min() == 0.0
    assert (delays == 0.0).mean() > 0.4


def test_jitter_overtakes_unless_the_order_is_kept() -> None:
    free, kept = (channel(latency_ms=20.0, jitter_ms=10.0, keep_order=keep) for keep in (False, True))
    free_came, kept_came = numbers(run(free, 2000)), numbers(run(kept, 2000))
    assert sorted(free_came) == kept_came == list(range(2000))
    late = sum(number < max(free_came[:index], default=-1) for index, number in enumerate(free_came))
    assert free.statistics.late == late > 500
    assert kept.statistics.late == 0
    assert kept.statistics.delay.p50_us > free.statistics.delay.p50_us


@pytest.mark.parametrize("loss", [0.01, 0.05, 0.2, 0.9])
def test_independent_loss(loss: float) -> None:
    tested = channel(loss=loss)
    came = np.zeros(N, bool)
    came[numbers(run(tested))] = True
    assert abs((~came).mean() - loss) < spread(loss)
    assert tested.statistics.lost == (~came).sum()
    assert tested.statistics.delivered + tested.statistics.lost == tested.statistics.sent == N
    after_a_loss = ~came[1:][~came[:-1]]  # independent: a loss says nothing about the next
    assert abs(after_a_loss.mean() - loss) < spread(loss, len(after_a_loss))


def test_all_is_lost_at_one() -> None:
    assert run(channel(loss=1.0), 100) == []


def test_bursts_last_as_long_and_come_as_often_as_asked_for() -> None:
    tested = channel(bursts=Bursts(bad_ms=200.0, good_ms=800.0))
    count = 200_000
    came = np.zeros(count, bool)
    came[numbers(run(tested, count))] = True
    changes = np.flatnonzero(np.diff(came.astype(int)))
    lengths_ms = np.diff(changes) * PERIOD_US / 1e3
    first_is_good = not came[changes[0] + 1 : changes[0] + 2].all()
    bad, good = (lengths_ms[0::2], lengths_ms[1::2]) if first_is_good else (lengths_ms[1::2], lengths_ms[0::2])
    assert len(bad) > 500
    for lengths, mean_ms in ((bad, 200.0), (good, 800.0)):
        assert abs(lengths.mean() / mean_ms - 1.0) < 5.0 / sqrt(len(lengths)) + 0.02
        assert abs(lengths.std() / lengths.mean() - 1.0) < 0.25  # exponential
    assert abs((~came).mean() - 0.2) < 0.05


def test_bursts_do_not_depend_on_how_much_is_sent() -> None:
    """The state goes with the time: with ten times the traffic the same instants are bad."""
    slow = {number * 10 for number in numbers(run(channel(bursts=Bursts(bad_ms=100.0, good_ms=300.0)), 1000, 40_000))}
    fast = set(numbers(run(channel(bursts=Bursts(bad_ms=100.0, good_ms=300.0)), 10_000)))
    assert slow == {number for number in fast if number % 10 == 0}
    assert len(slow) < 1000


def test_both_states_of_a_burst_have_a_loss_of_their_own() -> None:
    tested = channel(bursts=Bursts(bad_ms=500.0, good_ms=500.0, loss_bad=0.5, loss_good=0.1))
    run(tested, 100_000)
    assert abs(tested.statistics.lost / 100_000 - 0.3) < 0.04


def test_reordered_ones_come_so_much_later() -> None:
    tested = channel(reorder=0.01, reorder_ms=20.0)
    came = run(tested)
    held = delays_us(came) > 0.0
    assert set(delays_us(came)) == {0.0, 20_000.0}
    assert abs(held.mean() - 0.01) < spread(0.01)
    assert tested.statistics.reordered == tested.statistics.late == held.sum()
    order = numbers(came)
    first = int(np.argmax(np.diff(order) < 0))
    assert order[first] - order[first + 1] == 4  # so many overtook it; the fifth comes at the same look, behind it


def test_duplicates_come_twice() -> None:
    tested = channel(duplicate=0.1, latency_ms=20.0, jitter_ms=10.0)
    order = numbers(run(tested))
    assert set(order) == set(range(N))
    twice = len(order) - N
    assert twice == tested.statistics.duplicated
    assert abs(twice / N - 0.1) < spread(0.1)
    assert max(np.bincount(order)) == 2


def test_corrupted_ones_differ_by_up_to_three_bits_and_are_refused() -> None:
    tested = channel(corrupt=0.1)
    came = run(tested)
    flipped = []
    good = 0
    for number, (_, datagram) in enumerate(came):
        whole = frame(number)
        assert len(datagram) == len(whole)
        bits = sum((a ^ b).bit_count() for a, b in zip(datagram, whole, strict=True))
        if bits:
            flipped.append(bits)
            assert parse(datagram) == []
        else:
            good += 1
    assert set(flipped) == {1, 2, 3}
    assert tested.statistics.corrupted == len(flipped) == N - good
    assert abs(len(flipped) / N - 0.1) < spread(0.1)


def test_a_bandwidth_passes_so_many_bits_and_drops_the_tail() -> None:
    """100 kbit/s for 250 frames of 40 bytes a second, 80 kbit/s, and for 500, which is too much."""
    bits_per_frame = 8 * FRAME_BYTES
    fits, floods = (channel(bandwidth_kbit_s=0.25 * bits_per_frame * 1.25, queue_bytes=1000) for _ in range(2))
    run(fits, 2500)
    assert fits.statistics.queue_drops == 0
    assert fits.statistics.delay.max_us <= 3201  # a frame needs 3.2 ms
    came = run(floods, 5000, 2000)
    drops = floods.statistics.queue_drops
    assert abs(drops / 5000 - 0.375) < 0.01  # 312.5 of 500 pass
    assert floods.statistics.delivered + drops == 5000
    assert 1000 // FRAME_BYTES - 1 <= floods.statistics.delay.max_us / 3200 <= 1000 // FRAME_BYTES + 1
    order = numbers(came)
    assert order == sorted(order)


def test_an_outage_by_flight_time_needs_a_flight() -> None:
    outages = (Outage(start_s=1.0, duration_s=0.5),)
    tested = channel(outages=outages)
    assert len(run(tested, 1000)) == 1000
    tested = channel(outages=outages)
    tested.flight_began_us = 500_000
    missing = sorted(set(range(1000)) - set(numbers(run(tested, 1000))))
    assert missing == list(range(375, 500))
    assert tested.statistics.outage == 125


def test_an_outage_by_simulated_time_needs_none() -> None:
    tested = channel(outages=(Outage(start_s=0.0, duration_s=0.4, clock="simulated"),))
    assert numbers(run(tested, 200)) == list(range(100, 200))


def test_a_combined_datagram_is_impaired_frame_by_frame() -> None:
    tested = channel(loss=0.5)
    datagrams = [b"".join(frame(10 * i + j) for j in range(10)) for i in range(500)]
    came = []
    for datagram in datagrams:
        tested.send(datagram, 0)
        came += tested.due(0)
    assert all(len(parse(each)) == 1 for each in came)
    assert tested.statistics.sent == 5000
    whole = sum(all(frame(10 * i + j) in set(came) for j in range(10)) for i in range(500))
    assert whole < 10
    assert abs(len(came) / 5000 - 0.5) < spread(0.5, 5000)


EVERYTHING = Impairment(
    latency_ms=15.0, jitter_ms=10.0, distribution="gamma", loss=0.1, bursts=Bursts(bad_ms=50.0, good_ms=500.0),
    reorder=0.05, duplicate=0.1, corrupt=0.05, bandwidth_kbit_s=100.0, queue_bytes=1000,
    outages=(Outage(start_s=2.0, duration_s=1.0, clock="simulated"),),
)  # fmt: skip


def test_the_same_seed_and_direction_are_the_same_to_the_byte() -> None:
    assert run(Channel(EVERYTHING, 7, "to_ground"), 3000) == run(Channel(EVERYTHING, 7, "to_ground"), 3000)
    assert run(Channel(EVERYTHING, 7, "to_ground"), 3000) != run(Channel(EVERYTHING, 8, "to_ground"), 3000)
    assert run(Channel(EVERYTHING, 7, "to_ground"), 3000) != run(Channel(EVERYTHING, 7, "to_vehicle"), 3000)


def test_one_effect_does_not_move_another() -> None:
    """The same messages are lost whether or not others are corrupted or delayed."""
    alone = numbers(run(channel(loss=0.2), 2000))
    beside = channel(loss=0.2, latency_ms=5.0, jitter_ms=3.0, duplicate=0.3, bursts=Bursts(bad_ms=1.0, loss_bad=0.0))
    assert sorted(set(numbers(run(beside, 2000)))) == alone


def test_it_is_changed_in_flight() -> None:
    tested = channel(latency_ms=40.0)
    tested.send(frame(0), 0)
    tested.configure(Impairment())
    tested.send(frame(1), 4000)
    assert tested.due(4000) == [frame(1)]
    tested.configure(Impairment(loss=1.0))
    tested.send(frame(2), 8000)
    assert tested.due(10**9) == [frame(0)]
    assert (tested.statistics.lost, tested.statistics.late) == (1, 1)


def test_memory_is_bounded() -> None:
    tested = channel(latency_ms=10_000.0, duplicate=1.0)
    datagram = frame(0) * 40
    for _ in range(MAX_IN_FLIGHT // 40):
        tested.send(datagram, 0)
    assert tested.in_flight == MAX_IN_FLIGHT
    assert tested.statistics.queue_drops == tested.statistics.sent == MAX_IN_FLIGHT
    assert len(tested.due(10_000_000)) == MAX_IN_FLIGHT
    assert tested.in_flight == 0


def test_more_than_fits_waits_for_the_next_look() -> None:
    tested = channel()
    tested.send(frame(1 << 24) * 10, 0)
    assert [len(tested.due(0, 3 * FRAME_BYTES)) for _ in range(5)] == [3, 3, 3, 1, 0]
    tested.send(frame(0), 0)
    assert len(tested.due(0, 1)) == 1  # never stuck


@given(st.binary(max_size=MAX_DATAGRAM_BYTES), st.integers(0, 3))
def test_splitting_loses_nothing(octets: bytes, frames: int) -> None:
    datagram = b"".join(frame(number) for number in range(frames)) + octets
    pieces = split_frames(datagram)
    assert b"".join(pieces) == datagram
    assert pieces[:frames] == [frame(number) for number in range(frames)]
    assert all(pieces)


@given(st.lists(st.binary(max_size=300), max_size=20), st.booleans())
def test_an_exchange_is_read_as_it_was_packed(messages: list[bytes], last: bool) -> None:
    assert unpack(pack(messages, last=last)) == (messages, last)


@given(st.binary(max_size=100))
def test_an_exchange_of_anything_else_is_refused_or_read(octets: bytes) -> None:
    try:
        messages, last = unpack(octets)
    except LinkError:
        return
    assert pack(messages, last=last) == octets


def test_an_exchange_fits_a_datagram_and_no_frame_looks_like_one() -> None:
    assert len(pack([b"x" * 12] * (EXCHANGE_BYTES // 12))) < 65_507
    for stranger in (frame(0), HELLO, b""):
        with pytest.raises(LinkError, match=r"same \[link\]"):
            unpack(stranger)


def test_a_link_is_impaired_both_ways_and_knows_its_peers() -> None:
    near, far = memory_pair()
    model = LinkModel(to_ground=Impairment(latency_ms=10.0), to_vehicle=Impairment(latency_ms=20.0))
    channels = channels_for(model, 1)
    assert isinstance(channels, Channels)
    clock = [0]
    link = ImpairedLink(near, channels, lambda: clock[0])
    link.send(frame(1) + frame(2))
    far.send(frame(3))
    seen = []
    for now_us in range(0, 40_000, 1000):
        clock[0] = now_us
        seen += [(now_us, datagram, source) for datagram, source in link.receive(0)]
        seen += [(now_us, datagram, ()) for datagram, _ in far.receive(0)]
    assert seen == [(10_000, frame(1), ()), (10_000, frame(2), ()), (20_000, frame(3), far.address)]
    assert link.admit(far.address, 0)
    assert channels.statistics()["to_vehicle"]["delivered"] == 1


def test_what_is_on_its_way_arrives_when_the_link_is_closed() -> None:
    near, far = memory_pair()
    channels = channels_for(LinkModel(to_ground=Impairment(latency_ms=100.0)), 1)
    assert channels is not None
    link = ImpairedLink(near, channels, lambda: 0)
    link.send(frame(1))
    assert far.receive(0) == []
    link.close()
    link.close()
    assert [datagram for datagram, _ in far.receive(0)] == [frame(1)]
    with pytest.raises(LinkError):
        link.receive(0)


def test_a_link_has_outages_by_the_flight_time_of_its_vehicle() -> None:
    near, far = memory_pair()
    outage = Impairment(outages=(Outage(start_s=1.0, duration_s=1.0),))
    channels = channels_for(LinkModel(to_ground=outage), 1)
    assert channels is not None
    clock = [5_000_000]
    link = ImpairedLink(near, channels, lambda: clock[0])
    link.send(frame(1))
    link.flight_time_s = lambda: 1.5
    link.send(frame(2))
    link.flight_time_s = lambda: 2.5
    link.send(frame(3))
    assert [datagram for datagram, _ in far.receive(0)] == [frame(1), frame(3)]
