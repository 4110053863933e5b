"""One end of a flight as a process runs it: core, link, log files and driver, put together and closed again."""

from __future__ import annotations

import errno
import ipaddress
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mavsitl import __version__, drivers, wings
from mavsitl.clock import monotonic_us, unix_us
from mavsitl.drivers import Progress, Tap
from mavsitl.herald import Herald
from mavsitl.link.address import Address
from mavsitl.link.base import Link, LinkError
from mavsitl.link.endpoint import open_link
from mavsitl.link.udp import LOOPBACK, ConnectedUdp, UdpLink
from mavsitl.log.errors import LogError
from mavsitl.log.tlog import TlogWriter
from mavsitl.scenario import Flight, LinkModel

if TYPE_CHECKING:
    from mavsitl.check import Ear, Report, VehiclePort
    from mavsitl.link.impaired import Channels, ImpairedLink
    from mavsitl.log.ulog import Recorder

WIRE_LOG = "link.tlog"

GCS_PORT, GCS_REMOTE_PORT = 18570, 14550
OFFBOARD_PORT, OFFBOARD_REMOTE_PORT = 14580, 14540
"""PX4 SITL's: each is raised by the instance."""


@dataclass(frozen=True)
class Outcome:
    """What an end has to say when it is over."""

    simulated_s: float
    wall_s: float
    """Of the same stretch: in lock-step from the first exchange on, so that start-up is not in it."""
    wire_hash: str
    finished: bool
    """The flight came to its planned end: not stopped, not taken over."""
    frames: int
    """Valid frames received."""
    rejected: int
    """Bytes that looked like frames and were not."""
    lateness_us: tuple[float, float] | None = None
    """p50 and p99 of the tick's lateness; real time only."""
    rebased: int = 0
    link: dict[str, dict[str, float]] | None = None
    """Of an impaired link, by direction: `mavsitl.link.impaired.Statistics`; None of a perfect one, and the ground."""

    @property
    def speed(self) -> float:
        """Simulated over wall time."""
        return self.simulated_s / self.wall_s if self.wall_s > 0.0 else 0.0


End = Literal["vehicle", "ground"]

IMPAIRED_GRACE_S = 300.0
"""Over an impaired link a flight in lock-step that takes so much longer than its scenario says will never end."""


def _impaired_lockstep(flight: Flight) -> bool:
    """Whether a tick may pass without an answer: over an impaired link, or where the vehicle misbehaves."""
    return flight.scenario.link != LinkModel() or bool(flight.scenario.chaos)


def _channels(flight: Flight, *, lockstep: bool) -> Channels | None:
    always = lockstep and _impaired_lockstep(flight)
    if flight.scenario.link == LinkModel() and not always:
        return None
    from mavsitl.link.impaired import channels_for  # here, for it loads numpy

    return channels_for(flight.scenario.link, flight.scenario.seed, always=always)


@contextmanager
def _logs(folder: Path | None, end: End, flight: Flight) -> Iterator[tuple[Recorder, Tap]]:
    """Recorder and tap of an end. Without a folder the rows are dropped as they come."""
    if folder is None:
        yield NullRecorder(), Tap()
        return
    # Here, for they load numpy: a vehicle is heard before that.
    from mavsitl.log.flight import GROUND_LOG, VEHICLE_LOG
    from mavsitl.log.topics import GROUND_TOPICS, VEHICLE_TOPICS
    from mavsitl.log.ulog import UlogWriter

    name, topics = (VEHICLE_LOG, VEHICLE_TOPICS) if end == "vehicle" else (GROUND_LOG, GROUND_TOPICS)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(f"{folder}: no logs can be written there: {error.strerror or error}") from error
    info = {"sys_name": "mavsitl", "ver_sw": __version__, "scenario": flight.name}
    parameters = flight.airframe.parameters | flight.scenario.parameters
    with UlogWriter(folder / name, info, parameters, topics=topics) as writer:
        tlog = TlogWriter(folder / WIRE_LOG) if end == "vehicle" else None
        try:
            yield writer, Tap(tlog=tlog, flush=writer.flush)
        finally:
            if tlog is not None:
                tlog.close()


