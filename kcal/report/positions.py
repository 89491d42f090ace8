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
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter
from numpy.typing import NDArray
from torch import Tensor

import kcal.report.figures as figures
from kcal.errors import InputError
from kcal.finding import FAULTS
from kcal.locate.budget import RangeError
from kcal.locate.geodesy import geodetic_to_enu
from kcal.locate.positions import Located, Position, field_azimuths, region_outline
from kcal.locate.siting import Area, RankedSite, Site, SitingMap, siting_map
from kcal.locate.stereo import PositionStatus
from kcal.locate.tabulate import middle_row_ends
from kcal.report.tables import range_sigma, range_unit
from kcal.report.verdict import RangeAnswer
from kcal.texts import Unit, length_text, range_text

# Draw located points: a map with a logarithmic range scale, and the range intervals side by side.

Array = NDArray[np.float64]

_UNSURE = "#8a5a00"
# The arcs of the paper's figure first, then rounder fillers where there is room.
_FILLERS = [k * 10.0**e for e in (-3, -2, -1, 0, 1, 4, 5) for k in (1, 2.5, 5)]
_ARCS = [250, 1000, 5000, 100, 500, 2500, *_FILLERS, 10.0**6]
# Of the median: longer intervals are cut off, so that the others can be seen.
_LONGEST = 12.0
_NAMED = 40


def positions_figure(located: Located, truth: Tensor | None = None, figure: Figure | SubFigure | None = None) -> Figure:
    """Draw located points as seen from above, north up, and their range intervals.

    Distances from the left camera are drawn as log(1 + range / r0), so that 100 m and 5 km are both readable; azimuths
    are true. A bar along the line of sight is the 95 % range interval (`Located.interval_note` lists its errors); an
    arrow head means that it continues to infinity.

    Args:
        located: from `kcal.locate_points`.
        truth: (N, 3) true east, north, up in meters, NaN where unknown; an arrow leads from each to its estimate.
        figure: of yours, or a part of it, to draw into.

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
        >>> localize = Localizer(rig.placed(origin=Origin(lat=19.0, lon=72.9, height=0.0), heading_deg=35.0))
        >>> located = locate_points(localize, marks)
        >>> len(positions_figure(located).axes)
        2
    """
    true_enu = None if truth is None else truth.detach().cpu().double().numpy()
    if true_enu is not None and true_enu.shape != (len(located.positions), 3):
        raise InputError(f"truth: shape ({len(located.positions)}, 3) is needed, got {true_enu.shape}")
    shown = [i for i, position in enumerate(located.positions) if position.range_low_m is not None]
    scale = _scale_of(located, true_enu)
    place = f"{located.place.lat:.6f}°, {located.place.lon:.6f}°, heading {located.heading_deg:g}°"
    title = f"{located.count_note}, from {place}"
    figure = figures.framed_figure(13.0, 6.8, title, _interval_notes(located), into=figure)
    plan, ranges = figure.subplots(1, 2, width_ratios=[1.45, 1.0])
    _draw_map(plan, located, true_enu, shown, scale)
    _draw_ranges(ranges, located, true_enu, shown)
    return figures.whole(figure)


def _scale_of(located: Located, true_enu: Array | None) -> figures.RangeScale:
    ranges = [p.range_m or p.range_low_m or 0.0 for p in located.positions]
    if true_enu is not None:
        ranges += list(np.hypot(true_enu[:, 0], true_enu[:, 1]))
    ranges = [value for value in ranges if math.isfinite(value) and value > 0] or [100.0, 1000.0]
    highs = [p.range_high_m for p in located.positions if p.status == PositionStatus.OK and p.range_high_m is not None]
    # One wide interval must not squeeze everything else.
    reach = max([max(ranges), *(min(high, 2.5 * max(ranges)) for high in highs)])
    return figures.RangeScale(nearest=min(ranges), rim=1.25 * reach)


def _polar(scale: figures.RangeScale, azimuth_deg: float | Array, meters: float | Array) -> Array:
    azimuth = np.radians(azimuth_deg)
    return np.stack([np.sin(azimuth) * scale.radius(meters), np.cos(azimuth) * scale.radius(meters)], -1)


