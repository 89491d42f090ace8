"""Surveys: reading them, and recognizing those whose coordinates are exchanged or have the wrong sign."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import warnings
import xml.etree.ElementTree
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.explanations import AS_GOOD
from kcal.calibrate.rig.marks import Features, Landmarks, inverse_range_beyond
from kcal.calibrate.rig.resection import consensus_pose
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.solve import RigOptions, solve_rig
from kcal.calibrate.rig.source import require_positive
from kcal.calibrate.rig.sources import MeasuredPosition, RigData
from kcal.errors import FileError, InputError, KcalError, KcalWarning
from kcal.files import read_text
from kcal.finding import Finding
from kcal.lens.rig import Origin
from kcal.locate.geodesy import enu_to_geodetic, geodetic_to_enu
from kcal.locate.marks import PAIR, Marks, read_marks
from kcal.locate.mounting import attitude
from kcal.locate.tables import TableRow, guarded, read_rows
from kcal.strict_json import MOST_BYTES, read_json, read_xml
from kcal.texts import briefly, csv_line, length_text

# Surveyed landmarks and marks of them: the survey, its files, and matched far features.

# Read what was surveyed or is known of the surroundings of a rig from CSV files into its local frame.
#
# Latitudes and longitudes go through Earth-centered coordinates, so that the Earth's curvature is included; heights are
# above the WGS84 ellipsoid. Local meters are east, north, up of the same origin.

EARTH, LOCAL = ("lat", "lon", "height"), ("east", "north", "up")
RANGES = ("range", "range_sigma", "beyond")
PLACE_COLUMNS = ("name", *EARTH, *LOCAL, "sigma", "sigma_up", "note")
# Meters: no landmark is so far from its origin, and every place in a UTM zone is.
_PROJECTED = 1.5e5
# Degrees: places of one table that lie together, and one that does not.
_TOGETHER, _APART = 0.5, 1.0
# 1/m: how well the inverse range of a star is known.
_INFINITY_SIGMA = 1e-12


@briefly
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
    return _read_csv(path, origin, None if measured else 0.0)


def _read_csv(path: str | Path, origin: Origin | None, otherwise: float | None) -> Survey:
    """`read_survey`, with a sigma for places that state none; None: they are refused."""
    rows = read_rows(path, "name,lat,lon,height,sigma", PLACE_COLUMNS, ("sigma",) if otherwise is None else ())
    values, origin = places_of(rows, path, origin)
    sigma = [place_sigma(row, "place", otherwise) for row in rows]
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
    whats = ["a number in meters" if column in (*LOCAL, "height") else "decimal degrees" for column in columns]
    values = torch.tensor([[*map(row.number, columns, whats)] for row in rows], dtype=torch.float64)
    if columns == LOCAL:
        if (farthest := float(values[:, :2].abs().amax())) > _PROJECTED:
            text = (
                f"{path}: {length_text(farthest)} from the origin: east, north, up count from there. Convert UTM and "
                "other projected coordinates to lat, lon, height (gdaltransform -s_srs EPSG:32612 -t_srs EPSG:4979)"
            )
            if origin:
                raise FileError(text)
            warnings.warn(f"{text}; in a frame of your own they are flat and to the grid's scale", KcalWarning, 2)
        return values, origin
    refuse_exchanged(rows, values)
    for row, (lat, lon, height) in zip(rows, values.tolist(), strict=True):
        try:
            place = Origin(lat=lat, lon=lon, height=height)
        except InputError as error:
            height_there = ", unless lon and height are exchanged" if abs(lon) > 180 >= abs(height) else ""
            raise FileError(f"{row.where}: {str(error).removeprefix('origin: ')}{height_there}") from error
        origin = origin or place
    assert origin is not None
    return geodetic_to_enu(values, origin), origin


def refuse_exchanged(rows: Sequence[TableRow], values: Tensor) -> None:
    """Raise `FileError` for lines that lie among the others once latitude and longitude are exchanged."""
    places = values[:, :2]
    middle = places.median(0).values
    # With as many lines of each kind, that of the first line counts as right.
    for center in (middle, places[0]):
        direct, exchanged = ((values - center).abs().amax(1) for values in (places, places.flip(1)))
        wrong = (direct > _APART) & (exchanged < _TOGETHER)
        if bool(wrong.any()) and bool((direct[~wrong] < _TOGETHER).all()) and 2 * int(wrong.sum()) <= len(rows):
            lines = [rows[i] for i in wrong.nonzero()[:, 0].tolist()]
            named = ", ".join(row.name for row in lines[:6]) + (" ..." if len(lines) > 6 else "")
            raise FileError(
                f"{lines[0].where}: latitude and longitude are exchanged ({named}): only then does it lie near the "
                f"other {len(rows) - len(lines)} places"
            )


def _coordinates(row: TableRow, path: str | Path) -> tuple[str, str, str]:
    for columns, other in ((EARTH, LOCAL), (LOCAL, EARTH)):
        if all(column in row.cells for column in columns):
            if any(column in row.cells for column in other):
                raise FileError(f"{path}: lat, lon, height or east, north, up are needed, not both")
            return columns
    raise FileError(f"{path}: the columns lat, lon, height or east, north, up are needed")


def place_sigma(row: TableRow, what: str, otherwise: float | None = None) -> tuple[float, float, float]:
    """How well a place or fix is known along each axis, meters: the cells sigma (or `otherwise`) and sigma_up."""
    level = row.positive("sigma", infinite=True)
    level = otherwise if level is None else level
    if level is None or math.isinf(level):
        raise FileError(f"{row.where}: sigma is empty; write how well the {what} is known, meters")
    up = row.positive("sigma_up") or level
    return level, level, up


@briefly
class MarkedLandmarks(NamedTuple):
    """Landmarks with their marks, and names that have only one of the two."""

    landmarks: Landmarks
    unmarked: tuple[str, ...]
    unsurveyed: tuple[str, ...]


def match_landmarks(survey: Survey, marks: Marks, pixel_sigma: float | Tensor) -> MarkedLandmarks:
    """Match surveyed places and marks by name.

    Args:
        survey: the places.
        marks: with at least one mark of each point.
        pixel_sigma: of a mark along an axis, px; one number, or (N, V) such as `marks.sigmas(0.3)`.

    Raises:
        InputError: no name is in both.

    Example:
        >>> survey = Survey(("mast", "post"), torch.rand(2, 3).double(), torch.ones(2, 3).double(), None)
        >>> marks = Marks(("post", "tree"), torch.rand(2, 2, 2).double())
        >>> found = match_landmarks(survey, marks, pixel_sigma=0.1)
        >>> found.landmarks.names, found.unmarked, found.unsurveyed
        (('post',), ('mast',), ('tree',))
    """
    index = {name: i for i, name in enumerate(marks.names)}
    places = [i for i, name in enumerate(survey.names) if name in index]
    if not places:
        raise InputError(
            f"no surveyed place ({', '.join(survey.names[:3])} ...) has a mark ({', '.join(marks.names[:3])} ...): "
            "the names must be the same in both files"
        )
    common = tuple(survey.names[i] for i in places)
    rows = [index[name] for name in common]
    landmarks = Landmarks(
        names=common,
        points=survey.points[places],
        sigma=survey.sigma[places],
        pixels=marks.pixels[rows],
        pixel_sigma=pixel_sigma[rows] if isinstance(pixel_sigma, Tensor) else pixel_sigma,
    )
    unmarked = tuple(name for name in survey.names if name not in index)
    return MarkedLandmarks(landmarks, unmarked, tuple(name for name in marks.names if name not in common))


def read_features(path: str | Path, pixel_sigma: float, cameras: Sequence[str] = PAIR) -> Features:
    r"""Read matched far features: a table of marks, and what is known of their ranges, if anything.

    Either `range` and `range_sigma`, meters from the rig (`inf` without sigma for a star); or `beyond`, meters than
    which the feature is farther away; or nothing: then it determines the epipolar geometry only.

    Args:
        path: of the table, in either layout of `read_marks`.
        pixel_sigma: of a mark along an axis, px, where the table states none.
        cameras: their names, where each mark has a line.

    Raises:
        FileError: see `read_marks`; a range without its sigma, or with `beyond`.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "features.csv")
        ...     _ = path.write_text("left_u,left_v,right_u,right_v,beyond\n960,540,958,540,20000\n1,2,3,4,\n")
        ...     read_features(path, 0.1).inverse_range.tolist()
        [2.5e-05, 0.0]
    """
    marks = read_marks(path, cameras, more=RANGES)
    rows = [
        TableRow(f"{path}: {name}", name, {column: cells[i] for column, cells in marks.extras.items()})
        for i, name in enumerate(marks.names)
    ]
    known = torch.tensor([inverse_range_of(row) for row in rows], dtype=torch.float64).reshape(-1, 2)
    return Features(
        names=tuple(marks.names),
        pixels=marks.pixels,
        inverse_range=known[:, 0],
        inverse_range_sigma=known[:, 1],
        pixel_sigma=marks.sigmas(pixel_sigma),
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
    places = zip(map(cameras.index, survey.names), survey.points, survey.sigma, strict=True)
    return tuple(MeasuredPosition(camera=camera, point=point, sigma=sigma) for camera, point, sigma in places)


# Read surveyed places from GeoJSON and GPX, which state no accuracy: it must be given.
#
# GeoJSON (RFC 7946): Point features `[longitude, latitude, height]`, heights above the WGS84 ellipsoid, `name` and,
# optionally, `sigma` and `sigma_up` among the properties. GPX: waypoints with `name` and `ele`, which is above sea
# level unless its writer says otherwise, so a geoid's height must be given.


class _Place(NamedTuple):
    name: str
    origin: Origin
    sigma: tuple[float, float] | None


def import_survey(
    path: str | Path, origin: Origin | None = None, *, sigma: float | None = None, geoid: float | None = None
) -> Survey:
    r"""Read surveyed places from `.geojson`, `.json` or `.gpx`; any other file is read as CSV by `read_survey`.

    Args:
        path: of the file.
        origin: of the frame; the first place if left out.
        sigma: standard deviation along each axis in meters, where the file states none.
        geoid: height of the geoid above the WGS84 ellipsoid in meters, which is added to the elevations of a GPX file.

    Raises:
        FileError: it cannot be read, or a place without name, height or accuracy; the place is named.
        InputError: a GPX file without `geoid`, or another one with it.

    Example:
        >>> import json, tempfile
        >>> place = {"type": "Feature", "properties": {"name": "mast", "sigma": 0.02},
        ...          "geometry": {"type": "Point", "coordinates": [72.87, 19.07, 14.0]}}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "survey.geojson")
        ...     _ = path.write_text(json.dumps({"type": "FeatureCollection", "features": [place]}))
        ...     survey = import_survey(path)
        >>> survey.names, survey.origin
        (('mast',), Origin(lat=19.07, lon=72.87, height=14.0))
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if sigma is not None:
        require_positive("sigma", sigma)
    if geoid is not None and suffix != ".gpx":
        raise InputError(f"{path}: heights are ellipsoidal there; a geoid's height is added to those of GPX only")
    if suffix not in (".geojson", ".json", ".gpx"):
        return _read_csv(path, origin, sigma)
    if suffix == ".gpx" and geoid is None:
        raise InputError(
            f"{path}: elevations of GPX are above sea level; give the geoid's height there (0 if they are ellipsoidal)"
        )
    try:
        text = read_text(path, MOST_BYTES)
        if suffix == ".gpx":
            places = _from_gpx(read_xml(text, str(path)), geoid or 0.0)
        else:
            places = _from_geojson(read_json(text.encode(), str(path)))
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise FileError(f"{path}: bad survey: {error}") from error
    if not places:
        raise FileError(f"{path}: no places")
    names = [place.name for place in places]
    for name, count in Counter(names).items():
        if count > 1:
            raise FileError(f"{path}: the name {name!r} occurs twice; names must differ")
    spreads = [_spread(place, sigma, path) for place in places]
    origin = origin or places[0].origin
    geodetic = torch.tensor([[p.origin.lat, p.origin.lon, p.origin.height] for p in places], dtype=torch.float64)
    return Survey(tuple(names), geodetic_to_enu(geodetic, origin), torch.tensor(spreads, dtype=torch.float64), origin)