class _NullRows:
    __slots__ = ()

    def append(self, timestamp_us: int, *values: float) -> None:
        pass

    def extend(self, timestamps_us: Any, values: Any) -> None:
        pass


class NullRecorder:
    """Keeps nothing: for an end that runs without a folder."""

    def topic(self, topic: Any) -> Any:
        return _NullRows()

    def message(self, timestamp_us: int, level: int, text: str) -> None:
        pass

    def attach(self, drain: Callable[[], None]) -> None:
        pass


@dataclass(frozen=True)
class VehicleLinks:
    """Where the vehicle binds and sends. `bind` is loopback unless told otherwise."""

    bind: str = LOOPBACK
    offboard_port: int = OFFBOARD_PORT
    offboard_remote: tuple[str, int] = (LOOPBACK, OFFBOARD_REMOTE_PORT)
    gcs_port: int = GCS_PORT
    gcs_remote: tuple[str, int] = (LOOPBACK, GCS_REMOTE_PORT)
    tcp_port: int | None = None
    """Of a TCP server for ground stations; None: none."""


def vehicle_lockstep(
    flight: Flight,
    links: VehicleLinks,
    folder: Path | None,
    *,
    system_id: int,
    wing: str | None,
    deadline_s: float,
    cpu: int | None,
    progress: Progress | None,
) -> Outcome:
    """The vehicle in lock-step over UDP with one ground. Raises `LinkError`, `ScenarioError`, `LogError`."""
    link = ConnectedUdp(
        links.offboard_remote, (links.bind, links.offboard_port), timeout_s=drivers.FIRST_REPEAT_S,
        port_option="--offboard-port N", host_option="--bind HOST",
    )  # fmt: skip
    try:
        with _logs(folder, "vehicle", flight) as (recorder, tap):
            build = wings.find(wings.VEHICLE_GROUP, wing)
            core = build(
                flight, recorder, seed=flight.scenario.seed, system_id=system_id, ports=("offboard",), lockstep=True
            )
            watch = _Watch(core)
            channels = _channels(flight, lockstep=True)
            end_us = drivers.run_lockstep_vehicle(
                core, link, tap, deadline_s=deadline_s, cpu=cpu, progress=progress,
                channels=channels, max_time_s=flight.scenario.duration_s + IMPAIRED_GRACE_S,
            )  # fmt: skip
            return watch.outcome(end_us, tap, channels=channels)
    finally:
        link.close()


def ground_lockstep(
    flight: Flight, bind: tuple[str, int], remote: tuple[str, int], folder: Path | None, *,
    vehicle_system_id: int | None, wing: str | None, deadline_s: float, cpu: int | None,
    report: Callable[[str], None], progress: Progress | None,
) -> Outcome:  # fmt: skip
    """The ground in lock-step over UDP with one vehicle. Raises as `vehicle_lockstep`."""
    link = ConnectedUdp(
        remote,
        bind,
        timeout_s=drivers.FIRST_REPEAT_S,
        port_option="--link udpin:HOST:PORT",
        host_option="--link udpin:HOST:PORT",
    )
    try:
        with _logs(folder, "ground", flight) as (recorder, tap):
            build = wings.find(wings.GROUND_GROUP, wing)
            core = build(flight, recorder, report=report, vehicle_system_id=vehicle_system_id)
            watch = _Watch(core)
            end_us = drivers.run_lockstep_ground(
                core, link, tap, deadline_s=deadline_s, cpu=cpu, progress=progress,
                impaired=_impaired_lockstep(flight),
            )  # fmt: skip
            return watch.outcome(end_us, tap)
    finally:
        link.close()


