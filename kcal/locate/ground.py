"""Points on the ground, from one camera's line of sight: level ground, and rasters of heights."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.errors import FileError, InputError, with_extra
from kcal.files import read_head, read_text
from kcal.locate.geodesy import geodetic_to_ecef, place_enu
from kcal.locate.views import StatedHeight
from kcal.texts import brief

if TYPE_CHECKING:
    import pyproj

    # Heights, `Raster.to_cell`, coordinate system, and the unit of heights where the file tells it beside that.
    _Read = tuple[NDArray[np.float64], tuple[float, float, float, float, float, float], pyproj.CRS, str]

# Rasters of ground heights, which `terrain` reads: GeoTIFF and what else rasterio knows, or an ESRI ASCII grid.

# Of a raster, 1.6 GB as they are kept.
_MOST_CELLS = 200_000_000
_MOST_TEXT = 1 << 31
# Columns and rows from the middle cell to itself, to the next one in its row and in its column.
_BESIDE = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
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
    def most(self) -> float:
        """Meters by which its ground is at most above or below the ellipsoid."""
        return float(max(np.fmax.reduce(self.heights, None, initial=0), -np.fmin.reduce(self.heights, None, initial=0)))

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
        if self._middle_lon is not None:
            # Of longitudes that mean the same, the one nearest to the raster's middle: it may reach beyond 180°.
            x = x + 360.0 * np.round((self._middle_lon - x) / 360.0)
        column = self.to_cell[0] * x + self.to_cell[1] * y + self.to_cell[2] - 0.5
        row = self.to_cell[3] * x + self.to_cell[4] * y + self.to_cell[5] - 0.5
        return column, row

    @functools.cached_property
    def _middle_lon(self) -> float | None:
        """Where a raster in degrees has its middle."""
        if self.into is not None and not (self.into.target_crs and self.into.target_crs.is_geographic):
            return None
        rows, columns = self.heights.shape
        return float(self.places(np.array([0.5 * columns]), np.array([0.5 * rows]))[0, 0])

    def places(self, column: NDArray[np.float64], row: NDArray[np.float64]) -> NDArray[np.float64]:
        """(2, N) x and y of columns and rows (N,), counted from the first cell's corner."""
        a, b, c, d, e, f = self.to_cell
        return np.asarray(np.linalg.solve([[a, b], [d, e]], np.stack([column - c, row - f])), np.float64)

    def on_earth(self, column: NDArray[np.float64], row: NDArray[np.float64]) -> Tensor:
        """(N, 3) geocentric meters, on the ellipsoid, of columns and rows (N,), counted from the first cell's corner.

        What lies outside of the coordinate system is not finite.
        """
        lon, lat = self.places(column, row)
        if self.into is not None:
            lon, lat = map(np.asarray, self.into.transform(lon, lat, direction="INVERSE"))
        return geodetic_to_ecef(torch.from_numpy(np.stack([lat, lon, np.zeros_like(lat)], -1)))

    def farthest(self, place: Tensor, most: float = math.inf) -> float:
        """Meters from a geocentric place (3,) to the farthest corner; at most so many, and where it cannot be told."""
        rows, columns = self.heights.shape
        corners = self.on_earth(np.array([0.0, columns, 0.0, columns]), np.array([0.0, 0.0, rows, rows]))
        return float(torch.linalg.vector_norm(corners - place, dim=-1).max().nan_to_num(most).clamp_max(most))

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


