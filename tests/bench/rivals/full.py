"""The same flight as one writes it with mavutil and numpy for one vehicle: all of its models and laws, both ends.

Plant of 17 states (position, velocity, quaternion, body rates, rotor speeds) in four RK4 steps of 1 ms a tick, rotors
in wind by eqs 1-5, Dryden wind by eqs 14-17, white noise on every measured state, a rate loop with its allocation; at
the other end wind observer, position PID (eqs 18-26), reference filter and the three learning PIDNNs (eqs 27-57). The
telemetry is what the vehicle of mavsitl sends in lock-step. World NED, body FRD.

What it has not: an autopilot's modes, checks and services, a handshake, and logs.
"""

from __future__ import annotations

from math import atan2, cos, exp, pi, radians, sin, sqrt, tan
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from mavsitl.scenario import DrydenPaper, Flight

Array = npt.NDArray[np.float64]

TICK_S = 0.004
SUBSTEPS = 4
ROTOR_S = 0.002
"""Time constant of the rotors: the paper's have none, and then there would be 13 states."""
HOVER_NED = np.array([0.0, 0.0, -1.0])
SETTLED_S = 5.0


def rotation(q: Array) -> Array:
    """Body to world."""
    w, x, y, z = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def product(q: Array, p: Array) -> Array:
    """Of two quaternions."""
    return np.concatenate(([q[0] * p[0] - q[1:] @ p[1:]], q[0] * p[1:] + p[0] * q[1:] + np.cross(q[1:], p[1:])))


def euler(q: Array) -> Array:
    """Roll, pitch, yaw."""
    w, x, y, z = q
    return np.array([
        np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0)),
        np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    ])  # fmt: skip


class Plant:
    """Rigid body and rotors."""

    def __init__(self, flight: Flight) -> None:
        airframe = flight.airframe
        self.mass, self.gravity, self.arm = airframe.mass_kg, airframe.gravity_m_s2, airframe.arm_m
        self.inertia = np.array(airframe.inertia_kg_m2)
        self.rotor_inertia = airframe.rotor_inertia_kg_m2
        self.b, self.d = airframe.thrust_coefficient_n_s2, airframe.drag_coefficient_n_m_s2
        self.kappa = airframe.wind_coupling
        self.two_rho_a = 2.0 * airframe.air_density_kg_m3 * pi * airframe.rotor_radius_m**2
        self.x = np.zeros(17)
        self.x[0:3] = HOVER_NED
        self.x[6] = 1.0
        self.x[13:] = sqrt(self.mass * self.gravity / (4.0 * self.b))

    def derivative(self, x: Array, command: Array, wind: Array) -> Array:
        omega, speeds = x[10:13], x[13:17]
        up = -rotation(x[6:10])[:, 2]
        axial = up @ wind
        # Eqs 1-5.
        induced = np.sqrt(self.b / self.two_rho_a) * speeds
        thrust = self.b * speeds**2
        force = self.kappa * self.two_rho_a * induced
        felt = self.kappa * axial
        drag = self.d * speeds**2 + self.d * self.two_rho_a / self.b * felt * (2.0 * induced + felt)
        # Eqs 6-13.
        acceleration = (thrust.sum() * up + force.sum() * wind) / self.mass + np.array([0.0, 0.0, self.gravity])
        lift = thrust + force * axial
        torque = np.array([
            self.arm * (lift[3] - lift[1]),
            -self.arm * (lift[0] - lift[2]),
            -(drag[0] + drag[2] - drag[1] - drag[3]),
        ])  # fmt: skip
        spin = np.array([0.0, 0.0, -self.rotor_inertia * (speeds[1] + speeds[3] - speeds[0] - speeds[2])])
        omega_dot = (torque - np.cross(omega, self.inertia * omega + spin)) / self.inertia
        q_dot = 0.5 * product(x[6:10], np.concatenate(([0.0], omega)))
        return np.concatenate([x[3:6], acceleration, q_dot, omega_dot, (command - speeds) / ROTOR_S])

    def step(self, command: Array, wind: Array, h: float) -> None:
        x = self.x
        k1 = self.derivative(x, command, wind)
        k2 = self.derivative(x + 0.5 * h * k1, command, wind)
        k3 = self.derivative(x + 0.5 * h * k2, command, wind)
        k4 = self.derivative(x + h * k3, command, wind)
        self.x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        self.x[6:10] /= np.linalg.norm(self.x[6:10])


