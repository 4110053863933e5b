"""Which of a vehicle's links a frame heard on one of them is passed on to.

As MAVLink's routing rule has it: a frame for one component goes where that component was heard, a frame for all goes
wherever anybody was heard, none goes back where it came from or to a link on which its sender was heard too (a loop).
"""

from __future__ import annotations

from collections.abc import Callable

from mavsitl.codec import SIGNATURE_BYTES, Frame, target_system_offset
from mavsitl.dialect import mavlink
from mavsitl.services.base import Peer

__all__ = ["MAX_PEERS", "NOBODY", "NOT_FORWARDED", "TIMEOUT_US", "Router", "by_sender", "by_target"]

MAX_PEERS = 32
"""Components known per port; above it newcomers are not learned until one of the known falls silent."""

TIMEOUT_US = 15_000_000
"""A component not heard for this long is gone from its port."""

NOT_FORWARDED = frozenset((mavlink.MAVLINK_MSG_ID_SETUP_SIGNING, mavlink.MAVLINK_MSG_ID_RADIO_STATUS))
"""SETUP_SIGNING carries a key, and RADIO_STATUS tells of the one link it is heard on."""

NOBODY = -1
"""Whose a piece of a datagram is that is no frame."""

_NOWHERE: tuple[int, ...] = ()


class Router:
    """Learns who is heard on which port, and says where a frame goes. It sends nothing and limits no rate."""

    def __init__(self, ports: int, own: Peer) -> None:
        """`ports` links, numbered from 0, of the component `own`."""
        self._own = own
        self._heard_us: list[dict[Peer, int]] = [{} for _ in range(ports)]

    def note(self, port: int, sender: Peer, now_us: int) -> None:
        """A frame of `sender` came by `port`; only to be called for a frame that was believed."""
        known = self._heard_us[port]
        if sender not in known:
            if sender == self._own:
                return
            if len(known) >= MAX_PEERS:
                for silent in [peer for peer, heard_us in known.items() if now_us - heard_us > TIMEOUT_US]:
                    del known[silent]
                if len(known) >= MAX_PEERS:
                    return
        known[sender] = now_us

    def peers(self, port: int, now_us: int) -> list[Peer]:
        """Who lives on a port, in the order they were first heard."""
        return [peer for peer, heard_us in self._heard_us[port].items() if now_us - heard_us <= TIMEOUT_US]

    def destinations(self, port: int, frame: Frame, now_us: int) -> tuple[int, ...]:
        """The ports to which a frame that came by `port` goes on, as it is: ``frame.raw``.

        A target component 0 is every component of the target system, a target system 0 everybody.
        """
        sender = (frame.system_id, frame.component_id)
        target = frame.target
        if sender == self._own or target == self._own or frame.message_id in NOT_FORWARDED:
            return _NOWHERE
        target_system, target_component = target
        found = []
        for other in range(len(self._heard_us)):
            if other == port:
                continue
            peers = self.peers(other, now_us)
            if sender not in peers and any(
                target_system == 0 or (system_id == target_system and target_component in (0, component_id))
                for system_id, component_id in peers
            ):
                found.append(other)
        return tuple(found)


def by_target(datagram: bytes) -> list[tuple[int, bytes]]:
    """The pieces of a datagram by the system they are for, 0 being everybody; frames are found, not checked.

    What is no frame, and all that is after it, is one piece for `NOBODY`.
    """
    return _pieces(datagram, _target)


def by_sender(datagram: bytes) -> list[tuple[int, bytes]]:
    """The same by the system that sent them."""
    return _pieces(datagram, _sender)


def _pieces(datagram: bytes, whose: Callable[[bytes, int], int]) -> list[tuple[int, bytes]]:
    found: list[tuple[int, int, int]] = []
    begin, end = 0, len(datagram)
    while begin < end:
        stop = begin + _frame_bytes(datagram, begin)
        owner = NOBODY
        if begin < stop <= end:
            owner = whose(datagram, begin)
        else:
            stop = end
        if found and found[-1][0] == owner:
            found[-1] = (owner, found[-1][1], stop)
        else:
            found.append((owner, begin, stop))
        begin = stop
    if len(found) == 1:
        return [(found[0][0], datagram)]
    return [(owner, datagram[first:last]) for owner, first, last in found]


def _frame_bytes(datagram: bytes, begin: int) -> int:
    """Length of the frame that begins there; 0: none does."""
    if len(datagram) - begin < 8:
        return 0
    if datagram[begin] == _V2:
        return 12 + datagram[begin + 1] + (SIGNATURE_BYTES if datagram[begin + 2] & 1 else 0)
    return 8 + datagram[begin + 1] if datagram[begin] == _V1 else 0


_V1, _V2 = 0xFE, 0xFD


def _sender(datagram: bytes, begin: int) -> int:
    return datagram[begin + (5 if datagram[begin] == _V2 else 3)]


def _target(datagram: bytes, begin: int) -> int:
    if datagram[begin] == _V2:
        body, id_bytes = begin + 10, datagram[begin + 7 : begin + 10]
    else:
        body, id_bytes = begin + 6, bytes((datagram[begin + 5], 0, 0))
    offset = target_system_offset(id_bytes)
    # zeros at the end of a payload are not sent
    return 0 if offset is None or offset >= datagram[begin + 1] else datagram[body + offset]