def vehicle_realtime(
    flight: Flight, links: VehicleLinks, folder: Path | None, *,
    system_id: int, wing: str | None, speed: float, until_finished: bool, state: Path | None,
    stop: Callable[[], bool], progress: Progress | None,
) -> Outcome:  # fmt: skip
    """The vehicle on the wall clock, with PX4 SITL's two links and TCP where asked for. Raises as `vehicle_lockstep`.

    `state` is the folder of what outlives the process, None: nothing does.
    """
    opened: list[Link] = []
    try:
        opened.append(
            UdpLink(
                (links.bind, links.offboard_port),
                links.offboard_remote,
                port_option="--offboard-port N",
                host_option="--bind HOST",
            )
        )
        channels = _channels(flight, lockstep=False)
        impaired = None if channels is None else _impaired(opened[0], channels, speed)
        if impaired is not None:
            opened[0] = impaired
        opened.append(
            UdpLink(
                (links.bind, links.gcs_port), links.gcs_remote, port_option="--gcs-port N", host_option="--bind HOST"
            )
        )
        if links.tcp_port is not None:
            from mavsitl.link.tcp import TcpServerLink

            opened.append(TcpServerLink((links.bind, links.tcp_port), port_option="--tcp-port N"))
        with ExitStack() as stack:
            # A vehicle that misbehaves does so from its first word: nobody speaks for it.
            boot = None if flight.scenario.chaos else wings.find_boot(wing)
            with Herald(boot, system_id, opened) as herald:
                recorder, tap = stack.enter_context(_logs(folder, "vehicle", flight))
                build = wings.find(wings.VEHICLE_GROUP, wing)
                core = build(
                    flight, recorder, seed=flight.scenario.seed, system_id=system_id,
                    ports=("offboard", *["gcs"] * (len(opened) - 1)), lockstep=False,
                    state=state, logs=folder, unix_us=_steady_unix_clock(), trusted=is_loopback(links.bind),
                )  # fmt: skip
            if impaired is not None:
                impaired.flight_time_s = lambda: core.flight_time_s
            if herald.sequence:
                core.continue_from(herald.sequence)
            watch = _Watch(core)
            try:
                timing = drivers.run_realtime_vehicle(
                    core, opened, tap, speed=speed, until_finished=until_finished, stop=stop, progress=progress
                )
            finally:
                core.close()
            lateness = (timing.lateness.p50_us, timing.lateness.p99_us)
            return watch.outcome(timing.simulated_us, tap, lateness, timing.rebased, timing.wall_us, channels)
    finally:
        for link in opened:
            link.close()


def _impaired(link: Link, channels: Channels, speed: float) -> ImpairedLink:
    """In wall time times speed, which begins now."""
    from mavsitl.link.impaired import ImpairedLink

    start_us = monotonic_us()
    return ImpairedLink(link, channels, lambda: int((monotonic_us() - start_us) * speed))


def ground_realtime(
    flight: Flight, address: Address, folder: Path | None, *,
    vehicle_system_id: int | None, wing: str | None,
    report: Callable[[str], None], stop: Callable[[], bool], progress: Progress | None,
) -> Outcome:  # fmt: skip
    """The ground on the wall clock, on any endpoint. Raises as `vehicle_lockstep`."""
    link = open_link(address, port_option="--link udpin:HOST:PORT", host_option="--link udpin:HOST:PORT")
    try:
        with _logs(folder, "ground", flight) as (recorder, tap):
            build = wings.find(wings.GROUND_GROUP, wing)
            core = build(flight, recorder, report=report, vehicle_system_id=vehicle_system_id)
            watch = _Watch(core)
            simulated_us, wall_us = drivers.run_realtime_ground(core, link, tap, stop=stop, progress=progress)
            return watch.outcome(simulated_us, tap, wall_us=wall_us)
    finally:
        link.close()


def in_memory(
    flight: Flight, folder: Path | None, *, report: Callable[[str], None], progress: Progress | None
) -> Outcome:
    """Both ends in this process; the same bytes as in lock-step over UDP."""
    with (
        _logs(folder, "vehicle", flight) as (vehicle_recorder, tap),
        _logs(folder, "ground", flight) as (ground_recorder, ground_tap),
    ):
        vehicle_flush, ground_flush = tap.flush, ground_tap.flush

        def flush(now_us: int) -> None:
            for each in (vehicle_flush, ground_flush):
                if each is not None:
                    each(now_us)

        tap.flush = flush
        vehicle = wings.find(wings.VEHICLE_GROUP)(flight, vehicle_recorder, seed=flight.scenario.seed, lockstep=True)
        ground = wings.find(wings.GROUND_GROUP)(flight, ground_recorder, report=report)
        watch = _Watch(ground)
        channels = _channels(flight, lockstep=True)
        limit_s = inf if channels is None else flight.scenario.duration_s + IMPAIRED_GRACE_S
        end_us = drivers.fly_in_memory(vehicle, ground, tap, max_time_s=limit_s, progress=progress, channels=channels)
        return watch.outcome(end_us, tap, channels=channels)


