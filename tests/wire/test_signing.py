"""Signing: bytes like pymavlink's, checks that no forger can turn against us, and the way through a node."""

from __future__ import annotations

import pickle
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavsitl.codec import Frame, encode, parse
from mavsitl.dialect import mavlink
from mavsitl.node import Node
from mavsitl.signing import (
    FUTURE_UNITS,
    MAX_SETUP_UNITS,
    MAX_STREAMS,
    NEW_STREAM_UNITS,
    SAVE_AHEAD_OF_NEWEST_UNITS,
    SAVE_AHEAD_UNITS,
    Key,
    LinkSigning,
    Signing,
    SigningMode,
    SigningPolicy,
    SigningState,
    Verdict,
    setup_signing,
)
from tests.bench.bench_codec import messages

OCTETS = bytes(range(1, 33))
KEY = Key(OCTETS)
OTHER = Key(bytes(range(101, 133)))
VEHICLE = (1, 1)
GROUND = (255, 190)
NOW = 37 * 10**12  # 10 µs since 2015: in 2026
HEARTBEAT = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
RADIO_STATUS = mavlink.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7)
ALWAYS, UNTRUSTED, OFF = SigningMode.ALWAYS, SigningMode.UNTRUSTED, SigningMode.OFF


class Clock:
    """µs since 2015-01-01, set by hand in units of 10 µs."""

    def __init__(self, units: int = NOW) -> None:
        self.units = units

    def __call__(self) -> int:
        return self.units * 10


def signing_with(
    key: Key | None = KEY, mode: SigningMode = ALWAYS, clock: Clock | None = None, timestamp: int = 0
) -> Signing:
    return Signing(Clock() if clock is None else clock, SigningPolicy(mode), SigningState(key, timestamp))


def signed(
    stamp: int, link_id: int = 0, sender: tuple[int, int] = GROUND, key: Key = KEY, message: Any = HEARTBEAT
) -> bytes:
    return key.sign(encode(message, 0, *sender), link_id, stamp)


def frame_of(data: bytes) -> Frame:
    (frame,) = parse(data)
    return frame


def pymavlink(key: bytes, stamp: int, link_id: int, sender: tuple[int, int]) -> Any:
    peer = mavlink.MAVLink(None, srcSystem=sender[0], srcComponent=sender[1])
    peer.signing.secret_key = key
    peer.signing.timestamp = stamp
    peer.signing.link_id = link_id
    peer.signing.sign_outgoing = True
    return peer


# --- bytes


@pytest.mark.parametrize("message", [*messages(), HEARTBEAT, RADIO_STATUS], ids=lambda message: str(message.msgname))
@pytest.mark.parametrize(("stamp", "link_id"), [(0, 0), (NOW, 1), (2**48 - 1, 255)])
def test_frames_are_those_of_pymavlink(message: Any, stamp: int, link_id: int) -> None:
    theirs = message.pack(pymavlink(OCTETS, stamp, link_id, (7, 9)))
    assert KEY.sign(encode(message, 0, 7, 9), link_id, stamp) == theirs


@given(
    octets=st.binary(min_size=32, max_size=32).filter(any), stamp=st.integers(0, 2**48 - 1), link_id=st.integers(0, 255)
)
def test_any_key_and_stamp_as_pymavlink(octets: bytes, stamp: int, link_id: int) -> None:
    key = Key(octets)
    ours = key.sign(encode(HEARTBEAT, 0, 7, 9), link_id, stamp)
    assert ours == HEARTBEAT.pack(pymavlink(octets, stamp, link_id, (7, 9)))
    assert key.verify(ours)
    assert not OTHER.verify(ours)


def test_pymavlink_believes_us_and_we_believe_pymavlink() -> None:
    signing = signing_with()
    node = Node(*VEHICLE, signing.link(3))
    peer = pymavlink(OCTETS, NOW, 5, GROUND)
    for number in range(20):
        node.send_message(HEARTBEAT)
        (datagram,) = node.datagrams()
        (message,) = peer.parse_buffer(datagram)
        assert message.get_type() == "HEARTBEAT", "bad signature at pymavlink"
        (frame,) = node.receive(mavlink.MAVLink_ping_message(number, 1, 0, 0).pack(peer))
        assert frame.message.time_usec == number
    assert peer.signing.goodsig_count == 20
    assert node.signing is not None
    assert node.signing.counters.good == 20
    assert node.signing.counters.sent == 20


