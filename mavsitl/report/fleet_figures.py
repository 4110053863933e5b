"""The figures of a fleet's page. However many fly, a figure has so many points and its legend so many names."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mavsitl.log.flight import Array
from mavsitl.report import tables
from mavsitl.report.figures import BROKEN, POINTS, REFERENCE, UNDERNEATH, Drawing, decimate, dress_space, svg
from mavsitl.report.run import FleetRecord, VehicleRecord

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mavsitl.report.fleet import Track, Tracks

ALL_POINTS = 24_000
"""Of a figure, shared by its vehicles."""
LEAST_POINTS = 100
FEW = 10
"""So many vehicles have colours that are told apart, and names."""
NAMED = 5
"""Of more so many are named."""
_COLOURS = (
    "#2166ac", "#d6604d", "#1b7837", "#762a83", "#bf812d", "#35978f", "#c51b7d", "#4d4d4d", "#7fbc41", "#6baed6"
)  # fmt: skip
_HALF_IN, _WHOLE_IN = 5.8, 9.0


def drawings(tracks: Tracks, fleet: FleetRecord) -> list[Drawing]:
    """Those that there is something for."""
    drawn = [_top(tracks, fleet), _space(tracks), _error(tracks)]
    if len(fleet.vehicles) > 1:
        drawn.append(_separation(tracks, fleet))
    if any(vehicle.links for vehicle in fleet.vehicles):
        drawn.append(_links(fleet.vehicles))
    return drawn


def colours(count: int) -> list[Any]:
    """One for each vehicle: different ones for a few, a scale for many."""
    if count <= FEW:
        return list(_COLOURS[:count])
    from matplotlib import colormaps

    return [colormaps["viridis"](0.92 * index / (count - 1)) for index in range(count)]


def _lines(tracks: Tracks) -> Iterator[tuple[int, Track, Any, str | None]]:
    """(column, track, colour, name in the legend) of the vehicles that have flown."""
    count = len(tracks.vehicles)
    named = range(count) if count <= FEW else np.linspace(0, count - 1, NAMED).astype(int).tolist()
    for column, (track, colour) in enumerate(zip(tracks.vehicles, colours(count), strict=True)):
        if track.time_s.size:
            yield column, track, colour, f"vehicle {track.system_id}" if column in named else None


def _points(count: int) -> int:
    return min(max(ALL_POINTS // count, LEAST_POINTS), POINTS)


def _thinned(values: Array, count: int) -> Array:
    """Every few of the (k, 3) rows, and the last."""
    step = max(1, -(-values.shape[0] // _points(count)))
    return np.concatenate((values[::step], values[-1:]))


def _width(count: int) -> float:
    return 1.1 if count <= FEW else 0.7


def _dashed(count: int) -> dict[str, Any]:
    """Of references: over the paths of a few, under those of many, which they would hide."""
    few = count <= FEW
    look = {"color": REFERENCE, "linewidth": 0.6, "zorder": 3} if few else {"color": UNDERNEATH, "linewidth": 0.4}
    return {"linestyle": (0, (4, 3)), "zorder": 1} | look


def _legend(figure: Figure, axes: Any, columns: int = 6) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        figure.legend(handles, labels, loc="upper center", ncols=min(len(labels), columns), fontsize=8.5)


def _top_margin(figure: Figure, count: int, columns: int = 6) -> float:
    """The axes' upper end, as a share of the figure's height, under a legend of the vehicles and one or two names."""
    rows = -(-(count + 1 if count <= FEW else NAMED + 2) // columns)
    return 1.0 - (0.18 + 0.22 * rows) / float(figure.get_size_inches()[1])


def _met(tracks: Tracks, fleet: FleetRecord) -> list[tuple[float, float, Array]]:
    """(the fleet's time, distance in m, place (3,)) of each collision since the first release."""
    found = []
    by_id = {track.system_id: track for track in tracks.vehicles}
    for each in fleet.collisions:
        time_s = each.time_s - tracks.start_s
        track = by_id[each.vehicle]
        if track.time_s.size and time_s >= 0.0:
            row = min(int(np.searchsorted(track.time_s, time_s)), track.time_s.size - 1)
            found.append((time_s, each.distance_m, track.position_nwu_m[row]))
    return found


def _top(tracks: Tracks, fleet: FleetRecord) -> Drawing:
    """North up, west to the left."""
    count = len(tracks.vehicles)

    def draw(figure: Figure) -> None:
        axes: Any = figure.add_axes((0.13, 0.11, 0.84, _top_margin(figure, count, 4) - 0.11))
        for column, track, colour, name in _lines(tracks):
            reference, path = _thinned(track.reference_nwu_m, count), _thinned(track.position_nwu_m, count)
            label = "reference" if column == 0 else None
            axes.plot(reference[:, 1], reference[:, 0], label=label, **_dashed(count))
            axes.plot(path[:, 1], path[:, 0], color=colour, linewidth=_width(count), label=name, zorder=2)
            axes.plot(path[0, 1], path[0, 0], marker="o", markersize=3.0, color=colour, zorder=2)
        for _, _, place in _met(tracks, fleet):
            axes.plot(place[1], place[0], marker="X", markersize=7.0, color=BROKEN, zorder=4)
        axes.set_aspect("equal", adjustable="datalim")
        axes.invert_xaxis()
        axes.set_xlabel("y / m (west to the left)")
        axes.set_ylabel("x / m (north)")
        _legend(figure, axes, 4)

    crosses = "; crosses: collisions" if fleet.collisions else ""
    return Drawing(
        svg(draw, 5.6, "top", _HALF_IN), f"Paths from above; dots: where each was released{crosses}", "", True
    )


def _space(tracks: Tracks) -> Drawing:
    count = len(tracks.vehicles)

    def draw(figure: Figure) -> None:
        axes: Any = figure.add_axes((0.04, 0.0, 0.88, 1.0), projection="3d", computed_zorder=False)
        for _, track, colour, _ in _lines(tracks):
            axes.plot(*_thinned(track.reference_nwu_m, count).T, **_dashed(count))
            axes.plot(*_thinned(track.position_nwu_m, count).T, color=colour, linewidth=_width(count), zorder=2)
        dress_space(axes, labelpad=6, height=0.7, zoom=0.92, elevation=24)

    return Drawing(svg(draw, 5.6, "space", _HALF_IN), "Paths in space, references dashed", "", half=True)


def _over_time(tracks: Tracks, curves: Sequence[tuple[Array, Array]], label: str, mark: Any = None) -> Any:
    """Draws (time, values) of each vehicle, in their order, and over those of many their median in black."""
    count = len(tracks.vehicles)

    def draw(figure: Figure) -> None:
        axes: Any = figure.add_axes((0.085, 0.15, 0.895, _top_margin(figure, count) - 0.15))
        for column, _, colour, name in _lines(tracks):
            time_s, values = curves[column]
            axes.plot(*decimate(time_s, values, _points(count)), color=colour, linewidth=_width(count), label=name)
        if count > FEW:
            axes.plot(*_median(curves), color=REFERENCE, linewidth=1.6, label="median")
        if mark is not None:
            mark(axes)
        axes.set_xlabel("t / s")
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0.0)
        axes.set_xlim(left=0.0)
        _legend(figure, axes)

    return draw