def _arcs(scale: figures.RangeScale) -> list[float]:
    """Choose round ranges that are far enough from each other to be labeled."""
    chosen: list[float] = []
    for arc in _ARCS:
        apart = all(abs(scale.radius(arc) - scale.radius(other)) > 0.09 for other in chosen)
        if scale.nearest / 4 <= arc < 0.97 * scale.rim and apart:
            chosen.append(float(arc))
    return sorted(chosen)


def _draw_map(
    axes: Axes, located: Located, true_enu: Array | None, shown: list[int], scale: figures.RangeScale
) -> None:
    # Azimuths count from the heading here, so that a view across north is one stretch.
    edges = [(a - located.heading_deg + 180) % 360 - 180 for c in located.cameras for a in c.azimuths_deg or ()]
    low, high = (min(edges), max(edges)) if edges else (-180.0, 180.0)
    seen = [(located.positions[i].azimuth_deg or 0.0) - located.heading_deg for i in shown]
    seen = [(a + 180) % 360 - 180 for a in seen]
    low, high = min([low, *seen]) - 4, max([high, *seen]) + 4
    sweep = np.linspace(low, high, 200) + located.heading_deg
    extent, labels = [np.zeros((1, 2))], []
    for arc in _arcs(scale):
        line = _polar(scale, sweep, arc)
        extent.append(line)
        axes.plot(*line.T, color=figures.FAINT, linewidth=0.8, linestyle=(0, (4, 3)), zorder=1)
        direction = line[-1] - line[-2]
        place = line[-1] + direction / np.hypot(*direction) * 0.012
        labels.append(place)
        turn = (90.0 - sweep[-1]) % 180.0 - 90.0
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
            figures.draw_field(axes, wedge, color)
        axes.plot(*scale.place(foot), "o", color=color, markersize=7, zorder=6, label=f"{camera.name} camera")
    for i in shown:
        position = located.positions[i]
        _draw_sight(axes, position, scale)
        if true_enu is not None and np.isfinite(true_enu[i]).all():
            _draw_truth(axes, position, scale.place(true_enu[i]), scale)
    points = [scale.place(np.asarray(located.positions[i].enu)) for i in shown if located.positions[i].enu]
    if points:
        style: dict[str, Any] = {"color": figures.INK, "markerfacecolor": "white", "markersize": 6, "zorder": 7}
        axes.plot(*np.stack(points).T, "o", label="estimated", **style)
    if true_enu is not None:
        axes.plot([], [], "x", color=figures.WARN, markeredgewidth=1.6, label="true (arrow to estimated)")
    if len(shown) <= _NAMED:
        _draw_names(axes, located, shown, scale, labels)
    box = np.concatenate(extent)
    (left, bottom), (right, top) = box.min(0) - 0.05, box.max(0) + 0.05
    axes.set(xlim=(left - 0.04, right + 0.08), ylim=(bottom, top), aspect="equal", anchor="C")
    axes.axis("off")
    figures.draw_north(axes, 0.03)
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.005), ncols=4, fontsize=9, frameon=False, handletextpad=0.3,
        columnspacing=1.4,
    )  # fmt: skip
    axes.set_title("From above, range on a logarithmic scale", fontsize=10, loc="left")


def _draw_sight(axes: Axes, position: Position, scale: figures.RangeScale) -> None:
    """Draw the interval along the line of sight; dashed if only the bearing is known."""
    low, high, azimuth = position.range_low_m, position.range_high_m, position.azimuth_deg
    if low is None or high is None or azimuth is None:
        return
    tilt = math.cos(math.radians(position.elevation_deg or 0.0))
    known = position.status == PositionStatus.OK
    start, end = _polar(scale, azimuth, low * tilt), _polar(scale, azimuth, min(high * tilt, scale.rim))
    color = figures.INK if known else _UNSURE
    style: dict[str, Any] = {"linewidth": 2.6, "alpha": 0.45} if known else {"linewidth": 1.4, "linestyle": (0, (3, 2))}
    axes.plot(*np.stack([start, end]).T, color=color, solid_capstyle="butt", zorder=3, **style)
    if high * tilt > scale.rim:
        figures.draw_way(axes, start + 0.97 * (end - start), end, color, alpha=0.8)


def _draw_truth(axes: Axes, position: Position, true: Array, scale: figures.RangeScale) -> None:
    axes.plot(*true, "x", color=figures.WARN, markersize=7, markeredgewidth=1.6, zorder=8)
    if position.enu is not None:
        estimate = scale.place(np.asarray(position.enu))
        if np.hypot(*(estimate - true)) > 0.012:
            figures.draw_way(axes, true, estimate, figures.WARN, "->", linewidth=1.3)