def _spread(place: _Place, sigma: float | None, path: Path) -> tuple[float, float, float]:
    level, up = place.sigma or (sigma, sigma)
    if level is None or up is None:
        raise FileError(f"{path}: {place.name!r} has no sigma; say how well the places are known, meters")
    if not (0 < level < math.inf and 0 < up < math.inf):
        raise FileError(f"{path}: the sigma of {place.name!r} is {level}, {up}; positive meters are needed")
    return level, level, up


def _from_geojson(content: Any) -> list[_Place]:
    # GDAL and QGIS name the system that RFC 7946 prescribes.
    if (crs := content.get("crs")) and "CRS84" not in str(crs):
        raise ValueError("it has a member crs; RFC 7946 allows WGS84 longitude and latitude only")
    places = []
    for number, feature in enumerate(content["features"], 1):
        properties = feature.get("properties") or {}
        name = str(properties.get("name") or feature.get("id") or number)
        geometry = feature["geometry"]
        if geometry["type"] != "Point":
            raise ValueError(f"{name}: a {geometry['type']}; points are needed")
        if (count := len(geometry["coordinates"])) != 3:
            raise ValueError(f"{name}: [longitude, latitude, height] are needed, got {count} numbers")
        lon, lat, height = (_stated_number(one, f"a coordinate of {name!r}") for one in geometry["coordinates"])
        places.append(_Place(name, _origin(name, lat, lon, height), _stated(properties, name)))
    return places


