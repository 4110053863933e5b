"""What `parse` makes of datagrams that are not one clean frame."""

from __future__ import annotations

import pytest
from fastcrc import crc16
from hypothesis import given, settings
from hypothesis import strategies as st

from mavsitl import codec
from mavsitl.codec import MAX_DATAGRAM_BYTES, MAX_REJECTED, Counters, Parsed, encode, parse
from mavsitl.dialect import mavlink
from tests.wire.reference import CLASSES, address_of, assert_same_message, frame_v1, frame_v2, pymavlink

HEARTBEAT = mavlink.MAVLink_heartbeat_message
MESSAGE = HEARTBEAT(2, 12, 209, 0x60000, 4, 3)
GOOD = encode(MESSAGE, 0, 1, 1)

one_frame = st.builds(
    lambda message_class, payload: frame_v2(message_class, payload[: message_class.unpacker.size]),
    st.sampled_from(CLASSES),
    st.binary(min_size=1, max_size=60),
)
without_magic = st.binary(max_size=40).map(lambda octets: octets.replace(b"\xfd", b"").replace(b"\xfe", b""))


def check_books(datagram: bytes, frames: Parsed, counters: Counters) -> None:
    """Each byte is in one good frame or skipped; each magic byte outside good frames is refused once."""
    position = 0
    outside = bytearray()
    for frame in frames:
        raw = frame.raw
        found = datagram.index(raw, position)
        outside += datagram[position:found]
        position = found + len(raw)
    outside += datagram[position:]
    assert counters.frames == len(frames)
    assert counters.skipped_bytes == len(outside)
    magic = outside.count(0xFD) + outside.count(0xFE)
    if counters.abandoned:
        assert counters.rejected == MAX_REJECTED <= magic
    else:
        assert counters.rejected == magic


@given(st.binary(max_size=400) | st.lists(st.sampled_from([0xFD, 0xFE, 0x00, 0x01, 0xFF]), max_size=400).map(bytes))
@settings(max_examples=200, deadline=None)
def test_random_bytes(datagram: bytes) -> None:
    counters = Counters()
    check_books(datagram, parse(datagram, counters), counters)


@given(st.lists(one_frame, min_size=1, max_size=6), st.data())
@settings(max_examples=200, deadline=None)
def test_damaged_streams(wire: list[bytes], data: st.DataObject) -> None:
    datagram = bytearray(b"".join(wire))
    for position in data.draw(st.lists(st.integers(0, len(datagram) - 1), max_size=4)):
        datagram[position] ^= 1 << data.draw(st.integers(0, 7))
    first = data.draw(st.integers(0, 3))
    damaged = bytes(datagram[first : data.draw(st.integers(first, len(datagram)))])
    counters = Counters()
    check_books(damaged, parse(damaged, counters), counters)


@given(st.lists(st.tuples(without_magic, one_frame), max_size=6), without_magic)
@settings(max_examples=100, deadline=None)
def test_frames_between_garbage_are_all_found(parts: list[tuple[bytes, bytes]], rest: bytes) -> None:
    datagram = b"".join(garbage + wire for garbage, wire in parts) + rest
    counters = Counters()
    frames = parse(datagram, counters)
    assert [frame.raw for frame in frames] == [wire for _, wire in parts]
    assert counters.rejected == 0
    check_books(datagram, frames, counters)