def _median(curves: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Of those that there are at each of some times."""
    flown = [(time_s, values) for time_s, values in curves if time_s.size]
    if not flown:
        return np.zeros(0), np.zeros(0)
    times_s = np.linspace(min(t[0] for t, _ in flown), max(t[-1] for t, _ in flown), POINTS // 3)
    sampled = np.array([np.interp(times_s, t, values, left=np.nan, right=np.nan) for t, values in flown])
    known = ~np.isnan(sampled).all(axis=0)
    return times_s[known], np.nanmedian(sampled[:, known], axis=0)


def _error(tracks: Tracks) -> Drawing:
    curves = [(track.time_s, np.where(np.isfinite(track.error_m), track.error_m, np.nan)) for track in tracks.vehicles]
    draw = _over_time(tracks, curves, "distance from reference / m")
    return Drawing(svg(draw, 3.6, "error", _WHOLE_IN), "Position error of each vehicle", "")


def _separation(tracks: Tracks, fleet: FleetRecord) -> Drawing:
    curves = [(tracks.time_s, tracks.nearest_m[:, column]) for column in range(len(tracks.vehicles))]

    def mark(axes: Any) -> None:
        if fleet.collision_m:
            axes.axhline(fleet.collision_m, color=BROKEN, linewidth=1.0, linestyle=(0, (2, 2)), label="collision")
        for time_s, distance_m, _ in _met(tracks, fleet):
            axes.plot(time_s, distance_m, marker="X", markersize=7.0, color=BROKEN, zorder=4)

    draw = _over_time(tracks, curves, "to the nearest other / m", mark)
    crosses = "; crosses: collisions" if fleet.collisions else ""
    return Drawing(
        svg(draw, 3.6, "separation", _WHOLE_IN), f"Separation of each vehicle from the one nearest to it{crosses}", ""
    )


def _links(vehicles: Sequence[VehicleRecord]) -> Drawing:
    """Shares lost and the 99th percentile of the delay, a dot for each vehicle and direction."""
    rows = [(vehicle.system_id, row) for vehicle in vehicles for row in tables.link_rows(vehicle.links)]
    names = list(dict.fromkeys(row.link for _, row in rows))

    def draw(figure: Figure) -> None:
        for index, label in enumerate(("lost and in outages / %", "delay p99 / ms")):
            axes: Any = figure.add_axes((0.085 + 0.5 * index, 0.18, 0.4, 0.68))
            highest = 0.0
            for name, colour in zip(names, _COLOURS, strict=False):
                mine = [(system_id, row) for system_id, row in rows if row.link == name]
                values = [row.delay_p99_ms if index else 100.0 * (row.lost + row.outage) for _, row in mine]
                highest = max(highest, *values)
                axes.plot([each for each, _ in mine], values, "o", markersize=3.5, color=colour, label=name)
            axes.set_xlabel("vehicle")
            axes.set_ylabel(label)
            axes.set_ylim(0.0, 1.1 * highest or 1.0)
            axes.xaxis.get_major_locator().set_params(integer=True)
        _legend(figure, axes)

    return Drawing(svg(draw, 2.9, "links", _WHOLE_IN), "Each vehicle’s links over the whole run", "")
