"""The rigid body: eqs 6-13 with a quaternion for eq 6's R: no attitude is singular, no trigonometry."""

from __future__ import annotations

from mavsitl.compiled import fused
from mavsitl_vehicle.plant.parameters import (
    ARM,
    COUPLING,
    DRAG,
    GRAVITY,
    INDUCED,
    INERTIA,
    INVERSE_INERTIA,
    INVERSE_MASS,
    ROTOR_INERTIA,
    THRUST,
    WIND_FORCE,
    WIND_TORQUE,
    Column,
)
from mavsitl_vehicle.plant.rotor import rotor_in_wind
from mavsitl_vehicle.plant.state import Body, Rotors, Wind


@fused
def body_derivative(body: Body, rotors: Rotors, wind: Wind, parameters: Column) -> Body:
    """d/dt of a body (position, velocity, quaternion, rates) in free air, at these rotor speeds (rad/s)."""
    _, _, _, v_x, v_y, v_z, qw, qx, qy, qz, p, q, r = body
    o1, o2, o3, o4 = rotors
    wind_x, wind_y, wind_z = wind

    # Third column of R: body z, the rotor axis, in the world.
    axis_x = 2.0 * (qx * qz + qw * qy)
    axis_y = 2.0 * (qy * qz - qw * qx)
    axis_z = 1.0 - 2.0 * (qx * qx + qy * qy)
    wind_axial = axis_x * wind_x + axis_y * wind_y + axis_z * wind_z

    drag = parameters[DRAG]
    kappa = parameters[COUPLING]
    k_force = parameters[WIND_FORCE]
    k_torque = parameters[WIND_TORQUE]
    t1, m1, f1, n1 = rotor_in_wind(
        o1, wind_axial, parameters[THRUST], parameters[INDUCED], drag, kappa, k_force, k_torque
    )
    t2, m2, f2, n2 = rotor_in_wind(
        o2, wind_axial, parameters[THRUST + 1], parameters[INDUCED + 1], drag, kappa, k_force, k_torque
    )
    t3, m3, f3, n3 = rotor_in_wind(
        o3, wind_axial, parameters[THRUST + 2], parameters[INDUCED + 2], drag, kappa, k_force, k_torque
    )
    t4, m4, f4, n4 = rotor_in_wind(
        o4, wind_axial, parameters[THRUST + 3], parameters[INDUCED + 3], drag, kappa, k_force, k_torque
    )

    # Eq 6: thrust along body z, wind force along the wind.
    per_mass = parameters[INVERSE_MASS]
    thrust = (t1 + t3) + (t2 + t4)  # U_1 of eq 12
    wind_force = (f1 + f3) + (f2 + f4)
    a_x = (thrust * axis_x + wind_force * wind_x) * per_mass
    a_y = (thrust * axis_y + wind_force * wind_y) * per_mass
    a_z = (thrust * axis_z + wind_force * wind_z) * per_mass - parameters[GRAVITY]

    # q' = q (0, omega) / 2
    qw_dot = -0.5 * (qx * p + qy * q + qz * r)
    qx_dot = 0.5 * (qw * p + (qy * r - qz * q))
    qy_dot = 0.5 * (qw * q + (qz * p - qx * r))
    qz_dot = 0.5 * (qw * r + (qx * q - qy * p))

    # Eqs 9, 12 (U_2..U_4) and 10, 13 (W_4..W_6): of the wind force, its component along the rotor axis turns the body.
    arm = parameters[ARM]
    moment_x = arm * ((t4 - t2) + (f4 - f2) * wind_axial)
    moment_y = arm * ((t1 - t3) + (f1 - f3) * wind_axial)
    moment_z = ((m1 + m3) - (m2 + m4)) + ((n1 + n3) - (n2 + n4))

    # Eq 7. Rotors 2 and 4 spin along +z (eq 9), so the rotors' angular momentum is +J_r Omega_r of eq 8, and its
    # gyroscopic moment is -omega x [0, 0, J_r Omega_r]; with the printed + angular momentum would not be conserved.
    i_x, i_y, i_z = parameters[INERTIA], parameters[INERTIA + 1], parameters[INERTIA + 2]
    rotor_momentum = parameters[ROTOR_INERTIA] * ((o2 + o4) - (o1 + o3))
    p_dot = (moment_x + (i_y - i_z) * q * r - q * rotor_momentum) * parameters[INVERSE_INERTIA]
    q_dot = (moment_y + (i_z - i_x) * p * r + p * rotor_momentum) * parameters[INVERSE_INERTIA + 1]
    r_dot = (moment_z + (i_x - i_y) * p * q) * parameters[INVERSE_INERTIA + 2]
    return v_x, v_y, v_z, a_x, a_y, a_z, qw_dot, qx_dot, qy_dot, qz_dot, p_dot, q_dot, r_dot
