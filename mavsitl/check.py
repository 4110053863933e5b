"""Who is on a MAVLink port, without I/O: datagrams in with their addresses and times, a `Report` with findings out.

`Check` listens, and, unless told not to, sends a ground station's HEARTBEAT and asks each vehicle for its
AUTOPILOT_VERSION. Everything a peer can make it keep is bounded.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from math import nan
from typing import Literal, TypeAlias

import msgspec

from mavsitl.codec import SIGNATURE_BYTES, Counters, Frame, Message, parse
from mavsitl.dialect import mavlink
from mavsitl.link.base import Source
from mavsitl.node import Node, SourceStatistics
from mavsitl.px4_modes import CUSTOM_MODES

__all__ = [
    "Answer",
    "Check",
    "Ear",
    "Finding",
    "Heard",
    "Junk",
    "MessageCount",
    "PortReport",
    "Report",
    "VehiclePort",
]

SYSTEM_ID, COMPONENT_ID = 253, mavlink.MAV_COMP_ID_MISSIONPLANNER
"""Its own address: a ground station's component, on a system id that none of the known clients takes."""

HEARTBEAT_US = 1_000_000
FIRST_ASK_US = 1_000_000
"""A source without a HEARTBEAT is asked, too, when it has been heard for so long."""
ASK_AGAIN_US = 500_000
MAX_ASKED = 10

MAX_ADDRESSES, MAX_IDENTITIES, MAX_UNKNOWN_IDS = 32, 64, 32
"""Kept of a port: what is above is counted, not listed."""
SAMPLE_BYTES = 16
"""Of junk shown."""

LOSSY = 0.01
"""Share of lost frames from which a finding says so."""
HEARTBEAT_MISSED_US = 1_500_000
"""Heard for so long without a HEARTBEAT, a source sends none: one comes every second."""

AUTOPILOT_VERSION: int = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION

PX4_MODES = CUSTOM_MODES | {
    (3, 2): "POSCTL.SLOW",
    (4, 1): "AUTO.READY",
    (4, 8): "AUTO.FOLLOW_TARGET",
    (4, 9): "AUTO.PRECLAND",
    (4, 10): "AUTO.VTOL_TAKEOFF",
    (8, 0): "RATTITUDE",
    (9, 0): "SIMPLE",
}
"""PX4's main and sub mode in HEARTBEAT.custom_mode (px4_custom_mode.h) by mavros's names."""

Answer: TypeAlias = Literal["not asked", "none", "refused", "acknowledged", "answered"]
"""What came of REQUEST_MESSAGE AUTOPILOT_VERSION: "acknowledged" is a COMMAND_ACK without the message."""

Level: TypeAlias = Literal["good", "note", "problem"]


class Ear(msgspec.Struct, frozen=True, kw_only=True):
    """One endpoint that is listened at, or should be."""

    endpoint: str
    """as ``udpin:127.0.0.1:14550``"""
    speaks_first: bool = False
    """nothing is heard there before it has sent something: ``udpout`` and ``tcp``"""
    error: str = ""
    """why it is not open; empty where it is"""
    taken: bool = False
    """it is not open because another program has the port"""
    holder: str = ""
    """that program, where the system says, as "QGroundControl (process 4711)"; or empty"""
    find_holder: str = ""
    """the command that finds it"""


class VehiclePort(msgspec.Struct, frozen=True, kw_only=True):
    """A port that a vehicle binds by convention and that some program has now."""

    port: int
    sends_to: int
    """where a vehicle with PX4's defaults sends from there"""
    option: str
    """of `mavsitl vehicle`, that changes where it sends"""
    holder: str = ""


class MessageCount(msgspec.Struct, frozen=True, kw_only=True):
    """One kind of message of one source."""

    name: str
    id: int
    messages: int
    per_s: float
    bytes_per_s: float