def _draw_names(axes: Axes, located: Located, shown: list[int], scale: figures.RangeScale, labels: list[Array]) -> None:
    """Write each name beside its point, away from other points and from the labels of the arcs."""
    positions = [located.positions[i] for i in shown]
    anchors = [
        _polar(scale, one.azimuth_deg or 0.0, one.range_low_m or 0.0)
        if one.enu is None else scale.place(np.asarray(one.enu))
        for one in positions
    ]  # fmt: skip
    for position, anchor in zip(positions, anchors, strict=True):
        others = [other - anchor for other in [*anchors, *labels] if other is not anchor]
        crowded = any(0 < other[0] < 0.2 and abs(other[1]) < 0.04 for other in others)
        figures.name_point(axes, anchor, position.name, (-8 if crowded else 8, 0), zorder=9)


def _draw_ranges(axes: Axes, located: Located, true_enu: Array | None, shown: list[int]) -> None:
    """Draw intervals and true ranges relative to the estimate: on a scale of ranges, 1 % would be invisible."""
    axes.set_title("95 % interval of the range, relative to the estimate", fontsize=10, loc="left")
    order = sorted(shown, key=lambda i: located.positions[i].range_m or located.positions[i].range_low_m or 0.0)
    spans = [_relative(located.positions[i], None if true_enu is None else true_enu[i]) for i in order]
    ends = [max(abs(value) for value in (low, high) if math.isfinite(value)) for low, high, _ in spans]
    limit = 1.3 * min(max([0.001, *ends]), _LONGEST * float(np.median(ends or [1.0])) or 1.0, 1.5)
    for row, (i, (low, high, true)) in enumerate(zip(order, spans, strict=True)):
        position = located.positions[i]
        color = figures.INK if position.status == PositionStatus.OK else _UNSURE
        axes.plot((max(low, -limit), min(high, limit)), [row, row], color=color, linewidth=5, alpha=0.4,
                  solid_capstyle="butt")  # fmt: skip
        for end in (low, high):
            if abs(end) > limit:
                axes.plot(math.copysign(limit, end), row, ">" if end > 0 else "<", color=color, ms=7, clip_on=False)
        if position.range_m is not None:
            axes.plot(0.0, row, "o", color=figures.INK, markerfacecolor="white", markersize=6, zorder=3)
        if true is not None:
            marker = "x" if abs(true) <= limit else ">" if true > 0 else "<"
            style: dict[str, Any] = {"markersize": 7, "markeredgewidth": 1.6, "zorder": 4, "clip_on": False}
            axes.plot(max(-limit, min(limit, true)), row, marker, color=figures.WARN, **style)
    axes.xaxis.set_major_locator(MaxNLocator(6, symmetric=True))
    axes.xaxis.set_major_formatter(lambda value, _: f"{100 * value:+.3g} %" if value else "0")
    axes.set(xlim=(-limit, limit), ylim=(len(order) - 0.3, -0.7), yticks=[])
    if len(order) <= _NAMED:
        unit, size = range_unit(located), 9 if len(order) <= 20 else 7
        style = {"transform": axes.get_yaxis_transform(), "va": "center", "color": figures.GRAY}
        names = []
        for row, (i, (low, high, _)) in enumerate(zip(order, spans, strict=True)):
            position = located.positions[i]
            names.append(f"{figures.shortened(position.name, 40)}  {_estimate(position, unit)}")
            axes.text(1.03, row, _interval_text(position, low, high, unit), fontsize=size, **style)
        axes.set_yticks(range(len(order)), names, fontsize=size)
    axes.grid(axis="x", color="#e5e7eb", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)


def _interval_text(position: Position, low: float, high: float, unit: Unit) -> str:
    """How long a bar is: "± 0.3 %", "−9 % to +12 %", or from where on."""
    if position.range_m is None or not math.isfinite(high):
        return f"beyond {length_text(position.range_low_m or 0.0, digits=2, unit=unit)}"
    if abs(low + high) <= 0.1 * (high - low):
        return f"± {50 * (high - low):.2g} %"
    return f"{100 * low:+.2g} % to {100 * high:+.2g} %"


