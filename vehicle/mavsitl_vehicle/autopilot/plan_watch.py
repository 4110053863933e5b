"""What the plan means where the vehicle is: the fence on the local plane, and whether the mission could be flown."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from mavsitl.frames import Vector
from mavsitl.geodesy import Origin
from mavsitl.services.mission import FENCE, MISSION, RALLY
from mavsitl_vehicle.autopilot.fence import NO_LIMITS, Fence, FenceLimits
from mavsitl_vehicle.autopilot.plan import FeasibilityContext, Finding, Home, VehiclePlan
from mavsitl_vehicle.autopilot.position import Values

MAX_TOLD = 3
"""Findings of one mission that are said; the first fatal one is said again by every refusal."""


class PlanWatch:
    """Asked ten times a second, and by commands; it looks again only where something changed.

    Attributes:
        mission_refusal: why AUTO.MISSION would not fly; None when it would.
        mission_failure: the same without fence and limits, which have a fail-safe of their own.
        rally_nwu_m: the rally points.
    """

    def __init__(self, plan: VehiclePlan, origin: Origin, parameters: Values, tell: Callable[[str], None]) -> None:
        """`tell` gets what is wrong, or looks wrong, with a mission that has just come."""
        self.mission_refusal: str | None = "no mission"
        self.mission_failure: str | None = "no mission"
        self.rally_nwu_m: tuple[Vector, ...] = ()
        self._plan = plan
        self._origin = origin
        self._parameters = parameters
        self._tell = tell
        self._home: Vector | None = None
        self._fence = Fence((), origin)
        self._fence_id = 0
        self._rally_seen: tuple[object, ...] = ()
        self._mission_seen: tuple[object, ...] = ()
        self._mission_told = 0

    @property
    def fenced(self) -> bool:
        """There are zones, and a breach has consequences."""
        return bool(self._fence) and self.acts

    @property
    def acts(self) -> bool:
        """GF_ACTION is not "none"."""
        return self._parameters["GF_ACTION"] > 0

    @property
    def stale(self) -> bool:
        """Another mission or fence has come since the last look."""
        stores = self._plan.stores
        return self._mission_seen[:2] != (stores.id(MISSION), stores.id(FENCE))

    def breach(self, position_nwu_m: Vector) -> str | None:
        """Why the fence does not allow a position, whatever GF_ACTION is; None where it does, or home is not known."""
        if self._home is None:
            return None
        hx, hy, hz = self._home
        x, y, z = position_nwu_m
        breach = self._fence.breach(x, y, z - hz, hx, hy, self._limits)
        return None if breach is None else breach.text

    def refresh(self, home_nwu_m: Vector | None, on_ground: bool) -> None:
        """Look at what changed since the last time."""
        self._home = home_nwu_m
        stores, p = self._plan.stores, self._parameters
        fence_id = stores.id(FENCE)
        if fence_id != self._fence_id:
            self._fence_id = fence_id
            self._fence = self._plan.fence(self._origin)
        rally = (stores.id(RALLY), home_nwu_m)
        if rally != self._rally_seen:
            self._rally_seen = rally
            self.rally_nwu_m = self._rally()
        limits = self._limits if self.acts else NO_LIMITS
        seen = (
            stores.id(MISSION), fence_id, self.acts, limits, home_nwu_m, on_ground,
            p["MIS_TKO_LAND_REQ"], p["MIS_DIST_1WP"], p["MIS_TAKEOFF_ALT"],
        )  # fmt: skip
        if seen != self._mission_seen:
            self._mission_seen = seen
            self._judge(on_ground, limits)

    @property
    def _limits(self) -> FenceLimits:
        return FenceLimits(self._parameters["GF_MAX_HOR_DIST"], self._parameters["GF_MAX_VER_DIST"])

    def _rally(self) -> tuple[Vector, ...]:
        origin = self._origin
        home_amsl_m = origin.altitude_amsl_m + (0.0 if self._home is None else self._home[2])
        return tuple(
            (*origin.to_local(point.latitude_deg, point.longitude_deg), point.altitude_amsl_m - origin.altitude_amsl_m)
            for point in self._plan.rally_points(home_amsl_m)
        )

    def _judge(self, on_ground: bool, limits: FenceLimits) -> None:
        stores, p, home = self._plan.stores, self._parameters, None
        if self._home is not None:
            x, y, z = self._home
            home = Home(*self._origin.to_global(x, y), self._origin.altitude_amsl_m + z)
        context = FeasibilityContext(
            on_ground, home, self._origin, self._fence if self.acts else None, limits,
            p["MIS_DIST_1WP"], int(p["MIS_TKO_LAND_REQ"]), p["MIS_TAKEOFF_ALT"],
        )  # fmt: skip
        findings = self._plan.feasibility(context)
        self.mission_refusal = self.mission_failure = _first_fatal(findings)
        if self.mission_refusal is not None:
            self.mission_failure = _first_fatal(self._plan.feasibility(context._replace(fence=None, limits=NO_LIMITS)))
        if stores.items(MISSION) and stores.id(MISSION) != self._mission_told:
            self._mission_told = stores.id(MISSION)
            for finding in findings[:MAX_TOLD]:
                self._tell(f"Mission: {finding.text}")


def _first_fatal(findings: Iterable[Finding]) -> str | None:
    return next((finding.text for finding in findings if finding.fatal), None)