class Heard(msgspec.Struct, frozen=True, kw_only=True):
    """One (system, component) at one address. Rates count from its first frame."""

    address: str
    system_id: int
    component_id: int
    vehicle: bool
    """an autopilot, by its HEARTBEAT"""
    ground_station: bool
    type: str
    """MAV_TYPE of its HEARTBEAT; empty where none came"""
    autopilot: str
    mode: str
    armed: bool | None
    status: str
    """MAV_STATE"""
    mavlink_versions: tuple[int, ...]
    messages: int
    signed: int
    """frames that carry a signature"""
    heartbeats: int
    heard_s: float
    per_s: float
    bytes_per_s: float
    lost: int
    """by gaps in the sequence numbers"""
    late: int
    restarts: int
    """times its sequence numbers began anew"""
    kinds: tuple[MessageCount, ...]
    """most frequent first"""
    answer: Answer
    asked: int
    result: str
    """MAV_RESULT of the COMMAND_ACK; empty where none came"""
    answer_ms: float | None
    """from the last question to the COMMAND_ACK"""
    version: str
    """AUTOPILOT_VERSION.flight_sw_version, e.g. "1.17.0"; empty where none came"""

    @property
    def loss(self) -> float:
        """Share of the frames sent that never came, 0 to 1."""
        return self.lost / (self.messages + self.lost)

    @property
    def identity(self) -> tuple[int, int]:
        return self.system_id, self.component_id


class Junk(msgspec.Struct, frozen=True, kw_only=True):
    """What an address sent besides good frames."""

    address: str
    datagrams: int
    """all that came from there"""
    frames: int
    """good ones"""
    junk_bytes: int
    bad: dict[str, int]
    """by reason, those that happened: see `mavsitl.codec.Counters`"""
    begins: str
    """the first bytes of the first bad datagram, hexadecimal; empty where there was none"""
    unknown_ids: dict[int, int]
    """ids of well-formed frames that the dialect does not know, with their numbers"""


class PortReport(msgspec.Struct, frozen=True, kw_only=True):
    ear: Ear
    datagrams: int
    bytes: int
    frames: int
    heard: tuple[Heard, ...]
    junk: tuple[Junk, ...]
    own_echoes: int
    """frames of ours that came back"""
    not_listed: int
    """frames and datagrams of sources beyond the limits"""


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    level: Level
    text: str


class Report(msgspec.Struct, frozen=True, kw_only=True):
    ok: bool
    """a vehicle was heard and, unless nobody was asked, answers"""
    listened_s: float
    asked: bool
    """False: it listened only"""
    ports: tuple[PortReport, ...]
    vehicle_ports: tuple[VehiclePort, ...]
    findings: tuple[Finding, ...]


# ------------------------------------------------------------------------------------------------------------ listening


@dataclass(slots=True)
class _Identity:
    """What is kept of one (system, component) at one address."""

    first_us: int
    statistics: SourceStatistics
    messages: Counter[int] = field(default_factory=Counter)
    octets: Counter[int] = field(default_factory=Counter)
    versions: set[int] = field(default_factory=set)
    signed: int = 0
    heartbeat: Message | None = None
    heartbeats: int = 0
    asked: int = 0
    asked_us: int = 0
    result: int | None = None
    answer_us: int = 0
    version: Message | None = None

    @property
    def is_ground_station(self) -> bool:
        return self.heartbeat is not None and self.heartbeat.type == mavlink.MAV_TYPE_GCS

    @property
    def is_vehicle(self) -> bool:
        known = self.heartbeat
        return known is not None and known.autopilot != mavlink.MAV_AUTOPILOT_INVALID and not self.is_ground_station

    @property
    def settled(self) -> bool:
        return self.version is not None or self.result not in (None, mavlink.MAV_RESULT_ACCEPTED)


@dataclass(slots=True)
class _Origin:
    """What is kept of one address."""

    datagrams: int = 0
    frames: int = 0
    counters: Counters = field(default_factory=Counters)
    unknown: Counter[int] = field(default_factory=Counter)
    begins: bytes = b""


