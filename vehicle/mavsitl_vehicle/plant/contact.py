"""The ground at z = 0: a spring, a damper and smooth friction at four leg tips, one under the middle of each arm.

A leg pushes and never pulls. Its damping fades in over the first millimetre, so the force is continuous at touch-down.
The state's height is that of the leg plane under a level vehicle, so a vehicle at rest has height 0; the mass centre is
LEG_HEIGHT above it. Nothing but the leg tips touches the ground.
"""

from __future__ import annotations

from math import sqrt

from mavsitl.compiled import compiled
from mavsitl_vehicle.plant.parameters import (
    CONTACT_DAMPING,
    CONTACT_SINK_M,
    CONTACT_STIFFNESS,
    INVERSE_INERTIA,
    INVERSE_MASS,
    LEG_HEIGHT,
    LEG_RADIUS,
)
from mavsitl_vehicle.plant.state import Array, Body

FRICTION = 0.7
"""Coefficient of sliding friction."""
FRICTION_SPEED_M_S = 0.05
"""Friction is FRICTION N v / sqrt(v^2 + this^2): viscous well below this speed, Coulomb's well above."""


@compiled
def leg_force(depth_m: float, sink_speed_m_s: float, stiffness: float, damping: float) -> float:
    """Normal force of one leg, N, for its depth below the ground and the speed at which that grows."""
    if depth_m <= 0.0:
        return 0.0
    share = depth_m / CONTACT_SINK_M
    if share > 1.0:
        share = 1.0
    force = stiffness * depth_m + share * damping * sink_speed_m_s
    if force < 0.0:
        return 0.0
    return force


@compiled
def contact_derivative(body: Body, parameters: Array, j: int) -> tuple[float, float, float, float, float, float]:
    """What the ground adds to vehicle `j`'s accelerations: linear (m/s^2 NWU) and angular (rad/s^2 FLU)."""
    _, _, height, body_vx, body_vy, body_vz, qw, qx, qy, qz, p, q, r = body
    r_xx = 1.0 - 2.0 * (qy * qy + qz * qz)
    r_xy = 2.0 * (qx * qy - qw * qz)
    r_xz = 2.0 * (qx * qz + qw * qy)
    r_yx = 2.0 * (qx * qy + qw * qz)
    r_yy = 1.0 - 2.0 * (qx * qx + qz * qz)
    r_yz = 2.0 * (qy * qz - qw * qx)
    r_zx = 2.0 * (qx * qz - qw * qy)
    r_zy = 2.0 * (qy * qz + qw * qx)
    r_zz = 1.0 - 2.0 * (qx * qx + qy * qy)

    centre_z = height + parameters[LEG_HEIGHT, j]
    leg_z = -(parameters[LEG_HEIGHT, j] + CONTACT_SINK_M)
    force_x = force_y = force_z = 0.0
    moment_x = moment_y = moment_z = 0.0
    for leg in range(4):
        # Rear, right, front, left, as the rotors.
        leg_x = leg_y = 0.0
        if leg == 0:
            leg_x = -parameters[LEG_RADIUS, j]
        elif leg == 1:
            leg_y = -parameters[LEG_RADIUS, j]
        elif leg == 2:
            leg_x = parameters[LEG_RADIUS, j]
        else:
            leg_y = parameters[LEG_RADIUS, j]
        depth = -(centre_z + r_zx * leg_x + r_zy * leg_y + r_zz * leg_z)

        # The tip's velocity: v + R (omega x leg).
        spin_x = q * leg_z - r * leg_y
        spin_y = r * leg_x - p * leg_z
        spin_z = p * leg_y - q * leg_x
        v_x = body_vx + r_xx * spin_x + r_xy * spin_y + r_xz * spin_z
        v_y = body_vy + r_yx * spin_x + r_yy * spin_y + r_yz * spin_z
        v_z = body_vz + r_zx * spin_x + r_zy * spin_y + r_zz * spin_z

        normal = leg_force(depth, -v_z, parameters[CONTACT_STIFFNESS, j], parameters[CONTACT_DAMPING, j])
        drag = FRICTION * normal / sqrt(v_x * v_x + v_y * v_y + FRICTION_SPEED_M_S * FRICTION_SPEED_M_S)
        f_x = -drag * v_x
        f_y = -drag * v_y
        force_x += f_x
        force_y += f_y
        force_z += normal

        # The moment in the body: leg x (R^T f).
        b_x = r_xx * f_x + r_yx * f_y + r_zx * normal
        b_y = r_xy * f_x + r_yy * f_y + r_zy * normal
        b_z = r_xz * f_x + r_yz * f_y + r_zz * normal
        moment_x += leg_y * b_z - leg_z * b_y
        moment_y += leg_z * b_x - leg_x * b_z
        moment_z += leg_x * b_y - leg_y * b_x

    per_mass = parameters[INVERSE_MASS, j]
    return (
        force_x * per_mass,
        force_y * per_mass,
        force_z * per_mass,
        moment_x * parameters[INVERSE_INERTIA, j],
        moment_y * parameters[INVERSE_INERTIA + 1, j],
        moment_z * parameters[INVERSE_INERTIA + 2, j],
    )
