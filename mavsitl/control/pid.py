"""The outer loop: altitude and position PID, eqs 18-26, inverted into thrust, roll and pitch."""

from __future__ import annotations

import math

import numpy as np

from mavsitl.compiled import compiled
from mavsitl.control.arrays import Floats, Record, at, record
from mavsitl.scenario import Gains

LEAST_VERTICAL_SHARE = 0.1
"""The vertical specific force in eqs 25 and 26 is never taken below this share of gravity; at 0 they have a pole."""


@compiled
def position_step(
    position: Floats,
    velocity: Floats,
    quaternion: Floats,
    reference_position: Floats,
    reference_velocity: Floats,
    reference_acceleration: Floats,
    yaw: Floats,
    wind: Floats,
    parameters: Floats,
    integral: Floats,
    out: Floats,
) -> None:
    """`PositionLoop.update`: fills `out` (3, n), U_1, phi_d, theta_d. The last three are `PositionLoop.record`'s."""
    n = integral.shape[1]
    if (
        position.shape != integral.shape
        or velocity.shape != integral.shape
        or reference_position.shape != integral.shape
        or reference_velocity.shape != integral.shape
        or reference_acceleration.shape != integral.shape
        or wind.shape != integral.shape
        or quaternion.shape[0] != 4
        or quaternion.shape[1] != n
        or yaw.shape[0] != n
    ):
        raise ValueError("vectors must have shape (3, n), the quaternion (4, n), the yaw (n,)")
    z_p = parameters[0]
    z_i = parameters[1]
    z_d = parameters[2]
    xy_p = parameters[3]
    xy_i = parameters[4]
    xy_d = parameters[5]
    mass = parameters[6]
    gravity = parameters[7]
    tan_limit = parameters[8]
    cos_limit = parameters[9]
    max_thrust = parameters[10]
    period = parameters[11]
    least_vertical = parameters[12]
    for i in range(n):
        # Eqs 19 and 20; C_phi C_theta is the third diagonal element of R.
        error = reference_position[2, i] - position[2, i]
        rest = (
            z_p * error
            + z_d * (reference_velocity[2, i] - velocity[2, i])
            + reference_acceleration[2, i]
            + gravity
            - wind[2, i]
        )
        upright = 1.0 - 2.0 * (quaternion[1, i] * quaternion[1, i] + quaternion[2, i] * quaternion[2, i])
        if upright < cos_limit:
            upright = cos_limit
        candidate = integral[2, i] + period * error
        vertical = rest + z_i * candidate
        thrust = mass * vertical / upright
        if (thrust > max_thrust and error > 0.0) or (thrust < 0.0 and error < 0.0):
            vertical = rest + z_i * integral[2, i]
            thrust = mass * vertical / upright
        else:
            integral[2, i] = candidate
        if thrust > max_thrust:
            thrust = max_thrust
        elif thrust < 0.0:
            thrust = 0.0
        if vertical < least_vertical:
            vertical = least_vertical

        # Eqs 23 and 24.
        error_x = reference_position[0, i] - position[0, i]
        error_y = reference_position[1, i] - position[1, i]
        rest_x = (
            xy_p * error_x
            + xy_d * (reference_velocity[0, i] - velocity[0, i])
            + reference_acceleration[0, i]
            - wind[0, i]
        )
        rest_y = (
            xy_p * error_y
            + xy_d * (reference_velocity[1, i] - velocity[1, i])
            + reference_acceleration[1, i]
            - wind[1, i]
        )
        candidate_x = integral[0, i] + period * error_x
        candidate_y = integral[1, i] + period * error_y
        force_x = rest_x + xy_i * candidate_x
        force_y = rest_y + xy_i * candidate_y
        limit = tan_limit * vertical
        if force_x * force_x + force_y * force_y > limit * limit and error_x * force_x + error_y * force_y > 0.0:
            force_x = rest_x + xy_i * integral[0, i]
            force_y = rest_y + xy_i * integral[1, i]
        else:
            integral[0, i] = candidate_x
            integral[1, i] = candidate_y
        square = force_x * force_x + force_y * force_y
        if square > limit * limit:
            scale = limit / math.sqrt(square)
            force_x *= scale
            force_y *= scale

        # The third column of R, turned back by yaw, is (C_phi S_theta, -S_phi, C_phi C_theta).
        cosine = math.cos(yaw[i])
        sine = math.sin(yaw[i])
        forward = cosine * force_x + sine * force_y
        left = cosine * force_y - sine * force_x
        out[0, i] = thrust
        out[1, i] = math.atan2(-left, math.sqrt(forward * forward + vertical * vertical))
        out[2, i] = math.atan2(forward, vertical)


