"""The vehicle's files: written whole or not at all, and never in the way of a start."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.autopilot.storage import MAX_ASIDE, MAX_BYTES, MAX_TEXTS, Store, keep_parameters

posix = pytest.mark.skipif(os.name != "posix", reason="file modes")


EVER_US = 1 << 62


class Killed(BaseException):
    """Nothing after it runs, as after a kill."""


def store(folder: Path | None, report: Callable[[str], None] | None = None, **options: Any) -> Store:
    texts: list[str] = []
    return Store(folder, "things", 3, report or texts.append, **options)


def flush(things: Store, now_us: int = EVER_US) -> bool:
    """Write what is to be written; whether it is."""
    document = things.take(now_us)
    if document is None:
        return True
    error: OSError | None = None
    try:
        document.write()
    except OSError as failure:
        error = failure
    things.written(error, now_us)
    return error is None


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def document(content: Any, schema: Any = 3) -> str:
    return json.dumps({"schema": schema, "content": content})


def test_what_was_put_is_loaded(tmp_path: Path) -> None:
    first = store(tmp_path / "vehicle" / "1")
    assert first.load() == {}
    first.put({"a": 0.1, "b": [1, None, "β"]})
    flush(first)
    assert store(tmp_path / "vehicle" / "1").load() == {"a": 0.1, "b": [1, None, "β"]}
    assert names(tmp_path / "vehicle" / "1") == ["things.json"]


def test_what_was_taken_is_not_given_again(tmp_path: Path) -> None:
    things = store(tmp_path)
    assert things.take(0) is None
    things.put({"a": 1})
    document = things.take(0)
    assert document is not None
    assert things.take(0) is None
    things.put({"a": 2})  # while that is on its way
    document.write()
    things.written(None, 0)
    assert store(tmp_path).load() == {"a": 1}
    assert flush(things)
    assert store(tmp_path).load() == {"a": 2}


def test_no_folder_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    things = store(None)
    things.put({"a": 1})
    assert things.take(EVER_US) is None
    assert things.load() == {}
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "truncated"),
        ("[1]", "not a file of this vehicle"),
        ("{}", "not a file of this vehicle"),
        (document([]), "not a file of this vehicle"),
        (document({}, schema=2), "schema 2, need 3"),
        (document({}, schema=None), "schema None, need 3"),
        ('{"schema": 3, "content": {"a": NaN}}', "malformed"),
        ('{"schema": 3, "content": ' + "[" * 100_000, "recursion"),
        ('{"schema": 3, "content": {"a": ' + "9" * 10_000 + "}}", "out of range"),
        (" " * (MAX_BYTES + 1), f"longer than {MAX_BYTES} bytes"),
    ],
)
def test_a_damaged_file_is_kept_aside(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "things.json").write_text(text)
    texts: list[str] = []
    assert store(tmp_path, texts.append).load() == {}
    (line,) = texts
    assert re.search(rf"things\.json: damaged \(.*({reason}).*\), the defaults hold; kept as things\.json\.bad", line)
    assert names(tmp_path) == ["things.json.bad"]
    assert (tmp_path / "things.json.bad").read_text() == text


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_damage_is_survived(tmp_path: Path, data: st.DataObject) -> None:
    good = document({"a": 1.5, "b": 2}).encode()
    cut = data.draw(st.integers(0, len(good) - 1))
    junk = data.draw(st.binary(max_size=8))
    (tmp_path / "things.json").write_bytes(good[:cut] + junk)
    assert isinstance(store(tmp_path).load(), dict)


def test_a_folder_in_the_file_s_place_is_moved_aside(tmp_path: Path) -> None:
    (tmp_path / "things.json").mkdir()
    texts: list[str] = []
    things = store(tmp_path, texts.append)
    assert things.load() == {}
    assert "damaged (cannot be read: " in texts[0]
    things.put({"a": 1})
    assert flush(things)
    assert store(tmp_path).load() == {"a": 1}
    assert names(tmp_path) == ["things.json", "things.json.bad"]


@posix
def test_a_pipe_in_the_file_s_place_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "things.json")
    assert store(tmp_path).load() == {}
    assert names(tmp_path) == ["things.json.bad"]


def test_damaged_files_do_not_push_one_another_out(tmp_path: Path) -> None:
    for number in range(12):
        (tmp_path / "things.json").write_text(f"damage {number}")
        assert store(tmp_path).load() == {}
    assert len(names(tmp_path)) == MAX_ASIDE
    assert (tmp_path / "things.json.bad").read_text() == "damage 0"
    assert (tmp_path / "things.json.bad-2").read_text() == "damage 1"


@pytest.mark.parametrize("step", ["open", "write", "fsync", "replace", "folder"])
@pytest.mark.parametrize("how", [Killed, OSError])
def test_a_crash_leaves_the_old_file_or_the_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, how: type[BaseException]
) -> None:
    old = store(tmp_path)
    old.put({"a": 1})
    flush(old)
    things = store(tmp_path)
    things.put({"a": 2})
    calls = {"fsync": 0}
    real_open, real_fsync, real_fdopen = os.open, os.fsync, os.fdopen

    def broken_open(path: Any, flags: int, *rest: Any) -> int:
        if step == "open" and flags & os.O_CREAT:
            raise how(28, "No space left on device")
        return real_open(path, flags, *rest)

    class Torn:
        def __init__(self, file: Any) -> None:
            self._file = file

        def __enter__(self) -> Any:
            return self

        def __exit__(self, *error: object) -> None:
            self._file.close()

        def write(self, data: bytes) -> None:
            self._file.write(data[: len(data) // 2])
            raise how(28, "No space left on device")

    def broken_fdopen(descriptor: int, mode: str) -> Any:
        file = real_fdopen(descriptor, mode)
        return Torn(file) if step == "write" else file

    def broken_fsync(descriptor: int) -> None:
        calls["fsync"] += 1
        if (step, calls["fsync"]) in (("fsync", 1), ("folder", 2)):
            raise how(5, "Input/output error")
        real_fsync(descriptor)

    def broken_replace(self: Path, target: Any) -> Path:
        raise how(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", broken_open)
        patch.setattr(os, "fdopen", broken_fdopen)
        patch.setattr(os, "fsync", broken_fsync)
        if step == "replace":
            patch.setattr(Path, "replace", broken_replace)
        if how is Killed:
            with pytest.raises(Killed):
                flush(things)
        else:
            assert flush(things) == (step == "folder")
    texts: list[str] = []
    assert store(tmp_path, texts.append).load() == {"a": 2 if step == "folder" else 1}
    assert texts == []
    # The next start writes over what the last one left lying about.
    again = store(tmp_path)
    again.put({"a": 3})
    flush(again)
    assert store(tmp_path).load() == {"a": 3}
    assert names(tmp_path) == ["things.json"]


def test_a_full_disk_is_told_once_and_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    texts: list[str] = []
    things = store(tmp_path, texts.append)
    full = True
    tries: list[int] = []
    real = os.fsync

    def fsync(descriptor: int) -> None:
        tries.append(descriptor)
        if full:
            raise OSError(28, "No space left on device")
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    things.put({"a": 1})
    for now_us in range(0, 12_000_000, 100_000):
        flush(things, now_us)
    assert len(tries) == 3
    assert texts == [f"{tmp_path / 'things.json'}: cannot be written: No space left on device"]
    full = False
    assert flush(things, 20_000_000)
    assert store(tmp_path).load() == {"a": 1}


@posix
def test_a_secret_is_for_its_owner_alone(tmp_path: Path) -> None:
    left = tmp_path / ".things.json.tmp"
    left.write_text("from a process that was killed")
    left.chmod(0o644)
    secret = store(tmp_path, private=True)
    secret.put({"key": "00"})
    flush(secret)
    assert (tmp_path / "things.json").stat().st_mode & 0o777 == 0o600


@posix
def test_a_link_in_the_way_is_not_followed(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.write_text("not ours")
    (tmp_path / ".things.json.tmp").symlink_to(other)
    things = store(tmp_path)
    things.put({"a": 1})
    flush(things)
    assert other.read_text() == "not ours"
    assert store(tmp_path).load() == {"a": 1}


# --- parameters


def test_parameters_survive_a_restart(tmp_path: Path) -> None:
    first = Parameters({"MC_ROLL_P": 20.0})
    kept = keep_parameters(first, tmp_path, pytest.fail)
    first.set("MC_ROLL_P", 7.25)
    first.set("GF_ACTION", 3)
    flush(kept)
    second = Parameters({"MC_ROLL_P": 5.0, "MC_YAW_P": 1.0})
    keep_parameters(second, tmp_path, pytest.fail)
    assert (second["MC_ROLL_P"], second["GF_ACTION"], second["MC_YAW_P"]) == (7.25, 3, 1.0)
    assert second.changed() == first.changed()


def test_a_start_alone_writes_nothing(tmp_path: Path) -> None:
    kept = keep_parameters(Parameters({"MC_ROLL_P": 20.0}), tmp_path, pytest.fail)
    assert kept.take(EVER_US) is None
    assert names(tmp_path) == []


def test_values_that_are_not_allowed_are_left_out_and_told(tmp_path: Path) -> None:
    content = {"MC_ROLL_P": 99.0, "MC_PITCH_P": 9.0, **{f"OLD_{number}": 1 for number in range(20)}}
    (tmp_path / "parameters.json").write_text(document(content, schema=1))
    texts: list[str] = []
    parameters = Parameters()
    keep_parameters(parameters, tmp_path, texts.append)
    assert parameters.changed() == {"MC_PITCH_P": 9.0}
    assert len(texts) == MAX_TEXTS + 1
    assert "left out: MC_ROLL_P: 99 1/s is not allowed; allowed: 0 to 30 1/s" in texts[0]
    assert "left out: 16 more" in texts[-1]
