"""One rotor in wind: eqs 1-5 of the paper, and the first-order lag of its speed. Scalars in, scalars out."""

from __future__ import annotations

from mavsitl.compiled import fused


@fused
def rotor_in_wind(
    omega_rad_s: float,
    wind_axial_m_s: float,
    thrust_coefficient: float,
    induced_per_speed: float,
    drag_coefficient: float,
    wind_coupling: float,
    wind_force_coefficient: float,
    wind_torque_coefficient: float,
) -> tuple[float, float, float, float]:
    """Thrust F_T (N), drag torque M_T (N m), wind force per wind speed F_W / V_w (N s/m) and wind torque M_W (N m).

    `wind_axial_m_s` is the wind's component along the rotor axis (body z up). F_W points along the wind, as a vector.
    """
    v_d = induced_per_speed * omega_rad_s  # eq 2 with eq 3
    thrust = thrust_coefficient * omega_rad_s * omega_rad_s  # eq 3
    drag = drag_coefficient * omega_rad_s * omega_rad_s  # eq 3
    wind_force = wind_force_coefficient * v_d  # eq 4: F_R - F_T = 2 rho A V_d V_w, its share kappa
    v_w = wind_coupling * wind_axial_m_s
    wind_torque = wind_torque_coefficient * v_w * (2.0 * v_d + v_w)  # eqs 1, 5: k_drag ((V_d + V_w)^2 - V_d^2)
    return thrust, drag, wind_force, wind_torque


@fused
def decay(steps_per_time_constant: float) -> tuple[float, float]:
    """exp(-h / 2 tau) and exp(-h / tau) for h / tau, any value from 0 to infinity.

    The reciprocal of exp's series at a quarter of the step, squared: within 1e-10 up to h = tau, monotone and never
    negative beyond, and only products, so that every platform gives the same bits.
    """
    z = 0.25 * steps_per_time_constant
    series = 1.0 + z / 7.0 * (1.0 + z / 8.0)
    series = 1.0 + z / 5.0 * (1.0 + z / 6.0 * series)
    series = 1.0 + z / 3.0 * (1.0 + z / 4.0 * series)
    series = 1.0 + z * (1.0 + z / 2.0 * series)
    quarter = 1.0 / series
    half = quarter * quarter
    return half, half * half
