"""A controller of the user's flies as the paper's does: what it is told, what its demands do, what its failures do."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_ground.sequence import Handshake, Phase

from mavsitl import controllers, ends
from mavsitl.controllers import AttitudeDemand, PositionDemand, RateDemand, Reference, State
from mavsitl.log import topics
from mavsitl.log.ulog import read
from mavsitl.quaternion import rotate
from mavsitl.scenario import Flight, load
from tests.drivers.exercise import Flown, fly_in_memory

Floats = st.floats(-50.0, 50.0)


class Base:
    """Holds the reference by attitude."""

    seen: list[tuple[float, State, Reference]]
    """Of the newest flight."""

    def __init__(self, airframe: Any) -> None:
        self.airframe = airframe
        type(self).seen = []

    def attitude(self, state: State, reference: Reference) -> AttitudeDemand:
        wanted = 9.0 * (reference.position - state.position) + 5.0 * (reference.velocity - state.velocity)
        wanted = wanted + reference.acceleration + (0.0, 0.0, self.airframe.gravity_m_s2)
        return AttitudeDemand.along(self.airframe.mass_kg * wanted, reference.yaw)

    def update(self, time_s: float, state: State, reference: Reference) -> Any:
        self.seen.append((time_s, state, reference))
        return self.attitude(state, reference)


class ByAttitude(Base):
    def log(self) -> Sequence[float]:
        return 1.5, -2.5


class ByRates(Base):
    def update(self, time_s: float, state: State, reference: Reference) -> RateDemand:
        wanted = self.attitude(state, reference)
        w, x, y, z = wanted.quaternion
        error = np.array(rotate((w, x, y, z), (0.0, 0.0, 1.0)))
        tilt = state.rotation.T @ np.cross(state.rotation[:, 2], error)
        return RateDemand(10.0 * tilt, wanted.thrust, wanted.quaternion)


class ByPosition(Base):
    def update(self, time_s: float, state: State, reference: Reference) -> PositionDemand:
        return PositionDemand(reference.position, reference.velocity, reference.acceleration, reference.yaw)


class Counts(Base):
    resets = 0

    def reset(self) -> None:
        type(self).resets += 1


class Breaks(Base):
    answer: Any = None

    def update(self, time_s: float, state: State, reference: Reference) -> Any:
        self.seen.append((time_s, state, reference))
        if time_s < 0.5:
            return self.attitude(state, reference)
        if self.answer is None:
            raise RuntimeError("out of ideas")
        return self.answer


def flight(controller: type[Base], name: str = "spiral-calm", duration_s: float = 3.0, **overrides: Any) -> Flight:
    return load(name, {"duration_s": duration_s, "controller.own": f"{__name__}:{controller.__name__}", **overrides})


def error_m(flown: Flown) -> float:
    """At the end: the path begins a metre from the start."""
    return float(np.linalg.norm(flown.data.position_error_nwu_m()[-1]))


@pytest.mark.parametrize("controller", [ByAttitude, ByRates, ByPosition])
def test_each_demand_follows_the_reference(controller: type[Base]) -> None:
    flown = fly_in_memory(flight(controller, duration_s=6.0))
    assert flown.phase == "DONE"
    assert error_m(flown) < 0.2


@pytest.mark.parametrize("link", [{}, {"link.to_ground.loss": 0.2, "link.to_vehicle.loss": 0.2}])
def test_on_any_link_and_by_either_telemetry(link: dict[str, Any]) -> None:
    flown = fly_in_memory(flight(ByAttitude, **{**link, "controller.telemetry": "split"}))
    assert flown.phase == "DONE"


def test_what_it_is_told() -> None:
    flown = fly_in_memory(flight(ByAttitude, "spiral-calm"))
    time_s, state, reference = ByAttitude.seen[500]
    assert time_s == pytest.approx(2.0, abs=0.01)
    index = int(np.searchsorted(flown.data.time_s, time_s - 1e-9))
    assert state.position == pytest.approx(flown.data.position_nwu_m[index], abs=0.05)
    assert state.velocity == pytest.approx(flown.data.velocity_nwu_m_s[index], abs=0.05)
    assert reference.position == pytest.approx(flown.data.position_reference_nwu_m[index], abs=1e-6)
    assert np.degrees(state.angles) == pytest.approx(flown.data.attitude_deg[index], abs=0.2)
    assert state.rotation @ (0.0, 0.0, 1.0) == pytest.approx(rotate(tuple(state.quaternion), (0.0, 0.0, 1.0)))
    assert state.age_s == 0.0
    for vector in (state.position, state.quaternion, reference.acceleration):
        with pytest.raises(ValueError, match="read-only"):
            vector[0] = 1.0


def test_the_log_has_what_the_papers_controller_logs_and_its_own(tmp_path: Path) -> None:
    ends.in_memory(flight(ByAttitude), tmp_path, report=lambda text: None, progress=None)
    tables = read(tmp_path / "ground.ulg")
    assert topics.CONTROL_DEMAND.name not in tables
    own = tables[topics.OWN_CONTROLLER.name]["value"]
    assert own[10][:2].tolist() == [1.5, -2.5]
    assert np.isnan(own[10][2:]).all()
    assert len(own) == len(tables[topics.ATTITUDE_SETPOINT.name]["roll_body"])
    assert np.isfinite(tables[topics.ATTITUDE_SETPOINT.name]["roll_body"]).all()


def test_it_is_reset_once_before_it_flies_and_not_at_every_idle_period() -> None:
    Counts.resets = 0
    fly_in_memory(flight(Counts))
    assert Counts.resets == 0  # it is new
    fly_in_memory(
        flight(
            Counts,
            "takeoff-hover",
            6.0,
            **{"link.to_vehicle.outages": [{"start_s": 2.0, "duration_s": 1.5}], "parameters": {"COM_OF_LOSS_T": 0.5}},
        )
    )
    assert Counts.resets <= 2


BAD: dict[str, tuple[Any, str]] = {
    "an exception": (None, "RuntimeError: out of ideas (test_seat.py, line "),
    "NaN": (AttitudeDemand((1.0, 0.0, 0.0, float("nan")), 7.0), "not finite"),
    "no unit quaternion": (AttitudeDemand((2.0, 0.0, 0.0, 0.0), 7.0), "of length 2; needed: 1"),
    "a thrust that is none": (AttitudeDemand((1.0, 0.0, 0.0, 0.0), float("inf")), "thrust is (inf,): not finite"),
    "another type": ((1.0, 2.0), "update gave tuple; needed: AttitudeDemand, RateDemand or PositionDemand"),
    "two rates": (RateDemand((1.0, 2.0), 7.0), "omega has 2 numbers; needed: 3"),
    "words": (RateDemand("fast", 7.0), "omega is 'fast'; needed: 3 numbers"),  # type: ignore[arg-type]
    "no position": (PositionDemand(), "asks for nothing"),
}


@pytest.mark.parametrize(("answer", "said"), BAD.values(), ids=BAD.keys())
@pytest.mark.parametrize("name", ["takeoff-hover", "hover-calm"])
def test_a_failure_is_told_once_and_the_vehicle_lands(
    monkeypatch: pytest.MonkeyPatch, name: str, answer: Any, said: str
) -> None:
    monkeypatch.setattr(Breaks, "answer", answer)
    told: list[str] = []
    outcome = ends.in_memory(flight(Breaks, name, 5.0), None, report=told.append, progress=None)
    assert said in outcome.lost
    assert not outcome.finished
    assert outcome.simulated_s < 20.0, "landed, not waited for"
    assert len([text for text in told if said in text]) == 1
    assert len([each for each in Breaks.seen if each[0] >= 0.5]) == 1, "it is not asked again"


def test_a_controller_that_fails_on_the_ground_is_not_flown() -> None:
    """In its reset, say, before another flight."""
    handshake = Handshake(lambda *command: None, [], land=True, report=lambda text: None)
    handshake.fail("broken", 0)
    handshake.step(1000)
    assert handshake.phase is Phase.LOST
    assert handshake.lost == "broken"


@given(force=st.tuples(Floats, Floats, Floats), yaw=st.floats(-10.0, 10.0))
def test_along_points_the_thrust_and_the_nose(force: tuple[float, float, float], yaw: float) -> None:
    demand = AttitudeDemand.along(force, yaw)
    w, x, y, z = demand.quaternion
    assert w * w + x * x + y * y + z * z == pytest.approx(1.0)
    assert demand.thrust == pytest.approx(float(np.linalg.norm(force)))
    heading = np.array((np.cos(yaw), np.sin(yaw), 0.0))
    if demand.thrust > 1e-3 and np.linalg.norm(np.cross(force, heading)) > 1e-3 * demand.thrust:
        up, nose = (np.array(rotate((w, x, y, z), axis)) for axis in ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)))
        assert up * demand.thrust == pytest.approx(np.array(force), abs=1e-6 * max(demand.thrust, 1.0))
        assert nose @ np.cross(force, heading) / demand.thrust == pytest.approx(0.0, abs=1e-6)
        assert nose @ heading >= -1e-9


def test_the_shipped_are_deterministic() -> None:
    flown = [
        ends.in_memory(
            load("hover-wind", {"duration_s": 1.0, **controllers.settings(name)}), None,
            report=lambda text: None, progress=None,
        ).wire_hash
        for name in ("indi", "indi", "geometric")
    ]  # fmt: skip
    assert flown[0] == flown[1] != flown[2]