class _Port:
    """One endpoint's share of a `Check`."""

    def __init__(self, ear: Ear) -> None:
        self.ear = ear
        self.node = Node(SYSTEM_ID, COMPONENT_ID)
        self.identities: dict[tuple[Source, int, int], _Identity] = {}
        self.origins: dict[Source, _Origin] = {}
        self.datagrams = 0
        self.bytes = 0
        self.frames = 0
        self.own_echoes = 0
        self.not_listed = 0
        self.heartbeat_due_us: int | None = 0 if ear.speaks_first else None
        """None: nobody has been heard, so there is nobody to send to."""

    def receive(self, datagram: bytes, source: Source, now_us: int) -> int:
        self.datagrams += 1
        self.bytes += len(datagram)
        counters = Counters()
        frames = parse(datagram, counters)
        self.frames += len(frames)
        self._note_origin(datagram, source, counters)
        others = 0
        for frame in frames:
            if (frame.system_id, frame.component_id) == self.node.address:
                self.own_echoes += 1
                continue
            others += 1
            identity = self._identity(frame, source, now_us)
            if identity is not None:
                self._note(identity, frame, now_us)
        if others and self.heartbeat_due_us is None:
            self.heartbeat_due_us = now_us
        return others

    def _note_origin(self, datagram: bytes, source: Source, counters: Counters) -> None:
        origin = self.origins.get(source)
        if origin is None:
            if len(self.origins) >= MAX_ADDRESSES:
                self.not_listed += 1
                return
            origin = self.origins[source] = _Origin()
        origin.datagrams += 1
        origin.frames += counters.frames
        # Refused candidates inside the payload of a frame that is merely unknown are not bad frames.
        unknown = _unknown_ids(datagram) if counters.unknown_id else None
        if unknown is not None:
            for message_id in unknown:
                if message_id in origin.unknown or len(origin.unknown) < MAX_UNKNOWN_IDS:
                    origin.unknown[message_id] += 1
            return
        if not counters.skipped_bytes:
            return
        origin.begins = origin.begins or datagram[:SAMPLE_BYTES]
        kept = origin.counters
        for name in _BAD:
            setattr(kept, name, getattr(kept, name) + getattr(counters, name))
        kept.skipped_bytes += counters.skipped_bytes

    def _identity(self, frame: Frame, source: Source, now_us: int) -> _Identity | None:
        key = (source, frame.system_id, frame.component_id)
        identity = self.identities.get(key)
        if identity is not None:
            identity.statistics.update(frame.sequence)
            return identity
        if len(self.identities) >= MAX_IDENTITIES:
            self.not_listed += 1
            return None
        identity = self.identities[key] = _Identity(now_us, SourceStatistics(frame.sequence))
        return identity

    def _note(self, identity: _Identity, frame: Frame, now_us: int) -> None:
        raw, kind = frame.raw, frame.message_id
        identity.messages[kind] += 1
        identity.octets[kind] += len(raw)
        identity.versions.add(1 if raw[0] == 0xFE else 2)
        identity.signed += frame.signed
        if kind == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            identity.heartbeat = frame.message
            identity.heartbeats += 1
        elif kind == AUTOPILOT_VERSION:
            identity.version = frame.message
        elif kind == mavlink.MAVLINK_MSG_ID_COMMAND_ACK and self._answers_us(frame.message, identity):
            identity.result = frame.message.result
            identity.answer_us = now_us - identity.asked_us

    def _answers_us(self, message: Message, identity: _Identity) -> bool:
        """The first COMMAND_ACK to our question; one without a target is for everybody (MAVLink 1)."""
        return (
            message.command == mavlink.MAV_CMD_REQUEST_MESSAGE
            and message.target_system in (0, SYSTEM_ID)
            and message.target_component in (0, COMPONENT_ID)
            and identity.asked > 0
            and identity.result is None
        )

    def step(self, now_us: int) -> None:
        if self.heartbeat_due_us is not None and now_us >= self.heartbeat_due_us:
            self.node.send_message(_HEARTBEAT)
            self.heartbeat_due_us = now_us + HEARTBEAT_US
        for (_, system_id, component_id), identity in self.identities.items():
            if self._to_ask(identity, now_us):
                identity.asked += 1
                identity.asked_us = now_us
                self._ask(system_id, component_id)

    def _to_ask(self, identity: _Identity, now_us: int) -> bool:
        if identity.is_ground_station or identity.settled or identity.asked >= MAX_ASKED:
            return False
        if identity.asked and now_us - identity.asked_us < ASK_AGAIN_US:
            return False
        return identity.is_vehicle or (identity.heartbeat is None and now_us - identity.first_us >= FIRST_ASK_US)

    def _ask(self, system_id: int, component_id: int) -> None:
        command = mavlink.MAV_CMD_REQUEST_MESSAGE
        # Each question is a new command (confirmation 0): a repeat would be acknowledged without the message.
        params = (float(AUTOPILOT_VERSION), nan, nan, nan, nan, nan, 0.0)
        self.node.send_message(mavlink.MAVLink_command_long_message(system_id, component_id, command, 0, *params))

    def report(self, now_us: int) -> PortReport:
        return PortReport(
            ear=self.ear,
            datagrams=self.datagrams,
            bytes=self.bytes,
            frames=self.frames,
            heard=tuple(_heard(key, identity, now_us) for key, identity in self.identities.items()),
            junk=tuple(
                _junk(source, origin)
                for source, origin in self.origins.items()
                if origin.counters.skipped_bytes or origin.unknown
            ),
            own_echoes=self.own_echoes,
            not_listed=self.not_listed,
        )


