"""A picture of a residual field: how far and where to it moves the image, and where corners support it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.hybrid import HybridCamera
from kcal.report.figures import new_figure, save_png

_INK, _SUPPORT = "#111827", "#ffffff"
_FINE, _COARSE = (121, 81), (21, 14)
# A place has support where a corner was seen within this share of the image's width.
_NEAR = 0.03


def field_figure(observations: Observations, camera: Camera) -> Figure:
    """Draw the correction in pixels: its size in color, its direction as magnified arrows, support outlined.

    Args:
        observations: what was calibrated.
        camera: a `HybridCamera`.

    Raises:
        InputError: a camera without a residual field.
    """
    if not isinstance(camera, HybridCamera):
        raise InputError("a picture of the field: this camera has none")
    width, height = camera.size
    figure = new_figure(11.0, 9.0 * height / width + 1.0)
    axes = figure.add_axes((0.07, 0.08, 0.82, 0.86))
    beside = figure.add_axes((0.905, 0.08, 0.02, 0.86))
    fine, moved = _correction(camera, *_FINE)
    size = np.linalg.norm(moved, axis=-1)
    drawn = axes.contourf(fine[..., 0], fine[..., 1], size, levels=24, cmap="viridis")
    figure.colorbar(drawn, cax=beside, label="correction, pixels")
    place, arrows = _correction(camera, *_COARSE)
    longest = max(float(np.linalg.norm(arrows, axis=-1).max()), 1e-12)
    # A round magnification that makes the longest arrow about as long as the arrows are apart.
    wanted = width / _COARSE[0] / longest
    scale = 10.0 ** np.floor(np.log10(wanted))
    scale *= max(step for step in (1, 2, 5) if step * scale <= wanted)
    axes.quiver(
        place[..., 0],
        place[..., 1],
        arrows[..., 0] * scale,
        arrows[..., 1] * scale,
        color=_INK,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.0022,
    )
    pixels = observations.pixels().numpy()
    seen = pixels[np.isfinite(pixels).all(-1)]
    nearest = np.full(size.shape, np.inf)
    for part in np.array_split(seen, max(1, len(seen) // 500)):
        distance = np.linalg.norm(fine[:, :, None] - part, axis=-1).min(-1)
        nearest = np.minimum(nearest, distance)
    axes.contour(fine[..., 0], fine[..., 1], nearest, levels=[_NEAR * width], colors=[_SUPPORT], linewidths=1.5)
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xlabel("u, pixels")
    axes.set_ylabel("v, pixels")
    axes.set_title(
        f"What the field adds to the {camera.model} lens; arrows x {scale:g}; within the white lines corners were seen",
        fontsize=10,
        loc="left",
    )
    return figure


def save_field_picture(path: str | Path, observations: Observations, camera: Camera) -> Path:
    """Write the picture of `field_figure` as a PNG, atomically."""
    return save_png(path, field_figure(observations, camera))


def _correction(camera: HybridCamera, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (rows, columns, 2) and by how many pixels the field moved what is seen there."""
    pixels = camera.grid(columns, rows)
    return pixels.numpy(), camera.correction(pixels).detach().numpy()
