"""Textured objects of known position in both images of a rig, before a background at infinity.

An object is an elliptic plate that faces the rig; its gray levels are a sum of waves on the plate. Each pixel is the
mean over four by four rays through the true cameras, of the plate and of what is behind it; then both images are
blurred and get noise. Nothing of `kcal.pipeline` takes part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from torch import Tensor

from kcal.lens.rig import Rig

Floats = NDArray[np.float64]
_RAYS = 4  # across a pixel
OPTICAL_BLUR = 0.6  # pixels


@dataclass(frozen=True, kw_only=True)
class Plate:
    """An object.

    Args:
        point: (3,) its middle in the left camera's frame, meters.
        half: half its width and height, meters.
        waves: (K, 4) frequencies in x and y in radians per meter, phase, and amplitude in gray levels.
        level: its mean gray level.
    """

    point: Tensor
    half: tuple[float, float]
    waves: Floats
    level: float

    def gray(self, x: Floats, y: Floats) -> Floats:
        """Gray levels at positions in meters from the middle."""
        value = np.full(x.shape, self.level)
        for along, down, phase, amplitude in self.waves:
            value += amplitude * np.sin(along * x + down * y + phase)
        return value


def plate(
    point: Tensor, size: tuple[float, float], focal: float, contrast: float, random: np.random.Generator,
    wavelengths: tuple[float, float] = (5.0, 14.0),
) -> Plate:  # fmt: skip
    """An object of `size` pixels; `contrast`: four standard deviations of its gray levels; wavelengths in pixels."""
    meter = float(point[2]) / focal
    count = 12
    turn, length = random.uniform(0, 2 * math.pi, count), random.uniform(*wavelengths, count) * meter
    frequency = 2 * math.pi / length
    amplitude = np.full(count, contrast / 4 * math.sqrt(2.0 / count))
    waves = np.stack(
        [frequency * np.cos(turn), frequency * np.sin(turn), random.uniform(0, 2 * math.pi, count), amplitude], -1
    )  # fmt: skip
    half = 0.5 * size[0] * meter, 0.5 * size[1] * meter
    return Plate(point=point, half=half, waves=waves, level=120.0 + random.uniform(-30, 30))


def paint_plate(image: Floats, rig: Rig, side: int, item: Plate) -> None:
    """Paint an object over what an image (H, W) of the left (0) or right (1) camera shows."""
    rotation, shift = rig.right_from_left_rotation, rig.right_from_left_translation
    camera = rig.left if side == 0 else rig.right
    corners = item.point + torch.tensor([[x * item.half[0], y * item.half[1], 0.0] for x in (-1, 1) for y in (-1, 1)])
    seen, _ = camera.project(corners if side == 0 else rig.right_from_left(corners))
    height, width = image.shape
    low = np.maximum(np.floor(seen.min(0).values.numpy()).astype(int) - 2, 0)
    high = np.minimum(np.ceil(seen.max(0).values.numpy()).astype(int) + 3, (width, height))
    if (high <= low).any():
        return
    parts = (np.arange(_RAYS) + 0.5) / _RAYS - 0.5
    u = (np.arange(low[0], high[0])[:, None] + parts).ravel()
    v = (np.arange(low[1], high[1])[:, None] + parts).ravel()
    pixels = torch.from_numpy(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
    rays, _ = camera.unproject(pixels)
    origin = torch.zeros(3, dtype=torch.float64)
    if side == 1:
        rays, origin = rays @ rotation, -rotation.T @ shift
    at = origin + (item.point[2] - origin[2]) / rays[:, 2:] * rays - item.point
    x, y = at[:, 0].numpy(), at[:, 1].numpy()
    inside = (x / item.half[0]) ** 2 + (y / item.half[1]) ** 2 <= 1
    shape = high[1] - low[1], _RAYS, high[0] - low[0], _RAYS
    gray = np.where(inside, item.gray(x, y), 0.0).reshape(shape).mean((1, 3))
    share = inside.reshape(shape).mean((1, 3))
    window = image[low[1] : high[1], low[0] : high[0]]
    window[:] = gray + (1 - share) * window


def texture_gradient(image: Floats, box: Floats) -> float:
    """Root mean square of the slope along the rows in a box, gray levels per pixel."""
    left, top, right, bottom = (round(float(value)) for value in box)
    part = image[max(top, 0) : bottom + 1, max(left, 1) - 1 : right + 2]
    slope = (part[:, 2:] - part[:, :-2]) / 2
    return float(np.sqrt(np.mean(slope**2)))


def exposed(image: Floats, sigma: float, random: np.random.Generator) -> Tensor:
    """The image after optics and sensor: blurred, with noise, not rounded."""
    return torch.from_numpy(gaussian_filter(image, OPTICAL_BLUR) + random.normal(0, sigma, image.shape))


def true_box(rig: Rig, side: int, item: Plate) -> Floats:
    """Edges (4,) of the object's box in an image."""
    angle = torch.linspace(0, 2 * math.pi, 65, dtype=torch.float64)[:-1]
    ring = torch.stack([item.half[0] * angle.cos(), item.half[1] * angle.sin(), torch.zeros_like(angle)], -1)
    points = item.point + ring
    camera = rig.left if side == 0 else rig.right
    seen, _ = camera.project(points if side == 0 else rig.right_from_left(points))
    return torch.cat([seen.min(0).values, seen.max(0).values]).numpy()