_BAD = ("bad_crc", "bad_length", "unknown_id", "incompatible", "oversize", "abandoned")

_HEARTBEAT = mavlink.MAVLink_heartbeat_message(
    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
)


class Check:
    """Sans-IO. `receive` what comes at each open endpoint, `step` with the time, send `datagrams`; then `report`."""

    def __init__(self, ears: Sequence[Ear], vehicle_ports: Sequence[VehiclePort] = (), *, ask: bool = True) -> None:
        """`vehicle_ports`: those that somebody has. `ask`: whether it may send anything."""
        self.asks = ask
        self._ports = [_Port(ear) for ear in ears]
        self._vehicle_ports = tuple(vehicle_ports)
        self._first_us: int | None = None

    def receive(self, port: int, datagram: bytes, source: Source, now_us: int) -> int:
        """Take one datagram from the endpoint of that index; the number of others' good frames in it. Never raises."""
        self._begin(now_us)
        return self._ports[port].receive(datagram, source, now_us)

    def step(self, now_us: int) -> None:
        """Queue what is due: to those who were heard, and where the endpoint itself says whom to call."""
        self._begin(now_us)
        if self.asks:
            for port in self._ports:
                if not port.ear.error:
                    port.step(now_us)

    def datagrams(self, port: int) -> list[bytes]:
        """What is queued for the endpoint of that index, to everybody heard there."""
        return self._ports[port].node.datagrams()

    def report(self, now_us: int) -> Report:
        self._begin(now_us)
        ports = tuple(port.report(now_us) for port in self._ports)
        vehicles = [heard for port in ports for heard in port.heard if heard.vehicle]
        good = ("answered", "acknowledged") if self.asks else ("not asked",)
        return Report(
            ok=any(heard.answer in good for heard in vehicles),
            listened_s=(now_us - (self._first_us or 0)) / 1e6,
            asked=self.asks,
            ports=ports,
            vehicle_ports=self._vehicle_ports,
            findings=tuple(_findings(ports, self._vehicle_ports)),
        )

    def _begin(self, now_us: int) -> None:
        if self._first_us is None:
            self._first_us = now_us


def _unknown_ids(datagram: bytes) -> list[int] | None:
    """Ids that the dialect does not know, of a datagram that is frames from end to end; None: it is not."""
    found = []
    begin = 0
    while begin < len(datagram):
        head = datagram[begin : begin + 10]
        if len(head) == 10 and head[0] == 0xFD and not head[2] & ~1:
            message_id = int.from_bytes(head[7:10], "little")
            begin += 12 + head[1] + (SIGNATURE_BYTES if head[2] else 0)
        elif len(head) >= 6 and head[0] == 0xFE:
            message_id = head[5]
            begin += 8 + head[1]
        else:
            return None
        if message_id not in mavlink.mavlink_map:
            found.append(message_id)
    return found if begin == len(datagram) and found else None


# ------------------------------------------------------------------------------------------------------------ reporting


