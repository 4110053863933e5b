"""Eq 12 and its inverse for the plus layout, with limits: scalars, callable from other compiled functions.

U_1 is the thrust; U_2 and U_3 are force differences, so the torques of roll and pitch are l U_2 and l U_3; U_4 is
already a torque (eq 9 against eqs 11 and 12).
"""

from __future__ import annotations

import math

from mavsitl.compiled import compiled

SATURATED_ROLL = 1
SATURATED_PITCH = 2
SATURATED_THRUST = 4
SATURATED_YAW = 8
NOT_A_NUMBER = 16
"""A demand was NaN and was taken as 0."""


@compiled
def wrench(
    omega_1: float, omega_2: float, omega_3: float, omega_4: float, b: float, d: float, arm: float
) -> tuple[float, float, float, float]:
    """Eq 12 (with eq 11's arm): thrust in N and torques about x, y, z in N m (FLU) from rotor speeds in rad/s.

    b in N s^2, d in N m s^2, arm l in m.
    """
    q_1 = omega_1 * omega_1
    q_2 = omega_2 * omega_2
    q_3 = omega_3 * omega_3
    q_4 = omega_4 * omega_4
    return b * (q_1 + q_2 + q_3 + q_4), arm * b * (q_4 - q_2), arm * b * (q_1 - q_3), d * (q_1 - q_2 + q_3 - q_4)


@compiled
def _speed(square: float, max_square: float, max_speed: float) -> float:
    # Rounding may leave a square an ulp outside its limits.
    if square <= 0.0:
        return 0.0
    if square >= max_square:
        return max_speed
    speed = math.sqrt(square)
    if speed > max_speed:
        return max_speed
    return speed


@compiled
def allocate(
    u1_n: float,
    torque_x_n_m: float,
    torque_y_n_m: float,
    torque_z_n_m: float,
    b: float,
    d: float,
    arm: float,
    max_speed_rad_s: float,
) -> tuple[float, float, float, float, int]:
    """Rotor speeds 1..4 in rad/s, each in [0, max], and the demands that could not be met as bits.

    The inverse of eq 12 wherever that lies within the limits. Elsewhere roll and pitch come first (rotors 2, 4 and 1,
    3: they do not compete, each reaches l b max^2), then the thrust, moved as little as roll and pitch need, then yaw,
    as much as is left. Any input, infinite or NaN included, gives finite speeds.
    """
    bits = 0
    top = max_speed_rad_s * max_speed_rad_s
    total = u1_n / b
    roll = torque_x_n_m / (arm * b)
    pitch = torque_y_n_m / (arm * b)
    yaw = torque_z_n_m / d
    if total != total:
        total = 0.0
        bits |= NOT_A_NUMBER
    if roll != roll:
        roll = 0.0
        bits |= NOT_A_NUMBER
    if pitch != pitch:
        pitch = 0.0
        bits |= NOT_A_NUMBER
    if yaw != yaw:
        yaw = 0.0
        bits |= NOT_A_NUMBER

    if roll > top:
        roll = top
        bits |= SATURATED_ROLL
    elif roll < -top:
        roll = -top
        bits |= SATURATED_ROLL
    if pitch > top:
        pitch = top
        bits |= SATURATED_PITCH
    elif pitch < -top:
        pitch = -top
        bits |= SATURATED_PITCH

    # A pair whose difference is r has a sum between |r| and 2 max^2 - |r|; the thrust is the sum of both pairs.
    abs_roll = abs(roll)
    abs_pitch = abs(pitch)
    least = abs_roll + abs_pitch
    most = 4.0 * top - least
    if total < least:
        total = least
        bits |= SATURATED_THRUST
    elif total > most:
        total = most
        bits |= SATURATED_THRUST

    # Yaw is the difference of the pairs' sums: (total + yaw) / 2 and (total - yaw) / 2 must stay within those ranges.
    low = 2.0 * abs_pitch - total
    other = total - 4.0 * top + 2.0 * abs_roll
    if other > low:
        low = other
    high = total - 2.0 * abs_roll
    other = 4.0 * top - 2.0 * abs_pitch - total
    if other < high:
        high = other
    if yaw > high:
        yaw = high
        bits |= SATURATED_YAW
    elif yaw < low:
        yaw = low
        bits |= SATURATED_YAW

    quarter = 0.25 * total
    turn = 0.25 * yaw
    return (
        _speed(quarter + turn + 0.5 * pitch, top, max_speed_rad_s),
        _speed(quarter - turn - 0.5 * roll, top, max_speed_rad_s),
        _speed(quarter + turn - 0.5 * pitch, top, max_speed_rad_s),
        _speed(quarter - turn + 0.5 * roll, top, max_speed_rad_s),
        bits,
    )
