"""The vehicle's own cascade: the reference is sent as it is, and the loops aboard do all."""

from __future__ import annotations

from mavsitl.controllers import PositionDemand, Reference, State


class Stock:
    """Position setpoints with velocity and acceleration fed forward: what is aboard without an off-board controller.

    The cascade is PX4's, with the airframe's MPC_* and MC_* parameters. To give it the paper's attitude setpoints in
    place of positions is the scenario's `controller.level = "attitude"`.
    """

    def update(self, time_s: float, state: State, reference: Reference) -> PositionDemand:
        return PositionDemand(reference.position, reference.velocity, reference.acceleration, reference.yaw)

    def reset(self) -> None:
        """It has no memory."""
