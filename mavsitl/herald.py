"""The first words of a vehicle, or of each of a fleet: a HEARTBEAT, said while what is behind it is being loaded.

Loading numpy, numba and the compiled kernels takes most of a second, compiling them for the first time many. Clients
give a vehicle up after 3 s without a HEARTBEAT and look for it once a second. So the wing gives the bridge a HEARTBEAT
that says MAV_STATE_BOOT and that costs no more to make than the dialect; the vehicle goes on with its sequence numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from threading import Event, Thread
from types import TracebackType
from typing import TypeAlias

from mavsitl.link.base import Link, LinkError

__all__ = ["INTERVAL_S", "Beat", "Herald"]

INTERVAL_S = 1.0

Beat: TypeAlias = Callable[[int, int], bytes]
"""(sequence, system id) -> the frame of a HEARTBEAT."""


class Herald:
    """Within its context the links carry a HEARTBEAT of each vehicle at once and then every second.

    It only sends. What clients say meanwhile waits in their sockets for the vehicle.

    Attributes:
        sequence: the sequence number that comes next, the same on every link and of every vehicle.
    """

    def __init__(
        self, beat: Beat | None, vehicles: Mapping[int, Sequence[Link]], interval_s: float = INTERVAL_S
    ) -> None:
        """`vehicles`: links by system id. `beat` None: the wing has no such HEARTBEAT, and nothing is sent."""
        self._beat = beat
        self._vehicles = vehicles
        self._interval_s = interval_s
        self._done = Event()
        self._thread = Thread(target=self._run, name="herald", daemon=True)
        self.sequence = 0

    def __enter__(self) -> Herald:
        if self._beat is not None:
            self._say(self._beat)
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """The last one has gone when this returns."""
        self._done.set()
        if self._beat is not None:
            self._thread.join()

    def _run(self) -> None:
        while self._beat is not None and not self._done.wait(self._interval_s):
            try:
                self._say(self._beat)
            except LinkError:
                return  # the vehicle meets the same error, and says so

    def _say(self, beat: Beat) -> None:
        sequence, self.sequence = self.sequence, (self.sequence + 1) & 0xFF
        for system_id, links in self._vehicles.items():
            frame = beat(sequence, system_id)
            for link in links:
                link.send(frame)
