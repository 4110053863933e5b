"""`mavsitl link`, `inject` and `param`: what they ask for, what they print, their exit codes; and once on sockets."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest

from mavsitl import drivers, ends
from mavsitl.ask import Ask, CommandTask, ListTask, ParameterTask, Reply
from mavsitl.cli import main
from mavsitl.codec import encode
from mavsitl.dialect import mavlink
from mavsitl.link.address import Address
from mavsitl.link.base import Source
from mavsitl.link.memory import MemoryLink
from mavsitl.link.udp import LOOPBACK
from mavsitl.pair import free_ports


class Asked:
    """Stands for the vehicle: notes what it is asked and does all of it, unless `problem` says otherwise."""

    def __init__(self) -> None:
        self.address = ""
        self.system_id: int | None = None
        self.wishes: list[tuple[str, float | None]] = []
        self.command: tuple[float, ...] = ()
        self.problem = ""
        self.values: dict[str, float] = {}

    def __call__(self, task: Any, address: Address, *, system_id: int | None, patience_s: float) -> Reply:
        self.address, self.system_id = str(address), system_id
        if isinstance(task, ParameterTask):
            self.wishes = list(task._wishes)
            self.values = {name: 0.0 if value is None else value for name, value in self.wishes}
        elif isinstance(task, CommandTask):
            self.command = (task._command, *task._params)
        else:
            assert isinstance(task, ListTask)
            self.values = {"COM_OF_LOSS_T": 1.0, "SIM_LINK_DOWN": 0, "SIM_LINK_LOSS": 0.1}
        return Reply(
            ok=not self.problem, vehicle=1, parameters=self.values, result="ACCEPTED", texts=("said so",),
            problem=self.problem,
        )  # fmt: skip


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Asked:
    made = Asked()
    monkeypatch.setattr(ends, "ask", made)
    return made


def test_link_shows_everything_where_nothing_is_said(asked: Asked, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["link"]) == 0
    assert asked.address == "udpout:127.0.0.1:18570"
    assert [value for _, value in asked.wishes] == [None] * 11
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["SIM_LINK_DIR", "direction", "both"]
    assert lines[-1] == "vehicle 1 says: said so"


def test_link_sets_what_is_said_the_direction_first_and_the_outage_last(asked: Asked) -> None:
    arguments = ["link", "--down", "--latency", "40", "--loss", "0.05", "--direction", "to-vehicle", "--instance", "2"]
    assert main(arguments) == 0
    assert asked.address == "udpout:127.0.0.1:18572"
    assert asked.wishes == [
        ("SIM_LINK_DIR", 2.0), ("SIM_LINK_LAT", 40.0), ("SIM_LINK_LOSS", 0.05), ("SIM_LINK_DOWN", 1.0),
    ]  # fmt: skip


def test_the_ground_stations_link_is_spoken_to_over_the_other_one(asked: Asked) -> None:
    assert main(["link", "--gcs", "--reset", "--burst", "100", "--instance", "1", "--system", "2"]) == 0
    assert asked.address == "udpout:127.0.0.1:14581"
    assert asked.system_id == 2
    wishes = dict(asked.wishes)
    assert len(wishes) == 11
    assert wishes.pop("SIM_GLINK_BURST") == 100.0
    assert wishes.pop("SIM_GLINK_GOOD") == 2000.0
    assert set(wishes.values()) == {0.0}


def test_a_refusal_is_exit_1_and_names_the_endpoint(asked: Asked, capsys: pytest.CaptureFixture[str]) -> None:
    asked.problem = "vehicle 1 refuses"
    assert main(["link", "--loss", "0.3"]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.endswith("mavsitl link: udpout:127.0.0.1:18570: vehicle 1 refuses\n")
    assert main(["link", "--gcs", "--down", "--endpoint", "udpout:127.0.0.1:18570"]) == 1
    assert "over --endpoint udpout:127.0.0.1:14580 it has" in capsys.readouterr().err
    assert main(["link", "--loss", "0.3", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["problem"].endswith("refuses")


def test_inject_sends_the_command_by_name(asked: Asked, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inject", "motor", "off", "2"]) == 0
    assert asked.command == (420, 101.0, 1.0, 2.0)
    assert asked.address == "udpout:127.0.0.1:18570"  # INSTANCE is the motor's, not the vehicle's
    assert main(["inject", "motor", "off", "2", "--instance", "3"]) == 0
    assert asked.command == (420, 101.0, 1.0, 2.0)
    assert asked.address == "udpout:127.0.0.1:18573"
    assert main(["inject", "motor", "off", "2", "--endpoint", "udpout:127.0.0.1:18571"]) == 0
    capsys.readouterr()
    assert main(["inject", "motor", "off", "2"]) == 0
    assert capsys.readouterr().out.startswith("motor 2 off: accepted\n")
    assert main(["inject", "rc", "ok"]) == 0
    assert asked.command == (420, 104.0, 0.0, 0.0)
    assert main(["inject", "--list"]) == 0
    text = capsys.readouterr().out
    assert "gyro, accel, mag, baro, gps" in text
    assert "intermittent" in text


def test_param_reads_sets_and_lists(asked: Asked, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["param", "set", "A=1", "B=0.5"]) == 0
    assert asked.wishes == [("A", 1), ("B", 0.5)]
    assert isinstance(asked.wishes[0][1], int)
    assert main(["param", "get", "A"]) == 0
    assert asked.wishes == [("A", None)]
    capsys.readouterr()
    assert main(["param", "list", "SIM_*", "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)["parameters"]) == ["SIM_LINK_DOWN", "SIM_LINK_LOSS"]
    assert main(["param", "list", "NOPE*"]) == 1
    assert "vehicle 1 has no parameter like 'NOPE*'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["inject", "gps"], "TYPE: missing; allowed: ok, off"),
        (["inject", "gsp", "off"], "UNIT: 'gsp' is not allowed; did you mean gps? allowed: gyro"),
        (["param", "set", "A"], "A: not NAME=VALUE"),
        (["param", "set", "A=x"], "A=x: 'x' is not a number"),
        (["param", "get", "A=1"], "get takes a name alone"),
        (["param", "get"], "get: name at least one parameter"),
        (["param", "get", "A" * 17], "1 to 16 ASCII characters"),
        (["param", "list", "A", "B"], "one pattern at most"),
        (["param", "get", "A", "--endpoint", "18570"], "is not an endpoint"),
        (["param", "get", "A", "--endpoint", "tcp:127.0.0.1:1", "--instance", "1"], "--instance: not with --endpoint"),
    ],
)
def test_wrong_arguments_are_exit_2(
    asked: Asked, capsys: pytest.CaptureFixture[str], arguments: list[str], text: str
) -> None:
    assert main(arguments) == 2
    assert text in capsys.readouterr().err


def test_a_negative_loss_is_no_loss(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["link", "--loss", "-1"]) == 2
    assert "a finite number from 0 to 1" in capsys.readouterr().err


class Late(MemoryLink):
    """Like a TCP client: it tries to connect by `receive`, at the third time with success."""

    def __init__(self) -> None:
        super().__init__("late", 100)
        self.tries = 0

    def wait(self, timeout_s: float) -> bool:
        return self.tries >= 3

    def receive(self, now_us: int, limit: int = 256) -> list[tuple[bytes, Source]]:
        self.tries += 1
        value = mavlink.MAVLink_param_value_message(b"A", 1.0, 9, 1, 0)
        messages = (mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3), value)
        return [(encode(message, 0, 1, 1), ("late",)) for message in messages] if self.tries >= 3 else []


def test_a_server_may_come_later() -> None:
    asking = Ask(ListTask(), patience_us=60_000_000)
    drivers.run_ask(asking, Late())
    assert asking.reply() == Reply(ok=True, vehicle=1, parameters={"A": 1.0}, result="", texts=(), problem="")


@pytest.mark.sockets
def test_a_running_vehicles_links_are_cut_and_mended(capsys: pytest.CaptureFixture[str]) -> None:
    """Over UDP and TCP: the ground stations' links are cut and silent, the off-board one brings them back."""
    gcs, gcs_remote, own, remote, tcp = free_ports(5)
    process = subprocess.Popen(
        [
            sys.executable, "-m", "mavsitl", "vehicle", "--no-state", "--tcp-port", str(tcp),
            "--gcs-port", str(gcs), "--gcs-remote", f"{LOOPBACK}:{gcs_remote}",
            "--offboard-port", str(own), "--offboard-remote", f"{LOOPBACK}:{remote}",
        ],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    over_udp, over_tcp = (["--endpoint", f"{kind}:{LOOPBACK}:{port}"] for kind, port in (("udpout", gcs), ("tcp", tcp)))
    other = ["--endpoint", f"udpout:{LOOPBACK}:{own}"]
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("vehicle 1")
        assert main(["link", "--timeout", "120", *over_tcp]) == 0  # it may have to compile
        assert main(["param", "set", "COM_OF_LOSS_T=0.5", *over_udp]) == 0
        assert main(["link", "--gcs", "--down", *other]) == 0
        for cut in (over_udp, over_tcp):
            capsys.readouterr()
            assert main(["param", "get", "COM_OF_LOSS_T", "--timeout", "0.6", *cut]) == 1
            assert "no vehicle is heard within 0.6 s" in capsys.readouterr().err
        assert main(["link", "--gcs", "--up", "--latency", "30", *other]) == 0
        capsys.readouterr()
        for mended in (over_udp, over_tcp):
            assert main(["param", "get", "COM_OF_LOSS_T", *mended]) == 0
            assert capsys.readouterr().out.split() == ["COM_OF_LOSS_T", "0.5"]
    finally:
        process.terminate()
        output, _ = process.communicate(timeout=30.0)
    assert process.returncode == 0, output
    for place in ("gcs_link", "tcp_link"):
        assert f"{place} to_ground: sent" in output
        assert any(f"{place} to_vehicle" in line and "outage" in line for line in output.splitlines())
