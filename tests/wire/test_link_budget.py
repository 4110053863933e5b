"""What each source of a link may say: who floods is stopped, who does not is heard."""

from __future__ import annotations

from collections import Counter

from mavsitl.link.base import Source
from mavsitl.link.budget import (
    MAX_PEERS,
    MAX_STRANGERS,
    PEER_BURST,
    PEER_HZ,
    STRANGER_BURST,
    STRANGER_HZ,
    STRANGERS_BURST,
    STRANGERS_HZ,
    Excess,
    FairQueue,
    InputBudget,
)

SECOND = 1_000_000


def source(number: int) -> Source:
    return "127.0.0.1", 20000 + number


def test_a_stranger_that_floods_leaves_the_others_their_share() -> None:
    budget = InputBudget()
    taken: Counter[Source] = Counter()
    for tick_us in range(0, 2 * SECOND, 10_000):
        for _ in range(200):
            taken[source(0)] += budget.take(source(0), tick_us) is None
        taken[source(1)] += budget.take(source(1), tick_us) is None
    assert taken[source(0)] <= STRANGER_BURST + 2 * STRANGER_HZ
    assert taken[source(1)] == 200


def test_all_strangers_together_are_bounded_and_a_peer_is_none_of_them() -> None:
    budget = InputBudget()
    gcs = source(999)
    budget.peer(gcs)
    reasons: Counter[Excess | None] = Counter()
    heard = 0
    for number in range(40_000):
        now_us = number * 50
        reasons[budget.take(source(number % 300), now_us)] += 1
        if number % 100 == 0:
            heard += budget.take(gcs, now_us) is None
    assert reasons[None] <= STRANGERS_BURST + 2 * STRANGERS_HZ + 1
    assert reasons[Excess.STRANGERS] == 40_000 - reasons[None] - reasons[Excess.SOURCE]
    assert heard == 400


def test_a_peer_that_floods_is_stopped_at_its_own_budget() -> None:
    budget = InputBudget()
    budget.peer(source(0))
    taken = sum(budget.take(source(0), number * 100) is None for number in range(10_000))
    assert taken <= PEER_BURST + PEER_HZ + 1
    budget = InputBudget()
    budget.peer(source(0))
    assert [budget.take(source(0), 0) for _ in range(401)][-1] is Excess.SOURCE


def test_its_tables_are_bounded() -> None:
    budget = InputBudget()
    for number in range(1000):
        budget.take(source(number), number)
        budget.peer(source(number))
        budget.take(source(2000 + number), number)
    assert len(budget._strangers) <= MAX_STRANGERS
    assert len(budget._peers) <= MAX_PEERS


def test_one_of_each_source_in_turn_and_each_in_its_order() -> None:
    queue = FairQueue()
    for number in range(600):
        assert queue.put(bytes((number & 0xFF,)), source(0)) == (number < FairQueue.MAX_WAITING)
    queue.put(b"one", source(1))
    queue.put(b"two", source(1))
    assert len(queue) == FairQueue.MAX_WAITING + 2
    order = [queue.get() for _ in range(5)]
    assert order == [
        (b"\x00", source(0)), (b"one", source(1)), (b"\x01", source(0)), (b"two", source(1)), (b"\x02", source(0)),
    ]  # fmt: skip
    for _ in range(FairQueue.MAX_WAITING - 3):
        queue.get()
    assert len(queue) == 0
    assert not queue._waiting
