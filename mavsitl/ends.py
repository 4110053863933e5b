"""One end of a flight as a process runs it: core, link, log files and driver, put together and closed again."""

from __future__ import annotations

import errno
import inspect
import ipaddress
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mavsitl import drivers, fleet, process, realtime, wings
from mavsitl.clock import monotonic_us, unix_us
from mavsitl.drivers import Progress, RealTime, Tap
from mavsitl.errors import UsageError
from mavsitl.fleet import FleetOutcome, Flown
from mavsitl.herald import Herald
from mavsitl.link.address import Address
from mavsitl.link.base import Link, LinkError
from mavsitl.link.endpoint import open_link
from mavsitl.link.settings import PLACES
from mavsitl.link.udp import LOOPBACK, ConnectedUdp, UdpLink
from mavsitl.log.errors import Failed, LogError
from mavsitl.log.tlog import TlogWriter
from mavsitl.scenario import Flight, LinkModel

if TYPE_CHECKING:
    from mavsitl.ask import Reply, Task
    from mavsitl.check import Ear, Report, VehiclePort
    from mavsitl.link.impaired import Channels, ImpairedLink
    from mavsitl.link.settings import LinkName, Overlay
    from mavsitl.log.ulog import Recorder

WIRE_LOG = "link.tlog"

GCS_PORT, GCS_REMOTE_PORT = 18570, 14550
OFFBOARD_PORT, OFFBOARD_REMOTE_PORT = 14580, 14540
"""PX4 SITL's: each is raised by the instance."""
REMOTE_INSTANCES = 10
"""From this instance on all send to the off-board port of the one before it, as PX4's do: higher ones are others'."""


def offboard_remote_port(instance: int) -> int:
    """Where an instance's off-board link sends first."""
    return OFFBOARD_REMOTE_PORT + min(instance, REMOTE_INSTANCES - 1)


def ground_address(instance: int) -> Address:
    """Where a program meets an instance that nobody told otherwise: it is sent to, or has to speak first."""
    if instance < REMOTE_INSTANCES:
        return Address("udpin", LOOPBACK, OFFBOARD_REMOTE_PORT + instance)
    return Address("udpout", LOOPBACK, OFFBOARD_PORT + instance)


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
    """p50 and p99 of the tick's lateness; of a vehicle in real time only."""
    rebased: int = 0
    """How often the schedule was moved, the machine being too slow or the process suspended."""
    lost_s: float = 0.0
    """Wall time given up by that."""
    lost: str = ""
    """How the vehicle was lost in flight; empty: it was not. The ground's to say."""
    links: dict[str, dict[str, dict[str, float]]] = field(default_factory=dict)
    """Of the vehicle's impaired links ("link", "gcs_link", "tcp_link"), by direction:
    `mavsitl.link.impaired.Statistics`."""
    dropped: dict[str, int] = field(default_factory=dict)
    """Input that was not taken, by reason, those that happened: `mavsitl.codec.Counters`."""

    @property
    def speed(self) -> float:
        """Simulated over wall time."""
        return self.simulated_s / self.wall_s if self.wall_s > 0.0 else 0.0


End = Literal["vehicle", "ground"]

IMPAIRED_GRACE_S = 300.0
"""Over an impaired link a flight in lock-step that takes so much longer than its scenario says will never end."""


def lockstep_channels(flight: Flight, vehicle: int = 0) -> Channels | None:
    """Of the off-board link in lock-step, of that vehicle of a fleet; None where each tick is answered."""
    if not flight.scenario.impaired:
        return None
    from mavsitl import seeds  # here, for these load numpy
    from mavsitl.link.impaired import Channels

    return Channels(flight.scenario.link, seeds.of_vehicle(flight.scenario.seed, vehicle))


def _watch_lockstep_link(core: Any, channels: Channels | None, recorder: Recorder, tap: Tap) -> None:
    """Parameters change the one link, and it is logged."""
    if channels is None:
        return
    from mavsitl.log.links import LinkLog

    change_by_parameters(core, channels)
    tap.record = LinkLog(recorder, lambda: {"link": channels}).write


def change_by_parameters(core: Any, channels: Channels) -> None:
    """What the vehicle's parameters say of the off-board link is laid over it, in lock-step."""

    def listen(link: LinkName, overlay: Overlay) -> None:
        if link == "link":
            channels.lay_over(overlay)

    _subscribe(core, listen)


