"""A token bucket in integer time: what keeps answers, texts and lists from flooding a link."""

from __future__ import annotations

from collections import OrderedDict

from mavsitl.services.base import Peer

__all__ = ["FairBuckets", "TokenBucket"]


class TokenBucket:
    """Holds `burst` tokens and gains `rate_hz` a second; full at first."""

    __slots__ = ("_capacity", "_credit", "_filled_us", "_rate_hz")

    def __init__(self, rate_hz: float, burst: float) -> None:
        """Raises `ValueError` unless both are above 0 and `burst` holds a whole token."""
        if not (rate_hz > 0.0 and burst >= 1.0):
            raise ValueError(f"rate_hz is {rate_hz}, burst {burst}; allowed: above 0, and 1 or more")
        # In millionths of a token: time then adds whole numbers at whole rates, and nothing is lost by rounding.
        self._rate_hz = rate_hz
        self._capacity = self._credit = burst * 1e6
        self._filled_us: int | None = None

    def take(self, now_us: int, tokens: float = 1.0) -> bool:
        """Whether that many tokens were there; if so they are gone. A clock that goes back gains nothing."""
        if self._filled_us is not None and now_us > self._filled_us:
            self._credit = min(self._capacity, self._credit + (now_us - self._filled_us) * self._rate_hz)
        self._filled_us = now_us
        if self._credit < tokens * 1e6:
            return False
        self._credit -= tokens * 1e6
        return True

    def spend(self, tokens: float) -> None:
        """Take tokens that need not be there: what is owed is paid back before the next is given."""
        self._credit -= tokens * 1e6


class FairBuckets:
    """A `TokenBucket` for each sender, so that one that asks too much is refused and the others are not.

    At most `MAX_SENDERS` are told apart, and all together may ask `SHARES` times as much as one.
    """

    MAX_SENDERS = 16
    SHARES = 4.0

    __slots__ = ("_all", "_buckets", "_burst", "_rate_hz")

    def __init__(self, rate_hz: float, burst: float) -> None:
        """Of one sender. Raises as `TokenBucket`."""
        self._rate_hz = rate_hz
        self._burst = burst
        self._all = TokenBucket(self.SHARES * rate_hz, self.SHARES * burst)
        self._buckets: OrderedDict[Peer, TokenBucket] = OrderedDict()

    def take(self, sender: Peer, now_us: int) -> bool:
        """Whether `sender` had a token, and all together one."""
        bucket = self._buckets.get(sender)
        if bucket is None:
            if len(self._buckets) >= self.MAX_SENDERS:
                self._buckets.popitem(last=False)
            bucket = self._buckets[sender] = TokenBucket(self._rate_hz, self._burst)
        self._buckets.move_to_end(sender)
        return bucket.take(now_us) and self._all.take(now_us)

    def spend(self, sender: Peer, tokens: float) -> None:
        """Of the sender who took last: what it asked for came to more than it took."""
        bucket = self._buckets.get(sender)
        if bucket is not None:
            bucket.spend(tokens)
        self._all.spend(tokens)
