"""Dryden turbulence: numbers of Table 1, the filters, and what comes out of them."""

from __future__ import annotations

from math import exp, log, pi, sqrt

import numpy as np
import pytest
from mavsitl_vehicle.wind import dryden
from mavsitl_vehicle.wind.dryden import Filter
from mavsitl_vehicle.wind.field import WindField
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.signal import welch

from mavsitl.scenario import DrydenMil, DrydenPaper, Wind
from tests.wind.turbulence import blow

FIRST_ORDER = DrydenPaper()
SPECTRUM = DrydenPaper(form="spectrum")
UNIT = DrydenPaper(intensity="unit")
MIL = DrydenMil(speed_20ft_m_s=10.0, altitude_m=1.0)


def sigmas(wind: DrydenPaper | DrydenMil) -> list[float]:
    """Stationary sigma of u, v, w by design."""
    if isinstance(wind, DrydenPaper):
        filters = dryden.shaping_filters(dryden.paper_scales(wind), wind.form == "spectrum", wind.intensity == "two-pi")
    else:
        filters = dryden.shaping_filters(dryden.mil_scales(wind), True, True)
    return [dryden.sigma_m_s(f) for f in filters]


def test_table_1() -> None:
    """Eq 15 at the paper's height and wind."""
    scales = dryden.paper_scales(FIRST_ORDER)
    assert scales.length_m == pytest.approx((7.943, 3.971, 0.5), abs=1.0e-3)
    assert scales.sigma_m_s == pytest.approx((1.995, 3.981, 1.0), abs=1.0e-3)
    assert scales.speed_m_s == 10.0


def test_mil_by_hand() -> None:
    """h = 1 m is 3.281 ft and b = 0.177 + 0.0027 = 0.1797: L_u = 3.281 / b^1.2 ft = 25.73 ft, sigma_u = 1 / b^0.4."""
    scales = dryden.mil_scales(MIL)
    assert scales.length_m == pytest.approx((7.844, 3.922, 0.5), abs=1.0e-3)
    assert scales.sigma_m_s == pytest.approx((1.987, 1.987, 1.0), abs=1.0e-3)
    assert scales.speed_m_s == pytest.approx(10.0 * log(3.28084 / 0.15) / log(20.0 / 0.15), rel=1.0e-6)


def test_mil_at_the_top_is_isotropic() -> None:
    """1,000 ft: 0.177 + 0.823 = 1, so every L is 1,000 ft (L_u = 2 L_v = 2 L_w) and every sigma is 0.1 u20."""
    scales = dryden.mil_scales(DrydenMil(speed_20ft_m_s=20.0, altitude_m=304.8))
    assert scales.length_m == pytest.approx((304.8, 152.4, 152.4))
    assert scales.sigma_m_s == pytest.approx((2.0, 2.0, 2.0))


def test_mean_wind_is_u20_at_20_feet_and_has_a_floor() -> None:
    assert dryden.mil_mean_speed_m_s(DrydenMil(speed_20ft_m_s=7.0, altitude_m=6.096)) == pytest.approx(7.0)
    low = [dryden.mil_mean_speed_m_s(DrydenMil(speed_20ft_m_s=7.0, altitude_m=h)) for h in (0.01, 0.9144)]
    assert low[0] == low[1] > 0.0


@pytest.mark.parametrize("component", [0, 1, 2])
def test_eq_14_integrates_to_sigma_squared(component: int) -> None:
    scales = dryden.paper_scales(FIRST_ORDER)
    area, _ = quad(lambda w: float(dryden.density(np.array([w]), scales, component)[0]), 0.0, np.inf, limit=200)
    assert 2.0 * area == pytest.approx(scales.sigma_m_s[component] ** 2, rel=1.0e-6)


def test_which_reading_gives_which_sigma() -> None:
    """Eq 17's filters: 1 and sqrt(sqrt(3) / 2) of sigma with intensity 2 pi, and 1 / sqrt(2 pi) of that with 1."""
    table = np.array(dryden.paper_scales(FIRST_ORDER).sigma_m_s)
    short = sqrt(sqrt(3.0) / 2.0)
    np.testing.assert_allclose(sigmas(FIRST_ORDER) / table, [1.0, short, short], rtol=1e-12)
    np.testing.assert_allclose(sigmas(UNIT) / table, np.array([1.0, short, short]) / sqrt(2.0 * pi), rtol=1e-12)
    np.testing.assert_allclose(sigmas(SPECTRUM) / table, 1.0, rtol=1e-12)
    np.testing.assert_allclose(sigmas(MIL), dryden.mil_scales(MIL).sigma_m_s, rtol=1e-12)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("ratio", [1.0e-5, 1.0e-3, 0.1, 0.9, 1.1, 4.0])
