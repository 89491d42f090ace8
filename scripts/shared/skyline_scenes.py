"""Images of a sky over a terrain whose height is known everywhere, for absolute attitude from skylines.

The terrain is a sum of smooth random fields, so that the true horizon of every column of an image is computed from the
heights themselves, and a raster of them has whatever cells and errors are asked for.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import pyproj
import torch
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from kcal import Origin
from kcal.lens.camera import Camera
from kcal.locate import enu_from_cam, enu_to_geodetic
from kcal.locate.ground import Raster
from kcal.rig import RasterError
from kcal.sim.captures import drawn_lens
from kcal.sim.coast import exposed, smooth_noise
from kcal.sim.raytrace import SURVEILLANCE
from kcal.sim.truth import TruthLens
from scripts.shared.traced import as_camera

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


HERE = (47.0, 11.0)
# Meters: above the ground, and how far the terrain and its rasters go.
MAST, FARTHEST, REACH = 12.0, 11_000.0, 12_000.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ground:
    """A raster as it is given to kcal.

    Args:
        cell: meters.
        error: as its errors are drawn, and as they are stated.
        place: meters, sigma of the camera's measured place, east and north; half as much again upward.
        trees: meters, height of woods on a third of the terrain that the raster does not have.
    """

    cell: float
    error: RasterError
    place: float = 0.5
    trees: float = 0.0

    @property
    def place_sigma(self) -> Floats:
        """(3,) meters."""
        return self.place * np.array([1.0, 1.0, 1.5])


class Site(NamedTuple):
    """A camera before a terrain, as it is in truth.

    Attributes:
        hills: the terrain.
        angles: heading, pitch and roll, degrees.
        eye: (3,) meters east, north, height.
        air: the weather, refraction included.
    """

    hills: Hills
    angles: tuple[float, float, float]
    eye: Floats
    air: HillWeather


@functools.lru_cache(8)
def lens_of(number: int) -> TruthLens:
    """A traced surveillance lens, f 800 px, 960 x 540."""
    return drawn_lens(SURVEILLANCE, 1.0, number, focal_mm=4.64, scale=0.5)


@functools.lru_cache(8)
def exact_camera(number: int) -> Camera:
    """The lens itself as a camera of kcal."""
    return as_camera(lens_of(number))


def site_of(seed: int, trees: float = 0.0) -> Site:
    """A site of a seed: terrain, attitude, air."""
    random = np.random.default_rng([seed, 5])
    hills = Hills(seed=seed, relief=float(random.uniform(250, 600)), far=9_500.0, trees=trees, woods=0.33)
    angles = float(random.uniform(0, 360)), float(random.uniform(-1, 4)), float(random.uniform(-1.5, 1.5))
    nowhere = np.zeros(1)
    eye = np.array([0.0, 0.0, float(hills.ground(nowhere, nowhere)[0]) + MAST])
    air = HillWeather(
        haze=float(random.uniform(8_000, 30_000)),
        refraction=0.13 + 0.1 * float(random.standard_normal()),
        clouds=float(random.uniform(0.0, 0.8)),
        noise=float(random.uniform(0.7, 2.5)),
        seed=seed,
    )
    return Site(hills, angles, eye, air)


def picture(site: Site, lens: TruthLens, seed: int = 0) -> Skyline:
    """An image; another seed is another moment with other clouds and noise."""
    air = dataclasses.replace(site.air, seed=site.air.seed + 1000 * seed)
    return skyline_image(site.hills, lens, enu_from_cam(*site.angles), site.eye, air, farthest=FARTHEST)


def raster_of(hills: Hills, ground: Ground, seed: int) -> Raster:
    """Heights in cells, with drawn errors: alike over the correlation length, and of all heights together."""
    bare = dataclasses.replace(hills, trees=0.0)
    return _raster(bare, ground.cell, ground.error, seed)


@functools.lru_cache(2)
def _raster(bare: Hills, cell: float, error: RasterError, seed: int) -> Raster:
    count = int(2 * REACH / cell)
    x: Floats = (-REACH + cell * (np.arange(count) + 0.5)).astype(np.float64)
    heights = np.stack([bare.ground(x, np.full(count, -y)) for y in x])
    # Cells have the mean of what is in them: to second order, by how each differs from its neighbors.
    edge = np.pad(heights, 1, mode="edge")
    heights += (edge[2:, 1:-1] + edge[:-2, 1:-1] + edge[1:-1, 2:] + edge[1:-1, :-2] - 4.0 * heights) / 24.0
    random = np.random.default_rng([seed, 23])
    heights += error.sigma * _alike(count, error.correlation / cell, random)
    heights += error.offset * random.standard_normal()
    return raster_around(heights, cell)


def raster_around(heights: Floats, cell: float) -> Raster:
    """A raster of square cells around `HERE`, from north to south."""
    into = pyproj.Transformer.from_crs("EPSG:4326", level_system(), always_xy=True)
    middle = 0.5 * len(heights)
    return Raster(heights, (1 / cell, 0.0, middle, 0.0, -1 / cell, middle), into, cell)


def level_system() -> pyproj.CRS:
    """Meters east and north of `HERE`."""
    return pyproj.CRS.from_proj4(f"+proj=aeqd +lat_0={HERE[0]} +lon_0={HERE[1]} +datum=WGS84 +units=m")


def _alike(count: int, correlation: float, random: np.random.Generator) -> Floats:
    """(count, count) standard normals with the correlation exp(-d / correlation), d in cells, by their spectrum."""
    off = np.minimum(np.arange(count), count - np.arange(count))
    kernel = np.exp(-np.hypot(off[:, None], off) / correlation)
    root = np.sqrt(np.maximum(np.fft.rfft2(kernel).real, 0.0))
    found: Floats = np.fft.irfft2(root * np.fft.rfft2(random.standard_normal((count, count))), (count, count))
    return found


def measured_place(site: Site, ground: Ground, seed: int) -> Origin:
    """Where GNSS says that the camera is."""
    random = np.random.default_rng([seed, 29])
    off = ground.place_sigma * random.standard_normal(3)
    origin = Origin(lat=HERE[0], lon=HERE[1], height=float(site.eye[2]))
    lat, lon, height = enu_to_geodetic(torch.from_numpy(off)[None], origin)[0].tolist()
    return Origin(lat=lat, lon=lon, height=height)


def angle_errors(found: tuple[float, float, float], site: Site) -> Floats:
    """(3,) degrees."""
    off = np.array(found) - np.array(site.angles)
    wrapped: Floats = (off + 180.0) % 360.0 - 180.0
    return wrapped


def true_directions(site: Site, lens: TruthLens, pixels: Tensor) -> Tensor:
    """(N, 3) unit vectors east, north, up in which pixels see."""
    rays, _ = lens.unproject(pixels)
    return rays @ enu_from_cam(*site.angles).T
