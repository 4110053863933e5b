"""How protocol chaos is asked for: command line, scenario in a process, the vehicle for tests of clients, the page."""

from __future__ import annotations

import json
import re
import socket
import threading
from pathlib import Path
from typing import Any

import pytest

from mavsitl import scenario, testing
from mavsitl.chaos import TABLE
from mavsitl.cli import main
from mavsitl.codec import Frame, parse
from mavsitl.link.udp import LOOPBACK
from mavsitl.scenario import ScenarioError
from tests.interop.conftest import PATIENCE_S, sitl

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "protocol-chaos.md"


def frames(ear: socket.socket, seconds_us: int) -> list[Frame]:
    """What comes within so much of the vehicle's own time."""
    found: list[Frame] = []
    first = last = None
    while first is None or last is None or last - first < seconds_us // 1000:
        for frame in parse(ear.recv(2048)):
            found.append(frame)
            stamp = getattr(frame.message, "time_boot_ms", None)
            if frame.message.get_type() == "ATTITUDE":
                first, last = stamp if first is None else first, stamp
    return found


def ear(port: int) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.settimeout(PATIENCE_S)
    made.bind((LOOPBACK, port))
    return made


@pytest.mark.sockets
def test_a_vehicle_of_the_command_line_misbehaves_from_its_first_word() -> None:
    arguments = ("--chaos", "heartbeat-lost@gcs", "--chaos", "landed-unknown", "--set", 'chaos=[{mode="home-lost"}]')
    with sitl("takeoff-hover", *arguments) as vehicle:
        with ear(vehicle.gcs_port) as gcs, ear(vehicle.offboard_port) as offboard:
            heard = [{f.message.get_type() for f in frames(each, 1_500_000)} for each in (gcs, offboard)]
        assert [("HEARTBEAT" in kinds, "HOME_POSITION" in kinds) for kinds in heard] == [(False, False), (True, False)]
        for line in ("heartbeat-lost on port gcs", "landed-unknown on port all", "home-lost on port all"):
            assert f"misbehaves: {line}" in vehicle.log()


def test_the_list_names_every_mode(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    assert main(["chaos"]) == 0
    printed = capsys.readouterr().out
    assert all(row.usage(name) in printed for name, row in TABLE.items())
    assert main(["chaos", "--json"]) == 0
    rows: list[dict[str, Any]] = json.loads(capsys.readouterr().out)
    assert {row["name"]: row["does"] for row in rows} == {name: row.text for name, row in TABLE.items()}


@pytest.mark.sockets
def test_a_vehicle_for_tests_of_clients_runs_and_ends() -> None:
    with testing.vehicle(speed=4.0) as running, ear(running.offboard_port) as offboard:
        assert "HEARTBEAT" in {f.message.get_type() for f in frames(offboard, 1_500_000)}
        with running.chaos.during("heartbeat-lost"):
            offboard.recv(2048)
            frames(offboard, 500_000)  # what was on its way
            assert "HEARTBEAT" not in {f.message.get_type() for f in frames(offboard, 1_500_000)}
        assert running.chaos.active == ()
    with pytest.raises(ScenarioError, match="no such shipped file"), testing.vehicle("no-such-scenario"):
        pass


@pytest.mark.sockets
def test_what_ends_such_a_vehicle_early_is_told() -> None:
    class Broken(Exception):
        pass

    stepped = threading.Event()

    def step(now_us: int) -> None:
        stepped.set()
        raise Broken

    def run() -> None:
        with testing.vehicle() as running:
            running.core.step = step
            assert stepped.wait(PATIENCE_S)

    with pytest.raises(Broken):
        run()


def test_the_page_shows_a_scenario_and_modes_that_there_are(tmp_path: Path) -> None:
    text = PAGE.read_text("utf-8")
    (example,) = re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
    path = tmp_path / "example.toml"
    path.write_text(example, "utf-8")
    assert [window.mode for window in scenario.load(str(path)).scenario.chaos] == ["heartbeat-lost", "mission-ack-lost"]
    spoken = set(re.findall(r"`([a-z]+(?:-[a-z]+)+)(?::[^`]*)?`", text))
    assert spoken - TABLE.keys() <= {"protocol-chaos"}
