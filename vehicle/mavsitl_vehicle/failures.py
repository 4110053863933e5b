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

TABLE: Mapping[tuple[Unit, Kind], str] = {}
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
