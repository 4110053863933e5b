"""``{flight} SCENARIO``: a shipped scenario, flown when the page is built, drawn: path, wind, error, attitude."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from math import cos, isfinite, radians, sin
from pathlib import Path

import numpy as np
from docutils import nodes
from numpy.typing import NDArray
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata

from mavsitl import ends, scenario
from mavsitl.log.flight import FlightData

Array = NDArray[np.float64]

WIDTH, HEIGHT = 960, 400
PATH = (20.0, 20.0, 380.0, 360.0)
"""Left, top, width and height of the path's panel."""
LEFT, RIGHT = 500.0, 945.0
STRIP, FIRST, GAP = 84.0, 34.0, 40.0
SAMPLES = 700
SETTLED_S = 5.0
"""The paper's spiral starts 1 m beside its path."""
FLOWN = "#c2410c"
VIEW_RAD = radians(35.0), radians(28.0)
"""Azimuth and elevation from which the path is looked at."""


class FlightFigure(SphinxDirective):
    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        flight = scenario.load(self.arguments[0])
        with tempfile.TemporaryDirectory() as folder:
            outcome = ends.in_memory(flight, Path(folder), report=lambda text: None, progress=None)
            data = FlightData.from_folder(Path(folder), duration_s=flight.scenario.duration_s)
        if outcome.lost:
            raise self.error(f"{self.arguments[0]} was lost: {outcome.lost}")
        rms_cm = float(np.sqrt(np.mean(distance_cm(data)[data.time_s >= SETTLED_S] ** 2)))
        said = (
            f"{flight.scenario.title}, {flight.scenario.duration_s:g} s, flown when this page was built. "
            f"After the first {SETTLED_S:g} s it was {rms_cm:.1f} cm RMS from its reference (dashed)."
        )
        return [nodes.raw("", drawing(data, said), format="html"), nodes.caption("", said)]


def drawing(data: FlightData, label: str) -> str:
    """Lines take the page's own colour, so that it is read in light and dark."""
    step = max(1, len(data.time_s) // SAMPLES)
    time_s = data.time_s[::step]
    style = 'style="width: 100%; height: auto; font: 14px sans-serif" fill="currentColor" stroke="none"'
    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{label}" {style}>']
    parts += path_panel(data.position_nwu_m[::step], data.position_reference_nwu_m[::step])
    error_cm = distance_cm(data)[::step]
    error_cm[time_s < SETTLED_S] = np.nan
    strips: Sequence[tuple[str, Array, Array | None]] = (
        ("wind to the north, m/s", data.wind_nwu_m_s[::step, 0], None),
        ("distance from the reference, cm", error_cm, None),
        ("pitch, °: flown, and asked for", data.attitude_deg[::step, 1], data.attitude_reference_deg[::step, 1]),
    )
    for index, (text, values, asked) in enumerate(strips):
        parts += strip(text, time_s, values, asked, FIRST + index * (STRIP + GAP))
    parts.append(f'<text x="{RIGHT:g}" y="{HEIGHT - 8}" text-anchor="end">{time_s[-1]:.0f} s</text>')
    return "\n".join([*parts, "</svg>"])


def distance_cm(data: FlightData) -> Array:
    """(k,) from the reference."""
    error = data.position_nwu_m - data.position_reference_nwu_m
    return np.asarray(100.0 * np.linalg.norm(error, axis=1), dtype=np.float64)


def seen(points: Array) -> Array:
    """(k, 2) on the picture's plane, right and up, of points NWU (k, 3)."""
    azimuth, elevation = VIEW_RAD
    north, west, up = points.T
    right = -west * cos(azimuth) + north * sin(azimuth)
    away = north * cos(azimuth) + west * sin(azimuth)
    return np.column_stack((right, up * cos(elevation) + away * sin(elevation)))


def path_panel(flown: Array, reference: Array) -> list[str]:
    """The way flown over the reference, and its shadow on the ground."""
    lines = [seen(points) for points in (flown * (1.0, 1.0, 0.0), reference, flown)]
    every = np.concatenate(lines)
    low, high = every.min(axis=0), every.max(axis=0)
    left, top, width, height = PATH
    scale = min(width / (high[0] - low[0]), height / (high[1] - low[1]))
    margin = (width - scale * (high[0] - low[0])) / 2.0

    def placed(points: Array) -> str:
        x = left + margin + scale * (points[:, 0] - low[0])
        y = top + height - scale * (points[:, 1] - low[1])
        return polyline(x, y)

    shadow, asked, path = (placed(points) for points in lines)
    return [
        line(shadow, "currentColor", 1.0, 0.25),
        line(asked, "currentColor", 1.2, 0.6, "5 4"),
        line(path, FLOWN, 1.8, 1.0),
    ]


def strip(text: str, time_s: Array, values: Array, asked: Array | None, top: float) -> list[str]:
    """One chart over time, with its range at the left."""
    every = values if asked is None else np.concatenate((values, asked))
    low, high = min(float(np.nanmin(every)), 0.0), max(float(np.nanmax(every)), 0.0)
    x = LEFT + (RIGHT - LEFT) * (time_s - time_s[0]) / (time_s[-1] - time_s[0])

    def y(numbers: Array) -> Array:
        return top + STRIP - STRIP * (numbers - low) / (high - low)

    zero = float(y(np.zeros(1))[0])
    parts = [
        f'<text x="{LEFT:g}" y="{top - 9:g}">{text}</text>',
        f'<text x="{LEFT - 8:g}" y="{top + 9:g}" text-anchor="end">{high:.3g}</text>',
        f'<text x="{LEFT - 8:g}" y="{top + STRIP:g}" text-anchor="end">{low:.3g}</text>',
        line(f"{LEFT:g},{zero:.1f} {RIGHT:g},{zero:.1f}", "currentColor", 1.0, 0.3),
    ]
    if asked is not None:
        parts.append(line(polyline(x, y(asked)), "currentColor", 1.0, 0.6))
    parts.append(line(polyline(x, y(values)), FLOWN, 1.2, 1.0))
    return parts


def polyline(x: Array, y: Array) -> str:
    """Without what is not a number."""
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True) if isfinite(b))


def line(points: str, colour: str, width: float, opacity: float, dashes: str = "") -> str:
    dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
    return (
        f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{width:g}" '
        f'stroke-opacity="{opacity:g}"{dashed}/>'
    )


def setup(app: Sphinx) -> ExtensionMetadata:
    app.add_directive("flight", FlightFigure)
    return {"version": "1", "parallel_read_safe": True}
