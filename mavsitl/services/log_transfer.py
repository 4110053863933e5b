"""Flight logs over the LOG_* messages: the list, the data, and the client that fetches them.

As PX4 1.17 (ids from 0, packets of 90 bytes, one transfer per client, no answer to LOG_ERASE), except where its answers
leave clients waiting:

* Without logs there is one LOG_ENTRY with `num_logs` 0; PX4 is silent.
* `last_log_num` is the last id. PX4 sends the number of logs, from which QGroundControl concludes that ids begin at 1
  if the first entry is lost.
* Behind the end of a log there is a LOG_DATA with `count` 0. QGroundControl knows the end of a log by a packet that is
  not full, and waits for it where the length is a multiple of 90.
* Data can be had without asking for the list first, and a LOG_ERASE that is refused is answered with a STATUSTEXT.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from mavsitl.dialect import mavlink
from mavsitl.services.base import NOTHING, Message, Peer
from mavsitl.services.files import FilePath, FileTree, Gaps, Reader

__all__ = ["CHUNK_BYTES", "PACKET_BYTES", "LogClient", "LogEntry", "LogFile", "LogServer", "LogStore", "TreeLogs"]

PACKET_BYTES = 90
CHUNK_BYTES = 512 * PACKET_BYTES
"""What a client asks for at once; QGroundControl's and MAVSDK's, too."""

_U32_MAX = 0xFFFFFFFF
_LIST_END = 0xFFFF


class LogFile(NamedTuple):
    """A log as the vehicle has it."""

    path: FilePath
    time_utc_s: int
    size_bytes: int


class LogStore(Protocol):
    """Where logs are. All links share one."""

    def logs(self) -> Sequence[LogFile]:
        """The oldest first, so that a new log does not change the ids of the others."""

    def open(self, log: LogFile) -> Reader:
        """Raises `OSError`."""

    def erase(self) -> bool:
        """Remove all logs but the one that is being written; False where that is not allowed."""


class TreeLogs:
    """The files of a `FileTree` that have a log's name, as deep as `MAX_DEPTH` directories."""

    MAX_LOGS = 1000
    MAX_DEPTH = 3
    MAX_DIRECTORIES = 400

    def __init__(
        self, tree: FileTree, root: FilePath = (), suffix: str = ".ulg", erase: Callable[[], bool] | None = None
    ) -> None:
        """`erase` removes the logs where a client may do so; without it LOG_ERASE is refused."""
        self._tree = tree
        self._root = root
        self._suffix = suffix
        self._erase = erase

    def logs(self) -> Sequence[LogFile]:
        found: list[LogFile] = []
        pending, seen = deque([self._root]), 0
        while pending and len(found) < self.MAX_LOGS and seen < self.MAX_DIRECTORIES:
            path = pending.popleft()
            seen += 1
            try:
                entries = self._tree.entries(path)
            except OSError:
                continue
            for entry in entries:
                below = (*path, entry.name)
                if entry.is_directory:
                    if len(below) - len(self._root) <= self.MAX_DEPTH:
                        pending.append(below)
                elif entry.name.endswith(self._suffix):
                    time_s = min(max(int(entry.modified_s), 0), _U32_MAX)
                    found.append(LogFile(below, time_s, min(entry.size_bytes, _U32_MAX)))
        return sorted(found, key=lambda log: (log.time_utc_s, log.path))[: self.MAX_LOGS]

    def open(self, log: LogFile) -> Reader:
        return self._tree.open_read(log.path)

    def erase(self) -> bool:
        return self._erase is not None and self._erase()


# ---------------------------------------------------------------------------------------------------------- server


@dataclass(slots=True)
class _Transfer:
    log_id: int
    log: LogFile
    reader: Reader
    offset: int
    end: int
    """Behind the last byte asked for."""
    used_us: int
    active: bool = True


