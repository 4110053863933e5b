"""What is broken: MAVLink's FAILURE_UNIT and FAILURE_TYPE, and which unit of the vehicle has which failure now.

`TABLE` says what each combination means; what is not in it is not supported. The parts of the vehicle ask `Failures.of`
when they work; nothing is told to them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import IntEnum
from math import inf, isfinite, nan
from typing import NamedTuple

from mavsitl.dialect import mavlink
from mavsitl.scenario import Failure, Flight, Scenario, ScenarioError
from mavsitl_vehicle.schedule import Schedule


class Unit(IntEnum):
    """FAILURE_UNIT."""

    GYRO = mavlink.FAILURE_UNIT_SENSOR_GYRO
    ACCEL = mavlink.FAILURE_UNIT_SENSOR_ACCEL
    MAG = mavlink.FAILURE_UNIT_SENSOR_MAG
    BARO = mavlink.FAILURE_UNIT_SENSOR_BARO
    GPS = mavlink.FAILURE_UNIT_SENSOR_GPS
    BATTERY = mavlink.FAILURE_UNIT_SYSTEM_BATTERY
    MOTOR = mavlink.FAILURE_UNIT_SYSTEM_MOTOR
    RC = mavlink.FAILURE_UNIT_SYSTEM_RC_SIGNAL
    MAVLINK = mavlink.FAILURE_UNIT_SYSTEM_MAVLINK_SIGNAL


class Kind(IntEnum):
    """FAILURE_TYPE."""

    OK = mavlink.FAILURE_TYPE_OK
    OFF = mavlink.FAILURE_TYPE_OFF
    STUCK = mavlink.FAILURE_TYPE_STUCK
    GARBAGE = mavlink.FAILURE_TYPE_GARBAGE
    WRONG = mavlink.FAILURE_TYPE_WRONG
    SLOW = mavlink.FAILURE_TYPE_SLOW
    DELAYED = mavlink.FAILURE_TYPE_DELAYED
    INTERMITTENT = mavlink.FAILURE_TYPE_INTERMITTENT


SENSORS = frozenset((Unit.GYRO, Unit.ACCEL, Unit.MAG, Unit.BARO, Unit.GPS))
"""Units that exist only where the vehicle estimates its state from sensors."""

INSTANCES = {Unit.MOTOR: 4, Unit.MAVLINK: 2}
"""Of a unit; any other has one. The link's are 1 off-board, 2 ground stations."""

