"""Whatever lies where the vehicle keeps its state: it boots, says what was wrong, keeps it aside, and goes on."""

from __future__ import annotations

import errno
import json
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mavsitl_vehicle.autopilot import storage
from mavsitl_vehicle.autopilot.storage import MAX_BYTES, Store
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import keep
from mavsitl.ends import NullRecorder
from mavsitl.keep import carry_out
from mavsitl.services.ftp import FtpClient
from mavsitl.services.mission import MISSION, MissionItem
from mavsitl.signing import EPOCH_UNIX_US, Key, SigningState
from tests.autopilot.conftest import Client, flight
from tests.autopilot.copter import ACCEPTED, parameter, upload, waypoint

pytestmark = pytest.mark.skipif(os.name != "posix", reason="links, pipes and modes")

STORES = ("parameters", "plan", "signing")
KEY = Key(bytes(range(32)))
UNIX_US = EPOCH_UNIX_US + 1_000_000_000_000


class Booted(Client):
    """A client of a vehicle that found `state`; what is unsaved is written after each run."""

    def __init__(self, state: Path) -> None:
        super().__init__(flight())
        self.vehicle = Vehicle(
            flight(), NullRecorder(), seed=1, ports=("offboard", "gcs"), state=state, unix_us=lambda: UNIX_US
        )
        self.now_us = 0
        self.inbox.clear()
        self.vehicle.step(0)
        self._collect()
        self.run(0.1)

    def run(self, seconds: float, each: Callable[[], object] | None = None) -> None:
        super().run(seconds, each)
        carry_out(self.vehicle, self.now_us)


def good(store: str) -> dict[str, Any]:
    """What each of them contains."""
    item = MissionItem(16, 6, 0.0, 1.0, 0.0, 0.0, 473_977_418, 85_455_939, 10.0)
    content: dict[str, dict[str, Any]] = {
        "parameters": {"MIS_TAKEOFF_ALT": 4.0, "COM_LOW_BAT_ACT": 3},
        "plan": {"current": 0, "mission": [item._asdict()], "fence": [], "rally": []},
        "signing": {"state": SigningState(KEY, 1).to_bytes().hex()},
    }
    return {"schema": 1, "content": content[store]}


def text(store: str) -> str:
    return json.dumps(good(store))


def pipe(path: Path) -> None:
    os.mkfifo(path)


def written(make: Callable[[str], str | bytes]) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        data = make(path.stem)
        path.write_bytes(data.encode() if isinstance(data, str) else data)

    return write


def _plan(**changes: Any) -> dict[str, Any]:
    """The good plan with something else in its one item."""
    content: dict[str, Any] = good("plan")["content"]
    return content | {"mission": [content["mission"][0] | changes]}


WRONG_INTEGERS: tuple[Any, ...] = (2**40, -(2**40), None, "0", [])
WRONG_FLOATS: tuple[Any, ...] = ("0", [], {}, True)

HOSTILE: dict[str, list[dict[str, Any]]] = {
    "parameters": [
        {"MIS_TAKEOFF_ALT": 1e300}, {"MIS_TAKEOFF_ALT": "4"}, {"MIS_TAKEOFF_ALT": None}, {"MIS_TAKEOFF_ALT": [4]},
        {"COM_LOW_BAT_ACT": 2**80}, {"COM_LOW_BAT_ACT": -1}, {"COM_LOW_BAT_ACT": 1.5}, {"": 1}, {"NO_SUCH": 1},
        {"A" * 100_000: 1}, {f"P{k}": k for k in range(10_000)}, {"MIS_TAKEOFF_ALT\u0000\u202e": 1},
    ],
    "plan": [
        {"current": 0}, {"current": 5, "mission": [], "fence": [], "rally": []},
        {"current": -(2**70), "mission": [], "fence": [], "rally": []},
        _plan() | {"mission": [{}] * 5000}, _plan() | {"mission": "abc"},
        _plan() | {"fence": [_plan(command=5001, param1=3.0)["mission"][0]]},
        *(_plan(**{name: odd}) for name in ("command", "frame", "x") for odd in WRONG_INTEGERS),
        *(_plan(**{name: odd}) for name in ("z", "param1") for odd in WRONG_FLOATS), _plan(z=1e300),
        _plan(z=None), _plan(more=1),
    ],
    "signing": [
        {"key": "00"}, {"state": ""}, {"state": 7}, {"state": None}, {"state": "zz"}, {"state": "00" * 48},
        {"state": "00" * 47}, {"state": "ab" * 1_000_000}, {"state": SigningState(KEY, 1).to_bytes().hex()[:-2] + "00"},
    ],
}  # fmt: skip

