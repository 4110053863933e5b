"""Eqs 18-26."""

from __future__ import annotations

from math import asin, atan, atan2, cos, pi, radians, sin, tan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavsitl.control.arrays import Floats
from mavsitl.control.pid import LEAST_VERTICAL_SHARE, PositionLoop
from mavsitl.scenario import Gains

MASS = 0.723
G = 9.81
T_S = 0.004
GAINS_Z = Gains(k_p_per_s2=5.0, k_i_per_s3=0.5, k_d_per_s=6.0)
GAINS_XY = Gains(k_p_per_s2=9.0, k_i_per_s3=0.2, k_d_per_s=4.0)
PROPORTIONAL = Gains(k_p_per_s2=2.0, k_i_per_s3=0.0, k_d_per_s=0.0)


def build(
    z: Gains = GAINS_Z, xy: Gains = GAINS_XY, tilt_deg: float = 50.0, max_thrust: float = 2 * MASS * G, n: int = 1
) -> PositionLoop:
    return PositionLoop(z, xy, MASS, G, radians(tilt_deg), max_thrust, T_S, n)


def column(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Floats:
    return np.array([[x], [y], [z]])


def attitude(phi: float = 0.0, theta: float = 0.0, psi: float = 0.0) -> Floats:
    """Z-Y-X Euler angles to a quaternion, multiplied out: q_z q_y q_x."""
    cr, sr, cp, sp, cy, sy = (f(a / 2) for a in (phi, theta, psi) for f in (cos, sin))
    return np.array(
        [
            [cy * cp * cr + sy * sp * sr],
            [cy * cp * sr - sy * sp * cr],
            [cy * sp * cr + sy * cp * sr],
            [sy * cp * cr - cy * sp * sr],
        ]
    )


def fly(
    loop: PositionLoop,
    error: Floats | None = None,
    error_velocity: Floats | None = None,
    acceleration: Floats | None = None,
    wind: Floats | None = None,
    quaternion: Floats | None = None,
    yaw: float = 0.0,
) -> tuple[float, float, float]:
    """The vehicle at the origin at rest, the reference elsewhere."""
    zero = column()
    thrust, phi, theta = loop.update(
        zero,
        zero,
        attitude() if quaternion is None else quaternion,
        zero if error is None else error,
        zero if error_velocity is None else error_velocity,
        zero if acceleration is None else acceleration,
        np.array([yaw]),
        zero if wind is None else wind,
    )
    return float(thrust[0]), float(phi[0]), float(theta[0])


def test_at_the_reference_in_still_air_the_thrust_is_the_weight() -> None:
    assert fly(build()) == pytest.approx((MASS * G, 0.0, 0.0), abs=0.0)


def test_eqs_19_and_20_by_hand() -> None:
    loop = build()
    phi, theta, wind = 0.2, -0.3, 0.7
    total = 0.0
    for k in range(1, 4):
        thrust, _, _ = fly(
            loop, column(z=0.4), column(z=-0.1), wind=column(z=wind), quaternion=attitude(phi, theta, 1.0)
        )
        total = k * T_S * 0.4
        p_z = 5.0 * 0.4 + 0.5 * total + 6.0 * -0.1
        assert thrust == pytest.approx(MASS / (cos(phi) * cos(theta)) * (p_z + G - wind), rel=1e-12)
    assert loop.integral_m_s[2, 0] == pytest.approx(total)


def test_eqs_23_to_26_at_yaw_0() -> None:
    """theta_d is eq 26; phi_d is eq 25 once its quotient has the factor C_theta_d."""
    wind = column(0.5, -0.4, 0.3)
    _, phi, theta = fly(build(), column(0.3, -0.2, 0.1), column(0.05, 0.02, -0.03), wind=wind)
    p_x = 9.0 * 0.3 + 0.2 * T_S * 0.3 + 4.0 * 0.05
    p_y = 9.0 * -0.2 + 0.2 * T_S * -0.2 + 4.0 * 0.02
    p_z = 5.0 * 0.1 + 0.5 * T_S * 0.1 + 6.0 * -0.03
    vertical = p_z + G - 0.3
    assert theta == pytest.approx(atan((p_x - 0.5) / vertical), rel=1e-12)
    assert phi == pytest.approx(-atan((p_y + 0.4) * cos(theta) / vertical), rel=1e-12)
    printed = -atan((p_y + 0.4) / vertical)
    assert abs(printed) > abs(phi)


def test_eq_25_is_exact_as_printed_where_pitch_is_0() -> None:
    _, phi, theta = fly(build(), column(y=0.5))
    assert theta == 0.0
    assert phi == pytest.approx(-atan((9.0 + 0.2 * T_S) * 0.5 / G), rel=1e-12)


@given(p=st.tuples(*[st.floats(-3.0, 3.0)] * 3), wind=st.tuples(*[st.floats(-1.0, 1.0)] * 3), yaw=st.floats(-7.0, 7.0))
@settings(deadline=None, max_examples=100)
def test_eq_11_gives_back_the_wanted_acceleration_at_any_yaw(
    p: tuple[float, float, float], wind: tuple[float, float, float], yaw: float
) -> None:
    """Eqs 18, 21 and 22, without their small-yaw approximation: fly the angles found, and x'' = P."""
    unit = Gains(k_p_per_s2=1.0, k_i_per_s3=0.0, k_d_per_s=0.0)
    loop = build(unit, unit, tilt_deg=60.0, max_thrust=100.0)
    error, w = column(*p), column(*wind)
    _, phi, theta = fly(loop, error, wind=w, yaw=yaw)
    thrust, _, _ = fly(loop, error, wind=w, yaw=yaw, quaternion=attitude(phi, theta, yaw))
    x = thrust * (cos(phi) * sin(theta) * cos(yaw) + sin(phi) * sin(yaw)) / MASS + wind[0]
    y = thrust * (cos(phi) * sin(theta) * sin(yaw) - sin(phi) * cos(yaw)) / MASS + wind[1]
    z = thrust * cos(phi) * cos(theta) / MASS - G + wind[2]
    assert (x, y, z) == pytest.approx(p, abs=1e-9)


def test_the_references_acceleration_is_added_to_the_pid() -> None:
    asked = fly(build(PROPORTIONAL, PROPORTIONAL), acceleration=column(1.0, 2.0, 3.0))
    assert asked == pytest.approx(fly(build(PROPORTIONAL, PROPORTIONAL), column(0.5, 1.0, 1.5)))


@given(error=st.tuples(*[st.floats(-100.0, 100.0)] * 3), phi=st.floats(-3.0, 3.0), yaw=st.floats(-4.0, 4.0))
@settings(deadline=None, max_examples=100)
def test_limits_hold_for_any_error_and_attitude(error: tuple[float, float, float], phi: float, yaw: float) -> None:
    limit = radians(35.0)
    thrust, roll, pitch = fly(build(tilt_deg=35.0), column(*error), quaternion=attitude(phi), yaw=yaw)
    assert 0.0 <= thrust <= 2 * MASS * G
    assert cos(roll) * cos(pitch) >= cos(limit) - 1e-12


def test_a_limited_tilt_keeps_its_direction() -> None:
    _, phi, theta = fly(build(PROPORTIONAL, PROPORTIONAL, tilt_deg=20.0), column(30.0, 40.0))
    assert tan(theta) == pytest.approx(0.6 * tan(radians(20.0)))
    assert asin(sin(phi)) == pytest.approx(-atan2(0.8 * tan(radians(20.0)) * cos(theta), 1.0))


def test_in_free_fall_the_angles_keep_a_tenth_of_gravity() -> None:
    thrust, _, theta = fly(build(PROPORTIONAL, PROPORTIONAL), column(0.1, 0.0, -100.0))
    assert thrust == 0.0
    assert theta == pytest.approx(atan(0.2 / (LEAST_VERTICAL_SHARE * G)))


def test_beyond_the_tilt_limit_the_thrust_no_longer_grows() -> None:
    loop = build(PROPORTIONAL, PROPORTIONAL, tilt_deg=50.0, max_thrust=100.0)
    at_limit, *_ = fly(loop, quaternion=attitude(radians(50.0)))
    assert at_limit == pytest.approx(MASS * G / cos(radians(50.0)))
    for degrees in (70.0, 90.0, 180.0):
        assert fly(loop, quaternion=attitude(radians(degrees)))[0] == pytest.approx(at_limit)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_integrators_stand_still_while_their_output_is_limited(sign: float) -> None:
    loop = build()
    for _ in range(10):
        fly(loop, column(sign * 50.0, sign * 50.0, sign * 50.0))
    assert not loop.integral_m_s.any()
    fly(loop, column(sign * 0.01, sign * 0.01, sign * 0.01))
    assert loop.integral_m_s == pytest.approx(sign * 0.01 * T_S)


def test_a_limited_integrator_still_unwinds() -> None:
    loop = build()
    loop.integral_m_s[:] = 1000.0
    fly(loop, column(-0.1, -0.1, -0.1))
    assert loop.integral_m_s == pytest.approx(1000.0 - 0.1 * T_S, abs=1e-12)


def test_vehicles_of_a_fleet_do_not_mix() -> None:
    rng = np.random.default_rng(1)
    fleet, singles = build(n=3), [build() for _ in range(3)]
    quaternion = np.repeat(attitude(0.1, 0.2, 0.3), 3, axis=1)
    for _ in range(5):
        vectors = [rng.normal(size=(3, 3)) for _ in range(6)]
        yaw = rng.normal(size=3)
        together = fleet.update(vectors[0], vectors[1], quaternion, vectors[2], vectors[3], vectors[4], yaw, vectors[5])
        for i, single in enumerate(singles):
            p, v, rp, rv, ra, w = (np.ascontiguousarray(a[:, i : i + 1]) for a in vectors)
            alone = single.update(p, v, attitude(0.1, 0.2, 0.3), rp, rv, ra, yaw[i : i + 1].copy(), w)
            assert [a[0] for a in alone] == [a[i] for a in together]
    fleet.reset(1)
    assert not fleet.integral_m_s[:, 1].any()
    assert fleet.integral_m_s[:, [0, 2]].all()
    fleet.reset()
    assert not fleet.integral_m_s.any()


def test_wrong_shapes_are_refused() -> None:
    loop, zero = build(), column()
    with pytest.raises(ValueError, match="shape"):
        loop.update(zero, zero, attitude(), np.zeros((3, 2)), zero, zero, np.zeros(1), zero)


@pytest.mark.parametrize("tilt", [0.0, pi / 2, float("nan")])
def test_tilt_limits_that_have_no_tangent_are_refused(tilt: float) -> None:
    with pytest.raises(ValueError, match="tilt_limit_rad"):
        PositionLoop(GAINS_Z, GAINS_XY, MASS, G, tilt, 10.0, T_S)
