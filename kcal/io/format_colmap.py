"""COLMAP's `cameras.txt` and `cameras.bin`. Pixel (0.5, 0.5) is the center of the first pixel there."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from kcal.files import read_bytes, read_text, write_atomic
from kcal.io.foreign import MOST_BYTES, CameraPose, Hints, ImportedCameras, named_camera, whole_size
from kcal.lens.camera import Camera

MODELS = ("pinhole", "opencv4", "opencv8", "fisheye4")
_HALF = 0.5


class ColmapModel(NamedTuple):
    """A model of COLMAP: its number in binary files, the names of its parameters, and kcal's model."""

    number: int
    parameters: tuple[str, ...]
    model: str


_CENTER, _TWO = ("cx", "cy"), ("fx", "fy", "cx", "cy")
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": ColmapModel(0, ("f", *_CENTER), "pinhole"),
    "PINHOLE": ColmapModel(1, _TWO, "pinhole"),
    "SIMPLE_RADIAL": ColmapModel(2, ("f", *_CENTER, "k1"), "opencv4"),
    "RADIAL": ColmapModel(3, ("f", *_CENTER, "k1", "k2"), "opencv4"),
    "OPENCV": ColmapModel(4, (*_TWO, "k1", "k2", "p1", "p2"), "opencv4"),
    "OPENCV_FISHEYE": ColmapModel(5, (*_TWO, "k1", "k2", "k3", "k4"), "fisheye4"),
    "FULL_OPENCV": ColmapModel(6, (*_TWO, "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), "opencv8"),
    "SIMPLE_RADIAL_FISHEYE": ColmapModel(8, ("f", *_CENTER, "k1"), "fisheye4"),
    "RADIAL_FISHEYE": ColmapModel(9, ("f", *_CENTER, "k1", "k2"), "fisheye4"),
}
WRITTEN = {"pinhole": "PINHOLE", "opencv4": "OPENCV", "opencv8": "FULL_OPENCV", "fisheye4": "OPENCV_FISHEYE"}


def read_colmap(path: Path, hints: Hints) -> ImportedCameras:
    """Read all cameras of a reconstruction; they are named by their numbers."""
    entries = _from_binary(read_bytes(path, MOST_BYTES)) if path.suffix.lower() == ".bin" else _from_text(path)
    if not entries:
        raise ValueError("no cameras")
    cameras = tuple(_colmap_camera(*entry) for entry in entries)
    return ImportedCameras(format="colmap", cameras=cameras)


def _colmap_camera(number: int, name: str, size: tuple[int, int], values: Sequence[float]) -> Camera:
    known = COLMAP_MODELS[name]
    given = dict(zip(known.parameters, values, strict=True))
    fx = given.pop("fx", None) or given["f"]
    fy = given.pop("fy", None) or given.pop("f")
    cx, cy = given.pop("cx") - _HALF, given.pop("cy") - _HALF
    # What is left are coefficients, and kcal has the same names in the same order.
    return named_camera(str(number), (fx, fy, cx, cy), size, known.model, list(given.values()))


def _known(name: str) -> ColmapModel:
    if name not in COLMAP_MODELS:
        raise ValueError(f"camera model {name}: kcal reads {', '.join(COLMAP_MODELS)}")
    return COLMAP_MODELS[name]


def _from_text(path: Path) -> list[tuple[int, str, tuple[int, int], list[float]]]:
    entries = []
    for number, line in enumerate(read_text(path, MOST_BYTES).splitlines(), 1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) < 5 or len(fields) != 4 + len(_known(fields[1]).parameters):
            raise ValueError(f"line {number}: ID MODEL WIDTH HEIGHT and the model's parameters are needed")
        values = [float(field) for field in fields[4:]]
        entries.append((int(fields[0]), fields[1], whole_size(fields[2], fields[3]), values))
    return entries


def _from_binary(data: bytes) -> list[tuple[int, str, tuple[int, int], list[float]]]:
    by_number = {known.number: name for name, known in COLMAP_MODELS.items()}
    try:
        (count,), place, entries = struct.unpack_from("<Q", data), 8, []
        for _ in range(count):
            number, kind, width, height = struct.unpack_from("<IiQQ", data, place)
            if kind not in by_number:
                raise ValueError(f"camera {number} has the model number {kind}, which kcal does not read")
            name = by_number[kind]
            size = len(COLMAP_MODELS[name].parameters)
            values = list(struct.unpack_from(f"<{size}d", data, place + 24))
            place += 24 + 8 * size
            entries.append((number, name, whole_size(width, height), values))
    except struct.error as error:
        raise ValueError(f"the file ends too early: {error}") from None
    if place != len(data):
        raise ValueError(f"{len(data) - place} bytes after the last camera")
    return entries


def write_colmap(cameras: Sequence[Camera], poses: Sequence[CameraPose], path: Path) -> list[Path]:
    """Write the cameras, numbered from 1, as text or, for the suffix .bin, in binary."""
    entries = []
    for number, camera in enumerate(cameras, 1):
        fx, fy, cx, cy, _, *lens = camera.params.tolist()
        entries.append((number, WRITTEN[str(camera.model)], camera.size, [fx, fy, cx + _HALF, cy + _HALF, *lens]))
    if path.suffix.lower() == ".bin":
        data = struct.pack("<Q", len(entries))
        for number, name, size, values in entries:
            data += struct.pack(f"<IiQQ{len(values)}d", number, COLMAP_MODELS[name].number, *size, *values)
        return [write_atomic(path, data)]
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    lines.append(f"# Number of cameras: {len(entries)}")
    for number, name, (width, height), values in entries:
        lines.append(f"{number} {name} {width} {height} {' '.join(map(repr, values))}")
    return [write_atomic(path, "\n".join(lines) + "\n")]
