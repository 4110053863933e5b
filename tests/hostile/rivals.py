"""Strangers and rivals, in memory and in simulated time: `python -m tests.hostile.rivals`.

Spoofed sources, replays, a second ground station that fights the first, paths that lead out of the card, transfers
that are too long, storms of lists: what the vehicle answers, to whom, how much, and what it keeps.
"""

from __future__ import annotations

import os
import socket
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from mavsitl_vehicle.autopilot.parameters import TABLE
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.drivers import Intake, Tap
from mavsitl.ends import NullRecorder
from mavsitl.keep import carry_out
from mavsitl.link.udp import LOOPBACK, MAX_PEERS, UdpLink
from mavsitl.services.ftp import DATA_BYTES, FtpError, FtpPayload, Opcode
from mavsitl.signing import EPOCH_UNIX_US, Key, setup_signing
from tests.autopilot.conftest import GCS, OFFBOARD, flight
from tests.autopilot.copter import flying, parameter
from tests.hostile.attacks import PATHS
from tests.hostile.report import Report

HEARTBEAT = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)
GROUND = (255, 190)
ONE_HEARTBEAT_BYTES = 20_000
SECRET = bytes(range(7, 39))


class Wire:
    """A vehicle behind its intake on real sockets of loopback, in simulated time: nothing here looks at a clock."""

    def __init__(self) -> None:
        self._remote = client()
        self.vehicle = Vehicle(flight(), NullRecorder(), seed=1, ports=("offboard", "gcs"))
        self.links = (UdpLink(), UdpLink(remote=self._remote.getsockname()))
        self._intake = Intake(self.vehicle, self.links, {0: Tap()})
        self.now_us = 0
        self.vehicle.step(0)

    @property
    def gcs(self) -> tuple[str, int]:
        """Where ground stations send."""
        return LOOPBACK, int(self.links[GCS].address[1])

    @property
    def remote(self) -> socket.socket:
        """The ground station that the vehicle was told to send to."""
        return self._remote

    def run(self, seconds: float, each: Any = None) -> None:
        for _ in range(round(seconds * 250)):
            if each is not None:
                each()
            while True:  # between two ticks there is time for all that is within the budgets
                self._intake.take(range(len(self.links)), self.now_us, self.now_us, lambda: self.now_us)
                if not self._intake.waiting:
                    break
            self.now_us += self.vehicle.period_us
            self.vehicle.step(self.now_us)
            for port, link in enumerate(self.links):
                for datagram in self.vehicle.datagrams(port, combine=False):
                    link.send(datagram)

    def close(self) -> None:
        self.vehicle.close()
        self._remote.close()
        for link in self.links:
            link.close()


@contextmanager
def wire() -> Iterator[Wire]:
    made = Wire()
    try:
        yield made
    finally:
        made.close()


def client() -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.bind((LOOPBACK, 0))
    opened.setblocking(False)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    return opened


def heard(opened: socket.socket) -> list[bytes]:
    datagrams = []
    while True:
        try:
            datagrams.append(opened.recv(4096))
        except BlockingIOError:
            return datagrams


def names(datagrams: list[bytes]) -> list[str]:
    return [frame.message.get_type() for datagram in datagrams for frame in parse(datagram)]


# --- who is fed, and how much


def amplification(report: Report) -> None:
    with wire() as world:
        stranger = client()
        for number in range(200):
            stranger.sendto(bytes((number,)) * (1 + number), world.gcs)
            stranger.sendto(b"\xfd\xff\x00", world.gcs)
            world.run(0.004)
        world.run(1.0)
        junk = sum(map(len, heard(stranger)))
        report.demand("bytes to a source of junk", "0", junk, junk == 0)

        stranger.sendto(encode(HEARTBEAT, 0, *GROUND), world.gcs)
        world.run(16.0)
        first = sum(map(len, heard(stranger)))
        world.run(5.0)
        later = sum(map(len, heard(stranger)))
        report.demand("bytes for one heartbeat", f"1 to {ONE_HEARTBEAT_BYTES}", first, 0 < first <= ONE_HEARTBEAT_BYTES)
        report.demand("bytes after that", "0", later, later == 0)
        stranger.close()

    with wire() as world:
        asker = client()
        asker.sendto(encode(HEARTBEAT, 0, *GROUND), world.gcs)
        world.run(0.1)
        heard(asker)
        for number in range(100):
            asker.sendto(encode(mavlink.MAVLink_param_request_list_message(1, 1), number, *GROUND), world.gcs)
        world.run(9.0)
        values = names(heard(asker)).count("PARAM_VALUE")
        lists = values / len(TABLE)
        report.demand("parameter lists for 100 requests", "1 to 3", lists, 1.0 <= lists <= 3.0)
        asker.close()


