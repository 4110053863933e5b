"""MAVLink FTP and log transfers that break."""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Sequence

from mavsitl.chaos.base import NOTHING, REMEMBERED, Message, Mode, Peer, altered, ids
from mavsitl.dialect import mavlink
from mavsitl.services.ftp import FtpError, FtpPayload, Opcode

FTP = ids("FILE_TRANSFER_PROTOCOL")

FIRST = frozenset({
    Opcode.NONE, Opcode.TERMINATE_SESSION, Opcode.RESET_SESSIONS, Opcode.OPEN_FILE_RO, Opcode.OPEN_FILE_WO,
    Opcode.CREATE_FILE,
})  # fmt: skip
"""What begins or ends a transfer; a listing begins one at offset 0."""
DATA = frozenset({Opcode.READ_FILE, Opcode.BURST_READ_FILE})

_U32 = struct.Struct("<I")


def _payload(message: Message) -> FtpPayload:
    """Every message of this kind holds 251 bytes, so there always is one."""
    payload = FtpPayload.decode(bytes(message.payload))
    assert payload is not None
    return payload


def _message(payload: FtpPayload, target: Peer) -> Message:
    return mavlink.MAVLink_file_transfer_protocol_message(0, *target, payload.encode())


def _with(message: Message, payload: FtpPayload) -> Message:
    return _message(payload, (message.target_system, message.target_component))


def _nak(request: FtpPayload, error: int) -> FtpPayload:
    sequence = (request.sequence + 1) & 0xFFFF
    return FtpPayload(sequence, request.session, Opcode.NAK, 1, request.opcode, 0, request.offset, bytes((error,)))


def _is_later(request: FtpPayload) -> bool:
    """A request of a transfer that has begun."""
    return request.opcode not in FIRST and not (request.opcode == Opcode.LIST_DIRECTORY and request.offset == 0)


class Nak(Mode):
    """Requests are refused: all, or those of a transfer that has begun."""

    takes = FTP

    def __init__(self, error: int, *, later: bool) -> None:
        self._error = error
        self._later = later

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        request = _payload(message)
        if request.opcode in (Opcode.ACK, Opcode.NAK) or (self._later and not _is_later(request)):
            return message
        self.line.send(_message(_nak(request, self._error), sender))
        return None


class SecondSilent(Mode):
    """Requests of a transfer that has begun are not looked at: all, or (`once`) the first after it began."""

    takes = FTP

    def __init__(self, *, once: bool) -> None:
        self._once = once
        self._begun: OrderedDict[Peer, None] = OrderedDict()
        """Clients whose transfer has begun and lost nothing yet."""

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        request = _payload(message)
        if not _is_later(request):
            self._begun[sender] = None
            if len(self._begun) > REMEMBERED:
                self._begun.popitem(last=False)
            return message
        if not self._once:
            return None
        if sender not in self._begun:
            return message
        del self._begun[sender]
        return None


class SequenceWrong(Mode):
    gives = FTP

    def outgoing(self, message: Message) -> Sequence[Message]:
        reply = _payload(message)
        return (_with(message, reply._replace(sequence=(reply.sequence + 1) & 0xFFFF)),)


class SessionWrong(Mode):
    gives = FTP

    def outgoing(self, message: Message) -> Sequence[Message]:
        reply = _payload(message)
        return (_with(message, reply._replace(session=reply.session ^ 0x80)),)


class Drops(Mode):
    """A share of the messages of one kind is lost, by chance, in both directions."""

    def __init__(self, share: float, *names: str) -> None:
        self._share = share
        self.takes = self.gives = ids(*names)

    def incoming(self, message: Message, sender: Peer) -> Message | None:
        return None if self._lost() else message

    def outgoing(self, message: Message) -> Sequence[Message]:
        return NOTHING if self._lost() else (message,)

    def _lost(self) -> bool:
        return bool(self.line.random.random() < self._share)


class SizeWrong(Mode):
    """The answer to an opened file promises more bytes than there are."""

    gives = FTP

    def __init__(self, more: int) -> None:
        self._more = more

    def outgoing(self, message: Message) -> Sequence[Message]:
        reply = _payload(message)
        if reply.opcode != Opcode.ACK or reply.requested_opcode != Opcode.OPEN_FILE_RO or len(reply.data) < 4:
            return (message,)
        size = min(_U32.unpack_from(reply.data)[0] + self._more, 0xFFFFFFFF)
        return (_with(message, reply._replace(data=_U32.pack(size) + reply.data[4:])),)


class Cut(Mode):
    """Files end after a share of the size that was told."""

    gives = FTP

    def __init__(self, share: float) -> None:
        self._share = share
        self._limits: OrderedDict[tuple[Peer, int], int] = OrderedDict()
        """Bytes there are, by client and session."""

    def outgoing(self, message: Message) -> Sequence[Message]:
        reply = _payload(message)
        if reply.opcode != Opcode.ACK:
            return (message,)
        key = ((int(message.target_system), int(message.target_component)), reply.session)
        if reply.requested_opcode == Opcode.OPEN_FILE_RO and len(reply.data) >= 4:
            self._limits.pop(key, None)
            self._limits[key] = int(_U32.unpack_from(reply.data)[0] * self._share)
            if len(self._limits) > REMEMBERED:
                self._limits.popitem(last=False)
            return (message,)
        limit = self._limits.get(key)
        if limit is None or reply.requested_opcode not in DATA:
            return (message,)
        there = limit - reply.offset
        if there >= len(reply.data):
            return (message,)
        if there > 0:
            return (_with(message, reply._replace(size=there, data=reply.data[:there])),)
        if reply.requested_opcode == Opcode.BURST_READ_FILE and there <= -len(reply.data):
            return NOTHING  # the rest of a burst, behind its refusal
        end = bytes((FtpError.EOF,))
        return (_with(message, reply._replace(opcode=Opcode.NAK, size=1, data=end)),)


class EveryDataReply(Mode):
    """Every n-th reply with a file's data is lost, or one of its bytes is wrong."""

    gives = FTP

    def __init__(self, n: int, *, lost: bool) -> None:
        self._n = n
        self._lost = lost
        self._count = 0

    def outgoing(self, message: Message) -> Sequence[Message]:
        reply = _payload(message)
        if reply.opcode != Opcode.ACK or reply.requested_opcode not in DATA or not reply.data:
            return (message,)
        self._count += 1
        if self._count % self._n:
            return (message,)
        if self._lost:
            return NOTHING
        return (_with(message, reply._replace(data=bytes((reply.data[0] ^ 0xFF,)) + reply.data[1:])),)


class LogSizeWrong(Mode):
    """LOG_ENTRY promises more bytes than there are."""

    gives = ids("LOG_ENTRY")

    def __init__(self, more: int) -> None:
        self._more = more

    def outgoing(self, message: Message) -> Sequence[Message]:
        return (altered(message, size=min(message.size + self._more, 0xFFFFFFFF)),)
