"""Blow every model at once and write the bytes to standard output; test_field runs it with MAVSITL_JIT=0."""

from __future__ import annotations

import sys

from mavsitl_vehicle.wind.dryden import Array

from mavsitl.scenario import DrydenMil, DrydenPaper, Gust, Steady
from tests.wind.turbulence import blow

EVERYTHING = (
    Steady(velocity_nwu_m_s=(1.0, 0.3, -0.1)),
    Gust(velocity_nwu_m_s=(2.0, 1.0, 0.5), start_s=0.1, length_s=0.7),
    Gust(velocity_nwu_m_s=(-2.0, 1.0, 0.5), start_s=0.0, length_s=0.3, shape="ramp"),
    DrydenPaper(),
    DrydenPaper(form="spectrum", intensity="unit"),
    DrydenMil(speed_20ft_m_s=7.0, altitude_m=2.0, from_deg=40.0, include_mean=True),
)


def blow_everything() -> Array:
    return blow(EVERYTHING, 16, 0.01, 200)


if __name__ == "__main__":
    sys.stdout.buffer.write(blow_everything().tobytes())
