"""Draw where stated intervals contain the truth: maps of the image, from repeated captures."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure

from kcal.calibrate.camera.advice import reached
from kcal.calibrate.camera.interval_check import IntervalCheck
from kcal.corners.observations import Observations
from kcal.report.colors import INK
from kcal.report.figures import frame_image, new_figure, save_picture

_MOST = 3  # ranges that are drawn
_WIDE, _BESIDE, _BELOW, _ABOVE = 4.6, 0.75, 0.55, 0.8  # inches
# What 95 % intervals should have is blue, and 90 % in the middle of the colors.
_LEVELS = [0.0, 0.5, 0.7, 0.8, 0.85, 0.9, 0.925, 0.95, 0.975, 1.0]


def range_label(at: float) -> str:
    """A range in words: "1000 m", or "far away".

    Example:
        >>> range_label(1000.0), range_label(math.inf)
        ('1000 m', 'far away')
    """
    return "far away" if math.isinf(at) else f"{at:g} m"


def interval_figure(check: IntervalCheck, observations: Observations, title: str = "") -> Figure:
    """Draw the share of refits whose error is within the stated 95 % ellipse, at up to three ranges.

    Args:
        check: the comparison.
        observations: the capture; what its boards reached is outlined.
        title: above the maps.
    """
    width, height = observations.image_size
    shown = list(zip(check.ranges, check.coverage, check.shares, strict=True))[:_MOST]
    tall = _WIDE * height / width
    across, down = (_WIDE + _BESIDE) * len(shown) + 1.0, tall + _BELOW + _ABOVE
    figure = new_figure(across, down)
    places = check.pixels.numpy()
    seen = reached(observations, 256, max(2, round(256 * height / width))).numpy()
    columns, rows = (np.linspace(-0.5, size - 0.5, count) for size, count in ((width, 256), (height, len(seen))))
    for i, (at, coverage, (share, error)) in enumerate(shown):
        left = _BESIDE + i * (_WIDE + _BESIDE)
        axes = figure.add_axes((left / across, _BELOW / down, _WIDE / across, tall / down))
        drawn = axes.contourf(
            places[..., 0],
            places[..., 1],
            coverage.numpy(),
            levels=_LEVELS,
            cmap="RdYlBu",
            norm=BoundaryNorm(_LEVELS, 256),
        )
        if not seen.all():
            axes.contour(columns, rows, seen, levels=[0.5], colors=INK, linewidths=1.0, linestyles="dashed")
        frame_image(axes, observations.image_size)
        axes.set_title(f"{range_label(at)}: {100 * share:.1f} ± {100 * error:.1f} %", fontsize=10, loc="left")
        if i:
            axes.set(ylabel="")
    beside = figure.add_axes(((across - 0.85) / across, _BELOW / down, 0.16 / across, tall / down))
    figure.colorbar(drawn, cax=beside, format=lambda value, _: f"{100 * value:g} %", ticks=_LEVELS)
    text = f"{title}\n" if title else ""
    text += f"Share of {len(check.errors)} refits within the stated 95 % ellipse; dashed: what boards reached"
    figure.text(0.2 / across, 1.0 - 0.1 / down, text, va="top", fontsize=10, color=INK)
    return figure


def save_interval_picture(path: str | Path, check: IntervalCheck, observations: Observations, title: str = "") -> Path:
    """Write the maps as PNG or SVG, atomically.

    Raises:
        InputError: a suffix other than .png and .svg.
        FileError: the file cannot be written.
    """
    return save_picture(path, interval_figure(check, observations, title))
