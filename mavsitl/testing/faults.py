"""What goes wrong with a craft under test: parts, links, protocol, wind. Now, or when its time comes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import inf
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from mavsitl import scenario
from mavsitl.link.settings import BOTH, DIRECTIONS
from mavsitl.scenario import Failure, LinkChange

if TYPE_CHECKING:
    from mavsitl.testing.craft import Craft

__all__ = ["Agenda", "Clock", "Fault", "FaultError", "Faults"]

Clock: TypeAlias = Literal["flight", "simulated"]
Direction: TypeAlias = Literal["both", "to_ground", "to_vehicle"]
Ender: TypeAlias = Callable[[], None]
Entry: TypeAlias = tuple[float, Clock, Callable[[], None]]

_HALF_US = 0.5


class FaultError(ValueError):
    """There is no such fault, or this craft cannot have it; the message says what is allowed."""


class Agenda:
    """What is to be done with a craft, and when: asked before each of its ticks."""

    def __init__(self) -> None:
        self._entries: list[Entry] = []

    def add(self, at_s: float, clock: Clock, action: Callable[[], None]) -> None:
        self._entries.append((at_s, clock, action))

    def remove(self, action: Callable[[], None]) -> None:
        self._entries = [entry for entry in self._entries if entry[2] != action]

    def step(self, now_us: int, flight_time_s: float) -> None:
        """`now_us`: the last tick; the flight's time is negative before the release."""
        if not self._entries:
            return
        due: list[Entry] = []
        later: list[Entry] = []
        for entry in self._entries:
            at_s, clock, _ = entry
            time_us = now_us if clock == "simulated" else flight_time_s * 1e6
            (due if time_us + _HALF_US >= at_s * 1e6 and time_us >= 0.0 else later).append(entry)
        self._entries = later
        for _, _, action in due:
            action()


class Fault:
    """One fault that was asked for. In a `with` block it ends with the block."""

    def __init__(self, craft: Craft, what: str, begin: Callable[[], Ender], ends_after_s: float | None) -> None:
        self.what = what
        self.began_s: float | None = None
        """When it began, by the craft's clock; None: not yet."""
        self.ended_s: float | None = None
        self._craft = craft
        self._begin = begin
        self._ends_after_s = ends_after_s
        self._ender: Ender | None = None

    def _start(self) -> None:
        """Where the vehicle lives."""
        self._ender = self._begin()
        self.began_s = self._craft.time_s
        if self._ends_after_s is not None:
            self._craft._agenda.add(self._craft._now_us / 1e6 + self._ends_after_s, "simulated", self._stop)

    def _stop(self) -> None:
        self._craft._agenda.remove(self._start)
        self._craft._agenda.remove(self._stop)
        if self._ender is not None:
            ender, self._ender = self._ender, None
            ender()
            self.ended_s = self._craft.time_s

    def end(self) -> None:
        """End it now, or let it never begin. What is over already stays as it is."""
        self._craft._call(self._stop)

    def __enter__(self) -> Fault:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def __str__(self) -> str:
        if self.began_s is None:
            return f"{self.what}: not begun"
        begin = "the start" if self.began_s < 0.0 else f"{self.began_s:.2f} s"
        until = f" to {self.ended_s:.2f} s" if self.ended_s is not None else " on"
        return f"{self.what}: from {begin}{until}"


