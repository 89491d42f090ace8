"""Read what was surveyed or is known of the surroundings of a rig from CSV files into its local frame.

Latitudes and longitudes go through Earth-centered coordinates, so that the Earth's curvature is included; heights are
above the WGS84 ellipsoid. Local meters are east, north, up of the same origin.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.sources import Features, Landmarks, MeasuredPosition, inverse_range_beyond
from kcal.errors import FileError, InputError
from kcal.lens.mounting import Origin
from kcal.locate.geodesy import geodetic_to_enu
from kcal.locate.marks import PIXELS, Marks, pixel_of
from kcal.locate.tables import TableRow, guarded, read_rows
from kcal.texts import brief, csv_line

EARTH, LOCAL = ("lat", "lon", "height"), ("east", "north", "up")
FEATURE_COLUMNS = ("name", *PIXELS, "range", "range_sigma", "beyond", "note")
PLACE_COLUMNS = ("name", *EARTH, *LOCAL, "sigma", "sigma_up", "note")
# 1/m: how well the inverse range of a star is known.
_INFINITY_SIGMA = 1e-12


class Survey(NamedTuple):
    """Named places with their uncertainty.

    Attributes:
        names: one each.
        points: (N, 3) meters east, north, up of `origin`.
        sigma: (N, 3) meters.
        origin: where the frame is anchored; None if the file contains local meters and no origin was given.
    """

    names: tuple[str, ...]
    points: Tensor
    sigma: Tensor
    origin: Origin | None

    def __repr__(self) -> str:
        return brief(self)


def read_survey(path: str | Path, origin: Origin | None = None, *, measured: bool = True) -> Survey:
    r"""Read surveyed places: `name,lat,lon,height,sigma` or `name,east,north,up,sigma`, and if need be `sigma_up`.

    Degrees, meters above the WGS84 ellipsoid, meters; `sigma` is along each axis, `sigma_up` upward where that
    differs.

    Args:
        path: of the file.
        origin: of the frame; the first place if left out and the file has latitudes.
        measured: whether a sigma is needed; it is zero where it is not and is not given.

    Raises:
        FileError: see `kcal.locate.tables.read_rows`; a latitude out of range, a sigma that is not positive.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "survey.csv")
        ...     _ = path.write_text("name,lat,lon,height,sigma\npost,0,180,0,0.02\nmast,0,-179.991,10,0.02\n")
        ...     survey = read_survey(path)
        >>> [round(value, 2) for value in survey.points[1].tolist()]  # across the antimeridian
        [1001.88, 0.0, 9.92]
    """
    rows = read_rows(path, "name,lat,lon,height,sigma", PLACE_COLUMNS, ("sigma",) if measured else ())
    values, origin = places_of(rows, path, origin)
    sigma = [place_sigma(row, "place") if measured or row.cells.get("sigma") else (0.0, 0.0, 0.0) for row in rows]
    return Survey(tuple(row.name for row in rows), values, torch.tensor(sigma, dtype=torch.float64), origin)


def places_csv(columns: Sequence[str], places: Iterable[Sequence[str | float | None]]) -> str:
    """Places as CSV that `read_survey` reads: each its name, three coordinates in `columns`, sigma and sigma_up."""
    lines = [csv_line([guarded(str(name)), *numbers]) for name, *numbers in places]
    return csv_line(["name", *columns, "sigma", "sigma_up"]) + "".join(lines)


def places_of(rows: Sequence[TableRow], path: str | Path, origin: Origin | None) -> tuple[Tensor, Origin | None]:
    """(N, 3) meters of the places in rows, and the origin: the first place if None is given and there are latitudes.

    Raises:
        FileError: neither latitudes nor local meters, or both; a number that is none, a latitude out of range.
    """
    columns = _coordinates(rows[0], path)
    values = torch.tensor([[row.number(column) for column in columns] for row in rows], dtype=torch.float64)
    if columns == LOCAL:
        return values, origin
    for row, (lat, lon, height) in zip(rows, values.tolist(), strict=True):
        try:
            place = Origin(lat=lat, lon=lon, height=height)
        except InputError as error:
            raise FileError(f"{row.where}: {str(error).removeprefix('origin: ')}") from error
        origin = origin or place
    assert origin is not None
    return geodetic_to_enu(values, origin), origin


def _coordinates(row: TableRow, path: str | Path) -> tuple[str, str, str]:
    for columns in (EARTH, LOCAL):
        if all(column in row.cells for column in columns):
            other = LOCAL if columns == EARTH else EARTH
            if any(column in row.cells for column in other):
                raise FileError(f"{path}: lat, lon, height or east, north, up are needed, not both")
            return columns
    raise FileError(f"{path}: the columns lat, lon, height or east, north, up are needed")


def place_sigma(row: TableRow, what: str) -> tuple[float, float, float]:
    """How well a place or fix is known along each axis, meters: the cells sigma and, if it is there, sigma_up."""
    level = row.positive("sigma", infinite=True)
    if level is None or math.isinf(level):
        raise FileError(f"{row.where}: sigma is empty; write how well the {what} is known, meters")
    up = row.positive("sigma_up") or level
    return level, level, up


class MarkedLandmarks(NamedTuple):
    """Landmarks with their marks, and what has only one of the two."""

    landmarks: Landmarks
    unmarked: tuple[str, ...]
    unsurveyed: tuple[str, ...]


def match_landmarks(survey: Survey, marks: Marks, pixel_sigma: float | Tensor) -> MarkedLandmarks:
    """Match surveyed places and marks by name.

    Args:
        survey: the places.
        marks: with at least one mark of each thing.
        pixel_sigma: of a mark along an axis, px; one number, or (N, 2) for the marks in both images.

    Raises:
        InputError: no name is in both.

    Example:
        >>> survey = Survey(("mast", "post"), torch.rand(2, 3).double(), torch.ones(2, 3).double(), None)
        >>> marks = Marks(("post", "tree"), torch.rand(2, 2).double(), torch.rand(2, 2).double())
        >>> found = match_landmarks(survey, marks, pixel_sigma=0.1)
        >>> found.landmarks.names, found.unmarked, found.unsurveyed
        (('post',), ('mast',), ('tree',))
    """
    return marked_places(survey, marks.names, marks.pixels, pixel_sigma)


def marked_places(survey: Survey, names: Sequence[str], pixels: Tensor, pixel_sigma: float | Tensor) -> MarkedLandmarks:
    """The same for pixels (N, C, 2) of C cameras; `pixel_sigma` is one number, or (N, C)."""
    index = {name: i for i, name in enumerate(names)}
    places = [i for i, name in enumerate(survey.names) if name in index]
    if not places:
        raise InputError(
            f"no surveyed place ({', '.join(survey.names[:3])} ...) has a mark ({', '.join(names[:3])} ...): "
            "the names must be the same in both files"
        )
    common = tuple(survey.names[i] for i in places)
    rows = [index[name] for name in common]
    landmarks = Landmarks(
        names=common,
        points=survey.points[places],
        sigma=survey.sigma[places],
        pixels=pixels[rows],
        pixel_sigma=pixel_sigma[rows] if isinstance(pixel_sigma, Tensor) else pixel_sigma,
    )
    unmarked = tuple(name for name in survey.names if name not in index)
    return MarkedLandmarks(landmarks, unmarked, tuple(name for name in names if name not in common))


def read_features(path: str | Path, pixel_sigma: float) -> Features:
    r"""Read matched far features: `name,left_u,left_v,right_u,right_v` and what is known of their ranges, if anything.

    Either `range` and `range_sigma`, meters from the rig (`inf` without sigma for a star); or `beyond`, meters than
    which the feature is farther away; or nothing: then it determines the epipolar geometry only.

    Raises:
        FileError: see `kcal.locate.tables.read_rows`; a range without its sigma, or with `beyond`.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "features.csv")
        ...     _ = path.write_text("left_u,left_v,right_u,right_v,beyond\n960,540,958,540,20000\n1,2,3,4,\n")
        ...     read_features(path, 0.1).inverse_range.tolist()
        [2.5e-05, 0.0]
    """
    rows = read_rows(path, "name,left_u,left_v,right_u,right_v,range,range_sigma", FEATURE_COLUMNS, PIXELS)
    pixels = [[pixel_of(row, side, False) for side in ("left", "right")] for row in rows]
    known = torch.tensor([inverse_range_of(row) for row in rows], dtype=torch.float64)
    return Features(
        names=tuple(row.name for row in rows),
        pixels=torch.tensor(pixels, dtype=torch.float64),
        inverse_range=known[:, 0],
        inverse_range_sigma=known[:, 1],
        pixel_sigma=pixel_sigma,
    )


def inverse_range_of(row: TableRow) -> tuple[float, float]:
    """Inverse range and its sigma, 1/m, by the cells range, range_sigma and beyond of a row."""
    distance, sigma, beyond = (row.positive(column, infinite=True) for column in ("range", "range_sigma", "beyond"))
    if beyond is not None and distance is not None:
        raise FileError(f"{row.where}: range or beyond is needed, not both")
    if beyond is not None:
        return (0.0, _INFINITY_SIGMA) if math.isinf(beyond) else inverse_range_beyond(beyond)
    if distance is None:
        return 0.0, math.inf
    if math.isinf(distance):
        return 0.0, _INFINITY_SIGMA
    if sigma is None:
        raise FileError(f"{row.where}: the range needs its range_sigma, meters")
    return 1.0 / distance, sigma / distance**2


def camera_positions(survey: Survey, cameras: Sequence[str]) -> tuple[MeasuredPosition, ...]:
    """The places whose names are those of cameras, as measured positions of these.

    Raises:
        InputError: a name that is no camera's.

    Example:
        >>> survey = Survey(("right",), torch.tensor([[10.0, 0.0, 0.5]]), torch.full((1, 3), 0.02), None)
        >>> camera_positions(survey, ("left", "right"))[0].camera
        1
    """
    unknown = [name for name in survey.names if name not in cameras]
    if unknown:
        raise InputError(f"camera positions: {unknown[0]!r} is no camera; the names are {', '.join(cameras)}")
    numbers: Mapping[str, int] = {name: number for number, name in enumerate(cameras)}
    return tuple(
        MeasuredPosition(camera=numbers[name], point=point, sigma=sigma)
        for name, point, sigma in zip(survey.names, survey.points, survey.sigma, strict=True)
    )