class LogServer:
    """Lists and sends the logs of a store on one link, to a few clients at once."""

    MAX_PEERS = 4
    MAX_PACKETS_PER_STEP = 16
    IDLE_US = 10_000_000
    """A file that nobody asked for so long is closed."""
    FRESH_US = 1_000_000
    """The folder is not read again before: a list costs milliseconds, asking for it nothing."""

    def __init__(self, store: LogStore, packets_per_s: float = 1000.0) -> None:
        """`packets_per_s` is the pace of LOG_ENTRY and LOG_DATA together."""
        self._store = store
        self._packets_per_s = packets_per_s
        self._credit = 0.0
        self._step_us: int | None = None
        self._logs: Sequence[LogFile] | None = None
        self._read_us = 0
        self._listing: OrderedDict[Peer, tuple[int, int]] = OrderedDict()
        """(next id, id behind the last one) of the lists on their way"""
        self._transfers: OrderedDict[Peer, _Transfer] = OrderedDict()

    @property
    def open_files(self) -> int:
        return len(self._transfers)

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        match type(message).id:
            case mavlink.MAVLINK_MSG_ID_LOG_REQUEST_LIST:
                return self._list(sender, message.start, message.end, now_us)
            case mavlink.MAVLINK_MSG_ID_LOG_REQUEST_DATA:
                return self._data(sender, message.id, message.ofs, message.count, now_us)
            case mavlink.MAVLINK_MSG_ID_LOG_REQUEST_END:
                self._listing.pop(sender, None)
                self._stop(sender)
            case mavlink.MAVLINK_MSG_ID_LOG_ERASE:
                return self._erase()
        return NOTHING

    def step(self, now_us: int) -> Sequence[Message]:
        elapsed_us = 0 if self._step_us is None else max(0, now_us - self._step_us)
        self._step_us = now_us
        self._credit = min(self.MAX_PACKETS_PER_STEP, self._credit + elapsed_us * 1e-6 * self._packets_per_s)
        if not self._transfers and not self._listing:
            return NOTHING
        for peer, transfer in list(self._transfers.items()):
            if now_us - transfer.used_us >= self.IDLE_US and not transfer.active:
                self._stop(peer)
        messages: list[Message] = []
        while self._credit >= 1.0:
            message = self._next_entry() or self._next_data()
            if message is None:
                break
            self._credit -= 1.0
            messages.append(message)
        return messages or NOTHING

    def close(self) -> None:
        """Close every file."""
        for peer in list(self._transfers):
            self._stop(peer)
        self._listing.clear()

    # -- list

    def _known(self, now_us: int, anew: bool = False) -> Sequence[LogFile]:
        if self._logs is None or (anew and now_us - self._read_us >= self.FRESH_US):
            self._logs, self._read_us = self._store.logs(), now_us
        return self._logs

    def _list(self, sender: Peer, start: int, end: int, now_us: int) -> Sequence[Message]:
        # A part is asked for when a part was lost: that must be a part of the same list.
        logs = self._known(now_us, anew=start == 0 and end == _LIST_END)
        if not logs:
            return (mavlink.MAVLink_log_entry_message(0, 0, 0, 0, 0),)
        stop = min(end + 1, len(logs))
        if start < stop:
            self._listing[sender] = (start, stop)
            if len(self._listing) > self.MAX_PEERS:
                self._listing.popitem(last=False)
        return NOTHING

    def _next_entry(self) -> Message | None:
        while self._listing:
            peer, (log_id, stop) = next(iter(self._listing.items()))
            if self._logs is None or log_id >= min(stop, len(self._logs)):
                del self._listing[peer]
                continue
            self._listing[peer] = (log_id + 1, stop)
            log = self._logs[log_id]
            count = len(self._logs)
            return mavlink.MAVLink_log_entry_message(log_id, count, count - 1, log.time_utc_s, log.size_bytes)
        return None

    # -- data

    def _data(self, sender: Peer, log_id: int, offset: int, count: int, now_us: int) -> Sequence[Message]:
        logs = self._known(now_us)
        if log_id >= len(logs):
            self._stop(sender)
            return NOTHING
        log = logs[log_id]
        transfer = self._transfers.get(sender)
        if transfer is None or transfer.log is not log:
            self._stop(sender)
            try:
                reader = self._store.open(log)
            except OSError:
                return NOTHING
            while len(self._transfers) >= self.MAX_PEERS:
                self._stop(next(iter(self._transfers)))
            transfer = self._transfers[sender] = _Transfer(log_id, log, reader, 0, 0, now_us)
        self._transfers.move_to_end(sender)
        transfer.log_id, transfer.used_us, transfer.active = log_id, now_us, True
        transfer.offset, transfer.end = offset, offset + count
        return NOTHING

    def _next_data(self) -> Message | None:
        for peer, transfer in self._transfers.items():
            if not transfer.active:
                continue
            # What was appended since the list is not part of the log that the client asked for.
            size = transfer.log.size_bytes
            length = max(0, min(PACKET_BYTES, size - transfer.offset))
            try:
                data = transfer.reader.read(transfer.offset, length) if length else b""
            except OSError:
                self._stop(peer)
                return self._next_data()
            message = mavlink.MAVLink_log_data_message(
                transfer.log_id, transfer.offset, len(data), data.ljust(PACKET_BYTES, b"\0")
            )
            transfer.offset += len(data)
            # A packet that is not full says that the log ends here; where the last one was full, an empty one follows.
            transfer.active = len(data) == PACKET_BYTES and transfer.offset < transfer.end
            self._transfers.move_to_end(peer)
            return message
        return None

    def _stop(self, peer: Peer) -> None:
        transfer = self._transfers.pop(peer, None)
        if transfer is not None:
            transfer.reader.close()

    def _erase(self) -> Sequence[Message]:
        if self._store.erase():
            self.close()
            self._logs = None
            return NOTHING
        text = b"Erase logs refused: logs are read-only"
        return (mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_WARNING, text, 0, 0),)


