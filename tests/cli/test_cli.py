"""The commands: help, exit codes, messages, and what a run leaves behind."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pyulog import ULog

from mavsitl import __version__, cli, pair, scenario
from mavsitl.cli import main
from mavsitl.link.udp import LOOPBACK

COMMANDS = (
    "fly",
    "vehicle",
    "ground",
    "check",
    "link",
    "inject",
    "param",
    "sweep",
    "tune",
    "bench",
    "view",
    "report",
    "log",
    "scenarios",
    "chaos",
    "completion",
)

HELP = {
    "fly": ("--seed", "--airframe", "--law", "--level", "--wind-information", "--duration", "--set", "--run-dir",
            "--in-memory", "--no-report", "--json", "report.html", "mavsitl fly hover-wind --law pid"),
    "vehicle": ("--instance", "--system", "--bind", "--offboard-port", "--offboard-remote", "--gcs-port",
                "--gcs-remote", "--lockstep", "--deadline", "--run-dir", "--wing", "--status", "--speed",
                "--until-disarmed", "--chaos", "14580", "18570", "mavsitl vehicle hover-wind --instance 1"),
    "ground": ("--link", "--system", "--vehicle", "--lockstep", "--deadline", "--run-dir", "--wing", "--status",
               "--monitor", "udpin:127.0.0.1:14540", "mavsitl ground spiral-calm --link udpout:"),
    "check": ("--listen", "--for", "--quiet", "--all", "--json", "14550", "14540", "18570", "Exit codes",
              "udpout:HOST:PORT", "mavsitl check --listen tcp:127.0.0.1:5760"),
    "link": ("--gcs", "--latency", "--jitter", "--loss", "--burst", "--good", "--reorder", "--duplicate", "--corrupt",
             "--bandwidth", "--direction", "--down", "--up", "--reset", "--endpoint", "--instance", "--system",
             "--timeout", "--json", "14580", "18570", "SIM_GLINK_", "Exit codes", "mavsitl link --gcs --reset"),
    "inject": ("UNIT", "TYPE", "INSTANCE", "--list", "--endpoint", "--instance", "--system", "--timeout", "--json",
               "SYS_FAILURE_EN", "Exit codes", "mavsitl inject motor off 2"),
    "param": ("{get,set,list}", "NAME[=VALUE]", "--endpoint", "--instance", "--system", "--timeout", "--json",
              "Exit codes", "mavsitl param set COM_OF_LOSS_T=0.5"),
    "sweep": ("--set", "--compare", "--seeds", "--jobs", "--scheduler", "--output", "--no-report", "--json",
              "KEY=START:STOP:STEP", "--set wind.speed_20ft_m_s=0,5,10", "130 interrupted"),
    "tune": ("--tune", "--evaluations", "--effort-weight", "--seeds", "--held-out", "--search-duration",
             "--search-seed", "--jobs", "--scheduler", "--output", "--set", "--json", "report.html", "rows.jsonl",
             "mavsitl tune my.toml"),
    "bench": ("CONTROLLER", "--program", "--quick", "--case", "--seeds", "--only", "--jobs", "--speed", "--output",
              "--json", "{url}", "{reference}", "bench.json", "mavsitl bench my.py:MyController"),
    "view": ("RUN", "--listen", "--instance", "--count", "--monitor", "--port", "--bind", "--no-browser",
             "--no-buttons", "--json", "--demo", "--set", "--run-dir", "18570", "14560", "token",
             "mavsitl view --demo"),
    "report": ("RUN", "run.json", "report.html"),
    "scenarios": ("--json",),
    "completion": ("bash", "zsh", "fish", 'eval "$(mavsitl completion bash)"'),
    "chaos": ("--json", "NAME[:ARGUMENT...][@PORT]", "ack-late:2.5:NAV_TAKEOFF@gcs"),
    "log": ("info", "convert", "diff", "mavsitl log convert hover hover.ulg"),
}  # fmt: skip


@pytest.fixture(autouse=True)
def _handlers() -> Iterator[None]:
    """The commands set signal handlers of their own."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def taken() -> Iterator[int]:
    """A port that somebody has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind((LOOPBACK, 0))
        yield holder.getsockname()[1]


def usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit code and stderr, whether the parser or the command found the mistake."""
    try:
        code = main(arguments)
    except SystemExit as ended:
        code = int(ended.code or 0)
    return code, capsys.readouterr().err


