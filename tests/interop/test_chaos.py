"""Clients that we did not write against a vehicle that misbehaves: each ends, and says what failed, or asks again.

What is expected of a client is what this release of it does; it shows that the modes are seen by a client as they are
meant. After each the same client works again, and another one at the vehicle's other port never noticed.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.link.udp import LOOPBACK
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.testing import RunningVehicle, vehicle
from tests.autopilot.conftest import flight
from tests.interop.conftest import PATIENCE_S
from tests.interop.test_pymavlink import connection, heartbeat, say_hello

pytestmark = pytest.mark.interop

NAME = "MIS_TAKEOFF_ALT"
LOG = bytes(range(250)) * 20
PATH = "/fs/microsd/log/flight.ulg"


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    (folder / "flight.ulg").write_bytes(LOG)
    return folder


@pytest.fixture(scope="module")
def running(logs: Path) -> Iterator[RunningVehicle]:
    with vehicle(logs=logs) as made:
        yield made


# --- MAVSDK ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pilot(running: RunningVehicle) -> Iterator[Any]:
    pytest.importorskip("mavsdk.plugins", reason="MAVSDK 4 is not installed")
    from tests.interop.mavsdk_client import connected

    with connected(SimpleNamespace(offboard_port=running.offboard_port, log=str)) as made:  # type: ignore[arg-type]
        made.wait("health_all_ok", bool)
        yield made


def outcome(call: Callable[[], Any]) -> str:
    """The name of a plugin's result, within `PATIENCE_S`: none of these operations may take for ever."""
    results: list[str] = []

    def run() -> None:
        try:
            call()
            results.append("SUCCESS")
        except Exception as error:
            results.append(str(error.result.name))  # type: ignore[attr-defined]

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(PATIENCE_S)
    assert results, f"it did not end within {PATIENCE_S:g} s"
    return results[0]


def download(pilot: Any, folder: Path) -> str:
    from tests.interop.test_mavsdk import finished

    return finished(pilot.ftp.download_async, PATH, str(folder), False)


def items(pilot: Any) -> list[Any]:
    from tests.interop.test_mavsdk import _raw

    here = pilot.telemetry.position()
    return _raw(here, (22, 0.0, 3.0), (16, 6.0, 3.0), (16, 9.0, 3.0), (16, 12.0, 3.0), (21, 6.0, 0.0))


OPERATIONS: dict[str, Callable[[Any], Any]] = {
    "hold": lambda pilot: pilot.action.hold(),
    "get": lambda pilot: pilot.param.get_param_float(NAME),
    "set": lambda pilot: pilot.param.set_param_float(NAME, 3.0),
    "upload": lambda pilot: pilot.mission_raw.upload_mission(items(pilot)),
    "download": lambda pilot: pilot.mission_raw.download_mission(),
}


@pytest.mark.sockets
@pytest.mark.parametrize(
    ("mode", "operation", "result"),
    [
        ("ack-first-lost", "hold", "SUCCESS"),
        ("command-first-lost", "hold", "SUCCESS"),
        ("ack-lost", "hold", "TIMEOUT"),
        ("ack-refused", "hold", "COMMAND_DENIED"),
        ("ack-busy", "hold", "COMMAND_DENIED"),
        ("ack-doubled", "hold", "SUCCESS"),
        ("ack-no-target", "hold", "SUCCESS"),
        ("ack-progress-failed:0.4", "hold", "FAILED"),
        ("ack-progress-accepted:0.4", "hold", "SUCCESS"),
        ("param-read-first-ignored", "get", "SUCCESS"),
        ("param-read-refused", "get", "DOES_NOT_EXIST"),
        ("param-type-wrong", "get", "WRONG_TYPE"),
        ("param-set-first-ignored", "set", "SUCCESS"),
        ("param-set-refused", "set", "VALUE_OUT_OF_RANGE"),
        ("mission-begin-first-ignored", "upload", "SUCCESS"),
        ("mission-request-refused:1", "upload", "PROTOCOL_ERROR"),
        ("mission-ack-error", "upload", "PROTOCOL_ERROR"),
        ("mission-ack-early", "upload", "PROTOCOL_ERROR"),
        ("mission-ack-lost", "upload", "TIMEOUT"),
        ("mission-ack-doubled", "upload", "SUCCESS"),
        ("mission-count-first-lost", "download", "SUCCESS"),
        ("mission-item-first-lost:1", "download", "SUCCESS"),
    ],
)
def test_mavsdk(running: RunningVehicle, pilot: Any, mode: str, operation: str, result: str) -> None:
    with running.chaos.during(f"{mode}@offboard"):
        assert outcome(lambda: OPERATIONS[operation](pilot)) == result
    # an answer that came twice would be taken for one to the next operation: a round trip later it is behind us
    assert outcome(lambda: OPERATIONS["get"](pilot)) == "SUCCESS"
    assert outcome(lambda: OPERATIONS[operation](pilot)) == "SUCCESS"


