"""Pictures of a solved rig, of what tells its attitude, and of its attitude over time."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from kcal.calibrate.rig.result import RigResult
from kcal.lens.calibration import ItemResidual
from kcal.lens.camera import Camera
from kcal.locate.tabulate import middle_row_ends
from kcal.report.figures import (
    ACCENT,
    CAMERA_COLORS,
    FAINT,
    HALO,
    INK,
    WARN,
    draw_arrows,
    draw_north,
    field_outline,
    frame_image,
    new_figure,
    wrapped,
)
from kcal.skyline.attitude import SkylineAttitude
from kcal.texts import length_text, measured_length, range_text
from kcal.threads import in_one_thread

# A picture of a solved rig: the site from above, and how well each source and each item agrees with the rest.

Array = NDArray[np.float64]

_COLORS = {
    "boards": "#4b5563",
    "landmarks": "#2b6cb0",
    "features": "#0f766e",
    "stars": "#b7791f",
    "skyline": "#be3455",
    "baselines": "#7c3aed",
    "positions": "#dd7a1f",
}
_ROWS = 45
# Of what is shown: cameras farther from their middle stand around it.
_WIDE = 0.1


@in_one_thread
def rig_figure(result: RigResult) -> Figure:
    """Draw a rig on the map, with what it was solved from, and each item's residual in sigmas.

    Distances from the rig are drawn as log(1 + range / r0), directions as they are; to scale where the cameras stand as
    far apart as what they saw. What was left out is magenta.

    Args:
        result: from `solve_rig` or `calibrate_rig`.

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
    figure = new_figure(13.0, 7.6)
    plan, bars = figure.subplots(1, 2, width_ratios=[1.25, 1.0])
    _draw_plan(plan, result)
    _draw_items(bars, result)
    apart = torch.cdist(result.center, result.center)
    size = f"up to {length_text(float(apart.max()))} apart"
    if len(result.names) == 2:
        size = f"baseline {measured_length(float(apart[0, 1]), result.sigma_baseline)}"
    figure.suptitle(
        f"Rig of {len(result.names)} cameras, {size}",
        x=0.015,
        ha="left",
        fontsize=14,
    )
    figure.text(0.015, 0.02, _footer(result), fontsize=9, color="#4b5563", va="bottom", linespacing=1.45)
    figure.subplots_adjust(left=0.015, right=0.975, top=0.9, bottom=0.19, wspace=0.28)
    return figure


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