# ---------------------------------------------------------------------------------------------------------- client


class LogEntry(NamedTuple):
    """A log as a LOG_ENTRY tells of it."""

    log_id: int
    time_utc_s: int
    size_bytes: int


class LogClient:
    """Fetches the list or a log, one thing at a time; what is lost is asked for again.

    Done when `busy` is False: `entries` or `data` is there, or None where no answer came after `tries`.
    """

    TIMEOUT_US = 500_000
    MIN_QUIET_US = 40_000
    """No shorter silence in the middle of a transfer means that something was lost; it may be longer, see `_heard`."""
    MERGED_PACKETS = 16
    """Gaps not further apart than this are asked for together: one more question costs more than a few packets."""

    def __init__(self, target: Peer = (1, 1), tries: int = 15, limit_bytes: int = 256 * 1024 * 1024) -> None:
        """`tries` in a row without an answer end it, `limit_bytes` is the longest log it downloads."""
        self._target = target
        self._tries = tries
        self._limit_bytes = limit_bytes
        self._state = ""
        self._silent = 0
        self._due_us = 0
        self._asked_us: int | None = None
        self._quiet_us = float(self.TIMEOUT_US)
        self._listed: dict[int, LogEntry] = {}
        self._count = -1
        self._log_id = 0
        self._buffer = bytearray()
        self._gaps = Gaps(0)
        self._chunk = 0
        self._asked_end = 0
        self._close = False
        self.entries: tuple[LogEntry, ...] | None = None
        self.data: bytes | None = None

    @property
    def busy(self) -> bool:
        return bool(self._state)

    @property
    def progress(self) -> float:
        """Of a download, from 0 to 1."""
        return 1.0 - self._gaps.missing_bytes / len(self._buffer) if self._buffer else float(self.data is not None)

    def list(self) -> None:
        """Ask for the list of logs."""
        self._begin("list")
        self._listed, self._count, self.entries = {}, -1, None

    def download(self, entry: LogEntry) -> None:
        """Fetch a log. Raises `ValueError` where it is longer than allowed."""
        if not 0 <= entry.size_bytes <= self._limit_bytes:
            raise ValueError(f"a log of {entry.size_bytes} bytes, {self._limit_bytes} are allowed")
        self._begin("data")
        self._log_id, self.data = entry.log_id, None
        self._buffer, self._gaps = bytearray(entry.size_bytes), Gaps(entry.size_bytes)
        self._chunk = 0

    def cancel(self) -> None:
        """Stop; the vehicle is told to with the next step."""
        self._state, self._close = "", True

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Message]:
        if sender != self._target:
            return NOTHING
        kind = type(message).id
        if kind == mavlink.MAVLINK_MSG_ID_LOG_ENTRY and self._state == "list":
            return self._entry(message, now_us)
        if kind == mavlink.MAVLINK_MSG_ID_LOG_DATA and self._state == "data":
            return self._packet(message, now_us)
        return NOTHING

    def step(self, now_us: int) -> Sequence[Message]:
        if self._close:
            self._close = False
            return (mavlink.MAVLink_log_request_end_message(*self._target),)
        if not self._state or now_us < self._due_us:
            return NOTHING
        if self._silent >= self._tries:
            self._state, self._close = "", True
            return NOTHING
        self._silent += 1
        if self._state == "list":
            return self._ask_list(now_us)
        return self._ask_data(now_us)

    def _begin(self, state: str) -> None:
        if self._state:
            raise RuntimeError("another transfer is on")
        self._state, self._silent, self._due_us = state, 0, 0

    def _wait(self, now_us: int) -> None:
        """A question was asked."""
        self._asked_us = now_us
        self._due_us = now_us + min(int(self._quiet_us) << max(0, min(self._silent - 1, 4)), 2 * self.TIMEOUT_US)

    def _heard(self, now_us: int) -> None:
        """An answer came; how long the first one took says which silence means a loss."""
        if self._asked_us is not None:
            sample_us = max(4.0 * (now_us - self._asked_us), float(self.MIN_QUIET_US))
            first = self._quiet_us == self.TIMEOUT_US
            self._quiet_us = sample_us if first else 0.875 * self._quiet_us + 0.125 * sample_us
            self._asked_us = None
        self._silent, self._due_us = 0, now_us + int(self._quiet_us)

    # -- list

    def _ask_list(self, now_us: int) -> Sequence[Message]:
        self._wait(now_us)
        missing = [log_id for log_id in range(self._count) if log_id not in self._listed]
        first, last = (missing[0], missing[-1]) if self._listed and missing else (0, _LIST_END)
        return (mavlink.MAVLink_log_request_list_message(*self._target, first, last),)

    def _entry(self, message: Message, now_us: int) -> Sequence[Message]:
        if message.num_logs == 0:
            self.entries, self._state = (), ""
            return NOTHING
        if message.num_logs != self._count:
            self._listed, self._count = {}, message.num_logs
        # ArduPilot's ids begin at 1.
        if message.id <= message.num_logs:
            self._listed[message.id] = LogEntry(message.id, message.time_utc, message.size)
        self._heard(now_us)
        if len(self._listed) >= self._count:
            self.entries, self._state = tuple(self._listed[log_id] for log_id in sorted(self._listed)), ""
        return NOTHING

    # -- data

    def _ask_data(self, now_us: int) -> Sequence[Message]:
        """Ask for the first gap of this chunk and for those near it; with the chunk complete, for the next one."""
        begin = end = -1
        for low, high in self._gaps:
            if begin < 0:
                begin = low - low % PACKET_BYTES
                self._chunk = begin // CHUNK_BYTES
            elif low - end > self.MERGED_PACKETS * PACKET_BYTES or low >= (self._chunk + 1) * CHUNK_BYTES:
                break
            end = min(high, (self._chunk + 1) * CHUNK_BYTES)
        if begin < 0:
            self.data, self._state, self._close = bytes(self._buffer), "", True
            return NOTHING
        self._wait(now_us)
        self._asked_end = end
        return (mavlink.MAVLink_log_request_data_message(*self._target, self._log_id, begin, end - begin),)

    def _packet(self, message: Message, now_us: int) -> Sequence[Message]:
        begin, end = message.ofs, message.ofs + message.count
        if message.id != self._log_id or not 0 < message.count <= PACKET_BYTES or end > len(self._buffer):
            return NOTHING
        self._heard(now_us)
        if self._gaps.fill(begin, end):
            self._buffer[begin:end] = bytes(message.data[: message.count])
        if end >= self._asked_end or not self._gaps:
            return self._ask_data(now_us)
        return NOTHING