class Faults:
    """What goes wrong with one craft. Each method says what, when, and for how long, and gives a `Fault`.

    `at_s`: when it begins; None: now. `for_s`: it ends by itself after so long; None: it stays, until `Fault.end` or
    `clear`. `clock`: of `at_s`, "flight" (since the release or the lift-off) or "simulated" (since the vehicle's
    start); None: that of the craft, which is flight time of a `Flight`, else simulated. Wrong names and values raise at
    once, whenever it is to begin: `ScenarioError`, `ChaosError`, `FaultError`.
    """

    def __init__(self, craft: Craft) -> None:
        self._craft = craft
        self._asked: list[Fault] = []

    def inject(
        self, unit: str, kind: str = "off", *, instance: int = 0, value: float | None = None,
        at_s: float | None = None, for_s: float | None = None, clock: Clock | None = None,
    ) -> Fault:  # fmt: skip
        """A part fails: MAV_CMD_INJECT_FAILURE's unit and type, as the scenario's `[[failures]]` have them.

        E.g. ``inject("motor", "off", instance=3)``, ``inject("gps", "stuck", at_s=10.0, for_s=5.0)``. Which types
        each unit knows, and what `value` means, is in the reference of failures; sensors fail only where there are
        some (`estimator.kind` = "ekf"). `instance` 0: all of them.
        """
        keys = {"unit": unit, "type": kind, "instance": instance, "start_s": 0.0}
        failure = scenario.section(Failure, "faults.inject", keys if value is None else {**keys, "value": value})
        core = self._craft.core
        try:
            core.check_failure(failure)
        except ValueError as error:
            raise FaultError(f"faults.inject: {error}") from None

        def begin() -> Ender:
            core.inject(failure)
            return lambda: core.mend(failure)

        which = f" {instance}" if instance else ""
        return self._ask(f"{unit}{which} {kind}", begin, at_s, for_s, clock)

    def link(
        self, *, port: str = "offboard", direction: Direction = "both",
        at_s: float | None = None, for_s: float | None = None, clock: Clock | None = None, **impairment: Any,
    ) -> Fault:  # fmt: skip
        """A link becomes worse, by the keys of the scenario's `[link]`: ``link(loss=0.2, latency_ms=50.0)``.

        `port`: "offboard" or "gcs". `direction`: "to_ground" (telemetry, acknowledgements), "to_vehicle" (setpoints,
        commands), or both. Keys that are not named stay as they are.
        """
        change = scenario.section(LinkChange, "faults.link", {"at_s": 0.0, "direction": direction, **impairment})
        if not impairment:
            raise FaultError("faults.link: nothing is to change; e.g. link(loss=0.2)")
        channels = self._channels("faults.link", port)
        names = [each for each in DIRECTIONS[BOTH] if direction in ("both", each)]

        def begin() -> Ender:
            before = {each: channels.base(each) for each in names}
            channels.change(change)

            def end() -> None:
                for each, impaired in before.items():
                    values = {key: getattr(impaired, key) for key in impairment}
                    channels.change(LinkChange(at_s=0.0, direction=each, **values))

            return end

        told = ", ".join(f"{key} {value}" for key, value in impairment.items())
        where = "" if direction == "both" else f", {direction}"
        return self._ask(f"{port} link{where}: {told}", begin, at_s, for_s, clock)

    def outage(
        self, duration_s: float, *, port: str = "offboard", direction: Direction = "both",
        at_s: float | None = None, clock: Clock | None = None,
    ) -> Fault:  # fmt: skip
        """Nothing that is sent on a link arrives, for `duration_s`."""
        return self.link(port=port, direction=direction, at_s=at_s, for_s=duration_s, clock=clock, down=True)

    def chaos(
        self, mode: str, *, port: str | None = None,
        at_s: float | None = None, for_s: float | None = None, clock: Clock | None = None,
    ) -> Fault:  # fmt: skip
        """The vehicle breaks MAVLink's rules: ``chaos("ack-first-lost")``. `mavsitl chaos` lists the modes.

        `port`: "offboard", "gcs" or "all"; None: all, or what the mode names behind "@".
        """
        craft = self._craft
        made = craft._call(lambda: craft.core.chaos)
        made.check(mode, port)

        def begin() -> Ender:
            made.begin(mode, port)
            return lambda: made.end(mode, port)

        return self._ask(f"chaos {mode}" + (f" on {port}" if port else ""), begin, at_s, for_s, clock)

    def gust(
        self, speed_m_s: float, *, from_deg: float = 0.0, rise_s: float = 1.0,
        at_s: float | None = None, clock: Clock | None = None,
    ) -> Fault:  # fmt: skip
        """A 1-cosine gust on top of all other wind, in flight only: `SIM_GUST_*`.

        It rises to `speed_m_s` in `rise_s` and falls as slowly. `from_deg`: where it comes from, clockwise from north.
        """
        settings = {"SIM_GUST_SPD": speed_m_s, "SIM_GUST_DIR": from_deg, "SIM_GUST_LEN": rise_s}
        return self._set(f"gust of {speed_m_s:g} m/s", {**settings, "SIM_GUST_TRIG": 1.0}, at_s, None, clock, ())

    def parameters(
        self, *, at_s: float | None = None, for_s: float | None = None, clock: Clock | None = None, **values: float
    ) -> Fault:
        """The vehicle's parameters are set, as PARAM_SET does; at the end they are as before."""
        told = ", ".join(f"{name} = {value:g}" for name, value in values.items())
        return self._set(told, values, at_s, for_s, clock, tuple(values))

    def clear(self) -> None:
        """All is well again, and nothing is to come."""
        for fault in reversed(self._asked):
            if fault.ended_s is None:
                fault.end()

    def told(self) -> list[str]:
        """Each that was asked for, and when it was there."""
        return [str(fault) for fault in self._asked]

    def _set(
        self, what: str, values: Mapping[str, float], at_s: float | None, for_s: float | None, clock: Clock | None,
        restored: tuple[str, ...],
    ) -> Fault:  # fmt: skip
        table = self._craft.core.parameters
        if unknown := [name for name in values if name not in table.names]:
            raise FaultError(f"faults: the vehicle has no parameter {', '.join(unknown)}")

        def put(wanted: Mapping[str, float]) -> None:
            for name, value in wanted.items():
                if refused := table.set(name, value):
                    raise FaultError(f"faults: {refused.text}")

        def begin() -> Ender:
            before = {name: table[name] for name in restored}
            put(values)
            return lambda: put(before)

        return self._ask(what, begin, at_s, for_s, clock)

    def _channels(self, where: str, port: str) -> Any:
        channels = self._craft._channels
        if port not in channels:
            raise FaultError(f"{where}: port: {port!r} is not allowed; allowed: {', '.join(map(repr, channels))}")
        return channels[port]

    def _ask(
        self, what: str, begin: Callable[[], Ender], at_s: float | None, for_s: float | None, clock: Clock | None
    ) -> Fault:
        craft = self._craft
        if clock not in (None, "flight", "simulated"):
            raise FaultError(f"faults: clock: {clock!r} is not allowed; allowed: 'flight', 'simulated'")
        for name, value in (("at_s", at_s), ("for_s", for_s)):
            if value is not None and not 0.0 <= value < inf:
                raise FaultError(f"faults: {name}: {value!r} is not allowed; allowed: number >= 0")
        fault = Fault(craft, what, begin, for_s)
        self._asked.append(fault)
        if at_s is None:
            craft._call(fault._start)
        else:
            when, by = at_s, clock or craft.clock
            craft._call(lambda: craft._agenda.add(when, by, fault._start))
        return fault
