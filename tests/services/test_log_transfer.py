"""The LOG_* messages: the server by itself, the client against it, and clients that behave like others' do."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.services.files import Folder, MemoryFiles
from mavsitl.services.log_transfer import CHUNK_BYTES, PACKET_BYTES, LogClient, LogEntry, LogFile, LogServer, TreeLogs
from tests.services.lossy import CLIENT, SERVER, LossyLink
from tests.services.test_ftp import content, handles

OTHER = (250, 191)
ALL = 0xFFFF
REST = 0xFFFFFFFF


class Vehicle:
    """Logs in dated folders, as PX4 keeps them."""

    def __init__(self, root: Path, sizes: Sequence[int]) -> None:
        self.root = root
        self.files: list[bytes] = []
        for n, size in enumerate(sizes):
            self.add(n, size)
        self.server = LogServer(TreeLogs(Folder(root)))
        self.now_us = 1_000_000
        self.server.step(self.now_us)

    def add(self, n: int, size: int) -> Path:
        path = self.root / f"2026-01-{30 - n:02d}" / f"{n:02d}_00_00.ulg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content(size, n + 1))
        os.utime(path, (1_700_000_000 + n, 1_700_000_000 + n))
        self.files.append(content(size, n + 1))
        return path

    def send(self, message: Any, sender: tuple[int, int] = CLIENT) -> list[Any]:
        (frame,) = parse(encode(message, 0, *sender))
        return self.wire(self.server.receive(frame.message, sender, self.now_us))

    def wire(self, messages: Any) -> list[Any]:
        return [frame.message for message in messages for frame in parse(encode(message, 0, *SERVER))]

    def run(self, seconds: float) -> list[Any]:
        out: list[Any] = []
        for _ in range(round(seconds * 250)):
            self.now_us += 4_000
            out += self.wire(self.server.step(self.now_us))
        return out

    def list(self, start: int = 0, end: int = ALL) -> list[Any]:
        return self.send(mavlink.MAVLink_log_request_list_message(*SERVER, start, end)) + self.run(0.2)

    def ask(self, log_id: int, offset: int, count: int, sender: tuple[int, int] = CLIENT) -> None:
        assert self.send(mavlink.MAVLink_log_request_data_message(*SERVER, log_id, offset, count), sender) == []


def joined(packets: Sequence[Any]) -> bytes:
    """The data of packets that follow one another."""
    data = b""
    for packet in packets:
        assert packet.ofs == packets[0].ofs + len(data)
        data += bytes(packet.data[: packet.count])
    return data


@pytest.fixture
def vehicle(tmp_path: Path) -> Iterator[Vehicle]:
    before = handles()
    made = Vehicle(tmp_path, (1000, 0, 180, 100_000))
    yield made
    made.server.close()
    assert handles() == before


def test_list(vehicle: Vehicle) -> None:
    (vehicle.root / "notes.txt").write_bytes(b"no log")
    (vehicle.root / "link.ulg").symlink_to("notes.txt")
    entries = vehicle.list()
    assert [(e.id, e.num_logs, e.last_log_num, e.time_utc, e.size) for e in entries] == [
        (n, 4, 3, 1_700_000_000 + n, size) for n, size in enumerate((1000, 0, 180, 100_000))
    ]


def test_a_part_of_the_list_is_of_the_same_list(vehicle: Vehicle) -> None:
    vehicle.list()
    early = vehicle.add(9, 50)
    os.utime(early, (1, 1))
    assert [(e.id, e.num_logs, e.size) for e in vehicle.list(1, 2)] == [(1, 4, 0), (2, 4, 180)]
    assert [(e.id, e.size) for e in vehicle.list(3, 3)] == [(3, 100_000)]
    assert vehicle.list(4, 9) == vehicle.list(3, 2) == []
    assert [e.size for e in vehicle.list()] == [50, 1000, 0, 180, 100_000]


def test_without_logs_there_is_an_answer(tmp_path: Path) -> None:
    for server in (LogServer(TreeLogs(Folder(tmp_path))), LogServer(TreeLogs(Folder(tmp_path / "none")))):
        request = mavlink.MAVLink_log_request_list_message(*SERVER, 0, ALL)
        (entry,) = server.receive(request, CLIENT, 0)
        assert (entry.id, entry.num_logs, entry.last_log_num, entry.size) == (0, 0, 0, 0)


def test_asking_often_does_not_read_the_folder_often(vehicle: Vehicle) -> None:
    vehicle.list()
    vehicle.add(9, 50)
    assert vehicle.list()[0].num_logs == 4
    vehicle.run(1.0)
    assert vehicle.list()[0].num_logs == 5


def test_lists_are_paced(tmp_path: Path) -> None:
    vehicle = Vehicle(tmp_path, [10] * 30)
    vehicle.run(1.0)
    vehicle.send(mavlink.MAVLink_log_request_list_message(*SERVER, 0, ALL))
    assert len(vehicle.run(0.004)) == LogServer.MAX_PACKETS_PER_STEP
    assert len(vehicle.run(0.008)) == 8
    assert len(vehicle.run(1.0)) == 6


def test_data(vehicle: Vehicle) -> None:
    vehicle.list()
    vehicle.ask(0, 0, REST)
    packets = vehicle.run(1.0)
    assert joined(packets) == vehicle.files[0]
    assert [packet.count for packet in packets] == [90] * 11 + [10]
    assert {packet.id for packet in packets} == {0}
    assert bytes(packets[-1].data[10:]) == bytes(80)
    vehicle.ask(0, 123, 90)
    assert joined(vehicle.run(1.0)) == vehicle.files[0][123:213]
    vehicle.ask(0, 0, 91)  # only whole packets, but for the end: a short one would mean the end
    assert [packet.count for packet in vehicle.run(1.0)] == [90, 90]


def test_data_without_a_list(vehicle: Vehicle) -> None:
    vehicle.ask(0, 0, REST)
    assert joined(vehicle.run(1.0)) == vehicle.files[0]


def test_the_end_is_a_packet_that_is_not_full(vehicle: Vehicle) -> None:
    """QGroundControl waits for one; MAVSDK asks for what there is and no more, and gets just that."""
    vehicle.ask(2, 0, CHUNK_BYTES)
    assert [(packet.ofs, packet.count) for packet in vehicle.run(1.0)] == [(0, 90), (90, 90), (180, 0)]
    vehicle.ask(2, 0, 180)
    assert [(packet.ofs, packet.count) for packet in vehicle.run(1.0)] == [(0, 90), (90, 90)]
    for offset in (180, 181, REST):
        vehicle.ask(2, offset, 90)
        assert [(packet.ofs, packet.count) for packet in vehicle.run(1.0)] == [(offset, 0)]
    vehicle.ask(1, 0, REST)
    assert [(packet.id, packet.count) for packet in vehicle.run(1.0)] == [(1, 0)]


def test_logs_that_are_not_there(vehicle: Vehicle) -> None:
    for log_id in (4, 1000, ALL):
        vehicle.ask(log_id, 0, REST)
        assert vehicle.run(0.5) == []
    (vehicle.root / "2026-01-30" / "00_00_00.ulg").unlink()
    vehicle.ask(0, 0, REST)
    assert vehicle.run(0.5) == []


def test_a_log_that_grows_is_as_long_as_it_was_listed(vehicle: Vehicle) -> None:
    vehicle.list()
    with (vehicle.root / "2026-01-30" / "00_00_00.ulg").open("ab") as log:
        log.write(bytes(5000))
    vehicle.ask(0, 0, REST)
    assert joined(vehicle.run(1.0)) == vehicle.files[0]


def test_a_new_request_replaces_the_old_one(vehicle: Vehicle) -> None:
    vehicle.ask(3, 0, REST)
    assert len(vehicle.run(0.1)) == 100
    vehicle.ask(3, 90_000, 180)
    assert [packet.ofs for packet in vehicle.run(1.0)] == [90_000, 90_090]
    vehicle.ask(3, 0, REST)
    vehicle.run(0.1)
    vehicle.ask(0, 0, 90)
    assert [packet.id for packet in vehicle.run(1.0)] == [0]
    assert vehicle.server.open_files == 1


def test_end(vehicle: Vehicle) -> None:
    vehicle.ask(3, 0, REST)
    assert len(vehicle.run(0.1)) == 100
    vehicle.send(mavlink.MAVLink_log_request_end_message(*SERVER))
    assert vehicle.run(1.0) == []
    assert vehicle.server.open_files == 0


def test_the_end_of_another_client_is_not_ours(vehicle: Vehicle) -> None:
    vehicle.ask(0, 0, REST)
    vehicle.send(mavlink.MAVLink_log_request_end_message(*SERVER), OTHER)
    assert joined(vehicle.run(1.0)) == vehicle.files[0]


def test_several_clients_share_the_pace(vehicle: Vehicle) -> None:
    vehicle.ask(3, 0, REST)
    vehicle.ask(2, 0, 180, OTHER)
    packets = vehicle.run(0.1)
    assert len(packets) == 100
    assert joined([packet for packet in packets if packet.id == 2]) == vehicle.files[2]
    for system in range(1, 50):
        vehicle.ask(3, 0, REST, (system, 1))
    assert vehicle.server.open_files == LogServer.MAX_PEERS
    vehicle.run(0.1)


def test_files_are_closed_when_nobody_asks(vehicle: Vehicle) -> None:
    vehicle.ask(0, 0, REST)
    vehicle.run(9.9)
    assert vehicle.server.open_files == 1
    vehicle.run(0.2)
    assert vehicle.server.open_files == 0


def test_erase_is_refused_with_a_reason(vehicle: Vehicle) -> None:
    vehicle.ask(3, 0, REST)
    (text,) = vehicle.send(mavlink.MAVLink_log_erase_message(*SERVER), OTHER)
    assert text.text == "Erase logs refused: logs are read-only"
    assert len(vehicle.run(0.1)) == 100  # nobody's download stops
    assert len(list(vehicle.root.rglob("*.ulg"))) == 4


def test_erase(tmp_path: Path) -> None:
    vehicle = Vehicle(tmp_path, (100, 200))

    def erase() -> bool:
        for path in tmp_path.rglob("*.ulg"):
            path.unlink()
        return True

    vehicle.server = LogServer(TreeLogs(Folder(tmp_path), erase=erase))
    vehicle.ask(0, 0, REST)
    assert vehicle.send(mavlink.MAVLink_log_erase_message(*SERVER)) == []
    assert vehicle.run(0.5) == []
    assert [entry.num_logs for entry in vehicle.list()] == [0]


def test_what_is_found(tmp_path: Path) -> None:
    deep = tmp_path / "a" / "b" / "c" / "d"
    deep.mkdir(parents=True)
    (deep / "too_deep.ulg").write_bytes(b"1")
    (deep.parent / "deep.ulg").write_bytes(b"1")
    assert [log.path for log in TreeLogs(Folder(tmp_path)).logs()] == [("a", "b", "c", "deep.ulg")]
    files = MemoryFiles({f"{n:04d}.ulg": b"" for n in range(1500)})
    assert len(TreeLogs(files).logs()) == TreeLogs.MAX_LOGS
    assert TreeLogs(MemoryFiles({"x/y.ulg": b"12"}), ("x",)).logs() == [LogFile(("x", "y.ulg"), 0, 2)]


log_messages = st.one_of(
    st.builds(
        mavlink.MAVLink_log_request_data_message,
        st.just(1),
        st.just(1),
        st.one_of(st.integers(0, 5), st.integers(0, 0xFFFF)),
        st.one_of(st.integers(0, 2000), st.integers(0, REST)),
        st.one_of(st.integers(0, 2000), st.integers(0, REST)),
    ),
    st.builds(
        mavlink.MAVLink_log_request_list_message,
        st.just(1),
        st.just(1),
        st.integers(0, 0xFFFF),
        st.integers(0, 0xFFFF),
    ),
    st.builds(mavlink.MAVLink_log_request_end_message, st.just(1), st.just(1)),
    st.builds(mavlink.MAVLink_log_erase_message, st.just(1), st.just(1)),
    st.builds(mavlink.MAVLink_log_data_message, st.just(0), st.just(0), st.integers(0, 255), st.just(bytes(90))),
)


@settings(max_examples=40)
@given(st.lists(st.tuples(log_messages, st.integers(1, 8), st.integers(0, 3_000_000)), max_size=30))
def test_whatever_comes_is_answered_within_bounds(story: list[tuple[Any, int, int]]) -> None:
    files = MemoryFiles({"a.ulg": content(1000), "b.ulg": content(90), "c.ulg": b""})
    server, now_us = LogServer(TreeLogs(files)), 0
    for message, system, wait_us in story:
        assert len(server.receive(message, (system, 1), now_us)) <= 1
        now_us += wait_us
        out = server.step(now_us)
        assert len(out) <= LogServer.MAX_PACKETS_PER_STEP
        for sent in out:
            assert len(encode(sent, 0, 1, 1)) <= 120
        assert server.open_files <= LogServer.MAX_PEERS


@given(
    st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, 1200), st.integers(0, 255), st.integers(0, 3), st.integers(0, 5)),
        max_size=30,
    )
)
def test_a_hostile_vehicle_does_not_break_the_client(story: list[tuple[int, int, int, int, int]]) -> None:
    client, now_us = LogClient(SERVER), 0
    client.download(LogEntry(1, 0, 1000))
    lister = LogClient(SERVER)
    lister.list()
    for log_id, offset, count, entry_id, num_logs in story:
        now_us += 10_000
        data = mavlink.MAVLink_log_data_message(log_id, offset, count, bytes(range(90)))
        assert len(client.receive(data, SERVER, now_us)) + len(client.step(now_us)) <= 2
        entry = mavlink.MAVLink_log_entry_message(entry_id, num_logs, 7, 1, 2)
        lister.receive(entry, SERVER, now_us)
        lister.step(now_us)
        assert lister.entries is None or len(lister.entries) <= 5


# ---------------------------------------------------------------------------------------------- client and server


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_list_over_a_link(tmp_path: Path, loss: float) -> None:
    vehicle = Vehicle(tmp_path, list(range(100, 125)))
    client = LogClient(SERVER)
    link = LossyLink(vehicle.server, client, loss)
    client.list()
    seconds = link.run(lambda: not client.busy)
    expected = [LogEntry(n, 1_700_000_000 + n, 100 + n) for n in range(25)]
    assert client.entries == tuple(expected)
    assert seconds < (0.1 if loss == 0.0 else 3.0)


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_an_empty_list_over_a_link(tmp_path: Path, loss: float) -> None:
    client = LogClient(SERVER)
    link = LossyLink(LogServer(TreeLogs(Folder(tmp_path))), client, loss, seed=3)
    client.list()
    link.run(lambda: not client.busy)
    assert client.entries == ()


@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("size", [0, 1, 90, 180, 1000, CHUNK_BYTES, CHUNK_BYTES + 1, 120_000])
def test_download_over_a_link(tmp_path: Path, size: int, loss: float) -> None:
    vehicle = Vehicle(tmp_path, (500, size))
    client = LogClient(SERVER)
    link = LossyLink(vehicle.server, client, loss, seed=size + 1)
    client.download(LogEntry(1, 0, size))
    seconds = link.run(lambda: not client.busy)
    assert client.data == vehicle.files[1]
    assert seconds < (0.1 + size / 70_000 if loss == 0.0 else 5.0 + size / 12_000)
    link.loss = 0.0
    link.run(lambda: vehicle.server.open_files == 0, 12.0)


def test_a_silent_vehicle_is_given_up(vehicle: Vehicle) -> None:
    client = LogClient(SERVER)
    link = LossyLink(vehicle.server, client, 1.0)
    for start in (client.list, lambda: client.download(LogEntry(0, 0, 1000))):
        start()
        link.run(lambda: not client.busy)
        assert client.entries is None
        assert client.data is None


def test_one_thing_at_a_time() -> None:
    client = LogClient(limit_bytes=100)
    client.list()
    with pytest.raises(RuntimeError):
        client.list()
    client.cancel()
    (end,) = client.step(0)
    assert type(end).id == mavlink.MAVLINK_MSG_ID_LOG_REQUEST_END
    assert not client.step(1)
    with pytest.raises(ValueError, match="101"):
        client.download(LogEntry(0, 0, 101))


# ------------------------------------------------------------------------------------------- like others' clients


class ChunkClient:
    """Asks as MAVSDK and QGroundControl do: 512 packets at once, then the first gap, after half a second of silence."""

    def __init__(self, size: int, whole_chunks: bool) -> None:
        self.size = size
        self.whole_chunks = whole_chunks
        """QGroundControl asks past the end and waits for the packet that is not full; MAVSDK does neither."""
        self.data = bytearray(size)
        self.have: set[int] = set()
        self.ended = not whole_chunks
        self.chunk = 0
        self.quiet_us = 0

    @property
    def done(self) -> bool:
        return self.ended and len(self.have) == -(-self.size // PACKET_BYTES)

    def _missing(self) -> list[int]:
        last = 512 * (self.chunk + 1)
        bins = last if self.whole_chunks and not self.ended else min(last, -(-self.size // PACKET_BYTES))
        return [n for n in range(512 * self.chunk, bins) if n not in self.have]

    def _ask(self) -> list[Any]:
        missing = self._missing()
        if not missing:
            self.chunk += 1
            missing = self._missing()
            if not missing:
                return []
        stop = next((n for n in range(missing[0], missing[-1] + 1) if n in self.have), missing[-1] + 1)
        count = (stop - missing[0]) * PACKET_BYTES
        if not self.whole_chunks:
            count = min(count, self.size - missing[0] * PACKET_BYTES)
        return [mavlink.MAVLink_log_request_data_message(*SERVER, 0, missing[0] * PACKET_BYTES, count)]

    def receive(self, message: Any, sender: tuple[int, int], now_us: int) -> list[Any]:
        self.quiet_us = now_us
        assert message.ofs % PACKET_BYTES == 0
        if message.count < PACKET_BYTES:
            assert message.ofs + message.count == self.size
            self.ended = True
        if message.count:
            self.have.add(message.ofs // PACKET_BYTES)
            self.data[message.ofs : message.ofs + message.count] = bytes(message.data[: message.count])
        return self._ask() if not self.done and not self._missing() else []

    def step(self, now_us: int) -> list[Any]:
        if self.done or (self.quiet_us and now_us - self.quiet_us < 500_000):
            return []
        self.quiet_us = now_us
        return self._ask()


@pytest.mark.parametrize("whole_chunks", [False, True], ids=["MAVSDK", "QGroundControl"])
@pytest.mark.parametrize("size", [100, 90, CHUNK_BYTES, 100_000])
def test_chunk_clients_finish_without_a_timeout(tmp_path: Path, size: int, whole_chunks: bool) -> None:
    vehicle = Vehicle(tmp_path, (size,))
    client = ChunkClient(size, whole_chunks)
    link = LossyLink(vehicle.server, client)
    seconds = link.run(lambda: client.done)
    assert bytes(client.data) == vehicle.files[0]
    assert seconds < 0.1 + size / 80_000


@pytest.mark.parametrize("whole_chunks", [False, True], ids=["MAVSDK", "QGroundControl"])
def test_chunk_clients_finish_with_losses(tmp_path: Path, whole_chunks: bool) -> None:
    vehicle = Vehicle(tmp_path, (5_000,))
    client = ChunkClient(5_000, whole_chunks)
    link = LossyLink(vehicle.server, client, 0.2)
    link.run(lambda: client.done)
    assert bytes(client.data) == vehicle.files[0]
