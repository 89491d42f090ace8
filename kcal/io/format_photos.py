"""Formats of photogrammetry programs: Metashape, COLMAP, Nerfstudio, OpenSfM and Qualisys."""

from __future__ import annotations

import json
import math
import re
import sqlite3
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
import torch

import kcal.io.foreign as foreign
from kcal.errors import InputError
from kcal.files import dump_json, read_bytes, read_head, read_text, write_atomic
from kcal.io.foreign_lenses import LENSES, ForeignCamera, as_written, foreign_camera
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.pose import Pose
from kcal.strict_json import read_json, read_xml

# Agisoft Metashape's XML: a calibration, or the sensors of exported cameras with the covariances of their parameters.
#
#     x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p1 (r² + 2x²) + 2 p2 x y,   u = width / 2 + cx + x' (f + b1) + y' b2
#     y' = y (1 + ...) + p2 (r² + 2y²) + 2 p1 x y,                            v = height / 2 + cy + y' f
#
# Pixel (0.5, 0.5) is the center of the first pixel there. p1 and p2 are OpenCV's p2 and p1 (Metashape's manual,
# appendix D). A fisheye has θ in place of r = tan θ, an equisolid one 2 sin(θ / 2). Older versions multiply the terms
# of p1 and p2 by 1 + p3 r² + p4 r⁴.

# What of kcal's parameters changes with each of Metashape's.
_FRAME = {"f": ("fx", "fy"), "b1": ("fx",), "b2": ("skew",), "cx": ("cx",), "cy": ("cy",), "p1": ("p2",), "p2": ("p1",),
          "k1": ("k1",), "k2": ("k2",), "k3": ("k3",), "k4": ("k7",)}  # fmt: skip
_FISHEYE = {name: own for name, own in _FRAME.items() if name[0] != "p"} | {"k4": ("k4",)}
_OTHERS = ("p3", "p4")


def read_agisoft(path: Path, hints: foreign.Hints) -> foreign.ImportedCameras:
    """Read the adjusted calibration of every sensor; poses are in a frame of the chunk and not read."""
    root = read_xml(read_bytes(path, foreign.MOST_BYTES), str(path))
    sensors = [part for part in root.iter("sensor") if part.find("calibration") is not None] or [root]
    notes = ["the poses of images are not read"] if root.find(".//camera/transform") is not None else []
    cameras, unread = foreign.each_readable(
        (part.get("label") or f"sensor {number}", partial(_agisoft_camera, part, number, notes))
        for number, part in enumerate(sensors)
    )
    return foreign.ImportedCameras(format="agisoft", cameras=cameras, notes=tuple(notes), unread=unread)


def _agisoft_camera(sensor: Element, number: int, notes: list[str]) -> Camera:
    name = sensor.get("label") or f"sensor {sensor.get('id', number)}"
    found = [sensor] if sensor.tag == "calibration" else sensor.findall("calibration")
    if not found:
        raise ValueError("no sensor with a calibration")
    best = next((part for part in found if part.get("class") == "adjusted"), found[0])
    kind = best.get("type") or best.findtext("projection") or "frame"
    kind = "fisheye" if kind == "equidistant_fisheye" else kind
    if kind not in ("frame", "fisheye", "equisolid_fisheye") or best.find("corrections") is not None:
        extra = " with additional corrections" if best.find("corrections") is not None else ""
        raise ValueError(
            f"{name}: a lens of type {kind}{extra}: kcal reads frame, fisheye, equidistant_fisheye and "
            "equisolid_fisheye without corrections"
        )
    own = _FISHEYE if kind == "fisheye" else _FRAME
    size = best.find("resolution")
    stated = best.findtext if size is None else size.get
    width, height = foreign.whole_size(stated("width"), stated("height"))
    given = {tag: foreign.numbers([best.findtext(tag, "0")], 1, tag)[0] for tag in (*_FRAME, *_OTHERS)}
    if kind == "fisheye":
        model = LensModel.named("fisheye4")
    else:
        model = LensModel(numerator=4, tangential=True) if given["k4"] else LensModel.named("opencv5")
    names = ("fx", "fy", "cx", "cy", "skew", *model.names)
    fx, fy, cx, cy, skew, *lens = (sum((given[tag] for tag in own if name in own[tag]), 0.0) for name in names)
    core = (fx, fy, cx + 0.5 * width - 0.5, cy + 0.5 * height - 0.5)
    kinds = {"frame": "frame with p3, p4", "fisheye": "fisheye with p1 to p4", "equisolid_fisheye": "equisolid fisheye"}
    if kind == "equisolid_fisheye" or any(value for tag, value in given.items() if tag not in own):
        kind = kinds[kind]
        terms = [given[tag] for tag in LENSES[kind].names]
        camera = foreign_camera(kind, name, core, (width, height), terms, notes, skew)
        notes[-1] += "" if sensor.find("covariance") is None else "; its error bars are not kept"
        return camera
    camera = foreign.named_camera(name, core, (width, height), model, lens, skew)
    covariance = _sensor_covariance(sensor, own, names)
    if covariance is not None:
        camera.calibration = CameraCalibration(name=name, covariance=covariance)
    return camera


