"""Draw a night image with the names of its stars, and the residuals of all of them as magnified arrows."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from kcal.report.colors import ACCENT, INK, WARN
from kcal.report.figures import draw_arrows, frame_image, new_figure, save_picture

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