def _relative(position: Position, true: Array | None) -> tuple[float, float, float | None]:
    """Return lower end, upper end and truth relative to the estimate, or to the nearest range if there is none."""
    base = position.range_m or position.range_low_m or 1.0
    low = base if position.range_low_m is None else position.range_low_m
    high = base if position.range_high_m is None else position.range_high_m
    known = true is not None and bool(np.isfinite(true).all())
    return low / base - 1.0, high / base - 1.0, float(np.linalg.norm(true)) / base - 1.0 if known else None  # type: ignore[arg-type]


def _estimate(position: Position, unit: Unit) -> str:
    if position.range_m is None:
        return "bearing only"
    return length_text(position.range_m, range_sigma(position), unit=unit)


def _interval_notes(located: Located) -> list[str]:
    lines = [f"Bars: range interval, {located.interval_note}; marks have {located.pixel_sigma:g} px of noise."]
    failed: Sequence[Position] = [p for p in located.positions if p.range_low_m is None]
    lines += [f"{p.name}: {p.reason}" for p in failed[:3]]
    return lines + ([f"and {len(failed) - 3} more"] if len(failed) > 3 else [])


# A plan of stations: towers with what they see, positions with their 95 % ellipses, bearings of single cameras.

# Of the larger side of what is shown: how far fields of view and bearings are drawn.
_REACH = 0.9


def stations_figure(located: Located, truth: Tensor | None = None, ax: Axes | None = None) -> Figure:
    """Draw a plan, kilometers east and north of the origin.

    Args:
        located: from `kcal.locate_points`.
        truth: (N, 3) true east, north, up in meters, NaN where unknown.
        ax: of yours, to draw into.
    """
    notes = ["Outlines: 95 % regions. Dashed: bearings without a range."]
    axes = figures.one_panel(ax, 8.0, 7.0, located.count_note, notes)
    towers = torch.tensor([camera.enu[:2] for camera in located.cameras], dtype=torch.float64)
    shown = torch.cat([towers, located.enu[located.enu.isfinite().all(-1), :2]])
    reach = _REACH * max(float((shown.amax(0) - shown.amin(0)).amax()), 1.0) / 1e3
    for number, (camera, place) in enumerate(zip(located.cameras, (towers / 1e3).numpy(), strict=True)):
        color, sweep = figures.CAMERA_COLORS[number % len(figures.CAMERA_COLORS)], field_azimuths(camera)
        if sweep is not None:
            angle = torch.deg2rad(sweep)
            rim = place + reach * torch.stack([angle.sin(), angle.cos()], -1).numpy()
            figures.draw_field(axes, np.concatenate([place[None], rim, place[None]]), color)
        axes.plot(*place, "^", color=color, markersize=9)
        figures.name_point(axes, place, camera.name, (6, 6), fontsize=10)
    for position, foot in zip(located.positions, located.feet.numpy() / 1e3, strict=True):
        if position.enu is not None and position.covariance is not None:
            center, spread = torch.tensor(position.enu).double(), torch.tensor(position.covariance).double()
            ring = region_outline(center, spread, plain=True) / 1e3
            axes.fill(ring[:, 0], ring[:, 1], facecolor="none", edgecolor=figures.INK, linewidth=1.2)
            axes.plot(*center[:2] / 1e3, ".", color=figures.INK, markersize=4)
            figures.name_point(axes, center[:2] / 1e3, position.name, (5, -11), fontsize=8.5)
        elif position.azimuth_deg is not None and position.status == PositionStatus.BEARING_ONLY:
            way = math.radians(position.azimuth_deg)
            end = foot[:2] + reach * np.array([math.sin(way), math.cos(way)])
            axes.plot(*np.stack([foot[:2], end], 1), "--", color=figures.GRAY, linewidth=1)
            figures.name_point(axes, end, position.name, (4, 4), fontsize=8.5, color=figures.GRAY)
    if truth is not None:
        axes.plot(*(truth[truth.isfinite().all(-1)] / 1e3)[:, :2].T, "+", color=figures.WARN, markersize=8)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="km east", ylabel="km north")
    return figures.finished(axes)


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