@pytest.mark.parametrize("position", range(len(signed(NOW))))
def test_every_changed_byte_is_noticed(position: int) -> None:
    data = bytearray(signed(NOW))
    data[position] ^= 0x40
    assert not KEY.verify(bytes(data))
    assert signing_with().check(bytes(data)) is Verdict.BAD_SIGNATURE


@given(st.binary(max_size=80))
def test_no_bytes_break_the_check(data: bytes) -> None:
    signing = signing_with()
    assert signing.check(data) is Verdict.BAD_SIGNATURE
    assert signing.check(b"\xfd\x09\x01" + data) is Verdict.BAD_SIGNATURE
    assert signing.streams == 0


@pytest.mark.parametrize(
    "frame",
    [
        b"",
        b"\xfd",
        signed(NOW),  # signed already
        encode(HEARTBEAT, 0, 1, 1)[:-1],
        encode(HEARTBEAT, 0, 1, 1) + b"\0",
        HEARTBEAT.pack(mavlink.MAVLink(None), force_mavlink1=True),
        b"\xfd\x01\0\0\0\1\1\xff\xff\xff\0\0\0",  # no such message
    ],
)
def test_only_unsigned_frames_are_signed(frame: bytes) -> None:
    with pytest.raises(ValueError, match=r"not an unsigned|no message"):
        KEY.sign(frame, 0, NOW)


@pytest.mark.parametrize(("link_id", "stamp"), [(256, 0), (-1, 0), (0, -1), (0, 2**48)])
def test_numbers_that_do_not_fit_are_refused(link_id: int, stamp: int) -> None:
    with pytest.raises(ValueError, match="out of range"):
        KEY.sign(encode(HEARTBEAT, 0, 1, 1), link_id, stamp)


# --- the key


def test_a_key_does_not_show() -> None:
    state = SigningState(KEY, 5)
    signing = signing_with()
    for thing in (KEY, [KEY], state, signing, signing.link(0), SigningPolicy()):
        for text in (repr(thing), str(thing), f"{thing}"):
            assert OCTETS.hex() not in text
            assert repr(OCTETS)[3:20] not in text
            assert "1, 2, 3, 4" not in text
    assert repr(KEY) == "Key(hidden)"
    with pytest.raises(TypeError):
        pickle.dumps(KEY)


@pytest.mark.parametrize("octets", [b"", bytes(31), bytes(32), bytes(33), b"\1" * 31, b"\1" * 33])
def test_keys_have_32_bytes_and_are_not_zero(octets: bytes) -> None:
    with pytest.raises(ValueError, match="32 bytes"):
        Key(octets)


def test_keys_compare_by_content() -> None:
    assert Key(OCTETS) == KEY
    assert hash(Key(OCTETS)) == hash(KEY)
    assert KEY != OTHER
    assert KEY != OCTETS
    # SHA-256 of "abc" is the standard's own example.
    assert Key.from_passphrase("abc").reveal().hex().startswith("ba7816bf8f01cfea414140de5dae2223")


# --- time stamps


def test_a_forged_frame_from_the_far_future_locks_nobody_out() -> None:
    """The attack that shuts a peer out of pymavlink for ever, by one frame of who has no key."""
    forged = signed(2**48 - 16, key=OTHER)
    genuine = [signed(NOW + k) for k in range(3)]
    signing = signing_with()
    assert signing.check(genuine[0]) is Verdict.GOOD
    assert signing.check(forged) is Verdict.BAD_SIGNATURE
    assert signing.check(genuine[1]) is Verdict.GOOD
    other = signing_with()
    assert other.check(forged) is Verdict.BAD_SIGNATURE  # before the stream is known, too
    assert other.check(genuine[2]) is Verdict.GOOD


def test_a_stream_goes_forward_only() -> None:
    signing = signing_with()
    first, second = signed(NOW), signed(NOW + 1)
    assert signing.check(first) is Verdict.GOOD
    assert signing.check(first) is Verdict.REPLAY
    assert signing.check(second) is Verdict.GOOD
    assert signing.check(first) is Verdict.REPLAY
    assert signing.check(signed(NOW + 10)) is Verdict.GOOD
    assert signing.check(signed(NOW + 9)) is Verdict.REPLAY


