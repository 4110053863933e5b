"""A ground station whose screen is the page: links to vehicles and to a ground's monitor, rates, and the buttons.

Sans-IO: datagrams and time in, datagrams out, and a `Model` that is kept.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from math import nan
from typing import ClassVar, Literal, NamedTuple, TypeAlias

from mavsitl import monitor
from mavsitl.ask import enum_name
from mavsitl.codec import Frame, Message
from mavsitl.dialect import mavlink
from mavsitl.node import Node
from mavsitl.services.base import Peer
from mavsitl.services.command import CommandClient
from mavsitl.services.parameter import ParameterClient
from mavsitl.services.statustext import Joiner
from mavsitl.services.timesync import TimesyncClient
from mavsitl.view.model import Model, Vehicle, hear, look, put_link

__all__ = ["ACTIONS", "Action", "Station", "rate_hz"]

SYSTEM_ID, COMPONENT_ID = 253, mavlink.MAV_COMP_ID_MISSIONPLANNER
"""Of a ground station, on a system id that none of the known ones takes."""

HEARTBEAT_US = 1_000_000
REPEAT_US = 500_000
TRIES = 4
LOOK_US = 5_000_000
"""Between two looks whether the messages that were asked for come: a vehicle that restarted has forgotten."""
MAX_QUEUED = 20
"""Actions of a vehicle that wait for those before them."""

_HEARTBEAT = mavlink.MAVLink_heartbeat_message(
    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
)


def rate_hz(vehicles: int) -> float:
    """How often a second the page's picture is renewed: as a film for a few vehicles, less for many."""
    return 33.0 if vehicles <= 4 else 20.0 if vehicles <= 12 else 12.0


FASTER = 1.5
"""States come so much more often, so that each picture has a new one."""
SLOW_HZ = 2.0

FAST = (
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
)
STEADY = (
    mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED,
    mavlink.MAVLINK_MSG_ID_DEBUG_VECT,
)
SLOW = (
    mavlink.MAVLINK_MSG_ID_SYS_STATUS,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
    mavlink.MAVLINK_MSG_ID_CURRENT_MODE,
    mavlink.MAVLINK_MSG_ID_WIND_COV,
    mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
)
"""What is asked for: for each picture, at most ten times a second, twice a second."""

SHOWN_PARAMETERS = (*(f"SIM_FAIL_MOT{motor}" for motor in range(1, 5)), "SIM_LINK_DOWN", "SIM_GUST_TRIG")
"""Of the vehicle, that buttons change. One that has them tells of each change."""

# --- what the buttons do ---------------------------------------------------------------------------------------------


class Command(NamedTuple):
    id: int
    params: tuple[float, ...]


class Set(NamedTuple):
    """Of a parameter, at the vehicle or at the ground."""

    name: str
    value: float
    of: Literal["vehicle", "ground"] = "vehicle"


Step: TypeAlias = Command | Set
Action: TypeAlias = tuple[Step, ...]

_ARM = Command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (1.0, 0.0))
_CUSTOM = float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)

GUST_M_S = 8.0

ACTIONS: dict[str, Action] = {
    "arm": (_ARM,),
    "disarm": (Command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, (0.0, 0.0)),),
    "takeoff": (_ARM, Command(mavlink.MAV_CMD_NAV_TAKEOFF, (nan,) * 7)),
    "land": (Command(mavlink.MAV_CMD_NAV_LAND, (nan,) * 7),),
    "hold": (Command(mavlink.MAV_CMD_DO_SET_MODE, (_CUSTOM, 4.0, 3.0)),),
    "offboard": (Command(mavlink.MAV_CMD_DO_SET_MODE, (_CUSTOM, 6.0, 0.0)),),
    "gust": (Set("SIM_GUST_SPD", GUST_M_S), Set("SIM_GUST_TRIG", 1)),
    **{f"motor-{motor}-off": (Set(f"SIM_FAIL_MOT{motor}", 1),) for motor in range(1, 5)},
    **{f"motor-{motor}-ok": (Set(f"SIM_FAIL_MOT{motor}", 0),) for motor in range(1, 5)},
    "link-down": (Set("SIM_LINK_DOWN", 1),),
    "link-up": (Set("SIM_LINK_DOWN", 0),),
    **{f"law-{law}": (Set(monitor.CONTROL_LAW, number, "ground"),) for law, number in monitor.LAWS.items()},
}
"""By the name of the button, what is done one after the other, as far as each is accepted."""


