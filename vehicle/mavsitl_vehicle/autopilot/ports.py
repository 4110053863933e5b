"""The autopilot's links: on each a MAVLink endpoint, its telemetry schedule and the server halves of the services."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavsitl.codec import Message
from mavsitl.dialect import mavlink
from mavsitl.node import Node
from mavsitl.services.base import Peer, Service
from mavsitl.services.bucket import FairBuckets, TokenBucket
from mavsitl.services.command import Command, CommandServer
from mavsitl.services.files import FileTree, Folder, MemoryFiles, Mounts
from mavsitl.services.ftp import FtpServer
from mavsitl.services.log_transfer import LogServer, TreeLogs
from mavsitl.services.mission import MissionServer
from mavsitl.services.parameter import ParameterServer
from mavsitl.services.timesync import PingServer, TimesyncServer
from mavsitl.signing import Signing
from mavsitl_vehicle.autopilot import commands, metadata, telemetry
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.autopilot.plan import VehiclePlan

if TYPE_CHECKING:
    from mavsitl_vehicle.autopilot.autopilot import Autopilot

COMPONENT_ID = mavlink.MAV_COMP_ID_AUTOPILOT1

FORWARDED_HZ, FORWARDED_BURST = 2000.0, 200.0
"""Frames of others passed on to a link, at most."""

COMMANDS_HZ, COMMANDS_BURST = 200.0, 200.0
"""Frames a second that answer the commands of one sender; what is beyond is not done, and its sender asks again."""

BUSY_US = 10_000_000
"""After a client's last word the services are stepped in every period for so long, and then every `IDLE_STEP_US`."""
IDLE_STEP_US = 100_000

SANDBOX, LOGS = "/fs/microsd", "/fs/microsd/log"
"""PX4's places of the memory card and of the logs on it."""


OFFBOARD_LINK, GCS_LINK = 1, 2
"""Instances of the failure unit MAVLINK."""


class Shared:
    """What the links of one vehicle share: parameters, plans, files, key."""

    def __init__(
        self,
        parameters: Parameters,
        plan: VehiclePlan,
        *,
        card: Folder | None = None,
        logs: Path | None = None,
        signing: Signing | None = None,
        trusted: bool = True,
    ) -> None:
        """`card`: what MAVLink FTP may write to; `logs`: where the logs are; None: there is none."""
        self.card = card
        self.parameters = parameters
        self.plan = plan
        self.signing = signing
        self.trusted = trusted
        names = (uri.rsplit("/", 1)[-1] for uri in (metadata.GENERAL_URI, metadata.PLAIN_URI, metadata.PACKED_URI))
        extras = {name: _extra(f"{metadata.FOLDER}/{name}") for name in names}
        mounts: dict[str, FileTree] = {metadata.FOLDER: MemoryFiles(extras)}
        if card is not None:
            mounts[SANDBOX] = card
        log_tree: FileTree = MemoryFiles({})
        if logs is not None:
            log_tree = mounts[LOGS] = Folder(logs)
        self.files = Mounts(mounts)
        self.logs = TreeLogs(log_tree)


@cache
def _extras() -> dict[str, bytes]:
    return metadata.files()


def component_metadata() -> telemetry.Metadata:
    """What COMPONENT_METADATA says."""
    name = f"/{metadata.GENERAL_URI.removeprefix('mftp://')}"
    return telemetry.Metadata(metadata.GENERAL_URI, metadata.file_crc(_extras()[name]))


def _extra(name: str) -> Any:
    """Made when it is first asked for: packing it takes longer than the rest of the start."""
    return lambda: _extras()[name]