def test_streams_are_by_system_component_and_link() -> None:
    signing = signing_with()
    assert signing.check(signed(NOW)) is Verdict.GOOD
    for sender, link_id in (((254, 190), 0), ((255, 191), 0), ((255, 190), 1)):
        assert signing.check(signed(NOW - 5, link_id, sender)) is Verdict.GOOD
        assert signing.check(signed(NOW - 5, link_id, sender)) is Verdict.REPLAY


def test_a_new_stream_is_at_most_a_minute_behind() -> None:
    signing = signing_with()
    assert signing.check(signed(NOW - NEW_STREAM_UNITS - 1)) is Verdict.OLD
    assert signing.check(signed(NOW - NEW_STREAM_UNITS)) is Verdict.GOOD
    # A known stream may lag: it is behind nobody but itself.
    assert signing.check(signed(NOW + 1000, link_id=1)) is Verdict.GOOD
    assert signing.check(signed(NOW - NEW_STREAM_UNITS + 1)) is Verdict.GOOD


def test_the_minute_counts_from_the_newest_stamp() -> None:
    signing = signing_with()
    assert signing.check(signed(NOW + 1_000_000, link_id=1)) is Verdict.GOOD
    assert signing.check(signed(NOW + 1_000_000 - NEW_STREAM_UNITS - 1)) is Verdict.OLD
    assert signing.check(signed(NOW + 1_000_000 - NEW_STREAM_UNITS)) is Verdict.GOOD


def test_a_key_holders_wrong_clock_does_not_carry_ours_away() -> None:
    signing = signing_with()
    assert signing.check(signed(NOW + FUTURE_UNITS + 1)) is Verdict.FUTURE
    assert signing.check(signed(NOW + FUTURE_UNITS)) is Verdict.GOOD
    assert signing.check(signed(NOW + FUTURE_UNITS + 1)) is Verdict.FUTURE  # nor step by step
    assert signing.check(signed(NOW + FUTURE_UNITS - NEW_STREAM_UNITS, link_id=1)) is Verdict.GOOD


def test_what_we_send_goes_forward_and_follows_clock_and_peers() -> None:
    clock = Clock()
    signing = signing_with(clock=clock)

    def stamp() -> int:
        return int.from_bytes(signing.sign(encode(HEARTBEAT, 0, *VEHICLE), 0)[-12:-6], "little")

    assert [stamp(), stamp()] == [NOW, NOW + 1]
    clock.units -= 10**9  # the clock went back
    assert stamp() == NOW + 2
    clock.units = NOW + 500
    assert stamp() == NOW + 500
    assert signing.check(signed(NOW + 9000)) is Verdict.GOOD
    assert stamp() == NOW + 9001
    with pytest.raises(ValueError, match="no key"):
        signing_with(None).sign(encode(HEARTBEAT, 0, *VEHICLE), 0)


def test_a_clock_that_goes_back_shuts_nobody_out() -> None:
    clock = Clock()
    signing = signing_with(clock=clock)
    assert signing.check(signed(NOW)) is Verdict.GOOD
    clock.units -= 100 * FUTURE_UNITS
    assert signing.check(signed(NOW + 1)) is Verdict.GOOD


