"""Rendered night images: catalog stars through a camera, with noise, and what is no star."""

from __future__ import annotations

import datetime

import numpy as np
import torch
from numpy.typing import NDArray

from kcal import Camera, Origin
from kcal.lens.projection import FAR
from kcal.locate import enu_from_cam
from kcal.stars.sky import StarCatalog, observed_directions

TIME = datetime.datetime(2026, 11, 24, 4, 0, tzinfo=datetime.UTC)
PLACE = Origin(lat=40.762, lon=-113.896, height=1282.0)


def night_camera(focal: float = 900.0, size: tuple[int, int] = (960, 600)) -> Camera:
    """A pinhole camera of 56° by 37°."""
    center = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    return Camera.build(focal=(focal, focal), center=center, size=size, model="pinhole")


def star_pixels(
    camera: Camera,
    attitude: tuple[float, float, float],
    time: datetime.datetime = TIME,
    faintest: float = 5.0,
    place: Origin = PLACE,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Pixels (N, 2) and indices (N,) in the catalog of the stars in view, the brightest first."""
    catalog = StarCatalog.bundled()
    there = observed_directions(catalog, time, place)
    up = np.flatnonzero((catalog.magnitude <= faintest) & (there[:, 2] > 0.02))
    up = up[np.argsort(catalog.magnitude[up])]
    rays = torch.from_numpy(there[up]) @ enu_from_cam(*attitude)
    pixels, valid = camera.project(FAR * rays)
    seen = (valid & camera.inside(pixels)).numpy()
    return pixels.numpy()[seen], up[seen]


def rendered(
    camera: Camera, pixels: NDArray[np.float64], magnitude: NDArray[np.float64], *, seed: int = 0, full: int = 65535
) -> NDArray[np.uint16]:
    """(H, W) gray levels with stars of 1.1 px on a noisy sky; magnitude 5 is 18 times the noise of a pixel."""
    width, height = camera.size
    generator = np.random.default_rng(seed)
    image = generator.normal(600.0, 20.0, (height, width))
    around = np.arange(-8, 9)
    for (u, v), m in zip(pixels, magnitude, strict=True):
        column, row = round(u), round(v)
        if not (8 <= column < width - 8 and 8 <= row < height - 8):
            continue
        spot = np.exp(-((around[:, None] + row - v) ** 2 + (around + column - u) ** 2) / (2 * 1.1**2))
        image[row - 8 : row + 9, column - 8 : column + 9] += 360.0 * 10 ** (-0.4 * (m - 5.0)) * spot
    return np.clip(np.rint(image), 0, full).astype(np.uint16)
