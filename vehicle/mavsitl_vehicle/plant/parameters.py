"""The plant's parameters: float64 of shape (N_PARAMETERS, n), one column a vehicle. The constants are rows.

Kernels take one vehicle's by value, as `Column`: the constants are its indices.
"""

from __future__ import annotations

from math import inf, pi, sqrt
from typing import TypeAlias

import numpy as np

from mavsitl.airframes import Airframe
from mavsitl.compiled import fused
from mavsitl.scenario import Offnominal
from mavsitl_vehicle.plant.state import Array

MASS = 0
"""m, kg."""
GRAVITY = 1
"""g, m/s^2."""
ARM = 2
"""l, metres."""
INERTIA = 3
"""Rows 3:6: I_xx, I_yy, I_zz, kg m^2."""
ROTOR_INERTIA = 6
"""J_r, kg m^2."""
THRUST = 7
"""Rows 7:11: b of each rotor (eq 3), N s^2."""
INDUCED = 11
"""Rows 11:15: V_d / Omega of each rotor, metres: eq 2 with eq 3 is V_d = sqrt(b / (2 rho A)) Omega."""
DRAG = 15
"""d (eq 3), N m s^2."""
COUPLING = 16
"""kappa: the share of eq 4's wind force that acts."""
WIND_FORCE = 17
"""kappa 2 rho A, kg/m: eq 4's wind force is this times V_d V_w."""
WIND_TORQUE = 18
"""k_drag of eq 5, kg, from the windless case M_T = d Omega^2 = k_drag V_d^2."""
MAX_ROTOR_SPEED = 19
"""rad/s."""
ROTOR_RATE = 20
"""1 / tau of the rotor speed's first-order lag, 1/s; infinite for ideal rotors."""
CONTACT_REACH = 21
"""Below this height a leg tip may touch the ground, metres; minus infinity where there is no ground."""
CONTACT_STIFFNESS = 22
"""Of one leg, N/m."""
CONTACT_DAMPING = 23
"""Of one leg, N s/m."""
LEG_RADIUS = 24
"""Distance of a leg tip from the body's z axis, metres."""
LEG_HEIGHT = 25
"""Distance of the mass centre from the ground at rest, metres."""
INVERSE_MASS = 26
"""1 / m, 1/kg: a kernel that divides by a constant over and over is slower."""
INVERSE_INERTIA = 27
"""Rows 27:30: 1 / I_xx, 1 / I_yy, 1 / I_zz, 1/(kg m^2)."""
N_PARAMETERS = 30

Column: TypeAlias = tuple[float, ...]
"""The N_PARAMETERS rows of one vehicle."""

CONTACT_SINK_M = 1.0e-3
"""How far each leg is pressed in at rest. It sets the bounce's angular frequency, sqrt(g / sink): 99 rad/s."""
CONTACT_DAMPING_RATIO = 0.7
LEG_RADIUS_PER_ARM = 0.5
LEG_HEIGHT_PER_ARM = 0.2


def plant_parameters(airframe: Airframe, offnominal: Offnominal, ground_contact: bool, n: int) -> Array:
    """The parameters of `n` vehicles of one airframe, made off-nominal: shape (N_PARAMETERS, n).

    ``rotor_thrust_scale`` scales b alone (eq 3's thrust and, through eq 2, the induced velocity); drag torque stays.
    Raises `ValueError` for `n` below 1.
    """
    if n < 1:
        raise ValueError(f"n = {n}: a fleet has at least one vehicle")
    mass = airframe.mass_kg * offnominal.mass_scale
    two_rho_a = 2.0 * airframe.air_density_kg_m3 * pi * airframe.rotor_radius_m * airframe.rotor_radius_m
    thrust = np.array(offnominal.rotor_thrust_scale) * airframe.thrust_coefficient_n_s2
    tau = airframe.rotor_time_constant_s
    bounce_rad_s = sqrt(airframe.gravity_m_s2 / CONTACT_SINK_M)
    leg_radius = LEG_RADIUS_PER_ARM * airframe.arm_m
    leg_height = LEG_HEIGHT_PER_ARM * airframe.arm_m
    # The lowest that a tip can be, over all attitudes, is its distance below the mass centre.
    reach = sqrt(leg_radius**2 + (leg_height + CONTACT_SINK_M) ** 2) - leg_height

    p = np.zeros((N_PARAMETERS, n))
    p[MASS] = mass
    p[GRAVITY] = airframe.gravity_m_s2
    p[ARM] = airframe.arm_m
    p[INERTIA : INERTIA + 3] = offnominal.inertia_scale * np.array(airframe.inertia_kg_m2)[:, np.newaxis]
    p[ROTOR_INERTIA] = airframe.rotor_inertia_kg_m2
    p[THRUST : THRUST + 4] = thrust[:, np.newaxis]
    p[INDUCED : INDUCED + 4] = np.sqrt(thrust / two_rho_a)[:, np.newaxis]
    p[DRAG] = airframe.drag_coefficient_n_m_s2
    p[COUPLING] = airframe.wind_coupling
    p[WIND_FORCE] = airframe.wind_coupling * two_rho_a
    p[WIND_TORQUE] = airframe.drag_coefficient_n_m_s2 * two_rho_a / airframe.thrust_coefficient_n_s2
    p[MAX_ROTOR_SPEED] = airframe.max_rotor_speed_rad_s
    p[ROTOR_RATE] = 1.0 / tau if tau > 0.0 else inf
    p[CONTACT_REACH] = reach if ground_contact else -inf
    p[CONTACT_STIFFNESS] = 0.25 * mass * bounce_rad_s * bounce_rad_s
    p[CONTACT_DAMPING] = 0.25 * mass * 2.0 * CONTACT_DAMPING_RATIO * bounce_rad_s
    p[LEG_RADIUS] = leg_radius
    p[LEG_HEIGHT] = leg_height
    p[INVERSE_MASS] = 1.0 / mass
    p[INVERSE_INERTIA : INVERSE_INERTIA + 3] = 1.0 / p[INERTIA : INERTIA + 3]
    return p


@fused
def parameters_of(parameters: Array, j: int) -> Column:
    """Of vehicle `j`."""
    p = parameters
    return (
        p[0, j], p[1, j], p[2, j], p[3, j], p[4, j], p[5, j], p[6, j], p[7, j], p[8, j], p[9, j],
        p[10, j], p[11, j], p[12, j], p[13, j], p[14, j], p[15, j], p[16, j], p[17, j], p[18, j], p[19, j],
        p[20, j], p[21, j], p[22, j], p[23, j], p[24, j], p[25, j], p[26, j], p[27, j], p[28, j], p[29, j],
    )  # fmt: skip
