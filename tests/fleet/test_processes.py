"""Fleets as processes: ports and ids as PX4's instances, what they print and leave behind, and what is refused."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from mavsitl import ends
from mavsitl.cli import main
from mavsitl.link.address import Address
from mavsitl.link.udp import LOOPBACK
from tests.bench.bench_fleet import free_block
from tests.bench.bench_fleet import main as bench

PATIENCE_S = 120.0


@contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    running = subprocess.Popen(
        [sys.executable, "-m", "mavsitl", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    try:
        yield running
    finally:
        if running.poll() is None:
            running.terminate()
        running.wait(PATIENCE_S)
        for stream in (running.stdout, running.stderr):
            assert stream is not None
            stream.close()


def end_of(running: subprocess.Popen[bytes]) -> dict[str, Any]:
    """The event "end"."""
    out, err = running.communicate(timeout=PATIENCE_S)
    assert running.returncode == 0, err.decode()
    return json.loads(out.splitlines()[-1])  # type: ignore[no-any-return]


def fly(count: int, vehicle: Sequence[str], ground: Sequence[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Both ends' last events after a short flight."""
    common = ("formation-spiral", "--count", str(count), "--status", "json", "--set", "duration_s=1.5")
    with (
        process("ground", *common, *ground) as controllers,
        process("vehicle", *common, "--until-disarmed", *vehicle) as vehicles,
    ):
        return end_of(vehicles), end_of(controllers)


@pytest.mark.sockets
def test_a_formation_flies_over_udp_and_leaves_logs_and_state_of_each(tmp_path: Path) -> None:
    offboard = free_block(6)
    vehicle, ground = fly(
        2,
        ("--instance", "4", "--offboard-port", f"{offboard}", "--offboard-remote", f"{LOOPBACK}:{offboard + 2}",
         "--gcs-port", f"{offboard + 4}", "--run-dir", str(tmp_path / "run"), "--state-dir", str(tmp_path / "state")),
        ("--instance", "4", "--link", f"udpin:{LOOPBACK}:{offboard + 2}", "--run-dir", str(tmp_path / "run")),
    )  # fmt: skip
    assert [each["system_id"] for each in vehicle["vehicles"]] == [5, 6]
    assert [each["system_id"] for each in ground["vehicles"]] == [5, 6]
    assert vehicle["finished"] is ground["finished"] is True
    assert vehicle["collisions"] == []
    assert all(0.0 < each["rms_m"] <= each["worst_m"] < 3.0 for each in ground["vehicles"])
    for instance in (4, 5):
        logs = {each.name for each in (tmp_path / "run" / f"vehicle-{instance}").iterdir()}
        assert logs == {"vehicle.ulg", "ground.ulg", "link.tlog"}
        assert (tmp_path / "state" / f"instance-{instance}" / "card").is_dir()


@pytest.mark.sockets
def test_a_formation_flies_over_one_link() -> None:
    ports = free_block(3)
    vehicle, ground = fly(
        3,
        ("--one-link", "--no-state", "--offboard-port", f"{ports}", "--offboard-remote", f"{LOOPBACK}:{ports + 1}",
         "--gcs-port", f"{ports + 2}"),
        ("--one-link", "--link", f"udpin:{LOOPBACK}:{ports + 1}"),
    )  # fmt: skip
    assert vehicle["finished"] is ground["finished"] is True
    assert [each["system_id"] for each in ground["vehicles"]] == [1, 2, 3]
    assert not vehicle["dropped"]


@pytest.mark.sockets
def test_a_port_that_is_taken_is_named_with_its_option() -> None:
    block = free_block(4)
    ports = ("--offboard-port", f"{block}", "--gcs-port", f"{block + 2}")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((LOOPBACK, block + 1))
        with process("vehicle", "--count", "2", "--no-state", *ports) as running:
            _, err = running.communicate(timeout=PATIENCE_S)
    assert running.returncode == 1
    assert f"port {block + 1} is in use" in err.decode()
    assert "--offboard-port N or --instance I" in err.decode()


@pytest.mark.sockets
def test_in_memory_a_formation_flies_the_same_bytes_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ends_of = []
    for run in ("one", "two"):
        folder = str(tmp_path / run)
        assert main(["fly", "formation-spiral", "--count", "2", "--duration", "1", "--json", "--run-dir", folder]) == 0
        ends_of.append(json.loads(capsys.readouterr().out))
    hashes = [[each["wire_hash"] for each in end["vehicles"]] for end in ends_of]
    assert hashes[0] == hashes[1]
    assert len(set(hashes[0])) == 2
    written = {each.relative_to(tmp_path / "one").as_posix() for each in (tmp_path / "one").rglob("*.*")}
    assert written == {"run.json", "report.html"} | {
        f"formation-spiral/vehicle-{j}/{name}" for j in (0, 1) for name in ("vehicle.ulg", "ground.ulg", "link.tlog")
    }


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["vehicle", "--one-link"], "--one-link: only with --count"),
        (["vehicle", "--count", "2", "--lockstep"], "--count: not with --lockstep"),
        (["vehicle", "--count", "2", "--tcp-port", "0"], "--tcp-port: with --count only with --one-link"),
        (["vehicle", "--count", "200", "--instance", "100"], "system ids 101 to 300; allowed: up to 250"),
        (["vehicle", "--count", "9", "--gcs-port", "65530"], "--gcs-port: 9 vehicles would need ports up to 65538"),
        (["vehicle", "--count", "2", "--bind", "0.0.0.0", "--no-state"], "say --insecure"),
        (["vehicle", "--count", "2", "--set", "fleet.collision_m=9"], "allowed: less than fleet.spacing_m (3)"),
        (["vehicle", "--count", "2", "--set", 'fleet.formation="v"'], "allowed: 'circle', 'grid', 'line'"),
        (["ground", "--count", "2", "--lockstep"], "--count: not with --lockstep"),
        (["ground", "--count", "2", "--link", "udpin:127.0.0.1:65535"], "would need ports up to 65536"),
        (["fly", "hover-calm", "hover-wind", "--count", "2"], "--count: name one scenario, such as "),
    ],
)  # fmt: skip
def test_what_does_not_go_together_is_refused(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert said in capsys.readouterr().err


def test_from_the_tenth_instance_on_ports_do_not_run_into_others() -> None:
    """14540 + 10 is the ground stations' 14550, 14540 + 40 an off-board port of the vehicles."""
    assert [ends.offboard_remote_port(instance) for instance in (0, 9, 10, 40)] == [14540, 14549, 14549, 14549]
    assert ends.ground_address(9) == Address("udpin", LOOPBACK, 14549)
    assert ends.ground_address(10) == Address("udpout", LOOPBACK, 14590)


@pytest.mark.sockets
@pytest.mark.skipif(sys.platform != "linux", reason="reads the processes' accounts as Linux gives them")
def test_the_bench_in_short(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figure = tmp_path / "fleet.svg"
    assert bench(["--counts", "2", "--seconds", "1", "--figure", str(figure)]) == 0
    row = capsys.readouterr().out.splitlines()[-1].split("|")
    assert row[1].strip() == "2"
    assert float(row[2].strip(" %")) > 0.0
    assert "<svg" in figure.read_text("utf-8")
