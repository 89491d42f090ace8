"""Write an interactive map as one HTML file that needs no network, no server and no other file."""

from __future__ import annotations

import base64
import io
import math
import os
import re
import struct
import warnings
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import torch
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import TiffImageFile
from pyproj.exceptions import ProjError
from torch import Tensor

import kcal.locate.positions as places
from kcal.errors import FileError, InputError
from kcal.file_kind import check_pixel_count
from kcal.files import read_bytes, write_atomic
from kcal.locate.stereo import PositionStatus
from kcal.report.pages import from_template
from kcal.report.tables import interval_text, range_sigma, range_unit
from kcal.texts import Unit, length_text, number_text, range_text
from kcal.web.coast import coast_near

# Embed a folder of map tiles or a GeoTIFF in a map that works without a network.

_KINDS = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".webp": "image/webp"}
# Limits that keep a page easy to send: bytes of tiles (finer levels are left out), pixels of an image's longer side.
_MOST_BYTES = 24_000_000
_LONGER_SIDE = 2048
# Level of tiles: one of its pixels is 1 mm.
_FINEST = 27
# TIFF tags of GeoTIFF 1.1 (OGC 19-008r4).
_SCALE, _TIE_POINTS, _MATRIX, _KEYS = 33550, 33922, 34264, 34735
_GEOGRAPHIC, _PROJECTED, _RASTER_TYPE = 2048, 3072, 1025
_POINT_IS_CENTER = 2
Box = tuple[float, float, float, float]


def local_tiles(folder: str | Path, view: Box) -> dict[str, Any]:
    """Embed the tiles `z/x/y.png` of a folder that show the view (south, west, north, east), coarse levels first.

    Raises:
        FileError: no folder, or no tile in it that shows the view.
    """
    folder = Path(folder)
    if not os.path.isdir(folder):
        raise FileError(f"{folder}: no such folder; tiles are expected as {folder}/zoom/x/y.png")
    zooms = [zoom for zoom in range(_FINEST + 1) if (folder / str(zoom)).is_dir()]
    images: dict[str, str] = {}
    used, total = [], 0
    for zoom in zooms:
        (x0, y0), (x1, y1) = _tile(view[2], view[1], zoom), _tile(view[0], view[3], zoom)
        paths = [
            path
            for path in (folder / str(zoom)).glob("*/*")
            if path.suffix.lower() in _KINDS and path.is_file()
            and x0 <= _number(path.parent.name) <= x1 and y0 <= _number(path.stem) <= y1
        ]  # fmt: skip
        total += sum(path.stat().st_size for path in paths)
        if total > _MOST_BYTES:
            break
        if paths:
            used.append(zoom)
        for path in paths:
            data = base64.b64encode(read_bytes(path, _MOST_BYTES)).decode()
            images[f"{zoom}/{path.parent.name}/{path.stem}"] = f"data:{_KINDS[path.suffix.lower()]};base64,{data}"
    if not images:
        raise FileError(f"{folder}: no tile zoom/x/y.png shows this place")
    return {"images": images, "zooms": [used[0], used[-1]], "name": folder.name}


def _number(name: str) -> int:
    """The number that a folder or a file of tiles stands for; -1 for none."""
    return int(name) if re.fullmatch(r"0|[1-9][0-9]{0,8}", name) else -1


def _tile(lat: float, lon: float, zoom: int) -> tuple[int, int]:
    count = 2**zoom
    phi = math.radians(max(-85.0, min(85.0, lat)))
    return int((lon + 180) / 360 * count), int((1 - math.asinh(math.tan(phi)) / math.pi) / 2 * count)


