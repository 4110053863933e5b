"""A vehicle that a test drives by MAVLink messages, in simulated time: no sockets, no threads, no sleeps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from mavsitl import wings
from mavsitl.codec import Frame, encode, parse
from mavsitl.dialect import mavlink
from mavsitl.drivers import FROM_GROUND, FROM_VEHICLE, Tap
from mavsitl.link.impaired import Channels
from mavsitl.link.settings import LinkName
from mavsitl.px4_modes import MODES
from mavsitl.services.command import CommandClient
from mavsitl.testing.checks import FlightAssertionError
from mavsitl.testing.craft import DEFAULT_SCENARIO, Craft, Overrides, ScenarioLike, prepare
from mavsitl.testing.results import State

if TYPE_CHECKING:
    from mavsitl.testing.connection import Connection

__all__ = ["Arrived", "Stream", "Vehicle"]

Message: TypeAlias = Any
"""An object of pymavlink's message classes."""
Sent: TypeAlias = "Message | bytes | Iterable[Message | bytes] | None"
Each: TypeAlias = Callable[[State], Sent]

PORTS: dict[str, LinkName] = {"offboard": "link", "gcs": "gcs_link"}
"""In the order of the vehicle's ports, with their sections of the scenario."""

SENDER = (255, mavlink.MAV_COMP_ID_MISSIONPLANNER)
"""Whom the test speaks as: the system and component id of most ground stations."""
TARGET = (1, mavlink.MAV_COMP_ID_AUTOPILOT1)

COMMAND_WITHIN_S = 5.0
REPEAT_US = 500_000
"""A command without an answer is sent again."""


class Arrived(NamedTuple):
    """A frame that reached the test."""

    time_us: int
    port: str
    frame: Frame


class Stream:
    """Messages sent at a rate. In a `with` block it ends with the block."""

    def __init__(self, what: Message | bytes | Each, period_us: float, port: str, due_us: int) -> None:
        self.what = what
        self.port = port
        self.ended = False
        self._period_us = period_us
        self._due_us: float = due_us

    def due(self, now_us: int) -> bool:
        if self.ended or now_us < self._due_us:
            return False
        self._due_us += self._period_us
        return True

    def end(self) -> None:
        self.ended = True

    def __enter__(self) -> Stream:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()