def _draw_plan(axes: Axes, result: RigResult) -> None:
    centers = _flat(result, result.center.numpy())
    middle = centers.mean(0)
    places = _places(result)
    spans = [np.hypot(*(centers - middle).T)] + [np.hypot(*(xy - middle).T) for xy, _, _ in places.values()]
    reach = max(float(np.max(span)) for span in spans) * 1.15
    nearest = min((float(np.min(span)) for span in spans[1:]), default=reach)
    unit = max(nearest / 2.0, reach / 1000.0)
    # Stations around what they see are drawn to scale.
    wide = float(np.max(spans[0])) > _WIDE * reach

    def length(distance: Any) -> Any:
        return distance / reach if wide else np.log1p(distance / unit) / math.log1p(reach / unit)

    def place(points: Array) -> Array:
        offset = points - middle
        distance = np.maximum(np.hypot(offset[..., 0], offset[..., 1]), 1e-9)[..., None]
        return np.asarray(offset / distance * length(distance))

    extent = []
    for c, camera in enumerate(result.cameras):
        color, edges = CAMERA_COLORS[c % len(CAMERA_COLORS)], _edges(result, c, camera)
        if edges is not None:
            extent.append(place(field_outline(centers[c], *edges, 1.1 * reach, 100)))
            axes.fill(*extent[-1].T, facecolor=color, alpha=0.07, edgecolor="none", zorder=0)
            axes.plot(*extent[-1].T, color=color, alpha=0.5, linewidth=0.9, zorder=1)
    circle = np.linspace(0.0, 2.0 * math.pi, 200)
    for radius in (step * 10.0**power for power in range(-3, 7) for step in (1.0, 5.0)):
        if nearest / 4 <= radius <= reach:
            ring = length(radius)
            axes.plot(ring * np.sin(circle), ring * np.cos(circle), color=FAINT, linewidth=0.7, linestyle=":")
            axes.text(
                0.0, ring, range_text(radius), fontsize=8, color="#4b5563", ha="center", va="bottom", path_effects=HALO
            )
    for kind, (points, names, used) in places.items():
        drawn, good = place(points), np.array(used)
        marker = {"landmarks": "^", "boards": "s", "features": "o"}[kind]
        axes.plot(*drawn[good].T, marker, label=kind, markersize=6, color=_COLORS[kind], markerfacecolor="white")
        axes.plot(*drawn[~good].T, "x", color=WARN, markersize=8, markeredgewidth=1.8)
        for xy, name, fine in zip(drawn, names, used, strict=True):
            if not fine or (kind == "landmarks" and len(names) <= 30):
                color = _COLORS[kind] if fine else WARN
                axes.annotate(
                    name, (float(xy[0]), float(xy[1])), (6, 0), textcoords="offset points", fontsize=8, color=color,
                    va="center",
                )  # fmt: skip
    if any(not item.used for item in result.items):
        axes.plot([], [], "x", color=WARN, markeredgewidth=1.8, label="left out")
    looks = result.rotation[:, 2].numpy()
    for c, name in enumerate(result.names):
        here = place(centers[c])
        ahead = _flat(result, looks[c])
        ahead = ahead / max(float(np.hypot(*ahead)), 1e-9)
        axes.annotate(
            "", (float(here[0] + 0.12 * ahead[0]), float(here[1] + 0.12 * ahead[1])), (float(here[0]), float(here[1])),
            arrowprops={"arrowstyle": "-|>", "color": "#111827", "linewidth": 1.2},
        )  # fmt: skip
        axes.plot(
            *here, "o", color=CAMERA_COLORS[c % len(CAMERA_COLORS)], markersize=6, zorder=5, label=f"{name} camera"
        )
    seen = np.concatenate([place(centers), *extent, *(place(points) for points, _, _ in places.values())])
    low, high = seen.min(0) - 0.1, seen.max(0) + 0.15
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.axis("off")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.005), ncols=4, fontsize=9, frameon=False)
    if result.absolute:
        draw_north(axes, 0.04)
    where = "north up" if result.absolute else "first camera's axis up"
    scale = "to scale" if wide else "ranges on a logarithmic scale"
    axes.set_title(f"From above, {where}, {scale}", fontsize=10.5, color="#374151")


def _edges(result: RigResult, c: int, camera: Camera) -> tuple[float, float] | None:
    """Azimuths on the plan of the left and right ends of the image's middle row; None without rays there."""
    rays = middle_row_ends(camera)
    if rays is None:
        return None
    flat = _flat(result, (rays @ result.rotation[c]).numpy())
    if float(np.linalg.norm(flat, axis=-1).min()) < 1e-6:
        return None
    return float(np.arctan2(*flat[0])), float(np.arctan2(*flat[1]))


def _draw_items(axes: Axes, result: RigResult) -> None:
    """A bar for each item: the worst ones where there are many."""
    items = sorted(result.items, key=lambda item: (item.source, item.used, -item.sigmas))
    if len(items) > _ROWS:
        wrong = [item for item in items if not item.used]
        good = sorted((item for item in items if item.used), key=lambda item: -item.sigmas)
        items = sorted((wrong + good)[:_ROWS], key=lambda item: (item.source, item.used, -item.sigmas))
    limit = max([3.5, *(min(item.sigmas, 8.0) for item in items)]) * 1.05
    for row, item in enumerate(items):
        length = min(item.sigmas, limit)
        axes.barh(row, length, color=_COLORS[item.source] if item.used else WARN, height=0.7, alpha=0.85)
        if item.sigmas > limit:
            axes.text(limit * 0.99, row, f"{item.sigmas:.0f} ▸", ha="right", va="center", fontsize=7.5, color="white")
    axes.axvline(1.0, color="#374151", linewidth=0.9, linestyle=(0, (4, 3)))
    axes.set_yticks(range(len(items)), [_label(item) for item in items], fontsize=7 if len(items) > 25 else 8.5)
    axes.set(xlim=(0, limit), ylim=(len(items) - 0.4, -0.6), xlabel="residual in sigmas; 1 is typical")
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    shown = "" if len(items) == len(result.items) else f", the worst {len(items)} of {len(result.items)}"
    axes.set_title(f"Residuals by item{shown}", fontsize=10.5, color="#374151")


