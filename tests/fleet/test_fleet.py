"""A fleet is vehicles: each what it would be alone, told apart by port or by system id."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from mavsitl_ground.formation import Formation
from mavsitl_vehicle.failures import Kind, Unit
from mavsitl_vehicle.fleet import LOOKS, Fleet
from mavsitl_vehicle.kept import Kept
from mavsitl_vehicle.vehicle import Vehicle, take_seats

from mavsitl import fleet as fleets
from mavsitl import formation
from mavsitl.dialect import mavlink
from mavsitl.drivers import Tap, fly_in_memory
from mavsitl.ends import NullRecorder
from mavsitl.keep import carry_out
from mavsitl.scenario import Flight
from tests.autopilot.conftest import flight
from tests.drivers.exercise import hash_in_memory, shortened
from tests.fleet.exercise import Station


def hashes(scenario: Flight, count: int) -> list[str]:
    """Of each vehicle's wire."""
    recorders = [NullRecorder()] * count
    fleet = Fleet(scenario, recorders, seed=scenario.scenario.seed, count=count, lockstep=True)
    taps = [Tap() for _ in range(count)]
    fleets.fly_in_memory(fleet, fleet.vehicles, Formation(scenario, recorders, count=count), taps)
    return [tap.wire.hexdigest() for tap in taps]


# --- alone and together


@pytest.mark.parametrize("name", ["hover-wind", "takeoff-hover", "hover-wind-ekf", "formation-spiral"])
def test_a_fleet_of_one_is_the_vehicle_byte_for_byte(name: str) -> None:
    scenario = shortened(name, 1.5)
    assert hashes(scenario, 1) == [hash_in_memory(scenario)]


def test_each_of_a_fleet_is_the_vehicle_that_flies_alone_in_its_place() -> None:
    scenario = shortened("formation-spiral", 2.0)
    together = hashes(scenario, 3)
    assert together == hashes(scenario, 3)
    assert len(set(together)) == 3
    assert together[0] == hash_in_memory(scenario)
    alone = []
    for j, each in enumerate(formation.flights(scenario, 3)):
        (seat,) = take_seats([each], [Kept(each, system_id=1 + j)], each.scenario.seed, first=j)
        vehicle = Vehicle(each, NullRecorder(), seed=1, system_id=1 + j, lockstep=True, seat=seat)
        ground = Formation(scenario, [NullRecorder()] * 3, count=3).grounds[j]
        tap = Tap()
        fly_in_memory(vehicle, ground, tap)
        alone.append(tap.wire.hexdigest())
    assert together == alone


def test_vehicles_with_sensors_fly_together_as_alone() -> None:
    scenario = shortened("hover-wind-ekf", 1.0)
    together = hashes(scenario, 2)
    assert together[0] == hash_in_memory(scenario) != together[1]


def test_they_start_in_their_places() -> None:
    station = Station(5, flight(fleet__formation="line", fleet__spacing_m=2.0))
    assert station.fleet.positions_nwu_m()[1] == pytest.approx([0.0, -2.0, -4.0, -6.0, -8.0])
    station.run(0.3)
    east_m = {sender: message.y for _, sender, message in station.of("LOCAL_POSITION_NED")}
    assert [east_m[system_id] for system_id in range(1, 6)] == pytest.approx([0.0, 2.0, 4.0, 6.0, 8.0], abs=1e-3)


# --- what is one's own


