"""What lies behind the pieces of a coast: sky with clouds, and the sea on a round Earth up to its horizon."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from kcal.sim.facets import Color, Eye, Haze
from kcal.sim.noise import smooth_noise

Floats = NDArray[np.float64]
EARTH = 6_371_000.0  # meters
_HAZE = Haze((196.0, 206.0, 214.0), 16_000.0)
_FEW = 4  # pixels between those for which clouds are computed


@dataclass(frozen=True, kw_only=True)
class Coast:
    """Sky, sea and air.

    Args:
        sea: meters by which the sea lies below the scene's origin.
        refraction: bending of light as a share of the Earth's curvature.
        zenith: color high up in the sky.
        water: color of the sea near by.
        haze: air, and with it the color of the sky at the horizon.
    """

    sea: float = 18.0
    refraction: float = 0.13
    zenith: Color = (96.0, 138.0, 186.0)
    water: Color = (52.0, 82.0, 96.0)
    haze: Haze = _HAZE

    @property
    def bend(self) -> float:
        """Meters, over the square of a distance, by which level light rises above the Earth's surface."""
        return (1.0 - self.refraction) / (2.0 * EARTH)

    def apparent(self, points: Floats) -> Floats:
        """Where points (..., 3) east, north, up seem to be: bent light raises them (meters)."""
        seen = np.array(points, dtype=np.float64)
        seen[..., 2] += self.refraction * np.square(seen[..., :2]).sum(-1) / (2.0 * EARTH)
        return seen

    def surface(self, distance: float) -> float:
        """Height of the sea's surface at a distance, meters from the scene's origin, where it truly is."""
        return -self.sea - distance**2 / (2.0 * EARTH)


def backdrop(camera: Eye, coast: Coast) -> Floats:
    """Render sky and sea as a camera sees them: (H, W, 3) gray levels."""
    slopes = camera.looks[..., :2]
    heading = np.concatenate([slopes, np.ones_like(slopes[..., :1])], -1) @ camera.rotation
    heading /= np.linalg.norm(heading, axis=-1, keepdims=True)
    level = np.hypot(heading[..., 0], heading[..., 1])
    height = coast.sea + float(camera.center[2])
    rising = -heading[..., 2]
    # The near root of bend (level t)² - rising t + height = 0: where the ray meets the surface.
    below = rising - 2.0 * level * math.sqrt(coast.bend * height)
    share = np.clip(0.5 + below / np.maximum(np.abs(np.gradient(below)[0]), 1e-12), 0.0, 1.0)
    above, wet = (np.flatnonzero(rows.any(1)) for rows in (share < 1, share > 0))
    image = np.zeros((*share.shape, 3))
    if len(above):
        image[: above[-1] + 1] = _sky(heading[: above[-1] + 1], coast)
    if len(wet):
        rows = slice(int(wet[0]), None)
        square = rising[rows] ** 2 - 4.0 * coast.bend * level[rows] ** 2 * height
        distance = 2.0 * height / np.maximum(rising[rows] + np.sqrt(np.maximum(square, 0.0)), 1e-9)
        sea = _sea(camera, heading[rows], np.where(share[rows] > 0, distance, 1.0), coast)
        image[rows] += share[rows, :, None] * (sea - image[rows])
    return image


def _sky(heading: Floats, coast: Coast) -> Floats:
    up = np.clip(heading[..., 2], 0.0, 1.0)
    high = 1.0 - np.exp(-up / 0.16)
    color = np.array(coast.haze.color) + high[..., None] * (np.array(coast.zenith) - np.array(coast.haze.color))
    # Clouds on a level layer: its places are the slopes of the lines of sight.
    steep = np.maximum(heading[..., 2], 0.02)
    few = heading[::_FEW, ::_FEW] / steep[::_FEW, ::_FEW, None]
    cloud = _joined_values(smooth_noise(0.55 * few[..., 0], 0.8 * few[..., 1], 5), up.shape)
    cover = np.clip(1.6 * cloud + 0.1, 0.0, 1.0) * np.clip((heading[..., 2] - 0.03) / 0.1, 0.0, 1.0)
    mixed: Floats = color + 0.75 * cover[..., None] * (np.array([238.0, 240.0, 242.0]) - color)
    return mixed


def _joined_values(values: Floats, shape: tuple[int, ...]) -> Floats:
    """Values of every fourth pixel, joined by straight lines."""
    for axis, size in enumerate(shape):
        at = np.arange(size) / _FEW
        low = np.minimum(at.astype(int), max(values.shape[axis] - 2, 0))
        high = np.minimum(low + 1, values.shape[axis] - 1)
        share = np.expand_dims(at - low, 1 - axis).clip(0.0, 1.0)
        first = values.take(low, axis)
        values = first + share * (values.take(high, axis) - first)
    return values


def _sea(camera: Eye, heading: Floats, distance: Floats, coast: Coast) -> Floats:
    x, y = (camera.center[i] + distance * heading[..., i] for i in (0, 1))
    waves = np.zeros_like(x)
    # Waves that are narrower than a pixel, mostly those far away, are not seen.
    depth = np.abs(np.gradient(np.hypot(x, y))[0])
    for size, strength in ((3.0, 0.12), (11.0, 0.10), (60.0, 0.07)):
        fine = np.clip(2.0 * size / np.maximum(depth, 1e-9), 0.0, 1.0)
        waves += strength * fine * smooth_noise(x / size, y / size, 2)
    color = np.array(coast.water) * (1 + waves)[..., None]
    # Water mirrors the sky more, the flatter it is looked at.
    mirrored = np.exp(heading[..., 2:3] / 0.05)
    color = color + 0.45 * mirrored * (np.array(coast.haze.color) - color)
    return coast.haze.seen(color, distance)


def exposed(light: Floats, blur: float, noise: float, random: np.random.Generator) -> NDArray[np.uint8]:
    """Blur light (H, W, ...) as the optics do, add noise, and round to 8 bits."""
    from scipy.ndimage import gaussian_filter

    sigma = (blur, blur) + (0.0,) * (light.ndim - 2)
    seen = gaussian_filter(light, sigma) if blur else light
    if noise:
        seen = seen + noise * random.standard_normal(light.shape, dtype=np.float32)
    levels: NDArray[np.uint8] = np.clip(np.rint(seen), 0, 255).astype(np.uint8)
    return levels


def rotation_of(matrix: torch.Tensor) -> Floats:
    """A rotation as NumPy's floats."""
    found: Floats = matrix.detach().numpy().astype(np.float64)
    return found
