"""Read surveyed places from GeoJSON and GPX, which state no accuracy: it must be given.

GeoJSON (RFC 7946): Point features `[longitude, latitude, height]`, heights above the WGS84 ellipsoid, `name` and,
optionally, `sigma` and `sigma_up` among the properties. GPX: waypoints with `name` and `ele`, which is above sea level
unless its writer says otherwise, so a geoid's height must be given.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from kcal.errors import FileError, InputError
from kcal.files import read_text
from kcal.lens.mounting import Origin
from kcal.locate.geodesy import geodetic_to_enu
from kcal.locate.survey import Survey, read_survey
from kcal.strict_json import MOST_BYTES, read_json
from kcal.strict_xml import read_xml


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
        InputError: a GPX file without `geoid`.

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
    if suffix not in (".geojson", ".json", ".gpx"):
        return read_survey(path, origin)
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
    if content.get("crs"):
        raise ValueError("it has a member crs; RFC 7946 allows WGS84 longitude and latitude only")
    places = []
    for number, feature in enumerate(content["features"], 1):
        properties = feature.get("properties") or {}
        name = str(properties.get("name") or feature.get("id") or number)
        geometry = feature["geometry"]
        if geometry["type"] != "Point":
            raise ValueError(f"{name}: a {geometry['type']}; points are needed")
        position = _position_in(geometry["coordinates"], name)
        places.append(_Place(name, _origin(name, *position), _stated(properties, name)))
    return places


def _position_in(coordinates: Sequence[Any], name: str) -> tuple[float, float, float]:
    if len(coordinates) != 3:
        raise ValueError(f"{name}: [longitude, latitude, height] are needed, got {len(coordinates)} numbers")
    lon, lat, height = (_stated_number(value, f"a coordinate of {name!r}") for value in coordinates)
    return lat, lon, height


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
    try:
        if isinstance(value, int | float | str) and not isinstance(value, bool):
            return float(value)
    except ValueError:
        pass
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
        places.append(
            _Place(name, _origin(name, float(element.attrib["lat"]), float(element.attrib["lon"]), height), None)
        )
    return places