@dataclass
class _Work:
    """Steps to do for a vehicle, one after the other. `name` of a button; empty: nobody asked."""

    name: str
    steps: deque[Step]


Poll: TypeAlias = Callable[[], str | None]
"""Of a step that is under way. None: not done; empty: done well; else what is wrong."""


def _poll_command(client: CommandClient, command: Command) -> Poll:
    client.start(command.id, *command.params)

    def poll() -> str | None:
        if client.busy:
            return None
        if client.result == mavlink.MAV_RESULT_ACCEPTED:
            return ""
        result = "no answer" if client.result is None else enum_name("MAV_RESULT", client.result)
        return f"{enum_name('MAV_CMD', command.id)}: {result}"

    return poll


def _poll_set(client: ParameterClient | None, wish: Set) -> Poll:
    if client is None:
        return lambda: "no ground is heard here: start it with --monitor"
    request = client.set(wish.name, wish.value)

    def poll() -> str | None:
        match request.outcome:
            case "open":
                return None
            case "done":
                return ""
            case "refused" if request.error == mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST:
                return f"{wish.name}: there is no such parameter"
            case outcome:
                return f"{wish.name} = {wish.value:g}: {'refused' if outcome == 'refused' else 'no answer'}"

    return poll


# --- vehicles --------------------------------------------------------------------------------------------------------


@dataclass
class _Craft:
    """What is known of a vehicle beside what is shown."""

    port: int
    target: Peer
    vehicle: Vehicle
    texts: Joiner = field(default_factory=Joiner)
    work: deque[_Work] = field(default_factory=deque)
    """The first is under way."""
    poll: Poll | None = None
    """Of its step."""
    heard: int = 0
    """States since the last look."""
    look_us: int = 0
    asked_hz: float = 0.0
    ground_parameters: ParameterClient | None = None

    def __post_init__(self) -> None:
        self.out: list[Message] = []
        """For the vehicle."""
        self.commands = CommandClient(self._command, REPEAT_US, TRIES)
        self.parameters = ParameterClient(self.target, REPEAT_US, TRIES)
        self.clock = TimesyncClient(self.target)

    def _command(self, command: int, confirmation: int, params: tuple[float, ...]) -> None:
        self.out.append(mavlink.MAVLink_command_long_message(*self.target, command, confirmation, *params))

    def ask(self, *steps: Step, name: str = "") -> None:
        """Add work; that of a button goes before what nobody asked for, and behind what is under way."""
        place = len(self.work)
        if name:
            place = max(sum(bool(work.name) for work in self.work), 1 if self.poll is not None else 0)
        self.work.insert(place, _Work(name, deque(steps)))


