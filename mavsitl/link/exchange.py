"""What two ends in lock-step over an impaired link say to one another: one datagram each way a tick, whatever is due.

The datagram keeps the messages in it apart, so that a damaged one hides no other. Before the first, the vehicle's
end says hello until it is answered; hellos are not counted, exchanges are.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from mavsitl.link.base import LinkError

__all__ = ["EXCHANGE_BYTES", "HELLO", "pack", "unpack"]

HELLO = b"H"
_GOING_ON, _LAST = b"E", b"L"  # none begins a MAVLink frame
_LENGTH = struct.Struct("<H")

EXCHANGE_BYTES = 40_000
"""Of messages in one exchange; with their lengths they fit into a UDP datagram."""


def pack(messages: Sequence[bytes], *, last: bool = False) -> bytes:
    """The datagram of one exchange; `last`: the sender has finished."""
    parts = [_LAST if last else _GOING_ON]
    for message in messages:
        parts.append(_LENGTH.pack(len(message)))
        parts.append(message)
    return b"".join(parts)


def unpack(datagram: bytes) -> tuple[list[bytes], bool]:
    """The messages, and whether they are the last. Raises `LinkError` for anything that `pack` did not make."""
    kind = datagram[:1]
    messages = []
    begin = 1
    while kind in (_GOING_ON, _LAST) and begin + _LENGTH.size <= len(datagram):
        (length,) = _LENGTH.unpack_from(datagram, begin)
        begin += _LENGTH.size
        messages.append(datagram[begin : begin + length])
        begin += length
    if kind not in (_GOING_ON, _LAST) or begin != len(datagram):
        raise LinkError(
            "the other side does not take turns as over an impaired link: do both ends have the same [link] "
            "in their scenario?"
        )
    return messages, kind == _LAST