def _show(source: Source) -> str:
    host, port = str(source[0]), source[1] if len(source) > 1 else ""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _name(enum: str, value: int, prefix: str = "") -> str:
    entry = mavlink.enums[enum].get(value)
    return entry.name.removeprefix(prefix or f"{enum}_") if entry is not None else str(value)


def _mode(heartbeat: Message) -> str:
    if heartbeat.autopilot == mavlink.MAV_AUTOPILOT_PX4:
        numbers = heartbeat.custom_mode >> 16 & 0xFF, heartbeat.custom_mode >> 24 & 0xFF
        return PX4_MODES.get(numbers, f"main {numbers[0]} sub {numbers[1]}")
    if heartbeat.base_mode & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return f"custom mode {heartbeat.custom_mode}"
    return f"base mode {heartbeat.base_mode}"


def _answer(identity: _Identity) -> Answer:
    if identity.version is not None and identity.asked:
        return "answered"
    if identity.result is not None:
        return "acknowledged" if identity.result == mavlink.MAV_RESULT_ACCEPTED else "refused"
    return "none" if identity.asked else "not asked"


def _version(message: Message | None) -> str:
    if message is None:
        return ""
    number = message.flight_sw_version
    return f"{number >> 24 & 0xFF}.{number >> 16 & 0xFF}.{number >> 8 & 0xFF}"


def _heard(key: tuple[Source, int, int], identity: _Identity, now_us: int) -> Heard:
    source, system_id, component_id = key
    # A single frame has no rate yet: half a second bounds what it can claim.
    seconds = max((now_us - identity.first_us) / 1e6, 0.5)
    heartbeat = identity.heartbeat
    kinds = tuple(
        MessageCount(
            name=mavlink.mavlink_map[kind].msgname,
            id=kind,
            messages=number,
            per_s=number / seconds,
            bytes_per_s=identity.octets[kind] / seconds,
        )
        for kind, number in sorted(identity.messages.items(), key=lambda item: (-item[1], item[0]))
    )
    vehicle = identity.is_vehicle
    return Heard(
        address=_show(source),
        system_id=system_id,
        component_id=component_id,
        vehicle=vehicle,
        ground_station=identity.is_ground_station,
        type="" if heartbeat is None else _name("MAV_TYPE", heartbeat.type),
        autopilot="" if heartbeat is None else _name("MAV_AUTOPILOT", heartbeat.autopilot),
        mode=_mode(heartbeat) if vehicle else "",
        armed=bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED) if heartbeat and vehicle else None,
        status="" if heartbeat is None else _name("MAV_STATE", heartbeat.system_status),
        mavlink_versions=tuple(sorted(identity.versions)),
        messages=identity.statistics.received,
        signed=identity.signed,
        heartbeats=identity.heartbeats,
        heard_s=(now_us - identity.first_us) / 1e6,
        per_s=identity.statistics.received / seconds,
        bytes_per_s=identity.octets.total() / seconds,
        lost=identity.statistics.lost,
        late=identity.statistics.late,
        restarts=identity.statistics.restarts,
        kinds=kinds,
        answer=_answer(identity),
        asked=identity.asked,
        result="" if identity.result is None else _name("MAV_RESULT", identity.result),
        answer_ms=None if identity.result is None else identity.answer_us / 1e3,
        version=_version(identity.version),
    )


def _junk(source: Source, origin: _Origin) -> Junk:
    counters = origin.counters
    return Junk(
        address=_show(source),
        datagrams=origin.datagrams,
        frames=origin.frames,
        junk_bytes=counters.skipped_bytes,
        bad={name: getattr(counters, name) for name in _BAD if getattr(counters, name)},
        begins=origin.begins.hex(" "),
        unknown_ids=dict(sorted(origin.unknown.items())),
    )


# ------------------------------------------------------------------------------------------------------------- findings