def spoofed(report: Report) -> None:
    """300 sources with valid heartbeats, twice a second each: who was there first keeps its place and its telemetry."""
    with wire() as world:
        station = client()
        count = 0

        def station_beats() -> None:
            nonlocal count
            if count % 250 == 0:
                station.sendto(encode(HEARTBEAT, 0, *GROUND), world.gcs)
            count += 1

        world.run(2.0, station_beats)
        heard(station)
        heard(world.remote)
        world.run(4.0, station_beats)
        calm = len(heard(station))
        calm_remote = len(heard(world.remote))
        sources = [client() for _ in range(300)]
        ticks = 0

        def all_beat() -> None:
            nonlocal ticks
            station_beats()
            for number in range(ticks % 125, 300, 125):
                sources[number].sendto(encode(HEARTBEAT, 0, 66, 1), world.gcs)
            ticks += 1

        world.run(4.0, all_beat)
        flooded = len(heard(station))
        flooded_remote = len(heard(world.remote))
        fed = len(world.links[GCS].peers)
        report.demand("peers fed of 300 spoofed", f"<= {MAX_PEERS}", fed, fed <= MAX_PEERS)
        share = flooded / calm
        report.demand("telemetry of the station that was there", ">= 90 %", f"{share:.0%}", share >= 0.9)
        share = flooded_remote / calm_remote
        report.demand("telemetry of the station at the remote", ">= 90 %", f"{share:.0%}", share >= 0.9)
        world.run(11.0, station_beats)
        left = len(world.links[GCS].peers)
        report.demand("peers fed 11 s after they fell silent", "1", left, left == 1)
        for opened in (station, *sources):
            opened.close()


# --- two ground stations


def fighting(report: Report) -> None:
    """Both set modes, parameters and missions at once; each gets its answers, and what holds is one of the two."""
    pilot = flying(3.0)
    one, other = (255, 190), (66, 190)
    wrong: list[str] = []
    for turn in range(60):
        for sender, port, value in ((one, OFFBOARD, 10.0), (other, GCS, 20.0)):
            seen = len(pilot.inbox)
            mode = (4, 3) if sender == one else (2, 0)
            acks = pilot.command(mavlink.MAV_CMD_DO_SET_MODE, 1, *mode, port=port, sender=sender)
            if [(ack.target_system, ack.target_component) for ack in acks] != [sender]:
                wrong.append(f"turn {turn}: acknowledged to {acks}")
            pilot.send(parameter("RTL_RETURN_ALT", value), port=port, sender=sender)
            pilot.send(mavlink.MAVLink_mission_count_message(1, 1, 2, 0), port=port, sender=sender)
            pilot.run(0.004)
            answers = [(p, m) for _, p, m in pilot.inbox[seen:]]
            told = {m.param_value for p, m in answers if m.get_type() == "PARAM_VALUE" and p == port}
            if told != {value}:
                wrong.append(f"turn {turn}: {sender} set {value} and heard {told}")
            kinds = {m.get_type() for p, m in answers if p == port and getattr(m, "target_system", 0) == sender[0]}
            if not kinds & {"MISSION_REQUEST_INT", "MISSION_ACK"}:
                wrong.append(f"turn {turn}: no answer to a mission count of {sender}")
        for sender, port in ((one, OFFBOARD), (other, GCS)):
            for seq in range(2):
                item = mavlink.MAVLink_mission_item_int_message(
                    1, 1, seq, 6, 22 if seq == 0 else 16, 0, 1, 0, 0, 0, 0, 473977418, 85455939, 5.0 + port, 0
                )
                pilot.send(item, port=port, sender=sender)
                pilot.run(0.004)
        pilot.run(0.1)
    heights = {item.z for item in pilot.vehicle.plan.stores.items(0)}
    report.demand("answers that went astray between two stations", "0", len(wrong), not wrong)
    report.demand("the mission is one station's, whole", "one height", sorted(heights), len(heights) == 1)
    value = pilot.vehicle.parameters["RTL_RETURN_ALT"]
    report.demand("the parameter is the last one set", "20", value, value == 20.0)
    errors = pilot.vehicle.counters.errors
    report.demand("exceptions of a handler", "0", errors, errors == 0)
    armed = pilot.vehicle.autopilot.commander.armed
    report.demand("still flying", "yes", armed, armed)
    for text in wrong[:5]:
        print(text, file=sys.stderr)