def _origin(name: str, lat: float, lon: float, height: float) -> Origin:
    try:
        return Origin(lat=lat, lon=lon, height=height)
    except InputError as error:
        raise ValueError(f"{name}: {str(error).removeprefix('origin: ')}") from None


def _stated(properties: dict[str, Any], name: str) -> tuple[float, float] | None:
    if properties.get("sigma") in (None, ""):
        return None
    level = _stated_number(properties["sigma"], f"the sigma of {name!r}")
    up = properties.get("sigma_up")
    return level, level if up in (None, "") else _stated_number(up, f"the sigma_up of {name!r}")


def _stated_number(value: Any, what: str) -> float:
    """A number, also one that a program has written as a text."""
    with contextlib.suppress(ValueError):
        if isinstance(value, int | float | str) and not isinstance(value, bool):
            return float(value)
    raise ValueError(f"{what} is {value!r:.40}; a number is needed")


def _from_gpx(root: xml.etree.ElementTree.Element, geoid: float) -> list[_Place]:
    places = []
    for number, element in enumerate(root.iter(), 1):
        if element.tag.rpartition("}")[2] != "wpt":
            continue
        parts = {child.tag.rpartition("}")[2]: (child.text or "").strip() for child in element}
        name = parts.get("name") or str(number)
        if not parts.get("ele"):
            raise ValueError(f"{name}: no elevation (ele)")
        height = float(parts["ele"]) + geoid
        lat, lon = (float(element.attrib[axis]) for axis in ("lat", "lon"))
        places.append(_Place(name, _origin(name, lat, lon, height), None))
    return places


