"""Draw a depth budget: range errors against range, on logarithmic scales."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from torch import Tensor

from kcal.errors import InputError
from kcal.locate.budget import RangeError
from kcal.report.figures import new_figure, plain_number, save_picture

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


def budget_figure(distances: Tensor, found: dict[str, RangeError], labels: dict[str, str]) -> Figure:
    """Draw lines for each source: outward error solid, inward dotted, first order thin and dashed.

    Args:
        distances: (D,) meters.
        found: errors by source, from `range_errors`.
        labels: source -> text in the legend.
    """
    figure = new_figure(8.6, 6.0)
    axes = figure.add_subplot()
    far = distances.numpy()
    for name, error in found.items():
        color = _SOURCE_COLORS.get(name, "#111827")
        outward = error.farther.clone()
        # Infinite errors are not drawn: the line leaves the picture there.
        outward[~outward.isfinite()] = float("nan")
        axes.plot(far, outward.numpy(), color=color, linewidth=2.0, label=labels.get(name, name))
        axes.plot(far, error.nearer.abs().numpy(), color=color, linewidth=1.4, linestyle=":")
        axes.plot(far, error.first_order.numpy(), color=color, linewidth=0.8, linestyle=(0, (6, 4)), alpha=0.8)
    axes.plot([], [], color="#6b7280", linewidth=1.4, linestyle=":", label="inward")
    axes.plot([], [], color="#6b7280", linewidth=0.8, linestyle=(0, (6, 4)), label="first order")
    axes.set(xscale="log", yscale="log", xlim=(far.min(), far.max()), xlabel="range, m", ylabel="error of the range, m")
    low = min(float(error.nearer.abs()[error.nearer.abs() > 0].min()) for error in found.values())
    axes.set_ylim(max(low, 1e-4), float(far.max()) * 2)
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        axis.set_major_formatter(plain_number)
        axis.set_minor_formatter(NullFormatter() if high > 10 * low else plain_number)
    axes.grid(which="major", color="#e5e7eb", linewidth=0.8)
    axes.grid(which="minor", color="#f3f4f6", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9, loc="upper left")
    axes.set_title("Range error by source: outward, inward, and to first order", fontsize=11, color="#374151")
    figure.subplots_adjust(left=0.1, right=0.98, top=0.94, bottom=0.09)
    return figure


def save_budget_picture(
    path: str | Path, distances: Tensor, found: dict[str, RangeError], labels: dict[str, str]
) -> Path:
    """Write a picture of range errors over the distance as PNG or SVG; see `budget_figure`."""
    return save_picture(path, budget_figure(distances, found, labels))
