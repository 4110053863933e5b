"""The velocity disturbance observer."""

from __future__ import annotations

from math import cos, exp, sin

import numpy as np
import pytest

from mavsitl.control.wind_observer import WindObserver, model_acceleration

T_S = 0.004


@pytest.mark.parametrize("bandwidth", [1.0, 22.0, 5000.0])
def test_a_constant_wind_is_found_as_a_first_order_lag_at_any_bandwidth(bandwidth: float) -> None:
    wind = np.array([[0.8], [-1.6], [0.4]])
    model = np.array([[0.3], [0.1], [-2.0]])
    observer = WindObserver(bandwidth, 16.5)
    velocity = np.array([[1.0], [2.0], [3.0]])
    assert not observer.update(velocity, model, T_S).any()
    for k in range(1, 50):
        velocity = velocity + T_S * (wind + model)
        found = observer.update(velocity, model, T_S)
        assert found[:2] == pytest.approx(wind[:2] * (1.0 - exp(-bandwidth * T_S * k)), abs=1e-9)
        assert found[2] == pytest.approx(wind[2] * (1.0 - exp(-16.5 * T_S * k)), abs=1e-9)


def test_uneven_periods_are_exact_too() -> None:
    observer = WindObserver(22.0, 16.5)
    velocity = np.zeros((3, 1))
    observer.update(velocity, velocity, T_S)
    for period in (0.004, 0.02, 0.008):
        velocity = velocity + period
        found = observer.update(velocity, np.zeros((3, 1)), period)
    assert found[0, 0] == pytest.approx(1.0 - exp(-22.0 * 0.032), abs=1e-12)


def test_the_same_telemetry_twice_changes_nothing() -> None:
    observer = WindObserver(22.0, 16.5)
    zero, one = np.zeros((3, 1)), np.ones((3, 1))
    observer.update(zero, zero, T_S)
    before = observer.update(one, zero, T_S).copy()
    assert before.all()
    assert (observer.update(one, zero, 0.0) == before).all()


def test_reset_takes_the_next_velocity_as_it_is() -> None:
    observer = WindObserver(22.0, 16.5, n=2)
    zero = np.zeros((3, 2))
    observer.update(zero, zero, T_S)
    observer.update(zero + 1.0, zero, T_S)
    observer.reset(0)
    found = observer.update(zero + 7.0, zero, T_S)
    assert not found[:, 0].any()
    assert found[:, 1].all()


def test_the_model_is_eq_11_without_wind() -> None:
    phi, theta, psi, thrust, mass = 0.3, -0.4, 1.1, 9.0, 0.723
    cr, sr, cp, sp, cy, sy = (f(a / 2) for a in (phi, theta, psi) for f in (cos, sin))
    quaternion = np.array(
        [
            [cy * cp * cr + sy * sp * sr],
            [cy * cp * sr - sy * sp * cr],
            [cy * sp * cr + sy * cp * sr],
            [sy * cp * cr - cy * sp * sr],
        ]
    )
    found = model_acceleration(quaternion, np.array([thrust]), mass, 9.81, np.zeros((3, 1)))
    assert found[:, 0] == pytest.approx(
        [
            thrust * (cos(phi) * sin(theta) * cos(psi) + sin(phi) * sin(psi)) / mass,
            thrust * (cos(phi) * sin(theta) * sin(psi) - sin(phi) * cos(psi)) / mass,
            thrust * cos(phi) * cos(theta) / mass - 9.81,
        ]
    )


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="greater than 0"):
        WindObserver(0.0, 16.5)
    with pytest.raises(ValueError, match="shape"):
        WindObserver(1.0, 1.0).update(np.zeros((3, 2)), np.zeros((3, 1)), T_S)
