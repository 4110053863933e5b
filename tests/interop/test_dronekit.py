"""DroneKit 2.9.2, unmaintained since 2019 and written for ArduPilot: what it can do with PX4, it does here."""

from __future__ import annotations

import collections
import collections.abc
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from mavsitl_vehicle.autopilot.parameters import TABLE

from mavsitl.link.udp import LOOPBACK
from tests.interop.conftest import PATIENCE_S, sitl

pytestmark = [pytest.mark.interop, pytest.mark.sockets]

SPEED = 3.0

HOME = 47.397742, 8.545594


@pytest.fixture(scope="module")
def dronekit() -> Any:
    """The package, with the names that Python 3.10 took out of `collections` put back."""
    for name in ("MutableMapping", "Callable", "Iterable"):
        if not hasattr(collections, name):
            setattr(collections, name, getattr(collections.abc, name))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import dronekit
    except Exception as error:
        pytest.skip(f"dronekit cannot be imported by this Python: {error!r}")
    return dronekit


@pytest.fixture(scope="module")
def copter(dronekit: Any) -> Iterator[Any]:
    """Connected at the ground-station link, with all that `wait_ready` waits for."""
    with sitl(speed=SPEED) as vehicle:
        copter = dronekit.connect(f"udpin:{LOOPBACK}:{vehicle.gcs_port}", wait_ready=True, timeout=PATIENCE_S)
        try:
            yield copter
        finally:
            copter.close()


def wait(copter: Any, condition: Callable[[], bool], what: str, limit_s: float = PATIENCE_S) -> None:
    copter.wait_for(condition, timeout=limit_s, errmsg=f"waited {limit_s:g} s for {what}")


@contextmanager
def messages(copter: Any, *names: str) -> Iterator[list[Any]]:
    """The messages of these names that come from now on."""
    came: list[Any] = []

    def keep(_: Any, name: str, message: Any) -> None:
        came.append(message)

    for name in names:
        copter.add_message_listener(name, keep)
    try:
        yield came
    finally:
        for name in names:
            copter.remove_message_listener(name, keep)


def test_its_attributes_are_filled(copter: Any) -> None:
    copter.wait_ready("autopilot_version", "system_status", "location", "velocity", "battery", timeout=PATIENCE_S)
    assert (copter.version.autopilot_type, copter.version.major, copter.version.minor) == (12, 1, 17)
    assert copter.mode.name == "LOITER"
    assert not copter.armed
    assert copter.system_status.state == "STANDBY"
    assert copter.gps_0.fix_type == 3
    assert copter.gps_0.satellites_visible >= 6
    assert copter.battery.level == 100
    assert copter.battery.voltage == pytest.approx(12.6, abs=0.1)
    where = copter.location.global_frame
    assert (where.lat, where.lon) == (pytest.approx(HOME[0], abs=1e-5), pytest.approx(HOME[1], abs=1e-5))
    assert copter.location.global_relative_frame.alt == pytest.approx(0.0, abs=0.3)
    assert copter.location.local_frame.down == pytest.approx(0.0, abs=0.3)
    assert max(map(abs, (copter.attitude.roll, copter.attitude.pitch, copter.attitude.yaw))) < 0.05
    assert max(map(abs, copter.velocity)) < 0.2
    assert copter.airspeed == pytest.approx(0.0, abs=0.5)


def test_it_has_all_parameters_and_sets_one(copter: Any) -> None:
    assert set(copter.parameters.keys()) - {"_HASH_CHECK"} == TABLE.keys()
    before = copter.parameters["MIS_TAKEOFF_ALT"]
    assert before == TABLE["MIS_TAKEOFF_ALT"].default
    for value in (4.0, before):
        assert copter.parameters.set("MIS_TAKEOFF_ALT", value)
        assert copter.parameters["MIS_TAKEOFF_ALT"] == value


def test_it_moves_a_mission_to_and_fro(copter: Any, dronekit: Any) -> None:
    link = dronekit.mavutil.mavlink
    plan = [
        (link.MAV_CMD_NAV_TAKEOFF, HOME[0], HOME[1], 4.0),
        (link.MAV_CMD_NAV_WAYPOINT, HOME[0] + 1e-4, HOME[1], 5.0),
        (link.MAV_CMD_NAV_LAND, HOME[0] + 1e-4, HOME[1], 0.0),
    ]
    copter.commands.clear()
    for command, latitude, longitude, height in plan:
        frame = link.MAV_FRAME_GLOBAL_RELATIVE_ALT
        copter.commands.add(dronekit.Command(0, 0, 0, frame, command, 0, 1, 0, 0, 0, 0, latitude, longitude, height))
    with messages(copter, "MISSION_ACK") as acks:
        copter.commands.upload(timeout=PATIENCE_S)
        wait(copter, lambda: any(ack.type == 0 for ack in acks), "MISSION_ACK")
    copter.commands.download()
    copter.commands.wait_ready(timeout=PATIENCE_S)
    got = [(each.command, each.x, each.y, each.z) for each in copter._wploader.wpoints]
    assert got == [(row[0], pytest.approx(row[1], abs=5e-6), pytest.approx(row[2], abs=5e-6), row[3]) for row in plan]


def test_it_flies(copter: Any, dronekit: Any) -> None:
    copter.mode = dronekit.VehicleMode("LOITER")
    wait(copter, lambda: copter.mode.name == "LOITER", "LOITER")
    copter.armed = True
    wait(copter, lambda: bool(copter.armed), "arming")
    copter.simple_takeoff(5.0)
    wait(copter, lambda: copter.location.global_relative_frame.alt > 4.75, "5 m")
    wait(copter, lambda: copter.mode.name == "LOITER", "LOITER")
    assert copter.system_status.state == "ACTIVE"
    copter.mode = dronekit.VehicleMode("RTL")
    wait(copter, lambda: copter.mode.name == "RTL", "RTL")
    copter.mode = dronekit.VehicleMode("LAND")
    wait(copter, lambda: copter.mode.name == "LAND", "LAND")
    wait(copter, lambda: not copter.armed, "the disarming after the landing")
    assert copter.location.global_relative_frame.alt == pytest.approx(0.0, abs=0.5)


def test_an_empty_mission_is_answered(copter: Any) -> None:
    """DroneKit asks for item 0 of no items and waits for it for ever, with PX4 too; it is told that there is none."""
    with messages(copter, "MISSION_COUNT", "MISSION_ACK") as answers:
        copter._master.waypoint_clear_all_send()
        wait(copter, lambda: len(answers) == 1, "an answer to MISSION_CLEAR_ALL")
        copter.commands.download()
        wait(copter, lambda: len(answers) >= 3, "an answer to the request for item 0")
    cleared, count, refused = answers[:3]
    assert (cleared.get_type(), cleared.type) == ("MISSION_ACK", 0)
    assert (count.get_type(), count.count) == ("MISSION_COUNT", 0)
    assert (refused.get_type(), refused.type) == ("MISSION_ACK", 13)  # MAV_MISSION_INVALID_SEQUENCE