class Dryden:
    """Eqs 14-17: three first-order filters of white noise, discretised exactly."""

    def __init__(self, wind: DrydenPaper, h: float, rng: np.random.Generator) -> None:
        height, speed = wind.altitude_m, wind.speed_20ft_m_s
        base = 0.177 + 0.000823 * height
        length = np.array([height / base**1.2, height / base**1.2 / 2.0, height / 2.0])
        sigma_w = 0.1 * speed
        sigma = np.array([sigma_w / base**0.4, sigma_w / base**0.8, sigma_w])
        travel = length / speed
        time_constant = travel * np.array([1.0, 2.0 / sqrt(3.0), 2.0 / sqrt(3.0)])
        self.gain = sigma * np.sqrt(travel / pi)
        self.decay = np.exp(-h / time_constant)
        self.noise = np.sqrt(2.0 * pi / (2.0 * time_constant) * (1.0 - self.decay**2))
        self.state = np.sqrt(2.0 * pi / (2.0 * time_constant)) * rng.standard_normal(3)
        self.rng = rng

    def step(self) -> Array:
        """The wind over the next step, NED."""
        wind: Array = self.gain * self.state * np.array([1.0, -1.0, -1.0])
        self.state = self.decay * self.state + self.noise * self.rng.standard_normal(3)
        return wind


def vehicle(port: int, duration_s: float, flight: Flight) -> tuple[float, float]:
    """The vehicle's end, until `duration_s` are flown: times real time, and RMS metres off the hover once settled."""
    from pymavlink import mavutil

    link: Any = mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", source_system=1, source_component=1)
    rng = np.random.default_rng(flight.scenario.seed)
    plant = Plant(flight)
    (turbulence,) = flight.scenario.wind
    assert isinstance(turbulence, DrydenPaper)
    h = TICK_S / SUBSTEPS
    dryden = Dryden(turbulence, h, rng)
    noise = flight.scenario.noise
    airframe = flight.airframe
    largest = np.array(airframe.max_torque_n_m)
    rate_p = np.array([airframe.parameters[f"MC_{axis}RATE_P"] for axis in ("ROLL", "PITCH", "YAW")])
    b, d, arm = plant.b, plant.d, plant.arm
    allocation = np.linalg.inv(
        np.array([[b, b, b, b], [0, -arm * b, 0, arm * b], [-arm * b, 0, arm * b, 0], [-d, d, -d, d]])
    )
    ticks = round(duration_s / TICK_S)
    started, squares = 0.0, []
    for tick in range(ticks):
        x = plant.x
        position = x[0:3] + noise.position_m * rng.standard_normal(3)
        velocity = x[3:6] + noise.velocity_m_s * rng.standard_normal(3)
        turn = 0.5 * radians(noise.attitude_deg) * rng.standard_normal(3)
        q = product(x[6:10], np.concatenate(([1.0], turn)))
        q /= np.linalg.norm(q)
        rates = x[10:13] + radians(noise.rate_deg_s) * rng.standard_normal(3)
        telemetry(link, tick, position, velocity, q, rates)
        message = None
        while message is None or message.time_boot_ms != 4 * tick:
            message = link.recv_match(type="SET_ATTITUDE_TARGET", blocking=True, timeout=1.0)
            if message is None:
                telemetry(link, tick, position, velocity, q, rates)
        if not tick:
            started = perf_counter()
        wanted = np.array([message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate])
        for _ in range(SUBSTEPS):
            gyro = plant.x[10:13] + radians(noise.rate_deg_s) * rng.standard_normal(3)
            torque = rate_p * (wanted - gyro) * largest
            squared = allocation @ np.concatenate(([message.thrust * airframe.max_thrust_n], torque))
            command = np.sqrt(np.clip(squared, 0.0, airframe.max_rotor_speed_rad_s**2))
            plant.step(command, dryden.step(), h)
        if tick * TICK_S >= min(SETTLED_S, 0.5 * duration_s):
            squares.append(float(np.sum((plant.x[0:3] - HOVER_NED) ** 2)))
    wall_s = perf_counter() - started
    return (ticks - 1) * TICK_S / wall_s, sqrt(sum(squares) / len(squares))


