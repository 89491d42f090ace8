"""Draw a measured board: heights as colors, print errors as magnified arrows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from kcal.calibrate.hybrid.measured_board import Measured, MeasuredBoard
from kcal.quantities import measured_text
from kcal.report.colors import GRAY, INK
from kcal.report.figures import draw_arrows, new_figure, save_picture

_ACROSS = 160
# What is below this (mm) is not worth full colors and long arrows.
_LEAST = 0.01


def board_text(board: MeasuredBoard) -> list[str]:
    """Bending, stretch, shear and print error with their standard deviations, one line each."""

    def text(found: Measured, scale: float, unit: str) -> str:
        return measured_text(scale * found.value, scale * found.sigma, unit)

    return [
        f"bending {text(board.bending, 1e3, 'mm')} (height over the best plane, at most)",
        f"stretch {text(board.stretch, 100.0, '%')} (width over height)",
        f"shear {text(board.shear, 100.0, '%')}",
        f"print error {text(board.print_error, 1e3, 'mm')} RMS, beyond stretch and shear",
    ]


def board_figure(board: MeasuredBoard) -> Figure:
    """Draw heights over the best plane and in-plane displacements from the best fit of the ordered board."""
    corners = 1e3 * board.board.points
    low, high = corners[:, :2].amin(0), corners[:, :2].amax(0)
    wide, tall = (high - low).tolist()
    down = max(2, round(_ACROSS * tall / wide))
    x = torch.linspace(float(low[0]), float(high[0]), _ACROSS, dtype=torch.float64)
    y = torch.linspace(float(low[1]), float(high[1]), down, dtype=torch.float64)
    places = torch.nn.functional.pad(torch.cartesian_prod(y, x).flip(-1), (0, 1))
    heights = 1e3 * board.displacements(1e-3 * places)[:, 2].view(down, _ACROSS).numpy()
    moved = 1e3 * board.displacements()[:, :2].numpy()
    square = 1e3 * board.board.square
    figure = new_figure(9.0, min(12.0, 7.4 * (tall + 2 * square) / (wide + 2 * square) + 2.0))
    axes = figure.add_axes((0.08, 0.08, 0.78, 0.9 - 1.25 / figure.get_figheight()))
    most = max(float(np.abs(heights).max()), _LEAST)
    levels = MaxNLocator(nbins=20, symmetric=True).tick_values(-1.0001 * most, 1.0001 * most)
    drawn = axes.contourf(x.numpy(), y.numpy(), heights, levels=levels, cmap="RdBu_r", alpha=0.8)
    beside = axes.inset_axes((1.02, 0.0, 0.025, 1.0))
    figure.colorbar(drawn, cax=beside, label="height, mm (positive: away from the cameras)", ticks=levels[::2])
    axes.plot(corners[:, 0], corners[:, 1], ".", color=GRAY, markersize=3)
    longest = max(float(np.linalg.norm(moved, axis=-1).max()), _LEAST)
    # The longest arrow is about as long as the corners are apart.
    scale = draw_arrows(axes, corners[:, :2].numpy(), moved, 0.9 * square / longest, color=INK, width=0.0028)
    axes.set(xlim=(low[0] - square, high[0] + square), ylim=(high[1] + square, low[1] - square), aspect="equal")
    axes.set(xlabel="x, mm", ylabel="y, mm")
    axes.spines[["top", "right"]].set_visible(False)
    head = [f"{board.name}: {board.board}", *board_text(board), f"arrows: displacement in the plane x {scale:g}"]
    figure.text(0.08, 1.0 - 0.12 / figure.get_figheight(), "\n".join(head), va="top", fontsize=9, color=INK)
    return figure


def save_board_picture(path: str | Path, board: MeasuredBoard) -> Path:
    """Write a picture of how a measured board differs from the ordered one as PNG or SVG; see `board_figure`."""
    return save_picture(path, board_figure(board))
