"""One case to one row: flown in memory, measured as it flies, and whatever goes wrong is a row too."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from math import hypot, inf
from pathlib import Path
from typing import Literal, TypeAlias, TypeVar

import msgspec

from mavsitl import controllers, drivers, ends, wings
from mavsitl.campaign.grid import Case, Labels, source_digest
from mavsitl.campaign.sums import LOST_M, Six, Sums
from mavsitl.clock import processor_s
from mavsitl.drivers import Tap
from mavsitl.report.metrics import Rmse
from mavsitl.report.run import scenario_digest
from mavsitl.scenario import Flight

GRACE_S = 120.0
"""Simulated time beside the flight itself: handshake, take-off, landing."""

Status: TypeAlias = Literal["flown", "lost", "failed"]


class Row(msgspec.Struct, frozen=True):
    """How one flight went. Errors are the truth's: x, y, z in m (NWU), phi, theta, psi in degrees, from the release."""

    key: str
    scenario: str
    seed: int
    status: Status
    """``lost``: too far from its reference, or on the ground; ``failed``: an error, or an end that was not planned."""
    time_s: float
    """Flight time at the end, or when it was lost."""
    rmse: Six | None = None
    """Only of a flight that was flown to its end."""
    largest: Six | None = None
    """Largest absolute errors, of a lost flight up to its loss."""
    weight_range: tuple[float, float] = (1.0, 1.0)
    """Least and largest output weight of the PIDNNs, in multiples of its initial value."""
    message: str = ""
    """What went wrong."""
    left_offboard: int = 0
    """Times that the vehicle was in another mode than OFFBOARD during the flight."""
    effort_rad_s: float | None = None
    """What the rotors did for it: RMS of their speeds about each one's mean. None where none was logged."""
    settling_s: float | None = None
    """Mean time from each of `sums.events` until the vehicle stays within `sums.SETTLED_M`; None without an event."""
    labels: Labels = {}
    """The case's."""
    scenario_digest: str = ""
    """As in `run.json` of `mavsitl fly`."""
    wire_hash: str = ""
    """Of all bytes that crossed the wire, as `mavsitl fly` prints it, of a lost flight up to its end; empty where the
    worker was lost."""
    code: str = ""
    """`grid.source_digest` of what flew it."""
    cpu_s: float = 0.0
    """The processor's time that it took: no measure of the flight, and not the same twice."""

    @property
    def flown(self) -> bool:
        return self.status == "flown"

    @property
    def repeatable(self) -> bool:
        """It would end so again; one that took its worker with it may not."""
        return self.wire_hash != ""

    @property
    def states(self) -> Rmse:
        """Raises ValueError for a flight that was not flown."""
        if self.rmse is None:
            raise ValueError(f"{self.scenario}, seed {self.seed}: {self.status} at {self.time_s:g} s")
        return Rmse(*self.rmse)

    @property
    def position_m(self) -> float:
        """RMS distance from the reference; infinite for a flight that was not flown to its end."""
        return inf if self.rmse is None else hypot(*self.rmse[:3])

    @property
    def attitude_deg(self) -> float:
        """RMS error of the three angles together; infinite for a flight that was not flown to its end."""
        return inf if self.rmse is None else hypot(*self.rmse[3:])


class _LostError(RuntimeError):
    """The vehicle is too far from its reference: no use in flying on."""


def fly(case: Case) -> Row:
    """Fly one case in this process. Whatever goes wrong in the flight is its row, not an exception."""
    started_s = processor_s()
    sums = Sums(case.flight)

    def watch(now_us: int) -> None:
        sums.collect()
        if sums.lost_s is not None:
            raise _LostError

    tap = Tap(record=watch)

    def row(status: Status, message: str = "") -> Row:
        return Row(
            key=case.key, scenario=case.flight.name, seed=case.seed, status=status,
            time_s=sums.time_s if sums.lost_s is None else sums.lost_s,
            rmse=sums.rmse if status == "flown" else None, largest=sums.largest, weight_range=sums.weight_range,
            message=message, left_offboard=sums.left_offboard, effort_rad_s=sums.effort_rad_s,
            settling_s=sums.settling_s, labels=case.labels,
            scenario_digest=scenario_digest(case.flight), wire_hash=tap.wire.hexdigest(), code=source_digest(),
            cpu_s=processor_s() - started_s,
        )  # fmt: skip

    said: list[str] = []
    with ExitStack() as stack:
        try:
            own = case.flight.scenario.controller.own
            if own and controllers.source_digest(own) != case.controller:
                return not_flown(case, f"{own}: has changed since this flight was asked for")
            flight = stack.enter_context(_with_waypoints(case))
            vehicle = wings.find(wings.VEHICLE_GROUP)(flight, sums.vehicle, seed=case.seed, lockstep=True)
            ground = wings.find(wings.GROUND_GROUP)(flight, sums.ground, report=said.append)
            channels = ends.lockstep_channels(flight)
            if channels is not None:
                ends.change_by_parameters(vehicle, channels)
            limit_s = flight.scenario.duration_s + GRACE_S
            drivers.fly_in_memory(vehicle, ground, tap, max_time_s=limit_s, channels=channels)
            sums.collect()
        except _LostError:
            pass
        except Exception as error:  # a campaign goes on without this flight, and says so
            return row("failed", f"{type(error).__name__}: {error}")
    if sums.lost_s is not None:
        return row("lost", f"more than {LOST_M:g} m from its reference at {sums.lost_s:g} s")
    if ground.lost:
        return row("lost", ground.lost)
    if not ground.succeeded or not sums.samples:
        return row("failed", f"{ground.phase}: {said[-1] if said else 'nothing was said'}")
    return row("flown")


def not_flown(case: Case, message: str) -> Row:
    """The row of a case that took its worker with it."""
    return Row(
        case.key, case.flight.name, case.seed, "failed", 0.0, message=message, labels=case.labels,
        scenario_digest=scenario_digest(case.flight), code=source_digest(),
    )  # fmt: skip


@contextmanager
def _with_waypoints(case: Case) -> Iterator[Flight]:
    """The flight, with its file of waypoints where this machine has it."""
    if case.waypoints is None:
        yield case.flight
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "waypoints.csv"
        file.write_bytes(case.waypoints)
        scenario = case.flight.scenario
        reference = msgspec.structs.replace(scenario.reference, file=str(file))
        scenario = msgspec.structs.replace(scenario, reference=reference)
        yield msgspec.structs.replace(case.flight, scenario=scenario)


T = TypeVar("T", Case, Row)


def encode(what: Case | Row) -> bytes:
    """For another process or machine: data, no code."""
    return msgspec.msgpack.encode(what)


def decode(data: bytes, kind: type[T]) -> T:
    return msgspec.msgpack.decode(data, type=kind)


def fly_encoded(data: bytes) -> bytes:
    """`fly` for another process or machine."""
    return encode(fly(decode(data, Case)))
