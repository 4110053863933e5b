"""What is broken: MAVLink's FAILURE_UNIT and FAILURE_TYPE, and which unit of the vehicle has which failure now.

`TABLE` says what each combination means; what is not in it is not supported. The parts of the vehicle ask `Failures.of`
when they work; nothing is told to them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import NamedTuple

from mavsitl.dialect import mavlink


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
}
"""What each supported combination does."""


class Change(NamedTuple):
    """One instance of a unit that is broken, or well again, from now on."""

    unit: Unit
    instance: int
    kind: Kind


class Failures:
    """Of each unit's instances, counted from 1, the failure it has."""

    def __init__(self) -> None:
        self.active: dict[tuple[Unit, int], Kind] = {}
        self._listeners: list[Callable[[Change], None]] = []

    def of(self, unit: Unit, instance: int = 1) -> Kind:
        return self.active.get((unit, instance), Kind.OK)

    def subscribe(self, listener: Callable[[Change], None]) -> None:
        self._listeners.append(listener)

    def set(self, unit: Unit, kind: Kind, instance: int = 0) -> None:
        """`instance` 0: all. Tells the listeners of what changes.

        Raises `ValueError` for an instance that the unit does not have.
        """
        count = INSTANCES.get(unit, 1)
        if not 0 <= instance <= count:
            raise ValueError(f"{unit.name} has no instance {instance}; allowed: 0 (all) to {count}")
        for each in range(1, count + 1) if instance == 0 else (instance,):
            if self.of(unit, each) is kind:
                continue
            if kind is Kind.OK:
                del self.active[unit, each]
            else:
                self.active[unit, each] = kind
            for listener in self._listeners:
                listener(Change(unit, each, kind))