def _sensor_covariance(sensor: Element, own: dict[str, tuple[str, ...]], names: tuple[str, ...]) -> torch.Tensor | None:
    stated = sensor.find("covariance")
    if stated is None:
        return None
    tags = (stated.findtext("params") or "").split()
    strange = [tag for tag in tags if tag not in own]
    if not tags or len(tags) > len(own) or strange:
        raise ValueError(f"covariance: its parameters are {' '.join(tags)[:80]!r}")
    matrix = foreign.numbers((stated.findtext("coeffs") or "").split(), len(tags) ** 2, "covariance")
    moved = torch.tensor([[name in own[tag] for tag in tags] for name in names], dtype=torch.float64)
    spread = torch.tensor(matrix, dtype=torch.float64).reshape(len(tags), len(tags))
    return moved @ (0.5 * (spread + spread.T)) @ moved.T


# COLMAP's `cameras.txt` and `cameras.bin`.

# Pixel (0.5, 0.5) is the center of the first pixel in files of COLMAP and nerfstudio.
_HALF = 0.5


class ColmapModel(NamedTuple):
    """A model of COLMAP: its number in binary files, the names of its parameters, and kcal's model or foreign lens."""

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
    "SIMPLE_FISHEYE": ColmapModel(14, ("f", *_CENTER), "fisheye4"),
    "FISHEYE": ColmapModel(15, _TWO, "fisheye4"),
    # Those that become hybrid lenses; the names are those of `LENSES`.
    "FOV": ColmapModel(7, (*_TWO, "omega"), "fov"),
    "THIN_PRISM_FISHEYE": ColmapModel(10, (*_TWO, "k1", "k2", "p1", "p2", "k3", "k4", "s0", "s2"), "fisheye624"),
    "RAD_TAN_THIN_PRISM_FISHEYE": ColmapModel(11, (*_TWO, *LENSES["rad-tan-thin-prism"].names), "rad-tan-thin-prism"),
    "SIMPLE_DIVISION": ColmapModel(12, ("f", *_CENTER, "k"), "division"),
    "DIVISION": ColmapModel(13, (*_TWO, "k"), "division"),
    "EUCM": ColmapModel(16, (*_TWO, "alpha", "beta"), "eucm"),
    # Known, so that other cameras of a binary file can be read; a panorama is no camera of kcal.
    "EQUIRECTANGULAR": ColmapModel(17, ("w", "h"), ""),
}
_BY_NUMBER = {known.number: name for name, known in COLMAP_MODELS.items()}
WRITTEN = {"pinhole": "PINHOLE", "opencv4": "OPENCV", "opencv8": "FULL_OPENCV", "fisheye4": "OPENCV_FISHEYE",
           "fov": "FOV", "division": "DIVISION", "eucm": "EUCM",
           "rad-tan-thin-prism": "RAD_TAN_THIN_PRISM_FISHEYE"}  # fmt: skip


SQLITE = b"SQLite format 3\0"
Entries = list[tuple[int, str, tuple[int, int], list[float]]]
# Rotation (w, x, y, z) and translation of each camera of a rig, by its number.
Rigs = list[dict[int, Sequence[float]]]
_STILL, _MOST_ROWS = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 10_000


