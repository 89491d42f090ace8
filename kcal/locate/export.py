"""Positions as files: GeoJSON (RFC 7946), CSV, KML and Cursor-on-Target; numbers keep every float64 digit."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

from kcal.errors import InputError
from kcal.files import dump_json, write_atomic
from kcal.locate.cot import to_cot
from kcal.locate.kml import to_kml
from kcal.locate.positions import Located, Position
from kcal.locate.region import REGION_SHARE, cut_at_antimeridian, region_rings


def to_geojson(located: Located) -> dict[str, Any]:
    """A FeatureCollection after RFC 7946: coordinates are [longitude, latitude, ellipsoidal WGS84 height in meters].

    The cameras come first (`kind` is "camera"), then one feature for each pair of marks (`kind` is "point"), and last
    a polygon for each position (`kind` is "region"): its 95 % region, a long and slightly skewed ellipse. A
    pair without a position has a null geometry, its status and the reason. `range_high_m` is null where it is
    infinite, because JSON has no infinity; `range_high_infinite` is then true.

    Example:
        >>> from kcal.lens.mounting import Origin
        >>> from kcal.locate.positions import Viewpoint
        >>> left = Viewpoint(name="left", enu=(0, 0, 0), geodetic=(19.07, 72.87, 14.0), azimuths_deg=None)
        >>> located = Located(positions=(), cameras=(left, left), origin=Origin(lat=19.07, lon=72.87, height=14.0),
        ...                   heading_deg=0.0, pitch_deg=0.0, roll_deg=0.0, pixel_sigma=0.3)
        >>> to_geojson(located)["features"][0]["geometry"]
        {'type': 'Point', 'coordinates': [72.87, 19.07, 14.0]}
    """
    features = []
    for camera in located.cameras:
        properties: dict[str, Any] = {"name": f"{camera.name} camera", "kind": "camera"}
        if camera.name == "left":
            properties |= {
                "heading_deg": located.heading_deg,
                "pitch_deg": located.pitch_deg,
                "roll_deg": located.roll_deg,
                "pixel_sigma": located.pixel_sigma,
                "range_interval": located.interval_note,
                "geoid": located.geoid,
            }
        features.append(_feature(camera.geodetic, properties))
    for position in located.positions:
        place = None
        if position.lat is not None and position.lon is not None and position.height is not None:
            place = (position.lat, position.lon, position.height)
        features.append(_feature(place, {"kind": "point", **_fields(position)}))
    for position, ring in region_rings(located):
        # Section 3.1.6: closed, counterclockwise; section 3.1.9: a polygon across the antimeridian is cut in two.
        parts = [[[lon, lat] for lat, lon in part] for part in cut_at_antimeridian(ring)]
        shape = {"type": "Polygon", "coordinates": parts}
        if len(parts) > 1:
            shape = {"type": "MultiPolygon", "coordinates": [[part] for part in parts]}
        properties = {"kind": "region", "name": position.name, "share": REGION_SHARE}
        features.append({"type": "Feature", "geometry": shape, "properties": properties})
    return {"type": "FeatureCollection", "features": features}


def _feature(place: tuple[float, float, float] | None, properties: dict[str, Any]) -> dict[str, Any]:
    geometry = None
    if place is not None:
        lat, lon, height = place
        geometry = {"type": "Point", "coordinates": [lon, lat, height]}
    if properties.get("range_high_m") == float("inf"):
        properties |= {"range_high_m": None, "range_high_infinite": True}
    if properties.get("cep95_m") == float("inf"):
        properties |= {"cep95_m": None, "cep95_infinite": True}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


# Of east, north, up in square meters; the first letters of the two axes.
_COVARIANCE = ("cov_ee_m2", "cov_en_m2", "cov_eu_m2", "cov_nn_m2", "cov_nu_m2", "cov_uu_m2")


def _upper(position: Position) -> list[float | None]:
    c = position.covariance
    return [None] * 6 if c is None else [c[0][0], c[0][1], c[0][2], c[1][1], c[1][2], c[2][2]]


def _fields(position: Position) -> dict[str, Any]:
    """The values of a position by column name; None where unknown."""
    east, north, up = position.enu or (None, None, None)
    left, right = position.reprojection_px or (None, None)
    return {
        "name": position.name,
        "status": position.status.name.lower(),
        "reason": position.reason,
        "lat": position.lat,
        "lon": position.lon,
        "height_ellipsoidal_m": position.height,
        "geoid_height_m": position.geoid_height,
        "east_m": east,
        "north_m": north,
        "up_m": up,
        "range_m": position.range_m,
        "range_low_m": position.range_low_m,
        "range_high_m": position.range_high_m,
        **dict(zip(_COVARIANCE, _upper(position), strict=True)),
        "cep50_m": position.cep50_m,
        "cep95_m": position.cep95_m,
        "range_m_per_px": position.meters_per_pixel,
        "range_m_per_deg_yaw": position.meters_per_degree,
        "azimuth_deg": position.azimuth_deg,
        "elevation_deg": position.elevation_deg,
        "reprojection_left_px": left,
        "reprojection_right_px": right,
    }


def to_csv(located: Located) -> str:
    """Comma-separated text, one line for each pair; unknown fields are empty and an infinite range is `inf`."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_fields(located.positions[0]))
    for position in located.positions:
        # repr reads back to the same float64; csv would write it so too, but only by accident of str().
        values = _fields(position).values()
        writer.writerow([repr(value) if isinstance(value, float) else value for value in values])
    return text.getvalue()


_FORMATS: dict[str, Callable[[Located], str]] = {
    ".geojson": lambda located: dump_json(to_geojson(located)),
    ".json": lambda located: dump_json(to_geojson(located)),
    ".csv": to_csv,
    ".kml": to_kml,
    ".cot": to_cot,
}


def check_format(path: str | Path) -> None:
    """Raise `InputError` unless the suffix of `path` is one that `write_positions` knows."""
    if Path(path).suffix.lower() not in _FORMATS:
        raise InputError(f"{path}: unknown format; the file name must end with {', '.join(_FORMATS)}")


def write_positions(path: str | Path, located: Located) -> Path:
    """Write positions, atomically, in the format of the suffix: .geojson or .json, .csv, .kml, .cot (Cursor-on-Target).

    Raises:
        InputError: another suffix.
        FileError: the file cannot be written; an old one is then untouched.

    Example:
        >>> import tempfile, torch
        >>> from kcal.lens.mounting import Origin
        >>> from kcal.locate.budget import planned_rig
        >>> from kcal.locate.positions import locate_points
        >>> left, right, _ = planned_rig()(torch.tensor([[0.0, 0.0, 1000.0]]))
        >>> located = locate_points(planned_rig(), left, right, origin=Origin(lat=19.07, lon=72.87, height=14.0),
        ...                         heading_deg=0.0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_positions(Path(folder, "positions.csv"), located).read_text().splitlines()[1][:4]
        '1,ok'
    """
    check_format(path)
    return write_atomic(path, _FORMATS[Path(path).suffix.lower()](located))