def terrain(path: str | Path, geoid_height: float | None = None) -> Raster:
    r"""Ground from a raster of heights, for example a GeoTIFF, interpolated between the middles of its cells.

    An ESRI ASCII grid (.asc) is read without further packages: in the coordinate system of the .prj file beside it, or
    in degrees, if its numbers are such. Other rasters need the extra `terrain`. A raster's own scale, offset and unit
    of heights are heeded.

    Args:
        path: a raster with a coordinate system.
        geoid_height: meters that are added, for a raster of heights above the sea: the height of the geoid there.
            Needed where the coordinate system says that its heights are such.

    Raises:
        InputError: rasterio is missing, or a height that is not finite; heights above the sea without `geoid_height`.
        FileError: not a raster, one without coordinate system, or of more than 200 million cells; heights in a unit
            that is none of length.

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
    if not math.isfinite(geoid_height or 0.0):
        raise InputError(f"geoid height {geoid_height}: finite meters are needed")
    import pyproj  # which a rig without terrain does not need

    read_head(path, 0)
    read = _read_grid if Path(path).suffix.lower() == ".asc" else _read_raster
    heights, to_cell, whole, unit = read(Path(path))
    if geoid_height is None and (above := [part.name for part in whole.sub_crs_list if part.is_vertical]):
        raise InputError(
            f"{path}: its heights are above the sea ({above[0]}): give the height of the geoid there (--geoid)"
        )
    system = whole.to_2d()
    # In place: a raster may have a gigabyte.
    heights *= _unit_of_heights(path, unit, whole)
    heights += geoid_height or 0.0
    if not all(map(math.isfinite, to_cell)):
        raise FileError(f"{path}: its cells have no size on the ground")
    if np.isinf(heights).any():
        raise FileError(f"{path}: a height is infinite")
    into = None
    if not (system.is_geographic and pyproj.CRS("EPSG:4326").datum == system.datum):
        into = pyproj.Transformer.from_crs("EPSG:4326", system, always_xy=True)
    no_size = FileError(f"{path}: its cells have no size on the ground")
    a, b, _, d, e, _ = to_cell
    if not a * e - b * d or not math.isfinite(1.0 / (a * e - b * d)):
        raise no_size
    raster = Raster(heights, to_cell, into, math.nan)
    # The middle, and a cell beside and below it.
    column, row = (0.5 * side + np.array(steps) for side, steps in zip(heights.shape[::-1], _BESIDE, strict=True))
    if system.is_geographic and not abs(lat := float(raster.places(column, row)[1, 0])) <= 90.0:
        raise FileError(f"{path}: its middle row lies at latitude {lat:g}: at most 90 degrees are possible")
    middle, *beside = raster.on_earth(column, row)
    sides = [float(torch.linalg.vector_norm(place - middle)) for place in beside]
    if not 0.0 < min(sides) <= max(sides) < math.inf:
        raise no_size
    return dataclasses.replace(raster, cell_m=min(sides))


def _unit_of_heights(path: str | Path, unit: str, system: pyproj.CRS) -> float:
    """Length of the unit of a raster's heights: the one that the file names, or that of a third axis."""
    from pyproj.database import get_units_map

    if not unit:
        return system.axis_info[2].unit_conversion_factor if len(system.axis_info) == 3 else 1.0
    known = {"meter": 1.0, "feet": 0.3048}
    for one in get_units_map(category="linear").values():
        known |= dict.fromkeys((one.name.lower(), one.proj_short_name or ""), one.conv_factor)
    name = unit.strip().lower()
    if (length := known.get(name) or known.get(name.removesuffix("s"))) is None:
        raise FileError(f"{path}: its heights are in {unit!r}, which is no known unit of length")
    return length


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
            heights *= raster.scales[0]
            heights += raster.offsets[0]
            unit = raster.units[0] or ""
            if raster.transform.is_degenerate:
                raise FileError(f"{path}: its cells have no size on the ground")
            system, to_cell = raster.crs, ~raster.transform
    except rasterio.errors.RasterioError as error:
        raise FileError(f"{path}: cannot be read as a raster: {error}") from error
    if system is None:
        raise FileError(f"{path}: the raster has no coordinate system")
    return heights, tuple(to_cell)[:6], _coordinate_system(path, system.to_wkt()), unit