FILES: dict[str, Callable[[Path], object]] = {
    "empty": written(lambda store: ""),
    "cut": written(lambda store: text(store)[:-3]),
    "cut in half": written(lambda store: text(store)[: len(text(store)) // 2]),
    "one byte": written(lambda store: "{"),
    "zeros": written(lambda store: bytes(4096)),
    "zeros at the end": written(lambda store: text(store).encode() + bytes(100)),
    "random bytes": written(lambda store: random.Random(1).randbytes(5000)),
    "one bit flipped": written(lambda store: text(store).replace('"content"', '"cONtent"')),
    "other encoding": written(lambda store: text(store).encode("utf-16")),
    "no schema": written(lambda store: json.dumps({"content": {}})),
    "another schema": written(lambda store: json.dumps(good(store) | {"schema": 2})),
    "schema of another type": written(lambda store: json.dumps(good(store) | {"schema": [1]})),
    "no content": written(lambda store: json.dumps({"schema": 1})),
    "content is a list": written(lambda store: json.dumps({"schema": 1, "content": []})),
    "a list": written(lambda store: "[]"),
    "null": written(lambda store: "null"),
    "NaN": written(lambda store: '{"schema": 1, "content": {"MIS_TAKEOFF_ALT": NaN}}'),
    "deep": written(lambda store: "[" * 100_000),
    "deep objects": written(lambda store: '{"a":' * 100_000),
    "a huge number": written(lambda store: '{"schema": 1, "content": {"a": ' + "9" * 10_000 + "}}"),
    "twice": written(lambda store: text(store) * 2),
    "huge": written(lambda store: b" " * (MAX_BYTES + 1)),
    "a folder": Path.mkdir,
    "a pipe": pipe,
    "a link to itself": lambda path: path.symlink_to(path),
    "a link to a folder": lambda path: path.symlink_to(path.parent),
    "a link to a device": lambda path: path.symlink_to("/dev/zero"),
}


def works(client: Booted, state: Path, store: str) -> None:
    """The defaults hold, it arms, and what is changed now is there at the next start."""
    assert client.vehicle.parameters["MIS_TAKEOFF_ALT"] == 2.5
    assert client.vehicle.plan.mission == ()
    assert client.arm() == ACCEPTED
    assert client.disarm() == ACCEPTED
    client.send(parameter("MIS_TAKEOFF_ALT", 6.0))
    assert upload(client, [waypoint(client, 5, 0, 4)]) == 0
    client.run(0.1)
    again = Booted(state)
    assert again.vehicle.parameters["MIS_TAKEOFF_ALT"] == 6.0
    assert len(again.vehicle.plan.stores.items(MISSION)) == 1
    assert again.texts() == []


@pytest.mark.parametrize("store", STORES)
@pytest.mark.parametrize("damage", FILES)
def test_a_damaged_file(tmp_path: Path, store: str, damage: str) -> None:
    path = tmp_path / f"{store}.json"
    FILES[damage](path)
    regular = path.is_file() and not path.is_symlink()
    before = path.read_bytes() if regular else b""
    client = Booted(tmp_path)
    (said,) = client.texts()
    assert f"{store}.json: damaged (" in said
    assert f"kept as {store}.json.bad" in said
    aside = tmp_path / f"{store}.json.bad"
    assert os.path.lexists(aside)
    if regular:
        assert aside.read_bytes() == before
    works(client, tmp_path, store)


@pytest.mark.parametrize(
    ("store", "content"), [(store, content) for store in STORES for content in HOSTILE[store]],
    ids=lambda value: value if isinstance(value, str) else None,
)  # fmt: skip
def test_hostile_values_in_a_good_file(tmp_path: Path, store: str, content: Any) -> None:
    (tmp_path / f"{store}.json").write_text(json.dumps({"schema": 1, "content": content}))
    client = Booted(tmp_path)
    assert any(f"{store}.json: " in said for said in client.texts())
    assert client.vehicle.parameters["COM_LOW_BAT_ACT"] == 0
    assert client.vehicle.plan.mission == ()
    assert client.arm() == ACCEPTED


@pytest.mark.parametrize("store", STORES)
def test_a_good_file_is_taken(tmp_path: Path, store: str) -> None:
    """Else the tests above would hold of a vehicle that reads nothing."""
    (tmp_path / f"{store}.json").write_text(text(store))
    client = Booted(tmp_path)
    assert client.texts() == []
    assert (client.vehicle.parameters["MIS_TAKEOFF_ALT"] == 4.0) == (store == "parameters")
    assert (len(client.vehicle.plan.mission) == 1) == (store == "plan")
    assert client.vehicle._signing is not None
    assert client.vehicle._signing.has_key == (store == "signing")


@pytest.mark.parametrize("store", STORES)
@pytest.mark.parametrize("code", [errno.EACCES, errno.EIO, errno.EPERM, errno.EMFILE])
def test_a_file_that_cannot_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, store: str, code: int) -> None:
    (tmp_path / f"{store}.json").write_text(text(store))
    real = storage._read

    def refuse(path: Path) -> bytes:
        if path.stem == store:
            raise OSError(code, os.strerror(code))
        return real(path)

    with monkeypatch.context() as patch:
        patch.setattr(storage, "_read", refuse)
        client = Booted(tmp_path)
    (said,) = client.texts()
    assert f"cannot be read: {os.strerror(code)}" in said
    assert (tmp_path / f"{store}.json.bad").read_text() == text(store)
    works(client, tmp_path, store)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EDQUOT, errno.EIO])
