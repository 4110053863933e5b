"""What outlives the process and what does not: the state folder, reboots, and SIM_* parameters changed in flight."""

from __future__ import annotations

from collections.abc import Callable
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl.codec import encode, parse
from mavsitl.dialect import mavlink
from mavsitl.ends import NullRecorder
from mavsitl.keep import carry_out
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.services.mission import FENCE, MISSION, RALLY, same_plan
from tests.autopilot.conftest import GCS, OFFBOARD, Client, flight
from tests.autopilot.copter import (
    ACCEPTED,
    HOLD,
    distance,
    fence_circle,
    flying,
    item,
    parameter,
    set_parameter,
    take_off,
    track,
    upload,
    waypoint,
)

REBOOT = mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN


class Kept(Client):
    """A client of a vehicle with a state folder."""

    def __init__(self, state: Path, system_id: int = 1) -> None:
        super().__init__(flight())
        self.vehicle = Vehicle(
            flight(), MemoryRecorder(), seed=1, system_id=system_id, ports=("offboard", "gcs"), state=state
        )
        self.now_us = 0
        self.inbox.clear()
        self.vehicle.step(0)
        self._collect()

    def run(self, seconds: float, each: Callable[[], object] | None = None) -> None:
        super().run(seconds, each)
        carry_out(self.vehicle)

    def close(self) -> None:
        self.vehicle.close()
        carry_out(self.vehicle)


def test_parameters_and_plans_survive_a_restart(tmp_path: Path) -> None:
    first = Kept(tmp_path)
    first.run(0.2)
    first.send(parameter("MIS_TAKEOFF_ALT", 4.0))
    first.send(parameter("COM_LOW_BAT_ACT", 3))
    plans: dict[int, list[dict[str, Any]]] = {
        MISSION: [item(first, 22, height_m=4.0), waypoint(first, 5, 0, 4), waypoint(first, 0, 0, 4)],
        FENCE: [fence_circle(first, 100.0)],
        RALLY: [item(first, mavlink.MAV_CMD_NAV_RALLY_POINT, at=(1, 1), height_m=10.0)],
    }
    for kind, items in plans.items():
        assert upload(first, items, kind) == mavlink.MAV_MISSION_ACCEPTED
    kept = [first.vehicle.plan.stores.items(kind) for kind in plans]
    first.close()

    second = Kept(tmp_path)
    second.run(1.2)
    assert second.vehicle.parameters["MIS_TAKEOFF_ALT"] == 4.0
    assert second.vehicle.parameters["COM_LOW_BAT_ACT"] == 3
    for kind, plan in zip(plans, kept, strict=True):
        assert same_plan(second.vehicle.plan.stores.items(kind), plan)
    assert second.last("MISSION_CURRENT", OFFBOARD).total == 3
    take_off(second, 4.0)
    assert second.truth[2] == pytest.approx(4.0, abs=0.1)


def test_what_is_written_without_a_proper_end_is_there(tmp_path: Path) -> None:
    """A process that is killed: changes are handed over when they were made, and not at the end alone."""
    first = Kept(tmp_path)
    first.send(parameter("MIS_TAKEOFF_ALT", 4.0))
    first.run(0.5)
    assert Kept(tmp_path).vehicle.parameters["MIS_TAKEOFF_ALT"] == 4.0


def test_the_system_id_that_was_asked_for_outweighs_the_one_that_was_kept(tmp_path: Path) -> None:
    first = Kept(tmp_path)
    first.send(parameter("MAV_SYS_ID", 9))
    first.close()
    again = Vehicle(flight(), NullRecorder(), seed=1, system_id=3, state=tmp_path)
    assert again.parameters["MAV_SYS_ID"] == 3


@pytest.mark.parametrize("system_id", [1, 250, 251, 255])
def test_every_system_id_boots(system_id: int) -> None:
    vehicle = Vehicle(flight(), NullRecorder(), seed=1, system_id=system_id)
    vehicle.step(0)
    frames = [frame for datagram in vehicle.datagrams(0, combine=False) for frame in parse(datagram)]
    assert frames
    assert {frame.system_id for frame in frames} == {system_id}


