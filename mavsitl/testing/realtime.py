"""A vehicle on sockets, in a thread of the test's own process: for clients that are programs, or bring their own loop.

The client under test is anything that speaks MAVLink over UDP. The test holds the vehicle itself, and makes it
misbehave while the client works::

    with vehicle() as sitl:
        client = mavutil.mavlink_connection(sitl.gcs_device)
        with sitl.chaos.during("ack-first-lost"):
            ...
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from mavsitl import drivers, wings
from mavsitl.clock import monotonic_us
from mavsitl.drivers import Tap
from mavsitl.ends import lockstep_channels
from mavsitl.link.impaired import Channels, ImpairedLink
from mavsitl.link.udp import LOOPBACK, ConnectedUdp, UdpLink
from mavsitl.pair import free_ports
from mavsitl.testing.checks import FlightAssertionError
from mavsitl.testing.craft import Craft, Overrides, ScenarioLike, Watched, prepare
from mavsitl.testing.results import State

if TYPE_CHECKING:
    from mavsitl.chaos import Chaos

__all__ = ["RunningVehicle", "vehicle"]

STOP_S = 10.0
"""A vehicle that is told to stop ends with its tick; beyond this it hangs, and that is an error."""
LOOK_S = 0.005
"""Wall clock between two looks at a vehicle whose state is waited for."""

T = TypeVar("T")


class _Stopped(Exception):
    """A test is over before its vehicle's flight is."""


class RunningVehicle(Craft):
    """A vehicle that runs by itself, in real time or in lock-step with a program. Times are since its start.

    Attributes:
        core: the vehicle's core; it belongs to the vehicle's thread, and only `chaos` may be used from others.
        offboard_port, gcs_port: where its two links send: a client listens there (14540 and 14550 of PX4 SITL).
        offboard_own, gcs_own: where they listen: a client may speak first there (14580 and 18570 of PX4 SITL).
        lockstep: time goes by answers; it has the off-board link alone.
    """

    def __init__(self, flight: Any, logs: Path | None, lockstep: bool) -> None:
        super().__init__(flight, logs)
        self.lockstep = lockstep
        self.offboard_own = self.offboard_port = self.gcs_own = self.gcs_port = 0
        self._lock = threading.RLock()
        self._over = threading.Event()

    @property
    def chaos(self) -> Chaos:
        """What misbehaves; `begin`, `end` and `during` may be called at any time."""
        found: Chaos = self.core.chaos
        return found

    @property
    def offboard_url(self) -> str:
        """Of the off-board link, as MAVSDK takes it: the client speaks first, and needs no port of its own.

        In lock-step the vehicle speaks first, and the client listens.
        """
        if self.lockstep:
            return f"udpin://{LOOPBACK}:{self.offboard_port}"
        return f"udpout://{LOOPBACK}:{self.offboard_own}"

    @property
    def gcs_url(self) -> str:
        """Of the ground stations' link, as MAVSDK takes it."""
        return f"udpout://{LOOPBACK}:{self.gcs_own}"

    @property
    def offboard_device(self) -> str:
        """As `offboard_url`, for `mavutil.mavlink_connection` and MAVProxy's ``--master``."""
        return self.offboard_url.replace("//", "")

    @property
    def gcs_device(self) -> str:
        """As `gcs_url`, for `mavutil.mavlink_connection` and MAVProxy's ``--master``."""
        return self.gcs_url.replace("//", "")

    def wait_until(self, condition: Callable[[State], bool], *, within_s: float) -> State:
        """Wait until a condition holds of the vehicle's true state, looking every few milliseconds; the state then.

        `within_s` is of the wall clock. Raises `FlightAssertionError` where it does not, or the vehicle ends before.
        """
        end_us = monotonic_us() + round(within_s * 1e6)
        while True:
            over = self._over.is_set()
            state = self.now
            if condition(state):
                return state
            if over or monotonic_us() >= end_us:
                found = "the vehicle ended before" if over else "it did not"
                raise FlightAssertionError(self, f"the condition comes within {within_s:g} s", [found], self.time_s)
            self._over.wait(LOOK_S)

    def wait_end(self, *, within_s: float) -> RunningVehicle:
        """Wait for the end of a flight in lock-step: the vehicle has flown and is disarmed. Raises as `wait_until`."""
        if not self._over.wait(within_s):
            raise FlightAssertionError(self, f"the flight ends within {within_s:g} s", ["it did not"], self.time_s)
        return self

    def flush(self) -> None:
        """The ULog. The tlog is the vehicle's thread's alone, which flushes it twice a second."""
        if self._logs is not None:
            self._call(self._logs.vehicle.flush)

    def _call(self, function: Callable[[], T]) -> T:
        with self._lock:
            return function()


class _Locked(Watched):
    """As the vehicle's thread has the core: the test's thread may look at it between two calls."""

    def __init__(self, core: Any, craft: RunningVehicle) -> None:
        super().__init__(core, craft)
        self._lock = craft._lock

    def step(self, now_us: int) -> None:
        with self._lock:
            super().step(now_us)

    def datagrams(self, port: int, *, combine: bool) -> list[bytes]:
        with self._lock:
            return super().datagrams(port, combine=combine)

    def receive(self, port: int, datagram: bytes, at_us: int | None = None) -> int:
        with self._lock:
            count: int = self._core.receive(port, datagram, at_us)
            return count