TABLE: Mapping[tuple[Unit, Kind], str] = {
    # --- sensors: with estimator.kind = "ekf" alone (`mavsitl_vehicle.sensors`)
    (Unit.GYRO, Kind.OFF): "No samples: rate loop and filter keep the last one; the attitude is not valid after 0.1 s.",
    (Unit.GYRO, Kind.STUCK): "Rate loop and filter see the value of that moment for ever; nothing notices.",
    (Unit.GYRO, Kind.GARBAGE): "Noise of 10 rad/s (1 sigma).",
    (Unit.GYRO, Kind.WRONG): "20 deg/s too much about each axis: the rate loop turns the vehicle the other way.",
    (Unit.GYRO, Kind.SLOW): "50 samples a second.",
    (Unit.GYRO, Kind.DELAYED): "20 ms late.",
    (Unit.GYRO, Kind.INTERMITTENT): "Each 50 ms there or not, as a coin falls; the last sample is kept meanwhile.",
    (Unit.ACCEL, Kind.OFF): "No samples: the filter keeps the last one; "
    "velocity, position and height are not valid after 0.1 s.",
    (Unit.ACCEL, Kind.STUCK): "The filter sees the value of that moment for ever.",
    (Unit.ACCEL, Kind.GARBAGE): "Noise of 50 m/s^2 (1 sigma).",
    (Unit.ACCEL, Kind.WRONG): "3 m/s^2 too much along each axis.",
    (Unit.ACCEL, Kind.SLOW): "50 samples a second.",
    (Unit.ACCEL, Kind.DELAYED): "20 ms late.",
    (Unit.ACCEL, Kind.INTERMITTENT): "Each 50 ms there or not, as a coin falls; the last sample is kept meanwhile.",
    (Unit.MAG, Kind.OFF): "No measurements: the heading is the gyro's, and what GPS shows of it in motion.",
    (Unit.MAG, Kind.STUCK): "The field of that moment in body axes for ever: right until the vehicle turns.",
    (Unit.MAG, Kind.GARBAGE): "Noise of 0.5 gauss (1 sigma); most of it is refused at the gate.",
    (Unit.MAG, Kind.WRONG): "0.15 gauss too much forward and to the left, as a current beside it makes.",
    (Unit.MAG, Kind.SLOW): "One measurement in ten.",
    (Unit.MAG, Kind.DELAYED): "0.5 s late, and the filter is not told.",
    (Unit.MAG, Kind.INTERMITTENT): "Each 0.5 s there or not, as a coin falls.",
    (Unit.BARO, Kind.OFF): "No measurements: the height is GPS's.",
    (Unit.BARO, Kind.STUCK): "The height of that moment for ever: refused when the vehicle climbs, "
    "and believed with another offset after 5 s.",
    (Unit.BARO, Kind.GARBAGE): "Noise of 50 m (1 sigma); most of it is refused at the gate.",
    (Unit.BARO, Kind.WRONG): "15 m too high: refused, and believed with another offset after 5 s.",
    (Unit.BARO, Kind.SLOW): "One measurement in ten.",
    (Unit.BARO, Kind.DELAYED): "0.5 s late, and the filter is not told.",
    (Unit.BARO, Kind.INTERMITTENT): "Each 0.5 s there or not, as a coin falls.",
    (Unit.GPS, Kind.OFF): "No fixes: dead reckoning; velocity and position are not valid after EKF2_NOAID_TOUT.",
    (Unit.GPS, Kind.STUCK): "The fix of that moment for ever, velocity too, with new stamps.",
    (Unit.GPS, Kind.GARBAGE): "Noise of 50 m and 5 m/s (1 sigma) that the receiver does not tell of; "
    "most of it is refused at the gates, and one is believed after 7 s.",
    (Unit.GPS, Kind.WRONG): "20 m north, 20 m west and 10 m up of the truth: refused, and believed after 7 s. "
    "SIM_GPS_GLITCH_* have any other offset.",
    (Unit.GPS, Kind.SLOW): "One fix in ten.",
    (Unit.GPS, Kind.DELAYED): "0.5 s later than usual, and the filter is not told.",
    (Unit.GPS, Kind.INTERMITTENT): "Each 0.5 s there or not, as a coin falls.",
    (Unit.BATTERY, Kind.OFF): "It reads empty, as PX4's simulated battery does; the rotors turn on.",
    (Unit.BATTERY, Kind.STUCK): "Charge, voltage and current stay as last measured, while the pack drains on.",
    (Unit.BATTERY, Kind.WRONG): "It collapses: charge and voltage fall at once. Well again, it has what it would have.",
    (Unit.BATTERY, Kind.SLOW): "It is measured every 20 s: unhealthy from 5 s on, until the next.",
    (Unit.MOTOR, Kind.OFF): "The rotor stands still. Its speed controller reports no speed.",
    (Unit.MOTOR, Kind.STUCK): "The rotor keeps its speed while armed. Its speed controller reports nothing any more.",
    (Unit.MOTOR, Kind.GARBAGE): "The rotor turns at any speed, another one every 0.1 s while armed.",
    (Unit.MOTOR, Kind.WRONG): "The rotor is too slow, so that it has a share of its thrust and of its drag torque.",
    (Unit.MOTOR, Kind.SLOW): "The rotor follows its command with a lag, on top of the airframe's.",
    (Unit.MOTOR, Kind.INTERMITTENT): "The rotor cuts out, for 0.1 s on average and every second on average.",
    (Unit.RC, Kind.OFF): "MANUAL_CONTROL is not heard.",
    (Unit.RC, Kind.STUCK): "The sticks stay as they were and count as fresh, whatever comes.",
    (Unit.MAVLINK, Kind.OFF): "Nothing comes in and nothing goes out.",
    (Unit.MAVLINK, Kind.STUCK): "Telemetry repeats the state of the moment, newly stamped; mode and answers stay true.",
    (Unit.MAVLINK, Kind.GARBAGE): "A fifth of the messages have flipped bits, both ways.",
    (Unit.MAVLINK, Kind.SLOW): "57.6 kbit/s each way, a telemetry radio's; what does not fit its queue is lost.",
    (Unit.MAVLINK, Kind.DELAYED): "500 ms later, each way.",
    (Unit.MAVLINK, Kind.INTERMITTENT): "Bursts of 500 ms in which all is lost, every 2.5 s on average, each way.",
}
"""What each supported combination does."""


class Size(NamedTuple):
    """How much of a failure, where that is a number."""

    default: float
    minimum: float
    maximum: float
    text: Callable[[float], str]


SIZES: Mapping[tuple[Unit, Kind], Size] = {
    (Unit.BATTERY, Kind.WRONG): Size(0.04, 0.0, 1.0, lambda share: f"{100.0 * share:g} % of the charge"),
    (Unit.MOTOR, Kind.WRONG): Size(0.5, 0.0, 1.0, lambda share: f"{100.0 * share:g} % of the thrust"),
    (Unit.MOTOR, Kind.SLOW): Size(0.1, 0.001, 10.0, lambda tau_s: f"time constant {tau_s:g} s"),
}
"""The others have no number."""

