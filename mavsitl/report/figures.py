"""The paper's figures from our flights, as SVG text, by matplotlib's objects alone: no pyplot, no global state."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from mavsitl.log.flight import Array, Broken, FlightData

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Flights: TypeAlias = Sequence[tuple[str, str, FlightData]]
"""(label, colour, flight) of what is drawn into one figure."""

POINTS = 1200
CALM = "#2166ac"
WIND = "#d6604d"
REFERENCE = "#1b1b1f"
UNDERNEATH = "#a9abb8"
BROKEN = "#a3241b"
_TERMS = ("#2166ac", "#d6604d", "#1b7837")
_WIDTH_IN = 9.0
_HALF_WIDTH_IN = 5.8

_STYLE: dict[str, Any] = {
    "svg.fonttype": "path",
    "svg.hashsalt": "mavsitl",
    "path.simplify_threshold": 0.2,
    "font.size": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#9a9aa5",
    "axes.labelcolor": "#26262b",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e7e7ec",
    "grid.linewidth": 0.8,
    "xtick.color": "#5c5c66",
    "ytick.color": "#5c5c66",
    "lines.linewidth": 1.1,
    "lines.solid_joinstyle": "round",
    "legend.frameon": False,
}


@dataclass(frozen=True)
class Drawing:
    """A figure for the page."""

    svg: str
    caption: str
    counterpart: str
    """E.g. ``Fig. 7``; empty where the paper has no such figure."""
    half: bool = False
    """Drawn for half the page's width, so that two stand side by side."""