def test_who_has_no_key_cannot_fill_the_table() -> None:
    signing = signing_with()
    for number in range(2000):
        forged = signed(NOW, number % 256, (number // 256 + 1, 1), OTHER)
        assert signing.check(forged) is Verdict.BAD_SIGNATURE
    assert signing.streams == 0


def test_the_table_is_bounded_and_what_is_forgotten_is_not_replayed() -> None:
    signing = signing_with()
    frames = [signed(NOW + k, k % 256, (k // 256 + 1, 1)) for k in range(3 * MAX_STREAMS)]
    assert all(signing.check(frame) is Verdict.GOOD for frame in frames)
    assert signing.streams == MAX_STREAMS
    verdicts = {signing.check(frame) for frame in frames}
    assert verdicts == {Verdict.OLD, Verdict.REPLAY}
    # More streams than places do not lock one another out: who speaks again comes in again.
    assert all(signing.check(signed(NOW + 5000 + k, k)) is Verdict.GOOD for k in range(2 * MAX_STREAMS))


# --- restarts


def stored(signing: Signing) -> SigningState:
    state = signing.unsaved()
    assert state is not None
    signing.saved(state)
    return SigningState.from_bytes(state.to_bytes())


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 400_000)), min_size=1, max_size=60))
def test_nothing_heard_before_a_crash_is_heard_after_it(steps: list[tuple[bool, int]]) -> None:
    clock = Clock()
    signing = signing_with(clock=clock)
    state = stored(signing)
    frames: list[bytes] = []
    newest_sent = 0
    for heard, pause in steps:
        clock.units += pause
        if heard:
            data = signed(clock.units, link_id=len(frames))
            if signing.check(data) is Verdict.GOOD:
                frames.append(data)
        else:
            newest_sent = int.from_bytes(signing.sign(encode(HEARTBEAT, 0, *VEHICLE), 0)[-12:-6], "little")
        kept = signing.unsaved()
        if kept is not None:
            signing.saved(kept)
            state = kept
    again = Signing(clock, SigningPolicy(ALWAYS), state)
    assert all(again.check(data) is Verdict.OLD for data in frames)
    first = int.from_bytes(again.sign(encode(HEARTBEAT, 0, *VEHICLE), 0)[-12:-6], "little")
    assert first > newest_sent
    # A peer that has heard us goes on at once, as pymavlink and the C library do.
    assert again.check(signed(first + 1)) is Verdict.GOOD


def test_it_is_stored_now_and_then() -> None:
    clock = Clock()
    signing = signing_with(clock=clock)
    stores = 0
    for second in range(600):
        clock.units = NOW + second * 100_000
        assert signing.check(signed(clock.units)) is Verdict.GOOD
        signing.sign(encode(HEARTBEAT, 0, *VEHICLE), 0)
        state = signing.unsaved()
        if state is not None:
            assert state.timestamp > clock.units
            assert state.timestamp <= clock.units + SAVE_AHEAD_UNITS + SAVE_AHEAD_OF_NEWEST_UNITS
            signing.saved(state)
            stores += 1
    assert 15 <= stores <= 25
    assert signing.unsaved() is None
    assert signing_with(None).unsaved() is None


def test_crashes_in_a_row_do_not_drive_the_stamps_away() -> None:
    clock = Clock()
    state = SigningState(KEY, 0)
    for _ in range(100):
        signing = Signing(clock, SigningPolicy(ALWAYS), state)
        for _ in range(10):
            signing.sign(encode(HEARTBEAT, 0, *VEHICLE), 0)
        state = signing.unsaved() or state
        clock.units += 200_000  # two seconds
    assert state.timestamp < clock.units + FUTURE_UNITS / 4


def test_an_orderly_end_spends_no_time() -> None:
    clock = Clock()
    signing = signing_with(clock=clock)
    assert signing.check(signed(NOW + 5)) is Verdict.GOOD
    again = Signing(clock, SigningPolicy(ALWAYS), signing.closing_state())
    assert again.check(signed(NOW + 5)) is Verdict.OLD
    assert again.check(signed(NOW + 6)) is Verdict.GOOD


def test_a_clock_that_setup_signing_had_to_set_is_found_again() -> None:
    clock = Clock(0)  # no clock of the day
    signing = signing_with(None, clock=clock)
    signing.set_key(KEY, NOW)
    assert signing.check(signed(NOW)) is Verdict.GOOD
    again = Signing(Clock(0), SigningPolicy(ALWAYS), stored(signing))
    assert again.check(signed(NOW)) is Verdict.OLD
    assert again.check(signed(NOW + SAVE_AHEAD_UNITS + 1)) is Verdict.GOOD


@pytest.mark.parametrize("state", [SigningState(), SigningState(KEY, 0), SigningState(OTHER, MAX_SETUP_UNITS)])
def test_states_come_back_from_bytes(state: SigningState) -> None:
    data = state.to_bytes()
    assert len(data) == 48
    assert SigningState.from_bytes(data) == state
    for position in range(len(data)):
        damaged = bytearray(data)
        damaged[position] ^= 1
        with pytest.raises(ValueError, match="damaged") as caught:
            SigningState.from_bytes(bytes(damaged))
        assert OCTETS.hex() not in str(caught.value)


def test_a_stored_stamp_leaves_room_for_all_that_is_to_be_sent() -> None:
    with pytest.raises(ValueError, match="out of range"):
        SigningState.from_bytes(SigningState(KEY, 2**48 - 1).to_bytes())
    state = SigningState.from_bytes(SigningState(KEY, MAX_SETUP_UNITS).to_bytes())
    signing = Signing(Clock(), SigningPolicy(ALWAYS), state)
    assert KEY.verify(signing.sign(encode(HEARTBEAT, 0, *VEHICLE), 0))


@given(st.binary(max_size=100))
def test_no_bytes_make_a_state_by_accident(data: bytes) -> None:
    with pytest.raises(ValueError, match="damaged"):
        SigningState.from_bytes(data)


# --- policy


@pytest.mark.parametrize(
    ("mode", "has_key", "trusted", "active"),
    [
        (OFF, True, False, False),
        (OFF, False, True, False),
        (UNTRUSTED, True, False, True),
        (UNTRUSTED, True, True, False),
        (UNTRUSTED, False, False, False),
        (ALWAYS, True, False, True),
        (ALWAYS, True, True, True),
        (ALWAYS, False, True, False),
    ],
)
def test_where_signatures_are_demanded(mode: SigningMode, has_key: bool, trusted: bool, active: bool) -> None:
    policy = SigningPolicy(mode)
    assert policy.active(has_key, trusted) is active
    assert policy.accepts_unsigned(mavlink.MAVLINK_MSG_ID_HEARTBEAT, has_key, trusted) is not active
    for message_id in (109, 246, 247):  # RADIO_STATUS, ADSB_VEHICLE, COLLISION
        assert policy.accepts_unsigned(message_id, has_key, trusted)


@pytest.mark.parametrize(
    ("mode", "has_key", "trusted", "verified", "accepted"),
    [
        (OFF, False, True, False, True),
        (OFF, False, False, False, False),  # the first key never comes from a stranger
        (OFF, True, False, False, False),
        (OFF, True, False, True, True),
        (OFF, True, True, False, True),
        (UNTRUSTED, True, True, False, True),
        (UNTRUSTED, True, False, False, False),
        (UNTRUSTED, True, False, True, True),
        (ALWAYS, False, True, False, True),
        (ALWAYS, False, False, False, False),
        (ALWAYS, True, True, False, False),
        (ALWAYS, True, True, True, True),
    ],
)
def test_who_may_set_the_key(mode: SigningMode, has_key: bool, trusted: bool, verified: bool, accepted: bool) -> None:
    assert SigningPolicy(mode).accepts_setup(has_key, trusted, verified) is accepted
    assert not SigningPolicy(mode, locked=True).accepts_setup(has_key, trusted, verified)


# --- through a node


def node_of(signing: Signing, trusted: bool = False, link_id: int = 0) -> tuple[Node, LinkSigning]:
    link = signing.link(link_id, trusted)
    return Node(*VEHICLE, link), link


def test_without_signing_signatures_are_skipped() -> None:
    node = Node(*VEHICLE)
    (frame,) = node.receive(signed(NOW))
    assert frame.signed
    node.send_message(HEARTBEAT)
    (datagram,) = node.datagrams()
    assert not frame_of(datagram).signed


@pytest.mark.parametrize(("key", "mode", "trusted"), [(KEY, OFF, False), (None, ALWAYS, False), (KEY, UNTRUSTED, True)])
def test_where_it_is_off_everything_passes_unsigned(key: Key | None, mode: SigningMode, trusted: bool) -> None:
    node, link = node_of(signing_with(key, mode), trusted)
    assert len(node.receive(signed(NOW, key=OTHER) + encode(HEARTBEAT, 1, *GROUND) + signed(NOW, key=OTHER))) == 3
    node.send_message(HEARTBEAT)
    assert not frame_of(node.datagrams()[0]).signed
    assert link.counters.sent == link.counters.bad_signature == 0


def test_what_is_not_believed_is_counted_and_leaves_no_trace() -> None:
    node, link = node_of(signing_with())
    version1 = HEARTBEAT.pack(mavlink.MAVLink(None, srcSystem=255, srcComponent=190), force_mavlink1=True)
    datagram = b"".join(
        (
            encode(HEARTBEAT, 0, 9, 9),
            version1,
            signed(NOW, sender=(8, 8), key=OTHER),
            signed(NOW),
            signed(NOW),
            signed(NOW - NEW_STREAM_UNITS - 1, link_id=1),
            signed(NOW + FUTURE_UNITS + 1),
            encode(RADIO_STATUS, 0, 51, 68),
            signed(NOW, message=RADIO_STATUS, sender=(51, 69), key=OTHER),
        )
    )
    frames = node.receive(datagram)
    assert [(frame.system_id, frame.component_id) for frame in frames] == [GROUND, (51, 68)]
    assert set(node.sources) == {GROUND, (51, 68)}
    counters = link.counters
    assert (counters.good, counters.unsigned_accepted, counters.unsigned_refused) == (1, 1, 2)
    assert (counters.bad_signature, counters.replayed, counters.old, counters.future) == (2, 1, 1, 1)


def test_combined_datagrams_of_signed_frames_stay_within_their_size() -> None:
    node, _ = node_of(signing_with())
    for _ in range(50):
        node.send_message(HEARTBEAT)
    datagrams = node.datagrams(max_bytes=200, combine=True)
    assert all(len(datagram) <= 200 for datagram in datagrams)
    frames = [frame for datagram in datagrams for frame in parse(datagram)]
    assert len(frames) == 50
    assert all(KEY.verify(frame.raw) for frame in frames)
    assert [frame.sequence for frame in frames] == list(range(50))


def test_a_forwarded_frame_stays_as_it_is() -> None:
    node, link = node_of(signing_with())
    plain, foreign = encode(HEARTBEAT, 77, *GROUND), signed(NOW, key=OTHER)
    node.send_message(HEARTBEAT)
    node.forward(plain)
    node.forward(foreign)
    node.send_message(HEARTBEAT)
    own, first, second, last = node.datagrams()
    assert (first, second) == (plain, foreign)
    assert KEY.verify(own)
    assert KEY.verify(last)
    assert (frame_of(own).sequence, frame_of(last).sequence) == (0, 1)
    assert link.counters.sent == 2


def test_our_own_frames_come_back_without_effect() -> None:
    signing = signing_with()
    node, link = node_of(signing)
    node.send_message(HEARTBEAT)
    (datagram,) = node.datagrams()
    assert node.receive(datagram) == []
    assert node.own_frames == 1
    assert (signing.streams, link.counters.good) == (0, 0)


def test_a_frame_heard_on_one_link_is_no_news_on_another() -> None:
    signing = signing_with()
    first, second = Node(*VEHICLE, signing.link(0)), Node(*VEHICLE, signing.link(1))
    assert len(first.receive(signed(NOW))) == 1
    assert second.receive(signed(NOW)) == []
    first.send_message(HEARTBEAT)
    second.send_message(HEARTBEAT)
    one, two = first.datagrams()[0], second.datagrams()[0]
    assert (one[-13], two[-13]) == (0, 1)
    assert one[-12:-6] != two[-12:-6]


@pytest.mark.parametrize("link_id", [-1, 256])
def test_link_ids_are_a_byte(link_id: int) -> None:
    with pytest.raises(ValueError, match="link_id"):
        signing_with().link(link_id)


# --- SETUP_SIGNING


def test_a_key_is_set_used_changed_and_taken_away() -> None:
    signing = signing_with(None)
    node, link = node_of(signing, trusted=True)
    assert len(node.receive(encode(HEARTBEAT, 0, *GROUND))) == 1
    setup = setup_signing(VEHICLE, KEY, NOW)
    assert node.receive(encode(setup, 0, *GROUND)) == []  # it ends here
    assert signing.has_key
    assert stored(signing).key == KEY
    assert node.receive(encode(HEARTBEAT, 0, *GROUND)) == []
    assert len(node.receive(signed(NOW))) == 1
    node.send_message(HEARTBEAT)
    assert KEY.verify(node.datagrams()[0])

    change = setup_signing(VEHICLE, OTHER, NOW)
    assert node.receive(encode(change, 0, *GROUND)) == []  # unsigned
    assert signing.unsaved() is None
    assert node.receive(signed(NOW + 1, message=change)) == []
    assert stored(signing).key == OTHER
    assert node.receive(signed(NOW + 2)) == []  # the old key
    assert len(node.receive(signed(NOW + 3, key=OTHER))) == 1

    assert node.receive(signed(NOW + 4, key=OTHER, message=setup_signing(VEHICLE, None, NOW))) == []
    assert not signing.has_key
    assert stored(signing).key is None
    assert len(node.receive(encode(HEARTBEAT, 0, *GROUND))) == 1
    node.send_message(HEARTBEAT)
    assert not frame_of(node.datagrams()[0]).signed
    assert (link.counters.setups, link.counters.setups_refused) == (3, 1)


@pytest.mark.parametrize("target", [(1, 1), (1, 0), (0, 0), (0, 1)])
def test_setups_for_us_are_obeyed(target: tuple[int, int]) -> None:
    signing = signing_with(None)
    node, _ = node_of(signing, trusted=True)
    assert node.receive(encode(setup_signing(target, KEY, NOW), 0, *GROUND)) == []
    assert signing.has_key


@pytest.mark.parametrize(
    ("target", "trusted", "locked", "stamp"),
    [
        ((2, 1), True, False, NOW),
        ((1, 2), True, False, NOW),
        ((1, 1), False, False, NOW),
        ((1, 1), True, True, NOW),
        ((1, 1), True, False, MAX_SETUP_UNITS + 1),
        ((1, 1), True, False, 2**64 - 1),
    ],
)
def test_other_setups_are_dropped(target: tuple[int, int], trusted: bool, locked: bool, stamp: int) -> None:
    signing = signing_with(None)
    signing.policy.locked = locked
    node, link = node_of(signing, trusted)
    assert node.receive(encode(setup_signing(target, KEY, stamp), 0, *GROUND)) == []
    assert not signing.has_key
    assert link.counters.setups_refused == 1


def test_a_setup_is_not_replayed() -> None:
    signing = signing_with()
    node, link = node_of(signing)
    change = signed(NOW, message=setup_signing(VEHICLE, OTHER, NOW))
    back = signed(NOW + 1, key=OTHER, message=setup_signing(VEHICLE, KEY, NOW))
    for data in (change, back, change, change):
        assert node.receive(data) == []
    assert link.counters.setups == 2
    assert signing.check(signed(NOW + 2)) is Verdict.GOOD  # the key is the first one still


def test_pymavlink_sets_our_key_and_both_go_on() -> None:
    signing = signing_with(None)
    node, _ = node_of(signing, trusted=True)
    peer = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    peer.robust_parsing = True
    node.receive(mavlink.MAVLink_setup_signing_message(*VEHICLE, list(OCTETS), NOW - 1000).pack(peer))
    peer.signing.secret_key = OCTETS
    peer.signing.timestamp = NOW - 1000
    peer.signing.sign_outgoing = True
    for _ in range(3):
        node.send_message(HEARTBEAT)
        (message,) = peer.parse_buffer(node.datagrams()[0])
        assert message.get_type() == "HEARTBEAT"
        assert len(node.receive(HEARTBEAT.pack(peer))) == 1


def test_a_restarted_vehicle_and_pymavlink_find_together_at_once() -> None:
    clock = Clock()
    signing = signing_with(clock=clock)
    peer = pymavlink(OCTETS, NOW, 0, GROUND)
    state = stored(signing)
    for restart in range(5):
        node, _ = node_of(signing)
        node.send_message(HEARTBEAT)
        (message,) = peer.parse_buffer(node.datagrams()[0])
        assert message.get_type() == "HEARTBEAT", f"start {restart}"
        assert len(node.receive(HEARTBEAT.pack(peer))) == 1, f"start {restart}"
        clock.units += 100_000
        signing = Signing(clock, SigningPolicy(ALWAYS), state)
        state = signing.unsaved() or state


def test_a_stamp_before_the_epoch_sets_no_key() -> None:
    signing = signing_with(None)
    with pytest.raises(ValueError, match="timestamp"):
        signing.set_key(KEY, -1)
    assert not signing.has_key