PARAMETERS: Mapping[str, tuple[Unit, int]] = {
    "SIM_FAIL_GYRO": (Unit.GYRO, 1),
    "SIM_FAIL_ACC": (Unit.ACCEL, 1),
    "SIM_FAIL_MAG": (Unit.MAG, 1),
    "SIM_FAIL_BARO": (Unit.BARO, 1),
    "SIM_FAIL_GPS": (Unit.GPS, 1),
    "SIM_FAIL_BAT": (Unit.BATTERY, 1),
    **{f"SIM_FAIL_MOT{motor}": (Unit.MOTOR, motor) for motor in range(1, 5)},
    "SIM_FAIL_RC": (Unit.RC, 1),
    "SIM_FAIL_LINK1": (Unit.MAVLINK, 1),
    "SIM_FAIL_LINK2": (Unit.MAVLINK, 2),
}
"""The parameter that shows and sets the failure of each instance."""

EFFICIENCIES: Mapping[str, int] = {f"SIM_MOT{motor}_EFF": motor for motor in range(1, 5)}
"""The parameter that shows and sets each motor's share of thrust: 1 is `OK`, 0 is `OFF`, between is `WRONG`."""


def kinds(unit: Unit) -> tuple[Kind, ...]:
    """The failures that a unit may have, `OK` first."""
    return (Kind.OK, *(kind for other, kind in TABLE if other is unit))


def has_sensors(scenario: Scenario) -> bool:
    """Does the vehicle estimate its state from sensors, which can fail?"""
    return scenario.estimator.kind == "ekf"


NO_SILENCE = "in lock-step it needs an impaired [link], e.g. link.live: over a perfect one time goes by telemetry"


def silences(unit: int, kind: int) -> bool:
    """Whether messages are late or lost by it."""
    return unit == Unit.MAVLINK and kind not in (Kind.OK, Kind.STUCK)


def may_fall_silent(scenario: Scenario, *, lockstep: bool) -> bool:
    """Does the peer's clock go on where the vehicle says nothing? If not, what `silences` would end the flight."""
    return not lockstep or scenario.impaired


def unsupported(unit: int, kind: int, *, sensors: bool) -> str | None:
    """Why there is no such failure, by the numbers of FAILURE_UNIT and FAILURE_TYPE; None where there is."""
    if unit not in Unit.__members__.values() or kind not in Kind.__members__.values():
        return f"unit {unit} type {kind} is not supported"
    if Unit(unit) in SENSORS and not sensors:
        return f'{named(Unit(unit))} needs estimator.kind = "ekf"'
    if kind not in (known := kinds(Unit(unit))):
        allowed = ", ".join(f"{each.value} {named(each)}" for each in known)
        return f"{named(Unit(unit))} {named(Kind(kind))} is not supported; allowed: {allowed}"
    return None


def named(item: Unit | Kind) -> str:
    """As the scenario writes it."""
    return item.name.lower()


class Change(NamedTuple):
    """One instance of a unit that is broken, or well again, from now on."""

    unit: Unit
    instance: int
    kind: Kind
    value: float = nan
    """How much, where the failure has a size."""

    @property
    def text(self) -> str:
        """For people: "Failure injected: motor 2 off"."""
        what = named(self.unit) + (f" {self.instance}" if INSTANCES.get(self.unit, 1) > 1 else "")
        if self.kind is Kind.OK:
            return f"Failure cleared: {what}"
        size = SIZES.get((self.unit, self.kind))
        return f"Failure injected: {what} {named(self.kind)}" + (f", {size.text(self.value)}" if size else "")


class Failures:
    """Of each unit's instances, counted from 1, the failure it has."""

    def __init__(self) -> None:
        self.active: dict[tuple[Unit, int], Kind] = {}
        self._values: dict[tuple[Unit, int], float] = {}
        self._listeners: list[Callable[[Change], None]] = []

    def of(self, unit: Unit, instance: int = 1) -> Kind:
        return self.active.get((unit, instance), Kind.OK)

    def value(self, unit: Unit, instance: int = 1) -> float:
        """How much of its failure; NaN where that is no number."""
        return self._values.get((unit, instance), nan)

    def subscribe(self, listener: Callable[[Change], None]) -> None:
        self._listeners.append(listener)

    def set(self, unit: Unit, kind: Kind, instance: int = 0, value: float | None = None) -> None:
        """`instance` 0: all. `value`: as in `SIZES`; None: as it is, or the default. Tells the listeners what changes.

        Raises `ValueError` for an instance that the unit does not have, and a value that the failure cannot have.
        """
        if problem := instance_problem(unit, instance) or (None if value is None else value_problem(unit, kind, value)):
            raise ValueError(problem)
        count = INSTANCES.get(unit, 1)
        for each in range(1, count + 1) if instance == 0 else (instance,):
            same = self.of(unit, each) is kind
            if same and (value is None or value == self.value(unit, each)):
                continue
            self.active.pop((unit, each), None)
            self._values.pop((unit, each), None)
            if kind is not Kind.OK:
                self.active[unit, each] = kind
            if size := SIZES.get((unit, kind)):
                self._values[unit, each] = size.default if value is None else value
            change = Change(unit, each, kind, self.value(unit, each))
            for listener in self._listeners:
                listener(change)

    def clear(self) -> None:
        """All is well again."""
        for unit, instance in tuple(self.active):
            self.set(unit, Kind.OK, instance)


