"""What a test says of a flight, and what it is told where that is not so: when, how far, which mode, what was said."""

from __future__ import annotations

import re
from collections.abc import Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

import numpy as np

from mavsitl.log.flight import FlightError
from mavsitl.px4_modes import MODES
from mavsitl.testing.results import Array, Status, Text, Track

if TYPE_CHECKING:
    from mavsitl.testing.craft import Craft

__all__ = ["FlightAssertionError", "FlightCheck", "assert_flight"]

Point = Sequence[float]

RMSE_STATES = {"x": "x_m", "y": "y_m", "z": "z_m", "phi": "phi_deg", "theta": "theta_deg", "psi": "psi_deg"}


class FlightAssertionError(AssertionError):
    """What was asserted of a flight is not so.

    Attributes:
        craft: what was flown.
        time_s: when it was not so first, by the craft's clock; None: at no time of its own.
    """

    def __init__(self, craft: Craft, claim: str, found: Sequence[str], time_s: float | None = None) -> None:
        craft.flush()
        lines = [f"{craft.name}: {claim}", *found, *craft.story(time_s)]
        super().__init__("\n".join((lines[0], *(f"  {line}" for line in lines[1:]))))
        self.craft = craft
        self.time_s = time_s


def assert_flight(craft: Craft) -> FlightCheck:
    """What is to be so of a `Flight`, a `Vehicle` or a running vehicle; each method asserts, and they can be chained.

    ``assert_flight(flight).stays_within(0.3, after_s=5).mode_was("OFFBOARD").never_failsafe()``
    """
    return FlightCheck(craft)


