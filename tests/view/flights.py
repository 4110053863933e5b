"""Vehicles in real time and the page's server, in threads of the test's own process."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from mavsitl_vehicle.vehicle import Vehicle

from mavsitl import drivers, scenario
from mavsitl.drivers import Tap
from mavsitl.ends import NullRecorder
from mavsitl.link.udp import LOOPBACK, UdpLink
from mavsitl.view import server
from mavsitl.view.server import Page, Source

STOP_S = 20.0


@contextmanager
def flying(system_id: int, to_port: int, *, speed: float = 1.0) -> Iterator[Vehicle]:
    """A vehicle whose link for ground stations sends to a port of loopback; `speed` is simulated over wall time."""
    flight = scenario.load("takeoff-hover")
    offboard = UdpLink((LOOPBACK, 0))
    gcs = UdpLink((LOOPBACK, 0), (LOOPBACK, to_port))
    try:
        core = Vehicle(
            flight, NullRecorder(), seed=system_id, system_id=system_id, ports=("offboard", "gcs"), lockstep=False
        )
        stop = threading.Event()
        thread = threading.Thread(
            target=lambda: drivers.run_realtime_vehicle(core, [offboard, gcs], Tap(), speed=speed, stop=stop.is_set),
            daemon=True,
        )
        thread.start()
        try:
            yield core
        finally:
            stop.set()
            thread.join(STOP_S)
            assert not thread.is_alive()
    finally:
        offboard.close()
        gcs.close()


@contextmanager
def serving(source: Source, port: int = 0) -> Iterator[str]:
    """The page's address."""
    page = Page(source, LOOPBACK, port)
    stop, started = threading.Event(), threading.Event()
    failures: list[BaseException] = []

    def serve() -> None:
        try:
            asyncio.run(server.run(page, source, stop=stop.is_set, started=started.set))
        except BaseException as error:
            failures.append(error)
            started.set()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        assert started.wait(STOP_S)
        if not failures:
            yield page.address
    finally:
        stop.set()
        thread.join(STOP_S)
    if failures:
        raise failures[0]
