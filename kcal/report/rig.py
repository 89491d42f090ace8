"""Pictures of a solved rig, of what tells its attitude, and of its attitude over time."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray

import kcal.report.figures as figures
from kcal.calibrate.rig.result import RigResult
from kcal.lens.camera import Camera
from kcal.locate.tabulate import middle_row_ends
from kcal.skyline.attitude import SkylineAttitude
from kcal.texts import length_text, measured_length, range_text
from kcal.threads import in_one_thread

# A picture of a solved rig: the site from above, and how well each source and each item agrees with the rest.

Array = NDArray[np.float64]

_COLORS = {
    "boards": "#4b5563", "landmarks": "#2b6cb0", "features": "#0f766e", "stars": "#b7791f", "skyline": "#be3455",
    "baselines": "#7c3aed", "positions": "#dd7a1f",
}  # fmt: skip
_ROWS = 45
# Of what is shown: cameras farther from their middle stand around it.
_WIDE = 0.1


@in_one_thread
def rig_figure(result: RigResult, narrow: bool = False, figure: Figure | SubFigure | None = None) -> Figure:
    """Draw a rig on the map, with what it was solved from, and each item's residual in sigmas.

    Distances from the rig are drawn as log(1 + range / r0), directions as they are; to scale where the cameras stand as
    far apart as what they saw. What was left out is magenta.

    Args:
        result: from `solve_rig` or `calibrate_rig`.
        narrow: for a phone: the bars below the map.
        figure: of yours, or a part of it, to draw into.

    Returns:
        A matplotlib figure that belongs to no window and no global state: the map, then the bars.

    Example:
        >>> import torch
        >>> from kcal import Camera, Landmarks, RigData, RigOptions, Rig, solve_rig
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> ahead = 80.0 * (1.0 + torch.arange(8).double())
        >>> places = torch.stack([ahead * torch.sin(ahead), ahead * torch.cos(ahead), 10 * ahead], -1) * 0.4
        >>> left, right = rig(places)[0].unbind(-2)
        >>> seen = Landmarks(names=tuple("abcdefgh"), points=places, sigma=torch.full_like(places, 0.02),
        ...                  pixels=torch.stack([left, right], 1), pixel_sigma=0.1)
        >>> data = RigData(cameras=(camera, camera), names=("left", "right"), landmarks=seen)
        >>> figure = rig_figure(solve_rig(data, RigOptions(refraction=0.0, refraction_sigma=0.0)))
        >>> len(figure.axes)
        2
    """
    apart = torch.cdist(result.center, result.center)
    size = f"up to {length_text(float(apart.max()))} apart"
    if len(result.names) == 2:
        size = f"baseline {measured_length(float(apart[0, 1]), result.sigma_baseline)}"
    title = f"Rig of {len(result.names)} cameras, {size}"
    width, height, dpi = (4.4, 8.4, 160) if narrow else (13.0, 7.0, 130)
    figure = figures.framed_figure(width, height, title, _notes(result), dpi, figure)
    parts = figure.subfigures(2, 1) if narrow else figure.subfigures(1, 2, width_ratios=[1.25, 1.0])
    plan, bars = (part.subplots() for part in np.asarray(parts))
    _draw_plan(plan, result, 2 if narrow else 4)
    _draw_items(bars, result)
    return figures.whole(figure)


def _flat(result: RigResult, points: Array) -> Array:
    """East and north, or right and forward of the first camera where the frame is its own."""
    return points[..., :2] if result.absolute else points[..., [0, 2]]


def _places(result: RigResult) -> dict[str, tuple[Array, list[str], list[bool]]]:
    """Places on the plan of landmarks, boards and features, their names, and whether they are used."""
    out: dict[str, tuple[Array, list[str], list[bool]]] = {}
    for kind, points in result.places().items():
        items = {item.name: item.used for item in result.items if item.source == kind}
        names = [name for name in points if name in items]
        if names:
            places = np.stack([points[name].numpy() for name in names])
            out[kind] = (_flat(result, places), names, [items[name] for name in names])
    return out


def _draw_plan(axes: Axes, result: RigResult, columns: int) -> None:
    centers = _flat(result, result.center.numpy())
    middle = centers.mean(0)
    places = _places(result)
    spans = [np.hypot(*(centers - middle).T)] + [np.hypot(*(xy - middle).T) for xy, _, _ in places.values()]
    reach = max(float(np.max(span)) for span in spans) * 1.15
    nearest = min((float(np.min(span)) for span in spans[1:]), default=reach)
    # Stations around what they see are drawn to scale.
    scale = figures.RangeScale(nearest=nearest, rim=reach, middle=middle, true=float(np.max(spans[0])) > _WIDE * reach)
    extent = []
    for c, camera in enumerate(result.cameras):
        color, edges = figures.CAMERA_COLORS[c % len(figures.CAMERA_COLORS)], _edges(result, c, camera)
        if edges is not None:
            extent.append(scale.place(figures.field_outline(centers[c], *edges, reach, 100)))
            figures.draw_field(axes, extent[-1], color)
    circle = np.linspace(0.0, 2.0 * math.pi, 200)
    for radius in (step * 10.0**power for power in range(-3, 7) for step in (1.0, 5.0)):
        if nearest / 4 <= radius <= reach:
            ring = float(scale.radius(radius))
            axes.plot(ring * np.sin(circle), ring * np.cos(circle), color=figures.FAINT, linewidth=0.7, linestyle=":")
            style: dict[str, Any] = {"color": figures.GRAY, "ha": "center", "va": "bottom", "fontsize": 8}
            figures.name_point(axes, (0.0, ring), range_text(radius), (0, 1), **style)
    for kind, (points, names, used) in places.items():
        drawn, good = scale.place(points), np.array(used)
        marker = {"landmarks": "^", "boards": "s", "features": "o"}[kind]
        axes.plot(*drawn[good].T, marker, label=kind, markersize=6, color=_COLORS[kind], markerfacecolor="white")
        axes.plot(*drawn[~good].T, "x", color=figures.WARN, markersize=8, markeredgewidth=1.8)
        for xy, name, fine in zip(drawn, names, used, strict=True):
            if not fine or (kind == "landmarks" and len(names) <= 30):
                figures.name_point(axes, xy, name, fontsize=8, color=_COLORS[kind] if fine else figures.WARN)
    if any(not item.used for item in result.items):
        axes.plot([], [], "x", color=figures.WARN, markeredgewidth=1.8, label="left out")
    looks = result.rotation[:, 2].numpy()
    for c, name in enumerate(result.names):
        here = scale.place(centers[c])
        ahead = _flat(result, looks[c])
        ahead = ahead / max(float(np.hypot(*ahead)), 1e-9)
        figures.draw_way(axes, here, here + 0.12 * ahead, figures.INK, linewidth=1.2)
        color = figures.CAMERA_COLORS[c % len(figures.CAMERA_COLORS)]
        axes.plot(*here, "o", color=color, markersize=6, zorder=9, label=f"{name} camera")
    seen = np.concatenate([scale.place(centers), *extent, *(scale.place(points) for points, _, _ in places.values())])
    low, high = seen.min(0) - 0.1, seen.max(0) + 0.15
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.axis("off")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.005), ncols=columns, fontsize=9, frameon=False)
    if result.absolute:
        figures.draw_north(axes, 0.04)
    where = "north up" if result.absolute else "first camera's axis up"
    ranges = "to scale" if scale.true else "ranges on a logarithmic scale"
    axes.set_title(f"From above, {where}, {ranges}", fontsize=9)


def _edges(result: RigResult, c: int, camera: Camera) -> tuple[float, float] | None:
    """Azimuths on the plan of the left and right ends of the image's middle row; None without rays there."""
    if (rays := middle_row_ends(camera)) is None:
        return None
    flat = _flat(result, (rays @ result.rotation[c]).numpy())
    if float(np.linalg.norm(flat, axis=-1).min()) < 1e-6:
        return None
    return float(np.arctan2(*flat[0])), float(np.arctan2(*flat[1]))