def _coordinate_system(path: Path, text: str) -> pyproj.CRS:
    """A coordinate system that positions can be turned into."""
    import pyproj

    try:
        system = pyproj.CRS.from_wkt(text)
        pyproj.Transformer.from_crs("EPSG:4326", system, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise FileError(f"{path}: its coordinate system cannot be used: {error}") from error
    return system


def _read_grid(path: Path) -> _Read:
    """An ESRI ASCII grid: six lines of a word and a number, then rows from north to south."""
    import pyproj

    text = read_text(path, _MOST_TEXT)
    head: dict[str, float] = {}
    while (line := text.split("\n", 1))[0].split()[:1] and line[0].split()[0].lower() in _GRID_KEYS:
        words = line[0].split()
        try:
            head[words[0].lower()] = value = float(words[1])
            if not (math.isfinite(value) or words[0].lower() == "nodata_value"):
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
    return heights, (1 / cell, 0.0, -x / cell, 0.0, -1 / cell, rows + y / cell), system, ""


# A line of sight is followed outward until it is below the ground for the first time: what lies behind is hidden. Light
# bends as for `Localizer`, and the ellipsoid falls away below the tangent plane.

# Height above the ellipsoid, meters, of latitudes and longitudes (degrees, of one shape); NaN where it is not known.
Ground = Callable[[Tensor, Tensor], Tensor]
# Steps within a cell of a raster, whose crests are as narrow as that; and of one search along several lines, by memory.
_WITHIN, _SEARCHED = 8, 1 << 21
# Steps of the search along a line of sight over a level surface, of equal ratio; then each is halved this often.
_STEPS, _HALVINGS = 512, 50
# Of a tangent that is found by differences, meters.
_STEP_M = 0.5


def level_ground(height: float) -> Ground:
    """Ground at one height above the WGS84 ellipsoid, meters: a plain, or the sea with its geoid height.

    Example:
        >>> level_ground(12.0)(torch.tensor([19.07]), torch.tensor([72.87])).tolist()
        [12.0]
    """
    if not math.isfinite(height):
        raise InputError(f"ground height {height}: finite meters above the ellipsoid are needed")
    return lambda lat, lon: torch.full_like(lat, height)


class Search(NamedTuple):
    """Where lines of sight are held against the ground, going outward.

    Attributes:
        distances: (K,) increasing, from that of the camera.
        heights: of the numbers (M,) of lines: (M, K) meters above the ground; NaN where that is not known.
        cell: how many of the distances lie within the first cell of a raster.
    """

    distances: Tensor
    heights: Callable[[Tensor], Tensor]
    cell: int = 1


def first_meeting(
    along: Callable[[Tensor, Tensor], Tensor], above: Callable[[Tensor], Tensor], count: int, search: Search
) -> tuple[Tensor, Tensor, Tensor]:
    """Follow lines of sight outward until they are below the ground, or over ground that is not known.

    Args:
        along: of distances (M,) and the numbers (M,) of lines: the places (M, 3) on these.
        above: height of places (..., 3) above the ground; NaN where that is not known.
        count: N lines, at least one.
        search: the places that are looked at first.

    Returns:
        Which lines (N,) meet the ground, where (N, 3) they do so first, and the slope (N, 3) of the height above the
        ground by the place.
    """
    parts, distances = [], search.distances
    for rows in torch.arange(count).split(max(1, _SEARCHED // len(distances))):
        heights = search.heights(rows)
        # The first place that is not above known ground ends the search, but not one where a raster buries the camera.
        ended = ~(heights > 0)
        buried = ended[:, :1].clone()
        ended[:, : search.cell] &= ~buried
        first = torch.where(ended.any(1), ended.to(torch.int8).argmax(1), 0)
        met = torch.isfinite(heights.gather(1, first[:, None])[:, 0]) & (first > search.cell * buried[:, 0])
        parts.append((distances[first], distances[(first - 1).clamp_min(0)], met))
    far, near, met = (torch.cat(part) for part in zip(*parts, strict=True))
    rows = torch.arange(count)
    for _ in range(_HALVINGS):
        middle = 0.5 * (near + far)
        high = above(along(middle, rows)) > 0
        near, far = torch.where(high, middle, near), torch.where(high, far, middle)
    distance = 0.5 * (near + far)
    point = along(distance, rows)
    steps = _STEP_M * torch.eye(3, dtype=torch.float64)
    normal = (above(point[:, None] + steps) - above(point[:, None] - steps)) / (2 * _STEP_M)
    tangent = along(distance + 0.5, rows) - along(distance - 0.5, rows)
    return met & torch.isfinite(normal).all(-1) & ((normal * tangent).sum(-1) < 0), point, normal


# Where a camera's line of sight reaches a stated height or the ground, by which one camera alone is enough.

# Steps to a stated height; each leaves a thousandth.
_HEIGHT_STEPS = 3
# Meters: how far a line of sight is followed until it meets the ground.
_FARTHEST = 60_000.0
_GROWING = torch.logspace(0.0, math.log10(_FARTHEST), _STEPS, dtype=torch.float64)


class EarthFrame(NamedTuple):
    """How the frame of a rig lies on the Earth, and how light bends there.

    Attributes:
        up: (C, 3) the vertical at each camera, in the frame.
        heights: (C,) of the cameras above the ellipsoid, meters.
        ecef_from_enu: (3, 3).
        ecef_of_origin: (3,) meters.
        refraction: coefficient k.
        half_curvature: 1 / 2R, 1/m.
    """

    up: Tensor
    heights: Tensor
    ecef_from_enu: Tensor
    ecef_of_origin: Tensor
    refraction: Tensor
    half_curvature: Tensor


def stated_ahead(
    frame: EarthFrame,
    place: Tensor,
    ray: Tensor,
    first: Tensor,
    alone: Tensor,
    *,
    height: Tensor | Ground,
    sigma: float,
    differentiated: bool,
) -> StatedHeight:
    """Where rays (N, 3) from places of cameras first reach heights (N,) above the ellipsoid, or the ground.

    Args:
        frame: on the Earth.
        place: (N, 3) centers of cameras.
        ray: (N, 3) directions.
        first: (N, C) bool: whose they are.
        alone: (N,) what one camera alone saw.
        height: (N,) meters, or the ground.
        sigma: of the height, meters.
        differentiated: derivatives by heights and frame are wanted; `StatedHeight.off` has them.
    """
    still = frame._replace(**{name: v.detach() for name, v in frame._asdict().items() if isinstance(v, Tensor)})
    at = still, place.detach(), ray.detach(), first, alone
    found = (
        _height_ahead(*at, height.detach(), sigma) if isinstance(height, Tensor) else _ground_ahead(*at, height, sigma)
    )
    with torch.set_grad_enabled(differentiated):
        point = found.point @ frame.ecef_from_enu.mT + frame.ecef_of_origin
        off = (found.up * ((point - point.detach()) @ still.ecef_from_enu)).sum(-1)
        if isinstance(height, Tensor):
            off = off - torch.where(found.reached, height - height.detach(), 0.0)
    return found._replace(off=off)


def _ground_ahead(
    frame: EarthFrame, place: Tensor, ray: Tensor, first: Tensor, alone: Tensor, ground: Ground, sigma: float
) -> StatedHeight:
    """Where rays (N, 3) from places of cameras meet the ground for the first time, of those that are `alone`."""
    wanted = alone.nonzero()[:, 0]
    point, normal, met = place + ray, torch.zeros_like(place), torch.zeros_like(alone)
    if not len(wanted):
        return StatedHeight(point, normal, torch.full_like(place[:, 0], sigma), met)
    start, sight, up = place[wanted], ray[wanted], first[wanted].to(torch.float64) @ frame.up
    bent = frame.refraction * frame.half_curvature * (1.0 - (sight * up).sum(-1).square())
    anchored = frame.ecef_from_enu, frame.ecef_of_origin

    def along(distance: Tensor, rows: Tensor) -> Tensor:
        own = [value[rows].reshape(len(rows), *[1] * (distance.ndim - 1), 3) for value in (start, sight, up)]
        fall = bent[rows].reshape(len(rows), *[1] * (distance.ndim - 1)) * distance.square()
        return own[0] + distance[..., None] * own[1] - fall[..., None] * own[2]

    def above(points: Tensor) -> Tensor:
        lat, lon, height = place_enu(points, *anchored).unbind(-1)
        return height - ground(lat, lon)

    def heights_over(raster: Raster, distances: Tensor, rows: Tensor) -> Tensor:
        lat, lon, height = place_enu(along(distances.expand(len(rows), -1), rows), *anchored).unbind(-1)
        column, row = map(torch.from_numpy, raster.cells(lat.numpy(), lon.numpy()))
        # From the last column to the first one, where a raster goes around the Earth.
        column[column.diff(prepend=column[:, :1]).abs() > max(0.5 * raster.heights.shape[1], 16)] = math.nan
        column, row, height = map(_subdivided, (column, row, height))
        return height - torch.from_numpy(raster.between(column.numpy(), row.numpy()))

    search = Search(_GROWING, lambda rows: above(along(_GROWING.expand(len(rows), -1), rows)))
    if isinstance(ground, Raster):
        # No farther than the raster reaches.
        away = float(torch.linalg.vector_norm(start, dim=-1).max()) + ground.most
        away += ground.farthest(frame.ecef_of_origin, _FARTHEST)
        cell = ground.cell_m
        coarse = torch.arange(0.0, min(away, _FARTHEST) + 2.0 * cell, cell, dtype=torch.float64)
        search = Search(_subdivided(coarse), functools.partial(heights_over, ground, coarse), _WITHIN)
    reached, there, slope = first_meeting(along, above, len(wanted), search)
    met[wanted] = reached
    point[wanted] = torch.where(reached[:, None], there, point[wanted])
    normal[wanted] = torch.where(reached[:, None], slope, 0.0)
    return StatedHeight(point, normal, torch.full_like(place[:, 0], sigma), met)


def _subdivided(values: Tensor) -> Tensor:
    """Values (..., K) in steps of a cell, and between them (..., 8 (K - 1))."""
    part = torch.arange(_WITHIN, dtype=torch.float64) / _WITHIN
    return values[..., :-1, None].lerp(values[..., 1:, None], part).flatten(-2)


def _height_ahead(
    frame: EarthFrame, place: Tensor, ray: Tensor, first: Tensor, alone: Tensor, height: Tensor, sigma: float
) -> StatedHeight:
    """Where rays (N, 3) from places of cameras reach heights (N,) above the ellipsoid for the first time."""
    del alone  # what several cameras saw is computed too, and not used
    one = first.to(torch.float64)
    up, own = one @ frame.up, one @ frame.heights
    target = torch.where(torch.isfinite(height), height, own)
    climb = (ray * up).sum(-1)
    # Above the ellipsoid, a line of sight rises by the distance's square over twice the radius of its curve.
    curve = frame.half_curvature * (1.0 - frame.refraction) * (1.0 - climb * climb)
    drop = own - target
    root = climb * climb - 4.0 * curve * drop
    reached = torch.isfinite(height) & (drop * climb < 0) & (root > 0)
    far = torch.where(reached, 2.0 * drop.abs() / (torch.sqrt(torch.where(reached, root, 1.0)) + climb.abs()), 1.0)
    for _ in range(_HEIGHT_STEPS):
        bent = frame.refraction * frame.half_curvature * (1.0 - climb * climb) * far * far
        point = place + far[..., None] * ray - bent[..., None] * up
        off = place_enu(point, frame.ecef_from_enu, frame.ecef_of_origin)[..., 2] - target
        slope = torch.where(reached, climb + 2.0 * curve * far, -1.0)
        far = far - torch.where(reached, off, 0.0) / slope
    lat, lon, _ = place_enu(point, frame.ecef_from_enu, frame.ecef_of_origin).deg2rad().unbind(-1)
    normal = torch.stack([lat.cos() * lon.cos(), lat.cos() * lon.sin(), lat.sin()], -1) @ frame.ecef_from_enu
    return StatedHeight(point, normal, torch.full_like(height, sigma), reached)
