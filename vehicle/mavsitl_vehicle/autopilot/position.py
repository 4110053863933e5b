"""The on-board position and velocity cascade that flies AUTO.LOITER and AUTO.LAND."""

from __future__ import annotations

from math import cos, radians, sin, sqrt, tan

from mavsitl.frames import Quaternion, Vector
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint


class PositionControl:
    """P on position, PI on velocity, acceleration to attitude and thrust. World NWU, body FLU; no clock, no message."""

    def __init__(self, parameters: Parameters, gravity_m_s2: float, hover_thrust: float, period_s: float) -> None:
        self._parameters = parameters
        self._gravity = gravity_m_s2
        self._hover_thrust = hover_thrust
        self._period_s = period_s
        self._integral: list[float] = [0.0, 0.0, 0.0]
        self._hold: Vector = (0.0, 0.0, 0.0)
        self._yaw_rad = 0.0

    def engage(self, position_nwu_m: Vector, yaw_rad: float, afresh: bool) -> None:
        """Hold this position and heading; `afresh` forgets the integrals of the position mode flown before."""
        self._hold = position_nwu_m
        self._yaw_rad = yaw_rad
        if afresh:
            self._integral = [0.0, 0.0, 0.0]

    def update(self, position_nwu_m: Vector, velocity_nwu_m_s: Vector, descend: bool) -> AttitudeSetpoint:
        """Hold the engaged position; with `descend`, sink at MPC_LAND_SPEED over it."""
        p = self._parameters
        x, y, z = position_nwu_m
        vx, vy, vz = velocity_nwu_m_s
        hx, hy, hz = self._hold
        sp_x, sp_y = p["MPC_XY_P"] * (hx - x), p["MPC_XY_P"] * (hy - y)
        speed = sqrt(sp_x * sp_x + sp_y * sp_y)
        if speed > p["MPC_XY_VEL_MAX"]:
            sp_x, sp_y = sp_x * p["MPC_XY_VEL_MAX"] / speed, sp_y * p["MPC_XY_VEL_MAX"] / speed
        sp_z = -p["MPC_LAND_SPEED"] if descend else p["MPC_Z_P"] * (hz - z)
        sp_z = min(max(sp_z, -p["MPC_Z_VEL_MAX_DN"]), p["MPC_Z_VEL_MAX_UP"])
        errors = (sp_x - vx, sp_y - vy, sp_z - vz)
        gains = (p["MPC_XY_VEL_P_ACC"], p["MPC_XY_VEL_P_ACC"], p["MPC_Z_VEL_P_ACC"])
        i_gains = (p["MPC_XY_VEL_I_ACC"], p["MPC_XY_VEL_I_ACC"], p["MPC_Z_VEL_I_ACC"])
        ax, ay, az = (gain * e + i for gain, e, i in zip(gains, errors, self._integral, strict=True))
        lift = max(self._gravity + az, 0.2 * self._gravity)
        tilt = sqrt(ax * ax + ay * ay)
        largest = lift * tan(radians(p["MPC_TILTMAX_AIR"]))
        if tilt > largest:
            ax, ay = ax * largest / tilt, ay * largest / tilt
        force = sqrt(ax * ax + ay * ay + lift * lift)
        thrust = force / self._gravity * self._hover_thrust
        for axis in range(3):
            if thrust < 1.0 or errors[axis] * self._integral[axis] < 0.0:
                limit = 0.5 * self._gravity
                value = self._integral[axis] + i_gains[axis] * errors[axis] * self._period_s
                self._integral[axis] = min(max(value, -limit), limit)
        return AttitudeSetpoint(_attitude(ax / force, ay / force, lift / force, self._yaw_rad), 0.0, min(thrust, 1.0))


def _attitude(zx: float, zy: float, zz: float, yaw_rad: float) -> Quaternion:
    """The attitude whose body z axis is the unit vector (zx, zy, zz), zz > 0: the shortest turn from that heading."""
    w = sqrt((1.0 + zz) / 2.0)
    x, y = -zy / (2.0 * w), zx / (2.0 * w)
    c, s = cos(yaw_rad / 2.0), sin(yaw_rad / 2.0)
    return (w * c, x * c + y * s, y * c - x * s, w * s)
