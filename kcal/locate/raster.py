"""Rasters of ground heights, which `terrain` reads: GeoTIFF and what else rasterio knows, or an ESRI ASCII grid."""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path

import numpy as np
import pyproj
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.errors import FileError, InputError, with_extra
from kcal.files import read_head, read_text
from kcal.locate.geodesy import mean_radius
from kcal.texts import brief

# Of a raster, 1.6 GB as they are kept.
_MOST_CELLS = 200_000_000
_MOST_TEXT = 1 << 31
_GRID_KEYS = {"ncols", "nrows", "xllcorner", "yllcorner", "xllcenter", "yllcenter", "cellsize", "nodata_value"}


@dataclasses.dataclass(frozen=True, eq=False)
class Raster:
    """Heights of the ground in cells, interpolated between their middles: a function of latitudes and longitudes.

    Args:
        heights: (rows, columns) meters above the ellipsoid, NaN where they are not known.
        to_cell: a, b, c, d, e, f: column a x + b y + c and row d x + e y + f, counted from the first cell's corner.
        into: latitude and longitude (degrees) to x, y of the raster's coordinate system; None where these are degrees.
        cell_m: the smaller side of a cell in the middle, meters.
    """

    __repr__ = brief

    heights: NDArray[np.float64]
    to_cell: tuple[float, float, float, float, float, float]
    into: pyproj.Transformer | None
    cell_m: float

    def __call__(self, lat: Tensor, lon: Tensor) -> Tensor:
        """Meters above the ellipsoid at latitudes and longitudes (degrees, of one shape); NaN where unknown."""
        return torch.from_numpy(self.between(*self.cells(lat.numpy(), lon.numpy())))

    @functools.cached_property
    def coarser(self) -> Raster:
        """The same ground in cells of twice the size, means of four; of an odd side the last cells are left out."""
        rows, columns = (side // 2 for side in self.heights.shape)
        heights = self.heights[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean((1, 3))
        a, b, c, d, e, f = (0.5 * value for value in self.to_cell)
        return Raster(heights, (a, b, c, d, e, f), self.into, 2.0 * self.cell_m)

    def cells(
        self, lat: NDArray[np.float64], lon: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Columns and rows of latitudes and longitudes (degrees, of one shape), from the first cell's middle on."""
        x, y = lon, lat
        if self.into is not None:
            x, y = map(np.asarray, self.into.transform(x, y))
        column = self.to_cell[0] * x + self.to_cell[1] * y + self.to_cell[2] - 0.5
        row = self.to_cell[3] * x + self.to_cell[4] * y + self.to_cell[5] - 0.5
        return column, row

    def between(self, column: NDArray[np.float64], row: NDArray[np.float64]) -> NDArray[np.float64]:
        """Heights at columns and rows of `cells`, interpolated; NaN outside and beside unknown cells."""
        rows, columns = self.heights.shape
        left, top = np.floor(column), np.floor(row)
        with np.errstate(invalid="ignore"):
            inside = (left >= 0) & (top >= 0) & (left < columns - 1) & (top < rows - 1)
        i, j = np.where(inside, top, 0).astype(int), np.where(inside, left, 0).astype(int)
        a, b, heights = column - left, row - top, self.heights
        found = (1 - b) * ((1 - a) * heights[i, j] + a * heights[i, j + 1])
        found = found + b * ((1 - a) * heights[i + 1, j] + a * heights[i + 1, j + 1])
        return np.where(inside, found, np.nan)


def terrain(path: str | Path, geoid_height: float = 0.0) -> Raster:
    r"""Ground from a raster of heights, for example a GeoTIFF, interpolated between the middles of its cells.

    An ESRI ASCII grid (.asc) is read without further packages: in the coordinate system of the .prj file beside it, or
    in degrees, if its numbers are such. Other rasters need the extra `terrain`.

    Args:
        path: a raster with a coordinate system.
        geoid_height: meters that are added, for a raster of heights above the sea: the height of the geoid there.

    Raises:
        InputError: rasterio is missing, or a height that is not finite.
        FileError: not a raster, one without coordinate system, or of more than 200 million cells.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "hill.asc")
        ...     head = "ncols 2\nnrows 2\nxllcorner 6.0\nyllcorner 45.0\ncellsize 0.01\n"
        ...     _ = path.write_text(head + "10 20\n30 40\n")
        ...     ground = terrain(path)
        >>> ground(*torch.tensor([[45.01], [6.01]], dtype=torch.float64)).round(decimals=6).tolist()
        [25.0]
    """
    if not math.isfinite(geoid_height):
        raise InputError(f"geoid height {geoid_height}: finite meters are needed")
    read_head(path, 0)
    read = _read_grid if Path(path).suffix.lower() == ".asc" else _read_raster
    heights, to_cell, system = read(Path(path))
    if not all(map(math.isfinite, to_cell)):
        raise FileError(f"{path}: its cells have no size on the ground")
    if np.isinf(heights).any():
        raise FileError(f"{path}: a height is infinite")
    heights = heights + geoid_height
    into = None
    if not (system.is_geographic and pyproj.CRS("EPSG:4326").datum == system.datum):
        into = pyproj.Transformer.from_crs("EPSG:4326", system, always_xy=True)
    a, b, c, d, e, f = to_cell
    # Not a number for cells without an area, which the checks below refuse.
    per_area = (a * e - b * d) or math.nan
    area = abs(1.0 / per_area)
    sides = [math.hypot(e, d) * area, math.hypot(a, b) * area]
    if system.is_geographic:
        # y of the middle row.
        lat = (a * (0.5 * heights.shape[0] - f) - d * (0.5 * heights.shape[1] - c)) / per_area
        if not abs(lat) <= 90.0:
            raise FileError(f"{path}: its middle row lies at latitude {lat:g}: at most 90 degrees are possible")
        degree = math.radians(1.0) * mean_radius(lat)
        sides = [sides[0] * degree * math.cos(math.radians(lat)), sides[1] * degree]
    else:
        sides = [side * system.axis_info[0].unit_conversion_factor for side in sides]
    if not 0.0 < min(sides) <= max(sides) < math.inf:
        raise FileError(f"{path}: its cells have no size on the ground")
    return Raster(heights, to_cell, into, min(sides))


_Read = tuple[NDArray[np.float64], tuple[float, float, float, float, float, float], pyproj.CRS]


def _check_cells(path: Path, columns: int, rows: int) -> None:
    if columns * rows > _MOST_CELLS:
        raise FileError(f"{path}: {columns} x {rows} cells; at most {_MOST_CELLS:,} are read: cut out what is needed")


def _read_raster(path: Path) -> _Read:
    with with_extra("terrain", "terrain needs"):
        import rasterio
    try:
        with rasterio.open(path) as raster:
            _check_cells(path, raster.width, raster.height)
            heights = raster.read(1, masked=True).astype(np.float64).filled(np.nan)
            if raster.transform.is_degenerate:
                raise FileError(f"{path}: its cells have no size on the ground")
            system, to_cell = raster.crs, ~raster.transform
    except rasterio.errors.RasterioError as error:
        raise FileError(f"{path}: cannot be read as a raster: {error}") from error
    if system is None:
        raise FileError(f"{path}: the raster has no coordinate system")
    return heights, tuple(to_cell)[:6], _coordinate_system(path, system.to_wkt())


def _coordinate_system(path: Path, text: str) -> pyproj.CRS:
    """A coordinate system that positions can be turned into."""
    try:
        system = pyproj.CRS.from_wkt(text)
        pyproj.Transformer.from_crs("EPSG:4326", system, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise FileError(f"{path}: its coordinate system cannot be used: {error}") from error
    return system


def _read_grid(path: Path) -> _Read:
    """An ESRI ASCII grid: six lines of a word and a number, then rows from north to south."""
    text = read_text(path, _MOST_TEXT)
    head: dict[str, float] = {}
    while (line := text.split("\n", 1))[0].split()[:1] and line[0].split()[0].lower() in _GRID_KEYS:
        words = line[0].split()
        try:
            head[words[0].lower()] = value = float(words[1])
            if not math.isfinite(value):
                raise ValueError(words[1])
        except (ValueError, IndexError):
            raise FileError(f"{path}: {line[0].strip()!r} is no line of an ESRI ASCII grid's head") from None
        text = line[1] if len(line) > 1 else ""
    try:
        columns, rows, cell = int(head["ncols"]), int(head["nrows"]), head["cellsize"]
        x = head["xllcorner"] if "xllcorner" in head else head["xllcenter"] - 0.5 * cell
        y = head["yllcorner"] if "yllcorner" in head else head["yllcenter"] - 0.5 * cell
    except KeyError as error:
        raise FileError(f"{path}: an ESRI ASCII grid needs the line {error.args[0]} in its head") from None
    if not (cell > 0 and columns > 0 and rows > 0):
        raise FileError(f"{path}: ncols, nrows and cellsize must be positive")
    _check_cells(path, columns, rows)
    try:
        heights = np.array(text.split(), dtype=np.float64)
    except ValueError as error:
        raise FileError(f"{path}: {error}; heights must be numbers") from None
    if len(heights) != columns * rows:
        raise FileError(f"{path}: {len(heights)} heights, ncols x nrows are {columns} x {rows}")
    heights = np.where(heights == head.get("nodata_value", -9999.0), np.nan, heights).reshape(rows, columns)
    projection = path.with_suffix(".prj")
    if projection.is_file():
        system = _coordinate_system(projection, read_text(projection, 1 << 20))
    elif x >= -180.0 and x + columns * cell <= 180.0 and y >= -90.0 and y + rows * cell <= 90.0:
        system = pyproj.CRS("EPSG:4326")
    else:
        raise FileError(f"{path}: its numbers are not degrees; put the coordinate system beside it as {projection}")
    return heights, (1 / cell, 0.0, -x / cell, 0.0, -1 / cell, rows + y / cell), system
