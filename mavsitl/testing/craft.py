"""A vehicle under test, whoever runs it: its state now, what came of it so far, what goes wrong with it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeAlias, TypeVar

import msgspec
import numpy as np

from mavsitl import scenario
from mavsitl.codec import parse
from mavsitl.dialect import mavlink
from mavsitl.link.impaired import Channels
from mavsitl.log import topics
from mavsitl.log.flight import VEHICLE_LOG
from mavsitl.px4_modes import NAV_STATES
from mavsitl.scenario import Flight as Scenario
from mavsitl.services.statustext import Joiner
from mavsitl.testing.faults import Agenda, Clock, Faults
from mavsitl.testing.recording import Logs, Recording
from mavsitl.testing.results import Failsafe, State, Status, Text, Track, euler_deg

__all__ = ["Craft", "Overrides", "ScenarioLike", "Watched", "prepare"]

Overrides: TypeAlias = Mapping[str, Any]
ScenarioLike: TypeAlias = "str | Path | Overrides | Scenario"

DEFAULT_SCENARIO = "takeoff-hover"

_STATUSTEXT_ID = mavlink.MAVLINK_MSG_ID_STATUSTEXT.to_bytes(3, "little")
_NEAR_S = 0.3
"""A fail-safe is announced so near to the change of mode."""

T = TypeVar("T")


def prepare(
    what: ScenarioLike, *, seed: int | None = None, overrides: Overrides | None = None, live: bool = True
) -> Scenario:
    """A scenario made ready; `live`: with a link that may become worse at any time.

    `what`: a shipped one's name, a file's path, keys to be put over `DEFAULT_SCENARIO`, or one that is loaded.
    Raises `ScenarioError`.
    """
    if isinstance(what, Scenario):
        flight = scenario.changed(what, overrides) if overrides else what
    elif isinstance(what, Mapping):
        flight = scenario.load(DEFAULT_SCENARIO, {**what, **(overrides or {})})
    elif isinstance(what, str | Path):
        flight = scenario.load(str(what), dict(overrides or {}))
    else:
        raise scenario.ScenarioError(
            f"a {type(what).__name__} is no scenario; allowed: a name, a path, a table of keys"
        )
    changed = flight.scenario
    if seed is not None:
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise scenario.ScenarioError(f"seed: {seed!r} is not allowed; allowed: whole number >= 0")
        changed = msgspec.structs.replace(changed, seed=seed)
    if live:
        changed = msgspec.structs.replace(changed, link=msgspec.structs.replace(changed.link, live=True))
    return msgspec.structs.replace(flight, scenario=changed)


class Craft:
    """What `Flight`, `Vehicle` and `RunningVehicle` have in common.

    Attributes:
        core: the simulated vehicle itself.
        scenario: what it was set up with, `mavsitl.scenario.Flight`.
        faults: what goes wrong with it, see `Faults`.
        folder: where its logs are; None: nowhere.
    """

    clock: ClassVar[Clock] = "simulated"
    """Of all times in seconds: since the vehicle's start, or ("flight") since the release or the lift-off."""
    _kind: ClassVar[Literal["flight", "vehicle"]] = "vehicle"

    def __init__(self, flight: Scenario, logs: Path | None) -> None:
        self.scenario = flight
        self.folder = logs
        self.faults = Faults(self)
        self.core: Any = None
        self._logs = None if logs is None else Logs(logs, flight, ground=self._kind == "flight")
        self._recording = Recording(None if self._logs is None else self._logs.vehicle)
        self._channels: dict[str, Channels] = {}
        """By the link's port."""
        self._agenda = Agenda()
        self._now_us = 0
        self._release_us: int | None = None
        """When the first flight began."""
        self._joiner = Joiner()
        self._texts: list[tuple[int, int, str]] = []
        """(time us, MAV_SEVERITY, text)"""

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name} at {self.time_s:.2f} s>"

    # --- now

    @property
    def name(self) -> str:
        """The scenario's, with its seed: for messages."""
        return f"{self.scenario.name} (seed {self.scenario.scenario.seed})"

    @property
    def time_s(self) -> float:
        """Now, by `clock`."""
        return self._now_us / 1e6

    @property
    def now(self) -> State:
        """The vehicle's true state."""
        return self._call(self._state)

    def _state(self) -> State:
        status, land = self._recording.newest(topics.VEHICLE_STATUS), self._recording.newest(topics.LAND_DETECTED)
        armed, nav_state, failsafe, *_ = status or (topics.DISARMED, -1, 0)
        return State.of(
            self.time_s, self.core.truth, mode=_mode(int(nav_state)), armed=armed == topics.ARMED,
            landed=bool(land[0]) if land else True, failsafe=bool(failsafe),
        )  # fmt: skip

    # --- so far

    @property
    def truth(self) -> Track:
        """Where the vehicle was, how fast, at which attitude."""
        return self._track(
            topics.LOCAL_POSITION_TRUTH, topics.ATTITUDE_TRUTH, topics.ANGULAR_VELOCITY_TRUTH, self._span_us()
        )

    @property
    def estimate(self) -> Track:
        """The same as the vehicle itself believed, which is what its telemetry says."""
        return self._track(topics.LOCAL_POSITION, topics.ATTITUDE, topics.ANGULAR_VELOCITY, self._span_us())

    @property
    def statuses(self) -> tuple[Status, ...]:
        """Modes, arming and fail-safes over time: a row at each change."""
        table, zero_us = self._call(lambda: self._recording.memory.arrays(topics.VEHICLE_STATUS)), self._zero_us()
        columns = (table[name].tolist() for name in ("timestamp", "arming_state", "nav_state", "failsafe"))
        return tuple(
            Status((stamp_us - zero_us) / 1e6, _mode(nav_state), state == topics.ARMED, bool(failsafe))
            for stamp_us, state, nav_state, failsafe in zip(*columns, strict=True)
        )

    @property
    def modes(self) -> tuple[tuple[float, str], ...]:
        """(time_s, mode) at each change of the mode."""
        found: list[tuple[float, str]] = []
        for status in self.statuses:
            if not found or found[-1][1] != status.mode:
                found.append((status.time_s, status.mode))
        return tuple(found)

    @property
    def failsafes(self) -> tuple[Failsafe, ...]:
        """Those that took over, in order. One that only warns is among the `texts`."""
        found: list[Failsafe] = []
        statuses = self.statuses
        for number, status in enumerate(statuses):
            end_s = statuses[number + 1].time_s if number + 1 < len(statuses) else self.time_s
            if status.failsafe and found and found[-1].end_s == status.time_s:
                found[-1] = found[-1]._replace(end_s=end_s)
            elif status.failsafe:
                found.append(Failsafe(status.time_s, end_s, status.mode, self._announced(status.time_s)))
        return tuple(found)

    @property
    def texts(self) -> tuple[Text, ...]:
        """STATUSTEXTs of the vehicle, long ones joined, as it sent them: a lossy link loses none of these."""
        zero_us = self._zero_us()
        return tuple(Text((stamp_us - zero_us) / 1e6, severity, text) for stamp_us, severity, text in self._texts)

    @property
    def reference_ned_m(self) -> tuple[Any, Any] | None:
        """(time_s (k,), position (k, 3)) of where it was to be; None: there is no such thing."""
        return None

    @property
    def trouble(self) -> str:
        """Why it did not end as planned; empty: it did, or goes on."""
        return ""

    def _announced(self, time_s: float) -> str:
        near = [text for text in self.texts if abs(text.time_s - time_s) < _NEAR_S and "ailsafe" in text.text]
        return near[-1].text if near else ""

    def _zero_us(self) -> int:
        """When `clock` was 0, in the vehicle's time."""
        return 0

    def _span_us(self) -> tuple[int, int] | None:
        """First and last time of what `truth` shows; None: nothing."""
        return (0, self._now_us)

    def _track(self, position: Any, attitude: Any, rates: Any, span_us: tuple[int, int] | None) -> Track:
        def read() -> list[Any]:
            return [self._recording.memory.arrays(topic) for topic in (position, attitude, rates)]

        place, turn, rate = self._call(read)
        stamps = place["timestamp"].astype(np.int64)
        rows = np.zeros(stamps.size, bool) if span_us is None else (stamps >= span_us[0]) & (stamps <= span_us[1])

        def columns(*names: str) -> Any:
            return np.column_stack([place[name][rows].astype(np.float64) for name in names])

        return Track(
            time_s=(stamps[rows] - self._zero_us()) / 1e6,
            position_ned_m=columns("x", "y", "z"),
            velocity_ned_m_s=columns("vx", "vy", "vz"),
            attitude_deg=euler_deg(turn["q"][rows].astype(np.float64)),
            rates_deg_s=np.degrees(rate["xyz"][rows].astype(np.float64)),
        )

    # --- where it runs

    def _call(self, function: Callable[[], T]) -> T:
        """Call it where the vehicle lives, between two of its ticks."""
        return function()

    def _build(self, core: Any) -> Watched:
        """Take a core; the same for a driver."""
        self.core = core
        return Watched(core, self)

    def _subscribe(self, core: Any) -> None:
        """What the vehicle's parameters and failures make of its links is laid over them."""
        places = {"link": ("offboard",), "gcs_link": ("gcs",)}

        def listen(link: str, overlay: Any) -> None:
            for port in places[link]:
                if port in self._channels:
                    self._channels[port].lay_over(overlay)

        core.subscribe_links(listen)

    def _hear(self, now_us: int, datagrams: Sequence[bytes]) -> None:
        """What the vehicle says on its first link: texts are kept."""
        for datagram in datagrams:
            if _STATUSTEXT_ID in datagram:
                for frame in parse(datagram):
                    if frame.message_id == mavlink.MAVLINK_MSG_ID_STATUSTEXT:
                        sender = (frame.system_id, frame.component_id)
                        for text in self._joiner.receive(frame.message, sender, now_us):
                            self._texts.append((now_us, text.severity, text.text))

    def flush(self) -> None:
        """What was logged so far is in the files."""
        if self._logs is not None:
            self._call(self._logs.flush)

    def close(self) -> None:
        """The end of it: its logs are complete. What came of it can still be asked."""
        if self._logs is not None:
            self._call(self._logs.close)

    def discard(self) -> None:
        """As `close`, and the logs are deleted."""
        if self._logs is not None:
            self._logs.remove()

    def story(self, around_s: float | None = None) -> list[str]:
        """For a person: modes, fail-safes, faults, and what was said, around a time where one is given; a line each."""
        return tell(self, around_s)