# Recognize surveys whose coordinates are exchanged or have the wrong sign: landmarks as in a mirror.

# Marks of one camera that are needed to tell; degrees of pitch beyond which a roll says nothing of what is upright.
_LEAST, _STEEP = 5, 60.0
# Times the noise that rays may be off, on average, where three of the marks place a camera.
_ROUGHLY = 10.0
# What is wrong: order and signs of the columns that are right.
_EARTH = {
    "latitude and longitude are exchanged": ((1, 0, 2), (1, 1, 1)),
    "latitudes or longitudes have the wrong sign (south and west are negative)": ((0, 1, 2), (1, -1, 1)),
    "heights count downward": ((0, 1, 2), (1, 1, -1)),
}
_LOCAL = {
    "east and north are exchanged, or one of them has the wrong sign": ((1, 0, 2), (1, 1, 1)),
    "up counts downward": ((0, 1, 2), (1, 1, -1)),
    "north and up are exchanged": ((0, 2, 1), (1, 1, 1)),
    "east and up are exchanged": ((2, 1, 0), (1, 1, 1)),
}


def solve_surveyed(
    data: RigData, origin: Origin | None, options: RigOptions, progress: Callable[[str], None] = lambda _: None
) -> RigResult:
    """`solve_rig`, and where landmarks may be surveyed as in a mirror, an error or a warning that says so.

    Raises:
        InputError: landmarks fit only as in a mirror; or see `solve_rig`.
        DegenerateError: see `solve_rig`.
    """
    try:
        found = solve_rig(data, options, progress)
    except KcalError:
        _, text = _like_mirrored(data, origin, None)
        if text:
            raise InputError(text) from None
        raise
    told, text = _like_mirrored(data, origin, found)
    if told:
        raise InputError(text)
    return dataclasses.replace(found, findings=(*found.findings, Finding("swapped", "doubt", text))) if text else found