def test_each_has_ports_parameters_and_a_mode_of_its_own() -> None:
    station = Station(3)
    station.run(0.6)
    heard = {(port, sender) for port, sender, _ in station.of("HEARTBEAT")}
    assert heard == {(2 * j + own, j + 1) for j in range(3) for own in (0, 1)}
    second = station.fleet.vehicles[1]
    station.send(2, mavlink.MAVLink_param_set_message(2, 1, b"MPC_XY_CRUISE", 3.5, 9))
    station.command(3, 2, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    station.run(0.3)
    assert [each.parameters["MPC_XY_CRUISE"] == 3.5 for each in station.fleet.vehicles] == [False, True, False]
    assert [each.autopilot.commander.armed for each in station.fleet.vehicles] == [False, True, False]
    assert second.counters.frames == 2
    acks = station.of("COMMAND_ACK")
    assert [(port, sender) for port, sender, _ in acks] == [(3, 2)]


def test_a_failure_of_one_is_its_own() -> None:
    station = Station(3, flight(parameters__SYS_FAILURE_EN=1))
    station.command(
        2, 2, mavlink.MAV_CMD_INJECT_FAILURE, mavlink.FAILURE_UNIT_SYSTEM_MOTOR, mavlink.FAILURE_TYPE_OFF, 1
    )
    station.run(0.2)
    assert any("motor" in text.lower() for text in station.texts(2))
    assert not station.texts(1)
    assert not station.texts(3)


def test_one_reboots_and_the_others_go_on() -> None:
    station = Station(2)
    station.run(1.0)
    station.command(0, 1, mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1)
    station.inbox.clear()
    station.run(0.5)
    boot_ms = {sender: message.time_boot_ms for _, sender, message in station.of("ATTITUDE")}
    assert boot_ms[1] <= 500
    assert boot_ms[2] >= 1400


# --- on one link


def test_on_one_link_they_are_told_apart_by_system_id() -> None:
    station = Station(3, one_link=True)
    station.run(0.6)
    assert {(port, sender) for port, sender, _ in station.of("HEARTBEAT")} == {
        (port, sender) for port in (0, 1) for sender in (1, 2, 3)
    }
    station.inbox.clear()
    request = mavlink.MAVLink_param_request_read_message
    taken = station.send(1, request(2, 1, b"MAV_SYS_ID", -1), request(3, 1, b"MAV_SYS_ID", -1))
    assert taken == 2
    station.run(0.1)
    values = [(port, sender, message.param_value) for port, sender, message in station.of("PARAM_VALUE")]
    assert [(port, sender) for port, sender, _ in values] == [(1, 2), (1, 3)]
    assert [each.counters.frames for each in station.fleet.vehicles] == [0, 1, 1]


def test_on_one_link_what_is_for_all_comes_to_all_and_is_passed_on_once() -> None:
    station = Station(3, one_link=True)
    heartbeat = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    station.send(0, heartbeat)  # a companion on the off-board link, so that there is somebody to pass on to
    station.run(0.1)
    assert station.send(1, heartbeat, sender=(255, 190)) == 1
    station.run(0.1)
    assert [each.counters.frames for each in station.fleet.vehicles] == [2, 2, 2]
    assert [port for port, sender, _ in station.of("HEARTBEAT") if sender == 255] == [0]


def test_on_one_link_junk_is_counted_once() -> None:
    station = Station(3, one_link=True)
    assert station.fleet.receive(0, b"\xfd" * 30) == 0
    assert station.fleet.vehicles[0].counters.rejected > 0
    assert station.fleet.vehicles[1].counters.rejected == station.fleet.vehicles[2].counters.rejected == 0


def test_a_datagram_is_of_one_vehicle_and_holds_all_it_says_on_a_link() -> None:
    station = Station(3, one_link=True)
    station.datagrams.clear()
    station.now_us += station.fleet.period_us
    station.fleet.step(station.now_us)
    said = list(station.fleet.outgoing())
    assert len({(port, datagrams[0][5]) for port, datagrams in said}) == len(said)
    assert list(station.fleet.outgoing()) == []


# --- collisions


def near(station: Station, distance_m: float) -> None:
    """Vehicle 2 that far above vehicle 1."""
    x = station.fleet.vehicles[0].simulation.x
    x[0:3, 1] = x[0:3, 0] + (0.0, 0.0, distance_m)


def collided(station: Station) -> list[tuple[int, int]]:
    return [(each.vehicle, each.other) for each in station.fleet.collisions]


def in_the_clamp(**changes: Any) -> Flight:
    return flight(start__clamp=True, fleet__spacing_m=2.0, fleet__collision_m=0.6, **changes)


def test_a_collision_is_said_to_both_and_logged_once_until_they_part() -> None:
    station = Station(3, in_the_clamp())
    station.run(0.2)
    assert collided(station) == []
    near(station, 0.7)
    station.run(0.2)
    assert collided(station) == []
    near(station, 0.5)
    station.run(0.3)
    assert collided(station) == [(1, 2)]
    assert station.fleet.collisions[0].distance_m == pytest.approx(0.5)
    assert station.fleet.collisions[0].time_s == pytest.approx(0.4, abs=0.06)
    assert station.texts(1) == ["Collision with vehicle 2: 0.50 m"]
    assert station.texts(2) == ["Collision with vehicle 1: 0.50 m"]
    assert station.texts(3) == []
    near(station, 1.0)
    station.run(0.1)
    near(station, 0.4)
    station.run(0.1)
    assert collided(station) == [(1, 2), (1, 2)]


def test_a_collision_stops_the_rotors_where_the_scenario_says_so() -> None:
    for what, broken in (("report", 0), ("crash", 2)):
        station = Station(3, in_the_clamp(fleet__on_collision=what))
        near(station, 0.3)
        station.run(0.1)
        assert collided(station) == [(1, 2)]
        failed = [
            all(each.failures.of(Unit.MOTOR, motor) is Kind.OFF for motor in range(1, 5))
            for each in station.fleet.vehicles
        ]
        assert sum(failed) == broken
        assert not failed[2]


def test_collisions_are_not_looked_for_where_the_distance_is_zero() -> None:
    station = Station(2, flight(start__clamp=True, fleet__collision_m=0.0))
    near(station, 0.0)
    station.run(0.2)
    assert collided(station) == []


# --- what is kept


def test_each_keeps_its_state_in_a_folder_of_its_own(tmp_path: Path) -> None:
    states = [tmp_path / f"instance-{j}" for j in range(LOOKS + 5)]
    station = Station(len(states), states=states)
    station.fleet.vehicles[3].parameters.put("MPC_XY_CRUISE", 2.25)
    batches = [station.fleet.unsaved(1) for _ in range(LOOKS)]
    assert sum(map(len, batches)) == 1
    for work in itertools.chain.from_iterable(batches):
        work.write()
        station.fleet.saved(work, None, 1)
    station.fleet.vehicles[7].parameters.put("MPC_XY_CRUISE", 3.25)
    station.fleet.close()
    carry_out(station.fleet)
    again = Fleet(flight(), [NullRecorder()] * len(states), seed=1, count=len(states), states=states)
    kept = {j: each.parameters["MPC_XY_CRUISE"] for j, each in enumerate(again.vehicles)}
    assert {j: value for j, value in kept.items() if value != kept[0]} == {3: 2.25, 7: 3.25}


# --- formations


@pytest.mark.parametrize("kind", ["grid", "line", "circle"])
@pytest.mark.parametrize("count", [1, 2, 3, 7, 25])
def test_neighbours_are_the_spacing_apart_and_the_first_is_at_the_start(kind: Any, count: int) -> None:
    settings = msgspec.structs.replace(flight().scenario.fleet, formation=kind, spacing_m=2.5)
    places = np.array(formation.places(settings, count))
    assert places.shape == (count, 3)
    assert places[0] == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    if count > 1:
        apart = np.linalg.norm(places[:, None] - places[None], axis=2) + 1e9 * np.eye(count)
        assert apart.min(axis=1) == pytest.approx(2.5)


def test_a_formation_flies_to_its_places() -> None:
    scenario = shortened("takeoff-hover", 6.0, fleet__formation="circle", fleet__spacing_m=3.0)
    recorders = [NullRecorder()] * 3
    fleet = Fleet(scenario, recorders, seed=1, count=3, lockstep=True)
    grounds = Formation(scenario, recorders, count=3)
    highest = np.zeros(3)

    class Watched(Tap):
        def tick(self, now_us: int, wall_us: int = 0) -> None:
            np.maximum(highest, fleet.positions_nwu_m()[2], out=highest)

    fleets.fly_in_memory(fleet, fleet.vehicles, grounds, [Watched() for _ in range(3)])
    flown = grounds.flown()
    assert [each.system_id for each in flown] == [1, 2, 3]
    assert all(each.finished and not each.lost and each.flight_time_s == pytest.approx(6.0, abs=0.02) for each in flown)
    assert (highest > 0.4).all()
    for each in flown:
        assert each.rms_m is not None
        assert each.rms_m < 0.5
    places = np.array(formation.places(scenario.scenario.fleet, 3)).T
    assert fleet.positions_nwu_m()[:2] == pytest.approx(places[:2], abs=0.3)


# --- streams


def test_default_streams_are_no_faster_than_the_scenario_says_and_vehicles_take_turns() -> None:
    station = Station(4, flight(fleet__stream_hz=10.0))
    station.inbox.clear()
    station.datagrams.clear()
    station.run(2.0)
    for system_id in range(1, 5):
        for own, most in ((0, 10.0), (1, 10.0)):
            mine = [message.get_type() for port, sender, message in station.inbox if sender == system_id]
            assert mine
            names = [
                message.get_type()
                for port, sender, message in station.inbox
                if (port, sender) == (2 * (system_id - 1) + own, system_id)
            ]
            counts = {name: names.count(name) / 2.0 for name in set(names)}
            assert max(counts.values()) == most
            assert counts["ATTITUDE"] == most
            assert counts["HEARTBEAT"] == 1.0
            datagrams = [port for port, _ in station.datagrams if port == 2 * (system_id - 1) + own]
            assert len(datagrams) <= 2.0 * 3.0 * most
    by_tick: list[int] = []
    for _ in range(25):
        station.datagrams.clear()
        station.run(0.004)
        by_tick.append(len({port // 2 for port, _ in station.datagrams}))
    assert sum(count > 0 for count in by_tick) >= 4
    station.command(0, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_ODOMETRY, 20_000)
    station.inbox.clear()
    station.run(1.0)
    asked = [sender for port, sender, message in station.inbox if port == 0 and message.get_type() == "ODOMETRY"]
    assert len(asked) == pytest.approx(50, abs=1)