def test_discretisation_against_van_loan(order: int, ratio: float) -> None:
    """exp(A h), and the noise covariance out of exp of [[-A, B B' I], [0, A']] h (Van Loan 1978)."""
    filter_ = Filter(order, 0.7, 1.3, 2.0 * pi)
    dt_s = ratio * filter_.time_constant_s
    a = np.array([[-1.0, 0.0], [1.0, -1.0]])[:order, :order] / filter_.time_constant_s
    b = np.array([[1.0], [0.0]])[:order] / filter_.time_constant_s
    block = np.block([[-a, filter_.intensity * b @ b.T], [np.zeros_like(a), a.T]])
    both = expm(block * dt_s)
    phi = expm(a * dt_s)
    q = phi @ both[:order, order:]

    e, cross = dryden.transition(filter_, dt_s)
    q_11, q_12, q_22 = dryden.covariance(filter_, dt_s)
    np.testing.assert_allclose(phi, np.array([[e, 0.0], [cross, e]])[:order, :order], rtol=1e-12, atol=1e-300)
    np.testing.assert_allclose(q[0, 0], q_11, rtol=1e-9)
    if order == 2:
        np.testing.assert_allclose([q[0, 1], q[1, 1]], [q_12, q_22], rtol=1e-9)
        factor = np.array([[1.0, 0.0], [0.0, 1.0]])
        factor[0, 0], factor[1, 0], factor[1, 1] = dryden.cholesky(q_11, q_12, q_22)
        np.testing.assert_allclose(factor @ factor.T, [[q_11, q_12], [q_12, q_22]], rtol=1e-12)
        # (1 - rho^2) of the pair tends to 1/4 for short steps: the second noise does not drown in rounding.
        if ratio <= 1.0e-3:
            assert factor[1, 1] ** 2 / q_22 == pytest.approx(0.25, rel=2.0e-3)


@pytest.mark.parametrize("order", [1, 2])
def test_the_stationary_covariance_is_a_fixed_point(order: int) -> None:
    filter_ = Filter(order, 0.7, 1.3, 1.0)
    p_11, p_12, p_22 = dryden.covariance(filter_, None)
    p = np.array([[p_11, p_12], [p_12, p_22]])
    e, cross = dryden.transition(filter_, 0.01)
    phi = np.array([[e, 0.0], [cross, e]])
    q_11, q_12, q_22 = dryden.covariance(filter_, 0.01)
    np.testing.assert_allclose(phi @ p @ phi.T + [[q_11, q_12], [q_12, q_22]], p, rtol=1e-12)


@pytest.mark.parametrize("wind", [FIRST_ORDER, SPECTRUM, UNIT, MIL])
def test_stationary_from_the_first_sample(wind: DrydenPaper | DrydenMil) -> None:
    """Sigma over 20,000 vehicles, sampling error 0.5 %: at the first sample and later, whatever the step."""
    n = 20_000
    expected = np.array(sigmas(wind))
    for dt_s in (1.0e-3, 0.05):
        samples = blow((wind,), n, dt_s, 30)
        for k in (0, 1, 29):
            # u and v lie along x and y for a wind from north or along the paper's axes.
            np.testing.assert_allclose(samples[k].std(axis=1) / expected, 1.0, atol=4.5 / sqrt(2.0 * n))
            np.testing.assert_allclose(samples[k].mean(axis=1) / expected, 0.0, atol=4.5 / sqrt(n))


def test_the_step_does_not_change_sigma_in_time() -> None:
    """The time average of one vehicle after another, 64 of them over 100 s, at 5 ms and at 0.1 s."""
    for dt_s in (5.0e-3, 0.1):
        samples = blow((SPECTRUM,), 64, dt_s, round(100.0 / dt_s), seed=7)
        np.testing.assert_allclose(samples.std(axis=(0, 2)) / sigmas(SPECTRUM), 1.0, atol=0.05)