def _label(item: ItemResidual) -> str:
    name = item.name if len(item.name) <= 28 else f"{item.name[:27]}…"
    return dataclasses.replace(item, name=name).label


def _footer(result: RigResult) -> str:
    parts = []
    for source in result.sources:
        values = [f"{source.used} used"] + ([f"{source.left_out} left out"] if source.left_out else [])
        values += [] if source.rms_px is None else [f"{source.rms_px:.3f} px"]
        values += [] if source.rms_m is None else [length_text(source.rms_m)]
        values += [] if source.sigmas is None else [f"{source.sigmas:.2f} sigma"]
        parts.append(f"{source.name}: {', '.join(values)}")
    texts = ["   ".join(parts), *(f"{item.label}: {item.reason}" for item in result.left_out[:2])]
    return "\n".join(line for text in texts for line in wrapped(text, 12.6, 9.0))


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
) -> Figure:
    """Draw the stars (N, 2) over the image (H, W), its gray levels turned over; the first stars get their names.

    Args:
        image: gray levels.
        pixels: (N, 2) stars, the brightest first.
        names: of each; empty for stars without one.
        residual: (N, 2) projected minus seen; NaN for those.
        title: the line above.
    """
    height, width = image.shape
    figure = new_figure(9.0, 9.0 * height / width + 0.9)
    axes = figure.add_axes((0.07, 0.07, 0.91, 0.86))
    # Turned over: stars are dark on a bright sky, so that marks and names can be read.
    axes.imshow(-_above_sky(image), cmap="gray", vmin=-30.0, vmax=2.0, interpolation="nearest")
    frame_image(axes, (width, height))
    known = np.array([bool(name) for name in names], bool)
    axes.plot(*pixels[~known].T, "x", color=WARN, markersize=4, label=f"{int((~known).sum())} without a name")
    axes.plot(
        *pixels[known].T, "o", markersize=9, markerfacecolor="none", color=ACCENT, label=f"{int(known.sum())} named"
    )
    for place, name in [(at, name) for at, name in zip(pixels, names, strict=True) if name][:_MOST_NAMES]:
        beside = (7, "left") if place[0] < _NEAR_EDGE * width else (-7, "right")
        axes.annotate(name, place, (beside[0], -3), textcoords="offset points", fontsize=7, color=INK, ha=beside[1])
    if known.any():
        longest = max(float(np.linalg.norm(residual[known], axis=1).max()), 1e-3)
        scale = draw_arrows(axes, pixels[known], residual[known], 0.04 * width / longest, color=WARN, width=0.0015)
        axes.set_title(f"{title}  arrows: residuals x {scale:g}".strip(), fontsize=9, color=INK, loc="left")
    axes.legend(loc="lower right", fontsize=8)
    return figure


