"""A picture of a calibration: where the board was seen, what is left over, and which views hurt."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from kcal.calibrate.camera.calibrate import CameraCalibrationResult
from kcal.corners.observations import Observations
from kcal.report.figures import new_figure, save_png

_INK, _FAINT, _ACCENT, _WARN = "#111827", "#9aa3af", "#2b6cb0", "#c02a6b"


def calibration_figure(observations: Observations, result: CameraCalibrationResult) -> Figure:
    """Draw coverage (the paper's Fig. 1) with magnified residuals, residuals against noise, and the RMS of each view.

    Args:
        observations: what was calibrated.
        result: what came out.
    """
    figure = new_figure(13.0, 7.0)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.5, 1.0], left=0.05, right=0.98, top=0.9, bottom=0.08, hspace=0.38)
    _coverage(figure.add_subplot(grid[:, 0]), observations, result)
    _scatter(figure.add_subplot(grid[0, 1]), result)
    _views(figure.add_subplot(grid[1, 1]), observations, result)
    figure.suptitle(
        f"{len(observations.views)} views, model {result.camera.model}: RMS {result.rms:.3f} px",
        x=0.05,
        ha="left",
        fontsize=14,
    )
    return figure


def save_calibration_picture(path: str | Path, observations: Observations, result: CameraCalibrationResult) -> Path:
    """Write the picture of `calibration_figure` as a PNG, atomically."""
    return save_png(path, calibration_figure(observations, result))


def _coverage(axes: Axes, observations: Observations, result: CameraCalibrationResult) -> None:
    width, height = observations.image_size
    pixels = observations.pixels().numpy()
    left_over = -result.residuals.numpy()
    seen = np.isfinite(pixels).all(-1)
    where, error = pixels[seen], left_over[seen]
    # A round magnification that makes a typical residual a sixtieth of the image.
    wanted = width / 60 / max(float(np.sqrt(np.mean(error**2))), 1e-9)
    scale = 10.0 ** np.floor(np.log10(wanted))
    scale *= max(step for step in (1, 2, 5) if step * scale <= wanted)
    axes.add_patch(Rectangle((-0.5, -0.5), width, height, fill=False, edgecolor=_INK, linewidth=1.2))
    view = np.broadcast_to(np.arange(len(pixels))[:, None], seen.shape)[seen]
    axes.quiver(
        where[:, 0],
        where[:, 1],
        error[:, 0] * scale,
        error[:, 1] * scale,
        view,
        cmap="turbo",
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.0015,
    )
    axes.scatter(where[:, 0], where[:, 1], c=view, cmap="turbo", s=4, linewidths=0)
    grid = result.camera.grid(97, 73)
    valid = result.camera.unproject(grid)[1].numpy()
    if not valid.all():
        axes.contourf(*grid.unbind(-1), ~valid, levels=[0.5, 1.5], colors=[_WARN], alpha=0.25)
        axes.text(0.02, 0.02, "shaded: no valid ray", transform=axes.transAxes, color=_WARN, fontsize=9)
    axes.set_xlim(-0.03 * width, 1.03 * width)
    axes.set_ylim(1.03 * height, -0.03 * height)
    axes.set_aspect("equal")
    axes.set_xlabel("u, pixels")
    axes.set_ylabel("v, pixels")
    axes.set_title(f"Corners, one color a view; arrows: observed minus modeled, x {scale:g}", fontsize=10, loc="left")


def _scatter(axes: Axes, result: CameraCalibrationResult) -> None:
    error = -result.residuals.numpy().reshape(-1, 2)
    error = error[np.isfinite(error).all(-1)]
    sigma = float(np.sqrt(np.mean(error**2)))
    limit = max(5.0 * sigma, 1e-9)
    axes.scatter(error[:, 0], error[:, 1], s=5, color=_ACCENT, alpha=0.45, linewidths=0)
    turn = np.linspace(0, 2 * np.pi, 200)
    # 95 % of a circular Gaussian lie within 2.45 σ.
    axes.plot(2.448 * sigma * np.cos(turn), 2.448 * sigma * np.sin(turn), color=_INK, linewidth=1)
    outside = float(np.mean(np.hypot(*error.T) > 2.448 * sigma))
    axes.axhline(0, color=_FAINT, linewidth=0.6)
    axes.axvline(0, color=_FAINT, linewidth=0.6)
    axes.set_xlim(-limit, limit)
    axes.set_ylim(limit, -limit)
    axes.set_aspect("equal")
    axes.set_xlabel("u, pixels")
    axes.set_ylabel("v, pixels")
    axes.set_title(f"Residuals; σ {sigma:.3f} px an axis, {100 * outside:.1f} % outside the 95 % circle", fontsize=10)


def _views(axes: Axes, observations: Observations, result: CameraCalibrationResult) -> None:
    rms = result.per_view_rms.numpy()
    typical = float(np.nanmedian(rms))
    colors = [_WARN if value > 2 * typical else _ACCENT for value in rms]
    place = np.arange(len(rms))
    axes.bar(place, rms, color=colors, width=0.8)
    axes.axhline(typical, color=_INK, linewidth=0.8)
    axes.set_ylabel("RMS, pixels")
    axes.set_title("RMS of each view; line: median", fontsize=10, loc="left")
    if len(rms) <= 40:
        axes.set_xticks(place, [name.rsplit(".", 1)[0] for name in observations.names], rotation=90, fontsize=7)
    else:
        axes.set_xlabel("view")
