"""Draw the skyline of a terrain raster over an image, and how far the image's own is from it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from kcal.report.colors import ACCENT, INK, WARN
from kcal.report.figures import frame_image, new_figure, save_picture
from kcal.skyline.attitude import SkylineAttitude

# Images that are drawn at most; inches of one.
_MOST, _WIDTH = 6, 9.0


def skyline_figure(images: Sequence[tuple[str, NDArray[Any]]], found: Sequence[SkylineAttitude]) -> Figure:
    """Draw each image with the raster's skyline over it, and below what is left of it in the columns.

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


def save_skyline_picture(
    path: str | Path, images: Sequence[tuple[str, NDArray[Any]]], found: Sequence[SkylineAttitude]
) -> Path:
    """Write a picture of skylines as PNG or SVG; see `skyline_figure`."""
    return save_picture(path, skyline_figure(images, found))