def _subscribe(core: Any, listener: Callable[[LinkName, Overlay], None]) -> None:
    """To a vehicle that has settings of its links in flight; another wing's need not."""
    subscribe = getattr(core, "subscribe_links", None)
    if subscribe is not None:
        subscribe(listener)


class _LiveLinks:
    """The vehicle's links in real time. One that is perfect has nothing before it until a parameter makes it bad."""

    def __init__(self, links: list[Link], flight: Flight, speed: float, seed: int | None = None) -> None:
        """`links` in the order of the ports; elements of the list are replaced. `seed`: None is the scenario's."""
        self.channels: dict[str, Channels] = {}
        """By place; those that there are."""
        self.flight_time_s: Callable[[], float] = lambda: -1.0
        self._links = links
        self._impaired: list[ImpairedLink] = []
        self._seed = flight.scenario.seed if seed is None else seed
        self._speed = speed
        self._start_us = monotonic_us()
        scenario = flight.scenario
        self._models = {place: scenario.link if place == "link" else scenario.gcs_link for place in PLACES}
        for place, _ in zip(PLACES, links, strict=False):
            if self._models[place] != LinkModel():
                self._impair(place)

    def listen(self, link: LinkName, overlay: Overlay) -> None:
        """What parameters and failures make of a link."""
        for place, _ in zip(PLACES, self._links, strict=False):
            if (place == "link") == (link == "link"):
                if place not in self.channels:
                    if overlay.leaves(self._models[place]):
                        continue
                    self._impair(place)
                self.channels[place].lay_over(overlay)

    def due_s(self) -> float:
        """Wall time to the next arrival on any of them."""
        return min((link.due_us() for link in self._impaired), default=inf) * 1e-6 / self._speed

    def statistics(self) -> dict[str, dict[str, dict[str, float]]]:
        return {place: channels.statistics() for place, channels in self.channels.items()}

    def _now_us(self) -> int:
        """Wall time times speed, since the start."""
        return int((monotonic_us() - self._start_us) * self._speed)

    def _impair(self, place: str) -> None:
        from mavsitl.link.impaired import Channels, ImpairedLink  # here, for it loads numpy

        index = PLACES.index(place)
        channels = self.channels[place] = Channels(self._models[place], self._seed, place)
        link = ImpairedLink(self._links[index], channels, self._now_us, lambda: self.flight_time_s())
        self._links[index] = link
        self._impaired.append(link)


@contextmanager
def _logs(
    folder: Path | None, end: End, flight: Flight, failed: Failed | None = None, *, boot_us: int | None = None
) -> Iterator[tuple[Recorder, Tap]]:
    """Recorder and tap of an end. Without a folder the rows are dropped as they come. `boot_us`: see `information`.

    With `failed` the logs are of an end that outlives them: a full disk ends the log and not the flight, and the logs
    of an earlier process in this folder are kept beside the new ones.
    """
    if folder is None:
        yield NullRecorder(), Tap()
        return
    # Here, for they load numpy: a vehicle is heard before that.
    from mavsitl.log.flight import ENDS, open_ulog

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(f"{folder}: no logs can be written there: {error.strerror or error}") from error
    if failed is not None:
        _keep_older(folder / ENDS[end][0])
        if end == "vehicle":
            _keep_older(folder / WIRE_LOG)
    with open_ulog(folder, end, flight, failed, boot_us) as writer:
        tap = Tap(TlogWriter(folder / WIRE_LOG, failed) if end == "vehicle" else None, flush=writer.flush)
        try:
            yield writer, tap
        finally:
            tap.close()


def _keep_older(path: Path) -> None:
    """A log that is there gets a number: ``vehicle-001.ulg``, the highest is the youngest of them."""
    if not os.path.lexists(path):
        return
    taken = [int(match[1]) for other in path.parent.iterdir() if (match := _numbered(path).fullmatch(other.name))]
    try:
        path.rename(path.with_name(f"{path.stem}-{max(taken, default=0) + 1:03}{path.suffix}"))
    except OSError as error:
        raise LogError(f"{path}: cannot be renamed to make room: {error.strerror or error}") from error


def _numbered(path: Path) -> re.Pattern[str]:
    return re.compile(rf"{re.escape(path.stem)}-(\d{{3,9}}){re.escape(path.suffix)}")