def read_colmap(path: Path, hints: foreign.Hints) -> foreign.ImportedCameras:
    """Read all cameras of a reconstruction or a database; they are named by their numbers.

    Poses are those of the rig, in `rigs.txt` or `rigs.bin` beside the file or in the database, if one has all cameras.
    """
    binary, beside = path.suffix.lower() == ".bin", path.with_name(f"rigs{path.suffix}")
    notes, rigs = list[str](), Rigs()
    if read_head(path, len(SQLITE)) == SQLITE:
        entries, rigs = _from_database(path, notes)
    else:
        entries = _from_binary(read_bytes(path, foreign.MOST_BYTES)) if binary else _from_text(path)
        if beside != path and beside.exists():
            with foreign.reading(beside, "COLMAP rig"):
                rigs = _rigs_in(beside)
    if not entries:
        raise ValueError("no cameras")
    cameras, unread = foreign.each_readable(
        (str(entry[0]), partial(_colmap_camera, *entry, notes)) for entry in entries
    )
    numbers = [entry[0] for entry in entries if str(entry[0]) not in unread]
    whole = next((rig for rig in rigs if len(rig) > 1 and set(numbers) <= set(rig)), None)
    poses = tuple(
        foreign.moved_by(move[:4], [(hints.meters or 1.0) * each for each in move[4:]])
        for move in ([whole[number] for number in numbers] if whole else [])
    )
    if poses and not hints.meters:
        notes.append("lengths of COLMAP's rig are in the unit of its reconstruction: taken as meters (--unit)")
    elif any(len(rig) > 1 for rig in rigs) and not poses:
        notes.append("no rig has all cameras with their poses: no pose is read")
    return foreign.ImportedCameras(format="colmap", cameras=cameras, poses=poses, notes=tuple(notes), unread=unread)


def _from_database(path: Path, notes: list[str]) -> tuple[Entries, Rigs]:
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as base:
        base.execute("PRAGMA trusted_schema = OFF")
        # A view may compute forever.
        tables = {name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}

        def rows(table: str, columns: str, where: str = "1") -> list[Any]:
            if table not in tables:
                return []
            return base.execute(f"SELECT {columns} FROM {table} WHERE {where} LIMIT {_MOST_ROWS}").fetchall()

        cameras = rows("cameras", "camera_id, model, width, height, params, prior_focal_length")
        first = rows("rigs", "rig_id, ref_sensor_id", "ref_sensor_type = 0")
        moves = rows(
            "rig_sensors", "rig_id, sensor_id, sensor_from_rig", "sensor_type = 0 AND sensor_from_rig NOT NULL"
        )
    entries, rigs = Entries(), {rig: dict[int, Sequence[float]]({sensor: _STILL}) for rig, sensor in first}
    for number, kind, width, height, data, known in cameras:
        values = list(struct.unpack(f"<{len(data) // 8}d", data))
        entries.append((number, _BY_NUMBER.get(kind, f"number {kind}"), foreign.whole_size(width, height), values))
        if not known:
            notes.append(f"camera {number}: prior_focal_length is 0, so its focal length is a guess of COLMAP")
    for rig, sensor, move in (one for one in moves if one[2]):
        rigs.setdefault(rig, {})[sensor] = struct.unpack("<7d", move)
    return entries, list(rigs.values())


def _rigs_in(path: Path) -> Rigs:
    """The rigs of `rigs.txt` or `rigs.bin`."""
    if path.suffix.lower() == ".bin":
        data, place = read_bytes(path, foreign.MOST_BYTES), [8]

        def take(code: str) -> Any:
            place[0] += struct.calcsize(code)
            return struct.unpack_from(f"<{code}", data, place[0] - struct.calcsize(code))[0]

        return [_sensors_of(take) for _ in range(*struct.unpack_from("<Q", data))]
    lines = (line.split() for line in read_text(path, foreign.MOST_BYTES).splitlines())
    return [_sensors_of(_taker(iter(line))) for line in lines if line and not line[0].startswith("#")]


def _taker(words: Iterator[str]) -> Callable[[str], Any]:
    return lambda code: {"CAMERA": 0, "IMU": 1}[next(words)] if code == "i" else float(next(words))


