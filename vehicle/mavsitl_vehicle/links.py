"""What is wrong with the vehicle's links on command: parameters and failures in, settings for the channels out.

The vehicle core moves no datagram. Whoever does, subscribes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from typing import TypeAlias

from mavsitl.link.settings import DIRECTION, KEYS, PREFIXES, LinkName, Overlay, initial
from mavsitl.scenario import LinkModel, Scenario, ScenarioError
from mavsitl_vehicle.autopilot.parameters import TABLE, Parameters
from mavsitl_vehicle.failures import Change, Failures, Kind, Unit

Listener: TypeAlias = Callable[[LinkName, Overlay], None]

NAMES: Mapping[LinkName, Mapping[str, str]] = {
    link: {key: f"{prefix}{key}" for key in (*KEYS, DIRECTION)} for link, prefix in PREFIXES.items()
}
"""The parameter of each setting."""

INSTANCES: Mapping[LinkName, int] = {"link": 1, "gcs_link": 2}
"""Of the failure unit MAVLINK."""

FAILURES: Mapping[Kind, Mapping[str, float]] = {
    Kind.GARBAGE: {"CORR": 0.2},
    Kind.SLOW: {"BW": 57.6},
    Kind.DELAYED: {"LAT": 500.0},
    Kind.INTERMITTENT: {"BURST": 500.0, "GOOD": 2000.0},
}
"""Settings of a link that has this failure, over the parameters', both ways. The ports make `OFF` and `STUCK`."""

PERFECT = (
    "the lock-step exchange of this flight has a perfect link; give the scenario a [link], or link.live = true, "
    "or link.changes"
)
NO_GCS = "there is no ground-station link in lock-step"


def initial_links(scenario: Scenario) -> dict[LinkName, dict[str, float]]:
    """What the parameters of each link begin with, by the scenario's section; within the parameters' limits."""
    models: dict[LinkName, LinkModel] = {"link": scenario.link, "gcs_link": scenario.gcs_link}
    return {link: dict(_parameters(link, model)) for link, model in models.items()}


def _parameters(link: LinkName, model: LinkModel) -> Iterator[tuple[str, float]]:
    for key, value in initial(model).items():
        row = TABLE[NAMES[link][key]]
        yield row.name, min(max(value, row.minimum), row.maximum)


class LinkControl:
    """The links' parameters and failures as overlays over the scenario's links."""

    def __init__(self, parameters: Parameters, failures: Failures, scenario: Scenario, *, lockstep: bool) -> None:
        """In `lockstep` the parameters of links that cannot change are locked.

        Raises `ScenarioError` where the scenario itself sets one of those of the off-board link.
        """
        self._parameters = parameters
        self._initial = initial_links(scenario)
        self._failures = failures
        self._listeners: list[Listener] = []
        self._told: dict[LinkName, Overlay] = {}
        if lockstep:
            parameters.lock(self._initial["gcs_link"], NO_GCS)
            if not scenario.impaired:
                for name in self.overlay("link").values:
                    raise ScenarioError(f"parameters.{NAMES['link'][name]}: {PERFECT}")
                parameters.lock(self._initial["link"], PERFECT)
        parameters.subscribe(self._on_parameter)
        failures.subscribe(self._on_failure)

    def overlay(self, link: LinkName) -> Overlay:
        """The parameters that are not as in the scenario, and the failure's settings over them."""
        names, begun = NAMES[link], self._initial[link]
        now = {key: self._parameters[names[key]] for key in KEYS}
        values = {key: value for key, value in now.items() if _single(value) != _single(begun[names[key]])}
        failure = FAILURES.get(self._failures.of(Unit.MAVLINK, INSTANCES[link]), {})
        return Overlay(values, int(self._parameters[names[DIRECTION]]), failure)

    def subscribe(self, listener: Listener) -> None:
        """Hear of every link now, and then of each that changes."""
        self._listeners.append(listener)
        for link in NAMES:
            listener(link, self.overlay(link))

    def _on_parameter(self, name: str, value: float) -> None:
        for link, names in self._initial.items():
            if name in names:
                self._tell(link)

    def _on_failure(self, change: Change) -> None:
        if change.unit is Unit.MAVLINK:
            for link, instance in INSTANCES.items():
                if instance == change.instance:
                    self._tell(link)

    def _tell(self, link: LinkName) -> None:
        overlay = self.overlay(link)
        if self._told.get(link) == overlay:
            return
        self._told[link] = overlay
        for listener in self._listeners:
            listener(link, overlay)


def _single(value: float) -> bytes:
    """A parameter is what the wire carries."""
    return struct.pack("<f", value)
