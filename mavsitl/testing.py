"""For tests of MAVLink clients: a vehicle in real time, on sockets, in a thread of the test's own process.

The client under test is anything that speaks MAVLink over UDP. The test holds the vehicle itself, and makes it
misbehave while the client works::

    with vehicle() as sitl:
        client = mavutil.mavlink_connection(f"udpin:127.0.0.1:{sitl.gcs_port}")
        with sitl.chaos.during("ack-first-lost"):
            ...
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavsitl import drivers, scenario, wings
from mavsitl.drivers import Tap
from mavsitl.ends import NullRecorder
from mavsitl.link.base import Link
from mavsitl.link.udp import LOOPBACK, UdpLink
from mavsitl.pair import free_ports

if TYPE_CHECKING:
    from mavsitl.chaos import Chaos

__all__ = ["RunningVehicle", "vehicle"]

STOP_S = 10.0
"""A vehicle that is told to stop ends with its tick; beyond this it hangs, and that is an error."""


class RunningVehicle:
    """A vehicle that runs.

    Attributes:
        core: the vehicle's core; it belongs to the vehicle's thread, and only `chaos` may be used from others.
        offboard_port, gcs_port: where its two links send: a client listens there (14540 and 14550 of PX4 SITL).
        offboard_own, gcs_own: where they listen: a client may speak first there (14580 and 18570 of PX4 SITL).
    """

    def __init__(self, core: Any, ports: tuple[int, int, int, int]) -> None:
        self.core = core
        self.offboard_own, self.offboard_port, self.gcs_own, self.gcs_port = ports

    @property
    def chaos(self) -> Chaos:
        """What misbehaves; `begin`, `end` and `during` may be called at any time."""
        found: Chaos = self.core.chaos
        return found


@contextmanager
def vehicle(
    name: str = "takeoff-hover",
    *,
    speed: float = 1.0,
    overrides: Mapping[str, Any] | None = None,
    state: Path | None = None,
    logs: Path | None = None,
) -> Iterator[RunningVehicle]:
    """Run a vehicle on free ports of loopback until the end of the `with`.

    `name` and `overrides` as of `mavsitl.scenario.load`; `speed` is simulated over wall time; `state` is a folder for
    what outlives the vehicle, `logs` one with logs to download; None: none. What ends the vehicle's thread early is
    raised at the end. Raises `ScenarioError`, `LinkError`.
    """
    flight = scenario.load(name, dict(overrides or {}))
    ports = free_ports(4)
    links: list[Link] = []
    stop = threading.Event()
    failures: list[BaseException] = []
    try:
        for own, remote in ((ports[0], ports[1]), (ports[2], ports[3])):
            links.append(UdpLink((LOOPBACK, own), (LOOPBACK, remote), port_option="a free port", host_option="host"))
        core = wings.find(wings.VEHICLE_GROUP)(
            flight, NullRecorder(), seed=flight.scenario.seed, ports=("offboard", "gcs"), state=state, logs=logs
        )
        running = RunningVehicle(core, (ports[0], ports[1], ports[2], ports[3]))
        running.chaos  # noqa: B018  made here, so that no two threads make it

        def fly() -> None:
            try:
                drivers.run_realtime_vehicle(core, links, Tap(), speed=speed, stop=stop.is_set)
            except BaseException as error:
                failures.append(error)

        thread = threading.Thread(target=fly, name="mavsitl vehicle", daemon=True)
        thread.start()
        try:
            yield running
        finally:
            stop.set()
            thread.join(STOP_S)
            if thread.is_alive():
                raise RuntimeError(f"the vehicle did not stop within {STOP_S:g} s")
        if failures:
            raise failures[0]
    finally:
        for link in links:
            link.close()
