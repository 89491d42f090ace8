"""The night above a practice site: stars as the cameras see them, wherever a catalogue says that they stand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kcal.sim.practice import NOISE, SIDES, PracticeSite, Side

Floats = NDArray[np.float64]
# Gray levels of the dark sky, and all of a star of magnitude 0.
_SKY, _BRIGHTEST = 14.0, 60_000.0
_STAR_BLUR = 1.1  # px: sigma of a star's image
_HALF = 6  # pixels around a star that it lights


def night_picture(site: PracticeSite, side: Side, directions: Floats, magnitudes: Floats) -> NDArray[np.uint8]:
    """A picture (H, W) of the night sky in gray; the ground is dark.

    Args:
        site: cameras.
        side: which of them.
        directions: (N, 3) unit vectors east, north, up to where stars seem to be, refraction included.
        magnitudes: (N,) visual; 2.5 of it are a factor of ten.
    """
    camera = site.eyes[side]
    height, width = camera.looks.shape[:2]
    light = np.full((height, width), _SKY)
    up = directions[:, 2] > 0.0
    pixels, valid = camera.project(1e9 * directions[up])
    inside = valid & (pixels > -_HALF).all(-1) & (pixels < np.array([width, height]) + _HALF).all(-1)
    for (u, v), magnitude in zip(pixels[inside], magnitudes[up][inside], strict=True):
        column, row = round(u), round(v)
        x, y = np.arange(column - _HALF, column + _HALF + 1), np.arange(row - _HALF, row + _HALF + 1)
        x, y = x[(x >= 0) & (x < width)], y[(y >= 0) & (y < height)]
        if len(x) and len(y):
            profile = np.exp(-0.5 * (((x - u) ** 2) + ((y - v) ** 2)[:, None]) / _STAR_BLUR**2)
            flux = _BRIGHTEST * 10.0 ** (-0.4 * magnitude) / (2 * np.pi * _STAR_BLUR**2)
            light[y[0] : y[-1] + 1, x[0] : x[-1] + 1] += flux * profile
    random = np.random.default_rng([site.scene.seed, SIDES.index(side), 4])
    levels: NDArray[np.uint8] = np.clip(np.rint(light + NOISE * random.standard_normal(light.shape)), 0, 255).astype(
        np.uint8
    )
    return levels
