"""The monitor link: what it tells is what the ground knows, CTRL_LAW changes the law without a bump, and the off-board
link does not know of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from mavsitl_ground import cycle
from mavsitl_ground.controller import Controller, Ground
from mavsitl_ground.formation import Formation
from mavsitl_ground.monitor import Monitor
from mavsitl_ground.observer import Observer
from mavsitl_ground.sequence import Phase
from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import drivers, monitor
from mavsitl.codec import Frame, parse
from mavsitl.dialect import mavlink
from mavsitl.ends import NullRecorder
from mavsitl.log.ulog import MemoryRecorder
from mavsitl.node import Node
from mavsitl.services.parameter import ParameterClient
from tests.drivers.exercise import hash_in_memory, shortened

PERIOD_US = 4000


class Flight:
    """Both wings in memory, the monitor stepped beside them, and whoever listens."""

    def __init__(self, name: str = "hover-wind", seconds: float = 8.0, **overrides: Any) -> None:
        self.flight = shortened(name, seconds, **overrides)
        self.log = MemoryRecorder()
        self.ground = Ground(self.flight, self.log, monitored=True)
        self.vehicle = Vehicle(self.flight, NullRecorder(), seed=self.flight.scenario.seed, lockstep=True)
        self.tap = drivers.Tap()
        self.told: list[Frame] = []
        self.listener = Node(253, mavlink.MAV_COMP_ID_MISSIONPLANNER)
        self.client = ParameterClient((1, monitor.COMPONENT_ID))
        self.at: dict[float, Callable[[], object]] = {}
        """What is done at these times of the flight."""

    @property
    def telling(self) -> Monitor:
        assert self.ground.monitor is not None
        return self.ground.monitor

    def aside(self, now_us: int) -> None:
        for message in self.client.step(now_us):
            self.listener.send_message(message)
        for datagram in self.listener.datagrams():
            self.telling.receive(datagram)
        self.telling.step(now_us)
        for datagram in self.telling.datagrams():
            for frame in self.listener.receive(datagram):
                self.told.append(frame)
                self.client.receive(frame.message, (frame.system_id, frame.component_id), now_us)

    def fly(self) -> Flight:
        step = self.ground.step

        def stepped(now_us: int) -> None:
            step(now_us)
            for at_s in [each for each in self.at if self.ground.flight_time_s >= each]:
                self.at.pop(at_s)()
            self.aside(now_us)

        self.ground.step = stepped  # type: ignore[method-assign]
        drivers.fly_in_memory(self.vehicle, self.ground, self.tap, max_time_s=60.0)
        return self

    def messages(self, kind: int) -> list[Any]:
        return [frame.message for frame in self.told if frame.message_id == kind]

    def arrays(self, array: monitor.Array) -> list[Any]:
        found = self.messages(mavlink.MAVLINK_MSG_ID_DEBUG_FLOAT_ARRAY)
        return [message for message in found if (message.name, message.array_id) == (array.name, array.id)]


def test_no_byte_of_the_offboard_link_changes() -> None:
    watched = Flight(seconds=4.0).fly()
    assert watched.told
    assert watched.tap.wire.hexdigest() == hash_in_memory(watched.flight)


def test_it_tells_what_the_ground_knows() -> None:
    flown = Flight("spiral-wind", 4.0).fly()
    assert {frame.system_id for frame in flown.told} == {1}
    assert {frame.component_id for frame in flown.told} == {monitor.COMPONENT_ID}
    references = flown.messages(mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED)
    assert len(references) == pytest.approx(4.0 / 0.05, abs=3)
    logged = flown.log.tables()["trajectory_setpoint"]
    for message in references:
        row = int(np.searchsorted(logged["timestamp"], message.time_boot_ms * 1000))
        assert (message.x, message.y, message.z) == pytest.approx(logged["position"][row], abs=1e-6)
    weights = flown.arrays(monitor.WEIGHTS)
    rows = flown.log.tables()["pidnn_weights"]
    last = int(np.searchsorted(rows["timestamp"], weights[-1].time_usec))
    expected = [value for net in ("roll", "pitch", "yaw") for value in rows[net][last].tolist()]
    assert weights[-1].data[:9] == pytest.approx(expected, rel=1e-6)
    assert weights[-1].data[:9] != weights[-1].data[9:18]
    link = flown.arrays(monitor.LINK)[-1]
    assert link.data[0] > 900
    assert link.data[1] == 0.0
    phases = [message.custom_mode for message in flown.messages(mavlink.MAVLINK_MSG_ID_HEARTBEAT)]
    assert monitor.PHASES[phases[-1]] == "FLY"


def test_the_phases_have_the_numbers_of_the_handshake() -> None:
    assert {phase.value: phase.name for phase in Phase} == monitor.PHASES


def law_in_flight(flown: Flight, *changes: tuple[float, str]) -> Flight:
    for at_s, law in changes:
        number = monitor.LAWS[law]  # type: ignore[index]
        flown.at[at_s] = lambda number=number: flown.client.set(monitor.CONTROL_LAW, number)  # type: ignore[misc]
    return flown.fly()


def test_the_law_is_changed_in_flight_and_back() -> None:
    flown = law_in_flight(Flight(seconds=8.0), (3.0, "pid"), (5.0, "pidnn"))
    assert flown.ground.law == "pidnn"
    assert flown.client.values[monitor.CONTROL_LAW] == 1
    tables = flown.log.tables()
    error_m = tables["trajectory_setpoint"]["position"].shape[0]
    assert error_m > 1900  # it flew on to its end
    weights = np.hstack([tables["pidnn_weights"][net] for net in ("roll", "pitch", "yaw")])
    changed = np.flatnonzero(np.any(np.diff(weights, axis=0) != 0.0, axis=1))
    still = np.diff(changed)
    assert still.max() == pytest.approx(500, abs=30)  # two seconds of a PID, whose gains are logged


@pytest.mark.parametrize("derivative", ["rate", "difference"])
def test_a_change_of_law_does_not_bump(derivative: str) -> None:
    """From nets that have learned much to a PID: from one state it demands what they did, but for one more error."""
    flight = shortened("hover-wind", 6.0, controller__derivative=derivative, controller__learning__rate=[1e3, 1e3, 1e3])
    controller = Controller(flight)
    state, row = Observer(), np.zeros(cycle.COLUMNS)
    state.state["angles"][0, :, 0] = 0.1, -0.05, 0.2

    def accelerations() -> Any:
        controller.update(1.0, state, row, 0, 0, 0, 0)
        return controller._memory[0]["law"]["out"][:, 0].copy()

    for _ in range(250):
        demanded = accelerations()
    nets = controller._memory[0]["law"]
    assert np.all(np.abs(nets["weights"][:, :, 0] / nets["initial"] - 1.0).max(axis=0) > 0.1)  # they have learned
    controller.fly_by("pid")
    after = accelerations()
    gains = controller._memory[0]["law"]["gains"]
    error = controller._memory[0]["desired"][:, 0] - state.angles_rad[:, 0]
    desired_moves = 0.02 * np.abs(demanded)  # the filter of the desired angles is still on its way
    assert np.all(np.abs(after - demanded - gains[1] * error) < desired_moves)


def test_a_pid_hands_over_to_nets_bit_for_bit() -> None:
    """With nets that do not learn the flight is the same to the bit, however often the law is changed."""
    still: dict[str, Any] = {"controller__law": "pid", "controller__learning__rate": [0.0, 0.0, 0.0]}
    plain = hash_in_memory(shortened("hover-wind", 4.0, **still))
    assert law_in_flight(Flight(seconds=4.0, **still), (1.0, "pidnn")).tap.wire.hexdigest() == plain


def test_a_law_that_is_none_is_refused_and_so_is_one_that_is_aboard() -> None:
    flown = Flight(seconds=3.0)
    wrong = []
    flown.at[1.0] = lambda: wrong.append(flown.client.set(monitor.CONTROL_LAW, 7))
    flown.fly()
    assert wrong[0].outcome == "refused"
    assert wrong[0].error == mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
    assert flown.ground.law == "pidnn"
    aboard = Flight(seconds=3.0, controller__level="attitude")
    refused = []
    aboard.at[1.0] = lambda: refused.append(aboard.client.set(monitor.CONTROL_LAW, 1))
    aboard.fly()
    assert refused[0].outcome == "refused"
    assert aboard.client.values[monitor.CONTROL_LAW] == monitor.NO_LAW
    assert not aboard.arrays(monitor.WEIGHTS)


def test_it_is_silent_without_a_vehicle_and_survives_junk() -> None:
    ground = Ground(shortened("hover-wind", 2.0), NullRecorder(), monitored=True)
    assert ground.monitor is not None
    ground.monitor.step(100_000)
    assert ground.monitor.datagrams() == []
    assert ground.monitor.receive(b"\xfd\x00junk") == 0


def test_a_formation_tells_of_each() -> None:
    formation = Formation(shortened("formation-spiral", 2.0), [NullRecorder(), NullRecorder()], count=2, monitored=True)
    vehicles = [Vehicle(shortened("formation-spiral", 2.0), NullRecorder(), seed=1, system_id=1 + j) for j in range(2)]
    assert formation.monitor is not None
    senders = set()
    for now_us in range(0, 3_000_000, 20_000):
        for j, vehicle in enumerate(vehicles):
            vehicle.step(now_us)
            for datagram in vehicle.datagrams(0, combine=False):
                formation.receive(j, datagram)
        formation.step(now_us, due=True)
        for port, _, datagrams in formation.outgoing():
            for datagram in datagrams:
                vehicles[port].receive(0, datagram)
        formation.monitor.step(now_us)
        for datagram in formation.monitor.datagrams():
            senders |= {(frame.system_id, frame.component_id) for frame in parse(datagram)}
    assert senders == {(1, monitor.COMPONENT_ID), (2, monitor.COMPONENT_ID)}
