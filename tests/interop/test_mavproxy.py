"""MAVProxy, as it comes from the package index, at its own prompt: parameters, plans, arming, flight, restart."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from mavsitl_vehicle.autopilot.parameters import TABLE

from mavsitl.clock import monotonic_us
from mavsitl.link.udp import LOOPBACK
from tests.interop.conftest import PATIENCE_S, Sitl, sitl
from tests.interop.process import Program, mavproxy

pytest.importorskip("MAVProxy", reason="MAVProxy is not installed")

pytestmark = [pytest.mark.interop, pytest.mark.sockets]

SPEED = 3.0
"""Of the simulation that is flown."""

# `mode NAME` cannot work: for PX4's modes MAVProxy finds a tuple where it needs a number. This is DO_SET_MODE.
HOLD, LAND, MISSION = "long 176 1 4 3", "long 176 1 4 6", "long 176 1 4 4"
OFFBOARD, POSITION = "long 176 1 6", "long 176 1 3"

ALARMS = r"fence breach|no link|link .* down|heartbeat lost|Traceback|Exception|ERROR|bad data|Failsafe"

MISSION_TEXT = """QGC WPL 110
0	1	3	22	0	0	0	0	47.397742	8.545594	4	1
1	0	3	16	0	2	0	0	47.397832	8.545594	4	1
2	0	3	16	1	2	0	0	47.397832	8.5457	5	1
3	0	3	21	0	0	0	0	47.397832	8.5457	0	1
"""

FENCE_TEXT = """QGC WPL 110
0	1	3	5001	4	0	0	0	47.399	8.544	0	1
1	0	3	5001	4	0	0	0	47.399	8.547	0	1
2	0	3	5001	4	0	0	0	47.396	8.547	0	1
3	0	3	5001	4	0	0	0	47.396	8.544	0	1
"""


def rows(path: Path) -> list[list[float]]:
    """Command, parameters and place of each item of a plan in QGroundControl's text format."""
    lines = path.read_text("utf-8").splitlines()[1:]
    return [[float(field) for field in line.split()[3:11]] for line in lines]


def loaded(program: Program) -> None:
    """Wait until it has all that it asks for when it starts."""
    program.wait(r"online system 1$")
    program.wait(rf"Received {len(TABLE)} parameters")
    program.wait(r"Saved \d+ parameters")


def undisturbed(program: Program) -> None:
    """No alarm, and not one frame lost."""
    program.do("link", r"\blink 1 OK .* 0 lost, 0\.0% loss")
    found = re.search(ALARMS, program.printed)
    assert found is None, program.printed


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("mavproxy")


@pytest.fixture(scope="module")
def station(folder: Path) -> Iterator[Program]:
    """MAVProxy listening where a ground station does; this vehicle stays on the ground."""
    with sitl() as vehicle, mavproxy(f"udpin:{LOOPBACK}:{vehicle.gcs_port}", folder) as program:
        loaded(program)
        yield program
        undisturbed(program)


def speaks(vehicle: Sitl) -> None:
    """Wait until the vehicle is up, which it is once it sends."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.settimeout(PATIENCE_S)
        ear.bind((LOOPBACK, vehicle.gcs_port))
        ear.recv(1500)


@pytest.fixture(scope="module")
def pilot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Program]:
    """MAVProxy at the vehicle's TCP server; this vehicle flies."""
    folder = tmp_path_factory.mktemp("mavproxy")
    with socket.create_server((LOOPBACK, 0)) as probe:
        port = probe.getsockname()[1]
    with sitl("takeoff-hover", "--tcp-port", str(port), speed=SPEED) as vehicle:
        speaks(vehicle)
        with mavproxy(f"tcp:{LOOPBACK}:{port}", folder) as program:
            loaded(program)
            yield program
            undisturbed(program)


def height_m(program: Program) -> float:
    """Above home, of the newest GLOBAL_POSITION_INT."""
    (match,) = program.do("status GLOBAL_POSITION_INT", r"GLOBAL_POSITION_INT {.*relative_alt : (-?\d+)")
    return int(match[1]) / 1000.0


