"""The compiled ground on the same random inputs: ``python -m tests.ground.exercise`` prints the outputs' digests."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from typing import Any

import numpy as np
from mavsitl_ground import cycle, observer
from mavsitl_ground.controller import Controller
from mavsitl_ground.observer import Observer
from mavsitl_ground.reference import reference_for

from mavsitl.codec import Frame, Message, encode, parse
from mavsitl.control import rotation
from mavsitl.control.arrays import Floats
from mavsitl.scenario import Figure8, Flight, Reference, Spiral, Step, Steps, load

CALLS = 60
PERIOD_US = 4000

VARIANTS: dict[str, dict[str, Any]] = {
    "body_rate pidnn": {},
    "body_rate pid, oracle": {"law": "pid", "wind_information": "oracle"},
    "torque pidnn, difference": {"level": "torque", "derivative": "difference"},
    "torque pid, no wind": {"level": "torque", "law": "pid", "wind_information": "none"},
    "attitude": {"level": "attitude"},
    "attitude, pidnn aboard, no filter": {"level": "attitude", "inner": "pidnn", "angle_filter_rad_s": 0.0},
}
"""Settings of the scenario's controller; together every branch of `mavsitl_ground.cycle`."""

PATHS: dict[str, Reference] = {
    "spiral": Spiral(),
    "figure-8": Figure8(),
    "steps": Steps((Step(0.0, (0.0, 0.0, 1.0)), Step(0.1, (1.0, 0.5, 2.0), 45.0))),
}


def framed(message: Message) -> Frame:
    """The message as it comes from the wire, where its floats have 32 bits."""
    [frame] = parse(encode(message, 0, 1, 1))
    return frame


def flight(variant: str) -> Flight:
    """A spiral in wind with realistic rotors, flown by that variant of the controller."""
    settings = {f"controller.{name}": value for name, value in VARIANTS[variant].items()}
    return load("spiral-wind", {"airframe": "realistic", **settings})


def telemetry(rng: np.random.Generator) -> Iterator[tuple[int, Any]]:
    """Stamps and what `observer.take_odometry` takes before its flags: float32 values, NED and FRD."""
    for k in range(CALLS):
        q = rng.normal(size=4) * (1.0, 0.2, 0.2, 0.2)
        values = np.concatenate((rng.normal(size=3), q / np.sqrt(q @ q), rng.normal(size=6))).astype(np.float32)
        yield k * PERIOD_US, tuple(values.astype(np.float64).tolist())


def take(values: Any, in_body: bool, into: Observer) -> bool:
    arguments: list[Any] = [*values, in_body, True, into.state]
    good: bool = observer.take_odometry(*arguments)
    return good


def states(rng: np.random.Generator) -> Iterator[Observer]:
    """The same as states, with a true wind from the second on."""
    seen = Observer()
    for stamp_us, values in telemetry(rng):
        assert take(values, False, seen)
        seen.stamp_us = stamp_us
        yield seen
        seen.state["true_wind"][0, :, 0] = rng.normal(size=3)


def flatten(demand: cycle.Demand) -> Floats:
    return np.array([*demand[0], *demand[1:]])


def digests() -> dict[str, str]:
    """A digest of every output, by its name."""
    rng = np.random.default_rng(4)
    found: dict[str, str] = {}

    def add(name: str, *arrays: Any) -> None:
        digest = hashlib.blake2b(bytes.fromhex(found.get(name, "")), digest_size=8)
        for array in arrays:
            digest.update(np.ascontiguousarray(array, dtype=np.float64).tobytes())
        found[name] = digest.hexdigest()

    for name in VARIANTS:
        controller, row = Controller(flight(name)), np.zeros(cycle.COLUMNS)
        for state in states(rng):
            add(name, flatten(controller.update(state.stamp_us / 1e6, state, row, 1, 2, 3, 4)), row)
    for name, reference in PATHS.items():
        path = reference_for(reference)
        for time_s in (-1.0, *rng.uniform(0.0, 20.0, 20).tolist()):
            add(name, *path.sample(time_s))
    seen = Observer()
    for _, values in telemetry(rng):
        x, y, z, *q, vx, vy, vz, w_x, w_y, w_z = values
        for in_body in (False, True):
            good = take(values, in_body, seen)
            add("odometry", good, *(seen.state[name] for name in ("position", "velocity", "quaternion", "angle_rates")))
        good = observer.take_attitude(tuple(q), w_x, w_y, w_z, True, seen.state)
        good = good and observer.take_linear(x, y, z, vx, vy, vz, True, seen.state)
        add("split", good, *(seen.state[name] for name in ("position", "velocity", "quaternion", "angles", "omega")))
        add("norm", rotation.norm(*q))
    return found


if __name__ == "__main__":
    print(json.dumps(digests()))