class Vehicle(Craft):
    """A vehicle as `mavsitl vehicle` runs it, with its off-board link and its ground-station link, in simulated time.

    The test says when time passes. What it sends arrives with the next control period::

        vehicle = Vehicle("takeoff-hover")
        vehicle.takeoff(3.0)
        with vehicle.stream(my_setpoint, hz=50):
            assert vehicle.set_mode("OFFBOARD") == "ACCEPTED"
            vehicle.run(10.0)
        assert vehicle.now.mode == "AUTO.RTL"

    Times are since the vehicle's start, as in the messages' time_boot_ms.
    """

    def __init__(
        self,
        scenario: ScenarioLike = DEFAULT_SCENARIO,
        *,
        seed: int | None = None,
        overrides: Overrides | None = None,
        port: str = "offboard",
        logs: Path | None = None,
    ) -> None:
        """As of `Flight`. `port`: the link that is meant where a call names none, "offboard" or "gcs"."""
        super().__init__(prepare(scenario, seed=seed, overrides=overrides), logs)
        self.port = _port(port)
        flight = self.scenario
        self._watched = self._build(
            wings.find(wings.VEHICLE_GROUP)(
                flight, self._recording, seed=flight.scenario.seed, ports=tuple(PORTS), lockstep=False
            )
        )
        models = {"link": flight.scenario.link, "gcs_link": flight.scenario.gcs_link}
        for name, place in PORTS.items():
            self._channels[name] = Channels(models[place], flight.scenario.seed, place)
        self._subscribe(self.core)
        self._tap = Tap() if self._logs is None else Tap(tlog=self._logs.wire, flush=self.flush)
        self._inbox: list[Arrived] = []
        self._raw: dict[str, list[bytes]] = {name: [] for name in PORTS}
        self._sequence = dict.fromkeys(PORTS, 0)
        self._streams: list[Stream] = []
        self._watched.step(0)
        self._collect()

    # --- time

    def run(self, seconds: float) -> Vehicle:
        """Let so much time pass."""
        for _ in range(round(seconds * 1e6 / self.core.period_us)):
            self._tick()
        return self

    def run_until(self, condition: Callable[[State], bool], *, within_s: float) -> State:
        """Let time pass until a condition holds, which is asked after each control period; the state then.

        Raises `FlightAssertionError` where it does not within so much time.
        """
        end_us = self._now_us + round(within_s * 1e6)
        while True:
            state = self._state()
            if condition(state):
                return state
            if self._now_us >= end_us:
                raise FlightAssertionError(
                    self, f"the condition comes within {within_s:g} s", ["it did not"], self.time_s
                )
            self._tick()

    def _tick(self) -> None:
        now_us = self._now_us
        if self._streams:
            self._stream(now_us)
        for index, name in enumerate(PORTS):
            channels = self._channels[name]
            channels.fly(now_us, self.core.flight_time_s)
            for piece in channels.to_vehicle.due(now_us):
                if not index:
                    self._tap.hear(FROM_GROUND, now_us, piece)
                self.core.receive(index, piece)
        self._watched.step(now_us + self.core.period_us)
        self._collect()
        self._tap.tick(self._now_us)

    def _collect(self) -> None:
        now_us = self._now_us
        for index, name in enumerate(PORTS):
            to_test = self._channels[name].to_ground
            for datagram in self._watched.datagrams(index, combine=False):
                if not index:
                    self._tap.hear(FROM_VEHICLE, now_us, datagram)
                to_test.send(datagram, now_us)
            for piece in to_test.due(now_us):
                self._raw[name].append(piece)
                self._inbox += [Arrived(now_us, name, frame) for frame in parse(piece)]

    def _stream(self, now_us: int) -> None:
        self._streams = [stream for stream in self._streams if not stream.ended]
        for stream in self._streams:
            if stream.due(now_us):
                self.send(stream.what(self._state()) if callable(stream.what) else stream.what, port=stream.port)

    # --- to the vehicle

    def send(self, what: Sent, *, port: str | None = None) -> None:
        """Send a pymavlink message, a datagram of bytes as it is, or several of them; None: nothing.

        Messages are numbered, and come from system 255, component 190.
        """
        name = self._named(port)
        if what is None:
            return
        if isinstance(what, bytes | bytearray | memoryview):
            datagram = bytes(what)
        elif hasattr(what, "get_type"):
            datagram = encode(what, self._sequence[name], *SENDER)
            self._sequence[name] = (self._sequence[name] + 1) & 0xFF
        elif isinstance(what, Iterable) and not isinstance(what, str):
            for each in what:
                self.send(each, port=name)
            return
        else:
            raise TypeError(f"send takes a pymavlink message, bytes, or several of them; not {type(what).__name__}")
        self._channels[name].to_vehicle.send(datagram, self._now_us)

    def stream(self, what: Message | bytes | Each, *, hz: float, port: str | None = None) -> Stream:
        """Send at a rate from now on: a message, or what a function of the vehicle's true state gives each time.

        It goes on, whenever time passes, until `Stream.end` or the end of its `with` block.
        """
        if not hz > 0.0:
            raise ValueError(f"hz is {hz}; allowed: number > 0")
        stream = Stream(what, 1e6 / hz, self._named(port), self._now_us)
        self._streams.append(stream)
        return stream

    # --- from the vehicle

    def wait(
        self,
        name: str,
        *,
        within_s: float = 5.0,
        where: Callable[[Message], bool] | None = None,
        port: str | None = None,
    ) -> Message:
        """Let time pass until a message of this name comes, for which `where` holds; the message.

        What came before does not count. Raises `FlightAssertionError` where none comes within so much time.
        """
        message_id, on = _message_id(name), self._named(port)
        end_us = self._now_us + round(within_s * 1e6)
        seen = first = len(self._inbox)
        while self._now_us < end_us:
            self._tick()
            for arrived in self._inbox[seen:]:
                if arrived.port == on and arrived.frame.message_id == message_id:
                    message = arrived.frame.message
                    if where is None or where(message):
                        return message
            seen = len(self._inbox)
        came = [each.frame.message.get_type() for each in self._inbox[first:] if each.port == on]
        kinds = ", ".join(f"{count} {kind}" for kind, count in _counted(came)) or "nothing"
        suits = "" if where is None else " that suits"
        raise FlightAssertionError(
            self, f"a {name}{suits} comes on the {on} link within {within_s:g} s", [f"came: {kinds}"], self.time_s
        )

    def messages(self, name: str | None = None, *, port: str | None = None, after_s: float = 0.0) -> list[Message]:
        """The messages that came on a link, oldest first; of one name, or all. Long STATUSTEXTs: see `texts`."""
        on, message_id = self._named(port), None if name is None else _message_id(name)
        return [
            each.frame.message
            for each in self._inbox
            if each.port == on and each.time_us >= after_s * 1e6 and message_id in (None, each.frame.message_id)
        ]

    def last(self, name: str, *, port: str | None = None) -> Message | None:
        """The newest message of a name; None: there was none."""
        on, message_id = self._named(port), _message_id(name)
        found = (each for each in reversed(self._inbox) if each.port == on and each.frame.message_id == message_id)
        return next((each.frame.message for each in found), None)

    def receive(self, *, port: str | None = None) -> list[bytes]:
        """The datagrams that came since the last call, for a MAVLink stack of your own."""
        on = self._named(port)
        found, self._raw[on] = self._raw[on], []
        return found

    def connection(self, *, port: str | None = None) -> Connection:
        """The link as pymavlink's `mavutil` has one, for code that takes such a connection. See `Connection`."""
        from mavsitl.testing.connection import Connection

        return Connection(self, self._named(port))

    # --- what most tests do first

    def command(
        self, command: str | int, *params: float, within_s: float = COMMAND_WITHIN_S, port: str | None = None
    ) -> str:
        """Send a COMMAND_LONG, again where no answer comes; the MAV_RESULT's name, e.g. "ACCEPTED".

        `command`: a MAV_CMD by name or number. Parameters that are left out are NaN. Raises `FlightAssertionError`
        where no answer comes within so much time.
        """
        number, on = _command_id(command), self._named(port)

        def send(asked: int, confirmation: int, filled: tuple[float, ...]) -> None:
            self.send(mavlink.MAVLink_command_long_message(*TARGET, asked, confirmation, *filled), port=on)

        client = CommandClient(send, REPEAT_US, max(1, round(within_s * 1e6 / REPEAT_US)))
        client.start(number, *params)
        seen = len(self._inbox)
        while client.busy:
            client.step(self._now_us)
            self._tick()
            for arrived in self._inbox[seen:]:
                if arrived.port == on and arrived.frame.message_id == mavlink.MAVLINK_MSG_ID_COMMAND_ACK:
                    client.receive(arrived.frame.message)
            seen = len(self._inbox)
        if client.result is None:
            claim = f"acknowledges {_enum('MAV_CMD', number)} within {within_s:g} s"
            raise FlightAssertionError(self, claim, ["it did not"], self.time_s)
        return _enum("MAV_RESULT", client.result)

    def set_mode(self, mode: str, *, port: str | None = None) -> str:
        """Ask for a mode by its name, e.g. "OFFBOARD", "AUTO.LOITER"; the MAV_RESULT's name."""
        wanted = mode.upper()
        if wanted not in MODES:
            raise ValueError(f"{mode!r} is no mode; allowed: {', '.join(MODES)}")
        numbers = MODES[wanted]
        return self.command("DO_SET_MODE", 1, numbers.main_mode, numbers.sub_mode, port=port)

    def arm(self, *, port: str | None = None) -> str:
        """The MAV_RESULT's name."""
        return self.command("COMPONENT_ARM_DISARM", 1, port=port)

    def disarm(self, *, port: str | None = None) -> str:
        """The MAV_RESULT's name."""
        return self.command("COMPONENT_ARM_DISARM", 0, port=port)

    def takeoff(self, height_m: float = 2.5) -> Vehicle:
        """Take off by MAVLink's commands and hold there. Raises `FlightAssertionError` where it does not."""
        if refused := self.core.parameters.set("MIS_TAKEOFF_ALT", height_m):
            raise ValueError(f"takeoff: {refused.text}")
        for command, *params in (("NAV_TAKEOFF",), ("COMPONENT_ARM_DISARM", 1.0)):
            result = self.command(command, *params)
            if result != "ACCEPTED":
                raise FlightAssertionError(self, f"takes off to {height_m:g} m", [f"it answers {result}"], self.time_s)
        self.run_until(lambda state: not state.landed and state.mode == "AUTO.LOITER", within_s=10.0 + 2.0 * height_m)
        return self

    def land(self, *, within_s: float = 60.0) -> Vehicle:
        """Land by MAVLink's command, until it is disarmed. Raises `FlightAssertionError` where it does not."""
        result = self.command("NAV_LAND")
        if result != "ACCEPTED":
            raise FlightAssertionError(self, "lands", [f"it answers {result}"], self.time_s)
        self.run_until(lambda state: not state.armed, within_s=within_s)
        return self

    def _named(self, port: str | None) -> str:
        return self.port if port is None else _port(port)