def fetched(program: Program, name: str, value: float) -> None:
    """Ask for a parameter until it is `value`: MAVProxy sets it some time after it has read the line."""
    until_us = monotonic_us() + round(PATIENCE_S * 1e6)
    answer = None
    while answer != value:
        assert monotonic_us() < until_us, f"{name} is {answer}, not {value}"
        (match,) = program.do(f"param fetch {name}", rf"\b{name} = ([-0-9.]+)$")
        answer = float(match[1])


# --- on the ground ---------------------------------------------------------------------------------------------------


def test_it_sees_a_vehicle_with_every_parameter(station: Program, folder: Path) -> None:
    station.wait(r"\bLOITER> ")
    station.wait(r"GPS lock at 48[78] meters")
    kept = dict(line.split()[:2] for line in (folder / "mav.parm").read_text("utf-8").splitlines())
    assert kept.keys() - {"_HASH_CHECK"} == TABLE.keys()
    exceptions = {name for name, row in TABLE.items() if float(kept[name]) != pytest.approx(row.default, rel=1e-6)}
    assert len(exceptions) < len(TABLE) / 4, "most parameters are at their defaults, few at the airframe's"
    assert float(kept["SYS_AUTOSTART"]) == TABLE["SYS_AUTOSTART"].default  # an INT32, byte-wise


@pytest.mark.parametrize(("name", "value"), [("MIS_TAKEOFF_ALT", 4.5), ("COM_RC_IN_MODE", 3)])
def test_it_sets_a_parameter(station: Program, name: str, value: float) -> None:
    before = station.do(f"param show {name}", rf"{name} +([-0-9.]+)$")[0][1]
    for wanted in (value, float(before)):
        station.type(f"param set {name} {wanted:g}")
        fetched(station, name, wanted)
        (shown,) = station.do(f"param show {name}", rf"{name} +([-0-9.]+)$")
        assert float(shown[1]) == wanted


def test_a_refused_parameter_says_why(station: Program) -> None:
    station.do("param set COM_RC_IN_MODE 99", r"\bAP: .*COM_RC_IN_MODE.*99")
    fetched(station, "COM_RC_IN_MODE", 1)


def test_it_loads_all_parameters_again(station: Program) -> None:
    station.do("param fetch", r"Requested parameter list", rf"Received {len(TABLE)} parameters")


def test_refused_arming_says_why(station: Program) -> None:
    station.do(OFFBOARD, r"Got COMMAND_ACK: DO_SET_MODE: ACCEPTED", r"\bOFFBOARD> ")
    station.do(
        "arm throttle", r"Got COMMAND_ACK: COMPONENT_ARM_DISARM: TEMPORARILY_REJECTED", r"\bAP: Arming denied: .+"
    )
    station.do(HOLD, r"Got COMMAND_ACK: DO_SET_MODE: ACCEPTED", r"\bLOITER> ")


def test_it_arms_and_disarms(station: Program) -> None:
    station.do("arm throttle", r"Got COMMAND_ACK: COMPONENT_ARM_DISARM: ACCEPTED", r"\bARMED$", r"\bAP: Armed")
    station.do("reboot", r"Got COMMAND_ACK: PREFLIGHT_REBOOT_SHUTDOWN: DENIED", r"\bAP: Reboot refused: armed$")
    station.do("disarm", r"Got COMMAND_ACK: COMPONENT_ARM_DISARM: ACCEPTED", r"\bDISARMED$")
    station.do("arm throttle force", r"\bARMED$")
    station.do("disarm force", r"\bDISARMED$")


def test_it_moves_a_mission_to_and_fro(station: Program, folder: Path) -> None:
    plan, copy = folder / "plan.txt", folder / "copy.txt"
    plan.write_text(MISSION_TEXT, "utf-8")
    station.do("wp load plan.txt", r"Sent all 4 waypoints", r"Got MISSION_ACK: TYPE_MISSION: ACCEPTED")
    station.do("wp list", r"Requesting 4 waypoints", r"Saved 4 waypoints to")
    station.do("wp save copy.txt", r"Saved 4 waypoints to copy\.txt")
    assert rows(copy) == [pytest.approx(row, abs=1e-7) for row in rows(plan)]
    station.do("wp set 2", r"Got COMMAND_ACK: DO_SET_MISSION_CURRENT: ACCEPTED", r"\bwaypoint 2$")
    station.do("wp clear", r"Got MISSION_ACK: TYPE_MISSION: ACCEPTED")
    station.do("wp list", r"Requesting 0 waypoints")