@pytest.mark.sockets
@pytest.mark.parametrize(
    ("mode", "result"),
    [
        ("ftp-nak", "PROTOCOL_ERROR"),
        ("ftp-second-nak", "PROTOCOL_ERROR"),
        ("ftp-second-first-silent", "SUCCESS"),
        ("ftp-drops:0.03", "SUCCESS"),
    ],
)
def test_mavsdk_files(running: RunningVehicle, pilot: Any, mode: str, result: str, tmp_path: Path) -> None:
    with running.chaos.during(f"{mode}@offboard"):
        assert download(pilot, tmp_path) == result
    assert download(pilot, tmp_path) == "SUCCESS"
    assert (tmp_path / "flight.ulg").read_bytes() == LOG


# --- pymavlink -------------------------------------------------------------------------------------------------------


@pytest.mark.sockets
def test_mavparm_asks_again_and_gives_up_and_the_other_port_does_not_notice(running: RunningVehicle) -> None:
    from pymavlink import mavparm

    parameters = mavparm.MAVParmDict()
    with (
        connection(f"udpin:{LOOPBACK}:{running.gcs_port}", 250) as spoilt,
        connection(f"udpout:{LOOPBACK}:{running.offboard_own}", 251) as well,
    ):
        say_hello(well)
        heartbeat(spoilt)
        heartbeat(well)
        with running.chaos.during("param-set-first-ignored@gcs"):
            assert parameters.mavset(spoilt, NAME, 4.0)
            assert running.core.parameters[NAME] == 4.0
        with running.chaos.during("param-set-ignored@gcs", "heartbeat-lost@gcs", "text-flood@gcs"):
            assert not parameters.mavset(spoilt, NAME, 5.0, retries=1)
            assert running.core.parameters[NAME] == 4.0
            assert parameters.mavset(well, NAME, 6.0, retries=1)
            heartbeat(well)
        assert parameters.mavset(spoilt, NAME, 2.5)


class Connection:
    """What pymavlink's FTP client uses of a connection, to a vehicle in memory. Who waits lets the time pass."""

    source_system, source_component = 255, 190

    def __init__(self, logs: Path) -> None:
        self.vehicle = Vehicle(flight(), MemoryRecorder(), seed=1, logs=logs)
        self.mav = SimpleNamespace(file_transfer_protocol_send=self._send)
        self._now_us = 0
        self._came: list[Any] = []
        self.vehicle.step(0)

    def time(self) -> float:
        return 1000.0 + self._now_us / 1e6

    def sleep(self, seconds: float) -> None:
        for _ in range(max(round(seconds / 0.004), 1)):
            self._now_us += 4000
            self.vehicle.step(self._now_us)
            self._collect()

    def recv_match(self, type: Any = None, blocking: bool = False, timeout: float = 0.0) -> Any:  # noqa: A002
        end_s = self.time() + (timeout or 0.0)
        while not self._came:
            if self.time() >= end_s:
                return None
            self.sleep(0.004)
        return self._came.pop(0)

    def _send(self, *fields: Any) -> None:
        *target, payload = fields
        request = mavlink.MAVLink_file_transfer_protocol_message(*target, bytes(payload))
        self.vehicle.receive(0, encode(request, 0, self.source_system, self.source_component))
        self._collect()

    def _collect(self) -> None:
        for datagram in self.vehicle.datagrams(0, combine=False):
            found = [frame.message for frame in parse(datagram)]
            self._came += [each for each in found if each.get_type() == "FILE_TRANSFER_PROTOCOL"]


