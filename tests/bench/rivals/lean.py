"""A lock-step loop of the usual kind with mavutil and numpy alone, which does less than mavsitl.

The same exchange (ODOMETRY out, SET_ATTITUDE_TARGET back, 250 Hz, next tick when the answer is in) and four RK4 steps
of 1 ms, 13 states, with a position PID at one end and an attitude loop at the other. No wind, no noise, no rotors, no
observer, no learning, no handshake, no logs.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np
import numpy.typing as npt

from mavsitl.scenario import Flight

Array = npt.NDArray[np.float64]

TICK_S = 0.004
SUBSTEPS = 4


def _derivative(
    x: Array, thrust_n: float, torque_n_m: Array, mass_kg: float, gravity_m_s2: float, inertia: Array
) -> Array:
    """13 states: position, velocity (NED), quaternion, body rates (FRD)."""
    w, i, j, k = x[6:10]
    rotation = np.array([
        [1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)],
        [2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)],
        [2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)],
    ])  # fmt: skip
    p, q, r = omega = x[10:13]
    rate = 0.5 * np.array([
        -i * p - j * q - k * r, w * p + j * r - k * q, w * q - i * r + k * p, w * r + i * q - j * p,
    ])  # fmt: skip
    acceleration = rotation @ np.array([0.0, 0.0, -thrust_n / mass_kg]) + np.array([0.0, 0.0, gravity_m_s2])
    spin = (torque_n_m - np.cross(omega, inertia * omega)) / inertia
    return np.concatenate([x[3:6], acceleration, rate, spin])


def vehicle(port: int, duration_s: float, flight: Flight) -> tuple[float, float]:
    """Plant and attitude loop, until `duration_s` are flown: times real time, and metres off the hover at the end."""
    from pymavlink import mavutil

    airframe = flight.airframe

    link = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", source_system=1, source_component=1)
    inertia = np.array(airframe.inertia_kg_m2)
    x = np.zeros(13)
    x[2], x[6] = -1.0, 1.0
    step_s = TICK_S / SUBSTEPS
    ticks = round(duration_s / TICK_S)
    started = 0.0
    for tick in range(ticks):
        message = None
        while message is None:
            link.mav.odometry_send(
                tick * 4000, mavutil.mavlink.MAV_FRAME_LOCAL_NED, mavutil.mavlink.MAV_FRAME_BODY_FRD,
                *x[0:3], list(x[6:10]), *x[3:6], *x[10:13], [0.0] * 21, [0.0] * 21,
            )  # fmt: skip
            message = link.recv_match(type="SET_ATTITUDE_TARGET", blocking=True, timeout=1.0)
        if not tick:
            started = perf_counter()
        wanted = np.array(message.q)
        w, v = x[6], x[7:10]
        # Vector part of conj(q) * wanted: half the rotation vector to go, in the body frame.
        error = w * wanted[1:] - wanted[0] * v - np.cross(v, wanted[1:])
        torque = inertia * (400.0 * 2.0 * error - 40.0 * x[10:13])
        thrust = message.thrust * airframe.max_thrust_n
        plant = (thrust, torque, airframe.mass_kg, airframe.gravity_m_s2, inertia)
        for _ in range(SUBSTEPS):
            k1 = _derivative(x, *plant)
            k2 = _derivative(x + 0.5 * step_s * k1, *plant)
            k3 = _derivative(x + 0.5 * step_s * k2, *plant)
            k4 = _derivative(x + step_s * k3, *plant)
            x = x + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            x[6:10] /= np.linalg.norm(x[6:10])
    wall_s = perf_counter() - started
    return (ticks - 1) * TICK_S / wall_s, float(np.linalg.norm(x[0:3] - np.array([0.0, 0.0, -1.0])))


def ground(port: int, flight: Flight) -> None:
    """Position PID; answers each ODOMETRY, until it is ended."""
    from pymavlink import mavutil

    airframe = flight.airframe

    link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=250, source_component=191)
    wanted = np.array([0.0, 0.0, -1.0])
    integral = np.zeros(3)
    while True:
        message = link.recv_match(type="ODOMETRY", blocking=True)
        position = np.array([message.x, message.y, message.z])
        velocity = np.array([message.vx, message.vy, message.vz])
        error = wanted - position
        integral += error * TICK_S
        acceleration = 6.0 * error + 1.0 * integral - 4.5 * velocity
        roll = acceleration[1] / airframe.gravity_m_s2
        pitch = -acceleration[0] / airframe.gravity_m_s2
        cr, sr, cp, sp = np.cos(roll / 2), np.sin(roll / 2), np.cos(pitch / 2), np.sin(pitch / 2)
        thrust = airframe.mass_kg * (airframe.gravity_m_s2 - acceleration[2]) / airframe.max_thrust_n
        link.mav.set_attitude_target_send(
            message.time_usec // 1000,
            1,
            1,
            7,
            [cr * cp, sr * cp, cr * sp, -sr * sp],
            0.0,
            0.0,
            0.0,
            np.clip(thrust, 0.0, 1.0),
        )
