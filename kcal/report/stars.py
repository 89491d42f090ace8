"""Draw a night image with the names of its stars, and the residuals of all of them as magnified arrows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from kcal.corners.images import to_8bit
from kcal.report.figures import ACCENT, INK, WARN, draw_arrows, frame_image, new_figure, save_picture

# Names of more stars would cover each other.
_MOST_NAMES = 30


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
    levels = to_8bit(image) if image.dtype in (np.uint8, np.uint16) else _sixteen_bits(image)
    axes.imshow(255 - levels.astype(np.int64), cmap="gray", vmin=-60, vmax=255, interpolation="nearest")
    frame_image(axes, (width, height))
    known = np.array([bool(name) for name in names], bool)
    axes.plot(*pixels[~known].T, "x", color=WARN, markersize=4, label=f"{int((~known).sum())} without a name")
    axes.plot(
        *pixels[known].T, "o", markersize=9, markerfacecolor="none", color=ACCENT, label=f"{int(known.sum())} named"
    )
    for place, name in [(at, name) for at, name in zip(pixels, names, strict=True) if name][:_MOST_NAMES]:
        axes.annotate(name, place, (7, -3), textcoords="offset points", fontsize=7, color=INK)
    if known.any():
        longest = max(float(np.linalg.norm(residual[known], axis=1).max()), 1e-3)
        scale = draw_arrows(axes, pixels[known], residual[known], 0.04 * width / longest, color=WARN, width=0.0015)
        axes.set_title(f"{title}  arrows: residuals x {scale:g}".strip(), fontsize=9, color=INK, loc="left")
    axes.legend(loc="lower right", fontsize=8)
    return figure


def _sixteen_bits(image: NDArray[Any]) -> NDArray[np.uint8]:
    low, high = np.percentile(image, (0.1, 99.9))
    return to_8bit(np.rint(np.clip((image - low) / max(high - low, 1e-9), 0, 1) * 65535).astype(np.uint16))


def save_stars_picture(
    path: str | Path,
    image: NDArray[Any],
    pixels: NDArray[np.float64],
    names: Sequence[str],
    residual: NDArray[np.float64],
    title: str = "",
) -> Path:
    """Write a picture of named stars over a night image as PNG or SVG; see `stars_figure`."""
    return save_picture(path, stars_figure(image, pixels, names, residual, title))