class FlightCheck:
    """Assertions on what was flown so far. Each raises `FlightAssertionError`, or returns this object.

    Times are by the craft's clock, which is flight time for a `Flight`, else time since the vehicle's start; `after_s`
    to `until_s` is what is looked at, None: to the end. Positions are NED in m, and true ones.
    """

    def __init__(self, craft: Craft) -> None:
        self.craft = craft

    # --- where it was

    def stays_within(
        self, distance_m: float, *, of: Point | None = None, after_s: float = 0.0, until_s: float | None = None
    ) -> FlightCheck:
        """It was never farther than `distance_m` from a point; None: from its reference, which only a `Flight` has."""
        __tracebackhide__ = True
        track = self._track(after_s, until_s)
        what = "its reference" if of is None else f"({_point(of)}) m"
        claim = f"stays within {distance_m:g} m of {what}{_span(after_s, until_s)}"
        if of is None:
            found = self.craft.reference_ned_m
            if found is None:
                raise TypeError(f"{self.craft.name}: has no reference; say of=(north, east, down)")
            track, wanted = _joined(track, *found)
        else:
            wanted = np.asarray(of, float)
        self._flown(track, claim)
        error = track.position_ned_m - wanted
        self._never(track, np.linalg.norm(error, axis=1), distance_m, claim, "m away", error)
        return self

    def reaches(
        self, position_ned_m: Point, *, within_m: float = 0.5, after_s: float = 0.0, by_s: float | None = None
    ) -> FlightCheck:
        """It was once within `within_m` of a position."""
        __tracebackhide__ = True
        claim = f"reaches ({_point(position_ned_m)}) m within {within_m:g} m{_span(after_s, by_s)}"
        track = self._track(after_s, by_s)
        self._flown(track, claim)
        distance = np.linalg.norm(track.position_ned_m - np.asarray(position_ned_m, float), axis=1)
        nearest = int(np.argmin(distance))
        if distance[nearest] > within_m:
            time_s = float(track.time_s[nearest])
            at = _point(track.position_ned_m[nearest])
            self._fail(claim, [f"it came as near as {distance[nearest]:.2f} m, at {time_s:.2f} s, at ({at}) m"], time_s)
        return self

    def stays_above(self, height_m: float, *, after_s: float = 0.0, until_s: float | None = None) -> FlightCheck:
        """It was never lower than `height_m` above the origin."""
        __tracebackhide__ = True
        claim = f"stays above {height_m:g} m{_span(after_s, until_s)}"
        track = self._track(after_s, until_s)
        self._flown(track, claim)
        self._never(track, height_m - track.height_m, 0.0, claim, "m too low")
        return self

    def tilt_below(self, limit_deg: float, *, after_s: float = 0.0, until_s: float | None = None) -> FlightCheck:
        """It was never tilted by more than `limit_deg`."""
        __tracebackhide__ = True
        claim = f"tilts by less than {limit_deg:g} deg{_span(after_s, until_s)}"
        track = self._track(after_s, until_s)
        self._flown(track, claim)
        self._never(track, track.tilt_deg, limit_deg, claim, "deg")
        return self

    def rmse_below(self, **limits: float) -> FlightCheck:
        """The paper's measure of a `Flight`: `x`, `y`, `z` in m, `phi`, `theta`, `psi` in degrees."""
        __tracebackhide__ = True
        if unknown := [name for name in limits if name not in RMSE_STATES]:
            raise TypeError(f"rmse_below: {', '.join(unknown)} is not allowed; allowed: {', '.join(RMSE_STATES)}")
        if not limits:
            raise TypeError(f"rmse_below: nothing is asserted; allowed: {', '.join(RMSE_STATES)}")
        wanted = ", ".join(f"{name} < {limit:g}" for name, limit in limits.items())
        claim = f"has an RMSE of {wanted}"
        if self.craft.reference_ned_m is None:
            raise TypeError(f"{self.craft.name}: has no RMSE, for it has no reference; see stays_within")
        measured = None
        try:
            measured = getattr(self.craft, "rmse", None)
        except FlightError as error:
            self._fail(claim, [f"it was not flown: {error}"])
        worse = []
        for name, limit in limits.items():
            value, unit = getattr(measured, RMSE_STATES[name]), RMSE_STATES[name].rpartition("_")[2]
            if not value < limit:
                worse.append(f"{name} is {value:.4g} {unit}, {value / limit:.2f} times the limit")
        if worse:
            self._fail(claim, worse)
        return self

    # --- modes and fail-safes

    def mode_was(self, *modes: str, after_s: float = 0.0, until_s: float | None = None) -> FlightCheck:
        """It was in one of these modes all the time."""
        __tracebackhide__ = True
        wanted = [_mode(mode) for mode in modes]
        claim = f"is in {' or '.join(wanted)}{_span(after_s, until_s)}"
        flown = _during(self.craft.statuses, after_s, self._end(until_s))
        if not flown:
            self._fail(claim, ["it flew in no mode then"])
        for status in flown:
            if status.mode not in wanted:
                time_s = max(status.time_s, after_s)
                self._fail(claim, [f"at {time_s:.2f} s it was in {status.mode}"], time_s)
        return self

    def entered(self, mode: str, *, after_s: float = 0.0, by_s: float | None = None) -> FlightCheck:
        """It was in this mode at some time."""
        __tracebackhide__ = True
        wanted = _mode(mode)
        flown = _during(self.craft.statuses, after_s, self._end(by_s))
        if all(status.mode != wanted for status in flown):
            was = dict.fromkeys(status.mode for status in flown)
            self._fail(f"enters {wanted}{_span(after_s, by_s)}", [f"it was in {', '.join(was) or 'no mode'}"], by_s)
        return self

    def never_failsafe(self, *, after_s: float = 0.0, until_s: float | None = None) -> FlightCheck:
        """No fail-safe took over."""
        __tracebackhide__ = True
        end_s = self._end(until_s)
        for each in self.craft.failsafes:
            if each.end_s >= after_s and each.start_s <= end_s:
                found = f"at {each.start_s:.2f} s: {each.text or 'not announced'} ({each.mode})"
                self._fail(f"has no fail-safe{_span(after_s, until_s)}", [found], each.start_s)
        return self

    def had_failsafe(self, text: str = "", *, after_s: float = 0.0, by_s: float | None = None) -> FlightCheck:
        """A fail-safe took over whose announcement has `text` in it, e.g. "off-board signal lost"."""
        __tracebackhide__ = True
        until_s = self._end(by_s)
        wanted = text.lower()
        if not any(after_s <= each.start_s <= until_s and wanted in each.text.lower() for each in self.craft.failsafes):
            self._fail(f"has a fail-safe {text!r}{_span(after_s, by_s)}", ["it had none of that kind"], by_s)
        return self

    def completes(self) -> FlightCheck:
        """A `Flight` ended as planned: flown for its time, landed or stopped, disarmed, not lost."""
        __tracebackhide__ = True
        ended = getattr(self.craft, "ended", None)
        if ended is None:
            raise TypeError(f"{self.craft.name}: only a Flight has an end; see lands")
        if not ended:
            self._fail("ends as planned", ["it has not ended: say run() before"])
        if self.craft.trouble:
            self._fail("ends as planned", ["it did not"])
        return self

    def lands(self) -> FlightCheck:
        """It has flown, and now it is on the ground and disarmed."""
        __tracebackhide__ = True
        now = self.craft.now
        missing = [
            text
            for text, is_so in (
                ("it has never left the ground", self.craft._release_us is None),
                (f"it is in the air, at {now.height_m:.2f} m", not now.landed),
                ("it is armed", now.armed),
            )
            if is_so
        ]
        if missing:
            self._fail("lands and disarms", missing, now.time_s)
        return self

    # --- what it said

    def says(
        self, text: str | re.Pattern[str], *, after_s: float | None = None, by_s: float | None = None
    ) -> FlightCheck:
        """A STATUSTEXT has `text` in it, upper or lower case, or matches the expression."""
        __tracebackhide__ = True
        if not self._said(text, after_s, by_s):
            near = get_close_matches(str(text), [each.text for each in self.craft.texts], 1, 0.4)
            found = [f"the nearest is {near[0]!r}"] if isinstance(text, str) and near else ["nothing like it was said"]
            self._fail(f"says {_shown(text)}{_span(after_s, by_s)}", found, by_s)
        return self

    def never_says(
        self, text: str | re.Pattern[str], *, after_s: float | None = None, until_s: float | None = None
    ) -> FlightCheck:
        """No STATUSTEXT has `text` in it."""
        __tracebackhide__ = True
        for each in self._said(text, after_s, until_s):
            found = f"at {each.time_s:.2f} s: {each.text}"
            self._fail(f"never says {_shown(text)}{_span(after_s, until_s)}", [found], each.time_s)
        return self

    # ---

    def _said(self, text: str | re.Pattern[str], after_s: float | None, until_s: float | None) -> list[Text]:
        pattern = re.compile(re.escape(text), re.IGNORECASE) if isinstance(text, str) else text
        return [
            each
            for each in self.craft.texts
            if pattern.search(each.text)
            and (after_s is None or each.time_s >= after_s)
            and (until_s is None or each.time_s <= until_s)
        ]

    def _track(self, after_s: float, until_s: float | None) -> Track:
        return self.craft.truth.between(after_s, until_s)

    def _end(self, until_s: float | None) -> float:
        """Of what is looked at: for a `Flight` not beyond its time, when it lands."""
        span_us = self.craft._span_us()
        last_s = self.craft.time_s if span_us is None else (span_us[1] - self.craft._zero_us()) / 1e6
        return min(last_s, self.craft.time_s) if until_s is None else until_s

    def _flown(self, track: Track, claim: str) -> None:
        __tracebackhide__ = True
        if not len(track):
            self._fail(claim, ["it did not fly then"])

    def _never(self, track: Track, value: Array, limit: float, claim: str, unit: str, error: Any = None) -> None:
        """Fail where `value` (k,) is beyond `limit` at any time of the track."""
        __tracebackhide__ = True
        beyond = ~(value <= limit)
        if not beyond.any():
            return
        first, worst = int(np.argmax(beyond)), int(np.nanargmax(value))
        period_s = float(np.median(np.diff(track.time_s))) if len(track) > 1 else 0.0
        found = [
            f"from {track.time_s[first]:.2f} s on it was not, for {beyond.sum() * period_s:.2f} s in all",
            f"the most was {value[worst]:.3g} {unit}, at {track.time_s[worst]:.2f} s"
            + ("" if error is None else f" ({_compass(error[worst])})"),
        ]
        self._fail(claim, found, float(track.time_s[first]))

    def _fail(self, claim: str, found: Sequence[str], time_s: float | None = None) -> None:
        __tracebackhide__ = True
        raise FlightAssertionError(self.craft, claim, found, time_s)