class _NullRows:
    __slots__ = ()

    def append(self, timestamp_us: int, *values: float) -> None:
        pass

    def extend(self, timestamps_us: Any, values: Any) -> None:
        pass


class NullRecorder:
    """Keeps nothing: for an end that runs without a folder."""

    keeps = False

    def topic(self, topic: Any) -> Any:
        return _NullRows()

    def message(self, timestamp_us: int, level: int, text: str) -> None:
        pass

    def begin(self, parameters: Any, defaults: Any) -> None:
        pass

    def parameter(self, name: str, value: float) -> None:
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
    insecure: bool = False
    """Whoever reaches `bind`, another address than loopback, may fly the vehicle without a key."""

    def sockets(self, *, lockstep: bool) -> str:
        """What is bound, for a person."""
        host = f"[{self.bind}]" if ":" in self.bind else self.bind
        bound = [f"UDP {host}:{self.offboard_port} (off-board)"]
        if not lockstep:
            bound.append(f"UDP {host}:{self.gcs_port} (ground stations)")
            if self.tcp_port is not None:
                bound.append(f"TCP {host}:{self.tcp_port} (ground stations)")
        return ", ".join(bound)


class ExposedError(UsageError):
    """A vehicle would be open to a network without a key, and nobody said that it may. The text names the ways out."""


def _check_exposed(links: VehicleLinks, report: Callable[[str], None], *, signed: bool, lockstep: bool) -> None:
    """Of an address that is not loopback: say what it exposes. Raises `ExposedError` where that is not allowed."""
    if is_loopback(links.bind):
        return
    sockets = links.sockets(lockstep=lockstep)
    if signed:
        report(f"open to the network: {sockets}; only messages signed with the vehicle's key are obeyed")
    elif links.insecure:
        report(f"open to the network WITHOUT AUTHENTICATION: {sockets}; whoever reaches them can fly the vehicle")
    else:
        key = "" if lockstep else (
            "let it demand signed messages (start it on loopback, give it a key by SETUP_SIGNING and set "
            "MAV_SIGN_CFG to 1 or 2, and start it again with the same --state-dir), or "
        )  # fmt: skip
        raise ExposedError(
            f"--bind {links.bind} opens {sockets} to a network, and whoever reaches them could fly the vehicle: "
            f"{key}say --insecure"
        )


def vehicle_lockstep(
    flight: Flight,
    links: VehicleLinks,
    folder: Path | None,
    *,
    system_id: int,
    wing: str | None,
    deadline_s: float,
    cpu: int | None,
    report: Callable[[str], None],
    progress: Progress | None,
) -> Outcome:
    """The vehicle in lock-step over UDP with one ground.

    Raises `LinkError`, `ScenarioError`, `LogError`, `ExposedError`.
    """
    _check_exposed(links, report, signed=False, lockstep=True)
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
            channels = lockstep_channels(flight)
            _watch_lockstep_link(core, channels, recorder, tap)
            with process.flying():
                end_us = drivers.run_lockstep_vehicle(
                    core, link, tap, deadline_s=deadline_s, cpu=cpu, progress=progress,
                    channels=channels, max_time_s=flight.scenario.duration_s + IMPAIRED_GRACE_S,
                )  # fmt: skip
            return watch.outcome(end_us, tap, links=_statistics(channels))
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
            with process.flying():
                end_us = drivers.run_lockstep_ground(
                    core, link, tap, deadline_s=deadline_s, cpu=cpu, progress=progress,
                    impaired=flight.scenario.impaired,
                )  # fmt: skip
            return watch.outcome(end_us, tap)
    finally:
        link.close()


def _open_links(links: VehicleLinks, hint: str = "") -> list[Link]:
    """The off-board link and the ground stations'. `hint` goes on after the option that names a port."""
    opened: list[Link] = []
    try:
        for port, remote, option in (
            (links.offboard_port, links.offboard_remote, "--offboard-port N"),
            (links.gcs_port, links.gcs_remote, "--gcs-port N"),
        ):
            opened.append(UdpLink((links.bind, port), remote, port_option=f"{option}{hint}", host_option="--bind HOST"))
        if links.tcp_port is not None:
            from mavsitl.link.tcp import TcpServerLink

            opened.append(TcpServerLink((links.bind, links.tcp_port), port_option="--tcp-port N"))
    except LinkError:
        for link in opened:
            link.close()
        raise
    return opened


def _nobody_is_told() -> None:
    """For who does not want to know when the ports are taken."""


