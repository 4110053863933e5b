"""What PX4's failure detector measures over time; `commander.FAILSAFES` says what follows from it."""

from __future__ import annotations

from math import isfinite, nan


class AltitudeLoss:
    """How far the vehicle has fallen while it was to hold its height or do better (PX4: FD_ALT_LOSS).

    Below its setpoint the loss counts from the highest point reached since it was there. Where only a climb or a
    descent is asked for, it counts from the highest point, which a descent that was asked for takes along.
    """

    def __init__(self) -> None:
        self.reference_m = nan

    def update(self, height_m: float, setpoint_m: float, climb_m_s: float, elapsed_s: float) -> float:
        """Metres lost, at least 0. NaN: the height is not known, or none, or no climb, is asked for."""
        reference = self.reference_m
        if not isfinite(height_m) or not (isfinite(setpoint_m) or isfinite(climb_m_s)):
            self.reference_m = nan
            return 0.0
        reference = max(reference, height_m) if isfinite(reference) else height_m
        if isfinite(setpoint_m):
            reference = max(min(reference, setpoint_m), height_m)
        else:
            reference = max(reference + min(climb_m_s, 0.0) * elapsed_s, height_m)
        self.reference_m = reference
        return reference - height_m
