"""Images of a sky over a terrain whose height is known everywhere, for absolute attitude from skylines.

The terrain is a sum of smooth random fields, so that the true horizon of every column of an image is computed from the
heights themselves, and a raster of them has whatever cells and errors are asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.sim.coast import exposed, smooth_noise
from kcal.sim.truth import TruthLens

Floats = NDArray[np.float64]
EARTH = 6_371_000.0
# Meters: wavelength of each field of a terrain, and its share of the height; the first have ridges.
_WAVES = tuple((wave, (wave / 5_000.0) ** 0.9) for wave in (7_000.0, 3_100.0, 1_500.0, 700.0, 330.0, 150.0, 70.0, 40.0))
_RIDGED = 3
_SKY = 190.0


@dataclass(frozen=True, kw_only=True)
class Hills:
    """A terrain.

    Args:
        seed: of its shape.
        relief: meters: about the height of its hills.
        level: meters above the ellipsoid.
        clear: meters around the origin in which it is level, where a camera stands.
        far: meters from the origin at which the hills end before a plain, so that nothing beyond is seen.
        trees: meters: height of woods that no raster of the ground has.
        woods: share of the terrain with trees.
    """

    seed: int
    relief: float = 500.0
    level: float = 200.0
    clear: float = 1_500.0
    far: float = 13_000.0
    trees: float = 0.0
    woods: float = 0.0

    def ground(self, east: Floats, north: Floats) -> Floats:
        """Meters above the ellipsoid."""
        random = np.random.default_rng([self.seed, 11])
        total = np.zeros(np.broadcast(east, north).shape)
        for number, (wave, share) in enumerate(_WAVES):
            dx, dy, turn = *random.uniform(0.0, 250.0, 2), random.uniform(0.0, math.pi)
            across, along = math.cos(turn), math.sin(turn)
            x, y = (east * across + north * along) / wave + dx, (north * across - east * along) / wave + dy
            value = smooth_noise(x, y, 1)
            if number < _RIDGED:
                value = 0.7 - 2.0 * np.sqrt(np.square(value) + 0.002)
            total = total + share * value
        away = np.hypot(east, north)
        rise = np.clip(away / self.clear - 1.0, 0.0, None)
        fall = 1.0 / (1.0 + np.exp(np.clip((away - self.far) / 300.0, -50.0, 50.0)))
        return self.level + self.relief * (1.0 + total) * fall * rise / (1.0 + rise)

    def seen(self, east: Floats, north: Floats) -> Floats:
        """Meters above the ellipsoid of what stands there, trees included."""
        ground = self.ground(east, north)
        if not self.trees:
            return ground
        random = np.random.default_rng([self.seed, 13])
        dx, dy = random.uniform(0.0, 250.0, 2)
        where = smooth_noise(east / 700.0 + dx, north / 700.0 + dy, 2)
        # Values of the noise spread by about a third.
        wood = 1.0 / (1.0 + np.exp(-40.0 * (where - 0.33 * NormalDist().inv_cdf(1.0 - self.woods))))
        return ground + self.trees * wood * (1.0 + 0.15 * smooth_noise(east / 9.0, north / 9.0, 2))


@dataclass(frozen=True, kw_only=True)
class HillWeather:
    """How clear the air is, and how an image is taken.

    Args:
        haze: meters in which a contrast falls to 1/e.
        refraction: coefficient k of light.
        clouds: share of their contrast.
        noise: sigma of the sensor's noise, gray levels.
        blur: sigma of the optics' blur, px.
        light: of 1 by day.
        seed: of clouds and noise.
    """

    haze: float = 15_000.0
    refraction: float = 0.13
    clouds: float = 0.4
    noise: float = 1.5
    blur: float = 0.7
    light: float = 1.0
    seed: int = 0


class Skyline(NamedTuple):
    """What a camera sees of a terrain.

    Attributes:
        image: (H, W) gray levels.
        azimuth: (A,) radians.
        elevation: (A,) radians of the true horizon, refracted.
        distance: (A,) meters to it.
    """

    image: NDArray[np.uint8]
    azimuth: Floats
    elevation: Floats
    distance: Floats


def skyline_image(
    hills: Hills,
    lens: TruthLens | Camera,
    enu_from_cam: Tensor,
    eye: Floats,
    air: HillWeather,
    *,
    farthest: float = 20_000.0,
) -> Skyline:
    """Render a terrain as a camera sees it.

    Args:
        hills: the terrain, whose heights are above a sphere that touches the plane of `eye` at its origin.
        lens: the camera.
        enu_from_cam: (3, 3) its attitude.
        eye: (3,) east, north and height above the sphere, meters.
        air: the weather.
        farthest: meters at which the terrain ends.

    Example:
        >>> from kcal.sim.captures import drawn_lens
        >>> look = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).double()  # to the north
        >>> from kcal.sim.raytrace import SURVEILLANCE
        >>> lens = drawn_lens(SURVEILLANCE, 1.0, 1, focal_mm=4.64, scale=0.25)
        >>> seen = skyline_image(Hills(seed=1), lens, look, np.array([0.0, 0, 220]), HillWeather(), farthest=5e3)
        >>> seen.image.shape, bool(seen.elevation.max() > 0.02)
        ((270, 480), True)
    """
    azimuth, elevation = _pixel_angles(lens, enu_from_cam)
    low, high = float(azimuth.min()), float(azimuth.max())
    table = np.linspace(low, high, 2 * azimuth.shape[1])
    distance, slope = _sampled_slopes(hills, eye, table, air, farthest)
    tops = np.maximum.accumulate(slope, 1)
    top, far = _exact_tops(hills, eye, table, distance, slope, air)
    # Height over the horizon in pixels, by its slope in the image.
    above = elevation - np.interp(azimuth, table, top)
    steep = np.hypot(*np.gradient(above))
    share = np.clip(0.5 + above / np.maximum(steep, 1e-9), 0.0, 1.0)
    random = np.random.default_rng([air.seed, 17])
    sky = _sky_light(azimuth, elevation, air, random.uniform(0.0, 200.0))
    land = _land(hills, eye, azimuth, elevation, table, distance, tops, sky, air)
    light = air.light * (share * sky + (1.0 - share) * land)
    return Skyline(exposed(light, air.blur, air.noise, random), table, top, far)


def _pixel_angles(lens: TruthLens | Camera, enu_from_cam: Tensor) -> tuple[Floats, Floats]:
    """(H, W) azimuth, without a jump, and elevation of every pixel, from a grid of them."""
    width, height = lens.size
    x, y = (np.linspace(0.0, size - 1.0, max(size // 12, 24)) for size in (width, height))
    grid = torch.from_numpy(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
    rays, valid = lens.unproject(grid)
    if not bool(valid.all()):
        raise ValueError("a lens that covers its image is needed")
    heading = rays @ enu_from_cam.T
    ahead = enu_from_cam[:, 2]
    middle = math.atan2(float(ahead[0]), float(ahead[1]))
    azimuth = torch.atan2(heading[:, 0], heading[:, 1]) - middle
    azimuth = torch.remainder(azimuth + math.pi, 2.0 * math.pi) - math.pi
    elevation = torch.atan2(heading[:, 2], torch.hypot(heading[:, 0], heading[:, 1]))
    columns, rows = np.arange(width), np.arange(height)
    found = [
        RectBivariateSpline(y, x, part.numpy().reshape(len(y), len(x)))(rows, columns) for part in (azimuth, elevation)
    ]
    return found[0] + middle, found[1]


def _sampled_slopes(
    hills: Hills, eye: Floats, azimuth: Floats, air: HillWeather, farthest: float
) -> tuple[Floats, Floats]:
    """Distances (S,) and the tangent of the elevation (A, S) of the terrain there."""
    distance = np.concatenate([np.geomspace(30.0, 1_500.0, 80)[:-1], np.arange(1_500.0, farthest, 12.0)])
    return distance, _slope_at(hills, eye, azimuth[:, None], distance, air)


def _slope_at(hills: Hills, eye: Floats, azimuth: Floats, distance: Floats, air: HillWeather) -> Floats:
    east, north = eye[0] + distance * np.sin(azimuth), eye[1] + distance * np.cos(azimuth)
    radius = EARTH + hills.seen(east, north)
    turn = distance / EARTH
    level, up = radius * np.sin(turn), radius * np.cos(turn) - EARTH - eye[2]
    slope: Floats = up / level + air.refraction * level / (2.0 * EARTH)
    return slope


def _exact_tops(
    hills: Hills, eye: Floats, azimuth: Floats, distance: Floats, slope: Floats, air: HillWeather
) -> tuple[Floats, Floats]:
    """Elevation of the horizon and meters to it, from samples a meter apart around the highest ones."""
    best = slope.argmax(1)
    off = np.linspace(-14.0, 14.0, 29)
    near = np.maximum(distance[best][:, None] + off, 1.0)
    fine = _slope_at(hills, eye, azimuth[:, None], near, air)
    pick = np.arange(len(azimuth)), fine.argmax(1)
    return np.arctan(fine[pick]), near[pick]


def _sky_light(azimuth: Floats, elevation: Floats, air: HillWeather, place: float) -> Floats:
    steep = np.maximum(elevation, 0.01) + 0.05
    cloud = smooth_noise(0.4 / steep + place, azimuth / (0.3 + 0.0 * steep) + 3.0, 4)
    return _SKY - 60.0 * np.clip(elevation, 0.0, 1.0) + 45.0 * air.clouds * cloud


def _land(
    hills: Hills, eye: Floats, azimuth: Floats, elevation: Floats, table: Floats, distance: Floats, tops: Floats,
    sky: Floats, air: HillWeather,
) -> Floats:  # fmt: skip
    """(H, W) gray levels of the ground: textured, and the more of the sky's brightness the farther it is."""
    column = np.clip(np.rint(np.interp(azimuth, table, np.arange(len(table)))).astype(int), 0, len(table) - 1)
    far = np.empty(azimuth.shape)
    tangent = np.tan(elevation)
    order = np.argsort(column, axis=None, kind="stable")
    cuts = np.searchsorted(column.ravel()[order], np.arange(len(table) + 1))
    flat, tangents = far.ravel(), tangent.ravel()
    for number in range(len(table)):
        some = order[cuts[number] : cuts[number + 1]]
        # Pixels that are half sky show of the ground what stands highest.
        hit = np.searchsorted(tops[number], np.minimum(tangents[some], tops[number, -1]))
        flat[some] = distance[hit]
    far = flat.reshape(far.shape)
    east, north = eye[0] + far * np.sin(azimuth), eye[1] + far * np.cos(azimuth)
    texture = smooth_noise(east / 60.0, north / 60.0, 3) + smooth_noise(azimuth / 0.004, elevation / 0.004, 2)
    clear = np.exp(-far / air.haze)
    return (80.0 + 22.0 * texture) * clear + sky * (1.0 - clear)