def _draw_items(axes: Axes, result: RigResult) -> None:
    """A bar for each item: the worst ones where there are many."""
    items = sorted(result.items, key=lambda item: (item.source, item.used, -item.sigmas))
    # What was left out, and then the worst.
    items = sorted(items, key=lambda item: (item.used, -item.sigmas if item.used else 0.0))[:_ROWS]
    items = sorted(items, key=lambda item: (item.source, item.used, -item.sigmas))
    limit = max([3.5, *(min(item.sigmas, 8.0) for item in items)]) * 1.05
    for row, item in enumerate(items):
        length = min(item.sigmas, limit)
        axes.barh(row, length, color=_COLORS[item.source] if item.used else figures.WARN, height=0.7, alpha=0.85)
        if item.sigmas > limit:
            axes.text(limit * 0.99, row, f"{item.sigmas:.0f} ▸", ha="right", va="center", fontsize=7.5, color="white")
    axes.axvline(1.0, color=figures.INK, linewidth=0.9, linestyle=(0, (4, 3)))
    labels = [dataclasses.replace(item, name=figures.shortened(item.name, 28)).label for item in items]
    axes.set_yticks(range(len(items)), labels, fontsize=7 if len(items) > 25 else 8.5)
    axes.set(xlim=(0, limit), ylim=(len(items) - 0.4, -0.6), xlabel="residual in sigmas; 1 is typical")
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    shown = "" if len(items) == len(result.items) else f", the worst {len(items)} of {len(result.items)}"
    axes.set_title(f"Residuals by item{shown}", fontsize=9)