@pytest.mark.parametrize("wind", [SPECTRUM, FIRST_ORDER])
def test_welch_spectrum(wind: DrydenPaper) -> None:
    """Within 8 % of eq 14 (first order: of eq 16, |G|^2 of eq 17), averaged in bands between 0.4 and 20 rad/s."""
    dt_s, n = 0.02, 256
    samples = blow((wind,), n, dt_s, 8192, seed=3)
    scales = dryden.paper_scales(wind)
    filters = dryden.shaping_filters(scales, False, True)
    frequency, psd = welch(samples, fs=1.0 / dt_s, nperseg=4096, axis=0, detrend=False)
    omega = 2.0 * pi * frequency
    two_sided = psd.mean(axis=2) / (4.0 * pi)  # per hertz one-sided -> per rad/s two-sided
    for component in range(3):
        if wind.form == "spectrum":
            expected = dryden.density(omega, scales, component)
        else:
            f = filters[component]
            expected = f.gain**2 / (1.0 + (f.time_constant_s * omega) ** 2)
        for low in np.geomspace(0.4, 10.0, 7):
            band = (omega >= low) & (omega < 2.0 * low)
            assert two_sided[band, component].mean() == pytest.approx(expected[band].mean(), rel=0.08)


def test_eq_17_against_eq_14() -> None:
    """Eq 17's first-order v and w miss eq 14's density by a third at their worst, near L omega / V = 0.5."""
    scales = dryden.paper_scales(FIRST_ORDER)
    f = dryden.shaping_filters(scales, False, True)[1]
    travel = scales.length_m[1] / scales.speed_m_s
    omega = np.linspace(0.01, 10.0, 4000) / travel
    ratio = dryden.density(omega, scales, 1) * (1.0 + (f.time_constant_s * omega) ** 2) / f.gain**2
    assert ratio.max() == pytest.approx(4.0 / 3.0, abs=2.0e-3)
    assert omega[ratio.argmax()] * travel == pytest.approx(0.5, abs=0.01)


def test_components_are_uncorrelated_and_so_are_vehicles() -> None:
    samples = blow((SPECTRUM,), 20_000, 0.01, 3)[-1]
    assert np.abs(np.corrcoef(samples) - np.eye(3)).max() < 0.03
    few = blow((FIRST_ORDER,), 2, 0.5, 4000)
    assert abs(np.corrcoef(few[:, 2, 0], few[:, 2, 1])[0, 1]) < 0.08


def test_memory_over_time() -> None:
    """u of eq 17 forgets as exp(-t V / L_u)."""
    samples = blow((FIRST_ORDER,), 20_000, 0.1, 6)
    correlation = np.corrcoef(samples[0, 0], samples[5, 0])[0, 1]
    assert correlation == pytest.approx(exp(-0.5 * 10.0 / 7.943), abs=0.03)


@pytest.mark.parametrize(("from_deg", "towards"), [(0.0, (-1, 0, 0)), (90.0, (0, 1, 0)), (225.0, (0.7071, -0.7071, 0))])
def test_mil_mean_wind_goes_where_it_does_not_come_from(from_deg: float, towards: tuple[float, ...]) -> None:
    """From the east it blows west, +y; from the south-west to the north-east, +x and -y."""
    wind = DrydenMil(speed_20ft_m_s=5.0, altitude_m=6.096, from_deg=from_deg, include_mean=True)
    field = WindField((wind,), 1, 0.01)
    out = np.empty((3, 1))
    field.step(0.0, np.zeros((5, 1)), out)
    np.testing.assert_allclose(out[:, 0], 5.0 * np.array(towards), atol=1e-3)


def test_mil_turbulence_turns_with_the_wind() -> None:
    """At 1 m, L_u = 2 L_v: turned by 90 degrees u lies along y. Told apart by their memory after 2 s."""
    n = 20_000
    for from_deg, axis_u, axis_v in ((0.0, 0, 1), (90.0, 1, 0)):
        wind: Wind = DrydenMil(speed_20ft_m_s=10.0, altitude_m=1.0, from_deg=from_deg)
        samples = blow((wind,), n, 1.0, 3)
        u = np.corrcoef(samples[0, axis_u], samples[2, axis_u])[0, 1]
        v = np.corrcoef(samples[0, axis_v], samples[2, axis_v])[0, 1]
        scales = dryden.mil_scales(MIL)
        decay_v = 2.0 * scales.speed_m_s / (2.0 * scales.length_m[1])
        assert u == pytest.approx(exp(-2.0 * scales.speed_m_s / scales.length_m[0]), abs=0.03)
        assert v == pytest.approx(exp(-decay_v) * (1.0 - decay_v / 2.0), abs=0.03)
