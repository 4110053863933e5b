"""What impaired links do, in the log: a row a second for each direction."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from mavsitl.log import topics
from mavsitl.log.ulog import Recorder

if TYPE_CHECKING:
    from mavsitl.clock import LatenessHistogram
    from mavsitl.link.impaired import Channels

COUNTS = tuple(name for name, kind, _ in topics.CHANNELS["link"]["to_ground"].columns[1:] if kind == "uint32_t")
"""The columns that count messages since the start."""


class LinkLog:
    """Writes `topics.CHANNELS` of the links that have channels when it is asked to."""

    def __init__(self, recorder: Recorder, channels: Callable[[], Mapping[str, Channels]]) -> None:
        """`channels`: by the link's place, those that there are by now."""
        self._recorder = recorder
        self._channels = channels
        self._before: dict[str, LatenessHistogram] = {}

    def write(self, now_us: int) -> None:
        """One row each; the delays are those since the last time."""
        for place, channels in self._channels().items():
            for direction, topic in topics.CHANNELS[place].items():
                statistics = getattr(channels, direction).statistics
                delay = statistics.delay
                before = self._before.get(topic.name)
                lately = delay if before is None else delay.since(before)
                self._before[topic.name] = delay.copy()
                self._recorder.topic(topic).append(
                    now_us,
                    *(getattr(statistics, name) for name in COUNTS),
                    lately.p50_us / 1e3,
                    lately.p99_us / 1e3,
                    lately.max_us / 1e3,
                )
