"""The tools that people have open what we write: pyulog, pymavlink, MAVProxy; and rules of those that are no Python.

PlotJuggler and QGroundControl are not run: what their loaders (`ulog_parser.cpp`, `LogReplayLink.cc`) demand of a file
is written out here.
"""

from __future__ import annotations

import csv
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mavsitl.dialect import mavlink
from mavsitl.log.content import load
from mavsitl.log.convert import convert


@pytest.fixture(scope="module")
def one(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run's ULogs as one."""
    path = tmp_path_factory.mktemp("one") / "run.ulg"
    convert(run, path)
    return path


def tool(module: str, *arguments: str) -> str:
    """What a tool of pyulog prints."""
    code = f"import sys; from {module} import main; sys.argv[1:] = {list(arguments)!r}; main()"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def test_ulog_info(run: Path) -> None:
    said = tool("pyulog.info", str(run / "vehicle.ulg"))
    assert "No Dropouts" in said
    assert "sys_name: mavsitl" in said
    assert "vehicle_attitude_groundtruth" in said


def test_ulog2csv_writes_the_numbers_that_we_convert(one: Path, tmp_path: Path) -> None:
    tool("pyulog.ulog2csv", "-o", str(tmp_path), str(one))
    with (tmp_path / "run_vehicle_attitude_0.csv").open(newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["timestamp", "q[0]", "q[1]", "q[2]", "q[3]"]
    table = load(one).tables["vehicle_attitude"]
    np.testing.assert_array_equal(np.array(rows)[:, 1:].astype(np.float32), table["q"])


def test_ulog_params_and_messages(run: Path) -> None:
    vehicle = str(run / "vehicle.ulg")
    assert "MC_ROLLRATE_P" in tool("pyulog.params", "-i", vehicle)
    assert "Armed by external command" in tool("pyulog.messages", vehicle)


def test_mavlogdump(run: Path) -> None:
    program = Path(sys.executable).with_name("mavlogdump.py")
    if not program.exists():
        pytest.skip("pymavlink's scripts are not installed beside this Python")
    said = subprocess.run(
        [sys.executable, str(program), "--types", "STATUSTEXT", str(run / "link.tlog")],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert "Armed by external command" in said


def test_mavexplorer_s_graphs(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MAVExplorer draws by this class; its window needs a screen."""
    monkeypatch.setenv("MPLBACKEND", "Agg")
    grapher = pytest.importorskip("MAVProxy.modules.lib.grapher", reason="MAVProxy is not installed")
    from pymavlink import mavutil

    graph = grapher.MavGraph()
    tlog = mavutil.mavlink_connection(str(run / "link.tlog"))
    graph.add_mav(tlog)
    fields = ("degrees(ATTITUDE.roll)", "ODOMETRY.z", "sqrt(LOCAL_POSITION_NED.vx**2+LOCAL_POSITION_NED.vy**2)")
    for field in fields:
        graph.add_field(field)
    graph.process([], [], 0)
    tlog.close()
    tables = load(run / "link.tlog").tables
    np.testing.assert_allclose(graph.y[0], np.degrees(tables["ATTITUDE"]["roll"]))
    np.testing.assert_array_equal(graph.y[1], tables["ODOMETRY"]["z"])
    assert len(graph.y[2]) == len(tables["LOCAL_POSITION_NED"]["vx"])


# --- rules of PlotJuggler's loader


def messages(data: bytes) -> Iterator[tuple[str, bytes]]:
    at = 16
    while at < len(data):
        size, kind = struct.unpack_from("<HB", data, at)
        assert at + 3 + size <= len(data)
        yield chr(kind), data[at + 3 : at + 3 + size]
        at += 3 + size


SIZES = {
    "int8_t": 1, "uint8_t": 1, "bool": 1, "char": 1, "int16_t": 2, "uint16_t": 2, "int32_t": 4, "uint32_t": 4,
    "float": 4, "int64_t": 8, "uint64_t": 8, "double": 8,
}  # fmt: skip


@pytest.mark.parametrize("joint", [False, True])
def test_plotjuggler_s_rules(run: Path, one: Path, joint: bool) -> None:
    data = (one if joint else run / "vehicle.ulg").read_bytes()
    assert data[:7] == b"ULog\x01\x12\x35"
    found = list(messages(data))
    kinds = [kind for kind, _ in found]
    assert kinds[0] == "B"
    flags = found[0][1]
    assert len(flags) == 40
    assert not any(flags[8:16])  # no incompatible feature
    first = kinds.index("A")  # ends the definitions
    assert set(kinds[:first]) <= set("BFIMPQ")
    assert set(kinds[first:]) <= set("ADLPS")
    formats: dict[str, int] = {}
    names: list[str] = []
    subscribed: dict[int, int] = {}
    for kind, body in found:
        if kind == "F":
            name, _, fields = body.decode("ascii").partition(":")
            formats[name] = 0
            for declaration in filter(None, fields.split(";")):
                type_name, field = declaration.split(" ")
                base, _, count = type_name.partition("[")
                formats[name] += SIZES[base] * int(count.rstrip("]") or 1)
                names.append(field)
        elif kind == "P":
            length = body[0]
            type_name, name = body[1 : 1 + length].decode("ascii").split(" ")
            assert (type_name, len(body)) in {("int32_t", 1 + length + 4), ("float", 1 + length + 4)}
            assert len(name) <= 16
        elif kind == "A":
            _, number = struct.unpack_from("<BH", body)
            subscribed[number] = formats[body[3:].decode("ascii")]
        elif kind == "D":
            assert len(body) == 2 + subscribed[struct.unpack_from("<H", body)[0]]
    parameters = [body[1 : 1 + body[0]] for kind, body in found[:first] if kind == "P"]
    assert len(parameters) == len(set(parameters))  # it lists each definition


# --- rules of QGroundControl's replay


def test_qgroundcontrol_s_rules(run: Path) -> None:
    """A stamp of 8 bytes, big-endian, not after now, then one frame that MAVLink's own parser takes, to the end."""
    data = (run / "link.tlog").read_bytes()
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = False  # raises for a byte that is in no frame
    stamps = []
    at = 0
    while at < len(data):
        stamps.append(int.from_bytes(data[at : at + 8], "big"))
        at += 8
        message = None
        while message is None:
            message = parser.parse_char(data[at : at + 1])
            at += 1
    assert at == len(data)
    assert stamps == sorted(stamps)
    assert stamps[-1] > stamps[0]  # else it says that the log is empty
    assert stamps[-1] < time.time() * 1e6  # else it takes the bytes the other way round