class Watched:
    """A vehicle's core as its driver has it: before each tick comes what a test has planned, and its texts are kept."""

    def __init__(self, core: Any, craft: Craft) -> None:
        self._core = core
        self._craft = craft

    def step(self, now_us: int) -> None:
        craft, core = self._craft, self._core
        craft._agenda.step(craft._now_us, core.flight_time_s)
        core.step(now_us)
        craft._now_us = now_us
        if craft._release_us is None and (flight_time_s := core.flight_time_s) >= 0.0:
            craft._release_us = now_us - round(flight_time_s * 1e6)

    def datagrams(self, port: int, *, combine: bool) -> list[bytes]:
        found: list[bytes] = self._core.datagrams(port, combine=combine)
        if found and not port:
            self._craft._hear(self._craft._now_us, found)
        return found

    def __getattr__(self, name: str) -> Any:
        return getattr(self._core, name)


MOST_SAID = 6
"""Texts that a story tells."""
BEFORE_S, AFTER_S = 5.0, 1.0
"""Around the time of a failure."""


def tell(craft: Craft, around_s: float | None) -> list[str]:
    lines = []
    end_s = craft.time_s
    modes = [f"{mode} from {time_s:.2f} s" for time_s, mode in craft.modes]
    shown = deque(modes, maxlen=4)
    lines.append(f"mode        {'... ' if len(modes) > 4 else ''}{', '.join(shown) or 'none yet'}")
    failsafes = [
        f"{each.start_s:.2f} s to {each.end_s:.2f} s: {each.text or each.mode}"
        + (" (lasts)" if each.end_s >= end_s else "")
        for each in craft.failsafes
    ]
    lines += _column("fail-safes", failsafes or ["none"])
    faults = craft.faults.told()
    if faults:
        lines += _column("faults", faults)
    texts = craft.texts
    if around_s is not None:
        near = [text for text in texts if around_s - BEFORE_S <= text.time_s <= around_s + AFTER_S]
        texts = tuple(near) or texts
    said = [f"{text.time_s:8.2f} s  {text.text}" for text in texts[-MOST_SAID:]]
    lines += _column("said", said or ["nothing"])
    if craft.trouble:
        lines.append(f"ended       {craft.trouble}")
    if craft.folder is not None:
        folder = craft.folder.relative_to(Path.cwd()) if craft.folder.is_relative_to(Path.cwd()) else craft.folder
        file = folder / VEHICLE_LOG
        lines += _column("logs", [f"{folder}", f"mavsitl log info {file}", f"plotjuggler -d {file}"])
    return lines


def _column(title: str, lines: Sequence[str]) -> list[str]:
    return [f"{title if not number else '':<12}{line}" for number, line in enumerate(lines)]


def _mode(nav_state: int) -> str:
    return NAV_STATES.get(nav_state, "none" if nav_state < 0 else f"nav_state {nav_state}")
