"""Is the vehicle on the ground, taking off or in the air? And the clamp that may hold it before its flight."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot

from mavsitl.dialect import mavlink

ON_GROUND: int = mavlink.MAV_LANDED_STATE_ON_GROUND
IN_AIR: int = mavlink.MAV_LANDED_STATE_IN_AIR
TAKING_OFF: int = mavlink.MAV_LANDED_STATE_TAKEOFF
LANDING: int = mavlink.MAV_LANDED_STATE_LANDING

TAKEOFF_THRUST_SHARE = 0.9
"""Of the hover thrust: above it, a spooled-up vehicle on the ground counts as taking off."""
LOW_THRUST_SHARE = 0.5
"""Of the hover thrust: below it, a vehicle that rests on the ground has landed, whatever its mode."""
LANDED_HEIGHT_M = 0.05
LANDED_SPEED_M_S = 0.15
AIRBORNE_HEIGHT_M = 0.15
LANDING_TIME_US = 300_000
UNSURE_LANDING_TIME_US = 1_000_000
"""Where the height is not known to a few centimetres (PX4's LNDMC_TRIG_TIME)."""
FILTER_S = 0.3


class LandDetector:
    """One vehicle's.

    Attributes:
        state: ON_GROUND, TAKING_OFF or IN_AIR.
        on_ground: the state is ON_GROUND.
        held: in the clamp.
        released_us: when the clamp opened or the take-off began, the flight's time zero; None: not yet.
    """

    def __init__(self, hover_thrust: float, period_s: float, *, clamped: bool, knows_height: bool = True) -> None:
        """`knows_height`: the ground is at height 0. Else the take-off tells where it was, and a landing is what
        stands still on little thrust.
        """
        self.state = ON_GROUND
        self.on_ground = True
        self.held = clamped
        self.released_us: int | None = None
        self._hover_thrust = hover_thrust
        self._knows_height = knows_height
        self._ground_m = 0.0
        self._still_since_us: int | None = None
        self._smooth = (0.0, 0.0, 0.0, 0.0)
        """Height and velocity, with the sensors' noise filtered out."""
        self._share = min(period_s / FILTER_S, 1.0)

    def update(
        self, now_us: int, estimate: Sequence[float], thrust: float, armed: bool, ready: bool, landing: bool
    ) -> bool:
        """One period; whether the take-off began in it.

        `thrust` is the collective demanded, `ready`: the rotors are at speed, `landing`: the vehicle means to touch
        down.
        """
        share = self._share
        z, vx, vy, vz = self._smooth
        z += share * (estimate[2] - z)
        vx += share * (estimate[3] - vx)
        vy += share * (estimate[4] - vy)
        vz += share * (estimate[5] - vz)
        self._smooth = z, vx, vy, vz
        if not self.on_ground:
            if z - self._ground_m > AIRBORNE_HEIGHT_M:
                self.state = IN_AIR
                if self._knows_height:
                    self._still_since_us = None
                    return False
            little = not armed or thrust < LOW_THRUST_SHARE * self._hover_thrust
            self._watch(now_us, little or (landing and self._knows_height))
            return False
        if not (armed and ready and thrust >= TAKEOFF_THRUST_SHARE * self._hover_thrust):
            return False
        self._become(IN_AIR if self.held else TAKING_OFF)
        self.held = False
        self.released_us = now_us
        if not self._knows_height:
            self._ground_m = self._smooth[0]
        self._still_since_us = None
        return True

    def _watch(self, now_us: int, landing: bool) -> None:
        """Low, or at a height that is not known: does it stand still?"""
        z, vx, vy, vz = self._smooth
        low = z < LANDED_HEIGHT_M or not self._knows_height
        still = low and abs(vz) < LANDED_SPEED_M_S and hypot(vx, vy) < LANDED_SPEED_M_S
        if not (still and landing):
            self._still_since_us = None
        elif self._still_since_us is None:
            self._still_since_us = now_us
        elif now_us - self._still_since_us >= (LANDING_TIME_US if self._knows_height else UNSURE_LANDING_TIME_US):
            self._become(ON_GROUND)

    def put_back(self) -> None:
        """The clamp has taken the vehicle again."""
        self.held = True
        self._become(ON_GROUND)

    def _become(self, state: int) -> None:
        self.state = state
        self.on_ground = state == ON_GROUND