def vehicle_realtime(
    flight: Flight, links: VehicleLinks, folder: Path | None, *,
    system_id: int, wing: str | None, speed: float, until_finished: bool, state: Path | None,
    report: Callable[[str], None], stop: Callable[[], bool], progress: Progress | None,
    wish: realtime.Wish = realtime.Wish.ORDINARY, bound: Callable[[], None] = _nobody_is_told,
) -> Outcome:  # fmt: skip
    """The vehicle on the wall clock, with PX4 SITL's two links and TCP where asked for.

    `state` is the folder of what outlives the process, None: nothing does. `report` is told what went wrong on the
    machine, and so are the links: logs that cannot be written any more, real time that was not kept. `wish`: of the
    system, see `mavsitl.realtime`. `bound` is called when the ports are taken, before anything is compiled.
    Raises as `vehicle_lockstep`, and `RealTimeError`.
    """
    realtime.check(wish)
    opened: list[Link] = []
    core: Any = None

    def log_failed(error: LogError) -> None:
        text = f"Logging has ended: {error}"
        report(text)
        core.warn(text)

    try:
        opened += _open_links(links)
        bound()
        live = _LiveLinks(opened, flight, speed)
        with ExitStack() as stack:
            # A vehicle that misbehaves does so from its first word: nobody speaks for it.
            boot = None if flight.scenario.chaos else wings.find_boot(wing)
            with Herald(boot, {system_id: opened}) as herald:
                unix_clock = _steady_unix_clock()
                recorder, tap = stack.enter_context(_logs(folder, "vehicle", flight, log_failed, boot_us=unix_clock()))
                build = wings.find(wings.VEHICLE_GROUP, wing)
                core = build(
                    flight, recorder, seed=flight.scenario.seed, system_id=system_id,
                    ports=("offboard", *["gcs"] * (len(opened) - 1)), lockstep=False,
                    state=state, logs=folder, unix_us=unix_clock, trusted=is_loopback(links.bind),
                )  # fmt: skip
            live.flight_time_s = lambda: core.flight_time_s
            _subscribe(core, live.listen)
            if folder is not None:
                from mavsitl.log.links import LinkLog

                tap.record = LinkLog(recorder, lambda: live.channels).write
            if herald.sequence:
                core.continue_from(herald.sequence)
            watch = _Watch(core)
            try:
                _check_exposed(links, report, signed=core.signed_only, lockstep=False)
            except ExposedError:
                core.close()
                raise
            with process.flying(), realtime.claim(wish, report):
                realtime.fine_timers()
                timing = drivers.run_realtime_vehicle(
                    core, opened, tap, speed=speed, until_finished=until_finished, stop=stop, say=report,
                    progress=progress, due_s=live.due_s,
                )  # fmt: skip
            return watch.outcome(timing.simulated_us, tap, timing, links=live.statistics())
    finally:
        for link in opened:
            link.close()


def _statistics(channels: Channels | None) -> dict[str, dict[str, dict[str, float]]]:
    return {} if channels is None else {"link": channels.statistics()}


def ground_realtime(
    flight: Flight, address: Address, folder: Path | None, *,
    vehicle_system_id: int | None, wing: str | None,
    report: Callable[[str], None], stop: Callable[[], bool], progress: Progress | None,
    wish: realtime.Wish = realtime.Wish.ORDINARY, monitor: Address | None = None,
    bound: Callable[[], None] = _nobody_is_told,
) -> Outcome:  # fmt: skip
    """The ground on the wall clock, on any endpoint. `monitor`: where it tells what it knows, see `mavsitl.monitor`.

    `bound` and raises as `vehicle_realtime`.
    """
    realtime.check(wish)
    with ExitStack() as stack:
        link = open_link(address, port_option="--link udpin:HOST:PORT", host_option="--link udpin:HOST:PORT")
        stack.callback(link.close)
        beside = stack.enter_context(_monitor(monitor))
        bound()
        recorder, tap = stack.enter_context(
            _logs(folder, "ground", flight, lambda error: report(f"logging has ended: {error}"))
        )
        build = wings.find(wings.GROUND_GROUP, wing)
        core = build(flight, recorder, report=report, vehicle_system_id=vehicle_system_id, **_monitored(build, monitor))
        beside.core = core
        watch = _Watch(core)
        with process.flying(), realtime.claim(wish, report):
            simulated_us, wall_us = drivers.run_realtime_ground(
                core, link, tap, stop=stop, say=report, progress=progress, aside=beside
            )
        return watch.outcome(simulated_us, tap, wall_us=wall_us)