def telemetry(link: Any, tick: int, position: Array, velocity: Array, q: Array, rates: Array) -> None:
    """What mavsitl's vehicle sends on its off-board link in lock-step, at its rates."""
    ms = 4 * tick
    if tick % 250 == 0:
        link.mav.heartbeat_send(2, 12, 0x81, 0x00060000, 4)
    if tick % 25 == 0:
        link.mav.attitude_send(ms, *euler(q), *rates)
        link.mav.attitude_quaternion_send(ms, *q, *rates)
        link.mav.local_position_ned_send(ms, *position, *velocity)
    link.mav.odometry_send(
        1000 * ms, 1, 1, *position, list(q), *velocity, *rates, [np.nan] + [0.0] * 20, [np.nan] + [0.0] * 20,
        0, 8, 100,
    )  # fmt: skip
    if tick % 50 == 0:
        link.mav.sys_status_send(15, 15, 15, 200, 12000, 1500, 90, 0, 0, 0, 0, 0, 0)
        link.mav.extended_sys_state_send(0, 2)


class Pidnn:
    """Eqs 27-57 for the three axes, output weights learned, with mavsitl's guards."""

    def __init__(self, flight: Flight, limit: Array) -> None:
        settings = flight.scenario.controller
        gains = (settings.roll_pitch, settings.roll_pitch, settings.yaw)
        self.initial = np.array([[g.k_p_per_s2, g.k_i_per_s3 * TICK_S, g.k_d_per_s / TICK_S] for g in gains])
        self.weights = self.initial.copy()
        self.eta = np.array(settings.learning.rate) * self.initial
        self.low, self.high = settings.learning.projection
        self.leak = settings.learning.leakage_per_s * TICK_S
        self.dead_zone = radians(settings.learning.dead_zone_deg)
        self.sum = np.zeros(3)
        self.limit = limit

    def update(self, angles: Array, rates: Array, desired: Array, desired_rates: Array) -> Array:
        """The wanted angular acceleration."""
        error = desired - angles
        error[2] = (error[2] + pi) % (2.0 * pi) - pi
        derivative = TICK_S * (desired_rates - rates)
        total = self.sum + error
        hidden = np.stack([error, total, derivative], axis=1)
        demand: Array = np.sum(self.weights * hidden, axis=1)
        stands = (np.abs(demand) > self.limit) & (demand * error > 0.0)
        self.sum = np.where(stands, self.sum, total)
        hidden[:, 1] = self.sum
        demand = np.sum(self.weights * hidden, axis=1)
        eta = np.minimum(self.eta, 2.0 / np.maximum(hidden**2, 1e-12))
        active = (np.abs(error) >= self.dead_zone)[:, np.newaxis]
        learned = self.weights + active * eta * error[:, np.newaxis] * hidden
        learned += self.leak * (self.initial - self.weights)
        self.weights = np.clip(learned, self.low * self.initial, self.high * self.initial)
        return demand