def local_image(path: str | Path) -> dict[str, Any]:
    """Warp a GeoTIFF to Web Mercator, and embed its picture with its bounds in degrees.

    Raises:
        FileError: the file is missing or no image.
        InputError: an image without georeference, or in an unknown coordinate system.
    """
    path = Path(path)
    data = read_bytes(path)
    try:
        with warnings.catch_warnings():
            # Of damaged tags; what is missing is told below.
            warnings.simplefilter("ignore", UserWarning)
            with TiffImageFile(io.BytesIO(data)) as file:
                check_pixel_count(file.size)
                tags = dict(file.tag_v2)
                pixels = np.asarray(file.convert("RGBA"))
    except (OSError, SyntaxError, ValueError, TypeError, KeyError, OverflowError, struct.error) as error:
        raise FileError(f"{path}: cannot read this image as a TIFF: {error}") from error
    matrix, system = _placing(path, tags)
    try:
        to_map = pyproj.Transformer.from_crs(system, "EPSG:3857", always_xy=True)
        height, width = pixels.shape[:2]
        along = np.linspace(0, 1, 33)
        sides = [(along, 0 * along + edge) for edge in (0, 1)]
        border = np.concatenate([np.stack(side, -1) for u, v in sides for side in ((u, v), (v, u))]) * (width, height)
        world = border @ matrix[:, :2].T + matrix[:, 2]
        x, y = to_map.transform(world[:, 0], world[:, 1])
        if not np.isfinite([*x, *y]).all():
            raise InputError(f"{path}: does not lie on a Web Mercator map")
        picture = _warp(pixels, matrix, to_map, (min(x), min(y), max(x), max(y)))
        back = pyproj.Transformer.from_crs("EPSG:3857", "EPSG:4326", always_xy=True)
        (west, east), (south, north) = back.transform((min(x), max(x)), (min(y), max(y)))
    except ProjError as error:
        raise InputError(f"{path}: its coordinate system cannot be used: {error}") from error
    webp = io.BytesIO()
    Image.fromarray(picture).save(webp, "WEBP", quality=80)
    uri = f"data:image/webp;base64,{base64.b64encode(webp.getvalue()).decode()}"
    return {"uri": uri, "bounds": [[south, west], [north, east]], "name": path.name}


def _placing(path: Path, tags: dict[int, Any]) -> tuple[NDArray[np.float64], pyproj.CRS]:
    """Read the (2, 3) matrix from pixel corners to the image's own coordinates, and their system."""
    try:
        keys = np.asarray(tags.get(_KEYS, ()), dtype=int).reshape(-1, 4)[1:]
        code = {int(key): int(value) for key, place, _, value in keys if place == 0}
        epsg = code.get(_PROJECTED) or code.get(_GEOGRAPHIC)
        if epsg is None or epsg == 32767:
            raise InputError(f"{path}: no GeoTIFF with an EPSG coordinate system")
        if _MATRIX in tags:
            matrix = np.asarray(tags[_MATRIX], dtype=float).reshape(4, 4)[:2][:, [0, 1, 3]]
        elif _SCALE in tags and _TIE_POINTS in tags:
            (sx, sy), (i, j, _, x, y) = tags[_SCALE][:2], tags[_TIE_POINTS][:5]
            matrix = np.array([[sx, 0.0, x - i * sx], [0.0, -sy, y + j * sy]], dtype=float)
        else:
            raise InputError(f"{path}: a GeoTIFF without a scale and tie point, or a transformation")
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: its GeoTIFF tags are damaged: {error}") from error
    if not np.isfinite(matrix).all() or not abs(np.linalg.det(matrix[:, :2])) > 0:
        raise InputError(f"{path}: its GeoTIFF tags place all pixels on a line, or nowhere")
    if code.get(_RASTER_TYPE) == _POINT_IS_CENTER:
        matrix[:, 2] -= 0.5 * matrix[:, :2].sum(1)
    try:
        return matrix, pyproj.CRS.from_epsg(epsg)
    except ProjError as error:
        raise InputError(f"{path}: PROJ does not know EPSG:{epsg}") from error