class _Beside:
    """Moves the datagrams of a ground's monitor link, beside the control loop and never before it is due."""

    LOOK_US = 20_000
    """Between two looks at the socket."""

    def __init__(self, link: Link | None) -> None:
        self.core: Any = None
        self._link = link
        self._due_us = 0

    def __call__(self, now_us: int) -> None:
        link = self._link
        if link is None or now_us < self._due_us:
            return
        self._due_us = now_us + self.LOOK_US
        monitor = self.core.monitor
        for datagram, source in link.receive(now_us):
            if monitor.receive(datagram):
                link.admit(source, now_us)
        monitor.step(now_us)
        for datagram in monitor.datagrams():
            link.send(datagram)


@contextmanager
def _monitor(address: Address | None) -> Iterator[_Beside]:
    """The monitor link of a ground, where it has one."""
    if address is None:
        yield _Beside(None)
        return
    link = open_link(address, port_option="--monitor ENDPOINT", host_option="--monitor ENDPOINT")
    try:
        yield _Beside(link)
    finally:
        link.close()


def _monitored(build: Any, monitor: Address | None) -> dict[str, Any]:
    """The option of a ground wing that shall have a monitor link. Raises `WingError` for one that has none."""
    if monitor is None:
        return {}
    parameters = inspect.signature(build).parameters
    if "options" not in parameters and "monitored" not in parameters:
        raise wings.WingError(f"{build.__module__} tells nothing beside the off-board link: it takes no --monitor")
    return {"monitored": True}


def in_memory(
    flight: Flight, folder: Path | None, *, report: Callable[[str], None], progress: Progress | None
) -> Outcome:
    """Both ends in this process; the same bytes as in lock-step over UDP."""
    with (
        _logs(folder, "vehicle", flight) as (vehicle_recorder, tap),
        _logs(folder, "ground", flight) as (ground_recorder, ground_tap),
    ):
        vehicle_flush, ground_flush = tap.flush, ground_tap.flush

        def flush() -> None:
            for each in (vehicle_flush, ground_flush):
                if each is not None:
                    each()

        tap.flush = flush
        vehicle = wings.find(wings.VEHICLE_GROUP)(flight, vehicle_recorder, seed=flight.scenario.seed, lockstep=True)
        ground = wings.find(wings.GROUND_GROUP)(flight, ground_recorder, report=report)
        watch = _Watch(ground)
        channels = lockstep_channels(flight)
        _watch_lockstep_link(vehicle, channels, vehicle_recorder, tap)
        limit_s = inf if channels is None else flight.scenario.duration_s + IMPAIRED_GRACE_S
        end_us = drivers.fly_in_memory(vehicle, ground, tap, max_time_s=limit_s, progress=progress, channels=channels)
        return watch.outcome(end_us, tap, links=_statistics(channels), heard_by=vehicle)


# --- fleets ----------------------------------------------------------------------------------------------------------


def _fleet_folder(folder: Path | None, number: int) -> Path | None:
    """Of the logs of one vehicle, or controller, of many."""
    return None if folder is None else folder / f"vehicle-{number}"


def _many(build: Any, *arguments: Any, count: int, **options: Any) -> Any:
    """A wing's core of many. Raises `WingError` for a wing that has none."""
    if "count" not in inspect.signature(build).parameters:
        raise wings.WingError(f"{build.__module__} flies one vehicle: it takes no --count")
    return build(*arguments, count=count, **options)