@contextmanager
def vehicle(
    name: ScenarioLike = "takeoff-hover",
    *,
    speed: float = 1.0,
    lockstep: bool = False,
    seed: int | None = None,
    overrides: Overrides | None = None,
    state: Path | None = None,
    logs: Path | None = None,
    record: Path | None = None,
) -> Iterator[RunningVehicle]:
    """Run a vehicle on free ports of loopback until the end of the `with`.

    `name`, `seed` and `overrides` as of `Flight`; `speed` is simulated over wall time. `lockstep`: time goes on when
    the program answers, each telemetry with a setpoint that has its time_boot_ms; then the vehicle ends with its
    flight. `state` is a folder for what outlives the vehicle, `logs` one with logs to download, `record` one for the
    logs of this flight; None: none. What ends the vehicle's thread early is raised at the end. Raises `ScenarioError`,
    `LinkError`.
    """
    if not speed > 0.0:
        raise ValueError(f"speed is {speed}; allowed: number > 0")
    running = RunningVehicle(prepare(name, seed=seed, overrides=overrides, live=not lockstep), record, lockstep)
    run = _lockstep if lockstep else _realtime
    stop = threading.Event()
    failures: list[BaseException] = []
    links: list[Any] = []
    try:
        fly = run(running, links, speed, state, logs, stop)
        running.chaos  # noqa: B018  made here, so that no two threads make it

        def guarded() -> None:
            try:
                with suppress(_Stopped):
                    fly()
            except BaseException as error:
                failures.append(error)
            finally:
                running._over.set()

        thread = threading.Thread(target=guarded, name="mavsitl vehicle", daemon=True)
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
        running.close()


def _realtime(
    running: RunningVehicle, links: list[Any], speed: float, state: Path | None, logs: Path | None,
    stop: threading.Event,
) -> Callable[[], object]:  # fmt: skip
    """What the vehicle's thread does; `links` are to be closed at the end."""
    scenario = running.scenario.scenario
    remotes = free_ports(2)
    sockets = []
    for remote in remotes:
        sockets.append(UdpLink((LOOPBACK, 0), (LOOPBACK, remote), port_option="a free port", host_option="host"))
        links.append(sockets[-1])
    running.offboard_port, running.gcs_port = remotes
    running.offboard_own, running.gcs_own = (int(each.address[1]) for each in sockets)
    build = wings.find(wings.VEHICLE_GROUP)
    core = build(
        running.scenario, running._recording, seed=scenario.seed, ports=("offboard", "gcs"), state=state, logs=logs
    )
    running.core = core
    start_us = monotonic_us()

    def simulated_us() -> int:
        return int((monotonic_us() - start_us) * speed)

    impaired: list[ImpairedLink] = []
    for name, place, model, each in (
        ("offboard", "link", scenario.link, sockets[0]), ("gcs", "gcs_link", scenario.gcs_link, sockets[1])
    ):  # fmt: skip
        channels = running._channels[name] = Channels(model, scenario.seed, place)
        impaired.append(ImpairedLink(each, channels, simulated_us, lambda: core.flight_time_s))
    running._subscribe(core)
    return lambda: drivers.run_realtime_vehicle(
        _Locked(core, running), impaired, _tap(running), speed=speed, stop=stop.is_set,
        due_s=lambda: min(each.due_us() for each in impaired) * 1e-6 / speed,
    )  # fmt: skip


def _lockstep(
    running: RunningVehicle, links: list[Any], speed: float, state: Path | None, logs: Path | None,
    stop: threading.Event,
) -> Callable[[], object]:  # fmt: skip
    if speed != 1.0 or state is not None or logs is not None:
        raise ValueError("in lock-step there is no speed, no state and no logs to download")
    (running.offboard_port,) = free_ports(1)
    link = ConnectedUdp(
        (LOOPBACK, running.offboard_port), (LOOPBACK, 0), timeout_s=drivers.FIRST_REPEAT_S,
        port_option="a free port", host_option="host",
    )  # fmt: skip
    links.append(link)
    running.offboard_own = int(link.address[1])
    core = wings.find(wings.VEHICLE_GROUP)(
        running.scenario, running._recording, seed=running.scenario.scenario.seed, lockstep=True
    )
    running.core = core
    channels = lockstep_channels(running.scenario)
    if channels is not None:
        running._channels["offboard"] = channels
        running._subscribe(core)

    def heed(flight_time_s: float) -> None:
        if stop.is_set():
            raise _Stopped

    return lambda: drivers.run_lockstep_vehicle(
        _Locked(core, running), link, _tap(running), progress=heed, channels=channels
    )


def _tap(running: RunningVehicle) -> Tap:
    files = running._logs
    return Tap() if files is None else Tap(tlog=files.wire, flush=running.flush)