class Station:
    """Vehicles on any number of links, and the monitor of a ground.

    Attributes:
        model: what the page shows.
    """

    def __init__(self, links: int, *, with_monitor: bool, buttons: bool = True) -> None:
        """Ports 0 to `links` - 1 are those of vehicles, the one after them is the monitor's, where there is one."""
        self.model = Model()
        self._nodes = [Node(SYSTEM_ID, COMPONENT_ID) for _ in range(links + with_monitor)]
        self._monitor_port = links if with_monitor else None
        self._crafts: dict[int, _Craft] = {}
        self._heartbeat_us = 0
        self._acts = 0
        self.model.put("kind", "live")
        self.model.put("buttons", buttons)
        self.model.put("gust_m_s", GUST_M_S)
        self._buttons = buttons

    @property
    def hz(self) -> float:
        """How often `step` is to be called for a new picture."""
        return rate_hz(len(self._crafts))

    # --- in

    def receive(self, port: int, datagram: bytes, now_us: int) -> int:
        """One datagram; the number of good frames in it. Never raises on its content."""
        frames = self._nodes[port].receive(datagram)
        for frame in frames:
            if port == self._monitor_port:
                self._on_ground(frame, now_us)
            elif frame.component_id == mavlink.MAV_COMP_ID_AUTOPILOT1:
                self._on_vehicle(port, frame, now_us)
        return len(frames)

    def _on_vehicle(self, port: int, frame: Frame, now_us: int) -> None:
        message, kind = frame.message, frame.message_id
        craft = self._crafts.get(frame.system_id)
        if craft is None:
            if kind != mavlink.MAVLINK_MSG_ID_HEARTBEAT or message.autopilot == mavlink.MAV_AUTOPILOT_INVALID:
                return
            craft = self._meet(port, (frame.system_id, frame.component_id), now_us)
        elif port != craft.port:
            if craft.vehicle.fresh("vehicle", now_us, HEARTBEAT_US * 3):
                return  # heard on two links: the first is enough
            craft.port = port
        take = self._services.get(kind)
        if take is not None:
            if self._nodes[port].addressed_to(frame):
                take(self, craft, message, now_us)
            return
        chapter = craft.vehicle.chapter
        hear(craft.vehicle, message, now_us)
        if kind == mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
            craft.heard += 1
        if craft.vehicle.chapter != chapter:  # it has restarted
            self._ask_anew(craft)

    def _meet(self, port: int, target: Peer, now_us: int) -> _Craft:
        vehicle = self.model.vehicle(target[0])
        craft = self._crafts[target[0]] = _Craft(port, target, vehicle)
        craft.look_us = now_us + LOOK_US
        vehicle.put("parameters", {})
        for each in self._crafts.values():
            if each.asked_hz != self.hz:
                self._ask_anew(each)
        return craft

    def _ask_anew(self, craft: _Craft) -> None:
        """For messages at their rates, and for what the buttons show."""
        craft.asked_hz = self.hz
        craft.work = deque(work for place, work in enumerate(craft.work) if work.name or not place)
        rates = [(message_id, FASTER * craft.asked_hz) for message_id in FAST]
        rates += [(message_id, min(craft.asked_hz, 10.0)) for message_id in STEADY]
        rates += [(message_id, SLOW_HZ) for message_id in SLOW]
        for message_id, hz in rates:
            interval_us = float(round(1e6 / hz))
            craft.ask(Command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, (message_id, interval_us, 0.0, 0.0, 0.0, 0.0, 0.0)))
        for name in SHOWN_PARAMETERS:
            craft.parameters.read(name)

    def _on_ack(self, craft: _Craft, message: Message, now_us: int) -> None:
        craft.commands.receive(message)

    def _on_value(self, craft: _Craft, message: Message, now_us: int) -> None:
        craft.parameters.receive(message, craft.target, now_us)
        if message.param_id in SHOWN_PARAMETERS:
            shown = craft.vehicle.values.get("parameters") or {}
            value = craft.parameters.values.get(message.param_id)
            craft.vehicle.put("parameters", {**shown, message.param_id: value})

    def _on_timesync(self, craft: _Craft, message: Message, now_us: int) -> None:
        craft.clock.receive(message, craft.target, now_us)

    def _on_text(self, craft: _Craft, message: Message, now_us: int) -> None:
        for text in craft.texts.receive(message, craft.target, now_us):
            self._say(craft, text.severity, text.text)

    def _say(self, craft: _Craft, severity: int, text: str) -> None:
        self.model.say(craft.vehicle.number, severity, text, craft.vehicle.values.get("time_s"))

    _services: ClassVar[dict[int, Callable[[Station, _Craft, Message, int], None]]] = {
        mavlink.MAVLINK_MSG_ID_COMMAND_ACK: _on_ack,
        mavlink.MAVLINK_MSG_ID_PARAM_VALUE: _on_value,
        mavlink.MAVLINK_MSG_ID_PARAM_ERROR: _on_value,
        mavlink.MAVLINK_MSG_ID_TIMESYNC: _on_timesync,
        mavlink.MAVLINK_MSG_ID_STATUSTEXT: _on_text,
    }

    def _on_ground(self, frame: Frame, now_us: int) -> None:
        craft = self._crafts.get(frame.system_id)
        if craft is None or frame.component_id != monitor.COMPONENT_ID:
            return
        sender = (frame.system_id, frame.component_id)
        hear(craft.vehicle, frame.message, now_us, by_ground=True)
        if craft.ground_parameters is None:
            craft.ground_parameters = ParameterClient(sender, REPEAT_US, TRIES)
        client = craft.ground_parameters
        if craft.vehicle.values.get("law") is None and not client.busy:
            client.read(monitor.CONTROL_LAW)
        client.receive(frame.message, sender, now_us)
        known = client.values.get(monitor.CONTROL_LAW)
        if known is not None:
            craft.vehicle.put("law", next((law for law, number in monitor.LAWS.items() if number == known), "none"))

    # --- the buttons

    def act(self, vehicle: int, name: str) -> None:
        """Begin what a button does. Raises `KeyError` for one that there is not, or a vehicle that is not known."""
        steps, craft = ACTIONS[name], self._crafts[vehicle]
        if not self._buttons:
            self._done(craft, name, "the buttons are off: --no-buttons")
        elif sum(bool(work.name) for work in craft.work) >= MAX_QUEUED:
            self._done(craft, name, "too many at once")
        else:
            craft.ask(*steps, name=name)

    def _done(self, craft: _Craft, name: str, problem: str) -> None:
        self._acts += 1
        craft.vehicle.put("act", {"number": self._acts, "name": name, "problem": problem})

    def _work(self, craft: _Craft) -> None:
        """Begin the next step when the one before it is done; one that fails ends what is behind it."""
        if craft.poll is not None:
            problem = craft.poll()
            if problem is None:
                return
            craft.poll, work = None, craft.work[0]
            if problem or not work.steps:
                craft.work.popleft()
                if work.name:
                    self._done(craft, work.name, problem)
        if craft.work:
            match craft.work[0].steps.popleft():
                case Command() as command:
                    craft.poll = _poll_command(craft.commands, command)
                case Set() as wish:
                    client = craft.ground_parameters if wish.of == "ground" else craft.parameters
                    craft.poll = _poll_set(client, wish)

    # --- time

    def step(self, now_us: int) -> None:
        """What is due; call it `hz` times a second."""
        if now_us >= self._heartbeat_us:
            self._heartbeat_us = now_us + HEARTBEAT_US
            for node in self._nodes:
                node.send_message(_HEARTBEAT)
        for craft in self._crafts.values():
            self._step_craft(craft, now_us)

    def _step_craft(self, craft: _Craft, now_us: int) -> None:
        vehicle, out = craft.vehicle, craft.out
        for text in craft.texts.step(now_us):
            self._say(craft, text.severity, text.text)
        self._work(craft)
        craft.commands.step(now_us)
        out += craft.parameters.step(now_us)
        out += craft.clock.step(now_us)
        for message in out:
            self._nodes[craft.port].send_message(message)
        out.clear()
        if craft.ground_parameters is not None and self._monitor_port is not None:
            for message in craft.ground_parameters.step(now_us):
                self._nodes[self._monitor_port].send_message(message)
        if not vehicle.fresh("off-board", now_us, 3 * HEARTBEAT_US):
            self._own_link(craft, now_us)
        if now_us >= craft.look_us:
            wanted = craft.asked_hz * LOOK_US * 1e-6
            if vehicle.values.get("online") and craft.heard < 0.3 * wanted and not craft.work:
                self._ask_anew(craft)
            craft.look_us, craft.heard = now_us + LOOK_US, 0
        look(vehicle, now_us)

    def _own_link(self, craft: _Craft, now_us: int) -> None:
        """Where no ground tells of the off-board link: the one to here."""
        source = self._nodes[craft.port].sources.get(craft.target)
        round_trip_ns = craft.clock.clock.median_round_trip_ns
        if source is not None:
            latency_ms = None if round_trip_ns is None else round_trip_ns * 0.5e-6
            put_link(craft.vehicle, "this page", source.received, source.lost, latency_ms, now_us)

    # --- out

    def datagrams(self, port: int) -> list[bytes]:
        return self._nodes[port].datagrams(combine=True)