# --- help -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
def test_help_names_every_option_and_gives_examples(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    missing = [each for each in HELP[command] if each not in text]
    assert missing == []
    assert max(map(len, text.splitlines())) <= 125


def test_every_option_is_explained() -> None:
    parsers = next(each for each in cli.build_parser()._actions if isinstance(each.choices, dict)).choices
    assert isinstance(parsers, dict)
    assert tuple(parsers) == COMMANDS
    for name, parser in parsers.items():
        for action in parser._actions:
            assert action.help, f"{name}: {action.option_strings or action.dest} has no help"


def test_no_command_shows_the_help_and_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    text = capsys.readouterr().out
    assert all(command in text for command in COMMANDS)
    assert "Exit codes: 0 done; 1 the run failed" in text


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"mavsitl {__version__}\n"


# --- mistakes -------------------------------------------------------------------------------------

MISTAKES: dict[str, tuple[list[str], tuple[str, ...]]] = {
    "unknown command": (["land"], ("'land'", "fly")),
    "unknown option": (["fly", "--fast"], ("--fast",)),
    "unknown scenario": (["fly", "hover-clam"], ("hover-clam", "hover-calm", "spiral-wind", ".toml")),
    "missing file": (["fly", "none.toml"], ("none.toml", "no such file")),
    "bad law": (["fly", "--law", "lqr"], ("--law", "'lqr'", "pidnn", "pid")),
    "bad seed": (["fly", "--seed", "-1"], ("--seed", "'-1'", "whole number from 0")),
    "seed not a number": (["fly", "--seed", "x"], ("--seed", "'x'")),
    "duration": (["fly", "--duration", "nan"], ("--duration", "'nan'", "finite number above 0")),
    "airframe": (["fly", "--airframe", "boat"], ("boat", "paper", "realistic")),
    "set without value": (["fly", "--set", "seed"], ("--set seed", "KEY=VALUE")),
    "set of nothing": (["fly", "--set", "=3"], ("--set =3", "KEY=VALUE")),
    "set of an unknown key": (["fly", "--set", "noise.wind=3"], ("noise.wind", "position_m")),
    "set of a wrong type": (["fly", "--set", "noise.position_m=much"], ("noise.position_m", "'much'", "number >= 0")),
    "set below a value": (["fly", "--set", "title.x=3"], ("title.x", "not a table")),
    "second scenario": (["fly", "hover-calm", "spiral-clam"], ("spiral-clam",)),
    "system 0": (["vehicle", "--system", "0"], ("--system", "'0'", "from 1 to 255")),
    "ground's system": (["ground", "--system", "256"], ("--system", "'256'", "from 1 to 255")),
    "instance": (["vehicle", "--instance", "-1"], ("--instance", "'-1'", "from 0 to 254")),
    "port": (["vehicle", "--offboard-port", "65536"], ("--offboard-port", "'65536'", "from 0 to 65535")),
    "gcs port": (["vehicle", "--gcs-port", "x"], ("--gcs-port", "'x'", "from 0 to 65535")),
    "remote": (["vehicle", "--offboard-remote", "192.0.2.1"], ("--offboard-remote 192.0.2.1", "HOST:PORT")),
    "gcs remote": (["vehicle", "--gcs-remote", "192.0.2.1:0"], ("--gcs-remote 192.0.2.1:0", "1 to 65535")),
    "speed": (["vehicle", "--speed", "0"], ("--speed", "'0'", "finite number above 0")),
    "infinite speed": (["vehicle", "--speed", "inf"], ("--speed", "'inf'", "finite number above 0")),
    "too slow": (["vehicle", "--speed", "0.1"], ("--speed", "'0.1'", "0.5 or more")),
    "paced lock-step": (["vehicle", "--lockstep", "--speed", "2"], ("--speed", "not with --lockstep")),
    "lock-step's chaos": (["vehicle", "--lockstep", "--chaos", "mute"], ("--chaos", "not with --lockstep")),
    "no such chaos": (["vehicle", "--chaos", "ack-lst"], ("no chaos mode 'ack-lst'", "did you mean ack-lost")),
    "lock-step's gcs": (["vehicle", "--lockstep", "--gcs-port", "18570"], ("--gcs-port", "not with --lockstep")),
    "deadline in real time": (["vehicle", "--deadline", "3"], ("--deadline", "only with --lockstep")),
    "vehicle in real time": (["ground", "--vehicle", "127.0.0.1:1"], ("--vehicle", "only with --lockstep")),
    "deadline": (["ground", "--deadline", "nan"], ("--deadline", "'nan'", "finite number above 0")),
    "endpoint": (["ground", "--link", "serial:/dev/tty"], ("'serial:/dev/tty'", "udpin:HOST:PORT", "udpout:HOST:PORT")),
    "check's endpoint": (["check", "--listen", "14550"], ("'14550'", "udpin:HOST:PORT", "tcp:HOST:PORT")),
    "check's time": (["check", "--for", "0"], ("--for", "'0'", "finite number above 0")),
    "lock-step over TCP": (
        ["ground", "--lockstep", "--link", "tcp:127.0.0.1:5760"], ("--link tcp:127.0.0.1:5760", "udpin:HOST:PORT")
    ),
    "vehicle's duration": (["vehicle", "--duration", "3"], ("--duration", "no effect on the vehicle")),
    "ground's seed": (["ground", "--seed", "3"], ("--seed", "no effect on the ground")),
    "wing": (["ground", "--wing", "kite", "--link", "udpin:127.0.0.1:0"], ("'kite'", "installed: paper")),
}  # fmt: skip


@pytest.mark.parametrize(("arguments", "words"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_named_with_what_is_allowed(
    arguments: list[str], words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = usage(arguments, capsys)
    assert code == 2
    assert [word for word in words if word not in said] == []
    assert "Traceback" not in said


@pytest.mark.sockets
@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (["vehicle", "--gcs-port", "0", "--offboard-port", "{}"], "--offboard-port"),
        (["vehicle", "--offboard-port", "0", "--gcs-port", "{}"], "--gcs-port"),
        (["vehicle", "--lockstep", "--offboard-port", "{}"], "--offboard-port"),
        (["ground", "--link", "udpin:127.0.0.1:{}"], "--link udpin:HOST:PORT"),
        (["ground", "--lockstep", "--link", "udpin:127.0.0.1:{}"], "--link udpin:HOST:PORT"),
    ],
)
def test_a_port_in_use_is_named(
    arguments: list[str], option: str, taken: int, capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = usage([each.format(taken) for each in arguments], capsys)
    assert code == 1
    assert f"port {taken} is in use" in said
    assert option in said


@pytest.mark.sockets
def test_a_foreign_address_to_bind_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    code, said = usage(["vehicle", "--bind", "192.0.2.1", "--offboard-port", "0"], capsys)
    assert code == 1
    assert "192.0.2.1 is not an address of this machine" in said
    assert "--bind" in said


@pytest.mark.parametrize(
    "command", ["fly hover-calm --in-memory --duration 1", "vehicle --offboard-port 0 --gcs-port 0"]
)
def test_a_run_folder_that_cannot_be_made_is_named(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.write_text("not a folder")
    code, said = usage([*command.split(), "--run-dir", str(file)], capsys)
    assert code == 1
    assert str(file) in said


# --- scenarios, fly, report -----------------------------------------------------------------------


def test_scenarios_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenarios", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert sorted(listed) == scenario.names()
    assert listed["hover-wind"]["wind"][0]["model"] == "dryden-paper"
    assert listed["hover-wind"]["controller"]["level"] == "body_rate"


def test_scenarios_as_a_table(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["scenarios"]) == 0
    text = capsys.readouterr().out
    assert [name for name in scenario.names() if name not in text] == []


def fly(folder: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    arguments = [
        "fly",
        "hover-wind",
        "--in-memory",
        "--json",
        "--duration",
        "1",
        "--seed",
        "5",
        "--run-dir",
        str(folder),
    ]
    assert main(arguments) == 0
    return json.loads(capsys.readouterr().out)


def test_fly_leaves_run_logs_and_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    told = fly(folder, capsys)
    [flight] = told["flights"]
    assert told["folder"] == str(folder)
    assert flight["flight"]["seed"] == 5
    assert len(flight["rmse"]) == 6
    assert all(0.0 < row["ours"] < 5.0 for row in flight["rmse"])
    written = json.loads((folder / "run.json").read_text())
    assert written["flights"] == [flight["flight"]]
    for name in ("vehicle.ulg", "ground.ulg"):
        log = ULog(str(folder / "hover-wind" / name))
        assert not log.file_corruption
        assert log.data_list
    assert (folder / "hover-wind" / "link.tlog").stat().st_size > 100_000
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "Hover in Dryden wind" in page

    # The report is drawn again from the folder alone, and a damaged folder is refused by name.
    (folder / "report.html").unlink()
    assert main(["report", str(folder)]) == 0
    assert capsys.readouterr().out.strip() == str(folder / "report.html")
    log_file = folder / "hover-wind" / "vehicle.ulg"
    log_file.write_bytes(b"ULog no more" * 100)
    code, said = usage(["report", str(folder)], capsys)
    assert code == 1
    assert str(log_file) in said
    log_file.unlink()
    code, said = usage(["report", str(folder)], capsys)
    assert code == 1
    assert str(log_file) in said
    (folder / "run.json").write_text("{")
    code, said = usage(["report", str(folder)], capsys)
    assert code == 1
    assert "run.json" in said
    assert "damaged" in said


def test_report_of_a_folder_that_is_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, said = usage(["report", str(tmp_path)], capsys)
    assert code == 2
    assert "run.json" in said
    assert "not found" in said


# --- interrupted ----------------------------------------------------------------------------------


@pytest.mark.sockets
def test_ctrl_c_ends_a_vehicle_with_its_log_closed(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind((LOOPBACK, 0))
        peer.settimeout(60.0)
        command = [
            *(sys.executable, "-m", "mavsitl", "vehicle", "hover-calm", "--offboard-port", "0", "--gcs-port", "0"),
            *("--offboard-remote", f"{LOOPBACK}:{peer.getsockname()[1]}", "--run-dir", str(tmp_path)),
        ]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                assert process.stdout.readline().startswith("vehicle 1 (hover-calm): off-board")
                assert process.stdout.readline() == f"logs: {tmp_path}\n"
                for _ in range(20):
                    peer.recv(2048)
                process.send_signal(signal.SIGINT)
                rest, errors = process.communicate(timeout=30.0)
            finally:
                process.kill()
    assert process.returncode == 0
    assert errors == ""
    assert "x real time" in rest
    assert "tick lateness p50" in rest
    assert rest.endswith(f"logs: {tmp_path}\n")
    log = ULog(str(tmp_path / "vehicle.ulg"))
    assert not log.file_corruption
    assert "vehicle_local_position_groundtruth" in {data.name for data in log.data_list}


@pytest.mark.sockets
def test_ctrl_c_ends_a_lockstep_end_that_waits(tmp_path: Path) -> None:
    """At once, not at its deadline."""
    vehicle_port, ground_port = pair.free_ports(2)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind((LOOPBACK, ground_port))
        peer.settimeout(60.0)
        command = [
            *(sys.executable, "-m", "mavsitl", "vehicle", "hover-calm", "--lockstep", "--run-dir", str(tmp_path)),
            *("--offboard-port", str(vehicle_port), "--offboard-remote", f"{LOOPBACK}:{ground_port}"),
        ]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            try:
                peer.recv(2048)
                process.send_signal(signal.SIGINT)
                _, errors = process.communicate(timeout=30.0)
            finally:
                process.kill()
    assert process.returncode == 130
    assert errors == f"mavsitl vehicle: interrupted\nlogs so far: {tmp_path}\n"


@pytest.mark.sockets
def test_an_interrupted_fly_leaves_readable_logs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C in the middle of the flight, by the signal itself."""
    original = pair.fly
    signal.signal(signal.SIGINT, signal.default_int_handler)

    def interrupted(name: str, settings: list[str], folder: Path, on_event: pair.OnEvent) -> pair.Result:
        def watch(end: str, event: pair.Event) -> None:
            on_event(end, event)
            if event["event"] == "progress" and event["flight_time_s"] > 1.5:
                signal.raise_signal(signal.SIGINT)

        return original(name, settings, folder, watch)

    monkeypatch.setattr(pair, "fly", interrupted)
    assert main(["fly", "hover-calm", "--duration", "100000", "--run-dir", str(tmp_path)]) == 130
    said = capsys.readouterr()
    assert "interrupted" in said.err
    assert f"logs so far: {tmp_path}" in said.err
    for name in ("vehicle.ulg", "ground.ulg"):
        log = ULog(str(tmp_path / "hover-calm" / name))
        assert not log.file_corruption
        assert log.last_timestamp > 1_500_000
