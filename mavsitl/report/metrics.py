"""The paper's measures: RMSE of the six states, and Tables 3 and 4 as data."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from mavsitl.log.flight import FlightData
from mavsitl.scenario import DrydenPaper, Hover, Scenario, Spiral


@dataclass(frozen=True)
class States:
    """One number for each state: position errors in m, attitude errors in degrees."""

    x_m: float
    y_m: float
    z_m: float
    phi_deg: float
    theta_deg: float
    psi_deg: float

    def values(self) -> tuple[float, float, float, float, float, float]:
        """x, y, z, phi, theta, psi."""
        return astuple(self)


class Rmse(States):
    """Root mean square errors over the flight."""


class MaximumError(States):
    """Largest absolute errors over the flight."""


LABELS = ("x", "y", "z", "φ", "θ", "ψ")
UNITS = ("m", "m", "m", "°", "°", "°")

PAPER_TABLES: dict[str, Rmse] = {
    "hover-calm": Rmse(8.942e-3, 8.534e-3, 2.333e-2, 3.394e-2, 3.357e-2, 2.071e-2),
    "hover-wind": Rmse(9.072e-2, 8.675e-2, 0.124, 0.373, 0.392, 0.143),
    "spiral-calm": Rmse(0.109, 8.074e-2, 0.164, 0.369, 0.226, 2.196e-2),
    "spiral-wind": Rmse(0.479, 0.234, 0.409, 1.099, 1.178, 0.236),
}
"""Table 3 (hover) and Table 4 (spiral)."""


def rmse(flight: FlightData) -> Rmse:
    """Against the truth; position against the reference, attitude against the commanded angles."""
    position = np.sqrt(np.mean(np.square(flight.position_error_nwu_m()), axis=0))
    attitude = np.sqrt(np.mean(np.square(flight.attitude_error_deg()), axis=0))
    return Rmse(*map(float, position), *map(float, attitude))


def maximum_error(flight: FlightData) -> MaximumError:
    """The errors whose mean square `rmse` takes, at their largest."""
    position = np.max(np.abs(flight.position_error_nwu_m()), axis=0)
    attitude = np.max(np.abs(flight.attitude_error_deg()), axis=0)
    return MaximumError(*map(float, position), *map(float, attitude))


@dataclass(frozen=True)
class Aftermath:
    """The worst of a flight from some moment on."""

    position_m: float
    """Largest distance from the reference."""
    altitude_m: float
    """Largest height below the reference."""
    tilt_deg: float
    yaw_rate_deg_s: float
    """Largest, of the heading, by its change over a tenth of a second."""


def aftermath(flight: FlightData, from_s: float) -> Aftermath:
    """From `from_s` on, which is within the flight."""
    rows = flight.time_s >= from_s
    error = flight.position_error_nwu_m()[rows]
    angles = np.radians(flight.attitude_deg[rows])
    tilt = np.degrees(np.arccos(np.clip(np.cos(angles[:, 0]) * np.cos(angles[:, 1]), -1.0, 1.0)))
    time_s, heading = flight.time_s[rows], np.unwrap(angles[:, 2])
    later = np.minimum(np.searchsorted(time_s, time_s + 0.1 - 1e-9), time_s.size - 1)
    span_s = time_s[later] - time_s
    turning = np.degrees(np.abs(heading[later] - heading))[span_s > 0.05] / span_s[span_s > 0.05]
    return Aftermath(
        position_m=float(np.max(np.linalg.norm(error, axis=1))),
        altitude_m=float(np.max(-error[:, 2])),
        tilt_deg=float(np.max(tilt)),
        yaw_rate_deg_s=float(np.max(turning, initial=0.0)),
    )


def paper_case(scenario: Scenario) -> str | None:
    """The part of Tables 3 and 4 that a scenario answers to, by path, start, air and duration; else None."""
    if scenario.duration_s != 60.0 or scenario.failures:
        return None
    if scenario.reference == Hover() and scenario.start.position_nwu_m == (0.0, 0.0, 1.0):
        path = "hover"
    elif scenario.reference == Spiral() and scenario.start.position_nwu_m == (0.0, 0.0, 0.0):
        path = "spiral"
    else:
        return None
    if scenario.wind == ():
        return f"{path}-calm"
    if scenario.wind == (DrydenPaper(),):
        return f"{path}-wind"
    return None
