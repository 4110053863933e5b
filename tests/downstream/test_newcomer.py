"""The pieces of `python -m tests.downstream.newcomer`, without a network: what README says, and what is timed."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from mavsitl import testing
from tests.downstream import newcomer
from tests.downstream.steps import StepError


def test_readme_has_both_in_one_command() -> None:
    found = newcomer.commands("file:///somewhere")
    assert set(found) == {"fly", "vehicle"}
    for parts in found.values():
        assert parts[0] == "git clone file:///somewhere mavsitl"
        assert [newcomer._named(part) for part in parts[1:-1]] == ["", "virtual environment", "install"]


def test_parts_are_timed_up_to_the_one_that_fails(tmp_path: Path) -> None:
    walk = newcomer.Walk(["true", "cd .", "false", "true"], tmp_path / "walk", str(tmp_path / "pip"))
    with walk.running() as process:
        assert process.wait(30.0) == 1
    assert [name for name, _ in walk.times()] == ["true", ""]
    assert all(seconds >= 0.0 for _, seconds in walk.times())


def test_a_run_without_a_report_is_told(tmp_path: Path) -> None:
    walk = newcomer.Walk(["mkdir mavsitl", "echo report: runs/report.html"], tmp_path / "walk", str(tmp_path / "pip"))
    with pytest.raises(StepError, match="no report; exit code 0"):
        newcomer.first_report(walk)


def test_what_runs_is_ended(tmp_path: Path) -> None:
    walk = newcomer.Walk(["true", "sleep 1000"], tmp_path / "walk", str(tmp_path / "pip"))
    with walk.running() as process:
        pass
    assert process.returncode is not None


@pytest.mark.sockets
def test_a_port_that_is_taken_is_told() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        with pytest.raises(StepError, match=f"UDP {port} is taken"), newcomer.listening(port):
            pass


@pytest.mark.sockets
def test_another_vehicle_is_not_taken_for_ours() -> None:
    with newcomer.listening(0) as link, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        newcomer.silent_until(link, lambda: True)
        other.sendto(b"a word", ("127.0.0.1", link.port.getsockname()[1]))
        with pytest.raises(StepError, match=r"another vehicle, at 127\.0\.0\.1:"):
            newcomer.silent_until(link, lambda: False)


def test_a_command_that_fails_starts_no_vehicle(tmp_path: Path) -> None:
    walk = newcomer.Walk(["true", "false", "true"], tmp_path / "walk", str(tmp_path / "pip"))
    with pytest.raises(StepError, match="no vehicle has been started; exit code 1"):
        newcomer.ready_vehicle(walk, port=0)


@pytest.mark.sockets
def test_the_station_gets_parameters_and_a_mission() -> None:
    from pymavlink import mavutil

    with testing.vehicle() as vehicle:
        spoken = mavutil.mavlink_connection(vehicle.gcs_device, source_system=255, source_component=190)
        spoken.mav.heartbeat_send(6, 8, 0, 0, 0)
        try:
            found = newcomer.station(spoken, 60.0)
        finally:
            spoken.close()
    assert found.parameters > 200
    assert found.mission_s > 0.0
