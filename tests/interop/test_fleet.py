"""Clients that we did not write see the vehicles of a fleet as so many vehicles."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from time import monotonic, sleep
from typing import Any

import pytest

from mavsitl.dialect import mavlink
from mavsitl.link.udp import LOOPBACK
from tests.bench.bench_fleet import free_block
from tests.interop.conftest import PATIENCE_S, Sitl, sitl
from tests.interop.mavsdk_client import Pilot

pytestmark = [pytest.mark.interop, pytest.mark.sockets]

COUNT = 3


@contextmanager
def fleet(*settings: str) -> Iterator[tuple[Sitl, int]]:
    """Three vehicles, and the first of the ports that their off-board links send to."""
    remote = free_block(3 * COUNT)
    own = ("--offboard-port", str(remote + COUNT), "--gcs-port", str(remote + 2 * COUNT))
    with sitl(
        "formation-spiral", "--count", str(COUNT), "--offboard-remote", f"{LOOPBACK}:{remote}", *own, *settings,
        speed=3.0,
    ) as vehicles:  # fmt: skip
        yield vehicles, remote


@contextmanager
def mavsdk_at(ports: list[int]) -> Iterator[dict[int, Pilot]]:
    """MAVSDK's systems by their ids, as soon as there are three."""
    pytest.importorskip("mavsdk.plugins", reason="MAVSDK 4 is not installed")
    from mavsdk import ComponentType, Configuration, ConnectionResult, Mavsdk

    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    mavsdk = Mavsdk(configuration)
    try:
        for port in ports:
            assert mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}") == ConnectionResult.SUCCESS
        until_s = monotonic() + PATIENCE_S
        systems: list[Any] = []
        while len(systems) < COUNT and monotonic() < until_s:
            sleep(0.05)
            systems = [each for each in mavsdk.get_systems() if each.has_autopilot()]
        yield {each.get_system_id(): Pilot(each) for each in systems}
    finally:
        mavsdk.destroy()
        configuration.destroy()


def fly_the_second(pilots: dict[int, Pilot]) -> None:
    """It takes off; the others stay where they are."""
    assert sorted(pilots) == [1, 2, 3]
    for pilot in pilots.values():
        pilot.wait("health_all_ok", bool)
    second = pilots[2]
    second.fly(2.0)
    assert second.telemetry.armed()
    second.near(0.0, 4.0, -2.0, within_m=0.8)  # its place in the grid is 4 m east of the first
    for other in (pilots[1], pilots[3]):
        assert not other.telemetry.armed()
        other.height(-0.3, 0.3)
    second.action.kill()


def test_mavsdk_flies_one_of_three_each_on_its_own_port() -> None:
    with fleet() as (_, remote), mavsdk_at([remote, remote + 1, remote + 2]) as pilots:
        fly_the_second(pilots)


def test_mavsdk_flies_one_of_three_behind_one_port() -> None:
    with fleet("--one-link") as (_, remote), mavsdk_at([remote]) as pilots:
        fly_the_second(pilots)


def test_pymavlink_hears_three_system_ids_on_one_link_and_asks_each() -> None:
    mavutil = pytest.importorskip("pymavlink.mavutil")
    with fleet("--one-link") as (_, remote):
        link = mavutil.mavlink_connection(f"udpin:{LOOPBACK}:{remote}", source_system=245)
        try:
            heard: set[int] = set()
            until_s = monotonic() + PATIENCE_S
            while len(heard) < COUNT and monotonic() < until_s:
                message = link.recv_match(type="HEARTBEAT", blocking=True, timeout=1.0)
                if message is not None:
                    heard.add(message.get_srcSystem())
            assert heard == {1, 2, 3}
            # The HEARTBEATs came while the fleet was being built: what is asked again meanwhile is answered twice.
            answers: dict[int, int] = {}
            for system_id in (3, 1, 2):
                while system_id not in answers and monotonic() < until_s:
                    link.mav.param_request_read_send(system_id, 1, b"MAV_SYS_ID", -1)
                    answer = link.recv_match(type="PARAM_VALUE", blocking=True, timeout=1.0)
                    if answer is not None:
                        answers[answer.get_srcSystem()] = int(_as_integer(answer.param_value))
            assert answers == {1: 1, 2: 2, 3: 3}
        finally:
            link.close()


def _as_integer(value: float) -> int:
    """PX4's way of an INT32 in a float's bytes."""
    import struct

    return int(struct.unpack("<i", struct.pack("<f", value))[0])


def test_the_ground_stations_link_carries_all_three() -> None:
    """QGroundControl listens on 14550 and knows vehicles by their system ids."""
    mavutil = pytest.importorskip("pymavlink.mavutil")
    with fleet() as (vehicles, _):
        link = mavutil.mavlink_connection(f"udpin:{LOOPBACK}:{vehicles.gcs_port}", source_system=255)
        try:
            heard: dict[int, int] = {}
            until_s = monotonic() + PATIENCE_S
            while len(heard) < COUNT and monotonic() < until_s:
                message = link.recv_match(type="HEARTBEAT", blocking=True, timeout=1.0)
                if message is not None:
                    heard[message.get_srcSystem()] = message.autopilot
            assert heard == dict.fromkeys((1, 2, 3), mavlink.MAV_AUTOPILOT_PX4)
        finally:
            link.close()
