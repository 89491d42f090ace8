"""Positions as GeoJSON (RFC 7946): one file, or one feature a line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import orjson

from kcal.locate.columns import NUMBERS, TEXTS, PositionColumns
from kcal.locate.positions import Located
from kcal.locate.region import CORNER_DECIMALS, REGION_SHARE, cut_at_antimeridian, ring_blocks
from kcal.locate.stereo import PositionStatus

# What JSON calls a number; "007" is none, and stays a text.
_JSON_NUMBER = re.compile(r"-?(0|[1-9][0-9]*)(\.[0-9]+)?([eE][+-]?[0-9]+)?")
# Whole numbers beyond this lose digits in programs that read every number as a float64.
_LARGEST_WHOLE = 2**53
_POLYGON = (b'{"type":"Feature","geometry":{"type":"Polygon","coordinates":[', b']},"properties":')
_PROPERTIES = ("kind", *TEXTS, *NUMBERS)
_HEIGHT = NUMBERS.index("height_ellipsoidal_m")


def camera_features(run: Located) -> list[bytes]:
    """A feature for each camera; the left one says what holds for all positions."""
    features = []
    for camera in run.cameras:
        properties: dict[str, Any] = {"name": f"{camera.name} camera", "kind": "camera"}
        if camera.name == "left":
            properties |= {
                "heading_deg": run.heading_deg,
                "pitch_deg": run.pitch_deg,
                "roll_deg": run.roll_deg,
                "pixel_sigma": run.pixel_sigma,
                "range_interval": run.interval_note,
                "geoid": run.geoid,
            }
        lat, lon, height = camera.geodetic
        features.append(_feature({"type": "Point", "coordinates": [lon, lat, height]}, properties))
    return features


def point_features(columns: PositionColumns) -> Iterator[bytes]:
    """A feature for each pair of marks; its geometry is null where there is no position."""
    statuses = {int(status): status.name.lower() for status in PositionStatus}
    infinite = set(np.flatnonzero(np.isinf(columns.numbers).any(1)).tolist())
    extras = [(column, list(map(_json_value, cells))) for column, cells in columns.extras.items()]
    rows = zip(columns.names, columns.status.tolist(), columns.reasons, columns.numbers.tolist(), strict=True)
    for place, (name, status, reason, numbers) in enumerate(rows):
        lat, lon, height = numbers[0], numbers[1], numbers[_HEIGHT]
        # JSON has neither NaN nor infinity: both become null.
        values = ("point", name, statuses[status], reason, *numbers)
        properties: dict[str, Any] = dict(zip(_PROPERTIES, values, strict=True))
        if place in infinite:
            properties |= {
                f"{column.removesuffix('_m')}_infinite": True
                for column, value in zip(NUMBERS, numbers, strict=True)
                if value == float("inf")
            }
        if extras:
            properties.update((column, cells[place]) for column, cells in extras)
        yield _feature({"type": "Point", "coordinates": [lon, lat, height]} if lat == lat else None, properties)


def region_features(columns: PositionColumns, run: Located) -> Iterator[bytes]:
    """A polygon for each position: its 95 % region, a long and slightly skewed ellipse."""
    names = iter([columns.names[place] for place in np.flatnonzero(columns.located).tolist()])
    for block in ring_blocks(columns, run.origin, plain=run.feet is not None):
        corners = np.ascontiguousarray(block[..., ::-1]).round(CORNER_DECIMALS)
        beyond = (np.abs(block[..., 1]).max(-1) > 180.0).tolist()
        # Section 3.1.6: closed, counterclockwise; section 3.1.9: a polygon across the antimeridian is cut in two.
        for lon_lat, cut, ring in zip(corners, beyond, block, strict=True):
            properties = {"kind": "region", "name": next(names), "share": REGION_SHARE}
            if cut:
                yield _feature(_cut(ring.tolist()), properties)
            else:
                # Most of the file: copied once.
                text = orjson.dumps(lon_lat, option=orjson.OPT_SERIALIZE_NUMPY)
                yield b"".join([_POLYGON[0], text, _POLYGON[1], orjson.dumps(properties), b"}"])


def _cut(ring: list[tuple[float, float]]) -> dict[str, Any]:
    parts = [[[lon, lat] for lat, lon in part] for part in cut_at_antimeridian(ring)]
    if len(parts) == 1:
        return {"type": "Polygon", "coordinates": parts}
    return {"type": "MultiPolygon", "coordinates": [[part] for part in parts]}


def _feature(geometry: dict[str, Any] | None, properties: dict[str, Any]) -> bytes:
    feature = {"type": "Feature", "geometry": geometry, "properties": properties}
    return orjson.dumps(feature)


def _json_value(cell: str) -> object:
    """The cell of a further column: a number with all its digits where it is one, null where it is empty."""
    if not cell:
        return None
    number = _JSON_NUMBER.fullmatch(cell)
    # One beyond float64 is none for programs that read it.
    if number and (_is_exact(cell) if not (number[2] or number[3]) else math.isfinite(float(cell))):
        return orjson.Fragment(cell)
    return cell


def _is_exact(digits: str) -> bool:
    """Of a whole number; Python refuses to read one of thousands of digits."""
    return len(digits) <= len(str(-_LARGEST_WHOLE)) and abs(int(digits)) <= _LARGEST_WHOLE