@pytest.mark.parametrize(
    "damage",
    [
        b"", b"{", b"\x00" * 100, b"[]", b"null", b'{"schema": 1}', b'{"schema": 1, "content": {"mission": 5}}',
        b'{"schema": 1, "content": {"MIS_TAKEOFF_ALT": "high", "NO_SUCH": 1, "COM_LOW_BAT_ACT": 77}}', b"[" * 100_000,
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["parameters.json", "plan.json"])
def test_damaged_files_do_not_keep_it_from_booting(tmp_path: Path, name: str, damage: bytes) -> None:
    (tmp_path / name).write_bytes(damage)
    client = Kept(tmp_path)
    client.run(0.2)
    assert client.vehicle.parameters["MIS_TAKEOFF_ALT"] == 2.5
    assert client.texts(), "it says what was wrong"
    assert client.arm() == ACCEPTED


def test_without_a_folder_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    client = Client(flight())
    client.send(parameter("MIS_TAKEOFF_ALT", 4.0))
    client.run(1.0)
    client.vehicle.close()
    carry_out(client.vehicle)
    assert list(tmp_path.iterdir()) == []


# --- reboot


def test_a_reboot_begins_the_clock_anew_and_keeps_what_is_kept(client: Client) -> None:
    client.run(2.0)
    client.send(parameter("MIS_TAKEOFF_ALT", 4.0))
    upload(client, [item(client, 22, height_m=3.0), waypoint(client, 5, 0, 3)])
    before = client.last("ATTITUDE", OFFBOARD).time_boot_ms
    assert client.result(REBOOT, 1) == ACCEPTED
    client.run(0.5)
    after = client.last("ATTITUDE", OFFBOARD).time_boot_ms
    assert after < before
    assert after < 600
    assert client.vehicle.parameters["MIS_TAKEOFF_ALT"] == 4.0
    assert client.last("MISSION_CURRENT", OFFBOARD).total == 2
    client.run(1.0)
    take_off(client, 3.0)
    assert client.flight_mode == HOLD
    assert client.truth[2] == pytest.approx(3.0, abs=0.1)


# --- home and forwarding


def test_home_is_where_it_armed_or_was_set(client: Client) -> None:
    client.run(0.3)
    latitude, longitude = client.vehicle.autopilot.origin.to_global(30.0, 40.0)
    altitude = client.vehicle.autopilot.origin.altitude_amsl_m
    home = (0.0, 0, 0, nan, latitude, longitude, altitude + 5.0)
    assert client.result(mavlink.MAV_CMD_DO_SET_HOME, *home) == ACCEPTED
    client.run(0.1)
    told = client.last("HOME_POSITION", GCS)
    assert (told.x, told.y, told.z) == pytest.approx((30.0, -40.0, -5.0), abs=0.6) or (
        told.latitude / 1e7 == pytest.approx(latitude, abs=1e-5)
    )
    assert told.altitude / 1e3 == pytest.approx(altitude + 5.0, abs=0.01)
    client.arm()
    client.run(0.1)
    assert client.last("HOME_POSITION", GCS).altitude / 1e3 == pytest.approx(altitude, abs=0.01)


def test_what_is_meant_for_others_is_passed_on_once_and_never_back(client: Client) -> None:
    station, camera = (255, 190), (1, 100)
    client.run(0.1)
    beat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
    client.send(beat, port=GCS, sender=station)
    client.send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_CAMERA, 8, 0, 0, 4, 3), sender=camera)
    client.tick()
    client.forwarded.clear()
    ask = mavlink.MAVLink_command_long_message(1, 100, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, 259, 0, 0, 0, 0, 0, 0)
    assert client.acks_of(ask, port=GCS, sender=station) == []  # the camera's business
    client.tick()
    assert [(port, frame.system_id, frame.message.get_type()) for port, frame in client.forwarded] == [
        (OFFBOARD, 255, "COMMAND_LONG")
    ]
    client.forwarded.clear()
    client.send(mavlink.MAVLink_command_ack_message(512, 0, 0, 0, *station), sender=camera)
    client.tick()
    assert [(port, frame.component_id) for port, frame in client.forwarded] == [(GCS, 100)]
    client.forwarded.clear()
    own = mavlink.MAVLink_command_long_message(1, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, 148, 0, 0, 0, 0, 0, 0)
    client.acks_of(own, port=GCS, sender=station)
    client.tick()
    assert client.forwarded == []  # ours alone