# --- files


class Files:
    """A vehicle with a card, a key and logs, and a client of its files."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.logs = folder / "run"
        self.logs.mkdir()
        (self.logs / "vehicle.ulg").write_bytes(bytes(10_000))
        self.clock_us = EPOCH_UNIX_US + 400_000_000_000_000
        self.vehicle = Vehicle(
            flight(), NullRecorder(), seed=1, state=folder / "state", logs=self.logs, unix_us=lambda: self.clock_us
        )
        self.now_us = 0
        self.sequence = 0
        self.said = b""
        self.vehicle.step(0)
        self.vehicle.receive(0, encode(setup_signing((1, 1), Key(SECRET), 1), 0, *GROUND))
        self.run(1.5)

    def run(self, seconds: float) -> list[Any]:
        messages = []
        for _ in range(round(seconds * 250)):
            self.now_us += 4000
            self.clock_us += 4000
            self.vehicle.step(self.now_us)
            for datagram in self.vehicle.datagrams(0, combine=False):
                self.said += datagram
                messages += [frame.message for frame in parse(datagram)]
        return messages

    def send(self, message: Any) -> None:
        self.vehicle.receive(0, encode(message, self.sequence & 0xFF, *GROUND))

    def ask(self, opcode: int, data: bytes = b"", *, offset: int = 0, session: int = 0, size: int = -1) -> FtpPayload:
        self.sequence = (self.sequence + 2) & 0xFFFF
        payload = FtpPayload(self.sequence, session, opcode, len(data) if size < 0 else size, 0, 0, offset, data)
        self.send(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, payload.encode()))
        answers = [
            FtpPayload.decode(bytes(m.payload))
            for m in self.run(0.008)
            if m.get_type() == "FILE_TRANSFER_PROTOCOL"
        ]  # fmt: skip
        assert answers, f"opcode {opcode} was not answered"
        assert answers[0] is not None
        return answers[0]


def traversal(report: Report, folder: Path) -> None:
    files = Files(folder)
    outside = folder / "outside"
    outside.write_bytes(b"not yours")
    (folder / "state" / "card" / "link").symlink_to(outside)
    (folder / "state" / "card" / "up").symlink_to(folder)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and "card" not in path.parts}
    leaks = 0
    climbing = [path for path in PATHS if b".." in path or path.startswith((b"/etc", b"/proc", b"/dev", b"~"))]
    climbing += [b"/fs/microsd/link", b"/fs/microsd/up/outside", b"/fs/microsd/up/state/signing.json"]
    for path in climbing:
        for opcode in range(16):
            reply = files.ask(opcode, path[:DATA_BYTES])
            if reply.opcode == Opcode.ACK and opcode in (4, 6, 8, 9, 10, 11, 12, 14):
                leaks += 1
                print(f"opcode {opcode} {path!r}: {reply}", file=sys.stderr)
            renamed = files.ask(Opcode.RENAME, path[:100] + b"\0/fs/microsd/x")
            leaks += renamed.opcode == Opcode.ACK and b"link" not in path
        files.ask(Opcode.RESET_SESSIONS)
    report.demand(f"of {len(climbing)} paths out of the card, opened by any request", "0", leaks, leaks == 0)
    after = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and "card" not in path.parts}
    changed = len(set(before.items()) ^ set(after.items()))
    report.demand("files outside it that changed", "0", changed, changed == 0)

    offsets = [0, 1, 2**31 - 1, 2**31, 2**32 - 1]
    files.ask(Opcode.CREATE_FILE, b"/fs/microsd/big")
    results = {files.ask(Opcode.WRITE_FILE, bytes(239), offset=offset).opcode for offset in offsets[2:]}
    files.ask(Opcode.TERMINATE_SESSION)
    report.demand("writes at 2 and 4 GiB", "refused", sorted(results), results == {Opcode.NAK})
    files.ask(Opcode.OPEN_FILE_RO, b"/fs/microsd/log/vehicle.ulg")
    replies = [files.ask(Opcode.READ_FILE, bytes(DATA_BYTES), offset=offset) for offset in offsets[2:]]
    ends = all(reply.opcode == Opcode.NAK and reply.data[0] == FtpError.EOF for reply in replies)
    report.demand("reads at 2 and 4 GiB", "EOF", "EOF" if ends else replies, ends)
    reply = files.ask(Opcode.TRUNCATE_FILE, b"/fs/microsd/big", offset=2**32 - 1)
    report.demand("truncated to 4 GiB", "refused", Opcode(reply.opcode).name, reply.opcode == Opcode.NAK)
    used = sum(path.stat().st_size for path in (folder / "state" / "card").rglob("*") if path.is_file())
    report.demand("bytes on the card", "<= 16 MiB", used, used <= 16 << 20)
    handles = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    for number in range(300):
        files.ask(Opcode.OPEN_FILE_RO, b"/fs/microsd/log/vehicle.ulg", session=number & 0xFF)
    held = len(os.listdir("/proc/self/fd")) - handles  # noqa: PTH208
    report.demand("file handles after 300 openings", "<= 8", held, held <= 8)

    files.send(mavlink.MAVLink_mission_count_message(1, 1, 65535, 0))
    acks = [m.type for m in files.run(0.02) if m.get_type() == "MISSION_ACK"]
    report.demand("a mission of 65535 items", "NO_SPACE", acks, acks == [mavlink.MAV_MISSION_NO_SPACE])
    files.send(mavlink.MAVLink_log_request_data_message(1, 1, 0, 2**32 - 1, 2**32 - 1))
    data = [m for m in files.run(1.0) if m.get_type() == "LOG_DATA"]
    report.demand("log data behind the end", "one empty", [m.count for m in data], [m.count for m in data] == [0])
    files.send(mavlink.MAVLink_log_request_data_message(1, 1, 0, 0, 2**32 - 1))
    data = [m for m in files.run(3.0) if m.get_type() == "LOG_DATA"]
    sizes = sum(m.count for m in data)
    report.demand("bytes for 4 GiB of a log of 10000", "10000", sizes, sizes == 10_000)

    carry_out(files.vehicle)
    secrecy(report, files)
    files.vehicle.close()


def secrecy(report: Report, files: Files) -> None:
    """The key is in one file, which its owner alone can read; nothing that was said or kept elsewhere holds it."""
    kept = files.folder / "state" / "signing.json"
    modes = [stat.S_IMODE(path.stat().st_mode) for path in (kept, kept.parent)]
    report.demand(
        "modes of the key's file and folder", "0o600, 0o700", [oct(m) for m in modes], modes == [0o600, 0o700]
    )
    forms = (SECRET, SECRET.hex().encode(), SECRET.hex().upper().encode(), repr(list(SECRET)).encode())
    places = [kept.parent, files.logs]
    shown = [
        str(path) for place in places for path in place.rglob("*")
        if path.is_file() and path != kept and any(form in path.read_bytes() for form in forms)
    ]  # fmt: skip
    report.demand("other files that hold the key", "none", shown or "none", not shown)
    said = any(form in files.said for form in forms)
    report.demand("the key was said on the wire", "no", said, not said)
    texts = [repr(files.vehicle.__dict__), repr(files.vehicle._signing), str(files.vehicle.parameters.as_dict())]
    told = any(form.decode("latin-1") in text for form in forms[1:] for text in texts)
    report.demand("the key shows in repr or parameters", "no", told, not told)


def main() -> int:
    report = Report("strangers and rivals")
    amplification(report)
    spoofed(report)
    fighting(report)
    with TemporaryDirectory() as folder:
        traversal(report, Path(folder))
    return report.print()


if __name__ == "__main__":
    sys.exit(main())