def _like_mirrored(data: RigData, origin: Origin | None, found: RigResult | None) -> tuple[bool, str]:
    """Whether landmarks fit better as in a mirror, and what is then exchanged; no text where nothing speaks for it.

    A camera cannot tell flat ground from its mirror image: that is seen alike from below by a camera that hangs upside
    down. Landmarks at several heights contradict each other.

    Args:
        data: what a rig was solved from.
        origin: of its frame; None for local meters.
        found: its solution; None where there is none.
    """
    marks = data.landmarks
    if marks is None or marks.effects or data.positions or data.skyline or data.stars:
        return False, ""
    seen = torch.isfinite(marks.pixels).all(-1)
    camera = int(seen.sum(0).argmax())
    if int(seen[:, camera].sum()) < _LEAST:
        return False, ""
    if found is not None and _upright(found, camera) and not found.left_out and found.variance == 1.0:
        return False, ""
    given = _one_camera(data, marks.points, camera)
    if given is not None and _upright(given, 0):
        return False, ""
    ways = {}
    for text, (order, signs) in (_LOCAL if origin is None else _EARTH).items():
        points = _changed(marks.points, origin, list(order), signs)
        mirrored = None if points is None else _one_camera(data, points, camera)
        if mirrored is not None and _upright(mirrored, 0) and (given is None or mirrored.chi2 < given.chi2 + AS_GOOD):
            ways[text] = mirrored
    if not ways:
        return False, ""
    least = min(way.chi2 for way in ways.values())
    # Of those that fit, the one by which the camera is the most level.
    tilt = {text: sum(map(abs, attitude(ways[text].rotation[0].T)[1:])) for text in ways}
    text = min((text for text in ways if ways[text].chi2 < least + AS_GOOD), key=tilt.__getitem__)
    below = "as given, they contradict each other"
    if given is not None:
        _, _, roll = attitude(given.rotation[0].T)
        below = f"as given, {data.names[camera]} hangs upside down (roll {roll:.0f}°) {_height(given)} them"
    told = given is None or least < given.chi2 - AS_GOOD
    first, last = ("are", "Correct the columns of the survey") if told or found is None else (
        "may be", "Correct the columns of the survey, unless it hangs so: level landmarks do not tell"
    )  # fmt: skip
    return told, (
        f"the landmarks {first} surveyed as in a mirror: {text}; {below}, otherwise they fit and it stands upright "
        f"{_height(ways[text])} them (RMS {ways[text].rms:.2g} px). {last}"
    )


def _one_camera(data: RigData, points: Tensor, camera: int) -> RigResult | None:
    """The solution of one camera from landmarks at these points; None where they contradict each other."""
    marks = data.landmarks
    assert marks is not None
    use = torch.isfinite(marks.pixels[:, camera]).all(-1)
    sigma = torch.as_tensor(marks.pixel_sigma).expand(marks.pixels.shape[:2])[use][:, [camera]]
    names = tuple(name for name, used in zip(marks.names, use.tolist(), strict=True) if used)
    own = Landmarks(
        names=names, points=points[use], sigma=marks.sigma[use], pixels=marks.pixels[use][:, [camera]],
        pixel_sigma=sigma,
    )  # fmt: skip
    # Whether the places can agree is seen at once; only then is it worth solving.
    rays, valid = data.cameras[camera].unproject(own.pixels[:, 0])
    pose = consensus_pose(rays[valid], own.points[valid])
    if pose is None:
        return None
    near = float((own.points - pose[1]).norm(dim=-1).min())
    noise = float(sigma.max()) / float(data.cameras[camera].focal[0].detach()) + float(own.sigma.max()) / near
    if not pose[2] < len(names) * (_ROUGHLY * noise) ** 2:
        return None
    one = RigData(cameras=(data.cameras[camera],), names=(data.names[camera],), landmarks=own)
    try:
        result = solve_rig(one, RigOptions(intrinsics="fixed"))
    except KcalError:
        return None
    return None if result.left_out or result.variance > 1.0 else result


def _changed(points: Tensor, origin: Origin | None, order: list[int], signs: tuple[int, ...]) -> Tensor | None:
    """(N, 3) the places with their coordinates in another order and with other signs; None for no places on Earth."""
    values = points if origin is None else enu_to_geodetic(points, origin)
    values = values[:, order] * torch.tensor(signs, dtype=torch.float64)
    if origin is None:
        return values
    try:
        return geodetic_to_enu(values, Origin.at(values[0]))
    except InputError:
        return None


def _upright(found: RigResult, camera: int) -> bool:
    """Whether a camera is not upside down below the landmarks; where it looks up or down, there is no telling."""
    _, pitch, roll = attitude(found.rotation[camera].T)
    return abs(pitch) > _STEEP or abs(roll) < 90.0 or _over_them(found, camera) > 0.0


def _over_them(found: RigResult, camera: int) -> float:
    assert found.data.landmarks is not None
    return float(found.center[camera, 2] - found.data.landmarks.points[:, 2].mean())


def _height(found: RigResult) -> str:
    above = _over_them(found, 0)
    return f"{length_text(abs(above), digits=2)} {'above' if above > 0 else 'below'}"