def ground(port: int, flight: Flight) -> None:
    """The controller's end: answers each ODOMETRY, until it is ended."""
    from pymavlink import mavutil

    link: Any = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=250, source_component=191)
    settings, airframe = flight.scenario.controller, flight.airframe
    inertia, largest = np.array(airframe.inertia_kg_m2), np.array(airframe.max_torque_n_m)
    rate_p = np.array([airframe.parameters[f"MC_{axis}RATE_P"] for axis in ("ROLL", "PITCH", "YAW")])
    rate_gain = rate_p * largest / inertia
    net = Pidnn(flight, largest / inertia)
    axes = (settings.position, settings.position, settings.altitude)
    k_p = np.array([g.k_p_per_s2 for g in axes])
    k_i = np.array([g.k_i_per_s3 for g in axes])
    k_d = np.array([g.k_d_per_s for g in axes])
    observer = settings.wind_observer
    bandwidth = np.array([observer.horizontal_rad_s, observer.horizontal_rad_s, observer.vertical_rad_s])
    share = 1.0 - np.exp(-bandwidth * TICK_S)
    follow = 1.0 - exp(-settings.angle_filter_rad_s * TICK_S)
    weight = np.array([0.0, 0.0, airframe.gravity_m_s2])
    integral, wind, last_velocity = np.zeros(3), np.zeros(3), np.zeros(3)
    thrust_n = airframe.mass_kg * airframe.gravity_m_s2
    filtered = np.zeros(2)
    ticks = 0
    while True:
        message = link.recv_match(type="ODOMETRY", blocking=True)
        position = np.array([message.x, message.y, message.z])
        velocity = np.array([message.vx, message.vy, message.vz])
        q = np.array(message.q)
        omega = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
        angles = euler(q)
        roll, pitch, yaw = angles
        angle_rates = np.array([
            [1.0, sin(roll) * tan(pitch), cos(roll) * tan(pitch)],
            [0.0, cos(roll), -sin(roll)],
            [0.0, sin(roll) / cos(pitch), cos(roll) / cos(pitch)],
        ]) @ omega  # fmt: skip
        # The observer of W_1..W_3.
        down = rotation(q)[:, 2]
        model = weight - down * thrust_n / airframe.mass_kg
        if ticks:
            wind += share * ((velocity - last_velocity) / TICK_S - model - wind)
        last_velocity = velocity
        # Eqs 18-26.
        error = HOVER_NED - position
        integral += TICK_S * error
        wanted = k_p * error + k_i * integral - k_d * velocity - wind
        lift = max(airframe.gravity_m_s2 - wanted[2], 0.1 * airframe.gravity_m_s2)
        horizontal = wanted[0:2]
        limit = tan(radians(settings.tilt_limit_deg)) * lift
        length = float(np.linalg.norm(horizontal))
        if length > limit:
            horizontal = horizontal * (limit / length)
        thrust_n = float(np.clip(airframe.mass_kg * lift / max(down[2], 0.5), 0.0, airframe.max_thrust_n))
        forward = cos(yaw) * horizontal[0] + sin(yaw) * horizontal[1]
        right = cos(yaw) * horizontal[1] - sin(yaw) * horizontal[0]
        tilt = np.array([atan2(right, sqrt(forward**2 + lift**2)), -atan2(forward, lift)])
        filtered += follow * (tilt - filtered)
        filtered_rates = settings.angle_filter_rad_s * (tilt - filtered)
        # Eqs 27-57, and the rates that make the rate loop give what they ask for.
        demand = net.update(angles, angle_rates, np.append(filtered, 0.0), np.append(filtered_rates, 0.0))
        rates = omega + demand / rate_gain
        link.mav.set_attitude_target_send(
            message.time_usec // 1000, 1, 1, 0x80, [1.0, 0.0, 0.0, 0.0], *rates, thrust_n / airframe.max_thrust_n
        )
        if ticks % 250 == 0:
            link.mav.heartbeat_send(18, 8, 0, 0, 4)
        ticks += 1