def fleet_realtime(
    flight: Flight, links: Sequence[VehicleLinks], folder: Path | None, *,
    count: int, system_id: int, wing: str | None, speed: float, until_finished: bool, states: Sequence[Path | None],
    report: Callable[[str], None], stop: Callable[[], bool], progress: Progress | None,
    wish: realtime.Wish = realtime.Wish.ORDINARY, bound: Callable[[], None] = _nobody_is_told,
) -> FleetOutcome:  # fmt: skip
    """`count` vehicles on the wall clock in this process. `links`: each one's, or those that all are behind.

    `folder` gets the logs of each in a folder ``vehicle-<instance>``, the instance being its system id less 1; `states`
    are what each keeps. `bound` and raises as `vehicle_realtime`.
    """
    realtime.check(wish)

    one_link = len(links) < count
    for each in links:
        _check_exposed_fleet(each, report)
    core: Any = None

    def log_failed(error: LogError) -> None:
        text = f"Logging has ended: {error}"
        report(text)
        if core is not None:
            core.warn(text)

    opened: list[list[Link]] = []
    with ExitStack() as stack:
        for each in links:
            group = _open_links(each, " or --instance I")
            opened.append(group)
            stack.callback(_close_all, group)  # the list, for its elements are replaced
        bound()
        scenario = flight.scenario
        # Nor over links that are impaired: those begin with the vehicles' clock, when all are built.
        silent = scenario.chaos or scenario.link != LinkModel() or scenario.gcs_link != LinkModel()
        boot = None if silent else wings.find_boot(wing)
        speakers = {system_id + j: opened[0 if one_link else j] for j in range(count)}
        folders = [_fleet_folder(folder, system_id - 1 + j) for j in range(count)]
        with Herald(boot, speakers) as herald:
            unix_clock = _steady_unix_clock()
            logs = [
                stack.enter_context(_logs(each, "vehicle", flight, log_failed, boot_us=unix_clock()))
                for each in folders
            ]
            core = _many(
                wings.find(wings.VEHICLE_GROUP, wing), flight, [recorder for recorder, _ in logs], count=count,
                seed=flight.scenario.seed, system_id=system_id, one_link=one_link,
                ports=("offboard", *["gcs"] * (len(opened[0]) - 1)), states=states, logs=folders,
                unix_us=unix_clock, trusted=is_loopback(links[0].bind),
            )  # fmt: skip
        if herald.sequence:
            for vehicle in core.vehicles:
                vehicle.continue_from(herald.sequence)
        per_group = len(opened[0])
        ports = _Ports(opened)
        from mavsitl import seeds  # here, for it loads numpy

        lives = []
        for j, group in enumerate(opened):
            vehicle = core.vehicles[j]
            live = _LiveLinks(group, flight, speed, seed=seeds.of_vehicle(flight.scenario.seed, j))
            live.flight_time_s = _flight_time_of(vehicle)
            _subscribe(vehicle, live.listen)
            lives.append(live)
            if folder is not None:
                from mavsitl.log.links import LinkLog

                logs[j][1].record = LinkLog(logs[j][0], _channels_of(live)).write
        taps = {} if folder is None else {j * per_group: logs[j][1] for j in range(len(opened))}
        started_us = monotonic_us()
        with process.flying(), realtime.claim(wish, report):
            realtime.fine_timers()
            timing = fleet.run_realtime_fleet(
                core, ports, taps, logs=[] if folder is None else [tap for _, tap in logs],
                polled=lambda: ports.polled(lives), speed=speed, until_finished=until_finished,
                stop=stop, say=report, progress=progress,
            )  # fmt: skip
        _record_links((tap for _, tap in logs), timing.simulated_us)
        flown = tuple(
            Flown(
                vehicle.system_id, vehicle.succeeded,
                "" if j * per_group not in taps else taps[j * per_group].wire.hexdigest(),
                link=lives[j].statistics() if j < len(lives) else {},
            )
            for j, vehicle in enumerate(core.vehicles)
        )  # fmt: skip
        return _fleet_outcome(core, timing.simulated_us, monotonic_us() - started_us, flown, timing=timing)


def _record_links(taps: Iterable[Tap], now_us: int) -> None:
    """The last row of each: what the links did in all."""
    for tap in taps:
        if tap.record is not None:
            tap.record(now_us)


def _close_all(links: list[Link]) -> None:
    for link in links:
        link.close()


def _flight_time_of(vehicle: Any) -> Callable[[], float]:
    return lambda: float(vehicle.flight_time_s)


def _channels_of(live: _LiveLinks) -> Callable[[], dict[str, Channels]]:
    return lambda: live.channels


class _Ports(Sequence[Link]):
    """The links of a fleet, numbered through. Those of a vehicle are replaced where they become impaired."""

    def __init__(self, groups: list[list[Link]]) -> None:
        self._groups = groups
        self._each = len(groups[0])
        links = [link for group in groups for link in group]
        self._changing = [port for port, link in enumerate(links) if not isinstance(link, UdpLink)]

    def __len__(self) -> int:
        return len(self._groups) * self._each

    def __getitem__(self, port: Any) -> Any:
        group, own = divmod(port, self._each)
        if group >= len(self._groups):
            raise IndexError(port)
        return self._groups[group][own]

    def polled(self, lives: Sequence[_LiveLinks]) -> list[int]:
        """Ports with messages that are held back, and those whose sockets come and go."""
        found = list(self._changing)
        for number, live in enumerate(lives):
            if live.channels:
                found += [
                    number * self._each + own
                    for own, place in enumerate(PLACES[: self._each])
                    if place in live.channels
                ]
        return found


