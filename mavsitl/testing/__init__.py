"""For tests of other people's code: vehicles and flights in memory and on sockets, faults, assertions, a pytest plugin.

============================  ==========================================================================
`Flight`                      a whole flight in memory, in lock-step: a minute in about a second
`Vehicle`                     a vehicle that the test drives by messages, in simulated time
`vehicle`, `RunningVehicle`   one on sockets, in real time or in lock-step with a program
`Faults`                      what goes wrong with any of them: their `faults`
`assert_flight`               what is to be so of any of them
============================  ==========================================================================

`mavsitl.testing.plugin` makes pytest's fixtures of them. What is named here is loaded when it is asked for: pytest
loads the plugin at its start, and is not to wait for a vehicle that nobody wants.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mavsitl.testing.checks import FlightAssertionError, FlightCheck, assert_flight
    from mavsitl.testing.connection import Connection
    from mavsitl.testing.faults import Fault, FaultError, Faults
    from mavsitl.testing.flight import Flight
    from mavsitl.testing.lockstep import Stream, Vehicle
    from mavsitl.testing.realtime import RunningVehicle, vehicle
    from mavsitl.testing.results import Failsafe, State, Status, Text, Track

_WHERE = {
    "checks": ("FlightAssertionError", "FlightCheck", "assert_flight"),
    "connection": ("Connection",),
    "faults": ("Fault", "FaultError", "Faults"),
    "flight": ("Flight",),
    "lockstep": ("Stream", "Vehicle"),
    "realtime": ("RunningVehicle", "vehicle"),
    "results": ("Failsafe", "State", "Status", "Text", "Track"),
}
_MODULES = {name: module for module, names in _WHERE.items() for name in names}

__all__ = [
    "Connection",
    "Failsafe",
    "Fault",
    "FaultError",
    "Faults",
    "Flight",
    "FlightAssertionError",
    "FlightCheck",
    "RunningVehicle",
    "State",
    "Status",
    "Stream",
    "Text",
    "Track",
    "Vehicle",
    "assert_flight",
    "vehicle",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