def _notes(result: RigResult) -> list[str]:
    parts = []
    for source in result.sources:
        values = [f"{source.used} used"] + ([f"{source.left_out} left out"] if source.left_out else [])
        values += [] if source.rms_px is None else [f"{source.rms_px:.3f} px"]
        values += [] if source.rms_m is None else [length_text(source.rms_m)]
        values += [] if source.sigmas is None else [f"{source.sigmas:.2f} sigma"]
        parts.append(f"{source.name}: {', '.join(values)}")
    return ["   ".join(parts), *(f"{item.label}: {item.reason}" for item in result.left_out[:2])]


# Draw a night image with the names of its stars, and the residuals of all of them as magnified arrows.

# Names of more stars would cover each other.
_MOST_NAMES = 30
# Share of the width from which on names stand to the left of their stars.
_NEAR_EDGE = 0.92
# px over which the sky's brightness hardly changes.
_BLOCK = 64


def stars_figure(
    image: NDArray[Any],
    pixels: NDArray[np.float64],
    names: Sequence[str],
    residual: NDArray[np.float64],
    title: str = "",
    ax: Axes | None = None,
) -> Figure:
    """Draw the stars (N, 2) over the image (H, W), its gray levels turned over; the first stars get their names.

    Args:
        image: gray levels.
        pixels: (N, 2) stars, the brightest first.
        names: of each; empty for stars without one.
        residual: (N, 2) projected minus seen; NaN for those.
        title: the line above.
        ax: of yours, to draw into.
    """
    height, width = image.shape
    known = np.array([bool(name) for name in names], bool)
    axes = figures.image_panel(ax, (width, height), title, ["Arrows: residuals, modeled minus seen."])
    # Turned over: stars are dark on a bright sky, so that marks and names can be read.
    axes.imshow(-_above_sky(image), cmap="gray", vmin=-30.0, vmax=2.0, interpolation="nearest")
    axes.plot(*pixels[~known].T, "x", color=figures.WARN, markersize=4, label=f"{int((~known).sum())} without a name")
    style: dict[str, Any] = {"markersize": 9, "markerfacecolor": "none", "color": figures.ACCENT}
    axes.plot(*pixels[known].T, "o", label=f"{int(known.sum())} named", **style)
    for place, name in [(at, name) for at, name in zip(pixels, names, strict=True) if name][:_MOST_NAMES]:
        beside = 7 if place[0] < _NEAR_EDGE * width else -7, -3
        figures.name_point(axes, place, name, beside, fontsize=7, va="baseline")
    if known.any():
        off = residual[known]
        scale = 0.04 * width / max(float(np.linalg.norm(off, axis=1).max()), 1e-3)
        figures.draw_arrows(axes, pixels[known], off, scale, color=figures.WARN, width=0.0015)
    axes.legend(loc="lower right", fontsize=8)
    return figures.finished(axes)


