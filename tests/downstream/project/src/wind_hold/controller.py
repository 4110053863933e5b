"""A stiff position controller with an integral: it takes out what stays, wind and weight."""

import numpy as np

from mavsitl.controllers import AttitudeDemand

REACH_M = 0.2
"""A farther error is not answered by more."""
PROPORTIONAL, INTEGRAL, DERIVATIVE = 25.0, 25.0, 8.0  # 1/s², 1/s³, 1/s


class WindHold:
    def __init__(self, airframe, period_s):
        self.mass_kg = airframe.mass_kg
        self.gravity = np.array((0.0, 0.0, airframe.gravity_m_s2))
        self.period_s = period_s
        self.reset()

    def reset(self):
        self.integral = np.zeros(3)

    def update(self, time_s, state, reference):
        error = np.clip(reference.position - state.position, -REACH_M, REACH_M)
        self.integral = self.integral + INTEGRAL * error * self.period_s
        wanted = PROPORTIONAL * error + DERIVATIVE * (reference.velocity - state.velocity) + self.integral
        force = self.mass_kg * (wanted + reference.acceleration + self.gravity)
        return AttitudeDemand.along(force, reference.yaw)

    def log(self):
        return self.integral