def _above_sky(image: NDArray[Any]) -> NDArray[np.float64]:
    """(H, W) gray levels above the sky, whose brightness changes slowly over the image, in units of its noise."""
    levels = image.astype(np.float64)
    sky = levels
    for axis in (0, 1):
        parts = np.array_split(sky, max(1, image.shape[axis] // _BLOCK), axis)
        places = np.cumsum([0, *(part.shape[axis] for part in parts)])
        middles = 0.5 * (places[:-1] + places[1:] - 1)
        medians = np.stack([np.median(part, axis) for part in parts], axis)
        sky = np.apply_along_axis(partial(_interpolated, middles, int(places[-1])), axis, medians)
    above = levels - sky
    return above / max(1.4826 * float(np.median(np.abs(above))), 1e-9)


def _interpolated(places: NDArray[np.float64], count: int, values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.interp(np.arange(count), places, values)


# Draw the skyline of a terrain raster over an image, and how far the image's own is from it.

# Images that are drawn at most; inches of one.
_MOST, _WIDTH = 6, 9.0


def skyline_figure(images: Sequence[tuple[str, NDArray[Any]]], found: Sequence[SkylineAttitude]) -> Figure:
    """Draw the raster's skyline over each image, and below it the residual of each column.

    Args:
        images: name and gray levels (H, W) of each.
        found: the attitude from each.
    """
    shown = list(zip(images, found, strict=True))[:_MOST]
    # The band around the skyline is what there is to see.
    bands = [_band(image.shape[0], one) for (_, image), one in shown]
    sizes = [
        0.92 * _WIDTH * (high - low) / image.shape[1] for ((_, image), _), (low, high) in zip(shown, bands, strict=True)
    ]
    total = sum(sizes) + 2.3 * len(shown)
    figure = new_figure(_WIDTH, total)
    top = 1.0
    for ((name, image), one), (low, high), size in zip(shown, bands, sizes, strict=True):
        width = image.shape[1]
        axes = figure.add_axes((0.07, top - (0.4 + size) / total, 0.91, size / total))
        below = figure.add_axes((0.07, top - (0.7 + size + 1.1) / total, 0.91, 1.1 / total))
        top -= (2.3 + size) / total
        axes.imshow(image, cmap="gray", interpolation="nearest")
        frame_image(axes, (width, image.shape[0]))
        axes.set_ylim(high - 0.5, low - 0.5)
        axes.set_xlabel("")
        column = np.arange(width)
        axes.plot(column, one.expected, color=ACCENT, linewidth=1.0, label="raster")
        left_out = one.border.clear & ~one.used
        axes.plot(column[left_out], one.border.row[left_out], ".", color=WARN, markersize=2, label="image, left out")
        axes.legend(loc="lower right", fontsize=7)
        heading, pitch, roll = one.sigma_deg
        axes.set_title(
            f"{name}: heading {one.heading_deg:.3f} ± {heading:.3f}°, pitch {one.pitch_deg:.3f} ± {pitch:.3f}°, roll "
            f"{one.roll_deg:.3f} ± {roll:.3f}°",
            fontsize=9, color=INK, loc="left",
        )  # fmt: skip
        off = one.expected - one.border.row
        below.plot(column, np.where(one.used, off, np.nan), ".", color=ACCENT, markersize=2)
        below.plot(column, np.where(left_out, off, np.nan), ".", color=WARN, markersize=2)
        below.axhline(0.0, color=INK, linewidth=0.5)
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
    figure = new_figure(9.0, 6.5)
    for k, name in enumerate(_ANGLES):
        axes = figure.add_axes((0.1, 0.7 - 0.3 * k, 0.88, 0.24))
        middle, wide = angle[:, k], 1.96 * sigma[:, k]
        axes.fill_between(along, middle - wide, middle + wide, color=ACCENT, alpha=0.25, linewidth=0, label="95 %")
        axes.plot(along, middle, color=ACCENT, linewidth=1.0)
        for sign in (-1.0, 1.0):
            axes.axhline(sign * limit, color=WARN, linewidth=0.8, linestyle="--", label="limit" if sign > 0 else None)
        if not seen.all():
            low = axes.get_ylim()[0]
            axes.plot(along[~seen], np.full(int((~seen).sum()), low), "|", color=INK, markersize=6, label="not seen")
            axes.set_ylim(bottom=low)
        axes.set_ylabel(f"{name}, degrees", color=INK, fontsize=9)
        axes.tick_params(labelsize=8, colors=INK)
        if k == 0:
            axes.set_title(title, fontsize=9, color=INK, loc="left")
            axes.legend(loc="upper right", fontsize=8, ncols=3)
        if k == 2:
            axes.set_xlabel(word, color=INK, fontsize=9)
    return figure