def test_a_frame_with_our_own_id_is_not_passed_on(client: Client) -> None:
    """Somebody echoes what the vehicle sent."""
    client.run(0.2)
    datagram = encode(mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0), 0, 1, 1)
    client.vehicle.receive(OFFBOARD, datagram)
    client.run(0.1)
    assert client.forwarded == []


# --- SIM_* and gains in flight


def test_wind_from_a_parameter_pushes_and_is_held_against() -> None:
    client = flying(5.0)
    set_parameter(client, "SIM_WIND_DIR", 0.0)  # from the north: pushes to the south
    set_parameter(client, "SIM_WIND_SPD", 5.0)
    client.tick()
    assert client.vehicle.simulation.wind[:, 0] == pytest.approx([-5.0, 0.0, 0.0], abs=1e-9)
    path = track(client, 10.0)
    assert path[:, 0].min() < -0.02
    assert distance(client, 0.0, 0.0, 5.0) < 0.1
    set_parameter(client, "SIM_WIND_SPD", 0.0)
    client.tick()
    assert client.vehicle.simulation.wind[:, 0] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)


def test_turbulence_from_a_parameter() -> None:
    client = flying(5.0)
    set_parameter(client, "SIM_WIND_TURB", 1)
    gusts = []
    client.run(5.0, lambda: gusts.append(client.vehicle.simulation.wind[:, 0].copy()))
    assert np.std(gusts, axis=0).min() > 0.02
    assert distance(client, 0.0, 0.0, 5.0) < 1.0
    set_parameter(client, "SIM_WIND_TURB", 0)
    client.run(0.1)
    assert client.vehicle.simulation.wind[:, 0] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)


def test_noise_from_a_parameter() -> None:
    client = Client(flight(noise__position_m=0.02, noise__velocity_m_s=0.02))

    def spread() -> float:
        values: list[float] = []
        client.run(1.0, lambda: values.append(client.vehicle.autopilot.estimate[0]))
        return float(np.std(values))

    plain = spread()
    set_parameter(client, "SIM_NOISE_SCALE", 4.0)
    assert spread() / plain == pytest.approx(4.0, rel=0.35)
    set_parameter(client, "SIM_NOISE_SCALE", 0.0)
    assert spread() < 1e-3


def test_mass_from_a_parameter_costs_thrust() -> None:
    client = flying(4.0)

    def thrust() -> float:
        return float(client.last("ATTITUDE_TARGET", OFFBOARD).thrust)

    before = thrust()
    set_parameter(client, "SIM_MASS_SCALE", 1.2)
    client.run(6.0)
    assert thrust() / before == pytest.approx(1.2, rel=0.03)
    assert client.truth[2] == pytest.approx(4.0, abs=0.1)


def test_gains_count_in_flight() -> None:
    """A vehicle whose roll is hardly corrected answers a roll step late."""

    def rise(gain: float) -> float:
        client = flying(6.0)
        set_parameter(client, "MC_ROLL_P", gain)
        client.attitude()
        client.offboard()
        q = (0.9962, 0.0872, 0.0, 0.0)
        client.run(0.25, lambda: client.attitude(q))
        return float(client.last("ATTITUDE", OFFBOARD).roll)

    assert rise(1.0) < 0.5 * rise(6.5)
