"""STATUSTEXT: chunks and back, over links that lose, double and reorder; and the limit on repeated texts."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.services.statustext import (
    CHUNK_BYTES,
    GAP,
    MAX_TEXT_BYTES,
    Joiner,
    Text,
    TextLimiter,
    chunks,
    printable,
)

PEER = (1, 1)
SECOND = 1_000_000
ASCII = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=400)


def wire(message: Any) -> Any:
    (frame,) = parse(encode(message, 0, *PEER))
    return frame.message


def sent(text: str, text_id: int = 7, severity: int = 4) -> list[Any]:
    return [wire(message) for message in chunks(severity, text, text_id)]


def join(joiner: Joiner, messages: Sequence[Any], now_us: int = 0) -> list[str]:
    return [text.text for message in messages for text in joiner.receive(message, PEER, now_us)]


def letters(count: int) -> str:
    return "".join(chr(ord("a") + k % 26) for k in range(count))


@pytest.mark.parametrize(
    ("length", "lengths"),
    [(0, [0]), (1, [1]), (50, [50]), (51, [50, 1]), (99, [50, 49]), (100, [50, 50, 0]), (149, [50, 50, 49])],
)
def test_the_last_chunk_is_the_one_not_full(length: int, lengths: list[int]) -> None:
    messages = sent(letters(length))
    assert [len(message.text) for message in messages] == lengths
    assert [message.chunk_seq for message in messages] == list(range(len(lengths)))
    assert {message.id for message in messages} == {7 if len(lengths) > 1 else 0}
    assert {message.severity for message in messages} == {4}
    assert join(Joiner(), messages) == [letters(length)]


def test_what_is_too_long_is_cut_and_still_ends() -> None:
    messages = sent(letters(MAX_TEXT_BYTES + 1000))
    assert len(messages) == 256
    assert join(Joiner(), messages) == [letters(MAX_TEXT_BYTES)]


@pytest.mark.parametrize("text_id", [0, -1, 0x10000])
def test_ids_are_in_range(text_id: int) -> None:
    with pytest.raises(ValueError, match="text_id"):
        chunks(4, "short", text_id)


@given(ASCII)
def test_every_text_comes_back(text: str) -> None:
    assert join(Joiner(), sent(text)) == [text.rstrip()]


@given(st.text(max_size=200))
def test_only_printable_ascii_goes_out(text: str) -> None:
    for message in chunks(4, text, 1):
        assert all(0x20 <= octet <= 0x7E for octet in message._text_raw)


def test_no_text_of_a_peer_steers_the_terminal() -> None:
    message = wire(mavlink.MAVLink_statustext_message(4, b"a\x1b[2Jb\r\nc\t", 0, 0))
    assert join(Joiner(), [message]) == ["a?[2Jb??c"]
    assert printable("plain\t") == "plain"


@given(st.integers(51, 300), st.randoms())
def test_order_and_repeats_do_not_matter(length: int, rng: random.Random) -> None:
    messages = sent(letters(length))
    arriving = messages + rng.sample(messages, len(messages) // 2)
    rng.shuffle(arriving)
    joiner = Joiner()
    assert join(joiner, arriving) == [letters(length)]
    assert not joiner.step(10 * SECOND)


@pytest.mark.parametrize(
    ("kept", "text"),
    [
        ((0, 1, 2), "A" * 50 + "B" * 50 + "C" * 50 + GAP),
        ((0, 1, 3), "A" * 50 + "B" * 50 + GAP + "D"),
        ((0, 3), "A" * 50 + GAP + "D"),
        ((1, 2, 3), GAP + "B" * 50 + "C" * 50 + "D"),
        ((3,), GAP + "D"),
        ((1,), GAP + "B" * 50 + GAP),
    ],
)
def test_missing_chunks_are_shown_after_the_time_out(kept: tuple[int, ...], text: str) -> None:
    messages = sent("A" * 50 + "B" * 50 + "C" * 50 + "D")
    joiner = Joiner(timeout_us=SECOND)
    assert join(joiner, [messages[number] for number in kept], now_us=5) == []
    assert not joiner.step(SECOND + 4)
    assert joiner.step(SECOND + 5) == [Text(PEER, 4, text, False)]
    assert not joiner.step(9 * SECOND)


def test_the_time_out_counts_from_the_newest_chunk() -> None:
    joiner = Joiner(timeout_us=SECOND)
    messages = sent(letters(120))
    join(joiner, messages[:1], 0)
    join(joiner, messages[1:2], 900_000)
    assert not joiner.step(1_500_000)
    assert join(joiner, messages[2:], 1_600_000) == [letters(120)]


def test_texts_of_several_senders_and_ids_do_not_mix() -> None:
    joiner = Joiner()
    first, second = sent("A" * 60, 1), sent("B" * 60, 2)
    other = sent("C" * 60, 1)
    ready: list[Text] = []
    for one, two, three in zip(first, second, other, strict=True):
        ready += joiner.receive(one, (1, 1), 0)
        ready += joiner.receive(two, (1, 1), 0)
        ready += joiner.receive(three, (2, 1), 0)
    assert [(text.sender, text.text) for text in ready] == [
        ((1, 1), "A" * 60),
        ((1, 1), "B" * 60),
        ((2, 1), "C" * 60),
    ]


def test_an_id_used_again_is_another_text() -> None:
    joiner = Joiner()
    lost = sent("A" * 120, 1)[:2]
    assert join(joiner, lost) == []
    assert join(joiner, sent("B" * 70, 1)) == ["A" * 100 + GAP, "B" * 70]
    assert join(joiner, sent("C" * 70, 1)) == ["C" * 70]
    assert join(joiner, sent("C" * 70, 1)) == []  # the same once more, at once: a repeat
    assert not joiner.step(SECOND)
    assert join(joiner, sent("C" * 70, 1), 2 * SECOND) == ["C" * 70]


def test_memory_is_bounded_and_nothing_is_lost_unsaid() -> None:
    joiner = Joiner()
    begun = 0
    ready: list[Text] = []
    for system_id in range(1, 40):
        for text_id in range(1, 10):
            begun += 1
            ready += joiner.receive(sent("A" * 60, text_id)[0], (system_id, 1), 0)
    assert begun - len(ready) == Joiner.MAX_SENDERS * Joiner.MAX_TEXTS
    assert len(joiner.step(SECOND)) == Joiner.MAX_SENDERS * Joiner.MAX_TEXTS


def test_the_sender_not_heard_for_longest_gives_way() -> None:
    joiner = Joiner()
    first, second = sent("A" * 60)
    joiner.receive(first, PEER, 0)
    for system_id in range(2, 40):
        given_up = joiner.receive(sent("B" * 60)[0], (system_id, 1), 0)
        assert PEER not in [text.sender for text in given_up]
        joiner.receive(first, PEER, 0)
    assert joiner.receive(second, PEER, 0) == [Text(PEER, 4, "A" * 60, True)]


def test_flush_gives_the_rest() -> None:
    joiner = Joiner()
    join(joiner, sent("done" * 20, 1))
    join(joiner, sent("A" * 60, 2)[:1])
    assert joiner.flush() == [Text(PEER, 4, "A" * 50 + GAP, False)]
    assert not joiner.flush()


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_every_text_is_reported_once_whatever_the_loss(loss: float) -> None:
    rng = random.Random(11)
    joiner = Joiner()
    ready: list[Text] = []
    whole = 0
    for number in range(1, 200):
        text = f"{number:04d} " + letters(55 + number % 90)
        arrived = [message for message in sent(text, number) if rng.random() >= loss]
        whole += len(arrived) == len(sent(text, number))
        for message in arrived:
            ready += joiner.receive(message, PEER, number * 100_000)
        ready += joiner.step(number * 100_000)
    ready += joiner.flush()
    assert sum(text.complete for text in ready) == whole
    assert all(GAP in text.text for text in ready if not text.complete)
    numbers = [text.text[:4] for text in ready if not text.text.startswith(GAP)]
    assert len(numbers) == len(set(numbers))
    assert (whole == 199) == (loss == 0.0)


@given(
    st.lists(
        st.tuples(
            st.integers(0, 255),
            st.binary(max_size=50),
            st.integers(0, 3),
            st.integers(0, 255),
            st.tuples(st.integers(1, 12), st.just(1)),
            st.integers(0, 3 * SECOND),
        ),
        max_size=80,
    )
)
def test_no_input_breaks_it(steps: list[tuple[int, bytes, int, int, tuple[int, int], int]]) -> None:
    joiner = Joiner()
    for severity, data, text_id, number, sender, now_us in steps:
        message = wire(mavlink.MAVLink_statustext_message(severity, data, text_id, number))
        for text in (*joiner.receive(message, sender, now_us), *joiner.step(now_us)):
            assert text.text.isprintable()
            assert len(text.text) <= 256 * CHUNK_BYTES + 257 * len(GAP)
            assert text.complete or GAP in text.text
    assert len(joiner.flush()) <= Joiner.MAX_SENDERS * Joiner.MAX_TEXTS


# --- the limit


def test_what_was_held_back_is_told_by_the_next() -> None:
    limiter = TextLimiter(rate_hz=1.0, burst=2)
    passed = [limiter.admit("gps", f"no fix {k}", k * 100_000) for k in range(15)]
    # Tokens: two at 0, the third after one second.
    assert passed[:2] == ["no fix 0", "no fix 1"]
    assert passed[2:10] == [None] * 8
    assert passed[10] == "no fix 10 (8 more held back)"
    assert passed[11:] == [None] * 4
    assert limiter.admit("gps", "no fix", 60 * SECOND) == "no fix (4 more held back)"
    assert limiter.admit("gps", "no fix", 60 * SECOND) == "no fix"


def test_reasons_do_not_hold_each_other_back_and_are_bounded() -> None:
    limiter = TextLimiter(rate_hz=1.0, burst=1)
    assert limiter.admit("a", "A", 0) == "A"
    assert limiter.admit("a", "A", 0) is None
    assert limiter.admit("b", "B", 0) == "B"
    for number in range(1000):
        limiter.admit(str(number), "x", 0)
        limiter.admit(str(number), "x", 0)
    assert len(limiter._buckets) == TextLimiter.MAX_KEYS
    assert len(limiter._held) == TextLimiter.MAX_KEYS
    assert limiter.admit("a", "A", 0) == "A"  # forgotten, and its count with it