def budget_figure(
    distances: Tensor, found: dict[str, RangeError], labels: dict[str, str], ax: Axes | None = None
) -> Figure:
    """Draw lines for each source: outward error solid, inward dotted, first order thin and dashed.

    Args:
        distances: (D,) meters.
        found: errors by source, from `range_errors`.
        labels: source -> text in the legend.
        ax: of yours, to draw into.
    """
    notes = ["Solid: outward. Dotted: inward. Dashed: to first order."]
    axes, far = figures.one_panel(ax, 8.6, 5.7, "Range error by source", notes), distances.numpy()
    for name, error in found.items():
        color = _SOURCE_COLORS.get(name, "#111827")
        # Infinite errors are not drawn: the line leaves the picture there.
        outward = torch.where(error.farther.isfinite(), error.farther, torch.nan)
        axes.plot(far, outward.numpy(), color=color, linewidth=2.0, label=labels.get(name, name))
        axes.plot(far, error.nearer.abs().numpy(), color=color, linewidth=1.4, linestyle=":")
        axes.plot(far, error.first_order.numpy(), color=color, linewidth=0.8, linestyle=(0, (6, 4)), alpha=0.8)
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
    return figures.finished(axes)


# Standard deviations of ranges for a verdict's page.

_PART_COLORS = {"marks": figures.ACCENT, "lenses": "#dd7a1f", "relative pose": "#0f766e", FAULTS: figures.WARN}


def range_picture(answers: Sequence[RangeAnswer]) -> bytes:
    """Standard deviation of ranges by their sources, beside what is required."""
    figure = figures.framed_figure(4.4, 1.3 + 0.6 * len(answers), dpi=160)
    axes = figure.add_subplot()
    names = list(answers[0].parts)
    for row, answer in enumerate(answers):
        far = answer.requirement.distance
        total = answer.sigma
        start = 0.0
        for name in names:
            # Shares of the variance, drawn as shares of the bar.
            length = 100.0 * total / far * (answer.parts[name] / total) ** 2 if 0 < total < math.inf else 0.0
            color, label = _PART_COLORS.get(name, figures.FAINT), None if row else name
            axes.barh(row, length, left=start, color=color, height=0.5, label=label)
            start += length
        allowed = 100.0 * answer.requirement.meters / far
        axes.plot([allowed, allowed], [row - 0.4, row + 0.4], color=figures.INK, linewidth=2.2)
    axes.plot([], [], color=figures.INK, linewidth=2.2, label="required")
    axes.set_yticks(range(len(answers)), [range_text(answer.requirement.distance) for answer in answers])
    axes.invert_yaxis()
    axes.set(xlabel="σ of the range, % (colors: shares of the variance)", xlim=(0.0, None))
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(frameon=False, fontsize=8.5, loc="outside upper left", ncols=3)
    return figures.picture_bytes(figure)


# A picture of sites: how well an area is seen and located today, and with the candidates that are worth most.