@given(st.integers(0, 8 * len(GOOD) - 1))
@settings(max_examples=200, deadline=None)
def test_one_flipped_bit_never_passes(bit: int) -> None:
    damaged = bytearray(GOOD)
    damaged[bit // 8] ^= 1 << bit % 8
    assert parse(bytes(damaged)) == []


@given(one_frame, st.integers(0, 8), st.data())
@settings(max_examples=300, deadline=None)
def test_the_short_way_finds_what_the_search_finds(wire: bytes, changes: int, data: st.DataObject) -> None:
    datagram = bytearray(wire)
    for _ in range(changes):
        datagram[data.draw(st.integers(0, min(12, len(datagram) - 1)))] = data.draw(st.integers(0, 255))
    datagram += data.draw(st.sampled_from([b"", b"\0", wire]))
    quick, slow = Counters(), Counters()
    found = parse(bytes(datagram), quick)
    searched = codec._search(bytes(datagram), slow)
    assert quick == slow
    assert [(frame.raw, frame.message_id, *address_of(frame)) for frame in found] == [
        (frame.raw, frame.message_id, *address_of(frame)) for frame in searched
    ]


def test_the_residue_is_that_of_the_right_checksum_and_of_no_other() -> None:
    """For every state that a frame may leave before its CRC_EXTRA; a checksum is two bytes taken in one by one."""
    for extra in (0, 1, 50, 254, 255):
        residues = set()
        for state in range(0x10000):
            low, high = checksum = crc16.mcrf4xx(bytes((extra,)), state).to_bytes(2, "little")
            found = crc16.mcrf4xx(checksum, state)
            assert found == codec._RESIDUE_LOW[low] ^ codec._RESIDUE_HIGH[high] ^ codec._residue(0, extra)
            residues.add(crc16.mcrf4xx(b"\x12\x34", state))
        assert len(residues) == 0x10000


def test_an_unfinished_frame_eats_nothing() -> None:
    counters = Counters()
    datagram = b"\xfd\xff\x00" + GOOD * 20
    assert len(parse(datagram, counters)) == 20
    check_books(datagram, parse(datagram), Counters(frames=20, skipped_bytes=3, bad_length=1))
    assert parse(b"\xfd\xff\x00", counters) == []
    assert len(parse(GOOD, counters)) == 1


@pytest.mark.parametrize(
    "pattern",
    [b"\xfd\x00", b"\xfd\xff\x00", b"\xfd\xff\x00\x00\x00", b"\xfd", b"\xfe", b"\xfe\x00", b"\xfe\x6e"],
    ids=lambda pattern: pattern.hex(),
)
def test_a_datagram_of_magic_bytes_costs_a_bounded_number_of_checks(pattern: bytes) -> None:
    datagram = (pattern * MAX_DATAGRAM_BYTES)[:MAX_DATAGRAM_BYTES]
    counters = Counters()
    check_books(datagram, parse(datagram, counters), counters)
    assert (counters.abandoned, counters.rejected) == (1, MAX_REJECTED)


def test_oversize_is_dropped_whole() -> None:
    counters = Counters()
    full = GOOD * (MAX_DATAGRAM_BYTES // len(GOOD) + 1)
    assert parse(full, counters) == []
    assert counters == Counters(oversize=1, skipped_bytes=len(full))
    assert len(parse(full, counters, max_bytes=len(full))) == len(full) // len(GOOD)


@pytest.mark.parametrize(
    ("datagram", "expected"),
    [
        (b"", Counters()),
        (b"noise", Counters(skipped_bytes=5)),
        (GOOD[:-1], Counters(bad_length=1, skipped_bytes=len(GOOD) - 1)),
        (GOOD[:5], Counters(bad_length=1, skipped_bytes=5)),
        (GOOD[:-1] + bytes((GOOD[-1] ^ 1,)), Counters(bad_crc=1, skipped_bytes=len(GOOD))),
        (frame_v2(HEARTBEAT, b"\x01", incompat=2), Counters(incompatible=1, skipped_bytes=13)),
        (frame_v2(HEARTBEAT, b"\x01", incompat=1), Counters(bad_length=1, skipped_bytes=13)),
        (GOOD[:7] + b"\xfa\xff\xff" + GOOD[10:], Counters(unknown_id=1, skipped_bytes=len(GOOD))),
        (b"\xfe\x01\x00\x01\x01\xc9\x05\x00\x00", Counters(unknown_id=1, skipped_bytes=9)),
        (frame_v1(HEARTBEAT, bytes(9))[:-1], Counters(bad_length=1, skipped_bytes=16)),
        (b"\xfe\x00\x00", Counters(bad_length=1, skipped_bytes=3)),
        (frame_v1(HEARTBEAT, bytes(9))[:-1] + b"\x00", Counters(bad_crc=1, skipped_bytes=17)),
    ],
)
def test_each_fault_has_its_counter(datagram: bytes, expected: Counters) -> None:
    counters = Counters()
    assert parse(datagram, counters) == []
    assert counters == expected


def test_counters_add_up_over_datagrams() -> None:
    counters = Counters()
    for _ in range(3):
        parse(GOOD + b"\xfd" + GOOD, counters)
    assert counters == Counters(frames=6, incompatible=3, skipped_bytes=3)


def test_a_signed_frame_is_read_and_marked_but_not_called_verified() -> None:
    signer = pymavlink(4, 9, 8)
    signer.signing.secret_key = bytes(range(32))
    signer.signing.sign_outgoing = True
    wire = MESSAGE.pack(signer)
    assert wire[2] == 1

    counters = Counters()
    first, second = parse(wire + GOOD, counters)
    assert first.signed
    assert not first.message.get_signed()
    assert (first.system_id, first.component_id, first.sequence) == (9, 8, 4)
    assert first.message.get_msgbuf() == wire
    assert_same_message(first.message, pymavlink().decode(bytearray(wire)))
    assert not second.signed
    assert counters == Counters(frames=2)


def test_unknown_ids_are_not_remembered() -> None:
    before = len(codec._kinds)
    for message_id in range(0xFF0000, 0xFF0040):
        parse(GOOD[:7] + message_id.to_bytes(3, "little") + GOOD[10:])
    assert len(codec._kinds) == before
