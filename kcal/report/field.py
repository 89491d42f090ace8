"""Draw a residual field: how it moves the image, and where corners support it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.hybrid import HybridCamera
from kcal.report.figures import INK, draw_arrows, frame_image, new_figure, save_png

_COLOR_GRID, _ARROW_GRID = (121, 81), (21, 14)
# A place has support where a corner was seen within this share of the image's width.
_SUPPORT_SHARE = 0.03


def field_figure(observations: Observations, camera: Camera) -> Figure:
    """Draw the correction in pixels: size as color, direction as magnified arrows, support as an outline.

    Args:
        observations: what was calibrated.
        camera: a `HybridCamera`.

    Raises:
        InputError: a camera without a residual field.
    """
    if not isinstance(camera, HybridCamera):
        raise InputError("a picture of the residual field needs a hybrid camera; this one has no field")
    width, height = camera.size
    figure = new_figure(11.0, 9.0 * height / width + 1.0)
    axes = figure.add_axes((0.07, 0.08, 0.82, 0.86))
    beside = figure.add_axes((0.905, 0.08, 0.02, 0.86))
    fine, moved = _correction(camera, *_COLOR_GRID)
    size = np.linalg.norm(moved, axis=-1)
    drawn = axes.contourf(fine[..., 0], fine[..., 1], size, levels=24, cmap="viridis")
    figure.colorbar(drawn, cax=beside, label="correction, pixels")
    place, arrows = _correction(camera, *_ARROW_GRID)
    longest = max(float(np.linalg.norm(arrows, axis=-1).max()), 1e-12)
    # The longest arrow is about as long as the arrows are apart.
    scale = draw_arrows(axes, place, arrows, width / _ARROW_GRID[0] / longest, color=INK, width=0.0022)
    pixels = observations.pixels().numpy()
    seen = pixels[np.isfinite(pixels).all(-1)]
    nearest = np.full(size.shape, np.inf)
    for part in np.array_split(seen, max(1, len(seen) // 500)):
        distance = np.linalg.norm(fine[:, :, None] - part, axis=-1).min(-1)
        nearest = np.minimum(nearest, distance)
    axes.contour(fine[..., 0], fine[..., 1], nearest, levels=[_SUPPORT_SHARE * width], colors=["white"], linewidths=1.5)
    frame_image(axes, camera.size)
    axes.set_title(
        f"What the field adds to the {camera.model} lens; arrows x {scale:g}; corners were seen inside the white lines",
        fontsize=10,
        loc="left",
    )
    return figure


def save_field_picture(path: str | Path, observations: Observations, camera: Camera) -> Path:
    """Write the picture of `field_figure` as a PNG, atomically."""
    return save_png(path, field_figure(observations, camera))


def _correction(camera: HybridCamera, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (rows, columns, 2) and how far the field moves what is seen there, pixels."""
    pixels = camera.grid(columns, rows)
    return pixels.numpy(), camera.correction(pixels).detach().numpy()
