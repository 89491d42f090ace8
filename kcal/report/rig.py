"""A picture of a solved rig: the site from above, and how well each source and each item agrees with the rest."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from kcal.calibrate.rig.result import ItemResidual, RigResult
from kcal.lens.camera import Camera
from kcal.locate.tabulate import middle_row_ends
from kcal.quantities import length_text, measured_length, range_text
from kcal.report.colors import CAMERA_COLORS, FAINT, WARN
from kcal.report.figures import HALO, draw_north, field_outline, new_figure, save_picture, wrapped
from kcal.threads import in_one_thread

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
        >>> from kcal import Camera, Landmarks, RigData, RigOptions, StereoRig, solve_rig
        >>> camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> ahead = 80.0 * (1.0 + torch.arange(8).double())
        >>> places = torch.stack([ahead * torch.sin(ahead), ahead * torch.cos(ahead), 10 * ahead], -1) * 0.4
        >>> left, right, _ = rig(places)
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


def save_rig_picture(path: str | Path, result: RigResult) -> Path:
    """Write the picture of `rig_figure` as PNG or SVG, atomically.

    Raises:
        InputError: a suffix other than .png and .svg.
        FileError: the file cannot be written.
    """
    return save_picture(path, rig_figure(result))


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
        parts.append(f"{source.source}: {', '.join(values)}, {source.sigmas:.2f} sigma")
    texts = ["   ".join(parts), *(f"{item.label}: {item.reason}" for item in result.left_out[:2])]
    return "\n".join(line for text in texts for line in wrapped(text, 12.6, 9.0))