def _findings(ports: Sequence[PortReport], vehicle_ports: Sequence[VehiclePort]) -> Iterator[Finding]:
    """What a person should know, port by port, then about all of them."""
    for port in ports:
        yield from _port_findings(port)
    heard = [each for port in ports for each in port.heard]
    if not any(port.datagrams for port in ports):
        yield from _silence(ports, vehicle_ports)
    elif any(each.heartbeats for each in heard) and not any(each.vehicle for each in heard):
        yield _problem("No vehicle: the HEARTBEATs that came are of ground stations and other components.")
    if any(each.vehicle for each in heard) and not any(each.ground_station for each in heard):
        yield _note(
            "No ground station's HEARTBEAT was heard. That is usual where the ground station has a port of its own; "
            "a vehicle with NAV_DLL_ACT other than 0 flies its fail-safe when none reaches it."
        )


def _problem(text: str) -> Finding:
    return Finding(level="problem", text=text)


def _note(text: str) -> Finding:
    return Finding(level="note", text=text)


def _port_findings(port: PortReport) -> Iterator[Finding]:
    endpoint = port.ear.endpoint
    if port.ear.taken:
        who = port.ear.holder or "another program"
        find = f" Find it with: {port.ear.find_holder}." if port.ear.find_holder and not port.ear.holder else ""
        yield _problem(
            f"{endpoint} is in use by {who}: what is sent there goes to that program, and nobody can listen beside it."
            f"{find} End it, let it listen elsewhere, or check at another port: --listen udpin:127.0.0.1:PORT. A "
            "mavsitl vehicle serves several clients at once: --listen udpout:127.0.0.1:18570 asks it beside a "
            "running ground station (14580: beside an off-board program)."
        )
        return
    if port.ear.error:
        yield _problem(f"{endpoint} cannot be opened: {port.ear.error}")
        return
    for heard in port.heard:
        yield from _heard_findings(endpoint, heard)
    yield from _duplicates(endpoint, port.heard)
    for junk in port.junk:
        yield from _junk_findings(endpoint, junk)
    if port.own_echoes:
        yield _note(
            f"{endpoint}: {port.own_echoes} frames of ours came back: a vehicle or router forwards between its links."
        )
    if port.not_listed:
        yield _problem(f"{endpoint}: too many sources; {port.not_listed} frames or datagrams are not listed.")


def _heard_findings(endpoint: str, heard: Heard) -> Iterator[Finding]:
    who = f"{endpoint}: {heard.system_id}/{heard.component_id} at {heard.address}"
    if heard.vehicle:
        yield from _vehicle_findings(who, heard)
    elif not heard.heartbeats:
        if heard.heard_s < HEARTBEAT_MISSED_US / 1e6:
            yield _note(f"{who} was heard too briefly to say whether it sends a HEARTBEAT.")
        else:
            yield _problem(
                f"{who} sends {heard.per_s:.0f} messages a second but no HEARTBEAT: ground stations and SDKs take it "
                "for nobody. Is HEARTBEAT (0) filtered on the way, or never sent?"
            )
    if heard.loss >= LOSSY:
        yield _problem(
            f"{who}: {heard.lost} of {heard.lost + heard.messages} frames are missing ({heard.loss:.0%}): the link "
            "or this machine is overloaded, or the sender numbers two links with one counter."
        )
    if heard.restarts:
        yield _problem(
            f"{who}: its sequence numbers began anew {heard.restarts} times: it restarted, or two senders share this "
            "address and id."
        )


def _vehicle_findings(who: str, heard: Heard) -> Iterator[Finding]:
    if heard.answer == "answered":
        took = "" if heard.answer_ms is None else f" after {heard.answer_ms:.0f} ms"
        yield Finding(level="good", text=f"{who} is a vehicle and answers{took}; it says version {heard.version}.")
    elif heard.answer == "acknowledged":
        yield Finding(
            level="good", text=f"{who} is a vehicle and acknowledges the question, but sent no AUTOPILOT_VERSION."
        )
    elif heard.answer == "refused":
        yield _problem(f"{who} is a vehicle that hears us but refuses REQUEST_MESSAGE: {heard.result}.")
    elif heard.answer == "none" and heard.status == "BOOT":
        yield _problem(f"{who} is a vehicle that still starts (MAV_STATE_BOOT) and does not answer yet: check again.")
    elif heard.answer == "none":
        signed = (
            " It signs its frames: it believes only those signed with its key (MAV_SIGN_CFG)." if heard.signed else ""
        )
        yield _problem(
            f"{who} is a vehicle that does not answer: asked {heard.asked} times.{signed} Either what we send does "
            "not reach it (a firewall, a router without a way back), or it serves another partner "
            "only: PX4 serves the first one that spoke to it until it is started again."
        )
    else:
        yield _note(f"{who} is a vehicle; it was not asked anything.")


