"""Draw how differently two lenses see: a map of the difference with magnified arrows, and of its error bars."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from kcal.calibrate.camera.export import Misfit
from kcal.lens.difference import CameraDifference
from kcal.report.colors import INK
from kcal.report.difference_text import difference_text
from kcal.report.figures import draw_arrows, frame_image, new_figure, save_picture

# Arrows per row of the picture, at most.
_ARROWS = 17


def difference_figure(found: CameraDifference | Misfit, title: str, lines: list[str]) -> Figure:
    """Draw the shift as colors and magnified arrows; beside it, its sigma if there is one."""
    sigma = found.sigma if isinstance(found, CameraDifference) else None
    low, high = (value.flatten(0, 1) for value in (found.pixels.amin((0, 1), True), found.pixels.amax((0, 1), True)))
    width, height = (round(float(value)) for value in (high - low)[0] + (1.0 if float(low[0, 0]) >= 0 else 0.0))
    panels = [("difference, px", found.length)] + ([("sigma of it, px", sigma)] if sigma is not None else [])
    across = 6.4 * len(panels) + 0.6
    down = 5.2 * height / width + 1.4 + 0.2 * len(lines)
    figure = new_figure(across, min(12.0, max(4.0, down)))
    top = 1.0 - (0.55 + 0.19 * len(lines)) / figure.get_figheight()
    places = found.pixels.numpy()
    for i, (label, values) in enumerate(panels):
        axes = figure.add_axes(((i * 6.4 + 0.8) / across, 0.1, 4.9 / across, top - 0.1))
        drawn = _colors(axes, places, values, figure, label)
        if i == 0:
            step = max(1, math.ceil(places.shape[1] / _ARROWS))
            shown = np.nan_to_num(found.shift.numpy())[::step, ::step]
            longest = float(np.linalg.norm(shown, axis=-1).max())
            if longest > 0:
                wanted = 1.5 * step * width / places.shape[1] / longest
                scale = draw_arrows(axes, places[::step, ::step], shown, wanted, color=INK, width=0.0025)
                axes.set_title(f"arrows x {scale:g}", fontsize=9, color=INK, loc="left")
        frame_image(axes, (width, height))
        del drawn
    figure.text(0.02, 1.0 - 0.1 / figure.get_figheight(), "\n".join([title, *lines]), va="top", fontsize=9, color=INK)
    return figure


def _colors(axes, places: np.ndarray, values: Tensor, figure: Figure, label: str):  # type: ignore[no-untyped-def]
    most = float(np.nanmax(values.numpy()))
    levels = MaxNLocator(nbins=16).tick_values(0.0, max(most, 1e-12))
    drawn = axes.contourf(places[..., 0], places[..., 1], values.numpy(), levels=levels, cmap="viridis_r", alpha=0.85)
    figure.colorbar(drawn, ax=axes, label=label, shrink=0.85)
    return drawn


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
