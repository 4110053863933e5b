"""The compiled step against an independent writing of eqs 1-13, integrated by DOP853."""

from __future__ import annotations

import numpy as np
import pytest
from mavsitl_vehicle.plant.state import ROTOR, Array
from scipy.integrate import solve_ivp

from mavsitl.airframes import Airframe
from tests.plant.flight import HOVER_RAD_S, PAPER, REALISTIC, Fleet, rotation

SECONDS = 10.0
WIND = np.array([2.0, -1.5, 0.5])
LEVER = PAPER.arm_m * np.array([[-1.0, 0, 0], [0, -1.0, 0], [1.0, 0, 0], [0, 1.0, 0]])
TURN = np.array([1.0, -1.0, 1.0, -1.0])


def slope(a: Airframe, y: Array, rotors: Array) -> Array:
    """Eqs 1-13 with vectors: forces at their places, moments by cross products, the rotors' momentum as a vector."""
    turn = rotation(y[6:10])
    omega = y[10:13]
    two_rho_a = 2.0 * a.air_density_kg_m3 * np.pi * a.rotor_radius_m**2
    thrust = a.thrust_coefficient_n_s2 * rotors**2
    induced = np.sqrt(thrust / two_rho_a)
    wind_force = a.wind_coupling * two_rho_a * induced[:, None] * WIND
    axial = a.wind_coupling * (turn.T @ WIND)[2]
    k_drag = a.drag_coefficient_n_m_s2 * two_rho_a / a.thrust_coefficient_n_s2
    torque = k_drag * (induced + axial) ** 2
    acceleration = (turn[:, 2] * thrust.sum() + wind_force.sum(axis=0)) / a.mass_kg - [0.0, 0.0, a.gravity_m_s2]
    up = np.zeros((4, 3))
    up[:, 2] = thrust + (wind_force @ turn)[:, 2]
    moment = np.cross(LEVER, up).sum(axis=0)
    moment[2] += TURN @ torque
    inertia = np.array(a.inertia_kg_m2)
    momentum = inertia * omega + [0.0, 0.0, -a.rotor_inertia_kg_m2 * (TURN @ rotors)]
    w, v = y[6], y[7:10]
    quaternion = 0.5 * np.concatenate([[-v @ omega], w * omega + np.cross(v, omega)])
    return np.concatenate([y[3:6], acceleration, quaternion, (moment - np.cross(omega, momentum)) / inertia])


def speeds(t: float) -> Array:
    """Rotor speeds that stir every axis and stay within the limits."""
    phase = np.array([0.0, 0.3, 0.9, 1.4])
    return HOVER_RAD_S * (1.02 + 2.0e-3 * np.sin(2.0 * t + phase) + 1.0e-3 * np.sin(5.0 * t + 2.0 * phase))


def compare(fleet: Fleet, final: Array) -> tuple[float, float]:
    """Position error, m, and attitude error, rad."""
    q = fleet.x[6:10, 0]
    vector = q[0] * final[7:10] - final[6] * q[1:] - np.cross(q[1:], final[7:10])
    return (
        float(np.linalg.norm(fleet.x[:3, 0] - final[:3])),
        2.0 * float(np.linalg.norm(vector)),
    )


@pytest.mark.parametrize(("dt_s", "position_m", "attitude_rad"), [(1.0e-3, 1.0e-9, 1.0e-10), (5.0e-3, 1.0e-8, 1.0e-9)])
def test_rigid_body_with_constant_rotor_speeds(dt_s: float, position_m: float, attitude_rad: float) -> None:
    fleet = Fleet()
    fleet.wind[:, 0] = WIND
    fleet.x[10:13, 0] = [0.3, -0.2, 0.4]
    rotors = HOVER_RAD_S * np.array([1.001, 0.999, 1.0, 1.002])
    fleet.run(SECONDS, dt_s, lambda _t: rotors[:, None])

    y0 = np.concatenate([[0, 0, 100.0], np.zeros(3), [1.0, 0, 0, 0], [0.3, -0.2, 0.4]])
    truth = solve_ivp(lambda _t, y: slope(PAPER, y, rotors), (0, SECONDS), y0, method="DOP853", rtol=1e-12, atol=1e-12)
    position, attitude = compare(fleet, truth.y[:, -1])
    assert np.linalg.norm(truth.y[:3, -1] - y0[:3]) > 10.0  # it did fly somewhere
    assert position < position_m
    assert attitude < attitude_rad


def test_rotor_lag_and_smooth_commands_held_over_each_step() -> None:
    """Commands are sampled and held, as aboard; the reference is integrated step by step with the same hold."""
    dt_s, tau, seconds = 5.0e-3, REALISTIC.rotor_time_constant_s, 2.0
    fleet = Fleet(REALISTIC)
    fleet.wind[:, 0] = WIND
    fleet.run(seconds, dt_s, lambda t: speeds(t)[:, None])

    y = np.concatenate([[0, 0, 100.0], np.zeros(3), [1.0, 0, 0, 0], np.zeros(3), np.full(4, HOVER_RAD_S)])
    for k in range(round(seconds / dt_s)):
        command = speeds(k * dt_s)

        def lagged(_t: float, y: Array, command: Array = command) -> Array:
            return np.concatenate([slope(REALISTIC, y, y[13:]), (command - y[13:]) / tau])

        y = solve_ivp(lagged, (0.0, dt_s), y, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    position, attitude = compare(fleet, y)
    assert np.abs(fleet.x[ROTOR:, 0] - y[13:]).max() < 1.0e-8
    assert position < 1.0e-7
    assert attitude < 1.0e-7


def test_the_method_is_of_fourth_order() -> None:
    rotors = HOVER_RAD_S * np.array([1.02, 0.98, 1.0, 1.01])
    y0 = np.concatenate([[0, 0, 100.0], np.zeros(3), [1.0, 0, 0, 0], np.zeros(3)])
    truth = solve_ivp(lambda _t, y: slope(PAPER, y, rotors), (0, 2.0), y0, method="DOP853", rtol=1e-12, atol=1e-12)
    errors = []
    for dt_s in (0.02, 0.01):
        fleet = Fleet()
        fleet.wind[:, 0] = WIND
        fleet.run(2.0, dt_s, lambda _t: rotors[:, None])
        errors.append(compare(fleet, truth.y[:, -1])[0])
    assert 12.0 < errors[0] / errors[1] < 24.0