def _sensors_of(take: Callable[[str], Any]) -> dict[int, Sequence[float]]:
    """A rig of which `take` gives one value after the other: a kind (i), a number (I), a flag (B) or a length (d)."""
    rig = dict[int, Sequence[float]]()
    for i in range([int(take("I")) for _ in range(2)][1]):
        kind, number = take("i"), int(take("I"))
        move = _STILL if not i else [take("d") for _ in range(7)] if take("B") else None
        if kind == 0 and move:
            rig[number] = move
    return rig


def _colmap_camera(number: int, name: str, size: tuple[int, int], values: Sequence[float], notes: list[str]) -> Camera:
    known = COLMAP_MODELS.get(name)
    if known is None or not known.model:
        readable = ", ".join(name for name, model in COLMAP_MODELS.items() if model.model)
        raise ValueError(f"camera model {name}: kcal reads {readable}")
    given = dict(zip(known.parameters, values, strict=True))
    fx = given.pop("fx", None) or given["f"]
    fy = given.pop("fy", None) or given.pop("f")
    cx, cy = given.pop("cx") - _HALF, given.pop("cy") - _HALF
    # What is left are coefficients, and models of kcal have the same names in the same order.
    names = LENSES[known.model].names if known.model in LENSES else given
    own = [given.get(name, 0.0) for name in names]
    return foreign_camera(known.model, str(number), (fx, fy, cx, cy), size, own, notes)


def _from_text(path: Path) -> Entries:
    entries = []
    for number, line in enumerate(read_text(path, foreign.MOST_BYTES).splitlines(), 1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        known = COLMAP_MODELS.get(fields[1]) if len(fields) > 4 else None
        if (
            len(fields) < 5
            or not re.fullmatch(r"\d+ [A-Z0-9_]+", " ".join(fields[:2]))
            or (known and len(fields) != 4 + len(known.parameters))
        ):
            raise ValueError(f"line {number}: ID MODEL WIDTH HEIGHT and the model's parameters are needed")
        values = [float(field) for field in fields[4:]]
        entries.append((int(fields[0]), fields[1], foreign.whole_size(fields[2], fields[3]), values))
    return entries


def _from_binary(data: bytes) -> Entries:
    try:
        (count,), place, entries = struct.unpack_from("<Q", data), 8, []
        for _ in range(count):
            number, kind, width, height = struct.unpack_from("<IiQQ", data, place)
            if kind not in _BY_NUMBER:
                raise ValueError(f"camera {number} has the model number {kind}, which kcal does not read")
            name = _BY_NUMBER[kind]
            size = len(COLMAP_MODELS[name].parameters)
            values = list(struct.unpack_from(f"<{size}d", data, place + 24))
            place += 24 + 8 * size
            entries.append((number, name, foreign.whole_size(width, height), values))
    except struct.error as error:
        raise ValueError(f"the file ends too early: {error}") from None
    if place != len(data):
        raise ValueError(f"{len(data) - place} bytes after the last camera")
    return entries


def write_colmap(cameras: Sequence[Camera | ForeignCamera], poses: Sequence[Pose], path: Path) -> list[Path]:
    """Write the cameras, numbered from 1, as text, in binary (.bin) or as a rig_config.json (.json).

    With poses there is a `rigs.txt` or `rigs.bin` beside cameras.txt or cameras.bin, in which the first camera is the
    reference sensor. COLMAP's `rig_configurator` takes the rig_config.json, with images in folders of the cameras.
    """
    entries, moves = [], []
    for number, camera in enumerate(cameras, 1):
        name, kind, (fx, fy, cx, cy, _, *lens) = as_written(camera, f"camera{number}")
        entries.append((number, name, WRITTEN[kind], camera.size, [fx, fy, cx + _HALF, cy + _HALF, *lens]))
        if poses:
            step = poses[number - 1].after(poses[0].inverse())
            moves.append([*foreign.quaternion_of(step.rotation), *foreign.plain(step.translation)])
    suffix = path.suffix.lower()
    if suffix == ".json":
        parts: list[dict[str, Any]] = []
        for number, name, kind, _, values in entries:
            move = moves[number - 1] if moves and number > 1 else []
            where = {"cam_from_rig_rotation": move[:4], "cam_from_rig_translation": move[4:]} if move else {}
            parts.append({"image_prefix": f"{name}/", "camera_model_name": kind, "camera_params": values, **where})
        parts[0]["ref_sensor"] = True
        return [write_atomic(path, dump_json([{"cameras": parts}]))]
    if suffix == ".bin":
        data = struct.pack("<Q", len(entries))
        for number, _, kind, size, values in entries:
            data += struct.pack(f"<IiQQ{len(values)}d", number, COLMAP_MODELS[kind].number, *size, *values)
        rig = struct.pack("<QIIiI", 1, 1, len(moves), 0, 1)
        rig += b"".join(struct.pack("<iIB7d", 0, number, 1, *move) for number, move in enumerate(moves[1:], 2))
        paths = [write_atomic(path, data)]
        return paths + ([write_atomic(path.with_name("rigs.bin"), rig)] if moves else [])
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    lines.append(f"# Number of cameras: {len(entries)}")
    for number, _, kind, (width, height), values in entries:
        lines.append(f"{number} {kind} {width} {height} {' '.join(map(repr, values))}")
    paths = [write_atomic(path, "\n".join(lines) + "\n")]
    if moves:
        sensors = (f" CAMERA {number} 1 {' '.join(map(repr, move))}" for number, move in enumerate(moves[1:], 2))
        paths.append(write_atomic(path.with_name("rigs.txt"), f"1 {len(moves)} CAMERA 1{''.join(sensors)}\n"))
    return paths


# nerfstudio's `transforms.json`: intrinsics of one camera, or of each frame. Pixel (0.5, 0.5) is the first center.
#
# `camera_model` names a lens of COLMAP, but the program has two: k1 to k4 of r², r⁴, r⁶, r⁸ with p1 and p2, and
# OpenCV's fisheye. instant-ngp says `is_fisheye`. Both may have a field of view in place of the focal length.

_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
_FIELDS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2",
           "distortion_params", "is_fisheye", "camera_angle_x", "camera_angle_y")  # fmt: skip