def test_a_file_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    """It is told once, in flight too, the old file stays whole, and the change is written when that works again."""
    (tmp_path / "parameters.json").write_text(text("parameters"))
    client = Booted(tmp_path)

    def refuse(path: Path, data: bytes, mode: int) -> None:
        raise OSError(code, os.strerror(code))

    with monkeypatch.context() as patch:
        patch.setattr(keep, "replace_file", refuse)
        client.send(parameter("MIS_TAKEOFF_ALT", 6.0))
        for _ in range(5):
            client.run(0.1)
        assert client.vehicle.parameters["MIS_TAKEOFF_ALT"] == 6.0
    (said,) = client.texts()
    assert said == f"{tmp_path / 'parameters.json'}: cannot be written: {os.strerror(code)}"
    assert json.loads((tmp_path / "parameters.json").read_text()) == good("parameters")
    carry_out(client.vehicle, client.now_us + Store.RETRY_DELAY_US)
    assert Booted(tmp_path).vehicle.parameters["MIS_TAKEOFF_ALT"] == 6.0


# --- the folder and the card


def _block(monkeypatch: pytest.MonkeyPatch, path: Path, code: int) -> None:
    real = Path.mkdir

    def mkdir(self: Path, *args: Any, **options: Any) -> None:
        if self == path:
            raise OSError(code, os.strerror(code))
        real(self, *args, **options)

    monkeypatch.setattr(Path, "mkdir", mkdir)


PLACES: dict[str, Callable[[Path], object]] = {
    "an empty file": Path.touch,
    "a file": lambda path: path.write_bytes(bytes(range(256))),
    "a pipe": pipe,
    "a link to nothing": lambda path: path.symlink_to(path.parent / "nothing"),
    "a link to itself": lambda path: path.symlink_to(path),
    "a link to a file": lambda path: path.symlink_to("/dev/null"),
}


@pytest.mark.parametrize("damage", PLACES)
@pytest.mark.parametrize("place", ["state", "card"])
def test_no_folder_in_a_folder_s_place(tmp_path: Path, place: str, damage: str) -> None:
    """It flies without a memory card, or without keeping anything, and says so."""
    state = tmp_path / "state"
    if place == "card":
        state.mkdir()
    PLACES[damage](state if place == "state" else state / "card")
    client = Booted(state)
    assert any("no memory card" in said for said in client.texts())
    assert client.arm() == ACCEPTED
    assert client.disarm() == ACCEPTED
    client.send(parameter("MIS_TAKEOFF_ALT", 6.0))
    client.run(0.1)
    assert client.vehicle.parameters["MIS_TAKEOFF_ALT"] == 6.0
    if place == "card":
        assert Booted(state).vehicle.parameters["MIS_TAKEOFF_ALT"] == 6.0
    else:
        client.run(0.1)
        assert any("cannot be written" in said for said in client.texts())
    _, _, uploaded = transfer(client)
    assert not uploaded


