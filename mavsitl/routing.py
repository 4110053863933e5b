"""Which of a vehicle's links a frame heard on one of them is passed on to.

As MAVLink's routing rule has it: a frame for one component goes where that component was heard, a frame for all goes
wherever anybody was heard, none goes back where it came from or to a link on which its sender was heard too (a loop).
"""

from __future__ import annotations

from mavsitl.codec import Frame
from mavsitl.dialect import mavlink
from mavsitl.services.base import Peer

__all__ = ["MAX_PEERS", "NOT_FORWARDED", "TIMEOUT_US", "Router"]

MAX_PEERS = 32
"""Components known per port; above it newcomers are not learned until one of the known falls silent."""

TIMEOUT_US = 15_000_000
"""A component not heard for this long is gone from its port."""

NOT_FORWARDED = frozenset((mavlink.MAVLINK_MSG_ID_SETUP_SIGNING, mavlink.MAVLINK_MSG_ID_RADIO_STATUS))
"""SETUP_SIGNING carries a key, and RADIO_STATUS tells of the one link it is heard on."""

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