def read_nerfstudio(path: Path, hints: foreign.Hints) -> foreign.ImportedCameras:
    """Read the cameras; frames with intrinsics of their own that are equal are one camera."""
    content = foreign.Keys(read_json(read_bytes(path, foreign.MOST_BYTES), str(path)))
    frames = content.get("frames", [])
    shared = {key: content[key] for key in _FIELDS if key in content}
    found: dict[str, dict[str, Any]] = {}
    notes = content.rest()
    for i, frame in enumerate(foreign.Keys(frame) for frame in frames or [{}]):
        values = shared | {key: frame[key] for key in _FIELDS if key in frame}
        notes += frame.rest()
        found.setdefault(json.dumps(values, sort_keys=True), values | {"name": str(frame.get("file_path", i))})
    single = len(found) == 1
    named = {path.stem if single else values.pop("name"): values for values in found.values()}
    cameras, unread = foreign.each_readable(
        (name, partial(_nerfstudio_camera, values, name, hints)) for name, values in named.items()
    )
    if any("transform_matrix" in frame for frame in frames):
        notes.append("the poses of the frames are not kept")
    return foreign.ImportedCameras(
        format="nerfstudio", cameras=cameras, notes=tuple(dict.fromkeys(notes)), unread=unread
    )


def _nerfstudio_camera(values: dict[str, Any], name: str, hints: foreign.Hints) -> Camera:
    kind = str(values.get("camera_model", "OPENCV"))
    fisheye = kind in ("OPENCV_FISHEYE", "fisheye") or values.get("is_fisheye") in (True, 1)
    if kind not in (*_PERSPECTIVE, "OPENCV_FISHEYE", "fisheye"):
        raise ValueError(f"camera_model {kind}: kcal reads {', '.join(_PERSPECTIVE)} and OPENCV_FISHEYE")
    stated_size = foreign.whole_size(values["w"], values["h"]) if {"w", "h"} <= values.keys() else hints.size
    size = foreign.known_size(stated_size)
    given = {key: foreign.numbers(value, 1, key)[0] for key, value in values.items() if key in _NUMBERS}
    if "distortion_params" in values:
        stated = foreign.numbers(values["distortion_params"], 6, "distortion_params")
        given |= dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), stated, strict=True))
    # In place of the focal length there may be the angle of view.
    fx, fy = (
        given.get(f"fl_{axis}") or (0.5 * side / math.tan(0.5 * angle) if angle else 0.0)
        for axis, side in zip("xy", size, strict=True)
        for angle in (given.get(f"camera_angle_{axis}"),)
    )
    if not fx and not fy:
        raise ValueError("neither fl_x nor camera_angle_x is there")
    center = [given.get(key, 0.5 * side) - _HALF for key, side in zip(("cx", "cy"), size, strict=True)]
    stray = [key for key in (("p1", "p2", "k5", "k6") if fisheye else ("k5", "k6")) if given.get(key)]
    if stray:
        raise ValueError(f"{', '.join(stray)}: {'a fisheye' if fisheye else 'a lens of nerfstudio'} has no such term")
    # kcal's name for a fourth radial coefficient; k4 is a denominator's.
    lens = given | {"k7": given.get("k4", 0.0)}
    bent = any(lens.get(key) for key in ("k1", "k2", "p1", "p2")) or kind not in ("PINHOLE", "SIMPLE_PINHOLE")
    known = "fisheye4" if fisheye else "opencv5" if lens.get("k3") else "opencv4" if bent else "pinhole"
    model = LensModel(numerator=4, tangential=True) if lens["k7"] and not fisheye else LensModel.named(known)
    terms = [lens.get(key, 0.0) for key in model.names]
    return foreign.named_camera(name, (fx or fy, fy or fx, *center), size, model, terms)