def _check_exposed_fleet(links: VehicleLinks, report: Callable[[str], None]) -> None:
    """As `_check_exposed`, before there are keys: many vehicles have none in common."""
    _check_exposed(links, report, signed=False, lockstep=False)


def ground_fleet(
    flight: Flight, addresses: Sequence[Address], folder: Path | None, *,
    count: int, first_system_id: int, wing: str | None,
    report: Callable[[str], None], stop: Callable[[], bool], wish: realtime.Wish = realtime.Wish.ORDINARY,
    monitor: Address | None = None, bound: Callable[[], None] = _nobody_is_told,
) -> FleetOutcome:  # fmt: skip
    """`count` controllers on the wall clock, each on its endpoint or all on one. `monitor`, `bound` and raises as
    `ground_realtime`.
    """
    realtime.check(wish)
    opened: list[Link] = []
    with ExitStack() as stack:
        stack.callback(_close_all, opened)
        for address in addresses:
            option = "--link udpin:HOST:PORT or --instance I"
            opened.append(open_link(address, port_option=option, host_option="--link udpin:HOST:PORT"))

        beside = stack.enter_context(_monitor(monitor))
        bound()

        def failed(error: LogError) -> None:
            report(f"logging has ended: {error}")

        folders = [_fleet_folder(folder, first_system_id - 1 + j) for j in range(count)]
        logs = [stack.enter_context(_logs(each, "ground", flight, failed)) for each in folders]
        build = wings.find(wings.GROUND_GROUP, wing)
        core = _many(
            build, flight, [recorder for recorder, _ in logs], count=count, report=report,
            vehicle_system_id=first_system_id, one_link=len(addresses) < count, **_monitored(build, monitor),
        )  # fmt: skip
        beside.core = core
        taps = {} if folder is None else {j: tap for j, (_, tap) in enumerate(logs)}
        with process.flying(), realtime.claim(wish, report):
            simulated_us, wall_us = fleet.run_realtime_formation(
                core, opened, taps, stop=stop, say=report, aside=beside
            )
        return _fleet_outcome(core, simulated_us, wall_us, core.flown())


def fleet_in_memory(
    flight: Flight, folder: Path | None, *, count: int, report: Callable[[str], None], progress: Progress | None
) -> FleetOutcome:
    """A fleet and its controllers in this process, in lock-step; each pair has a link of its own."""
    with ExitStack() as stack:
        folders = [_fleet_folder(folder, j) for j in range(count)]
        vehicle_logs = [stack.enter_context(_logs(each, "vehicle", flight)) for each in folders]
        ground_logs = [stack.enter_context(_logs(each, "ground", flight)) for each in folders]
        core = _many(
            wings.find(wings.VEHICLE_GROUP), flight, [recorder for recorder, _ in vehicle_logs], count=count,
            seed=flight.scenario.seed, lockstep=True,
        )  # fmt: skip
        recorders = [recorder for recorder, _ in ground_logs]
        formation = _many(wings.find(wings.GROUND_GROUP), flight, recorders, count=count, report=report)
        taps = [tap for _, tap in vehicle_logs]
        for tap, (_, ground_tap) in zip(taps, ground_logs, strict=True):
            tap.flush = _both(tap.flush, ground_tap.flush)
        channels = [lockstep_channels(flight, j) for j in range(count)]
        for vehicle, own, (recorder, tap) in zip(core.vehicles, channels, vehicle_logs, strict=True):
            _watch_lockstep_link(vehicle, own, recorder, tap)
        started_us = monotonic_us()
        end_us = fleet.fly_in_memory(
            core, core.vehicles, formation, taps, progress=progress,
            channels=[each for each in channels if each is not None],
            max_time_s=flight.scenario.duration_s + IMPAIRED_GRACE_S if flight.scenario.impaired else inf,
        )  # fmt: skip
        wall_us = monotonic_us() - started_us
        _record_links(taps, end_us)
        flown = tuple(
            replace(
                each,
                finished=each.finished and vehicle.finished,
                wire_hash=tap.wire.hexdigest(),
                link=_statistics(own),
            )
            for each, vehicle, tap, own in zip(formation.flown(), core.vehicles, taps, channels, strict=True)
        )
        if flight.scenario.fleet.on_collision == "crash":
            flown = _crashed(flown, core.collisions)
        return _fleet_outcome(core, end_us, wall_us, flown)


