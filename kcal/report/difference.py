"""Draw how differently two lenses see: a map of the difference with magnified arrows, and of its error bars."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from torch import Tensor

from kcal.calibrate.camera.misfit import Misfit
from kcal.lens.difference import CameraDifference
from kcal.report.difference_text import difference_text
from kcal.report.figures import INK, draw_arrows, frame_image, new_figure, save_picture, wrapped

# Arrows per row of the picture, at most.
_ARROWS = 17
# Inches: width of an image and of its panel, and the height of an upright image.
_WIDE, _PANEL, _TALLEST = 5.2, 6.9, 8.0


def difference_figure(found: CameraDifference | Misfit, title: str, lines: list[str]) -> Figure:
    """Draw the shift as colors and magnified arrows; beside it, its sigma if there is one."""
    sigma = found.sigma if isinstance(found, CameraDifference) else None
    low, high = (value.flatten(0, 1) for value in (found.pixels.amin((0, 1), True), found.pixels.amax((0, 1), True)))
    width, height = (round(float(value)) for value in (high - low)[0] + (1.0 if float(low[0, 0]) >= 0 else 0.0))
    panels = [("difference, px", found.length)] + ([("sigma of it, px", sigma)] if sigma is not None else [])
    # Inches: every panel has an image, its axis to the left and its color bar to the right.
    across = _PANEL * len(panels) + 0.2
    head = [*wrapped(title, across - 0.4, 11.0)] if title else []
    body = [part for line in lines for part in wrapped(line, across - 0.4, 9.0)]
    tall = min(_WIDE * height / width, _TALLEST)
    top = 0.15 + 0.2 * len(head) + 0.17 * len(body) + 0.4
    down = top + tall + 0.6
    figure = new_figure(across, down)
    places = found.pixels.numpy()
    for i, (label, values) in enumerate(panels):
        left, wide = i * _PANEL + 0.8, tall * width / height
        axes = figure.add_axes((left / across, 0.55 / down, wide / across, tall / down))
        beside = figure.add_axes(((left + wide + 0.12) / across, 0.55 / down, 0.16 / across, tall / down))
        _colors(axes, beside, places, values, label)
        if i == 0:
            step = max(1, math.ceil(places.shape[1] / _ARROWS))
            # The border is no place for an arrow: half of those would be outside.
            shown = np.nan_to_num(found.shift.numpy())[step // 2 :: step, step // 2 :: step]
            longest = float(np.linalg.norm(shown, axis=-1).max())
            if longest > 0:
                wanted = 1.5 * step * width / places.shape[1] / longest
                here = places[step // 2 :: step, step // 2 :: step]
                scale = draw_arrows(axes, here, shown, wanted, color=INK, width=0.004)
                axes.set_title(f"arrows x {scale:g}", fontsize=9, color=INK, loc="left")
        frame_image(axes, (width, height))
    figure.text(0.2 / across, 1.0 - 0.12 / down, "\n".join(head), va="top", fontsize=11, color=INK)
    below = 0.12 + 0.2 * len(head)
    figure.text(0.2 / across, 1.0 - below / down, "\n".join(body), va="top", fontsize=9, color=INK)
    return figure


def _colors(axes: Axes, beside: Axes, places: NDArray[np.float64], values: Tensor, label: str) -> None:
    most = float(np.nanmax(values.numpy()))
    levels = MaxNLocator(nbins=16).tick_values(0.0, max(most, 1e-12))
    drawn = axes.contourf(places[..., 0], places[..., 1], values.numpy(), levels=levels, cmap="viridis_r", alpha=0.85)
    axes.figure.colorbar(drawn, cax=beside, label=label)


def save_difference_picture(
    path: str | Path, found: CameraDifference | Misfit, title: str = "", lines: list[str] | None = None
) -> Path:
    """Write the picture of a comparison, or of the misfit of an exported lens, as PNG or SVG, atomically.

    Raises:
        InputError: a suffix other than .png and .svg.
        FileError: the file cannot be written.
    """
    if lines is None:
        lines = (
            difference_text(found)
            if isinstance(found, CameraDifference)
            else [f"{found.model}: RMS {found.rms:.4g} px, largest {found.largest:.4g} px, at infinity"]
        )
    return save_picture(path, difference_figure(found, title, lines))
