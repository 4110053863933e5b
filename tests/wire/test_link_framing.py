"""Frames found in a byte stream, however it is cut."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from mavsitl.codec import MAX_DATAGRAM_BYTES, SIGNATURE_BYTES, encode
from mavsitl.dialect import mavlink
from mavsitl.link.framing import LONGEST_FRAME_BYTES, StreamSplitter
from tests.wire.reference import CLASSES, frame_v1, frame_v2

GOOD = encode(mavlink.MAVLink_heartbeat_message(2, 12, 209, 0x60000, 4, 3), 0, 1, 1)
UNKNOWN = b"\xfd\x03\x00\x00\x07\x01\x01\xff\xff\xff" + b"abc" + b"\x00\x00"

payloads = st.binary(min_size=1, max_size=255)
classes = st.sampled_from(CLASSES)
frames = st.one_of(
    st.builds(lambda c, p: frame_v2(c, p[: c.unpacker.size]), classes, payloads),
    st.builds(
        lambda c, p, s: frame_v2(c, p[: c.unpacker.size], incompat=1, signature=s),
        classes,
        payloads,
        st.binary(min_size=SIGNATURE_BYTES, max_size=SIGNATURE_BYTES),
    ),
    st.builds(
        lambda c, p: frame_v1(c, p[: c.unpacker.size]),
        st.sampled_from([c for c in CLASSES if c.id < 256]),
        payloads,
    ),
)
streams = st.lists(frames, min_size=1, max_size=8)
bytes_of_junk = st.binary(max_size=300) | st.lists(st.sampled_from([0xFD, 0xFE, 0, 1]), max_size=300).map(bytes)


def feed(splitter: StreamSplitter, stream: bytes, cuts: list[int]) -> list[bytes]:
    """What comes of a stream that arrives in pieces of these lengths, over and over."""
    datagrams: list[bytes] = []
    begin = piece = 0
    while begin < len(stream):
        end = begin + cuts[piece % len(cuts)]
        datagrams += splitter.feed(stream[begin:end])
        assert splitter.held_bytes < LONGEST_FRAME_BYTES
        begin, piece = end, piece + 1
    return datagrams


cuts = st.lists(st.integers(1, 700), min_size=1, max_size=5)


@given(streams, cuts)
def test_each_frame_is_one_datagram(wire: list[bytes], cuts: list[int]) -> None:
    splitter = StreamSplitter()
    assert feed(splitter, b"".join(wire), cuts) == wire
    assert (splitter.frames, splitter.held_bytes, splitter.junk_run) == (len(wire), 0, 0)


@given(streams, st.lists(st.binary(max_size=60), max_size=8), cuts)
def test_junk_without_magic_goes_by_and_hides_nothing(wire: list[bytes], junk: list[bytes], cuts: list[int]) -> None:
    harmless = [octets.replace(b"\xfd", b"").replace(b"\xfe", b"") for octets in junk] + [b""] * len(wire)
    stream = b"".join(between + frame for between, frame in zip(harmless, wire, strict=False))
    datagrams = feed(StreamSplitter(), stream, cuts)
    assert b"".join(datagrams) == stream
    assert [datagram for datagram in datagrams if datagram in wire] == wire


@given(bytes_of_junk, st.lists(frames, max_size=3).map(b"".join), bytes_of_junk, cuts)
def test_any_bytes_are_kept_in_order_and_held_within_bounds(
    before: bytes, wire: bytes, after: bytes, cuts: list[int]
) -> None:
    splitter = StreamSplitter()
    stream = before + wire + after
    datagrams = feed(splitter, stream, cuts)
    assert b"".join(datagrams) == stream[: len(stream) - splitter.held_bytes]
    assert all(0 < len(datagram) <= MAX_DATAGRAM_BYTES for datagram in datagrams)
    assert splitter.frames <= len(datagrams)


def test_a_damaged_frame_hides_nothing_behind_it() -> None:
    damaged = bytearray(GOOD)
    damaged[12] ^= 1
    splitter = StreamSplitter()
    assert splitter.feed(bytes(damaged) + GOOD) == [bytes(damaged), GOOD]
    assert splitter.frames == 1


def test_a_stray_magic_byte_hides_nothing_behind_it() -> None:
    # The stray byte claims the longest payload of a known message, so the frames wait until that much has come.
    stray = b"\xfd\xff\x00\x00\x00\x01\x01\x00\x00\x00"
    splitter = StreamSplitter()
    assert splitter.feed(stray + GOOD * 5) == []
    assert splitter.feed(GOOD * 10) == [stray] + [GOOD] * 15


def test_a_length_that_grows_into_the_next_frame_is_found_out() -> None:
    longer = bytes((GOOD[0], GOOD[1] + 4)) + GOOD[2:]
    splitter = StreamSplitter()
    assert splitter.feed(longer + GOOD) == [longer, GOOD]
    assert splitter.junk_run == 0


def test_an_unknown_message_passes_whole_where_a_frame_or_nothing_follows() -> None:
    splitter = StreamSplitter()
    assert splitter.feed(UNKNOWN + GOOD + UNKNOWN) == [UNKNOWN, GOOD, UNKNOWN]
    assert splitter.frames == 3
    assert splitter.feed(UNKNOWN + b"x" + GOOD) == [UNKNOWN + b"x", GOOD]
    assert splitter.frames == 4


def test_unknown_incompatible_flags_are_no_frame() -> None:
    odd = GOOD[:2] + b"\x02" + GOOD[3:]
    splitter = StreamSplitter()
    assert splitter.feed(odd[:3]) == [odd[:3]]
    assert splitter.junk_run == 3
    assert splitter.feed(GOOD) == [GOOD]
