"""The vehicle's parameters: PX4's names where the meaning is PX4's. One table; scenario or airframe override values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from mavsitl.scenario import ScenarioError


class Parameter(NamedTuple):
    default: float
    minimum: float
    maximum: float
    unit: str
    text: str


TABLE: dict[str, Parameter] = {
    "COM_OF_LOSS_T": Parameter(1.0, 0.0, 60.0, "s", "Off-board stream counts as lost after this silence"),
    "COM_OBL_RC_ACT": Parameter(
        0, 0, 7, "", "Action on off-board loss: 0-2 stick modes, 3 return, 4 land, 5 hold, 7 disarm"
    ),
    "COM_DISARM_LAND": Parameter(2.0, -1.0, 20.0, "s", "Auto-disarm after landing; negative: never"),
    "COM_DISARM_PRFLT": Parameter(10.0, -1.0, 60.0, "s", "Auto-disarm when armed and not taken off; negative: never"),
    "COM_SPOOLUP_TIME": Parameter(1.0, 0.0, 30.0, "s", "From arming to rotors at speed"),
    "MC_ROLL_P": Parameter(6.5, 0.0, 30.0, "1/s", "Roll angle error to roll rate"),
    "MC_PITCH_P": Parameter(6.5, 0.0, 30.0, "1/s", "Pitch angle error to pitch rate"),
    "MC_YAW_P": Parameter(2.8, 0.0, 10.0, "1/s", "Yaw angle error to yaw rate"),
    "MC_YAW_WEIGHT": Parameter(0.4, 0.0, 1.0, "", "Share of yaw in the attitude error, against roll and pitch"),
    "MC_ROLLRATE_MAX": Parameter(220.0, 0.0, 1800.0, "deg/s", "Largest roll rate that the attitude loop asks for"),
    "MC_PITCHRATE_MAX": Parameter(220.0, 0.0, 1800.0, "deg/s", "Largest pitch rate that the attitude loop asks for"),
    "MC_YAWRATE_MAX": Parameter(200.0, 0.0, 1800.0, "deg/s", "Largest yaw rate that the attitude loop asks for"),
    "MC_ROLLRATE_P": Parameter(0.32, 0.0, 5.0, "", "Roll rate error (rad/s) to torque (1 = MAX)"),
    "MC_ROLLRATE_I": Parameter(0.0, 0.0, 5.0, "", "Integral of the roll rate error to torque"),
    "MC_ROLLRATE_D": Parameter(0.0, 0.0, 0.1, "", "Roll acceleration to torque"),
    "MC_PITCHRATE_P": Parameter(0.32, 0.0, 5.0, "", "Pitch rate error (rad/s) to torque (1 = MAX)"),
    "MC_PITCHRATE_I": Parameter(0.0, 0.0, 5.0, "", "Integral of the pitch rate error to torque"),
    "MC_PITCHRATE_D": Parameter(0.0, 0.0, 0.1, "", "Pitch acceleration to torque"),
    "MC_YAWRATE_P": Parameter(4.0, 0.0, 50.0, "", "Yaw rate error (rad/s) to torque (1 = MAX)"),
    "MC_YAWRATE_I": Parameter(0.0, 0.0, 50.0, "", "Integral of the yaw rate error to torque"),
    "MC_YAWRATE_D": Parameter(0.0, 0.0, 0.1, "", "Yaw acceleration to torque"),
    "MC_RR_INT_LIM": Parameter(0.3, 0.0, 1.0, "", "Limit of the roll rate integral"),
    "MC_PR_INT_LIM": Parameter(0.3, 0.0, 1.0, "", "Limit of the pitch rate integral"),
    "MC_YR_INT_LIM": Parameter(0.3, 0.0, 1.0, "", "Limit of the yaw rate integral"),
    "MPC_XY_P": Parameter(0.95, 0.0, 2.0, "1/s", "Horizontal position error to velocity"),
    "MPC_XY_VEL_P_ACC": Parameter(1.8, 0.0, 15.0, "1/s", "Horizontal velocity error to acceleration"),
    "MPC_XY_VEL_I_ACC": Parameter(0.4, 0.0, 60.0, "1/s^2", "Integral of the horizontal velocity error"),
    "MPC_XY_VEL_MAX": Parameter(12.0, 0.0, 20.0, "m/s", "Largest horizontal velocity"),
    "MPC_Z_P": Parameter(1.0, 0.0, 2.0, "1/s", "Vertical position error to velocity"),
    "MPC_Z_VEL_P_ACC": Parameter(4.0, 0.0, 15.0, "1/s", "Vertical velocity error to acceleration"),
    "MPC_Z_VEL_I_ACC": Parameter(2.0, 0.0, 30.0, "1/s^2", "Integral of the vertical velocity error"),
    "MPC_Z_VEL_MAX_UP": Parameter(3.0, 0.5, 8.0, "m/s", "Largest climb"),
    "MPC_Z_VEL_MAX_DN": Parameter(1.5, 0.5, 4.0, "m/s", "Largest descent"),
    "MPC_TILTMAX_AIR": Parameter(45.0, 20.0, 89.0, "deg", "Largest tilt in the position loop"),
    "MPC_LAND_SPEED": Parameter(0.7, 0.6, 5.0, "m/s", "Descent in AUTO.LAND"),
}  # fmt: skip


class Parameters:
    """The values in force. Raises `ScenarioError` for a name or a value that the table does not allow."""

    def __init__(self, *layers: Mapping[str, float]) -> None:
        self._values = {name: parameter.default for name, parameter in TABLE.items()}
        for layer in layers:
            for name, value in layer.items():
                self._set(name, value)

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def as_dict(self) -> dict[str, float]:
        return dict(self._values)

    def _set(self, name: str, value: float) -> None:
        parameter = TABLE.get(name)
        if parameter is None:
            raise ScenarioError(f"parameters.{name}: no such parameter; known: {', '.join(TABLE)}")
        if not parameter.minimum <= value <= parameter.maximum:
            unit = f" {parameter.unit}" if parameter.unit else ""
            raise ScenarioError(
                f"parameters.{name}: {value:g}{unit} is not allowed; "
                f"allowed: {parameter.minimum:g} to {parameter.maximum:g}{unit}"
            )
        self._values[name] = float(value)