class Port:
    """One link of the autopilot."""

    def __init__(self, name: str, index: int, autopilot: Autopilot, shared: Shared, *, lockstep: bool) -> None:
        """`name`: "offboard" or "gcs", which decides on the streams that are sent unasked."""
        self.name = name
        signing = None if shared.signing is None else shared.signing.link(index, shared.trusted)
        self.node = Node(autopilot.system_id, COMPONENT_ID, signing)
        profile: telemetry.Profile = "gcs" if name == "gcs" else "offboard"
        most_hz = None if lockstep else autopilot.stream_hz
        # Vehicles of a fleet take turns, each with all that it has to say.
        turn_us = 0 if most_hz is None else int(autopilot.system_id * telemetry.GOLDEN % 1.0 * telemetry.HZ / most_hz)
        self.schedule = telemetry.Schedule("lockstep" if lockstep else profile, start_us=turn_us, most_hz=most_hz)
        self.instance = OFFBOARD_LINK if profile == "offboard" else GCS_LINK
        """Of the failure unit MAVLINK."""
        self.down = False
        """Nothing comes in and nothing goes out."""
        self.subject: telemetry.Subject = autopilot
        """What telemetry speaks of."""
        self._autopilot = autopilot
        self._commands = CommandServer(self._execute)
        self._commanded = FairBuckets(COMMANDS_HZ, COMMANDS_BURST)
        self._busy_until_us = 0
        self.due_us = 0
        """When `step` is."""
        self._forwarded = TokenBucket(FORWARDED_HZ, FORWARDED_BURST)
        parameters = self._parameters = ParameterServer(shared.parameters, autopilot.warn_parameter)
        missions = MissionServer(shared.plan.stores, current_interval_us=None if lockstep else 1_000_000)
        self._files = FtpServer(shared.files)
        self._logs = LogServer(shared.logs)
        self._stepped: tuple[Service, ...] = (parameters, missions, self._files, self._logs)
        self._services: dict[int, Service] = {
            mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_LIST: parameters,
            mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ: parameters,
            mavlink.MAVLINK_MSG_ID_PARAM_SET: parameters,
            mavlink.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL: self._files,
            mavlink.MAVLINK_MSG_ID_LOG_REQUEST_LIST: self._logs,
            mavlink.MAVLINK_MSG_ID_LOG_REQUEST_DATA: self._logs,
            mavlink.MAVLINK_MSG_ID_LOG_REQUEST_END: self._logs,
            mavlink.MAVLINK_MSG_ID_LOG_ERASE: self._logs,
            mavlink.MAVLINK_MSG_ID_TIMESYNC: TimesyncServer(),
            mavlink.MAVLINK_MSG_ID_PING: PingServer(),
            **dict.fromkeys(missions.message_ids, missions),
        }

    @property
    def message_ids(self) -> frozenset[int]:
        """What `receive` takes."""
        commands_in = (mavlink.MAVLINK_MSG_ID_COMMAND_LONG, mavlink.MAVLINK_MSG_ID_COMMAND_INT)
        return frozenset((*self._services, *commands_in))

    def receive(self, message: Message, sender: Peer, now_us: int, at_us: int | None = None) -> bool:
        """A message that is meant for this vehicle and no setpoint: False where nobody here takes it.

        Commands act at the tick `now_us`, the other services at `at_us`, which is not before it; None: the same.
        """
        kind = type(message).id
        if kind in (mavlink.MAVLINK_MSG_ID_COMMAND_LONG, mavlink.MAVLINK_MSG_ID_COMMAND_INT):
            if not self._commanded.take(sender, now_us):
                self.node.counters.over_budget += 1
                return True
            waiting = self.node.queued
            command, result = self._commands.receive(message, *sender, now_us)
            self.node.send(telemetry.COMMAND_ACK, command, result, 0, 0, *sender)
            self._commanded.spend(sender, self.node.queued - waiting - 1)
            return True
        service = self._services.get(kind)
        if service is None:
            return False
        self._busy_until_us = now_us + BUSY_US
        self.due_us = now_us
        for answer in service.receive(message, sender, now_us if at_us is None else at_us):
            self.node.send_message(answer)
        return True

    def forward(self, frame: bytes, now_us: int) -> None:
        """Another component's frame, meant for somebody on this link."""
        if self._forwarded.take(now_us):
            self.node.forward(bytes(frame))

    def step(self, now_us: int) -> None:
        """What the services have to send by themselves; needed when it is due."""
        if now_us >= self._busy_until_us:
            self.due_us = now_us + IDLE_STEP_US
        for service in self._stepped:
            for message in service.step(now_us):
                self.node.send_message(message)

    def close(self) -> None:
        """Close the files that clients had open."""
        self._parameters.close()
        self._files.close()
        self._logs.close()

    def _execute(self, command: Command, now_us: int) -> int:
        result = commands.execute(self._autopilot, command, now_us, self)
        if self._autopilot.journal is not None:
            self._autopilot.journal.command(command, result)
        return result
