"""The flight laws on the real plant, with no link and no modes between: a law in, the flown track out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from mavsitl_vehicle.autopilot.parameters import Parameters
from mavsitl_vehicle.autopilot.position import PositionControl
from mavsitl_vehicle.autopilot.setpoints import AttitudeSetpoint, PositionSetpoint, Setpoint, State
from mavsitl_vehicle.plant.state import ROTOR
from mavsitl_vehicle.simulation import Simulation
from numpy.typing import NDArray

from mavsitl.scenario import load

Array = NDArray[np.float64]

PERIOD_S = 0.004

GAINS: dict[str, dict[str, float]] = {
    "paper": {
        "MPC_XY_P": 2.0,
        "MPC_XY_VEL_P_ACC": 6.0,
        "MPC_XY_VEL_I_ACC": 3.0,
        "MPC_Z_P": 2.0,
        "MPC_Z_VEL_P_ACC": 10.0,
        "MPC_Z_VEL_I_ACC": 5.0,
    },
    "realistic": {
        "MPC_XY_P": 1.5,
        "MPC_XY_VEL_P_ACC": 5.0,
        "MPC_XY_VEL_I_ACC": 2.0,
        "MPC_Z_P": 1.5,
        "MPC_Z_VEL_P_ACC": 8.0,
        "MPC_Z_VEL_I_ACC": 4.0,
    },
}
"""What the airframes' inner loops are fast enough for."""

VALUES: dict[str, float] = {
    **GAINS["realistic"],
    "MPC_XY_VEL_D_ACC": 0.0,
    "MPC_Z_VEL_D_ACC": 0.0,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MPC_TILTMAX_AIR": 45.0,
    "MPC_THR_MIN": 0.12,
    "MPC_THR_MAX": 1.0,
    "MPC_THR_HOVER": 0.5,
    "MPC_THR_CURVE": 0.0,
    "MPC_ACC_HOR": 3.0,
    "MPC_ACC_HOR_MAX": 5.0,
    "MPC_ACC_UP_MAX": 4.0,
    "MPC_ACC_DOWN_MAX": 3.0,
    "MPC_JERK_AUTO": 4.0,
    "MPC_XY_CRUISE": 5.0,
    "MPC_Z_V_AUTO_UP": 3.0,
    "MPC_Z_V_AUTO_DN": 1.5,
    "MPC_TKO_SPEED": 1.5,
    "MPC_TKO_RAMP_T": 0.5,
    "MPC_LAND_SPEED": 0.7,
    "MPC_LAND_ALT1": 10.0,
    "MPC_LAND_ALT2": 5.0,
    "MPC_MAN_TILT_MAX": 35.0,
    "MPC_MAN_Y_MAX": 150.0,
    "MPC_VEL_MANUAL": 10.0,
    "MAN_DEADZONE": 0.1,
    "MPC_YAWRAUTO_MAX": 60.0,
    "MPC_YAWRAUTO_ACC": 20.0,
    "MPC_JERK_MAX": 8.0,
    "MPC_THR_XY_MARG": 0.3,
    "MPC_MANTHR_MIN": 0.08,
    "MC_ACRO_R_MAX": 100.0,
    "MC_ACRO_P_MAX": 100.0,
    "MC_ACRO_Y_MAX": 100.0,
}
"""PX4's defaults but for the gains of the cascade and the ramp of the take-off."""


class Rig:
    """One vehicle in the air at `height_m`, hovering, or on the ground with its rotors at rest."""

    def __init__(
        self,
        *,
        scenario: str = "takeoff-hover",
        airframe: str = "paper",
        height_m: float = 0.0,
        seed: int = 1,
        values: dict[str, float] | None = None,
        **changes: Any,
    ) -> None:
        """`changes` are scenario keys with "__" for dots; the sensors are as noisy as the scenario says."""
        overrides = {key.replace("__", "."): value for key, value in changes.items()}
        flight = load(
            scenario,
            {
                "airframe": airframe,
                "start.position_nwu_m": [0.0, 0.0, height_m],
                "start.clamp": False,
                "ground_contact": True,
                **overrides,
            },
        )
        frame = flight.airframe
        self.values = VALUES | GAINS[airframe] | (values or {})
        self.gravity_m_s2 = frame.gravity_m_s2
        self.hover_thrust = 1.0 / frame.thrust_to_weight
        parameters = Parameters(frame.parameters, flight.scenario.parameters)
        self.simulation = Simulation(flight, parameters, seed)
        if height_m > 0.0:
            self.simulation.x[ROTOR : ROTOR + 4] = frame.hover_rotor_speed_rad_s
        self.control = PositionControl(self.values, self.gravity_m_s2, self.hover_thrust, PERIOD_S)
        self.time_s = 0.0
        self.flown: Setpoint | None = None

    @property
    def state(self) -> State:
        return State.of(self.simulation.estimate[:, 0].tolist())

    @property
    def truth(self) -> Array:
        """Position NWU m, velocity NWU m/s, quaternion FLU -> NWU, omega FLU rad/s, rotors rad/s, (17,)."""
        return self.simulation.x[:, 0].copy()

    def fly(
        self, seconds: float, law: Callable[[State], Setpoint | PositionSetpoint], climb_limit_m_s: float = np.inf
    ) -> Array:
        """The track (ticks, 17): the truth after each tick of `law`, whose position setpoints the cascade flies."""
        track = np.empty((round(seconds / PERIOD_S), 17))
        for row in track:
            state = self.state
            setpoint = law(state)
            if isinstance(setpoint, PositionSetpoint):
                setpoint = self.control.update(setpoint, state, climb_limit_m_s)
            self.flown = setpoint
            self.simulation.set_demand(0, setpoint)
            self.simulation.advance(self.time_s)
            self.time_s += PERIOD_S
            row[:] = self.simulation.x[:, 0]
        return track

    def engage(self) -> None:
        """The cascade takes over from what was flown last."""
        self.control.engage(self.flown if isinstance(self.flown, AttitudeSetpoint) else None)
