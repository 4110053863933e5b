"""The compiled controller: the same bits un-jitted, and the same bits as its laws put together by hand."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from math import acos, cos, exp, hypot, nan, pi, radians, sin, sqrt
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsitl_ground import cycle
from mavsitl_ground.controller import Controller
from mavsitl_ground.observer import Observer
from mavsitl_ground.reference import reference_for

from mavsitl.compiled import JIT
from mavsitl.control import rotation
from mavsitl.control.arrays import Floats, record
from mavsitl.control.filters import FirstOrder
from mavsitl.control.inner_loop import InnerLoop
from mavsitl.control.pid import PositionLoop
from mavsitl.control.wind_observer import WindObserver, model_acceleration
from mavsitl.frames import flip_quaternion, flip_vector
from mavsitl.quaternion import from_euler
from mavsitl.scenario import Flight, load
from tests.ground.exercise import VARIANTS, digests, flatten, flight, states

FLOATS = st.floats(-1.0, 1.0, width=32)


def test_the_plain_text_gives_the_same_bits_as_the_compiled_one() -> None:
    other = subprocess.run(
        [sys.executable, "-m", "tests.ground.exercise"],
        env={**os.environ, "MAVSITL_JIT": "0" if JIT else "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert digests() == json.loads(other.stdout)


class ByHand:
    """Fig 3 out of the classes of `mavsitl.control`, one call after another."""

    def __init__(self, flight: Flight) -> None:
        scenario, airframe = flight.scenario, flight.airframe
        self.settings, self.airframe = scenario.controller, airframe
        self.period_s = scenario.rates.control_period_us / 1e6
        self.path = reference_for(scenario.reference)
        self.outer = PositionLoop(
            self.settings.altitude, self.settings.position, airframe.mass_kg, airframe.gravity_m_s2,
            radians(self.settings.tilt_limit_deg), airframe.max_thrust_n, self.period_s,
        )  # fmt: skip
        self.filter = FirstOrder(self.settings.angle_filter_rad_s, self.period_s)
        self.inner = InnerLoop(self.settings, airframe, self.period_s)
        observer = self.settings.wind_observer
        self.observer = WindObserver(observer.horizontal_rad_s, observer.vertical_rad_s)
        self.thrust_n = self.acting_n = airframe.weight_n
        self.parameters = airframe.parameters | scenario.parameters

    def wind(self, state: Observer) -> Any:
        airframe = self.airframe
        share = 1.0 - exp(-self.period_s / airframe.rotor_time_constant_s)
        self.acting_n += share * (self.thrust_n - self.acting_n)
        if self.settings.wind_information == "observer":
            model = model_acceleration(
                state.quaternion, np.array([self.acting_n]), airframe.mass_kg, airframe.gravity_m_s2, np.zeros((3, 1))
            )
            return self.observer.update(state.velocity_nwu_m_s, model, self.period_s)
        if self.settings.wind_information == "none" or np.isnan(state.true_wind_nwu_m_s).any():
            return np.zeros((3, 1))
        area = np.pi * airframe.rotor_radius_m**2
        coupling = airframe.wind_coupling * sqrt(8.0 * airframe.air_density_kg_m3 * area) / airframe.mass_kg
        return np.multiply(coupling * sqrt(self.acting_n), state.true_wind_nwu_m_s)

    def update(self, time_s: float, state: Observer) -> tuple[list[float], list[float]]:
        """The demand as `flatten` has it, and the log's row without the link's columns and the weights."""
        settings, level = self.settings, self.settings.level
        position, velocity, acceleration, yaw = self.path.sample(time_s)
        x_d, v_d, a_d = (np.array(vector)[:, np.newaxis] for vector in (position, velocity, acceleration))
        whole = level == "attitude" and settings.inner == "stock"
        wind = self.wind(state)
        flown_at = np.array([yaw]) if whole else state.angles_rad[2]
        thrust, phi, theta = self.outer.update(
            state.position_nwu_m, state.velocity_nwu_m_s, state.quaternion, x_d, v_d, a_d, flown_at, wind
        )
        self.thrust_n = float(thrust[0])
        tilt = self.filter.update(np.stack((phi, theta)))
        desired = np.array([*tilt[:, 0], yaw])[:, np.newaxis]
        rates = np.array([*self.filter.rate[:, 0], 0.0])[:, np.newaxis]
        share = self.thrust_n / self.airframe.max_thrust_n
        wanted = np.zeros((3, 1))
        if level == "attitude":
            lead_s = 0.0 if settings.inner == "pidnn" else 1.0 / self.parameters["MC_ROLL_P"]
            q = from_euler(*(desired + lead_s * rates)[:, 0].tolist())
            demand = [*flip_quaternion(*q), 0.0, 0.0, 0.0, share]
        else:
            wanted = self.inner.update(state.angles_rad, state.angle_rates_rad_s, desired, rates)
            out = self.inner.torque_shares(wanted) if level == "torque" else self._rates(wanted, state)
            demand = [1.0, 0.0, 0.0, 0.0, *flip_vector(*out[:, 0].tolist()), share]
        wire = [flip_vector(*vector) for vector in (position, velocity, desired[:, 0].tolist())]
        row = [*wire[0], *wire[1], -yaw, *wire[2], 0.0, 0.0, -share, self.thrust_n, *wanted[:, 0], *wind[:, 0]]
        return demand, row

    def _rates(self, wanted: Floats, state: Observer) -> Floats:
        gains = [
            self.parameters[f"MC_{axis}RATE_P"] * torque / inertia
            for axis, torque, inertia in zip(
                ("ROLL", "PITCH", "YAW"), self.airframe.max_torque_n_m, self.airframe.inertia_kg_m2, strict=True
            )
        ]
        rates: Floats = state.omega_flu_rad_s + wanted / np.array(gains)[:, np.newaxis]
        return rates


@pytest.mark.parametrize("variant", VARIANTS)
def test_it_is_its_laws_in_their_order(variant: str) -> None:
    rng = np.random.default_rng(11)
    controller, by_hand, row = Controller(flight(variant)), ByHand(flight(variant)), np.zeros(cycle.COLUMNS)
    for state in states(rng):
        time_s = state.stamp_us / 1e6
        demand, logged = by_hand.update(time_s, state)
        assert flatten(controller.update(time_s, state, row, 5, 6, 7, 8)).tolist() == demand
        assert row[: cycle.LINK].tolist() == [float(value) for value in logged]
        assert row[cycle.LINK : cycle.WEIGHTS].tolist() == [5.0, 6.0, 7.0, 8.0]
        weights = by_hand.inner.weights
        if controller.learns:
            assert weights is not None
            assert row[cycle.WEIGHTS :].tolist() == weights[:, :, 0].T.ravel().tolist()


def test_after_a_reset_it_is_as_new() -> None:
    controller, row = Controller(flight("body_rate pidnn")), np.zeros(cycle.COLUMNS)

    def flown() -> list[list[float]]:
        made = states(np.random.default_rng(3))
        return [flatten(controller.update(s.stamp_us / 1e6, s, row, 0, 0, 0, 0)).tolist() for s in made]

    first = flown()
    assert flown() != first
    controller.reset()
    assert flown() == first


def at_rest(**settings: Any) -> tuple[Controller, Observer]:
    """A controller of a calm hover at (0, 0, 1), and the state there."""
    controller = Controller(load("hover-calm", {f"controller.{name}": value for name, value in settings.items()}))
    state = Observer()
    state.state["position"][0, 2] = 1.0
    return controller, state


def test_attitude_in_the_wire_s_terms() -> None:
    flight = load("hover-calm", {"controller.level": "attitude", "reference.yaw_deg": 90.0})
    controller, state = Controller(flight), Observer()
    state.state["position"][0, 2] = 1.0
    (w, x, y, z), *rates, thrust = controller.update(0.0, state, np.zeros(cycle.COLUMNS), 0, 0, 0, 0)
    # To the left is a positive yaw about z up, a negative one about z down.
    assert (w, x, y, z) == pytest.approx((cos(pi / 4), 0.0, 0.0, -sin(pi / 4)))
    assert rates == [0.0, 0.0, 0.0]
    assert thrust == pytest.approx(1.0 / flight.airframe.thrust_to_weight)


def test_a_place_to_the_left_of_it_is_flown_to_by_a_roll_to_the_left() -> None:
    """Left is +y of NWU: the left side goes down, a negative roll in FLU and in FRD alike."""
    controller, state = at_rest(level="attitude")
    state.state["position"][0, 1] = -1.0
    for _ in range(100):
        (w, x, y, z), *_ = controller.update(0.0, state, np.zeros(cycle.COLUMNS), 0, 0, 0, 0)
    assert x < -0.1
    assert (y, z) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert acos(w) < radians(50.0)


@pytest.mark.parametrize("level", ["body_rate", "torque"])
def test_a_turn_is_stopped_about_each_axis(level: str) -> None:
    """Rates to the right, up and left (FLU +x, -y, +z), all unwanted: what is asked for turns back."""
    controller, state = at_rest(level=level)
    omega = np.array([[0.3], [-0.2], [0.1]])
    state.state["omega"], state.state["angle_rates"] = omega, omega
    _, *about, _ = controller.update(0.0, state, np.zeros(cycle.COLUMNS), 0, 0, 0, 0)
    sign = np.sign(about)
    assert sign.tolist() == [-1.0, -1.0, 1.0]  # FRD: x as in FLU, y and z the other way


@given(w=st.floats(0.5, 1.0, width=32), x=FLOATS, y=FLOATS, z=FLOATS)
def test_the_norm_is_hypot(w: float, x: float, y: float, z: float) -> None:
    assert rotation.norm(w, x, y, z) == hypot(w, x, y, z)


def test_a_record_holds_copies_under_names() -> None:
    values = np.arange(6.0).reshape(3, 2)
    inner = record(flag=True, count=3)
    made = record(values=values, inner=inner, number=0.5)
    values[:], inner["count"] = nan, 9
    own = made[0]
    assert own["values"].tolist() == [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]
    assert (bool(own["inner"]["flag"]), int(own["inner"]["count"]), float(own["number"])) == (True, 3, 0.5)
    own["values"][1, 0] = 8.0
    own["inner"]["count"] = 4
    assert made["values"][0, 1, 0] == 8.0
    assert made["inner"]["count"][0] == 4
    assert record(number=1.0).dtype is record(number=2.0).dtype
