"""Simulated skylines with their truth: terrain, image, a raster with errors, and what kcal makes of them."""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
import pyproj
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal import Camera, Origin
from kcal.locate import enu_from_cam, enu_to_geodetic
from kcal.locate.ground import Raster
from kcal.rig import RasterError
from kcal.sim.captures import drawn_lens
from kcal.sim.raytrace import SURVEILLANCE
from kcal.sim.truth import TruthLens
from scripts.shared.skyline_scenes import Hills, HillWeather, Skyline, skyline_image
from scripts.shared.traced import as_camera

Floats = NDArray[np.float64]
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