GENERIC, NOT_FOUND, NO_REPLY = 1, 10, 73


@pytest.mark.parametrize(
    ("mode", "error", "got"),
    [
        ("ftp-silent", GENERIC, None),
        ("ftp-nak:FILENOTFOUND", NOT_FOUND, None),
        ("ftp-second-silent", NO_REPLY, None),
        ("ftp-second-first-silent", 0, LOG),
        ("ftp-second-nak", GENERIC, None),
        ("ftp-bad-sequence", GENERIC, None),
        ("ftp-wrong-session", NO_REPLY, None),
        ("ftp-drops:0.1", 0, LOG),
        ("ftp-gaps:3", 0, LOG),
        ("ftp-wrong-size", 0, LOG),
        ("ftp-cut:0.5", 0, LOG[: len(LOG) // 2]),
    ],
)
def test_mavftp(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str, error: int, got: bytes | None
) -> None:
    from pymavlink import mavftp

    link = Connection(logs)
    monkeypatch.setattr(mavftp, "time", SimpleNamespace(time=link.time, sleep=link.sleep))

    def get() -> tuple[int, bytes | None]:
        ftp, local = mavftp.MAVFTP(link, 1, 1), tmp_path / "got"
        local.unlink(missing_ok=True)
        assert ftp.cmd_get([PATH, str(local)]).error_code == 0
        ended = int(ftp.process_ftp_reply("OpenFileRO", timeout=30).error_code)
        return ended, local.read_bytes() if local.exists() else None

    with link.vehicle.chaos.during(mode):
        assert get() == (error, got)
    link.sleep(11.0)  # what it left open is closed
    assert get() == (0, LOG)


# --- MAVProxy --------------------------------------------------------------------------------------------------------


@pytest.mark.sockets
def test_mavproxy(tmp_path: Path) -> None:
    pytest.importorskip("MAVProxy", reason="MAVProxy is not installed")
    from tests.interop.process import mavproxy
    from tests.interop.test_mavproxy import MISSION_TEXT

    plan = tmp_path / "plan.txt"
    plan.write_text(MISSION_TEXT, "utf-8")
    with vehicle(overrides={"chaos": [{"mode": f"param-list-without:{NAME}"}]}) as sitl:
        chaos, values, changed = sitl.chaos, sitl.core.parameters, threading.Event()
        values.subscribe(lambda name, value: changed.set() if (name, value) == (NAME, 3.0) else None)
        with mavproxy(f"udpin:{LOOPBACK}:{sitl.gcs_port}", tmp_path) as program:
            program.wait(rf"Received {len(values.names)} parameters")  # it asked for the one that was missing

            with chaos.during("param-set-first-ignored"):
                program.type(f"param set {NAME} 3")
                assert changed.wait(PATIENCE_S)
            with chaos.during("param-set-ignored"):
                program.do(f"param set {NAME} 4", rf"Failed to set {NAME} to 4")
            with chaos.during("ack-refused"):
                program.do("long 176 1 4 3", r"Got COMMAND_ACK: DO_SET_MODE: DENIED")
            with chaos.during("ack-progress-failed:0.5"):
                program.do("long 176 1 4 3", r"DO_SET_MODE: IN_PROGRESS", r"DO_SET_MODE: FAILED")
            with chaos.during("mission-request-refused:1"):
                program.do(f"wp load {plan}", r"Got MISSION_ACK: TYPE_MISSION: ERROR")
            program.do(f"wp load {plan}", r"Got MISSION_ACK: TYPE_MISSION: ACCEPTED")
            with chaos.during("crc-wrong:20", "frame-cut:30", "frame-unknown:20", "ack-doubled"):
                program.do("long 176 1 4 3", r"DO_SET_MODE: ACCEPTED")
            assert "Traceback" not in program.printed
