"""`mavsitl check` as a program, beside a vehicle process and beside programs that have its ports."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from mavsitl import ends
from mavsitl.cli import main
from mavsitl.codec import parse
from mavsitl.dialect import mavlink
from mavsitl.link.address import Address
from mavsitl.link.holders import find_command, holders
from mavsitl.link.udp import LOOPBACK
from mavsitl.pair import free_ports

pytestmark = pytest.mark.sockets

ATTITUDE: int = mavlink.MAVLINK_MSG_ID_ATTITUDE


@pytest.fixture
def taken() -> Iterator[int]:
    """A port that this process has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind((LOOPBACK, 0))
        yield holder.getsockname()[1]


@pytest.fixture
def vehicle() -> Iterator[tuple[int, int, int, int]]:
    """A vehicle process that talks by now; its ports: ground station's, where it sends, off-board, where it sends."""
    gcs, gcs_remote, own, remote = free_ports(4)
    process = subprocess.Popen(
        [
            sys.executable, "-m", "mavsitl", "vehicle", "--no-state",
            "--gcs-port", str(gcs), "--gcs-remote", f"{LOOPBACK}:{gcs_remote}",
            "--offboard-port", str(own), "--offboard-remote", f"{LOOPBACK}:{remote}",
        ],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("vehicle 1")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first:
            first.bind((LOOPBACK, gcs_remote))
            first.settimeout(120.0)
            while not any(type(frame.message).id == ATTITUDE for frame in parse(first.recv(2048))):
                pass  # HEARTBEATs alone are of a vehicle that still starts, and may have to compile
        yield gcs, gcs_remote, own, remote
    finally:
        process.terminate()
        output, _ = process.communicate(timeout=30.0)
    assert process.returncode == 0, output


def test_a_vehicle_is_found_at_both_its_ports_and_beside_another_client(
    vehicle: tuple[int, int, int, int], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    gcs, gcs_remote, own, remote = vehicle
    listen = ["--listen", f"udpin:{LOOPBACK}:{gcs_remote}", "--listen", f"udpin:{LOOPBACK}:{remote}"]
    assert main(["check", "--for", "4", "--json", *listen]) == 0
    told: dict[str, Any] = json.loads(capsys.readouterr().out)
    for port, address, least_per_s in zip(told["ports"], (gcs, own), (20, 100), strict=True):
        [heard] = port["heard"]
        assert heard["address"] == f"{LOOPBACK}:{address}"
        assert (heard["system_id"], heard["component_id"], heard["autopilot"]) == (1, 1, "PX4")
        assert (heard["mode"], heard["armed"], heard["mavlink_versions"]) == ("AUTO.LOITER", False, [2])
        assert (heard["answer"], heard["version"]) == ("answered", "1.17.0")
        assert heard["per_s"] > least_per_s
        assert port["junk"] == []

    # Somebody else has the ground station's port: the vehicle is asked at its own.
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.bind((LOOPBACK, gcs_remote))
        listen = ["--listen", f"udpin:{LOOPBACK}:{gcs_remote}", "--listen", f"udpout:{LOOPBACK}:{gcs}"]
        assert main(["check", "--for", "3", "--all", *listen]) == 0
    text = capsys.readouterr().out
    assert "is in use by" in text
    assert f"messages of 1/1 at {LOOPBACK}:{gcs}" in text
    assert "GLOBAL_POSITION_INT" in text
    assert text.endswith("A vehicle was heard and answers.\n")


def test_without_a_vehicle_the_exit_code_and_the_last_line_say_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--for", "0.05", "--listen", f"udpin:{LOOPBACK}:0"]) == 1
    text = capsys.readouterr().out
    assert "Nothing came" in text
    assert text.endswith("No vehicle that answers.\n")


def test_a_port_in_use_is_told_with_its_holder(taken: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--for", "0.05", "--json", "--listen", f"udpin:{LOOPBACK}:{taken}"]) == 1
    [port] = json.loads(capsys.readouterr().out)["ports"]
    assert port["ear"]["taken"]
    assert str(taken) in port["ear"]["error"]
    if sys.platform == "linux":
        assert f"process {os.getpid()}" in port["ear"]["holder"]


def test_holders_names_taken_ports_alone(taken: int) -> None:
    [free] = free_ports(1)
    found = holders([taken, free])
    assert list(found) == [taken]
    assert str(taken) in find_command(taken)


def test_a_taken_default_port_is_replaced_by_the_vehicle_port_that_is_bound(
    taken: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    [other] = free_ports(1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind((LOOPBACK, 0))
        vehicle.settimeout(10.0)
        monkeypatch.setattr(ends, "GCS_REMOTE_PORT", taken)
        monkeypatch.setattr(ends, "OFFBOARD_REMOTE_PORT", other)
        monkeypatch.setattr(ends, "GCS_PORT", vehicle.getsockname()[1])
        report = ends.check(None, duration_s=0.05, ask=True)
        assert vehicle.recv(2048)[0] == 0xFD
        held = vehicle.getsockname()[1]
    assert [port.ear.endpoint for port in report.ports][:1] == [str(Address("udpin", LOOPBACK, taken))]
    assert report.ports[0].ear.taken
    assert f"udpout:{LOOPBACK}:{held}" in [port.ear.endpoint for port in report.ports if not port.ear.error]
