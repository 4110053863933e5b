"""STATUSTEXT (253): long texts in chunks, chunks back to texts, and a limit on how often one reason may speak.

A text of up to 50 characters is one message with id 0. A longer one is cut into chunks of 50 that share an id; the last
is the one that is not full, so a text that ends on a chunk's edge is followed by an empty chunk.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from mavsitl.codec import Message
from mavsitl.dialect import mavlink
from mavsitl.services.base import Peer
from mavsitl.services.bucket import TokenBucket

__all__ = ["CHUNK_BYTES", "GAP", "MAX_TEXT_BYTES", "Joiner", "Text", "TextLimiter", "chunks", "printable"]

CHUNK_BYTES = 50
MAX_TEXT_BYTES = 255 * CHUNK_BYTES + CHUNK_BYTES - 1
"""The most that chunks 0 to 255 hold, the last not full; what is longer is cut."""

GAP = "[...]"
"""Stands for chunks that never came."""

_NO_TEXTS: Sequence[Text] = ()


def printable(text: str) -> str:
    """The text without blanks at its end, "?" for what is not printable: no text of a peer may steer a terminal."""
    text = text.rstrip()  # PX4 ends a text with a tab where an event says the same
    return text if text.isprintable() else "".join(c if c.isprintable() else "?" for c in text)


def chunks(severity: int, text: str, text_id: int) -> list[Message]:
    """The STATUSTEXT messages of a text.

    Args:
        severity: MAV_SEVERITY.
        text: what is not printable ASCII becomes "?", what is longer than `MAX_TEXT_BYTES` is cut.
        text_id: 1 to 65535, another for each text while chunks may be under way; not used by a short text.

    Raises:
        ValueError: `text_id` is out of range.
    """
    if not 1 <= text_id <= 0xFFFF:
        raise ValueError(f"text_id is {text_id}; allowed: 1 to 65535")
    data = printable(text).encode("ascii", "replace")[:MAX_TEXT_BYTES]
    if len(data) <= CHUNK_BYTES:
        return [mavlink.MAVLink_statustext_message(severity, data, 0, 0)]
    return [
        mavlink.MAVLink_statustext_message(severity, data[begin : begin + CHUNK_BYTES], text_id, number)
        for number, begin in enumerate(range(0, len(data) + 1, CHUNK_BYTES))
    ]


class Text(NamedTuple):
    """A whole text of a peer."""

    sender: Peer
    severity: int
    text: str
    """printable, of one line"""
    complete: bool
    """False where `GAP` stands in it"""


@dataclass(slots=True)
class _Parts:
    severity: int
    heard_us: int
    parts: dict[int, str] = field(default_factory=dict)
    last: int | None = None
    done: bool = False

    def fits(self, number: int, part: str) -> bool:
        """Whether a chunk can be of the text that these chunks are of."""
        known = self.parts.get(number)
        if known is not None:
            return known == part
        if self.last is not None and number > self.last:
            return False
        return len(part) >= CHUNK_BYTES or number > max(self.parts, default=-1)

    def add(self, number: int, part: str) -> bool:
        """Take a chunk in; whether that makes the text whole."""
        self.parts[number] = part
        if len(part) < CHUNK_BYTES:
            self.last = number
        if not self.done and self.last is not None and len(self.parts) == self.last + 1:
            self.done = True
            return True
        return False

    def text(self) -> str:
        pieces: list[str] = []
        expected = 0
        for number in sorted(self.parts):
            if number > expected:
                pieces.append(GAP)
            pieces.append(self.parts[number])
            expected = number + 1
        if self.last is None:
            pieces.append(GAP)
        return "".join(pieces)


class Joiner:
    """Texts out of the STATUSTEXT messages of any senders, chunks in any order, lost and doubled ones among them.

    A text comes out when it is whole; with `GAP` for what is missing when nothing of it came for `timeout_us`, or when
    its id or its place is needed for another. At most `MAX_SENDERS` senders and `MAX_TEXTS` texts of each are kept.
    """

    MAX_SENDERS = 8
    MAX_TEXTS = 4

    def __init__(self, timeout_us: int = 1_000_000) -> None:
        self._timeout_us = timeout_us
        self._senders: OrderedDict[Peer, OrderedDict[int, _Parts]] = OrderedDict()

    @property
    def waiting(self) -> bool:
        """Whether there is a text that `step` may give up."""
        return bool(self._senders)

    def receive(self, message: Message, sender: Peer, now_us: int) -> Sequence[Text]:
        """A STATUSTEXT; the texts that are ready by it."""
        part: str = message.text
        if message.id == 0:
            return (Text(sender, message.severity, printable(part), True),)
        ready: list[Text] = []
        texts = self._senders.get(sender)
        if texts is None:
            if len(self._senders) >= self.MAX_SENDERS:
                other, dropped = self._senders.popitem(last=False)
                ready += [self._text(other, parts) for parts in dropped.values() if not parts.done]
            texts = self._senders[sender] = OrderedDict()
        self._senders.move_to_end(sender)
        parts = texts.get(message.id)
        if parts is not None and not parts.fits(message.chunk_seq, part):
            del texts[message.id]
            if not parts.done:
                ready.append(self._text(sender, parts))
            parts = None
        if parts is None:
            if len(texts) >= self.MAX_TEXTS:
                _, oldest = texts.popitem(last=False)
                if not oldest.done:
                    ready.append(self._text(sender, oldest))
            parts = texts[message.id] = _Parts(message.severity, now_us)
        parts.heard_us = now_us
        # A whole text is kept for a while: its chunks may come twice.
        if parts.add(message.chunk_seq, part):
            ready.append(self._text(sender, parts))
        return ready

    def step(self, now_us: int) -> Sequence[Text]:
        """The texts that are given up waiting for."""
        if not self._senders:
            return _NO_TEXTS
        ready: list[Text] = []
        for sender, texts in list(self._senders.items()):
            for text_id, parts in list(texts.items()):
                if now_us - parts.heard_us >= self._timeout_us:
                    del texts[text_id]
                    if not parts.done:
                        ready.append(self._text(sender, parts))
            if not texts:
                del self._senders[sender]
        return ready

    def flush(self) -> Sequence[Text]:
        """Everything unfinished, at the end of a session."""
        senders = list(self._senders.items())
        self._senders.clear()
        return [self._text(sender, parts) for sender, texts in senders for parts in texts.values() if not parts.done]

    @staticmethod
    def _text(sender: Peer, parts: _Parts) -> Text:
        return Text(sender, parts.severity, printable(parts.text()), parts.done)


class TextLimiter:
    """Lets each reason speak at a bounded rate; the next text that passes says how many did not.

    At most `MAX_KEYS` reasons are told apart; the one not used for longest is forgotten.
    """

    MAX_KEYS = 64

    def __init__(self, rate_hz: float = 0.5, burst: float = 2.0) -> None:
        """`burst` texts of one reason pass at once, `rate_hz` a second later on."""
        self._rate_hz = rate_hz
        self._burst = burst
        self._buckets: OrderedDict[str, TokenBucket] = OrderedDict()
        self._held: dict[str, int] = {}

    def admit(self, key: str, text: str, now_us: int) -> str | None:
        """The text to send for reason `key`, or None where it has spoken enough."""
        bucket = self._buckets.get(key)
        if bucket is None:
            if len(self._buckets) >= self.MAX_KEYS:
                forgotten, _ = self._buckets.popitem(last=False)
                self._held.pop(forgotten, None)
            bucket = self._buckets[key] = TokenBucket(self._rate_hz, self._burst)
        self._buckets.move_to_end(key)
        if not bucket.take(now_us):
            self._held[key] = self._held.get(key, 0) + 1
            return None
        held = self._held.pop(key, 0)
        return f"{text} ({held} more held back)" if held else text
