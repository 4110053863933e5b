"""tlogs that pymavlink's own reader reads, and the digest of the wire."""

from __future__ import annotations

from pathlib import Path

import pytest
from pymavlink import mavutil

from mavsitl.dialect import mavlink
from mavsitl.log.tlog import Direction, TlogWriter, WireHash, frames
from mavsitl.log.ulog import LogError

T0 = 1_700_000_000_000_000


def heartbeat(sysid: int, *, version: int = 2, signed: bool = False) -> bytes:
    sender = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=1)
    if signed:
        sender.signing.secret_key = bytes(range(32))
        sender.signing.sign_outgoing = True
    message = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3)
    return bytes(message.pack(sender, force_mavlink1=version == 1))


def test_a_datagram_is_split_by_length_fields_and_rubbish_left_out() -> None:
    one, two, three = heartbeat(1), heartbeat(2, version=1), heartbeat(3, signed=True)
    assert three[2] & 1
    assert frames(one + two + three) == [one, two, three]
    assert frames(b"\x00\x17" + one + b"xx" + two) == [one, two]
    assert frames(one + two[:-1]) == [one]
    assert frames(b"") == []
    assert frames(b"\xfd") == []


def test_pymavlink_reads_every_frame_with_its_time(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    with TlogWriter(path) as tlog:
        for k in range(5):
            up = Direction.FROM_VEHICLE, T0 + 4000 * k, heartbeat(1) + heartbeat(1, version=1)
            down = Direction.FROM_GROUND, T0 + 4000 * k, heartbeat(255)
            tlog.write([up, down])
        tlog.write([(Direction.FROM_GROUND, T0, b"rubbish")])
        assert tlog.left_out_bytes == 7
    reader = mavutil.mavlogfile(str(path))
    seen = []
    while (message := reader.recv_msg()) is not None:
        assert message.get_type() == "HEARTBEAT"
        seen.append((message.get_srcSystem(), round(message._timestamp * 1e6)))
    reader.close()
    assert seen == [(sysid, T0 + 4000 * k) for k in range(5) for sysid in (1, 1, 255)]


def test_faults_name_the_file(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"none/a\.tlog: cannot be written"):
        TlogWriter(tmp_path / "none" / "a.tlog")
    tlog = TlogWriter(Path("/dev/full"))
    tlog.write([(Direction.FROM_VEHICLE, 0, heartbeat(1))])
    with pytest.raises(LogError, match="/dev/full: cannot be written: No space left"):
        tlog.flush()
    with pytest.raises(LogError, match="/dev/full: cannot be written: it is closed"):
        tlog.flush()
    tlog.close()


def test_the_wire_hash_tells_direction_order_and_where_datagrams_end() -> None:
    def of(*parts: tuple[Direction, bytes]) -> str:
        wire = WireHash()
        wire.update((direction, 0, datagram) for direction, datagram in parts)
        return wire.hexdigest()

    up, down = Direction.FROM_VEHICLE, Direction.FROM_GROUND
    digests = [
        of((up, b"ab"), (down, b"c")),
        of((down, b"c"), (up, b"ab")),
        of((down, b"ab"), (up, b"c")),
        of((up, b"a"), (up, b"b"), (down, b"c")),
        of((up, b"ab"), (down, b"")),
        of(),
    ]
    assert len(set(digests)) == len(digests)
    assert of((up, b"ab"), (down, b"c")) == digests[0]
    # blake2b-128 of 00 02000000 6162 | 01 01000000 63, by b2sum -l 128
    assert digests[0] == "6483ba36b79e283f0ee06cf1a9dceffb"
