"""The lock-step benchmark's rivals do what its table says of them."""

from __future__ import annotations

from math import isfinite
from pathlib import Path

import numpy as np
import pytest
from mavsitl_vehicle.plant.rotor import rotor_in_wind
from mavsitl_vehicle.wind import dryden

from mavsitl import scenario
from mavsitl.control.pidnn import Pidnn
from mavsitl.scenario import DrydenPaper
from tests.bench import bench_lockstep
from tests.bench.rivals import exchange, full

FLIGHT = scenario.load(bench_lockstep.SCENARIO)


@pytest.mark.sockets
def test_the_c_program_exchanges_our_datagrams_and_hovers(tmp_path: Path) -> None:
    program = exchange.build(tmp_path)
    if program is None:
        pytest.skip("no C compiler")
    bench_lockstep.check_bytes(program)
    bench_lockstep.fly_c(program, 20.0)


@pytest.mark.sockets
@pytest.mark.parametrize("name", bench_lockstep.PYTHON_RIVALS)
def test_the_rivals_in_python_hover(name: str) -> None:
    assert isfinite(bench_lockstep.fly_python(name, 0.5))


def test_numpys_pidnn_learns_as_ours() -> None:
    settings, period_s = FLIGHT.scenario.controller, full.TICK_S
    limit = np.array(FLIGHT.airframe.max_torque_n_m) / np.array(FLIGHT.airframe.inertia_kg_m2)
    ours = Pidnn(settings.roll_pitch, settings.yaw, settings.learning, period_s, "rate", tuple(limit))
    its = full.Pidnn(FLIGHT, limit)
    rng = np.random.default_rng(1)
    for _ in range(500):
        angles, rates, desired, desired_rates = 0.05 * rng.standard_normal((4, 3))
        ours.update(*(each[:, np.newaxis] for each in (angles, rates, desired, desired_rates)))
        its.update(angles, rates, desired, desired_rates)
        np.testing.assert_allclose(its.weights, ours.weights[..., 0].T, rtol=1e-9)


def test_numpys_wind_has_the_deviation_of_ours() -> None:
    (wind,) = FLIGHT.scenario.wind
    assert isinstance(wind, DrydenPaper)
    its = full.Dryden(wind, 0.001, np.random.default_rng(1))
    expected = [dryden.sigma_m_s(each) for each in dryden.shaping_filters(dryden.paper_scales(wind), False, True)]
    stationary = its.gain * its.noise / np.sqrt(1.0 - its.decay**2)
    np.testing.assert_allclose(stationary, expected, rtol=1e-9)


def test_numpys_rotors_act_as_ours() -> None:
    """Hovering level in a vertical wind: the vertical force of four rotors (eqs 1-5)."""
    plant, airframe = full.Plant(FLIGHT), FLIGHT.airframe
    up_m_s = 2.0
    two_rho_a = plant.two_rho_a
    thrust, _, force, _ = rotor_in_wind(
        float(plant.x[13]), up_m_s, plant.b, np.sqrt(plant.b / two_rho_a), plant.d, airframe.wind_coupling,
        airframe.wind_coupling * two_rho_a, plant.d * two_rho_a / plant.b,
    )  # fmt: skip
    derivative = plant.derivative(plant.x, plant.x[13:], np.array([0.0, 0.0, -up_m_s]))
    expected = airframe.gravity_m_s2 - 4.0 * (thrust + force * up_m_s) / airframe.mass_kg
    assert derivative[5] == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(np.delete(derivative, 5), 0.0, atol=1e-12)