def test_it_moves_a_fence_to_and_fro(station: Program, folder: Path) -> None:
    fence, copy = folder / "fence.txt", folder / "copy_of_fence.txt"
    fence.write_text(FENCE_TEXT, "utf-8")
    station.do("fence load fence.txt", r"Sent all 4 fence items", r"Got MISSION_ACK: TYPE_FENCE: ACCEPTED")
    station.do("fence list", r"Requesting 4 fence items", r"Saved 4 fence items to")
    station.do("fence save copy_of_fence.txt", r"Saved 4 fence items to copy_of_fence\.txt")
    assert rows(copy) == [pytest.approx(row, abs=1e-7) for row in rows(fence)]
    station.do("fence clear", r"Got MISSION_ACK: TYPE_FENCE: ACCEPTED")


def test_it_restarts_the_vehicle(station: Program) -> None:
    """The links stay: nothing is lost, and the parameters are as before."""
    station.do("reboot", r"Got COMMAND_ACK: PREFLIGHT_REBOOT_SHUTDOWN: ACCEPTED")
    station.do("param fetch", rf"Received {len(TABLE)} parameters")
    station.do("arm throttle", r"Got COMMAND_ACK: COMPONENT_ARM_DISARM: ACCEPTED", r"\bARMED$")
    station.do("disarm", r"Got COMMAND_ACK: COMPONENT_ARM_DISARM: ACCEPTED", r"\bDISARMED$")


# --- in flight -------------------------------------------------------------------------------------------------------


def test_it_flies(pilot: Program) -> None:
    pilot.do("arm throttle", r"\bARMED$")
    mark = pilot.type("takeoff 6")
    pilot.wait(r"Got COMMAND_ACK: NAV_TAKEOFF: ACCEPTED", mark)
    taking_off = pilot.wait(r"\bTAKEOFF> ", mark)
    pilot.wait(r"\bLOITER> ", taking_off.end())
    assert height_m(pilot) == pytest.approx(6.0, abs=0.5)  # above home, not above the sea

    pilot.do("disarm", r"Got COMMAND_ACK: COMPONENT_ARM_DISARM: DENIED", r"\bAP: Disarming denied: .+")
    pilot.do(POSITION, r"Got COMMAND_ACK: DO_SET_MODE: TEMPORARILY_REJECTED", r"\bAP: POSCTL refused: .*MANUAL_CONTROL")
    pilot.do(MISSION, r"Got COMMAND_ACK: DO_SET_MODE: TEMPORARILY_REJECTED", r"\bAP: .*[Mm]ission")
    pilot.do("long 20", r"Got COMMAND_ACK: NAV_RETURN_TO_LAUNCH: ACCEPTED", r"\bRTL> ")
    pilot.do(HOLD, r"Got COMMAND_ACK: DO_SET_MODE: ACCEPTED", r"\bLOITER> ")
    mark = pilot.type(LAND)
    pilot.wait(r"\bLAND> ", mark)
    pilot.wait(r"\bAP: Disarmed", mark, 2.0 * PATIENCE_S)
    pilot.wait(r"\bDISARMED$", mark)
    assert height_m(pilot) == pytest.approx(0.0, abs=0.5)


def test_it_flies_a_mission(pilot: Program, tmp_path: Path) -> None:
    plan = tmp_path / "plan.txt"
    plan.write_text(MISSION_TEXT, "utf-8")
    pilot.do(f"wp load {plan}", r"Got MISSION_ACK: TYPE_MISSION: ACCEPTED")
    mark = pilot.type("long 300")
    pilot.wait(r"Got COMMAND_ACK: MISSION_START: ACCEPTED", mark)
    pilot.wait(r"\bMISSION> ", mark)
    for n in (1, 2, 3):
        pilot.wait(rf"\bwaypoint {n}$", mark, 2.0 * PATIENCE_S)
    pilot.wait(r"\bAP: Disarmed", mark, 2.0 * PATIENCE_S)
    pilot.wait(r"\bDISARMED$", mark)
    pilot.do("wp clear", r"Got MISSION_ACK: TYPE_MISSION: ACCEPTED")
