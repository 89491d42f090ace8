"""Pictures of located points, of stations that locate them, and of a budget of ranges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import NullFormatter
from numpy.typing import NDArray
from torch import Tensor

import kcal.report.figures as figures
from kcal.errors import InputError
from kcal.locate.budget import RangeError
from kcal.locate.geodesy import geodetic_to_enu
from kcal.locate.positions import Located, Position, field_azimuths, region_outline
from kcal.locate.siting import Area, RankedSite, Site, SitingMap, siting_map
from kcal.locate.stereo import PositionStatus
from kcal.locate.tabulate import middle_row_ends
from kcal.report.figures import ACCENT, HALO, WARN, new_figure, round_levels, save_picture
from kcal.report.tables import range_sigma, range_unit
from kcal.texts import Unit, length_text, range_text

# Draw located points: a map with a logarithmic range scale, and the range intervals side by side.

Array = NDArray[np.float64]

_UNSURE = "#8a5a00"
# The arcs of the paper's figure first, then rounder fillers where there is room.
_ARCS = [
    250,
    1000,
    5000,
    100,
    500,
    2500,
    *(k * 10.0**e for e in (-3, -2, -1, 0, 1, 4, 5) for k in (1, 2.5, 5)),
    10.0**6,
]
_PERCENT = (-1.0, -0.3, -0.1, -0.03, -0.01, -0.003, 0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
_NAMED = 40


def positions_figure(located: Located, truth: Tensor | None = None) -> Figure:
    """Draw located points as seen from above, north up, and their range intervals.

    Distances from the left camera are drawn as log(1 + range / r0), so that 100 m and 5 km are both readable; azimuths
    are true. A bar along the line of sight is the 95 % range interval (`Located.interval_note` lists its errors); an
    arrow head means that it continues to infinity.

    Args:
        located: from `kcal.locate_points`.
        truth: (N, 3) true east, north, up in meters, NaN where unknown; an arrow leads from each to its estimate.

    Returns:
        A matplotlib figure that belongs to no window and no global state: the map, then the intervals.

    Raises:
        InputError: a truth of the wrong shape.

    Example:
        >>> import torch
        >>> from kcal import Camera, Localizer, Origin, Rig, locate_points
        >>> from kcal.locate import Marks
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> marks = Marks(("mast",), rig(torch.tensor([[50.0, 0.0, 900.0]]))[0])
        >>> localize = Localizer(rig, origin=Origin(lat=19.0, lon=72.9, height=0.0), heading_deg=35.0)
        >>> located = locate_points(localize, marks)
        >>> len(positions_figure(located).axes)
        2
    """
    true_enu = None if truth is None else truth.detach().cpu().double().numpy()
    if true_enu is not None and true_enu.shape != (len(located.positions), 3):
        raise InputError(f"truth: shape ({len(located.positions)}, 3) is needed, got {true_enu.shape}")
    shown = [i for i, position in enumerate(located.positions) if position.range_low_m is not None]
    scale = _RangeScale(located, true_enu)
    figure = figures.new_figure(13.0, 7.4)
    plan, ranges = figure.subplots(1, 2, width_ratios=[1.45, 1.0])
    _draw_map(plan, located, true_enu, shown, scale)
    _draw_ranges(ranges, located, true_enu, shown)
    figure.suptitle(
        f"{located.count_note}, from "
        f"{located.place.lat:.6f}°, {located.place.lon:.6f}°, heading {located.heading_deg:g}°",
        x=0.015,
        ha="left",
        fontsize=14,
    )
    figure.text(0.015, 0.02, _interval_footer(located), fontsize=9, color=figures.GRAY, va="bottom", linespacing=1.4)
    figure.subplots_adjust(left=0.015, right=0.975, top=0.91, bottom=0.17, wspace=0.14)
    return figure


class _RangeScale:
    """Map ENU meters to the plane: azimuth unchanged, range as log(1 + range / r0), the rim at 1."""

    def __init__(self, located: Located, true_enu: Array | None) -> None:
        ranges = [p.range_m or p.range_low_m or 0.0 for p in located.positions]
        if true_enu is not None:
            ranges += list(np.hypot(true_enu[:, 0], true_enu[:, 1]))
        ranges = [value for value in ranges if math.isfinite(value) and value > 0] or [100.0, 1000.0]
        highs = [
            p.range_high_m for p in located.positions if p.status == PositionStatus.OK and p.range_high_m is not None
        ]
        # One wide interval must not squeeze everything else.
        reach = max([max(ranges), *(min(high, 2.5 * max(ranges)) for high in highs)])
        self.nearest, self.rim = min(ranges), 1.25 * reach
        self._r0 = max(self.nearest / 2.0, self.rim / 1000.0)

    def radius(self, meters: float | Array) -> Array:
        return np.asarray(np.log1p(np.minimum(meters, self.rim) / self._r0) / math.log1p(self.rim / self._r0))

    def place(self, enu: Array) -> Array:
        """Turn east and north (..., 2 or more) in meters into map coordinates (..., 2)."""
        distance = np.hypot(enu[..., 0], enu[..., 1])[..., None]
        return np.asarray(enu[..., :2] / np.maximum(distance, 1e-9) * self.radius(distance))

    def polar(self, azimuth_deg: float | Array, meters: float | Array) -> Array:
        azimuth = np.radians(azimuth_deg)
        return np.stack([np.sin(azimuth) * self.radius(meters), np.cos(azimuth) * self.radius(meters)], -1)

    def arcs(self) -> list[float]:
        """Choose round ranges that are far enough from each other to be labeled."""
        chosen: list[float] = []
        for arc in _ARCS:
            apart = all(abs(self.radius(arc) - self.radius(other)) > 0.09 for other in chosen)
            if self.nearest / 4 <= arc < 0.97 * self.rim and apart:
                chosen.append(float(arc))
        return sorted(chosen)


def _xy(place: Array) -> tuple[float, float]:
    return float(place[0]), float(place[1])


def _draw_map(axes: Axes, located: Located, true_enu: Array | None, shown: list[int], scale: _RangeScale) -> None:
    # Azimuths count from the heading here, so that a view across north is one stretch.
    edges = [(a - located.heading_deg + 180) % 360 - 180 for c in located.cameras for a in c.azimuths_deg or ()]
    low, high = (min(edges), max(edges)) if edges else (-180.0, 180.0)
    seen = [(located.positions[i].azimuth_deg or 0.0) - located.heading_deg for i in shown]
    seen = [(a + 180) % 360 - 180 for a in seen]
    low, high = min([low, *seen]) - 4, max([high, *seen]) + 4
    sweep = np.linspace(low, high, 200) + located.heading_deg
    extent = [np.zeros((1, 2))]
    for arc in scale.arcs():
        line = scale.polar(sweep, arc)
        extent.append(line)
        axes.plot(*line.T, color=figures.FAINT, linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
        direction = line[-1] - line[-2]
        place = line[-1] + direction / np.hypot(*direction) * 0.012
        turn = (90.0 - sweep[-1]) - 90.0
        turn = (turn + 90) % 180 - 90
        outward = direction[0] >= 0
        axes.text(
            place[0], place[1], range_text(arc), fontsize=8.5, color=figures.GRAY, rotation=turn,
            rotation_mode="anchor", ha="left" if outward else "right", va="center",
        )  # fmt: skip
    for camera, color in zip(located.cameras, figures.CAMERA_COLORS, strict=False):
        foot = np.asarray(camera.enu[:2])
        if camera.azimuths_deg is not None:
            first, last = camera.azimuths_deg
            wedge = scale.place(figures.field_outline(foot, math.radians(first), math.radians(last), scale.rim))
            extent.append(wedge)
            axes.fill(*wedge.T, facecolor=color, alpha=0.07, edgecolor="none", zorder=0)
            axes.plot(*wedge.T, color=color, alpha=0.55, linewidth=0.9, zorder=1)
        axes.plot(*scale.place(foot), "o", color=color, markersize=7, zorder=6, label=f"{camera.name} camera")
    for i in shown:
        position = located.positions[i]
        _draw_sight(axes, position, scale)
        if true_enu is not None and np.isfinite(true_enu[i]).all():
            _draw_truth(axes, position, scale.place(true_enu[i]), scale)
    points = [scale.place(np.asarray(located.positions[i].enu)) for i in shown if located.positions[i].enu]
    if points:
        axes.plot(
            *np.stack(points).T,
            "o",
            color=figures.INK,
            markerfacecolor="white",
            markersize=6,
            zorder=7,
            label="estimated",
        )
    if true_enu is not None:
        axes.plot([], [], "x", color=figures.WARN, markeredgewidth=1.6, label="true (arrow to estimated)")
    if len(shown) <= _NAMED:
        _draw_names(axes, located, shown, scale, float(sweep[-1]))
    box = np.concatenate(extent)
    (left, bottom), (right, top) = box.min(0) - 0.05, box.max(0) + 0.05
    axes.set(xlim=(left - 0.04, right + 0.08), ylim=(bottom, top), aspect="equal", anchor="C")
    axes.axis("off")
    figures.draw_north(axes, 0.03)
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.005), ncols=4, fontsize=9, frameon=False, handletextpad=0.3,
        columnspacing=1.4,
    )  # fmt: skip
    axes.set_title("From above, range on a logarithmic scale", fontsize=10.5, loc="center", color="#374151")


def _draw_sight(axes: Axes, position: Position, scale: _RangeScale) -> None:
    """Draw the interval along the line of sight; dashed if only the bearing is known."""
    low, high, azimuth = position.range_low_m, position.range_high_m, position.azimuth_deg
    if low is None or high is None or azimuth is None:
        return
    tilt = math.cos(math.radians(position.elevation_deg or 0.0))
    known = position.status == PositionStatus.OK
    start, end = scale.polar(azimuth, low * tilt), scale.polar(azimuth, min(high * tilt, scale.rim))
    color = figures.INK if known else _UNSURE
    style = {"linewidth": 2.6, "alpha": 0.45} if known else {"linewidth": 1.4, "linestyle": (0, (3, 2))}
    axes.plot(*np.stack([start, end]).T, color=color, solid_capstyle="butt", zorder=3, **style)
    if high * tilt > scale.rim:
        axes.annotate(
            "", _xy(end), _xy(start + 0.97 * (end - start)), zorder=3,
            arrowprops={"arrowstyle": "-|>", "color": color, "alpha": 0.8, "shrinkA": 0, "shrinkB": 0},
        )  # fmt: skip


def _draw_truth(axes: Axes, position: Position, true: Array, scale: _RangeScale) -> None:
    axes.plot(*true, "x", color=figures.WARN, markersize=7, markeredgewidth=1.6, zorder=8)
    if position.enu is not None:
        estimate = scale.place(np.asarray(position.enu))
        if np.hypot(*(estimate - true)) > 0.012:
            axes.annotate(
                "", _xy(estimate), _xy(true), zorder=8,
                arrowprops={"arrowstyle": "->", "color": figures.WARN, "linewidth": 1.3, "shrinkA": 0, "shrinkB": 2},
            )  # fmt: skip


def _draw_names(axes: Axes, located: Located, shown: list[int], scale: _RangeScale, labels_deg: float) -> None:
    """Write each name beside its point, away from other points and from the labels of the arcs."""
    anchors = []
    for i in shown:
        position = located.positions[i]
        if position.enu is not None:
            anchors.append(scale.place(np.asarray(position.enu)))
        else:
            anchors.append(scale.polar(position.azimuth_deg or 0.0, position.range_low_m or 0.0))
    for i, anchor in zip(shown, anchors, strict=True):
        others = [other - anchor for other in anchors if other is not anchor]
        crowded = any(0 < other[0] < 0.2 and abs(other[1]) < 0.03 for other in others)
        from_labels = (labels_deg - (located.positions[i].azimuth_deg or 0.0) + 180) % 360 - 180
        labeled = 0 < from_labels < 15 and math.cos(math.radians(labels_deg)) > 0
        side = -1 if crowded or labeled else 1
        axes.annotate(
            located.positions[i].name, _xy(anchor), (8 * side, 0), textcoords="offset points", fontsize=9, zorder=9,
            ha="left" if side > 0 else "right", va="center", path_effects=figures.HALO,
        )  # fmt: skip


def _draw_ranges(axes: Axes, located: Located, true_enu: Array | None, shown: list[int]) -> None:
    """Draw intervals and true ranges relative to the estimate: on a scale of ranges, 1 % would be invisible."""
    axes.set_title("95 % interval of the range, relative to the estimate", fontsize=10.5, color="#374151")
    order = sorted(shown, key=lambda i: located.positions[i].range_m or located.positions[i].range_low_m or 0.0)
    spans = [_relative(located.positions[i], None if true_enu is None else true_enu[i]) for i in order]
    finite = [abs(value) for span in spans for value in span if value is not None and math.isfinite(value)]
    limit = min(max([0.02, *finite]) * 1.3, 2.0)
    for row, (i, (low, high, true)) in enumerate(zip(order, spans, strict=True)):
        position = located.positions[i]
        color = figures.INK if position.status == PositionStatus.OK else _UNSURE
        ends = max(low, -limit), min(high, limit)
        axes.plot(ends, [row, row], color=color, linewidth=5, alpha=0.4, solid_capstyle="butt")
        if high > limit:
            axes.plot(limit, row, ">", color=color, markersize=7, clip_on=False)
        if position.range_m is not None:
            axes.plot(0.0, row, "o", color=figures.INK, markerfacecolor="white", markersize=6, zorder=3)
        if true is not None:
            beyond = abs(true) > limit
            axes.plot(
                math.copysign(min(abs(true), limit), true),
                row,
                (">" if true > 0 else "<") if beyond else "x",
                color=figures.WARN,
                markersize=7,
                markeredgewidth=1.6,
                zorder=4,
                clip_on=False,
            )
    # Linear up to 1 %, logarithmic beyond: intervals at 100 m and at 5 km differ by a factor of fifty.
    axes.set_xscale("symlog", linthresh=0.01, linscale=1.0)
    ticks = [tick for tick in _PERCENT if abs(tick) < limit]
    if len(ticks) > 9:
        # Those at 3, 30 and .3 % would meet their neighbors.
        ticks = ticks[len(ticks) // 2 % 2 :: 2]
    axes.set_xticks(ticks, [f"{100 * tick:+g} %" if tick else "0" for tick in ticks], fontsize=9)
    axes.set_xticks([], minor=True)
    axes.set(xlim=(-limit, limit), ylim=(len(order) - 0.3, -0.7))
    unit = range_unit(located)
    names = [f"{located.positions[i].name}  {_estimate(located.positions[i], unit)}" for i in order]
    axes.set_yticks(range(len(order)) if len(order) <= _NAMED else [])
    if len(order) <= _NAMED:
        axes.set_yticklabels(names, fontsize=9 if len(order) <= 20 else 7)
    axes.grid(axis="x", color="#e5e7eb", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)


def _relative(position: Position, true: Array | None) -> tuple[float, float, float | None]:
    """Return lower end, upper end and truth relative to the estimate, or to the nearest range if there is none."""
    base = position.range_m or position.range_low_m or 1.0
    low = base if position.range_low_m is None else position.range_low_m
    high = base if position.range_high_m is None else position.range_high_m
    known = true is not None and bool(np.isfinite(true).all())
    return low / base - 1.0, high / base - 1.0, float(np.linalg.norm(true)) / base - 1.0 if known else None  # type: ignore[arg-type]


def _estimate(position: Position, unit: Unit) -> str:
    return (
        "bearing only" if position.range_m is None else length_text(position.range_m, range_sigma(position), unit=unit)
    )


def _interval_footer(located: Located) -> str:
    lines = [f"Bars: range interval, {located.interval_note}; marks have {located.pixel_sigma:g} px of noise."]
    failed: Sequence[Position] = [p for p in located.positions if p.range_low_m is None]
    lines += [f"{p.name}: {p.reason}" for p in failed[:3]]
    if len(failed) > 3:
        lines.append(f"and {len(failed) - 3} more")
    return "\n".join(lines)


# A plan of stations: towers with what they see, positions with their 95 % ellipses, bearings of single cameras.

# Of the larger side of what is shown: how far fields of view and bearings are drawn.
_REACH = 0.9


def stations_figure(located: Located, truth: Tensor | None = None) -> Figure:
    """Draw a plan, kilometers east and north of the origin.

    Args:
        located: from `kcal.locate_points`.
        truth: (N, 3) true east, north, up in meters, NaN where unknown.
    """
    figure = figures.new_figure(8.0, 7.0)
    axes = figure.add_subplot()
    towers = torch.tensor([camera.enu[:2] for camera in located.cameras], dtype=torch.float64)
    found = located.enu[located.enu.isfinite().all(-1)]
    shown = torch.cat([towers, found[:, :2]])
    reach = _REACH * max(float((shown.amax(0) - shown.amin(0)).amax()), 1.0)
    for number, camera in enumerate(located.cameras):
        x, y = (value / 1e3 for value in camera.enu[:2])
        sweep = field_azimuths(camera)
        if sweep is not None:
            angle = torch.deg2rad(sweep)
            east, north = x + reach / 1e3 * angle.sin(), y + reach / 1e3 * angle.cos()
            axes.fill([x, *east.tolist()], [y, *north.tolist()], color=f"C{number % 10}", alpha=0.10, linewidth=0)
        axes.plot([x], [y], "^", color=f"C{number % 10}", markersize=9)
        axes.annotate(camera.name, (x, y), xytext=(6, 6), textcoords="offset points")
    feet = torch.zeros(len(located.positions), 3) if located.feet is None else located.feet
    for position, foot in zip(located.positions, feet.tolist(), strict=True):
        if position.enu is not None and position.covariance is not None:
            center, spread = torch.tensor(position.enu).double(), torch.tensor(position.covariance).double()
            ring = region_outline(center, spread, plain=True) / 1e3
            axes.fill(ring[:, 0], ring[:, 1], facecolor="none", edgecolor="black", linewidth=1.2)
            axes.plot([position.enu[0] / 1e3], [position.enu[1] / 1e3], "k.", markersize=4)
            axes.annotate(
                position.name, (position.enu[0] / 1e3, position.enu[1] / 1e3), xytext=(5, -11),
                textcoords="offset points", fontsize="small",
            )  # fmt: skip
        elif position.azimuth_deg is not None and position.status == PositionStatus.BEARING_ONLY:
            way = math.radians(position.azimuth_deg)
            ends = [foot[0], foot[0] + reach * math.sin(way)], [foot[1], foot[1] + reach * math.cos(way)]
            axes.plot(*([value / 1e3 for value in end] for end in ends), "--", color="gray", linewidth=1)
    if truth is not None:
        known = truth[truth.isfinite().all(-1)] / 1e3
        axes.plot(known[:, 0], known[:, 1], "r+", markersize=8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("km east")
    axes.set_ylabel("km north")
    axes.set_title(f"{located.count_note}; outlines: 95 % regions", fontsize="medium")
    return figure


# Draw a depth budget: range errors against range, on logarithmic scales.

_SOURCE_COLORS = {"disparity": "#2b6cb0", "yaw": "#c02a6b", "baseline": "#4b5563", "timing": "#dd7a1f"}


def plotted_ranges(distances: Sequence[float]) -> Tensor:
    """(121,) ranges for a plot, evenly spaced on a logarithmic scale from the nearest to the farthest.

    Raises:
        InputError: fewer than two distances.

    Example:
        >>> plotted_ranges([100.0, 10000.0])[[0, 60, 120]].tolist()
        [100.0, 1000.0, 10000.0]
    """
    if len(distances) < 2:
        raise InputError("distances: a plot needs at least two")
    near, far = min(distances), max(distances)
    # The ends themselves, which rounding of the logarithm may push out of view.
    return torch.logspace(math.log10(near), math.log10(far), 121, dtype=torch.float64).clamp(near, far)


def budget_figure(distances: Tensor, found: dict[str, RangeError], labels: dict[str, str]) -> Figure:
    """Draw lines for each source: outward error solid, inward dotted, first order thin and dashed.

    Args:
        distances: (D,) meters.
        found: errors by source, from `range_errors`.
        labels: source -> text in the legend.
    """
    figure = figures.new_figure(8.6, 6.0)
    axes = figure.add_subplot()
    far = distances.numpy()
    for name, error in found.items():
        color = _SOURCE_COLORS.get(name, "#111827")
        outward = error.farther.clone()
        # Infinite errors are not drawn: the line leaves the picture there.
        outward[~outward.isfinite()] = float("nan")
        axes.plot(far, outward.numpy(), color=color, linewidth=2.0, label=labels.get(name, name))
        axes.plot(far, error.nearer.abs().numpy(), color=color, linewidth=1.4, linestyle=":")
        axes.plot(far, error.first_order.numpy(), color=color, linewidth=0.8, linestyle=(0, (6, 4)), alpha=0.8)
    axes.plot([], [], color="#6b7280", linewidth=1.4, linestyle=":", label="inward")
    axes.plot([], [], color="#6b7280", linewidth=0.8, linestyle=(0, (6, 4)), label="first order")
    axes.set(xscale="log", yscale="log", xlim=(far.min(), far.max()), xlabel="range, m", ylabel="error of the range, m")
    low = min(float(error.nearer.abs()[error.nearer.abs() > 0].min()) for error in found.values())
    axes.set_ylim(max(low, 1e-4), float(far.max()) * 2)
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        axis.set_major_formatter(figures.plain_number)
        axis.set_minor_formatter(NullFormatter() if high > 10 * low else figures.plain_number)
    axes.grid(which="major", color="#e5e7eb", linewidth=0.8)
    axes.grid(which="minor", color="#f3f4f6", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9, loc="upper left")
    axes.set_title("Range error by source: outward, inward, and to first order", fontsize=11, color="#374151")
    figure.subplots_adjust(left=0.1, right=0.98, top=0.94, bottom=0.09)
    return figure


# A picture of sites: how well an area is seen and located today, and with the candidates that are worth most.

# From good to poor; blind and single are told apart by the blind eye too.
_RAMP = LinearSegmentedColormap.from_list("sigma", ["#0b5d4f", "#3aa17e", "#a6d69b", "#f3e79b", "#e9a857", "#c8553d"])
_HIDDEN, _SINGLE, _NEW = "#2f2b3a", "#b9b4c7", "#f8d568"


def siting_figure(
    area: Area, sites: Sequence[Site], ranked: Sequence[RankedSite] = (), weights: torch.Tensor | None = None
) -> Figure:
    """Draw standard deviations of level positions, what is hidden, the sites and the ranked candidates.

    Args:
        area: from `kcal.locate.area_of`.
        sites: that stand.
        ranked: from `kcal.locate.rank_sites`; a second map shows the area with those that have an order.
        weights: (rows, columns), as for `rank_sites`; counted in the titles.

    Example:
        >>> from kcal.lens.rig import Origin
        >>> from kcal.locate.ground import level_ground
        >>> from kcal.locate.siting import area_of
        >>> towers = [Site(name=name, origin=Origin(lat=45.0, lon=lon, height=99.0)) for name, lon in
        ...           (("mill", 5.9), ("mast", 6.1))]
        >>> area = area_of((45.05, 5.95, 45.15, 6.05), level_ground(0.0), towers, cells=10)
        >>> len(siting_figure(area, towers).axes)
        2
    """
    built = [one for one in ranked if one.order is not None]
    maps = [("Today", siting_map(area, sites, weights))]
    if built:
        names = ", ".join(one.site.name for one in built)
        maps.append((f"With {names}", siting_map(area, [*sites, *(one.site for one in built)], weights)))
    levels = _sigma_levels([found for _, found in maps])
    figure = new_figure(6.4 * len(maps) + 1.0, 7.4)
    panels = figure.subplots(1, len(maps), squeeze=False)[0]
    for number, (axes, (title, found)) in enumerate(zip(panels, maps, strict=True)):
        colored = _siting_area(axes, area, found, levels)
        later = [] if number else list(ranked)
        _siting_marks(axes, area, sites, [one.site for one in built if number], later)
        axes.set_title(
            f"{title}\n{100 * found.covered:.0f} % of the area seen by two or more, "
            f"median σ there {_median_sigma(found)}",
            fontsize=10.5, loc="left",
        )  # fmt: skip
    figure.subplots_adjust(left=0.07, right=0.9, bottom=0.17, top=0.91, wspace=0.14)
    bar = figure.colorbar(colored, cax=figure.add_axes((0.915, 0.17, 0.016, 0.74)), ticks=levels)
    bar.ax.set_yticklabels([length_text(level, digits=2) for level in levels])
    bar.set_label("standard deviation of a position on the map", fontsize=9)
    patches = [Patch(color=_SINGLE, label="one site sees it: a bearing only"), Patch(color=_HIDDEN, label="hidden")]
    marks = [axes.plot([], [], "^", color="white", markeredgecolor="black", markersize=9, label="site")[0]]
    if ranked:
        marks.append(
            axes.plot([], [], "o", color=_NEW, markeredgecolor="black", label="candidate, by rank; new site")[0]
        )
    figure.legend(handles=[*patches, *marks], loc="lower left", bbox_to_anchor=(0.06, 0.045), ncols=4, frameon=False,
                  fontsize=9)  # fmt: skip
    figure.text(0.07, 0.02, _siting_footer(maps[0][1], ranked), fontsize=9, color="#374151")
    return figure


def _map_sigma(found: SitingMap) -> NDArray[np.float64]:
    """(rows, columns) standard deviations where two sites or more see a thing."""
    return np.where((found.seen_by > 1).numpy(), found.sigma.numpy(), np.nan)


def _median_sigma(found: SitingMap) -> str:
    there = _map_sigma(found)
    there = there[np.isfinite(there)]
    return length_text(float(np.median(there)), digits=2) if len(there) else "nowhere known"


def _sigma_levels(maps: Sequence[SitingMap]) -> list[float]:
    """Steps of 1, 2, 5 from what the best twentieth of the area has to what the worst twentieth has."""
    values = np.concatenate([_map_sigma(found).ravel() for found in maps])
    values = values[np.isfinite(values)]
    low, high = np.quantile(values, [0.02, 0.95]) if len(values) else (1.0, 10.0)
    return round_levels(max(float(low), 1e-3), float(high), least=2)


def _map_grid(area: Area) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    lats, lons = torch.meshgrid(area.lat, (area.lon + 180.0) % 360.0 - 180.0, indexing="ij")
    east, north, _ = geodetic_to_enu(torch.stack([lats, lons, torch.zeros_like(lats)], -1), area.origin).unbind(-1)
    return east.numpy() / 1e3, north.numpy() / 1e3


def _siting_area(axes: Axes, area: Area, found: SitingMap, levels: Sequence[float]) -> Any:
    east, north = _map_grid(area)
    count = np.where(area.known.numpy(), found.seen_by.numpy(), np.nan).astype(float)
    blind = np.where(count == 0, 0.0, np.where(count == 1, 1.0, np.nan))
    axes.pcolormesh(east, north, blind, cmap=ListedColormap([_HIDDEN, _SINGLE]), vmin=0, vmax=1, rasterized=True)
    norm, sigma = BoundaryNorm(levels, 256, extend="both"), _map_sigma(found)
    colored = axes.pcolormesh(east, north, sigma, cmap=_RAMP, norm=norm, rasterized=True)
    if np.isfinite(sigma).any():
        lines = axes.contour(east, north, sigma, levels=levels, colors="white", linewidths=0.7, alpha=0.8)
        axes.clabel(lines, fmt=lambda level: length_text(level, digits=2), fontsize=7.5, colors="black")
    # Light from the northwest, so that ridges and valleys are seen.
    heights = area.ground.numpy()
    if np.nanmax(heights) - np.nanmin(heights) > 1.0:
        step = 1e3 * float(east[0, 1] - east[0, 0]), 1e3 * float(north[1, 0] - north[0, 0])
        rise, across = np.gradient(heights, step[1], step[0])
        shade = (across - rise) / max(3.0 * float(np.nanstd(across - rise)), 1e-9)
        axes.pcolormesh(
            east, north, np.clip(shade, -1, 1), cmap="gray", vmin=-1, vmax=1, alpha=0.22, linewidth=0, rasterized=True
        )
    axes.set(aspect="equal", xlabel="km east", ylabel="km north", facecolor="#e5e7eb")
    return colored


def _siting_marks(
    axes: Axes, area: Area, sites: Sequence[Site], new: Sequence[Site], ranked: Sequence[RankedSite]
) -> None:
    for number, site in enumerate([*sites, *new]):
        x, y = _site_field(axes, area, site)
        color = "white" if number < len(sites) else _NEW
        axes.plot([x], [y], "^", color=color, markeredgecolor="black", markersize=9, zorder=5)
        axes.annotate(site.name, (x, y), (7, 6), textcoords="offset points", fontsize=9, path_effects=HALO, zorder=6)
    for rank, one in enumerate(ranked, start=1):
        x, y = _site_place(area, one.site)
        axes.plot([x], [y], "o", color=_NEW, markeredgecolor="black", markersize=13, zorder=5)
        axes.text(x, y, str(rank), ha="center", va="center", fontsize=8, zorder=6)
        axes.annotate(
            one.site.name, (x, y), (9, -10), textcoords="offset points", fontsize=8, path_effects=HALO, zorder=6
        )


def _site_place(area: Area, site: Site) -> tuple[float, float]:
    east, north, _ = (geodetic_to_enu(site.origin.geodetic, area.origin) / 1e3).tolist()
    return east, north


def _site_field(axes: Axes, area: Area, site: Site) -> tuple[float, float]:
    """A short wedge where a site does not look all around."""
    x, y = _site_place(area, site)
    if site.heading_deg is not None and (site.field_deg < 360.0 or site.camera is not None):
        half = 0.5 * site.field_deg
        if site.camera is not None:
            # The angle between its rays through the left and right ends of the middle row.
            rays = middle_row_ends(site.camera)
            if rays is None:
                return x, y
            half = math.degrees(0.5 * math.acos(max(-1.0, min(1.0, float(rays[0] @ rays[1])))))
        turn = np.radians(np.linspace(site.heading_deg - half, site.heading_deg + half, 40))
        reach = 0.07 * (axes.get_xlim()[1] - axes.get_xlim()[0])
        axes.fill([x, *(x + reach * np.sin(turn))], [y, *(y + reach * np.cos(turn))], color="white", alpha=0.55,
                  linewidth=0, zorder=4)  # fmt: skip
    return x, y


def _siting_footer(today: SitingMap, ranked: Sequence[RankedSite]) -> str:
    if not ranked:
        return ""
    built = sorted((one for one in ranked if one.after is not None), key=lambda one: one.order or 0)[:5]
    steps = [f"{length_text(one.after or 0.0, digits=3)} with {one.site.name}" for one in built]
    return "standard deviation over the whole area, where what nobody sees may be anywhere in it: " + ", then ".join(
        [f"{length_text(today.mean_sigma, digits=3)} today", *steps]
    )


# A surveyor's sketch: the picture of a site with the names of what to mark.

Named = tuple[list[str], NDArray[np.float64]]


def save_site_sketch(path: str | Path, image: NDArray[np.uint8], landmarks: Named, targets: Named) -> Path:
    """Write a picture with named landmarks and targets.

    Args:
        path: of the .png, .svg or .pdf file.
        image: (H, W, 3) of the site.
        landmarks: names, and pixels (N, 2).
        targets: the same of what is to be located.
    """
    height, width = image.shape[:2]
    figure = new_figure(width / 160, height / 160, 100)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(image)
    axes.set_axis_off()
    for (names, pixels), color in ((landmarks, ACCENT), (targets, WARN)):
        for name, (u, v) in zip(names, pixels, strict=True):
            axes.plot(u, v, "o", mfc="none", mec=color, ms=9)
            axes.annotate(
                name, (u, v), (4, 14), textcoords="offset points", color=color, fontsize=11, path_effects=HALO,
                rotation=55, arrowprops={"arrowstyle": "-", "color": color, "lw": 0.8},
            )  # fmt: skip
    where = 0.01 * width, 0.97 * height
    axes.text(*where, "blue: surveyed landmarks    red: targets to locate", fontsize=12, path_effects=HALO)
    return save_picture(path, figure)