@pytest.mark.parametrize("place", ["state", "card"])
@pytest.mark.parametrize("code", [errno.EACCES, errno.EROFS, errno.ENOSPC, errno.EIO])
def test_a_folder_that_cannot_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, code: int) -> None:
    state = tmp_path / "state"
    _block(monkeypatch, state if place == "state" else state / "card", code)
    client = Booted(state)
    assert any(f"no memory card: {os.strerror(code)}" in said for said in client.texts())
    assert client.arm() == ACCEPTED


def _crowd(card: Path) -> None:
    for number in range(300):
        (card / f"{number}").touch()


def touch(path: Path, mode: int = 0o644, size_bytes: int = 0) -> object:
    path.touch(mode)
    os.truncate(path, size_bytes)
    return path


def make(path: Path, mode: int = 0o755) -> object:
    path.mkdir(mode, parents=True)
    return path


CARDS: dict[str, Callable[[Path], object]] = {
    "an upload that a kill left": lambda card: (card / ".mavsitl-upload-0").write_bytes(bytes(5000)),
    "uploads in a folder": lambda card: (make(card / "a"), touch(card / "a" / ".mavsitl-upload-7")),
    "an upload that is a folder": lambda card: (card / ".mavsitl-upload-1").mkdir(),
    "a link out": lambda card: (card / "out").symlink_to("/etc"),
    "a link to nothing": lambda card: (card / "out").symlink_to(card / "nothing"),
    "a link to itself": lambda card: (card / "out").symlink_to(card / "out"),
    "a link to the card": lambda card: (card / "out").symlink_to(card),
    "a pipe": lambda card: pipe(card / "pipe"),
    "odd names": lambda card: [touch(card / name) for name in ("a\nb", "tab\t", "\u202e", " ", "-rf", "x" * 255)],
    "bytes that are no text": lambda card: Path(os.fsdecode(os.fsencode(card) + b"/\xff\xfe")).touch(),
    "deep": lambda card: (card / "/".join("d" * 60)).mkdir(parents=True),
    "no mode": lambda card: (card / "locked").mkdir(mode=0),
    "a file without mode": lambda card: (card / "locked").touch(mode=0),
    "a sparse file": lambda card: touch(card / "big", size_bytes=10_000),
    "a folder named as the logs": lambda card: (card / "log").write_bytes(b"not a folder"),
}


@pytest.mark.parametrize("damage", CARDS)
def test_odd_things_on_the_card(tmp_path: Path, damage: str) -> None:
    card = tmp_path / "card"
    card.mkdir()
    CARDS[damage](card)
    client = Booted(tmp_path)
    assert client.arm() == ACCEPTED
    listed, back, uploaded = transfer(client)
    assert uploaded
    assert back == b"new" * 1000
    assert "new.bin" in listed
    assert not [name for name in listed if name.startswith(".mavsitl-upload")]
    assert "out" not in listed


def test_more_on_the_card_than_allowed(tmp_path: Path) -> None:
    """Nothing is removed for that; nothing more comes in."""
    (tmp_path / "card").mkdir()
    _crowd(tmp_path / "card")
    client = Booted(tmp_path)
    listed, _, uploaded = transfer(client)
    assert not uploaded
    assert len(listed) == 300


def transfer(client: Booted) -> tuple[list[str], bytes, bool]:
    """Upload a file over the wire, list the card and read the file: names, what came back, whether it was taken."""
    files = FtpClient()

    def done() -> bool:
        for message in files.step(client.now_us):
            client.send(message)
        seen = len(client.inbox)
        client.tick()
        for time_us, _, message in client.inbox[seen:]:
            for answer in files.receive(message, (1, 1), time_us):
                client.send(answer)
        return files.result is not None

    files.upload("/fs/microsd/new.bin", b"new" * 1000)
    client.run_until(done, 60.0)
    assert files.result is not None
    uploaded = files.result.ok
    files.list("/fs/microsd")
    client.run_until(done, 60.0)
    listed = [entry.name for entry in files.result.entries]
    files.download("/fs/microsd/new.bin")
    client.run_until(done, 60.0)
    return listed, files.result.data, uploaded
