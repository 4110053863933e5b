"""What is fuzzed byte by byte: each takes any bytes, and fails by an exception that it should not let out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from mavsitl.codec import Counters, Reader, encode, parse, reader
from mavsitl.dialect import mavlink
from mavsitl.link.framing import LONGEST_FRAME_BYTES, StreamSplitter
from mavsitl.scenario import ScenarioError
from mavsitl.services.base import Service
from mavsitl.services.files import MemoryFiles, Mounts
from mavsitl.services.ftp import FtpServer
from mavsitl.services.log_transfer import LogServer, TreeLogs
from mavsitl.services.mission import MissionServer, MissionStores, same_plan
from mavsitl.services.parameter import ParameterServer
from mavsitl.signing import SigningState
from tests.hostile.attacks import message_class

Target = Callable[[bytes], None]
CORPUS = Path(__file__).parent / "corpus"
PEER = (66, 1)


@cache
def _read_all(message_id: int) -> Reader:
    kind = mavlink.mavlink_map[message_id]
    return reader(kind, *kind.fieldnames)


def parser(data: bytes) -> None:
    """`codec.parse`: whatever it finds is in the datagram, frame by frame, and every byte is accounted for.

    What it found can be read, both ways, and sent on.
    """
    counters = Counters()
    frames = parse(data, counters)
    taken = b"".join(frame.raw for frame in frames)
    begin = 0
    for frame in frames:
        begin = data.index(frame.raw, begin) + len(frame.raw)
    assert len(taken) + counters.skipped_bytes == len(data)
    assert counters.frames == len(frames)
    for frame in frames:
        message = frame.message
        fields = _read_all(frame.message_id)(frame)
        plain = [list(value) if isinstance(value, tuple | bytes) else value for value in fields]
        assert repr(plain) == repr([getattr(message, name) for name in message.fieldnames])
        assert frame.target == (getattr(message, "target_system", 0), getattr(message, "target_component", 0))
        (again,) = parse(encode(message, frame.sequence, frame.system_id, frame.component_id))
        assert repr(again.message.to_dict()) == repr(message.to_dict())


def stream(data: bytes) -> None:
    """`StreamSplitter`: cut anywhere, nothing is lost or invented, and little is held back."""
    splitter = StreamSplitter()
    step = 1 + (data[0] if data else 0)
    out = b"".join(b"".join(splitter.feed(data[begin : begin + step])) for begin in range(0, len(data), step))
    assert data.startswith(out)
    assert len(data) - len(out) == splitter.held_bytes < LONGEST_FRAME_BYTES


def _each(data: bytes, names: Sequence[str]) -> Iterator[Any]:
    """Messages made of the bytes: a byte that chooses the kind and one for the length, and then its payload."""
    begin = 0
    while begin + 2 <= len(data):
        kind = message_class(names[data[begin] % len(names)])
        length = data[begin + 1]
        payload = data[begin + 2 : begin + 2 + length]
        begin += 2 + length
        head = bytes((0xFD, len(payload), 0, 0, 0, *PEER)) + kind.id.to_bytes(3, "little")
        crc = _crc(head[1:] + payload + bytes((kind.crc_extra,)))
        for frame in parse(head + payload + crc):
            yield frame.message


def _crc(data: bytes) -> bytes:
    from fastcrc import crc16

    return int(crc16.mcrf4xx(data, 0xFFFF)).to_bytes(2, "little")


def _serve(service: Service, data: bytes, names: Sequence[str]) -> None:
    """Whatever it is asked, it answers what can be packed."""
    now_us = 0
    for message in _each(data, names):
        for answer in service.receive(message, PEER, now_us):
            encode(answer, 0, 1, 1)
        now_us += 4000
        for answer in service.step(now_us):
            encode(answer, 0, 1, 1)
    for _ in range(3):
        now_us += 6_000_000
        for answer in service.step(now_us):
            encode(answer, 0, 1, 1)


def missions(data: bytes) -> None:
    from mavsitl_vehicle.autopilot.plan import VehiclePlan

    plan = VehiclePlan()
    _serve(MissionServer(plan.stores), data, MISSIONS)
    again = VehiclePlan()
    again.load_document(plan.to_document())
    assert all(same_plan(again.stores.items(kind), plan.stores.items(kind)) for kind in range(3))


def plain_missions(data: bytes) -> None:
    """Without a vehicle's rules."""
    _serve(MissionServer(MissionStores()), data, MISSIONS)


