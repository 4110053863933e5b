"""Airframes: the numbers of Table 2 and those the paper leaves out, each with its unit, read from TOML."""

from __future__ import annotations

from math import sqrt
from typing import Annotated

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0.0)]


class Airframe(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A quadrotor in the paper's plus layout: rotor 1 rear, 2 right, 3 front, 4 left (eq 9 in FLU axes).

    Rotors 1 and 3 turn clockwise seen from above, so their drag turns the body counter-clockwise (eq 9, third row).
    """

    title: str
    mass_kg: Positive
    arm_m: Positive
    rotor_inertia_kg_m2: NonNegative
    inertia_kg_m2: tuple[Positive, Positive, Positive]
    thrust_coefficient_n_s2: Positive
    drag_coefficient_n_m_s2: Positive
    rotor_radius_m: Positive
    air_density_kg_m3: Positive
    wind_coupling: NonNegative
    """kappa: the share of eq 4's wind force that acts; 1 is eq 4 as printed."""
    thrust_to_weight: Annotated[float, msgspec.Meta(gt=1.0)]
    rotor_time_constant_s: NonNegative
    """First-order lag of the rotor speed; 0 is an ideal rotor."""
    gravity_m_s2: Positive = 9.81
    battery_cells: Annotated[int, msgspec.Meta(ge=1, le=14)] = 3
    """Lithium-polymer cells in series."""
    battery_capacity_ah: Positive = 2.2
    battery_cell_resistance_ohm: NonNegative = 0.005
    """Internal resistance of one cell (BAT1_R_INTERNAL)."""
    battery_efficiency: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.6
    """Mechanical power at the rotors by electrical power: propeller drive and speed controller."""
    battery_hotel_w: NonNegative = 5.0
    """What the rest of the vehicle draws."""
    parameters: dict[str, float] = {}
    """PX4 parameters of this airframe that differ from the vehicle's defaults (e.g. MC_ROLLRATE_P)."""

    @property
    def weight_n(self) -> float:
        return self.mass_kg * self.gravity_m_s2

    @property
    def max_thrust_n(self) -> float:
        """Collective thrust, all four rotors at full speed: thrust 1.0 on the wire."""
        return self.thrust_to_weight * self.weight_n

    @property
    def max_rotor_speed_rad_s(self) -> float:
        return sqrt(self.max_thrust_n / (4.0 * self.thrust_coefficient_n_s2))

    @property
    def hover_rotor_speed_rad_s(self) -> float:
        return sqrt(self.weight_n / (4.0 * self.thrust_coefficient_n_s2))

    @property
    def max_torque_n_m(self) -> tuple[float, float, float]:
        """Torque 1.0 on the wire, roll, pitch, yaw: the most that eq 12 gives with rotors between 0 and full speed."""
        roll = self.arm_m * self.max_thrust_n / 4.0
        yaw = 2.0 * self.drag_coefficient_n_m_s2 * self.max_rotor_speed_rad_s**2
        return roll, roll, yaw