def instance_problem(unit: Unit, instance: int) -> str | None:
    """Why a unit has no such instance; None where it has. 0 is all of them."""
    count = INSTANCES.get(unit, 1)
    if 0 <= instance <= count:
        return None
    return f"{named(unit)} has no instance {instance}; allowed: 0 (all) to {count}"


def value_problem(unit: Unit, kind: Kind, value: float) -> str | None:
    """Why a failure is not of this size; None where it may be."""
    size = SIZES.get((unit, kind))
    if size is None:
        return f"{named(unit)} {named(kind)} has no value"
    if isfinite(value) and size.minimum <= value <= size.maximum:
        return None
    return f"{value:g} is not allowed for {named(unit)} {named(kind)}; allowed: {size.minimum:g} to {size.maximum:g}"


# --- the scenario's time line ----------------------------------------------------------------------------------------


class Timeline:
    """Injects the scenario's failures when their time comes, and clears them when it is over."""

    def __init__(self, flight: Flight, failures: Failures, *, lockstep: bool) -> None:
        """Raises `ScenarioError` for a failure that there is not."""
        self._failures = failures
        self._planned = [_Planned(flight, number, lockstep) for number in range(len(flight.scenario.failures))]
        self._schedule = Schedule((planned.asked.start_s, planned.asked.clock) for planned in self._planned)

    def __bool__(self) -> bool:
        return bool(self._planned)

    def step(self, now_us: int, flight_time_s: float) -> None:
        """What begins or ends by `now_us` since the start; the flight's time is negative before the release."""
        due = self._schedule.due(now_us, flight_time_s)
        for number, planned in enumerate(self._planned):
            if planned.ends_us <= now_us:
                planned.ends_us = inf
                self._end(planned)
            if number in due:
                asked = planned.asked
                if asked.duration_s:
                    planned.ends_us = now_us + asked.duration_s * 1e6 - 0.5
                self._failures.set(planned.unit, planned.kind, asked.instance, asked.value)

    def _end(self, planned: _Planned) -> None:
        """What somebody else has changed since stays as it is."""
        instances = range(1, INSTANCES.get(planned.unit, 1) + 1)
        for each in instances if planned.asked.instance == 0 else (planned.asked.instance,):
            if self._failures.of(planned.unit, each) is planned.kind:
                self._failures.set(planned.unit, Kind.OK, each)


class _Planned:
    """One entry of `[[failures]]`: as it was asked for, and how far it has come."""

    def __init__(self, flight: Flight, number: int, lockstep: bool) -> None:
        self.asked: Failure = flight.scenario.failures[number]
        self.ends_us = inf
        try:
            self.unit, self.kind = understood(self.asked, flight.scenario, lockstep=lockstep)
        except FailureError as error:
            raise ScenarioError(f"{flight.name}: failures[{number}].{error.key}: {error}") from None


class FailureError(ValueError):
    """There is no such failure.

    Attributes:
        key: of the scenario's `[[failures]]`, to which the text refers.
    """

    def __init__(self, key: str, text: str) -> None:
        super().__init__(text)
        self.key = key


def understood(asked: Failure, scenario: Scenario, *, lockstep: bool) -> tuple[Unit, Kind]:
    """What is to fail and how, checked for this vehicle. Raises `FailureError`."""
    unit, kind = Unit[asked.unit.upper()], Kind[asked.type.upper()]
    if problem := unsupported(unit, kind, sensors=has_sensors(scenario)):
        raise FailureError("type", problem)
    if silences(unit, kind) and not may_fall_silent(scenario, lockstep=lockstep):
        raise FailureError("type", f"mavlink {asked.type}: {NO_SILENCE}")
    if problem := instance_problem(unit, asked.instance):
        raise FailureError("instance", problem)
    if asked.value is not None and (problem := value_problem(unit, kind, asked.value)):
        raise FailureError("value", problem)
    return unit, kind