def _crashed(flown: Sequence[Flown], collisions: Sequence[fleet.Collision]) -> tuple[Flown, ...]:
    """Who has collided is lost, wherever the pieces came down; the ground need not have seen it."""
    first: dict[int, str] = {}
    for each in collisions:
        for system_id, other in ((each.vehicle, each.other), (each.other, each.vehicle)):
            first.setdefault(system_id, f"collided with vehicle {other} at t = {each.time_s:.2f} s")
    return tuple(
        replace(each, finished=False, lost="; ".join(filter(None, (first[each.system_id], each.lost))))
        if each.system_id in first
        else each
        for each in flown
    )


def _both(one: Callable[[], None] | None, other: Callable[[], None] | None) -> Callable[[], None]:
    def flush() -> None:
        for each in (one, other):
            if each is not None:
                each()

    return flush


def _fleet_outcome(
    core: Any, simulated_us: int, wall_us: int, flown: tuple[Flown, ...], timing: RealTime | None = None
) -> FleetOutcome:
    counters = core.counters
    return FleetOutcome(
        simulated_s=simulated_us / 1e6,
        wall_s=wall_us / 1e6,
        finished=all(each.finished for each in flown),
        frames=counters.frames,
        rejected=counters.rejected,
        dropped={name: count for name, count in asdict(counters).items() if count and name not in _KEPT},
        vehicles=flown,
        collisions=tuple(getattr(core, "collisions", ())),
        lateness_us=None if timing is None else (timing.lateness.p50_us, timing.lateness.p99_us),
        rebased=0 if timing is None else timing.rebased,
        lost_s=0.0 if timing is None else timing.lost_us / 1e6,
    )


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


def ask(task: Task, address: Address, *, system_id: int | None, patience_s: float) -> Reply:
    """Ask the vehicle that is heard at an endpoint. Raises `LinkError` for an endpoint that cannot be opened."""
    from mavsitl.ask import Ask

    asking = Ask(task, system_id=system_id, patience_us=round(patience_s * 1e6))
    link = open_link(address, port_option="--endpoint ENDPOINT", host_option="--endpoint ENDPOINT")
    try:
        drivers.run_ask(asking, link)
    finally:
        link.close()
    return asking.reply()


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


_KEPT = ("frames", "skipped_bytes")
"""The counters that are not numbers of what was dropped."""


class _Watch:
    """Wall time of a run, from the first exchange: start-up and waiting for the other side do not count."""

    def __init__(self, core: Any) -> None:
        self._core = core
        self._start_us = monotonic_us()

    def outcome(
        self,
        simulated_us: int,
        tap: Tap,
        timing: RealTime | None = None,
        wall_us: int | None = None,
        links: dict[str, dict[str, dict[str, float]]] | None = None,
        heard_by: Any = None,
    ) -> Outcome:
        """`timing` of a vehicle in real time; `wall_us`: None is since the first exchange. `heard_by`: the core whose
        dropped input counts; None: this."""
        counters = self._core.counters
        dropped = asdict((heard_by or self._core).counters)
        if tap.record is not None:
            tap.record(simulated_us)
        if timing is not None:
            wall_us = timing.wall_us
        if wall_us is None:
            wall_us = monotonic_us() - (tap.started_us or self._start_us)
        return Outcome(
            simulated_s=simulated_us / 1e6,
            wall_s=wall_us / 1e6,
            wire_hash=tap.wire.hexdigest(),
            finished=self._core.succeeded,
            frames=counters.frames,
            rejected=counters.rejected,
            lateness_us=None if timing is None else (timing.lateness.p50_us, timing.lateness.p99_us),
            rebased=0 if timing is None else timing.rebased,
            lost_s=0.0 if timing is None else timing.lost_us / 1e6,
            lost=getattr(self._core, "lost", ""),
            links=links or {},
            dropped={name: count for name, count in dropped.items() if count and name not in _KEPT},
        )
