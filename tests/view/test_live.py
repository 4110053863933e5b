"""The station against the shipped vehicle and ground, in memory and simulated time."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_ground.controller import Ground
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import monitor, scenario
from mavsitl.codec import encode
from mavsitl.dialect import mavlink
from mavsitl.ends import NullRecorder
from mavsitl.view.live import ACTIONS, FAST, SLOW, STEADY, Station, rate_hz
from mavsitl.view.model import FROM_AUTOPILOT, FROM_GROUND, Seen
from tests.wire.reference import frame_v2

PERIOD_US = 4000
OFFBOARD, GCS = 0, 1


class World:
    """Vehicles with their ground-station links, a ground with its monitor where wanted, and the station."""

    def __init__(
        self, name: str = "takeoff-hover", *, vehicles: int = 1, ground: bool = False, buttons: bool = True
    ) -> None:
        self.flight = scenario.load(name)
        self.station = Station(vehicles, with_monitor=True, buttons=buttons)
        self.vehicles: list[Vehicle | None] = [self.boot(1 + j) for j in range(vehicles)]
        self.clocks = [0] * vehicles
        self.ground = Ground(self.flight, NullRecorder(), monitored=True) if ground else None
        self.monitor_port = vehicles
        self.now_us = 0
        self.sent = 0
        """Datagrams of vehicle 1 to the station."""

    def boot(self, system_id: int) -> Vehicle:
        return Vehicle(
            self.flight, NullRecorder(), seed=1, system_id=system_id, ports=("offboard", "gcs"), lockstep=False
        )

    def run(self, seconds: float, until: Callable[[], object] = lambda: False) -> bool:
        end_us = self.now_us + round(seconds * 1e6)
        step_us = self.now_us
        while self.now_us < end_us:
            self.now_us += PERIOD_US
            for j, vehicle in enumerate(self.vehicles):
                if vehicle is not None:
                    self.step_vehicle(j, vehicle)
            if self.ground is not None:
                self.step_ground(self.ground)
            if self.now_us >= step_us:
                step_us += round(1e6 / self.station.hz)
                self.step_station()
            if until():
                return True
        return False

    def step_vehicle(self, j: int, vehicle: Vehicle) -> None:
        vehicle.step(self.clocks[j])
        self.clocks[j] += PERIOD_US
        for datagram in vehicle.datagrams(GCS, combine=False):
            self.sent += j == 0
            self.station.receive(j, datagram, self.now_us)
        for datagram in vehicle.datagrams(OFFBOARD, combine=False):
            if self.ground is not None and j == 0:
                self.ground.receive(0, datagram)

    def step_ground(self, ground: Ground) -> None:
        ground.step(self.now_us)
        for datagram in ground.datagrams(0, combine=False):
            if self.vehicles[0] is not None:
                self.vehicles[0].receive(OFFBOARD, datagram)
        assert ground.monitor is not None
        ground.monitor.step(self.now_us)
        for datagram in ground.monitor.datagrams():
            self.station.receive(self.monitor_port, datagram, self.now_us)

    def step_station(self) -> None:
        self.station.step(self.now_us)
        for j, vehicle in enumerate(self.vehicles):
            for datagram in self.station.datagrams(j):
                if vehicle is not None:
                    vehicle.receive(GCS, datagram)
        for datagram in self.station.datagrams(self.monitor_port):
            if self.ground is not None:
                assert self.ground.monitor is not None
                self.ground.monitor.receive(datagram)

    def values(self, number: int = 1) -> dict[str, Any]:
        return self.station.model.vehicles[number].values

    def press(self, name: str, number: int = 1, seconds: float = 6.0) -> str:
        """The outcome: empty is well."""
        before = (self.values(number).get("act") or {}).get("number", 0)
        self.station.act(number, name)
        assert self.run(seconds, lambda: (self.values(number).get("act") or {}).get("number", 0) > before)
        assert self.values(number)["act"]["name"] == name
        problem: str = self.values(number)["act"]["problem"]
        return problem


def test_it_asks_for_its_messages_and_they_come() -> None:
    world = World()
    world.run(5.0)
    values = world.values()
    for name in ("mode", "armed", "attitude", "position", "truth", "battery", "landed", "intended", "wind", "origin"):
        assert values.get(name) is not None, name
    assert values["wind"]["source"] == "true"
    assert values["online"]
    assert values["link"]["of"] == "this page"
    assert values["link"]["latency_ms"] is not None
    assert values["parameters"]["SIM_FAIL_MOT1"] == 0
    rows = world.station.model.vehicles[1].rows
    assert len(rows) == pytest.approx(5.0 * 20, abs=15)


def test_each_message_asked_for_is_one_that_the_vehicle_has() -> None:
    from mavsitl_vehicle.autopilot.telemetry import BY_ID

    assert {*FAST, *STEADY, *SLOW} <= set(BY_ID)


@pytest.mark.parametrize(("vehicles", "hz"), [(1, 33.0), (4, 33.0), (9, 20.0), (50, 12.0)])
def test_many_vehicles_are_renewed_less_often(vehicles: int, hz: float) -> None:
    assert rate_hz(vehicles) == hz


def test_arming_take_off_and_landing_by_the_buttons() -> None:
    world = World()
    world.run(2.0)
    assert world.press("arm") == ""
    assert world.run(2.0, lambda: world.values()["armed"])
    assert world.press("disarm") == ""
    assert world.run(2.0, lambda: not world.values()["armed"])
    assert world.press("takeoff") == ""
    assert world.run(10.0, lambda: world.values()["position"][2] < -1.0)
    assert world.press("hold") == ""
    assert world.press("land") == ""
    assert world.run(20.0, lambda: not world.values()["armed"])
    severities = {text["severity"] for text in world.station.model.news(Seen())["texts"]}
    assert severities <= set(range(8))


def test_what_is_refused_is_said() -> None:
    world = World()
    world.run(2.0)
    world.press("takeoff")
    assert world.run(10.0, lambda: world.values()["landed"] == "in the air")
    assert world.press("disarm").startswith("COMPONENT_ARM_DISARM: ")
    assert world.values()["armed"]
    assert world.press("law-pid") == "no ground is heard here: start it with --monitor"
    with pytest.raises(KeyError):
        world.station.act(1, "self-destruct")
    with pytest.raises(KeyError):
        world.station.act(7, "arm")


def test_a_motor_is_broken_and_mended_and_the_page_knows() -> None:
    world = World()
    world.run(2.0)
    assert world.press("motor-3-off") == ""
    assert world.run(2.0, lambda: world.values()["parameters"]["SIM_FAIL_MOT3"] == 1)
    assert world.press("motor-3-ok") == ""
    assert world.run(2.0, lambda: world.values()["parameters"]["SIM_FAIL_MOT3"] == 0)


def test_a_motor_that_somebody_else_broke_is_shown() -> None:
    world = World()
    world.run(2.0)
    vehicle = world.vehicles[0]
    assert vehicle is not None
    vehicle.autopilot.parameters.put("SIM_FAIL_MOT2", 1)
    assert world.run(2.0, lambda: world.values()["parameters"]["SIM_FAIL_MOT2"] == 1)


def test_with_a_ground_the_reference_the_weights_and_the_law() -> None:
    world = World(ground=True)
    assert world.run(12.0, lambda: world.station.model.vehicles and world.values().get("ground") == "FLY")
    assert world.run(5.0, lambda: world.values().get("weights") and world.values().get("law"))
    values = world.values()
    assert values["law"] == "pidnn"
    assert values["link"]["of"] == "off-board"
    assert all(0.5 <= weight <= 1.5 for weight in values["weights"])
    assert values["reference"][2] == pytest.approx(-0.5)
    assert values["wanted"] is not None
    assert world.press("law-pid") == ""
    assert world.run(2.0, lambda: world.values()["law"] == "pid")
    world.run(1.5)
    assert world.values()["weights"] is None
    assert world.press("link-down") == ""
    assert world.run(2.0, lambda: world.values()["parameters"]["SIM_LINK_DOWN"] == 1)
    assert world.press("gust") == ""


def test_a_vehicle_that_restarts_is_asked_again() -> None:
    world = World()
    world.run(4.0)
    chapter = world.values().get("chapter")
    world.vehicles[0] = None
    assert world.run(5.0, lambda: not world.values()["online"])
    world.vehicles[0], world.clocks[0] = world.boot(1), 0
    assert world.run(3.0, lambda: world.values()["online"])
    world.run(8.0)
    assert world.values()["chapter"] != chapter
    before = world.sent
    world.run(1.0)
    assert world.sent - before > 2 * 40  # attitude and position at 50 Hz


def test_several_vehicles_and_their_buttons() -> None:
    world = World(vehicles=2)
    world.run(3.0)
    assert sorted(world.station.model.vehicles) == [1, 2]
    assert world.press("arm", 2) == ""
    assert world.run(2.0, lambda: world.values(2)["armed"])
    assert not world.values(1)["armed"]


def test_without_buttons_nothing_is_commanded() -> None:
    world = World(buttons=False)
    world.run(2.0)
    assert "--no-buttons" in world.press("arm")
    world.run(1.0)
    assert not world.values()["armed"]
    assert world.station.model.world["buttons"] is False


def test_a_pile_of_presses_is_bounded() -> None:
    world = World()
    world.run(2.0)
    for _ in range(1000):
        world.station.act(1, "arm")
    assert len(world.station._crafts[1].work) < 60
    assert world.values()["act"]["problem"] == "too many at once"


def test_who_is_no_autopilot_is_no_vehicle_and_junk_is_nothing() -> None:
    station = Station(1, with_monitor=True)
    camera = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3)
    assert station.receive(0, encode(camera, 0, 7, 1), 0) == 1
    assert station.receive(0, b"\xfd\x09junk" * 50, 0) == 0
    assert station.receive(1, encode(camera, 0, 9, 191), 0) == 1  # a ground of a vehicle that is not known
    station.step(0)
    assert station.model.vehicles == {}


HEARD = sorted({*FROM_AUTOPILOT, *FROM_GROUND, *Station._services})
"""Ids of the messages that anything is made of."""


@given(st.data())
def test_no_content_of_a_message_stops_it(data: st.DataObject) -> None:
    """Frames that are good but for what stands in them, from a vehicle and from a ground: the page is told JSON."""
    station = Station(1, with_monitor=True)
    heartbeat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 1, 6 << 16, 3, 3)
    station.receive(0, encode(heartbeat, 0, 1, 1), 0)
    for sequence in range(6):
        message_class = mavlink.mavlink_map[data.draw(st.sampled_from(HEARD))]
        size = struct.calcsize(message_class.native_format.decode())
        payload = data.draw(st.binary(min_size=1, max_size=size))
        port, component = data.draw(st.sampled_from([(0, 1), (1, monitor.COMPONENT_ID)]))
        datagram = frame_v2(message_class, payload, sequence=sequence, component_id=component)
        assert station.receive(port, datagram, sequence * 400_000) == 1
        station.step(sequence * 400_000)
    seen = Seen()
    seen.selected = 1
    text = msgspec.json.encode(station.model.news(seen))
    assert b"NaN" not in text
    msgspec.json.decode(text)


def test_a_law_that_is_no_number_is_none() -> None:
    station = Station(1, with_monitor=True)
    heartbeat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 1, 6 << 16, 3, 3)
    station.receive(0, encode(heartbeat, 0, 1, 1), 0)
    for sequence, value in enumerate((float("nan"), float("inf"), 1e30)):
        law = mavlink.MAVLink_param_value_message(
            monitor.CONTROL_LAW.encode(), value, mavlink.MAV_PARAM_TYPE_REAL32, 1, 0
        )
        station.receive(1, encode(law, sequence, 1, monitor.COMPONENT_ID), 0)
        assert station.model.vehicles[1].values["law"] == "none"


def test_hostile_text_is_told_as_it_is() -> None:
    station = Station(1, with_monitor=False)
    heartbeat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 1, 6 << 16, 3, 3)
    station.receive(0, encode(heartbeat, 0, 1, 1), 0)
    text = mavlink.MAVLink_statustext_message(4, b"<script>alert(1)</script>\x1b[2J", 0, 0)
    station.receive(0, encode(text, 1, 1, 1), 0)
    assert station.model.news(Seen())["texts"][0]["text"] == "<script>alert(1)</script>?[2J"


def test_every_button_has_steps() -> None:
    assert all(ACTIONS.values())