# From good to poor; blind and single are told apart by the blind eye too.
_RAMP = LinearSegmentedColormap.from_list("sigma", ["#08519c", "#3b8bc4", "#a9cfe5", "#f5e3b5", "#e9a34f", "#b5471b"])
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
        1
    """
    built = [one for one in ranked if one.order is not None]
    maps = [("Today", siting_map(area, sites, weights))]
    if built:
        names = ", ".join(one.site.name for one in built)
        maps.append((f"With {names}", siting_map(area, [*sites, *(one.site for one in built)], weights)))
    levels = _sigma_levels([found for _, found in maps])
    figure = figures.framed_figure(7.4 * len(maps) + 1.0, 6.8, notes=_siting_notes(maps[0][1], ranked))
    panels = figure.subplots(1, len(maps), squeeze=False, sharex=True, sharey=True)[0]
    for number, (axes, (title, found)) in enumerate(zip(panels, maps, strict=True)):
        colored = _siting_area(axes, area, found, levels)
        later = [] if number else list(ranked)
        _siting_marks(axes, area, sites, [one.site for one in built if number], later)
        axes.set_title(
            f"{title}\n{100 * found.covered:.0f} % of the area seen by two or more, "
            f"median σ there {_median_sigma(found)}",
            fontsize=10.5, loc="left",
        )  # fmt: skip
    (left, right), (low, high) = panels[0].get_xlim(), panels[0].get_ylim()
    figure.set_figheight(min(7.0 * (high - low) / (right - left), 9.0) + 1.8)
    lengths = FuncFormatter(lambda level, _: length_text(level, digits=2))
    label = "standard deviation of a position on the map"
    figures.add_color_bar(colored, panels[-1], label, ticks=levels, format=lengths)
    patches = [Patch(color=_SINGLE, label="one site sees it: a bearing only"), Patch(color=_HIDDEN, label="hidden")]
    marks = axes.plot([], [], "^", color="white", markeredgecolor="black", markersize=9, label="site")
    if ranked:
        marks += axes.plot([], [], "o", color=_NEW, markeredgecolor="black", label="candidate, by rank; new site")
    figure.legend(handles=[*patches, *marks], loc="outside upper left", ncols=4, frameon=False, fontsize=9)
    return figure


def _map_sigma(found: SitingMap) -> NDArray[np.float64]:
    """(rows, columns) standard deviations where two sites or more see an object."""
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
    return figures.round_levels(max(float(low), 1e-3), float(high), least=2)


def _siting_area(axes: Axes, area: Area, found: SitingMap, levels: Sequence[float]) -> Any:
    lats, lons = torch.meshgrid(area.lat, (area.lon + 180.0) % 360.0 - 180.0, indexing="ij")
    places = geodetic_to_enu(torch.stack([lats, lons, torch.zeros_like(lats)], -1), area.origin)
    east, north, _ = (axis.numpy() / 1e3 for axis in places.unbind(-1))
    count = np.where(area.known.numpy(), found.seen_by.numpy(), np.nan).astype(float)
    blind = np.where(count == 0, 0.0, np.where(count == 1, 1.0, np.nan))
    axes.pcolormesh(east, north, blind, cmap=ListedColormap([_HIDDEN, _SINGLE]), vmin=0, vmax=1, rasterized=True)
    norm, sigma = BoundaryNorm(levels, 256, extend="both"), _map_sigma(found)
    colored = axes.pcolormesh(east, north, sigma, cmap=_RAMP, norm=norm, rasterized=True)
    if np.isfinite(sigma).any():
        axes.contour(east, north, sigma, levels=levels, colors="white", linewidths=0.7, alpha=0.8)
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
    # Room for names beyond the edges of the area.
    axes.use_sticky_edges = False
    axes.margins(0.08)
    return colored


def _siting_marks(
    axes: Axes, area: Area, sites: Sequence[Site], new: Sequence[Site], ranked: Sequence[RankedSite]
) -> None:
    for number, site in enumerate([*sites, *new]):
        x, y = _site_field(axes, area, site)
        color = "white" if number < len(sites) else _NEW
        axes.plot([x], [y], "^", color=color, markeredgecolor="black", markersize=9, zorder=5)
        figures.name_point(axes, (x, y), site.name, (7, 9), zorder=6)
    for rank, one in enumerate(ranked, start=1):
        x, y = _site_place(area, one.site)
        axes.plot([x], [y], "o", color=_NEW, markeredgecolor="black", markersize=13, zorder=5)
        axes.text(x, y, str(rank), ha="center", va="center", fontsize=8, zorder=6)
        figures.name_point(axes, (x, y), one.site.name, (9, -8), fontsize=8, zorder=6)


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


def _siting_notes(today: SitingMap, ranked: Sequence[RankedSite]) -> list[str]:
    if not ranked:
        return []
    built = sorted((one for one in ranked if one.after is not None), key=lambda one: one.order or 0)[:5]
    steps = [f"{length_text(one.after or 0.0, digits=3)} with {one.site.name}" for one in built]
    steps = [f"{length_text(today.mean_sigma, digits=3)} today", *steps]
    about = "standard deviation over the whole area, where what nobody sees may be anywhere in it"
    return [f"{about}: {', then '.join(steps)}"]


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
    figure = figures.new_figure(width / 160, height / 160, 100)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(image)
    axes.set_axis_off()
    for (names, pixels), color in ((landmarks, figures.ACCENT), (targets, figures.WARN)):
        for name, (u, v) in zip(names, pixels, strict=True):
            axes.plot(u, v, "o", mfc="none", mec=color, ms=9)
            axes.annotate(
                name, (u, v), (4, 14), textcoords="offset points", color=color, fontsize=11, path_effects=figures.HALO,
                rotation=55, arrowprops={"arrowstyle": "-", "color": color, "lw": 0.8},
            )  # fmt: skip
    where = 0.01 * width, 0.97 * height
    axes.text(*where, "blue: surveyed landmarks    red: targets to locate", fontsize=12, path_effects=figures.HALO)
    return figures.save_picture(path, figure)
