"""Embed a folder of map tiles or a GeoTIFF in a map that works without a network."""

from __future__ import annotations

import base64
import io
import math
import os
import re
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import TiffImageFile
from pyproj.exceptions import ProjError

from kcal.errors import FileError, InputError
from kcal.files import read_bytes
from kcal.image_size import check_pixel_count

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
        border = np.concatenate(
            [np.stack([along * width, edge * height + 0 * along], -1) for edge in (0, 1)]
            + [np.stack([edge * width + 0 * along, along * height], -1) for edge in (0, 1)]
        )
        world = border @ matrix[:, :2].T + matrix[:, 2]
        x, y = to_map.transform(world[:, 0], world[:, 1])
        if not np.isfinite([*x, *y]).all():
            raise InputError(f"{path}: does not lie on a Web Mercator map")
        picture = _warp(pixels, matrix, to_map, (min(x), min(y), max(x), max(y)))
        back = pyproj.Transformer.from_crs("EPSG:3857", "EPSG:4326", always_xy=True)
        west, south = back.transform(min(x), min(y))
        east, north = back.transform(max(x), max(y))
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