class PositionLoop:
    """Altitude PID (eqs 18-20) and position PID (eqs 21-26) of n vehicles; world NWU, attitude FLU to NWU.

    P_x, P_y, P_z are PIDs on acceleration (eqs 20, 23, 24; k_zP printed on the sum of eq 20 is k_zI), to which the
    reference's own acceleration is added (0 is the paper). With f = P - W + g e_z, wanted specific force:

        U_1 = m f_z / (C_phi C_theta)                              eq 19, measured attitude, clipped to [0, max]
        f' = f turned back by yaw
        theta_d = atan2(f'_x, f_z)                                 eq 26
        phi_d = atan2(-f'_y, sqrt(f'_x^2 + f_z^2))                 eq 25 with the factor that it leaves out

    The last two lines invert the first two rows of eq 11 exactly at any yaw. At yaw 0 theta_d is eq 26 and
    phi_d = -arctan((P_y - W_2) C_theta_d / (P_z + g - W_3)): eq 25 lacks C_theta_d, because eq 22 divides by C_theta
    what eq 11 does not.

    What eqs 18-26 leave open: the total tilt is limited by shortening f's horizontal part; f_z is at least a tenth of
    gravity in the angles (not in U_1); C_phi C_theta is at least the cosine of the tilt limit in eq 19, which needs it
    to differ from 0; an integrator stands still while its output is limited and its error pushes further.
    """

    def __init__(
        self,
        gains_z: Gains,
        gains_xy: Gains,
        mass_kg: float,
        gravity_m_s2: float,
        tilt_limit_rad: float,
        max_thrust_n: float,
        period_s: float,
        n: int = 1,
    ) -> None:
        """Raises `ValueError` for a tilt limit outside (0, pi/2), or a mass, gravity, thrust or period not > 0."""
        if not 0.0 < tilt_limit_rad < math.pi / 2:
            raise ValueError(f"tilt_limit_rad: {tilt_limit_rad} is not allowed; allowed: more than 0, less than pi/2")
        if not min(mass_kg, gravity_m_s2, max_thrust_n, period_s) > 0.0:
            raise ValueError("mass_kg, gravity_m_s2, max_thrust_n and period_s must be greater than 0")
        self._parameters = np.array(
            [
                gains_z.k_p_per_s2,
                gains_z.k_i_per_s3,
                gains_z.k_d_per_s,
                gains_xy.k_p_per_s2,
                gains_xy.k_i_per_s3,
                gains_xy.k_d_per_s,
                mass_kg,
                gravity_m_s2,
                math.tan(tilt_limit_rad),
                math.cos(tilt_limit_rad),
                max_thrust_n,
                period_s,
                LEAST_VERTICAL_SHARE * gravity_m_s2,
            ]
        )
        self.integral_m_s = np.zeros((3, n))
        """Sum of t_s e, (3, n), m s, NWU."""
        self._out = np.zeros((3, n))
        self._outputs = (self._out[0], self._out[1], self._out[2])

    def update(
        self,
        position_nwu_m: Floats,
        velocity_nwu_m_s: Floats,
        quaternion: Floats,
        reference_position_nwu_m: Floats,
        reference_velocity_nwu_m_s: Floats,
        reference_acceleration_nwu_m_s2: Floats,
        yaw_rad: Floats,
        wind_acceleration_nwu_m_s2: Floats,
    ) -> tuple[Floats, Floats, Floats]:
        """One period: thrust U_1 in N, phi_d and theta_d in rad, each (n,), overwritten by the next call.

        Vectors (3, n); quaternion (4, n), scalar first, body FLU to world NWU, unit; `wind_acceleration_nwu_m_s2` is
        W_1..W_3 of eq 11. `yaw_rad` (n,) is the yaw that phi_d and theta_d are flown at: the measured yaw where roll
        and pitch are tracked as angles (eqs 27-57), the reference yaw where the three become one attitude setpoint.

        Raises `ValueError` for a wrong shape.
        """
        position_step(
            position_nwu_m,
            velocity_nwu_m_s,
            quaternion,
            reference_position_nwu_m,
            reference_velocity_nwu_m_s,
            reference_acceleration_nwu_m_s2,
            yaw_rad,
            wind_acceleration_nwu_m_s2,
            self._parameters,
            self.integral_m_s,
            self._out,
        )
        return self._outputs

    def record(self) -> Record:
        """What `position_step` takes beside its inputs, as it stands, by the names of its parameters."""
        return record(parameters=self._parameters, integral=self.integral_m_s, out=self._out)

    def reset(self, vehicle: int | None = None) -> None:
        """Empty the integrators of one vehicle, or of all."""
        self.integral_m_s[:, at(vehicle)] = 0.0
        self._out[:, at(vehicle)] = 0.0
