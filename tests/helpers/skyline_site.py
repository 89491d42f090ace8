"""A small terrain, an image of its skyline and a raster of it, made once for all tests."""

import functools
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcal import Camera, Origin
from kcal.locate import enu_from_cam
from kcal.locate.ground import Raster
from kcal.rig import RasterError
from scripts.check.skyline import Hills, HillWeather, level_system, raster_around, skyline_image

HILLS = Hills(seed=3, relief=260.0, clear=700.0, far=4_500.0)
ANGLES = (40.0, 3.0, 1.0)
CELL, REACH = 25.0, 6_000.0
ERROR = RasterError(sigma=0.5, offset=0.2, refraction_sigma=0.03)
PLACE_SIGMA = (0.3, 0.3, 0.3)


class SmallSite(NamedTuple):
    """What tests need."""

    camera: Camera
    image: NDArray[np.uint8]
    place: Origin
    raster: Raster


def eye(east: float = 0.0, north: float = 0.0) -> NDArray[np.float64]:
    """(3,) meters of a camera on a mast of 12 m."""
    return np.array([east, north, float(HILLS.ground(np.array([east]), np.array([north]))[0]) + 12.0])


def camera() -> Camera:
    """A pinhole camera of 480 x 270 pixels."""
    return Camera.build(focal=(400, 400), center=(239.5, 134.5), size=(480, 270), model="pinhole")


def image(
    angles: tuple[float, float, float] = ANGLES, air: HillWeather | None = None, east: float = 0.0
) -> NDArray[np.uint8]:
    """The site as that camera sees it."""
    air = air or HillWeather(haze=9_000.0)
    return skyline_image(HILLS, camera(), enu_from_cam(*angles), eye(east), air, farthest=REACH).image


def heights() -> NDArray[np.float64]:
    """(rows, columns) meters, from north to south."""
    return _heights().copy()


@functools.cache
def _heights() -> NDArray[np.float64]:
    count = int(2 * REACH / CELL)
    x = -REACH + CELL * (np.arange(count) + 0.5)
    return np.stack([HILLS.ground(x, np.full(count, -y)) for y in x])


def raster_of(values: NDArray[np.float64], cell: float = CELL) -> Raster:
    """A raster around the site."""
    return raster_around(values, cell)


def write_raster(path: Path, values: NDArray[np.float64]) -> None:
    """An ESRI ASCII grid, which needs no rasterio."""
    side = 0.5 * len(values) * CELL
    head = f"ncols {len(values)}\nnrows {len(values)}\nxllcorner {-side}\nyllcorner {-side}\ncellsize {CELL}\n"
    path.write_text(head + "\n".join(" ".join(f"{value:.2f}" for value in row) for row in values))
    path.with_suffix(".prj").write_text(level_system().to_wkt("WKT1_ESRI"))


@functools.cache
def small_site() -> SmallSite:
    """Camera, image, place and raster without errors."""
    place = Origin(lat=47.0, lon=11.0, height=float(eye()[2]))
    return SmallSite(camera(), image(), place, raster_of(heights()))