MISSIONS = (
    "MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_ITEM", "MISSION_REQUEST_LIST", "MISSION_REQUEST_INT",
    "MISSION_REQUEST", "MISSION_ACK", "MISSION_CLEAR_ALL", "MISSION_SET_CURRENT", "MISSION_REQUEST_PARTIAL_LIST",
    "MISSION_WRITE_PARTIAL_LIST",
)  # fmt: skip


def files(data: bytes) -> None:
    server = FtpServer(_tree())
    _serve(server, data, ("FILE_TRANSFER_PROTOCOL",))
    server.close()


@cache
def _tree() -> Mounts:
    return Mounts({"/fs": MemoryFiles({"a": b"x" * 1000, "d/b": b"", "d/c": b"y" * 239})})


def parameters(data: bytes) -> None:
    from mavsitl_vehicle.autopilot.parameters import Parameters

    table = Parameters()
    _serve(ParameterServer(table), data, ("PARAM_SET", "PARAM_REQUEST_READ", "PARAM_REQUEST_LIST"))
    assert all(abs(value) < 1e30 for value in table.as_dict().values())
    Parameters().restore(table.changed())


def logs(data: bytes) -> None:
    server = LogServer(TreeLogs(MemoryFiles({"one.ulg": bytes(1000), "d/two.ulg": b"", "x.txt": b"z"})))
    _serve(server, data, ("LOG_REQUEST_LIST", "LOG_REQUEST_DATA", "LOG_REQUEST_END", "LOG_ERASE"))
    server.close()


def scenarios(data: bytes) -> None:
    """A scenario file of any text: taken, or refused with a `ScenarioError`."""
    from tempfile import NamedTemporaryFile

    from mavsitl import scenario

    with NamedTemporaryFile(suffix=".toml") as file:
        file.write(data)
        file.flush()
        with suppress(ScenarioError):
            scenario.load(file.name)


def signing_state(data: bytes) -> None:
    """What was kept of a key: taken as it is, or refused."""
    with suppress(ValueError):
        assert SigningState.from_bytes(data).to_bytes() == data


TARGETS: dict[str, Target] = {
    "parser": parser, "stream": stream, "missions": missions, "plain_missions": plain_missions, "files": files,
    "parameters": parameters, "logs": logs, "scenarios": scenarios, "signing_state": signing_state,
}  # fmt: skip


def seeds(name: str) -> list[bytes]:
    """Where the search begins: good input of each kind, and what earlier searches found worth keeping."""
    found = [path.read_bytes() for path in sorted((CORPUS / name).glob("*"))] if (CORPUS / name).is_dir() else []
    heartbeat = encode(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3), 0, *PEER)
    if name in ("parser", "stream"):
        return [heartbeat, heartbeat * 3, b"\xfd\xff\x00" + heartbeat, heartbeat[:7] + heartbeat, *found]
    if name == "scenarios":
        from mavsitl import scenario

        folder = Path(scenario.__file__).parent / "scenarios"
        return [*(path.read_bytes() for path in sorted(folder.glob("*.toml"))), *found]
    if name == "signing_state":
        return [SigningState(timestamp=5).to_bytes(), *found]
    if name in ("missions", "plain_missions"):
        count, item = bytes((1, 0, 1, 1, 0)), bytes(37)
        return [bytes((0, len(count))) + count + bytes((1, len(item))) + item, *found]
    return [bytes((0, 30)) + bytes(30), *found]