_NUMBERS = {*_FIELDS} - {"camera_model", "distortion_params", "is_fisheye"}


def write_nerfstudio(cameras: Sequence[Camera], poses: Sequence[Pose], path: Path) -> list[Path]:
    """Write the intrinsics of one camera, and no frames."""
    if len(cameras) != 1:
        raise InputError("transforms.json has one camera; write the cameras one by one")
    camera = cameras[0]
    fx, fy, cx, cy = camera.params[:4].tolist()
    lens = dict(zip(camera.model.names, camera.coefficients.tolist(), strict=True))
    content: dict[str, Any] = {
        "w": camera.size[0],
        "h": camera.size[1],
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx + _HALF,
        "cy": cy + _HALF,
        "camera_model": "OPENCV_FISHEYE" if camera.model.fisheye else "OPENCV",
        **lens,
        "frames": [],
    }
    return [write_atomic(path, dump_json(content))]


# OpenSfM's and OpenDroneMap's `camera_models.json` and `cameras.json`: lengths in units of the image's longer side.

# Coefficients by projection type, in kcal's order, and kcal's model or foreign lens.
_OPENSFM_LENSES = {
    "perspective": (("k1", "k2"), "opencv4"),
    "simple_radial": (("k1",), "opencv4"),
    "radial": (("k1", "k2"), "opencv4"),
    "brown": (("k1", "k2", "p1", "p2", "k3"), "opencv5"),
    "fisheye": (("k1", "k2"), "fisheye4"),
    "fisheye_opencv": (("k1", "k2", "k3", "k4"), "fisheye4"),
    "fisheye62": (LENSES["fisheye624"].names[:8], "fisheye624"),
    "fisheye624": (LENSES["fisheye624"].names, "fisheye624"),
    "dual": (LENSES["dual"].names, "dual"),
}


def read_opensfm(path: Path, hints: foreign.Hints) -> foreign.ImportedCameras:
    """Read all cameras, by their names."""
    content = read_json(read_bytes(path, foreign.MOST_BYTES), str(path))
    if isinstance(content, list):
        content = content[0]
    content = content.get("cameras", content)
    if not content:
        raise ValueError("no cameras")
    notes: list[str] = []
    cameras, unread = foreign.each_readable(
        (name, partial(_opensfm_camera, name, foreign.Keys(value), notes)) for name, value in content.items()
    )
    return foreign.ImportedCameras(format="opensfm", cameras=cameras, notes=tuple(notes), unread=unread)


def _opensfm_camera(name: str, value: foreign.Keys, notes: list[str]) -> Camera:
    kind = str(value["projection_type"])
    if kind not in _OPENSFM_LENSES:
        raise ValueError(f"{name}: projection_type {kind}: kcal reads {', '.join(_OPENSFM_LENSES)}")
    names, model = _OPENSFM_LENSES[kind]
    size = foreign.whole_size(value["width"], value["height"])
    longer = max(size)
    fx = longer * float(value.get("focal_x", value.get("focal")))
    fy = longer * float(value["focal_y"]) if "focal_y" in value else fx
    cx, cy = (
        longer * float(value.get(key, 0.0)) + 0.5 * (side - 1) for key, side in zip(("c_x", "c_y"), size, strict=True)
    )
    lens = [float(value.get(key, 0.0)) for key in names]
    value.rest()
    return foreign_camera(model, name, (fx, fy, cx, cy), size, lens, notes)