def is_loopback(host: str) -> bool:
    """Can only programs of this machine reach it?"""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _steady_unix_clock() -> Callable[[], int]:
    """The system's clock as of now, which from here on does not jump with it."""
    offset_us = unix_us() - monotonic_us()
    return lambda: offset_us + monotonic_us()


CHECKED_INSTANCES = 10
"""Instances whose ports `check` looks at."""


def check(endpoints: Sequence[Address] | None, *, duration_s: float, ask: bool) -> Report:
    """Listen at the endpoints and say who is there; None: at the ports that PX4's vehicles send to, on loopback.

    An endpoint that cannot be opened is in the report. In its stead, at PX4's ports, each vehicle port that somebody
    has is called.
    """
    from mavsitl.check import Check

    found = _vehicle_ports()
    wanted = list(endpoints) if endpoints is not None else _default_endpoints()
    ears: list[Ear] = []
    links: list[Link | None] = []
    try:
        for address in wanted:
            ear, link = _open_ear(address)
            ears.append(ear)
            links.append(link)
            if endpoints is None and ear.taken and ask:
                for held in found:
                    if held.sends_to == address.port:
                        ear, link = _open_ear(Address("udpout", LOOPBACK, held.port))
                        ears.append(ear)
                        links.append(link)
        core = Check(ears, found, ask=ask)
        return core.report(drivers.run_check(core, links, duration_s))
    finally:
        for opened in links:
            if opened is not None:
                opened.close()


def _default_endpoints() -> list[Address]:
    return [Address("udpin", LOOPBACK, port) for port in (GCS_REMOTE_PORT, OFFBOARD_REMOTE_PORT)]


def _vehicle_ports() -> list[VehiclePort]:
    from mavsitl.check import VehiclePort
    from mavsitl.link.holders import holders

    named = {}
    for instance in range(CHECKED_INSTANCES):
        named[GCS_PORT + instance] = (GCS_REMOTE_PORT, "--gcs-remote")
        named[OFFBOARD_PORT + instance] = (OFFBOARD_REMOTE_PORT + instance, "--offboard-remote")
    return [
        VehiclePort(port=port, sends_to=named[port][0], option=named[port][1], holder=holder)
        for port, holder in holders(named).items()
    ]


def _open_ear(address: Address) -> tuple[Ear, Link | None]:
    from mavsitl.check import Ear
    from mavsitl.link.holders import find_command, holders

    speaks_first = address.kind in ("udpout", "tcp")
    try:
        link = open_link(address, port_option="--listen ENDPOINT", host_option="--listen ENDPOINT")
    except LinkError as error:
        taken = isinstance(error.__cause__, OSError) and error.__cause__.errno == errno.EADDRINUSE
        udp = address.kind == "udpin"
        ear = Ear(
            endpoint=str(address),
            error=str(error),
            taken=taken,
            holder=holders([address.port]).get(address.port, "") if taken and udp else "",
            find_holder=find_command(address.port) if taken and udp else "",
        )
        return ear, None
    return Ear(endpoint=str(address), speaks_first=speaks_first), link


class _Watch:
    """Wall time of a run, from the first exchange: start-up and waiting for the other side do not count."""

    def __init__(self, core: Any) -> None:
        self._core = core
        self._start_us = monotonic_us()

    def outcome(
        self,
        simulated_us: int,
        tap: Tap,
        lateness_us: tuple[float, float] | None = None,
        rebased: int = 0,
        wall_us: int | None = None,
        channels: Channels | None = None,
    ) -> Outcome:
        """`wall_us`: None is since the first exchange."""
        counters = self._core.counters
        if wall_us is None:
            wall_us = monotonic_us() - (tap.started_us or self._start_us)
        return Outcome(
            simulated_s=simulated_us / 1e6,
            wall_s=wall_us / 1e6,
            wire_hash=tap.wire.hexdigest(),
            finished=self._core.succeeded,
            frames=counters.frames,
            rejected=counters.rejected,
            lateness_us=lateness_us,
            rebased=rebased,
            link=None if channels is None else channels.statistics(),
        )