def _port(name: str) -> str:
    if name not in PORTS:
        raise ValueError(f"port: {name!r} is not allowed; allowed: {', '.join(map(repr, PORTS))}")
    return name


def _message_id(name: str) -> int:
    found = getattr(mavlink, f"MAVLINK_MSG_ID_{name.upper()}", None)
    if found is None:
        raise ValueError(f"{name!r} is no message{_similar(name, 'MAVLINK_MSG_ID_')}")
    return int(found)


def _command_id(command: str | int) -> int:
    if isinstance(command, int):
        return command
    found = getattr(mavlink, f"MAV_CMD_{command.upper().removeprefix('MAV_CMD_')}", None)
    if found is None:
        raise ValueError(f"{command!r} is no MAV_CMD{_similar(command.removeprefix('MAV_CMD_'), 'MAV_CMD_')}")
    return int(found)


def _similar(name: str, prefix: str) -> str:
    from difflib import get_close_matches

    known = [each.removeprefix(prefix) for each in dir(mavlink) if each.startswith(prefix)]
    wanted = name.upper()
    near = [each for each in known if wanted in each][:4] or get_close_matches(wanted, known, 3)
    return f"; near it: {', '.join(near)}" if near else " of the dialect `development`"


def _enum(name: str, value: int) -> str:
    entry = mavlink.enums[name].get(value)
    return f"{name} {value}" if entry is None else str(entry.name).removeprefix(f"{name}_")


def _counted(names: Sequence[str]) -> list[tuple[str, int]]:
    from collections import Counter

    return Counter(names).most_common(8)
