"""A whole flight in memory: a vehicle and the ground that flies it, in lock-step, as far as a test wants it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from mavsitl import controllers, drivers, ends, wings
from mavsitl.drivers import LockstepError, Tap
from mavsitl.link.impaired import Channels
from mavsitl.log import topics
from mavsitl.log.flight import FlightData
from mavsitl.report.metrics import PAPER_TABLES, Rmse, paper_case, rmse
from mavsitl.testing.checks import FlightAssertionError
from mavsitl.testing.craft import DEFAULT_SCENARIO, Craft, Overrides, ScenarioLike, prepare
from mavsitl.testing.faults import Clock
from mavsitl.testing.recording import Recording
from mavsitl.testing.results import Array, State

__all__ = ["Flight"]


class Flight(Craft):
    """A scenario flown in memory, in simulated time: no sockets, no threads, a minute in about a second.

    The bytes between the two ends are those of `mavsitl fly`, over a link that may become worse at any time
    (`link.live`). Equal scenario, seed and faults give equal flights::

        flight = Flight("hover-wind", seed=3, overrides={"offnominal.mass_scale": 1.2})
        flight.faults.link(loss=0.2)
        flight.run()
        assert flight.rmse.x_m < 0.1

    Times are flight time: since the release of the clamp or the lift-off, negative before it.
    """

    clock: ClassVar[Clock] = "flight"
    _kind: ClassVar[Literal["flight", "vehicle"]] = "flight"

    def __init__(
        self,
        scenario: ScenarioLike = DEFAULT_SCENARIO,
        *,
        seed: int | None = None,
        overrides: Overrides | None = None,
        controller: str | type | None = None,
        logs: Path | None = None,
    ) -> None:
        """`scenario`: a shipped one's name, a file's path, a table of keys, or one from `mavsitl.scenario.load`.

        `overrides`: keys of the scenario, dotted, over it. `seed`: None is the scenario's. `controller`: one of your
        own in the place of the paper's, by class, or by its name as of `mavsitl ground --controller`. `logs`: a folder
        for `vehicle.ulg`, `ground.ulg` and `link.tlog`; None: no files. Raises `ScenarioError`, `ControllerError`.
        """
        if controller is not None:
            name = controller if isinstance(controller, str) else f"{controller.__module__}:{controller.__qualname__}"
            overrides = {**controllers.settings(name), **(overrides or {})}
        super().__init__(prepare(scenario, seed=seed, overrides=overrides), logs)
        self._variants: list[Flight] = []
        flight = self.scenario
        self._ground_recording = Recording(None if self._logs is None else self._logs.ground)
        self._reported: list[tuple[float, str]] = []
        seed = flight.scenario.seed
        watched = self._build(
            wings.find(wings.VEHICLE_GROUP)(flight, self._recording, seed=seed, lockstep=True),
        )
        self.ground: Any = wings.find(wings.GROUND_GROUP)(
            flight, self._ground_recording, report=lambda text: self._reported.append((self.time_s, text))
        )
        channels = self._channels["offboard"] = Channels(flight.scenario.link, seed)
        self._subscribe(self.core)
        self._tap = Tap() if self._logs is None else Tap(tlog=self._logs.wire, flush=self.flush)
        self._ticks = drivers.ticks_in_memory(watched, self.ground, channels, self._tap)
        self._limit_us = round((flight.scenario.duration_s + ends.IMPAIRED_GRACE_S) * 1e6)
        self._ended = False
        self._trouble = ""

    def variant(self, *, seed: int | None = None, overrides: Overrides | None = None) -> Flight:
        """Another flight of the same scenario, with another seed or other keys. It has not begun, and has no faults.

        Its logs are beside this one's, and are kept or not with them.
        """
        number = len(self._variants) + 2
        logs = None if self.folder is None else self.folder.with_name(f"{self.folder.name}-{number}")
        made = Flight(self.scenario, seed=seed, overrides=overrides, logs=logs)
        self._variants.append(made)
        return made

    def close(self) -> None:
        for each in self._variants:
            each.close()
        super().close()

    def discard(self) -> None:
        for each in self._variants:
            each.discard()
        super().discard()

    # --- flying

    @property
    def ended(self) -> bool:
        """It is over: both ends have finished, or will not."""
        return self._ended

    def run(self) -> Flight:
        """Fly to the end. A flight that ends otherwise than planned says so in `trouble`, and raises nothing."""
        while self._tick():
            pass
        return self

    def run_until(self, when: float | Callable[[State], bool], *, within_s: float | None = None) -> State:
        """Fly up to a flight time in seconds, or until a condition holds, which is asked after each control period.

        Returns the state then. Raises `FlightAssertionError` where the flight ends before, or `within_s` of simulated
        time pass.
        """
        limit_us = self._limit_us if within_s is None else self._now_us + round(within_s * 1e6)
        while True:
            if not self._tick():
                raise FlightAssertionError(self, "flies on", [f"it ended before {_told(when)}"], self.time_s)
            if callable(when):
                state = self._state()
                if when(state):
                    return state
            elif self.time_s + 5e-7 >= when:
                return self._state()
            if self._now_us >= limit_us:
                given = "" if within_s is None else f" within {within_s:g} s"
                raise FlightAssertionError(self, f"{_told(when)} comes{given}", ["it did not"], self.time_s)

    def _tick(self) -> bool:
        """One control period; False: it is over."""
        if self._ended:
            return False
        try:
            now_us = next(self._ticks, None)
        except LockstepError as error:
            self._trouble = str(error)
            now_us = None
        if now_us is not None and now_us >= self._limit_us:
            self._trouble = f"the flight did not end within {self._limit_us / 1e6:g} s of simulated time"
            now_us = None
        if now_us is None:
            self._ended = True
            self.flush()
        return not self._ended

    # --- what came of it

    @property
    def time_s(self) -> float:
        """Flight time; -1 before the release."""
        zero_us = self._release_us
        return -1.0 if zero_us is None else (self._now_us - zero_us) / 1e6

    @property
    def released(self) -> bool:
        """It has left the clamp or the ground."""
        return self._release_us is not None

    def _zero_us(self) -> int:
        return 0 if self._release_us is None else self._release_us

    def _span_us(self) -> tuple[int, int] | None:
        zero_us = self._release_us
        if zero_us is None:
            return None
        return (zero_us, zero_us + round(self.scenario.scenario.duration_s * 1e6))

    @property
    def trouble(self) -> str:
        """Why it did not end as planned; empty: it did, or goes on."""
        if not self._ended:
            return ""
        if self._trouble or self.ground.succeeded:
            return self._trouble
        said = self._reported[-1][1] if self._reported else "nothing was said"
        return f"lost: {self.lost}" if self.lost else f"the ground's last phase is {self.ground.phase}: {said}"

    @property
    def lost(self) -> str:
        """How the vehicle was lost in flight, as the ground saw it; empty: it was not."""
        return str(self.ground.lost)

    @property
    def reported(self) -> tuple[tuple[float, str], ...]:
        """(time_s, line) of what the ground reported: phases, and the STATUSTEXTs that reached it."""
        return tuple(self._reported)

    @property
    def wire_hash(self) -> str:
        """Of all bytes that passed between the ends so far: equal flights have equal ones."""
        return self._tap.wire.hexdigest()

    @property
    def data(self) -> FlightData:
        """The flight in the paper's frame (NWU), as reports take it. Raises `FlightError` where none was flown."""
        memories = (self._recording.memory, self._ground_recording.memory)
        return FlightData.from_recorders(*memories, duration_s=self.scenario.scenario.duration_s)

    @property
    def rmse(self) -> Rmse:
        """The paper's measure: position against the reference, m (NWU), attitude against the commanded one, degrees.

        Raises `FlightError` where none was flown.
        """
        return rmse(self.data)

    @property
    def paper(self) -> Rmse | None:
        """The paper's numbers for this flight; None: it is none of the paper's four."""
        case = paper_case(self.scenario.scenario)
        return None if case is None else PAPER_TABLES[case]

    @property
    def reference_ned_m(self) -> tuple[Array, Array]:
        """(time_s (k,), position (k, 3)) of where the ground wanted the vehicle, over the flight's time."""
        table = self._ground_recording.memory.arrays(topics.TRAJECTORY_SETPOINT)
        stamps = table["timestamp"].astype(np.int64)
        span_us = self._span_us() or (1, 0)
        rows = (stamps >= span_us[0]) & (stamps <= span_us[1])
        return (stamps[rows] - self._zero_us()) / 1e6, table["position"][rows].astype(np.float64)


def _told(when: float | Callable[[State], bool]) -> str:
    if callable(when):
        return "the condition" if getattr(when, "__name__", "<lambda>") == "<lambda>" else when.__name__
    return f"{when:g} s"