def _joined(track: Track, time_s: Array, position: Array) -> tuple[Track, Array]:
    """The moments of a track that have a reference, and the reference then."""
    if not time_s.size:
        return track.between(np.inf), np.zeros((0, 3))
    rows = np.isin(np.round(track.time_s * 1e6), np.round(time_s * 1e6))
    there = np.isin(np.round(time_s * 1e6), np.round(track.time_s * 1e6))
    return Track(*(getattr(track, name)[rows] for name in Track.__dataclass_fields__)), position[there]


def _during(statuses: Sequence[Status], start_s: float, end_s: float) -> list[Status]:
    """Those that hold at some time from `start_s` to `end_s`."""
    ends = [*(status.time_s for status in statuses[1:]), np.inf]
    return [
        status for status, until_s in zip(statuses, ends, strict=True) if until_s > start_s and status.time_s <= end_s
    ]


def _mode(name: str) -> str:
    wanted = name.upper()
    if wanted not in MODES:
        raise ValueError(f"{name!r} is no mode; allowed: {', '.join(MODES)}")
    return wanted


def _span(after_s: float | None, until_s: float | None) -> str:
    begin = f" from {after_s:g} s" if after_s else ""
    return begin + (f" {'to' if begin else 'until'} {until_s:g} s" if until_s is not None else " on" if begin else "")


def _point(point: Any) -> str:
    north, east, down = point
    return f"{north:.2f}, {east:.2f}, {down:.2f}"


def _compass(error: Any) -> str:
    north, east, down = error
    return f"north {north:+.2f}, east {east:+.2f}, down {down:+.2f} m"


def _shown(text: str | re.Pattern[str]) -> str:
    return repr(text) if isinstance(text, str) else repr(text.pattern)