def _above_sky(image: NDArray[Any]) -> NDArray[np.float64]:
    """(H, W) gray levels above the sky, whose brightness changes slowly over the image, in units of its noise."""
    levels = image.astype(np.float64)
    sky = levels
    for axis in (0, 1):
        parts = np.array_split(sky, max(1, image.shape[axis] // _BLOCK), axis)
        places = np.cumsum([0, *(part.shape[axis] for part in parts)])
        middles = 0.5 * (places[:-1] + places[1:] - 1)
        medians = np.stack([np.median(part, axis) for part in parts], axis)
        every = np.arange(places[-1])
        sky = np.apply_along_axis(lambda line, x=every, at=middles: np.interp(x, at, line), axis, medians)
    above = levels - sky
    return above / max(1.4826 * float(np.median(np.abs(above))), 1e-9)


# Draw the skyline of a terrain raster over an image, and how far the image's own is from it.

# Images that are drawn at most.
_MOST = 6


def skyline_figure(images: Sequence[tuple[str, NDArray[Any]]], found: Sequence[SkylineAttitude]) -> Figure:
    """Draw the raster's skyline over each image, and below it the residual of each column.

    Args:
        images: name and gray levels (H, W) of each.
        found: the attitude from each.
    """
    shown = list(zip(images, found, strict=True))[:_MOST]
    # The band around the skyline is what there is to see.
    bands = [_band(image.shape[0], one) for (_, image), one in shown]
    sizes = [8.3 * (high - low) / image.shape[1] for ((_, image), _), (low, high) in zip(shown, bands, strict=True)]
    ratios = [height for size in sizes for height in (size, 1.1)]
    figure = figures.framed_figure(9.0, sum(sizes) + 2.3 * len(shown))
    panels = figure.subplots(2 * len(shown), 1, height_ratios=ratios, squeeze=False)[:, 0]
    for k, (((name, image), one), (low, high)) in enumerate(zip(shown, bands, strict=True)):
        axes, below = panels[2 * k : 2 * k + 2]
        column, width = np.arange(image.shape[1]), image.shape[1]
        axes.imshow(image, cmap="gray", interpolation="nearest")
        figures.frame_image(axes, (width, image.shape[0]))
        axes.set(ylim=(high - 0.5, low - 0.5), xlabel="")
        axes.plot(column, one.expected, color=figures.ACCENT, linewidth=1.0, label="raster")
        left_out = one.border.clear & ~one.used
        style: dict[str, Any] = {"color": figures.WARN, "markersize": 2, "label": "image, left out"}
        axes.plot(column[left_out], one.border.row[left_out], ".", **style)
        axes.legend(loc="lower right", fontsize=7)
        angles = (("heading", one.heading_deg), ("pitch", one.pitch_deg), ("roll", one.roll_deg))
        named = zip(angles, one.sigma_deg, strict=True)
        text = ", ".join(f"{angle} {value:.3f} ± {sigma:.3f}°" for (angle, value), sigma in named)
        axes.set_title(f"{name}: {text}", fontsize=9, color=figures.INK, loc="left")
        off = one.expected - one.border.row
        for part, color in ((one.used, figures.ACCENT), (left_out, figures.WARN)):
            below.plot(column, np.where(part, off, np.nan), ".", color=color, markersize=2)
        below.axhline(0.0, color=figures.INK, linewidth=0.5)
        most = float(np.nanquantile(np.abs(off[one.used]), 0.99)) * 1.6
        below.set(xlim=(-0.5, width - 0.5), ylim=(-most, most))
        below.set_xlabel("u, pixels", fontsize=7)
        below.set_ylabel("image above\nraster, px", fontsize=7)
        below.tick_params(labelsize=7)
    return figure


def _band(height: int, found: SkylineAttitude) -> tuple[int, int]:
    rows = np.concatenate([found.expected[np.isfinite(found.expected)], found.border.row[found.border.clear]])
    beside = max(0.08 * height, 20.0)
    return max(int(rows.min() - beside), 0), min(int(rows.max() + beside), height)


# Draw the attitude of a watched rig over time, with its 95 % bands.

_ANGLES = ("pitch", "yaw", "roll")
_SPANS = ((86400.0 * 3, 86400.0, "days"), (7200.0, 3600.0, "hours"), (0.0, 60.0, "minutes"))


def attitude_figure(
    time: NDArray[np.float64],
    angle: NDArray[np.float64],
    sigma: NDArray[np.float64],
    seen: NDArray[np.bool_],
    limit: float,
    title: str = "",
) -> Figure:
    """Draw pitch, yaw and roll of the right camera against the left one, each in its own axes.

    Args:
        time: (T,) seconds.
        angle: (T, 3) degrees.
        sigma: (T, 3) degrees.
        seen: (T,) looks at which both cameras saw something.
        limit: degrees of the alarm.
        title: the line above.
    """
    span = float(time[-1] - time[0]) if len(time) else 0.0
    unit, word = next((unit, word) for least, unit, word in _SPANS if span >= least)
    along = (time - (time[0] if len(time) else 0.0)) / unit
    figure = figures.framed_figure(9.0, 6.3, title)
    panels = figure.subplots(3, 1, sharex=True)
    for axes, name, middle, wide in zip(panels, _ANGLES, angle.T, 1.96 * sigma.T, strict=True):
        band: dict[str, Any] = {"color": figures.ACCENT, "alpha": 0.25, "linewidth": 0, "label": "95 %"}
        axes.fill_between(along, middle - wide, middle + wide, **band)
        axes.plot(along, middle, color=figures.ACCENT, linewidth=1.0)
        for end, label in ((-limit, None), (limit, "limit")):
            axes.axhline(end, color=figures.WARN, linewidth=0.8, linestyle="--", label=label)
        if not seen.all():
            gaps, low = along[~seen], axes.get_ylim()[0]
            axes.plot(gaps, np.full_like(gaps, low), "|", color=figures.INK, markersize=6, label="not seen")
            axes.set_ylim(bottom=low)
        axes.set_ylabel(f"{name}, degrees")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", fontsize=8, ncols=3, frameon=False)
    panels[2].set_xlabel(word)
    return figure