def _warp(
    pixels: NDArray[np.uint8], matrix: NDArray[np.float64], to_map: pyproj.Transformer, box: Box
) -> NDArray[np.uint8]:
    """Take the nearest source pixel for each pixel of a Web Mercator raster; transparent outside."""
    left, bottom, right, top = box
    step = max(right - left, top - bottom) / min(_LONGER_SIDE, max(pixels.shape[:2]))
    columns, rows = max(1, round((right - left) / step)), max(1, round((top - bottom) / step))
    x = left + (np.arange(columns) + 0.5) * (right - left) / columns
    y = top - (np.arange(rows) + 0.5) * (top - bottom) / rows
    across, down = np.meshgrid(x, y)
    world = np.stack(to_map.transform(across, down, direction="INVERSE"), -1)
    place = (world - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T
    u, v = np.floor(np.nan_to_num(place, nan=-1.0, posinf=-1.0, neginf=-1.0)).astype(int).transpose(2, 0, 1)
    inside = (u >= 0) & (v >= 0) & (u < pixels.shape[1]) & (v < pixels.shape[0])
    picture = pixels[v.clip(0, pixels.shape[0] - 1), u.clip(0, pixels.shape[1] - 1)]
    return np.where(inside[..., None], picture, 0).astype(np.uint8)


# Write an interactive map as one HTML file that needs no network, no server and no other file.
#
# Leaflet (BSD-2-Clause, in the folder `leaflet`) draws. All geometry is computed here, on the ellipsoid, and written
# into the page. The page's content policy allows its own scripts only and, without online tiles, forbids it to load
# anything.

# Rings of a site and of the sea; on a bench, and where all is nearer than the first of them, round shares of the range.
ARCS_M = (250.0, 1000.0, 5000.0)
_ROUND = tuple(k * 10.0**e for e in range(-3, 3) for k in (1.0, 2.5, 5.0))
_ONLINE = {
    "url": "https://tile.openstreetmap.org/{z}/{x}/{y}.png",
    "attribution": "© OpenStreetMap contributors, openstreetmap.org/copyright",
}
LatLon = tuple[float, float]


def map_page(
    located: places.Located,
    truth: Tensor | None = None,
    *,
    tiles: str | Path | None = None,
    image: str | Path | None = None,
    online: bool = False,
) -> str:
    """Make the page: positions with 95 % regions, true ones with arrows, cameras, fields of view, arcs of range.

    Args:
        located: from `kcal.locate_points`.
        truth: (N, 3) true east, north, up in meters, NaN where unknown; an arrow leads from each to its estimate.
        tiles: a folder of map tiles `z/x/y.png` (or .jpg, .webp) in Web Mercator; those in view are embedded.
        image: a GeoTIFF to show below the map, for example an orthophoto; embedded, at most 2048 pixels long.
        online: also load tiles of OpenStreetMap when the page is opened with a network.

    Raises:
        InputError: a truth of the wrong shape, or an image without georeference.
        FileError: a folder or file that cannot be read.
    """
    if truth is not None and tuple(truth.shape) != (len(located.positions), 3):
        raise InputError(f"truth: shape ({len(located.positions)}, 3) is needed, got {tuple(truth.shape)}")
    content = _content(located, truth)
    south, west, north, east = _box(content)
    content["bounds"] = [[south, west], [north, east]]
    margin = 0.25 * max(north - south, east - west, 1e-4)
    view = (south - margin, west - margin, north + margin, east + margin)
    content["tiles"] = None if tiles is None else local_tiles(tiles, view)
    content["image"] = None if image is None else local_image(image)
    content["online"] = _ONLINE if online else None
    library = resources.files("kcal.report") / "leaflet"
    style = (library / "leaflet.css").read_text(encoding="utf-8")
    # This page does not show the controls of these pictures.
    for picture in ("images/layers.png", "images/layers-2x.png", "images/marker-icon.png"):
        style = style.replace(f"url({picture})", "none")
    shared, own = resources.files("kcal.web") / "map", resources.files("kcal.report")
    style += "".join(sheet.read_text(encoding="utf-8") for sheet in (shared / "map.css", own / "map_page.css"))
    sources = (library / "leaflet.js", shared / "map.js", own / "map_page.js")
    scripts = [source.read_text(encoding="utf-8") for source in sources]
    return from_template(
        "map_page", style, scripts, "data: https://tile.openstreetmap.org" if online else "data:",
        title=located.count_note, place=located.place, heading=located.heading_deg, located=located,
        with_truth=truth is not None, content=content,
    )  # fmt: skip


def save_map(path: str | Path, located: places.Located, truth: Tensor | None = None, **options: Any) -> Path:
    """Write positions on a map to an .html file that needs no network; for the options see `map_page`.

    Raises:
        InputError: another suffix, or as `map_page`.
        FileError: the file cannot be written.
    """
    check_map_format(path)
    return write_atomic(path, map_page(located, truth, **options))


def check_map_format(path: str | Path) -> None:
    """Raise `InputError` unless `path` ends with .html or .htm."""
    if Path(path).suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: the map is a web page; the file name must end with .html")


def _content(located: places.Located, truth: Tensor | None) -> dict[str, Any]:
    ranges = [p.range_m or p.range_low_m or 0.0 for p in located.positions]
    farthest = max((one for one in ranges if math.isfinite(one)), default=0.0) or 300.0
    reach = 1.15 * farthest
    cameras, edges = [], []
    for view in located.cameras:
        sweep = places.field_azimuths(view)
        if sweep is not None:
            edges += [(float(a) - located.heading_deg + 180) % 360 - 180 for a in sweep[[0, -1]]]
        outline, place = places.field_of_view(view, located.place, reach), places.camera_place(view, located.place)
        cameras.append({"name": view.name, "place": place, "field": outline})
    low, high = (min(edges), max(edges)) if edges else (-180.0, 180.0)
    sweep = torch.linspace(low, high, 90, dtype=torch.float64) + located.heading_deg
    arcs = [
        {"name": range_text(arc), "line": places.map_places(places.level_rim((0, 0, 0), sweep, arc), located.place)}
        for arc in (arcs_within(reach) if located.centers is None else [])
    ]
    bearings = []
    for p, foot in zip(located.positions, located.feet, strict=True):
        if p.azimuth_deg is not None and p.status != PositionStatus.OK:
            ends = torch.tensor([[min(p.range_low_m or 0.0, reach)], [reach]], dtype=torch.float64)
            sight = places.level_rim((0.0, 0.0, 0.0), torch.full((2,), p.azimuth_deg, dtype=torch.float64), 1.0)
            bearings.append(places.map_places(foot + sight * ends, located.place))
    arrows, true = [], []
    for position, row in zip(located.positions, [] if truth is None else truth, strict=truth is not None):
        if not bool(torch.isfinite(row).all()):
            continue
        (spot,) = places.map_places(row[None], located.place)
        true.append(spot)
        if position.enu is not None and position.lat is not None and position.lon is not None:
            miss = torch.tensor(position.enu, dtype=torch.float64) - row.detach().cpu().double()
            azimuth = math.degrees(math.atan2(float(miss[0]), float(miss[1])))
            end = position.lat, places.near(position.lon, located.place.lon)
            arrows.append({"line": [spot, end], "azimuth": azimuth})
    unit = range_unit(located)
    points = [
        {"name": p.name, "place": (p.lat, places.near(p.lon, located.place.lon)), "rows": _popup_rows(p, unit)}
        for p in located.positions
        if p.lat is not None and p.lon is not None
    ]
    rings = [[(lat, places.near(lon, located.place.lon)) for lat, lon in ring] for ring in places.region_rings(located)]
    return {
        "cameras": cameras, "arcs": arcs, "regions": rings, "bearings": bearings, "arrows": arrows, "truth": true,
        "points": points, "coast": coast_near(located.place.lat, located.place.lon),
    }  # fmt: skip


def arcs_within(reach: float) -> list[float]:
    """Ranges at which arcs are drawn, meters.

    Example:
        >>> arcs_within(2000.0), arcs_within(0.5)
        ([250.0, 1000.0], [0.05, 0.1, 0.25])
    """
    known = [arc for arc in ARCS_M if arc < reach]
    return known or [arc for arc in _ROUND if reach / 12.0 < arc < reach]


def _popup_rows(position: places.Position, unit: Unit) -> list[tuple[str, str]]:
    sigma = range_sigma(position)
    up = None if position.covariance is None else math.sqrt(position.covariance[2][2])
    height = position.height or 0.0
    # Six digits are 0.1 m; what is known better has more.
    digits = 6 if (position.cep50_m or 1.0) > 0.05 else 8
    rows = [
        ("latitude", f"{position.lat:.{digits}f}°"),
        ("longitude", f"{position.lon:.{digits}f}°"),
        ("ellipsoidal height", f"{number_text(height, up)} m"),
    ]
    if position.geoid_height is not None:
        rows.append(("above the geoid", f"{number_text(height - position.geoid_height, up)} m"))
    errors = [position.cep50_m, position.cep95_m, position.meters_per_pixel, 0.01 * (position.meters_per_degree or 0.0)]
    cep50, cep95, by_pixel, by_yaw = (length_text(error or 0.0, digits=2) for error in errors)
    rows += [
        ("range", length_text(position.range_m or 0.0, sigma, unit=unit)),
        ("95 % interval", f"{interval_text(position, unit)} {unit.name}"),
        ("CEP50, CEP95", f"{cep50}, {cep95}"),
        ("a pixel is", by_pixel),
        ("0.01° of yaw is", by_yaw),
    ]
    return [*rows, ("", position.reason)] if position.reason else rows


def _box(content: dict[str, Any]) -> tuple[float, float, float, float]:
    spots: list[LatLon] = [*content["truth"], *(one["place"] for one in content["points"] + content["cameras"])]
    spots += [spot for line in content["regions"] + content["bearings"] for spot in line]
    lats, lons = zip(*spots, strict=True)
    return min(lats), min(lons), max(lats), max(lons)