def write_opensfm(cameras: Sequence[Camera | ForeignCamera], poses: Sequence[Pose], path: Path) -> list[Path]:
    """Write all cameras, by their names."""
    content: dict[str, Any] = {}
    for i, camera in enumerate(cameras):
        name, model, (fx, fy, cx, cy, _, *values) = as_written(camera, f"camera {i}")
        (width, height), longer = camera.size, max(camera.size)
        kind = {"fisheye4": "fisheye_opencv", "fisheye624": "fisheye624"}.get(model, "brown")
        lens = dict(zip(_OPENSFM_LENSES[kind][0], values, strict=False))
        content[name] = {
            "projection_type": kind,
            "width": width,
            "height": height,
            "focal_x": fx / longer,
            "focal_y": fy / longer,
            "c_x": (cx - 0.5 * (width - 1)) / longer,
            "c_y": (cy - 0.5 * (height - 1)) / longer,
            **{key: lens.get(key, 0.0) for key in _OPENSFM_LENSES[kind][0]},
        }
    return [write_atomic(path, dump_json(content))]


# Qualisys Track Manager's `.qca.txt`: XML with OpenCV's five coefficients of each camera, and its pose in millimeters.
#
# Lengths in the image are 1/64 px; the center of the first pixel is at 31.5/64 px of the sensor, and `fov_video` says
# which part of the sensor the video is. Cameras look along -z there, with y upwards.

_UNITS = 64.0
_FIRST = 31.5 / _UNITS
_CORE = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV", "skew")
_LENS = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2", "radialDistortion3")


def read_qualisys(path: Path, hints: foreign.Hints) -> foreign.ImportedCameras:
    """Read all cameras; those that were not calibrated are left out, with a note."""
    root = read_xml(read_bytes(path, foreign.MOST_BYTES), str(path))
    cameras, poses, notes = [], [], []
    for number, part in enumerate(root.iterfind(".//cameras/camera"), 1):
        name = part.get("serial") or f"camera {number}"
        if part.find("intrinsic") is None or part.get("calibrated") == "false":
            notes.append(f"camera {name} is not calibrated")
            continue
        cameras.append(_qualisys_camera(part, name))
        poses.append(_qualisys_pose(part))
    if not cameras:
        raise ValueError("no calibrated camera")
    return foreign.ImportedCameras(format="qualisys", cameras=tuple(cameras), poses=tuple(poses), notes=tuple(notes))


def _attributes(part: Element, tag: str, names: tuple[str, ...]) -> list[float]:
    found = part.find(tag)
    if found is None:
        raise ValueError(f"a camera has no {tag}")
    return foreign.numbers([found.attrib[name] for name in names], len(names), tag)


def _qualisys_camera(part: Element, name: str) -> Camera:
    left, top, right, bottom = _attributes(part, "fov_video", ("left", "top", "right", "bottom"))
    fx, fy, cx, cy, skew = (value / _UNITS for value in _attributes(part, "intrinsic", _CORE))
    size = foreign.whole_size(right - left + 1.0, bottom - top + 1.0)
    center = cx - _FIRST - left, cy - _FIRST - top
    return foreign.named_camera(name, (fx, fy, *center), size, "opencv5", _attributes(part, "intrinsic", _LENS), skew)


def _qualisys_pose(part: Element) -> Pose:
    names = tuple(f"r{row}{column}" for row in "123" for column in "123")
    axes = np.array(_attributes(part, "transform", names)).reshape(3, 3)
    # From axes to the right, up and backwards to those to the right, down and ahead.
    rotation = np.diag([1.0, -1.0, -1.0]) @ axes
    center = 1e-3 * np.array(_attributes(part, "transform", ("x", "y", "z")))
    return foreign.checked_pose(rotation.tolist(), (-rotation @ center).tolist())