def _duplicates(endpoint: str, heard: Sequence[Heard]) -> Iterator[Finding]:
    ordered = sorted(heard, key=lambda each: each.identity)
    for identity, same in groupby(ordered, key=lambda each: each.identity):
        addresses = [each.address for each in same]
        if len(addresses) > 1:
            yield _problem(
                f"{endpoint}: {identity[0]}/{identity[1]} comes from {len(addresses)} addresses: "
                f"{', '.join(addresses)}. Two vehicles with one system id (give each its own: mavsitl vehicle "
                "--instance I or --system ID; PX4: MAV_SYS_ID), or one vehicle by two ways."
            )


_REASONS = {
    "bad_crc": "wrong checksum: another dialect's definition of the message, or damage on the way",
    "bad_length": "cut short",
    "unknown_id": "no message of this dialect",
    "incompatible": "incompatibility flags other than signing",
    "oversize": "datagrams longer than MAVLink tools send",
    "abandoned": "datagrams given up after many bad starts",
}


def _junk_findings(endpoint: str, junk: Junk) -> Iterator[Finding]:
    if junk.junk_bytes and not junk.frames:
        yield _problem(
            f"{endpoint}: {junk.address} sends what is not MAVLink: {junk.datagrams} datagrams without one good frame, "
            f"beginning {junk.begins}. Another program's data at this port, or an encrypted or damaged link."
        )
    elif junk.junk_bytes:
        reasons = "; ".join(f"{number} x {_REASONS[name]}" for name, number in junk.bad.items())
        yield _problem(
            f"{endpoint}: {junk.address} sends bad frames among good ones ({junk.junk_bytes} bytes): "
            f"{reasons or 'bytes between the frames'}."
        )
    if junk.unknown_ids:
        ids = ", ".join(f"{number} ({times} x)" for number, times in junk.unknown_ids.items())
        yield _note(
            f"{endpoint}: {junk.address} sends messages that pymavlink's dialect `development` does not have: {ids}. "
            "Harmless; their checksums cannot be checked."
        )


def _silence(ports: Sequence[PortReport], vehicle_ports: Sequence[VehiclePort]) -> Iterator[Finding]:
    """Nothing at all has come."""
    deaf = [port.ear for port in ports if not port.ear.error]
    if not deaf:
        return
    waited = ", ".join(ear.endpoint for ear in deaf)
    yield _problem(f"Nothing came: {waited}.")
    if all(ear.speaks_first for ear in deaf):
        yield _note(
            "We spoke first and nobody answered: is a vehicle there, and does it serve more than its first partner? "
            "A mavsitl vehicle does; PX4 does not."
        )
        return
    for held in vehicle_ports:
        who = held.holder or "a program"
        yield _note(
            f"UDP port {held.port}, which a vehicle binds to send to {held.sends_to}, is taken by {who}. If that is a "
            f"vehicle, it sends elsewhere: look at its {held.option} (PX4: mavlink start -o), or ask it at its own "
            f"port: --listen udpout:127.0.0.1:{held.port}."
        )
    if not vehicle_ports:
        yield _note(
            "No program on this machine has a port that a vehicle binds (18570 and 14580, plus the instance): is one "
            "running? `mavsitl vehicle` and PX4 SITL send to 14550 and 14540 of this machine by themselves; for "
            "`mavsitl vehicle`, --gcs-remote and --offboard-remote HOST:PORT change it."
        )
    yield _note(
        "A vehicle on another machine has to send to this one, and loopback does not hear it: there, "
        "--bind 0.0.0.0 --gcs-remote THIS-MACHINE:14550, with a key or --insecure; here, --listen "
        "udpin:0.0.0.0:14550. A firewall must let UDP in."
    )