def decimate(time: Array, values: Array, points: int = POINTS) -> tuple[Array, Array]:
    """At most `points` of (k,) samples: the least and the largest of each stretch, so that no peak is lost."""
    size = time.size
    if size <= points:
        return time, values
    edges = np.linspace(0, size, points // 2 + 1).astype(np.int64)
    stretch = np.repeat(np.arange(edges.size - 1), np.diff(edges))
    # Sorted by value within each stretch, the first is the least and the last the largest; NaN where all are NaN.
    low = np.lexsort((np.where(np.isnan(values), np.inf, values), stretch))[edges[:-1]]
    high = np.lexsort((np.where(np.isnan(values), -np.inf, values), stretch))[edges[1:] - 1]
    chosen = np.unique(np.concatenate((low, high)))
    return time[chosen], values[chosen]


def wind(flight: FlightData, counterpart: str) -> Drawing:
    """u, v, w along x, y, z."""

    def draw(figure: Figure) -> None:
        for axes, axis, name in zip(_grid(figure, 3, 1).flat, range(3), "uvw", strict=True):
            _line(axes, flight.time_s, flight.wind_nwu_m_s[:, axis], WIND)
            axes.set_ylabel(f"{name} / (m/s)")
            _mark([axes], flight)

    return Drawing(svg(draw, 4.2, "wind"), "Wind along x, y and z at the vehicle", counterpart)


def altitude(flights: Flights, counterpart: str) -> Drawing:
    def draw(figure: Figure) -> None:
        axes = _grid(figure, 1, 1, legend=True)[0, 0]
        _axis_against_reference(axes, flights, 2)
        axes.set_ylabel("z / m")
        _legend(figure, axes)

    return Drawing(svg(draw, 2.9, "altitude"), "Altitude", counterpart)


def horizontal(flights: Flights, counterpart: str) -> Drawing:
    def draw(figure: Figure) -> None:
        rows = _grid(figure, 2, 1, legend=True)[:, 0]
        for axes, axis in zip(rows, range(2), strict=True):
            _axis_against_reference(axes, flights, axis)
            axes.set_ylabel(f"{'xy'[axis]} / m")
        _legend(figure, rows[0])

    return Drawing(svg(draw, 3.9, "horizontal"), "Horizontal position", counterpart)


def position(flights: Flights, counterpart: str) -> Drawing:
    def draw(figure: Figure) -> None:
        rows = _grid(figure, 3, 1, legend=True)[:, 0]
        for axes, axis in zip(rows, range(3), strict=True):
            _axis_against_reference(axes, flights, axis)
            axes.set_ylabel(f"{'xyz'[axis]} / m")
        _legend(figure, rows[0])

    return Drawing(svg(draw, 5.2, "position"), "Position by axis", counterpart)


def dress_space(axes: Any, *, labelpad: int, height: float, zoom: float, elevation: int) -> None:
    """Labels, view and planes of 3D axes; `height` in multiples of the width."""
    axes.set_xlabel("x / m", labelpad=labelpad)
    axes.set_ylabel("y / m", labelpad=labelpad)
    axes.set_zlabel("z / m", labelpad=labelpad - 2)
    axes.set_box_aspect((1.0, 1.0, height), zoom=zoom)
    axes.view_init(elev=elevation, azim=-55)
    for plane in (axes.xaxis, axes.yaxis, axes.zaxis):
        plane.pane.set_facecolor("#fafafc")
        plane.pane.set_edgecolor("#d4d4da")


def path_3d(flights: Flights, counterpart: str) -> Drawing:
    def draw(figure: Figure) -> None:
        axes: Any = figure.add_axes((0.12, 0.0, 0.76, 0.98), projection="3d", computed_zorder=False)
        for label, colour, flight in flights:
            axes.plot(*_track(flight.position_nwu_m), color=colour, label=label, linewidth=1.2, zorder=2)
            for broken in _during(flight):
                row = min(int(np.searchsorted(flight.time_s, broken.start_s)), flight.time_s.size - 1)
                axes.plot(*flight.position_nwu_m[row], marker="X", color=BROKEN, zorder=4)
        axes.plot(
            *_track(flights[0][2].position_reference_nwu_m),
            color=REFERENCE,
            linestyle=(0, (4, 3)),
            label="reference",
            zorder=3,
        )
        dress_space(axes, labelpad=8, height=0.85, zoom=0.95, elevation=22)
        figure.legend(*axes.get_legend_handles_labels(), loc="upper left", ncols=1)

    return Drawing(svg(draw, 6.2, "path"), "Path in space", counterpart)


def attitude(flight: FlightData, colour: str, air: str, counterpart: str) -> Drawing:
    """Left the angle on the commanded angle, right the difference, which the RMSE takes."""

    def draw(figure: Figure) -> None:
        error = flight.attitude_error_deg()
        grid = _grid(figure, 3, 2, legend=True, widths=(1.6, 1.0))
        for row, name in enumerate("φθψ"):
            left, right = grid[row]
            # Underneath and thick: the two lie on one another, and a dashed line would hide the thin one.
            _line(left, flight.time_s, flight.attitude_reference_deg[:, row], UNDERNEATH, label="commanded", width=2.6)
            _line(left, flight.time_s, flight.attitude_deg[:, row], colour, label=air, width=0.9)
            _line(right, flight.time_s, error[:, row], colour)
            left.set_ylabel(f"{name} / °")
            right.set_ylabel(f"{name} error / °")
            _mark((left, right), flight)
        _time_axis(grid[2], flight.time_s)
        _legend(figure, grid[0][0])

    return Drawing(svg(draw, 5.2, "attitude"), f"Attitude and its tracking error, {air}", counterpart)


def weights(flight: FlightData, air: str) -> Drawing | None:
    """The output weights of the three PIDNNs over their first values; None for a law without weights."""
    if flight.weights is None:
        return None
    table = flight.weights
    known = np.flatnonzero(~np.isnan(table).any(axis=(1, 2)))
    if not known.size:
        return None
    initial = table[known[0]]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(initial == 0.0, np.nan, table / initial)

    def draw(figure: Figure) -> None:
        columns = _grid(figure, 1, 3, legend=True, titles=True, share_y=True, gap_in=0.2)[0]
        for net, axes in enumerate(columns):
            for term, colour in enumerate(_TERMS):
                _line(axes, flight.time_s, ratio[:, net, term], colour, label="PID"[term])
            axes.set_title(("roll", "pitch", "yaw")[net], fontsize=10, color="#26262b")
        _mark(columns, flight)
        columns[0].set_ylabel("weight / initial weight")
        _time_axis(columns, flight.time_s)
        _legend(figure, columns[0])

    return Drawing(svg(draw, 2.5, "weights", _HALF_WIDTH_IN), f"PIDNN output weights, {air}", "", half=True)


def rotors(flight: FlightData, colour: str, air: str) -> Drawing | None:
    if flight.rotor_speed_rad_s is None:
        return None
    labels = [f"rotor {n} / (rad/s)" for n in range(1, 5)]
    svg = _four(flight, flight.rotor_speed_rad_s, colour, labels, share=True, name="rotors")
    return Drawing(svg, f"Rotor speeds (1 rear, 2 right, 3 front, 4 left), {air}", "", half=True)


def demand(flight: FlightData, colour: str, air: str) -> Drawing | None:
    if flight.demand is None:
        return None
    labels = ["$U_1$ / N", "$U_2$ / N", "$U_3$ / N", "$U_4$ / (N m)"]
    svg = _four(flight, flight.demand, colour, labels, share=False, name="demand")
    return Drawing(svg, f"Control demand (eq 12), {air}", "", half=True)


def link(flight: FlightData, colour: str, air: str) -> Drawing | None:
    if flight.link is None:
        return None
    status = flight.link

    def draw(figure: Figure) -> None:
        left, right = _grid(figure, 1, 2, legend=True)[0]
        _line(left, flight.time_s, status.state_age_ms, colour)
        left.set_ylabel("age of the state / ms")
        left.set_ylim(bottom=0.0)
        _line(right, flight.time_s, status.lost, _TERMS[1], label="lost")
        _line(right, flight.time_s, status.bad, _TERMS[2], label="bad", dashed=True)
        right.set_ylabel("frames")
        right.set_ylim(bottom=0.0)
        right.yaxis.get_major_locator().set_params(integer=True)
        _mark((left, right), flight)
        _time_axis((left, right), flight.time_s)
        _legend(figure, right)

    return Drawing(svg(draw, 2.3, "link", _HALF_WIDTH_IN), f"Link to the ground, {air}", "", half=True)


def channels(flight: FlightData, air: str) -> Drawing | None:
    """What an impaired link did, second by second, outages shaded by the share of messages that fell into them."""
    if not flight.channels:
        return None

    def draw(figure: Figure) -> None:
        top, bottom = _grid(figure, 2, 1, legend=True)[:, 0]
        for (direction, log), colour in zip(flight.channels.items(), _TERMS, strict=False):
            sent = np.maximum(log.sent, 1.0)
            name = direction.replace("_", " ")
            _line(top, log.time_s, 100.0 * log.lost / sent, colour, label=name)
            _line(bottom, log.time_s, log.delay_p50_ms, colour)
            _line(bottom, log.time_s, log.delay_p99_ms, colour, dashed=True)
            starts_s = np.concatenate(([0.0], log.time_s[:-1]))
            for start_s, end_s, share in zip(starts_s, log.time_s, log.outage / sent, strict=True):
                if share > 0.0:
                    for axes in (top, bottom):
                        axes.axvspan(start_s, end_s, color=colour, alpha=0.25 * share, linewidth=0.0)
        top.set_ylabel("lost / %")
        bottom.set_ylabel("delay / ms")
        for axes in (top, bottom):
            axes.set_ylim(bottom=0.0)
        _time_axis((top, bottom), flight.time_s)
        _legend(figure, top)

    caption = f"Off-board link: loss and delay (median, and dashed the 99th percentile) each second, {air}"
    return Drawing(svg(draw, 3.2, "channels"), caption, "")


def _four(flight: FlightData, values: Array, colour: str, labels: list[str], *, share: bool, name: str) -> str:
    def draw(figure: Figure) -> None:
        grid = _grid(figure, 2, 2, share_y=share)
        for axes, column, label in zip(grid.flat, range(4), labels, strict=True):
            _line(axes, flight.time_s, values[:, column], colour, width=0.7)
            axes.set_ylabel(label)
        _mark(grid.flat, flight)
        _time_axis(grid[1], flight.time_s)

    return svg(draw, 3.7, name, _HALF_WIDTH_IN)


def _track(path: Array) -> tuple[Array, Array, Array]:
    step = max(1, -(-path.shape[0] // POINTS))
    part = _finite(path)[::step]
    return part[:, 0], part[:, 1], part[:, 2]


def _finite(values: Array) -> Array:
    return np.where(np.isfinite(values), values, np.nan)


def _grid(
    figure: Figure,
    rows: int,
    columns: int,
    *,
    legend: bool = False,
    titles: bool = False,
    share_y: bool = False,
    widths: tuple[float, ...] | None = None,
    gap_in: float = 0.95,
) -> Any:
    """(rows, columns) axes over one time axis, margins in inches: the same in every figure, and nothing to solve."""
    width, height = figure.get_size_inches()
    left, right, bottom = 0.85, 0.2, 0.52
    top = 0.12 + (0.3 if legend else 0.0) + (0.2 if titles else 0.0)
    figure.subplots_adjust(
        left=left / width,
        right=1.0 - right / width,
        bottom=bottom / height,
        top=1.0 - top / height,
        wspace=gap_in * columns / (width - left - right - gap_in * (columns - 1)),
        hspace=0.16 * rows / (height - bottom - top - 0.16 * (rows - 1)),
    )
    ratios = {} if widths is None else {"width_ratios": widths}
    grid: Any = figure.subplots(rows, columns, sharex=True, sharey=share_y, squeeze=False, gridspec_kw=ratios)
    for axes in grid.flat:
        box = axes.get_position()
        axes.yaxis.set_label_coords(-0.66 / (box.width * width), 0.5)
        axes.xaxis.set_label_coords(0.5, -0.32 / (box.height * height))
    return grid


def _line(
    axes: Any,
    time: Array,
    values: Array,
    colour: str,
    *,
    label: str | None = None,
    dashed: bool = False,
    width: float = 1.1,
) -> None:
    style: Any = (0, (4, 3)) if dashed else "-"
    axes.plot(*decimate(time, _finite(values)), color=colour, label=label, linestyle=style, linewidth=width)
    _time_axis([axes], time)


def _during(flight: FlightData) -> list[Broken]:
    """The failures of some part of the flight."""
    return [each for each in flight.broken if each.start_s <= flight.time_s[-1] and each.end_s > 0.0]


def _mark(row: Iterable[Any], flight: FlightData) -> None:
    """Shade the time in which something is broken, with a line where it began."""
    for axes in row:
        for broken in _during(flight):
            start_s, end_s = max(broken.start_s, 0.0), min(broken.end_s, float(flight.time_s[-1]))
            axes.axvspan(start_s, end_s, color=BROKEN, alpha=0.08, linewidth=0.0)
            axes.axvline(start_s, color=BROKEN, linewidth=0.9, linestyle=(0, (2, 2)))


def _time_axis(row: Sequence[Any], time: Array) -> None:
    for axes in row:
        axes.set_xlim(time[0], max(time[-1], time[0] + 1e-3))
        if axes.get_subplotspec().is_last_row():
            axes.set_xlabel("t / s")


def _axis_against_reference(axes: Axes, flights: Flights, axis: int) -> None:
    for label, colour, flight in flights:
        _line(axes, flight.time_s, flight.position_nwu_m[:, axis], colour, label=label)
        _mark([axes], flight)
    longest = max((flight for _, _, flight in flights), key=lambda flight: flight.time_s[-1])
    _line(axes, longest.time_s, longest.position_reference_nwu_m[:, axis], REFERENCE, label="reference", dashed=True)


def _legend(figure: Figure, axes: Any) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncols=len(labels), borderaxespad=0.2)


def svg(draw: Callable[[Figure], None], height_in: float, name: str, width_in: float = _WIDTH_IN) -> str:
    """What `draw` makes of an empty figure, in the house's style, for `with_ids` and a page."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    # The context puts matplotlib's settings back; fonts come with matplotlib, so every machine draws the same.
    settings: Any = {**matplotlib.rcParamsDefault, "backend": "agg", **_STYLE}
    with matplotlib.rc_context(settings):
        figure = Figure(figsize=(width_in, height_in))
        FigureCanvasSVG(figure)
        draw(figure)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    return _inline(text.getvalue(), name)


_ID = re.compile(r'(\bid="|href="#|url\(#)')
_PATH = re.compile(r'(?<= d=")[^"]*')
_NUMBER = re.compile(r"-?\d+\.\d{3,}")


def _inline(document: str, name: str) -> str:
    """The bare <svg> element: no XML prologue, no metadata, coordinates to 0.01 pt, width from the page."""
    svg = document[document.index("<svg") :].strip()
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg, flags=re.DOTALL)
    svg = _PATH.sub(lambda match: _NUMBER.sub(_short, match[0]).replace(" \n", " "), svg)
    head, _, body = svg.partition(">")
    view = re.search(r'viewBox="([^"]+)"', head)
    if view is None:
        raise ValueError("matplotlib wrote an SVG without a viewBox")
    body = re.sub(r"\n\s*", "\n", body)
    return f'<svg viewBox="{view[1]}" xmlns:xlink="http://www.w3.org/1999/xlink" data-figure="{name}">{body}'


def _short(match: re.Match[str]) -> str:
    return f"{float(match[0]):.2f}".rstrip("0").rstrip(".")


def with_ids(svg: str, prefix: str) -> str:
    """The same SVG with every id, and every use of it, under `prefix`: many can stand in one page."""
    return _ID.sub(lambda match: match[1] + prefix, svg)
