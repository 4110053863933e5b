"""The ground at z = 0: a spring, a damper and smooth friction at four leg tips, one under the middle of each arm.

A leg pushes and never pulls. Its damping fades in over the first millimetre, so the force is continuous at touch-down.
The state's height is that of the leg plane under a level vehicle, so a vehicle at rest has height 0; the mass centre is
LEG_HEIGHT above it. Nothing but the leg tips touches the ground.
"""

from __future__ import annotations

from math import sqrt
from typing import TypeAlias

from mavsitl.compiled import fused
from mavsitl_vehicle.plant.parameters import (
    CONTACT_DAMPING,
    CONTACT_SINK_M,
    CONTACT_STIFFNESS,
    INVERSE_INERTIA,
    INVERSE_MASS,
    LEG_HEIGHT,
    LEG_RADIUS,
    Column,
)
from mavsitl_vehicle.plant.state import Body

FRICTION = 0.7
"""Coefficient of sliding friction."""
FRICTION_SPEED_M_S = 0.05
"""Friction is FRICTION N v / sqrt(v^2 + this^2): viscous well below this speed, Coulomb's well above."""

Rotation: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]
"""R of eq 6, row by row: body FLU to world NWU."""
Wrench: TypeAlias = tuple[float, float, float, float, float, float]
"""Force, N NWU, and moment about the mass centre, N m FLU."""


@fused
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


@fused
def with_leg(others: Wrench, leg_x: float, leg_y: float, body: Body, rotation: Rotation, parameters: Column) -> Wrench:
    """`others` and what the ground does to one more leg, its tip at `leg_x`, `leg_y` in the body."""
    force_x, force_y, force_z, moment_x, moment_y, moment_z = others
    _, _, height, body_vx, body_vy, body_vz, _, _, _, _, p, q, r = body
    r_xx, r_xy, r_xz, r_yx, r_yy, r_yz, r_zx, r_zy, r_zz = rotation
    centre_z = height + parameters[LEG_HEIGHT]
    leg_z = -(parameters[LEG_HEIGHT] + CONTACT_SINK_M)
    depth = -(centre_z + r_zx * leg_x + r_zy * leg_y + r_zz * leg_z)

    # The tip's velocity: v + R (omega x leg).
    spin_x = q * leg_z - r * leg_y
    spin_y = r * leg_x - p * leg_z
    spin_z = p * leg_y - q * leg_x
    v_x = body_vx + r_xx * spin_x + r_xy * spin_y + r_xz * spin_z
    v_y = body_vy + r_yx * spin_x + r_yy * spin_y + r_yz * spin_z
    v_z = body_vz + r_zx * spin_x + r_zy * spin_y + r_zz * spin_z

    normal = leg_force(depth, -v_z, parameters[CONTACT_STIFFNESS], parameters[CONTACT_DAMPING])
    drag = FRICTION * normal / sqrt(v_x * v_x + v_y * v_y + FRICTION_SPEED_M_S * FRICTION_SPEED_M_S)
    f_x = -drag * v_x
    f_y = -drag * v_y

    # The moment in the body: leg x (R^T f).
    b_x = r_xx * f_x + r_yx * f_y + r_zx * normal
    b_y = r_xy * f_x + r_yy * f_y + r_zy * normal
    b_z = r_xz * f_x + r_yz * f_y + r_zz * normal
    return (
        force_x + f_x,
        force_y + f_y,
        force_z + normal,
        moment_x + (leg_y * b_z - leg_z * b_y),
        moment_y + (leg_z * b_x - leg_x * b_z),
        moment_z + (leg_x * b_y - leg_y * b_x),
    )


@fused
def contact_derivative(body: Body, parameters: Column) -> Wrench:
    """What the ground adds to a vehicle's accelerations: linear (m/s^2 NWU) and angular (rad/s^2 FLU)."""
    _, _, _, _, _, _, qw, qx, qy, qz, _, _, _ = body
    rotation = (
        1.0 - 2.0 * (qy * qy + qz * qz),
        2.0 * (qx * qy - qw * qz),
        2.0 * (qx * qz + qw * qy),
        2.0 * (qx * qy + qw * qz),
        1.0 - 2.0 * (qx * qx + qz * qz),
        2.0 * (qy * qz - qw * qx),
        2.0 * (qx * qz - qw * qy),
        2.0 * (qy * qz + qw * qx),
        1.0 - 2.0 * (qx * qx + qy * qy),
    )
    radius = parameters[LEG_RADIUS]
    # Rear, right, front, left, as the rotors.
    wrench = with_leg((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), -radius, 0.0, body, rotation, parameters)
    wrench = with_leg(wrench, 0.0, -radius, body, rotation, parameters)
    wrench = with_leg(wrench, radius, 0.0, body, rotation, parameters)
    wrench = with_leg(wrench, 0.0, radius, body, rotation, parameters)
    per_mass = parameters[INVERSE_MASS]
    return (
        wrench[0] * per_mass,
        wrench[1] * per_mass,
        wrench[2] * per_mass,
        wrench[3] * parameters[INVERSE_INERTIA],
        wrench[4] * parameters[INVERSE_INERTIA + 1],
        wrench[5] * parameters[INVERSE_INERTIA + 2],
    )
