"""A surveyor's sketch: the picture of a site with the names of what to mark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kcal.report.colors import ACCENT, WARN
from kcal.report.figures import HALO, new_figure, save_picture

Named = tuple[list[str], NDArray[np.float64]]


def save_site_sketch(path: str | Path, image: NDArray[np.uint8], landmarks: Named, targets: Named) -> Path:
    """Write a picture with named landmarks and targets.

    Args:
        path: of the .png or .svg file.
        image: (H, W, 3) of the site.
        landmarks: names, and pixels (N, 2).
        targets: the same of what is to be located.
    """
    height, width = image.shape[:2]
    figure = new_figure(width / 160, height / 160, 100)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(image)
    axes.set_axis_off()
    for (names, pixels), color in ((landmarks, ACCENT), (targets, WARN)):
        for name, (u, v) in zip(names, pixels, strict=True):
            axes.plot(u, v, "o", mfc="none", mec=color, ms=9)
            axes.annotate(
                name, (u, v), (4, 14), textcoords="offset points", color=color, fontsize=11, path_effects=HALO,
                rotation=55, arrowprops={"arrowstyle": "-", "color": color, "lw": 0.8},
            )  # fmt: skip
    where = 0.01 * width, 0.97 * height
    axes.text(*where, "blue: surveyed landmarks    red: targets to locate", fontsize=12, path_effects=HALO)
    return save_picture(path, figure)
